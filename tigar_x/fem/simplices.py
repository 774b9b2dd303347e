"""Simplices that a linear function divides where it is zero, and those of which its sides and that set are made.

With k of its vertices a_i on the side that has fewer and m vertices b_j on the other one, a simplex is divided in the
points e_ij between a_i and b_j. What lies between is the product of two simplices of k and m vertices, and with
``e_i0 = a_i`` the smaller side is that of k and m + 1 vertices. Products are made of simplices whose vertices are the
places of a path that ascends through the table of (i, j): one tetrahedron and one triangle of a tetrahedron of which
one vertex is alone, three and two if there are two on either side.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property
from itertools import permutations
from typing import Any, Protocol

import numpy as np
from dolfinx import fem

from tigar_x import checks, compat
from tigar_x.compat import FloatArray, IntArray

FLAT = 1e-12
"""Share of the volume of a simplex below which a part of it is none."""


@dataclass(frozen=True, eq=False)
class Parts:
    """Simplices within divided simplices, as many in each.

    Attributes:
        rows: the divided ones, shape (n,).
        barycentric: coordinates of the vertices there, shape (n, parts, vertices, d + 1).
    """

    rows: IntArray
    barycentric: FloatArray

    def __post_init__(self) -> None:
        checks.freeze(self)

    @cached_property
    def shares(self) -> FloatArray:
        """Volumes relative to the divided simplices, of parts that are no smaller in dimension, shape (n, parts)."""
        return np.abs(np.linalg.det(self.barycentric))


@dataclass(frozen=True, eq=False)
class Division:
    """Simplices in which a linear function has two signs; zero counts as positive.

    Attributes:
        values: the function at the vertices, shape (n, d + 1).
    """

    values: FloatArray

    def __post_init__(self) -> None:
        checks.freeze(self)

    @cached_property
    def _negative(self) -> Any:
        return self.values < 0.0

    @cached_property
    def of_negative(self) -> Any:
        """Whether it is the negative side that has fewer vertices, or as many as the other one, shape (n,)."""
        return 2 * self._negative.sum(axis=1) <= self.values.shape[1]

    @cached_property
    def smaller(self) -> tuple[Parts, ...]:
        """Parts of the sides that have fewer vertices, for each number of these that occurs."""
        return self._parts(_of_smaller)

    @cached_property
    def larger(self) -> tuple[Parts, ...]:
        """Parts of the other sides."""
        return self._parts(_of_larger)

    @cached_property
    def zero(self) -> tuple[Parts, ...]:
        """Parts of where the function is zero, simplices with one vertex less."""
        return self._parts(_of_zero)

    @cached_property
    def smaller_share(self) -> FloatArray:
        """Volume of the sides that have fewer vertices relative to the simplices, shape (n,)."""
        share = np.empty(len(self.values))
        for parts in self.smaller:
            share[parts.rows] = parts.shares.sum(axis=1)
        return share

    def _parts(self, table: Callable[[int, int], IntArray]) -> tuple[Parts, ...]:
        return tuple(Parts(rows, points[:, table(k, points.shape[2] - k)]) for k, rows, points in self._points)

    @cached_property
    def _points(self) -> list[tuple[int, IntArray, FloatArray]]:
        """Number k of vertices on the smaller side, simplices with as many, and coordinates of all a, b and e there."""
        vertices = self.values.shape[1]
        few = np.where(self.of_negative[:, None], self._negative, ~self._negative)
        count, order = few.sum(axis=1), _orders(vertices)[few @ (1 << np.arange(vertices))]
        found = []
        for k in range(1, vertices // 2 + 1):
            rows = np.flatnonzero(count == k)
            if not len(rows):
                continue
            values, corners = np.take_along_axis(self.values[rows], order[rows], 1), np.eye(vertices)[order[rows]]
            a, b = values[:, :k, None], values[:, None, k:]
            t = (a / (a - b))[..., None]
            between = (1.0 - t) * corners[:, :k, None] + t * corners[:, None, k:]
            points = np.concatenate([corners, between.reshape(len(rows), -1, vertices)], axis=1)
            found.append((k, rows, points))
        return found


@dataclass(frozen=True, eq=False)
class SidedSimplices:
    """Simplices within divided cells, each on one side.

    Attributes:
        cells: the cell of each, shape (pieces,).
        barycentric: coordinates of its vertices there, in the direction in which the cell goes, shape (pieces, d + 1,
            d + 1).
        side: -1 or 1, shape (pieces,).
    """

    cells: IntArray
    barycentric: FloatArray
    side: FloatArray

    def __post_init__(self) -> None:
        checks.freeze(self)

    @classmethod
    def of(cls, cells: IntArray, values: FloatArray) -> "SidedSimplices":
        """Those of divided cells, one cell after the other, without such as have no volume.

        Args:
            cells: their numbers, shape (n,).
            values: a linear function of two signs at their vertices, shape (n, d + 1).
        """
        division, size = Division(values), values.shape[1]
        sign = np.where(division.of_negative, -1.0, 1.0)
        rows, simplices, side = [np.empty(0, dtype=np.int32)], [np.empty((0, size, size))], [np.empty(0)]
        for kinds, way in ((division.smaller, sign), (division.larger, -sign)):
            for parts in kinds:
                row, part = np.nonzero(parts.shares > FLAT)
                rows.append(parts.rows[row].astype(np.int32))
                simplices.append(parts.barycentric[row, part])
                side.append(way[rows[-1]])
        row = np.concatenate(rows)
        order = np.argsort(row, kind="stable")
        return cls(cells[row[order]], np.concatenate(simplices)[order], np.concatenate(side)[order])

    def linear(self, function: fem.Function) -> FloatArray:
        """Values of a linear function that is the same on both sides, shape (pieces, d + 1, components)."""
        V = function.function_space
        nodal = function.x.array.reshape(-1, V.dofmap.index_map_bs)[compat.cell_dofs(V)[self.cells]]
        return np.asarray(self.barycentric @ nodal)


class Sided(Protocol):
    """A linear function with more values than those at its nodes, such as varmint's ``Flow(...).sides``.

    Attributes:
        function: the function.
    """

    @property
    def function(self) -> fem.Function:
        """The function."""

    def pieces(self) -> SidedSimplices:
        """Pieces of the cells of this rank that are divided."""

    def of_pieces(self, pieces: SidedSimplices) -> FloatArray:
        """The function at the vertices of pieces, on their sides, shape (pieces, d + 1, components)."""


@cache
def _orders(vertices: int) -> IntArray:
    """For every set of vertices, by its bits, these first and then the others, as an even permutation."""
    orders = []
    for bits in range(1 << vertices):
        inside = [v for v in range(vertices) if bits >> v & 1]
        order = inside + [v for v in range(vertices) if v not in inside]
        if vertices > 2 and np.linalg.det(np.eye(vertices)[order]) < 0.0:
            order[-2:] = order[:-3:-1]
        orders.append(order)
    return np.array(orders)


def _paths(rows: int, columns: int) -> IntArray:
    """Ascending paths through a table from its first place to the last one, shape (paths, places, 2)."""
    steps = sorted(set(permutations((0,) * (columns - 1) + (1,) * (rows - 1))))
    down = np.cumsum(np.array(steps, dtype=np.int64).reshape(len(steps), -1), axis=1)
    right = np.arange(1, down.shape[1] + 1) - down
    return np.pad(np.stack([down, right], axis=-1), ((0, 0), (1, 0), (0, 0)))


@cache
def _of_smaller(k: int, m: int) -> IntArray:
    """Numbers of the points of :attr:`Division._points` in its parts, shape (parts, vertices)."""
    i, j = np.moveaxis(_paths(k, m + 1), -1, 0)
    return _turned(np.where(j == 0, i, k + m + i * m + j - 1), k, m)


@cache
def _of_larger(k: int, m: int) -> IntArray:
    """The same of the other side, which is the product of simplices of m and k + 1 vertices."""
    j, i = np.moveaxis(_paths(m, k + 1), -1, 0)
    j = m - 1 - j
    return _turned(np.where(i == 0, k + j, k + m + (i - 1) * m + j), k, m)


@cache
def _of_zero(k: int, m: int) -> IntArray:
    """The same of what lies between."""
    i, j = np.moveaxis(_paths(k, m), -1, 0)
    return np.asarray(k + m + i * m + j)


def _turned(table: IntArray, k: int, m: int) -> IntArray:
    """The same simplices in the direction in which the divided one goes."""
    corners = np.eye(k + m)
    middles = 0.5 * (corners[:k, None] + corners[k:]).reshape(-1, k + m)
    against = np.linalg.det(np.concatenate([corners, middles])[table]) < 0.0
    table[against, -2:] = table[against, :-3:-1]
    return table
