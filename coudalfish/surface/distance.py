"""Signed distance from curves in the plane: on which side of them a point lies.

Behind a free end a curve is continued straight on, so that sides are defined there too.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from coudalfish.surface.sheets import Sheets
from tigar_x import checks
from tigar_x.compat import FloatArray, IntArray

SAME_DISTANCE = 1e-12
"""Difference of distances, relative to what they are sought within, that rounding makes: the first segment counts."""


@dataclass(frozen=True, eq=False)
class Curves:
    """Curves of straight segments, some closed, some with free ends.

    Attributes:
        x: positions of the points, shape (points, d); unit: length.
        segments: pairs of neighbouring points, all in one direction along a curve, shape (segments, 2).
        place: number of the place in which a point is, the same for points that a joint unites, shape (points,).
    """

    x: FloatArray
    segments: IntArray
    place: IntArray

    def __post_init__(self) -> None:
        checks.freeze(self)

    @classmethod
    def of(cls, sheets: Sheets, x: FloatArray) -> "Curves":
        """Curves through the points of a shell.

        Args:
            sheets: how they hang together.
            x: their positions, shape (points, d); unit: length.
        """
        turned = sheets.sign[sheets.cells[:, 0]] < 0.0
        segments = np.where(turned[:, None], sheets.cells[:, ::-1], sheets.cells)
        return cls(x, segments, sheets.places)

    @cached_property
    def _tangents(self) -> tuple[FloatArray, FloatArray]:
        """Unit tangents and lengths of the segments."""
        arms = self.x[self.segments[:, 1]] - self.x[self.segments[:, 0]]
        lengths = np.linalg.norm(arms, axis=1)
        return arms / lengths[:, None], lengths

    def _sums(self, values: FloatArray) -> FloatArray:
        """Of the segments that meet at a place, at every point."""
        total = np.zeros((self.place.max(initial=-1) + 1, values.shape[1]))
        for end in (0, 1):
            np.add.at(total, self.place[self.segments[:, end]], values)
        return total[self.place]

    @cached_property
    def free(self) -> Any:
        """Mask of the points at free ends, shape (points,)."""
        return np.bincount(self.place[self.segments.ravel()], minlength=len(self.x))[self.place] == 1

    @cached_property
    def _normals(self) -> tuple[FloatArray, FloatArray]:
        """Unit normals of the segments, and their sums at the points."""
        tangents, _ = self._tangents
        normals = np.column_stack([-tangents[:, 1], tangents[:, 0]])
        return normals, self._sums(normals)

    @cached_property
    def curve(self) -> IntArray:
        """Number of the curve to which a segment belongs, shape (segments,)."""
        ends, places = self.place[self.segments], self.place.max(initial=-1) + 1
        joined = sp.coo_matrix((np.ones(len(ends)), ends.T), shape=(places, places))
        return np.asarray(connected_components(joined, directed=False)[1][ends[:, 0]])

    @cached_property
    def _middles(self) -> cKDTree:
        return cKDTree(self.x[self.segments].mean(axis=1))

    def _near(self, x: FloatArray, reach: float, tree: cKDTree | None = None) -> "_Nearest":
        """Nearest places of the curves to points that are not farther than a distance, all that are equally near."""
        tangents, lengths = self._tangents
        radius = reach + 0.5 * float(lengths.max(initial=0.0))
        points = cKDTree(x) if tree is None else tree
        near = points.sparse_distance_matrix(self._middles, radius, output_type="ndarray")
        i, k = near["i"], near["j"]
        arms = x[i] - self.x[self.segments[k, 0]]
        along = np.clip((arms * tangents[k]).sum(axis=1), 0.0, lengths[k])
        gap = arms - along[:, None] * tangents[k]
        distance = np.linalg.norm(gap, axis=1)
        order = np.lexsort((k, i))
        starts = np.flatnonzero(np.diff(i[order], prepend=-1))
        least = np.minimum.reduceat(distance[order], starts) if len(starts) else np.empty(0)
        least = np.repeat(least, np.diff(np.append(starts, len(order))))
        best = order[distance[order] <= np.minimum(least + SAME_DISTANCE * radius, reach)]
        i, k, along = i[best], k[best], along[best]
        corner = np.where(along <= 0.0, self.segments[k, 0], np.where(along >= lengths[k], self.segments[k, 1], -1))
        return _Nearest(i, k, corner, gap[best], distance[best])

    def _nearest(self, x: FloatArray, reach: float, tree: cKDTree | None = None) -> "_Nearest":
        """The same, of equally near ones the first."""
        near = self._near(x, reach, tree)
        k = np.unique(near.point, return_index=True)[1]
        return _Nearest(near.point[k], near.segment[k], near.corner[k], near.gap[k], near.distance[k])

    def signed_distance(self, x: FloatArray, reach: float, tree: cKDTree | None = None) -> FloatArray:
        """Distance from the nearest curve, positive to its left, and negative where normals of a shell point.

        Args:
            x: points, shape (m, d); unit: length.
            reach: farther points get none; unit: length.
            tree: of the points; None: it is made.

        Returns:
            Shape (m,), not a number where a point is farther; beyond a free end the distance from the straight line
            that continues it. Unit: length.
        """
        return self.sides(x, reach, tree)[0]

    def sides(self, x: FloatArray, reach: float, tree: cKDTree | None = None) -> tuple[FloatArray, IntArray]:
        """Signed distance from the nearest curve, and which one that is.

        Args:
            x: see :meth:`signed_distance`.
            reach: see there.
            tree: see there.

        Returns:
            Distances as there, and numbers of curves, -1 where a point is farther, both of shape (m,).
        """
        near, (of_segments, of_points) = self._nearest(x, reach, tree), self._normals
        at_corner = near.corner >= 0
        normal = np.where(at_corner[:, None], of_points[near.corner], of_segments[near.segment])
        side = (near.gap * normal).sum(axis=1)
        beyond = at_corner & self.free[near.corner]
        result = np.full(len(x), np.nan)
        result[near.point] = np.where(beyond, side, np.where(side < 0.0, -near.distance, near.distance))
        nearest = np.full(len(x), -1)
        nearest[near.point] = self.curve[near.segment]
        return result, nearest

    def crossed(self, start: FloatArray, end: FloatArray, reach: float) -> Any:
        """Mask of the straight lines that cross a curve or its continuation, shape (m,).

        Args:
            start: where they begin, shape (m, 2); unit: length.
            end: where they end.
            reach: how far curves are continued; unit: length.
        """
        result = np.zeros(len(start), dtype=bool)
        a, b = self._continued(reach)
        if not len(start) or not len(a):
            return result
        longest = np.linalg.norm(end - start, axis=1).max() + np.linalg.norm(b - a, axis=1).max()
        lines, curve = cKDTree(0.5 * (start + end)), cKDTree(0.5 * (a + b))
        near = lines.sparse_distance_matrix(curve, 0.5 * longest, output_type="ndarray")
        i, k = near["i"], near["j"]
        parts = _side(start[i], end[i], a[k]) * _side(start[i], end[i], b[k])
        parted = _side(a[k], b[k], start[i]) * _side(a[k], b[k], end[i])
        result[i[(parts <= 0.0) & (parted <= 0.0)]] = True
        return result

    def _continued(self, reach: float) -> tuple[FloatArray, FloatArray]:
        """Starts and ends of the segments, and of those that continue them at free ends."""
        starts, ends = self.x[self.segments].transpose(1, 0, 2)
        arms, (first, last) = reach * self._tangents[0], self.free[self.segments].T
        begins = starts, ends[last], starts[first] - arms[first]
        return np.concatenate(begins), np.concatenate([ends, ends[last] + arms[last], starts[first]])

    def at_nearest(self, x: FloatArray, values: FloatArray, reach: float) -> FloatArray:
        """Values at the nearest places of the curves, and of what continues them behind free ends.

        Where several are equally near it is their mean, as mirror images of curves have mirrored values half way.

        Args:
            x: points, shape (m, d); unit: length.
            values: at the points of the curves, linear between them, shape (points, k).
            reach: farther points get none; unit: length.

        Returns:
            Shape (m, k), zero where a point is farther.
        """
        near, (tangents, lengths) = self._near(x, reach), self._tangents
        first, last = self.segments[near.segment].T
        along = ((x[near.point] - self.x[first]) * tangents[near.segment]).sum(axis=1) / lengths[near.segment]
        beyond = (near.corner >= 0) & self.free[near.corner]
        along = np.where(beyond, along, np.clip(along, 0.0, 1.0))[:, None]
        result, count = np.zeros((len(x), values.shape[1])), np.bincount(near.point, minlength=len(x))
        np.add.at(result, near.point, (1.0 - along) * values[first] + along * values[last])
        return result / np.maximum(count, 1)[:, None]

    def near_ends(self, x: FloatArray, reach: float, tree: cKDTree | None = None) -> Any:
        """Mask of the points that are not farther than a distance from a free end, shape (m,); see above."""
        result, ends = np.zeros(len(x), dtype=bool), self.x[self.free]
        if len(ends) and len(x):
            found = (cKDTree(x) if tree is None else tree).query_ball_point(ends, reach)
            result[np.concatenate(found).astype(np.int64)] = True
        return result

    def covers(self, x: FloatArray, reach: float) -> Any:
        """Whether the nearest place of the curves is not beyond a free end, shape (m,).

        Args:
            x: points, shape (m, d); unit: length.
            reach: farther points are not covered; unit: length.
        """
        near = self._nearest(x, reach)
        result = np.zeros(len(x), dtype=bool)
        result[near.point] = (near.corner < 0) | ~self.free[near.corner] | (near.distance == 0.0)
        return result


def _side(start: FloatArray, end: FloatArray, x: FloatArray) -> FloatArray:
    """On which side of lines points lie, by its sign."""
    along, off = end - start, x - start
    return np.asarray(along[:, 0] * off[:, 1] - along[:, 1] * off[:, 0])


@dataclass(frozen=True, eq=False)
class _Nearest:
    """Nearest places of curves.

    Attributes:
        point: to which points, ascending.
        segment: on which segments.
        corner: the points of the curves there, -1 within a segment.
        gap: from there to the points, shape (near, d); unit: length.
        distance: its length.
    """

    point: IntArray
    segment: IntArray
    corner: IntArray
    gap: FloatArray
    distance: FloatArray
