"""The spline of a shell, with its supports by name."""

from collections.abc import Sequence

import numpy as np
import scipy.sparse as sp
from mpi4py import MPI
from numpy.typing import ArrayLike

from shnapr import supports
from tigar_x import checks
from tigar_x.geometry.multipatch import MultiPatch
from tigar_x.geometry.patch import Patch
from tigar_x.splines.spline import ExtractedSpline


def supported(
    geometry: Patch | MultiPatch | ExtractedSpline,
    comm: MPI.Comm,
    *,
    clamped: Sequence[str],
    pinned: Sequence[str],
    zero_dofs: ArrayLike | Sequence[int],
    constraints: Sequence[sp.spmatrix],
    quadrature_degree: int | None,
) -> ExtractedSpline:
    """The spline with its supports.

    Args:
        geometry: patches, or a spline that has its supports.
        comm: where the spline lives.
        clamped: names of edges whose position and tangent plane are held.
        pinned: names of edges whose position is held.
        zero_dofs: further coefficients that do not move.
        constraints: linear constraints.
        quadrature_degree: of every integral; None: twice the largest degree.

    Raises:
        ValueError: there is no such edge, or the geometry is a spline already and something else is given as well.
    """
    held = [np.asarray(zero_dofs).ravel()]
    if isinstance(geometry, ExtractedSpline):
        if clamped or pinned or len(held[0]) or constraints or quadrature_degree is not None:
            raise ValueError(
                "geometry is a spline, which has its supports and its quadrature: clamped, pinned, zero_dofs,"
                " constraints and quadrature_degree are for patches"
            )
        return geometry
    wanted = "a Patch, a MultiPatch such as disjoint(first, second), or an ExtractedSpline"
    checks.kind("geometry", geometry, Patch | MultiPatch, wanted)
    for name, sides, hold in (("clamped", clamped, supports.clamped), ("pinned", pinned, supports.pinned)):
        if checks.listed(name, sides):
            held.append(hold(geometry, *sides))
    whole = [part for part in held if len(part)]
    return ExtractedSpline(
        geometry,
        comm,
        quadrature_degree=quadrature_degree,
        zero_dofs=np.concatenate(whole) if whole else (),
        constraints=constraints,
    )
