"""Signed distance from surfaces in space: on which side of them a point lies.

Signs come from normals of faces, means of those at edges, and means by angles at corners, with which they are right
for every closed surface (Baerentzen and Aanaes, doi:10.1109/TVCG.2005.49). Behind an edge at which it ends a surface is
continued straight on in the planes of its triangles, so that sides are defined there too.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse as sp

from coudalfish.surface.boxes import CORNER, EDGE, Boxes, NearPlaces
from coudalfish.surface.interface import Sought
from coudalfish.surface.net import Ending, Net
from coudalfish.surface.triangles import Triangles
from tigar_x import checks
from tigar_x.compat import FloatArray, IntArray
from tigar_x.fem.simplices import cross_products


@dataclass(frozen=True, eq=False)
class Surfaces:
    """Surfaces of triangles, some closed, some with edges at which they end.

    Attributes:
        x: positions of the points, shape (points, 3); unit: length.
        net: how they hang together.
    """

    x: FloatArray
    net: Net

    def __post_init__(self) -> None:
        checks.freeze(self)

    @property
    def sheets(self) -> int:
        """Number of the connected surfaces."""
        return int(self.net.sheet.max(initial=-1)) + 1

    @cached_property
    def span(self) -> FloatArray:
        """Least and largest coordinates of the points, shape (2, 3), no rows without points; unit: length."""
        return np.stack([self.x.min(axis=0), self.x.max(axis=0)]) if len(self.x) else self.x

    @cached_property
    def triangles(self) -> Triangles:
        """Where they are."""
        return Triangles(np.take(self.net.functions @ self.x, self.net.triangles, axis=0))  # far faster than an index

    @cached_property
    def spacings(self) -> FloatArray:
        """Mean distances of points in the cells to which triangles belong, shape (triangles,); unit: length."""
        parts, areas = self.net.parts, self.triangles.areas
        of_points = areas.reshape(-1, parts).sum(axis=1) * (2.0 if parts == 1 else 1.0)
        return np.repeat(np.sqrt(of_points), parts)

    def normals(self, triangle: IntArray, kind: IntArray) -> FloatArray:
        """Unit normals of faces, edges and corners.

        Args:
            triangle: of which triangles, shape (n,).
            kind: which of their places, see :mod:`coudalfish.surface.boxes`, shape (n,).

        Returns:
            Shape (n, 3), zero where a triangle has no area.
        """
        triangles, result = self.triangles, self.triangles.normals[triangle]
        for first, at in ((EDGE, self.net.edges), (CORNER, self.net.corners)):
            there = np.flatnonzero((kind >= first) & (kind < first + 3))
            wanted, place = np.unique(at[triangle[there], kind[there] - first], return_inverse=True)
            around, of = (self.net.around_edges if first == EDGE else self.net.around_places)(wanted)
            k, corner = np.divmod(around, 3)
            values = triangles.normals[k]
            if first == CORNER:
                values = triangles.angles(k, corner)[:, None] * values
            sums = [np.bincount(of, column, len(wanted))[place] for column in values.T]
            result[there] = np.stack(sums, axis=1)
        return np.asarray(result / np.maximum(np.linalg.norm(result, axis=1)[:, None], np.finfo(float).tiny))

    @cached_property
    def _boxes(self) -> Boxes:
        """Around the triangles."""
        return Boxes.of(self.triangles, self.net.parts, self.net.order)

    @cached_property
    def _of_sheets(self) -> tuple[Boxes, ...]:
        """Around those of each connected surface."""
        return tuple(self._boxes.only(self.net.sheet == k) for k in range(self.sheets))

    def nearest(self, x: FloatArray, *sought: Sought, sheet: int | None = None) -> "NearestOnSurfaces":
        """Nearest places of the surfaces to points.

        Args:
            x: points, shape (m, 3); unit: length.
            sought: of which of them, at least one; of points that are sought twice the last reach counts.
            sheet: of which connected surface; None: of all.
        """
        limit = np.full(len(x), -1.0)
        for one in sought:
            limit[one.points] = one.reach
        near = (self._boxes if sheet is None else self._of_sheets[sheet]).nearest(x, limit)
        return NearestOnSurfaces(self, len(x), near.only(self._different(near)))

    def _different(self, near: NearPlaces) -> IntArray:
        """An order in which points ascend, and triangles of one point, without places that are the same."""
        order = np.lexsort((near.triangle, near.point))
        point = near.point[order]
        same = np.diff(point, prepend=-1, append=-1) == 0
        several = np.flatnonzero(same[1:] | same[:-1])
        if not len(several):
            return order
        places = order[several]
        keys = point[several] * self.net.count + self.net.numbers[near.triangle[places], near.kind[places]]
        kept = np.ones(len(order), dtype=bool)
        kept[several] = False
        kept[several[np.unique(keys, return_index=True)[1]]] = True
        return order[kept]

    def crossed(self, start: FloatArray, end: FloatArray, reach: float | FloatArray) -> Any:
        """Mask of the straight lines that cross a surface or its continuation, shape (m,).

        Args:
            start: where they begin, shape (m, 3); unit: length.
            end: where they end.
            reach: how far surfaces are continued, or how far for each line; unit: length.
        """
        result = np.zeros(len(start), dtype=bool)
        if not len(start) or not len(self.net.triangles):
            return result
        result[self._boxes.pierced(start, end)[0]] = True
        ends = self.net.at_ends
        a, b, away = self._at_ends(ends)
        if not len(a):
            return result
        reach = np.broadcast_to(reach, len(start))
        c, d = b + reach.max() * away, a + reach.max() * away
        beyond = Triangles(np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)]))
        order = None if ends.order is None else np.stack([ends.order, ends.order + len(a)], axis=1).ravel()
        line, k = Boxes.of(beyond, 1, order).pierced(start, end)
        from_edge, height = (
            [np.einsum("li,li->l", x[line] - a[k % len(a)], way) for x in (start, end)]
            for way in (away[k % len(a)], beyond.normals[k])
        )
        rise = height[0] - height[1]
        t = np.divide(height[0], rise, out=np.zeros_like(rise), where=rise != 0.0)
        result[line[(1.0 - t) * from_edge[0] + t * from_edge[1] <= reach[line]]] = True
        return result

    def _at_ends(self, edges: Ending) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Both ends of some edges at which surfaces end, and the directions away from these, shape (edges, 3)."""
        a, b = self.x[edges.points.T]
        away = cross_products(b - a, self.triangles.normals[edges.triangle])
        return a, b, away / np.linalg.norm(away, axis=1)[:, None]

    def near_sheet(self, k: int, x: FloatArray, reach: FloatArray) -> Any:
        """Mask of points that are not farther from a connected surface than a reach, one for each, shape (m,)."""
        return self._of_sheets[k].within(x, reach)

    def near_ends(self, x: FloatArray, reach: float | FloatArray) -> IntArray:
        """Those of some points that are not farther than a distance from an edge at which a surface ends, ascending.

        Edges at which a surface is attached to a wall do not count.

        Args:
            x: points, shape (m, 3); unit: length.
            reach: the distance, or one for each point; unit: length.
        """
        return np.flatnonzero(self._free.within(x, np.broadcast_to(reach, len(x))))

    def from_ends(self, x: FloatArray, reach: float | FloatArray) -> FloatArray:
        """Distances of points from these edges, infinite where they are farther; arguments as in :meth:`near_ends`."""
        reach = np.broadcast_to(reach, len(x))
        near, result = self._free.nearest(x, reach), np.full(len(x), np.inf)
        result[near.point] = near.distance
        return result

    @cached_property
    def _free(self) -> Boxes:
        """The edges at which surfaces end freely, as triangles without areas."""
        a, b = self.x[self.net.at_free.points.T]
        return Boxes.around(np.stack([a, b, b], axis=1), 1, self.net.at_free.order)


@dataclass(frozen=True, eq=False)
class NearestOnSurfaces:
    """Nearest places of surfaces to points, those that are in reach, all that are equally near.

    Attributes:
        surfaces: the surfaces.
        count: number m of the points.
        places: the places, of one point by their triangles, ascending.
    """

    surfaces: Surfaces
    count: int
    places: NearPlaces

    def __post_init__(self) -> None:
        checks.freeze(self)

    def of(self, points: IntArray) -> "NearestOnSurfaces":
        """Those of some of the points, ascending."""
        number = np.full(self.count, -1)
        number[points] = np.arange(len(points))
        places = self.places.only(number[self.places.point] >= 0)
        return NearestOnSurfaces(self.surfaces, len(points), places._replace(point=number[places.point]))

    @cached_property
    def _first(self) -> IntArray:
        """The first place of each point."""
        return np.flatnonzero(np.diff(self.places.point, prepend=-1))

    @cached_property
    def _normals(self) -> FloatArray:
        """Those of the surface at the first places, shape (points in reach, 3)."""
        return self.surfaces.normals(self.places.triangle[self._first], self.places.kind[self._first])

    @cached_property
    def _beyond(self) -> Any:
        """Mask of those behind an edge at which the surface ends, or on it."""
        return self._on(self.surfaces.net.ends, self.surfaces.net.places_at_ends)

    @cached_property
    def _beyond_free(self) -> Any:
        """Mask of those behind an edge at which it ends freely, or on it."""
        return self._on(self.surfaces.net.free, self.surfaces.net.places_at_free)

    def _on(self, edges: Any, ends: Any) -> Any:
        """Mask of those on some edges, by masks of these and of the places at their ends."""
        net, triangle, kind = self.surfaces.net, self.places.triangle, self.places.kind
        on_edge, at_corner = (kind >= EDGE) & (kind < CORNER), kind >= CORNER
        result = np.zeros(len(kind), dtype=bool)
        result[on_edge] = edges[net.edges[triangle[on_edge], kind[on_edge] - EDGE]]
        result[at_corner] = ends[net.corners[triangle[at_corner], kind[at_corner] - CORNER]]
        return result

    def signed_distance(self) -> FloatArray:
        """Distance from the nearest surface, negative where normals of a shell point.

        Returns:
            Shape (m,), not a number where a point is farther; behind an edge at which the surface ends the distance
            from the plane that continues it. Unit: length.
        """
        k = self._first
        side, distance = -np.einsum("pi,pi->p", self.places.gap[k], self._normals), self.places.distance[k]
        return self._spread(np.where(self._beyond[k], side, np.where(side < 0.0, -distance, distance)), np.nan)

    def normals(self) -> FloatArray:
        """Unit normals there, to where the distance is positive, zero where a point is farther, shape (m, 3)."""
        k, result = self._first, np.zeros((self.count, 3))
        result[self.places.point[k]] = -self._normals
        return result

    def gaps(self) -> FloatArray:
        """From the nearest places to the points, zero where one is farther, shape (m, 3); unit: length."""
        k, result = self._first, np.zeros((self.count, 3))
        result[self.places.point[k]] = self.places.gap[k]
        return result

    def distances(self) -> FloatArray:
        """Of the points, zero where one is farther, shape (m,); unit: length."""
        return self._spread(self.places.distance[self._first], 0.0)

    def sheet(self) -> IntArray:
        """Number of the nearest sheet, -1 where a point is farther, shape (m,)."""
        return self._spread(self.surfaces.net.sheet[self.places.triangle[self._first]], -1)

    def triangle(self, reach: FloatArray) -> IntArray:
        """Number of the nearest triangle, -1 where a point is farther than a reach, one for each, shape (m,)."""
        k = self._first
        near = self.places.distance[k] <= reach[self.places.point[k]]
        return self._spread(np.where(near, self.places.triangle[k], -1), -1)

    def covered(self) -> Any:
        """Whether the nearest place is not beyond a free edge, shape (m,); farther points are not covered."""
        k = self._first
        return self._spread(~self._beyond_free[k] | (self.places.distance[k] == 0.0), False)

    def margin(self, reach: FloatArray) -> FloatArray:
        """Distance to the next free edge along the surface, negative beyond it.

        Args:
            reach: the largest margin that is of interest, shape (m,); unit: length.

        Returns:
            Shape (m,), no more than the reach, and minus that where a point is farther from the surface.
        """
        k, surfaces = self._first, self.surfaces
        normal = surfaces.triangles.normals[self.places.triangle[k]]
        along = self.places.gap[k] - np.einsum("pi,pi->p", self.places.gap[k], normal)[:, None] * normal
        inner = self.places.barycentric[k]
        feet = np.einsum("pc,pci->pi", inner, surfaces.triangles.x[self.places.triangle[k]])
        there = reach[self.places.point[k]]
        margin = np.minimum(surfaces.from_ends(feet, there), there)
        beyond = -np.sqrt(np.einsum("pi,pi->p", along, along))
        return self._spread(np.where(self._beyond_free[k], beyond, margin), -reach)

    def functions(self) -> sp.csr_matrix:
        """Hat functions of the points of the surfaces at the nearest places, the mean where several are equally near.

        Returns:
            Shape (m, points of the surfaces), rows without entries where a point is farther.
        """
        net, point = self.surfaces.net, self.places.point
        count = np.bincount(point, minlength=self.count)
        values = self.places.barycentric / count[point, None]
        entries = values.ravel(), net.triangles[self.places.triangle].ravel(), 3 * np.append(0, np.cumsum(count))
        return sp.csr_matrix(entries, shape=(self.count, net.functions.shape[0])) @ net.functions

    def values(self, of_points: FloatArray) -> FloatArray:
        """Values at the nearest places, and of what continues the surfaces behind edges at which they end.

        Where several are equally near it is their mean, as mirror images of surfaces have mirrored values half way.

        Args:
            of_points: at the points of the surfaces, linear in triangles, shape (points, k).

        Returns:
            Shape (m, k), zero where a point is farther.
        """
        return self.of_corners(self.surfaces.net.functions @ of_points)

    def of_corners(self, values: FloatArray) -> FloatArray:
        """The same of values at the corners of the triangles, shape (corners, k)."""
        (net, places), k = (self.surfaces.net, self.places), np.flatnonzero(self._beyond)
        inner, corners = places.barycentric, self.surfaces.triangles
        x = np.einsum("pc,pci->pi", inner[k], corners.x[places.triangle[k]]) + places.gap[k]
        inner[k] = corners.in_plane(x, places.triangle[k])
        each = np.einsum("pc,pck->pk", inner, values[net.triangles[places.triangle]])
        sums = np.stack([np.bincount(places.point, column, self.count) for column in each.T], axis=1)
        return sums / np.maximum(np.bincount(places.point, minlength=self.count), 1)[:, None]

    def of_triangles(self, values: FloatArray) -> FloatArray:
        """Values of the nearest triangles, zero where a point is farther, shape (triangles,) -> (m,)."""
        return self._spread(values[self.places.triangle[self._first]], 0.0)

    def _spread(self, values: Any, otherwise: Any) -> Any:
        """Values of all points, out of those of the near places, of which the first counts."""
        result = np.full(self.count, otherwise, dtype=values.dtype)
        result[self.places.point[self._first]] = values
        return result
