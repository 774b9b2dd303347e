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

    run = _Run(system, norm, accepted, asks=callable(atol), line_search=line_search, keep=keep, stalled=stalled)
    while run.goes_on:
        if run.stalls(max_iterations):
            break
        run.renew_tangent()
        if run.goes_on:
            run.step()
    if not math.isfinite(run.norm):
        raise SolveError(f"Newton iteration {len(run.steps)}: the residual is not finite")
    return NewtonReport(tuple(run.norms), tuple(run.linear), tuple(run.steps), run.tangents)


class _Run:
    """One run of Newton's method.

    Args:
        system: the problem, with the residual of its first state.
        norm: norm of that residual.
        accepted: gives the accepted residual.
        asks: whether it is asked again after every tangent and step.
        line_search: see :func:`newton`, as the others.
        keep: see there.
        stalled: see there.

    Attributes:
        norm: of the present residual.
        norms: see :class:`NewtonReport`.
        linear: see there.
        steps: see there.
        tangents: see there.
        goes_on: whether there is something left to do.
    """

    def __init__(
        self,
        system: System,
        norm: float,
        accepted: Callable[[], float],
        *,
        asks: bool,
        line_search: LineSearch | None,
        keep: float | None,
        stalled: float,
    ) -> None:
        self._system, self._accepted, self._asks = system, accepted, asks
        self._line_search, self._keep, self._stalled = line_search, keep, stalled
        self._target, self._ended = accepted(), False
        self._kept = keep is not None and system.has_tangent
        self._lengths: list[float] = []
        self.norm, self.norms, self.tangents = norm, [norm], 0
        self.linear: list[int] = []
        self.steps: list[float] = []

    @property
    def goes_on(self) -> bool:
        return not self._ended and math.isfinite(self.norm) and self.norm > self._target

    def stalls(self, max_iterations: int) -> bool:
        """Whether nothing changes any more, near enough to a solution; SolveError where it is not, or at the limit."""
        if rounding.stagnates(self.norms, self._lengths):
            if not self._is_near:
                raise SolveError(rounding.stagnation(self.norms, self._lengths, self._target))
            log.info("Newton stalls at %.2e of an accepted %.2e", self.norm, self._target)
            return True
        if len(self.steps) == max_iterations:
            raise SolveError(f"Newton did not converge in {max_iterations} iterations: residuals {self.norms}")
        return False

    @property
    def _is_near(self) -> bool:
        return self.norm <= self._stalled * self._target

    def renew_tangent(self) -> None:
        """Assemble the tangent unless the last one still serves."""
        if self._kept:
            return
        self._system.assemble_tangent()
        self.tangents += 1
        if self._asks:
            self._target = self._accepted()

    def step(self) -> None:
        """Solve for an increment and move along it; what a kept tangent cannot do is left to a new one."""
        try:
            increment = self._system.solve()
        except SolveError:
            if not self._kept:
                raise
            self._kept = False
            return
        self.linear.append(int(getattr(self._system, "iterations", 1)))
        length = float(increment.norm())
        try:
            step, new = _move(self._system, increment, self.norm, self._line_search)
        except SolveError:
            if not (self._kept or self._is_near or rounding.is_solved(self._system, self.norms[0], self.norm)):
                raise
            self._stay()
            return
        if self._kept and not new < self.norm:
            increment.scale(-step)
            self._system.subtract(increment)
            step, new = 0.0, self._system.assemble_residual()
        self._accept(step, step * length, new)

    def _stay(self) -> None:
        """No step leads on: a new tangent may, or else rounding ends the run here."""
        self.steps.append(0.0)
        self.norms.append(self.norm)
        if self._kept:
            self._kept, self.norm = False, self._system.assemble_residual()
            return
        log.info("Newton stalls at %.2e of an accepted %.2e", self.norm, self._target)
        self._ended = True

    def _accept(self, step: float, length: float, new: float) -> None:
        """Take down a step and the norm of the residual that it led to."""
        solved = (
            not self._kept and new > rounding.LOWER * self.norm and rounding.is_solved(self._system, self.norms[0], new)
        )
        self._kept = self._keep is not None and new < self._keep * self.norm
        self._lengths.append(length)
        self.steps.append(step)
        self.norms.append(new)
        self.norm = new
        if self._asks and new > self._target:
            self._target = self._accepted()
        if solved:
            log.info("Newton starts at a solution up to rounding: a residual of %.2e", new)
            self._ended = True


def _move(system: System, increment: PETSc.Vec, norm: float, line_search: LineSearch | None) -> tuple[float, float]:
    """Step length and residual norm after a step along the increment."""
    if line_search is not None:
        return search(system, increment, norm, line_search)
    system.subtract(increment)
    return 1.0, system.assemble_residual()
