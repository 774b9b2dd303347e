"""What the steps of a run cost, added up; it goes on with a run that goes on."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from tigar_x.run.progress import Stopwatch, rss_mib

COUNTS = {
    "passes": "block_iterations",
    "iterations": "newton_iterations",
    "linear_iterations": "linear_iterations",
    "tangents": "tangents",
}
"""What reports may count, and what summaries call it."""
SETTLED = 10
"""Number of the step after which memory should not grow."""


class Tally:
    """Counts and costs of a run.

    Args:
        numbers: of the run before a restart, to be gone on from; empty: it is new.

    Attributes:
        numbers: so far, as JSON.
        watch: of the steps in this process.
    """

    def __init__(self, numbers: dict[str, Any]) -> None:
        self.numbers = numbers
        for name in ("intervals", "cuts", "wall_s", "cpu_s"):
            numbers.setdefault(name, 0)
        for name in ("sums", "most"):
            numbers.setdefault(name, {})
        self._spent = numbers["wall_s"], numbers["cpu_s"]
        self.watch = Stopwatch()
        self._steps = 0
        self._memory: dict[str, float] = {}

    def add(self, reports: Sequence[Any], monitors: Sequence[Mapping[str, float]] = ()) -> None:
        """Enter an interval.

        Args:
            reports: of its steps, more than one where steps were cut.
            monitors: numbers >= 0 by name whose largest values matter, of every step; what is below counts as zero.
        """
        n, sums, most = self.numbers, self.numbers["sums"], self.numbers["most"]
        n["intervals"] += 1
        n["cuts"] += len(reports) - 1
        for name in COUNTS:
            counts = [int(getattr(report, name)) for report in reports if hasattr(report, name)]
            if counts:
                sums[name] = sums.get(name, 0) + sum(counts)
                most[name] = max(most.get(name, 0), *counts)
        for numbers in monitors:
            for name, value in numbers.items():
                most[f"{name}_max"] = max(most.get(f"{name}_max", 0.0), float(value))
        n["wall_s"], n["cpu_s"] = self._spent[0] + self.watch.wall_s, self._spent[1] + self.watch.cpu_s
        self._steps += 1
        self._memory["rss_mib_end"] = rss_mib()
        if self._steps <= SETTLED:
            self._memory[f"rss_mib_step_{SETTLED}"] = self._memory["rss_mib_end"]

    def once(self, solve: Callable[[], Any]) -> "Tally":
        """Enter what one solve takes.

        Args:
            solve: returns its report.
        """
        with self.watch:
            report = solve()
        self.add([report])
        return self

    @property
    def cuts(self) -> int:
        """Number of additional steps where steps were cut."""
        return int(self.numbers["cuts"])

    @property
    def wall_s(self) -> float:
        """Wall seconds of the steps, without compilation and output."""
        return float(self.numbers["wall_s"])

    @property
    def cpu_s(self) -> float:
        """CPU seconds of this process in the steps, without compilation and output."""
        return float(self.numbers["cpu_s"])

    def total(self, name: str) -> int:
        """Sum over all steps of what reports count, such as ``passes``."""
        return int(self.numbers["sums"].get(name, 0))

    def mean(self, name: str) -> float:
        """Mean over the intervals of what reports count."""
        return self.total(name) / max(1, self.numbers["intervals"])

    def most(self, name: str) -> int:
        """Largest count of one step."""
        return int(self.numbers["most"].get(name, 0))

    @property
    def monitors(self) -> dict[str, float]:
        """Number of cuts, and the largest value of every monitor as ``name_max``."""
        largest = {name: value for name, value in self.numbers["most"].items() if name not in COUNTS}
        return {"cut_steps": self.cuts, **largest}

    def results(self) -> dict[str, Any]:
        """Counts and costs under the names of summaries; memory is that of this process."""
        found: dict[str, Any] = {}
        for name, called in COUNTS.items():
            if name in self.numbers["sums"]:
                found[f"{called}_mean"] = self.mean(name)
        if "passes" in self.numbers["sums"]:
            found["block_iterations_max"] = self.most("passes")
        return {**found, "wall_s": self.wall_s, "cpu_s": self.cpu_s, **self._memory}

    def __str__(self) -> str:
        counted = [
            f"{self.mean(name):.2f} {called} each"
            for name, called in (("passes", "passes"), ("iterations", "Newton iterations"))
            if name in self.numbers["sums"]
        ]
        cut = [f"{self.cuts} cut"] if self.cuts else []
        return ", ".join([f"{self.numbers['intervals']} steps", f"{self.cpu_s:.4g} CPU s", *counted, *cut])
