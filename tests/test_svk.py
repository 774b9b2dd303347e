"""St. Venant-Kirchhoff shells and their loads: energy, residual and tangent against each other."""

from functools import cache, cached_property

import numpy as np
import pytest
import ufl
from mpi4py import MPI
from dolfinx import fem
from ufl.algorithms import expand_derivatives

from shnapr.loads import dead_load, inertia
from shnapr.svk import StVenantKirchhoff
from shnapr.work import strain_energy, virtual_work
from tigar_x import compat
from tigar_x.geometry import shapes
from tigar_x.geometry.patch import Patch
from tigar_x.splines.spline import ExtractedSpline

COMMON = dict(youngs_modulus=10.0, poisson_ratio=0.3, thickness=0.3)
VALUES = {
    1: COMMON | dict(prestress=[1.1], bending_prestress=[0.2]),
    2: COMMON | dict(prestress=[1.1, 0.5, -0.3], bending_prestress=[0.2, -0.1, 0.15]),
}


def curve_patch(rational=True):
    rng = np.random.default_rng(1)
    flat = shapes.line((0.0, 0.0), (1.0, 0.3), elements=3, degree=2)
    points = flat.points + rng.uniform(-0.1, 0.1, flat.points.shape)
    return Patch.from_points(flat.bases, points, rng.uniform(0.8, 1.3, len(points)) if rational else None)


def plate(noise=0.0):
    flat = shapes.parallelogram((0, 0, 0), (1, 0, 0), (0.3, 0.8, 0), elements=(2, 2), degrees=(2, 2))
    points = flat.points + noise * np.random.default_rng(2).uniform(-1, 1, flat.points.shape)
    return Patch.from_points(flat.bases, points)


PATCHES = pytest.mark.parametrize("patch", [curve_patch(), plate()], ids=["curve", "surface"])


def spline_of(patch, **options):
    return ExtractedSpline(patch, MPI.COMM_SELF, **options)


def assembled(spline, form):
    """Extracted vector, one row per control point."""
    b, result = compat.create_vector(spline.V), spline.M.createVecRight()
    compat.assemble_vector(b, form)
    spline.M.multTranspose(b, result)
    return result.array.reshape(-1, spline.nsd)


class Scene:
    """A shell whose parameters are Constants: energy, residual and tangent as functions of spline coefficients."""

    def __init__(self, patch, **other):
        self.patch, self.spline = patch, spline_of(patch)
        values = VALUES[patch.dim] | other
        numbers = {name: value for name, value in values.items() if isinstance(value, float | list)}
        self.c = {name: fem.Constant(self.spline.mesh, np.asarray(value)) for name, value in numbers.items()}
        self.material = StVenantKirchhoff(**(values | self.c))
        self.y, z = self.spline.function(), ufl.TestFunction(self.spline.V)
        self._R = virtual_work(self.spline, lambda y: strain_energy(self.spline, self.material, y), self.y, z)

    @cached_property
    def _forms(self):
        return compat.compile_forms(strain_energy(self.spline, self.material, self.y), self._R)

    @cached_property
    def _tangent(self):
        return compat.compile_forms(ufl.derivative(self._R, self.y))[0]

    def _set(self, U):
        self.y.x.array[:] = (self.spline.vector.nodes @ U).ravel()

    def energy(self, U):
        self._set(U)
        return compat.assemble_scalar(self._forms[0])

    def residual(self, U):
        self._set(U)
        return assembled(self.spline, self._forms[1])

    def tangent(self, U):
        self._set(U)
        A = compat.create_matrix(self._tangent, "aij")
        compat.assemble_matrix(A, self._tangent)
        A.assemble()
        return A.PtAP(self.spline.M)[:, :]

    def random(self, seed=0, size=0.1):
        return size * np.random.default_rng(seed).uniform(-1, 1, (self.patch.basis.n, self.patch.nsd))

    def rigid(self, U):
        """Coefficients of the displacement U followed by a rotation and a translation."""
        nsd, w = self.patch.nsd, self.patch.weights[:, None]
        Q = np.linalg.qr(np.random.default_rng(7).normal(size=(nsd, nsd)))[0]
        Q[0] *= np.linalg.det(Q)
        return (self.patch.points * w + U) @ Q.T + w * np.arange(1.0, nsd + 1) - self.patch.points * w


@pytest.fixture(scope="module", params=[1, 2], ids=["curve", "surface"])
def shared(request):
    return Scene(curve_patch() if request.param == 1 else plate(noise=0.08))


@pytest.fixture
def scene(shared):
    """The shared scene, whose parameters are put back afterwards."""
    before = {name: c.value.copy() for name, c in shared.c.items()}
    yield shared
    for name, value in before.items():
        shared.c[name].value = value


def test_rigid_motion_costs_nothing(scene):
    U = scene.random()
    reference = scene.energy(U)
    assert reference > 1e-3
    assert abs(scene.energy(scene.rigid(0 * U))) < 1e-12 * reference
    np.testing.assert_allclose(scene.energy(scene.rigid(U)), reference, rtol=1e-12)


def test_internal_forces_balance(scene):
    """No net force and no net moment in any configuration."""
    U, w = scene.random(), scene.patch.weights[:, None]
    force = w * scene.residual(U)
    lever = (scene.patch.points + U / w).T @ force
    scale = np.abs(force).sum()
    assert scale > 1
    assert np.abs(force.sum(axis=0)).max() < 1e-12 * scale
    assert np.abs(lever - lever.T).max() < 1e-12 * scale


@pytest.mark.parametrize("order", [1, 2], ids=["residual", "tangent"])
def test_derivatives_are_slopes(scene, order):
    """Errors of central differences fall with the square of the step, down to 1e-6."""
    U, d = scene.random(), scene.random(2, 1.0)
    f = scene.energy if order == 1 else scene.residual
    exact = np.sum(scene.residual(U) * d) if order == 1 else scene.tangent(U) @ d.ravel()
    slopes = [np.ravel(f(U + eps * d) - f(U - eps * d)) / (2 * eps) for eps in (2e-3, 1e-3, 1e-5)]
    errors = [np.linalg.norm(slope - exact) for slope in slopes]
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2, abs=0.1)
    assert errors[2] < 1e-6 * np.linalg.norm(exact)


@pytest.mark.parametrize("name", list(VALUES[1]))
def test_every_parameter_enters(scene, name):
    U = scene.random()
    W, K = scene.energy(U), scene.tangent(U)
    np.testing.assert_allclose(K, K.T, atol=1e-11 * np.abs(K).max())
    scene.c[name].value = 1.1 * scene.c[name].value
    assert abs(scene.energy(U) - W) > 1e-4 * abs(W)
    assert np.abs(scene.tangent(U) - K).max() > 1e-4 * np.abs(K).max()


def test_bending_can_be_left_out():
    shell, membrane = (Scene(curve_patch(), bending=on, bending_prestress=None) for on in (True, False))
    U = shell.random()
    assert membrane.energy(U) < 0.99 * shell.energy(U)
    K = shell.tangent(U)
    assert np.abs(K - membrane.tangent(U)).max() > 1e-2 * np.abs(K).max()


@PATCHES
@pytest.mark.parametrize("bending", [True, False])
def test_a_membrane_has_no_second_derivatives(patch, bending):
    @cache
    def order(expression):
        here = isinstance(expression, ufl.classes.Grad)
        return here + max((order(operand) for operand in expression.ufl_operands), default=0)

    spline = spline_of(patch)
    values = VALUES[patch.dim] | dict(bending=bending, bending_prestress=None)
    energy = expand_derivatives(strain_energy(spline, StVenantKirchhoff(**values), spline.function()))
    assert max(order(integral.integrand()) for integral in energy.integrals()) == (2 if bending else 1)


def test_energy_of_a_plate():
    """Uniform stretch and shear, then slight bending and twist, of a parallelogram of area 0.8 with a_3 = e_z."""
    scene, (E, nu, h, N, M) = Scene(plate()), (np.array(v) for v in VALUES[2].values())

    def plane_stress(e):
        return 0.8 * E / (2 * (1 - nu**2)) * ((1 - nu) * np.sum(e * e) + nu * np.trace(e) ** 2)

    def prestress(T, e):
        return 0.8 * T @ [e[0, 0], e[1, 1], 2 * e[0, 1]]

    H = np.array([[0.10, 0.25, 0], [-0.05, -0.12, 0], [0, 0, 0]])
    e = 0.5 * (H + H.T + H.T @ H)
    np.testing.assert_allclose(
        scene.energy(scene.patch.points @ H.T), h * plane_stress(e) + prestress(N, e), rtol=1e-12
    )

    # w = k x^2/2 + c x y, with x = s + 0.3 r, y = 0.8 r; the control values of s^2 are products of adjacent knots
    k, c, delta = 0.7, 0.4, 1e-4
    bases = scene.patch.bases
    s, r = np.meshgrid(*(basis.greville for basis in bases), indexing="ij")
    ss, rr = np.meshgrid(*(basis.knots[1:-2] * basis.knots[2:-1] for basis in bases), indexing="ij")
    w = k / 2 * (ss + 0.6 * s * r + 0.09 * rr) + c * 0.8 * (s * r + 0.3 * rr)
    U = delta * w.ravel(order="F")[:, None] * [0, 0, 1]
    kappa = -delta * np.array([[k, c], [c, 0]])
    scene.c["prestress"].value = 0 * N
    up, down = scene.energy(U), scene.energy(-U)
    np.testing.assert_allclose((up + down) / 2, h**3 / 12 * plane_stress(kappa), rtol=1e-5)
    np.testing.assert_allclose((up - down) / 2, prestress(M, kappa), rtol=1e-6)


def test_strip_agrees_with_the_curve():
    """A cylinder strip of depth H without strain along its generator, per unit depth."""
    H, line, across = 0.7, curve_patch(rational=False), plate().bases[1]
    grid = [[*x, H * z] for z in across.greville for x in line.points]
    curve, strip = Scene(line), Scene(Patch.from_points([line.bases[0], across], grid))
    U, layers = curve.random(), len(across.greville)
    V = np.column_stack([np.tile(U, (layers, 1)), np.zeros(layers * len(U))])
    np.testing.assert_allclose(strip.energy(V) / H, curve.energy(U), rtol=1e-11)
    forces = strip.residual(V).reshape(layers, len(U), 3).sum(axis=0)[:, :2]
    np.testing.assert_allclose(forces / H, curve.residual(U), atol=1e-11 * np.abs(forces).max())


def test_virtual_work_carries_no_factor_of_the_level():
    """At y_alpha it is the residual at that displacement; the naive derivative is alpha_f times as large."""
    scene = Scene(curve_patch())
    spline, y, old = scene.spline, scene.y, scene.spline.function()
    alpha = fem.Constant(spline.mesh, 0.6)
    y_alpha, z = alpha * y + (1 - alpha) * old, ufl.TestFunction(spline.V)

    def energy(u):
        return strain_energy(spline, scene.material, u)

    forms = compat.compile_forms(virtual_work(spline, energy, y_alpha, z), ufl.derivative(energy(y_alpha), y, z))
    one, two = scene.random(1), scene.random(2)
    there = scene.residual(0.6 * one + 0.4 * two)
    y.x.array[:], old.x.array[:] = spline.function(one).x.array, spline.function(two).x.array
    scale = np.abs(there).max()
    assert scale > 1e-2
    np.testing.assert_allclose(assembled(spline, forms[0]), there, atol=1e-12 * scale)
    np.testing.assert_allclose(assembled(spline, forms[1]), 0.6 * there, atol=1e-12 * scale)


def test_ways_to_give_a_parameter():
    """Numbers, Constants and expressions over the mesh."""
    spline = spline_of(curve_patch())
    y = spline.function(np.random.default_rng(0).uniform(-0.1, 0.1, (spline.geometry.basis.n, 2)))
    one = fem.Function(compat.lagrange_space(spline.mesh, 1))
    one.x.array[:] = 1.0

    def expression(value):
        return ufl.as_vector([one * v for v in value]) if isinstance(value, list) else one * value

    ways = (lambda value: value, lambda value: fem.Constant(spline.mesh, np.asarray(value)), expression)
    materials = [StVenantKirchhoff(**{name: way(value) for name, value in VALUES[1].items()}) for way in ways]
    forms = compat.compile_forms(*(strain_energy(spline, material, y) for material in materials))
    energies = [compat.assemble_scalar(form) for form in forms]
    assert energies[0] > 1e-3
    np.testing.assert_allclose(energies, energies[0], rtol=1e-13)


@PATCHES
def test_total_load_and_mass(patch):
    """Tested with a constant field, loads give their resultant and inertia mass times acceleration."""
    spline = spline_of(patch)
    force, z, w = np.array([0.3, -2.0, 0.7])[: patch.nsd], ufl.TestFunction(spline.V), patch.weights[:, None]
    load = dead_load(spline, ufl.as_vector(force.tolist()), z)
    mass = inertia(spline, spline.function(w * force), z, density=7.0, thickness=0.2)
    totals = [(w * assembled(spline, form)).sum(axis=0) for form in compat.compile_forms(load, mass)]
    size = spline.node_areas.sum() if patch.dim == 1 else 0.8
    np.testing.assert_allclose(totals[0], -size * force, rtol=1e-12)
    np.testing.assert_allclose(totals[1], 7.0 * 0.2 * size * force, rtol=1e-12)
