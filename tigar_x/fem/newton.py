"""The one Newton loop, which keeps tangents while they serve.

Increments are subtracted throughout: ``K dx = R``, ``x <- x - dx``.
"""

import logging
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from petsc4py import PETSc

from tigar_x import checks
from tigar_x.fem import rounding
from tigar_x.fem.line_search import LineSearch, Movable, search
from tigar_x.fem.linear import SolveError

log = logging.getLogger(__name__)


class System(Movable, Protocol):
    """What the Newton loop needs to know of a nonlinear problem; only a line search looks at the residual itself."""

    @property
    def has_tangent(self) -> bool:
        """Whether a tangent has been assembled; only asked for where tangents are kept."""

    def assemble_tangent(self) -> None:
        """Assemble the tangent at the present state."""

    def solve(self) -> PETSc.Vec:
        """Solve for the increment of the present residual."""


@dataclass(frozen=True)
class NewtonReport:
    """What a Newton solve did.

    Attributes:
        norms: residual norms, from the initial one to the accepted one.
        linear_iterations: iterations of the linear solver, one entry per step.
        step_lengths: multiples of the increments that were subtracted, one entry per step; 1 without a line search, 0
            where a kept tangent made things worse.
        tangents: number of tangents that were assembled.
    """

    norms: tuple[float, ...]
    linear_iterations: tuple[int, ...]
    step_lengths: tuple[float, ...]
    tangents: int


def newton(
    system: System,
    *,
    rtol: float = 1e-5,
    atol: float | Callable[[], float] = 0.0,
    max_iterations: int = 20,
    reference: float | Callable[[], float] | None = None,
    line_search: LineSearch | None = None,
    keep: float | None = None,
    stalled: float = 1.0,
) -> NewtonReport:
    """Newton's method; the residual is tested before every solve.

    Args:
        system: the problem.
        rtol: accepted residual relative to ``reference``.
        atol: accepted residual, in the residual's unit, or a function that gives it, which is asked again after every
            tangent and step.
        max_iterations: solves after which the iteration has failed.
        reference: norm that ``rtol`` refers to, or a function that gives it, which is asked once the first residual is
            assembled; None: the initial residual. A start that is nearly a solution needs one, or ``atol``: rounding
            keeps the residual from falling far below its initial value. A start so near that rounding leaves half of
            the digits or less is accepted at the system's ``rounding()``, if it has one, where no step improves it.
        line_search: shortens steps that make things worse; None: full steps. It widens what converges, but slows what
            converges over a passing rise of the residual: thin shells. (An elastica with P L^2/(E I) = 4 and
            thickness L/100 takes 43 steps instead of 16.)
        keep: a tangent, with its factors, is kept from step to step, and from the last call, while every step with it
            reduces the residual at least by this factor in (0, 1). A step that makes things worse is taken back. None:
            a new tangent for every step.
        stalled: multiple of the accepted residual that is accepted as well where the line search finds nothing better
            or iterations change nothing: rounding ends there what the tolerances ask for. (Their limit stays an error.)

    Returns:
        The report.

    Raises:
        ValueError: a tolerance or the limit is out of range.
        SolveError: a residual is not finite, a linear solve failed, the limit was reached or iterations change nothing
            any more: the state is then the last iterate. Or the line search failed: the state is then the iterate from
            which it searched.
    """
    checks.whole("max_iterations", max_iterations, 0)
    if keep is not None:
        checks.within("keep", keep, 0.0, 1.0)
    norm = system.assemble_residual()
    scale = norm
    if reference is not None and math.isfinite(norm):
        scale = checks.not_negative("reference", reference() if callable(reference) else reference)
    checks.not_negative("rtol", rtol)

    def accepted() -> float:
        return max(rtol * scale, checks.not_negative("atol", atol() if callable(atol) else atol))

    target = accepted()
    norms, linear, steps, tangents, lengths = [norm], list[int](), list[float](), 0, list[float]()
    kept = keep is not None and system.has_tangent
    while math.isfinite(norm) and norm > target:
        if rounding.stagnates(norms, lengths):
            if norm <= stalled * target:
                log.info("Newton stalls at %.2e of an accepted %.2e", norm, target)
                break
            raise SolveError(rounding.stagnation(norms, lengths, target))
        if len(steps) == max_iterations:
            raise SolveError(f"Newton did not converge in {max_iterations} iterations: residuals {norms}")
        if not kept:
            system.assemble_tangent()
            tangents += 1
            if callable(atol):
                target = accepted()
                if norm <= target:
                    break
        try:
            increment = system.solve()
        except SolveError:
            if not kept:
                raise
            kept = False
            continue
        linear.append(int(getattr(system, "iterations", 1)))
        length = float(increment.norm())
        try:
            step, new = _move(system, increment, norm, line_search)
        except SolveError:
            if not (kept or norm <= stalled * target or rounding.is_solved(system, norms[0], norm)):
                raise
            steps.append(0.0)
            norms.append(norm)
            if not kept:
                log.info("Newton stalls at %.2e of an accepted %.2e", norm, target)
                break
            kept, norm = False, system.assemble_residual()
            continue
        if kept and not new < norm:
            increment.scale(-step)
            system.subtract(increment)
            step, new = 0.0, system.assemble_residual()
        solved = not kept and new > rounding.LOWER * norm and rounding.is_solved(system, norms[0], new)
        kept = keep is not None and new < keep * norm
        lengths.append(step * length)
        steps.append(step)
        norms.append(new)
        norm = new
        if callable(atol) and norm > target:
            target = accepted()
        if solved:
            log.info("Newton starts at a solution up to rounding: a residual of %.2e", norm)
            break
    if not math.isfinite(norm):
        raise SolveError(f"Newton iteration {len(steps)}: the residual is not finite")
    return NewtonReport(tuple(norms), tuple(linear), tuple(steps), tangents)


def _move(system: System, increment: PETSc.Vec, norm: float, line_search: LineSearch | None) -> tuple[float, float]:
    """Step length and residual norm after a step along the increment."""
    if line_search is not None:
        return search(system, increment, norm, line_search)
    system.subtract(increment)
    return 1.0, system.assemble_residual()
