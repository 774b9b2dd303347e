"""The parts of the linear system of fluid, shell and multiplier at one state, and what its multiplier is solved by."""

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp
from mpi4py import MPI
from petsc4py import PETSc

from coudalfish.sides.fluid import FluidSubproblem
from coudalfish.surface.trace import TraceMatrix
from tigar_x.compat import FloatArray
from tigar_x.fem.linear import SolveError

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
        G: their forces on the shell, shape (points d, functions).
        X: forces on the trace's nodes beside ``T' G``, shape (nodes d, functions), this rank's share; None: there are
            none.
        P: displacements of the points by the shell's coefficients, shape (points d, coefficients).
        P_t: its transpose.
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
    X: sp.csr_matrix | None
    P: sp.csr_matrix
    P_t: sp.csr_matrix
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
    def H_t(self) -> sp.csr_matrix:
        """Functions by points, shape (functions, points d)."""
        return self.H.T.tocsr()

    @cached_property
    def G_t(self) -> sp.csr_matrix:
        """Forces of the functions, shape (functions, points d)."""
        return self.G.T.tocsr()

    @cached_property
    def X_t(self) -> sp.csr_matrix | None:
        """What is beside them, shape (functions, nodes d)."""
        return None if self.X is None else self.X.T.tocsr()

    @cached_property
    def idle(self) -> Any:
        """Mask of the functions that act on nothing.

        Those that end at a row of points have values of rounding there, which determine nothing either.
        """
        size = self.H_t.multiply(self.H_t) @ self.W
        return size <= NOTHING * size.max(initial=0.0)

    def moved(self, forces: FloatArray) -> FloatArray:
        """Velocity with which the shell gives way to forces at the points, or to columns: ``a_s P A_s^-1 P'``."""
        return np.asarray(self.a_s * (self.P @ self.solve_shell(self.P_t @ forces)))

    def to_nodes(self, forces: FloatArray, b: FloatArray | None = None) -> FloatArray:
        """This rank's share of forces on the trace's nodes, shape (nodes, d).

        Args:
            forces: at the points, shape (points d,).
            b: coefficients of functions that have more than these, shape (functions,); None: there are none.
        """
        nodal = self.trace.transposed @ forces.reshape(-1, self.dofs.shape[1])
        if self.X is not None and b is not None:
            nodal = nodal + (self.X @ b).reshape(nodal.shape)
        return np.asarray(self.free * nodal)


class Preconditioner:
    """Upper triangular part of the system, with the fluid's own preconditioner and a kept S of the multiplier.

    Args:
        at: the state at which S is made (collective).

    Attributes:
        at: as given, or a later state, whose fluid is taken.
        made: as given.
        bent: how the shell gives way to the multiplier's functions, shape (coefficients, functions).
        fluid: the fluid's preconditioner.
    """

    fluid: PETSc.PC

    def __init__(self, at: Linearised) -> None:
        self.at = self.made = at
        loads = sp.csr_matrix(at.P_t @ at.G)
        self.bent = at.solve_shell(loads.toarray())
        S = at.a_s * (loads.T @ self.bent) + WEAK / at.beta * (at.G_t @ at.H).toarray()
        S += at.fluid.timeInt.x_factor * self._by_fluid()
        S[at.idle, at.idle] = S.diagonal().max(initial=0.0) or 1.0
        if not np.isfinite(S).all() or not S.size:
            raise SolveError("the multiplier's system is not finite")
        self._factors = _factors(S)

    def _by_fluid(self) -> FloatArray:
        """``C' D^-1 C`` with D the diagonal of the fluid's tangent (collective)."""
        at, diagonal = self.at, self.at.fluid.diagonal()
        forces = at.G.toarray() - self._drag(self.bent)
        if at.fluid.comm.size == 1:
            T, X, inverse = at.trace.B, at.X, at.free / np.where(at.free > 0.0, diagonal[at.dofs], 1.0)
        else:
            T, X, inverse = self._from_all_ranks(diagonal)
        C = (T.T @ forces.reshape(T.shape[0], -1)).reshape(inverse.size, forces.shape[1])
        if X is not None:
            C = np.asarray(C + X)
        return np.asarray(C.T @ (inverse.ravel()[:, None] * C))

    def _from_all_ranks(self, diagonal: FloatArray) -> tuple[sp.csr_matrix, sp.csr_matrix | None, FloatArray]:
        """The whole trace, what is beside, and the inverse of the diagonal at its nodes, on every rank (collective)."""
        at, fluid, T, d = self.at, self.at.fluid, self.at.trace.B.tocoo(), self.at.dofs.shape[1]
        names, X = fluid.names(at.trace.nodes), None if at.X is None else at.X.tocoo()
        beside = () if X is None else (names[X.row // d], X.row % d, X.col, X.data)
        parts = [
            np.concatenate(part)
            for part in zip(*fluid.comm.allgather((T.row, names[T.col], T.data, *beside)), strict=True)
        ]
        nodes = np.unique(np.concatenate([parts[1], *parts[3:4]]))
        whole = sp.csr_matrix((parts[2], (parts[0], np.searchsorted(nodes, parts[1]))), shape=(T.shape[0], len(nodes)))
        if X is not None:
            row = d * np.searchsorted(nodes, parts[3]) + parts[4]
            X = sp.csr_matrix((parts[6], (row, parts[5])), shape=(d * len(nodes), X.shape[1]))
        own = fluid.owned_nodes(nodes)
        mine = own >= 0
        inverse = np.zeros((len(nodes), at.dofs.shape[1]))
        dofs, free = fluid.trace_dofs[own[mine]], fluid.free[own[mine]]
        inverse[mine] = np.where(free, 1.0 / np.where(free, diagonal[dofs], 1.0), 0.0)
        fluid.comm.Allreduce(MPI.IN_PLACE, inverse, op=MPI.SUM)
        return whole, X, inverse

    def multiplier(self, r: FloatArray) -> FloatArray:
        """Increment of the multiplier's coefficients."""
        return np.asarray(-la.lu_solve(self._factors, r, check_finite=False) / self.at.beta)

    def forces(self, b: FloatArray) -> FloatArray:
        """Forces of coefficients at the points."""
        return np.asarray(self.made.G @ b - self._drag(self.bent @ b))

    def _drag(self, y: FloatArray) -> FloatArray:
        """Forces of the penalty at the points where the shell moves by its coefficients, or by columns of them."""
        at = self.made
        return np.asarray((at.beta * at.a_s * (at.W * (at.P @ y).T)).T)


def _factors(S: FloatArray) -> Any:
    """Factors of a matrix whose rows may depend on each other."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", la.LinAlgWarning)
        factors = la.lu_factor(S, check_finite=False)
    pivots = np.abs(factors[0].diagonal())
    if pivots.min() > DEPENDENT * pivots.max():
        return factors
    return la.lu_factor(S + SHIFT * pivots.max() * np.eye(len(S)), check_finite=False)
