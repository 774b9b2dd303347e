"""What curves and surfaces have in common whose points see averages of the fluid's velocity."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import scipy.sparse as sp

from coudalfish.surface.trace import Location, TraceMatrix
from tigar_x.compat import FloatArray, IntArray

TOUCHING = 1e-10
"""A point whose hat function has less than this share of its area in the fluid is outside."""


@dataclass(frozen=True, eq=False)
class Averaged:
    """A meeting whose points see averages over their hat functions, see :class:`coudalfish.surface.meeting.Meeting`.

    Attributes:
        W: areas of the hat functions in the fluid, shape (points,).
        location: quadrature points.
        penalty: nodal velocities at the quadrature points, and their areas, zero outside the fluid.
        seen: see there.
        means: from values at quadrature points to averages, shape (points, quadrature points); this rank's share.
    """

    W: FloatArray
    location: Location
    penalty: tuple[sp.csr_matrix, FloatArray]
    seen: IntArray
    means: sp.csr_matrix

    @cached_property
    def trace(self) -> TraceMatrix:
        """Averages at the points of nodal velocities."""
        return TraceMatrix(self.means @ self.penalty[0], self.seen)

    @property
    def active(self) -> Any:
        """Mask of the points whose hat functions are in the fluid, wholly or in part, shape (points,)."""
        return self.W > 0.0
