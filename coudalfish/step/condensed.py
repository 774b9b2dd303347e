"""The linear system of fluid, shell and multiplier together, with the shell condensed exactly into the fluid's.

With u, y, c the unknowns of the flow, of the shell and of the multiplier ``H c`` (forces per area at the points), T the
trace, P the displacement of the points by the shell's coefficients, W their areas, a_f = d u_alpha/d u, a_s = d y'/d y,
K and A_s the tangents of flow and shell, the latter with its part of the penalty beta, one step of Newton's solves

    [ K + beta a_f T'WT    -beta a_s T'WP     T'WH          ] [du]   [r_f]
    [ -beta a_f P'WT       A_s               -P'WH          ] [dy] = [r_s]        r_c = H'W (u_alpha - y')
    [ a_f H'WT             -a_s H'WP         -eps H'WH/beta ] [dc]   [r_c]

and subtracts the increments. WH are the forces G of the multiplier's functions on the shell, and T'WH their forces F on
the fluid's nodes; where the meeting has normals of its own, along which the multiplier acts, both are made with these,
and F is not T'G. The second row is solved for
dy with the shell's factors in every product, and the third one is multiplied by beta, as the flow's rows of continuity
are, so that all rows are forces.
"""

import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from typing import cast

import numpy as np
from petsc4py import PETSc

from coudalfish.sides.fluid import FluidSubproblem
from coudalfish.step.linearised import Linearised
from coudalfish.step.nodal import TraceNodes
from coudalfish.step.preconditioner import Preconditioner
from coudalfish.step.seen import Seen
from tigar_x import compat, ranks
from tigar_x.compat import FloatArray
from tigar_x.fem.linear import SolveError, keep_orthogonal

RTOL = 1e-8
"""Residual of the linear solver relative to the first one of the step; 1e-6 is too much for closed chambers."""
ROUNDED = 1e-13
"""Residual relative to the right-hand side below which it is rounding."""
LEFT = 0.1
"""Part of the right-hand side that is left at most: a pass that is taken for the slip alone has to lessen it."""
ITERATIONS = 200
"""Iterations of the linear solver after which it has failed."""


class CondensedSystem:
    """The system as PETSc's matrix and preconditioner, and its solution by GMRES.

    The unknowns of a rank are its dofs of the flow and all of the multiplier's, divided by the square root of the
    number of ranks: products of vectors are then those of one rank, and no rank has to tell the others.

    Args:
        fluid: the flow.
        functions: number of the multiplier's functions.

    Attributes:
        seen: the parts.
        preconditioner: see :class:`Preconditioner`.
        iterations: of the last solve.
        increment: of the flow, of the last solve.
    """

    seen: Seen
    preconditioner: Preconditioner

    def __init__(self, fluid: FluidSubproblem, functions: int) -> None:
        self._comm, b = fluid.comm, fluid.system.b
        self._n, self._functions, self._copies = b.getLocalSize(), functions, float(np.sqrt(self._comm.size))
        sizes = self._n + functions, b.getSize() + self._comm.size * functions
        self.increment = b.duplicate()
        self._given, self._result = fluid.system.A.createVecs()  # of parts of the unknowns, which are not copied
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
        keep_orthogonal(self._ksp)
        vectors = (self.increment, self._given, self._result, self._rhs, self._x)
        compat.freed_with(self, *vectors, pc, self._ksp, self._A)
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
        self._force = at.fluid.as_forces(at.beta)
        self._bent = self.preconditioner.bent[self.seen.columns]
        nodal, slip = self.seen.moved(at.solve_shell(r_s))
        self._nodes, rhs = TraceNodes(at), self._rhs.array_w
        rhs[: self._n] = b_f.array_r
        with placed(self._result, rhs[: self._n]) as result:
            self._nodes.add(nodal, result)
        rhs[: self._n] *= self._force
        rhs[self._n :] = np.where(at.idle, 0.0, at.beta * r_c + slip) / self._copies
        del rhs  # PETSc keeps norms of vectors that nobody writes to
        norm = float(self._rhs.norm())
        if norm == 0.0:
            self.increment.set(0.0)
            self.iterations = 0
            return norm, np.zeros(self._functions)
        smallest = max(min(RTOL * max(norm, reference), 0.1 * accepted, LEFT * norm), ROUNDED * norm)
        self._ksp.setTolerances(rtol=0.0, atol=smallest, max_it=ITERATIONS)
        try:
            self._ksp.solve(self._rhs, self._x)
        except PETSc.Error as error:
            at.fluid.system.served(np.inf)
            raise SolveError(f"GMRES of flow and multiplier: PETSc: {error}") from None
        self.iterations, reason = self._ksp.getIterationNumber(), self._ksp.getConvergedReason()
        failed = reason <= 0 or not np.isfinite(self._x.norm())
        at.fluid.system.served(np.inf if failed else self.iterations)
        if failed:
            raise SolveError(f"GMRES of flow and multiplier failed after {self.iterations} iterations ({reason})")
        x = self._x.array_r
        self.increment.array_w[:] = x[: self._n]
        c = self._copies * x[self._n :]
        ranks.share(self._comm, c)
        return norm, c

    @property
    def at(self) -> Linearised:
        """The state of the parts."""
        return self.seen.at

    # -- what PETSc calls ---------------------------------------------------------------------------------------------

    def multiply(self, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """The product with the matrix (collective)."""
        at, given, product = self.at, x.array_r, y.array_w
        b = self._copies * given[self._n :]
        with placed(self._given, given[: self._n]) as flow, placed(self._result, product[: self._n]) as result:
            at.fluid.system.multiply(flow, result)
            nodal, slip = self.seen.product(self._nodes.of(flow), b)
            self._nodes.add(nodal, result)
        product[: self._n] *= self._force
        product[self._n :] = np.where(at.idle, b, slip) / self._copies

    def precondition(self, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """The upper triangular part, solved (collective)."""
        at, given, increment = self.at, x.array_r, y.array_w
        r = self._copies * given[self._n :]
        b = self.preconditioner.multiplier(r, at.beta)
        self.increment.array_w[:] = given[: self._n] / self._force
        self._nodes.add(self.seen.to_nodes(self.seen.drag(self._bent @ b), -b), self.increment)
        with placed(self._result, increment[: self._n]) as result:
            self.preconditioner.fluid.apply(self.increment, result)
        increment[self._n :] = np.where(at.idle, r, b) / self._copies


@contextmanager
def placed(vector: PETSc.Vec, values: FloatArray) -> Iterator[PETSc.Vec]:
    """A vector whose values are an array, meanwhile."""
    vector.placeArray(values)
    try:
        yield vector
    finally:
        vector.resetArray()


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
