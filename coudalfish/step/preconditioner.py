"""What the multiplier of the system of fluid, shell and multiplier is solved by."""

import warnings
from typing import Any

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp
from mpi4py import MPI
from petsc4py import PETSc

from coudalfish.step.linearised import WEAK, Linearised
from coudalfish.step.seen import Seen
from tigar_x import ranks
from tigar_x.compat import FloatArray
from tigar_x.fem.linear import SolveError

DEPENDENT = 1e-13
"""Pivot relative to the largest one below which functions depend on each other, as those of two sheets in one place."""
SHIFT = 1e-10
"""What is added to their matrix then, likewise."""


class Preconditioner:
    """Upper triangular part of the system, with the fluid's own preconditioner and a kept S of the multiplier.

    Args:
        seen: the state at which S is made (collective).

    Attributes:
        bent: how the shell gives way to the multiplier's functions, shape (coefficients, functions).
        fluid: the fluid's preconditioner.
    """

    fluid: PETSc.PC

    def __init__(self, seen: Seen) -> None:
        at = seen.at
        own, loads = sp.csr_matrix(seen.P.T @ seen.G), np.zeros((at.P.shape[1], at.G.shape[1]))
        loads[seen.columns] = own.toarray()
        self.bent = at.solve_shell(ranks.total(at.fluid.comm, loads))
        S = at.a_s * (own.T @ self.bent[seen.columns]) + WEAK / at.beta * (seen.G.T @ seen.H).toarray()
        S += at.fluid.timeInt.x_factor * self._by_fluid(seen)
        S = ranks.total(at.fluid.comm, S)
        S[at.idle, at.idle] = S.diagonal().max(initial=0.0) or 1.0
        if not np.isfinite(S).all() or not S.size:
            raise SolveError("the multiplier's system is not finite")
        self._factors = _factors(S)

    def _by_fluid(self, seen: Seen) -> FloatArray:
        """This rank's share of ``C' D^-1 C`` with D the diagonal of the fluid's tangent (collective)."""
        at, diagonal = seen.at, seen.at.fluid.diagonal()
        drag = seen.drag(self.bent[seen.columns])
        wide = at.dofs.shape[1] * at.F.shape[1]
        C = at.F.toarray() - (seen.B.T @ drag.reshape(-1, wide)).reshape(at.F.shape)
        inverse = at.free / np.where(at.free > 0.0, diagonal[at.dofs], 1.0)
        if at.fluid.comm.size > 1:
            inverse *= self._first_of_all_ranks(at, C.reshape(-1, wide))[:, None]
        return np.asarray(C.T @ (inverse.ravel()[:, None] * C))

    def _first_of_all_ranks(self, at: Linearised, rows: FloatArray) -> Any:
        """Turn shares at nodes that several ranks see into their sums: mask of those that no rank before sees."""
        comm, names = at.fluid.comm, at.fluid.names(at.trace.nodes)
        each = comm.allgather(names)
        every, count = np.unique(np.concatenate(each), return_counts=True)
        common = every[count > 1]
        mine = np.flatnonzero(np.isin(names, common))
        place = np.searchsorted(common, names[mine])
        sums = np.zeros((len(common), rows.shape[1]))
        sums[place] = rows[mine]
        comm.Allreduce(MPI.IN_PLACE, sums, op=MPI.SUM)
        rows[mine] = sums[place]
        return ~np.isin(names, np.concatenate([names[:0], *each[: comm.rank]]))

    def multiplier(self, r: FloatArray, beta: float) -> FloatArray:
        """Increment of the multiplier's coefficients; beta is the penalty."""
        return np.asarray(-la.lu_solve(self._factors, r, check_finite=False) / beta)


def _factors(S: FloatArray) -> Any:
    """Factors of a matrix whose rows may depend on each other."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", la.LinAlgWarning)
        factors = la.lu_factor(S, check_finite=False)
    pivots = np.abs(factors[0].diagonal())
    if pivots.min() > DEPENDENT * pivots.max():
        return factors
    return la.lu_factor(S + SHIFT * pivots.max() * np.eye(len(S)), check_finite=False)
