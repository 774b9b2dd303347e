"""Closest points of a spline geometry."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from tigar_x import checks
from tigar_x.compat import FloatArray, IntArray
from tigar_x.multipatch import MultiPatch, as_multipatch
from tigar_x.patch import Patch

SAMPLES = 4
"""Start points per Bezier element and direction."""
ITERATIONS = 60


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


def closest_points(geometry: Patch | MultiPatch, points: ArrayLike) -> ClosestPoints:
    """Closest points of a geometry to points of space, by Gauss-Newton from the nearest of many samples.

    Args:
        geometry: curve, surface or volume of one or several patches.
        points: shape (m, nsd); unit: length.

    Returns:
        The closest points; a point inside a volume or on a surface has distance zero up to rounding.
    """
    x = checks.array("points", points, (None, geometry.nsd))
    patches = as_multipatch(geometry).patches
    starts = [_samples(patch) for patch in patches]
    tree = cKDTree(np.concatenate([patch.evaluate(xi) for patch, xi in zip(patches, starts, strict=True)]))
    nearest = tree.query(x)[1]
    first = np.cumsum([0, *map(len, starts)])
    owner = (np.searchsorted(first, nearest, side="right") - 1).astype(np.int32)
    xi = np.concatenate(starts)[nearest]
    distance = np.empty(len(x))
    for k, patch in enumerate(patches):
        here = owner == k
        xi[here], distance[here] = _descend(patch, x[here], xi[here])
    return ClosestPoints(owner, xi, distance)


def _samples(patch: Patch) -> FloatArray:
    ticks = []
    for basis in patch.bases:
        b = basis.breakpoints
        inner = b[:-1, None] + np.diff(b)[:, None] * np.arange(SAMPLES) / SAMPLES
        ticks.append(np.append(inner, b[-1]))
    return np.column_stack([grid.ravel() for grid in np.meshgrid(*ticks, indexing="ij")])


def _descend(patch: Patch, x: FloatArray, xi: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Gauss-Newton within the parametric box; a step that leads away is halved."""
    low, high = patch.basis.box
    closed = np.array([basis.periodic for basis in patch.bases])
    length = np.ones(len(x))
    gap = x - patch.evaluate(xi)
    for _ in range(ITERATIONS):
        J = _jacobian(patch, xi)
        slope = np.einsum("mik,mi->mk", J, gap)
        stuck = ~closed & (((xi <= low) & (slope < 0.0)) | ((xi >= high) & (slope > 0.0)))
        J[np.broadcast_to(stuck[:, None, :], J.shape)] = 0.0
        step = np.einsum("mki,mi->mk", np.linalg.pinv(J, rcond=1e-12), gap)
        if not len(x) or (np.abs(step) <= 1e-14 * (high - low)).all():
            break
        trial = xi + length[:, None] * step
        trial = np.where(closed, low + (trial - low) % (high - low), np.clip(trial, low, high))
        new_gap = x - patch.evaluate(trial)
        better = (new_gap**2).sum(axis=1) <= (gap**2).sum(axis=1)
        xi, gap = np.where(better[:, None], trial, xi), np.where(better[:, None], new_gap, gap)
        length = np.where(better, 1.0, 0.5 * length)
    return xi, np.linalg.norm(gap, axis=1)


def _jacobian(patch: Patch, xi: FloatArray) -> FloatArray:
    """Derivatives of the position by the parameters, shape (m, nsd, parametric dimension)."""
    A = patch.basis.evaluate(xi) @ patch.control
    X, w = A[:, :-1] / A[:, -1:], A[:, -1:]
    columns = []
    for direction in range(patch.dim):
        dA = patch.basis.evaluate(xi, direction) @ patch.control
        columns.append((dA[:, :-1] - X * dA[:, -1:]) / w)
    return np.stack(columns, axis=-1)
