"""Midsurface geometry and strains of a Kirchhoff-Love shell (Kiendl et al., doi:10.1016/j.cma.2009.08.013).

For a surface in space all tensors are 2 x 2. A curve in the plane stands for a cylindrical shell without strain along
its generator e_3; its tensors are 1 x 1.
"""

from dataclasses import dataclass
from typing import Any

import ufl

from tigar_x.splines.spline import ExtractedSpline, require_spline


@dataclass(frozen=True)
class Midsurface:
    """One configuration of the midsurface; UFL expressions over the parametric mesh.

    Attributes:
        x: position, shape (nsd,); unit: length.
        tangents: covariant base vectors a_alpha as columns, shape (nsd, m) with m = 1 or 2.
        normal: unit normal a_3, shape (nsd,): a_1 x a_2 / |a_1 x a_2|, in the plane a_1 x e_3 / |a_1|.
        metric: a_{alpha beta}, shape (m, m).
        curvature: b_{alpha beta} = x_{,alpha beta} . a_3, shape (m, m).
    """

    x: Any
    tangents: Any
    normal: Any
    metric: Any
    curvature: Any


def midsurface(spline: ExtractedSpline, y: Any = None) -> Midsurface:
    """Geometry of the configuration x = F + y.

    Args:
        spline: curve in the plane or surface in space.
        y: physical displacement, shape (nsd,); None: the reference configuration.

    Returns:
        The configuration.

    Raises:
        ValueError: the spline is neither a curve in the plane nor a surface in space.
    """
    require_spline(spline)
    m, nsd = spline.geometry.dim, spline.nsd
    if (m, nsd) not in ((1, 2), (2, 3)):
        raise ValueError(
            f"spline has parametric dimension {m} in {nsd}-dimensional space: (1, 2) or (2, 3) is required"
        )
    x = spline.F if y is None else spline.F + y
    a = spline.parametric_grad(x)
    n = area_vector(a)
    normal = n / ufl.sqrt(ufl.dot(n, n))
    second = spline.parametric_grad(a)
    i, al, be = ufl.indices(3)
    curvature = ufl.as_tensor(second[i, al, be] * normal[i], (al, be))
    return Midsurface(x, a, normal, a.T * a, curvature)


def area_vector(tangents: Any) -> Any:
    """Normal a_3 times the area (in the plane: length) per parametric one.

    Args:
        tangents: a_alpha as columns, shape (nsd, m).

    Returns:
        a_1 x a_2 for a surface, a_1 x e_3 for a curve, shape (nsd,).
    """
    if tangents.ufl_shape == (2, 1):
        return ufl.as_vector([tangents[1, 0], -tangents[0, 0]])
    return ufl.cross(tangents[:, 0], tangents[:, 1])


def layer_metric(surface: Midsurface, zeta: Any) -> Any:
    """Metric a - 2 zeta b at the distance zeta from the midsurface along a_3, shape (m, m).

    Its terms of second order in zeta are left out, so it is one of a surface only as long as zeta is less than half of
    every radius of curvature.
    """
    return surface.metric - 2 * zeta * surface.curvature


def membrane_strain(reference: Midsurface, current: Midsurface) -> Any:
    """Covariant membrane strain (a - A)/2, shape (m, m)."""
    return (current.metric - reference.metric) / 2


def curvature_change(reference: Midsurface, current: Midsurface) -> Any:
    """Covariant change of curvature B - b, shape (m, m); unit: 1/length."""
    return reference.curvature - current.curvature


def frame(metric: Any) -> Any:
    """Components e_i . a_alpha of base vectors in their Cartesian frame.

    The frame is e_1 = a_1/|a_1| and e_2 from a_2 by Gram-Schmidt. For a curve e_1 alone remains.

    Args:
        metric: a_{alpha beta}, shape (m, m).

    Returns:
        Upper triangular matrix R with R^T R = a, row i and column alpha, shape (m, m).
    """
    first = ufl.sqrt(metric[0, 0])
    if metric.ufl_shape == (1, 1):
        return ufl.as_matrix([[first]])
    second = ufl.sqrt(metric[1, 1] - metric[0, 1] ** 2 / metric[0, 0])
    return ufl.as_matrix([[first, metric[0, 1] / first], [0, second]])


def dual_frame(metric: Any) -> Any:
    """Components e_i . a^alpha of the dual base vectors in the same frame: the inverse transpose of :func:`frame`."""
    R = frame(metric)
    if metric.ufl_shape == (1, 1):
        return ufl.as_matrix([[1 / R[0, 0]]])
    return ufl.as_matrix([[1 / R[0, 0], 0], [-R[0, 1] / (R[0, 0] * R[1, 1]), 1 / R[1, 1]]])


def local_voigt(reference: Midsurface, strain: Any) -> Any:
    """Covariant strain in the local Cartesian frame of the reference configuration, in Voigt notation.

    Args:
        reference: reference configuration.
        strain: covariant components, shape (m, m).

    Returns:
        (T_11, T_22, 2 T_12) for a surface, (T_11,) for a curve.
    """
    A = reference.metric
    if A.ufl_shape == (1, 1):
        return ufl.as_vector([strain[0, 0] / A[0, 0]])
    Q = dual_frame(A)
    T = Q * strain * Q.T
    return ufl.as_vector([T[0, 0], T[1, 1], 2 * T[0, 1]])
