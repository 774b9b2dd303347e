"""Ribbons along curves in space, the knots that their centre lines make, and whether surfaces go through each other.

Source of the invariant: R. H. Fox, "A quick trip through knot theory", in Topology of 3-Manifolds, Prentice-Hall 1962.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline

from tigar_x import checks
from tigar_x.compat import FloatArray
from tigar_x.geometry import shapes
from tigar_x.geometry.bspline import BSplineBasis
from tigar_x.geometry.patch import Patch


@dataclass(frozen=True, eq=False)
class CentreLine:
    """A smooth curve in space by its arc length.

    Attributes:
        curve: position as a function of the arc length.
        length: of the whole curve; unit: length.
    """

    curve: CubicSpline
    length: float

    @classmethod
    def through(cls, points: ArrayLike) -> "CentreLine":
        """Cubic spline with continuous curvature through points, in proportion to the roots of their distances.

        Args:
            points: shape (any, 3); unit: length.

        Returns:
            The curve; the arc length is right to about 1e-6 of it.

        Raises:
            ValueError: points have a wrong shape, or two of them in a row are the same.
        """
        x = checks.array("points", points, (None, 3))
        chords = np.linalg.norm(np.diff(x, axis=0), axis=1)
        if not chords.all() or len(x) < 2:
            raise ValueError(f"points = {x}: two or more are required, none equal to the one before it")
        # roots keep a curve near points that are unevenly spaced (Lee, doi:10.1016/0010-4485(89)90003-1)
        raw = CubicSpline(np.append(0.0, np.cumsum(np.sqrt(chords))), x)
        fine = raw(np.linspace(0.0, raw.x[-1], 400 * len(x) + 1))
        s = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(fine, axis=0), axis=1)))
        return cls(CubicSpline(s[::10], fine[::10]), float(s[-1]))


def ribbon(line: CentreLine, width: float, facing: ArrayLike, along: BSplineBasis, across: BSplineBasis) -> Patch:
    """Ribbon along a curve, level with regard to a direction.

    Args:
        line: its centre line.
        width: its width > 0; unit: length.
        facing: vector that lies in no rung of the ribbon, shape (3,): rungs are normal to it and to the curve.
        along: basis whose parameter is the arc length of the centre line.
        across: basis whose range is mapped to the rungs.

    Returns:
        The patch; it interpolates the ribbon at the Greville points.

    Raises:
        ValueError: an argument is out of range, or the curve runs along ``facing``.
    """
    checks.positive("width", width)
    up = checks.array("facing", facing, (3,))
    low, high = across.knots[0], across.knots[-1]

    def position(s: FloatArray, v: FloatArray) -> FloatArray:
        rung = np.cross(up, line.curve(s, 1))
        size = np.linalg.norm(rung, axis=1)
        if not (size > 1e-6 * np.linalg.norm(up)).all():
            raise ValueError(f"facing = {up}: a direction along which the centre line runs nowhere is required")
        offset = width * ((v - low) / (high - low) - 0.5) / size
        return np.asarray((line.curve(s) + offset[:, None] * rung).T)

    return shapes.interpolated(position, (along, across))


@dataclass(frozen=True, eq=False)
class Crossings:
    """Crossings of a closed polygon seen from above, along its lower passages.

    Attributes:
        over: places of the upper strands along the polygon, counted in vertices, shape (crossings,).
        under: places of the lower strands, ascending.
        signs: +1 where the upper strand has to turn to the left to point along the lower one, else -1.
    """

    over: FloatArray
    under: FloatArray
    signs: FloatArray

    def __post_init__(self) -> None:
        checks.freeze(self)

    @classmethod
    def of(cls, polygon: ArrayLike) -> "Crossings":
        """Crossings of a closed polygon.

        Args:
            polygon: its vertices, shape (any, 3), in general position: no three strands cross in one place.

        Returns:
            The crossings.

        Raises:
            ValueError: the polygon has a wrong shape.
        """
        x = checks.array("polygon", polygon, (None, 3))
        ahead = np.roll(x, -1, axis=0) - x
        i, j = np.triu_indices(len(x), 2)
        turn = _turn(ahead[i], ahead[j])
        crossing = turn != 0.0
        i, j, turn = i[crossing], j[crossing], turn[crossing]
        a, b, gap = ahead[i], ahead[j], x[j] - x[i]
        s, t = _turn(gap, b) / turn, _turn(gap, a) / turn
        # the first and the last side share a vertex
        hit = (s >= 0.0) & (s < 1.0) & (t >= 0.0) & (t < 1.0) & ~((i == 0) & (j == len(x) - 1))
        i, j, s, t, a, b, gap, turn = (value[hit] for value in (i, j, s, t, a, b, gap, turn))
        first_below = s * a[:, 2] < gap[:, 2] + t * b[:, 2]
        under, over = np.where(first_below, (i + s, j + t), (j + t, i + s))
        order = np.argsort(under)
        signs = np.sign(np.where(first_below, -turn, turn))
        return cls(over[order], under[order], signs[order])

    @property
    def writhe(self) -> int:
        """Sum of the signs."""
        return int(self.signs.sum())

    @property
    def determinant(self) -> int:
        """Determinant of the knot, the same in all positions that a closed curve takes without passing itself.

        It is 1 for a ring, 3 for a trefoil, and that of two knots tied one after the other is the product of theirs. It
        comes as a minor of the matrix which says that at every crossing twice the colour of the upper arc is the sum of
        those of the lower ones; arcs run from one lower passage to the next.
        """
        n = len(self.under)
        if n == 0:
            return 1
        rows, matrix = np.arange(n), np.zeros((n, n))
        np.add.at(matrix, (rows, np.searchsorted(self.under, self.over) % n), 2.0)
        np.add.at(matrix, (rows, rows), -1.0)
        np.add.at(matrix, (rows, (rows + 1) % n), -1.0)
        return round(abs(np.linalg.det(matrix[1:, 1:])))


def _turn(a: FloatArray, b: FloatArray) -> FloatArray:
    """Third component of the cross products, positive where b points to the left of a."""
    return np.asarray(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
