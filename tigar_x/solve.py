"""Nonlinear systems in finite element spaces, and the one Newton loop.

Increments are subtracted throughout: ``K dx = R``, ``x <- x - dx``.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import ufl
from dolfinx import fem
from petsc4py import PETSc

from tigar_x import checks, compat
from tigar_x.compat import FloatArray
from tigar_x.line_search import LineSearch, search
from tigar_x.linear import LinearSolver, PreparedSolver, SolveError, direct


class System(Protocol):
    """What the Newton loop needs to know of a nonlinear problem."""

    @property
    def b(self) -> PETSc.Vec:
        """Residual of the last assembly; only a line search looks at it."""

    def assemble_residual(self) -> float:
        """Assemble the residual at the present state and return its norm."""

    def assemble_tangent(self) -> None:
        """Assemble the tangent at the present state."""

    def solve(self) -> PETSc.Vec:
        """Solve for the increment of the present residual."""

    def subtract(self, increment: PETSc.Vec) -> None:
        """Move the state by minus the increment."""


class FiniteElementSystem:
    """A residual in a finite element space with strong boundary conditions.

    Args:
        residual: UFL residual R(x; test).
        x: the unknown.
        bcs: strong conditions; their values enter through :meth:`apply_boundary_values`.
        tangent: UFL tangent; None: the derivative of the residual.
        solver: linear solver recipe.

    Attributes:
        A: tangent matrix.
        b: residual vector, with ghosts.
        recipe: linear solver recipe.
        iterations: linear iterations of the last solve.
    """

    def __init__(
        self,
        residual: ufl.Form,
        x: fem.Function,
        bcs: Sequence[Any] = (),
        *,
        tangent: ufl.Form | None = None,
        solver: LinearSolver | None = None,
    ) -> None:
        compat.free_dropped(x.function_space.mesh.comm)
        self.x = x
        self.bcs = tuple(bcs)
        self.recipe = direct() if solver is None else solver
        jacobian = ufl.derivative(residual, x) if tangent is None else tangent
        self._residual, self._tangent = compat.compile_forms(residual, jacobian)
        blocked = x.function_space.dofmap.index_map_bs > 1
        self.A = compat.create_matrix(self._tangent, self.recipe.matrix if blocked else "aij")
        self.b = compat.create_vector(x.function_space)
        self._dx = self.b.duplicate()
        self.constrained = compat.constrained_dofs(self.bcs)
        self._solver = PreparedSolver(self.recipe, self.A)
        compat.freed_with(self, self.A, self.b, self._dx)
        self.iterations = 0

    def apply_boundary_values(self) -> None:
        """Write the prescribed values into the unknown."""
        compat.apply_values(self.x, self.bcs)

    def assemble_residual(self, load: Callable[[FloatArray], None] | None = None) -> float:
        """Assemble the residual.

        Args:
            load: adds further contributions to this rank's array (owned dofs, then ghosts).

        Returns:
            Its Euclidean norm.
        """
        compat.assemble_vector(self.b, self._residual)
        with self.b.localForm() as local:
            if load is not None:
                load(local.array_w)
        self.b.ghostUpdate(PETSc.InsertMode.ADD, PETSc.ScatterMode.REVERSE)
        owned = self.constrained[self.constrained < self.b.getLocalSize()]
        self.b.array_w[owned] = 0.0
        return float(self.b.norm())

    def assemble_tangent(self, add: Callable[[PETSc.Mat], None] | None = None) -> None:
        """Assemble the tangent.

        Args:
            add: adds further contributions by local indices; must leave rows and columns of constrained dofs alone.
        """
        compat.assemble_matrix(self.A, self._tangent, self.bcs)
        if add is not None:
            self.A.assemble()
            add(self.A)
        self.A.assemble()

    def solve(self, reference: float | None = None) -> PETSc.Vec:
        """Solve for the increment.

        Args:
            reference: norm that an iterative solver's relative tolerance refers to; None: that of the residual.

        Returns:
            The increment, valid until the next solve.

        Raises:
            SolveError: the linear solver failed.
        """
        self.iterations = self._solver.solve(self.b, self._dx, reference)
        return self._dx

    def subtract(self, increment: PETSc.Vec) -> None:
        """Subtract an increment from the unknown, ghosts included."""
        self.x.x.array[: increment.getLocalSize()] -= increment.array_r
        self.x.x.scatter_forward()


@dataclass(frozen=True)
class NewtonReport:
    """What a Newton solve did.

    Attributes:
        norms: residual norms, from the initial one to the accepted one.
        linear_iterations: iterations of the linear solver, one entry per step.
        step_lengths: multiples of the increments that were subtracted, one entry per step; 1 without a line search.
    """

    norms: tuple[float, ...]
    linear_iterations: tuple[int, ...]
    step_lengths: tuple[float, ...]


def newton(
    system: System,
    *,
    rtol: float = 1e-5,
    atol: float = 0.0,
    max_iterations: int = 20,
    reference: float | None = None,
    line_search: LineSearch | None = None,
) -> NewtonReport:
    """Newton's method; the residual is tested before every solve.

    Args:
        system: the problem.
        rtol: accepted residual relative to ``reference``.
        atol: accepted residual, in the residual's unit.
        max_iterations: solves after which the iteration has failed.
        reference: norm that ``rtol`` refers to; None: the initial residual. A start that is nearly a solution needs
            one, or ``atol``: rounding keeps the residual from falling far below its initial value.
        line_search: shortens steps that make things worse; None: full steps. It widens what converges, but slows what
            converges over a passing rise of the residual: thin shells. (An elastica with P L^2/(E I) = 4 and
            thickness L/100 takes 43 steps instead of 16.)

    Returns:
        The report.

    Raises:
        ValueError: a tolerance or the limit is out of range.
        SolveError: a residual is not finite, a linear solve failed or the limit was reached: the state is then the
            last iterate. Or the line search failed: the state is then the iterate from which it searched.
    """
    checks.whole("max_iterations", max_iterations, 0)
    norm = system.assemble_residual()
    scale = norm if reference is None else checks.not_negative("reference", reference)
    target = max(checks.not_negative("rtol", rtol) * scale, checks.not_negative("atol", atol))
    norms, linear, steps = [norm], list[int](), list[float]()
    while math.isfinite(norm) and norm > target:
        if len(steps) == max_iterations:
            raise SolveError(f"Newton did not converge in {max_iterations} iterations: residuals {norms}")
        system.assemble_tangent()
        increment = system.solve()
        linear.append(int(getattr(system, "iterations", 1)))
        step, norm = _move(system, increment, norm, line_search)
        steps.append(step)
        norms.append(norm)
    if not math.isfinite(norm):
        raise SolveError(f"Newton iteration {len(steps)}: the residual is not finite")
    return NewtonReport(tuple(norms), tuple(linear), tuple(steps))


def _move(system: System, increment: PETSc.Vec, norm: float, line_search: LineSearch | None) -> tuple[float, float]:
    """Step length and residual norm after a step along the increment."""
    if line_search is not None:
        return search(system, increment, norm, line_search)
    system.subtract(increment)
    return 1.0, system.assemble_residual()
