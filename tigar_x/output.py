"""Time series on disk: fields on a mesh as XDMF, splines in physical space as VTU with a PVD index, histories as CSV.

Every series is a context manager with one verb, ``write(t)``. Rank 0 writes, but for HDF5's parts, and all ranks raise
what goes wrong there: making, writing and closing are collective on ``MPI.COMM_WORLD``.
"""

import csv
import xml.etree.ElementTree as ET
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, TextIO
from xml.sax.saxutils import escape

import numpy as np
from mpi4py import MPI
from dolfinx import fem, io, mesh

from tigar_x import checks, compat
from tigar_x.compat import FloatArray
from tigar_x.vertex_values import Components, VertexValues
from tigar_x.writing import all_come, gathered, on_root, replace_text, together

if TYPE_CHECKING:
    from tigar_x.spline import ExtractedSpline


SLACK = 1e-9
"""By which a time on disk may differ from the same time of the clock, relative to it."""


def is_later(t: float, after: float) -> bool:
    """Whether a time on disk is later than a time of the clock."""
    return t > after + SLACK * abs(after)


def _check_writable(*paths: Path) -> None:
    """Raise OSError where a file cannot be written, before work is lost; folders are made, what is there stays."""
    for path in paths:
        there = path.exists()
        path.parent.mkdir(parents=True, exist_ok=True)
        with open(path, "ab"):
            pass
        if not there:
            path.unlink()


class Series:
    """What every series is besides: a context manager that finishes or abandons its files."""

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


class XDMFSeries(Series):
    """Vertex values of components of finite element functions, as XDMF with HDF5 (collective).

    The files can be read once the series is closed, and not after a run that was killed; for output that can be read at
    any time see :class:`tigar_x.vtkhdf.VTKHDFSeries`.

    Args:
        path: file name ending in ``.xdmf``; its folder is made.
        domain: mesh.
        fields: for every name a function and the components to write, such as ``velocity=(w, (0, 1))``.

    Raises:
        ValueError: the file or a field has a name that readers of XDMF or HDF5 would take apart.
        OSError: on all ranks: the files cannot be made.
    """

    def __init__(self, path: Path | str, domain: mesh.Mesh, **fields: Components) -> None:
        target = Path(path)
        if target.suffix != ".xdmf":
            raise ValueError(f"path = {str(path)!r}: a name that ends in .xdmf is required")
        checks.label("path", target.name, without=":")
        for name in fields:
            checks.label("field", name, without="/:'")
        on_root(domain.comm, lambda: _check_writable(target, target.with_suffix(".h5")))
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


def _in_xml(text: str) -> str:
    """A text as it stands in an attribute, in any encoding; meshio writes names of fields as they are."""
    return escape(text, {'"': "&quot;"}).encode("ascii", "xmlcharrefreplace").decode()


class VTUSeries(Series):
    """A deformed spline in physical space: numbered VTU files and one PVD index that ParaView opens.

    Bezier elements are drawn as linear cells between neighbouring nodes. Rank 0 gathers and writes (collective on all
    ranks, also for a spline that every rank has whole).

    Args:
        path: path without ending; its folder is made.
        spline: curve, surface or volume of one or several patches.
        y: homogeneous displacement; None: the reference configuration.
        after: time from which a run goes on: files of an earlier series are kept up to then, and those that are later
            are deleted; None: a new series.
        fields: point data by name: a homogeneous isoparametric function of any number of components, or a callable
            that returns physical values at this rank's nodes, shape (nodes,) or (nodes, components). With ``y`` there
            is a field ``displacement`` already.

    Raises:
        ValueError: the file or a field has a name that cannot be printed, or ``displacement`` is given twice.
        ValueError: the index of the earlier series cannot be read.
        OSError: on all ranks, also by :meth:`write`: a file cannot be written.
    """

    def __init__(
        self,
        path: Path | str,
        spline: "ExtractedSpline",
        y: fem.Function | None = None,
        *,
        after: float | None = None,
        **fields: fem.Function | Callable[[], FloatArray],
    ) -> None:
        self._path = Path(path)
        self._spline = spline
        self._comm = spline.mesh.comm
        self._y = y
        self._fields = {checks.label("field", name): field for name, field in fields.items()}
        checks.label("path", self._path.name)
        if y is not None and "displacement" in fields:
            raise ValueError("field = 'displacement': another name is required, this is that of y")
        self._kind, cells = compat.subcells(spline.V)
        counts = self._comm.allgather(len(spline.node_positions))
        self._cells = gathered(self._comm, cells + sum(counts[: self._comm.rank]))
        self._index = self._path.with_name(self._path.name + ".pvd")
        self._entries: list[tuple[float, str]] = []
        on_root(MPI.COMM_WORLD, lambda: self._begin(after))

    def _begin(self, after: float | None) -> None:
        _check_writable(self._index)
        if after is None or not self._index.exists():
            return
        try:
            found = [(float(e.attrib["timestep"]), e.attrib["file"]) for e in ET.parse(self._index).iter("DataSet")]
        except (ET.ParseError, KeyError, ValueError) as error:
            raise ValueError(f"{self._index}: not the index of a series ({error})") from error
        self._entries = [(t, name) for t, name in found if not is_later(t, after)]
        self._write_index()
        for _, name in found[len(self._entries) :]:
            self._path.with_name(name).unlink(missing_ok=True)

    @staticmethod
    def _padded(values: FloatArray) -> FloatArray:
        if values.ndim == 1 or values.shape[1] > 2:
            return values
        return values[:, 0] if values.shape[1] == 1 else np.pad(values, ((0, 0), (0, 1)))

    def _values(self, field: Any) -> FloatArray:
        return self._spline.nodal(field) if isinstance(field, fem.Function) else np.asarray(field())

    def write(self, t: float) -> None:
        """Write the present configuration at time ``t``."""
        points, data = self._spline.node_positions, {}
        if self._y is not None:
            data["displacement"] = self._spline.nodal(self._y)
            points = points + data["displacement"]
        data.update({name: self._values(field) for name, field in self._fields.items()})
        points, data = (
            gathered(self._comm, points),
            {name: gathered(self._comm, values) for name, values in data.items()},
        )
        on_root(MPI.COMM_WORLD, lambda: self._put(t, points, data))

    def _put(self, t: float, points: FloatArray, data: dict[str, FloatArray]) -> None:
        import meshio

        file = self._path.with_name(f"{self._path.name}_{len(self._entries):06d}.vtu")
        cells, fields = [(self._kind, self._cells)], {_in_xml(name): self._padded(v) for name, v in data.items()}
        in_space = np.pad(points, ((0, 0), (0, 3 - points.shape[1])))
        meshio.Mesh(in_space, cells, point_data=fields).write(file)
        self._entries.append((t, file.name))
        self._write_index()

    def _write_index(self) -> None:
        entries = (
            f'    <DataSet timestep="{t:.17g}" group="" part="0" file="{_in_xml(name)}"/>\n'
            for t, name in self._entries
        )
        head = '<?xml version="1.0"?>\n<VTKFile type="Collection" version="0.1">\n  <Collection>\n'
        replace_text(self._index, head + "".join(entries) + "  </Collection>\n</VTKFile>\n")


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
