"""The way of a static problem along its load: what is measured after every load step, files and costs.

```python
path = follow(shell.solve, {"tip": lambda: shell.at("u1").displacement}, step=0.1)
path.history["tip_2"], path.iterations, path.results()
```
"""

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

from tigar_x.fem.load_stepping import LoadReport
from tigar_x.run.history import Columns, History, Recorder
from tigar_x.run.progress import Stopwatch
from tigar_x.run.results import Results


@dataclass(frozen=True)
class LoadPath:
    """How a load was reached.

    Attributes:
        history: what was measured; its times are the load factors, with that at the start.
        report: of all load steps.
        wall_s: wall seconds of the solution without compilation, measurement and output.
        cpu_s: CPU seconds of the same.
    """

    history: History
    report: LoadReport
    wall_s: float
    cpu_s: float

    @property
    def loads(self) -> tuple[float, ...]:
        """Load factors of the states, from the one at the start."""
        return tuple(self.history.t.tolist())

    @property
    def iterations(self) -> int:
        """Newton iterations of all converged steps."""
        return sum(self.report.iterations)

    def final(self, name: str) -> float:
        """Last value of a column."""
        return float(self.history[name][-1])

    def results(self) -> dict[str, Any]:
        """Counts and costs under the names of summaries."""
        counts = {"steps": len(self.report.loads), "newton_iterations": self.iterations, "cuts": sum(self.report.cuts)}
        return {**counts, "wall_s": self.wall_s, "cpu_s": self.cpu_s}


def follow(
    solve: Callable[..., LoadReport],
    columns: Columns,
    *,
    until: Sequence[float] = (1.0,),
    series: Sequence[Any] = (),
    results: Results | None = None,
    each: Callable[[float], Any] | None = None,
    **options: Any,
) -> LoadPath:
    """Raise the load from nothing, and measure after every load step.

    Args:
        solve: raises the load, such as :meth:`shnapr.shell.Shell.solve`: takes ``until``, ``each`` and the options.
        columns: what to measure, see :data:`tigar_x.run.history.Columns`.
        until: load factors to reach, one after the other.
        series: what writes every state after the start, see :class:`tigar_x.run.running.Run`.
        results: of the script, in whose folder history and series go, the latter where it has ``viz``; None: no files.
        each: called with the load factor of every state, after it was measured.
        options: of ``solve``.

    Returns:
        The way.
    """
    watch, extra = Stopwatch(), Stopwatch()
    recorder = Recorder(columns, None if results is None else results.out / "history.csv")
    reports: list[LoadReport] = []
    with ExitStack() as files:
        files.enter_context(recorder)
        shown = series if results is not None and results.viz else ()
        writers = [files.enter_context(item if hasattr(item, "write") else item()) for item in shown]

        def state(t: float) -> None:
            recorder.record(SimpleNamespace(t=t))
            if each is not None:
                each(t)

        def found(t: float) -> None:
            with extra:
                state(t)
                for writer in writers:
                    writer.write(t)

        state(0.0)
        with watch:
            for load in until:
                reports.append(solve(load, each=found, **options))
                options.pop("step", None)  # the next load goes on with the steps as they have become
    parts = (sum((getattr(r, name) for r in reports), ()) for name in ("loads", "iterations", "cuts"))
    costs = watch.wall_s - extra.wall_s, watch.cpu_s - extra.cpu_s
    return LoadPath(recorder.history, LoadReport(*parts), *costs)
