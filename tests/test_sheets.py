"""Sheets of several patches: nothing of the coupling depends on the direction in which a patch is parametrised."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse as sp
from mpi4py import MPI
from scenes import sheet_in_flow
from stability_runs import through_duct
from stability_scenes import duct

from coudalfish import CouplingOptions
from coudalfish.restart import CoupledState
from coudalfish.surface import exchange
from coudalfish.surface.multiplier import SheetMeans, apart, carried_over
from coudalfish.surface.sheets import Sheets
from tigar_x.geometry import shapes
from tigar_x.geometry.gluing import glued
from tigar_x.geometry.multipatch import disjoint
from tigar_x.geometry.patch import Patch
from tigar_x.splines.spline import ExtractedSpline

RNG = np.random.default_rng(5)
SIGNS = (1.0, -1.0)


def sheets_of(*patches, joined=True):
    return Sheets.of(ExtractedSpline((glued if joined else disjoint)(*patches), MPI.COMM_SELF))


def quarter(i, j):
    """Part of a bent square."""
    patch = shapes.parallelogram((0.5 * i, 0.5 * j, 0.0), (0.5, 0, 0), (0, 0.5, 0), elements=(2, 3), degrees=(2, 2))
    x = patch.points.copy()
    x[:, 2] = 0.3 * x[:, 0] ** 2 - 0.2 * x[:, 1] ** 2
    return Patch.from_points(patch.bases, x, patch.weights)


def quarters(sheets):
    """Number of the quarter to which each point belongs, which is 2 i + j."""
    part, patch = sheets._parts(sheets.edges), np.zeros(len(sheets.X), dtype=int)
    for k in np.unique(part):
        patch[part == k] = np.dot(sheets.X[part == k, :2].mean(axis=0) > 0.5, (2, 1))
    return patch


# -- how points hang together -----------------------------------------------------------------------------------------

TURNS = {
    "as they are": lambda p: p,
    "reversed": lambda p: p.reversed(0),
    "other side": lambda p: p.reversed(1),
    "swapped": lambda p: p.swapped(),
    "swapped and reversed": lambda p: p.swapped().reversed(0),
}


@pytest.mark.parametrize("name", TURNS)
def test_normals_of_joined_patches_agree_by_their_signs(name):
    turn = TURNS[name]
    sheets = sheets_of(quarter(0, 0), turn(quarter(1, 0)), quarter(0, 1), turn(quarter(1, 1)))
    assert (sheets.sheet == 0).all()
    turned = sheets.X[:, 0] > 0.5 + 1e-9
    expected = 1.0 if name in ("as they are", "swapped and reversed") else -1.0
    found = sheets.sign * sheets.sign[np.argmin(sheets.X[:, :2].sum(axis=1))]
    assert (found[turned] == expected).all()
    assert (found[sheets.X[:, 0] < 0.5 - 1e-9] == 1.0).all()


def test_patches_that_touch_without_being_glued_are_sheets_of_their_own():
    sheets = sheets_of(quarter(0, 0), quarter(1, 0), joined=False)
    assert set(sheets.sheet) == {0, 1}
    assert len(sheets.joints) == 0
    assert (sheets.sign == 1.0).all()


@pytest.mark.parametrize("direction", SIGNS)
def test_curves_are_joined_at_their_ends(direction):
    second = shapes.line((0.5, 0.2), (1.0, 0.0), elements=3, degree=2)
    sheets = sheets_of(
        shapes.line((0.0, 0.0), (0.5, 0.2), elements=2, degree=2), second if direction > 0 else second.reversed(0)
    )
    assert len(sheets.joints) == 1
    assert sheets.sign.min() == min(direction, 1.0)
    assert (sheets.sheet == 0).all()


def test_a_ring_agrees_with_itself():
    ring = shapes.line((0.0, 0.0), (1.0, 0.0), elements=4, degree=1)
    angle = 2.0 * np.pi * ring.points[:, 0]
    closed = glued(Patch.from_points(ring.bases, np.column_stack([np.cos(angle), np.sin(angle)])), within=True)
    sheets = Sheets.of(ExtractedSpline(closed, MPI.COMM_SELF))
    assert (sheets.sign == 1.0).all()
    assert len(sheets.joints) == 1


def test_stretch_is_the_ratio_of_areas():
    sheets = sheets_of(quarter(0, 0), quarter(1, 0).reversed(0), quarter(0, 1), quarter(1, 1))
    turn = np.linalg.qr(RNG.normal(size=(3, 3)))[0]
    np.testing.assert_allclose(sheets.stretch(3.0 * sheets.X @ turn + 1.0), 9.0, rtol=1e-12)
    flat = Sheets(sheets.cells, sheets.joints, sheets.X * [1.0, 1.0, 0.0], sheets.mobility)
    np.testing.assert_allclose(flat.stretch(flat.X * [2.0, 1.0, 1.0]), 2.0, rtol=1e-12)


# -- smoothing --------------------------------------------------------------------------------------------------------


def folded(points=17, gap=1e-3):
    """Two layers of one curve at a distance far below a cell, and hat functions of width 1/4 over x at their points."""
    s = np.linspace(0.0, 1.0, points)
    X = np.concatenate([np.column_stack([s, 0 * s]), np.column_stack([s[::-1], gap + 0 * s])])
    cells = np.column_stack([np.arange(2 * points - 1), np.arange(1, 2 * points)]).astype(np.int32)
    hats = np.maximum(0.0, 1.0 - np.abs(X[:, :1] * 4.0 - np.arange(5)))
    return Sheets(cells, np.empty((0, 2), dtype=np.int32), X, np.ones((2 * points, 2))), sp.csr_matrix(hats)


def test_areas_have_the_digits_of_numpys_products_without_their_time(monkeypatch):
    sheets = sheets_of(quarter(0, 0), quarter(1, 0), quarter(0, 1).reversed(0), quarter(1, 1))
    corners = sheets.X[sheets.cells]
    arms = corners[:, 1:] - corners[:, :1]
    sizes = 0.5 * np.linalg.norm(np.cross(arms[:, :-1], arms[:, 1:]).sum(axis=1), axis=1)
    expected = np.bincount(sheets.cells.ravel(), np.repeat(sizes, sheets.cells.shape[1]), len(sheets.X))
    monkeypatch.delattr(np, "cross")
    np.testing.assert_array_equal(sheets._areas(sheets.X), expected)


def test_neighbours_are_the_edges_of_the_cells_each_once():
    sheets = sheets_of(quarter(0, 0), quarter(1, 0))
    pairs = {tuple(sorted(edge)) for edge in sheets.edges.tolist()}
    assert len(pairs) < len(sheets.edges)
    assert sheets.neighbours.T.tolist() == sorted(map(list, pairs))


def test_layers_of_a_fold_are_apart_but_where_it_bends():
    sheets, N = folded()
    parts = apart(N, sheets)
    assert parts.shape[1] == 9  # of five vertices, that at the bend has both layers in one piece
    np.testing.assert_allclose(parts.sum(axis=1), 1.0)
    lower = np.arange(34) < 17
    lam = np.where(lower, 1.0, -2.0)  # loads of the layers have nothing to do with each other
    smooth = exchange.VertexMeans(parts, np.ones(34)) @ lam
    far = sheets.X[:, 0] < 0.7
    np.testing.assert_allclose(smooth[far], lam[far], rtol=1e-12)


def curved(flips):
    """Smoothing on a bent sheet of four patches, of which some are parametrised backwards, and its matrix."""
    patches = [quarter(i, j) for i in (0, 1) for j in (0, 1)]
    patches = [patch.reversed(0) if flip else patch for patch, flip in zip(patches, flips, strict=True)]
    sheets = sheets_of(*patches)
    x = sheets.X
    n = np.column_stack([-0.6 * x[:, 0], 0.4 * x[:, 1], np.ones(len(x))])
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    ahead = np.where(np.array(flips)[quarters(sheets)], -1.0, 1.0)
    hats = [np.maximum(0.0, 1.0 - np.abs(x[:, [k]] * 3.0 - np.arange(4))) for k in (0, 1)]
    N = sp.csr_matrix(np.einsum("qi,qj->qij", *hats).reshape(len(x), -1))
    W = 0.5 + np.sin(7.0 * x[:, 0] + 3.0 * x[:, 1]) ** 2
    means = SheetMeans(N, W, ahead[:, None] * n, sheets)
    return means, np.column_stack([means @ e for e in np.eye(len(x))]), W, ahead


@pytest.mark.parametrize("flips", [(0, 0, 0, 0), (0, 1, 0, 0), (1, 0, 1, 1)])
def test_smoothing_keeps_force_and_flow_of_a_curved_sheet(flips):
    """And is symmetric in the area, with eigenvalues from 0 to 1, of which many are small."""
    means, S, W, ahead = curved(flips)
    kept = np.column_stack([W * ahead, *(W * means.n.T)]).T
    np.testing.assert_allclose(kept @ S, kept, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(W[:, None] * S, (W[:, None] * S).T, atol=1e-13)
    values = np.sort(np.linalg.eigvals(S).real)
    assert values[0] > -1e-12
    assert values[-1] < 1.0 + 1e-12
    assert (values < 0.5).mean() > 0.8
    np.testing.assert_allclose(S @ ahead, ahead, rtol=1e-12)  # a pressure jump is left alone
    plain = exchange.VertexMeans(means.N, W)
    lost = kept[1:] @ np.column_stack([plain @ e for e in np.eye(len(W))]) - kept[1:]
    assert np.abs(lost).max() > 1e-3 * np.abs(kept).max()


@pytest.mark.parametrize("flips", [(0, 1, 0, 0), (1, 0, 1, 1), (1, 1, 1, 1)])
def test_smoothing_does_not_depend_on_directions(flips):
    means, S, _, ahead = curved(flips)
    reference, R, *_ = curved((0, 0, 0, 0))
    orders = [np.lexsort((*m.sheets.X.round(9).T, quarters(m.sheets))) for m in (means, reference)]
    same = np.empty(len(ahead), dtype=int)
    same[orders[0]] = orders[1]
    np.testing.assert_allclose(S, ahead[:, None] * R[np.ix_(same, same)] * ahead, atol=1e-12)


def test_on_a_plane_sheet_smoothing_is_the_mean_over_vertices():
    sheets = sheets_of(shapes.line((0.0, 0.0), (1.0, 0.3), elements=12, degree=1))
    hats = sp.csr_matrix(np.maximum(0.0, 1.0 - np.abs(sheets.X[:, :1] * 4.0 - np.arange(5))))
    n = np.tile([-0.3, 1.0], (13, 1)) / np.hypot(0.3, 1.0)
    W, lam = RNG.uniform(0.5, 1.0, 13), RNG.normal(size=13)
    expected = exchange.VertexMeans(hats, W) @ lam
    np.testing.assert_allclose(SheetMeans(hats, W, n, sheets) @ lam, expected, rtol=1e-12, atol=1e-14)


@pytest.mark.mpi
def test_ranks_that_share_the_vertices_smooth_as_one_does():
    means, S, *_ = curved((0, 1, 0, 0))
    shared = replace(means, comm=MPI.COMM_WORLD)
    lam = np.random.default_rng(2).standard_normal(len(S))
    np.testing.assert_allclose(shared @ lam, S @ lam, rtol=0.0, atol=1e-13)
    if MPI.COMM_WORLD.size > 1:
        assert shared._means.N.nnz < means._means.N.nnz


# -- coupled steps ----------------------------------------------------------------------------------------------------

TWO = np.array([((0.42, 0.25), (0.42, 0.75)), ((0.47, 0.25), (0.47, 0.75))])  # in one column of cells
BACKWARDS = TWO.copy()
BACKWARDS[1] = TWO[1, ::-1]
TIGHT = CouplingOptions(block_rtol=1e-11, block_atol=1e-13)
OPTIONS = {
    "none": replace(TIGHT, relaxation=0.0),
    "uniform": replace(TIGHT, relaxation=0.1, relaxation_mode="uniform"),
    "smoothed": replace(TIGHT, relaxation=0.5, relaxation_mode="smoothed"),
    "iterate": replace(TIGHT, normal="iterate", fluid_tangent="consistent"),
    "published": replace(CouplingOptions.reference(), penalty=2.0, block_rtol=1e-9),
}


def pushed(ends, options, **settings):
    return sheet_in_flow(
        (0.0, 0.0), ends=ends, sheet_velocity=[(0.2, 0.0), (0.5, 0.1)], traction=0.5, options=options, n=5, **settings
    )


@pytest.mark.mpi
@pytest.mark.parametrize("name", OPTIONS)
def test_a_sheet_that_is_parametrised_backwards_moves_as_the_other_way_round(name):
    plain, backwards = pushed(TWO, OPTIONS[name]), pushed(BACKWARDS, OPTIONS[name])
    order = np.concatenate([np.arange(17), np.arange(17, 34)[::-1]])
    sign = np.repeat([1.0, -1.0], 17)
    x = plain.shell.quadrature.points
    np.testing.assert_allclose(backwards.shell.quadrature.points[order], x, atol=1e-14)
    for _ in range(4):
        one, other = plain.fsi.takeStep(), backwards.fsi.takeStep()
        assert one.passes == other.passes
        y, turned = (s.shell.spline.nodal(s.y) for s in (plain, backwards))
        np.testing.assert_allclose(turned[order], y, atol=1e-9)
        lam = plain.fsi.lam
        np.testing.assert_allclose(sign * backwards.fsi.lam[order], lam, atol=1e-7 * np.abs(lam).max())
        np.testing.assert_allclose(backwards.shell.normals()[order], sign[:, None] * plain.shell.normals(), atol=1e-9)
        np.testing.assert_allclose(other.monitors.force, one.monitors.force, rtol=1e-7)
        assert other.monitors.normal_slip_rms == pytest.approx(one.monitors.normal_slip_rms, rel=1e-6)
        assert other.slip_ratio == pytest.approx(one.slip_ratio, rel=1e-6)


def test_the_leak_counts_along_the_normals_over_the_present_area():
    """A sheet stretched to twice its length in a uniform flow that goes through it lets through twice as much."""
    leaks = {}
    for stretch in (1.0, 2.0):
        for way in (1, -1):
            ends = np.array([(0.5, 0.3), (0.5, 0.5)])[::way]
            scene = sheet_in_flow(
                (0.4, 0.0), ends=ends, sheet_velocity=(0.0, 0.0), stiffness=1e-6, options=CouplingOptions(penalty=1e-7)
            )
            for field in (scene.y, scene.shell.timeInt.x_old):
                field.x.array[1::2] = (stretch - 1.0) * (scene.shell.quadrature.points[:, 1] - 0.4)
            leaks[stretch, way] = scene.fsi.takeStep().monitors.leak
    assert abs(leaks[1.0, 1]) == pytest.approx(0.4 * 0.2, rel=1e-4)
    for way in (1, -1):
        assert leaks[2.0, way] == pytest.approx(2.0 * leaks[1.0, way], rel=1e-3)
    assert leaks[1.0, -1] == pytest.approx(-leaks[1.0, 1], rel=1e-9)


def test_joined_patches_in_opposite_directions_have_the_normals_of_one():
    """And so forces, multiplier and leak; the joint is where they would cancel."""
    whole = ((0.35, 0.25), (0.4, 0.5)), ((0.4, 0.5), (0.45, 0.75))
    turned = (whole[0], whole[1][::-1])
    results = []
    for ends in (whole, turned):
        scene = sheet_in_flow(
            (0.0, 0.0), ends=ends, sheet_velocity=(0.5, 0.1), density_of_points=8, options=TIGHT, join=True
        )
        reports = [scene.fsi.takeStep() for _ in range(3)]
        x = scene.shell.quadrature.points
        order = np.argsort(x[:, 1], kind="stable")
        lengths = np.linalg.norm(scene.shell.normals(), axis=1)
        np.testing.assert_allclose(lengths, 1.0, atol=1e-3)
        results.append(
            (scene.shell.spline.nodal(scene.y)[order], np.abs(scene.fsi.lam[order]), reports[-1].monitors.force)
        )
    for one, other in zip(*results, strict=True):
        np.testing.assert_allclose(other, one, atol=1e-9 * np.abs(one).max())


def test_a_run_does_not_go_on_with_patches_in_other_directions():
    plain, backwards = pushed(TWO, TIGHT), pushed(BACKWARDS, TIGHT)
    plain.fsi.takeStep()
    record = CoupledState(plain.fsi).record()
    CoupledState(pushed(TWO, TIGHT).fsi).check(record)
    with pytest.raises(ValueError, match="parametrised in other directions"):
        CoupledState(backwards.fsi).check(record)


# -- points that are held ---------------------------------------------------------------------------------------------


def test_what_is_carried_over_comes_from_the_nearest_points():
    sheets = sheets_of(shapes.line((0.0, 0.0), (1.0, 0.0), elements=6, degree=1))
    lam, all_points = np.array([0.0, 0.0, 3.0, 4.0, 5.0, 6.0, -1.0]), np.ones(7, dtype=bool)
    held = np.array([1, 1, 0, 0, 0, 0, 1], dtype=bool)
    np.testing.assert_array_equal(carried_over(lam, all_points, held, sheets), [3.0, 3.0, 3.0, 4.0, 5.0, 6.0, 6.0])
    np.testing.assert_array_equal(carried_over(lam, all_points, all_points, sheets), lam)
    outside = np.arange(7) != 5
    np.testing.assert_array_equal(carried_over(lam, outside, held, sheets)[5:], [6.0, -1.0])


@pytest.mark.parametrize(("mode", "elements"), [("uniform", 6), ("smoothed", 12), ("smoothed", 24)])
def test_a_plate_between_walls_that_hold_the_fluid_takes_the_whole_force(mode, elements):
    """Walls without slip hold the fluid at its ends; a jump of pressure of 1 acts on a height of 1."""
    relaxation = 0.0 if mode == "uniform" else 0.5
    options = CouplingOptions(penalty=50.0, relaxation=relaxation, relaxation_mode=mode)
    scene = duct(options, n=6, jump=0.0, slip=False, elements=elements)
    report = through_duct(scene, 60, ramp=20)[0][-1]
    assert report.monitors.force[0] == pytest.approx(1.0, rel=5e-3)
    np.testing.assert_allclose(np.abs(scene.fsi.lam), 1.0, atol=0.02)
