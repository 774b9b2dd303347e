"""Factories of patches, named after what they make: flat shapes, what is swept from others, and analytic maps.

Round and curved surfaces are in :mod:`tigar_x.geometry.surfaces`. All parameters range over [0, 1] unless they come
from a
patch that was given.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from tigar_x import checks
from tigar_x.compat import FloatArray
from tigar_x.geometry.bspline import BSplineBasis, TensorBasis, open_knots
from tigar_x.geometry.patch import Patch


def uniform(degree: int, elements: int) -> BSplineBasis:
    """Open basis over [0, 1] with Bezier elements of equal size and the continuity degree - 1.

    Args:
        degree: polynomial degree.
        elements: number of Bezier elements.

    Raises:
        ValueError: one of them is not a positive integer.
    """
    degree, elements = checks.whole("degree", degree, 1), checks.whole("elements", elements, 1)
    return BSplineBasis(degree, open_knots(degree, np.linspace(0.0, 1.0, elements + 1)))


def uniform_bases(degrees: Sequence[int], elements: Sequence[int], dim: int) -> tuple[BSplineBasis, ...]:
    """Bases of :func:`uniform`, one per direction.

    Args:
        degrees: polynomial degrees, one per direction.
        elements: numbers of Bezier elements, one per direction.
        dim: number of directions.

    Raises:
        ValueError: not one number for each direction, or one that is not a positive integer.
    """
    one_per_direction(dim, elements=elements, degrees=degrees)
    return tuple(uniform(p, n) for p, n in zip(degrees, elements, strict=True))


def one_per_direction(dim: int, **numbers: Sequence[int]) -> None:
    """Check that there are ``dim`` of each of ``numbers``, which are given by name, else ValueError."""
    for name, values in numbers.items():
        if np.shape(values) != (dim,):
            raise ValueError(f"{name} = {values}: one number for each of the {dim} directions is required")


def line(
    start: ArrayLike,
    end: ArrayLike,
    *,
    elements: int,
    degree: int = 1,
    side_names: Mapping[str, tuple[int, int]] | None = None,
) -> Patch:
    """Straight curve with constant speed.

    Args:
        start: first point, shape (nsd,), nsd = 2 or 3; unit: length.
        end: last point, same shape.
        elements: number of Bezier elements.
        degree: polynomial degree.
        side_names: names of its ends, (0, 0) and (0, 1), see :class:`tigar_x.geometry.patch.Patch`.

    Returns:
        B-spline curve.

    Raises:
        ValueError: the points coincide or have no such shape.
    """
    a = _point("start", start)
    b = checks.array("end", end, a.shape)
    if np.array_equal(a, b):
        raise ValueError(f"end = {b}: a point other than start is required")
    return _affine(a, [b - a], [elements], [degree], side_names)


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
        B-spline surface.

    Raises:
        ValueError: the edges are parallel or the shapes differ.
    """
    corner = _point("origin", origin)
    e0, e1 = checks.array("edge_0", edge_0, corner.shape), checks.array("edge_1", edge_1, corner.shape)
    if np.linalg.matrix_rank(np.stack([e0, e1])) < 2:
        raise ValueError(f"edge_1 = {e1}: an edge that is not parallel to edge_0 = {e0} is required")
    return _affine(corner, [e0, e1], elements, degrees)


def plate(
    *, lengths: ArrayLike, center: ArrayLike = (0.0, 0.0, 0.0), elements: Sequence[int], degrees: Sequence[int]
) -> Patch:
    """Rectangle normal to the third axis, its sides along the first two.

    Args:
        lengths: of the sides along the first and the second axis, shape (2,); unit: length.
        center: midpoint, shape (nsd,), nsd = 2 or 3; unit: length.
        elements: number of Bezier elements in both directions.
        degrees: polynomial degrees in both directions.

    Returns:
        B-spline surface, u along the first axis.

    Raises:
        ValueError: a length is not positive, or the shapes are not as above.
    """
    middle = _point("center", center)
    edges = _lengths(lengths, 2)[:, None] * np.eye(2, len(middle))
    return _affine(middle - edges.sum(axis=0) / 2.0, list(edges), elements, degrees)


def strip(
    start: ArrayLike = (0.0, 0.0, 0.0),
    along: ArrayLike = (1.0, 0.0, 0.0),
    across: ArrayLike = (0.0, 1.0, 0.0),
    *,
    length: float,
    width: float,
    elements: Sequence[int],
    degrees: Sequence[int],
) -> Patch:
    """Straight ribbon in space around its middle line.

    Args:
        start: start of the middle line, shape (3,); unit: length.
        along: direction of the middle line (u), of any size, shape (3,).
        across: its part normal to ``along`` is the direction of the width (v), shape (3,).
        length: of the middle line; unit: length.
        width: from edge to edge, half of it on either side of the middle line; unit: length.
        elements: number of Bezier elements along and across.
        degrees: polynomial degrees along and across.

    Returns:
        B-spline surface with the sides "start", "end" (where the middle line starts and ends), "edge_0" and "edge_1".

    Raises:
        ValueError: a size is not positive, or the directions are parallel or zero.
    """
    a, t, s = (checks.array(*it, (3,)) for it in (("start", start), ("along", along), ("across", across)))
    if np.linalg.matrix_rank(np.stack([t, s])) < 2:
        raise ValueError(f"across = {s}: a direction that is not parallel to along = {t} is required")
    t = t / np.linalg.norm(t)
    s = s - (s @ t) * t
    e0 = checks.positive("length", length) * t
    e1 = checks.positive("width", width) * s / np.linalg.norm(s)
    names = {"start": (0, 0), "end": (0, 1), "edge_0": (1, 0), "edge_1": (1, 1)}
    return _affine(a - e1 / 2.0, [e0, e1], elements, degrees, names)


def box(
    *, lengths: ArrayLike, origin: ArrayLike = (0.0, 0.0, 0.0), elements: Sequence[int], degrees: Sequence[int]
) -> Patch:
    """Volume with its edges along the axes.

    Args:
        lengths: of the edges, shape (3,); unit: length.
        origin: corner with the least coordinates, shape (3,); unit: length.
        elements: number of Bezier elements in each direction.
        degrees: polynomial degree in each direction.

    Returns:
        B-spline volume.

    Raises:
        ValueError: a length is not positive, or the shapes are not as above.
    """
    corner = checks.array("origin", origin, (3,))
    return _affine(corner, list(np.diag(_lengths(lengths, 3))), elements, degrees)


def interpolated(
    f: Callable[..., Any], bases: Sequence[BSplineBasis], side_names: Mapping[str, tuple[int, int]] | None = None
) -> Patch:
    """B-spline that agrees with an analytic map at the tensor grid of Greville points; its error is O(h^(p+1)).

    Args:
        f: maps the parameters (one array of shape (n,) per direction) to nsd coordinates, each a number or an array of
            shape (n,); unit: length.
        bases: univariate bases, one per parametric direction.
        side_names: names of sides, see :class:`tigar_x.geometry.patch.Patch`.

    Returns:
        The patch.

    Raises:
        ValueError: f does not return such coordinates, or one that is not finite.
    """
    basis = TensorBasis(tuple(bases))
    rows = [np.broadcast_to(row, (basis.n,)) for row in f(*basis.greville.T)]
    return Patch.from_points(bases, basis.interpolate(np.column_stack(rows)), side_names=side_names)


def ruled(start: Patch, end: Patch, *, elements: int = 1, degree: int = 1) -> Patch:
    """Patch of straight lines between the points of equal parameters of two patches.

    The two are first brought to the higher of their degrees and to the knots of both. Lines are run through with
    constant speed where the weights of the two agree.

    Args:
        start: curve or surface.
        end: another one of the same dimension in the same space; its parameters are scaled to the ranges of ``start``.
        elements: number of Bezier elements in the new direction.
        degree: polynomial degree in the new direction.

    Returns:
        Surface or volume over the parameters of ``start`` and a new one over [0, 1]; with the sides of ``start``.

    Raises:
        ValueError: the patches are volumes, of different kind or identical.
    """
    for name in ("dim", "nsd"):
        if getattr(start, name) != getattr(end, name):
            raise ValueError(f"end has {name} = {getattr(end, name)}: {getattr(start, name)} is required, as start has")
    if start.dim == 3:
        raise ValueError("start has dim = 3: a curve or a surface is required")
    common = [_common(a, b) for a, b in zip(start.bases, end.bases, strict=True)]
    moved = Patch(tuple(b for _, b in common), end.control)
    first, last = (patch.on([basis for basis, _ in common]) for patch in (start, moved))
    if np.array_equal(first.control, last.control):
        raise ValueError("end is the same as start: another patch is required")
    control = np.concatenate([first.control, last.control])
    linear = Patch((*first.bases, uniform(1, 1)), control, start.side_names)
    return linear.on([*first.bases, uniform(degree, elements)])


def extruded(patch: Patch, vector: ArrayLike, *, elements: int = 1, degree: int = 1) -> Patch:
    """Curve or surface moved along a straight line.

    Args:
        patch: curve or surface; one in the plane is taken as one with the third coordinate 0 when the vector has three.
        vector: the way of every point, shape (nsd,) or (3,); unit: length.
        elements: number of Bezier elements along the way.
        degree: polynomial degree along the way.

    Returns:
        Surface or volume over the parameters of the patch and a new one over [0, 1]; with the patch's sides.

    Raises:
        ValueError: the patch is a volume, or the vector is zero or has no such shape.
    """
    way = _point("vector", vector)
    if not way.any() or len(way) < patch.nsd:
        raise ValueError(f"vector = {way}: a vector other than zero with {patch.nsd} or more entries is required")
    lifted = np.insert(patch.control, patch.nsd, np.zeros((len(way) - patch.nsd, 1)), axis=1)
    start = Patch(patch.bases, lifted, patch.side_names)
    end = Patch(patch.bases, lifted + lifted[:, -1:] * np.append(way, 0.0))
    return ruled(start, end, elements=elements, degree=degree)


def _common(first: BSplineBasis, second: BSplineBasis) -> tuple[BSplineBasis, BSplineBasis]:
    """Least basis that contains two, and the second one over the range of the first."""
    if first.periodic != second.periodic:
        raise ValueError("end is periodic where start is not, or the other way round: both or none is required")
    (a, b), (c, d) = first.knots[[0, -1]], second.knots[[0, -1]]
    scaled = BSplineBasis(second.degree, a + (b - a) * ((second.knots - c) / (d - c)), second.periodic)
    degree = max(first.degree, second.degree)
    return first.elevated(degree).with_knots(scaled.elevated(degree).knots), scaled


def _affine(
    origin: FloatArray,
    edges: Sequence[FloatArray],
    elements: Sequence[int],
    degrees: Sequence[int],
    side_names: Mapping[str, tuple[int, int]] | None = None,
) -> Patch:
    """Patch whose points are origin + parameters . edges."""
    basis = TensorBasis(uniform_bases(degrees, elements, len(edges)))
    return Patch.from_points(basis.directions, origin + basis.greville @ np.stack(edges), side_names=side_names)


def _point(name: str, value: ArrayLike) -> FloatArray:
    x = checks.array(name, value, (None,))
    if len(x) not in (2, 3):
        raise ValueError(f"{name} has {len(x)} coordinates: 2 or 3 are required")
    return x


def _lengths(value: ArrayLike, count: int) -> FloatArray:
    lengths = checks.array("lengths", value, (count,))
    for i, length in enumerate(lengths):
        checks.positive(f"lengths[{i}]", float(length))
    return lengths
