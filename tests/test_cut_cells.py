"""Curves that cut a mesh of triangles: sides, weights on the boundary, and the nodes that are enriched."""

import numpy as np
import pytest
import ufl
from mpi4py import MPI
from dolfinx import fem, mesh

from coudalfish.surface.cut_cells import CutCells
from coudalfish.surface.distance import Curves
from coudalfish.surface.enriched import Enriching, agreeing
from coudalfish.surface.facets import FacetWeights
from coudalfish.surface.interface import Sought
from coudalfish.surface.sheets import Chain, Sheets
from tigar_x import compat

COMM = MPI.COMM_WORLD


def polyline(x, closed=False):
    x = np.asarray(x, dtype=float)
    n = len(x)
    ends = np.arange(n if closed else n - 1)
    return Curves(x, Chain(np.column_stack([ends, (ends + 1) % n]), np.arange(n)))


def several(*curves):
    """Curves side by side."""
    counts = np.cumsum([0] + [len(curve.x) for curve in curves[:-1]])
    x = np.concatenate([curve.x for curve in curves])
    segments = np.concatenate([curve.chain.segments + count for curve, count in zip(curves, counts, strict=True)])
    return Curves(x, Chain(segments, np.arange(len(x))))


def nearest(curve, x, reach):
    return curve.nearest(np.asarray(x), Sought(np.arange(len(x)), reach))


def circle(radius=0.3, n=200, center=(0.51, 0.52)):
    angle = 2.0 * np.pi * np.arange(n) / n
    return polyline(np.array(center) + radius * np.column_stack([np.cos(angle), np.sin(angle)]), closed=True)


def enriching(n=10, comm=COMM, kinked=True):
    space = compat.lagrange_space(mesh.create_unit_square(comm, n, n), 1)
    return Enriching(space, kinked=kinked)


@pytest.mark.parametrize("degree", [2, 4])
def test_weights_on_the_boundary_integrate_over_its_part(degree):
    """Polynomials of their degree exactly: a penalty of products of kinks is then not negative."""
    domain = mesh.create_unit_square(MPI.COMM_SELF, 4, 4)
    space, linear = compat.lagrange_space(domain, degree, discontinuous=True), compat.lagrange_space(domain, 1)
    x = linear.tabulate_dof_coordinates()
    cut = CutCells.of(compat.cell_dofs(linear), x[:, 0] + 0.2 * x[:, 1] - 0.2502)  # close to a vertex at the bottom
    cells, values = FacetWeights(space, degree)(cut)
    weight = fem.Function(space)
    weight.x.array[compat.cell_dofs(space)[cells]] = values
    X = ufl.SpatialCoordinate(domain)
    ds = ufl.ds(domain=domain, metadata={"quadrature_degree": 2 * degree})
    for power in range(degree + 1):
        bottom = ufl.conditional(ufl.And(ufl.lt(X[1], 1e-9), ufl.gt(X[0], 0.25)), 1.0, 0.0)
        form = compat.compile_forms(weight * bottom * (X[0] - 0.25) ** power * ds)[0]
        assert compat.assemble_scalar(form) == pytest.approx(2e-4 ** (power + 1) / (power + 1), abs=1e-16)


def test_values_at_nearest_places_go_on_beyond_free_ends():
    curve = several(polyline([[0.0, 0.0], [1.0, 0.0]]))
    turning = np.column_stack([np.zeros(len(curve.x)), 2.0 * curve.x[:, 0]])
    x = np.array([[0.25, 0.1], [1.0, -0.1], [1.2, 0.1], [-0.1, 0.0], [0.5, 2.0]])
    expected = [[0.0, 0.5], [0.0, 2.0], [0.0, 2.4], [0.0, -0.2], [0.0, 0.0]]
    np.testing.assert_allclose(nearest(curve, x, 1.0).values(turning), expected, atol=1e-14)


def test_values_half_way_between_mirrored_curves_are_mirrored():
    """Where both are equally near it is the mean, at other points the value of the nearer one."""
    curves = several(polyline([[0.1, 0.0], [0.3, 0.4]]), polyline([[0.1, 1.0], [0.3, 0.6]]))
    v = np.column_stack([np.ones(len(curves.x)), np.where(curves.x[:, 1] < 0.5, 2.0, -2.0)])
    x = np.array([[0.3, 0.5], [0.7, 0.5], [0.3, 0.49], [0.3, 0.51]])
    expected = [[1.0, 0.0], [1.0, 0.0], [1.0, 2.0], [1.0, -2.0]]
    np.testing.assert_allclose(nearest(curves, x, 1.0).values(v), expected, atol=1e-14)


def test_zero_counts_as_positive_and_what_is_unknown_is_not_cut():
    phi = np.array([0.0, 1.0, 2.0, -1.0, np.nan])
    cut = CutCells.of(np.array([[0, 1, 2], [0, 1, 3], [3, 1, 4]]), phi)
    np.testing.assert_array_equal(cut.cells, [1])
    np.testing.assert_allclose(CutCells.of(np.array([[0, 3, 3]]), phi).negative_share, 1.0)


def test_sides_of_a_closed_curve():
    x = np.random.default_rng(5).uniform(0.0, 1.0, (300, 2))
    r = np.linalg.norm(x - [0.51, 0.52], axis=1)
    phi = nearest(circle(), x, 10.0).signed_distance()
    np.testing.assert_allclose(phi, 0.3 - r, atol=1e-4)  # it turns left, and its normals point inwards
    assert np.isnan(nearest(circle(), [[0.51, 0.52], [0.51, 0.80]], 0.1).signed_distance()[0])
    assert not circle().chain.free.any()


def test_a_curve_goes_straight_on_beyond_its_ends():
    curve = polyline([[0.2, 0.5], [0.4, 0.5], [0.5, 0.6]])
    x = np.array([[0.0, 0.7], [0.0, 0.3], [0.6, 0.8], [0.8, 0.8], [0.3, 0.45]])
    assert nearest(curve, [[0.41, 0.47]], 1.0).covered().all()  # nearest is the corner, at which the curve goes on
    np.testing.assert_allclose(
        nearest(curve, x, 1.0).signed_distance(), [0.2, -0.2, 0.1 / 2**0.5, -0.1 / 2**0.5, -0.05]
    )
    np.testing.assert_array_equal(nearest(curve, x, 1.0).covered(), [False, False, False, False, True])
    np.testing.assert_array_equal(curve.near_ends(x, 0.25), [2, 4])
    np.testing.assert_array_equal(curve.near_ends(x, np.array([0.25, 0.25, 0.1, 0.25, 0.25])), [4])


def test_corners_have_the_side_of_both_segments():
    """At a sharp corner the normals of one segment alone put points on the wrong side."""
    curve = polyline([[0.0, 0.0], [0.5, 0.1], [0.0, 0.2]])
    np.testing.assert_array_equal(np.sign(nearest(curve, [[0.6, 0.05], [0.6, 0.15]], 1.0).signed_distance()), -1.0)


def test_patches_that_are_parametrised_against_each_other_have_one_side():
    from tigar_x.geometry import shapes
    from tigar_x.geometry.gluing import glued
    from tigar_x.splines.spline import ExtractedSpline

    parts = [shapes.line((0.1, 0.5), (0.5, 0.5), elements=4), shapes.line((0.9, 0.5), (0.5, 0.5), elements=4)]
    sheets = Sheets.of(ExtractedSpline(glued(*parts), MPI.COMM_SELF))
    curves = Curves.of(sheets, sheets.X)
    phi = nearest(curves, [[0.2, 0.6], [0.8, 0.6], [0.5, 0.6]], 1.0).signed_distance()
    np.testing.assert_allclose(np.abs(phi), 0.1)
    assert len(set(np.sign(phi))) == 1
    np.testing.assert_allclose(np.sort(curves.x[curves.chain.free, 0]), [0.1, 0.9])


@pytest.mark.mpi
def test_sides_of_a_closed_curve_have_its_areas_and_every_node_is_enriched():
    e = enriching(12)
    found = e(circle())
    mine = found.cut.only(found.cut.cells < len(e.vertices[: compat.owned_cells(e._sum.function_space.mesh)]))
    areas = 0.5 * np.abs(np.linalg.det(e.corners[mine.cells][:, 1:] - e.corners[mine.cells][:, :1]))
    known = np.isfinite(found.phi)
    outside = (found.phi < 0.0) | (~known & (np.linalg.norm(e.x - [0.51, 0.52], axis=1) > 0.3))
    whole = np.ones(len(e.vertices), dtype=bool)
    whole[found.cut.cells] = False
    whole[compat.owned_cells(e._sum.function_space.mesh) :] = False
    uncut = 0.5 * np.abs(np.linalg.det(e.corners[whole][:, 1:] - e.corners[whole][:, :1]))
    inside = (areas * (1.0 - mine.negative_share)).sum() + uncut[~outside[e.vertices[whole]].any(axis=1)].sum()
    np.testing.assert_allclose(COMM.allreduce(float(inside)), np.pi * 0.3**2, rtol=0.02)
    assert found.jump[e.vertices[mine.cells]].all()
    assert found.kink[e.vertices[mine.cells]].all()
    assert not enriching(12, kinked=False)(circle()).kink.any()


@pytest.mark.mpi
def test_all_partitions_enrich_the_same_nodes():
    for curve in (circle(), polyline([[0.11, 0.2], [0.5, 0.43], [0.77, 0.81]])):
        masks = []
        for comm in (COMM, MPI.COMM_SELF):
            e = enriching(9, comm)
            found = e(curve)
            index = np.round(e.x * 9).astype(int) @ [10, 1]
            both = np.zeros((2, 100))
            both[:, index] = found.jump, found.kink
            masks.append(comm.allreduce(both, op=MPI.SUM) > 0)
        np.testing.assert_array_equal(*masks)


def test_along_mesh_lines_pressures_jump_at_the_line_and_velocities_are_not_kinked():
    e = enriching(10)
    found = e(polyline([[0.5, 0.0], [0.5, 1.0]]))
    np.testing.assert_array_equal(np.flatnonzero(found.jump), np.flatnonzero(np.abs(e.x[:, 0] - 0.5) < 1e-9))
    assert not found.kink.any()
    moved = e(polyline([[0.5 + 1e-7, 0.0], [0.5 + 1e-7, 1.0]]))
    np.testing.assert_array_equal(moved.jump, found.jump)


@pytest.mark.parametrize(("gap", "closed"), [(0.0, True), (0.4, True), (3.0, False)])
def test_small_gaps_between_free_ends_are_closed_and_wide_ones_open(gap, closed):
    h, y = 0.1, 0.533
    left, right = 0.5 - 0.5 * gap * h, 0.5 + 0.5 * gap * h
    whole = enriching(10)(polyline([[-0.1, y], [1.1, y]]))
    parts = enriching(10)(several(polyline([[-0.1, y], [left, y]]), polyline([[right, y], [1.1, y]])))
    assert np.array_equal(parts.kink, whole.kink) == closed
    assert np.array_equal(parts.jump, whole.jump) == closed
    assert not (parts.kink & ~whole.kink).any()


@pytest.mark.parametrize("distance", [0.2, 0.26, 0.35])
def test_nothing_is_cut_half_way_between_two_curves(distance):
    """Between curves whose normals agree the sign of the nearest one changes."""
    low, high = (polyline([[-0.1, y], [1.1, y]]) for y in (0.33, 0.33 + distance))
    e = enriching(10)
    found = e(several(low, high))
    cells = np.sort(np.concatenate([e(curve).cut.cells for curve in (low, high)]))
    np.testing.assert_array_equal(found.cut.cells, cells)


@pytest.mark.mpi
@pytest.mark.parametrize(
    "ends",
    [
        [[(0.53, -0.1), (0.53, 0.46)], [(0.53, 0.52), (0.53, 1.1)]],
        [[(0.43, -0.1), (0.43, 0.46)], [(0.47, -0.1), (0.47, 0.46)]],
        [[(0.43, -0.1), (0.43, 0.46)], [(0.57, -0.1), (0.57, 0.46)]],
        [[(0.23, -0.1), (0.23, 0.46)], [(0.41, -0.1), (0.41, 0.46)], [(0.62, 1.1), (0.62, 0.6)]],
    ],
    ids=["tips", "in one cell", "a cell apart", "three"],
)
def test_which_way_curves_are_parametrised_does_not_matter(ends):
    e, found = enriching(10), []
    for turned in np.ndindex(*[2] * len(ends)):
        found.append(e(several(*(polyline(pair[:: 1 - 2 * k]) for pair, k in zip(ends, turned, strict=True)))))
        for name in ("jump", "kink"):
            np.testing.assert_array_equal(getattr(found[-1], name), getattr(found[0], name))
        np.testing.assert_array_equal(found[-1].cut.cells, found[0].cut.cells)
        np.testing.assert_allclose(np.abs(found[-1].phi), np.abs(found[0].phi), rtol=1e-12)
    assert COMM.allreduce(int(found[0].jump.sum()), op=MPI.SUM) > 4
    near = np.isfinite(found[0].phi)
    assert np.array_equal(found[-1].phi[near] < 0.0, found[0].phi[near] >= 0.0)  # the first curve keeps its normals


def test_curves_in_a_star_divide_their_own_cells_alone():
    """Half way between two of them the side changes as well, and the continuation of another one may lie there."""
    e, center, parts = enriching(24), np.array([0.52, 0.54]), []
    for angle in np.deg2rad([113.0, 183.0, 258.0, 336.0]):
        parts.append(polyline(center + np.outer([0.026, 0.416], [np.cos(angle), np.sin(angle)])))
    cut = e(several(*parts)).cut.cells
    alone = np.unique(np.concatenate([e(part).cut.cells for part in parts]))
    outer = np.linalg.norm(e.corners.mean(axis=1) - center, axis=1) > 0.09
    np.testing.assert_array_equal(cut[outer[cut]], alone[outer[alone]])
    assert outer[cut].sum() > 70


def test_two_curves_in_one_cell_divide_it_as_one():
    """With normals that point at each other both far sides would be one."""
    ends = [(0.43, -0.1), (0.43, 1.1)], [(0.47, 1.1), (0.47, -0.1)]
    one, pair = enriching(10)(polyline(ends[0])), enriching(10)(several(*map(polyline, ends)))
    np.testing.assert_array_equal(pair.kink, one.kink)
    near = np.isfinite(one.phi)
    np.testing.assert_array_equal(np.sign(pair.phi[near]), np.sign(one.phi[near]))


def test_signs_follow_the_strongest_wishes():
    np.testing.assert_array_equal(agreeing(np.zeros((3, 3))), 1.0)
    wishes = np.array([[0.0, -3.0, 1.0], [-3.0, 0.0, 5.0], [1.0, 5.0, 0.0]])
    np.testing.assert_array_equal(agreeing(wishes), [1.0, -1.0, -1.0])
    np.testing.assert_array_equal(agreeing(wishes[::-1, ::-1]), [1.0, 1.0, -1.0])


@pytest.mark.mpi
def test_nothing_is_divided_beyond_a_free_end():
    """Sides are known far beyond it, so that cells are cut that no curve covers."""
    e = enriching(20)
    found = e(polyline([[0.71, 0.52], [0.93, 0.55]]))
    x = e.x[found.jump | found.kink, 0]
    assert COMM.allreduce(float(x.min(initial=1.0)), op=MPI.MIN) > 0.71 - 2.0 * 0.05
    assert COMM.allreduce(float(x.max(initial=0.0)), op=MPI.MAX) < 0.93 + 2.0 * 0.05
    assert COMM.allreduce(len(x)) > 5


def test_lines_that_cross_a_curve_or_its_continuation():
    curve = polyline([[0.1, 0.1], [0.5, 0.5], [0.9, 0.1]])
    start = np.array([[0.0, 0.3], [0.0, 0.2], [0.5, 0.6], [0.5, 0.6], [0.95, 0.0], [0.4, 0.9], [0.05, 0.0]])
    end = np.array([[0.3, 0.0], [0.05, 0.1], [0.5, 0.4], [0.5, 0.51], [0.95, 1.0], [0.6, 0.9], [0.05, 0.06]])
    near = [True, False, True, False, False, False, False]
    np.testing.assert_array_equal(curve.crossed(start, end, 1e-9), near)
    np.testing.assert_array_equal(curve.crossed(start, end, 0.1), [*near[:4], True, False, True])
    some = np.array([0.1, 0.1, 0.1, 0.1, 0.1, 0.1, 0.05])
    np.testing.assert_array_equal(curve.crossed(start, end, some), [*near[:4], True, False, False])
    assert curve.crossed(start[:0], end[:0], 0.1).shape == (0,)
    loop = polyline([[0.1, 0.1], [0.5, 0.5], [0.9, 0.1]], closed=True)
    np.testing.assert_array_equal(loop.crossed(start, end, 0.1), near)
