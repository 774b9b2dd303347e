"""Meshes and geometry."""

from itertools import pairwise
from typing import Any

import numpy as np
import ufl
from mpi4py import MPI
from dolfinx import geometry, graph, la, mesh
from numpy.typing import ArrayLike, NDArray

from tigar_x.compat.release import VERSION, FloatArray, IntArray, as_table

if VERSION < (0, 9):

    def _coordinates(cell: str, dim: int) -> dict[str, Any]:
        # the variant that the form compiler would write into the element, and into every later cache key, on first use
        nodes = ufl.FiniteElement("Lagrange", cell, 1, variant="equispaced")
        return {"domain": ufl.Mesh(ufl.VectorElement(nodes, dim=dim))}

    def _partitioner(comm: MPI.Comm) -> dict[str, Any]:
        return {}

    _tree, _collisions = geometry.BoundingBoxTree, geometry.compute_collisions
else:
    import basix.ufl

    def _coordinates(cell: str, dim: int) -> dict[str, Any]:
        return {"e": ufl.Mesh(basix.ufl.element("Lagrange", cell, 1, shape=(dim,)))}

    def _partitioner(comm: MPI.Comm) -> dict[str, Any]:
        if comm.size == 1:
            return {}
        mode = (mesh.GhostMode.shared_facet,) if VERSION < (0, 11) else (mesh.GhostMode.shared_facet, 2)
        return {"partitioner": mesh.create_cell_partitioner(*mode)}

    _tree, _collisions = geometry.bb_tree, geometry.compute_collisions_points  # type: ignore[attr-defined]

_VERTICES = {
    "interval": (2, 1),
    "triangle": (3, 2),
    "quadrilateral": (4, 2),
    "tetrahedron": (4, 3),
    "hexahedron": (8, 4),
}
"""How many vertices a cell has, and each of its facets."""


def cell_name(domain: mesh.Mesh) -> str:
    """UFL name of the mesh's cells."""
    return domain.topology.cell_type.name


def is_simplex(domain: mesh.Mesh) -> bool:
    """Whether the mesh's cells are triangles or tetrahedra."""
    return cell_name(domain) in ("triangle", "tetrahedron")


def create_mesh(comm: MPI.Comm, cell: str, cells: ArrayLike, x: ArrayLike, owner: IntArray | None = None) -> mesh.Mesh:
    """Mesh of affine or multilinear cells from arrays; ranks know the cells across the facets of their own.

    Args:
        comm: communicator; rank 0 gives the whole mesh, the other ranks give empty arrays of the same width.
        cell: UFL name of the cell.
        cells: vertices of the cells, shape (cells, vertices per cell), in dolfinx's ordering.
        x: coordinates, shape (vertices, geometric dimension).
        owner: rank that gets each simplex, shape (cells,), empty on the other ranks; None: dolfinx's choice.

    Returns:
        The distributed mesh.
    """
    points, table = np.asarray(x, dtype=np.float64), np.asarray(cells, dtype=np.int64)
    how = _coordinates(cell, points.shape[1])
    if owner is None:
        how |= _partitioner(comm)
    else:
        given = _adjacency(*_ranks_of(table, owner))
        how["partitioner"] = lambda *_: given
    return mesh.create_mesh(comm, cells=table, x=points, **how)


def _adjacency(data: NDArray[np.int32], starts: NDArray[np.int32]) -> Any:
    """Lists, one after the other in an array, as dolfinx takes them."""
    made = (getattr(graph, "adjacencylist", None) or graph.create_adjacencylist)(data, starts)
    return getattr(made, "_cpp_object", made)


def _ranks_of(cells: Any, owner: IntArray) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Ranks of every simplex, its owner first, then those that own one across a facet, and where its list begins."""
    n, corners = cells.shape
    opposite = np.array([np.delete(np.arange(corners), k) for k in range(corners)])
    facets = np.sort(cells[:, opposite], axis=2).reshape(-1, corners - 1)
    order = np.lexsort(facets.T)
    same = (facets[order[1:]] == facets[order[:-1]]).all(axis=1)
    a, b = order[:-1][same] // corners, order[1:][same] // corners
    known = np.unique(np.stack([np.append(a, b), owner[np.append(b, a)]], axis=1), axis=0)
    known = known[known[:, 1] != owner[known[:, 0]]]
    every, rank = np.append(np.arange(n), known[:, 0]), np.append(owner, known[:, 1])
    starts = np.append(0, np.cumsum(np.bincount(every, minlength=n)))
    return rank[np.argsort(every, kind="stable")].astype(np.int32), starts.astype(np.int32)


def cell_vertices(domain: mesh.Mesh) -> FloatArray:
    """Coordinates of the vertices of all local cells, shape (cells, vertices, geometric dimension)."""
    return domain.geometry.x[cell_nodes(domain)][:, :, : domain.geometry.dim]


def cell_nodes(domain: mesh.Mesh) -> IntArray:
    """Nodes of the geometry of all local cells, its vertices first, shape (cells, nodes per cell)."""
    nodes = domain.geometry.dofmap if VERSION < (0, 11) else domain.geometry.dofmaps[0]
    empty = VERSION < (0, 9) and nodes.num_nodes == 0
    return np.zeros((0, _VERTICES[cell_name(domain)][0]), dtype=np.int32) if empty else as_table(nodes)


def facet_nodes(domain: mesh.Mesh) -> IntArray:
    """Nodes of the geometry at the vertices of all local facets, shape (facets, vertices per facet)."""
    dim, (in_cell, in_facet) = domain.topology.dim, _VERTICES[cell_name(domain)]
    cells = connectivity(domain, dim, 0).array.reshape(-1, in_cell)
    node = np.zeros(cells.max(initial=-1) + 1, dtype=np.int32)
    node[cells] = cell_nodes(domain)[:, :in_cell]
    return node[connectivity(domain, dim - 1, 0).array.reshape(-1, in_facet)]


def connectivity(domain: mesh.Mesh, dim: int, other: int) -> Any:
    """Adjacency list from the entities of one dimension to those of another; both are made when they are missing."""
    topology = domain.topology
    for d in (dim, other):
        topology.create_entities(d)
    topology.create_connectivity(dim, other)
    return topology.connectivity(dim, other)


def shortest_edges(domain: mesh.Mesh) -> FloatArray:
    """Shortest distance of two vertices of every local cell, ghosts as well, shape (cells,); unit: length."""
    x = cell_vertices(domain)
    distances = np.linalg.norm(x[:, :, None] - x[:, None], axis=-1)[:, *np.triu_indices(x.shape[1], 1)]
    return np.asarray(distances.min(axis=1, initial=np.inf))


def exterior_facets(domain: mesh.Mesh) -> IntArray:
    """Local facets on the boundary of the mesh, ghosts as well, sorted; the ranks ask each other which they are."""
    dim = domain.topology.dim - 1
    connectivity(domain, dim, dim + 1)
    marks: Any = la.vector(domain.topology.index_map(dim))
    marks.array[:] = 0.0
    marks.array[mesh.exterior_facet_indices(domain.topology)] = 1.0
    marks.scatter_forward()
    return np.flatnonzero(marks.array).astype(np.int32)


def input_numbers(domain: mesh.Mesh) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Numbers that the local cells and the local nodes of the geometry had in the arrays the mesh was made from."""
    cells, nodes = domain.topology.original_cell_index, domain.geometry.input_global_indices
    return np.asarray(cells, dtype=np.int64), np.asarray(nodes, dtype=np.int64)


def global_nodes(domain: mesh.Mesh) -> tuple[NDArray[np.int64], int]:
    """Global numbers of the local nodes of the geometry, and how many of them this rank owns; those come first."""
    map = domain.geometry.index_map()
    local = np.arange(map.size_local + map.num_ghosts, dtype=np.int32)
    return np.asarray(map.local_to_global(local), dtype=np.int64), int(map.size_local)


def owned_cells(domain: mesh.Mesh) -> int:
    """Number of cells that this rank owns; they come first in the local numbering."""
    return int(domain.topology.index_map(domain.topology.dim).size_local)


def bounding_box_tree(domain: mesh.Mesh, padding: float, vertices: FloatArray | None = None) -> Any:
    """Bounding box tree of the cells that this rank owns.

    Args:
        domain: mesh.
        padding: by which the boxes are larger than the cells; unit: length.
        vertices: where the vertices of affine cells lie instead of where the mesh has them, shape (owned cells,
            vertices, geometric dimension); None: the cells are where they are.

    Returns:
        The tree.
    """
    cells = np.arange(owned_cells(domain), dtype=np.int32)
    if vertices is None:
        return _tree(domain, domain.topology.dim, entities=cells, padding=padding)
    x = domain.geometry.x
    before = x.copy()
    x[cell_nodes(domain)[: len(cells)], : domain.geometry.dim] = vertices
    try:
        return _tree(domain, domain.topology.dim, entities=cells, padding=padding)
    finally:
        x[:] = before


def candidate_cells(tree: Any, points: FloatArray) -> tuple[IntArray, IntArray]:
    """Cells whose boxes contain points.

    Args:
        tree: from :func:`bounding_box_tree`.
        points: shape (n, 3).

    Returns:
        The cells, and offsets of shape (n + 1,) into them.
    """
    hits = _collisions(tree, points)
    return hits.array, hits.offsets


def cells_of_points(domain: mesh.Mesh, points: FloatArray) -> IntArray:
    """A cell of this rank that contains each point, -1 where there is none, shape (n,).

    Args:
        domain: mesh.
        points: shape (n, geometric dimension).
    """
    x = np.pad(points, ((0, 0), (0, 3 - points.shape[1])))
    near = _collisions(bounding_box_tree(domain, 1e-10), x)
    inside = geometry.compute_colliding_cells(domain, near, x)
    array, offsets = inside.array, inside.offsets
    return np.array([array[i] if i < j else -1 for i, j in pairwise(offsets)], dtype=np.int32)
