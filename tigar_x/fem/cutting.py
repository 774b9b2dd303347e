"""Steps that are cut where they fail."""

import logging
from collections.abc import Callable, Sequence
from typing import Any, Protocol, TypeVar

from mpi4py import MPI

from tigar_x import checks

log = logging.getLogger(__name__)
R = TypeVar("R")

CUT = "%s; going on with dt = %g"


class Clock(Protocol):
    """What tells and takes the size of a step."""

    step_size: float

    @property
    def time(self) -> float:
        """Time of the last accepted state."""


def warn(error: Exception, size: float) -> None:
    """Warn once for all ranks of a step that failed, and of the smaller size."""
    if MPI.COMM_WORLD.rank == 0:
        log.warning(CUT, error, size)


def cut_steps(
    take_step: Callable[[], R],
    clocks: Sequence[Clock],
    interval: float,
    failures: Any,
    *,
    first: float | None = None,
    halvings: int = 6,
    tell: Callable[[Exception, float], None] = warn,
) -> list[R]:
    """Advance by an interval in one step or, where steps fail, in smaller ones (collective).

    Args:
        take_step: makes a step, or raises and leaves everything as it was.
        clocks: all that step together; their step size is ``interval`` afterwards. Unit: time.
        interval: time to advance by; unit: time.
        failures: exceptions that mean that a smaller step may help.
        first: size of the first step, where one of the interval has failed already; None: the interval.
        halvings: how often the interval may be halved.
        tell: told of a step that failed and of the smaller step size; by default warns.

    Returns:
        What the steps returned, one of them if none failed.

    Raises:
        Exception: that of the smallest step, if it failed as well; the state is that of the last good step.
        ValueError: a number is out of range.
    """
    smallest = checks.positive("interval", interval) / 2 ** checks.whole("halvings", halvings, 0)
    end, size = clocks[0].time + interval, interval if first is None else checks.positive("first", first)
    done: list[R] = []
    try:
        while (left := end - clocks[0].time) > 1e-9 * interval:
            for clock in clocks:
                clock.step_size = min(size, left)
            try:
                done.append(take_step())
            except failures as error:
                if size / 2 < 0.999 * smallest:
                    raise
                size /= 2
                tell(error, size)
    finally:
        for clock in clocks:
            clock.step_size = interval
    return done
