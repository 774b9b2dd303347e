"""Stresses and stress resultants of shells against closed forms, each other, and the balance of forces."""

from functools import cache

import numpy as np
import pytest
import ufl
from mpi4py import MPI
from dolfinx import fem
from numpy.polynomial.legendre import leggauss

from shnapr.hyperelastic import Hyperelastic, neo_hookean
from shnapr.kinematics import dual_frame, midsurface
from shnapr.loads import edge_traction
from shnapr.stress import cauchy, largest_principal, resultants, second_piola, von_mises
from shnapr.svk import StVenantKirchhoff
from shnapr.work import conjugates, internal_tangent, internal_work
from tigar_x import compat
from tigar_x.fem.solve import newton
from tigar_x.fem.time_integration import LoadStepper
from tigar_x.geometry import shapes
from tigar_x.geometry.patch import Patch
from tigar_x.splines.spline import ExtractedSpline
from tigar_x.splines.spline_system import SplineSystem

E, NU, H, MU = 10.0, 0.3, 0.1, 2.0
SVK, RUBBER = StVenantKirchhoff(E, NU, H), Hyperelastic(neo_hookean(MU), H)
MATERIALS = pytest.mark.parametrize("material", [SVK, RUBBER], ids=["St. Venant-Kirchhoff", "neo-Hookean"])
DIMENSIONS = pytest.mark.parametrize("dim", [1, 2], ids=["curve", "surface"])


def values(s, *expressions):
    """Values of UFL expressions at the points of a cell, one array (points, *shape) each."""
    parts = [np.ndindex(*e.ufl_shape) if e.ufl_shape else [()] for e in expressions]
    flat = [e[i] if i else e for e, part in zip(expressions, parts, strict=True) for i in part]
    u = fem.Function(compat.lagrange_space(s.mesh, 2, len(flat), discontinuous=True))
    compat.interpolate(u, ufl.as_vector(flat))
    found, result = u.x.array.reshape(-1, len(flat)), []
    for e in expressions:
        n = int(np.prod(e.ufl_shape, dtype=int))
        result.append(found[:, :n].reshape(-1, *e.ufl_shape))
        found = found[:, n:]
    return result


@cache
def flat(dim, degree=2, elements=1):
    """Straight line, or a plate whose first base vector is not along an axis; a_3 = e_z."""
    if dim == 1:
        patch = shapes.line((0, 0), (2, 1), elements=elements, degree=degree)
    else:
        patch = shapes.parallelogram(
            (0, 0, 0), (1, 1, 0), (-0.5, 1.5, 0), elements=[elements] * 2, degrees=[degree] * 2
        )
    return ExtractedSpline(patch, MPI.COMM_SELF)


@cache
def bent(dim):
    """A rational patch without symmetry."""
    rng = np.random.default_rng(3)
    patch = flat(dim).geometry
    points = patch.points + rng.uniform(-0.1, 0.1, patch.points.shape)
    return ExtractedSpline(Patch.from_points(patch.bases, points, rng.uniform(0.8, 1.3, patch.n)), MPI.COMM_SELF)


def moved(s, F, U=0.0):
    """Displacement by U and then by the homogeneous deformation F."""
    return s.function((s.geometry.control[:, :-1] + U) @ np.asarray(F).T - s.geometry.control[:, :-1])


def noise(s, size=0.05, seed=0):
    return size * np.random.default_rng(seed).uniform(-1, 1, (s.geometry.n, s.nsd))


def rotation(nsd):
    Q = np.linalg.qr(np.random.default_rng(7).normal(size=(nsd, nsd)))[0]
    Q[0] *= np.linalg.det(Q)
    return Q


def frames(s, F):
    """Gram-Schmidt frames of the flat shell before and after F, as rows, without the normal."""
    a = np.diff(s.geometry.points[[0, len(s.geometry.bases[0].greville) - 1]], axis=0)[0]
    b = s.geometry.points[-1] - a
    result = []
    for map_ in (np.eye(s.nsd), np.asarray(F)):
        e_1 = map_ @ a / np.linalg.norm(map_ @ a)
        e_2 = map_ @ b - (map_ @ b @ e_1) * e_1
        result.append(np.array([e_1, e_2 / np.linalg.norm(e_2)][: s.nsd - 1]))
    return result


def assert_constant(found, expected):
    scale = np.abs(expected).max()
    np.testing.assert_allclose(found, np.broadcast_to(expected, found.shape), rtol=0, atol=1e-12 * scale)


# -- any deformation --------------------------------------------------------------------------------------------------


@DIMENSIONS
@MATERIALS
def test_rigid_motions(dim, material):
    """They make no stress, and turn what there is with the frame."""
    s = bent(dim)
    U, Q = noise(s), rotation(dim + 1)

    def everything(y):
        r = resultants(s, material, y)
        return values(s, r.n, r.m, cauchy(s, material, y, -0.5), von_mises(s, material, y, 1.0), r.area_ratio)

    none, strained, turned = (everything(moved(s, F, u)) for F, u in ((Q, 0.0), (np.eye(dim + 1), U), (Q, U)))
    for rest, expected, found in zip(none[:4], strained, turned, strict=False):
        scale = np.abs(expected).max()
        assert scale > 1e-5
        assert np.abs(rest).max() < 1e-11 * scale
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-11 * scale)
    np.testing.assert_allclose(none[4], 1.0, rtol=1e-13)


@DIMENSIONS
@MATERIALS
def test_resultants_are_integrals_of_stress(dim, material):
    """n and m of second Piola-Kirchhoff type; on a curved shell the layers' own frames have to be left first."""
    s = bent(dim)
    y = moved(s, np.eye(dim + 1), noise(s))
    reference, current = midsurface(s), midsurface(s, s.rationalize(y))
    n, m = conjugates(material, reference, current)
    forces, moments = 0 * n, 0 * m
    for level, weight in zip(*leggauss(4), strict=True):
        zeta = float(level) * H / 2
        R = dual_frame(reference.metric - 2 * zeta * reference.curvature if material is RUBBER else reference.metric)
        S = R.T * second_piola(s, material, y, float(level)) * R
        forces += float(weight) * H / 2 * S
        moments += float(weight) * H / 2 * zeta * S
    found = values(s, n, m, forces, moments)
    for exact, integral in ((found[0], found[2]), (found[1], found[3])):
        scale = np.abs(exact).max()
        np.testing.assert_allclose(integral, exact, rtol=0, atol=1e-11 * scale)


def test_prestress_is_in_the_stress():
    """N_0/h + 12 zeta M_0/h^3 in a shell at rest, of both dimensions; a membrane has the same stress on both faces."""
    N, M = (1.1, 0.5, -0.3), (0.02, -0.01, 0.015)
    for dim in (1, 2):
        s, k = flat(dim), 2 * dim - 1
        material = StVenantKirchhoff(E, NU, H, N[:k], M[:k])
        S, r = second_piola(s, material, s.function(), 1.0), resultants(s, material, s.function())
        expected = np.array([[N[0], N[2]], [N[2], N[1]]]) / H + 6 / H**2 * np.array([[M[0], M[2]], [M[2], M[1]]])
        found = values(s, S, r.n, r.m)
        assert_constant(found[0], expected[:dim, :dim])
        assert_constant(found[1], np.array([[N[0], N[2]], [N[2], N[1]]])[:dim, :dim])
        assert_constant(found[2], np.array([[M[0], M[2]], [M[2], M[1]]])[:dim, :dim])
    s = bent(1)
    y = moved(s, np.eye(2), noise(s))
    membrane = StVenantKirchhoff(E, NU, H, bending=False)
    top, bottom = values(s, *(second_piola(s, membrane, y, level) for level in (1.0, -1.0)))
    np.testing.assert_array_equal(top, bottom)


# -- homogeneous deformations of a sheet ------------------------------------------------------------------------------

DEFORMATIONS = {
    "equibiaxial": np.diag([1.3, 1.3, 1.0]),
    "uniaxial": np.diag([1.3, 1.3**-0.5, 1.0]),
    "shear": np.array([[1.1, 0.4, 0.0], [-0.2, 0.8, 0.3], [0.3, 0.1, 1.0]]),
}


def svk_cauchy(F):
    """Plane stress of an embedded sheet with unit normal e_z: the third column of F is the stretched normal."""
    G = F[:, :2]
    strain = (G.T @ G - np.eye(2)) / 2
    S = E / (1 - NU**2) * ((1 - NU) * strain + NU * np.trace(strain) * np.eye(2))
    C_33 = 1 - 2 * NU / (1 - NU) * np.trace(strain)
    return G @ S @ G.T / np.sqrt(np.linalg.det(G.T @ G) * C_33)


def rubber_cauchy(F):
    G = F[:, :2]
    C = G.T @ G
    S = MU * (np.eye(2) - np.linalg.inv(C) / np.linalg.det(C))
    return G @ S @ G.T


@pytest.mark.parametrize("name", list(DEFORMATIONS))
@MATERIALS
def test_stress_of_a_stretched_sheet(material, name):
    s, F = flat(2), DEFORMATIONS[name]
    y, level = moved(s, F), fem.Constant(s.mesh, 0.3)
    r = resultants(s, material, y)
    sigma, equivalent, n, m, area = values(
        s, cauchy(s, material, y, level), von_mises(s, material, y, level), r.n, r.m, r.area_ratio
    )
    in_space = (svk_cauchy if material is SVK else rubber_cauchy)(F)
    e = frames(s, F)[1]
    local = e @ in_space @ e.T
    assert_constant(sigma, local)
    deviator = in_space - np.trace(in_space) / 3 * np.eye(3)
    assert_constant(equivalent, np.sqrt(1.5) * np.linalg.norm(deviator))
    ratio = np.linalg.norm(np.cross(F[:, 0], F[:, 1]))
    assert_constant(area, ratio)
    # the current thickness: J h/area ratio; the energy of a shell gives n = h S in the reference frame
    thinned = 1 if material is RUBBER else np.sqrt(1 - NU / (1 - NU) * (np.sum(F[:, :2] ** 2) - 2)) * ratio
    assert_constant(n, H * thinned * local)
    assert np.abs(m).max() < 1e-13


def test_known_stresses_of_rubber():
    """mu (l^2 - l^-4) under equibiaxial and mu (l^2 - 1/l) under uniaxial tension."""
    np.testing.assert_allclose(rubber_cauchy(DEFORMATIONS["equibiaxial"])[:2, :2], MU * (1.3**2 - 1.3**-4) * np.eye(2))
    np.testing.assert_allclose(
        rubber_cauchy(DEFORMATIONS["uniaxial"])[:2, :2], MU * (1.3**2 - 1 / 1.3) * np.diag([1, 0]), atol=1e-15
    )


@MATERIALS
def test_stress_of_a_stretched_line(material):
    """The generator keeps its length, so that there is stress along it, which von Mises counts."""
    s, stretch = flat(1), 1.2
    y = moved(s, stretch * np.eye(2))
    sigma, equivalent = values(s, cauchy(s, material, y, -1.0), von_mises(s, material, y, -1.0))
    F = np.diag([stretch, 1.0, 1.0])
    both = np.diag((svk_cauchy if material is SVK else rubber_cauchy)(F))[:2]
    assert_constant(sigma, both[:1, None])
    assert_constant(equivalent, np.sqrt(both @ both - both[0] * both[1]))


# -- bending ----------------------------------------------------------------------------------------------------------


def curvilinear_plate(w):
    """A plate whose parameter lines are parabolas, and its displacement by a cubic deflection, exact in degree 6."""

    patch = shapes.interpolated(lambda u, v: (u + 0.2 * v**2, v + 0.3 * u**2, 0.0), [shapes.uniform(6, 1)] * 2)
    s = ExtractedSpline(patch, MPI.COMM_SELF)
    x, y, _ = patch.evaluate(patch.basis.greville).T
    return s, s.function(patch.basis.interpolate(np.outer(w(x, y), [0, 0, 1])))


def test_bending_of_a_plate():
    """First order of m = -D ((1 - nu) grad grad w + nu lap w I), q = -D grad lap w, S = 12 zeta m/h^3."""
    delta = 1e-5
    s, y = curvilinear_plate(lambda x, y: delta * (0.3 * x**2 + 0.4 * x * y + 0.5 * x**3 - 0.2 * x * y**2 + 0.1 * y**3))
    r, E_i = resultants(s, SVK, y), []
    for state in (midsurface(s), midsurface(s, y)):
        E_i.append(state.tangents * dual_frame(state.metric).T)
    top, bottom = second_piola(s, SVK, y, 1.0), cauchy(s, SVK, y, -1.0)
    x, n, m, q, top, bottom = values(
        s, s.F, r.n, *(E_i[1] * T for T in (r.m * E_i[1].T, r.q)), E_i[0] * top * E_i[0].T, E_i[1] * bottom * E_i[1].T
    )
    D = E * H**3 / (12 * (1 - NU**2))
    w_xx, w_xy, w_yy = 0.6 + 3 * x[:, 0], 0.4 - 0.4 * x[:, 1], -0.4 * x[:, 0] + 0.6 * x[:, 1]
    hessian = np.stack([[w_xx, w_xy], [w_xy, w_yy]]).transpose(2, 0, 1)
    expected = -(1 - NU) * hessian - NU * (w_xx + w_yy)[:, None, None] * np.eye(2)
    close = dict(rtol=0, atol=1e-3)
    np.testing.assert_allclose(m[:, :2, :2] / (D * delta), expected, **close)
    np.testing.assert_allclose(q[:, :2] / (D * delta), np.tile([-2.6, -0.6], (len(q), 1)), **close)
    for stress, zeta in ((top, H / 2), (bottom, -H / 2)):
        np.testing.assert_allclose(stress[:, :2, :2] / (12 * zeta * D / H**3 * delta), expected, **close)
    assert np.abs(n).max() < 1e-2 * D * delta / H


@MATERIALS
def test_inflated_ring(material):
    """Strains and curvature of a circle, whose normal a_3 points outwards."""
    stretch, points = 1.2, [(1.0, 0.0), (1.0, 1.0), (0.0, 1.0)]
    s = ExtractedSpline(Patch.from_points([shapes.uniform(2, 1)], points, [1.0, 0.5**0.5, 1.0]), MPI.COMM_SELF)
    y = moved(s, stretch * np.eye(2))
    r = resultants(s, material, y)
    inside, outside, m, q = values(s, *(cauchy(s, material, y, level) for level in (-1.0, 1.0)), r.m, r.q)
    for level, found in ((-1, inside), (1, outside)):
        zeta = level * H / 2
        C = (stretch**2 + 2 * zeta * stretch) / (1 + 2 * zeta)
        if material is RUBBER:
            expected = MU * (C - 1 / C)
        else:  # the strain is linear in zeta, with eps and kappa = B - b = -1 + stretch of the midline
            strain = (stretch**2 - 1) / 2 + zeta * (stretch - 1)
            J = np.sqrt(C * (1 - 2 * NU / (1 - NU) * strain))
            expected = E / (1 - NU**2) * strain * C / J
        assert_constant(found, [[expected]])
    if material is SVK:
        assert_constant(m, [[E / (1 - NU**2) * H**3 / 12 * (stretch - 1) * stretch**2]])
    assert np.abs(m).max() > 1e-5
    assert np.abs(q).max() < 1e-11 * np.abs(m).max()


@pytest.mark.parametrize("material", [SVK, StVenantKirchhoff(E, NU, H, bending_prestress=(1e-3,))])
def test_balance_of_a_bent_cantilever(material):
    """Tangential force n - b m and shear q, per current length, add up to the tip force in any section."""
    patch = shapes.line((0, 0), (1, 0), elements=16, degree=5)
    # clamped without a condition on the stretch, which two layers of all components would contain
    clamp = np.concatenate([patch.side_dofs("u0"), patch.side_dofs("u0", 2, components=[1])])
    s = ExtractedSpline(patch, MPI.COMM_SELF, zero_dofs=clamp)
    y, z = s.function(), ufl.TestFunction(s.V)
    time, P = LoadStepper(y, 1.0), np.array([2e-3, 4e-3])
    load = edge_traction(s, time.t * fem.Constant(s.mesh, P), z, s.ds("u1"))
    tangent = internal_tangent(s, material, y, z, y)
    system = SplineSystem(s, internal_work(s, material, y, z) + load, tangent, unknown=y)
    for step in range(1, 5):
        time.t.value = step / 4
        newton(system, rtol=0.0, atol=1e-12, max_iterations=30)
    r, current = resultants(s, material, y), midsurface(s, s.rationalize(y))
    along = current.tangents[:, 0] / ufl.sqrt(current.metric[0, 0])
    effective = r.n[0, 0] - current.curvature[0, 0] / current.metric[0, 0] * r.m[0, 0]
    total, q, slope = values(s, (effective * along + r.q[0] * current.normal) / r.area_ratio, r.q, along)
    assert np.abs(slope[:, 1]).max() > 0.5  # it is well bent
    assert np.abs(q).max() > 1e-3
    np.testing.assert_allclose(total, np.tile(P, (len(total), 1)), rtol=0, atol=5e-6)


# -- bad input --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("level", [1.1, -2.0, np.nan])
def test_level_outside_the_thickness(level):
    s = flat(1)
    for given in (level, fem.Constant(s.mesh, level)):
        for function in (second_piola, cauchy, von_mises):
            with pytest.raises(ValueError, match=r"^level = .*: a .*number"):
                function(s, SVK, s.function(), given)


@pytest.mark.parametrize("matrix", [[[3.0, -1.0], [-1.0, 2.0]], [[-2.0, 0.0], [0.0, -5.0]], [[1.0, 4.0], [4.0, 1.0]]])
def test_the_largest_principal_value_is_the_largest_eigenvalue(matrix):
    value = largest_principal(ufl.as_matrix(matrix))
    assert value(()) == pytest.approx(np.linalg.eigvalsh(matrix).max(), rel=1e-14)
    assert largest_principal(ufl.as_matrix([[-0.5]]))(()) == -0.5
