"""Intervals of a coupled problem in which steps are cut where they fail."""

from collections.abc import Callable
from typing import Any, Protocol

from coudalfish.step.report import StepError, StepReport
from tigar_x import checks
from tigar_x.fem.cutting import CUT, cut_steps
from tigar_x.fem.time_integration import TimeIntegrator


class Advanced(Protocol):
    """What is asked of a coupled problem that is advanced, see :class:`coudalfish.coupler.CouDALFISh`."""

    watch: Any

    @property
    def integrators(self) -> tuple[TimeIntegrator, ...]:
        """All that advance together; the first one has the clock."""

    def takeStep(self, measure: Callable[[], Any] | None = None) -> StepReport:
        """Advance by one time step, or raise StepError."""


def advance(
    fsi: Advanced, interval: float, *, halvings: int = 6, measure: Callable[[], Any] | None = None
) -> list[StepReport]:
    """Advance by an interval in one step or, where steps fail, in smaller ones.

    Args:
        fsi: what is coupled; its step size is ``interval`` afterwards.
        interval: time to advance by; unit: time.
        halvings: how often the step may be halved.
        measure: called in every step with the new state before the clocks move.

    Returns:
        The reports of the steps, one if none failed.

    Raises:
        StepError: the smallest step failed as well; the state is that of the last good step.
        ValueError: a number is out of range.
    """
    checks.having("fsi", fsi, "takeStep integrators watch", "CouDALFISh(fluid, shell)")

    def tell(error: Exception, size: float) -> None:
        fsi.watch.warn_once("cut", CUT, error, size)

    return cut_steps(lambda: fsi.takeStep(measure), fsi.integrators, interval, StepError, halvings=halvings, tell=tell)
