"""How curves divide a flow in the plane, and where they see it: on the line on which the signed distance is zero."""

from collections.abc import Callable
from typing import Any

import numpy as np

from coudalfish.surface.distance import Curves
from coudalfish.surface.divided_mesh import DividedMesh
from coudalfish.surface.enriched import Enrichment
from coudalfish.surface.kinks import KinkedMeeting
from coudalfish.surface.meeting import Meeting
from coudalfish.surface.sheets import Sheets
from coudalfish.surface.trace import Location
from tigar_x.compat import FloatArray


class DividedPlane(DividedMesh):
    """A mesh of triangles that curves divide, see :class:`coudalfish.sides.sided_fluid.Dividing`."""

    def __call__(
        self, meeting: Meeting, sheets: Sheets, x: FloatArray, v: FloatArray, load: Callable[[], FloatArray]
    ) -> tuple[Enrichment, Meeting]:
        """See there (collective)."""
        found = self._enriching(Curves.of(sheets, x), meeting, v if self._kinked else None)
        phi, divided = found.known, np.zeros(len(self._enriching.vertices), dtype=bool)
        divided[found.cut.cells] = True
        of_cells = phi[self._enriching.vertices], self._enriching.corners
        location = onto_zero_line(meeting.location, *of_cells, divided)
        return found, KinkedMeeting.of(meeting, self._space, location, phi / self._size, found.kink)


def onto_zero_line(location: Location, phi: FloatArray, corners: FloatArray, divided: Any) -> Location:
    """Places in divided triangles moved along the gradient of a linear function to where it is zero.

    They count to the cells in which they were, whose functions are continued where they leave them.

    Args:
        location: the places.
        phi: the function at the vertices of the cells, shape (cells, 3).
        corners: the vertices, shape (cells, 3, 2); unit: length.
        divided: mask of the cells, in which the function has two signs, shape (cells,).
    """
    here = np.flatnonzero(location.owned)
    here = here[divided[location.cells[here]]]
    cells, at = location.cells[here], location.barycentric.copy()
    values, x = phi[cells], corners[cells]
    (p, q), (r, s) = (x[:, 1] - x[:, 0]).T, (x[:, 2] - x[:, 0]).T
    # gradients of the barycentric coordinates of the vertices but the first
    second, third = np.stack([s, -r]) / (p * s - q * r), np.stack([-q, p]) / (p * s - q * r)
    slopes = np.stack([-second - third, second, third], axis=-1)
    gradient = np.einsum("dci,ci->dc", slopes, values)
    steps = np.einsum("ci,ci->c", at[here], values) / np.einsum("dc,dc->c", gradient, gradient)
    at[here] -= steps[:, None] * np.einsum("dci,dc->ci", slopes, gradient)
    return Location(location.cells, at, location.active)
