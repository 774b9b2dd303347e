"""Factories of patches, named after what they make."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from tigar_x import checks
from tigar_x.bspline import BSplineBasis, open_knots
from tigar_x.patch import Patch


def _uniform(degree: int, elements: int) -> BSplineBasis:
    degree, elements = checks.whole("degree", degree, 1), checks.whole("elements", elements, 1)
    return BSplineBasis(degree, open_knots(degree, np.linspace(0.0, 1.0, elements + 1)))


def line(start: ArrayLike, end: ArrayLike, *, elements: int, degree: int = 1) -> Patch:
    """Straight curve with constant speed.

    Args:
        start: first point, shape (nsd,), nsd = 2 or 3; unit: length.
        end: last point, same shape.
        elements: number of Bezier elements.
        degree: polynomial degree.

    Returns:
        B-spline curve over [0, 1].

    Raises:
        ValueError: the points coincide or have no such shape.
    """
    a = checks.array("start", start, (None,))
    b = checks.array("end", end, a.shape)
    if len(a) not in (2, 3):
        raise ValueError(f"start has {len(a)} coordinates: 2 or 3 are required")
    if np.array_equal(a, b):
        raise ValueError(f"end = {b}: a point other than start is required")
    basis = _uniform(degree, elements)
    return Patch.from_points([basis], a + basis.greville[:, None] * (b - a))


def parallelogram(
    origin: ArrayLike, edge_0: ArrayLike, edge_1: ArrayLike, *, elements: Sequence[int], degrees: Sequence[int]
) -> Patch:
    """Flat surface spanned by two edges; a rectangle where they are orthogonal.

    Args:
        origin: corner, shape (nsd,), nsd = 2 or 3; unit: length.
        edge_0: edge along the first parametric direction, same shape.
        edge_1: edge along the second.
        elements: number of Bezier elements in both directions.
        degrees: polynomial degrees in both directions.

    Returns:
        B-spline surface over [0, 1]^2.

    Raises:
        ValueError: the edges are parallel or the shapes differ.
    """
    corner = checks.array("origin", origin, (None,))
    e0, e1 = checks.array("edge_0", edge_0, corner.shape), checks.array("edge_1", edge_1, corner.shape)
    if len(corner) not in (2, 3):
        raise ValueError(f"origin has {len(corner)} coordinates: 2 or 3 are required")
    if np.linalg.matrix_rank(np.stack([e0, e1])) < 2:
        raise ValueError(f"edge_1 = {e1}: an edge that is not parallel to edge_0 = {e0} is required")
    for name, pair in (("elements", elements), ("degrees", degrees)):
        if len(pair) != 2:
            raise ValueError(f"{name} = {pair}: one number for each of the 2 directions is required")
    bases = [_uniform(p, n) for p, n in zip(degrees, elements, strict=True)]
    s, t = np.meshgrid(bases[0].greville, bases[1].greville, indexing="ij")
    points = corner + s.ravel(order="F")[:, None] * e0 + t.ravel(order="F")[:, None] * e1
    return Patch.from_points(bases, points)
