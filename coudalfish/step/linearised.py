"""The parts of the linear system of fluid, shell and multiplier at one state, and what its multiplier is solved by."""

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp
from mpi4py import MPI
from petsc4py import PETSc

from coudalfish.sides.fluid import FluidSubproblem
from coudalfish.surface.trace import TraceMatrix
from tigar_x import ranks
from tigar_x.compat import FloatArray
from tigar_x.fem.linear import SolveError

if TYPE_CHECKING:
    from coudalfish.step.seen import Seen

DEPENDENT = 1e-13
"""Pivot relative to the largest one below which functions depend on each other, as those of two sheets in one place."""
SHIFT = 1e-10
"""What is added to their matrix then, likewise."""
WEAK = 1e-8
"""Factor eps of the term that keeps multipliers from growing which nothing else determines."""
NOTHING = 1e-14
"""Square of a function, summed over the areas at which it acts, relative to the largest, which is rounding."""


@dataclass(frozen=True, eq=False)
class Linearised:
    """The parts of the system at one state, the same on every rank but for the fluid's.

    Attributes:
        fluid: the flow, with its tangent assembled.
        trace: of its velocity at the points, this rank's share.
        part: what its tangent has of the penalty, for one component, shape (trace nodes, trace nodes).
        W: areas, zero at inactive points, shape (points d,).
        H: functions of the multiplier, zero where it acts on nothing, shape (points d, functions).
        G: their forces on the shell, shape (points d, functions), this rank's share.
        F: their forces on the trace's nodes, shape (nodes d, functions), likewise.
        P: displacements of the points by the shell's coefficients, shape (points d, coefficients).
        solve_shell: A_s^-1 times its argument, shape (coefficients,), or each of its columns.
        beta: penalty.
        a_s: derivative of y' by y.
    """

    fluid: FluidSubproblem
    trace: TraceMatrix
    part: sp.csr_matrix
    W: FloatArray
    H: sp.csr_matrix
    G: sp.csr_matrix
    F: sp.csr_matrix
    P: sp.csr_matrix
    solve_shell: Callable[[FloatArray], FloatArray]
    beta: float
    a_s: float

    @cached_property
    def dofs(self) -> Any:
        """Dofs of the trace's nodes, shape (nodes, d)."""
        return self.fluid.trace_dofs[self.trace.nodes]

    @cached_property
    def entries(self) -> Any:
        """Where these dofs are in a vector of the flow on one rank, -1: nowhere, shape (nodes, d)."""
        return self.fluid.system.entries[self.dofs]

    @cached_property
    def known(self) -> Any:
        """Mask of those that are somewhere, shape (nodes, d)."""
        return self.entries >= 0

    @cached_property
    def free(self) -> FloatArray:
        """One where a velocity is free, zero where it is held, shape (nodes, d)."""
        return self.fluid.free[self.trace.nodes].astype(np.float64)

    @cached_property
    def F_t(self) -> sp.csr_matrix:
        """Forces of the functions on the nodes, shape (functions, nodes d)."""
        return self.F.T.tocsr()

    @cached_property
    def idle(self) -> Any:
        """Mask of the functions that act on nothing.

        Those that end at a row of points have values of rounding there, which determine nothing either.
        """
        size = self.H.multiply(self.H).T @ self.W
        return size <= NOTHING * size.max(initial=0.0)


class Preconditioner:
    """Upper triangular part of the system, with the fluid's own preconditioner and a kept S of the multiplier.

    Args:
        seen: the state at which S is made (collective).

    Attributes:
        bent: how the shell gives way to the multiplier's functions, shape (coefficients, functions).
        fluid: the fluid's preconditioner.
    """

    fluid: PETSc.PC

    def __init__(self, seen: "Seen") -> None:
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

    def _by_fluid(self, seen: "Seen") -> FloatArray:
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
