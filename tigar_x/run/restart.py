"""Runs of many steps that go on where they ended, were ended or were killed.

```python
claim(out, restart=restart)                         # refuses the results of an earlier run, see tigar_x.run.writing
run = Restart(out / "checkpoints", Integrators(flow=flow.time), every=100, inputs=inputs)
if restart:
    run.read(restart)                               # "latest", a number or a file
peaks = run.extra.setdefault("peaks", [])           # what the script wants remembered
with CSVSeries(out / "history.csv", columns, after=run.after) as history:
    for _ in run.steps(script.Progress(steps, done=run.step)):
        history.write(flow.take_step().t, ...)
if run.step < steps:                                # told to end; a checkpoint has been written
    return
```
"""

import json
import logging
import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, Protocol

from mpi4py import MPI
from dolfinx import fem

from tigar_x import checks
from tigar_x.fem.time_integration import TimeIntegrator
from tigar_x.ranks import on_root
from tigar_x.run.checkpoint import Checkpoints
from tigar_x.run.progress import Termination
from tigar_x.run.summary import plain, versions

log = logging.getLogger(__name__)

ABSENT = "absent"
"""What a setting is that was not there."""
KEEPS = "%s goes on with its dt = %g, not %g; assign to change it"
ENDED = "ended after step %d at t = %.6g, as told; restart = latest goes on from %s"
OLD = "{} has checkpoints of an earlier run, up to step {}: go on from one (restart = latest), or take another folder"


class State(Protocol):
    """What the further steps of a run follow from.

    Attributes:
        fields: functions by name.
        settings: what a run should go on with as it began, as JSON; differences are warned of.
        time: time of the last accepted state.
    """

    @property
    def fields(self) -> Mapping[str, fem.Function]:
        """See the class."""

    @property
    def settings(self) -> Mapping[str, Any]:
        """See the class."""

    @property
    def time(self) -> float:
        """See the class."""

    def record(self) -> dict[str, Any]:
        """Bring the fields up to date; what is not in them, as JSON."""

    def check(self, record: Mapping[str, Any]) -> None:
        """Raise ValueError where a record cannot be that of this state."""

    def resume(self, record: Mapping[str, Any]) -> None:
        """Take over the fields, which have been read, and the record."""


class Integrators:
    """The state of time integrators that step together.

    Args:
        integrators: by name.
    """

    def __init__(self, **integrators: TimeIntegrator) -> None:
        if not integrators:
            raise ValueError("integrators: at least one is required")
        self._integrators = integrators

    @property
    def fields(self) -> dict[str, fem.Function]:
        """x_n and its rates, by the name of the integrator and their own."""
        return {f"{name}.{key}": f for name, time in self._integrators.items() for key, f in time.state.items()}

    @property
    def settings(self) -> dict[str, Any]:
        """Schemes."""
        return {"schemes": {name: asdict(time.scheme) for name, time in self._integrators.items()}}

    @property
    def time(self) -> float:
        """Time t_n of the last accepted state."""
        return next(iter(self._integrators.values())).time

    def record(self) -> dict[str, Any]:
        """Times and step sizes."""
        return {"clocks": {name: [time.time, time.step_size] for name, time in self._integrators.items()}}

    def check(self, record: Mapping[str, Any]) -> None:
        """All integrators are known by their fields."""

    def resume(self, record: Mapping[str, Any]) -> None:
        """Set the clocks, with the step sizes of the record, and x to x_n."""
        for name, time in self._integrators.items():
            t, dt = record["clocks"][name]
            if not math.isclose(dt, time.step_size):
                _tell(logging.WARNING, KEEPS, name, dt, time.step_size)
            time.resume(t, dt)


class Restart:
    """Writes the checkpoints of a run and goes on from one (collective).

    Args:
        folder: where the checkpoints are; made with the first one.
        state: of the run.
        every: number of steps between checkpoints; 0: none, but where the run is told to end.
        keep: number of checkpoints to keep.
        inputs: the script's parameters, as JSON; where a run goes on with others, a warning names them, as it does
            other settings of the state and other versions of the libraries.

    Attributes:
        step: number of the last accepted step.
        after: time from which the run goes on, for output that is continued; None: the run is new.
        extra: JSON that the script wants remembered; it may change it at any time.

    Raises:
        ValueError: a number is out of range, a field cannot be stored, or the inputs are no JSON.
    """

    def __init__(
        self,
        folder: Path | str,
        state: State,
        *,
        every: int = 0,
        keep: int = 2,
        inputs: Mapping[str, Any] | None = None,
    ) -> None:
        checks.having("state", state, "fields settings time record check", "Integrators, CoupledState or the like")
        self.every = checks.whole("every", every, 0)
        self.state = state
        self.inputs = plain(dict(inputs or {}))
        try:
            json.dumps(self.inputs, allow_nan=False)
        except (TypeError, ValueError) as error:
            raise ValueError(f"inputs = {self.inputs!r}: finite JSON is required ({error})") from error
        self.checkpoints = Checkpoints(folder, state.fields, keep=keep)
        self.step = 0
        self.after: float | None = None
        self.extra: dict[str, Any] = {}
        self._begun = False

    @property
    def _settings(self) -> dict[str, Any]:
        return {"inputs": self.inputs, "versions": versions(), **plain(dict(self.state.settings))}

    def write(self) -> Path:
        """Write a checkpoint of the present step.

        Returns:
            Its file.

        Raises:
            FileExistsError: the run is new, and the folder has checkpoints of an earlier one.
            OSError: it cannot be written; earlier ones stay.
            ValueError: ``extra`` is no JSON.
        """
        self._begin()
        record = {"state": self.state.record(), "settings": self._settings, "extra": self.extra}
        return self.checkpoints.write(self.step, record)

    def read(self, which: int | str | Path = "latest") -> None:
        """Go on from a checkpoint: sets the state, ``step``, ``after`` and ``extra``.

        Args:
            which: "latest", a step number or a file, see :meth:`tigar_x.run.checkpoint.Checkpoints.find`.

        Raises:
            FileNotFoundError: there is none.
            ValueError: it cannot be read or belongs to another run; the state stays as it was.
        """
        found = self.checkpoints.find(which)
        record = found.record
        self.state.check(record["state"])
        self.checkpoints.restore(found)
        for text in _differences(record["settings"], self._settings):
            _tell(logging.WARNING, "%s was written with %s", found.path, text)
        self.state.resume(record["state"])
        self.step, self.extra, self.after = found.number, record["extra"], self.state.time
        _tell(logging.INFO, "going on after step %d at t = %.6g from %s", self.step, self.after, found.path)

    def steps(self, numbers: Iterable[int]) -> Iterator[int]:
        """Numbers of steps, which the loop's body makes; writes checkpoints between them.

        A run that is told to end (:class:`tigar_x.run.progress.Termination`) gets a checkpoint and no further numbers.

        Args:
            numbers: of the steps to make, the first one ``step + 1``.

        Raises:
            FileExistsError: on all ranks: the run is new, and the folder has checkpoints of an earlier one.
        """
        self._begin()
        with Termination() as asked:
            for number in numbers:
                yield number
                self.step = number
                ends = asked()
                if ends or (self.every and number % self.every == 0):
                    path = self.write()
                if ends:
                    _tell(logging.INFO, ENDED, number, self.state.time, path)
                    return

    def _begin(self) -> None:
        """Refuse to replace the checkpoints of another run."""

        def check() -> None:
            if old := self.checkpoints.numbers():
                raise FileExistsError(OLD.format(self.checkpoints.folder, old[0]))

        if not self._begun and self.after is None:
            on_root(MPI.COMM_WORLD, check)
        self._begun = True

    def named(self, path: Path | str) -> Path:
        """Name of a file that cannot be continued: with the step after which a run goes on."""
        path = Path(path)
        return path if self.after is None else path.with_name(f"{path.stem}_{self.step:06d}{path.suffix}")


def _tell(level: int, message: str, *values: Any) -> None:
    """Log once for all ranks."""
    if MPI.COMM_WORLD.rank == 0:
        log.log(level, message, *values)


def _differences(found: Any, present: Any, name: str = "") -> Iterator[str]:
    """Settings that differ, in words."""
    if isinstance(found, dict) and isinstance(present, dict):
        for key in sorted({*found, *present}):
            yield from _differences(found.get(key, ABSENT), present.get(key, ABSENT), f"{name}.{key}" if name else key)
    elif found != present:
        yield f"{name} = {found!r}, now it is {present!r}"
