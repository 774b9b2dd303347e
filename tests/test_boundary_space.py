"""The boundary of a mesh in space, gathered over the ranks, and what is attached to it."""

import numpy as np
import pytest
from mpi4py import MPI
from dolfinx import mesh

from coudalfish.surface.boundary import Attaching, boundary
from coudalfish.surface.sheets import Sheets
from tigar_x import compat
from tigar_x.geometry import shapes
from tigar_x.splines.spline import ExtractedSpline

COMM = MPI.COMM_WORLD
pytestmark = pytest.mark.mpi


def test_the_boundary_is_whole_on_every_rank_and_its_normals_point_outwards():
    n = 4
    domain = mesh.create_unit_cube(COMM, n, n, n)
    x = domain.geometry.x
    x[:, 2] += 2.0 * (x[:, 0] - 0.5) ** 2 + 0.3 * x[:, 1]  # no longer convex
    walls = boundary(domain)
    assert len(walls.net.cells) == 6 * 2 * n**2
    assert len(walls.x) == (n + 1) ** 3 - (n - 1) ** 3
    assert not walls.net.ends.any()
    corners = compat.cell_vertices(domain)[: compat.owned_cells(domain)]
    volume = COMM.allreduce(float(np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1])).sum()) / 6.0)
    triangles = walls.triangles
    enclosed = np.einsum("ti,ti->", triangles.x.mean(axis=1), triangles.area_vectors) / 6.0
    assert enclosed == pytest.approx(volume, rel=1e-13)


def plate(low, high):
    """At half height between two places along the first axis, from one wall to the other along the second one."""
    patch = shapes.parallelogram((low, 0, 0.45), (high - low, 0, 0), (0, 1, 0), elements=(4, 4), degrees=(2, 2))
    return Sheets.of(ExtractedSpline(patch, MPI.COMM_SELF, quadrature_degree=4))


@pytest.mark.parametrize(
    ("low", "high", "free"),
    [(0.0, 1.0, ()), (0.3, 1.0, (0.3,)), (0.3, 0.7, (0.3, 0.7)), (-0.4, 0.6, (0.6,)), (0.01, 0.6, (0.6,))],
)
def test_a_surface_is_attached_where_it_ends_on_walls_or_beyond_them(low, high, free):
    sheets = plate(low, high)
    net = Attaching(mesh.create_unit_cube(COMM, 5, 5, 5), sheets, 0.02)(sheets.X)
    along = sheets.X[:, 0]
    triangle, corner, *_ = net.at_free
    assert len(triangle) == sum(np.isclose(along, end).sum() - 1 for end in free)
    for k, opposite in zip(triangle, corner, strict=True):
        ends = np.delete(net.triangles[k], opposite)
        assert min(abs(along[ends] - end).max() for end in free) < 1e-12


def test_edges_come_to_walls_and_leave_them_and_a_net_is_kept_while_they_do_not():
    sheets = plate(0.3, 1.0)
    attaching, moved = (
        Attaching(mesh.create_unit_cube(COMM, 5, 5, 5), sheets, 0.02),
        sheets.X + np.array([0.0, 0.0, 0.01]),
    )
    at_rest = attaching(sheets.X)
    assert attaching(moved) is at_rest

    def free(by):
        net = attaching(sheets.X + np.array([by, 0.0, 0.0]))
        return sorted({float(end) for end in sheets.X[net.edge_places[net.free]].mean(axis=1)[:, 0].round(9)})

    assert free(0.0) == [0.3]
    assert free(-0.1) == [0.3, 1.0]
    assert free(-0.31) == [1.0]
    np.testing.assert_array_equal(attaching(sheets.X).attached, at_rest.attached)
