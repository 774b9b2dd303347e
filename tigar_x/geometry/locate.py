"""Closest points of a spline geometry."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from tigar_x import checks
from tigar_x.compat import FloatArray, IntArray
from tigar_x.geometry.multipatch import MultiPatch
from tigar_x.geometry.patch import Patch

SAMPLES = 4
"""Parts of a Bezier element in every direction, between the samples that the search starts from."""
HALF = 0.55
"""Half the distance of two samples, with some room for what is curved between them."""
ITERATIONS = 50
CONVERGED = 1e-13
"""Steps below this, relative to the range of the parameters, end the search."""
DIFFERENCE = 1e-6
"""Difference of parameters that second derivatives are taken from, relative to their range."""
BLOCK = 1000
"""Points that are searched for at once, which bounds the memory."""


@dataclass(frozen=True)
class ClosestPoints:
    """Closest points of a geometry.

    Attributes:
        patch: which patch they lie on, shape (m,).
        xi: their parameters there, shape (m, parametric dimension).
        distance: to the points asked for, shape (m,); unit: length.
    """

    patch: IntArray
    xi: FloatArray
    distance: FloatArray

    def __post_init__(self) -> None:
        checks.freeze(self)


@dataclass(frozen=True)
class _Samples:
    """Samples of all patches.

    Attributes:
        patch: shape (samples,).
        xi: parameters, shape (samples, parametric dimension).
        x: positions, shape (samples, nsd).
        reach: how far the points around a sample, to which none is nearer, may be from it, shape (samples,); unit:
            length.
    """

    patch: IntArray
    xi: FloatArray
    x: FloatArray
    reach: FloatArray


def closest_points(geometry: Patch | MultiPatch, points: ArrayLike) -> ClosestPoints:
    """Closest points of a geometry to points of space.

    Newton's method starts from the nearest of many samples, and again from all those around which a closer point than
    the one it led to may be.

    Args:
        geometry: curve, surface or volume of one or several patches.
        points: shape (m, nsd); unit: length.

    Returns:
        The closest points; a point inside a volume or on a surface has distance zero up to rounding.

    Raises:
        ValueError: the points have no such shape or are not finite.
    """
    x = checks.array("points", points, (None, geometry.nsd))
    patches = (geometry,) if isinstance(geometry, Patch) else geometry.patches
    samples = _samples(patches)
    tree = cKDTree(samples.x)
    distance, start = tree.query(x)
    owner, xi = samples.patch[start], samples.xi[start]
    distance[:] = _descend(patches, x, owner, xi)
    rounding = 1e-13 * np.abs(samples.x).max()
    away = np.flatnonzero(distance > rounding)
    for block in np.array_split(away, len(away) // BLOCK + 1):
        point, start = _starts(samples, tree, x[block], distance[block])
        point = block[point]
        others, ends = samples.patch[start], samples.xi[start]
        found = _descend(patches, x[point], others, ends)
        order = np.lexsort((found, point))
        best = order[np.unique(point[order], return_index=True)[1]]
        best = best[found[best] < distance[point[best]]]
        owner[point[best]], xi[point[best]], distance[point[best]] = others[best], ends[best], found[best]
    return ClosestPoints(owner, xi, distance)


def points_on(geometry: Patch | MultiPatch, points: ArrayLike, distance: float | None = None) -> ClosestPoints:
    """Closest points of a geometry to points that lie on it, or near it.

    Args:
        geometry: see :func:`closest_points`.
        points: see there.
        distance: largest distance that is allowed; None: 1e-6 of the geometry's size. Unit: length.

    Returns:
        The closest points.

    Raises:
        ValueError: a point lies farther away, or see :func:`closest_points`.
    """
    found = closest_points(geometry, points)
    allowed = 1e-6 * float(np.ptp(geometry.points, axis=0).max()) if distance is None else distance
    if len(found.distance) and found.distance.max() > allowed:
        i = int(found.distance.argmax())
        raise ValueError(f"points[{i}] is {found.distance[i]:.3g} away from the spline: {allowed:.3g} is allowed")
    return found


def _samples(patches: tuple[Patch, ...]) -> _Samples:
    parts = []
    for k, patch in enumerate(patches):
        ticks = [_ticks(basis.breakpoints) for basis in patch.bases]
        xi = np.stack(np.meshgrid(*ticks, indexing="ij"), axis=-1)
        x = patch.evaluate(xi.reshape(-1, patch.dim)).reshape(*xi.shape[:-1], -1)
        reach = np.zeros(x.shape[:-1])
        for direction in range(patch.dim):
            steps = np.linalg.norm(np.diff(x, axis=direction), axis=-1)
            ends = [(int(d == direction),) * 2 for d in range(patch.dim)]
            padded = np.pad(steps, ends)
            n = reach.shape[direction]
            reach += np.maximum(*(padded.take(np.arange(i, i + n), axis=direction) for i in (0, 1))) ** 2
        owner = np.full(reach.size, k, dtype=np.int32)
        parts.append((owner, xi.reshape(-1, patch.dim), x.reshape(reach.size, -1), HALF * np.sqrt(reach.ravel())))
    return _Samples(*(np.concatenate(part) for part in zip(*parts, strict=True)))


def _ticks(breakpoints: FloatArray) -> FloatArray:
    inner = breakpoints[:-1, None] + np.diff(breakpoints)[:, None] * np.arange(SAMPLES) / SAMPLES
    return np.append(inner, breakpoints[-1])


def _starts(
    samples: _Samples, tree: cKDTree, x: FloatArray, distance: FloatArray
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """All pairs (point, sample) where a point closer than a distance may be around the sample."""
    near = tree.query_ball_point(x, distance + samples.reach.max())
    point = np.repeat(np.arange(len(x)), [len(found) for found in near])
    sample = np.array([i for found in near for i in found], dtype=np.int64)
    possible = np.linalg.norm(x[point] - samples.x[sample], axis=1) < distance[point] + samples.reach[sample]
    return point[possible], sample[possible]


def _descend(patches: tuple[Patch, ...], x: FloatArray, owner: IntArray, xi: FloatArray) -> FloatArray:
    """Move parameters to where the distance is least nearby, and return the distances."""
    distance = np.empty(len(x))
    for k, patch in enumerate(patches):
        here = owner == k
        xi[here], distance[here] = _descend_patch(patch, x[here], xi[here])
    return distance


def _descend_patch(patch: Patch, x: FloatArray, xi: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Newton's method for the least distance within the parametric box; steps that lead away are shortened."""
    low, high = patch.basis.box
    closed = np.array([basis.periodic for basis in patch.bases])
    gap = x - patch.evaluate(xi)
    length = np.ones(len(x))
    active = np.arange(len(x))
    for _ in range(ITERATIONS):
        if not len(active):
            break
        start, old = xi[active], gap[active]
        step = _newton(patch, start, old, ~closed & (start <= low), ~closed & (start >= high))
        trial = start + length[active, None] * step
        trial = np.where(closed, low + (trial - low) % (high - low), np.clip(trial, low, high))
        new = x[active] - patch.evaluate(trial)
        better = (new**2).sum(axis=1) < (old**2).sum(axis=1)
        xi[active[better]], gap[active[better]] = trial[better], new[better]
        moving = (np.abs(length[active, None] * step) > CONVERGED * (high - low)).any(axis=1)
        length[active] = np.where(better, np.minimum(2.0 * length[active], 1.0), 0.5 * length[active])
        active = active[moving]
    return xi, np.linalg.norm(gap, axis=1)


def _newton(
    patch: Patch, xi: FloatArray, gap: FloatArray, at_low: NDArray[np.bool_], at_high: NDArray[np.bool_]
) -> FloatArray:
    """Steps downhill, along the sides of the box where they would leave it, shape (m, parametric dimension)."""
    low, high = patch.basis.box
    size = high - low
    J = _jacobian(patch, xi) * size
    H = np.einsum("mik,mil->mkl", J, J)
    for direction in range(patch.dim):
        shift = np.where(xi[:, direction] + DIFFERENCE * size[direction] > high[direction], -DIFFERENCE, DIFFERENCE)
        moved = xi + (shift * size[direction])[:, None] * np.eye(patch.dim)[direction]
        second = (_jacobian(patch, moved) * size - J) / shift[:, None, None]
        H[:, :, direction] -= np.einsum("mik,mi->mk", second, gap)
    slope = np.einsum("mik,mi->mk", J, gap)
    stuck = (at_low & (slope < 0.0)) | (at_high & (slope > 0.0))
    slope[stuck] = 0.0
    H = np.where(
        stuck[:, :, None] | stuck[:, None, :], np.eye(patch.dim) * stuck[:, :, None], (H + H.transpose(0, 2, 1)) / 2.0
    )
    values, vectors = np.linalg.eigh(H)
    # absolute values lead downhill near a saddle as well
    curvature = np.abs(values)
    curvature = np.maximum(curvature, 1e-12 * curvature.max(axis=1, keepdims=True) + np.finfo(float).tiny)
    return size * np.einsum("mkl,ml,mjl,mj->mk", vectors, 1.0 / curvature, vectors, slope)


def _jacobian(patch: Patch, xi: FloatArray) -> FloatArray:
    """Derivatives of the position by the parameters, shape (m, nsd, parametric dimension)."""
    A = patch.basis.evaluate(xi) @ patch.control
    X, w = A[:, :-1] / A[:, -1:], A[:, -1:]
    columns = []
    for direction in range(patch.dim):
        dA = patch.basis.evaluate(xi, direction) @ patch.control
        columns.append((dA[:, :-1] - X * dA[:, -1:]) / w)
    return np.stack(columns, axis=-1)
