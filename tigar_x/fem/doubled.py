"""Systems of which some nodes have a second block of unknowns, where something divides the cells around them.

Cells that are divided have equations of their own, in fields ``z = (x_mean, e)`` with two blocks at every node. The
unknowns are x at all nodes and e at few. A node lies on one side, s_i = -1 or 1, and has the value that holds there: of
the component p that jumps by e_p the mean is ``x_p - s_i e_p/2``. Thus undivided cells need nothing of e, their code is
that of other systems, and the second blocks are rows at the end of the matrix.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import scipy.sparse as sp
import ufl
from mpi4py import MPI
from dolfinx import fem
from petsc4py import PETSc

from tigar_x import compat
from tigar_x.compat import FloatArray, IntArray
from tigar_x.fem import rounding
from tigar_x.fem.carried import Rows
from tigar_x.fem.carrying import Carrying
from tigar_x.fem.divided import Doubled, pairs
from tigar_x.fem.nodes import RowNodes
from tigar_x.fem.solve import FiniteElementSystem


class _Layout:
    """Owner of a matrix and its vectors."""


class DoubledSystem(FiniteElementSystem):
    """A residual of which some nodes have second blocks of unknowns, see the module.

    Local dofs are those of x, ghosts as well, and then those of e in the same order.

    Args:
        residual: residual of undivided cells and of their facets on the boundary.
        x: the unknown.
        bcs: strong conditions on x.
        doubled: equations of divided cells.
        options: see :class:`tigar_x.fem.solve.FiniteElementSystem`; loads of ``rank_one`` and fields that are known up
            to a constant are for other systems.

    Attributes:
        second: mask of the unknowns among the second blocks, shape (nodes, m).
    """

    def __init__(
        self, residual: ufl.Form, x: fem.Function, bcs: Sequence[Any], doubled: Doubled, **options: Any
    ) -> None:
        self._doubled = doubled
        super().__init__(residual, x, bcs, **options)

    def _make(self, residual: ufl.Form, tangent: ufl.Form) -> None:
        d, V = self._doubled, self.x.function_space
        self._e, self._z = d.joined[0][1:]
        forms = compat.partial_forms(residual, tangent, d.residual, ufl.derivative(d.residual, self._z))
        self._parts, self._divided_parts = forms[:2], forms[2:]
        self._m = V.dofmap.index_map_bs
        self._cell_nodes, self._node_of_z = compat.cell_dofs(V), d.node_of_z
        self._nodes = len(self.x.x.array) // self._m
        self._owned_nodes, self._owned_cells = V.dofmap.index_map.size_local, compat.owned_cells(V.mesh)
        self._comm, self._number = V.mesh.comm, fem.Function(V)
        self._beside = pairs(self._cell_nodes[: self._owned_cells], self._nodes)
        self._free = np.ones((self._nodes, self._m))
        self._free.ravel()[self.constrained] = 0.0
        self._shape: tuple[Any, ...] | None = None
        self._carrying = Carrying(V.mesh.comm)
        self.divide(d.cells, d.second, d.side)

    # -- what is divided ----------------------------------------------------------------------------------------------

    def divide(self, cells: Any, second: Any, side: FloatArray) -> None:
        """Say what is divided now (collective).

        Args:
            cells: mask of the divided cells, ghosts as well, shape (cells,).
            second: mask of the unknowns among the second blocks, shape (nodes, m); all nodes of it are those of divided
                cells.
            side: -1 or 1 for every node, shape (nodes,).
        """
        shape = (cells, second)
        same = self._shape is not None and all(map(np.array_equal, shape, self._shape))
        if not self._comm.allreduce(same, op=MPI.LAND):
            self._shape = tuple(mask.copy() for mask in shape)
            self._allocate(side)
        self._e.x.array[:] *= second.ravel()
        self._doubled.divide(cells, second, side)

    def _allocate(self, side: FloatArray) -> None:
        """Rows, matrix, vectors and forms of what is divided now (collective)."""
        compat.free_dropped(self._comm)
        cells, self.second = self._shape  # type: ignore[misc]
        self._plain = [part.on(~cells) for part in self._parts]
        self._divided = [part.on(cells) for part in self._divided_parts]
        mine = self._cell_nodes[: self._owned_cells][cells[: self._owned_cells]]
        self._touched, compact = np.unique(mine, return_inverse=True)
        self._compact = compact.reshape(mine.shape)
        self._is_double = self.second.any(axis=1)
        self._doubles = np.flatnonzero(self._is_double[: self._owned_nodes])
        rows = self._owned_nodes + len(self._doubles)
        first = self._comm.scan(rows) - rows
        numbers = self._number.x.array.reshape(-1, self._m)
        numbers[:, 0], numbers[:, 1] = np.arange(len(numbers)) + first, -1.0
        numbers[self._doubles, 1] = first + self._owned_nodes + np.arange(len(self._doubles))
        self._number.x.scatter_forward()
        names = numbers[:, :2].T.ravel().astype(PETSc.IntType)
        A, layout = self._matrix(names, rows), _Layout()
        self._lay_out(layout, A, A.createVecLeft())
        self._layout = layout
        self._carrying.begin(self._solver, self._rows(side))
        self._present = self.b.duplicate()
        compat.freed_with(layout, self._present)
        self._block = self._small_matrix(layout)

    def _matrix(self, names: IntArray, rows: int) -> PETSc.Mat:
        """Empty matrix whose local blocks have global names; -1: not an unknown."""
        m, comm = self._m, self._comm
        here = slice(self._owned_nodes)
        blocks, count = 1.0 + self._is_double, self._number.copy()
        counts, of_rank = count.x.array.reshape(-1, m), self._beside @ blocks
        counts[:] = 0.0
        counts[:, 0] = of_rank
        compat.accumulate(count)
        elsewhere = (counts[:, 0] - of_rank)[here]  # of cells of other ranks, whose nodes may belong to any of them
        inside = self._beside[here, here] @ blocks[here]
        widths = np.stack([np.maximum(inside, 2.0), of_rank[here] - inside]) + elsewhere
        widths = np.concatenate([widths, widths[:, self._doubles]], axis=1).astype(PETSc.IntType)
        A = PETSc.Mat().create(comm=comm)
        A.setSizes(((rows * m, None), (rows * m, None)))
        A.setType(self.recipe.matrix)
        A.setBlockSize(m)
        others = comm.allreduce(rows, op=MPI.SUM) - rows
        own, off = np.minimum(widths[0], rows), np.minimum(widths[1], others)
        if self.recipe.matrix != "baij":
            own, off = np.repeat(m * own, m), np.repeat(m * off, m)
        A.setPreallocationNNZ((own, off))
        names_map = PETSc.LGMap().create(names, bsize=m, comm=comm)
        A.setLGMap(names_map, names_map)
        A.setOption(PETSc.Mat.Option.NEW_NONZERO_ALLOCATION_ERR, False)
        return A

    def nodes_of_rows(self) -> RowNodes | None:
        """See there: second blocks, whose aggregates are their own, come after all nodes."""
        first, at = super().nodes_of_rows(), self._doubles
        if first is None:
            return None
        held = np.vstack([first.held, ~self.second[at]])
        group = np.repeat([0, 1], [len(first.x), len(at)])
        return replace(first, x=np.vstack([first.x, first.x[at]]), held=held, group=group)

    def _small_matrix(self, owner: Any) -> PETSc.Mat:
        """Matrix of this rank's divided cells, two blocks a node."""
        n, size = len(self._touched), 2 * self._m
        pattern = pairs(self._compact, n)
        counts = np.diff(pattern.indptr).astype(PETSc.IntType)
        A = PETSc.Mat().create(comm=MPI.COMM_SELF)
        A.setSizes(((n * size, None), (n * size, None)))
        A.setType("baij")
        A.setBlockSize(size)
        A.setPreallocationNNZ(counts if n else 0)
        names = np.full(self._nodes, -1, dtype=PETSc.IntType)
        names[self._node_of_z[self._touched]] = np.arange(n)
        names_map = PETSc.LGMap().create(names, bsize=size, comm=MPI.COMM_SELF)
        A.setLGMap(names_map, names_map)
        compat.freed_with(owner, A)
        return A

    def preconditioner(self) -> PETSc.PC:
        """See there."""
        self._fit()
        return super().preconditioner()

    def solve(self, reference: float | None = None) -> PETSc.Vec:
        """See there."""
        self._fit()
        return super().solve(reference)

    def _fit(self) -> None:
        """Let a preconditioner that is kept follow the tangent."""
        self._solver = self._carrying.fitted(self._solver, self._layout, self._rows(self._doubled.side), self.A)

    def _rows(self, side: FloatArray) -> Rows:
        return Rows(self._m, self._doubles, side[: self._owned_nodes].copy(), self._doubled.jumps)

    # -- fields -------------------------------------------------------------------------------------------------------

    @property
    def local_size(self) -> int:
        """Number of local dofs, those of x and of e, ghosts as well."""
        return 2 * len(self.x.x.array)

    @property
    def entries(self) -> IntArray:
        """See :class:`tigar_x.fem.solve.FiniteElementSystem`."""
        m, rows = self._m, self._m * self._owned_nodes
        places = np.full((2, len(self.x.x.array)), -1)
        places[0, :rows] = np.arange(rows)
        places[1].reshape(-1, m)[self._doubles] = rows + np.arange(m * len(self._doubles)).reshape(-1, m)
        return places.ravel()

    def owned(self, local: FloatArray) -> FloatArray:
        """See :class:`tigar_x.fem.solve.FiniteElementSystem`."""
        return self._owned(*np.split(local, 2))

    def to_local(self, vector: PETSc.Vec) -> FloatArray:
        """See :class:`tigar_x.fem.solve.FiniteElementSystem` (collective)."""
        array, rows, m, work = vector.array_r, self._m * self._owned_nodes, self._m, self._number.x
        parts = np.zeros((2, len(work.array)))
        parts[0, :rows] = array[:rows]
        parts[1].reshape(-1, m)[self._doubles] = array[rows:].reshape(-1, m)
        if self._comm.size > 1:
            for part in parts:
                work.array[:] = part
                work.scatter_forward()
                part[:] = work.array
        return parts.ravel()

    def from_local(self, local: FloatArray, vector: PETSc.Vec) -> None:
        """See :class:`tigar_x.fem.solve.FiniteElementSystem` (collective); what is no unknown gets zero."""
        totals = []
        for part in np.split(local, 2):
            if self._comm.size > 1:
                self._number.x.array[:] = part
                compat.add_ghosts(self._number)
                part = self._number.x.array.copy()
            totals.append(part)
        vector.array_w[:] = self._owned(totals[0], totals[1] * self.second.ravel())

    def _owned(self, first: FloatArray, second: FloatArray) -> FloatArray:
        """Unknowns of this rank out of local values of x and e."""
        m = self._m
        return np.concatenate([first[: m * self._owned_nodes], second.reshape(-1, m)[self._doubles].ravel()])

    # -- assembly -----------------------------------------------------------------------------------------------------

    def assemble_residual(self, load: Any = None) -> float:
        """See :class:`tigar_x.fem.solve.FiniteElementSystem`; the load's array has the dofs of x, then those of e."""
        for update in self._before:
            update()
        self._doubled.join(last=True)
        m, p, at = self._m, self._doubled.jumps, self._touched
        array = np.zeros(2 * m * self._nodes)
        first, second = array[: m * self._nodes], array[m * self._nodes :]
        compat.add_vector(first, self._plain[0])
        both = np.zeros(2 * m * self._nodes)
        compat.add_vector(both, self._divided[0])
        both = both.reshape(-1, 2 * m)[self._node_of_z[at]]
        first.reshape(-1, m)[at] += both[:, :m]
        second.reshape(-1, m)[at] += both[:, m:]
        second.reshape(-1, m)[at, p] -= 0.5 * self._doubled.side[at] * both[:, p]
        if load is not None:
            load(array)
        self.from_local(array, self.b)
        held = self.constrained[self.constrained < m * self._owned_nodes]
        self.b.array_w[held] = 0.0
        return float(self.b.norm())

    def assemble_tangent(self, add: Any = None) -> None:
        """See :class:`tigar_x.fem.solve.FiniteElementSystem`; ``add`` has the local dofs of x, then those of e."""
        A = self.A
        self._kept.replacing()
        A.zeroEntries()
        if not self.has_tangent:
            self._add_zeros()
        self._add_divided()
        compat.add_matrix(A, self._plain[1], self.bcs)
        A.assemble()
        if add is not None:
            add(A)
        A.assemble()
        self.has_tangent = True

    def _add_zeros(self) -> None:
        """Places for whatever couples unknowns of one cell that has second blocks, by a penalty at points as well."""
        cells = self._cell_nodes[: self._owned_cells]
        at, compact = np.unique(cells[self._is_double[cells].any(axis=1)], return_inverse=True)
        pattern = pairs(compact.reshape(-1, cells.shape[1]), len(at))
        both = (at[pattern.indices][:, None] + np.array([0, self._nodes])).ravel().astype(PETSc.IntType)
        starts, add = (2 * pattern.indptr).astype(PETSc.IntType), PETSc.InsertMode.ADD_VALUES
        values = np.zeros((len(both), self._m, self._m))
        for rows in (at, at + self._nodes):
            self.A.setValuesBlockedLocalIJV(starts, both, values, add, rowmap=rows.astype(PETSc.IntType))

    def _add_divided(self) -> None:
        """The tangent of divided cells, in the unknowns."""
        m, p, n, at = self._m, self._doubled.jumps, self._nodes, self._touched
        self._block.zeroEntries()
        compat.add_matrix(self._block, self._divided[1])
        self._block.assemble()
        starts, columns, values = self._block.getValuesCSR()
        size = 2 * m
        K = sp.csr_matrix((values, columns, starts), shape=(len(at) * size,) * 2).tobsr((size, size))
        K.sort_indices()
        i, j = np.repeat(np.arange(len(at)), np.diff(K.indptr)), K.indices
        V = K.data
        half = 0.5 * self._doubled.side[at]
        V[:, :, m + p] -= half[j, None] * V[:, :, p]
        V[:, m + p, :] -= half[i, None] * V[:, p, :]
        free = np.hstack([self._free[at], self.second[at]])
        V *= free[i][:, :, None] * free[j][:, None, :]
        pairs = (at[j][:, None] + np.array([0, n])).ravel().astype(PETSc.IntType)
        split = V.reshape(-1, 2, m, 2, m).transpose(1, 0, 3, 2, 4)
        twice, add = (2 * K.indptr).astype(PETSc.IntType), PETSc.InsertMode.ADD_VALUES
        for half_of, rows in enumerate((at, at + n)):
            blocks = np.ascontiguousarray(split[half_of]).reshape(-1, m, m)
            self.A.setValuesBlockedLocalIJV(twice, pairs, blocks, add, rowmap=rows.astype(PETSc.IntType))
        self._add_ones()

    def _add_ones(self) -> None:
        """On the diagonal of what is in a second block and no unknown."""
        m, mine = self._m, self._doubles
        values = np.zeros((len(mine), m, m))
        values[:, np.arange(m), np.arange(m)] = ~self.second[mine]
        rows, starts = (mine + self._nodes).astype(PETSc.IntType), np.arange(len(mine) + 1, dtype=PETSc.IntType)
        self.A.setValuesBlockedLocalIJV(starts, rows, values, PETSc.InsertMode.ADD_VALUES, rowmap=rows)

    # -- increments ---------------------------------------------------------------------------------------------------

    def state(self) -> PETSc.Vec:
        """The unknowns as a vector of the tangent, valid until the next call."""
        self._present.array_w[:] = self._owned(self.x.x.array, self._e.x.array)
        return self._present

    def rounding(self) -> float:
        """See :class:`tigar_x.fem.solve.FiniteElementSystem` (collective)."""
        if not self.has_tangent:
            return 0.0
        held = self.constrained[self.constrained < self._m * self._owned_nodes]
        return rounding.ROUNDING * rounding.of_tangent(self.A, self.state(), None, held)

    def subtract(self, increment: PETSc.Vec) -> None:
        """Subtract an increment from the unknowns, ghosts included."""
        m, array, rows = self._m, increment.array_r, self._m * self._owned_nodes
        self.x.x.array[:rows] -= array[:rows]
        self._e.x.array.reshape(-1, m)[self._doubles] -= array[rows:].reshape(-1, m)
        for function in (self.x, self._e):
            function.x.scatter_forward()
        self._doubled.join(last=True)
