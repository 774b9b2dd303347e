"""How surfaces divide a flow in space, and where they see it: on the polygons on which the signed distance is zero."""

import logging
import math
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import scipy.sparse as sp

from coudalfish.surface.boundary import Attaching
from coudalfish.surface.covering import AROUND
from coudalfish.surface.divided_mesh import DividedMesh
from coudalfish.surface.enriched import Enrichment
from coudalfish.surface.films import Films
from coudalfish.surface.interface import Sought
from coudalfish.surface.kinks import KinkedMeeting
from coudalfish.surface.meeting import Meeting
from coudalfish.surface.on_polygons import OnPolygons
from coudalfish.surface.polygons import ZeroPoints, ZeroSet
from coudalfish.surface.sheets import Sheets
from coudalfish.surface.surfaces import Surfaces
from tigar_x import ranks
from tigar_x.compat import FloatArray

log = logging.getLogger(__name__)

QUADRATURE = 2
"""Degree of the polynomials that points on polygons integrate exactly: hat functions times velocities."""
SMALL = 0.25
"""Edges of parts of polygons, in sizes of their cells, up to which one point suffices: kinks, quadratic, need more."""
FEW = 4.2
"""Longest edge of a part of a polygon, in distances of the surface's points, up to which its few points are as dense as
every hat function needs, and half as long if it has one point. Where there are three points of the surface along the
edge of a cube of cells, parts are shorter unless the surface is as oblique as the cells."""
FINE = 3.0
"""The same of what longer ones are divided into, so that hat functions have more alike."""
MOST = 8
"""Parts into which edges are divided at most: more are for points that meet, as at poles of patches."""
UNSEEN = 0.1
"""Share of a surface's area in which its points are too close to each other for that, before a warning."""
BESIDE = AROUND
"""Distance of a polygon from the surface, in sizes of its cell, up to which it sees it."""
ATTACHED = 0.1
"""Distance from the boundary, in sizes of cells, within which an edge of a surface is attached to it in a step."""


class DividedSpace(DividedMesh):
    """A mesh of tetrahedra that surfaces divide, see :class:`coudalfish.sides.sided_fluid.Dividing`."""

    _at_rest: tuple[Sheets, Attaching, FloatArray] | None = None
    _films: Films | None = None

    def __call__(
        self, meeting: Meeting, sheets: Sheets, x: FloatArray, v: FloatArray, load: Callable[[], FloatArray]
    ) -> tuple[Enrichment, Meeting]:
        """See there (collective)."""
        if self._at_rest is None or self._at_rest[0] is not sheets:
            attaching = Attaching(self._space.mesh, sheets, ATTACHED * self._size)
            resting = Surfaces(sheets.X, attaching(sheets.X))
            self._warn_of_close_points(resting)
            self._at_rest = sheets, attaching, resting.triangles.areas
        _, attaching, at_rest = self._at_rest
        surfaces = Surfaces(x, net := attaching(x))
        self._films = None
        films = partial(self._films_of, surfaces, load)
        found = self._enriching(surfaces, meeting, v if self._kinked else None, films)
        whole, comm = meeting.W, self._space.mesh.comm
        points, hats, areas = ranks.together(comm, lambda: self._seen(found.zero, surfaces, at_rest))
        on = OnPolygons.of(points, hats, net, areas, self._enriching.vertices, whole, meeting, comm)
        if not self._kinked:
            return found, on
        return found, KinkedMeeting.of(on, self._space, on.location, found.known / self._size, found.kink)

    def _seen(
        self, zero: ZeroSet, surfaces: Surfaces, at_rest: FloatArray
    ) -> tuple[ZeroPoints, sp.csr_matrix, FloatArray]:
        """Points on this rank's polygons, hat functions of the surface's points there, and areas at rest."""
        owned = zero.only(zero.cut.cells[zero.rows] < self._enriching.owned)
        points = self._points_of(owned, surfaces)
        areas, flat = surfaces.triangles.areas, surfaces.triangles.flat
        stretch = np.divide(areas, at_rest, out=np.ones_like(areas), where=~flat)
        sheet = None
        if self._films is not None:  # polygons half way to another sheet are those of the one that carries the jump
            of_nodes = self._films.carrying[self._enriching.vertices[points.cells]]
            sheet = np.where((of_nodes == of_nodes[:, :1]).all(axis=1), of_nodes[:, 0], -1)
        return points, *points.on(surfaces, stretch, BESIDE * self._enriching.sizes[points.cells], sheet)

    def _warn_of_close_points(self, surfaces: Surfaces) -> None:
        """Tell of a surface of which polygons do not see all points."""
        close, areas = MOST * FINE * surfaces.spacings < math.sqrt(2.0) * self._size, surfaces.triangles.areas
        if areas[close].sum() > UNSEEN * areas.sum() and self._space.mesh.comm.rank == 0:
            log.warning(
                "points of the shell are %.3g apart in %.2g of its area, %.3g times the fluid's cell size: the fluid "
                "does not act on all of them (at least %.2g times is advised; use larger elements or refine the fluid)",
                np.median(surfaces.spacings[close]),
                areas[close].sum() / areas.sum(),
                np.median(surfaces.spacings[close]) / self._size,
                math.sqrt(2.0) / (MOST * FINE),
            )

    def _points_of(self, zero: ZeroSet, surfaces: Surfaces) -> ZeroPoints:
        """Points on polygons, more of them where those of the surface are close to each other."""
        small, spacings = 0.0 if self._kinked else SMALL, surfaces.spacings
        needed = np.where(zero.small(small), 2.0, 1.0) * zero.lengths / FEW
        long = np.flatnonzero(needed > spacings.min(initial=np.inf))
        if not len(long):
            return zero.quadrature(QUADRATURE, small)
        there = self._spacings_at(zero.only(long), surfaces)
        parts = np.zeros(len(needed))
        fine = np.clip(np.ceil(zero.lengths[long] / (FINE * there)), 1, MOST)
        parts[long] = np.where(needed[long] > there, fine, 0)
        return zero.finer(parts.astype(int), QUADRATURE, small)

    def _spacings_at(self, zero: ZeroSet, surfaces: Surfaces) -> FloatArray:
        """Spacings of the surface's points at polygons, infinite where none is in reach, shape (n,)."""
        spacings = np.append(np.where(surfaces.spacings > 0.0, surfaces.spacings, np.inf), np.inf)
        nearest = np.full(len(zero.rows), -1)
        if zero.nearest is not None:  # what has been cut at a free edge has another middle
            nearest[:] = zero.nearest
        sought = np.flatnonzero(nearest < 0)
        middles, reach = zero.only(sought).middles(), BESIDE * self._enriching.sizes[zero.cut.cells[zero.rows[sought]]]
        nearest[sought] = surfaces.nearest(middles, Sought(np.arange(len(middles)), reach)).triangle(reach)
        return np.asarray(spacings[nearest])

    def _films_of(self, surfaces: Surfaces, load: Callable[[], FloatArray], *nodes: Any) -> Films:
        """See :class:`coudalfish.surface.films.Films`."""
        self._films = Films(self._space.mesh.comm, surfaces, load(), *nodes)
        return self._films

    def suits(self, load: Callable[[], FloatArray]) -> bool:
        """See there (collective)."""
        return self._films is None or self._films.suit(load())
