"""The loop around the steps of a run, as an iterator of their reports; what its body does is the script's.

```python
run = fsi.run(until=0.2, out=out, frames=80, restart=restart, checkpoint_every=500, inputs=inputs,
              series=[partial(VTUSeries, out / "shell", spline, y=y)], history={"leak": "monitors.leak"})
for report in run:
    if run.writes:
        ...                                         # at the steps that the series write
if run.finished:
    run.summary("valve", qoi={"leak": Quantity(run.history["leak"].max())})
```

A run claims its folder and goes on from a checkpoint when it is made, before any step. Whatever can be stepped has a
:class:`tigar_x.run.stepping.Stepper`; ``CouDALFISh.run`` and ``Flow.run`` make theirs.
"""

import logging
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from numbers import Integral
from pathlib import Path
from typing import Any

from mpi4py import MPI

from tigar_x import checks
from tigar_x.ranks import all_come
from tigar_x.run.history import FILE, Columns, History, Recorder
from tigar_x.run.progress import Progress, Termination
from tigar_x.run.restart import Restart
from tigar_x.run.stepping import Stepper, Writes
from tigar_x.run.summary import write_summary
from tigar_x.run.tally import Tally
from tigar_x.run.writing import claim

log = logging.getLogger(__name__)

TOLD = "ended after step %d at t = %.6g, as told%s"
GOES_ON = "; restart = latest goes on from %s"
ENDS = "until = %.6g is no whole number of steps of %.6g away: the run ends at t = %.6g"
SLACK = 1e-9
"""Part of the time between outputs by which a step may come too early for one."""


class Run:
    """A run, which is iterated over once: reports of its steps, the last one of each interval.

    Every interval goes so: step (cut where it fails), columns of the history, series and progress; then the body of the
    loop; then a checkpoint where one is due. Series and files are closed at the end, after a ``break`` and after an
    exception. SIGTERM, SIGUSR1 and Ctrl-C end the run after the interval in progress, with a checkpoint.

    The start is in no series: it is the script's.

    Args:
        stepper: what is stepped.
        until: time at which the run ends: the step nearest to it is the last one.
        steps: number of intervals in all, with those before a restart, instead of ``until``.
        out: folder of the results, which is claimed, see :func:`tigar_x.run.writing.claim`; None: no files.
        every: between outputs by the series, a number of intervals (int) or a time (float); the last interval is
            written in any case. None: 1, unless there are ``frames``.
        frames: number of outputs of the whole run instead, at least; 0: none.
        series: what writes, one or several: objects with ``write(t)``, or functions of ``after`` that make one, such as
            ``partial(VTUSeries, path, spline)``. Only the latter can go on with files of an earlier run, as they are
            called when the folder has been claimed, with the time that the run goes on from (None: it is new).
        measure: called in every step with its new state, for what belongs to the level of the equations;
            ``report.measured`` is what it returned.
        history: columns of ``history.csv`` in ``out``, see :data:`tigar_x.run.history.Columns`; a row an interval.
        restart: checkpoint to go on from: "latest", the number of its step or its file; None or empty: a new run.
        checkpoint_every: number of intervals between checkpoints; 0: none, but where the run is told to end.
        overwrite: whether to delete the results of an earlier run in ``out``.
        inputs: the script's parameters, for checkpoints and summaries.
        show: text of a report for progress lines; None: time, iterations and residuals; False: no lines.

    Attributes:
        step: number of the last accepted interval.
        steps: number of intervals of the whole run; follows the step size.
        after: time from which the run goes on; None: it is new.
        reports: of all steps of the last interval.
        writes: whether the series have written the last interval.
        extra: JSON that checkpoints remember; the script may change it.
        tally: counts and costs, with those before a restart.

    Raises:
        FileExistsError: the folder has results of an earlier run.
        FileNotFoundError: there is no checkpoint to go on from.
        ValueError: an argument is not allowed.
    """

    def __init__(
        self,
        stepper: Stepper,
        *,
        until: float | None = None,
        steps: int | None = None,
        out: Path | str | None = None,
        every: float | None = None,
        frames: int | None = None,
        series: Sequence[Writes | Callable[..., Writes]] | Writes | Callable[..., Writes] = (),
        measure: Callable[[], Any] | None = None,
        history: Columns | None = None,
        restart: str | int | Path | None = None,
        checkpoint_every: int = 0,
        overwrite: bool = False,
        inputs: Mapping[str, Any] | None = None,
        show: Callable[[Any], str] | bool | None = None,
    ) -> None:
        goes_on = restart is not None and restart != ""
        if not (measure is None or callable(measure)):
            raise ValueError(f"measure = {measure!r}: a function is required")
        self._until, self._steps = _end(until, steps)
        self._every, self._frames = _outputs(every, frames)
        self._checkpoint_every = checks.whole("checkpoint_every", checkpoint_every, 0)
        self.out = None if out is None else Path(out)
        if self.out is None and (goes_on or checkpoint_every or overwrite):
            raise ValueError(
                f"out = None: a folder is required with restart = {restart!r}, checkpoint_every = {checkpoint_every}, "
                f"overwrite = {overwrite}"
            )
        series = series if isinstance(series, list | tuple) else (series,)
        for item in series:
            if not (hasattr(item, "write") or callable(item)):
                raise ValueError(f"series: {item!r} can neither write nor be called with after=")
        self._stepper, self._series, self._measure, self._show = stepper, tuple(series), measure, show
        self.inputs = dict(inputs or {})
        self.step, self.after, self._size = 0, None, stepper.step_size
        # what is refused has to be so before results of an earlier run are deleted
        self.steps = 0 if goes_on else self._number_of_steps()
        if history is not None:
            Recorder(history)
        self._restart = self._checkpoints() if goes_on or checkpoint_every else None
        if self.out is not None:
            claim(self.out, overwrite=overwrite, restart=str(restart) if goes_on else "")
        if goes_on and self._restart is not None:
            self._restart.read(restart)  # type: ignore[arg-type]  # it is not None
            self.step, self.after, self._size = self._restart.step, self._restart.after, stepper.step_size
            self.steps = self._number_of_steps()
        self.extra: dict[str, Any] = {} if self._restart is None else dict(self._restart.extra)
        self.tally = Tally(self.extra.pop("tally", {}))
        self.reports: Sequence[Any] = ()
        self.writes = False
        if self._frames is not None:
            self._every = max(1, self.steps // self._frames) if self._frames else None
        path = None if self.out is None else self.out / FILE
        self._recorder = None if history is None else Recorder(history, path, after=self.after)
        self._begun = False
        end = self._stepper.time + (self.steps - self.step) * self._size
        if self._until is not None and abs(end - self._until) > 1e-3 * self._size and MPI.COMM_WORLD.rank == 0:
            log.warning(ENDS, self._until, self._size, end)

    def __repr__(self) -> str:
        return f"Run(step {self.step} of {self.steps}, t = {self._stepper.time:g}, {self.out or 'no files'})"

    # -- how far ------------------------------------------------------------------------------------------------------

    def _number_of_steps(self) -> int:
        if self._steps is not None:
            return self._steps
        until, t = self._until or 0.0, self._stepper.time
        if not self.step and until <= t:
            raise ValueError(f"until = {until!r}: a time later than t = {t:g}, where the run begins, is required")
        return self.step + max(0 if self.step else 1, round((until - t) / self._size))

    def _goes_on(self) -> bool:
        """Whether there is an interval to make, with the present step size."""
        if self._stepper.step_size != self._size:
            self._size = self._stepper.step_size
            self.steps = self._number_of_steps()
        return self.step < self.steps

    def _writes(self, before: float) -> bool:
        """Whether an output is due after an interval that began at a time."""
        if self._every is None:
            return False
        if self.step == self.steps:
            return True
        if isinstance(self._every, Integral):
            return self.step % self._every == 0
        passed = (math.floor(t / self._every + SLACK) for t in (before, self._stepper.time))
        return next(passed) < next(passed)

    @property
    def finished(self) -> bool:
        """Whether all intervals are done; False where the run was told to end, or left."""
        return self.step >= self.steps

    @property
    def history(self) -> History:
        """What has been measured so far, with what was measured before a restart.

        Raises:
            ValueError: the run has no columns.
        """
        if self._recorder is None:
            raise ValueError("history = None: the run was given no columns")
        return self._recorder.history

    # -- the loop -----------------------------------------------------------------------------------------------------

    def __iter__(self) -> Iterator[Any]:
        """Iterate over the reports.

        Raises:
            RuntimeError: the run has been iterated over already.
        """
        if self._begun:
            raise RuntimeError(f"{self!r} has been gone through: make another one to go on")
        self._begun = True
        return self._go()

    def through(self) -> "Run":
        """Go through all steps where the script has nothing to do after each; the run itself."""
        for _ in self:
            pass
        return self

    def _go(self) -> Iterator[Any]:
        with ExitStack() as files:
            try:
                writers = [self._opened(item, files) for item in self._series]
                if self._recorder is not None:
                    files.enter_context(self._recorder)
                with Termination() as told:
                    while self._goes_on():
                        self._interval(writers)
                        yield self.reports[-1]
                        if self._ends(told()):
                            return
            except GeneratorExit:  # a break on all ranks, or an exception in the body, perhaps on one rank alone
                if all_come(MPI.COMM_WORLD):
                    files.close()
                raise

    def _opened(self, item: Any, files: ExitStack) -> Any:
        made = item if hasattr(item, "write") else item(after=self.after)
        if hasattr(made, "__exit__"):
            files.enter_context(made)
        elif hasattr(made, "close"):
            files.callback(made.close)
        return made

    def _interval(self, writers: Sequence[Any]) -> None:
        """Make an interval, and write what is due."""
        stepper, before = self._stepper, self._stepper.time
        with self.tally.watch:
            self.reports = stepper.advance(self._size, self._measure)
        self.step += 1
        self.tally.add(self.reports, [stepper.monitors(report) for report in self.reports])
        report = self.reports[-1]
        if self._recorder is not None:
            self._recorder.record(report)
        self.writes = self._writes(before)
        if self.writes:
            for writer in writers:
                writer.write(report.t)
        self._tell(report)

    def _tell(self, report: Any) -> None:
        if self._show is False:
            return
        text = self._show(report) if callable(self._show) else _in_words(report)
        progress = Progress(self.steps, done=self.step)
        progress.show(text)
        if self.step == self.steps:
            progress.end()

    def _ends(self, told: bool) -> bool:
        """Write a checkpoint where one is due; whether the run is to end."""
        due = self._checkpoint_every and self.step % self._checkpoint_every == 0
        path = self.checkpoint() if self.out is not None and (told or due) else None
        if told and MPI.COMM_WORLD.rank == 0:
            log.info(TOLD, self.step, self._stepper.time, "" if path is None else GOES_ON % path)
        return told

    def _checkpoints(self) -> Restart:
        folder = (self.out or Path()) / "checkpoints"
        return Restart(folder, self._stepper.state(), every=self._checkpoint_every, inputs=self.inputs)

    def checkpoint(self) -> Path:
        """Write a checkpoint of the present step (collective).

        Returns:
            Its file.

        Raises:
            ValueError: the run has no folder, or what :attr:`extra` has is no JSON.
            OSError: it cannot be written; earlier ones stay.
        """
        if self.out is None:
            raise ValueError("out = None: a folder is required for checkpoints")
        if self._restart is None:
            self._restart = self._checkpoints()
        self._restart.step, self._restart.extra = self.step, {**self.extra, "tally": self.tally.numbers}
        return self._restart.write()

    # -- the end ------------------------------------------------------------------------------------------------------

    @property
    def monitors(self) -> dict[str, float]:
        """Largest values of the stepper's monitors, and the number of cut steps."""
        return self.tally.monitors

    def summary(self, name: str, *, monitors: Mapping[str, Any] | None = None, **results: Any) -> dict[str, Any]:
        """Write ``summary.json``: inputs, steps, unknowns, costs and monitors, and what is given (collective).

        Args:
            name: of the run's scene.
            monitors: more of them; they win over the run's.
            results: see :func:`tigar_x.run.summary.write_summary`; they win over the run's.

        Returns:
            The summary.

        Raises:
            ValueError: the run has no folder, or a result is not finite.
        """
        if self.out is None:
            raise ValueError("out = None: a folder is required for a summary")
        own: dict[str, Any] = {"steps": self.step, **self._stepper.sizes, **self.tally.results()}
        every = {**own, "monitors": {**self.monitors, **(monitors or {})}, **results}
        return write_summary(self.out, name, self.inputs, **every)


def _end(until: float | None, steps: int | None) -> tuple[float | None, int | None]:
    if (until is None) == (steps is None):
        raise ValueError(f"until = {until!r}, steps = {steps!r}: one of them is required")
    return (
        None if until is None else checks.finite("until", until),
        None if steps is None else checks.whole("steps", steps, 0),
    )


def _outputs(every: float | None, frames: int | None) -> tuple[float | None, int | None]:
    if every is not None and frames is not None:
        raise ValueError(f"every = {every!r}, frames = {frames!r}: one of them is allowed")
    if frames is not None:
        return None, checks.whole("frames", frames, 0)
    if every is None or isinstance(every, Integral):
        return checks.whole("every", 1 if every is None else every, 1), None
    return checks.positive("every", every), None


def _in_words(report: Any) -> Any:
    """What a progress line says of a report."""
    if hasattr(report, "passes"):
        return report
    counted = f"  iterations {report.iterations}" if hasattr(report, "iterations") else ""
    return f"t = {report.t:.4g}{counted}"
