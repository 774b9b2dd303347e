"""Runs of a coupled problem, see :mod:`tigar_x.run.running`."""

from collections.abc import Callable, Mapping
from typing import Any, Protocol

from coudalfish.intervals import Advanced, advance
from coudalfish.restart import Coupled, CoupledState
from coudalfish.step.report import StepReport
from tigar_x import checks, compat
from tigar_x.run.running import Run


class Stepped(Advanced, Coupled, Protocol):
    """What is asked of a coupled problem that is run, see :class:`coudalfish.coupler.CouDALFISh`."""

    step_size: float


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
        fluid, spline = self._fsi.timeInt_f.x.function_space, self._fsi.spline_sh
        return {"dofs_fluid": compat.unknowns(fluid), "dofs_shell": spline.vector.n}

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
