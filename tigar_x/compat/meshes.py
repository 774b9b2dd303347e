"""Meshes and geometry."""

from typing import Any

import numpy as np
import ufl
from mpi4py import MPI
from dolfinx import geometry, mesh
from numpy.typing import ArrayLike

from tigar_x.compat.release import VERSION, FloatArray, IntArray, table

if VERSION < (0, 9):

    def _coordinates(cell: str, dim: int) -> dict[str, Any]:
        # the variant that the form compiler would write into the element, and into every later cache key, on first use
        nodes = ufl.FiniteElement("Lagrange", cell, 1, variant="equispaced")
        return {"domain": ufl.Mesh(ufl.VectorElement(nodes, dim=dim))}

    _tree, _collisions = geometry.BoundingBoxTree, geometry.compute_collisions
else:
    import basix.ufl

    def _coordinates(cell: str, dim: int) -> dict[str, Any]:
        return {"e": ufl.Mesh(basix.ufl.element("Lagrange", cell, 1, shape=(dim,)))}

    _tree, _collisions = geometry.bb_tree, geometry.compute_collisions_points  # type: ignore[attr-defined]


def cell_name(domain: mesh.Mesh) -> str:
    """UFL name of the mesh's cells."""
    return domain.topology.cell_type.name


def create_mesh(comm: MPI.Comm, cell: str, cells: ArrayLike, x: ArrayLike) -> mesh.Mesh:
    """Mesh of affine or multilinear cells from arrays.

    Args:
        comm: communicator; rank 0 gives the whole mesh, the other ranks give empty arrays of the same width.
        cell: UFL name of the cell.
        cells: vertices of the cells, shape (cells, vertices per cell), in dolfinx's ordering.
        x: coordinates, shape (vertices, geometric dimension).

    Returns:
        The distributed mesh.
    """
    points = np.asarray(x, dtype=np.float64)
    coordinates = _coordinates(cell, points.shape[1])
    return mesh.create_mesh(comm, cells=np.asarray(cells, dtype=np.int64), x=points, **coordinates)


def cell_vertices(domain: mesh.Mesh) -> FloatArray:
    """Coordinates of the vertices of all local cells, shape (cells, vertices, geometric dimension)."""
    dofs = domain.geometry.dofmap if VERSION < (0, 11) else domain.geometry.dofmaps[0]
    return domain.geometry.x[table(dofs)][:, :, : domain.geometry.dim]


def owned_cells(domain: mesh.Mesh) -> int:
    """Number of cells that this rank owns; they come first in the local numbering."""
    return int(domain.topology.index_map(domain.topology.dim).size_local)


def bounding_box_tree(domain: mesh.Mesh, padding: float) -> Any:
    """Bounding box tree of the cells that this rank owns."""
    cells = np.arange(owned_cells(domain), dtype=np.int32)
    return _tree(domain, domain.topology.dim, entities=cells, padding=padding)


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
