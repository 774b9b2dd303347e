"""Weights of the two sides on the boundary of the fluid, where a curve crosses it between vertices."""

import numpy as np
from dolfinx import mesh

from coudalfish.surface.cut_cells import CutCells
from tigar_x import compat
from tigar_x.compat import FloatArray, IntArray

EDGES = ((1, 2), (0, 2), (0, 1))
"""Vertices of the sides of a triangle."""
ON_EDGE = 1e-9
"""Barycentric coordinate below which a node is on a side."""


class WallWeights:
    """Weights of the negative side on the sides of cut triangles that are on the boundary.

    On every side they are the projection of the indicator on polynomials of it, in the mean square. Where two sides of
    a triangle meet they have the mean of both there.

    Args:
        domain: mesh of triangles.
        degree: of the polynomials.
        points: reference coordinates of the nodes of an element of this degree, shape (nodes, 2).
    """

    def __init__(self, domain: mesh.Mesh, degree: int, points: FloatArray) -> None:
        vertices = compat.connectivity(domain, 2, 0).array.reshape(-1, 3)
        of_facets, cells_of = compat.connectivity(domain, 1, 0), compat.connectivity(domain, 1, 2)
        facets = compat.exterior_facets(domain)
        cells = cells_of.array[cells_of.offsets[facets]]
        ends = of_facets.array.reshape(-1, 2)[facets]
        inside = (vertices[cells][:, :, None] == ends[:, None]).any(axis=2)
        self._on_wall = np.zeros((len(vertices), 3), dtype=bool)
        self._on_wall[cells, (~inside).argmax(axis=1)] = True
        places = np.column_stack([1.0 - points.sum(axis=1), points])
        on_edge = np.abs(places.T) < ON_EDGE  # (sides, nodes)
        n, both = np.arange(degree + 1), np.arange(degree + 1) + np.arange(degree + 1)[:, None]
        mass, self._whole = _integral(np.ones(1), both.ravel()).reshape(both.shape), _integral(np.ones(1), n)
        along = places[:, [b for _, b in EDGES]].T - 0.5
        values = np.linalg.solve(mass, along[:, None] ** n[:, None])
        self._projection, self._counts = values * on_edge[:, None], on_edge.astype(np.float64)
        self._powers, (self._first, self._last) = n, np.array(EDGES).T

    def __call__(self, cut: CutCells) -> tuple[IntArray, FloatArray]:
        """Those cut cells that have a side on the boundary, and values at their nodes, shape (found, nodes)."""
        cell, side = np.nonzero(self._on_wall[cut.cells])
        if not len(cell):
            return cut.cells[:0], np.empty((0, self._counts.shape[1]))
        starts = np.flatnonzero(np.diff(cell, prepend=-1))
        a, b = cut.values[cell, self._first[side]], cut.values[cell, self._last[side]]
        values = np.einsum("sm,smn->sn", self._negative(a, b), self._projection[side])
        counts = np.add.reduceat(self._counts[side], starts)
        return cut.cells[cell[starts]], np.add.reduceat(values, starts) / np.maximum(counts, 1.0)

    def _negative(self, a: FloatArray, b: FloatArray) -> FloatArray:
        """Moments of where a linear function is negative, which is a at 0 and b at 1, shape (sides, powers)."""
        t = np.where((a < 0.0) == (b < 0.0), 1.0, np.clip(a / np.where(a == b, 1.0, a - b), 0.0, 1.0))
        moments = _integral(t, self._powers)
        return np.where((a < 0.0)[:, None], moments, self._whole - moments)


def _integral(t: FloatArray, powers: IntArray) -> FloatArray:
    """Of powers of the distance from 1/2, from 0 to t, shape (len(t), len(powers))."""
    return np.asarray(((t[:, None] - 0.5) ** (powers + 1) - (-0.5) ** (powers + 1)) / (powers + 1))
