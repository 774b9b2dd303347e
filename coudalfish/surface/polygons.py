"""Where a linear function is zero in cut cells, and points and areas to integrate over it.

In a triangle it is a line, in a tetrahedron a triangle or a quadrilateral, which is made of two triangles.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.sparse as sp

from coudalfish.surface.cut_cells import CutCells, rule
from coudalfish.surface.interface import Sought
from tigar_x import checks
from tigar_x.compat import FloatArray, IntArray
from tigar_x.fem.simplices import Parts, cross_products

if TYPE_CHECKING:
    from coudalfish.surface.surfaces import Surfaces


@dataclass(frozen=True, eq=False)
class ZeroSet:
    """Simplices, of one dimension less than space has, on which a linear function is zero in cut cells.

    Attributes:
        cut: the cells.
        corners: their vertices, shape (cut, d + 1, d); unit: length.
        rows: number of the cut cell of each, shape (n,).
        barycentric: coordinates of its vertices there, shape (n, d, d + 1).
        nearest: number of the surface's triangle that is nearest to its middle, -1: not known, shape (n,); None: it is
            not known of any.
    """

    cut: CutCells
    corners: FloatArray
    rows: IntArray
    barycentric: FloatArray
    nearest: IntArray | None = None

    def __post_init__(self) -> None:
        checks.freeze(self)

    @classmethod
    def of(cls, cut: CutCells, corners: FloatArray) -> "ZeroSet":
        """All of cut cells; arguments as the attributes."""
        d = corners.shape[2]
        rows, simplices = [np.empty(0, dtype=np.int64)], [np.empty((0, d, d + 1))]
        for parts in cut.division.zero:
            rows.append(np.repeat(parts.rows, parts.barycentric.shape[1]))
            simplices.append(parts.barycentric.reshape(-1, d, d + 1))
        return cls(cut, corners, np.concatenate(rows), np.concatenate(simplices))

    def places(self, barycentric: FloatArray) -> FloatArray:
        """Where points of the cells are, shape (n, ..., d + 1) -> (n, ..., d)."""
        return np.asarray(np.einsum("n...c,nci->n...i", barycentric, np.take(self.corners, self.rows, axis=0)))

    def sizes(self) -> FloatArray:
        """Lengths or areas of the simplices, shape (n,)."""
        ends = self.places(self.barycentric)
        arms = ends[:, 1:] - ends[:, :1]
        if arms.shape[1] == 1:
            return np.asarray(np.sqrt(np.einsum("nki,nki->n", arms, arms)))
        across = cross_products(arms[:, 0], arms[:, 1])
        return np.asarray(0.5 * np.sqrt(np.einsum("ni,ni->n", across, across)))

    def of_cells(self, values: FloatArray) -> FloatArray:
        """Sums over the simplices of every cut cell, shape (n,) -> (cut,)."""
        return np.asarray(np.bincount(self.rows, values, len(self.cut.cells)), dtype=np.float64)

    def normals(self) -> FloatArray:
        """Unit normals in the cells, to where the function is positive, shape (cut, d)."""
        arms, values = self.corners[:, 1:] - self.corners[:, :1], self.cut.values
        gradient = np.linalg.solve(arms, (values[:, 1:] - values[:, :1])[..., None])[..., 0]
        return np.asarray(gradient / np.linalg.norm(gradient, axis=1)[:, None])

    def only(self, chosen: Any) -> "ZeroSet":
        """Some of the simplices."""
        return ZeroSet(self.cut, self.corners, self.rows[chosen], self.barycentric[chosen], self._known[chosen])

    def joined(self, other: "ZeroSet") -> "ZeroSet":
        """These and other ones of the same cells."""
        rows = np.concatenate([self.rows, other.rows])
        places, nearest = ([a, b] for a, b in zip(*((z.barycentric, z._known) for z in (self, other)), strict=True))
        return ZeroSet(self.cut, self.corners, rows, np.concatenate(places), np.concatenate(nearest))

    @property
    def _known(self) -> IntArray:
        """See :attr:`nearest`."""
        return np.full(len(self.rows), -1) if self.nearest is None else self.nearest

    def middles(self) -> FloatArray:
        """Of the simplices, shape (n, d)."""
        return self.places(self.barycentric.mean(axis=1))

    def divided(self, parts: int) -> tuple["ZeroSet", FloatArray, IntArray]:
        """The same of smaller simplices, whose edges are divided into a number of parts.

        Returns:
            The small ones, those of the first simplex first; points at their corners, as many of each simplex, shape
            (n, points, d + 1); and which of these each of the small ones has, shape (small ones of a simplex, d).
        """
        d = self.barycentric.shape[1]
        lattice, table = _divided(d - 1, parts)
        points = lattice @ self.barycentric
        small = points[:, table].reshape(-1, d, d + 1)
        return ZeroSet(self.cut, self.corners, np.repeat(self.rows, len(table)), small), points, table

    def parts(self, parts: Parts, chosen: Any) -> "ZeroSet":
        """Parts of the simplices.

        Args:
            parts: of simplices whose corners are those of these.
            chosen: mask of the simplices that are divided, of which parts are taken, shape (divided,).
        """
        there = chosen[parts.rows]
        inside = parts.barycentric[there] @ self.barycentric[parts.rows[there], None]
        rows = np.repeat(self.rows[parts.rows[there]], inside.shape[1])
        return ZeroSet(self.cut, self.corners, rows, inside.reshape(-1, *self.barycentric.shape[1:]))

    def quadrature(self, degree: int = 2, small: float = 0.0) -> "ZeroPoints":
        """Points to integrate over it, of the simplices in their order, but small ones first.

        Args:
            degree: of the polynomials that are integrated exactly.
            small: length of the longest edge of a simplex, relative to that of its cell, up to which it is small: it
                has one point, with which linear functions are integrated exactly.
        """
        return self._joined(self._by_size(degree, small))

    def _by_size(self, degree: int, small: float) -> list[tuple["ZeroSet", int]]:
        """Small simplices and others, and the degrees with which they are integrated over."""
        is_small = self.small(small)
        return [(self.only(is_small), 1), (self.only(~is_small), degree)]

    def _joined(self, groups: Sequence[tuple["ZeroSet", int]]) -> "ZeroPoints":
        """Points of groups of simplices in the same cells, each with its degree."""
        normals = self.normals()
        parts = (group._points(degree, normals) for group, degree in groups)
        return ZeroPoints(*map(np.concatenate, zip(*parts, strict=True)))

    def small(self, share: float) -> Any:
        """Mask of the simplices whose longest edges are no longer than a share of those of their cells."""
        return self.lengths <= share * longest_edges(self.corners)[self.rows]

    @cached_property
    def lengths(self) -> FloatArray:
        """Of the longest edges of the simplices, shape (n,)."""
        return longest_edges(self.places(self.barycentric))

    def finer(self, parts: IntArray, degree: int, small: float) -> "ZeroPoints":
        """Points as above, but more of them in some of the simplices, which come last.

        Args:
            parts: into which the edges of each are divided, none of which is small; 0: it is as above, shape (n,).
            degree: see :meth:`quadrature`.
            small: likewise.
        """
        groups = self.only(parts == 0)._by_size(degree, small)
        groups += [(self.only(parts == k).divided(int(k))[0], degree) for k in np.unique(parts[parts > 0])]
        return self._joined(groups)

    def _points(self, degree: int, normals: FloatArray) -> tuple[Any, ...]:
        """What :class:`ZeroPoints` are made of; normals in the cells, shape (cut, d)."""
        d = self.barycentric.shape[1]
        x, weights = rule(d - 1, degree)
        at = np.column_stack([1.0 - x.sum(axis=1), x]) @ self.barycentric
        areas = self.sizes()[:, None] * (weights / weights.sum())
        row = np.repeat(self.rows, len(x))
        return self.cut.cells[row], at.reshape(-1, d + 1), areas.ravel(), self.places(at).reshape(-1, d), normals[row]


@dataclass(frozen=True, eq=False)
class ZeroPoints:
    """Quadrature where a linear function is zero.

    Attributes:
        cells: of the points, shape (points,).
        barycentric: coordinates there, shape (points, d + 1).
        areas: that the points stand for, shape (points,); unit: length^(d - 1).
        x: where they are, shape (points, d); unit: length.
        normals: unit normals, to where the function is positive, shape (points, d).
    """

    cells: IntArray
    barycentric: FloatArray
    areas: FloatArray
    x: FloatArray
    normals: FloatArray

    def __post_init__(self) -> None:
        checks.freeze(self)

    def on(
        self,
        surface: "Surfaces",
        stretch: FloatArray,
        reach: float | FloatArray,
        sheet: IntArray | None = None,
    ) -> tuple[sp.csr_matrix, FloatArray]:
        """What of a surface the points stand for.

        Args:
            surface: the surface.
            stretch: areas of its triangles relative to those at rest, shape (triangles,).
            reach: distance beyond which there is no surface, or one for each point; unit: length.
            sheet: number of the connected surface whose points they are, if it is in reach; -1: of the nearest one,
                shape (points,); None: as well.

        Returns:
            Hat functions of the surface's points at the nearest places, shape (points, surface's points), and areas at
            rest, shape (points,).
        """
        reach = np.broadcast_to(reach, len(self.x))
        near = surface.nearest(self.x, Sought(np.arange(len(self.x)), reach))
        hats, ratio = near.functions(), near.of_triangles(1.0 / stretch)
        sheet = np.full(len(self.x), -1) if sheet is None else np.where(sheet == near.sheet(), -1, sheet)
        for k in np.unique(sheet[sheet >= 0]):
            here = np.flatnonzero(sheet == k)
            own = surface.nearest(self.x[here], Sought(np.arange(len(here)), reach[here]), sheet=int(k))
            found = np.flatnonzero(own.sheet() >= 0)
            here, own = here[found], own.of(found)
            kept, shape = np.ones(len(self.x)), (len(self.x), len(here))
            kept[here] = 0.0
            place = sp.csr_matrix((np.ones(len(here)), (here, np.arange(len(here)))), shape=shape)
            hats = sp.csr_matrix(sp.diags(kept) @ hats + place @ own.functions())
            ratio[here] = own.of_triangles(1.0 / stretch)
        return hats, self.areas * ratio


@cache
def _divided(dim: int, parts: int) -> tuple[FloatArray, IntArray]:
    """Barycentric coordinates of a lattice on an interval or a triangle, and the equal simplices that it makes."""
    if dim == 1:
        t = np.arange(parts + 1.0) / parts
        return np.column_stack([1.0 - t, t]), np.column_stack([np.arange(parts), np.arange(1, parts + 1)])
    i, j = np.array([(i, j) for i in range(parts + 1) for j in range(parts + 1 - i)]).T
    number = np.full((parts + 2, parts + 2), -1)
    number[i, j] = np.arange(len(i))
    up, down = i + j < parts, i + j < parts - 1
    table = [np.column_stack([number[i, j], number[i + 1, j], number[i, j + 1]])[up]]
    table.append(np.column_stack([number[i + 1, j + 1], number[i, j + 1], number[i + 1, j]])[down])
    return np.column_stack([parts - i - j, i, j]) / parts, np.concatenate(table)


def longest_edges(corners: FloatArray) -> FloatArray:
    """Of simplices, shape (n, corners, d) -> (n,)."""
    a, b = np.triu_indices(corners.shape[1], 1)
    arms = corners[:, b] - corners[:, a]
    return np.asarray(np.sqrt(np.einsum("nei,nei->ne", arms, arms).max(axis=1, initial=0.0)))
