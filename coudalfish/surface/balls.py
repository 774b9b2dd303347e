"""Which cells of a surface may be near points or on lines: those of which a ball and a slab around them are."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from coudalfish.surface.triangles import Triangles
from tigar_x import checks
from tigar_x.compat import FloatArray, IntArray

CLASSES = 3
"""Cells are sought in classes by their sizes, each twice as large as the next, and the last one of all others."""
FINE = 0.25
"""Points are sought together whose bounds, and the size of a cell more, differ by no more than this share."""
ROUNDED = 1e-9
"""Part of the size of a cell that rounding may lack: no cell that counts is lost."""


@dataclass(frozen=True, eq=False)
class Balls:
    """Balls and slabs around cells.

    Attributes:
        middles: of the cells, shape (cells, 3); unit: length.
        radius: how far they reach from there, shape (cells,).
        normals: unit normals, shape (cells, 3).
        thickness: how far they reach from there along these, shape (cells,).
    """

    middles: FloatArray
    radius: FloatArray
    normals: FloatArray
    thickness: FloatArray

    def __post_init__(self) -> None:
        checks.freeze(self)

    @classmethod
    def of(cls, triangles: Triangles, parts: int = 1) -> "Balls":
        """Around cells of some triangles each.

        Args:
            triangles: cell by cell.
            parts: how many there are in each.
        """
        corners = triangles.x.reshape(-1, 3 * parts, 3)
        middles = 0.5 * (corners.min(axis=1) + corners.max(axis=1))
        off = corners - middles[:, None]
        normals = triangles.area_vectors.reshape(-1, parts, 3).sum(axis=1)
        normals /= np.maximum(np.sqrt(np.einsum("ci,ci->c", normals, normals)), np.finfo(float).tiny)[:, None]
        thickness = np.abs(np.einsum("cki,ci->ck", off, normals)).max(axis=1, initial=0.0)
        radius = np.sqrt(np.einsum("cki,cki->ck", off, off).max(axis=1, initial=0.0))
        return cls(middles, radius, normals, thickness + ROUNDED * radius)

    @cached_property
    def _tree(self) -> cKDTree:
        return cKDTree(self.middles)

    @cached_property
    def _classes(self) -> list[tuple[IntArray, float, cKDTree]]:
        """Cells of about the same size, how far the largest of them reaches from its middle, and trees of these."""
        number = np.maximum(np.ceil(np.log2(self.radius / self.radius.max(initial=0.0))), -CLASSES)
        found = []
        for one in np.unique(number):
            members = np.flatnonzero(number == one)
            found.append((members, float(self.radius[members].max()), cKDTree(self.middles[members])))
        return found

    def _touched(self, x: FloatArray, bound: FloatArray) -> list[tuple[IntArray, IntArray, FloatArray]]:
        """Points, cells of which the balls are no farther from these than a bound, and distances of the middles."""
        found, unit = [], float(np.median(self.radius)) if len(self.radius) else 1.0
        step = np.floor(np.log1p(bound / unit) / np.log1p(FINE))
        for number in np.unique(step):
            points = np.flatnonzero(step == number)
            tree, farthest = cKDTree(x[points]), float(bound[points].max())
            for members, largest, of_class in self._classes:
                near = tree.sparse_distance_matrix(of_class, farthest + largest, output_type="ndarray")
                i, k, distance = points[near["i"]], members[near["j"]], near["v"]
                some = distance <= bound[i] + self.radius[k]
                found.append((i[some], k[some], distance[some]))
        return found

    def nearest(self, x: FloatArray, limit: FloatArray) -> tuple[IntArray, IntArray]:
        """Points to which cells may be within a limit, ascending, and the cells with the nearest middles.

        Args:
            x: points, shape (n, 3); unit: length.
            limit: how far cells may be, negative where none counts, shape (n,).
        """
        tree, largest = self._tree, float(self.radius.max(initial=0.0))
        known, wanted = np.full(len(x), len(self.middles)), np.flatnonzero(limit >= 0.0)
        step = np.ceil(np.log2(limit[wanted] + largest))
        for number in np.unique(step):
            points = wanted[step == number]
            within = float(limit[points].max()) + largest
            distance, cell = tree.query(x[points], distance_upper_bound=within)
            known[points] = np.where(distance <= limit[points] + largest, cell, len(self.middles))
        points = np.flatnonzero(known < len(self.middles))
        return points, known[points]

    def near(self, x: FloatArray, bound: FloatArray, known: IntArray) -> tuple[IntArray, IntArray]:
        """Pairs of points and cells that may be no farther than a bound, but for one cell of each point.

        Args:
            x: points, shape (n, 3); unit: length.
            bound: how far cells may be, shape (n,).
            known: the cell that does not count, shape (n,).
        """
        pairs = [(known[:0], known[:0])]
        for i, k, distance in self._touched(x, bound):
            height = np.einsum("pi,pi->p", x[i] - self.middles[k], self.normals[k])
            aside = np.maximum(np.sqrt(np.maximum(distance**2 - height**2, 0.0)) - self.radius[k], 0.0)
            above = np.maximum(np.abs(height) - self.thickness[k], 0.0)
            some = (above**2 + aside**2 <= bound[i] ** 2) & (k != known[i])
            pairs.append((i[some], k[some]))
        i, k = (np.concatenate(part) for part in zip(*pairs, strict=True))
        return i, k

    def pierced(self, start: FloatArray, end: FloatArray) -> tuple[IntArray, IntArray]:
        """Pairs of straight lines and cells through which they may pass.

        Args:
            start: where lines begin, shape (n, 3); unit: length.
            end: where they end.
        """
        no = np.empty(0, dtype=np.int64)
        pairs, middle, arm = [(no, no)], 0.5 * (start + end), 0.5 * (end - start)
        half = np.sqrt(np.einsum("pi,pi->p", arm, arm))
        for i, k, _ in self._touched(middle, (1.0 + ROUNDED) * half):
            off = self.middles[k] - middle[i]
            height, rise = (np.einsum("pi,pi->p", way, self.normals[k]) for way in (off, arm[i]))
            t = np.clip(np.einsum("pi,pi->p", off, arm[i]) / np.maximum(half[i] ** 2, np.finfo(float).tiny), -1.0, 1.0)
            off -= t[:, None] * arm[i]
            beside = np.einsum("pi,pi->p", off, off) <= ((1.0 + ROUNDED) * self.radius[k]) ** 2
            some = beside & (np.abs(height) <= np.abs(rise) + self.thickness[k])
            pairs.append((i[some], k[some]))
        line, cell = (np.concatenate(part) for part in zip(*pairs, strict=True))
        return line, cell
