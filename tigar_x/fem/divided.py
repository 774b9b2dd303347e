"""Equations of cells that something divides, and the fields that they have, see :mod:`tigar_x.fem.doubled`."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy.sparse as sp
import ufl
from dolfinx import fem

from tigar_x import compat
from tigar_x.compat import FloatArray, IntArray


class Doubled:
    """The equations of divided cells, and what their fields are made of.

    Args:
        residual: residual of divided cells, R(z; test).
        joined: functions (x, e, z), the unknown and z first, then others of which z is made likewise, such as old
            states; x and e have m components and z has 2 m in a Lagrange space of one order.
        jumps: component of x that jumps by the same one of e.

    Attributes:
        residual: as given.
        joined: as given.
        jumps: as given.
        cells: mask of the divided cells, ghosts as well, shape (cells,).
        second: mask of the unknowns among the second blocks, shape (nodes, m).
        side: -1 or 1 for every node, shape (nodes,).
        marker: function that is one in divided cells and zero elsewhere.
    """

    def __init__(
        self, residual: ufl.Form, joined: Sequence[tuple[fem.Function, fem.Function, fem.Function]], jumps: int
    ) -> None:
        self.residual, self.joined, self.jumps = residual, tuple(joined), jumps
        V, W = joined[0][0].function_space, joined[0][2].function_space
        self._m = V.dofmap.index_map_bs
        self.marker = fem.Function(compat.lagrange_space(V.mesh, 0), name="divided")
        self._cell_nodes, of_z = compat.cell_dofs(V), compat.cell_dofs(W)
        nodes = len(joined[0][0].x.array) // self._m
        self.node_of_z = np.empty(nodes, dtype=np.int64)
        self.node_of_z[self._cell_nodes] = of_z
        self.divide(np.zeros(len(of_z), dtype=bool), np.zeros((nodes, self._m), dtype=bool), np.ones(nodes))

    def divide(self, cells: Any, second: Any, side: FloatArray) -> None:
        """Say what is divided now; arguments as the attributes."""
        self.cells, self.second, self.side = cells, second, side
        self.marker.x.array[compat.cell_dofs(self.marker.function_space)[:, 0]] = cells
        self._near = np.unique(self._cell_nodes[cells])
        self.join()

    def join(self, *, last: bool = False) -> None:
        """Make the fields of divided cells, where e vanishes that is no unknown.

        Args:
            last: whether the unknown alone has changed.
        """
        m, p, at = self._m, self.jumps, self._near
        for x, e, z in self.joined[: 1 if last else None]:
            first, second = x.x.array.reshape(-1, m)[at], e.x.array.reshape(-1, m)[at] * self.second[at]
            both, to = z.x.array.reshape(-1, 2 * m), self.node_of_z[at]
            both[to, :m], both[to, m:] = first, second
            both[to, p] -= 0.5 * self.side[at] * second[:, p]


def pairs(cells: IntArray, nodes: int) -> sp.csr_matrix:
    """Ones where two nodes are those of one cell, a node and itself as well, shape (nodes, nodes)."""
    starts = np.arange(0, cells.size + 1, cells.shape[1])
    ones = sp.csr_matrix((np.ones(cells.size, dtype=np.int32), cells.ravel(), starts), shape=(len(cells), nodes))
    pattern = (ones.T @ ones).tocsr()
    pattern.sort_indices()
    pattern.data[:] = 1
    return pattern
