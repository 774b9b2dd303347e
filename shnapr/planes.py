"""Contact of a shell with rigid planes: a pressure that grows with the depth, per current area."""

import numbers
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import ufl

from shnapr.conditions import ShellFields
from shnapr.kinematics import midsurface
from tigar_x import checks
from tigar_x.splines.spline import ExtractedSpline


@dataclass(frozen=True)
class RigidPlane:
    """Rigid half-space that pushes a shell out, along its normal.

    The pressure at the depth ``delta = -(x - point) . normal`` is ``k delta`` for ``delta > 0``; with a smoothing
    length s it is ``k (delta + s)^2/(2 s)`` from ``delta = -s`` to 0 and ``k (delta + s/2)`` beyond.

    Attributes:
        point: a point of the plane, numbers, a dolfinx Constant or a UFL vector, shape (d,), d = 2 or 3; unit: length.
        normal: points to where the shell may be, shape (d,); made a unit vector.
        stiffness: k > 0, a number, Constant or UFL expression; unit: force/length^3.
        smoothing: s, the number 0, or a number, Constant or UFL expression > 0; unit: length.

    Raises:
        ValueError: a parameter is out of range or has a wrong shape.
    """

    point: Any
    normal: Sequence[float]
    stiffness: Any
    smoothing: float | ufl.core.expr.Expr = 0.0

    def __post_init__(self) -> None:
        normal = checks.array("normal", self.normal, (None,))
        if len(normal) not in (2, 3):
            raise ValueError(f"normal has shape {normal.shape}: shape (2,) or (3,) is required")
        if not normal.any():
            raise ValueError(f"normal = {self.normal}: a vector other than zero is required")
        normal = normal / np.abs(normal).max()
        object.__setattr__(self, "normal", tuple((normal / np.linalg.norm(normal)).tolist()))
        checks.vector("point", self.point, len(normal))
        checks.parameter("stiffness", self.stiffness, checks.positive)
        plain = isinstance(self.smoothing, numbers.Real)
        checks.parameter("smoothing", self.smoothing, checks.not_negative if plain else checks.positive)

    def term(self, fields: ShellFields) -> ufl.Form:
        """See :class:`shnapr.conditions.Load`; a plane is as stiff under any load factor."""
        return plane_contact(fields.spline, self, fields.y, fields.z)

    def traction(self, depth: Any) -> Any:
        """Pressure of the plane on a shell.

        Args:
            depth: delta; a UFL scalar, or an array where the parameters are numbers or Constants; unit: length.

        Returns:
            Pressure >= 0 of the same kind; unit: force/area.
        """
        k, s = self.stiffness, self.smoothing
        maximum, minimum = ufl.max_value, ufl.min_value
        if not isinstance(depth, ufl.core.expr.Expr):
            k, s = (float(getattr(value, "value", value)) for value in (k, s))
            maximum, minimum = np.maximum, np.minimum
        if isinstance(s, numbers.Real) and s == 0.0:
            return k * maximum(depth, 0.0)
        overlap = maximum(depth + s, 0.0)
        onset = minimum(overlap, s)
        return k * onset * (2.0 * overlap - onset) / (2.0 * s)


def plane_contact(spline: ExtractedSpline, plane: RigidPlane, y: Any, z: Any) -> ufl.Form:
    """Virtual work of a rigid plane, ``-int t(delta) m . z`` over the current area.

    Args:
        spline: the midsurface, in as many dimensions as the plane.
        plane: the plane.
        y: homogeneous displacement, shape (nsd,); unit: length.
        z: test function in ``spline.V``.

    Returns:
        Residual form.

    Raises:
        ValueError: the dimensions of plane and spline differ.
    """
    if len(plane.normal) != spline.nsd:
        raise ValueError(f"plane.normal has shape ({len(plane.normal)},): shape ({spline.nsd},) is required")
    reference, current = midsurface(spline), midsurface(spline, spline.rationalize(y))
    m = ufl.as_vector(plane.normal)
    point = checks.vector("plane.point", plane.point, spline.nsd)
    pressure = plane.traction(ufl.dot(point - current.x, m))
    stretch = ufl.sqrt(ufl.det(current.metric) / ufl.det(reference.metric))
    return -pressure * stretch * ufl.dot(m, spline.rationalize(z)) * spline.dx
