"""Time series on disk: fields on a mesh as XDMF, splines in physical space as VTU with a PVD index, histories as CSV.

Every series is a context manager with one verb, ``write(t)``. Rank 0 writes, but for HDF5's parts, and all ranks raise
what goes wrong there: making, writing and closing are collective on ``MPI.COMM_WORLD``.
"""

import csv
from abc import ABC, abstractmethod
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, TextIO

from mpi4py import MPI
from dolfinx import io, mesh

from tigar_x import checks
from tigar_x.ranks import all_come, on_root, together
from tigar_x.run.vertex_values import Components, VertexValues
from tigar_x.run.writing import replace_text

SLACK = 1e-9
"""By which a time on disk may differ from the same time of the clock, relative to it."""


def is_later(t: float, after: float) -> bool:
    """Whether a time on disk is later than a time of the clock."""
    return t > after + SLACK * abs(after)


def check_writable(*paths: Path) -> None:
    """Raise OSError where a file cannot be written, before work is lost; folders are made, what is there stays."""
    for path in paths:
        there = path.exists()
        path.parent.mkdir(parents=True, exist_ok=True)
        with open(path, "ab"):
            pass
        if not there:
            path.unlink()


class ClosesFiles:
    """A context manager that finishes its files, or abandons them after an error."""

    def close(self) -> None:
        """Finish the files (collective)."""

    def _abandon(self) -> None:
        """Let go of the files after an error, which may have come to this rank alone: wait for no other."""

    def __enter__(self) -> Any:
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if error is None:
            self.close()
        else:
            with suppress(Exception):
                self._abandon()


class Series(ClosesFiles, ABC):
    """What is written at one time after the other."""

    @abstractmethod
    def write(self, t: float) -> None:
        """Write the present state at time ``t`` (collective)."""

    def once(self, t: float = 0.0) -> None:
        """Write one state and finish the files (collective).

        Args:
            t: its time.
        """
        with self:
            self.write(t)


class XDMFSeries(Series):
    """Vertex values of components of finite element functions, as XDMF with HDF5 (collective).

    The files can be read once the series is closed, and not after a run that was killed; for output that can be read at
    any time see :class:`tigar_x.run.vtkhdf.VTKHDFSeries`.

    Args:
        path: file name ending in ``.xdmf``; its folder is made.
        domain: mesh.
        fields: for every name a function, or what computes one, and the components to write: ``velocity=(w, (0, 1))``.

    Raises:
        ValueError: the file or a field has a name that readers of XDMF or HDF5 would take apart.
        OSError: on all ranks: the files cannot be made.
    """

    def __init__(self, path: Path | str, domain: mesh.Mesh, **fields: Components) -> None:
        checks.kind("domain", domain, mesh.Mesh, "a mesh of dolfinx")
        target = Path(path)
        if target.suffix != ".xdmf":
            raise ValueError(f"path = {str(path)!r}: a name that ends in .xdmf is required")
        checks.label("path", target.name, without=":")
        for name in fields:
            checks.label("field", name, without="/:'")
        on_root(domain.comm, lambda: check_writable(target, target.with_suffix(".h5")))
        self._values = VertexValues(domain, fields)
        self._comm = domain.comm.Dup()
        self._file = together(self._comm, lambda: io.XDMFFile(domain.comm, str(target), "w"))
        together(self._comm, lambda: self._file.write_mesh(domain))

    def write(self, t: float) -> None:
        """Append the present fields at time ``t``."""
        self._values.update()
        for function in self._values.functions.values():
            together(self._comm, lambda f=function: self._file.write_function(f, t))  # type: ignore[misc]

    def close(self) -> None:
        """Finish the file."""
        together(self._comm, self._file.close)

    def _abandon(self) -> None:
        if all_come(self._comm):
            self._file.close()


class CSVSeries(Series):
    """A history as CSV, one row per step, flushed at once (collective on all ranks; rank 0 writes).

    Args:
        path: file name; its folder is made.
        columns: names of the columns after ``t``, all different.
        after: time from which a run goes on: rows of an earlier history are kept up to then; None: a new history.

    Raises:
        ValueError: the earlier history has other columns, or one is named twice or cannot be printed.
        OSError: on all ranks, also by :meth:`write`: the file cannot be written.
    """

    def __init__(self, path: Path | str, columns: Sequence[str], *, after: float | None = None) -> None:
        checks.listed("columns", columns)
        self._columns = tuple(checks.label("column", name) for name in columns)
        if twice := [name for i, name in enumerate(self._columns) if name in ("t", *self._columns[:i])]:
            raise ValueError(f"columns = {self._columns}: {twice[0]!r} is there twice (the first is 't')")
        self._file: Any = on_root(MPI.COMM_WORLD, lambda: _opened(Path(path), ["t", *self._columns], after))

    def write(self, t: float, *values: Any) -> None:
        """Append a row.

        Args:
            t: time.
            values: one per column.

        Raises:
            ValueError: not as many values as columns.
        """
        if len(values) != len(self._columns):
            raise ValueError(f"values has {len(values)} entries: {len(self._columns)} are required {self._columns}")
        on_root(MPI.COMM_WORLD, lambda: _append(self._file, [t, *values]))

    def close(self) -> None:
        """Finish the file."""
        on_root(MPI.COMM_WORLD, self._abandon)

    def _abandon(self) -> None:
        if self._file is not None:
            self._file.close()


def _opened(path: Path, header: Sequence[str], after: float | None) -> TextIO:
    """The file of a history that has its header, open for more rows."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if after is not None:
        _cut(path, header, after)
    begins = after is None or not path.exists()
    file = open(path, "w" if begins else "a", newline="")  # noqa: SIM115  (closed by the series)
    if begins:
        _append(file, header)
    return file


def _append(file: TextIO, row: Sequence[Any]) -> None:
    csv.writer(file).writerow(row)
    file.flush()


def _cut(path: Path, header: Sequence[str], after: float) -> None:
    """Drop rows that are later than a time, and a last one that was not finished; a file without any line goes."""
    if not path.exists():
        return
    with open(path, newline="") as file:
        lines = [line for line in file if line.endswith("\n")]
    if not lines:
        path.unlink()
        return
    rows = csv.reader(lines)
    found = next(rows)
    if found != header:
        raise ValueError(f"{path}: columns {found} were found, {header} are required")
    try:
        kept = [line for line, row in zip(lines[1:], rows, strict=True) if not is_later(float(row[0]), after)]
    except (IndexError, ValueError) as error:
        raise ValueError(f"{path}: not a history ({error})") from error
    replace_text(path, "".join(lines[:1] + kept))
