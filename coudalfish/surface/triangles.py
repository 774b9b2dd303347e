"""Triangles in space: areas, normals, angles."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from tigar_x import checks
from tigar_x.compat import FloatArray, IntArray
from tigar_x.fem.simplices import cross_products

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
        return cross_products(b, c)

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

    def angles(self, k: IntArray, corner: IntArray) -> FloatArray:
        """At corners, shape (n,).

        Args:
            k: triangles, shape (n,).
            corner: one for each.
        """
        x = self.x[k, corner]
        arms = self.x[k, (corner + 1) % 3] - x, self.x[k, (corner + 2) % 3] - x
        across = cross_products(*arms)
        return np.arctan2(np.sqrt(_dot(across, across)), _dot(*arms))

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


def _dot(a: FloatArray, b: FloatArray) -> FloatArray:
    return np.asarray(np.einsum("ni,ni->n", a, b))
