"""Which preconditioner serves a system whose rows change, see :mod:`tigar_x.fem.carried`."""

from dataclasses import replace
from typing import Any

from mpi4py import MPI
from petsc4py import PETSc

from tigar_x import compat
from tigar_x.fem.carried import Rows
from tigar_x.fem.linear import PreparedSolver


class Carrying:
    """The solver whose preconditioner serves, from matrix to matrix.

    Args:
        comm: ranks of the system.
    """

    def __init__(self, comm: MPI.Comm) -> None:
        self._comm = comm
        self._made: tuple[PreparedSolver, Any, Rows] | None = None

    def begin(self, solver: PreparedSolver, rows: Rows) -> None:
        """Let the solver of a new matrix begin with the preconditioner of the one before (collective).

        Where that may not serve, it is freed: a new one would double the memory.

        Args:
            solver: that of the new matrix.
            rows: of the new matrix.
        """
        former, self._made = self._made, None
        if former is not None and former[0].can_be_carried and rows.resemble(former[2], self._comm):
            self._made = former
            solver.carry(*former, rows)
        elif former is not None and former[0].recipe.ksp is None:
            former[0].destroy()

    def fitted(self, solver: PreparedSolver, owner: Any, rows: Rows, A: PETSc.Mat) -> PreparedSolver:
        """The solver of a matrix whose values are others (collective).

        Args:
            solver: the present one.
            owner: of the matrix.
            rows: of the matrix.
            A: the matrix.
        """
        if not solver.keeps:  # it makes its preconditioner for what the matrix is now, without former ones in memory
            self._made = None
            compat.free_dropped(self._comm)
            diagonal = A.getDiagonal()
            second = diagonal.array_r[rows.size * len(rows.side) :].copy()
            diagonal.destroy()
            self._made = solver, owner, replace(rows, diagonal=second)
            return solver
        if self._made is None or self._made[0] is not solver or not solver.can_be_carried:
            return solver
        other = solver.again()
        other.carry(*self._made, rows)
        return other
