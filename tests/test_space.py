"""Spaces of spline fields: coefficients and values, constants, mixed spaces, refinement, triangles and poles."""

import numpy as np
import pytest
import ufl
from mpi4py import MPI
from dolfinx import fem
from splines import (
    WORLD,
    half_disc,
    integral,
    poisson,
    quarter,
    radial,
    rectangle,
    turned,
)

from tigar_x import compat
from tigar_x.geometry import shapes
from tigar_x.geometry.bspline import BSplineBasis, open_knots
from tigar_x.geometry.gluing import glued
from tigar_x.geometry.multipatch import as_multipatch, disjoint
from tigar_x.geometry.patch import Patch
from tigar_x.splines.constraints import tied
from tigar_x.splines.quadrature import NodalQuadrature
from tigar_x.splines.spline import ExtractedSpline
from tigar_x.splines.spline_system import SplineSystem, solve_linear

pytestmark = pytest.mark.mpi

# -- coefficients and values ------------------------------------------------------------------------------------------


def curved(degree, dim=2):
    """Rational patch over [0, 3] x [0, 1] with knots of several multiplicities."""
    knots = np.concatenate([np.zeros(degree + 1), [1.0] * max(degree - 1, 1), [2.5], np.full(degree + 1, 3.0)])
    bases = [BSplineBasis(degree, knots), BSplineBasis(2, open_knots(2, [0, 0.3, 1]))][:dim]
    flat = shapes.line((0, 0), (3, 0), elements=1, degree=1) if dim == 1 else rectangle((0, 3), (0, 1), (1, 1), (1, 1))
    ends = [BSplineBasis(1, open_knots(1, [0, 3])), BSplineBasis(1, open_knots(1, [0, 1]))][:dim]
    patch = Patch(tuple(ends), flat.control).on(bases)
    rng = np.random.default_rng(degree)
    return Patch.from_points(
        bases, patch.points + 0.05 * rng.uniform(size=(patch.n, 2)), rng.uniform(0.8, 1.2, patch.n)
    )


def ring():
    basis, r = radial(2, 2)
    return turned(basis, 1.0 + r, quarters=4, closed=True)


def pair():
    return glued(rectangle((1, 2), (-1, 0)), quarter([(1.0, None), (2.0, None)]).with_degree(2).refined(1, 2))


GEOMETRIES = {
    **{f"degree {p}": lambda p=p: curved(p) for p in (1, 2, 3, 4, 5)},
    "curve": lambda: curved(5, 1),
    "volume": lambda: shapes.box(lengths=(1, 2, 1), elements=(2, 1, 2), degrees=(2, 1, 1)),
    "periodic": ring,
    "pole": lambda: glued(turned(*radial(2, 2), quarters=4), within=True),
    "joined": pair,
    "apart": lambda: disjoint(rectangle((0, 1), (0, 1), (2, 2), (3, 2)), half_disc()),
}


@pytest.mark.parametrize("size", [1, 3])
@pytest.mark.parametrize("name", GEOMETRIES)
def test_coefficients_of_a_field_of_the_space(name, size):
    space = ExtractedSpline(GEOMETRIES[name]()).space(size)
    U = np.random.default_rng(0).uniform(-1, 1, (space.n // size, size))
    np.testing.assert_allclose(space.coefficients(space.function(U)), U, rtol=0, atol=1e-11)


def test_coefficients_under_constraints():
    """Only free combinations are fields of the space: zero dofs and constraints hold for what comes back."""
    geometry = pair()
    s, G = ExtractedSpline(geometry), tied([3, 8], [5, 9], 2 * geometry.n, [2.0, -1.0])
    space = s.space(2, zero_dofs=[0, 1], constraints=[G])
    assert space.M.size[1] == space.n - 4
    U = np.random.default_rng(0).uniform(-1, 1, space.n)
    U[[0, 1]], U[3], U[8] = 0.0, 2.0 * U[5], -U[9]
    np.testing.assert_allclose(space.coefficients(space.function(U.reshape(-1, 2))).ravel(), U, rtol=0, atol=1e-11)
    U[3] += 1.0
    other = space.coefficients(space.function(U.reshape(-1, 2))).ravel()
    assert np.abs(other - U).max() > 0.1
    assert np.abs(G @ other).max() < 1e-11
    assert not other[:2].any()


def test_coefficients_of_mixed_fields():
    patch = curved(2)
    s = ExtractedSpline(patch)
    space = s.space((patch.with_degree(3).functions, 2), 1, (patch.with_degree(4).functions, 1))
    U = np.random.default_rng(0).uniform(-1, 1, space.n)
    assert space.n == sum(space.sizes)
    np.testing.assert_allclose(space.coefficients(space.function(U)), U, rtol=0, atol=1e-11)
    held = s.space(
        (patch.with_degree(3).functions, 2),
        1,
        zero_dofs=[2, space.sizes[0]],
        constraints=[tied([0], [space.sizes[0] + 3], sum(space.sizes[:2]))],
    )
    U = U[: held.n]
    U[[2, space.sizes[0]]], U[0] = 0.0, U[space.sizes[0] + 3]
    np.testing.assert_allclose(held.coefficients(held.function(U)), U, rtol=0, atol=1e-11)


@pytest.mark.parametrize("name", GEOMETRIES)
def test_values_at_parameters_and_at_points(name):
    """Affine functions of the position belong to every isoparametric space."""
    geometry = GEOMETRIES[name]()
    s = ExtractedSpline(geometry)
    A = np.random.default_rng(1).uniform(-1, 1, (4, s.nsd + 1))
    value = ufl.as_vector([float(a[0]) + sum(float(c) * s.F[i] for i, c in enumerate(a[1:])) for a in A])
    u = s.project(value)
    for k, patch in enumerate(as_multipatch(geometry).patches):
        low, high = patch.basis.box
        xi = np.concatenate([low + (high - low) * np.random.default_rng(2).uniform(size=(9, s.dim)), [low, high]])
        x = patch.evaluate(xi)
        expected = A[:, 0] + x @ A[:, 1:].T
        np.testing.assert_allclose(s.evaluate(u, xi, k), expected, rtol=0, atol=1e-10)
        np.testing.assert_allclose(s.evaluate_at(u, x), expected, rtol=0, atol=1e-10)


def test_values_outside_are_refused():
    s = ExtractedSpline(pair())
    u = s.project(s.F[0])
    for xi, patch, message in (
        ([[0.5, 1.1]], 0, r"xi\[0\] = \[0.5 1.1\]: parameters within patch 0 are required"),
        ([[0.5, 0.5], [2.5, 0.0]], 1, r"xi\[1\] = \[2.5 0. \]: parameters within patch 1"),
        ([[0.5, 0.5]], 2, r"patch = 2: one of 0, 1 is required"),
        ([0.5, 0.5], 0, r"xi has shape \(2,\)"),
    ):
        with pytest.raises(ValueError, match=message):
            s.evaluate(u, xi, patch)
    with pytest.raises(ValueError, match=r"points\[1\] is 1 away from the spline"):
        s.evaluate_at(u, [[1.5, -0.5], [3.0, -0.5]])
    with pytest.raises(ValueError, match=r"u has \d+ nodal values: a field of this space, with \d+, is required"):
        s.evaluate(s.space(1, 1).function(), [[0.5, 0.5]])


# -- constants --------------------------------------------------------------------------------------------------------


def solid():
    """Quarter of a thick tube."""
    flat = quarter([(1.0, None), (2.0, None)])
    points = np.concatenate([np.column_stack([flat.points, np.full(flat.n, z)]) for z in (0.0, 3.0)])
    bases = (*flat.bases, BSplineBasis(1, open_knots(1, [0, 1])))
    return Patch.from_points(bases, points, np.tile(flat.weights, 2))


@pytest.mark.parametrize("cells", ["tensor", "simplex"])
@pytest.mark.parametrize("make", [lambda: curved(2), ring, pair, half_disc, solid], ids=str)
def test_constants_are_kept_by_both_projections(make, cells):
    s = ExtractedSpline(make(), cells=cells)
    constant = np.array([1.5, -2.0, 0.25])[: s.nsd]
    expected = np.tile(constant, (len(s.node_weights), 1))
    np.testing.assert_allclose(s.nodal(s.project(ufl.as_vector(list(constant)))), expected, rtol=0, atol=1e-11)
    lumped = s.lumped_projector
    form = lumped.compile(ufl.as_vector(list(constant)))
    np.testing.assert_allclose(lumped(form), expected, rtol=0, atol=1e-12)
    assert s.geometry.rational
    np.testing.assert_allclose(s.nodal(s.project(2.0))[:, 0], 2.0, rtol=0, atol=1e-11)


def test_the_lumped_projection_keeps_integrals():
    s = ExtractedSpline(curved(2), MPI.COMM_SELF)
    field = ufl.as_vector([ufl.sin(2.0 * s.F[0]), s.F[0] * s.F[1], 1.0 + s.F[0]][: s.nsd])
    lumped, values = s.lumped_projector, fem.Function(s.V)
    values.x.array[:] = (lumped(lumped.compile(field)) * s.node_weights[:, None]).ravel()
    forms = (f[i] * s.dx for f in (field, s.rationalize(values)) for i in range(s.nsd))
    of_field, of_projection = np.split(np.array([compat.assemble_scalar(f) for f in compat.compile_forms(*forms)]), 2)
    assert s.geometry.rational
    np.testing.assert_allclose(of_projection, of_field, rtol=1e-11)


# -- triangles and tetrahedra -----------------------------------------------------------------------------------------


def dense(A):
    """The whole matrix on every rank."""
    first, last = A.getOwnershipRange()
    return np.concatenate(WORLD.allgather(A.getValues(range(first, last), range(A.size[1]))))


@pytest.mark.parametrize(
    "patch",
    [
        *(shapes.parallelogram((1, 0), (2, 1), (0, 3), elements=(2, 2), degrees=(p, p)) for p in (1, 2, 3)),
        shapes.box(lengths=(1, 2, 3), elements=(2, 1, 1), degrees=(1, 1, 1)),
        shapes.box(lengths=(1, 2, 3), elements=(1, 2, 1), degrees=(1, 2, 3)),
        shapes.box(lengths=(1, 2, 3), elements=(1, 1, 2), degrees=(2, 2, 2)),
    ],
    ids=lambda patch: str(patch.basis.degrees),
)
def test_simplices_give_the_same_matrix(patch):
    """Of an affine patch, where both integrate exactly."""
    matrices = []
    for cells, degree in (("tensor", 2 * max(patch.basis.degrees)), ("simplex", 2 * sum(patch.basis.degrees))):
        s = ExtractedSpline(patch, cells=cells, quadrature_degree=degree)
        u, v = s.scalar.function(), ufl.TestFunction(s.scalar.V)
        form = (ufl.inner(s.grad(u), s.grad(v)) + ufl.inner(u, v)) * s.dx
        system = SplineSystem(s.scalar, form, ufl.derivative(form, u))
        system.assemble_tangent()
        matrices.append(dense(system.A))
    np.testing.assert_allclose(matrices[1], matrices[0], rtol=0, atol=1e-10 * np.abs(matrices[0]).max())


# -- mixed spaces -----------------------------------------------------------------------------------------------------


def stokes(patch):
    """Errors of velocity (H1) and pressure (L2) for a solenoidal field that vanishes on the boundary.

    The velocity has one degree more than the pressure and the continuity of it. The exact fields are psi = b^2,
    u = curl psi and p = x_0 x_1, with b = 0 on the boundary.
    """
    s = ExtractedSpline(patch, quadrature_degree=8)
    richer = patch.with_degree(3)
    sides = [richer.side_functions(*side) for side in as_multipatch(patch).outer_sides]
    held = (np.unique(np.concatenate(sides))[:, None] * 2 + np.arange(2)).ravel()
    pressure = Patch.from_points(patch.bases, patch.points)  # a polynomial one, without weights
    space = s.space((richer.functions, 2), (pressure.functions, 1), zero_dofs=[*held, 2 * richer.n])
    w = space.function()
    (u, p), (v, q) = ufl.split(w), ufl.TestFunctions(space.V)
    x = ufl.variable(s.F)
    if patch.rational:
        b = x[0] * x[1] * (x[0] ** 2 + x[1] ** 2 - 1) * (4 - x[0] ** 2 - x[1] ** 2) / 4
    else:
        b = 4 * x[0] * (1 - x[0]) * x[1] * (1 - x[1])
    slope = ufl.diff(b**2, x)
    u_exact, p_exact = ufl.as_vector([slope[1], -slope[0]]), x[0] * x[1]
    du, dv, du_exact = s.grad(u), s.grad(v), ufl.diff(u_exact, x)
    residual = ufl.inner(du - du_exact, dv) * s.dx - (p - p_exact) * ufl.tr(dv) * s.dx - q * ufl.tr(du) * s.dx
    solve_linear(SplineSystem(space, residual, ufl.derivative(residual, w), unknown=w))
    mean = fem.Constant(s.mesh, integral((p - p_exact) * s.dx) / integral(1.0 * s.dx))
    errors = ufl.inner(du - du_exact, du - du_exact), (p - p_exact - mean) ** 2
    scale = integral(ufl.inner(du_exact, du_exact) * s.dx)
    return np.sqrt([integral(e * s.dx) / scale for e in errors])


@pytest.mark.parametrize(
    ("make", "bounds"),
    [
        (lambda n: rectangle((0, 1), (0, 1), (n, n)), (1e-3, 1e-5)),
        (lambda n: quarter([(1.0, None), (2.0, None)]).with_degree(2).refined(n // 2, n), (1.5e-2, 2e-4)),
    ],
    ids=["square", "annulus"],
)
def test_stokes_flow(make, bounds):
    """Velocity of degree 3 and pressure of degree 2: third order of the velocity gradient and of the pressure."""
    errors = np.array([stokes(make(n)) for n in (4, 8)])
    rates = np.log2(errors[0] / errors[1])
    assert rates[0] > 2.6
    assert rates[1] > 2.7
    assert (errors[-1] < bounds).all()


@pytest.mark.parametrize(
    ("parts", "options", "message"),
    [
        ((), {}, "parts is empty: one field or more"),
        ((0,), {}, r"size = 0: an integer >= 1"),
        ((1,), {"zero_dofs": [16]}, r"zero_dofs contains 16: integers from 0 to 15 are required"),
        ((1,), {"constraints": [tied([0], [1], 15)]}, r"constraints\[0\] has 15 columns: 16 degrees"),
        (
            (2, (rectangle((0, 1), (0, 1), (2, 3)).functions, 1)),
            {},
            r"parts\[1\]: patch 0 has breakpoints .* direction 1",
        ),
        (((rectangle((0, 1), (0, 1), (4, 2)).functions, 1),), {}, r"parts\[0\]: patch 0 has breakpoints"),
        (
            ((disjoint(*[rectangle((0, 1), (0, 1))] * 2).functions, 1),),
            {},
            r"parts\[0\] has 2 patches of dimension 2: 1 of",
        ),
        (
            ((shapes.line((0, 0), (1, 0), elements=2).functions, 1),),
            {},
            r"parts\[0\] has 1 patches of dimension 1: 1 of dimension 2",
        ),
    ],
)
def test_bad_spaces(parts, options, message):
    with pytest.raises(ValueError, match=message):
        ExtractedSpline(rectangle((0, 1), (0, 1))).space(*parts, **options)


def test_functions_on_fewer_elements_are_allowed():
    s = ExtractedSpline(rectangle((0, 1), (0, 1), (4, 2)))
    coarse = rectangle((0, 1), (0, 1), (2, 1)).functions
    assert s.space((coarse, 1)).n == 4 * 3
    with pytest.raises(ValueError, match="the space has several parts"):
        _ = s.space(1, 1).nodes


# -- refinement -------------------------------------------------------------------------------------------------------


def graph(patch):
    """A rational patch of the plane with a field over it, as third coordinate of a surface in space."""
    rng = np.random.default_rng(5)
    points = np.column_stack([patch.points, rng.uniform(-1, 1, patch.n)])
    return Patch.from_points(patch.bases, points, patch.weights)


@pytest.mark.parametrize(
    "change", [lambda p: p.refined(2), lambda p: p.with_degree(3), lambda p: p.swapped().refined(1, 3)]
)
def test_refinement_keeps_every_field(change):
    surface = graph(curved(2))
    coarse, fine = ExtractedSpline(surface), ExtractedSpline(change(surface))
    x = surface.evaluate(surface.basis.greville)
    for s in (coarse, fine):
        np.testing.assert_allclose(s.evaluate_at(s.project(s.F[2]), x)[:, 0], x[:, 2], rtol=0, atol=1e-10)


@pytest.mark.parametrize("change", [lambda p: p, lambda p: p.refined(2, 1), lambda p: p.with_degree(3)])
def test_refinement_keeps_a_solution_of_the_coarse_space(change):
    patch = change(rectangle((0, 1), (0, 2), (1, 2)))
    u, s = poisson(patch, load=lambda x: 2.0 * (x[0] * (1 - x[0]) + x[1] * (2 - x[1])))
    x = np.random.default_rng(0).uniform((0, 0), (1, 2), (20, 2))
    exact = x[:, 0] * (1 - x[:, 0]) * x[:, 1] * (2 - x[:, 1])
    np.testing.assert_allclose(s.evaluate_at(u, x)[:, 0], exact, rtol=0, atol=1e-12)


# -- poles ------------------------------------------------------------------------------------------------------------


def cap(elements):
    """Cap of the unit sphere down to 60 degrees from its pole, v from the pole down."""
    angle, w = np.pi / 6 * np.arange(3), np.array([1.0, np.cos(np.pi / 6), 1.0])
    basis = BSplineBasis(2, open_knots(2, [0, 1]))
    r, z = np.sin(angle) / w, np.cos(angle) / w
    return turned(basis, r, z, w, quarters=4).refined(max(elements // 4, 1), elements)


def disc(elements):
    return turned(*radial(2, 1), quarters=4).refined(max(elements // 4, 1), elements)


AREAS = {disc: np.pi, cap: np.pi}  # 2 pi (1 - cos 60 degrees)


def load_and_solution(make, x):
    """-div grad u = f with u = 0 on the rim: z^2 is 1/3 and a harmonic of second degree on the sphere."""
    if make is cap:
        return 6 * x[2] ** 2 - 2, x[2] ** 2 - 0.25
    return 8 * x[0] + 16 * (x[0] ** 2 + x[1] ** 2), (1 - x[0] ** 2 - x[1] ** 2) * (1 + x[0] + x[0] ** 2 + x[1] ** 2)


@pytest.mark.parametrize("merged", [True, False])
@pytest.mark.parametrize("make", [disc, cap])
def test_a_problem_around_a_pole(make, merged):
    """Second order at least, whether or not the functions of the pole and of the seam are one."""
    errors = []
    for elements in (4, 8, 16):
        patch = make(elements)
        geometry = glued(patch, within=True) if merged else patch
        u, s = poisson(geometry, load=lambda x: load_and_solution(make, x)[0], fixed=[(0, 1, 1)], quadrature_degree=6)
        errors.append(np.sqrt(integral((s.rationalize(u) - load_and_solution(make, s.F)[1]) ** 2 * s.dx)))
    assert np.isfinite(errors).all()
    assert errors[-1] < 2e-4
    assert np.log2(errors[-2] / errors[-1]) > 2.7


@pytest.mark.parametrize("make", [disc, cap])
def test_geometry_around_a_pole(make):
    s = ExtractedSpline(glued(make(4), within=True), quadrature_degree=12)
    assert integral(1.0 * s.dx) == pytest.approx(AREAS[make], rel=1e-7)
    lumped = s.lumped_projector
    values = lumped(lumped.compile(s.F))
    assert np.isfinite(values).all()
    smoothing = np.linalg.norm(values - s.node_positions, axis=1)
    assert smoothing.max() < 0.35
    assert smoothing[np.hypot(*s.node_positions[:, :2].T) < 1e-9].max(initial=0.0) < 1e-12 + 0.2 * (make is cap)


@pytest.mark.parametrize(
    "make", [disc, cap, lambda n: disc(n).with_degree(3), lambda n: cap(n).with_degree(3)], ids=str
)
def test_points_of_a_rule_around_a_pole(make):
    s = ExtractedSpline(make(4), MPI.COMM_SELF, quadrature_degree=12)
    rule = NodalQuadrature.of(s)
    assert rule.weights.min() >= 0.0
    assert rule.weights.sum() == pytest.approx(np.pi, rel=1e-7)
    assert np.abs(rule.weights - s.node_areas).max() < 0.02 * rule.weights.max()
    r2 = (rule.points[:, :2] ** 2).sum(axis=1)
    exact = integral((s.F[0] ** 2 + s.F[1] ** 2) * s.dx)
    assert rule.weights @ r2 == pytest.approx(exact, rel=5e-3)


def test_rules_of_triangles_are_refused():
    s = ExtractedSpline(rectangle((0, 1), (0, 1)), MPI.COMM_SELF, cells="simplex")
    with pytest.raises(ValueError, match=r"weights\[\d+\] = -.*: nodal weights >= 0 are required"):
        NodalQuadrature.of(s)
