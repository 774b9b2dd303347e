"""Curves whose points see averages of the fluid: exact integrals, areas, forces, and the same on all ranks."""

import numpy as np
import pytest
from mpi4py import MPI
from dolfinx import fem, mesh
from scenes import sheet_in_flow

from coudalfish import CouplingOptions
from coudalfish.surface.averages import MeetsByAverages
from coudalfish.surface.crossings import CellsNearby, pieces_of
from coudalfish.surface.sheets import Sheets
from coudalfish.surface.trace import PointLocator
from tigar_x import compat
from tigar_x.geometry.shapes import interpolated, uniform
from tigar_x.splines.quadrature import NodalQuadrature
from tigar_x.splines.spline import ExtractedSpline

COMM = MPI.COMM_WORLD
EXACT = CouplingOptions(trace="exact")
BENT = np.array([[0.13, 0.21], [0.3, 0.33], [0.34, 0.5], [0.52, 0.61], [0.83, 0.58]])


def squares(n=4, comm=COMM):
    return mesh.create_unit_square(comm, n, n)


def meeting_of(x, degree=1, n=4, comm=COMM, domain=None):
    """An open curve through points, its lengths at rest those it has now."""
    domain = squares(n, comm) if domain is None else domain
    space = compat.lagrange_space(domain, degree)
    segments = np.column_stack([np.arange(len(x) - 1), np.arange(1, len(x))])
    lengths = np.linalg.norm(np.diff(x, axis=0), axis=1)
    return space, MeetsByAverages(space, segments, lengths, len(x))(x, PointLocator(domain))


def averages(space, met, f):
    function = fem.Function(space)
    function.interpolate(f)
    function.x.scatter_forward()
    return space.mesh.comm.allreduce(met.trace.B @ function.x.array[met.trace.nodes], op=MPI.SUM)


def hat_integrals(x, f):
    """Integrals of a smooth function times hat functions over the whole curve."""
    at, weights = np.polynomial.legendre.leggauss(8)
    at, result = 0.5 * (at + 1.0), np.zeros(len(x))
    for k in range(len(x) - 1):
        values = f((x[k] + at[:, None] * (x[k + 1] - x[k])).T) * 0.5 * weights * np.linalg.norm(x[k + 1] - x[k])
        result[k] += values @ (1.0 - at)
        result[k + 1] += values @ at
    return result


@pytest.mark.mpi
@pytest.mark.parametrize("degree", [1, 2, 3])
def test_polynomials_are_averaged_exactly(degree):
    space, met = meeting_of(BENT, degree)
    assert met.active.all()
    for i in range(degree + 1):

        def f(x, i=i):
            return x[0] ** i * (1.0 - 2.0 * x[1]) ** (degree - i)

        np.testing.assert_allclose(met.W * averages(space, met, f), hat_integrals(BENT, f), atol=1e-14)


@pytest.mark.mpi
def test_functions_that_bend_between_cells_are_averaged_exactly():
    """A linear interpolant is none on the curve as a whole: its bends are where the curve leaves a cell."""
    space, met = meeting_of(np.array([[0.05, 0.5], [0.95, 0.5]]))
    bent = averages(space, met, lambda x: np.abs(x[0] - 0.5))
    np.testing.assert_allclose(met.W * bent, 0.5 * (2.0 * 0.45 * 0.5 * 0.45), atol=1e-14)


@pytest.mark.mpi
@pytest.mark.parametrize("shift", [0.0, 1e-13, -1e-13, 1e-9])
def test_curves_along_the_sides_of_cells_count_once(shift):
    x = np.column_stack([np.full(7, 0.5 + shift), np.linspace(0.0, 1.0, 7)])
    space, met = meeting_of(x)
    np.testing.assert_allclose(met.W.sum(), 1.0, rtol=1e-12)
    np.testing.assert_allclose(averages(space, met, lambda x: 1.0 + 0.0 * x[0]), 1.0, atol=1e-12)


@pytest.mark.mpi
def test_what_is_outside_has_no_area_and_what_is_inside_keeps_its_own():
    x = np.array([[-0.6, 0.4], [-0.2, 0.4], [0.2, 0.4], [0.6, 0.4]])
    space, met = meeting_of(x)
    np.testing.assert_array_equal(met.active, [False, True, True, True])
    np.testing.assert_allclose(met.W, [0.0, 0.05, 0.35, 0.2], atol=1e-13)
    np.testing.assert_allclose(averages(space, met, lambda x: 1.0 + 0.0 * x[0]), [0.0, 1.0, 1.0, 1.0], atol=1e-13)


@pytest.mark.mpi
def test_forces_keep_their_sum_and_their_moment():
    x = np.column_stack([np.linspace(0.15, 0.85, 8), np.linspace(0.3, 0.62, 8)])
    space, met = meeting_of(x)
    forces = np.random.default_rng(3).normal(size=(8, 2))
    forces[[0, -1]] = 0.0  # ends stand for what lies on one side of them
    nodal = met.trace.transposed @ forces
    places = space.tabulate_dof_coordinates()[met.trace.nodes, :2]
    np.testing.assert_allclose(COMM.allreduce(nodal.sum(axis=0)), forces.sum(axis=0), atol=1e-13)

    def moment(x, F):
        return float((x[:, 0] * F[:, 1] - x[:, 1] * F[:, 0]).sum())

    np.testing.assert_allclose(COMM.allreduce(moment(places, nodal)), moment(x, forces), atol=1e-13)


@pytest.mark.mpi
def test_all_partitions_see_the_same():
    together, alone = meeting_of(BENT, n=7), meeting_of(BENT, n=7, comm=MPI.COMM_SELF)

    def f(x):
        return np.sin(9.0 * x[0]) * np.cos(7.0 * x[1])

    np.testing.assert_allclose(together[1].W, alone[1].W, atol=1e-14)
    np.testing.assert_allclose(averages(*together, f), averages(*alone, f), atol=1e-13)
    N = [met.vertex_functions() for _, met in (together, alone)]
    np.testing.assert_allclose(next(np.sort(part.toarray().max(axis=1)) for part in N), np.sort(N[1].toarray().max(1)))
    np.testing.assert_allclose(N[0].sum(axis=1), 1.0, atol=1e-13)


@pytest.mark.mpi
def test_pieces_cover_segments_and_lie_in_cells_whatever_their_sizes():
    """A mesh graded over three orders of magnitude, on which one radius for all cells would find nearly every pair."""
    domain = squares(12)
    domain.geometry.x[:, :2] **= 3.0
    locator = PointLocator(domain)
    nearby = CellsNearby(locator.corners)
    a, b = np.array([[0.001, 0.002], [0.1, 0.9]]), np.array([[0.9, 0.85], [0.1, -0.3]])
    pieces = pieces_of(a, b, locator, nearby, COMM)
    for k in range(2):
        mine = pieces.segment == k
        assert pieces.start[mine][0] == 0.0
        assert pieces.end[mine][-1] == 1.0
        np.testing.assert_array_equal(pieces.start[mine][1:], pieces.end[mine][:-1])
    held = np.flatnonzero(pieces.cells >= 0)
    for t in (pieces.start, pieces.end):
        x = a[pieces.segment] + t[:, None] * (b - a)[pieces.segment]
        assert locator.barycentric(pieces.cells[held], x[held]).min(initial=0.0) > -1e-7
    found = np.sum(COMM.allgather(pieces.cells >= 0), axis=0) > 0
    middle = a[pieces.segment] + (0.5 * (pieces.start + pieces.end))[:, None] * (b - a)[pieces.segment]
    np.testing.assert_array_equal(found, middle[:, 1] > 0.0)
    cells = squares(40)
    assert len(CellsNearby(PointLocator(cells).corners).pairs(a[:1], a[:1] + 1e-3)[0]) < 20


def test_a_curved_shell_keeps_its_length():
    """Chords between points are shorter than the arc."""
    radius, bases = 0.3, (uniform(2, 8),)
    patch = interpolated(lambda t: (0.5 + radius * np.cos(3.0 * t), 0.4 + radius * np.sin(3.0 * t)), bases)
    spline = ExtractedSpline(patch, MPI.COMM_SELF)
    sheets, weights = Sheets.of(spline), NodalQuadrature.of(spline).weights
    domain = squares(comm=MPI.COMM_SELF)
    meets = MeetsByAverages.of(compat.lagrange_space(domain, 1), sheets, weights)
    met = meets(sheets.X, PointLocator(domain))
    np.testing.assert_allclose(met.W.sum(), weights.sum(), rtol=1e-12)
    a, b = sheets.cells.T
    assert np.linalg.norm(sheets.X[a] - sheets.X[b], axis=1).sum() < (1.0 - 1e-4) * weights.sum()


def test_surfaces_in_space_are_refused():
    four = np.zeros((1, 4), dtype=np.int32)
    surface = Sheets(four, np.empty((0, 2), dtype=np.int32), np.zeros((4, 3)), np.ones((4, 3)))
    with pytest.raises(ValueError, match="trace = 'exact': a curve in the plane is required"):
        MeetsByAverages.of(compat.lagrange_space(squares(), 1), surface, np.ones(4))
    with pytest.raises(ValueError, match="trace = 'hats'"):
        CouplingOptions(trace="hats")


@pytest.mark.mpi
def test_a_sheet_in_a_uniform_flow_is_carried_along():
    scene = sheet_in_flow(sheet_velocity=(0.3, 0.2), options=EXACT)
    for _ in range(2):
        report = scene.fsi.take_step()
    assert report.monitors.normal_slip_max < 1e-9
    np.testing.assert_allclose(scene.fsi.timeInt_sh.x.x.array.reshape(-1, 2), [[0.06, 0.04]] * 17, atol=1e-8)


@pytest.mark.mpi
@pytest.mark.parametrize("changes", [{"relaxation": 0.0}, {}])
def test_a_sheet_that_is_slower_gives_the_fluid_what_it_gets(changes):
    scene = sheet_in_flow(sheet_velocity=(0.0, 0.1), options=EXACT.with_(fluid_tangent="consistent", **changes))
    for _ in range(2):
        report = scene.fsi.take_step()
    assert report.monitors.force_imbalance < 1e-12
    assert report.monitors.force[0] > 1e-3
    assert report.passes <= 4


def test_on_a_fine_mesh_points_and_averages_agree():
    """Where the fluid's cells are larger than the distance of points both traces are nearly the same."""
    moved = []
    for trace in ("nodes", "exact"):
        scene = sheet_in_flow(sheet_velocity=(0.0, 0.1), density_of_points=64, options=CouplingOptions(trace=trace))
        scene.fsi.take_step()
        moved.append(scene.fsi.timeInt_sh.x.x.array.copy())
    np.testing.assert_allclose(moved[0], moved[1], rtol=0.05, atol=1e-4)
    assert not np.array_equal(*moved)
