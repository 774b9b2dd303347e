"""How surfaces divide a flow in space, and where they see it: on the polygons on which the signed distance is zero."""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import scipy.sparse as sp

from coudalfish.surface.boundary import net_in
from coudalfish.surface.divided_mesh import DividedMesh
from coudalfish.surface.enriched import Enrichment
from coudalfish.surface.films import Films
from coudalfish.surface.kinks import KinkedMeeting
from coudalfish.surface.meeting import Meeting
from coudalfish.surface.net import Net
from coudalfish.surface.on_polygons import OnPolygons
from coudalfish.surface.polygons import ZeroPoints, ZeroSet
from coudalfish.surface.sheets import Sheets
from coudalfish.surface.surfaces import Surfaces
from tigar_x import ranks
from tigar_x.compat import FloatArray

QUADRATURE = 2
"""Degree of the polynomials that points on polygons integrate exactly: hat functions times velocities."""
SMALL = 0.25
"""Edges of parts of polygons, in sizes of their cells, up to which one point suffices: kinks, quadratic, need more."""
BESIDE = 0.5
"""Distance of a polygon from the surface, in sizes of its cell, up to which it sees it."""
ATTACHED = 0.1
"""Distance from the boundary, in sizes of cells, within which an edge of a surface is attached to it."""


class DividedSpace(DividedMesh):
    """A mesh of tetrahedra that surfaces divide, see :class:`coudalfish.sides.sided_fluid.Dividing`."""

    _net: tuple[Sheets, Net, FloatArray] | None = None
    _films: Films | None = None

    def __call__(
        self, meeting: Meeting, sheets: Sheets, x: FloatArray, v: FloatArray, load: Callable[[], FloatArray]
    ) -> tuple[Enrichment, Meeting]:
        """See there (collective)."""
        if self._net is None or self._net[0] is not sheets:
            net = net_in(self._space.mesh, sheets, ATTACHED * self._size)
            self._net = sheets, net, Surfaces(sheets.X, net).triangles.areas
        _, net, at_rest = self._net
        surfaces = Surfaces(x, net)
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
        points = owned.quadrature(QUADRATURE, 0.0 if self._kinked else SMALL)
        areas, flat = surfaces.triangles.areas, surfaces.triangles.flat
        stretch = np.divide(areas, at_rest, out=np.ones_like(areas), where=~flat)
        return points, *points.on(surfaces, stretch, BESIDE * self._enriching.sizes[points.cells])

    def _films_of(self, surfaces: Surfaces, load: Callable[[], FloatArray], *nodes: Any) -> Films:
        """See :class:`coudalfish.surface.films.Films`."""
        self._films = Films(self._space.mesh.comm, surfaces, load(), *nodes)
        return self._films

    def suits(self, load: Callable[[], FloatArray]) -> bool:
        """See there (collective)."""
        return self._films is None or self._films.suit(load())
