"""Linear constraints: what they leave free, and that joints and symmetry planes do what one smooth patch does."""

import numpy as np
import pytest
import scipy.sparse as sp
import ufl
from dolfinx import fem
from splines import energy, quarter, radial, rectangle, turned

from shnapr.supports import clamped, pinned
from shnapr.svk import StVenantKirchhoff
from shnapr.work import strain_energy, virtual_work
from tigar_x.geometry import shapes
from tigar_x.geometry.bspline import BSplineBasis, open_knots
from tigar_x.geometry.gluing import glued
from tigar_x.geometry.multipatch import as_multipatch, disjoint
from tigar_x.geometry.patch import Patch
from tigar_x.splines.constraints import no_rotation, null_space, smooth_joints, symmetry, tied
from tigar_x.splines.spline import ExtractedSpline
from tigar_x.splines.spline_system import SplineSystem, solve_linear

# -- elimination ------------------------------------------------------------------------------------------------------


def check(G, fixed, n):
    """T spans all solutions, has no column too many, and leaves its free degrees of freedom alone."""
    T = null_space([G], np.asarray(fixed, dtype=np.int32), n).toarray()
    dense = np.concatenate([G.toarray(), np.eye(n)[list(fixed)]])
    dense /= np.maximum(np.abs(dense).max(axis=1, keepdims=True), 1e-300)
    assert T.shape == (n, n - np.linalg.matrix_rank(dense))
    assert np.abs(dense @ T).max(initial=0.0) < 1e-12 * max(np.abs(T).max(initial=0.0), 1.0)
    unit = T[np.count_nonzero(T, axis=1) == 1]
    assert (unit == 1.0).any(axis=0).all()


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize(("rows", "n", "density"), [(10, 40, 0.1), (30, 40, 0.05), (60, 40, 0.08), (5, 8, 0.4)])
def test_null_space_of_random_constraints(rows, n, density, seed):
    rng = np.random.default_rng(seed)
    G = sp.random(rows, n, density, "csr", random_state=rng, data_rvs=lambda k: rng.uniform(-2, 2, k))
    mixed = sp.random(rows // 2, rows, 0.2, "csr", random_state=rng) @ G  # follow from the others
    shuffled = sp.vstack([G, mixed, 1e6 * G[:2], 1e-6 * G[-2:]], format="csr")[rng.permutation(rows + rows // 2 + 4)]
    check(shuffled, rng.choice(n, seed, replace=False), n)


def test_null_space_of_special_constraints():
    n = 6
    np.testing.assert_array_equal(null_space([sp.csr_matrix((0, n))], np.arange(0), n).toarray(), np.eye(n))
    np.testing.assert_array_equal(
        null_space([sp.csr_matrix((3, n))], np.array([2]), n).toarray(), np.delete(np.eye(n), 2, 1)
    )
    assert null_space([sp.identity(n, format="csr")], np.arange(0), n).shape == (n, 0)
    assert null_space([tied([0], [1], n)], np.arange(n), n).shape == (n, 0)
    chain = tied(np.arange(1, 2000), np.arange(1999), 2000)
    np.testing.assert_allclose(null_space([chain[::-1]], np.arange(0), 2000).toarray(), np.ones((2000, 1)), rtol=1e-12)
    T = null_space([tied([0, 3], [1, 4], n, [2.0, -1.0]), tied([1], [2], n, 3.0)], np.array([5]), n)
    U = T @ np.array([1.0, 10.0])
    np.testing.assert_allclose(U[[0, 1]], [6 * U[2], 3 * U[2]])
    np.testing.assert_allclose(U[[3, 5]], [-U[4], 0.0])


@pytest.mark.parametrize(
    ("block", "message"),
    [
        (sp.csr_matrix((1, 5)), r"constraints\[1\] has 5 columns: 6 degrees of freedom"),
        (sp.csr_matrix([[0, np.nan, 0, 0, 0, 0]]), r"constraints\[1\] has entries that are not finite"),
    ],
)
def test_bad_constraints(block, message):
    with pytest.raises(ValueError, match=message):
        null_space([tied([0], [1], 6), block], np.arange(0), 6)


# -- problems of fourth order -----------------------------------------------------------------------------------------


def bending(geometry, load=None, constraints=(), clamped=(), size=None):
    """Solution of a problem that needs continuous first derivatives, in ``size`` components, and its spline.

    ``clamped`` sides, each (patch, direction, end), neither move nor turn.
    """
    size = geometry.nsd if size is None else size
    s = ExtractedSpline(geometry, quadrature_degree=6)
    held = np.concatenate([geometry.side_functions(*side, 2) for side in clamped])
    zero = (held[:, None] * size + np.arange(size)).ravel()
    space = s.space(size, zero_dofs=zero, constraints=constraints)
    u, test = space.function(), s.rationalize(ufl.TestFunction(space.V))
    grad, grad_test = s.grad(s.rationalize(u)), s.grad(test)
    f = (lambda x: 1.0 + x[0] if size == 1 else ufl.as_vector([x[0], 1.0 + x[1] * x[0]])) if load is None else load
    residual = (ufl.inner(s.div(grad), s.div(grad_test)) + ufl.inner(grad, grad_test)) * s.dx
    residual -= ufl.inner(f(s.F), test) * s.dx
    solve_linear(SplineSystem(space, residual, ufl.derivative(residual, u), unknown=u))
    return u, s


def split(x, y, elements, p, at, repeat=None):
    """Rectangle on knots at fractions ``at`` of its sides, with continuity C1 there; ``elements`` in between."""
    bases = []
    for ends, counts, joints in zip((x, y), elements, at, strict=True):
        borders = (np.array([ends[0], *joints, ends[1]]) - ends[0]) / (ends[1] - ends[0])
        ticks = [np.linspace(a, b, k + 1) for a, b, k in zip(borders[:-1], borders[1:], counts, strict=True)]
        knots = open_knots(p, np.unique(np.concatenate(ticks)))
        bases.append(BSplineBasis(p, np.sort(np.concatenate([knots, np.repeat(borders[1:-1], p - 2)]))))
    return rectangle(x, y, (1, 1), (p, p)).on(bases)


def compare(one, other, points, rtol=1e-8):
    (u, s), (v, t) = one, other
    values = s.evaluate_at(u, points)
    np.testing.assert_allclose(t.evaluate_at(v, points), values, rtol=0, atol=rtol * np.abs(values).max())
    return values


def differ(one, other, points):
    values = one[1].evaluate_at(one[0], points)
    assert np.abs(other[1].evaluate_at(other[0], points) - values).max() > 1e-3 * np.abs(values).max()


SAMPLES = np.random.default_rng(0).uniform(size=(20, 2))


@pytest.mark.mpi
@pytest.mark.parametrize("degree", [2, 3])
@pytest.mark.parametrize("counts", [(2, 2), (1, 3)])
def test_two_patches_with_a_smooth_joint_are_one(degree, counts):
    """The joint of two halves removes a knot: p - 1 knots remain. With other elements its ratio is not 1."""
    whole = split((0, 2), (0, 1), (counts, (2,)), degree, ((1.0,), ()))
    left, right = (rectangle((k, k + 1), (0, 1), (counts[k], 2), (degree, degree)) for k in (0, 1))
    both = glued(right.swapped().reversed(0), left)
    G = smooth_joints(both)
    assert null_space([G], np.arange(0), 2 * both.n).shape[1] == 2 * whole.n
    points = SAMPLES * [2, 1]
    expected = bending(whole, clamped=[(0, 0, 0), (0, 1, 1)])
    sides = [(1, 0, 0), (1, 1, 1), (0, 0, 0)]
    found = bending(both, constraints=[G], clamped=sides)
    compare(expected, found, points)
    differ(expected, bending(both, clamped=sides), points)


@pytest.mark.mpi
def test_four_patches_that_meet_in_a_corner():
    x, y, counts = (0, 0.6, 1), (0, 1, 2), ((2, 1), (1, 2))
    whole = split((0, 1), (0, 2), counts, 2, ((0.6,), (1.0,)))
    corners = [
        rectangle(x[i : i + 2], y[j : j + 2], (counts[0][i], counts[1][j])) for i, j in ((0, 0), (1, 1), (1, 0), (0, 1))
    ]
    four = glued(corners[0], corners[1].reversed(1), corners[2].swapped(), corners[3])
    G = smooth_joints(four, 1)
    assert null_space([G], np.arange(0), four.n).shape[1] == whole.n
    expected = bending(whole, clamped=[(0, 0, 0)], size=1)
    sides = [side for side in four.outer_sides if not four.points[four.side_functions(*side), 0].any()]
    assert len(sides) == 2
    found = bending(four, constraints=[G], clamped=sides, size=1)
    compare(expected, found, SAMPLES * [1, 2])
    np.testing.assert_allclose(energy(*found), energy(*expected), rtol=1e-8)


def slopes(geometry, U, patch, xi):
    """Gradient of a field with homogeneous coefficients U in the tangent space, from its definition."""
    own = geometry.patches[patch]
    numbers = geometry.functions.global_numbers(patch, np.arange(own.n))
    # what the raw functions of a patch are multiplied by
    raw = U[numbers] * (own.weights / geometry.weights[numbers])[:, None]
    A, columns = np.column_stack([own.control, raw]), []
    value, w = own.basis.evaluate(xi) @ A, own.basis.evaluate(xi) @ own.weights
    for direction in range(own.dim):
        derivative, dw = (own.basis.evaluate(xi, direction) @ array for array in (A, own.weights))
        columns.append((derivative - value * (dw / w)[:, None]) / w[:, None])
    J = np.stack(columns, axis=-1)
    nsd = own.nsd
    return J[:, nsd + 1 :] @ np.linalg.pinv(J[:, :nsd])


def arcs():
    """Two quarters of an annulus; the weights of the arcs have a kink where these meet."""
    first = quarter([(1.0, None), (2.0, None)]).with_degree(2).refined(1, 2)
    turn = np.array([[0.0, 1.0], [-1.0, 0.0]])
    return first, Patch.from_points(first.bases, first.points @ turn, 3.0 * first.weights)


def cut(parts=(0.3, 1.0)):
    """Both parts of a rational patch without any symmetry, cut through by a knot of multiplicity p."""
    rng = np.random.default_rng(1)
    whole = rectangle((0, 1), (0, 1), (2, 2))
    whole = Patch.from_points(
        whole.bases, whole.points + 0.05 * rng.uniform(size=(whole.n, 2)), rng.uniform(1, 2, whole.n)
    )
    u = whole.bases[0].with_knots([parts[0]] * 2)
    fine = whole.on([u, whole.bases[1]])
    net = fine.control.reshape(u.n, fine.bases[1].n, 3, order="F")
    at = int(np.searchsorted(u.knots, parts[0] - 1e-9))
    pieces = []
    for knots, rows in (
        (np.append(u.knots[: at + 2], parts[0]), slice(0, at)),
        (np.insert(u.knots[at:], 0, parts[0]), slice(at - 1, None)),
    ):
        basis = BSplineBasis(2, knots)
        pieces.append(Patch((basis, fine.bases[1]), net[rows].reshape(-1, 3, order="F")))
    return pieces


@pytest.mark.parametrize("pair", [arcs, cut], ids=["arcs", "cut"])
def test_gradients_are_continuous_across_rational_joints(pair):
    """Of any field that satisfies the constraints, and the position does."""
    geometry = glued(*pair())
    G = smooth_joints(geometry)
    n = geometry.n * geometry.nsd
    assert np.abs(G @ geometry.control[:, :-1].ravel()).max() < 1e-12
    T = null_space([G], np.arange(0), n)
    U = (T @ np.random.default_rng(0).uniform(-1, 1, T.shape[1])).reshape(-1, geometry.nsd)
    (k, d, end), (l, e, other) = [side for side in geometry.open_sides if side not in geometry.outer_sides]
    v = np.linspace(*geometry.patches[k].basis.box[:, 1 - d], 7)
    ends = [np.insert(v[:, None], d, geometry.patches[k].basis.box[end, d], axis=1)]
    ends.append(np.insert(v[:, None], e, geometry.patches[l].basis.box[other, e], axis=1))
    before, after = slopes(geometry, U, k, ends[0]), slopes(geometry, U, l, ends[1])
    np.testing.assert_allclose(geometry.patches[k].evaluate(ends[0]), geometry.patches[l].evaluate(ends[1]), atol=1e-14)
    np.testing.assert_allclose(after, before, atol=1e-12 * np.abs(before).max())
    free = np.random.default_rng(0).uniform(-1, 1, U.shape)
    assert np.abs(slopes(geometry, free, k, ends[0]) - slopes(geometry, free, l, ends[1])).max() > 0.1


def test_the_seam_of_a_ring_can_be_smooth():
    """A ring of one patch that is glued to itself, and the second of two rings on a common circle."""
    basis, r = radial(2, 2)
    ring = glued(turned(basis, 1.0 + r, quarters=4), within=True)
    G = smooth_joints(ring, 1)
    assert G.shape == (4, ring.n)
    T = null_space([G], np.arange(0), ring.n)
    U = T @ np.random.default_rng(0).uniform(size=(T.shape[1], 1))
    v = np.linspace(0, 1, 5)
    start, end = (slopes(ring, U, 0, np.column_stack([np.full(5, u), v])) for u in (0.0, 4.0))
    np.testing.assert_allclose(start, end, atol=1e-12)
    rings = glued(ring.patches[0], turned(basis, 2.0 + r, quarters=4), within=True)
    assert smooth_joints(rings, 1).shape == (4 + 4 + 9, rings.n)


def test_poles_are_no_joints():
    piece = turned(*radial(2, 2), quarters=1)
    opposite = Patch.from_points(piece.bases, -piece.points, piece.weights)
    with pytest.raises(ValueError, match="no side that two patches share: glue"):
        smooth_joints(glued(piece, opposite, within=True))


def flap(angle, skew=0.0):
    """A square that begins at an edge of the unit square, turned up by an angle."""
    edges = (-np.cos(angle), skew, np.sin(angle)), (0.0, 1.0, 0.0)
    return shapes.parallelogram((0, 0, 0), *edges, elements=(2, 2), degrees=(2, 2))


def test_joints_that_cannot_be_smooth_are_refused():
    floor = shapes.parallelogram((0, 0, 0), (1, 0, 0), (0, 1, 0), elements=(2, 2), degrees=(2, 2))
    assert smooth_joints(glued(floor, flap(0.0))).shape == (3 * 4, 3 * (16 + 12))
    assert smooth_joints(glued(floor, flap(1e-9))).shape == (3 * 4, 3 * (16 + 12))
    for kinked in (flap(1e-3), flap(np.pi / 2), flap(0.0, 0.1)):
        with pytest.raises(ValueError, match="side u0 of patch 0 and side u0 of patch 1 meet at an angle"):
            smooth_joints(glued(floor, kinked))
    with pytest.raises(ValueError, match="no side that two patches share: glue"):
        smooth_joints(disjoint(floor, flap(0.0)))


# -- beams ------------------------------------------------------------------------------------------------------------

E, H, L = 3.0e4, 0.1, 2.0
STIFFNESS = E * H**3 / 12


def beam(geometry, clamped, *, load=0.0, force=0.0, constraints=()):
    """Linear deflection of a plane beam under a uniform load, and a force at the end of its last patch."""
    patches = as_multipatch(geometry)
    zero = np.concatenate([patches.side_dofs(name, 2, patch=k) for k, name in clamped])
    s = ExtractedSpline(patches, zero_dofs=zero, constraints=constraints)
    y, z = s.function(), ufl.TestFunction(s.V)
    across = fem.Constant(s.mesh, np.array([[0.0, -load], [0.0, -force]]))
    material = StVenantKirchhoff(E, 0.0, fem.Constant(s.mesh, H))
    residual = virtual_work(s, lambda u: strain_energy(s, material, u), y, z)
    residual -= ufl.inner(across[0, :], z) * s.dx
    residual -= ufl.inner(across[1, :], z) * s.ds("u1", patch=len(patches.patches) - 1)
    solve_linear(SplineSystem(s, residual, ufl.derivative(residual, y), unknown=y))
    return lambda x: s.evaluate_at(y, np.column_stack([x, np.zeros(len(x))]))


def pieces():
    """The beam in two pieces of different elements, the first one backwards."""
    ends = (0.0, 0.0), (L / 3, 0.0), (L, 0.0)
    first, second = (
        shapes.line(a, b, elements=k, degree=3) for a, b, k in zip(ends[:-1], ends[1:], (2, 3), strict=True)
    )
    return glued(first.reversed(0), second)


POSITIONS = np.linspace(0, L, 13)


@pytest.mark.mpi
def test_a_cantilever_in_two_pieces():
    """A force at its end bends it into a cubic, w = P x^2 (3 L - x)/(6 E I)."""
    geometry = pieces()
    found = beam(geometry, [(0, "u1")], force=1.0, constraints=[smooth_joints(geometry)])(POSITIONS)
    exact = POSITIONS**2 * (3 * L - POSITIONS) / (6 * STIFFNESS)
    np.testing.assert_allclose(found, np.column_stack([0 * exact, -exact]), rtol=0, atol=1e-8 * exact[-1])


@pytest.mark.mpi
def test_without_its_smooth_joint_a_beam_has_a_hinge():
    geometry, ends = pieces(), [(0, "u1"), (1, "u1")]
    knots = np.sort([*open_knots(3, np.array([0, 1, 2, 10 / 3, 14 / 3, 6]) / 6), 1 / 3])
    whole = shapes.line((0, 0), (L, 0), elements=1, degree=3).on([BSplineBasis(3, knots)])
    expected = beam(whole, [(0, "u0"), (0, "u1")], load=1.0)(POSITIONS)
    sag = np.abs(expected).max()
    joined = beam(geometry, ends, load=1.0, constraints=[smooth_joints(geometry)])(POSITIONS)
    np.testing.assert_allclose(joined, expected, rtol=0, atol=1e-8 * sag)
    assert np.abs(beam(geometry, ends, load=1.0)(POSITIONS)).max() > 1.5 * sag


# -- sides that are glued ---------------------------------------------------------------------------------------------


def test_supports_by_name_leave_joints_alone():
    """Of two squares the right edge of the first one is a joint."""
    two = glued(
        *(shapes.parallelogram((x, 0, 0), (1, 0, 0), (0, 1, 0), elements=(2, 2), degrees=(2, 2)) for x in (0, 1))
    )
    outer = two.side("u1", 2, patch=1)
    np.testing.assert_array_equal(clamped(two, "u1"), two.dofs(outer))
    np.testing.assert_array_equal(pinned(two, "u1", components=[2]), two.side_dofs("u1", 1, [2], patch=1))
    np.testing.assert_array_equal(clamped(two, "u1", patch=0), two.side_dofs("u1", 2, patch=0))
    assert no_rotation(two, "u1").shape[0] == no_rotation(two, "u1", patch=1).shape[0] == 4
    assert symmetry(two, "u1", 0).shape == symmetry(two, "u1", 0, patch=1).shape
    ring = glued(turned(*radial(2, 2), z=[0.0, 0.1, 0.2, 0.3], quarters=4), within=True)
    for support in (clamped, pinned, no_rotation):
        with pytest.raises(ValueError, match="side 'u1' is glued to another side wherever there is one"):
            support(ring, "u1")


# -- symmetry ---------------------------------------------------------------------------------------------------------


@pytest.mark.mpi
def test_half_a_beam():
    """The full one may have a jump of the second derivative in the middle, as the half one may."""
    knots = np.sort([*open_knots(3, np.linspace(0, 1, 7)), 0.5])
    whole = shapes.line((0, 0), (L, 0), elements=1, degree=3).on([BSplineBasis(3, knots)])
    half = shapes.line((0, 0), (L / 2, 0), elements=3, degree=3)
    x = POSITIONS[:7]
    expected = beam(whole, [(0, "u0"), (0, "u1")], load=1.0)(x)
    found = beam(half, [(0, "u0")], load=1.0, constraints=[symmetry(half, "u1", 0)])(x)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9 * np.abs(expected).max())
    cantilever = beam(half, [(0, "u0")], load=1.0)(x)
    assert np.abs(cantilever - expected).max() > np.abs(expected).max()


def odd(x):
    """Symmetric about both axes, as a displacement is."""
    return ufl.as_vector([x[0], x[1] * (1.0 + x[0] ** 2)])


@pytest.mark.mpi
def test_a_quarter_of_a_plate_in_one_and_in_two_patches():
    whole = bending(rectangle((-1, 1), (-1, 1), (4, 4)), odd, clamped=[(0, d, end) for d in (0, 1) for end in (0, 1)])
    quarter_plate = rectangle((0, 1), (0, 1))
    mirrors = [symmetry(quarter_plate, "u0", 0), symmetry(quarter_plate, "v0", 1)]
    outside = [(0, 0, 1), (0, 1, 1)]
    compare(whole, bending(quarter_plate, odd, mirrors, outside), SAMPLES)
    differ(whole, bending(quarter_plate, odd, mirrors[:1], outside), SAMPLES)

    two = glued(rectangle((0, 0.5), (0, 1), (1, 2)), rectangle((0.5, 1), (0, 1), (1, 2)).reversed(0))
    mirrors = [symmetry(two, "u0", 0, patch=0), symmetry(two, "v0", 1), smooth_joints(two)]
    compare(whole, bending(two, odd, mirrors, [(0, 1, 1), (1, 1, 1), (1, 0, 0)]), SAMPLES)


@pytest.mark.mpi
def test_half_a_ring_with_weights():
    half = arcs()[0]
    whole = glued(half, Patch.from_points(half.bases, half.points * [1, -1], half.weights))
    angle, r = np.pi / 2 * SAMPLES[:, 0], 1.0 + SAMPLES[:, 1]
    points = np.stack([r * np.cos(angle), r * np.sin(angle)], axis=1)
    expected = bending(whole, odd, [smooth_joints(whole)], [(0, 0, 1), (1, 0, 1)])
    compare(expected, bending(half, odd, [symmetry(half, "u0", 1)], [(0, 0, 1)]), points)


def uneven_weights():
    patch = rectangle((0, 1), (0, 1))
    return Patch.from_points(patch.bases, patch.points, np.random.default_rng(0).uniform(1, 2, patch.n))


@pytest.mark.parametrize(
    ("patch", "side", "normal", "message"),
    [
        (arcs()[0], "u0", 0, r"side = 'u0' does not lie in a plane normal to axis 0"),
        (arcs()[0], "v0", 1, r"side = 'v0' does not lie in a plane"),
        (rectangle((0, 1), (0, 1)), "w0", 1, r"name = 'w0': one of 'u0', 'u1', 'v0', 'v1'"),
        (rectangle((0, 1), (0, 1)), "u0", 2, r"normal = 2: one of 0, 1 is required"),
        (flap(0.0, 0.1), "u0", 0, r"side = 'u0': coordinate lines must leave it along axis 0"),
        (uneven_weights(), "u0", 0, r"side = 'u0': coordinate lines must leave it along axis 0"),
    ],
)
def test_symmetry_that_is_none_is_refused(patch, side, normal, message):
    with pytest.raises(ValueError, match=message):
        symmetry(patch, side, normal)
    with pytest.raises(ValueError, match=r"patch = 1: one of 0"):
        symmetry(rectangle((0, 1), (0, 1)), "u0", 0, patch=1)
