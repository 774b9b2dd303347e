"""Stress resultants of thin shells, and stresses at a point through the thickness.

Source: Kiendl et al., doi:10.1016/j.cma.2009.08.013. All are UFL expressions over the parametric mesh. Their components
refer to local Cartesian frames: e_1 along the first base vector, e_2 in the tangent plane. A ``level`` from -1 to 1
says where in the thickness a stress is: at ``zeta = level h/2``, so that 1 is the face that a_3 points to.
"""

from dataclasses import dataclass
from typing import Any, Protocol

import ufl

from shnapr.kinematics import Midsurface, dual_frame, frame, layer_metric, midsurface
from shnapr.smoothness import require_kinds
from shnapr.work import Material, conjugates
from tigar_x import checks
from tigar_x.moved import guide
from tigar_x.splines.spline import ExtractedSpline

__getattr__ = guide(__name__)


class MaterialAtPoint(Protocol):
    """What the stress at a point needs to know of a material; the strain is that of the tangent plane, shape (2, 2)."""

    @property
    def thickness(self) -> Any:
        """Thickness of the shell h."""

    def strain(self, reference: Midsurface, current: Midsurface, zeta: Any) -> Any:
        """Green strain at the distance zeta from the midsurface, in the local Cartesian frame."""

    def second_piola(self, strain: Any, zeta: Any) -> Any:
        """Second Piola-Kirchhoff stress of a strain."""

    def squared_normal_stretch(self, strain: Any) -> Any:
        """C_33 of a strain."""


@dataclass(frozen=True)
class Resultants:
    """Stress resultants in the local Cartesian frame of the current midsurface.

    They count per unit of reference area (Kirchhoff's measure): divided by ``area_ratio`` they are forces and moments
    per current length.

    Attributes:
        n: membrane forces, symmetric, shape (m, m); unit: force/length.
        m: bending moments, positive where they stretch the face that a_3 points to, shape (m, m); unit: force.
        q: transverse shear that balances the moments, q_alpha = m_{alpha beta | beta}, shape (m,); unit: force/length.
        area_ratio: current area per reference area, sqrt(det a / det A).
    """

    n: Any
    m: Any
    q: Any
    area_ratio: Any


def resultants(spline: ExtractedSpline, material: Material, y: Any) -> Resultants:
    """Stress resultants of a displaced shell.

    The shear follows from the balance of moments without couples and rotary inertia. Of the moments per current length
    M/j with the area ratio j it is ``j (M/j)^{alpha beta}_{| beta} = (sqrt(A) M^{alpha beta})_{, beta}/sqrt(A) +
    Gamma^alpha_{beta gamma} M^{beta gamma}``. It takes third derivatives of the displacement, so degree 3 is the least
    that gives more than a constant per element.

    Args:
        spline: the midsurface.
        material: the material.
        y: homogeneous displacement, shape (nsd,).

    Returns:
        The resultants.
    """
    require_kinds(spline, material)
    reference, current = midsurface(spline), midsurface(spline, spline.rationalize(y))
    n, m = conjugates(material, reference, current)
    R = frame(current.metric)
    return Resultants(
        R * n * R.T, R * m * R.T, R * _shear(spline, m, current), _area(current.metric) / _area(reference.metric)
    )


def largest_principal(tensor: Any) -> Any:
    """Largest principal value of a symmetric tensor of shape (m, m), m = 1 or 2.

    Args:
        tensor: such as the membrane forces.
    """
    if tensor.ufl_shape == (1, 1):
        return tensor[0, 0]
    return ufl.tr(tensor) / 2 + ufl.sqrt((tensor[0, 0] - tensor[1, 1]) ** 2 / 4 + tensor[0, 1] ** 2)


def _shear(spline: ExtractedSpline, m: Any, current: Midsurface) -> Any:
    """Contravariant shear of the contravariant moments, shape (m,)."""
    al, be, ga, i = ufl.indices(4)
    area, a = spline.dx.jacobian, current.tangents
    divergence = ufl.as_tensor(spline.parametric_grad(area * m)[al, be, be] / area, (al,))
    dual = a * ufl.inv(current.metric)
    bent = ufl.as_tensor(spline.parametric_grad(a)[i, be, ga] * m[be, ga], (i,))
    return divergence + dual.T * bent


def second_piola(spline: ExtractedSpline, material: MaterialAtPoint, y: Any, level: Any) -> Any:
    """Second Piola-Kirchhoff stress in the local Cartesian frame of the reference configuration.

    Args:
        spline: the midsurface.
        material: the material.
        y: homogeneous displacement, shape (nsd,).
        level: where in the thickness, from -1 to 1.

    Returns:
        S, shape (m, m); unit: force/length^2.

    Raises:
        ValueError: the level is out of range.
    """
    point = _Point(spline, material, y, level)
    return _leading(point.second_piola, spline.dim)


def cauchy(spline: ExtractedSpline, material: MaterialAtPoint, y: Any, level: Any) -> Any:
    """Cauchy stress in the local Cartesian frame of the current configuration.

    Base vectors at the point have the metrics a - 2 zeta b, and the normal stretch is the one of zero normal stress.

    Args:
        spline: the midsurface.
        material: the material.
        y: homogeneous displacement, shape (nsd,).
        level: where in the thickness, from -1 to 1.

    Returns:
        sigma, shape (m, m); unit: force/length^2.

    Raises:
        ValueError: the level is out of range.
    """
    return _leading(_Point(spline, material, y, level).cauchy, spline.dim)


def von_mises(spline: ExtractedSpline, material: MaterialAtPoint, y: Any, level: Any) -> Any:
    """Von Mises's equivalent of the Cauchy stress, without transverse shear.

    In the plane it contains the stress along the generator, which keeps its length.

    Args:
        spline: the midsurface.
        material: the material.
        y: homogeneous displacement, shape (nsd,).
        level: where in the thickness, from -1 to 1.

    Returns:
        UFL scalar; unit: force/length^2.

    Raises:
        ValueError: the level is out of range.
    """
    s = _Point(spline, material, y, level).cauchy
    return ufl.sqrt(s[0, 0] ** 2 - s[0, 0] * s[1, 1] + s[1, 1] ** 2 + 3 * s[0, 1] ** 2)


def _leading(tensor: Any, m: int) -> Any:
    """Components of the directions that the midsurface has."""
    return tensor if m == 2 else ufl.as_matrix([[tensor[0, 0]]])


class _Point:
    """Stresses at a point through the thickness; of a curve, direction 2 is the generator.

    Attributes:
        second_piola: S in the frame of the reference configuration, shape (2, 2).
        cauchy: sigma in the frame of the current configuration, shape (2, 2).
    """

    def __init__(self, spline: ExtractedSpline, material: MaterialAtPoint, y: Any, level: Any) -> None:
        require_kinds(spline, material)
        checks.parameter("level", level, lambda name, value: checks.within(name, value, -1.0, 1.0))
        zeta = level * material.thickness / 2
        reference, current = midsurface(spline), midsurface(spline, spline.rationalize(y))
        strain = material.strain(reference, current, zeta)
        self.second_piola = material.second_piola(strain, zeta)
        G, g = layer_metric(reference, zeta), layer_metric(current, zeta)
        F = frame(g) * dual_frame(G).T
        if spline.dim == 1:
            F = ufl.as_matrix([[F[0, 0], 0], [0, 1]])
        J = ufl.det(F) * ufl.sqrt(material.squared_normal_stretch(strain))
        self.cauchy = F * self.second_piola * F.T / J


def _area(metric: Any) -> Any:
    return ufl.sqrt(ufl.det(metric))
