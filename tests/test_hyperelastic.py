"""Incompressible hyperelastic shells: energies in closed form, and energy, residual and tangent against each other."""

from functools import cached_property

import numpy as np
import pytest
import ufl
from mpi4py import MPI
from dolfinx import fem
from scipy.integrate import quad
from ufl.algorithms import expand_derivatives

from shnapr.hyperelastic import Hyperelastic, lee_sacks, neo_hookean
from shnapr.loads import follower_pressure
from shnapr.svk import StVenantKirchhoff
from shnapr.work import internal_tangent, internal_work, strain_energy, virtual_work
from tigar_x import compat
from tigar_x.geometry import shapes
from tigar_x.geometry.patch import Patch
from tigar_x.splines.spline import ExtractedSpline

VALUES = dict(c0=3.0, c1=0.8, c2=2.0, thickness=0.06)
EDGES = np.array([[1.0, 0.0, 0.0], [0.3, 0.8, 0.0]])
AREA = 0.8


def plate(noise=0.0):
    flat = shapes.parallelogram((0, 0, 0), *EDGES, elements=(2, 2), degrees=(2, 2))
    rng = np.random.default_rng(2)
    points = flat.points + noise * rng.uniform(-1, 1, (16, 3))
    return Patch.from_points(flat.bases, points, rng.uniform(0.8, 1.3, 16) if noise else None)


def beam(noise=0.0):
    flat = shapes.line((0.0, 0.0), (1.0, 0.3), elements=3, degree=2)
    rng = np.random.default_rng(1)
    points = flat.points + noise * rng.uniform(-1, 1, flat.points.shape)
    return Patch.from_points(flat.bases, points, rng.uniform(0.8, 1.3, len(points)) if noise else None)


class Scene:
    """A shell: energy, residual and tangent as functions of spline coefficients."""

    def __init__(self, patch, make, quadrature_degree=None, **values):
        self.patch = patch
        self.spline = ExtractedSpline(patch, MPI.COMM_SELF, quadrature_degree=quadrature_degree)
        self.c = {name: fem.Constant(self.spline.mesh, value) for name, value in values.items()}
        self.material = make(**self.c)
        self.y, self.z = self.spline.function(), ufl.TestFunction(self.spline.V)

    @property
    def work(self):
        return internal_work(self.spline, self.material, self.y, self.z)

    @cached_property
    def _energy(self):
        return compat.compile_forms(strain_energy(self.spline, self.material, self.y))[0]

    @cached_property
    def _residual(self):
        return compat.compile_forms(self.work)[0]

    @cached_property
    def _tangent(self):
        form = internal_tangent(self.spline, self.material, self.y, self.z, self.y)
        return compat.compile_forms(form)[0]

    def set(self, U):
        self.y.x.array[:] = self.spline.function(U).x.array

    def energy(self, U):
        self.set(U)
        return compat.assemble_scalar(self._energy)

    def residual(self, U, form=None):
        self.set(U)
        b, result = compat.create_vector(self.spline.V), self.spline.M.createVecRight()
        compat.assemble_vector(b, self._residual if form is None else form)
        self.spline.M.multTranspose(b, result)
        return result.array.reshape(-1, self.patch.nsd)

    def tangent(self, U, form=None):
        self.set(U)
        form = self._tangent if form is None else form
        A = compat.create_matrix(form, "aij")
        compat.assemble_matrix(A, form)
        A.assemble()
        return A.PtAP(self.spline.M)[:, :]

    def random(self, seed=0, size=0.04):
        return size * np.random.default_rng(seed).uniform(-1, 1, (self.patch.basis.n, self.patch.nsd))

    def stretched(self, F):
        """Coefficients of the homogeneous deformation x = F X."""
        return self.patch.control[:, :-1] @ (np.asarray(F) - np.eye(self.patch.nsd)).T

    def rigid(self, U):
        """Coefficients of the displacement U followed by a rotation and a translation."""
        nsd, w = self.patch.nsd, self.patch.weights[:, None]
        Q = np.linalg.qr(np.random.default_rng(7).normal(size=(nsd, nsd)))[0]
        Q[0] *= np.linalg.det(Q)
        return (self.patch.points * w + U) @ Q.T + w * np.arange(1.0, nsd + 1) - self.patch.points * w


def soft_tissue(c0, c1, c2, thickness, points=3):
    return Hyperelastic(lee_sacks(c0, c1, c2), thickness, points)


def rubber(mu, thickness, points=3):
    return Hyperelastic(neo_hookean(mu), thickness, points)


@pytest.fixture(scope="module", params=[1, 2], ids=["curve", "surface"])
def shared(request):
    return Scene(beam(0.05) if request.param == 1 else plate(0.05), soft_tissue, **VALUES)


@pytest.fixture
def scene(shared):
    """The shared scene, whose parameters are put back afterwards."""
    yield shared
    for name, value in VALUES.items():
        shared.c[name].value = value


# -- energy, residual, tangent ----------------------------------------------------------------------------------------


def test_rigid_motion_costs_nothing(scene):
    U = scene.random()
    reference, force = scene.energy(U), np.abs(scene.residual(U)).max()
    assert reference > 1e-3
    assert abs(scene.energy(scene.rigid(0 * U))) < 1e-12 * reference
    assert np.abs(scene.residual(scene.rigid(0 * U))).max() < 1e-12 * force
    np.testing.assert_allclose(scene.energy(scene.rigid(U)), reference, rtol=1e-12)


@pytest.mark.parametrize("order", [1, 2], ids=["residual", "tangent"])
def test_derivatives_are_slopes(scene, order):
    """Errors of central differences fall with the square of the step, down to 1e-6."""
    U, d = scene.random(), scene.random(2, 1.0)
    f = scene.energy if order == 1 else scene.residual
    exact = np.sum(scene.residual(U) * d) if order == 1 else scene.tangent(U) @ d.ravel()
    slopes = [np.ravel(f(U + eps * d) - f(U - eps * d)) / (2 * eps) for eps in (1e-3, 5e-4, 1e-5)]
    errors = [np.linalg.norm(slope - exact) for slope in slopes]
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2, abs=0.1)
    assert errors[2] < 1e-6 * np.linalg.norm(exact)


@pytest.mark.parametrize("name", list(VALUES))
def test_every_parameter_enters(scene, name):
    U = scene.random()
    W, r, K = scene.energy(U), scene.residual(U), scene.tangent(U)
    np.testing.assert_allclose(K, K.T, rtol=0, atol=1e-12 * np.abs(K).max())
    scene.c[name].value = 1.1 * VALUES[name]
    assert abs(scene.energy(U) - W) > 1e-4 * abs(W)
    assert np.abs(scene.residual(U) - r).max() > 1e-4 * np.abs(r).max()
    assert np.abs(scene.tangent(U) - K).max() > 1e-4 * np.abs(K).max()


def test_points_through_the_thickness():
    """Gauss's rule converges; one point has no bending stiffness."""

    def bent(points):
        scene = Scene(beam(), lambda **c: rubber(**c, points=points), mu=3.0, thickness=0.2)
        s = scene.patch.points @ [1, 0.3] / 1.09
        return scene.energy(0.4 * (s**2)[:, None] * [-0.3, 1])

    W = [bent(points) for points in (1, 2, 4, 8)]
    errors = np.abs(np.array(W) / W[-1] - 1)[:-1]
    assert errors[0] > 0.02
    assert 1e-7 < errors[1] < 1e-3
    assert errors[2] < 1e-4 * errors[1]


MATERIALS = {
    "St. Venant-Kirchhoff": lambda m: StVenantKirchhoff(10.0, 0.3, 0.2, (1.1, 0.5, -0.3)[: 2 * m - 1]),
    "membrane": lambda m: StVenantKirchhoff(10.0, 0.3, 0.2, bending=False),
    "rubber": lambda m: rubber(3.0, 0.06, 2),
}


@pytest.mark.parametrize("name", list(MATERIALS))
@pytest.mark.parametrize("patch", [beam(0.05), plate(0.05)], ids=["curve", "surface"])
def test_work_is_the_derivative_of_energy(patch, name):
    """Against UFL's derivative of the energy, at the intermediate displacement of a step."""
    scene = Scene(patch, lambda: MATERIALS[name](patch.dim))
    spline, material, y, z = scene.spline, scene.material, scene.y, scene.z
    old, alpha = spline.function(scene.random(3)), fem.Constant(spline.mesh, 0.6)
    y_alpha = alpha * y + (1 - alpha) * old
    direct = virtual_work(spline, lambda u: strain_energy(spline, material, u), y_alpha, z)
    forms = [internal_work(spline, material, y_alpha, z), direct]
    U = scene.random()
    found, expected = (scene.residual(U, form) for form in compat.compile_forms(*forms))
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12 * np.abs(expected).max())
    if patch.dim == 1:
        forms = [internal_tangent(spline, material, y_alpha, z, y), ufl.derivative(direct, y)]
        found, expected = (scene.tangent(U, form) for form in compat.compile_forms(*forms))
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12 * np.abs(expected).max())


def test_strip_agrees_with_the_curve():
    """A cylinder strip of depth H without strain along its generator, per unit depth."""
    H, line, across = 0.7, Patch.from_points(beam().bases, beam(0.05).points), plate().bases[1]
    grid = [[*x, H * z] for z in across.greville for x in line.points]
    strip_patch = Patch.from_points([line.bases[0], across], grid)
    curve, strip = (Scene(patch, soft_tissue, **VALUES) for patch in (line, strip_patch))
    U, layers = curve.random(), len(across.greville)
    V = np.column_stack([np.tile(U, (layers, 1)), np.zeros(layers * len(U))])
    np.testing.assert_allclose(strip.energy(V) / H, curve.energy(U), rtol=1e-11)
    forces = strip.residual(V).reshape(layers, len(U), 3).sum(axis=0)[:, :2]
    np.testing.assert_allclose(forces / H, curve.residual(U), rtol=0, atol=1e-11 * np.abs(forces).max())


# -- closed forms -----------------------------------------------------------------------------------------------------

STRETCHES = {
    "equibiaxial": np.diag([1.3, 1.3, 1.0]),
    "uniaxial": np.diag([1.3, 1.3**-0.5, 1.0]),
    "shear": np.array([[1.1, 0.4, 0.0], [-0.2, 0.8, 0.0], [0.0, 0.0, 1.0]]),
}


@pytest.fixture(scope="module")
def sheet():
    return Scene(plate(), soft_tissue, **VALUES)


@pytest.mark.parametrize("name", list(STRETCHES))
@pytest.mark.parametrize("c1", [0.0, 0.8], ids=["neo-Hookean", "Lee-Sacks"])
def test_energy_of_a_stretched_sheet(sheet, name, c1):
    """I_1 of the sheet with the thickness stretch that incompressibility leaves."""
    sheet.c["c1"].value = c1
    F = STRETCHES[name]
    excess = np.sum(F[:2, :2] ** 2) + np.linalg.det(F[:2, :2]) ** -2 - 3
    psi = 1.5 * excess + c1 / 2 * (np.exp(2.0 * excess**2) - 1)
    assert sheet.energy(sheet.stretched(F)) == pytest.approx(AREA * VALUES["thickness"] * psi, rel=1e-12)


def test_uniaxial_stretch_needs_no_lateral_force(sheet):
    """The lateral load vanishes, and the axial one is h mu (l - 1/l^2) per reference width."""
    sheet.c["c1"].value = 0.0
    stretch, mu, h = 1.3, VALUES["c0"], VALUES["thickness"]
    force = sheet.residual(sheet.stretched(STRETCHES["uniaxial"]))
    virial = force.T @ sheet.patch.points / AREA
    np.testing.assert_allclose(virial, np.diag([h * mu * (stretch - stretch**-2), 0, 0]), rtol=0, atol=1e-13)


def smooth_quarter():
    """Quarter of the unit circle in quadratics that are smooth at the knots, so that no test function has a kink."""
    points = [(1.0, 0.0), (1.0, 1.0), (0.0, 1.0)]
    return Patch.from_points([shapes.uniform(2, 1)], points, [1.0, 0.5**0.5, 1.0]).refined(4)


def ring_energy(mu, h, stretch):
    """Energy of a ring of radius 1 per angle, and its slope, from the metrics r^2 + 2 zeta r of its layers."""

    def density(zeta, slope):
        C = (stretch**2 + 2 * zeta * stretch) / (1 + 2 * zeta)
        return mu * (1 - C**-2) * (stretch + zeta) / (1 + 2 * zeta) if slope else mu / 2 * (C + 1 / C - 2)

    return [quad(density, -h / 2, h / 2, args=(slope,), epsrel=1e-13)[0] for slope in (False, True)]


@pytest.mark.parametrize("h", [0.1, 1e-3])
@pytest.mark.parametrize("stretch", [0.8, 1.5])
def test_inflated_ring(h, stretch):
    """Energy and equilibrium pressure; for a thin ring P R/(mu h) = 1 - 1/l^4."""
    mu = 2.0
    scene = Scene(smooth_quarter(), lambda **c: rubber(**c, points=6), quadrature_degree=14, mu=mu, thickness=h)
    U = (stretch - 1) * scene.patch.control[:, :-1]
    energy, slope = ring_energy(mu, h, stretch)
    assert scene.energy(U) == pytest.approx(np.pi / 2 * energy, rel=1e-10)

    pressure = slope / stretch
    assert pressure / (mu * h) == pytest.approx(1 - stretch**-4, rel=20 * h**2 + 1e-6)
    load = follower_pressure(scene.spline, fem.Constant(scene.spline.mesh, pressure), scene.y, scene.z)
    force = scene.residual(U)
    balance = force + scene.residual(U, compat.compile_forms(load)[0])
    scale = np.abs(force).max()
    assert np.abs(balance[2:-2]).max() < 1e-10 * scale  # what remains acts on the ends
    assert np.abs(force[2:-2]).max() > 0.1 * scale


@pytest.mark.parametrize("patch", [beam(), plate()], ids=["curve", "surface"])
def test_small_strains(patch):
    """Of a flat sheet the neo-Hookean tangent is that of E = 3 mu, nu = 1/2, in tension and in bending."""
    mu, h = 2.0, 0.3
    soft = Scene(patch, rubber, mu=mu, thickness=h)
    linear = Scene(patch, lambda: StVenantKirchhoff(3 * mu, 0.5, h))
    K, expected = soft.tangent(0 * soft.random()), linear.tangent(0 * soft.random())
    np.testing.assert_allclose(K, expected, rtol=0, atol=1e-12 * np.abs(K).max())
    across = expected[patch.nsd - 1 :: patch.nsd, patch.nsd - 1 :: patch.nsd]
    assert np.abs(across).max() > 1e-3 * np.abs(K).max()  # bending is in it
    other = Scene(patch, lambda: StVenantKirchhoff(3 * mu, 0.49, h)).tangent(0 * soft.random())
    assert np.abs(K - other).max() > 1e-3 * np.abs(K).max()


# -- what may be given ------------------------------------------------------------------------------------------------


def test_energy_of_the_user():
    """Written in C, with a pressure term that incompressibility makes vanish with its derivatives."""
    mu, h = 2.0, 0.3

    def psi(E):
        C = 2 * E + ufl.Identity(3)
        return mu / 2 * (ufl.tr(C) - 3) + 7.0 * (ufl.det(C) - 1)

    soft, own = (Scene(plate(0.05), lambda p=p: Hyperelastic(p, h, 3)) for p in (neo_hookean(mu), psi))
    U = soft.random()
    assert own.energy(U) == pytest.approx(soft.energy(U), rel=1e-12)
    scale = np.abs(soft.residual(U)).max()
    np.testing.assert_allclose(own.residual(U), soft.residual(U), rtol=0, atol=1e-12 * scale)


def test_direction_of_the_user():
    """An energy of fibres along the first parameter sees that direction and no other."""
    k, h, stretch = 5.0, 0.2, 1.2
    scene = Scene(plate(), lambda: Hyperelastic(lambda E: k / 2 * E[0, 0] ** 2, h))
    strain = (stretch**2 - 1) / 2
    along, across = (scene.energy(scene.stretched(np.diag(d))) for d in ([stretch, 1, 1], [1, stretch, 1]))
    assert along == pytest.approx(AREA * h * k / 2 * strain**2, rel=1e-12)
    assert abs(across) < 1e-12 * along


def test_parameters_may_vary_in_space():
    """Thickness and modulus linear in the first parameter, over which the energy is integrated."""
    scene = Scene(plate(), lambda: None)
    s = ufl.SpatialCoordinate(scene.spline.mesh)[0]
    scene.material = rubber(2 + s, 0.1 * (1 + s))
    psi = 0.5 * (2 * 1.2**2 + 1.2**-4 - 3)
    U = scene.stretched(np.diag([1.2, 1.2, 1.0]))
    assert scene.energy(U) == pytest.approx(AREA * psi * 0.1 * (2 + 3 / 2 + 1 / 3), rel=1e-12)


@pytest.mark.parametrize("constant", [False, True], ids=["number", "Constant"])
@pytest.mark.parametrize(
    ("name", "value"),
    [("mu", 0.0), ("mu", np.nan), ("c0", 0.0), ("c1", -1.0), ("c2", -0.1), ("c2", np.inf), ("thickness", 0.0)],
)
def test_parameters_out_of_range(name, value, constant):
    given = fem.Constant(Scene(beam(), lambda: None).spline.mesh, value) if constant else value
    values = dict(c0=1.0, c1=1.0, c2=1.0, thickness=0.1) | {name: given}
    with pytest.raises(ValueError, match=rf"^{name} = .*{value}.* required"):
        rubber(given, 0.1) if name == "mu" else soft_tissue(**values)


def test_other_bad_input():
    with pytest.raises(ValueError, match=r"^psi = 3\.0: a function"):
        Hyperelastic(3.0, 0.1)
    for points in (0, 2.5):
        with pytest.raises(ValueError, match=rf"^points = {points}: an integer >= 1"):
            Hyperelastic(neo_hookean(1.0), 0.1, points)


def test_stress_does_not_know_how_a_shear_is_written():
    """A psi of one off-diagonal entry alone is that of their mean, as E is symmetric."""
    E = ufl.as_matrix([[0.1, 0.05], [0.05, -0.2]])
    one, both = (
        Hyperelastic(psi, 0.1).second_piola(E, 0.0)
        for psi in (
            lambda E: 3 * E[0, 1] ** 2 + E[0, 0] ** 2,
            lambda E: 1.5 * (E[0, 1] ** 2 + E[1, 0] ** 2) + E[0, 0] ** 2,
        )
    )
    found, expected = (
        [[float(expand_derivatives(S[i, j])(())) for j in range(2)] for i in range(2)] for S in (one, both)
    )
    np.testing.assert_allclose(found, expected, rtol=1e-14)
    assert found[0][1] == found[1][0] != 0.0
