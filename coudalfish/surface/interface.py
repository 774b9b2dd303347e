"""What cuts the cells of a mesh, curves in the plane or surfaces in space: on which side of it a point lies."""

from dataclasses import dataclass
from typing import Any, Protocol

from scipy.spatial import cKDTree

from tigar_x.compat import FloatArray, IntArray

SAME_DISTANCE = 1e-12
"""Difference of distances, relative to what they are sought within, that rounding makes: the first place counts."""


@dataclass(frozen=True, eq=False)
class Sought:
    """Points of which the nearest places are sought.

    Attributes:
        points: their numbers.
        reach: distance up to which, or one for each; unit: length.
        tree: of these points; None: it is made.
    """

    points: IntArray
    reach: float | FloatArray
    tree: cKDTree | None = None


class Nearest(Protocol):
    """Nearest places to m points.

    Behind free ends, where an interface ends without being attached to anything, it is continued straight on.
    """

    def signed_distance(self) -> FloatArray:
        """Distance, negative where normals point, not a number where a point is farther, shape (m,); unit: length."""

    def sheet(self) -> IntArray:
        """Number of the connected part in which the place is, -1 where a point is farther, shape (m,)."""

    def covered(self) -> Any:
        """Whether the place is not beyond a free end, shape (m,); farther points are not covered."""

    def values(self, of_points: FloatArray) -> FloatArray:
        """Values there, linear between those of the interface's points, zero where a point is farther.

        Args:
            of_points: at the points, shape (points, k).

        Returns:
            Shape (m, k).
        """


class Interface(Protocol):
    """Curves, see :class:`coudalfish.surface.distance.Curves`, or surfaces, see :mod:`coudalfish.surface.surfaces`."""

    @property
    def sheets(self) -> int:
        """Number of the connected parts."""

    def nearest(self, x: FloatArray, *sought: Sought) -> Nearest:
        """Nearest places to points.

        Args:
            x: points, shape (m, d); unit: length.
            sought: of which of them, at least one; of points that are sought twice the last reach counts.
        """

    def near_ends(self, x: FloatArray, reach: float | FloatArray) -> IntArray:
        """Those of some points that are not farther than a distance from a free end, ascending.

        Args:
            x: points, shape (m, d); unit: length.
            reach: the distance, or one for each point; unit: length.
        """

    def crossed(self, start: FloatArray, end: FloatArray, reach: float | FloatArray) -> Any:
        """Mask of the straight lines that cross the interface or its continuation, shape (m,).

        Args:
            start: where they begin, shape (m, d); unit: length.
            end: where they end.
            reach: how far it is continued behind free ends, or how far for each line; unit: length.
        """
