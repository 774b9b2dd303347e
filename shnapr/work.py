"""Energy and virtual work of thin shells of any elastic material, and the tangent of the virtual work.

The energy of a Kirchhoff-Love shell depends on the current metric a and curvature b alone. :func:`internal_work` and
:func:`internal_tangent` use that: the material is differentiated by these few numbers at a point, and their variations
are written out, so that neither the size of the compiled tangent nor its cost grows much with the material's formula
or the number of points through its thickness.

With dz = z_{,alpha} and z_{|alpha beta} = z_{,alpha beta} - Gamma^gamma_{alpha beta} z_{,gamma} the variations are

    a'_{alpha beta}  = a_alpha . z_{,beta} + a_beta . z_{,alpha}
    b'_{alpha beta}  = a_3 . z_{|alpha beta}
    a''_{alpha beta} = z_{,alpha} . u_{,beta} + z_{,beta} . u_{,alpha}
    b''_{alpha beta} = - (a^gamma . z_{|alpha beta}) (a_3 . u_{,gamma}) - (a^gamma . u_{|alpha beta}) (a_3 . z_{,gamma})
                       - b_{alpha beta} a^{gamma delta} (a_3 . z_{,gamma}) (a_3 . u_{,delta})

(Kiendl et al., doi:10.1016/j.cma.2015.03.010, in another arrangement).
"""

from collections.abc import Callable
from typing import Any, Protocol

import ufl

from shnapr.kinematics import Midsurface, midsurface
from shnapr.smoothness import require_bending, require_kinds
from tigar_x import compat
from tigar_x.splines.spline import ExtractedSpline


class Material(Protocol):
    """What the energy of a shell needs to know of its material."""

    def energy_density(self, reference: Midsurface, current: Midsurface) -> Any:
        """Strain energy per reference area, a function of the two metrics and curvatures alone."""


def strain_energy(spline: ExtractedSpline, material: Material, y: Any) -> ufl.Form:
    """Elastic energy of the displaced shell.

    Args:
        spline: the midsurface.
        material: the material.
        y: homogeneous displacement y^h, shape (nsd,); unit: length.

    Returns:
        Functional; unit: energy (per depth in the plane).

    Raises:
        ValueError: the spline is of degree 1 and the material bends.
    """
    require_bending(spline, material)
    current = midsurface(spline, spline.rationalize(y))
    return material.energy_density(midsurface(spline), current) * spline.dx


def virtual_work(spline: ExtractedSpline, energy: Callable[[Any], ufl.Form], y: Any, z: Any) -> ufl.Form:
    """Virtual work of an energy at any displacement, such as the intermediate one of a time step.

    The energy is differentiated at a placeholder that is then replaced by ``y``; nothing of how ``y`` depends on the
    unknown (factors alpha_f) enters. It may be any functional of the displacement; for the energy of a material,
    :func:`internal_work` is the same in less code.

    Args:
        spline: the midsurface.
        energy: maps a displacement to the energy.
        y: homogeneous displacement, an expression of shape (nsd,).
        z: test function in ``spline.V``.

    Returns:
        Residual form dW(y)[z].

    Raises:
        ValueError: the energy treats UFL expressions as numbers.
    """
    placeholder = ufl.Coefficient(spline.V)
    W = compat.ask("energy", energy, placeholder, passing=(ValueError,))
    return ufl.replace(ufl.derivative(W, placeholder, z), {placeholder: y})


def internal_work(spline: ExtractedSpline, material: Material, y: Any, z: Any) -> ufl.Form:
    """Virtual work of the elastic forces, the same form as ``virtual_work`` of ``strain_energy``.

    Args:
        spline: the midsurface.
        material: the material.
        y: homogeneous displacement, an expression of shape (nsd,), such as the intermediate one of a time step.
        z: test function in ``spline.V``.

    Returns:
        Residual form ``int n : a'/2 - m : b'``.

    Raises:
        ValueError: the spline is of degree 1 and the material bends.
    """
    require_bending(spline, material)
    current = midsurface(spline, spline.rationalize(y))
    slope = _Response(material, midsurface(spline), current).slope
    return ufl.dot(slope, _Variation(spline, current, z).measures) * spline.dx


def internal_tangent(spline: ExtractedSpline, material: Material, y: Any, z: Any, unknown: Any) -> ufl.Form:
    """Derivative of :func:`internal_work`; it compiles several times faster than ``ufl.derivative`` of it.

    Args:
        spline: the midsurface.
        material: the material.
        y: homogeneous displacement, an expression of shape (nsd,).
        z: test function in ``spline.V``.
        unknown: the Function that ``y`` depends on, or ``y`` itself.

    Returns:
        Bilinear form in ``z`` and a trial function of the unknown's space.
    """
    require_kinds(spline, material)
    current = midsurface(spline, spline.rationalize(y))
    response = _Response(material, midsurface(spline), current)
    test = _Variation(spline, current, z)
    trial = _Variation(spline, current, ufl.derivative(y, unknown, ufl.TrialFunction(unknown.function_space)))
    n, m = response.forces, response.moments
    integrand = ufl.dot(test.measures, response.stiffness * trial.measures)
    integrand += ufl.inner(test.gradient * n, trial.gradient)
    integrand += ufl.dot(test.turned(m), trial.tilt) + ufl.dot(trial.turned(m), test.tilt)
    integrand += ufl.inner(m, current.curvature) * ufl.dot(test.tilt, ufl.inv(current.metric) * trial.tilt)
    return integrand * spline.dx


def conjugates(material: Material, reference: Midsurface, current: Midsurface) -> tuple[Any, Any]:
    """Contravariant membrane forces and moments of second Piola-Kirchhoff type, ``dW = n : d(eps) + m : d(kappa)``.

    Args:
        material: the material.
        reference: reference configuration.
        current: current configuration.

    Returns:
        n^{alpha beta} and m^{alpha beta} per reference area, symmetric, shape (m, m) each.
    """
    response = _Response(material, reference, current)
    return response.forces, response.moments


def _independent(tensor: Any) -> list[Any]:
    """Independent components of a symmetric m x m tensor."""
    m = tensor.ufl_shape[0]
    return [tensor[i, j] for i in range(m) for j in range(i, m)]


def _symmetric(components: list[Any]) -> Any:
    """Symmetric tensor from its independent components."""
    if len(components) == 1:
        return ufl.as_matrix([components])
    t_11, t_12, t_22 = components
    return ufl.as_matrix([[t_11, t_12], [t_12, t_22]])


class _Response:
    """Energy of a material as a function of the independent components of a and b, and its derivatives.

    Attributes:
        slope: first derivatives by the components of a, then of b.
        stiffness: second derivatives.
        forces: n^{alpha beta} = 2 dW/da_{alpha beta}.
        moments: m^{alpha beta} = -dW/db_{alpha beta}.
    """

    def __init__(self, material: Material, reference: Midsurface, current: Midsurface) -> None:
        components = [*_independent(current.metric), *_independent(current.curvature)]
        measures = ufl.variable(ufl.as_vector(components))
        k = len(components) // 2
        entries = [measures[i] for i in range(2 * k)]
        # the other fields are absent: an energy that used them would not be differentiated by them
        state = Midsurface(None, None, None, _symmetric(entries[:k]), _symmetric(entries[k:]))
        self.slope = ufl.diff(material.energy_density(reference, state), measures)
        self.stiffness = ufl.diff(self.slope, measures)
        # an off-diagonal component stands for two entries
        share = [1.0] if k == 1 else [1.0, 0.5, 1.0]
        self.forces = _symmetric([2 * share[i] * self.slope[i] for i in range(k)])
        self.moments = _symmetric([-share[i] * self.slope[k + i] for i in range(k)])


class _Variation:
    """What a displacement field changes at first order.

    Attributes:
        gradient: v_{,alpha}, shape (nsd, m).
        second: v_{|alpha beta}, shape (nsd, m, m).
        tilt: a_3 . v_{,alpha}, shape (m,).
        measures: variations of the independent components of a, then of b.
    """

    def __init__(self, spline: ExtractedSpline, current: Midsurface, field: Any) -> None:
        i, al, be, ga = ufl.indices(4)
        a, n = current.tangents, current.normal
        self._dual = a * ufl.inv(current.metric)
        self.gradient = v = spline.parametric_grad(spline.rationalize(field))
        christoffel = ufl.as_tensor(self._dual[i, ga] * spline.parametric_grad(a)[i, al, be], (ga, al, be))
        straight = ufl.as_tensor(v[i, ga] * christoffel[ga, al, be], (i, al, be))
        self.second = spline.parametric_grad(v) - straight
        self.tilt = ufl.dot(n, v)
        metric = a.T * v
        curvature = ufl.as_tensor(n[i] * self.second[i, al, be], (al, be))
        self.measures = ufl.as_vector([*_independent(metric + metric.T), *_independent(curvature)])

    def turned(self, m: Any) -> Any:
        """``m^{alpha beta} a^gamma . v_{|alpha beta}``, shape (m,)."""
        i, al, be, ga = ufl.indices(4)
        return ufl.as_tensor(self._dual[i, ga] * self.second[i, al, be] * m[al, be], (ga,))
