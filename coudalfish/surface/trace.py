"""From immersed points to one sparse matrix per step: location in the fluid mesh and evaluation of its velocity basis.

Every point is owned by exactly one rank: among the ranks that find it in one of their own cells, the lowest.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse as sp
from mpi4py import MPI
from dolfinx import fem, mesh

from tigar_x import checks, compat
from tigar_x.compat import FloatArray, IntArray
from tigar_x.fem.linear import SolveError

INSIDE = 1e-10
"""A point is in a cell when no barycentric coordinate is below minus this."""
FLAT = 1e-14
"""A cell has no size when its volume is below this times that of a cube over its largest edge, or that at rest."""


@dataclass(frozen=True, eq=False)
class Location:
    """Where points lie.

    Attributes:
        cells: local cell of every point that this rank owns, -1 elsewhere, shape (points,).
        barycentric: barycentric coordinates there, zero elsewhere, shape (points, d + 1).
        active: whether a point lies in the mesh at all, the same on every rank, shape (points,).
    """

    cells: IntArray
    barycentric: FloatArray
    active: Any

    def __post_init__(self) -> None:
        checks.freeze(self)

    @property
    def owned(self) -> Any:
        """Mask of the points that this rank owns."""
        return self.cells >= 0


def _edges(x: FloatArray) -> FloatArray:
    """Edges of simplices from their first vertices, as columns, shape (cells, d, d)."""
    return np.swapaxes(x[:, 1:] - x[:, :1], 1, 2)


class PointLocator:
    """Finds the cells of moving points in a mesh of affine simplices.

    The cells of the previous call are tried first; only points that left theirs go through the bounding box tree.

    Args:
        domain: fluid mesh of triangles or tetrahedra.

    Attributes:
        cells: this rank's cells of the points of the last call, -1 for others, which the next one tries first: on the
            boundary between two cells they decide. None: there was no call, or it is to be forgotten.

    Raises:
        ValueError: another cell type, no cell, or a cell of zero size.
    """

    def __init__(self, domain: mesh.Mesh) -> None:
        cell = compat.cell_name(domain)
        if cell not in ("triangle", "tetrahedron"):
            raise ValueError(f"mesh has cells of type {cell}: immersed points need 'triangle' or 'tetrahedron'")
        if domain.topology.index_map(domain.topology.dim).size_global == 0:
            raise ValueError("mesh has no cell: at least one is required")
        self._mesh = domain  # its communicator lives as long as it does
        self._comm = domain.comm
        self._displaced: FloatArray | None = None
        self._tree: Any = None
        self.cells: IntArray | None = None
        x = self._rest = self._at_rest()
        edges = _edges(x)
        cubes = np.abs(edges).max(axis=(1, 2), initial=0.0) ** domain.geometry.dim
        place = self._first(~(np.abs(np.linalg.det(edges)) > FLAT * cubes), x)
        if place:
            raise ValueError(f"mesh has a cell of zero size near {place}: cells of positive size are required")
        self._origins, self._inverses = x[:, 0], np.linalg.inv(edges)

    def _at_rest(self) -> FloatArray:
        return compat.cell_vertices(self._mesh)[: compat.owned_cells(self._mesh)]

    def _first(self, bad: Any, x: FloatArray) -> str:
        """The middle of the first bad cell in words; empty when there is none on any rank (collective)."""
        if not self._comm.allreduce(int(bad.sum()), op=MPI.SUM):
            return ""
        return str(x[np.argmax(bad)].mean(axis=0)) if bad.any() else "another rank"

    def displace(self, u: FloatArray) -> None:
        """Move the cells, so that points are then located among the displaced ones (collective).

        Args:
            u: displacement of the vertices of the cells that this rank owns from where the mesh has them, shape
                (cells, vertices, d); unit: length.

        Raises:
            SolveError: a displaced cell is flat or inside out.
        """
        rest = self._at_rest()
        x = rest + u
        edges = _edges(x)
        place = self._first(~(np.linalg.det(edges) / np.linalg.det(_edges(rest)) > FLAT), x)
        if place:
            raise SolveError(f"a cell of the moving mesh is flat or inside out where points are located, near {place}")
        self._origins, self._inverses = x[:, 0], np.linalg.inv(edges)
        self._displaced, self._tree = x, None

    def barycentric(self, cells: IntArray, x: FloatArray) -> FloatArray:
        """Barycentric coordinates of points in cells, of any sign.

        Args:
            cells: cells that this rank owns, shape (points,).
            x: positions, shape (points, d); unit: length.

        Returns:
            Shape (points, d + 1).
        """
        result = np.empty((len(cells), x.shape[1] + 1))
        np.einsum("nij,nj->ni", self._inverses[cells], x - self._origins[cells], out=result[:, 1:])
        np.subtract(1.0, result[:, 1:].sum(axis=1), out=result[:, 0])
        return result

    @property
    def corners(self) -> FloatArray:
        """Vertices of the cells that this rank owns where they are, the same object until they move."""
        return self._rest if self._displaced is None else self._displaced

    def _make_tree(self) -> Any:
        size = np.abs(self.corners).max()
        return compat.bounding_box_tree(self._mesh, INSIDE * max(float(size), 1e-300), self._displaced)

    def search(self, x: FloatArray) -> IntArray:
        """Cells of this rank that contain points, -1 where there is none; ties go to the cell that holds it deepest.

        Args:
            x: positions, which may differ from rank to rank, shape (points, d); unit: length.
        """
        found = np.full(len(x), -1, dtype=np.int32)
        if not (len(self._origins) and len(x)):
            return found
        if self._tree is None:
            self._tree = self._make_tree()
        padded = np.zeros((len(x), 3))
        padded[:, : x.shape[1]] = x
        cells, offsets = compat.candidate_cells(self._tree, padded)
        point = np.repeat(np.arange(len(x)), np.diff(offsets))
        depth = self.barycentric(cells, x[point]).min(axis=1, initial=np.inf)
        inside = depth >= -INSIDE
        point, cells, depth = point[inside], cells[inside], depth[inside]
        order = np.lexsort((cells, -depth, point))
        first = np.unique(point[order], return_index=True)[1]
        found[point[order][first]] = cells[order][first]
        return found

    def _claim(self, cells: IntArray) -> tuple[IntArray, Any]:
        """Leave every point to the lowest rank that found it."""
        rank = np.where(cells >= 0, self._comm.rank, self._comm.size).astype(np.int32)
        owner = np.empty_like(rank)
        self._comm.Allreduce(rank, owner, op=MPI.MIN)
        return np.where(owner == self._comm.rank, cells, -1).astype(np.int32), owner < self._comm.size

    def locate(self, x: FloatArray) -> Location:
        """Locate points (collective).

        Args:
            x: the same positions on every rank, shape (points, d); unit: length.

        Returns:
            The location.
        """
        cells = np.full(len(x), -1, dtype=np.int32)
        if self.cells is not None and len(self.cells) == len(x):
            known = np.flatnonzero(self.cells >= 0)
            inside = self.barycentric(self.cells[known], x[known]).min(axis=1, initial=np.inf) >= -INSIDE
            cells[known[inside]] = self.cells[known[inside]]
        cells, active = self._claim(cells)
        missing = np.flatnonzero(~active)
        if len(missing):
            cells[missing], active[missing] = self._claim(self.search(x[missing]))
        self.cells = cells
        barycentric = np.zeros((len(x), x.shape[1] + 1))
        mine = np.flatnonzero(cells >= 0)
        barycentric[mine] = self.barycentric(cells[mine], x[mine])
        return Location(cells, barycentric, active)

    @cached_property
    def _numbers(self) -> Any:
        """Names of the mesh's vertices that all ranks share."""
        return compat.input_numbers(self._mesh)[1]

    def vertex_functions(self, location: Location) -> sp.csr_matrix:
        """Linear functions of the mesh's vertices at points, the same on every rank (collective).

        Args:
            location: from :meth:`locate`.

        Returns:
            Values, zero at points outside the mesh and summing to one at others, one column for every vertex of a cell
            in which a point lies, shape (points, columns).
        """
        mine = np.flatnonzero(location.owned)
        vertices = np.full(location.barycentric.shape, -1, dtype=np.int64)
        vertices[mine] = self._numbers[compat.cell_nodes(self._mesh)[location.cells[mine]]]
        values = location.barycentric
        if self._comm.size > 1:
            found, total = np.empty_like(vertices), np.empty_like(values)
            self._comm.Allreduce(vertices, found, op=MPI.MAX)
            self._comm.Allreduce(values, total, op=MPI.SUM)
            vertices, values = found, total
        there = np.zeros(int(vertices.max(initial=-1)) + 2, dtype=bool)  # -1: outside the mesh
        there[vertices + 1] = True
        columns, starts = (np.cumsum(there) - 1)[vertices + 1], np.arange(0, values.size + 1, values.shape[1])
        shape = len(values), int(np.count_nonzero(there))
        return sp.csr_matrix((values.flatten(), columns.ravel(), starts), shape=shape)


@dataclass(frozen=True, eq=False)
class TraceMatrix:
    """Evaluation of nodal velocities at points, ``u_q = B u[nodes]``, this rank's share.

    Only nodes of cut cells take part, so that the cost follows the number of points and not that of fluid nodes.

    Attributes:
        B: basis values, one row per point, empty where this rank does not own the point, shape (points, len(nodes)).
        nodes: local nodes of the velocity space that the columns stand for, sorted.
    """

    B: sp.csr_matrix
    nodes: IntArray

    def __post_init__(self) -> None:
        checks.freeze(self)

    @cached_property
    def transposed(self) -> sp.csr_matrix:
        """``B^T``, made once."""
        return self.B.T.tocsr()

    @property
    def seen(self) -> Any:
        """Mask of the points that this rank sees, shape (points,)."""
        return np.diff(self.B.indptr) > 0

    def seen_by(self, comm: MPI.Comm) -> IntArray:
        """Number of the ranks that see each point (collective), shape (points,)."""
        count = self.seen.astype(np.int32)
        comm.Allreduce(MPI.IN_PLACE, count, op=MPI.SUM)
        return count


def trace_matrix(space: fem.FunctionSpace, location: Location) -> TraceMatrix:
    """Trace matrix of a velocity space at located points.

    Args:
        space: scalar Lagrange space of one velocity component.
        location: from :meth:`PointLocator.locate`.

    Returns:
        The matrix.
    """
    mine = np.flatnonzero(location.owned)
    values = compat.tabulate(space, location.barycentric[mine, 1:])
    counts = np.zeros(len(location.cells) + 1, dtype=np.int32)
    counts[mine + 1] = values.shape[1]
    nodes, columns = np.unique(compat.cell_dofs(space)[location.cells[mine]], return_inverse=True)
    shape = (len(location.cells), len(nodes))
    B = sp.csr_matrix((values.ravel(), columns.ravel().astype(np.int32), np.cumsum(counts)), shape=shape)
    return TraceMatrix(B, nodes)
