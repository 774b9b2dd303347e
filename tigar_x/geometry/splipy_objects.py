"""Bases and homogeneous control points from splipy's objects, and back; splipy is imported where one is at hand."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from tigar_x.compat import FloatArray
from tigar_x.geometry.bspline import BSplineBasis


def from_splipy(shape: Any) -> tuple[tuple[BSplineBasis, ...], FloatArray]:
    """Bases and homogeneous control points of a splipy Curve, Surface or Volume.

    Args:
        shape: the splipy object.

    Returns:
        The univariate bases, periodic where the object is, and the control points, first direction fastest, shape
        (n, nsd + 1).

    Raises:
        ValueError: another object, a trimmed surface, whose boundary curves a patch does not have, or a periodic
            object whose start does not have the continuity that splipy says.
    """
    from splipy import SplineObject, TrimmedSurface

    if isinstance(shape, TrimmedSurface) or not isinstance(shape, SplineObject):
        raise ValueError(
            f"shape = {type(shape).__name__}: a splipy Curve, Surface or Volume is required; a trimmed surface has"
            " to be cut into patches first"
        )
    bases, net = [], np.asarray(shape.controlpoints)
    for direction, basis in enumerate(shape.bases):
        wrapped = basis.periodic + 1
        knots = basis.knots[wrapped : len(basis.knots) - wrapped]
        if not np.allclose(knots[[0, -1]], [basis.start(), basis.end()], rtol=0, atol=1e-12 * np.ptp(knots)):
            repeats = basis.order - 1 - basis.periodic
            raise ValueError(f"shape has {basis.knots} in direction {direction}: {repeats} knots at both ends required")
        bases.append(BSplineBasis(basis.order - 1, knots, wrapped > 0))
        net = np.roll(net, -wrapped, axis=direction)
    columns = net.reshape(-1, net.shape[-1], order="F")
    if not shape.rational:
        columns = np.column_stack([columns, np.ones(len(columns))])
    return tuple(bases), columns


def to_splipy(bases: Sequence[BSplineBasis], control: FloatArray, *, rational: bool) -> Any:
    """The splipy Curve, Surface or Volume of bases and control points.

    Args:
        bases: univariate bases.
        control: homogeneous control points, see :func:`from_splipy`.
        rational: whether it is to have weights.
    """
    from splipy import BSplineBasis as Knots
    from splipy import Curve, Surface, Volume

    knots, net = [], control.reshape([*(basis.n for basis in bases), -1], order="F")
    for direction, basis in enumerate(bases):
        extended, first = basis.extended
        knots.append(Knots(basis.degree + 1, extended, -1 - first))
        net = np.roll(net, -first, axis=direction)
    columns = net.reshape(len(control), -1, order="F")
    if not rational:
        columns = columns[:, :-1]
    return (Curve, Surface, Volume)[len(bases) - 1](*knots, columns, rational)
