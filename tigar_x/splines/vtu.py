"""A deformed spline in physical space as a time series of VTU files."""

import xml.etree.ElementTree as ET
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape

import numpy as np
from mpi4py import MPI
from dolfinx import fem

from tigar_x import checks, compat
from tigar_x.compat import FloatArray
from tigar_x.ranks import gathered, on_root
from tigar_x.run.output import Series, check_writable, is_later
from tigar_x.run.writing import replace_text
from tigar_x.splines.spline import ExtractedSpline, require_spline


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
        spline: ExtractedSpline,
        y: fem.Function | None = None,
        *,
        after: float | None = None,
        **fields: fem.Function | Callable[[], FloatArray],
    ) -> None:
        require_spline(spline)
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
        check_writable(self._index)
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
