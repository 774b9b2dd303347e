"""Triangles that the zero line of a linear function divides, and weights that integrate over its two sides.

Weights of a side are the projection of its indicator on polynomials of degree k, in the mean square: times any
polynomial of degree k they have the integral of the side. As functions they are polynomials of degree k as well, so
that any quadrature of degree 2 k in the whole cell integrates over the sides what has degree k.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import basix
import numpy as np

from tigar_x import checks
from tigar_x.compat import FloatArray, IntArray
from tigar_x.fem import pieces


@dataclass(frozen=True, eq=False)
class CutCells:
    """Triangles in which a nodal function has two signs; zero counts as positive.

    Attributes:
        cells: their numbers, ascending, shape (cut,).
        values: the function at their vertices, shape (cut, 3).
    """

    cells: IntArray
    values: FloatArray

    def __post_init__(self) -> None:
        checks.freeze(self)

    @classmethod
    def of(cls, vertices: IntArray, phi: FloatArray) -> "CutCells":
        """Those among triangles.

        Args:
            vertices: nodes at the vertices of all triangles, shape (cells, 3).
            phi: the function at the nodes; where it is not a number nothing is cut.
        """
        a, b, c = (phi < 0.0)[vertices].T
        cells = np.flatnonzero((a != b) | (a != c)).astype(np.int32)
        values = phi[vertices[cells]]
        known = np.isfinite(values).all(axis=1)
        return cls(cells[known], values[known])

    def only(self, chosen: Any) -> "CutCells":
        """Some of them, by a mask of shape (cut,)."""
        return self if chosen.all() else CutCells(self.cells[chosen], self.values[chosen])

    @cached_property
    def _alone(self) -> tuple[IntArray, Any]:
        """See :func:`tigar_x.fem.pieces.alone`."""
        return pieces.alone(self.values)

    @cached_property
    def corner(self) -> FloatArray:
        """Triangles at that vertex, see :func:`tigar_x.fem.pieces.corner`, shape (cut, 3, 3)."""
        return pieces.corner(self.values)

    @cached_property
    def negative_share(self) -> FloatArray:
        """Area of the negative side relative to the cell, shape (cut,)."""
        lone, of_negative = self._alone
        row = np.arange(len(lone))
        share = (1.0 - self.corner[row, 1, lone]) * (1.0 - self.corner[row, 2, lone])
        return np.where(of_negative, share, 1.0 - share)

    @property
    def smaller_share(self) -> FloatArray:
        """Area of the smaller side relative to the cell, shape (cut,)."""
        return np.minimum(self.negative_share, 1.0 - self.negative_share)

    def line(self, corners: FloatArray) -> FloatArray:
        """Ends of the zero line.

        Args:
            corners: vertices of all triangles, shape (cells, 3, d); unit: length.

        Returns:
            Shape (cut, 2, d).
        """
        return np.asarray(np.einsum("cev,cvi->cei", self.corner[:, 1:], corners[self.cells]))


class SideWeights:
    """Weights of the negative side of cut cells; those of the positive side are one minus them.

    Args:
        degree: k.
        points: reference coordinates at which they are wanted, shape (points, 2).
    """

    def __init__(self, degree: int, points: FloatArray) -> None:
        degree = checks.whole("degree", degree, 0)
        powers = [(i, n - i) for n in range(degree + 1) for i in range(n + 1)]
        self._degree, self._powers = degree, np.array(powers).T
        x, weights = _rule(2 * degree)
        V = self._monomials(x)
        self._from_moments = self._monomials(points) @ np.linalg.inv(V.T @ (weights[:, None] * V))
        self._whole = V.T @ weights
        x, self._weights = _rule(max(degree, 1))
        self._barycentric = np.column_stack([1.0 - x.sum(axis=1), x])

    def _monomials(self, x: FloatArray) -> FloatArray:
        """About the middle of the triangle, shape (..., monomials)."""
        y = np.moveaxis(x, -1, 0) - 1.0 / 3.0
        powers = np.ones((self._degree + 1, *y.shape))
        for n in range(self._degree):
            np.multiply(powers[n], y, out=powers[n + 1])
        a, b = self._powers
        return np.moveaxis(powers[a, 0] * powers[b, 1], 0, -1)

    def __call__(self, cut: CutCells) -> FloatArray:
        """Weights at the points, shape (cut, points)."""
        x = (self._barycentric @ cut.corner)[..., 1:]
        _, of_negative = cut._alone
        share = np.where(of_negative, cut.negative_share, 1.0 - cut.negative_share)
        moments = np.einsum("g,cgm->cm", self._weights, self._monomials(x)) * share[:, None]
        moments = np.where(of_negative[:, None], moments, self._whole - moments)
        return np.asarray(moments @ self._from_moments.T)


def _rule(degree: int) -> tuple[FloatArray, FloatArray]:
    """Quadrature points and weights on the reference triangle."""
    x, weights = basix.make_quadrature(basix.CellType.triangle, degree)
    return np.asarray(x), np.asarray(weights)
