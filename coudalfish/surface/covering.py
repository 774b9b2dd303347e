"""What curves or surfaces cover of the lines or polygons on which the signed distance is zero in cut cells."""

from typing import Any, Protocol

import numpy as np

from coudalfish.surface.interface import Interface, Nearest, Sought
from coudalfish.surface.polygons import ZeroSet
from tigar_x.compat import FloatArray
from tigar_x.fem.simplices import Division

AROUND = 0.5
"""Distance of where the signed distance is zero from what covers it, in sizes of the cell: nothing farther does."""
AT_END = 2.0
"""Distance from free ends, likewise, up to which nodes may be enriched whose cells the surface does not cover whole."""
SAMPLES = 16
"""Parts of a line near a free end, each of which is asked whether the curve covers its middle."""
FINER = 4
"""Parts of an edge into which is divided what may lie on a free edge of a surface: narrower gaps are none."""


class Covering(Protocol):
    """A way to find it."""

    def __call__(self, zero: ZeroSet, interface: Any, sizes: FloatArray, covered: Any, /) -> ZeroSet:
        """What is covered, in parts of lines or polygons.

        Args:
            zero: the lines or polygons.
            interface: the curves or surfaces.
            sizes: lengths of the longest edges of their cells, shape (n,).
            covered: whether the middles are, shape (n,).
        """


def by_curves(zero: ZeroSet, curves: Interface, sizes: FloatArray, covered: Any) -> ZeroSet:
    """By samples near free ends, see :class:`Covering`."""
    at_end = np.zeros(len(zero.rows), dtype=bool)
    at_end[curves.near_ends(zero.middles(), AT_END * sizes)] = True
    if not at_end.any():
        return zero.only(covered)
    samples, *_ = zero.only(at_end).divided(SAMPLES)
    middles, reach = samples.middles(), AROUND * np.repeat(sizes[at_end], SAMPLES)
    there = curves.nearest(middles, Sought(np.arange(len(middles)), reach)).covered()
    return zero.only(covered & ~at_end).joined(samples.only(there))


class NearestWithMargin(Nearest, Protocol):
    """Nearest places that tell how far free edges are, see :class:`coudalfish.surface.surfaces.NearestOnSurfaces`."""

    def margin(self, reach: FloatArray) -> FloatArray:
        """Distance to the next free edge along the surface, negative beyond, at most a reach, shape (m,)."""


class WithEdges(Interface, Protocol):
    """Surfaces, see :class:`coudalfish.surface.surfaces.Surfaces`."""

    def nearest(self, x: FloatArray, *sought: Sought) -> NearestWithMargin:
        """Nearest places to points."""


def by_surfaces(zero: ZeroSet, surfaces: WithEdges, sizes: FloatArray, covered: Any) -> ZeroSet:
    """By polygons that are cut at free edges, exactly where these are straight, see :class:`Covering`."""
    middles = zero.middles()
    radius = np.sqrt(((zero.places(zero.barycentric) - middles[:, None]) ** 2).sum(axis=2).max(axis=1, initial=0.0))
    at_end = np.zeros(len(zero.rows), dtype=bool)
    at_end[surfaces.near_ends(middles, radius)] = True
    clipped = _clipped(zero.only(at_end), surfaces, AROUND * sizes[at_end], 2.0 * radius[at_end])
    return zero.only(covered & ~at_end).joined(clipped)


def _clipped(zero: ZeroSet, surfaces: WithEdges, reach: FloatArray, size: FloatArray) -> ZeroSet:
    """The same, divided into small simplices of which those are cut that lie on a free edge."""
    small, points, table = zero.divided(FINER)
    x = zero.places(points).reshape(-1, points.shape[2] - 1)
    reach, size = np.repeat(reach, points.shape[1]), np.repeat(size, points.shape[1])
    margin = surfaces.nearest(x, Sought(np.arange(len(x)), reach)).margin(size).reshape(points.shape[:2])
    whole = (margin >= 0.0).all(axis=1)
    margin = margin[:, table].reshape(-1, table.shape[1])
    there = margin >= 0.0
    inside, on_edge = there.all(axis=1) & ~np.repeat(whole, len(table)), there.any(axis=1) & ~there.all(axis=1)
    result = zero.only(whole).joined(small.only(inside))
    division, small = Division(margin[on_edge]), small.only(on_edge)
    for positive, sides in ((~division.of_negative, division.smaller), (division.of_negative, division.larger)):
        for parts in sides:
            result = result.joined(small.parts(parts, positive))
    return result
