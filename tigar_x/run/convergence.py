"""Refinement studies: errors on a sequence of meshes, the rates with which they fall, and what they cost."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol, TypeVar, cast

import numpy as np

from tigar_x import checks
from tigar_x.run.figure import axis_label
from tigar_x.run.progress import Stopwatch, peak_rss_mib
from tigar_x.run.summary import table


class Solved(Protocol):
    """What a study asks of a solution."""

    @property
    def unknowns(self) -> int:
        """Number of unknowns."""


S = TypeVar("S", bound=Solved)


@dataclass(frozen=True)
class Level:
    """One mesh of a study.

    Attributes:
        elements: number of elements per direction.
        unknowns: number of unknowns.
        errors: errors by name, positive.
        cpu_s: CPU seconds of the solution, without the compilation of forms.
        wall_s: wall seconds of the same.
        peak_rss_mib: largest resident memory of the process until then [MiB].

    Raises:
        ValueError: an error is not a positive number, or there is no element.
    """

    elements: int
    unknowns: int
    errors: Mapping[str, float]
    cpu_s: float
    wall_s: float
    peak_rss_mib: float

    def __post_init__(self) -> None:
        checks.whole("elements", self.elements, 1)
        for name, error in self.errors.items():
            checks.positive(f"errors[{name!r}]", error)


@dataclass(frozen=True)
class Study:
    """Errors from level to level.

    Attributes:
        levels: from coarse to fine, with the same names of errors.
        expected: rates of theory by name of the error; names may be missing.
        last: how many of the finest levels the rates are fitted to.

    Raises:
        ValueError: fewer than two levels, or ``last`` below two.
    """

    levels: tuple[Level, ...]
    expected: Mapping[str, float]
    last: int = 3

    def __post_init__(self) -> None:
        checks.whole("last", self.last, 2)
        checks.listed("levels", self.levels)
        if len(self.levels) < 2:
            raise ValueError(f"levels has {len(self.levels)} entries: two or more are required")

    @property
    def rates(self) -> dict[str, float]:
        """Rates r of errors C h^r, by least squares in the logarithms."""
        levels = self.levels[-self.last :]
        log_h = -np.log([level.elements for level in levels])
        return {
            name: float(np.polyfit(log_h, np.log([level.errors[name] for level in levels]), 1)[0])
            for name in levels[0].errors
        }

    def table(self) -> str:
        """Text: a line for every level, then the fitted rates and those of theory."""
        rates = self.rates
        rows: list[list[Any]] = [
            [v.elements, v.unknowns, *v.errors.values(), v.cpu_s, v.peak_rss_mib] for v in self.levels
        ]
        rows.append(["rate", "", *(f"{rate:.2f}" for rate in rates.values()), "", ""])
        rows.append(["theory", "", *(f"{self.expected[n]:g}" if n in self.expected else "-" for n in rates), "", ""])
        return table(["elements", "unknowns", *rates, "CPU s", "peak MiB"], rows)

    def results(self) -> dict[str, Any]:
        """Entries of a demo's summary: the finest errors, all levels, rates and costs."""
        finest = self.levels[-1]
        return {
            "errors": finest.errors,
            "rates": self.rates,
            "rates_expected": self.expected,
            "unknowns": finest.unknowns,
            "levels": self.levels,
            "wall_s": sum(level.wall_s for level in self.levels),
            "cpu_s": sum(level.cpu_s for level in self.levels),
        }

    def draw(self, axes: Any, against: Literal["elements", "cpu_s"] = "cpu_s", *, unit: str = "-") -> None:
        """Draw the errors against the number of elements per direction or CPU time, logarithmic.

        Args:
            axes: of matplotlib.
            against: attribute of the levels.
            unit: of the errors; "-" where they are relative or the problem has no dimensions.

        Raises:
            ValueError: another attribute.
        """
        abscissae = {"elements": ("elements per direction", "-"), "cpu_s": ("CPU time", "s")}
        chosen = abscissae[checks.choice("against", against, tuple(abscissae))]
        x = [getattr(level, against) for level in self.levels]
        for name, rate in self.rates.items():
            axes.loglog(x, [level.errors[name] for level in self.levels], "o-", label=f"{name}: rate {rate:.2f}")
        axes.set(xlabel=axis_label(*chosen), ylabel=axis_label("error", unit))
        axes.grid(True, linewidth=0.4)
        axes.legend()


def doubled(elements: int, levels: int) -> tuple[int, ...]:
    """Numbers of elements n, 2 n, 4 n, ... of a sequence of meshes.

    Args:
        elements: number per direction on the coarsest level.
        levels: number of levels, 2 or more.

    Raises:
        ValueError: one of them is out of range.
    """
    first, count = checks.whole("elements", elements, 1), checks.whole("levels", levels, 2)
    return tuple(first * 2**i for i in range(count))


def halved(elements: int, levels: int, *, least: int = 2, multiple: int = 1) -> tuple[int, ...]:
    """Numbers of elements of a sequence of meshes whose last one is given, each half of the next.

    Args:
        elements: number per direction on the finest level.
        levels: number of levels, 1 or more.
        least: smallest number on the coarsest level.
        multiple: what the numbers are multiples of.

    Raises:
        ValueError: one of them is out of range, or the number cannot be halved so often.
    """
    coarsest = 2 ** (checks.whole("levels", levels, 1) - 1)
    if checks.whole("elements", elements, least * coarsest) % (multiple * coarsest):
        raise ValueError(
            f"elements = {elements}: a multiple of {multiple * coarsest} is required for levels = {levels}"
        )
    return tuple(elements // coarsest * 2**k for k in range(levels))


def observed_rates(values: Sequence[Mapping[str, float]]) -> dict[str, float] | None:
    """Rates at which differences between successive meshes fall, from the three finest ones.

    Args:
        values: by name on each mesh, from coarse to fine, each with twice the elements of the one before.

    Returns:
        Rates by name; None where there are less than three meshes.
    """
    if len(values) < 3:
        return None
    steps = np.abs(np.diff([list(one.values()) for one in values[-3:]], axis=0))
    return dict(zip(values[-1], np.log2(steps[0] / steps[1]).tolist(), strict=True))


def refine(
    solve: Callable[[Any], Any],
    errors: Callable[[S], Mapping[str, float]],
    elements: Sequence[int],
    expected: Mapping[str, float],
    prepare: Callable[[int], Any] | None = None,
) -> tuple[Study, S]:
    """Solve on finer and finer meshes; only ``solve`` is timed.

    Args:
        solve: from the number of elements per direction, or from what ``prepare`` makes of it, to a solution. What has
            no unknowns, such as a report, is none: then what was prepared is the solution.
        errors: from the solution to its errors by name.
        elements: numbers per direction from coarse to fine, see :func:`doubled`.
        expected: rates of theory by name of the error.
        prepare: what is not to be timed, such as mesh and forms; None: nothing.

    Returns:
        The study, and the solution on the finest mesh.

    Raises:
        ValueError: fewer than two meshes, or an error that is not a positive number.
    """
    levels: list[Level] = []
    for n in elements:
        watch, problem = Stopwatch(), n if prepare is None else prepare(n)
        with watch:
            found = solve(problem)
        memory, solution = peak_rss_mib(), cast(S, found if hasattr(found, "unknowns") else problem)
        levels.append(Level(n, solution.unknowns, errors(solution), watch.cpu_s, watch.wall_s, memory))
    return Study(tuple(levels), expected), solution
