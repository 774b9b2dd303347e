"""Points of a spline at fixed parameters: along lines and sides, on nets, at marks.

The matrix from coefficients to points is made once. Positions and fields are rational where the spline is, so circles
stay circles.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp
from dolfinx import fem
from numpy.typing import ArrayLike

from tigar_x import checks
from tigar_x.compat import FloatArray
from tigar_x.geometry.functions import within_patch
from tigar_x.splines.extraction import set_nodal
from tigar_x.splines.space import SplineSpace
from tigar_x.splines.spline import ExtractedSpline


@dataclass(frozen=True, eq=False)
class Sampling:
    """Points of a spline at fixed parameters.

    Attributes:
        spline: the spline.
        shape: of the points. Points of all patches have the patches as their first axis, also where there is one.
        matrix: values of all functions at the points, shape (points, functions).
    """

    spline: ExtractedSpline
    shape: tuple[int, ...]
    matrix: sp.csr_matrix

    @cached_property
    def reference(self) -> FloatArray:
        """Positions in the reference configuration, shape (*shape, nsd); unit: length."""
        return checks.read_only(self._rational(self.spline.geometry.control[:, :-1]))

    def positions(self, y: fem.Function | None = None) -> FloatArray:
        """Present positions (collective).

        Args:
            y: homogeneous displacement; None: none.

        Returns:
            Positions on every rank, shape (*shape, nsd); unit: length.
        """
        return self.reference.copy() if y is None else self.reference + self.values(y)

    def values(self, field: fem.Function | ArrayLike) -> FloatArray:
        """Physical values of a field (collective).

        Args:
            field: homogeneous isoparametric function; or physical values at this rank's nodes, of shape (nodes,) or
                (nodes, components), to which the nearest field of the spline is taken.

        Returns:
            Values on every rank, shape (*shape, components), or the shape of the points for a scalar.

        Raises:
            ValueError: values at nodes of another number.
        """
        if not isinstance(field, fem.Function):
            field = self._field(field)
        size = field.function_space.dofmap.index_map_bs
        values = self._rational(self._space(size).coefficients(field))
        return values if size > 1 else values[..., 0]

    def _rational(self, homogeneous: FloatArray) -> FloatArray:
        values, geometry = self.matrix @ homogeneous, self.spline.geometry
        if geometry.rational:
            values /= (self.matrix @ geometry.weights)[:, None]
        return np.asarray(values.reshape(*self.shape, -1))

    def _space(self, size: int) -> SplineSpace:
        vector = self.spline.vector
        known = size == self.spline.nsd and not vector.constraints.shape[0]  # and then all coefficients are its
        return vector if known else self.spline.free(size)

    def _field(self, values: ArrayLike) -> fem.Function:
        nodes = len(self.spline.node_weights)
        physical = np.asarray(values, dtype=float)
        physical = checks.array("field", physical[:, None] if physical.ndim == 1 else physical, (nodes, None))
        field = self.spline.free(physical.shape[1]).function()
        set_nodal(field, physical * self.spline.node_weights[:, None])
        return field


def marks(spline: ExtractedSpline, xi: ArrayLike, *, patch: int | None = None) -> Sampling:
    """Points at parameters.

    Args:
        spline: curve, surface or volume.
        xi: parameters of a patch in its own range, shape (..., parametric dimension); of a curve also one number.
        patch: which patch; None: all of them, with the same parameters.

    Raises:
        ValueError: there is no such patch, or a parameter lies outside of it.
    """
    points = np.atleast_1d(np.asarray(xi, dtype=float))
    flat = checks.array("xi", points.reshape(-1, points.shape[-1]), (None, spline.dim))
    plane = [within_patch(spline.geometry.functions, k, flat) for k in _patches(spline, patch)]
    return _sampling(spline, plane, points.shape[:-1], patch)


def line(
    spline: ExtractedSpline, direction: int, samples: int, *, at: float = 0.5, patch: int | None = None
) -> Sampling:
    """Points on a line along one parameter, its ends included.

    Args:
        spline: curve, surface or volume.
        direction: number of the parameter that changes.
        samples: number of points, 2 or more, equally apart in the parameter.
        at: place of the line in the other directions, 0 (start) to 1 (end).
        patch: which patch; None: one line on each.

    Raises:
        ValueError: there is no such direction or patch, or a number is out of range.
    """
    checks.choice("direction", direction, tuple(range(spline.dim)))
    fractions = np.full((checks.whole("samples", samples, 2), spline.dim), checks.within("at", at, 0.0, 1.0))
    fractions[:, direction] = np.linspace(0.0, 1.0, samples)
    return _at_fractions(spline, fractions, (samples,), patch)


def side(spline: ExtractedSpline, name: str, samples: int, *, patch: int | None = None) -> Sampling:
    """Points on a side of a surface, its ends included.

    Args:
        spline: surface.
        name: of the side, such as "v0" or a name of the patch's own.
        samples: number of points, 2 or more, equally apart in the parameter.
        patch: whose side; None: the sides of that name of all patches.

    Raises:
        ValueError: no surface, no such side or patch, or too few points.
    """
    _require_surface(spline)
    s = np.linspace(0.0, 1.0, checks.whole("samples", samples, 2))
    plane = []
    for k, direction, end in spline.geometry.locate_sides((name,), patch):
        fractions = np.full((samples, 2), float(end))
        fractions[:, 1 - direction] = s
        plane.append(_in_plane(spline, k, fractions))
    return _sampling(spline, plane, (samples,), patch)


def net(spline: ExtractedSpline, samples: int | Sequence[int], *, patch: int | None = None) -> Sampling:
    """Points on a net of parameters, the sides included.

    Args:
        spline: curve, surface or volume.
        samples: number of points in every direction, 2 or more, or one number for each.
        patch: which patch; None: a net on each.

    Raises:
        ValueError: there is no such patch, or too few points.
    """
    counts = tuple(samples) if isinstance(samples, Sequence) else (samples,) * spline.dim
    if len(counts) != spline.dim:
        raise ValueError(f"samples = {samples}: a number, or {spline.dim} of them, is required")
    ticks = [np.linspace(0.0, 1.0, checks.whole("samples", count, 2)) for count in counts]
    fractions = np.stack(np.meshgrid(*ticks, indexing="ij"), axis=-1).reshape(-1, spline.dim)
    return _at_fractions(spline, fractions, counts, patch)


def outline(spline: ExtractedSpline, samples: int, *, patch: int | None = None) -> Sampling:
    """Points once around a surface, along v0, u1, v1 and u0; the last point is the first.

    Args:
        spline: surface.
        samples: number of points on each side, 2 or more; corners belong to two sides.
        patch: which patch; None: an outline of each.

    Raises:
        ValueError: no surface, no such patch, or too few points.
    """
    _require_surface(spline)
    s = np.linspace(0.0, 1.0, checks.whole("samples", samples, 2))[:-1]
    zero, one = np.zeros_like(s), np.ones_like(s)
    sides = [(s, zero), (one, s), (1.0 - s, one), (zero, 1.0 - s), (zero[:1], zero[:1])]
    fractions = np.concatenate([np.transpose(pair) for pair in sides])
    return _at_fractions(spline, fractions, (len(fractions),), patch)


def enclosed_area(points: ArrayLike, axis: ArrayLike = (0.0, 0.0, 1.0)) -> float:
    """Area within a closed polygon as it is seen along an axis, positive where it runs counter-clockwise.

    Args:
        points: corners, shape (..., m, d), d = 2 or 3; several lines are joined, one after the other.
        axis: from what is seen to the eye, of any length; in the plane there is only the third one.

    Returns:
        The area; unit: square of length.

    Raises:
        ValueError: points or axis have another shape, or the axis has no length.
    """
    x = np.asarray(points, dtype=float)
    x = checks.array("points", x.reshape(-1, x.shape[-1]) if x.ndim > 1 else x, (None, None))
    if x.shape[1] not in (2, 3):
        raise ValueError(f"points has {x.shape[1]} coordinates: 2 or 3 are required")
    if x.shape[1] == 2:
        x = np.column_stack([x, np.zeros(len(x))])
    normal = checks.array("axis", axis, (3,))
    length = checks.positive("length of axis", float(np.linalg.norm(normal)))
    return float(np.cross(x, np.roll(x, -1, axis=0)).sum(axis=0) @ normal / (2.0 * length))


def _require_surface(spline: ExtractedSpline) -> None:
    if spline.dim != 2:
        raise ValueError(f"spline has {spline.dim} parameters: a surface, with 2, is required")


def _patches(spline: ExtractedSpline, patch: int | None) -> range:
    every = range(len(spline.geometry.functions.boxes))
    return every if patch is None else range(checks.choice("patch", patch, tuple(every)), patch + 1)


def _in_plane(spline: ExtractedSpline, patch: int, fractions: FloatArray) -> FloatArray:
    low, high = spline.geometry.functions.boxes[patch]
    return np.asarray(low + fractions * (high - low))


def _at_fractions(
    spline: ExtractedSpline, fractions: FloatArray, shape: tuple[int, ...], patch: int | None
) -> Sampling:
    return _sampling(spline, [_in_plane(spline, k, fractions) for k in _patches(spline, patch)], shape, patch)


def _sampling(
    spline: ExtractedSpline, plane: Sequence[FloatArray], shape: tuple[int, ...], patch: int | None
) -> Sampling:
    matrix = spline.geometry.functions.evaluate(np.concatenate(plane))
    return Sampling(spline, shape if patch is not None else (len(plane), *shape), matrix)
