"""Surfaces that meet the fluid on polygons: averages, areas, action and reaction, the same on all ranks."""

import numpy as np
import pytest
import scipy.sparse as sp
from mpi4py import MPI
from dolfinx import fem, mesh
from test_enriched_space import ball, plate
from test_nearest_surfaces import surfaces

from coudalfish.surface.enriched import Enriching
from coudalfish.surface.on_polygons import OnPolygons
from tigar_x import compat

COMM = MPI.COMM_WORLD


def met(surface, n=5, comm=COMM, stretch=1.0):
    """A surface whose areas at rest are its present ones over a stretch."""
    space = compat.lagrange_space(mesh.create_unit_cube(comm, n, n, n), 1)
    e = Enriching(space, kinked=False)
    found = e(surface)
    points = found.zero.only(found.zero.cut.cells[found.zero.rows] < e.owned).quadrature()
    hats, areas = points.on(surface, np.full(len(surface.net.triangles), stretch), 0.5)
    whole = surface.net.functions.T @ np.bincount(
        surface.net.triangles.ravel(), np.repeat(surface.triangles.areas / 3.0, 3), surface.net.functions.shape[0]
    )
    return space, points, OnPolygons.of(points, hats, areas, e.vertices, whole / stretch, None, comm)


def total(comm, values):
    result = np.array(values, dtype=float)
    comm.Allreduce(MPI.IN_PLACE, result, op=MPI.SUM)
    return result


@pytest.mark.mpi
def test_linear_velocities_are_averaged_over_hat_functions():
    """Of a plane surface, whose polygons lie in it."""
    surface = surfaces(plate(0.433))
    space, _, meeting = met(surface, stretch=1.5)
    f = fem.Function(space)
    f.interpolate(lambda x: 1.0 + 2.0 * x[0] - x[1] + 5.0 * x[2])
    found = total(COMM, meeting.trace.B @ f.x.array[meeting.seen])
    x = surface.x
    inside = ((x[:, :2] > 0.3) & (x[:, :2] < 0.7)).all(axis=1)
    assert inside.any()
    expected = 1.0 + 2.0 * x[:, 0] - x[:, 1] + 5.0 * 0.433
    np.testing.assert_allclose(found[inside], expected[inside], rtol=5e-3)
    np.testing.assert_allclose(meeting.W.sum(), 1.0 / 1.5, rtol=1e-12)
    np.testing.assert_array_equal(meeting.active, meeting.W > 0.0)
    assert not meeting.active.all()  # it goes on beyond the box


@pytest.mark.mpi
@pytest.mark.parametrize("surface", [ball(), surfaces(plate(0.433, low=0.31))], ids=["ball", "plate"])
def test_action_equals_reaction(surface):
    """Forces at points as well as along the normals of polygons: their sum, and where it acts, on either side."""
    _, points, meeting = met(surface)
    n = len(surface.x)
    forces = np.random.default_rng(3).standard_normal(n) * meeting.W
    at_nodes = total(COMM, (meeting.trace.transposed @ forces).sum())
    np.testing.assert_allclose(at_nodes, forces.sum(), atol=1e-13)
    net, faces = surface.net, np.repeat(surface.triangles.normals[:, None], 3, axis=1)
    normals = net.sums(faces, net.corners)[net.place]
    forces = meeting.normal_forces(sp.identity(n, format="csr"), normals)
    lam = np.random.default_rng(4).standard_normal(n)
    on_surface = (forces.at_points @ lam).reshape(-1, 3)
    on_fluid = meeting.trace.transposed @ on_surface + (forces.beside @ lam).reshape(-1, 3)
    np.testing.assert_allclose(total(COMM, on_fluid.sum(axis=0)), on_surface.sum(axis=0), atol=1e-13)
    along = (
        np.einsum("gi,gi->g", points.normals, meeting.hats @ normals) > 0.0
    )  # whatever the signs of the polygons are
    expected = total(COMM, (points.normals * np.where(along, points.areas, -points.areas)[:, None]).sum(axis=0))
    np.testing.assert_allclose((forces.at_points @ np.ones(n)).reshape(-1, 3).sum(axis=0), expected, atol=1e-13)


@pytest.mark.mpi
def test_all_partitions_see_the_same():
    surface, found = ball(), []
    for comm in (COMM, MPI.COMM_SELF):
        space, _, meeting = met(surface, comm=comm)
        f = fem.Function(space)
        f.interpolate(lambda x: np.sin(3.0 * x[0]) + x[1] * x[2])
        found.append((meeting.W, total(comm, meeting.trace.B @ f.x.array[meeting.seen])))
    for one, other in zip(*found, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-13)
