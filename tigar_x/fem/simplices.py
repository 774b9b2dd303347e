"""Simplices that a linear function divides where it is zero, and those of which its sides and that set are made.

With k of its vertices a_i on the side that has fewer and m vertices b_j on the other one, a simplex is divided in the
points e_ij between a_i and b_j. What lies between is the product of two simplices of k and m vertices, and with
``e_i0 = a_i`` the smaller side is that of k and m + 1 vertices. Products are made of simplices whose vertices are the
places of a path that ascends through the table of (i, j): one tetrahedron and one triangle of a tetrahedron of which
one vertex is alone, three and two if there are two on either side.
"""

from dataclasses import dataclass
from functools import cache, cached_property
from itertools import permutations
from typing import Any, NamedTuple, Protocol

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


@dataclass(frozen=True, eq=False)
class SideParts(Parts):
    """Those of which sides are made.

    Attributes:
        shares: volumes relative to the divided simplices, shape (n, parts).
    """

    shares: FloatArray


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
    def _pattern(self) -> IntArray:
        """Which vertices are negative, by bits, shape (n,)."""
        return np.asarray((self.values < 0.0) @ (1 << np.arange(self.values.shape[1])))

    @cached_property
    def of_negative(self) -> Any:
        """Whether it is the negative side that has fewer vertices, or as many as the other one, shape (n,)."""
        return _patterns(self.values.shape[1])[0][self._pattern]

    @cached_property
    def smaller(self) -> tuple[SideParts, ...]:
        """Parts of the sides that have fewer vertices, for each number of these that occurs."""
        return tuple(places.parts(*_of_smaller(*places.counts)) for places in self._places)

    @cached_property
    def larger(self) -> tuple[SideParts, ...]:
        """Parts of the other sides."""
        return tuple(places.parts(*_of_larger(*places.counts)) for places in self._places)

    @cached_property
    def zero(self) -> tuple[Parts, ...]:
        """Parts of where the function is zero, simplices with one vertex less."""
        return tuple(Parts(places.rows, places.points[:, _of_zero(*places.counts)]) for places in self._places)

    @cached_property
    def smaller_share(self) -> FloatArray:
        """Volume of the sides that have fewer vertices relative to the simplices, shape (n,)."""
        share = np.empty(len(self.values))
        for parts in self.smaller:
            share[parts.rows] = parts.shares.sum(axis=1)
        return share

    @cached_property
    def _places(self) -> list["_Places"]:
        vertices = self.values.shape[1]
        _, count, order = _patterns(vertices)
        found, count = [], count[self._pattern]
        for k in range(1, vertices // 2 + 1):
            rows = np.flatnonzero(count == k)
            if not len(rows):
                continue
            places = order[self._pattern[rows]]
            values, corners = self.values[rows[:, None], places], np.eye(vertices).take(places, axis=0)
            a, b = values[:, :k, None], values[:, None, k:]
            t = a / (a - b)
            between = (1.0 - t)[..., None] * corners[:, :k, None] + t[..., None] * corners[:, None, k:]
            points = np.concatenate([corners, between.reshape(len(rows), -1, vertices)], axis=1)
            found.append(_Places((k, vertices - k), rows, points, t.reshape(len(rows), -1)))
        return found


class _Places(NamedTuple):
    """Points in which simplices are divided that have as many vertices on the smaller side.

    Attributes:
        counts: of the vertices on both sides, k and m.
        rows: the simplices, shape (n,).
        points: coordinates of all a, b and e, shape (n, k + m + k m, k + m).
        t: coordinates of the e that belong to b, those of a are one minus them, shape (n, k m).
    """

    counts: tuple[int, int]
    rows: IntArray
    points: FloatArray
    t: FloatArray

    def parts(self, table: IntArray, factors: IntArray) -> SideParts:
        """See :func:`_of_smaller`."""
        corners, n = sum(self.counts), self.points.shape[1]
        coordinates = np.ones((len(self.rows), 2 * n))
        coordinates[:, corners:n], coordinates[:, n + corners :] = 1.0 - self.t, self.t
        shares = coordinates.take(factors, axis=1).prod(axis=2)
        return SideParts(self.rows, self.points.take(table, axis=1), shares)


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
def _patterns(vertices: int) -> tuple[Any, IntArray, IntArray]:
    """What follows from which vertices are negative, by their bits.

    Returns:
        Whether the side that has fewer vertices is the negative one, how many vertices that side has, and all vertices,
        those of that side first, as an even permutation.
    """
    bits = np.arange(1 << vertices)
    negative = (bits[:, None] >> np.arange(vertices) & 1).astype(bool)
    of_negative = 2 * negative.sum(axis=1) <= vertices
    few = negative == of_negative[:, None]
    order = np.argsort(~few, axis=1, kind="stable")
    if vertices > 2:
        odd = np.linalg.det(np.eye(vertices)[order]) < 0.0
        order[odd, -2:] = order[odd, :-3:-1]
    return of_negative, few.sum(axis=1), order


def _paths(rows: int, columns: int) -> IntArray:
    """Ascending paths through a table from its first place to the last one, shape (paths, places, 2)."""
    steps = sorted(set(permutations((0,) * (columns - 1) + (1,) * (rows - 1))))
    down = np.cumsum(np.array(steps, dtype=np.int64).reshape(len(steps), -1), axis=1)
    right = np.arange(1, down.shape[1] + 1) - down
    return np.pad(np.stack([down, right], axis=-1), ((0, 0), (1, 0), (0, 0)))


@cache
def _of_smaller(k: int, m: int) -> tuple[IntArray, IntArray]:
    """Numbers of the points in its parts, shape (parts, vertices), and those of the factors of their shares.

    Every point of a path but the first is the first one that has a part of a certain vertex, of an a if the path goes
    down and of a b if it goes right. So the volume is the product of these parts, which are numbered as the points are,
    those of a before those of b, shape (parts, vertices - 1).
    """
    i, j = np.moveaxis(_paths(k, m + 1), -1, 0)
    points = np.where(j == 0, i, k + m + i * m + j - 1)
    return _turned(points, k, m), points[:, 1:] + np.diff(j) * (k + m + k * m)


@cache
def _of_larger(k: int, m: int) -> tuple[IntArray, IntArray]:
    """The same of the other side, the product of simplices of m and k + 1 vertices: a path goes down to a b."""
    down, i = np.moveaxis(_paths(m, k + 1), -1, 0)
    j = m - 1 - down
    points = np.where(i == 0, k + j, k + m + (i - 1) * m + j)
    return _turned(points, k, m), points[:, 1:] + np.diff(down) * (k + m + k * m)


@cache
def _of_zero(k: int, m: int) -> IntArray:
    """The same of what lies between."""
    i, j = np.moveaxis(_paths(k, m), -1, 0)
    return np.asarray(k + m + i * m + j)


def _turned(table: IntArray, k: int, m: int) -> IntArray:
    """The same simplices in the direction in which the divided one goes."""
    corners = np.eye(k + m)
    middles = 0.5 * (corners[:k, None] + corners[k:]).reshape(-1, k + m)
    against, table = np.linalg.det(np.concatenate([corners, middles])[table]) < 0.0, table.copy()
    table[against, -2:] = table[against, :-3:-1]
    return table


def cross_products(a: FloatArray, b: FloatArray) -> FloatArray:
    """Of vectors in space, shape (n, 3): those of NumPy to the last bit, in a sixth of the time."""
    result = np.empty(a.shape)
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        np.multiply(a[:, i], b[:, j], out=result[:, k])
        result[:, k] -= a[:, j] * b[:, i]
    return result
