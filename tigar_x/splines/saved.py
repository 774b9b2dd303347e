"""Saved extractions: a spline with its conditions in one file, read back without what generated it.

The file is a NumPy archive without pickled objects. It holds the parametric mesh, the values of all functions at the
Lagrange nodes (the extraction matrix), the homogeneous control points, the conditions of the displacement space and a
record in JSON. It may be read on any number of ranks: the nodes find their rows by their parameters.
"""

import io
import json
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse as sp
from mpi4py import MPI
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from tigar_x import checks
from tigar_x.compat import FloatArray, IntArray
from tigar_x.geometry.functions import Cells, ParametricCells
from tigar_x.geometry.net import ControlNet
from tigar_x.ranks import on_root, together
from tigar_x.run.writing import replace_bytes
from tigar_x.splines.spline import ExtractedSpline

FORMAT = 1
"""Version of the file's layout."""


@dataclass(frozen=True, eq=False)
class SavedFunctions:
    """Spline functions that are known at the nodes of one parametric mesh only.

    Attributes:
        kind: "tensor" or "simplex".
        elements: the parametric mesh.
        degrees: largest polynomial degree in every direction.
        nodes: parameters of the nodes in the parametric plane, shape (nodes, dimension).
        values: values of the functions there, shape (nodes, n).
        boxes: lower and upper corner of every patch, shape (patches, 2, dimension).
    """

    kind: Cells
    elements: ParametricCells
    degrees: tuple[int, ...]
    nodes: FloatArray
    values: sp.csr_matrix
    boxes: FloatArray

    def __post_init__(self) -> None:
        checks.freeze(self)

    @property
    def n(self) -> int:
        """Number of functions."""
        return int(self.values.shape[1])

    @property
    def dim(self) -> int:
        """Parametric dimension."""
        return int(self.nodes.shape[1])

    @cached_property
    def _tree(self) -> cKDTree:
        return cKDTree(self.nodes)

    def evaluate(self, points: ArrayLike) -> sp.csr_matrix:
        """Values of all functions at nodes.

        Args:
            points: nodes in any order, shape (m, dimension).

        Returns:
            Sparse matrix of shape (m, n).

        Raises:
            ValueError: a point is no node.
        """
        x = checks.array("points", points, (None, self.dim))
        distance, row = self._tree.query(x)
        if len(x) and distance.max() > 1e-9 * np.ptp(self.nodes, axis=0).max():
            raise ValueError(
                f"points[{int(distance.argmax())}] is no node: a saved extraction is known at its nodes only"
            )
        return self.values[row]

    def cells(self, kind: Cells) -> ParametricCells:
        """The parametric mesh.

        Args:
            kind: the kind that was saved.

        Returns:
            The cells.

        Raises:
            ValueError: another kind.
        """
        checks.choice("cells", kind, (self.kind,))
        return self.elements

    def to_plane(self, patch: int, xi: FloatArray) -> FloatArray:
        """Points of the parametric plane: a saved extraction has no other parameters."""
        return xi

    def require_elements(self, name: str, other: Any) -> None:
        """Refuse functions of another degree: they would have to be saved as well."""
        raise ValueError(f"{name} = {other!r}: a saved extraction has fields of its own functions only")


@dataclass(frozen=True, eq=False, repr=False)
class SavedGeometry(ControlNet):
    """Geometry of a saved extraction.

    Attributes:
        functions: the functions.
        control: homogeneous control points (w x, w), shape (n, nsd + 1); unit: length.
        sides: for every patch its sides by name, each with its direction and end.
    """

    functions: SavedFunctions  # type: ignore[assignment]
    control: FloatArray
    sides: list[dict[str, tuple[int, int]]] = field(default_factory=list)

    def __post_init__(self) -> None:
        object.__setattr__(self, "control", self._check_control())

    def side_places(self) -> list[dict[str, tuple[int, int]]]:
        """Sides by name, see :meth:`tigar_x.geometry.net.ControlNet.side_places`."""
        return self.sides

    def locate_sides(self, names: Any, patch: int | None = None) -> list[tuple[int, int, int]]:
        """Sides by name, see :meth:`tigar_x.geometry.net.ControlNet.locate_sides`."""
        count = len(self.sides)
        chosen = range(count) if patch is None else [checks.choice("patch", patch, tuple(range(count)))]
        places = [
            (k, *self.sides[k][checks.choice("name", name, tuple(self.sides[k]))])
            for k in chosen
            for name in names or self.sides[k]
        ]
        return list(dict.fromkeys(places))

    def side_functions(self, patch: int, direction: int, end: int, layers: int = 1) -> IntArray:
        """Functions that do not vanish on a side; only one layer is known."""
        checks.choice("layers", layers, (1,))
        low, high = self.functions.boxes[patch]
        slack = 1e-9 * (high - low)
        x = self.functions.nodes
        inside = ((x >= low - slack) & (x <= high + slack)).all(axis=1)
        on_side = inside & (np.abs(x[:, direction] - (low, high)[end][direction]) <= slack[direction])
        return np.unique(self.functions.values[on_side].indices).astype(np.int32)


def save_extraction(path: Path | str, spline: ExtractedSpline) -> None:
    """Save a spline, its mesh, extraction matrix, control points and conditions (collective; rank 0 writes).

    The file replaces an older one of its name at once or not at all.

    Args:
        path: file name; its folder is made.
        spline: the spline.

    Raises:
        OSError: on all ranks: it cannot be written.
    """
    comm, scalar = spline.mesh.comm, spline.vector
    owned = scalar.V.dofmap.index_map.size_local
    rows = scalar.nodes[:owned].tocoo()
    nodes = spline.scalar.V.tabulate_dof_coordinates()[:owned, : spline.dim]
    first = sum(comm.allgather(owned)[: comm.rank])
    parts = comm.gather((nodes, rows.row + first, rows.col, rows.data))
    on_root(MPI.COMM_WORLD, lambda: replace_bytes(Path(path), _archive(spline, parts)))


def _archive(spline: ExtractedSpline, parts: Any) -> bytes:
    """Content of the file from the nodes and rows of all ranks."""
    scalar = spline.vector
    coordinates, i, j, values = (np.concatenate([part[c] for part in parts]) for c in range(4))
    functions = spline.geometry.functions
    elements = functions.cells(spline.cells)
    record = {
        "format": FORMAT,
        "cells": spline.cells,
        "cell": elements.cell,
        "degrees": functions.degrees,
        "quadrature_degree": spline.quadrature_degree,
        "sides": spline.geometry.side_places(),
    }
    constraints = scalar.constraints.tocoo()
    buffer = io.BytesIO()
    np.savez_compressed(
        buffer,
        record=np.array(json.dumps(record)),
        mesh_cells=elements.cells,
        mesh_x=elements.x,
        nodes=coordinates,
        M_row=i,
        M_column=j,
        M_value=values,
        control=spline.geometry.control,
        boxes=functions.boxes,
        zero_dofs=scalar.fixed,
        constraint_row=constraints.row,
        constraint_column=constraints.col,
        constraint_value=constraints.data,
    )
    return buffer.getvalue()


def load_extraction(path: Path | str, comm: MPI.Comm = MPI.COMM_WORLD) -> ExtractedSpline:
    """Read a saved extraction back, on any number of ranks (collective).

    Args:
        path: file of :func:`save_extraction`.
        comm: communicator.

    Returns:
        The spline with its conditions; its functions are known at the nodes only.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is truncated, malformed or of another format; the message names it.
    """
    data = together(comm, lambda: _read(Path(path)))
    record = _record(Path(path), data)
    count, n = len(data["nodes"]), len(data["control"])
    try:
        values = sp.csr_matrix((data["M_value"], (data["M_row"], data["M_column"])), shape=(count, n))
        elements = ParametricCells(record["cell"], data["mesh_cells"], data["mesh_x"])
        degrees = tuple(record["degrees"])
        functions = SavedFunctions(record["cells"], elements, degrees, data["nodes"], values, data["boxes"])
        sides = [{name: (d, end) for name, (d, end) in names.items()} for names in record["sides"]]
        geometry = SavedGeometry(functions, data["control"], sides)
        total = n * geometry.nsd
        height = int(data["constraint_row"].max(initial=-1)) + 1
        place = (data["constraint_row"], data["constraint_column"])
        constraints = sp.csr_matrix((data["constraint_value"], place), shape=(height, total))
        quadrature_degree = record["quadrature_degree"]
    except (KeyError, IndexError, TypeError, ValueError) as error:
        raise ValueError(f"{path}: the parts of the saved extraction do not fit together ({error})") from error
    return ExtractedSpline(
        geometry,
        comm,
        cells=functions.kind,
        quadrature_degree=quadrature_degree,
        zero_dofs=data["zero_dofs"],
        constraints=[constraints] if height else (),
    )


def _read(path: Path) -> dict[str, Any]:
    """All arrays of an archive."""
    if not path.is_file():
        raise FileNotFoundError(f"{path}: there is no such file")
    names = {"record", "mesh_cells", "mesh_x", "nodes", "M_row", "M_column", "M_value", "control", "boxes"}
    names |= {"zero_dofs", "constraint_row", "constraint_column", "constraint_value"}
    try:
        with np.load(path, allow_pickle=False) as archive:
            data = {name: archive[name] for name in archive.files}
    except Exception as error:  # there is no end to what a damaged or foreign file may raise
        reason = str(error) or type(error).__name__
        raise ValueError(f"{path}: not a saved extraction, or a truncated one ({reason})") from error
    if missing := sorted(names - set(data)):
        raise ValueError(f"{path}: {', '.join(missing)} missing, which a saved extraction contains")
    return data


def _record(path: Path, data: dict[str, Any]) -> dict[str, Any]:
    """The record of this format."""
    try:
        record = json.loads(str(data["record"]))
        found = record["format"]
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path}: not a saved extraction: its record is none ({error})") from error
    if found != FORMAT:
        raise ValueError(f"{path}: format {found!r} was found, {FORMAT} is required")
    return dict(record)
