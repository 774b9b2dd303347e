"""Midsurface geometry and strains of a Kirchhoff-Love shell (Kiendl et al., doi:10.1016/j.cma.2009.08.013).

For a surface in space all tensors are 2 x 2. A curve in the plane stands for a cylindrical shell without strain along
its generator e_3; its tensors are 1 x 1.
"""

from dataclasses import dataclass
from typing import Any

import ufl

from tigar_x.spline import ExtractedSpline


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
    m, nsd = spline.patch.dim, spline.nsd
    if (m, nsd) not in ((1, 2), (2, 3)):
        raise ValueError(
            f"spline has parametric dimension {m} in {nsd}-dimensional space: (1, 2) or (2, 3) is required"
        )
    x = spline.F if y is None else spline.F + y
    a = spline.parametric_grad(x)
    if m == 1:
        normal = ufl.as_vector([a[1, 0], -a[0, 0]]) / ufl.sqrt(a[0, 0] ** 2 + a[1, 0] ** 2)
    else:
        cross = ufl.cross(a[:, 0], a[:, 1])
        normal = cross / ufl.sqrt(ufl.dot(cross, cross))
    second = spline.parametric_grad(a)
    i, al, be = ufl.indices(3)
    curvature = ufl.as_tensor(second[i, al, be] * normal[i], (al, be))
    return Midsurface(x, a, normal, a.T * a, curvature)


def membrane_strain(reference: Midsurface, current: Midsurface) -> Any:
    """Covariant membrane strain (a - A)/2, shape (m, m)."""
    return (current.metric - reference.metric) / 2


def curvature_change(reference: Midsurface, current: Midsurface) -> Any:
    """Covariant change of curvature B - b, shape (m, m); unit: 1/length."""
    return reference.curvature - current.curvature


def local_voigt(reference: Midsurface, strain: Any) -> Any:
    """Covariant strain in the local Cartesian frame of the reference configuration, in Voigt notation.

    The frame is e_1 = A_1/|A_1| and e_2 from A_2 by Gram-Schmidt. For a curve e_1 alone remains.

    Args:
        reference: reference configuration.
        strain: covariant components, shape (m, m).

    Returns:
        (T_11, T_22, 2 T_12) for a surface, (T_11,) for a curve.
    """
    A = reference.metric
    if A.ufl_shape == (1, 1):
        return ufl.as_vector([strain[0, 0] / A[0, 0]])
    # e_i . A^alpha for Gram-Schmidt frames, in terms of the metric alone: lower triangular inverse of Q_{i alpha}
    l_1 = ufl.sqrt(A[0, 0])
    l_2 = ufl.sqrt(A[1, 1] - A[0, 1] ** 2 / A[0, 0])
    Q = ufl.as_matrix([[1 / l_1, 0], [-A[0, 1] / (A[0, 0] * l_2), 1 / l_2]])
    T = Q * strain * Q.T
    return ufl.as_vector([T[0, 0], T[1, 1], 2 * T[0, 1]])
