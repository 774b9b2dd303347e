"""The linear system of fluid, shell and multiplier together, with the shell condensed exactly into the fluid's.

With u, y, c the unknowns of the flow, of the shell and of the multiplier ``H c`` (forces per area at the points), T the
trace, P the displacement of the points by the shell's coefficients, W their areas, a_f = d u_alpha/d u, a_s = d y'/d y,
K and A_s the tangents of flow and shell, the latter with its part of the penalty beta, one step of Newton's solves

    [ K + beta a_f T'WT    -beta a_s T'WP     T'WH          ] [du]   [r_f]
    [ -beta a_f P'WT       A_s               -P'WH          ] [dy] = [r_s]        r_c = H'W (u_alpha - y')
    [ a_f H'WT             -a_s H'WP         -eps H'WH/beta ] [dc]   [r_c]

and subtracts the increments. The second row is solved for dy with the shell's factors in every product, and the third
one is multiplied by beta, so that all rows are forces.
"""

import weakref
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, cast

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp
from mpi4py import MPI
from petsc4py import PETSc

from coudalfish.sides.fluid import FluidSubproblem
from coudalfish.surface.trace import TraceMatrix
from tigar_x import compat
from tigar_x.compat import FloatArray
from tigar_x.fem.linear import SolveError

WEAK = 1e-8
"""Factor eps of the term that keeps multipliers from growing which nothing else determines."""
RTOL = 1e-8
"""Residual of the linear solver relative to the first one of the step; 1e-6 is too much for closed chambers."""
ROUNDED = 1e-13
"""Residual relative to the right-hand side below which it is rounding."""
ITERATIONS = 200
"""Iterations of the linear solver after which it has failed."""


@dataclass(frozen=True, eq=False)
class Linearised:
    """The parts of the system at one state, the same on every rank but for the fluid's.

    Attributes:
        fluid: the flow, with its tangent assembled.
        trace: of its velocity at the points, this rank's share.
        part: what its tangent has of the penalty, for one component, shape (trace nodes, trace nodes).
        W: areas, zero at inactive points, shape (points d,).
        H: functions of the multiplier, zero where it acts on nothing, shape (points d, functions).
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
    P: sp.csr_matrix
    solve_shell: Callable[[FloatArray], FloatArray]
    beta: float
    a_s: float

    @cached_property
    def dofs(self) -> Any:
        """Dofs of the trace's nodes, shape (nodes, d)."""
        return self.fluid.trace_dofs[self.trace.nodes]

    @cached_property
    def free(self) -> FloatArray:
        """One where a velocity is free, zero where it is held, shape (nodes, d)."""
        return self.fluid.free[self.trace.nodes].astype(np.float64)

    @cached_property
    def H_t_W(self) -> sp.csr_matrix:
        """Means of the functions, ``H' W``."""
        return (self.H.T @ sp.diags(self.W)).tocsr()

    @cached_property
    def P_t_W(self) -> sp.csr_matrix:
        """Forces on the shell of forces per area, ``P' W``."""
        return (self.P.T @ sp.diags(self.W)).tocsr()

    @cached_property
    def a_P(self) -> sp.csr_matrix:
        """Velocity of the points by the coefficients, ``a_s P``."""
        return (self.a_s * self.P).tocsr()

    @cached_property
    def gram(self) -> sp.csr_matrix:
        """``eps H'WH``."""
        return (WEAK * (self.H_t_W @ self.H)).tocsr()

    @cached_property
    def idle(self) -> Any:
        """Mask of the functions that act on nothing."""
        return np.asarray(self.H_t_W.multiply(self.H_t_W).sum(axis=1)).ravel() == 0.0

    def to_nodes(self, forces: FloatArray) -> FloatArray:
        """This rank's share of forces at the points, at local dofs with ghosts."""
        b = np.zeros(self.fluid.system.local_size)
        b[self.dofs] = self.free * (self.trace.transposed @ forces.reshape(-1, self.dofs.shape[1]))
        return b


class Preconditioner:
    """Upper triangular part of the system, with the fluid's own preconditioner and a kept S of the multiplier.

    Args:
        at: the state at which S is made (collective).

    Attributes:
        at: as given, or a later state, whose fluid is taken.
        fluid: the fluid's preconditioner.
    """

    fluid: PETSc.PC

    def __init__(self, at: Linearised) -> None:
        self.at = at
        n = at.H.shape[1]
        Q = at.P @ at.solve_shell(at.P_t_W @ at.H.toarray())
        self._forces = at.H.toarray() - at.beta * at.a_s * Q
        S = at.a_s * (at.H_t_W @ Q) + at.fluid.timeInt.x_factor * self._by_fluid() + at.gram.toarray() / at.beta
        S[at.idle, at.idle] = 1.0
        if not np.isfinite(S).all() or n == 0:
            raise SolveError("the multiplier's system is not finite")
        self._factors = la.lu_factor(S, check_finite=False)

    def _by_fluid(self) -> FloatArray:
        """``C' D^-1 C`` with D the diagonal of the fluid's tangent (collective)."""
        at, fluid = self.at, self.at.fluid
        T = at.trace.B.tocoo()
        share = T.row, fluid.names(at.trace.nodes)[T.col], T.data
        parts = [np.concatenate(part) for part in zip(*fluid.comm.allgather(share), strict=True)]
        nodes, column = np.unique(parts[1], return_inverse=True)
        whole = sp.csr_matrix((parts[2], (parts[0], column.ravel())), shape=(T.shape[0], len(nodes)))
        own = fluid.owned_nodes(nodes)
        mine = own >= 0
        diagonal = fluid.diagonal()
        inverse = np.zeros((len(nodes), at.dofs.shape[1]))
        dofs, free = fluid.trace_dofs[own[mine]], fluid.free[own[mine]]
        inverse[mine] = np.where(free, 1.0 / np.where(free, diagonal[dofs], 1.0), 0.0)
        fluid.comm.Allreduce(MPI.IN_PLACE, inverse, op=MPI.SUM)
        WG = (at.W[:, None] * self._forces).reshape(T.shape[0], -1)
        C = (whole.T @ WG).reshape(inverse.size, self._forces.shape[1])
        return np.asarray(C.T @ (inverse.ravel()[:, None] * C))

    def multiplier(self, r: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Increment of the multiplier's coefficients, and its forces at the points."""
        b = -la.lu_solve(self._factors, r, check_finite=False) / self.at.beta
        return b, self.at.W * (self._forces @ b)


class CondensedSystem:
    """The system as PETSc's matrix and preconditioner, and its solution by GMRES.

    The unknowns of a rank are its dofs of the flow and, on the first one, the multiplier's.

    Args:
        fluid: the flow.
        functions: number of the multiplier's functions.

    Attributes:
        at: the parts; None: there are none yet.
        preconditioner: see :class:`Preconditioner`.
        iterations: of the last solve.
    """

    at: Linearised
    preconditioner: Preconditioner

    def __init__(self, fluid: FluidSubproblem, functions: int) -> None:
        self._comm, b = fluid.comm, fluid.system.b
        self._n, self._own = b.getLocalSize(), functions if self._comm.rank == 0 else 0
        self._functions = functions
        sizes = self._n + self._own, b.getSize() + functions
        self._flow, self._result, self._vector = b.duplicate(), b.duplicate(), b.duplicate()
        self._A = PETSc.Mat().createPython((sizes, sizes), _Product(self), comm=b.comm)
        self._A.setUp()
        self._rhs, self._x = self._A.createVecs()
        self._ksp = PETSc.KSP().create(b.comm)
        self._ksp.setOperators(self._A)
        self._ksp.setType("fgmres" if fluid.system.recipe.options.get("ksp_type") == "fgmres" else "gmres")
        self._ksp.setPCSide(PETSc.PC.Side.RIGHT)
        self._ksp.setNormType(PETSc.KSP.NormType.UNPRECONDITIONED)
        self._ksp.setGMRESRestart(ITERATIONS)
        pc = self._ksp.getPC()
        pc.setType("python")
        pc.setPythonContext(_Triangle(self))
        made = (self._flow, self._result, self._vector, self._A, self._rhs, self._x, self._ksp)
        compat.freed_with(self, *made)
        self.iterations = 0

    def solve(
        self, b_f: PETSc.Vec, r_s: FloatArray, r_c: FloatArray, reference: float, accepted: float
    ) -> tuple[float, FloatArray]:
        """Solve for the increments of flow and multiplier (collective).

        Args:
            b_f: residual of the flow.
            r_s: residual of the shell, shape (coefficients,).
            r_c: of the multiplier's functions, shape (functions,).
            reference: norm that the tolerance refers to beside that of the right-hand side.
            accepted: residual of which no more than a tenth is to be left.

        Returns:
            Norm of the right-hand side, and the increment of the multiplier's coefficients, shape (functions,), the
            same on every rank. The increment of the flow is in :attr:`increment`.

        Raises:
            SolveError: GMRES failed.
        """
        at = self.at
        z = at.a_P @ at.solve_shell(r_s)
        at.fluid.system.from_local(at.to_nodes(at.beta * at.W * z), self._result)
        rhs = self._rhs.array_w
        rhs[: self._n] = b_f.array_r + self._result.array_r
        if self._own:
            rhs[self._n :] = np.where(at.idle, 0.0, at.beta * (r_c + at.H_t_W @ z))
        norm = float(self._rhs.norm())
        if norm == 0.0:
            self._vector.set(0.0)
            self.iterations = 0
            return norm, np.zeros(self._functions)
        smallest = max(min(RTOL * max(norm, reference), 0.1 * accepted), ROUNDED * norm)
        self._ksp.setTolerances(rtol=0.0, atol=smallest, max_it=ITERATIONS)
        try:
            self._ksp.solve(self._rhs, self._x)
        except PETSc.Error as error:
            raise SolveError(f"GMRES of flow and multiplier: PETSc: {error}") from None
        self.iterations, reason = self._ksp.getIterationNumber(), self._ksp.getConvergedReason()
        if reason <= 0 or not np.isfinite(self._x.norm()):
            raise SolveError(f"GMRES of flow and multiplier failed after {self.iterations} iterations ({reason})")
        x = self._x.array_r
        self._vector.array_w[:] = x[: self._n]
        c = x[self._n :].copy() if self._own else np.empty(self._functions)
        if self._comm.size > 1:
            self._comm.Bcast(c)
        return norm, c

    @property
    def increment(self) -> PETSc.Vec:
        """Increment of the flow of the last solve."""
        return self._vector

    # -- what PETSc calls ---------------------------------------------------------------------------------------------

    def multiply(self, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """The product with the matrix (collective)."""
        at, flow, result, given = self.at, self._flow, self._result, x.array_r
        flow.array_w[:] = given[: self._n]
        a = at.free * at.fluid.system.to_local(flow)[at.dofs]
        v = np.zeros(len(at.W) + self._functions)  # velocities at the points, then coefficients: in one sum over ranks
        v[: len(at.W)] = (at.fluid.timeInt.x_factor * (at.trace.B @ a)).ravel()
        v[len(at.W) :][: self._own] = given[self._n :]
        if self._comm.size > 1:
            self._comm.Allreduce(MPI.IN_PLACE, v, op=MPI.SUM)
        v, b = v[: len(at.W)], v[len(at.W) :]
        traction = at.beta * v + at.H @ b
        w = at.a_P @ at.solve_shell(at.P_t_W @ traction)
        at.fluid.system.multiply(flow, result)
        nodal = at.to_nodes(at.W * (traction - at.beta * w))
        nodal[at.dofs] -= at.free * (at.part @ a)
        at.fluid.system.from_local(nodal, self._vector)
        product = y.array_w
        product[: self._n] = result.array_r + self._vector.array_r
        if self._own:
            product[self._n :] = np.where(at.idle, b, at.beta * (at.H_t_W @ (v - w)) - at.gram @ b)

    def precondition(self, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """The upper triangular part, solved (collective)."""
        at, given = self.at, x.array_r
        r = given[self._n :].copy() if self._own else np.empty(self._functions)
        if self._comm.size > 1:
            self._comm.Bcast(r)
        b, forces = self.preconditioner.multiplier(r)
        at.fluid.system.from_local(at.to_nodes(-forces), self._result)
        self._result.array_w[:] += given[: self._n]
        self.preconditioner.fluid.apply(self._result, self._vector)
        increment = y.array_w
        increment[: self._n] = self._vector.array_r
        if self._own:
            increment[self._n :] = np.where(at.idle, r, b)


class _Product:
    """What PETSc asks of a matrix."""

    def __init__(self, system: CondensedSystem) -> None:
        self._system = weakref.ref(system)

    def mult(self, A: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """A x."""
        cast(CondensedSystem, self._system()).multiply(x, y)


class _Triangle:
    """What PETSc asks of a preconditioner."""

    def __init__(self, system: CondensedSystem) -> None:
        self._system = weakref.ref(system)

    def apply(self, pc: PETSc.PC, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """M^-1 x."""
        cast(CondensedSystem, self._system()).precondition(x, y)
