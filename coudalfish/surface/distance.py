"""Signed distance from curves in the plane: on which side of them a point lies.

Behind a free end a curve is continued straight on, so that sides are defined there too.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from coudalfish.surface.interface import SAME_DISTANCE, Sought
from coudalfish.surface.sheets import Chain, Sheets
from tigar_x import checks
from tigar_x.compat import FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class Curves:
    """Curves of straight segments, some closed, some with free ends.

    Attributes:
        x: positions of the points, shape (points, d); unit: length.
        chain: how they hang together.
    """

    x: FloatArray
    chain: Chain

    def __post_init__(self) -> None:
        checks.freeze(self)

    @classmethod
    def of(cls, sheets: Sheets, x: FloatArray) -> "Curves":
        """Curves through the points of a shell.

        Args:
            sheets: how they hang together.
            x: their positions, shape (points, d); unit: length.
        """
        return cls(x, sheets.chain)

    @property
    def sheets(self) -> int:
        """Number of the connected curves."""
        return int(self.chain.curve.max(initial=-1)) + 1

    @cached_property
    def tangents(self) -> tuple[FloatArray, FloatArray]:
        """Unit tangents and lengths of the segments."""
        arms = self.x[self.chain.segments[:, 1]] - self.x[self.chain.segments[:, 0]]
        lengths = np.sqrt(np.einsum("si,si->s", arms, arms))
        return arms / lengths[:, None], lengths

    @cached_property
    def normals(self) -> tuple[FloatArray, FloatArray]:
        """Unit normals of the segments, and their sums at the points."""
        tangents, _ = self.tangents
        normals = np.column_stack([-tangents[:, 1], tangents[:, 0]])
        return normals, self.chain.sums(normals)

    @cached_property
    def _middles(self) -> cKDTree:
        starts, ends = self.chain.segments.T
        return cKDTree(0.5 * (self.x[starts] + self.x[ends]))

    def nearest(self, x: FloatArray, *sought: Sought) -> "NearestOnCurves":
        """Nearest places of the curves to points.

        Args:
            x: points, shape (m, d); unit: length.
            sought: of which of them, at least one; of points that are sought twice the last reach counts.
        """
        tangents, lengths = self.tangents
        half, limit, none = 0.5 * float(lengths.max(initial=0.0)), np.zeros(len(x)), np.empty(0, dtype=np.int64)
        pairs = [(none, none)]
        for one in sought:
            if not len(one.points):
                continue
            limit[one.points] = one.reach
            tree = cKDTree(x[one.points]) if one.tree is None else one.tree
            near = tree.sparse_distance_matrix(
                self._middles, np.max(one.reach, initial=0.0) + half, output_type="ndarray"
            )
            pairs.append((one.points[near["i"]], near["j"]))
        i, k = (np.concatenate(part) for part in zip(*pairs, strict=True))
        group, order = _grouped(i, len(x))
        i, k = i[order], k[order]
        starts = self.x[self.chain.segments[:, 0]]
        arms, t = x.take(i, axis=0) - starts.take(k, axis=0), tangents.take(k, axis=0)
        along = np.einsum("pi,pi->p", arms, t)
        gap = arms - np.clip(along, 0.0, lengths[k])[:, None] * t
        distance = np.sqrt(np.einsum("pi,pi->p", gap, gap))
        tolerance = SAME_DISTANCE * (limit.max(initial=0.0) + half)
        best = _least(distance, tolerance, k, group)
        best = best[distance[best] <= limit[i[best]]]
        return NearestOnCurves(self, len(x), i[best], k[best], along[best], gap[best], distance[best])

    def crossed(self, start: FloatArray, end: FloatArray, reach: float | FloatArray) -> Any:
        """Mask of the straight lines that cross a curve or its continuation, shape (m,).

        Args:
            start: where they begin, shape (m, 2); unit: length.
            end: where they end.
            reach: how far curves are continued, or how far for each line; unit: length.
        """
        result = np.zeros(len(start), dtype=bool)
        if not len(start) or not len(self.chain.segments):
            return result
        reach = np.broadcast_to(reach, len(start))
        farthest = float(reach.max())
        a, b, from_end = self._continued(farthest)
        longest = np.linalg.norm(end - start, axis=1).max() + np.linalg.norm(b - a, axis=1).max()
        lines, curve = cKDTree(0.5 * (start + end)), cKDTree(0.5 * (a + b))
        near = lines.sparse_distance_matrix(curve, 0.5 * longest, output_type="ndarray")
        i, k = near["i"], near["j"]
        at_a, at_b = _side(start[i], end[i], a[k]), _side(start[i], end[i], b[k])
        parted = _side(a[k], b[k], start[i]) * _side(a[k], b[k], end[i])
        there = (at_a * at_b <= 0.0) & (parted <= 0.0)
        i, k, at_a, size = i[there], k[there], at_a[there], (at_a - at_b)[there]
        along = farthest * np.divide(at_a, size, out=np.zeros_like(size), where=size != 0.0)
        result[i[~from_end[k] | (along <= reach[i])]] = True
        return result

    def _continued(self, reach: float) -> tuple[FloatArray, FloatArray, Any]:
        """Starts and ends of the segments and of those that continue them at free ends, and the mask of these."""
        starts, ends = self.x[self.chain.segments].transpose(1, 0, 2)
        arms, (first, last) = reach * self.tangents[0], self.chain.free[self.chain.segments].T
        a, b = [starts, ends[last], starts[first]], [ends, ends[last] + arms[last], starts[first] - arms[first]]
        return np.concatenate(a), np.concatenate(b), np.arange(sum(map(len, a))) >= len(starts)

    def near_ends(self, x: FloatArray, reach: float | FloatArray) -> IntArray:
        """Those of some points that are not farther than a distance from a free end, ascending.

        Args:
            x: points, shape (m, d); unit: length.
            reach: the distance, or one for each point; unit: length.
        """
        near, reach = np.zeros(len(x), dtype=bool), np.broadcast_to(reach, len(x))
        for end in self.x[self.chain.free]:
            beside = np.flatnonzero(np.abs(x[:, 0] - end[0]) <= reach)
            gap = x[beside] - end
            near[beside[np.einsum("pi,pi->p", gap, gap) <= reach[beside] ** 2]] = True
        return np.flatnonzero(near)


def _side(start: FloatArray, end: FloatArray, x: FloatArray) -> FloatArray:
    """On which side of lines points lie, by its sign."""
    along, off = end - start, x - start
    return np.asarray(along[:, 0] * off[:, 1] - along[:, 1] * off[:, 0])


@dataclass(frozen=True, eq=False)
class NearestOnCurves:
    """Nearest places of curves to points, those that are in reach, all that are equally near.

    Attributes:
        curves: the curves.
        count: number m of the points.
        point: to which of them, ascending, shape (near,).
        segment: on which segments, of one point ascending, shape (near,).
        along: how far along these they are, below zero and beyond their lengths behind free ends, shape (near,); unit:
            length.
        gap: from there to the points, shape (near, d); unit: length.
        distance: its length, shape (near,).
    """

    curves: Curves
    count: int
    point: IntArray
    segment: IntArray
    along: FloatArray
    gap: FloatArray
    distance: FloatArray

    def __post_init__(self) -> None:
        checks.freeze(self)

    @cached_property
    def _first(self) -> IntArray:
        """The first place of each point."""
        return np.flatnonzero(np.diff(self.point, prepend=-1))

    @cached_property
    def _corner(self) -> IntArray:
        """The points of the curves there, -1 within a segment."""
        ends, lengths = self.curves.chain.segments[self.segment], self.curves.tangents[1][self.segment]
        return np.where(self.along <= 0.0, ends[:, 0], np.where(self.along >= lengths, ends[:, 1], -1))

    @cached_property
    def _beyond(self) -> Any:
        """Mask of those behind a free end, or at it."""
        return (self._corner >= 0) & self.curves.chain.free[self._corner]

    def signed_distance(self) -> FloatArray:
        """Distance from the nearest curve, positive to its left, and negative where normals of a shell point.

        Returns:
            Shape (m,), not a number where a point is farther; beyond a free end the distance from the straight line
            that continues it. Unit: length.
        """
        of_segments, of_points = self.curves.normals
        normal = np.where((self._corner >= 0)[:, None], of_points[self._corner], of_segments[self.segment])
        side = np.einsum("pi,pi->p", self.gap, normal)
        return self._spread(np.where(self._beyond, side, np.where(side < 0.0, -self.distance, self.distance)), np.nan)

    def sheet(self) -> IntArray:
        """Number of the nearest curve, -1 where a point is farther, shape (m,)."""
        return self._spread(self.curves.chain.curve[self.segment], -1)

    def covered(self) -> Any:
        """Whether the nearest place is not beyond a free end, shape (m,); farther points are not covered."""
        return self._spread(~self._beyond | (self.distance == 0.0), False)

    def values(self, of_points: FloatArray) -> FloatArray:
        """Values at the nearest places, and of what continues the curves behind free ends.

        Where several are equally near it is their mean, as mirror images of curves have mirrored values half way.

        Args:
            of_points: at the points of the curves, linear between them, shape (points, k).

        Returns:
            Shape (m, k), zero where a point is farther.
        """
        first, last = self.curves.chain.segments[self.segment].T
        at = self.along / self.curves.tangents[1][self.segment]
        at = np.where(self._beyond, at, np.clip(at, 0.0, 1.0))[:, None]
        values = (1.0 - at) * of_points[first] + at * of_points[last]
        count = np.bincount(self.point, minlength=self.count)
        sums = np.stack([np.bincount(self.point, column, self.count) for column in values.T], axis=1)
        return np.asarray(sums / np.maximum(count, 1)[:, None])

    def _spread(self, values: Any, otherwise: Any) -> Any:
        """Values of all points, out of those of the near places, of which the first counts."""
        result = np.full(self.count, otherwise, dtype=values.dtype)
        result[self.point[self._first]] = values[self._first]
        return result


def _grouped(i: IntArray, count: int) -> tuple[Any, Any]:
    """An order in which numbers below a count ascend, and which of their different ones each of them is then."""
    there = np.zeros(count, dtype=bool)
    there[i] = True
    different = np.flatnonzero(there)
    number = np.empty(count, dtype=np.uint16 if len(different) < 2**16 else np.int64)  # short ones are sorted at once
    number[different] = np.arange(len(different))
    group = number[i]
    order = np.argsort(group, kind="stable")
    return group[order], order


def _least(values: FloatArray, tolerance: float, k: IntArray, group: IntArray) -> IntArray:
    """Places of the least values of every group, and of those that are not larger by more than a tolerance.

    Args:
        values: shape (n,).
        tolerance: see above.
        k: by which places of a group are sorted, shape (n,).
        group: numbers of the groups, ascending without gaps.
    """
    if not len(group):
        return np.empty(0, dtype=np.int64)
    starts = np.flatnonzero(np.diff(group, prepend=group[0] + 1))
    best = np.flatnonzero(values <= np.minimum.reduceat(values, starts)[group] + tolerance)
    return best if len(best) == len(starts) else best[np.lexsort((k[best], group[best]))]
