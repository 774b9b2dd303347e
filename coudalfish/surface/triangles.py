"""Triangles in space: the places of them that are nearest to points, and the lines that pass through them.

The regions are those of C. Ericson, Real-Time Collision Detection, section 5.1.5.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from tigar_x import checks
from tigar_x.compat import FloatArray, IntArray

FACE, EDGE, CORNER = 0, 1, 4
"""Kinds of nearest places: within the triangle, ``EDGE + i`` on the edge opposite corner i, ``CORNER + i`` at it."""
FLAT = 1e-10
"""Area, relative to the square of the longest edge, up to which a triangle has none, as at a pole of a patch."""


@dataclass(frozen=True, eq=False)
class Triangles:
    """Triangles where they are.

    Attributes:
        x: their corners, shape (triangles, 3, 3); unit: length.
    """

    x: FloatArray

    def __post_init__(self) -> None:
        checks.freeze(self)

    @cached_property
    def _products(self) -> tuple[FloatArray, ...]:
        """First corners, edges from there, and the products of these."""
        start = np.ascontiguousarray(self.x[:, 0])
        b, c = self.x[:, 1] - start, self.x[:, 2] - start
        return start, b, c, _dot(b, b), _dot(b, c), _dot(c, c)

    @cached_property
    def area_vectors(self) -> FloatArray:
        """Normals times twice the areas, shape (triangles, 3)."""
        _, b, c, *_ = self._products
        return np.cross(b, c)

    @cached_property
    def areas(self) -> FloatArray:
        """Shape (triangles,)."""
        return 0.5 * np.sqrt(_dot(self.area_vectors, self.area_vectors))

    @cached_property
    def flat(self) -> Any:
        """Mask of those without area, whose places are those of their neighbours, shape (triangles,)."""
        *_, bb, bc, cc = self._products
        return 2.0 * self.areas <= FLAT * np.maximum(np.maximum(bb, cc), bb - 2.0 * bc + cc)

    @cached_property
    def normals(self) -> FloatArray:
        """Unit normals, zero where there is no area, shape (triangles, 3)."""
        return self.area_vectors / np.where(self.flat, np.inf, 2.0 * self.areas)[:, None]

    @cached_property
    def angles(self) -> FloatArray:
        """At the corners, shape (triangles, 3)."""
        arms = np.roll(self.x, -1, axis=1) - self.x, np.roll(self.x, 1, axis=1) - self.x
        across = np.cross(*arms)
        return np.arctan2(np.sqrt(np.einsum("tci,tci->tc", across, across)), np.einsum("tci,tci->tc", *arms))

    def in_plane(self, x: FloatArray, k: IntArray) -> FloatArray:
        """Barycentric coordinates of the feet of points in the planes of triangles, of any sign, shape (n, 3).

        Args:
            x: points, shape (n, 3); unit: length.
            k: one triangle for each.
        """
        _, p, q = self._along(x, k)
        bb, bc, cc = (product[k] for product in self._products[3:])
        size = bb * cc - bc * bc
        second, third = (cc * p - bc * q) / size, (bb * q - bc * p) / size
        return np.stack([1.0 - second - third, second, third], axis=1)

    def _along(self, x: FloatArray, k: IntArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        start, b, c = (part[k] for part in self._products[:3])
        arm = x - start
        return arm, _dot(arm, b), _dot(arm, c)

    def nearest(self, x: FloatArray, k: IntArray) -> tuple[FloatArray, FloatArray, IntArray]:
        """Nearest places of triangles to points.

        Args:
            x: points, shape (n, 3); unit: length.
            k: one triangle for each.

        Returns:
            Second and third barycentric coordinates of the places, shape (n, 2); the ways from there to the points,
            shape (n, 3), unit: length; and the kinds of the places, shape (n,).
        """
        arm, p, q = self._along(x, k)
        bb, bc, cc = (product[k] for product in self._products[3:])
        p_b, q_b, p_c, q_c = p - bb, q - bc, p - bc, q - cc  # the same from the second and the third corner
        at_a: FloatArray = p_b * q_c - p_c * q_b  # coordinates, times four times the area squared
        at_b: FloatArray = p_c * q - p * q_c
        at_c: FloatArray = p * q_b - p_b * q
        up, down = q_b - p_b, p_c - q_c
        kinds = (
            ((p <= 0.0) & (q <= 0.0), CORNER, 0.0, 0.0),
            ((p_b >= 0.0) & (up <= 0.0), CORNER + 1, 1.0, 0.0),
            ((q_c >= 0.0) & (down <= 0.0), CORNER + 2, 0.0, 1.0),
            ((at_c <= 0.0) & (p >= 0.0) & (p_b <= 0.0), EDGE + 2, _part(p, bb), 0.0),
            ((at_b <= 0.0) & (q >= 0.0) & (q_c <= 0.0), EDGE + 1, 0.0, _part(q, cc)),
            ((at_a <= 0.0) & (up >= 0.0) & (down >= 0.0), EDGE, _part(down, up + down), _part(up, up + down)),
        )
        size: FloatArray = at_a + at_b + at_c
        kind, second, third = np.full(len(x), FACE), _part(at_b, size), _part(at_c, size)
        for where, number, v, w in reversed(kinds):
            kind[where] = number
            for values, new in ((second, v), (third, w)):
                np.copyto(values, new, where=where)
        gap = arm - second[:, None] * self._products[1][k] - third[:, None] * self._products[2][k]
        return np.stack([second, third], axis=1), gap, kind

    def crossed(self, start: FloatArray, end: FloatArray, k: IntArray) -> Any:
        """Mask of the straight lines that pass through triangles, shape (n,).

        Args:
            start: where they begin, shape (n, 3); unit: length.
            end: where they end.
            k: one triangle for each.
        """
        line, normal = end - start, self.area_vectors[k]
        height = _dot(self.x[k, 0] - start, normal)
        result = np.asarray((height * (height - _dot(line, normal)) <= 0.0) & ~self.flat[k])
        parted = np.flatnonzero(result)
        a, b, c = (self.x[k[parted], corner] - start[parted] for corner in range(3))
        around = np.stack([_dot(line[parted], np.cross(*pair)) for pair in ((a, b), (b, c), (c, a))])
        result[parted] = (around >= 0.0).all(axis=0) | (around <= 0.0).all(axis=0)
        return result


class NearPlaces(NamedTuple):
    """Places of triangles that are nearest to points.

    Attributes:
        point: to which of them, shape (n,).
        triangle: in which triangles, shape (n,).
        kind: see above, shape (n,).
        inner: second and third barycentric coordinates there, shape (n, 2).
        gap: from there to the points, shape (n, 3); unit: length.
        distance: its length, infinite of triangles without area, shape (n,).
    """

    point: IntArray
    triangle: IntArray
    kind: IntArray
    inner: FloatArray
    gap: FloatArray
    distance: FloatArray

    @classmethod
    def of(cls, triangles: Triangles, x: FloatArray, point: IntArray, triangle: IntArray) -> "NearPlaces":
        """Of one triangle for each point."""
        inner, gap, kind = triangles.nearest(x[point], triangle)
        distance = np.sqrt(np.einsum("pi,pi->p", gap, gap))
        if triangles.flat.any():
            distance[triangles.flat[triangle]] = np.inf
        return cls(point, triangle, kind, inner, gap, distance)

    @classmethod
    def joined(cls, several: Sequence["NearPlaces"]) -> "NearPlaces":
        """All of several."""
        return cls(*map(np.concatenate, zip(*several, strict=True)))

    def only(self, chosen: Any) -> "NearPlaces":
        """Some of them, by a mask or in an order."""
        return NearPlaces(*(part[chosen] for part in self))

    @classmethod
    def none(cls) -> "NearPlaces":
        """No place."""
        no = np.empty(0, dtype=np.int32)
        return cls(no, no, no, np.empty((0, 2)), np.empty((0, 3)), np.empty(0))


def _dot(a: FloatArray, b: FloatArray) -> FloatArray:
    return np.asarray(np.einsum("ni,ni->n", a, b))


def _part(value: FloatArray, whole: FloatArray) -> FloatArray:
    """The quotient, where it is used; elsewhere the whole may be zero."""
    return np.divide(value, whole, out=np.zeros_like(value), where=whole != 0.0)
