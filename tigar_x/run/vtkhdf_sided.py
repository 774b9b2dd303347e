"""Fields that differ on both sides of a line or surface through cells, over time as VTKHDF.

Every time has a mesh of its own: triangles or tetrahedra that are divided are replaced by pieces of either side, whose
points belong to that side alone.
"""

from pathlib import Path
from typing import Any

import numpy as np
from dolfinx import mesh

from tigar_x import compat
from tigar_x.compat import FloatArray, IntArray
from tigar_x.fem.simplices import Sided, SidedSimplices
from tigar_x.ranks import gathered, on_root
from tigar_x.run.vertex_values import Components
from tigar_x.run.vtkhdf import CELLS, SIZES, VTKHDFSeries


class SidedVTKHDFSeries(VTKHDFSeries):
    """Vertex values of finite element functions, and values on both sides of what divides cells (collective).

    Args:
        path: see :class:`tigar_x.run.vtkhdf.VTKHDFSeries`.
        domain: mesh of triangles or tetrahedra.
        sides: what makes one of the functions differ on both sides.
        options: see there; functions that are not that of the sides are the same on both.
    """

    _is_fixed = False

    def __init__(
        self, path: Path | str, domain: mesh.Mesh, sides: Sided, *, after: float | None = None, **options: Any
    ) -> None:
        self._sides, self._sizes, self._domain = sides, [], domain
        self._fields: dict[str, Components] = {name: field for name, field in options.items() if name != "single"}
        super().__init__(path, domain, after=after, **options)
        self._order = None  # the mesh of a step comes with it

    _sizes: list[dict[str, int]]

    def write(self, t: float) -> None:
        """See :class:`tigar_x.run.vtkhdf.VTKHDFSeries`."""
        arrays, pieces = self._gather(), self._sides.pieces()
        grid = self._divided(pieces)
        for name, (function, components) in self._fields.items():
            if function is self._sides.function:
                values = self._sides.of_pieces(pieces)[:, :, list(components)]
            else:
                values = pieces.linear(self._values.functions[name])
            more = gathered(self._comm, values.reshape(-1, values.shape[2]))
            if more is not None:
                arrays[name] = np.concatenate([arrays[name], more])
        on_root(self._comm, lambda: self._append(float(t), arrays, grid))

    def _divided(self, pieces: SidedSimplices) -> dict[str, Any]:
        """Arrays of the mesh with pieces, on rank 0; nothing elsewhere (collective)."""
        space, owned = self._space, compat.owned_cells(self._domain)
        kind, order = CELLS[compat.cell_name(self._domain)]
        whole = np.ones(owned, dtype=bool)
        whole[pieces.cells] = False
        dofs = compat.cell_dofs(space)
        numbers = space.dofmap.index_map.local_to_global(dofs[:owned][whole].ravel().astype(np.int32))
        x = space.tabulate_dof_coordinates()
        parts = x[: self._owned], (pieces.barycentric @ x[dofs[pieces.cells]]).reshape(-1, 3), np.asarray(numbers)
        points, more, connectivity = (gathered(self._comm, part) for part in parts)
        if points is None:
            return {}
        connectivity = np.concatenate([connectivity, len(points) + np.arange(len(more))]).astype(np.int64)
        cells = len(connectivity) // len(order)
        return {
            "Points": np.concatenate([points, more]),
            "Connectivity": connectivity,
            "Offsets": len(order) * np.arange(cells + 1, dtype=np.int64),
            "Types": np.full(cells, kind, dtype=np.uint8),
        }

    def _take_over(self, group: Any, kept: int) -> None:
        counts = {name: group["NumberOf" + name][:kept] for name in SIZES}
        self._sizes = [{name: int(count[i]) for name, count in counts.items()} for i in range(kept)]

    def _append(self, t: float, arrays: dict[str, FloatArray], more: dict[str, Any]) -> None:
        self._sizes.append({name: len(more[entries]) for name, entries in SIZES.items()})
        try:
            super()._append(t, arrays, more)
        except BaseException:
            self._sizes.pop()
            raise

    def _fill_grid(self, root: Any, steps: Any) -> IntArray:
        n = len(self._sizes)
        counts = {name: np.array([sizes[name] for sizes in self._sizes], dtype=np.int64) for name in SIZES}
        first = {name: np.concatenate([[0], np.cumsum(count)]) for name, count in counts.items()}
        for name, count in counts.items():
            root["NumberOf" + name] = count
        self._join(root, "Points", first["Points"], (3,), np.float64)
        self._join(root, "Connectivity", first["ConnectivityIds"], (), np.int64)
        self._join(root, "Offsets", first["Cells"] + np.arange(n + 1), (), np.int64)
        self._join(root, "Types", first["Cells"], (), np.uint8)
        steps["PartOffsets"], steps["PointOffsets"] = np.arange(n), first["Points"][:-1]
        steps["CellOffsets"] = first["Cells"][:-1, None]
        steps["ConnectivityIdOffsets"] = first["ConnectivityIds"][:-1, None]
        return first["Points"]
