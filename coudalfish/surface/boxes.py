"""Triangles in a tree of boxes: the places of them that are nearest to points, and the lines that pass through them.

What is tested for every point, some boxes and a few triangles, differs from point to point: this is in C, ``boxes.c``.
"""

from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from coudalfish.surface.interface import SAME_DISTANCE
from coudalfish.surface.triangles import Triangles
from tigar_x import checks, compat
from tigar_x.compat import FloatArray, IntArray

FACE, EDGE, CORNER = 0, 1, 4
"""Kinds of nearest places: within the triangle, ``EDGE + i`` on the edge opposite corner i, ``CORNER + i`` at it."""
LEAF = 4
"""Triangles in the smallest boxes, at most."""
ROOM = 256
"""Places, beside two for each point, for which there is room at first."""
_DECLARATIONS = """
typedef struct {
  const double *x; const int64_t *order; int64_t leaves; const int64_t *first;
  double *boxes, *discs;
} tree;
typedef struct {
  int64_t room; int64_t *point, *triangle, *kind; double *inner, *gap, *distance;
} places;
typedef struct { double share, size; } tolerance;
void fit(const tree *);
double largest(const tree *);
int64_t nearest(const tree *, int64_t, const double *, const double *, const tolerance *, places *);
void within(const tree *, int64_t, const double *, const double *, int8_t *);
int64_t pierced(const tree *, int64_t, const double *, const double *, int64_t, int64_t *, int64_t *);
"""


class NearPlaces(NamedTuple):
    """Places of triangles that are nearest to points.

    Attributes:
        point: to which of them, ascending, shape (n,).
        triangle: in which triangles, shape (n,).
        kind: see above, shape (n,).
        inner: second and third barycentric coordinates there, shape (n, 2).
        gap: from there to the points, shape (n, 3); unit: length.
        distance: its length, shape (n,).
    """

    point: IntArray
    triangle: IntArray
    kind: IntArray
    inner: FloatArray
    gap: FloatArray
    distance: FloatArray

    @property
    def barycentric(self) -> FloatArray:
        """All three coordinates, shape (n, 3)."""
        return np.column_stack([1.0 - self.inner.sum(axis=1), self.inner])

    @classmethod
    def room(cls, n: int) -> "NearPlaces":
        """For n places."""
        point, triangle, kind = np.empty((3, n), dtype=np.int64)
        return cls(point, triangle, kind, np.empty((n, 2)), np.empty((n, 3)), np.empty(n))

    def only(self, chosen: Any) -> "NearPlaces":
        """Some of them, by a mask or in an order."""
        return NearPlaces(*(part[chosen] for part in self))


@dataclass(frozen=True, eq=False)
class Boxes:
    """Triangles in a tree of boxes.

    Attributes:
        x: corners of the triangles, shape (triangles, 3, 3); unit: length.
        order: in which they are in the smallest boxes, those that are close to each other, shape (sought,).
        parts: how many of them, one after the other, make a cell.
    """

    x: FloatArray
    order: IntArray
    parts: int = 1

    def __post_init__(self) -> None:
        checks.freeze(self)

    @classmethod
    def of(cls, triangles: Triangles, parts: int = 1, cells: IntArray | None = None) -> "Boxes":
        """Around triangles that have an area, of which some parts make a cell each.

        Args:
            triangles: cell by cell.
            parts: how many there are in each cell.
            cells: in an order in which those that are close to each other are together; None: it is found.
        """
        boxes, flat = cls.around(triangles.x, parts, cells), triangles.flat
        return cls(boxes.x, boxes.order[~flat[boxes.order]]) if flat.any() else boxes

    @classmethod
    def around(cls, x: FloatArray, parts: int = 1, cells: IntArray | None = None) -> "Boxes":
        """The same of all, which may be lines.

        Args:
            x: corners, shape (triangles, 3, 3); unit: length.
            parts: see above.
            cells: likewise.
        """
        if cells is None:
            cells = neighbouring(x.reshape(-1, 3 * parts, 3).mean(axis=1))
        return cls(x, (parts * cells[:, None] + np.arange(parts)).ravel().astype(np.int64), parts)

    def only(self, chosen: Any) -> "Boxes":
        """Around some of the triangles, by a mask, whole cells."""
        return Boxes(self.x, self.order[chosen[self.order]], self.parts)

    @cached_property
    def _tree(self) -> Any:
        """What the functions in C take, and the arrays on which it rests."""
        first = self.parts * _leaves(len(self.order) // self.parts, max(1, LEAF // self.parts))
        leaves = len(first) - 1
        x, boxes, discs = np.take(self.x, self.order, axis=0), np.empty((2 * leaves - 1, 2, 3)), np.empty((leaves, 8))
        tree = _functions().ffi.new("tree *")
        tree.leaves = leaves
        tree.x, tree.order, tree.first = _doubles(x), _integers(self.order), _integers(first)
        tree.boxes, tree.discs = _doubles(boxes), _doubles(discs)
        _functions().lib.fit(tree)
        return tree, boxes, discs, x, first

    @cached_property
    def size(self) -> float:
        """Length of the diagonal of the largest of the smallest boxes; unit: length."""
        return float(_functions().lib.largest(self._tree[0]))

    def nearest(self, x: FloatArray, limit: FloatArray) -> NearPlaces:
        """Nearest places to points, and those that are farther by rounding alone.

        Args:
            x: points, shape (n, 3); unit: length.
            limit: how far places may be, negative where none is sought, shape (n,).
        """
        x, limit = np.ascontiguousarray(x), np.ascontiguousarray(limit)
        room = ROOM + 2 * len(x)
        if not len(x) or not len(self.order):
            return NearPlaces.room(0)
        while True:
            places = NearPlaces.room(room)
            number = self._nearest(x, limit, places)
            if number >= 0:
                return places.only(slice(number))
            room *= 2

    def _nearest(self, x: FloatArray, limit: FloatArray, places: NearPlaces) -> int:
        """Fill the first places: their number, -1 where there are more."""
        functions = _functions()
        there = functions.ffi.new("places *")
        there.room = len(places.distance)
        there.point, there.triangle, there.kind = map(_integers, places[:3])
        there.inner, there.gap, there.distance = map(_doubles, places[3:])
        tolerance = functions.ffi.new("tolerance *", (SAME_DISTANCE, self.size))
        return int(functions.lib.nearest(self._tree[0], len(x), _doubles(x), _doubles(limit), tolerance, there))

    def within(self, x: FloatArray, limit: FloatArray) -> Any:
        """Mask of points that are not farther than a limit.

        Args:
            x: points, shape (n, 3); unit: length.
            limit: for each, negative where none is near, shape (n,).
        """
        x, limit, result = np.ascontiguousarray(x), np.ascontiguousarray(limit), np.zeros(len(x), dtype=np.int8)
        if len(x) and len(self.order):
            found = _functions().ffi.cast("int8_t *", result.ctypes.data)
            _functions().lib.within(self._tree[0], len(x), _doubles(x), _doubles(limit), found)
        return result > 0

    def pierced(self, start: FloatArray, end: FloatArray) -> tuple[IntArray, IntArray]:
        """Pairs of straight lines and triangles through which they pass, lines ascending.

        Args:
            start: where lines begin, shape (n, 3); unit: length.
            end: where they end.
        """
        start, end, room = np.ascontiguousarray(start), np.ascontiguousarray(end), ROOM + 2 * len(start)
        if not len(start) or not len(self.order):
            return tuple(np.empty((2, 0), dtype=np.int64))
        pierced, ends = _functions().lib.pierced, (_doubles(start), _doubles(end))
        while True:
            line, triangle = np.empty((2, room), dtype=np.int64)
            number = pierced(self._tree[0], len(start), *ends, room, _integers(line), _integers(triangle))
            if number >= 0:
                return line[:number], triangle[:number]
            room *= 2


def neighbouring(x: FloatArray) -> IntArray:
    """An order of points in which those are together that are close to each other, shape (n, 3) -> (n,)."""
    return np.asarray(cKDTree(x, leafsize=1).indices) if len(x) else np.arange(0)


@cache
def _leaves(cells: int, most: int) -> IntArray:
    """First cells of the smallest boxes, and their number: halves of halves, as in the tree that gave the order."""
    first = np.array([0, cells])
    while np.diff(first).max() > most:
        first = np.append(np.column_stack([first[:-1], (first[:-1] + first[1:]) // 2]), first[-1])
    return checks.read_only(first)


@cache
def _functions() -> Any:
    """The functions in C."""
    source = Path(__file__).with_suffix(".c").read_text(encoding="ascii")
    return compat.c_functions("boxes", _DECLARATIONS, source)


def _doubles(values: FloatArray) -> Any:
    ffi = _functions().ffi
    return ffi.cast("double *", values.ctypes.data)


def _integers(values: IntArray) -> Any:
    ffi = _functions().ffi
    return ffi.cast("int64_t *", values.ctypes.data)
