"""What a run asks of whatever it steps, and what answers for a flow or a shell alone."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

from tigar_x import checks
from tigar_x.fem.cutting import cut_steps, warn
from tigar_x.fem.time_integration import TimeIntegrator
from tigar_x.run.restart import Integrators, State


class Writes(Protocol):
    """A series of files, which writes the present state; it is closed at the end where it can be."""

    def write(self, t: float) -> None:
        """Write the present state at time ``t``."""


class Stepper(Protocol):
    """What can be stepped through time."""

    @property
    def time(self) -> float:
        """Time of the last accepted state."""

    @property
    def step_size(self) -> float:
        """Size of a step."""

    @property
    def sizes(self) -> Mapping[str, int]:
        """Numbers of unknowns by the names that summaries give them."""

    def advance(self, interval: float, measure: Callable[[], Any] | None) -> Sequence[Any]:
        """Advance by an interval, in one step or, where steps fail, in smaller ones.

        Args:
            interval: time to advance by.
            measure: called in every step with its new state, before the clock moves.

        Returns:
            Reports of the steps; each has its time ``t``, and what :mod:`tigar_x.run.tally` counts where it counts it.
        """

    def monitors(self, report: Any) -> Mapping[str, float]:
        """Numbers of a step whose largest values matter, by name."""

    def state(self) -> State:
        """What further steps follow from."""


class IntegratorStepper:
    """Steps of what has one verb and its integrators, such as a flow or a shell alone.

    Args:
        take_step: makes a step, with what is measured in it, or raises and leaves everything as it was.
        failures: exceptions that mean that a smaller step may help.
        halvings: how often a step may be halved.
        sizes: numbers of unknowns by the names that summaries give them.
        integrators: all that it advances, by the names that checkpoints give them; the first one has the clock.

    Attributes:
        sizes: as given.
    """

    def __init__(
        self,
        take_step: Callable[[Callable[[], Any] | None], Any],
        failures: Any,
        *,
        halvings: int = 6,
        sizes: Mapping[str, int] | None = None,
        **integrators: TimeIntegrator,
    ) -> None:
        self._take_step, self._failures = take_step, failures
        self._halvings = checks.whole("halvings", halvings, 0)
        self.sizes = dict(sizes or {})
        self._integrators, self._clocks = integrators, tuple(integrators.values())

    @property
    def time(self) -> float:
        """Time of the last accepted state."""
        return self._clocks[0].time

    @property
    def step_size(self) -> float:
        """Size of a step."""
        return self._clocks[0].step_size

    def advance(self, interval: float, measure: Callable[[], Any] | None) -> Sequence[Any]:
        """Advance by an interval, which is the step size; a step that does not fail leaves the clocks alone."""

        def take_step() -> Any:
            return self._take_step(measure)

        try:
            return [take_step()]
        except self._failures as error:
            if not self._halvings:
                raise
            warn(error, interval / 2)
        clocks, failures, halvings = self._clocks, self._failures, self._halvings
        return cut_steps(take_step, clocks, interval, failures, first=interval / 2, halvings=halvings)

    def monitors(self, _: Any) -> Mapping[str, float]:
        """None."""
        return {}

    def state(self) -> Integrators:
        """What further steps follow from."""
        return Integrators(**self._integrators)
