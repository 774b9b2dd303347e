"""Fields on a fixed mesh over time as VTKHDF, which ParaView opens while the run goes on and after it was killed.

``flow.vtkhdf`` is an index: the mesh and the values of every time lie in files of their own in ``flow.steps``, and the
index shows them as the datasets of one temporal file (virtual datasets of HDF5). A step writes its values and then the
index, each under another name that replaces the old one at once: whatever dies in between, the index on disk is whole,
and so is all that it refers to. No file stays open. Format: VTK's documentation of VTKHDF 2.0, unstructured grids.
"""

import shutil
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from dolfinx import mesh

from tigar_x import checks, compat
from tigar_x.compat import FloatArray, IntArray
from tigar_x.ranks import gathered, on_root
from tigar_x.run.nodal import Nodes, matching
from tigar_x.run.output import Series, is_later
from tigar_x.run.vertex_values import Components, VertexValues
from tigar_x.run.writing import replace_bytes

CELLS = {
    "interval": (3, [0, 1]),
    "triangle": (5, [0, 1, 2]),
    "quadrilateral": (9, [0, 1, 3, 2]),
    "tetrahedron": (10, [0, 1, 2, 3]),
    "hexahedron": (12, [0, 1, 3, 2, 4, 5, 7, 6]),
}
"""VTK's number of a cell, and the order in which VTK goes through the vertices that dolfinx gives."""
MESH = "mesh.h5"
SIZES = {"Points": "Points", "Cells": "Types", "ConnectivityIds": "Connectivity"}
"""What VTK counts, and the arrays that have as many entries."""


class VTKHDFSeries(Series):
    """Vertex values of components of finite element functions, as VTKHDF (collective).

    Rank 0 gathers and writes. The index and its folder of steps belong together: move both or none.

    Args:
        path: file name ending in ``.vtkhdf``; its folder is made.
        domain: mesh; it is written once.
        after: time from which a run goes on: steps of an earlier series are kept up to then, and those that are later
            are deleted; None: a new series in the place of an earlier one.
        single: whether values are stored in single precision, in half the space.
        fields: for every name a function, or what computes one, and the components to write: ``velocity=(w, (0, 1))``.

    Raises:
        ImportError: h5py is missing.
        IndexError: a function has no such component.
        OSError: a file cannot be written.
        ValueError: the path or a field has a name that cannot be, or the earlier series has other fields or points.
    """

    _is_fixed = True  # all steps have one mesh

    def __init__(
        self,
        path: Path | str,
        domain: mesh.Mesh,
        *,
        after: float | None = None,
        single: bool = False,
        **fields: Components,
    ) -> None:
        checks.kind("domain", domain, mesh.Mesh, "a mesh of dolfinx")
        self._path, self._comm = Path(path), domain.comm
        if self._path.suffix != ".vtkhdf":
            raise ValueError(f"path = {str(path)!r}: a name that ends in .vtkhdf is required")
        checks.label("path", self._path.name, without="%")  # HDF5 puts numbers there in names of virtual datasets
        for name in fields:
            checks.label("field", name, without="/%")
        self._h5 = _h5py()
        self._steps = self._path.with_suffix(".steps")
        self._type = np.dtype(np.float32 if single else np.float64)
        self._values = VertexValues(domain, fields)
        self._shapes = {name: _shape(len(components)) for name, (_, components) in fields.items()}
        self._times: list[float] = []
        self._order: IntArray | None = None
        self._space = compat.lagrange_space(domain, 1)
        self._owned = int(self._space.dofmap.index_map.size_local)
        grid = self._grid(domain)
        goes_on = after is not None and self._comm.bcast(self._path.exists())
        close = Nodes(self._space, str(self._path)).close if goes_on else None
        on_root(self._comm, lambda: self._begin(grid) if close is None else self._continue(close, grid, after))

    def _grid(self, domain: mesh.Mesh) -> dict[str, Any]:
        """Arrays of the mesh under VTKHDF's names, on rank 0; nothing elsewhere (collective)."""
        kind, order = CELLS[compat.cell_name(domain)]
        dofs = compat.cell_dofs(self._space)[: compat.owned_cells(domain)][:, order]
        numbers = self._space.dofmap.index_map.local_to_global(dofs.ravel().astype(np.int32))
        points = gathered(self._comm, self._space.tabulate_dof_coordinates()[: self._owned])
        connectivity = gathered(self._comm, np.asarray(numbers, dtype=np.int64))
        if points is None or connectivity is None:
            return {}
        cells = len(connectivity) // len(order)
        return {
            "Points": points,
            "Connectivity": connectivity,
            "Offsets": len(order) * np.arange(cells + 1, dtype=np.int64),
            "Types": np.full(cells, kind, dtype=np.uint8),
        }

    def _begin(self, grid: dict[str, Any]) -> None:
        self._counts = {name: len(array) for name, array in grid.items()}
        self._path.unlink(missing_ok=True)  # before what it refers to
        if self._steps.exists():
            shutil.rmtree(self._steps)
        replace_bytes(self._steps / MESH, self._image(grid))

    def _continue(self, close: float, grid: dict[str, Any], after: Any) -> None:
        """Take over the earlier series up to a time; what is later goes once the index no longer refers to it."""
        try:
            with self._h5.File(self._path, "r") as file, self._h5.File(self._steps / MESH, "r") as whole:
                group = file["VTKHDF"]
                times = [float(t) for t in group["Steps/Values"]]
                fields = {name: (data.shape[1:], data.dtype) for name, data in group["PointData"].items()}
                points, cells = whole["Points"][:], len(whole["Types"])
                is_fixed = isinstance(group.get("Points", getlink=True), self._h5.ExternalLink)
                kept = sum(not is_later(t, after) for t in times)
                if is_fixed == self._is_fixed:
                    self._take_over(group, kept)
        except (OSError, KeyError) as error:
            raise ValueError(f"{self._path}: not the index of a series, or its steps are missing ({error})") from error
        self._counts = {name: len(array) for name, array in grid.items()}
        required = {name: (shape, self._type) for name, shape in self._shapes.items()}
        if fields != required or cells != self._counts["Types"]:
            found = f"fields {fields} on {cells} cells were found"
            raise ValueError(f"{self._path}: {found}, {required} on {self._counts['Types']} are required")
        try:
            self._order = matching(grid["Points"], points, close)
        except ValueError as error:
            raise ValueError(f"{self._path}: another mesh ({error})") from error
        if is_fixed != self._is_fixed:
            kinds = ["with a mesh for every time", "with one mesh for all times"]
            raise ValueError(
                f"{self._path}: a series {kinds[is_fixed]} was found, one {kinds[not is_fixed]} is required"
            )
        self._times = times[:kept]
        self._write_index()
        for step in range(kept, len(times)):
            (self._steps / step_name(step)).unlink(missing_ok=True)

    def _take_over(self, group: Any, kept: int) -> None:
        """Take over what an earlier index knows of the meshes of the steps that are kept."""

    def write(self, t: float) -> None:
        """Append the present fields at time ``t``.

        Raises:
            OSError: it cannot be written; the series on disk stays as it was.
        """
        arrays = self._gather()
        on_root(self._comm, lambda: self._append(float(t), arrays, {}))

    def _gather(self) -> dict[str, FloatArray]:
        """Present fields at the vertices on rank 0 (collective), shape (vertices, components) each."""
        self._values.update()
        arrays = {}
        for name, function in self._values.functions.items():
            blocks = function.x.array.reshape(-1, function.function_space.dofmap.index_map_bs)
            arrays[name] = gathered(self._comm, blocks[: self._owned])
        return arrays

    def _append(self, t: float, arrays: dict[str, FloatArray], more: dict[str, Any]) -> None:
        """Write a step, its fields and what else is in its file."""
        values = dict(more)
        for name, array in arrays.items():
            ordered = array if self._order is None else array[self._order]
            width = self._shapes[name][0] if self._shapes[name] else 1
            padded = np.pad(ordered, ((0, 0), (0, width - ordered.shape[1]))).astype(self._type)
            values[name] = padded if self._shapes[name] else padded[:, 0]
        replace_bytes(self._steps / step_name(len(self._times)), self._image(values))
        self._times.append(t)
        try:
            self._write_index()
        except BaseException:
            self._times.pop()
            raise

    def _image(self, content: dict[str, Any] | Callable[[Any], None]) -> bytes:
        """A file of arrays by name, or of what a function writes to it, made in memory."""
        with self._h5.File("image", "w", driver="core", backing_store=False) as file:
            if callable(content):
                content(file)
            else:
                for name, array in content.items():
                    file[name] = array
            file.flush()
            return bytes(file.id.get_file_image())

    def _write_index(self) -> None:
        replace_bytes(self._path, self._image(self._fill_index))

    def _fill_index(self, file: Any) -> None:
        """Groups, attributes and datasets of a temporal unstructured grid in one part."""
        root, n = file.create_group("VTKHDF"), len(self._times)
        root.attrs["Version"] = (2, 0)
        root.attrs.create("Type", b"UnstructuredGrid", dtype=self._h5.string_dtype("ascii", 16))
        steps = root.create_group("Steps")
        steps.attrs["NSteps"] = n
        steps["Values"] = np.array(self._times)
        steps["NumberOfParts"] = np.ones(n, dtype=np.int64)
        first = self._fill_grid(root, steps)
        offsets, data = steps.create_group("PointDataOffsets"), root.create_group("PointData")
        for name, shape in self._shapes.items():
            offsets[name] = first[:-1]
            self._join(data, name, first, shape, self._type)

    def _fill_grid(self, root: Any, steps: Any) -> IntArray:
        """Datasets of the mesh; returns where the points of every step begin, and where the last ones end."""
        n = len(self._times)
        for name in self._counts:
            root[name] = self._h5.ExternalLink(f"{self._steps.name}/{MESH}", name)
        for name, entries in SIZES.items():
            root["NumberOf" + name] = np.array([self._counts[entries]])
        for name in ("PartOffsets", "PointOffsets"):  # all steps have the mesh of the first
            steps[name] = np.zeros(n, dtype=np.int64)
        for name in ("CellOffsets", "ConnectivityIdOffsets"):
            steps[name] = np.zeros((n, 1), dtype=np.int64)
        return self._counts["Points"] * np.arange(n + 1)

    def _join(self, group: Any, name: str, first: IntArray, shape: tuple[int, ...], kind: Any) -> None:
        """Arrays of that name in the files of all steps as one dataset, where those of every step begin as given."""
        layout = self._h5.VirtualLayout((first[-1], *shape), dtype=kind)
        for i, (begin, end) in enumerate(pairwise(first.tolist())):
            source = self._h5.VirtualSource(f"{self._steps.name}/{step_name(i)}", name, (end - begin, *shape), kind)
            layout[begin:end] = source
        group.create_virtual_dataset(name, layout)


def _shape(components: int) -> tuple[int, ...]:
    """Shape of a field at a point: a number, or a vector of at least three components, as viewers want it."""
    return () if components == 1 else (max(components, 3),)


def step_name(step: int) -> str:
    """Name of a step's file."""
    return f"{step:06d}.h5"


def _h5py() -> Any:
    try:
        import h5py
    except ImportError as error:
        raise ImportError("VTKHDFSeries needs h5py (Debian's python3-h5py): XDMFSeries does without it") from error
    return h5py
