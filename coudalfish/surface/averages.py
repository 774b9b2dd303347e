"""Curves that see the fluid by averages: the exact trace.

A point does not stand for the velocity where it is, but for the average over its hat function phi_q, which is linear
between neighbouring points: ``u_q = (1/W_q) int phi_q u dA`` with ``W_q = int phi_q dA`` over the part in the fluid.
The integrals are exact: they are taken over the pieces into which the fluid's cells divide the curve, on each of which
the integrand is a polynomial. A curve that is moved a little feels a little change, whatever cells its points lie in.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp
from dolfinx import fem

from coudalfish.surface.averaged import TOUCHING, Averaged
from coudalfish.surface.crossings import CellsNearby, Pieces, pieces_of
from coudalfish.surface.sheets import Sheets
from coudalfish.surface.trace import PointLocator, trace_matrix
from tigar_x import compat
from tigar_x.compat import FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class ByAverages(Averaged):
    """A curve in a step whose points see averages, see :class:`coudalfish.surface.meeting.Meeting`.

    Attributes:
        locator: of the fluid's mesh.
    """

    locator: PointLocator

    def vertex_functions(self) -> sp.csr_matrix:
        """See there."""
        return (self.means @ self.locator.vertex_functions(self.location)).tocsr()

    def normal_forces(self, functions: sp.csr_matrix, n: FloatArray, trace: sp.csr_matrix | None = None) -> None:
        """See there: normals of the curve are as good, since phi is corrected by its means over it."""


class MeetsByAverages:
    """The exact trace of a curve.

    Args:
        space: scalar space of one component of the fluid's velocity.
        segments: pairs of neighbouring points, shape (segments, 2).
        lengths: reference lengths between them, shape (segments,); unit: length.
        points: number of points.
    """

    def __init__(self, space: fem.FunctionSpace, segments: IntArray, lengths: FloatArray, points: int) -> None:
        self._space, self._segments, self._lengths, self._points = space, segments, lengths, points
        self._whole = np.bincount(segments.ravel(), np.repeat(0.5 * lengths, 2), points)
        order = (compat.lagrange_degree(space) + 3) // 2  # exact for a velocity times a hat function
        at, weights = np.polynomial.legendre.leggauss(order)
        self._at, self._weights = 0.5 * (at + 1.0), 0.5 * weights
        self._nearby: tuple[Any, CellsNearby] | None = None

    @classmethod
    def of(cls, space: fem.FunctionSpace, sheets: Sheets, weights: FloatArray) -> "MeetsByAverages":
        """Of the points of a shell.

        Args:
            space: scalar space of one component of the fluid's velocity.
            sheets: how the points hang together.
            weights: their reference areas, of which a sheet keeps the sum, shape (points,).

        Raises:
            ValueError: the shell is no curve.
        """
        if sheets.cells.shape[1] != 2:
            raise ValueError(
                "trace = 'exact': a curve in the plane is required, or a flow whose fields differ on both sides of a"
                " surface, Flow(..., immersed='jump and kink'); otherwise trace = 'nodes'"
            )
        a, b = sheets.cells.T
        chords, sheet = np.linalg.norm(sheets.X[b] - sheets.X[a], axis=1), sheets.sheet
        straight = np.bincount(sheet[a], chords)
        return cls(space, sheets.cells, chords * (np.bincount(sheet, weights) / straight)[sheet[a]], len(sheets.X))

    def __call__(self, x: FloatArray, locator: PointLocator) -> ByAverages:
        """See :class:`coudalfish.surface.meeting.Meets`."""
        a, b = x[self._segments.T]
        pieces = pieces_of(a, b, locator, self._cells_of(locator), self._space.mesh.comm)
        segment, at, reference = self._quadrature(pieces)
        locator.cells = np.repeat(pieces.cells, len(self._at))
        location = locator.locate(a[segment] + at[:, None] * (b - a)[segment])
        weights = np.where(location.active, reference, 0.0)
        fine = trace_matrix(self._space, location)
        W, means = self._means(segment, at, weights)
        return ByAverages(W, location, (fine.B, weights), fine.nodes, means, locator)

    def _cells_of(self, locator: PointLocator) -> CellsNearby:
        """Made once for a mesh, and again when it has moved."""
        corners = locator.corners
        if self._nearby is None or self._nearby[0] is not corners:
            self._nearby = corners, CellsNearby(corners)
        return self._nearby[1]

    def _quadrature(self, pieces: Pieces) -> tuple[IntArray, FloatArray, FloatArray]:
        """Segments, parameters and reference areas of the points of all pieces."""
        size = (pieces.end - pieces.start)[:, None]
        at = (pieces.start[:, None] + size * self._at).ravel()
        areas = (self._lengths[pieces.segment][:, None] * size * self._weights).ravel()
        return np.repeat(pieces.segment, len(self._at)), at, areas

    def _means(self, segment: IntArray, at: FloatArray, weights: FloatArray) -> tuple[FloatArray, sp.csr_matrix]:
        """Areas of the hat functions of the points, and averages over them of values at quadrature points."""
        point = self._segments[segment].ravel()
        areas = np.column_stack([(1.0 - at) * weights, at * weights]).ravel()
        W = np.asarray(np.bincount(point, areas, self._points), dtype=np.float64)
        W[TOUCHING * self._whole > W] = 0.0
        inverse = np.divide(1.0, W, out=np.zeros_like(W), where=W > 0.0)
        starts = np.arange(0, len(point) + 1, 2)
        return W, sp.csr_matrix((areas * inverse[point], point, starts), shape=(len(at), self._points)).T.tocsr()
