"""Histories: what a run measures after every step, as a file while it goes and as an object.

```python
past = History.read(out / "history.csv")            # on all ranks; or run.history, see tigar_x.run.running
past["lift"].max()
past.course("lift", "t_alpha").last(share=0.4).frequency()
```
"""

import csv
import inspect
from array import array
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import ufl
from mpi4py import MPI

from tigar_x import checks
from tigar_x.compat import FloatArray
from tigar_x.ranks import first, on_root
from tigar_x.run.course import Course
from tigar_x.run.output import ClosesFiles, CSVSeries, check_writable, is_later

FILE = "history.csv"
"""Name of the file of a run's history."""

Column = Callable[..., Any] | str
Columns = Mapping[Any, Column]
"""By name, or by names of the entries of a vector: a function of the report or of nothing, or the dotted name of what
the report has. It gives a number, a vector or, whatever it is called, numbers and vectors by name."""


class History:
    """Quantities at the times of a run.

    Args:
        names: of the columns after the time.
        rows: time and values, shape (times, 1 + columns).

    Attributes:
        names: as given.
        rows: as given.

    Raises:
        ValueError: names and rows do not fit.
    """

    def __init__(self, names: Sequence[str], rows: FloatArray) -> None:
        self.names = tuple(names)
        self.rows = np.asarray(rows, dtype=float)
        if self.rows.ndim != 2 or self.rows.shape[1] != 1 + len(self.names):
            raise ValueError(f"rows has shape {self.rows.shape}: (times, {1 + len(self.names)}) is required")

    @classmethod
    def read(cls, path: Path | str) -> "History":
        """Read what :class:`tigar_x.run.output.CSVSeries` has written (collective).

        Args:
            path: of the file, or the folder of a run, which has it as ``history.csv``.

        Raises:
            OSError: on all ranks: the file cannot be read.
            ValueError: on all ranks: it is no history of numbers.
        """
        return cls(*first(MPI.COMM_WORLD, on_root(MPI.COMM_WORLD, lambda: _read(Path(path)))))  # type: ignore[misc]

    def __getitem__(self, name: str) -> FloatArray:
        """Values of a column, shape (times,).

        Raises:
            KeyError: there is none of this name.
        """
        if name == "t":
            return self.rows[:, 0]
        if f"{name}_1" in self.names and name not in self.names:
            raise KeyError(f"{name!r} is a vector: vector({name!r}), or one of its columns {name}_1, {name}_2, ...")
        if name not in self.names:
            raise KeyError(f"{name!r}: one of {('t', *self.names)} is required")
        return self.rows[:, 1 + self.names.index(name)]

    def __contains__(self, name: object) -> bool:
        return name == "t" or name in self.names

    def __iter__(self) -> Iterator[str]:
        return iter(("t", *self.names))

    def __len__(self) -> int:
        return len(self.rows)

    def __repr__(self) -> str:
        span = f", t = {self.t[0]:g} to {self.t[-1]:g}" if len(self) else ""
        return f"History({len(self)} times{span}; {', '.join(self.names)})"

    @property
    def t(self) -> FloatArray:
        """Times, shape (times,)."""
        return self.rows[:, 0]

    def vector(self, name: str) -> FloatArray:
        """The columns ``name_1``, ``name_2``, ... of a vector, shape (times, components)."""
        names = [
            column for column in self.names if column.rpartition("_")[0] == name and column.rpartition("_")[2].isdigit()
        ]
        return np.stack([self[column] for column in names], axis=1) if names else self[name][:, None]

    def course(self, name: str, t: str = "t") -> Course:
        """A column over time.

        Args:
            name: of the column.
            t: column of its times, such as ``t_alpha`` for what belongs to the level of the equations.
        """
        return Course(self[t], self[name])

    def since(self, t: float) -> "History":
        """The rows from a time on."""
        return History(self.names, self.rows[self.t >= t])

    def until(self, t: float) -> "History":
        """The rows up to a time."""
        return History(self.names, self.rows[[not is_later(float(row[0]), t) for row in self.rows]])


def _read(path: Path) -> tuple[list[str], FloatArray]:
    path = path / FILE if path.is_dir() else path
    with open(path, newline="") as file:
        rows = [row for row in csv.reader(file) if row]
    if not rows or rows[0][0] != "t":
        raise ValueError(f"{path}: not a history: a first line that begins with t is required")
    try:
        numbers = [[float(value) for value in row] for row in rows[1:]]
        return rows[0][1:], np.array(numbers).reshape(-1, len(rows[0]))
    except ValueError as error:
        raise ValueError(f"{path}: not a history of numbers ({error})") from error


def _of(report: Any, name: str) -> Any:
    """What a report has under a dotted name."""
    found = report
    for part in name.split("."):
        if not hasattr(found, part):
            has = ", ".join(known for known in dir(found) if not known.startswith("_"))
            of = type(found).__name__
            raise ValueError(f"column = {name!r}: {of} has no {part!r}; one of {has or 'nothing'} is required")
        found = getattr(found, part)
    return found


def of_report(column: Column) -> Callable[[Any], Any]:
    """A function of a report, from one that may take none, or from the dotted name of what a report has."""
    if isinstance(column, str):
        return lambda report: _of(report, column)
    kinds = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
    try:
        parameters = inspect.signature(column).parameters.values()
    except ValueError:  # written in C, as attrgetter
        return column
    takes = any(p.kind in kinds and p.default is p.empty for p in parameters)
    return column if takes else lambda _: column()


class Recorder(ClosesFiles):
    """Measures columns step by step, keeps them, and writes them as CSV (collective).

    All ranks keep what rank 0 has measured.

    Args:
        columns: see :data:`Columns`. A vector becomes ``name_1``, ``name_2``, ..., or what the names of its entries
            say; what comes by name keeps its names.
        path: of the file; None: none.
        after: time from which a run goes on: rows of an earlier history are kept up to then; None: a new history.

    Raises:
        ValueError: a name cannot be printed, or something is no column.
        OSError: on all ranks: the file cannot be written.
    """

    def __init__(self, columns: Columns, path: Path | str | None = None, *, after: float | None = None) -> None:
        checks.kind("history", columns, Mapping, 'columns by name, such as {"leak": "monitors.leak"},')
        self._columns = [(_names(name), of_report(_checked(name, column))) for name, column in columns.items()]
        self._path, self._after = None if path is None else Path(path), after
        self._names: list[str] | None = None
        self._rows = array("d")
        self._file: CSVSeries | None = None
        if self._path is None:
            return
        on_root(MPI.COMM_WORLD, lambda: check_writable(self._path))  # type: ignore[arg-type]
        if after is not None and first(MPI.COMM_WORLD, self._path.exists()):
            earlier = History.read(self._path).until(after)
            self._names = list(earlier.names)
            self._rows.extend(earlier.rows.ravel())

    @property
    def history(self) -> History:
        """What has been measured, with what a run that goes on had measured before."""
        names = self._names or []
        return History(names, np.array(self._rows).reshape(-1, 1 + len(names)))

    def record(self, report: Any) -> None:
        """Measure the present state.

        Args:
            report: of the step, with its time ``t``.

        Raises:
            ValueError: something that was measured is no number, or the columns are not those of the rows before.
        """
        measured = [pair for name, column in self._columns for pair in _flat(name, column(report))]
        names, values = [name for name, _ in measured], [value for _, value in measured]
        t, values = first(MPI.COMM_WORLD, (float(report.t), values))
        numbers = [_number(name, value) for name, value in zip(names, values, strict=True)]
        if self._path is not None and self._file is None:
            self._file = CSVSeries(self._path, names, after=self._after)
        if self._names is not None and names != self._names:
            raise ValueError(f"columns {names} were measured, {self._names} are required")
        self._names = names
        self._rows.extend([t, *numbers])
        if self._file is not None:
            self._file.write(t, *values)

    def close(self) -> None:
        """Finish the file."""
        if self._file is not None:
            self._file.close()

    def _abandon(self) -> None:
        if self._file is not None:
            self._file._abandon()


def _names(name: Any) -> Any:
    if isinstance(name, tuple):
        return tuple(checks.label("column", each) for each in name)
    return checks.label("column", name)


def _checked(name: Any, column: Any) -> Column:
    if isinstance(column, ufl.Form):
        raise ValueError(f"columns[{name!r}] is a form: a function is required, such as varmint's Measured(x=form)")
    if not (isinstance(column, str) or callable(column)):
        raise ValueError(f"columns[{name!r}] = {column!r}: a function or the name of what the report has is required")
    return column


def _flat(name: Any, value: Any) -> Iterator[tuple[str, Any]]:
    """Names and numbers of what a column gave."""
    if isinstance(value, Mapping):
        for key, part in value.items():
            yield from _flat(key, part)
    elif isinstance(name, tuple):
        entries = _entries(value)
        if len(entries) != len(name):
            raise ValueError(f"columns[{name!r}]: {len(entries)} numbers were measured, {len(name)} are required")
        yield from zip(name, entries, strict=True)
    elif np.ndim(value) == 0:
        yield name, value
    else:
        yield from ((f"{name}_{i}", entry) for i, entry in enumerate(_entries(value), 1))


def _entries(vector: Any) -> list[Any]:
    """Entries of a vector; whole numbers among them remain whole."""
    whole = isinstance(vector, list | tuple) and all(np.ndim(entry) == 0 for entry in vector)
    return list(vector) if whole else np.ravel(vector).tolist()


def _number(name: str, value: Any) -> float:
    try:
        return float(value)
    except (TypeError, ValueError) as error:
        raise ValueError(f"column {name!r} = {value!r}: a number, a vector or a dict of them is required") from error
