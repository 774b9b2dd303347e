"""Knot vectors, univariate B-spline bases and their tensor products, evaluated by ``scipy.interpolate.BSpline``."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import BSpline
from scipy.sparse.linalg import splu

from tigar_x import checks
from tigar_x.compat import FloatArray, IntArray

SAME_KNOT = 3e-15
"""Knots closer than this, relative to the range of the knot vector, are one knot."""
DROPPED = 1e-15
"""Basis values below this are not stored."""


def open_knots(degree: int, breakpoints: ArrayLike, continuity: int | None = None) -> FloatArray:
    """Open knot vector: the ends repeated ``degree + 1`` times, the inner knots ``degree - continuity`` times.

    Args:
        degree: polynomial degree p.
        breakpoints: strictly increasing knots, shape (elements + 1,).
        continuity: number of continuous derivatives at the inner knots, 0 to p - 1; None: p - 1.

    Returns:
        Knots, shape (2 (p + 1) + (elements - 1) (p - continuity),).

    Raises:
        ValueError: breakpoints or continuity are not of that form.
    """
    x = _breakpoints(breakpoints)
    repeat = _multiplicity(degree, continuity)
    return np.concatenate([np.full(degree + 1, x[0]), np.repeat(x[1:-1], repeat), np.full(degree + 1, x[-1])])


def periodic_knots(degree: int, breakpoints: ArrayLike, continuity: int | None = None) -> FloatArray:
    """Knot vector of a periodic basis: every knot, the ends included, repeated ``degree - continuity`` times.

    Args:
        degree: polynomial degree p.
        breakpoints: strictly increasing knots, shape (elements + 1,); the last one is the first one of the next period.
        continuity: number of continuous derivatives at all knots, 0 to p - 1; None: p - 1.

    Returns:
        Knots, shape ((elements + 1) (p - continuity),).

    Raises:
        ValueError: breakpoints or continuity are not of that form.
    """
    return np.repeat(_breakpoints(breakpoints), _multiplicity(degree, continuity))


def _breakpoints(value: ArrayLike) -> FloatArray:
    x = checks.array("breakpoints", value, (None,))
    if len(x) < 2 or (np.diff(x) <= 0.0).any():
        raise ValueError(f"breakpoints = {x}: two or more strictly increasing numbers are required")
    return x


def _multiplicity(degree: int, continuity: int | None) -> int:
    p = checks.whole("degree", degree, 1)
    if continuity is None:
        return 1
    return p - int(checks.choice("continuity", continuity, tuple(range(p))))


@dataclass(frozen=True, eq=False)
class BSplineBasis:
    """Univariate B-spline basis on an open or a periodic knot vector.

    Attributes:
        degree: polynomial degree p >= 1.
        knots: non-decreasing; open: the ends repeated p + 1 times, shape (n + p + 1,); periodic: the ends repeated
            equally often, m <= p times, shape (n + m,). Inner knots at most p times.
        periodic: whether the functions go on beyond the end at the start; the parameter's range stays [first, last].

    Raises:
        ValueError: degree or knots are not of that form.
    """

    degree: int
    knots: FloatArray
    periodic: bool = False

    def __post_init__(self) -> None:
        p = checks.whole("degree", self.degree, 1)
        knots = checks.array("knots", self.knots, (None,)).copy()
        checks.flag("periodic", self.periodic)
        if len(knots) < 2 or (not self.periodic and len(knots) < 2 * (p + 1)):
            raise ValueError(f"knots has {len(knots)} entries: degree {p} requires at least {2 * (p + 1)}")
        steps = np.diff(knots)
        if (steps < 0).any():
            i = int(np.argmax(steps < 0))
            raise ValueError(f"knots[{i}:{i + 2}] = {knots[i : i + 2]}: a non-decreasing sequence is required")
        unique, counts = self._group(knots)
        allowed = range(1, p + 1) if self.periodic else range(p + 1, p + 2)
        if len(unique) < 2 or counts[0] not in allowed or counts[-1] != counts[0]:
            times = f"{p + 1} times are" if not self.periodic else f"equally many, 1 to {p}, are"
            raise ValueError(f"knots repeats its ends {counts[0]} and {counts[-1]} times: {times} required")
        if (counts[1:-1] > p).any():
            i = 1 + int(np.argmax(counts[1:-1] > p))
            raise ValueError(f"knots repeats {unique[i]} {counts[i]} times: at most {p} times are allowed inside")
        if self.periodic and len(knots) - counts[0] <= p:
            raise ValueError(f"knots gives {len(knots) - counts[0]} periodic functions: degree {p} requires {p + 1}")
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
        """Number of functions: of knots less the multiplicity of the first one."""
        return len(self.knots) - int(self.multiplicities[0])

    @cached_property
    def breakpoints(self) -> FloatArray:
        """Knots without repetition: the ends of the Bezier elements, shape (elements + 1,)."""
        return self._group(self.knots)[0]

    @cached_property
    def multiplicities(self) -> NDArray[np.int64]:
        """How often every breakpoint is repeated, shape (elements + 1,)."""
        return self._group(self.knots)[1]

    @cached_property
    def extended(self) -> tuple[FloatArray, int]:
        """Knots of all functions that reach into the range, and the number of the first (of the period before)."""
        if not self.periodic:
            return self.knots, 0
        p, n, m = self.degree, self.n, int(self.multiplicities[0])
        i = np.arange(m - 1 - p, n + p + 1)
        return self.knots[i % n] + (i // n) * (self.knots[-1] - self.knots[0]), m - 1 - p

    @property
    def greville(self) -> FloatArray:
        """Greville abscissae, shape (n,): means of ``degree`` consecutive knots, within the range."""
        knots, first = self.extended
        means = np.lib.stride_tricks.sliding_window_view(knots[1:-1], self.degree).mean(axis=1)
        if not self.periodic:
            return means
        low, high = self.knots[0], self.knots[-1]
        return low + (means[np.arange(self.n) - first] - low) % (high - low)

    def find(self, xi: ArrayLike) -> NDArray[np.int64]:
        """Which breakpoint each parameter is, up to rounding; -1 where it is none."""
        x = np.asarray(xi, dtype=np.float64)
        slack = SAME_KNOT * (self.knots[-1] - self.knots[0])
        at = np.minimum(np.searchsorted(self.breakpoints, x - slack), len(self.breakpoints) - 1)
        return np.where(np.abs(self.breakpoints[at] - x) <= slack, at, -1)

    def elevated(self, degree: int) -> "BSplineBasis":
        """Basis of a higher degree on the same breakpoints with the same continuity; it contains this one.

        Args:
            degree: not below the present one.

        Raises:
            ValueError: the degree is below the present one.
        """
        p = checks.whole("degrees", degree, self.degree)
        return replace(self, degree=p, knots=np.repeat(self.breakpoints, self.multiplicities + p - self.degree))

    def with_knots(self, knots: ArrayLike) -> "BSplineBasis":
        """Basis that has every given knot at least as often as it is given; it contains this one.

        Args:
            knots: within the range, in any order.

        Raises:
            ValueError: a knot lies outside the range, or inside it more than ``degree`` times.
        """
        x = np.sort(checks.array("knots", knots, (None,)))
        at = self.find(x)
        x = np.where(at < 0, x, self.breakpoints[at])
        low, high = self.breakpoints[[0, -1]]
        if len(x) and not low <= x[0] <= x[-1] <= high:
            raise ValueError(f"knots ranges over [{x[0]}, {x[-1]}]: knots in [{low}, {high}] are required")
        unique, counts = np.unique(x, return_counts=True)
        ticks = np.union1d(self.breakpoints, unique)
        repeat = np.zeros(len(ticks), dtype=np.int64)
        repeat[np.searchsorted(ticks, self.breakpoints)] = self.multiplicities
        np.maximum.at(repeat, np.searchsorted(ticks, unique), counts)
        return replace(self, knots=np.repeat(ticks, repeat))

    def local(self, xi: ArrayLike, order: int = 0) -> tuple[FloatArray, IntArray]:
        """Values and indices of the functions that may be non-zero at points.

        Args:
            xi: parameters within the range of the knots (up to rounding), shape (m,).
            order: 0 for the functions, 1 for their first derivatives (from the right at a kink).

        Returns:
            Values and function indices, each of shape (m, degree + 1).

        Raises:
            ValueError: a parameter lies outside the range of the knots, or there is no such order.
        """
        x = checks.array("xi", xi, (None,))
        checks.choice("order", order, (0, 1))
        low, high, p = self.knots[0], self.knots[-1], self.degree
        if not len(x):
            return np.zeros((0, p + 1)), np.zeros((0, p + 1), dtype=np.int32)
        slack = 1e-12 * (high - low)
        if x.min() < low - slack or x.max() > high + slack:
            raise ValueError(f"xi ranges over [{x.min()}, {x.max()}]: values in [{low}, {high}] are required")
        x = np.clip(x, low, high)
        t, first = self.extended
        matrix = BSpline.design_matrix(x, t, p)
        values, index = matrix.data.reshape(len(x), p + 1), matrix.indices.reshape(len(x), p + 1)
        if order:
            lower = BSpline.design_matrix(x, t[1:-1], p - 1).data.reshape(len(x), p)
            ratio = np.pad(p * lower / (t[index[:, 1:] + p] - t[index[:, 1:]]), ((0, 0), (1, 1)))
            values = ratio[:, :-1] - ratio[:, 1:]
        return values, ((index + first) % self.n).astype(np.int32)


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

    @property
    def dim(self) -> int:
        """Parametric dimension."""
        return len(self.directions)

    @property
    def degrees(self) -> tuple[int, ...]:
        """Polynomial degrees, one per direction."""
        return tuple(basis.degree for basis in self.directions)

    @property
    def box(self) -> FloatArray:
        """Ranges of the parameters: lower and upper corner, shape (2, parametric dimension)."""
        return np.array([[basis.knots[0], basis.knots[-1]] for basis in self.directions]).T

    @property
    def greville(self) -> FloatArray:
        """Tensor grid of the Greville abscissae, shape (n, parametric dimension)."""
        grid = np.meshgrid(*(basis.greville for basis in self.directions), indexing="ij")
        return np.column_stack([axis.ravel(order="F") for axis in grid])

    def interpolate(self, values: ArrayLike) -> FloatArray:
        """Coefficients of the spline with given values at the Greville points, one direction after the other.

        Args:
            values: shape (n, k).

        Returns:
            Coefficients, shape (n, k).

        Raises:
            ValueError: the values have no such shape.
        """
        net = checks.array("values", values, (self.n, None))
        net = net.reshape([*(basis.n for basis in self.directions), -1], order="F")
        for axis, basis in enumerate(self.directions):
            rows = np.moveaxis(net, axis, 0)
            collocation = TensorBasis((basis,)).evaluate(basis.greville[:, None])
            solved = splu(collocation.tocsc()).solve(rows.reshape(len(rows), -1))
            net = np.moveaxis(solved.reshape(rows.shape), 0, axis)
        return net.reshape(self.n, -1, order="F")

    def evaluate(self, xi: ArrayLike, derivative: int | None = None) -> sp.csr_matrix:
        """Values or first derivatives of all functions at parametric points.

        Args:
            xi: shape (m, parametric dimension).
            derivative: direction of differentiation; None: the functions themselves.

        Returns:
            Sparse matrix of shape (m, n); rows of values sum to one.
        """
        points = checks.array("xi", xi, (None, self.dim))
        if derivative is not None:
            checks.choice("derivative", derivative, tuple(range(self.dim)))
        m = len(points)
        if m == 0:
            return sp.csr_matrix((0, self.n))
        values, columns = np.ones((m, 1)), np.zeros((m, 1), dtype=np.int64)
        stride = 1
        for direction, (basis, x) in enumerate(zip(self.directions, points.T, strict=True)):
            v, j = basis.local(x, int(direction == derivative))
            values = (v[:, :, None] * values[:, None, :]).reshape(m, -1)
            columns = (stride * j.astype(np.int64)[:, :, None] + columns[:, None, :]).reshape(m, -1)
            stride *= basis.n
        width = values.shape[1]
        matrix = sp.csr_matrix((values.ravel(), columns.ravel(), np.arange(m + 1) * width), shape=(m, self.n))
        matrix.data[np.abs(matrix.data) < DROPPED] = 0.0
        matrix.eliminate_zeros()
        return matrix


def require_containing(name: str, old: BSplineBasis, new: BSplineBasis) -> None:
    """Refuse a basis that does not contain another one.

    Args:
        name: what messages call it.
        old: the one that is to be contained.
        new: the basis.

    Raises:
        ValueError: it does not contain it.
    """
    drop, at = new.degree - old.degree, new.find(old.breakpoints)
    same_range = at[0] == 0 and at[-1] == len(new.breakpoints) - 1 and old.periodic == new.periodic
    repeats = (at >= 0) & (new.multiplicities[at] >= old.multiplicities + drop)
    if not (same_range and drop >= 0 and repeats.all()):
        raise ValueError(
            f"{name} has degree {new.degree} on {new.knots}: degree {old.degree} on {old.knots} is not in it"
        )
