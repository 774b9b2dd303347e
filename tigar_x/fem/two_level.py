"""A preconditioner of two levels for node-blocked matrices of stabilised flows.

With r a residual, P what is constant for each component in aggregates of nodes, and S the smoother,

    z = P (P' A P)^-1 P' r,    y = z + S (r - A z).

The last component is a pressure, whose equation is nearly Poisson's at small time steps: of it P has linear functions
of the aggregates as well. With constants alone iterations grow with the number of unknowns.

Near an immersed surface whose stabilisation is scaled down, pivots of pressures are weak until fill arrives. The
smoother is therefore made for a repaired copy of the matrix, in which the pressures' couplings between two nodes there
are multiplied and those on the diagonal keep the sums of the rows. GMRES keeps the exact matrix.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy.sparse as sp
from mpi4py import MPI
from petsc4py import PETSc

from tigar_x import compat
from tigar_x.compat import FloatArray, IntArray
from tigar_x.compat.blocks import LongArray
from tigar_x.fem.coarse_solver import coarse_solver
from tigar_x.fem.nodes import RowNodes, aggregates

AGGREGATE = {0: 128, 20_000: 256}
"""Nodes of an aggregate, from a number of nodes of all ranks on: more would make the coarse level too expensive."""
OF_SEVERAL = {0: 128, 100_000: 256}
"""The same where nodes are of several groups, whose smaller aggregates take fewer iterations."""
MOST = 2_300
"""Aggregates of all ranks at most: beyond, they grow with the number of nodes."""
FLAT = 1e-3
"""Square of the extent of an aggregate, relative to that of its longest side, that is none."""
_FLOATING_POINT = 72  # PETSc's code for a number that is not finite


class TwoLevel:
    """What PETSc asks of a preconditioner of its type "python".

    Args:
        nodes: of the matrix's rows.
        prefix: of the smoother's PETSc options.
        size: nodes of an aggregate; 0: by number of nodes.
        repair: factor of the couplings of weak pressures; 1: the smoother is made for the matrix itself.

    Attributes:
        smoother: S.
    """

    smoother: PETSc.PC

    def __init__(self, nodes: RowNodes, prefix: str, *, size: int = 0, repair: float = 1.0) -> None:
        self._nodes, self._prefix, self._size, self._repair = nodes, prefix, size, repair
        self._A = PETSc.Mat()
        self._owned: list[Any] = []
        self._pattern: Any = None

    def set_up(self, pc: PETSc.PC) -> None:
        """Make both levels for the matrix as it is (collective)."""
        A = pc.getOperators()[0]
        if self._pattern is None or A.handle != self._A.handle or compat.nonzero_state(A) != self._pattern.state:
            self._lay_out(A)
        self._coarse.make(compat.block_values(A))
        self._repaired()
        self.smoother.setReusePreconditioner(False)
        self.smoother.setUp()
        self.smoother.setUpOnBlocks()
        self.smoother.setReusePreconditioner(True)  # where both levels are kept, its matrix may have changed meanwhile

    setUp = set_up  # as PETSc calls it

    def _lay_out(self, A: PETSc.Mat) -> None:
        """What depends on the pattern alone."""
        self.destroy()
        self._A, self._pattern = A, compat.block_pattern(A)
        names = _named_columns(A, self._pattern)
        self._coarse = Coarse(A, self._pattern, self._nodes, names, self._size)
        self._z, self._rest = A.createVecRight(), A.createVecLeft()
        self.smoother = PETSc.PC().create(A.comm)
        self.smoother.setOptionsPrefix(self._prefix)
        repairs = self._nodes.weak is not None and self._repair != 1.0
        self._copy = A.duplicate(copy=True) if repairs else A
        self.smoother.setOperators(A, self._copy)
        self.smoother.setFromOptions()
        # the reference to A as well: petsc4py keeps what is dropped last, and with it all of the matrix
        self._owned = [self._coarse, self._z, self._rest, self.smoother, *([self._copy] if repairs else []), self._A]
        self._ghosts = names

    def _repaired(self) -> None:
        """Bring the smoother's matrix up to date (collective)."""
        marks = self._nodes.weak
        if marks is None or self._copy is self._A:
            return
        self._A.copy(self._copy, PETSc.Mat.Structure.SAME_NONZERO_PATTERN)
        at, weak = self._pattern, self._ghosts(np.asarray(marks()).astype(np.float64)) > 0.5
        values = compat.block_values(self._copy)
        edges, start = weak[at.rows] & weak[at.columns] & (at.rows != at.columns), 0
        for blocks in values:
            found = np.flatnonzero(edges[start : start + len(blocks)])
            added = (self._repair - 1.0) * blocks[found, -1, -1]
            blocks[found, -1, -1] += added
            values[0][at.diagonal, -1, -1] -= np.bincount(at.rows[start + found], added, at.own)
            start += len(blocks)
        self._copy.stateIncrease()

    def apply(self, pc: PETSc.PC, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Y = M^-1 x (collective)."""
        self._coarse.correct(x.array_r, self._z.array_w, self._rest.array_w)
        self.smoother.apply(self._rest, y)
        y.axpy(1.0, self._z)

    def destroy(self, pc: PETSc.PC | None = None) -> None:
        """Free what was made (collective)."""
        for thing in self._owned:
            thing.destroy()
        self._owned, self._pattern = [], None


def _named_columns(A: PETSc.Mat, pattern: Any) -> Any:
    """Function that continues values at this rank's nodes to all columns of its rows (collective)."""
    if A.comm.size == 1:
        return lambda values: values
    mine = PETSc.Vec().createMPI((pattern.own, None), comm=A.comm)
    there = PETSc.Vec().createSeq(len(pattern.others), comm=PETSc.COMM_SELF)
    target = PETSc.IS().createGeneral(pattern.others, comm=PETSc.COMM_SELF)
    scatter = PETSc.Scatter().create(mine, target, there, None)
    target.destroy()

    def continued(values: FloatArray) -> FloatArray:
        mine.array_w[:] = values
        scatter.scatter(mine, there, PETSc.InsertMode.INSERT, PETSc.ScatterMode.FORWARD)
        return np.concatenate([values, there.array_r])

    compat.freed_with(continued, mine, scatter)
    compat.freed_with(continued, there)
    return continued


class Coarse:
    """The coarse level, solved on every rank: constants of each component in aggregates of nodes, and linear pressures.

    The rows of A P, about two blocks each, are kept: they take less time than a product with A, and no messages. A
    column of blocks belongs to an aggregate: first the constants, then the linear functions.

    Args:
        A: the matrix.
        pattern: of its blocks.
        nodes: of its rows.
        continued: continues values at this rank's nodes to all columns of its rows.
        size: nodes of an aggregate; 0: by number of nodes.
    """

    def __init__(self, A: PETSc.Mat, pattern: Any, nodes: RowNodes, continued: Any, size: int) -> None:
        comm = self._comm = A.comm.tompi4py()
        bs, own = pattern.size, pattern.own
        every = comm.allreduce(own, op=MPI.SUM)
        size = size or aggregate_size(every, nodes.group is not None)
        number = aggregates(nodes.x, size, nodes.group)
        mine = int(number.max(initial=-1)) + 1
        counts = comm.allgather(mine)
        first, self._total = sum(counts[: comm.rank]), sum(counts)
        nc = 2 * bs - 1
        self._bs, self._nc, self._own, self._counts = bs, nc, own, [nc * count for count in counts]
        self._range = slice(first, first + mine)
        self._free = 1.0 - nodes.held
        self._number, self._diagonal = number, pattern.diagonal
        self._linear = _linear(nodes.x[:, : bs - 1], number, mine, self._free[:, -1], bs - 1)
        self._restrict = sp.csr_matrix((np.ones(own), (number, np.arange(own))), shape=(mine, own))
        column = continued((number + first).astype(np.float64)).astype(np.int64)[pattern.columns]
        at_columns = [continued(np.ascontiguousarray(w))[pattern.columns] for w in self._linear.T]
        keys, sums = _sums(pattern.rows * self._total + column)
        rows, columns = np.divmod(keys, self._total)
        inside = int(np.searchsorted(pattern.columns >= own, True))
        self._sums = [
            (part[:, :inside], part[:, inside:]) for part in (sums, *(_weighted(sums, w) for w in at_columns))
        ]
        starts = np.searchsorted(rows, np.arange(own + 1))
        blocks, shape = np.zeros((len(keys), bs, nc)), (bs * own, nc * self._total)
        self._product = sp.bsr_matrix((blocks, columns, starts), shape=shape)
        held = np.argwhere(nodes.held)
        self._held = pattern.diagonal[held[:, 0]], held[:, 1]
        pairs = np.searchsorted(keys, held[:, 0] * self._total + first + number[held[:, 0]])
        self._held_place = pairs, held[:, 1], held[:, 1]
        keys, sums = _sums(number[rows] * self._total + columns)
        self._sums_of_rows = sums, *(_weighted(sums, w[rows]) for w in self._linear.T)
        every = np.hstack([self._free, np.abs(self._linear)])
        empty = (self._restrict @ every) == 0.0
        self._solver: Any = None
        self._lay_out(keys + first * self._total, empty, nodes.floating)

    def _lay_out(self, keys: IntArray, empty: Any, floating: bool) -> None:
        """Rows and columns of the coarse matrix, of all ranks (collective)."""
        comm, bs, nc = self._comm, self._bs, self._nc
        every = np.concatenate(comm.allgather(keys))
        self._parts = [nc * nc * count for count in comm.allgather(len(keys))]
        rows, columns = np.divmod(every, self._total)
        at = np.arange(nc)
        shape = len(every), nc, nc  # column by column, as the blocks are
        self._rows = np.broadcast_to((nc * rows)[:, None, None] + at[None, None, :], shape).ravel()
        self._columns = np.broadcast_to((nc * columns)[:, None, None] + at[None, :, None], shape).ravel()
        self._ones = np.flatnonzero(np.concatenate(comm.allgather(empty.ravel())))
        self._pinned = -1
        if floating:
            known = np.ones(nc * self._total, dtype=bool)
            known[self._ones] = False
            self._pinned = int(np.flatnonzero(known.reshape(-1, nc)[:, bs - 1])[0]) * nc + bs - 1

    def make(self, values: list[FloatArray]) -> None:
        """Factor P' A P (collective).

        Args:
            values: blocks of the matrix.
        """
        bs, nc, n = self._bs, self._nc, self._nc * self._total
        product = np.empty((len(self._product.data), nc, bs))
        whole = [blocks.reshape(-1, bs * bs) for blocks in values]
        of_pressures = [np.ascontiguousarray(blocks[:, -1]) for blocks in values]
        product[:, :bs] = _summed(self._sums[0], whole).reshape(-1, bs, bs)
        for k, parts in enumerate(self._sums[1:], start=bs):
            product[:, k] = _summed(parts, of_pressures)
        blocks, component = self._held
        product[self._held_place] -= values[0][blocks, component, component]
        self._product.data[:] = product.transpose(0, 2, 1)
        constants, *linear = self._sums_of_rows
        coarse = np.empty((constants.shape[0], nc, nc))
        coarse[:, :, :bs] = (constants @ product.reshape(-1, nc * bs)).reshape(-1, nc, bs)
        for k, part in enumerate(linear, start=bs):
            coarse[:, :, k] = part @ np.ascontiguousarray(product[:, :, -1])
        mine = coarse.ravel()
        every = np.empty(sum(self._parts))
        self._comm.Allgatherv(mine, (every, self._parts))
        if not np.isfinite(every).all():
            raise PETSc.Error(_FLOATING_POINT)
        if self._pinned >= 0:
            every[(self._rows == self._pinned) | (self._columns == self._pinned)] = 0.0
        ones = self._ones if self._pinned < 0 else np.append(self._ones, self._pinned)
        known = np.append(every, np.ones(len(ones)))
        rows, columns = np.append(self._rows, ones), np.append(self._columns, ones)
        A = sp.csc_matrix((known, (rows, columns)), shape=(n, n))
        self.destroy()
        self._solver = coarse_solver(A, self._sizes(values[0]), self._comm, self._counts)

    def destroy(self) -> None:
        """Free the factors (collective)."""
        if self._solver is not None:
            self._solver.destroy()
        self._solver = None

    def _sizes(self, blocks: FloatArray) -> FloatArray:
        """Diagonal of P' D P with the diagonal D of the matrix, one where that is zero (collective)."""
        at = np.arange(self._bs)
        fine = np.abs(blocks[self._diagonal][:, at, at])
        squares = np.hstack([self._free * fine, self._linear**2 * fine[:, -1:]])
        mine, every = np.ascontiguousarray(self._restrict @ squares).ravel(), np.empty(self._nc * self._total)
        self._comm.Allgatherv(mine, (every, self._counts))
        every[self._ones] = 1.0
        if self._pinned >= 0:
            every[self._pinned] = 1.0
        return np.where(every > 0.0, every, 1.0)

    def correct(self, x: FloatArray, z: FloatArray, rest: FloatArray) -> None:
        """The correction z = P (P' A P)^-1 P' x and the rest x - A z, for this rank's values (collective)."""
        bs, nc, nodal = self._bs, self._nc, x.reshape(-1, self._bs)
        mine = (self._restrict @ np.hstack([nodal * self._free, nodal[:, -1:] * self._linear])).ravel()
        every = np.empty(nc * self._total)
        self._comm.Allgatherv(mine, (every, self._counts))
        if self._pinned >= 0:
            every[self._pinned] = 0.0
        solved = self._solver.solve(every)
        found, values = solved.reshape(-1, nc)[self._range][self._number], z.reshape(-1, bs)
        values[:] = found[:, :bs] * self._free
        values[:, -1] += np.einsum("ij,ij->i", found[:, bs:], self._linear)
        rest[:] = x - self._product @ solved


def aggregate_size(nodes: int, several: bool) -> int:
    """Nodes of an aggregate.

    Args:
        nodes: their number, of all ranks.
        several: whether they are of several groups.
    """
    by_number = OF_SEVERAL if several else AGGREGATE
    return max(-(-nodes // MOST), *(size for start, size in by_number.items() if nodes >= start), 1)


def _linear(x: FloatArray, number: LongArray, count: int, free: FloatArray, m: int) -> FloatArray:
    """Values at nodes of m linear functions of each aggregate, independent of each other and of constants, or zero.

    They are its principal coordinates; those of one that has no extent there are zero.

    Args:
        x: the nodes, shape (nodes, d), d <= m.
        number: of each one's aggregate.
        count: of the aggregates.
        free: zero at nodes whose pressure is held, and one.
        m: number of functions.
    """

    def mean(values: FloatArray) -> FloatArray:
        sums = [np.bincount(number, free * column, count) for column in values.reshape(len(x), -1).T]
        return np.stack(sums, axis=1) / np.maximum(np.bincount(number, free, count), 1.0)[:, None]

    away, d = x - mean(x)[number], x.shape[1]
    squares, axes = np.linalg.eigh(mean(away[:, :, None] * away[:, None, :]).reshape(-1, d, d))
    lengths = np.where(squares > FLAT * squares[:, -1:], np.sqrt(np.maximum(squares, 0.0)), np.inf)
    along = np.einsum("ij,ijk->ik", away, axes[number]) / np.where(lengths > 0.0, lengths, np.inf)[number]
    return np.hstack([free[:, None] * along, np.zeros((len(x), m - d))])


def _weighted(sums: sp.csr_matrix, weights: FloatArray) -> sp.csr_matrix:
    """Sums of values that have weights."""
    return sp.csr_matrix((weights[sums.indices], sums.indices, sums.indptr), shape=sums.shape)


def _summed(parts: Sequence[sp.csr_matrix], values: Sequence[FloatArray]) -> FloatArray:
    """The sums over own columns and those of other ranks together."""
    return np.asarray(sum(part @ some for part, some in zip(parts, values, strict=False)))


def _sums(keys: IntArray) -> tuple[IntArray, sp.csr_matrix]:
    """The different keys, and what sums that which belongs to the same one, shape (different keys, keys)."""
    different, place = np.unique(keys, return_inverse=True)
    shape = len(keys), len(different)
    return different, sp.csr_matrix((np.ones(len(keys)), place, np.arange(len(keys) + 1)), shape=shape).T.tocsr()
