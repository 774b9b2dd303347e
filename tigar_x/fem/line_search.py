"""Line search along a Newton increment.

Increments are subtracted, ``x(s) = x - s dx``. Where the residual R is the gradient of an energy, ``-g(s)`` with
``g(s) = dx . R(x(s))`` is the slope of that energy, and a root of g its extremum along the increment. Source:
Matthies and Strang, doi:10.1002/nme.1620141104.
"""

import math
from dataclasses import dataclass
from typing import Protocol

from petsc4py import PETSc

from tigar_x import checks
from tigar_x.fem.linear import SolveError

_MARGIN = 0.2  # of the interval, that the secant keeps from both ends: g grows with a high power of s in thin shells


@dataclass(frozen=True)
class LineSearch:
    """When a step along the increment is good enough, and how long a shorter one is looked for.

    A step s is accepted when the residual's norm falls or when ``|g(s)| <= reduction |g(0)|``. The full step s = 1 is
    tried first, and costs nothing that Newton's method would not do anyway.

    Attributes:
        reduction: accepted ``|g(s)|/|g(0)|``, from 0 to 1.
        evaluations: residuals assembled in one search, that of the full step included, before it has failed.

    Raises:
        ValueError: a number is out of range.
    """

    reduction: float = 0.5
    evaluations: int = 12

    def __post_init__(self) -> None:
        checks.within("reduction", self.reduction, 0.0, 1.0)
        checks.whole("evaluations", self.evaluations, 1)


class Movable(Protocol):
    """What a line search needs to know of a nonlinear problem."""

    @property
    def b(self) -> PETSc.Vec:
        """Residual of the last assembly."""

    def assemble_residual(self) -> float:
        """Assemble the residual at the present state and return its norm."""

    def subtract(self, increment: PETSc.Vec) -> None:
        """Move the state by minus the increment."""


def search(system: Movable, increment: PETSc.Vec, norm: float, options: LineSearch) -> tuple[float, float]:
    """Move the state by minus an acceptable multiple of the increment.

    Shorter steps come from the secant of g where it changes sign, kept off the ends of the interval, and from halving
    where it does not or where the residual is not finite.

    Args:
        system: the problem, with the residual of the present state in ``system.b``.
        increment: dx; it is used as work space and comes back the same to rounding.
        norm: norm of that residual.
        options: what to accept.

    Returns:
        The step length s and the norm of the residual there, which ``system.b`` now holds.

    Raises:
        SolveError: no step was accepted; the state is then where it began, to rounding.
    """
    slope_0 = increment.dot(system.b)
    low, high = (0.0, slope_0), (1.0, math.nan)
    at, step = 0.0, 1.0
    for _ in range(options.evaluations):
        _move(system, increment, step - at)
        at = step
        trial = system.assemble_residual()
        slope = increment.dot(system.b) if math.isfinite(trial) else math.nan
        if trial < norm or abs(slope) <= options.reduction * abs(slope_0):
            return step, trial
        if low[1] * slope > 0.0 > low[1] * high[1]:
            low = step, slope
        else:
            high = step, slope
        step = _between(low, high)
    _move(system, increment, -at)
    raise SolveError(f"line search: no step length from 1 to {at:.1e} reduces the residual {norm:.3e}")


def _move(system: Movable, increment: PETSc.Vec, distance: float) -> None:
    """Subtract a multiple of the increment, which needs no second vector."""
    increment.scale(distance)
    system.subtract(increment)
    increment.scale(1.0 / distance)


def _between(low: tuple[float, float], high: tuple[float, float]) -> float:
    """Next step between two pairs (s, g(s)): the middle, or nearer to the secant's root when g changes sign."""
    (a, g_a), (b, g_b) = low, high
    if not (math.isfinite(g_b) and g_a * g_b < 0.0):
        return 0.5 * (a + b)
    root = g_a / (g_a - g_b)
    return a + (b - a) * min(max(root, _MARGIN), 1.0 - _MARGIN)
