"""How the points of a surface hang together as triangles: edges, places that joints unite, ends, sheets.

A quadrilateral is four triangles around its middle, so that mirror images of surfaces are made of mirrored triangles.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

from coudalfish.surface.boxes import neighbouring
from coudalfish.surface.sheets import Sheets
from tigar_x import checks
from tigar_x.compat import FloatArray, IntArray

OPPOSITE = ((1, 2), (2, 0), (0, 1))
"""Corners of the edges of a triangle, by the corner opposite."""
COLLAPSED = 1e-8
"""Length of an edge at rest, relative to the longest one, up to which its ends are one place."""


class Around(NamedTuple):
    """Which corners of triangles belong to each of some things.

    Attributes:
        corners: their numbers, three times that of the triangle and the corner, those of the first thing first.
        starts: where those of each begin, and their number.
    """

    corners: IntArray
    starts: IntArray

    @classmethod
    def of(cls, at: IntArray) -> "Around":
        """By the number of the thing at every corner, shape (triangles, 3)."""
        starts = np.append(0, np.cumsum(np.bincount(at.ravel())))
        return cls(np.argsort(at.ravel(), kind="stable"), starts)

    def __call__(self, wanted: IntArray) -> tuple[IntArray, IntArray]:
        """Those of some things, and to which of these each belongs."""
        first, count = self.starts[wanted], self.starts[wanted + 1] - self.starts[wanted]
        of = np.repeat(np.arange(len(wanted)), count)
        return self.corners[np.arange(len(of)) + (first - np.cumsum(count) + count)[of]], of


class Ending(NamedTuple):
    """Edges at which a surface ends.

    Attributes:
        triangle: to which of the triangles each belongs, shape (n,).
        corner: which corner of that is opposite, likewise.
        points: at both ends of each, as no middle of a cell is, shape (n, 2).
        order: in which those are together that are close to each other at rest; None: it is not known.
    """

    triangle: IntArray
    corner: IntArray
    points: IntArray
    order: IntArray | None


@dataclass(frozen=True, eq=False)
class Net:
    """How the points of a surface hang together.

    Attributes:
        cells: points around triangles or quadrilaterals, whose normals agree within a sheet, shape (cells, corners).
        place: number of the place of a point, the same for points that a joint unites, shape (points,).
        attached: places at the ends of edges at which the surface is attached to a wall, shape (edges, 2); None: at
            none.
        rest: positions of the points at rest, shape (points, 3); None: they are not known; unit: length.
    """

    cells: IntArray
    place: IntArray
    attached: IntArray | None = None
    rest: FloatArray | None = None

    def __post_init__(self) -> None:
        checks.freeze(self)

    @classmethod
    def of(cls, sheets: Sheets, attached: IntArray | None = None) -> "Net":
        """The points of a shell, of which those at a pole, a side of a patch without length, are in one place.

        Args:
            sheets: how its cells hang together.
            attached: see above.
        """
        turned = sheets.sign[sheets.cells[:, 0]] < 0.0
        pairs = sheets.edges
        lengths = np.linalg.norm(sheets.X[pairs[:, 0]] - sheets.X[pairs[:, 1]], axis=1)
        pairs = sheets.places[pairs[lengths <= COLLAPSED * lengths.max(initial=0.0)]]
        size = (int(sheets.places.max(initial=-1)) + 1,) * 2
        _, united = connected_components(sp.coo_matrix((np.ones(len(pairs)), pairs.T), shape=size), directed=False)
        cells = np.where(turned[:, None], sheets.cells[:, ::-1], sheets.cells)
        return cls(cells, united[sheets.places], attached, sheets.X)

    @cached_property
    def order(self) -> IntArray | None:
        """Cells in an order in which those are together that are close to each other at rest; None: it is not known."""
        return None if self.rest is None else neighbouring(self.rest[self.cells].mean(axis=1))

    @property
    def parts(self) -> int:
        """Triangles of which a cell is made."""
        return 1 if self.cells.shape[1] == 3 else 4

    @cached_property
    def triangles(self) -> IntArray:
        """Their corners, of which those beyond the points are middles of cells, cell by cell, shape (triangles, 3)."""
        if self.cells.shape[1] == 3:
            return self.cells
        middles = len(self.place) + np.arange(len(self.cells))
        sides = [self.cells, np.roll(self.cells, -1, axis=1), np.broadcast_to(middles[:, None], self.cells.shape)]
        return np.stack(sides, axis=-1).reshape(-1, 3)

    @cached_property
    def functions(self) -> sp.csr_matrix:
        """Hat functions of the points at the corners of triangles, shape (corners, points)."""
        n, (cells, corners) = len(self.place), self.cells.shape
        whole = sp.identity(n, format="csr")
        if corners == 3:
            return whole
        middle = np.full(cells * corners, 1.0 / corners), self.cells.ravel(), np.arange(0, cells * corners + 1, corners)
        return sp.vstack([whole, sp.csr_matrix(middle, shape=(cells, n))], format="csr")

    @cached_property
    def corners(self) -> IntArray:
        """Places of the corners of the triangles, shape (triangles, 3)."""
        number = int(self.place.max(initial=-1)) + 1
        return np.append(self.place, number + np.arange(len(self.cells)))[self.triangles]

    @cached_property
    def _edges(self) -> tuple[IntArray, IntArray]:
        """See :attr:`edge_places` and :attr:`edges`."""
        pairs = np.sort(self.corners[:, OPPOSITE], axis=-1).reshape(-1, 2)
        ends, edge = np.unique(pairs, axis=0, return_inverse=True)
        return ends, edge.reshape(-1, 3)

    @cached_property
    def numbers(self) -> IntArray:
        """Of each triangle, its edges and its corners, the same for those that are the same, shape (triangles, 7)."""
        n = len(self.triangles)
        return np.column_stack([np.arange(n), n + self.edges, 4 * n + self.corners])

    @cached_property
    def count(self) -> int:
        """More than any of these numbers."""
        return int(self.numbers.max(initial=-1)) + 1

    @property
    def edge_places(self) -> IntArray:
        """Places at the ends of the edges, ascending, shape (edges, 2)."""
        return self._edges[0]

    @property
    def edges(self) -> IntArray:
        """Number of the edge opposite each corner of the triangles, shape (triangles, 3)."""
        return self._edges[1]

    @cached_property
    def ends(self) -> Any:
        """Mask of the edges of one triangle alone, at which the surface ends, shape (edges,)."""
        a, b = self.edge_places.T
        return (np.bincount(self.edges.ravel()) == 1) & (a != b)

    @cached_property
    def free(self) -> Any:
        """Mask of those that are not attached to a wall, shape (edges,)."""
        if self.attached is None:
            return self.ends
        size = int(self.corners.max(initial=-1)) + 1
        numbers, attached = (np.sort(pairs, axis=1) @ [size, 1] for pairs in (self.edge_places, self.attached))
        return self.ends & ~np.isin(numbers, attached)

    @cached_property
    def around_edges(self) -> Around:
        """Corners of triangles opposite every edge."""
        return Around.of(self.edges)

    @cached_property
    def around_places(self) -> Around:
        """Corners of triangles at every place."""
        return Around.of(self.corners)

    @cached_property
    def at_ends(self) -> Ending:
        """Where the surface ends."""
        return self._ending(self.ends)

    @cached_property
    def at_free(self) -> Ending:
        """Where it ends and is not attached."""
        return self._ending(self.free)

    def _ending(self, edges: Any) -> Ending:
        triangle, corner = np.nonzero(edges[self.edges])
        points = self.triangles[triangle[:, None], np.array(OPPOSITE)[corner]]
        order = None if self.rest is None else neighbouring(self.rest[points].mean(axis=1))
        return Ending(triangle, corner, points, order)

    @cached_property
    def places_at_ends(self) -> Any:
        """Mask of the places where the surface ends, shape (places,)."""
        return self._at(self.ends)

    @cached_property
    def places_at_free(self) -> Any:
        """Mask of those where it ends and is not attached, shape (places,)."""
        return self._at(self.free)

    def _at(self, edges: Any) -> Any:
        there = np.zeros(int(self.corners.max(initial=-1)) + 1, dtype=bool)
        there[self.edge_places[edges]] = True
        return there

    @cached_property
    def sheet(self) -> IntArray:
        """Number of the connected sheet to which a triangle belongs, shape (triangles,)."""
        n, number = len(self.edges), int(self.edges.max(initial=-1)) + 1
        of = sp.csr_matrix((np.ones(3 * n), (np.repeat(np.arange(n), 3), self.edges.ravel())), shape=(n, number))
        return np.asarray(connected_components(of @ of.T, directed=False)[1])

    @cached_property
    def sheet_of_points(self) -> IntArray:
        """Number of the sheet to which a point belongs, -1: none, shape (points,)."""
        result = np.full(self.functions.shape[0], -1)
        result[self.triangles] = self.sheet[:, None]
        return result[: len(self.place)]

    @cached_property
    def one_sided(self) -> Any:
        """Mask of the sheets whose normals cannot agree, as that of a Moebius strip, shape (sheets,).

        Two triangles run along their edge in opposite directions where they agree.
        """
        ends = self.corners[:, OPPOSITE]
        way = np.bincount(self.edges.ravel(), np.sign(ends[..., 1] - ends[..., 0]).ravel())
        result = np.zeros(int(self.sheet.max(initial=-1)) + 1, dtype=bool)
        result[self.sheet[(np.abs(way) > 1.0)[self.edges].any(axis=1)]] = True
        return result

    def sums(self, values: FloatArray, at: IntArray) -> FloatArray:
        """Sums at edges or places of values of the triangles there.

        Args:
            values: shape (triangles, 3, k).
            at: :attr:`edges` or :attr:`corners`.

        Returns:
            Shape (edges or places, k).
        """
        size = int(at.max(initial=-1)) + 1
        columns = [np.bincount(at.ravel(), column.ravel(), size) for column in np.moveaxis(values, -1, 0)]
        return np.asarray(np.stack(columns, axis=1), dtype=np.float64)
