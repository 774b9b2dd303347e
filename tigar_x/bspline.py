"""Knot vectors, univariate B-spline bases and their tensor products, evaluated by ``scipy.interpolate.BSpline``."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import BSpline

from tigar_x import checks
from tigar_x.compat import FloatArray

SAME_KNOT = 3e-15
"""Knots closer than this, relative to the range of the knot vector, are one knot."""
DROPPED = 1e-15
"""Basis values below this are not stored."""


def open_knots(degree: int, breakpoints: ArrayLike) -> FloatArray:
    """Open knot vector of maximal continuity: the ends repeated ``degree + 1`` times.

    Args:
        degree: polynomial degree.
        breakpoints: strictly increasing knots, shape (elements + 1,).

    Returns:
        Knots, shape (elements + 1 + 2 degree,).
    """
    x = checks.array("breakpoints", breakpoints, (None,))
    if len(x) < 2 or (np.diff(x) <= 0.0).any():
        raise ValueError(f"breakpoints = {x}: two or more strictly increasing numbers are required")
    return np.concatenate([np.full(degree, x[0]), x, np.full(degree, x[-1])])


@dataclass(frozen=True, eq=False)
class BSplineBasis:
    """Univariate B-spline basis on an open knot vector.

    Attributes:
        degree: polynomial degree p >= 1.
        knots: non-decreasing, end knots repeated p + 1 times, interior ones at most p times; shape (n + p + 1,).

    Raises:
        ValueError: degree or knots are not of that form.
    """

    degree: int
    knots: FloatArray

    def __post_init__(self) -> None:
        p = checks.whole("degree", self.degree, 1)
        knots = checks.array("knots", self.knots, (None,)).copy()
        if len(knots) < 2 * (p + 1):
            raise ValueError(f"knots has {len(knots)} entries: degree {p} requires at least {2 * (p + 1)}")
        steps = np.diff(knots)
        if (steps < 0).any():
            i = int(np.argmax(steps < 0))
            raise ValueError(f"knots[{i}:{i + 2}] = {knots[i : i + 2]}: a non-decreasing sequence is required")
        unique, counts = self._group(knots)
        if len(unique) < 2 or counts[0] != p + 1 or counts[-1] != p + 1:
            raise ValueError(f"knots repeats its ends {counts[0]} and {counts[-1]} times: {p + 1} times are required")
        if (counts[1:-1] > p).any():
            i = 1 + int(np.argmax(counts[1:-1] > p))
            raise ValueError(f"knots repeats {unique[i]} {counts[i]} times: at most {p} times are allowed inside")
        knots = np.repeat(unique, counts)
        knots.flags.writeable = False
        object.__setattr__(self, "degree", p)
        object.__setattr__(self, "knots", knots)

    @staticmethod
    def _group(knots: FloatArray) -> tuple[FloatArray, NDArray[np.int64]]:
        new = np.concatenate([[True], np.diff(knots) > SAME_KNOT * (knots[-1] - knots[0])])
        return knots[new], np.diff(np.append(np.flatnonzero(new), len(knots)))

    @property
    def n(self) -> int:
        """Number of functions."""
        return len(self.knots) - self.degree - 1

    @cached_property
    def breakpoints(self) -> FloatArray:
        """Knots without repetition: the ends of the Bezier elements, shape (elements + 1,)."""
        return self._group(self.knots)[0]

    @property
    def greville(self) -> FloatArray:
        """Greville abscissae, shape (n,): means of ``degree`` consecutive knots."""
        windows = np.lib.stride_tricks.sliding_window_view(self.knots[1:-1], self.degree)
        return windows.mean(axis=1)

    def local(self, xi: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Values and indices of the functions that may be non-zero at points.

        Args:
            xi: parameters within the range of the knots (up to rounding), shape (m,).

        Returns:
            Values and function indices, each of shape (m, degree + 1).

        Raises:
            ValueError: a parameter lies outside the range of the knots.
        """
        x = checks.array("xi", xi, (None,))
        low, high = self.knots[0], self.knots[-1]
        slack = 1e-12 * (high - low)
        if len(x) and (x.min() < low - slack or x.max() > high + slack):
            raise ValueError(f"xi ranges over [{x.min()}, {x.max()}]: values in [{low}, {high}] are required")
        matrix = BSpline.design_matrix(np.clip(x, low, high), self.knots, self.degree)
        shape = (len(x), self.degree + 1)
        return matrix.data.reshape(shape), matrix.indices.reshape(shape)


@dataclass(frozen=True, eq=False)
class TensorBasis:
    """Tensor product of univariate bases; the first direction counts fastest.

    Attributes:
        directions: univariate bases, one per parametric direction.
    """

    directions: tuple[BSplineBasis, ...]

    @property
    def n(self) -> int:
        """Number of functions."""
        return int(np.prod([basis.n for basis in self.directions]))

    def evaluate(self, xi: ArrayLike) -> sp.csr_matrix:
        """Values of all functions at parametric points.

        Args:
            xi: shape (m, parametric dimension).

        Returns:
            Sparse matrix of shape (m, n); rows sum to one.
        """
        points = checks.array("xi", xi, (None, len(self.directions)))
        m = len(points)
        values, columns = np.ones((m, 1)), np.zeros((m, 1), dtype=np.int64)
        stride = 1
        for basis, x in zip(self.directions, points.T, strict=True):
            v, j = basis.local(x)
            values = (v[:, :, None] * values[:, None, :]).reshape(m, -1)
            columns = (stride * j.astype(np.int64)[:, :, None] + columns[:, None, :]).reshape(m, -1)
            stride *= basis.n
        width = values.shape[1]
        matrix = sp.csr_matrix((values.ravel(), columns.ravel(), np.arange(m + 1) * width), shape=(m, self.n))
        matrix.data[np.abs(matrix.data) < DROPPED] = 0.0
        matrix.eliminate_zeros()
        return matrix
