"""Triangles or tetrahedra that a linear function divides where it is zero, and weights that integrate over both sides.

Weights of a side are the projection of its indicator on polynomials of degree k, in the mean square: times any
polynomial of degree k they have the integral of the side. As functions they are polynomials of degree k as well, so
that any quadrature of degree 2 k in the whole cell integrates over the sides what has degree k.
"""

from dataclasses import dataclass
from functools import cached_property, reduce
from itertools import product
from typing import Any

import basix
import numpy as np
import scipy.linalg as la

from tigar_x import checks
from tigar_x.compat import FloatArray, IntArray
from tigar_x.fem.simplices import Division

KINDS = (basix.CellType.interval, basix.CellType.triangle, basix.CellType.tetrahedron)
"""Simplices, by their dimensions less one."""


@dataclass(frozen=True, eq=False)
class CutCells:
    """Triangles or tetrahedra in which a nodal function has two signs; zero counts as positive.

    Attributes:
        cells: their numbers, ascending, shape (cut,).
        values: the function at their vertices, shape (cut, d + 1).
    """

    cells: IntArray
    values: FloatArray

    def __post_init__(self) -> None:
        checks.freeze(self)

    @classmethod
    def of(cls, vertices: IntArray, phi: FloatArray) -> "CutCells":
        """Those among all cells.

        Args:
            vertices: nodes at the vertices of the cells, shape (cells, d + 1).
            phi: the function at the nodes; where it is not a number nothing is cut.
        """
        first, *others = (phi < 0.0)[vertices].T
        cells = np.flatnonzero(reduce(np.logical_or, [first != other for other in others])).astype(np.int32)
        values = phi[vertices[cells]]
        known = np.isfinite(values).all(axis=1)
        return cls(cells[known], values[known])

    def only(self, chosen: Any) -> "CutCells":
        """Some of them, by a mask of shape (cut,)."""
        return self if chosen.all() else CutCells(self.cells[chosen], self.values[chosen])

    @cached_property
    def division(self) -> Division:
        """In what they are divided."""
        return Division(self.values)

    @cached_property
    def negative_share(self) -> FloatArray:
        """Volume of the negative side relative to the cell, shape (cut,)."""
        share = self.division.smaller_share
        return np.where(self.division.of_negative, share, 1.0 - share)

    @property
    def smaller_share(self) -> FloatArray:
        """Volume of the smaller side relative to the cell, shape (cut,)."""
        return np.minimum(self.negative_share, 1.0 - self.negative_share)


class SideMoments:
    """Integrals of polynomials over the negative sides of cut simplices.

    Args:
        dim: of the simplices, 1 to 3.
        degree: k, of the polynomials.

    Attributes:
        whole: the same over the reference simplex, shape (polynomials,).
    """

    def __init__(self, dim: int, degree: int) -> None:
        self._degree = checks.whole("degree", degree, 0)
        powers = product(range(degree + 1), repeat=dim)
        self._powers = np.array(sorted((p for p in powers if sum(p) <= degree), key=sum)).T
        x, weights = rule(dim, 2 * degree)
        plain = self._monomials(x)
        # orthonormal, as moments of monomials of high degree are as good as linearly dependent
        self._factor = la.cholesky(plain * weights @ plain.T, lower=True)
        self.whole = self.polynomials(x).T @ weights
        x, self._weights = rule(dim, max(degree, 1))
        self._barycentric = np.column_stack([1.0 - x.sum(axis=1), x])

    def polynomials(self, x: FloatArray) -> FloatArray:
        """Orthonormal polynomials on the reference simplex at points of it, shape (n, d) -> (n, polynomials)."""
        return self._orthonormal(self._monomials(x)).T

    def _orthonormal(self, plain: FloatArray) -> FloatArray:
        """What monomials have, of orthonormal polynomials, shape (polynomials, n)."""
        return np.asarray(la.solve_triangular(self._factor, plain, lower=True, check_finite=False))

    def _monomials(self, x: FloatArray) -> FloatArray:
        """About the middle, shape (..., d) -> (monomials, ...)."""
        dim = x.shape[-1]
        y = np.moveaxis(x, -1, 0) * (dim + 1.0) - 1.0
        powers = np.ones((self._degree + 1, *y.shape))
        for n in range(self._degree):
            np.multiply(powers[n], y, out=powers[n + 1])
        result = powers[self._powers[0], 0]
        for axis in range(1, dim):
            result *= powers[self._powers[axis], axis]
        return result

    def __call__(self, division: Division) -> FloatArray:
        """Shape (n, polynomials)."""
        plain = np.empty((len(self.whole), len(division.values)))
        for parts in division.smaller:
            values = self._monomials((self._barycentric @ parts.barycentric)[..., 1:])
            plain[:, parts.rows] = np.einsum("mnp,np->mn", values @ self._weights, parts.shares)
        moments = self._orthonormal(plain).T
        return np.where(division.of_negative[:, None], moments, self.whole - moments)


class SideWeights:
    """Weights of the negative side of cut cells; those of the positive side are one minus them.

    Args:
        degree: k.
        points: reference coordinates at which they are wanted, shape (points, d).
    """

    def __init__(self, degree: int, points: FloatArray) -> None:
        self._moments = SideMoments(points.shape[1], degree)
        self._values = self._moments.polynomials(points).T

    def __call__(self, cut: CutCells) -> FloatArray:
        """Weights at the points, shape (cut, points)."""
        return np.asarray(self._moments(cut.division) @ self._values)


def rule(dim: int, degree: int) -> tuple[FloatArray, FloatArray]:
    """Quadrature points and weights on a reference simplex."""
    x, weights = basix.make_quadrature(KINDS[dim - 1], degree)
    return np.asarray(x), np.asarray(weights)
