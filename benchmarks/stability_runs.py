"""Cases of ``stability.py``: what one is, how its scene is run, and what comes of it."""

import logging
import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
from load import load_demo
from stability_scenes import box

from coudalfish import (
    CouDALFISh,
    CouplingOptions,
    StepError,
    StepReport,
)
from coudalfish.problems import manufactured as problem
from tigar_x import compat
from tigar_x.fem.linear import direct

TIGHT = CouplingOptions(block_rtol=1e-11, block_atol=1e-13)
HEADER = ("case", "value", "result", "passes mean/max", "observed", "message")
Reports = list[StepReport]
Observed = dict[str, float]


@dataclass(frozen=True)
class Outcome:
    """What a case did at one value.

    Attributes:
        case: its name.
        value: the value.
        result: "ran", "refused" before the first step, or "stopped" by a StepError.
        passes: block passes of every step.
        observed: figures by name.
        message: the warnings and the error that the user sees.
    """

    case: str
    value: Any
    result: str
    passes: tuple[int, ...]
    observed: Mapping[str, float]
    message: str

    @property
    def passes_mean(self) -> float:
        """Mean over the steps."""
        return float(np.mean(self.passes)) if self.passes else math.nan

    @property
    def passes_max(self) -> int:
        """Largest of any step."""
        return max(self.passes, default=0)

    def cells(self) -> tuple[str, ...]:
        """Row of the table, see ``HEADER``."""
        observed = ", ".join(f"{name} {value:.3g}" for name, value in self.observed.items())
        passes = f"{self.passes_mean:.2f}/{self.passes_max}" if self.passes else "-"
        value = f"{self.value:g}" if isinstance(self.value, float) else str(self.value)
        return self.case, value, self.result, passes, observed, self.message or "-"


@dataclass(frozen=True)
class Case:
    """A case: what must hold, the values that the fast tests and the slow ones take, and how to run one."""

    bound: str
    values: tuple[Any, ...]
    slow: tuple[Any, ...]
    run: Callable[[Any], tuple[Reports, Observed]]


CASES: dict[str, Case] = {}


def case(name: str, bound: str, *values: Any, slow: tuple[Any, ...] = ()) -> Callable[[Any], Any]:
    """Enter a function of one value, which gives step reports and figures, as a case."""

    def enter(run: Callable[[Any], tuple[Reports, Observed]]) -> Callable[[Any], tuple[Reports, Observed]]:
        CASES[name] = Case(bound, values, slow, run)
        return run

    return enter


class _Listener(logging.Handler):
    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.said: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.said.append(record.getMessage())


@contextmanager
def listening() -> Iterator[list[str]]:
    """The warnings of the coupling, which are then not shown."""
    log, listener = logging.getLogger("coudalfish"), _Listener()
    before = log.level, log.propagate
    log.addHandler(listener)
    log.setLevel(logging.WARNING)
    log.propagate = False
    try:
        yield listener.said
    finally:
        log.removeHandler(listener)
        log.setLevel(before[0])
        log.propagate = before[1]


@cache
def outcome(name: str, value: Any) -> Outcome:
    """Run a case at one value, once per process."""
    with listening() as said:
        try:
            reports, observed = CASES[name].run(value)
            result = "ran"
        except StepError as error:
            reports, observed, result = [error.report], {"t": error.report.t}, "stopped"
            said[:] = [text for text in said if str(error) not in text] + [str(error)]
        except ValueError as error:
            reports, observed, result = [], {}, "refused"
            said.append(str(error))
    passes = tuple(report.passes for report in reports)
    return Outcome(name, value, result, passes, observed, "; ".join(said))


def advance(fsi: CouDALFISh, steps: int, before: Callable[[int], None] | None = None) -> Reports:
    """Take steps; a state that is accepted although it is not finite is a defect of the library."""
    reports = []
    for n in range(steps):
        if before is not None:
            before(n)
        reports.append(fsi.takeStep())
        for values in (fsi.timeInt_f.x.x.array, fsi.timeInt_sh.x.x.array, fsi.lam):
            if not np.isfinite(values).all():
                raise FloatingPointError(f"step {n} was accepted with values that are not finite")
    return reports


def long_advance(fsi: CouDALFISh, steps: int, chunk: int = 100) -> Reports:
    """Take steps and keep only the last reports, which would take memory themselves."""
    reports: Reports = []
    for _ in range(steps // chunk):
        reports = advance(fsi, chunk)
    return reports


def through_duct(
    scene: SimpleNamespace, steps: int, *, jump: float = 1.0, ramp: int = 1
) -> tuple[Reports, Observed, list[float]]:
    """Load the duct smoothly over ``ramp`` steps; slip, outflow and multiplier, the outflow's rate at every step."""
    fsi, (outflow,) = scene.fsi, compat.compile_forms(scene.outflow)
    dt, rates = fsi.timeInt_f.step_size, []

    def load(n: int) -> None:
        if n:
            rates.append(compat.assemble_scalar(outflow))
        scene.load.value[0] = jump * 0.5 * (1.0 - math.cos(math.pi * min(1.0, (n + 1) / ramp)))

    reports = advance(fsi, steps, load)
    rates.append(compat.assemble_scalar(outflow))
    leak = [report.monitors.leak / scene.length for report in reports if report.monitors]
    observed = {
        "slip": dt * sum(leak),
        "slip rate": leak[-1],
        "outflow": dt * sum(rates),
        "outflow rate": rates[-1],
        "largest speed": fsi.fluid.speed(),
        "lam/jump": float(fsi.lam @ fsi.shell.quadrature.weights) / scene.length / jump,
    }
    return reports, observed, rates


def manufactured(
    level: int,
    options: CouplingOptions | None = None,
    *,
    dt_factor: float = 1.0,
    only: int | None = None,
    **data: float,
) -> tuple[Reports, Observed]:
    """The manufactured problem at a level, all of it or its first steps; errors with quadrature of degree 2."""
    chosen, steps = replace(problem.ProblemData(), **data), round(2 * problem.cells_per_side(level) / dt_factor)
    build = load_demo("manufactured").build
    *_, fsi = build(2, level, steps, options or CouplingOptions(), direct(), projected=False, data=chosen)
    reports = advance(fsi, only or steps)
    return reports, problem.errors(fsi, chosen, fsi.timeInt_f.time, 2)


def energy(scene: SimpleNamespace) -> Callable[[], float]:
    """Kinetic and elastic energy, and that of the multiplier's springs ``sum W lam^2 dt/(2 beta)``."""
    fsi, forms = scene.fsi, [compat.compile_forms(form)[0] for form in scene.energies]
    W = fsi.shell.quadrature.weights

    def total() -> float:
        springs = float((W * fsi.lam**2).sum()) * fsi.timeInt_f.step_size / (2.0 * fsi.penalty)
        return sum(compat.assemble_scalar(form) for form in forms) + springs

    return total


def released(steps: int, options: CouplingOptions | None = None, **scene: Any) -> tuple[Reports, Observed]:
    """The membrane in the closed box; energies relative to the initial one."""
    system = box(options, **({"prestress": 1.0} | scene))
    total = energy(system)
    history = [total()]
    reports = []
    for _ in range(steps):
        reports += advance(system.fsi, 1)
        history.append(total())
    figures = np.array(history) / history[0]
    return reports, {
        "largest rise per step": float(np.diff(figures).max()),
        "largest": float(figures.max()),
        "last": float(figures[-1]),
    }
