"""How curves divide a flow in the plane: where its fields differ, weights of the sides, and where the curves see it."""

import numpy as np
from dolfinx import fem

from coudalfish.surface.cut_cells import CutCells, SideWeights
from coudalfish.surface.distance import Curves
from coudalfish.surface.enriched import Enriching, Enrichment
from coudalfish.surface.facets import FacetWeights
from coudalfish.surface.kinks import KinkedMeeting, onto_zero_line
from coudalfish.surface.meeting import Meeting
from coudalfish.surface.sheets import Sheets
from tigar_x import compat
from tigar_x.compat import FloatArray, IntArray


class DividedPlane:
    """A mesh of triangles that curves divide, see :class:`coudalfish.sides.sided_fluid.Dividing`.

    Args:
        space: scalar linear space of one component of the velocity.
        weights: discontinuous space of the weights of sides.
        walls: the same of those on the boundary.
        size: of cells near the surface; unit: length.
        kinked: whether velocities are kinked; pressures always jump.
    """

    def __init__(
        self,
        space: fem.FunctionSpace,
        weights: fem.FunctionSpace,
        walls: fem.FunctionSpace,
        size: float,
        *,
        kinked: bool,
    ) -> None:
        self._space, self._size, self._kinked = space, size, kinked
        self._enriching = Enriching(space, kinked=kinked)
        self._weights = SideWeights(compat.lagrange_degree(weights), compat.node_points(weights))
        self._walls = FacetWeights(walls, compat.lagrange_degree(walls))

    def __call__(self, meeting: Meeting, sheets: Sheets, x: FloatArray, v: FloatArray) -> tuple[Enrichment, Meeting]:
        """See there (collective)."""
        found = self._enriching(Curves.of(sheets, x), meeting, v if self._kinked else None)
        phi, divided = found.known, np.zeros(len(self._enriching.vertices), dtype=bool)
        divided[found.cut.cells] = True
        of_cells = phi[self._enriching.vertices], self._enriching.corners
        location = onto_zero_line(meeting.location, *of_cells, divided)
        return found, KinkedMeeting.of(meeting, self._space, location, phi / self._size, found.kink)

    @property
    def nothing(self) -> Enrichment:
        """See there."""
        return self._enriching.nothing

    def weights(self, cut: CutCells) -> FloatArray:
        """See there."""
        return self._weights(cut)

    def on_walls(self, cut: CutCells) -> tuple[IntArray, FloatArray]:
        """See there."""
        return self._walls(cut)
