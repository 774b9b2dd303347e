"""Weights of the two sides on the boundary of the fluid, where a curve crosses it between vertices."""

import numpy as np
from dolfinx import mesh

from coudalfish.surface.cut_cells import CutCells
from tigar_x import compat
from tigar_x.compat import FloatArray, IntArray

EDGES = ((1, 2), (0, 2), (0, 1))
"""Vertices of the sides of a triangle."""


class WallWeights:
    """Weights of the negative side on the sides of cut triangles that are on the boundary.

    On every side they are the projection of the indicator on quadratic functions of it, in the mean square. Where two
    sides of a triangle meet they have the mean of both there.

    Args:
        domain: mesh of triangles.
        points: reference coordinates of the nodes of a quadratic element, shape (6, 2).
    """

    def __init__(self, domain: mesh.Mesh, points: FloatArray) -> None:
        vertices = compat.connectivity(domain, 2, 0).array.reshape(-1, 3)
        of_facets, cells_of = compat.connectivity(domain, 1, 0), compat.connectivity(domain, 1, 2)
        facets = compat.exterior_facets(domain)
        cells = cells_of.array[cells_of.offsets[facets]]
        ends = of_facets.array.reshape(-1, 2)[facets]
        inside = (vertices[cells][:, :, None] == ends[:, None]).any(axis=2)
        self._on_wall = np.zeros((len(vertices), 3), dtype=bool)
        self._on_wall[cells, (~inside).argmax(axis=1)] = True
        places = np.column_stack([1.0 - points.sum(axis=1), points])
        corner = np.eye(3)
        middles = [np.mean([corner[a], corner[b]], axis=0) for a, b in EDGES]
        self._nodes: list[IntArray] = [
            np.array([int(np.linalg.norm(places - place, axis=1).argmin()) for place in (corner[a], middle, corner[b])])
            for (a, b), middle in zip(EDGES, middles, strict=True)
        ]

    def __call__(self, cut: CutCells) -> tuple[IntArray, FloatArray]:
        """Those cut cells that have a side on the boundary, and values at their nodes, shape (found, 6)."""
        on_wall = self._on_wall[cut.cells]
        found = np.flatnonzero(on_wall.any(axis=1))
        sums, counts = np.zeros((len(found), 6)), np.zeros((len(found), 6))
        for k, (a, b) in enumerate(EDGES):
            here = np.flatnonzero(on_wall[found, k])
            values = cut.values[found[here]]
            places = np.ix_(here, self._nodes[k])
            sums[places] += _negative(values[:, a], values[:, b])
            counts[places] += 1.0
        return cut.cells[found], sums / np.maximum(counts, 1.0)


def _negative(a: FloatArray, b: FloatArray) -> FloatArray:
    """Projections of where a linear function is negative, at start, middle and end of its line, shape (lines, 3)."""
    gap = np.where(a == b, 1.0, a - b)
    t = np.clip(np.where(a == b, 1.0, a / gap), 0.0, 1.0)
    t = np.where((a < 0.0) == (b < 0.0), 1.0, t)
    # integrals from 0 to t of the quadratic functions that are one at 0, 1/2 and 1
    ends = np.column_stack([t - 1.5 * t**2 + 2 / 3 * t**3, 2 * t**2 - 4 / 3 * t**3, 2 / 3 * t**3 - 0.5 * t**2])
    whole = np.array([1.0, 4.0, 1.0]) / 6.0
    moments = np.where((a < 0.0)[:, None], ends, whole - ends)
    mass = np.array([[4.0, 2.0, -1.0], [2.0, 16.0, 2.0], [-1.0, 2.0, 4.0]]) / 30.0
    return np.asarray(np.linalg.solve(mass, moments.T).T)
