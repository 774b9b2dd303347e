"""Pockets: pieces of fluid that a surface in space cuts off at a wall, closed and smaller than a cell.

All nodes of a pocket are on the wall, and no edge of a cell leads from them to a node of their side inside the fluid.
The pressure in it would be that of these nodes alone, and keep what is in it to rounding, whatever the few functions of
a multiplier let pass. So it is counted to the other side. A film behind a leaflet that lies at a wall has no nodes
inside the fluid either, but it is longer than a pocket, or holds more.
"""

from collections.abc import Callable
from itertools import combinations

import numpy as np
import scipy.sparse as sp
from dolfinx import fem
from scipy.sparse.csgraph import connected_components

from coudalfish.surface.cut_cells import CutCells
from coudalfish.surface.facets import walls_of
from tigar_x import compat
from tigar_x.compat import FloatArray, IntArray

LONGEST = 2.0
"""Diagonal of the box around the nodes of a pocket, in sizes of the largest cell around them, at most."""
LARGEST = 1.0
"""Volume of a pocket of several nodes, in those of the largest cell in which it is, at most."""
STRAIGHT = 0.9
"""Length of the mean of unit normals of a node's facets from which on they belong to one plane or smooth surface."""
_EDGES = np.array(list(combinations(range(4), 2)))


class Pockets:
    """Finds them in a mesh of tetrahedra, see :class:`coudalfish.surface.enriched.Enriching` (collective).

    Args:
        space: scalar linear space of the mesh.
        sizes: of the largest cells of the nodes, shape (nodes,); unit: length.
        total: sums at all nodes, over the ranks, of values at some nodes of parts of cells, shape (parts, k) both.
    """

    def __init__(
        self, space: fem.FunctionSpace, sizes: FloatArray, total: Callable[[IntArray, FloatArray], FloatArray]
    ) -> None:
        domain = space.mesh
        self._comm, self._sizes, self._total = domain.comm, sizes, total
        self._x, own = space.tabulate_dof_coordinates()[:, :3], space.dofmap.index_map
        self._owned = own.size_local
        self._number = np.asarray(own.local_to_global(np.arange(len(self._x), dtype=np.int32)), dtype=np.int64)
        vertices = compat.cell_dofs(space)[: compat.owned_cells(domain)]
        self._on_wall = self._walls(vertices, walls_of(domain)[: len(vertices)])
        self._vertices = vertices[self._on_wall[vertices].any(axis=1)]
        arms = self._x[self._vertices[:, 1:]] - self._x[self._vertices[:, :1]]
        self._volumes = np.abs(np.linalg.det(arms)) / 6.0

    def _walls(self, vertices: IntArray, sides: IntArray) -> np.ndarray:
        """Mask of the nodes on walls (collective).

        Of a mesh one layer thick all nodes are on its boundary. Those of whose cells all nodes are, are on a wall where
        the boundary has an edge alone.
        """
        cell, side = np.nonzero(sides[:, None] >> np.arange(4) & 1)
        facets = np.take_along_axis(vertices[cell], np.array([np.delete(np.arange(4), k) for k in range(4)])[side], 1)
        a, b, c = np.moveaxis(self._x[facets], 1, 0)
        normal = np.cross(b - a, c - a)
        normal /= np.linalg.norm(normal, axis=1)[:, None]
        outwards = np.where(np.einsum("fi,fi->f", normal, self._x[vertices[cell, side]] - a) > 0.0, -1.0, 1.0)
        number = self._total(facets, np.ones((len(facets), 1)))
        sums = np.stack([self._total(facets, (outwards * n)[:, None]) for n in normal.T], axis=1)
        on_boundary = number > 0.0
        thin = self._total(vertices, np.where(on_boundary[vertices].all(axis=1), 0.0, 1.0)[:, None]) == 0.0
        return on_boundary & (~thin | (np.linalg.norm(sums, axis=1) < STRAIGHT * number))

    def joined(self, phi: FloatArray, off: float) -> FloatArray:
        """Values by which pockets belong to the other side (collective).

        Args:
            phi: signed distance at the nodes, not a number where it is not known, shape (nodes,); unit: length.
            off: distance from the surface, on the other side, that their nodes get; 0 counts as positive.
        """
        nodes = self._vertices
        negative, known = phi[nodes] < 0.0, np.isfinite(phi[nodes]).all(axis=1)[:, None]
        inside = ~self._on_wall[nodes]
        reached = ((inside & side).any(axis=1)[:, None] for side in (negative, ~negative))  # by a node in the fluid
        open_ = ~known | np.where(negative, *reached)
        closed = self._on_wall & np.isfinite(phi) & (self._total(nodes, np.where(open_, 1.0, 0.0)) == 0.0)
        if self._comm.allreduce(int(np.count_nonzero(closed[: self._owned]))):
            closed &= np.isin(self._number, self._pockets(phi, closed))
            phi = np.where(closed, np.where(phi < 0.0, 0.0, -off), phi)
        return phi

    def _pockets(self, phi: FloatArray, closed: np.ndarray) -> IntArray:
        """Numbers of the nodes of pockets, of all ranks, among nodes without one of their side inside the fluid."""
        own = np.flatnonzero(closed[: self._owned])
        parts = (self._number[own], self._x[own], self._sizes[own]), self._links(phi, closed), self._pieces(phi, closed)
        found = ([np.concatenate(each) for each in zip(*part, strict=True)] for part in self._of_all_ranks(parts))
        (number, x, size), (one, other), (node, volume, whole) = found
        order = np.argsort(number)
        number, x, size = number[order], x[order], size[order]
        outside = len(number)
        i, j, k = (np.where(n < 0, outside, np.searchsorted(number, n)) for n in (one, other, node))
        graph = sp.csr_matrix((np.ones(len(i)), (i, j)), shape=(outside + 1, outside + 1))
        count, label = connected_components(graph, directed=False)
        low, high, largest = np.full((count, 3), np.inf), np.full((count, 3), -np.inf), np.zeros((2, count))
        mine = label[:outside]
        np.minimum.at(low, mine, x)
        np.maximum.at(high, mine, x)
        np.maximum.at(largest[0], mine, size)
        np.maximum.at(largest[1], label[k], whole)
        volumes = np.bincount(label[k], volume, count)
        is_small = np.linalg.norm(high - low, axis=1) <= LONGEST * largest[0]
        is_small &= (volumes <= LARGEST * largest[1]) | (np.bincount(mine, minlength=count) == 1)
        is_small[label[outside]] = False
        return np.asarray(number[is_small[mine]])

    def _of_all_ranks(self, parts: tuple) -> list:
        """Arrays of every rank by what they are (collective)."""
        return list(zip(*self._comm.allgather(parts), strict=True))

    def _links(self, phi: FloatArray, closed: np.ndarray) -> tuple[IntArray, IntArray]:
        """Pairs of nodes of one side that an edge joins, -1 for nodes that are not closed in, as at least one is."""
        ends = self._vertices[closed[self._vertices].any(axis=1)][:, _EDGES].reshape(-1, 2)
        ends = ends[((phi[ends[:, 0]] < 0.0) == (phi[ends[:, 1]] < 0.0)) & closed[ends].any(axis=1)]
        one, other = np.where(closed[ends], self._number[ends], -1).T
        return one, other

    def _pieces(self, phi: FloatArray, closed: np.ndarray) -> tuple[IntArray, FloatArray, FloatArray]:
        """Parts of cells on the sides of such nodes: one of these, the volume of the part and that of the cell."""
        cells = np.flatnonzero(closed[self._vertices].any(axis=1))
        nodes, whole = self._vertices[cells], self._volumes[cells]
        cut, share = CutCells.of(nodes, phi), np.where((phi[nodes] < 0.0).all(axis=1), 1.0, 0.0)
        share[cut.cells] = cut.negative_share
        pieces = []
        for part, side in ((share, phi[nodes] < 0.0), (1.0 - share, phi[nodes] >= 0.0)):
            there = closed[nodes] & side
            here = there.any(axis=1)
            first = nodes[here, there[here].argmax(axis=1)]
            pieces.append((self._number[first], (part * whole)[here], whole[here]))
        number, volume, of_cell = (np.concatenate(each) for each in zip(*pieces, strict=True))
        return number, volume, of_cell
