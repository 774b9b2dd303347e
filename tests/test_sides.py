"""Integrals over sides against closed forms and the divergence theorem, and data on sides."""

from functools import cache

import numpy as np
import pytest
import ufl
from splines import PATCHES, energy, half_disc, integral, quarter, radial, rectangle, turned

from tigar_x.geometry import shapes
from tigar_x.geometry.bspline import BSplineBasis, open_knots
from tigar_x.geometry.gluing import glued
from tigar_x.geometry.multipatch import disjoint
from tigar_x.geometry.patch import Patch
from tigar_x.splines.sides import named_or_outer
from tigar_x.splines.spline import ExtractedSpline
from tigar_x.splines.spline_system import SplineSystem, solve_linear

pytestmark = pytest.mark.mpi

RIM = {"rim": (1, 1)}


def shell():
    """Quarter of a thick tube of height 3 between the radii 1 and 2."""
    ring = quarter([(1.0, None), (2.0, None)])
    points = np.concatenate([np.column_stack([ring.points, np.full(ring.n, z)]) for z in (0.0, 3.0)])
    bases = (*ring.bases, BSplineBasis(1, open_knots(1, [0, 1])))
    return Patch.from_points(bases, points, np.tile(ring.weights, 2)).refined(1, 2, 1)


def disc():
    """Unit disc with a pole, and a seam that is glued."""
    whole = turned(*radial(2, 2), quarters=4)
    return glued(Patch(whole.bases, whole.control, RIM), within=True)


GEOMETRIES = {
    "line": lambda: shapes.line((1, 2), (4, 6), elements=4, degree=2),
    "annulus": PATCHES["annulus"],
    "cylinder": PATCHES["cylinder"],
    "shell": shell,
    "disc": disc,
    "half disc": half_disc,
    "joined": lambda: glued(
        rectangle((1, 2), (-1, 0)), quarter([(1.0, None), (2.0, None)]).with_degree(2).refined(1, 2)
    ),
    "apart": lambda: disjoint(rectangle((0, 1), (0, 2)), rectangle((3, 5), (0, 1))),
}


@cache
def spline(name, cells="tensor"):
    geometry = GEOMETRIES[name]()
    return ExtractedSpline(geometry, cells=cells, quadrature_degree=16 if geometry.dim < 3 else 9)


# -- lengths and areas ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "sizes"),
    [
        ("line", {"u0": 1, "u1": 1}),
        ("annulus", {"u0": 1, "u1": 1, "v0": np.pi / 2, "v1": np.pi}),
        ("cylinder", {"u0": 2, "u1": 2, "v0": np.pi / 2, "v1": np.pi / 2}),
        ("shell", {"u0": 3, "u1": 3, "v0": 1.5 * np.pi, "v1": 3 * np.pi, "w0": 0.75 * np.pi, "w1": 0.75 * np.pi}),
        ("half disc", {"u0": 1, "u1": 1, "v0": 0, "v1": np.pi}),
        ("disc", {"v1": 2 * np.pi, "rim": 2 * np.pi, "v0": 0}),
        ("apart", {"u0": 3, "u1": 3, "v0": 3, "v1": 3}),
    ],
)
def test_sizes_of_sides(name, sizes):
    s = spline(name)
    for side, size in sizes.items():
        assert integral(1.0 * s.ds(side)) == pytest.approx(size, rel=1e-8, abs=1e-14)
    whole = sum(size for side, size in sizes.items() if side != "rim")
    assert integral(1.0 * s.ds()) == pytest.approx(whole, rel=1e-8)
    some = list(sizes)[:2]
    assert integral(1.0 * s.ds(*some)) == pytest.approx(sum(sizes[side] for side in some), rel=1e-8)


@pytest.mark.parametrize(("name", "side", "size"), [("annulus", "v1", np.pi), ("shell", "v1", 3 * np.pi)])
def test_sides_of_simplices(name, side, size):
    s = spline(name, "simplex")
    assert integral(1.0 * s.ds(side)) == pytest.approx(size, rel=1e-6)
    assert integral(s.F[0] * s.ds(side)) == pytest.approx(integral(spline(name).F[0] * spline(name).ds(side)), rel=1e-6)


def test_sides_of_one_patch():
    """Glued sides are no boundary; by name they are still there, once for each patch."""
    s = spline("joined")
    assert integral(1.0 * s.ds()) == pytest.approx(2 + 1 + 1 + 1.5 * np.pi, rel=1e-9)
    assert integral(1.0 * s.ds(patch=0)) == pytest.approx(3, rel=1e-12)
    assert integral(1.0 * s.ds("v1")) == pytest.approx(1 + np.pi, rel=1e-9)
    assert integral(1.0 * s.ds("v1", patch=0)) == pytest.approx(1, rel=1e-12)
    assert integral(1.0 * s.ds("v1", patch=1)) == pytest.approx(np.pi, rel=1e-9)
    assert integral(s.F[0] * s.ds("u1", "v1", patch=0)) == pytest.approx(2 + 1.5, rel=1e-12)


@pytest.mark.parametrize(
    ("name", "sides", "patch", "message"),
    [
        ("annulus", ["rim"], None, r"name = 'rim': one of 'u0', 'u1', 'v0', 'v1' is required"),
        ("annulus", ["u0"], 1, r"patch = 1: one of None, 0"),
        ("annulus", [], 1, r"patch = 1: one of 0 is required"),
        ("disc", ["w0"], None, r"name = 'w0': one of 'u0', 'u1', 'v0', 'v1', 'rim'"),
        ("line", ["v0"], None, r"name = 'v0': one of 'u0', 'u1'"),
        ("joined", ["u0"], 2, r"patch = 2: one of 0, 1 is required"),
        ("joined", [], 2, r"patch = 2: one of 0, 1 is required"),
    ],
)
def test_unknown_sides(name, sides, patch, message):
    for use in (spline(name).ds, lambda *names, patch: spline(name).project_boundary(1.0, *names, patch=patch)):
        with pytest.raises(ValueError, match=message):
            use(*sides, patch=patch)


# -- normals ----------------------------------------------------------------------------------------------------------


def field(s):
    """A field on a curve or in the space that a spline fills; tangential to the cylinder."""
    x = s.F
    if s.dim == 1:
        return ufl.as_vector([x[0] ** 2, x[1]])
    if s.nsd == 2:
        return ufl.as_vector([x[0] ** 2 * x[1] + x[1], x[1] ** 2 - x[0]])
    if s.dim == 2:
        return ufl.as_vector([-x[1] * x[0], x[0] * x[0], x[2] ** 2 * x[1]])
    return ufl.as_vector([x[0] ** 2 * x[1], x[1] * x[2] + x[0], x[2] ** 2 - x[1]])


@pytest.mark.parametrize("name", GEOMETRIES)
def test_divergence_theorem(name):
    s = spline(name)
    v = field(s)
    inside, outside = integral(s.div(v) * s.dx), integral(ufl.dot(v, s.side_normal) * s.ds())
    assert outside == pytest.approx(inside, rel=1e-7, abs=1e-11)
    size = integral(abs(ufl.dot(v, s.side_normal)) * s.ds())
    assert size > 0.5
    assert abs(integral(-ufl.dot(v, s.side_normal) * s.ds()) - inside) > 0.1 * size or abs(inside) < 0.1 * size


@pytest.mark.parametrize("name", ["annulus", "shell"])
def test_divergence_theorem_on_simplices(name):
    s = spline(name, "simplex")
    v = field(s)
    assert integral(ufl.dot(v, s.side_normal) * s.ds()) == pytest.approx(integral(s.div(v) * s.dx), rel=1e-5)


@pytest.mark.parametrize(("name", "side", "sign"), [("annulus", "v1", 1), ("annulus", "v0", -1), ("shell", "v0", -1)])
def test_normals_point_outwards(name, side, sign):
    s = spline(name)
    r = ufl.sqrt(s.F[0] ** 2 + s.F[1] ** 2)
    radial_vector = ufl.as_vector([s.F[0] / r, s.F[1] / r, *([0.0] * (s.nsd - 2))])
    error = s.side_normal - sign * radial_vector
    assert integral(ufl.dot(error, error) * s.ds(side)) < 1e-24


# -- data on sides ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["line", "annulus", "cylinder", "disc", "joined"])
@pytest.mark.parametrize("vector", [False, True])
def test_data_on_the_boundary(name, vector):
    """Data of the space are met exactly; all coefficients that are not on the boundary vanish."""
    s = spline(name)
    data = s.F if vector else 1.0 + 2.0 * s.F[0] - s.F[1]
    u = s.project_boundary(data)
    gap = s.rationalize(u) - data
    assert integral(ufl.inner(gap, gap) * s.ds()) < 1e-20
    U = s.free(s.nsd if vector else 1).coefficients(u)
    on_sides = np.concatenate([s.geometry.side_functions(*place) for place in named_or_outer(s.geometry, (), None)])
    assert np.abs(np.delete(U, on_sides, axis=0)).max(initial=0.0) < 1e-11
    assert np.abs(U[on_sides]).max() > 0.5


def test_data_on_one_side():
    s = spline("joined")
    u = s.project_boundary(1.0, "u1", patch=0)
    assert integral(s.rationalize(u) * s.ds("u1", patch=0)) == pytest.approx(1.0, rel=1e-12)
    assert integral(s.rationalize(u) ** 2 * s.ds("v0", patch=1)) < 1e-24
    f = ufl.sin(3.0 * s.F[1])  # not in the space: the least squares fit, whose error is orthogonal to constants
    u = s.project_boundary(f, "u1", patch=0)
    assert integral((s.rationalize(u) - f) ** 2 * s.ds("u1", patch=0)) > 1e-8
    assert abs(integral((s.rationalize(u) - f) * s.ds("u1", patch=0))) < 1e-12


def test_data_and_their_slopes():
    """Two rows of coefficients meet the values of a field of the space and its derivative across the boundary."""
    s = spline("apart")
    f = s.F[0] ** 2 - s.F[1] * s.F[0] + 2.0 * s.F[1] ** 2
    n = s.side_normal
    gaps = []
    for u in (s.project_boundary(f, slope_length=0.5), s.project_boundary(f)):
        gap = s.rationalize(u) - f
        gaps.append([integral(gap**2 * s.ds()), integral(ufl.dot(s.grad(gap), n) ** 2 * s.ds())])
    assert max(gaps[0]) < 1e-20
    assert gaps[1][0] < 1e-20
    assert gaps[1][1] > 1.0


def test_fit_of_data_and_slopes_does_not_depend_on_the_unit_of_length():
    """Data that are not in the space: values and slopes are weighed against each other by the length."""
    found = []
    for L in (1.0, 100.0):
        patch = shapes.parallelogram((0, 0), (L, 0), (0.3 * L, 0.8 * L), elements=(3, 2), degrees=(2, 2))
        s = ExtractedSpline(patch)
        f = ufl.sin(3.0 * s.F[1] / L + s.F[0] / L) + ufl.exp(s.F[0] / L)
        found.append(s.scalar.coefficients(s.project_boundary(f, slope_length=0.4 * L)))
    np.testing.assert_allclose(found[1], found[0], rtol=1e-9, atol=1e-11)
    assert np.abs(found[0]).max() > 1.0


@pytest.mark.parametrize("name", ["annulus", "disc", "joined"])
def test_harmonic_field_of_its_boundary_data(name):
    s = spline(name)
    exact = 1.0 + 2.0 * s.F[0] - s.F[1]
    u = s.project_boundary(exact)
    on_sides = np.concatenate([s.geometry.side_functions(*place) for place in named_or_outer(s.geometry, (), None)])
    v = s.rationalize(ufl.TestFunction(s.scalar.V))
    residual = ufl.inner(s.grad(s.rationalize(u)), s.grad(v)) * s.dx
    tangent = ufl.derivative(residual, u)
    solve_linear(SplineSystem(s.scalar, residual, tangent, unknown=u, zero_dofs=np.unique(on_sides)))
    assert integral((s.rationalize(u) - exact) ** 2 * s.dx) < 1e-18
    assert energy(u, s)[0] == pytest.approx(5.0 * integral(1.0 * s.dx), rel=1e-9)
