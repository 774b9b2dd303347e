"""Immersed points: location, ownership and the trace matrix B."""

import numpy as np
import pytest
from mpi4py import MPI
from dolfinx import fem, mesh

from coudalfish.surface.trace import PointLocator, trace_matrix
from tigar_x import compat

COMM = MPI.COMM_WORLD


def make_mesh(dim, n=4):
    if dim == 2:
        return mesh.create_unit_square(COMM, n, n)
    return mesh.create_unit_cube(COMM, n, n, n)


def evaluate(space, function, x):
    """Values of a scalar function at points by B, summed over the ranks, and how many ranks own each point."""
    location = PointLocator(space.mesh).locate(x)
    trace = trace_matrix(space, location)
    values = COMM.allreduce(trace.B @ function.x.array[trace.nodes], op=MPI.SUM)
    owners = COMM.allreduce(location.owned.astype(int), op=MPI.SUM)
    return values, owners, location.active


@pytest.mark.mpi
@pytest.mark.parametrize(("dim", "degree"), [(2, 1), (2, 2), (3, 1), (3, 2)])
def test_B_reproduces_polynomials(dim, degree):
    domain = make_mesh(dim)
    space = compat.lagrange_space(domain, degree)
    f = fem.Function(space)

    def polynomial(x):
        s = 1.0 + 2.0 * x[0] - 3.0 * x[1] + (0.5 * x[2] if dim == 3 else 0.0)
        return s if degree == 1 else s + x[0] * x[1] - x[1] ** 2

    f.interpolate(polynomial)
    f.x.scatter_forward()
    x = np.random.default_rng(1).uniform(0.0, 1.0, (60, dim))
    values, owners, active = evaluate(space, f, x)
    assert active.all()
    assert (owners == 1).all()
    np.testing.assert_allclose(values, polynomial(x.T), atol=1e-12)


@pytest.mark.mpi
@pytest.mark.parametrize("dim", [2, 3])
def test_points_on_vertices_edges_and_partition_boundaries_count_once(dim):
    domain = make_mesh(dim)
    grid = np.linspace(0.0, 1.0, 9)
    x = np.stack(np.meshgrid(*[grid] * dim), axis=-1).reshape(-1, dim)
    space = compat.lagrange_space(domain, 1)
    one = fem.Function(space)
    one.x.array[:] = 1.0
    values, owners, active = evaluate(space, one, x)
    assert active.all()
    assert (owners == 1).all()
    np.testing.assert_allclose(values, 1.0, atol=1e-13)


@pytest.mark.mpi
def test_points_outside_by_rounding_are_inside():
    domain = make_mesh(2)
    x = np.array([[-1e-12, 0.4], [0.6, 1.0 + 1e-12], [-1e-8, 0.4]])
    np.testing.assert_array_equal(PointLocator(domain).locate(x).active, [True, True, False])


@pytest.mark.mpi
def test_outside_points_are_inactive_and_have_empty_rows():
    domain = make_mesh(2)
    x = np.array([[0.5, 0.5], [1.2, 0.5], [-1e-3, 0.2], [0.3, 7.0], [1.0, 1.0]])
    location = PointLocator(domain).locate(x)
    np.testing.assert_array_equal(location.active, [True, False, False, False, True])
    trace = trace_matrix(compat.lagrange_space(domain, 1), location)
    counts = COMM.allreduce(np.diff(trace.B.indptr), op=MPI.SUM)
    np.testing.assert_array_equal(counts, [3, 0, 0, 0, 3])


@pytest.mark.mpi
def test_moving_points_are_followed():
    """The second call starts from the cells of the first and finds what a fresh search finds."""
    domain = make_mesh(2, 8)
    rng = np.random.default_rng(2)
    x = rng.uniform(0.2, 0.8, (40, 2))
    locator = PointLocator(domain)
    for shift in (0.0, 1e-3, 0.15, 0.5, -0.4):
        moved = x + shift
        location, fresh = locator.locate(moved), PointLocator(domain).locate(moved)
        np.testing.assert_array_equal(location.active, fresh.active)
        np.testing.assert_array_equal(location.owned, fresh.owned)
        mine = location.owned
        found = np.einsum("qv,qvi->qi", location.barycentric[mine], compat.cell_vertices(domain)[location.cells[mine]])
        np.testing.assert_allclose(found, moved[mine], atol=1e-12)


@pytest.mark.mpi
@pytest.mark.parametrize("dim", [2, 3])
def test_vertex_functions(dim):
    """The same on every rank, whatever the partition: they are the linear functions of the mesh."""
    domain = make_mesh(dim)
    x = np.random.default_rng(4).uniform(0.0, 1.0, (30, dim))
    x = np.concatenate([x, np.full((1, dim), 0.25), np.full((1, dim), 1.3)])
    locator = PointLocator(domain)
    N = locator.vertex_functions(locator.locate(x))
    assert N.min() > -1e-9
    np.testing.assert_allclose(N.sum(axis=1).ravel(), [[1.0] * 31 + [0.0]], atol=1e-12)
    assert (N[30] > 0.5).nnz == 1  # a point in a vertex
    same = COMM.allgather(N.toarray())
    np.testing.assert_allclose(same[0], same[-1], atol=1e-15)
    # points that share all of their vertices lie in one cell
    cells = locator.locate(x).cells
    mine = np.flatnonzero(cells[:30] >= 0)
    shared = ((abs(N) > 1e-9).astype(float) @ (abs(N) > 1e-9).astype(float).T).toarray()
    together = cells[mine][:, None] == cells[mine][None, :]
    np.testing.assert_array_equal(shared[np.ix_(mine, mine)] == dim + 1, together)


def test_changed_number_of_points_is_no_error():
    locator = PointLocator(make_mesh(2))
    assert locator.locate(np.full((3, 2), 0.5)).active.all()
    assert locator.locate(np.full((5, 2), 0.4)).active.all()


def test_bad_meshes_are_refused():
    quads = mesh.create_unit_square(COMM, 2, 2, mesh.CellType.quadrilateral)
    with pytest.raises(ValueError, match=r"quadrilateral.*'triangle' or 'tetrahedron'"):
        PointLocator(quads)
    flat = compat.create_mesh(MPI.COMM_SELF, "triangle", [[0, 1, 2], [1, 2, 3]], [[0, 0], [1, 0], [0, 1], [0.5, 0.5]])
    with pytest.raises(ValueError, match="zero size near"):
        PointLocator(flat)
