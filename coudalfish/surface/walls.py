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
        self._nodes = [np.flatnonzero(np.abs(places[:, k]) < ON_EDGE) for k in range(3)]
        self._along = [places[nodes, b] for nodes, (_, b) in zip(self._nodes, EDGES, strict=True)]
        self._powers, self._count = np.arange(degree + 1), len(points)

    def __call__(self, cut: CutCells) -> tuple[IntArray, FloatArray]:
        """Those cut cells that have a side on the boundary, and values at their nodes, shape (found, nodes)."""
        on_wall = self._on_wall[cut.cells]
        found = np.flatnonzero(on_wall.any(axis=1))
        sums, counts = np.zeros((2, len(found), self._count))
        for k, (a, b) in enumerate(EDGES):
            here = np.flatnonzero(on_wall[found, k])
            values = cut.values[found[here]]
            places = np.ix_(here, self._nodes[k])
            sums[places] += self._negative(values[:, a], values[:, b], self._along[k])
            counts[places] += 1.0
        return cut.cells[found], sums / np.maximum(counts, 1.0)

    def _negative(self, a: FloatArray, b: FloatArray, at: FloatArray) -> FloatArray:
        """Projections of where a linear function is negative, which is a at 0 and b at 1, shape (lines, len(at))."""
        gap = np.where(a == b, 1.0, a - b)
        t = np.where((a < 0.0) == (b < 0.0), 1.0, np.clip(a / gap, 0.0, 1.0))
        n, sums = self._powers, self._powers + self._powers[:, None]
        mass, whole = self._integral(np.ones(1), sums.ravel()).reshape(sums.shape), self._integral(np.ones(1), n)
        moments = self._integral(t, n)
        moments = np.where((a < 0.0)[:, None], moments, whole - moments)
        return np.asarray(moments @ np.linalg.solve(mass, ((at - 0.5) ** n[:, None])))

    @staticmethod
    def _integral(t: FloatArray, powers: IntArray) -> FloatArray:
        """Of powers of the distance from 1/2, from 0 to t, shape (len(t), len(powers))."""
        return np.asarray(((t[:, None] - 0.5) ** (powers + 1) - (-0.5) ** (powers + 1)) / (powers + 1))
