"""A preconditioner that goes on to serve while other nodes get second blocks, see :mod:`tigar_x.fem.doubled`."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from tigar_x.compat import FloatArray, IntArray

MOST = 0.1
"""Share of the second blocks, of all ranks, that is new or turned at most where a preconditioner goes on to serve."""


@dataclass(frozen=True, eq=False)
class Rows:
    """This rank's rows of a matrix: a block of every node, and then second blocks.

    Attributes:
        size: rows of a block.
        second: nodes that have second blocks, ascending.
        side: of every node, -1 or 1, shape (nodes,).
        jumps: component that jumps: its first unknown is what holds on the node's side.
        diagonal: of the matrix, for the second blocks; empty: it is not assembled yet.
    """

    size: int
    second: IntArray
    side: FloatArray
    jumps: int
    diagonal: FloatArray = field(default_factory=lambda: np.empty(0))

    def of_blocks(self, nodes: IntArray) -> IntArray:
        """Rows of the second blocks of some nodes that have them."""
        first = self.size * (len(self.side) + np.searchsorted(self.second, nodes))
        return (first[:, None] + np.arange(self.size)).ravel()

    def resemble(self, former: "Rows", comm: MPI.Comm) -> bool:
        """Whether few second blocks are others or have another meaning than formerly (collective)."""
        both = np.intersect1d(self.second, former.second, assume_unique=True)
        others = len(self.second) - len(both) + np.count_nonzero(self.side[both] != former.side[both])
        count, every = comm.allreduce(np.array([others, len(self.second)]), op=MPI.SUM)
        return bool(count <= MOST * every)


class Carried:
    """The preconditioner of a former matrix as that of a later one, as PETSc asks of its type "python".

    A surface that moves over a node changes what the node's first unknown means: with x on the side s and a jump of e
    the other side has ``x - s e``. Forces and increments are turned into those of the former unknowns. Second blocks
    that are new are divided by their diagonal.

    What an unknown of a second block acts on may be a small part of the cells around, whose size changes by orders of
    magnitude where the surface moves by little of a cell. With d the diagonals of both matrices and M the former
    preconditioner, ``D M^-1 D`` serves the later one, ``D^2 = d_was/d_now``. There is no such change of what turned.

    Args:
        former: the preconditioner, which is not made anew.
        owner: kept as long as this, so that nothing of ``former`` is freed.
        was: rows of its matrix.
        now: rows of the later one.
    """

    def __init__(self, former: PETSc.PC, owner: Any, was: Rows, now: Rows) -> None:
        former.setReusePreconditioner(True)  # its matrix may be the same, with other values
        self._former, self._owner = former, owner
        self._x, self._y = former.getOperators()[1].createVecs()
        self._first = was.size * len(was.side)
        both = np.intersect1d(was.second, now.second, assume_unique=True)
        self._there, self._here = was.of_blocks(both), now.of_blocks(both)
        self._new = now.of_blocks(np.setdiff1d(now.second, both, assume_unique=True))
        over = both[was.side[both] != now.side[both]]
        self._side = now.side[over]
        self._turned, self._jump = was.size * over + was.jumps, now.of_blocks(over)[was.jumps :: was.size]
        self._was = np.where(np.repeat(np.isin(both, over), was.size), 0.0, was.diagonal[self._there - self._first])
        self._inverse, self._scale = np.empty(0), np.empty(0)

    def set_up(self, pc: PETSc.PC) -> None:
        """What is made of the diagonal (collective)."""
        diagonal = pc.getOperators()[1].getDiagonal()
        new, here = diagonal.array_r[self._new], diagonal.array_r[self._here]
        diagonal.destroy()
        self._inverse = np.divide(1.0, new, out=np.zeros_like(new), where=new != 0.0)
        known = (self._was != 0.0) & (here != 0.0)
        self._scale = np.sqrt(np.abs(np.divide(self._was, here, out=np.ones_like(here), where=known)))

    setUp = set_up  # as PETSc calls it

    def apply(self, pc: PETSc.PC, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Y = M^-1 x (collective)."""
        n, given, there = self._first, x.array_r, self._x.array_w
        there[:n], there[n:] = given[:n], 0.0
        forces = given.copy()
        forces[self._jump] += self._side * given[self._turned]
        there[self._there] = self._scale * forces[self._here]
        del there  # PETSc keeps norms of vectors that nobody writes to
        self._former.apply(self._x, self._y)
        found, result = self._y.array_r, y.array_w
        result[:n], result[self._here] = found[:n], self._scale * found[self._there]
        result[self._new] = self._inverse * given[self._new]
        result[self._turned] += self._side * result[self._jump]

    def destroy(self, pc: PETSc.PC | None = None) -> None:
        """Free the vectors (collective)."""
        self._x.destroy()
        self._y.destroy()
