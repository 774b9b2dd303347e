"""How the points of a shell hang together: sheets, neighbours, sides that agree, areas.

Patches may be parametrised in any direction, and their normals a_3 with them; what is summed or averaged over several
patches needs signs that make the normals agree.
"""

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
import scipy.sparse as sp
from dolfinx import fem
from scipy.sparse.csgraph import breadth_first_order, connected_components
from scipy.spatial import cKDTree

from shnapr.kinematics import midsurface
from tigar_x import checks, compat
from tigar_x.compat import FloatArray, IntArray
from tigar_x.fem.simplices import cross_products
from tigar_x.fem.time_integration import TimeIntegrator
from tigar_x.splines.spline import ExtractedSpline

SAME_ROW = 1e-10
"""Difference of normalised rows of the extraction within which two nodes are one place of a joint."""


@dataclass(frozen=True, eq=False)
class Chain:
    """How the points of curves hang together.

    Attributes:
        segments: pairs of neighbouring points, all in one direction along a curve, shape (segments, 2).
        place: number of the place in which a point is, the same for points that a joint unites, shape (points,).
    """

    segments: IntArray
    place: IntArray

    def __post_init__(self) -> None:
        checks.freeze(self)

    @cached_property
    def places(self) -> int:
        """Number of the places."""
        return int(self.place.max(initial=-1)) + 1

    @cached_property
    def ends(self) -> IntArray:
        """Places at the ends of the segments, shape (segments, 2)."""
        return self.place[self.segments]

    @cached_property
    def free(self) -> Any:
        """Mask of the points at free ends, shape (points,)."""
        return np.bincount(self.ends.ravel(), minlength=self.places)[self.place] == 1

    @cached_property
    def curve(self) -> IntArray:
        """Number of the curve to which a segment belongs, shape (segments,)."""
        joined = sp.coo_matrix((np.ones(len(self.ends)), self.ends.T), shape=(self.places, self.places))
        return np.asarray(connected_components(joined, directed=False)[1][self.ends[:, 0]])

    def sums(self, values: FloatArray) -> FloatArray:
        """Of values of the segments that meet at a place, at every point, shape (points, k).

        Args:
            values: shape (segments, k).
        """
        ends = self.ends.T.ravel()
        sums = [np.bincount(ends, np.tile(column, 2), self.places) for column in values.T]
        return np.asarray(np.stack(sums, axis=1)[self.place], dtype=np.float64)


@dataclass(frozen=True, eq=False)
class Sheets:
    """The points of a shell as the corners of small cells, which are joined where patches are.

    Attributes:
        cells: points around every cell, in the direction of the parametric plane or curve, shape (cells, corners).
        joints: pairs of points that are one place of a joint, shape (joints, 2).
        X: reference positions, shape (points, d); unit: length.
        mobility: weight of the functions that are free to move at the points, shape (points, d).
    """

    cells: IntArray
    joints: IntArray
    X: FloatArray
    mobility: FloatArray

    @classmethod
    def of(cls, spline: ExtractedSpline) -> "Sheets":
        """Sheets of a spline that lives whole on this rank."""
        rows = spline.vector.nodes
        rows = sp.diags(1.0 / np.sqrt(np.asarray(rows.multiply(rows).sum(axis=1)).ravel())) @ rows
        marks = rows @ np.random.default_rng(0).standard_normal((rows.shape[1], 3))  # tell rows from one another
        joints = cKDTree(marks).query_pairs(SAME_ROW, output_type="ndarray").astype(np.int32)
        free = np.ones(spline.rows.shape[1])
        free[spline.zero_dofs] = 0.0
        mobility = np.asarray(abs(spline.rows) @ free).reshape(-1, spline.nsd)
        return cls(_directed(spline), joints.reshape(-1, 2), spline.node_positions, mobility)

    @cached_property
    def edges(self) -> IntArray:
        """Edges of the cells in their cyclic direction, shape (edges, 2)."""
        return np.stack([self.cells, np.roll(self.cells, -1, axis=1)], axis=-1).reshape(-1, 2)

    @cached_property
    def neighbours(self) -> IntArray:
        """Pairs of points at the ends of these edges, each pair once, shape (2, pairs)."""
        return np.ascontiguousarray(np.unique(np.sort(self.edges, axis=1), axis=0).T)

    @cached_property
    def links(self) -> IntArray:
        """Pairs of neighbouring points, also across joints, shape (links, 2)."""
        return np.concatenate([self.edges, self.joints])

    @cached_property
    def both_ways(self) -> IntArray:
        """The same with the second point first as well, shape (2, 2 links)."""
        return np.ascontiguousarray(np.concatenate([self.links, self.links[:, ::-1]]).T)

    def _parts(self, pairs: IntArray) -> IntArray:
        n = len(self.X)
        return connected_components(sp.coo_matrix((np.ones(len(pairs)), pairs.T), shape=(n, n)), directed=False)[1]

    @cached_property
    def sheet(self) -> IntArray:
        """Number of the connected sheet to which a point belongs, shape (points,)."""
        return self._parts(self.links)

    @cached_property
    def places(self) -> IntArray:
        """Number of the place of a point, which it shares with those that a joint unites, shape (points,)."""
        return self._parts(self.joints)

    @cached_property
    def sign(self) -> FloatArray:
        """1 or -1 at every point, times which the normals of a sheet agree across joints, shape (points,).

        A sheet that has only one side, or more than two patches at a joint, has none that agree everywhere.
        """
        patch = self._parts(self.edges)
        n = patch.max(initial=-1) + 1
        sign, turns = np.ones(n), self._turns(patch)
        for start in np.unique(self.sheet, return_index=True)[1]:
            order, before = breadth_first_order(turns, patch[start], directed=False)
            for k in order[1:]:
                turn = turns[before[k], k] + turns[k, before[k]]
                sign[k] = np.copysign(1.0, turn) * sign[before[k]]
        return sign[patch]

    @cached_property
    def chain(self) -> Chain:
        """The points as those of curves, all in one direction where patches are joined."""
        turned = self.sign[self.cells[:, 0]] < 0.0
        return Chain(np.where(turned[:, None], self.cells[:, ::-1], self.cells), self.places)

    def _turns(self, patch: IntArray) -> sp.csr_matrix:
        """Positive for pairs of patches whose normals agree at their joints, negative for those that do not."""
        place = self.places
        if self.cells.shape[1] == 2:  # a joint is a point, the end of one cell and the start of the other
            ends = self.cells.ravel()
            keys, way = place[ends][:, None], np.tile([-1.0, 1.0], len(self.cells))
        else:  # or an edge, which the two cells run along in opposite directions
            ends, pair = self.edges[:, 0], place[self.edges]
            keys, way = np.sort(pair, axis=1), np.sign(pair[:, 1] - pair[:, 0]).astype(float)
        _, facet = np.unique(keys, axis=0, return_inverse=True)
        n = patch.max(initial=-1) + 1
        table = sp.csr_matrix((way, (facet.ravel(), patch[ends])), shape=(facet.max(initial=-1) + 1, n))
        return sp.csr_matrix(-sp.triu(table.T @ table, 1))  # inner facets of a patch cancel

    def stretch(self, x: FloatArray) -> FloatArray:
        """Present area around every point relative to that in the reference configuration.

        Args:
            x: present positions, shape (points, d); unit: length.

        Returns:
            Shape (points,).
        """
        present, reference = self._areas(x), self._reference_areas
        return np.divide(present, reference, out=np.ones(len(x)), where=reference > 0.0)

    @cached_property
    def _reference_areas(self) -> FloatArray:
        return self._areas(self.X)

    def _areas(self, x: FloatArray) -> FloatArray:
        """Areas (in the plane: lengths) of the cells around every point."""
        first, *others = (np.take(x, corners, axis=0) for corners in self.cells.T)  # far faster than an index
        arms = [corner - first for corner in others]
        if self.cells.shape[1] == 2:
            sizes = np.linalg.norm(arms[0], axis=1)
        else:
            sizes = 0.5 * np.linalg.norm(sum(cross_products(a, b) for a, b in pairwise(arms)), axis=1)
        weights = np.repeat(sizes, self.cells.shape[1])
        return np.asarray(np.bincount(self.cells.ravel(), weights, len(x)), dtype=np.float64)


def _directed(spline: ExtractedSpline) -> IntArray:
    """Points around the small cells, along the curve or counterclockwise in the parametric plane."""
    cells = compat.subcells(spline.V)[1]
    xi = spline.scalar.V.tabulate_dof_coordinates()[cells]
    arms = xi[:, 1:] - xi[:, :1]
    along = arms[:, 0, 0] if spline.dim == 1 else np.cross(arms[:, :-1], arms[:, 1:])[..., 2].sum(axis=1)
    return np.where(along[:, None] < 0.0, cells[:, ::-1], cells)


class Normals:
    """Lumped projection of a_3 at the intermediate level, continuous across joints but for the patches' directions.

    Args:
        spline: the midsurface.
        time: integrator of its homogeneous displacement.
        sign: see :attr:`Sheets.sign`.
    """

    def __init__(self, spline: ExtractedSpline, time: TimeIntegrator, sign: FloatArray) -> None:
        self._projector = spline.lumped_projector
        self._sign: FloatArray | None = None
        normal = midsurface(spline, spline.rationalize(time.x_alpha)).normal
        if (sign < 0.0).any():
            side = fem.Function(compat.lagrange_space(spline.mesh, 0))
            cells = compat.cell_dofs(side.function_space)[:, 0]
            side.x.array[cells] = sign[compat.cell_dofs(spline.scalar.V)[:, 0]]
            normal, self._sign = side * normal, sign[:, None]
        self._form = self._projector.compile(normal)

    def __call__(self) -> FloatArray:
        """Normals of the patches as they are parametrised, not renormalised, shape (points, d)."""
        n = self._projector(self._form)
        return n if self._sign is None else self._sign * n
