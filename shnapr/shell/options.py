"""How a shell is solved, what a step reports, and how one fails."""

from dataclasses import dataclass
from typing import Any

from tigar_x import checks
from tigar_x.fem.line_search import LineSearch
from tigar_x.splines.spline_system import SplineSystem

STALLED = 1e3
"""Multiple of the accepted residual that is accepted as well where rounding keeps Newton's method from going on."""


class ShellError(RuntimeError):
    """A step or a static solve that failed.

    After a step the shell is in the state before it; after a static solve in the last equilibrium that was found.

    Attributes:
        t: time of the step that failed; statics: load factor of the state.
    """

    def __init__(self, message: str, t: float) -> None:
        super().__init__(message)
        self.t = t


@dataclass(frozen=True)
class ShellOptions:
    """How Newton's method solves for a shell.

    Attributes:
        rtol: accepted residual, relative to the first one of a step; in statics to that of the full load on the
            undeformed shell.
        atol: accepted residual; None: what rounding leaves. Unit: force (per depth in the plane).
        max_iterations: after which a step has failed.
        line_search: shortens steps that make things worse; None: full steps, see :func:`tigar_x.fem.newton.newton`.
        keep: see there; None: every iteration has a new tangent.

    Raises:
        ValueError: a number is out of range.
    """

    rtol: float = 1e-8
    atol: float | None = None
    max_iterations: int = 30
    line_search: LineSearch | None = None
    keep: float | None = None

    def __post_init__(self) -> None:
        checks.not_negative("rtol", self.rtol)
        if self.atol is not None:
            checks.not_negative("atol", self.atol)
        checks.whole("max_iterations", self.max_iterations, 1)
        if self.keep is not None:
            checks.within("keep", self.keep, 0.0, 1.0)


@dataclass(frozen=True)
class ShellReport:
    """What a step did.

    Attributes:
        t: end of the step, to which positions and velocities belong.
        t_alpha: time at which the equations hold, to which forces of supports and contact belong.
        residuals: norms of the residual, from the first to the accepted one; unit: force.
        tangents: number of tangents that were assembled.
        measured: what the step's ``measure`` returned.
    """

    t: float
    t_alpha: float
    residuals: tuple[float, ...]
    tangents: int
    measured: Any = None

    @property
    def iterations(self) -> int:
        """Number of Newton iterations."""
        return len(self.residuals) - 1


def newton_options(options: ShellOptions, system: SplineSystem) -> dict[str, Any]:
    """Options of :func:`tigar_x.fem.newton.newton` for a system."""
    atol = system.rounding if options.atol is None else options.atol
    return vars(options) | {"atol": atol, "stalled": STALLED}
