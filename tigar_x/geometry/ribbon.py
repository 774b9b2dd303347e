"""Ribbons along curves in space."""

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
