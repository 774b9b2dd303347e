"""Static loading in steps that follow the difficulty: cut where Newton fails, grown where it converges easily.

Compare Crisfield, Non-linear Finite Element Analysis of Solids and Structures, vol. 1, Wiley 1991,
section 9.5.
"""

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from mpi4py import MPI

from tigar_x import checks
from tigar_x.compat import FloatArray
from tigar_x.fem.linear import SolveError
from tigar_x.fem.solve import System, newton
from tigar_x.fem.time_integration import LoadStepper
from tigar_x.ranks import agreed

log = logging.getLogger(__name__)

_CUT = 0.5


@dataclass(frozen=True)
class StepControl:
    """When load steps are cut and grown.

    Attributes:
        smallest: size below which no step is cut; unit: pseudo-time.
        largest: size beyond which no step is grown; unit: pseudo-time.
        easy: Newton iterations up to which a step counts as easy.
        growth: factor by which the step after an easy one is larger, unless the easy one had to be cut.

    Raises:
        ValueError: a number is out of range.
    """

    smallest: float = 1e-3
    largest: float = 1.0
    easy: int = 8
    growth: float = 1.5

    def __post_init__(self) -> None:
        checks.positive("smallest", self.smallest)
        if checks.finite("largest", self.largest) < self.smallest:
            raise ValueError(f"largest = {self.largest}: a number >= smallest = {self.smallest} is required")
        checks.whole("easy", self.easy, 0)
        if checks.finite("growth", self.growth) < 1.0:
            raise ValueError(f"growth = {self.growth}: a number >= 1 is required")


@dataclass(frozen=True)
class LoadReport:
    """How a load was reached; one entry per converged step.

    Attributes:
        loads: pseudo-times.
        iterations: Newton iterations; those of attempts that failed are not among them.
        cuts: how often the step had to be cut before it converged.
    """

    loads: tuple[float, ...]
    iterations: tuple[int, ...]
    cuts: tuple[int, ...]


class _Path:
    """Moves a stepper and its unknown to the next pseudo-time, and back to the last accepted state."""

    def __init__(self, stepper: LoadStepper, updates: Sequence[Callable[[float], None]]) -> None:
        self._stepper = stepper
        self._updates = tuple(updates)
        self._step = math.inf
        self._state = self._before = stepper.x.x.array.copy()

    def _set(self, t: float, x: FloatArray) -> None:
        self._stepper.t.value = t
        self._stepper.x.x.array[:] = x
        for update in self._updates:
            update(t)

    def start(self, t: float, *, extrapolate: bool) -> None:
        """Go to the start of an attempt."""
        ahead = (t - self._stepper.time) / self._step if extrapolate else 0.0
        self._set(t, self._state + ahead * (self._state - self._before))

    def accept(self, next_size: float) -> None:
        """Make the present state the last accepted one."""
        t = float(self._stepper.t.value)
        self._before, self._state = self._state, self._stepper.x.x.array.copy()
        self._step = t - self._stepper.time
        self._stepper.advance()
        self._stepper.step_size = next_size
        self._stepper.t.value = t

    def restore(self, next_size: float) -> None:
        """Go back to the last accepted state."""
        self._stepper.step_size = next_size
        self._set(self._stepper.time, self._state)
        self._stepper.x.x.array[:] = self._state


def follow_load(
    system: System,
    stepper: LoadStepper,
    *,
    until: float = 1.0,
    control: StepControl | None = None,
    updates: Sequence[Callable[[float], None]] = (),
    each: Callable[[float], None] | None = None,
    extrapolate: bool = False,
    comm: MPI.Comm = MPI.COMM_SELF,
    **newton_options: Any,
) -> LoadReport:
    """Raise the pseudo-time of a static problem, step by step, each solved by :func:`tigar_x.fem.solve.newton`.

    The first step has the stepper's present size. After the call, failed or not, the stepper's ``t`` and ``time`` are
    both the last load reached, so that forms with ``t`` belong to the state. Its ``step_size`` is what would come next:
    another call goes on from there.

    Args:
        system: the problem; its unknown is that of the stepper.
        stepper: owns the pseudo-time; its ``time`` is the load of the present state.
        until: pseudo-time to reach.
        control: when to cut and grow; None: the defaults of :class:`StepControl`.
        updates: called with the pseudo-time before every attempt, for data that are not UFL expressions of it, such as
            prescribed displacements in the unknown.
        each: called with the pseudo-time after every converged step.
        extrapolate: whether an attempt starts from the last increment, in proportion to the step, added to the last
            state; else from the last state.
        comm: ranks each of which solves the whole problem, on ``MPI.COMM_SELF``, while together they write or the like:
            the steps, states and failures of all are then those of rank 0, for rounding may make others take other
            steps. A distributed problem needs no more than the default.
        newton_options: of :func:`tigar_x.fem.newton.newton`. Without ``reference`` or ``atol`` the accepted residual
            shrinks
            with the step.

    Returns:
        The report.

    Raises:
        ValueError: ``until`` lies behind the present pseudo-time.
        SolveError: a step failed that would be too small if cut; the state is that of the last converged step, exactly.
    """
    checks.having("system", system, "assemble_residual", "a system, such as SplineSystem(spline, residual, tangent),")
    checks.kind("stepper", stepper, LoadStepper, "a LoadStepper")
    control = StepControl() if control is None else control
    if checks.finite("until", until) < stepper.time:
        raise ValueError(f"until = {until}: a number >= the present pseudo-time {stepper.time} is required")
    path = _Path(stepper, updates)
    loads, iterations, cuts = list[float](), list[int](), [0]
    while stepper.time < until:
        left = until - stepper.time
        step = left if left < stepper.step_size + control.smallest else stepper.step_size
        path.start(until if step == left else stepper.time + step, extrapolate=extrapolate)
        try:
            report = agreed(comm, lambda: newton(system, **newton_options), stepper.x.x.array)
        except SolveError as error:
            path.restore(_CUT * step)
            if stepper.step_size < control.smallest:
                raise SolveError(f"loading ended at {stepper.time:g}: a step of {step:g} failed: {error}") from error
            log.info("load %g: a step of %g failed: %s", stepper.time, step, error)
            cuts[-1] += 1
            continue
        iterations.append(len(report.step_lengths))
        easy = iterations[-1] <= control.easy and cuts[-1] == 0
        path.accept(min(control.growth * stepper.step_size, control.largest) if easy else stepper.step_size)
        loads.append(stepper.time)
        cuts.append(0)
        if each is not None:
            each(stepper.time)
    return LoadReport(tuple(loads), tuple(iterations), tuple(cuts[:-1]))
