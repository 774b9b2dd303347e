"""Coupled problems over many steps: intervals in which steps are cut where they fail, and whole runs."""

from collections.abc import Callable, Mapping
from typing import Any, Protocol

from coudalfish.restart import Coupled, CoupledState
from coudalfish.step.report import StepError, StepReport
from tigar_x import checks
from tigar_x.fem.time_integration import TimeIntegrator
from tigar_x.run.running import Run
from tigar_x.run.stepping import CUT, cut_steps


class Stepped(Coupled, Protocol):
    """What is asked of a coupled problem to be stepped, see :class:`coudalfish.coupler.CouDALFISh`."""

    step_size: float
    watch: Any

    @property
    def integrators(self) -> tuple[TimeIntegrator, ...]:
        """All that advance together; the first one has the clock."""

    def takeStep(self, measure: Callable[[], Any] | None = None) -> StepReport:
        """Advance by one time step, or raise StepError."""


def advance(
    fsi: Stepped, interval: float, *, halvings: int = 6, measure: Callable[[], Any] | None = None
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

    def tell(error: Exception, size: float) -> None:
        fsi.watch.warn_once("cut", CUT, error, size)

    return cut_steps(lambda: fsi.takeStep(measure), fsi.integrators, interval, StepError, halvings=halvings, tell=tell)


class CoupledStepper:
    """What a run asks of a coupled problem.

    Args:
        fsi: what is coupled.
        halvings: how often a step that fails may be halved.

    Raises:
        ValueError: a number is out of range.
    """

    def __init__(self, fsi: Stepped, halvings: int = 6) -> None:
        self._fsi = fsi
        self._halvings = checks.whole("halvings", halvings, 0)

    @property
    def time(self) -> float:
        """Time of the last accepted state."""
        return self._fsi.timeInt_f.time

    @property
    def step_size(self) -> float:
        """Step size of fluid and shell."""
        return self._fsi.step_size

    @property
    def sizes(self) -> dict[str, int]:
        """Unknowns of the fluid, and coefficients of the shell."""
        dofmap, spline = self._fsi.timeInt_f.x.function_space.dofmap, self._fsi.spline_sh
        fluid = dofmap.index_map.size_global * dofmap.index_map_bs
        return {"dofs_fluid": int(fluid), "dofs_shell": int(spline.geometry.n * spline.nsd)}

    def advance(self, interval: float, measure: Callable[[], Any] | None) -> list[StepReport]:
        """Advance by an interval, see :func:`advance`."""
        return advance(self._fsi, interval, halvings=self._halvings, measure=measure)

    def monitors(self, report: StepReport) -> Mapping[str, float]:
        """Slip, leak, imbalance of forces, and the closing ratio of contact."""
        m = report.monitors
        found = {"slip_ratio": report.slip_ratio}
        if m is not None:
            found |= {"normal_slip": m.normal_slip_max, "leak": abs(m.leak), "force_imbalance": m.force_imbalance}
        return found if report.contact is None else {**found, "closing_ratio": report.contact.closing_ratio}

    def state(self) -> CoupledState:
        """What the further steps follow from."""
        return CoupledState(self._fsi)


def run(fsi: Stepped, *, halvings: int = 6, **options: Any) -> Run:
    """A run of a coupled problem.

    Args:
        fsi: what is coupled.
        halvings: how often a step that fails may be halved.
        options: see :class:`tigar_x.run.running.Run`.
    """
    return Run(CoupledStepper(fsi, halvings), **options)
