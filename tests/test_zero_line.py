"""The zero line by which a flow knows a curve: where it is on average, and how points see the flow on it."""

import numpy as np
import pytest
from mpi4py import MPI
from dolfinx import mesh
from test_cut_cells import circle, several

from coudalfish.surface.averages import MeetsByAverages
from coudalfish.surface.enriched import Enriching
from coudalfish.surface.in_plane import onto_zero_line
from coudalfish.surface.trace import PointLocator
from tigar_x import compat


def met(curves, n=10):
    """Enriching of the unit square, and how curves meet it by the exact trace."""
    domain = mesh.create_unit_square(MPI.COMM_WORLD, n, n)
    space = compat.lagrange_space(domain, 1)
    lengths = np.linalg.norm(np.diff(curves.x[curves.chain.segments], axis=1)[:, 0], axis=1)
    found = MeetsByAverages(space, curves.chain.segments, lengths, len(curves.x))(curves.x, PointLocator(domain))
    return Enriching(space, kinked=True), found


def off(phi, meeting):
    """Mean of phi over a curve, and root of its mean square (collective)."""
    (E, w), nodes = meeting.penalty, meeting.trace.nodes
    values = E @ np.nan_to_num(phi)[nodes]
    sums = MPI.COMM_WORLD.allreduce(np.array([w[meeting.location.owned].sum(), w @ values, w @ values**2]))
    return sums[1] / sums[0], np.sqrt(sums[2] / sums[0])


@pytest.mark.mpi
def test_a_bent_curve_departs_to_both_sides_of_its_zero_line_alike():
    curves = circle()
    enriching, meeting = met(curves)
    (mean, rms), (centred, less) = (off(enriching(curves, m).phi, meeting) for m in (None, meeting))
    assert abs(mean) > 1e-3
    assert abs(centred) < 0.1 * abs(mean)
    assert less < 0.6 * rms


@pytest.mark.mpi
def test_a_second_curve_in_the_same_cells_hardly_moves_the_zero_line():
    """Places on it are half a cell from that of the first one, and all of this would be taken for a departure."""
    curves = several(circle(0.3), circle(0.35))
    enriching, meeting = met(curves)
    before, after = (enriching(curves, m).phi for m in (None, meeting))
    assert MPI.COMM_WORLD.allreduce(float(np.nanmax(np.abs(after - before))), op=MPI.MAX) < 0.02


@pytest.mark.mpi
def test_places_are_moved_straight_onto_the_zero_line_in_divided_cells_alone():
    curves = circle()
    enriching, meeting = met(curves)
    phi, location = np.nan_to_num(enriching(curves, meeting).phi), meeting.location
    divided = np.zeros(len(enriching.vertices), dtype=bool)
    divided[enriching(curves, meeting).cut.cells] = True
    moved = onto_zero_line(location, phi[enriching.vertices], enriching.corners, divided)
    inside = location.owned & divided[location.cells]
    at = phi[enriching.vertices][location.cells]
    assert np.abs(np.einsum("gi,gi->g", moved.barycentric, at)[inside]).max(initial=0.0) < 1e-15
    assert moved.barycentric.sum(axis=1) == pytest.approx(location.barycentric.sum(axis=1))
    np.testing.assert_array_equal(moved.barycentric[~inside], location.barycentric[~inside])
    x, to = (
        np.einsum("gi,gid->gd", each.barycentric, enriching.corners[location.cells])[inside]
        for each in (location, moved)
    )
    edges = np.diff(enriching.corners[location.cells][inside], axis=1)
    slope = np.linalg.solve(edges, np.diff(at[inside], axis=1)[..., None])[..., 0]
    step = to - x
    assert np.abs(step[:, 0] * slope[:, 1] - step[:, 1] * slope[:, 0]).max(initial=0.0) < 1e-14
    assert np.linalg.norm(step, axis=1).max(initial=0.0) < 0.01
