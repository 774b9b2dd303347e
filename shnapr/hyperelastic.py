"""Incompressible hyperelastic shells (Kiendl et al., doi:10.1016/j.cma.2015.03.010).

At every point through the thickness the stretch along the normal follows from incompressibility, C_33 = 1/det C over
the tangent plane. A pressure term p (J - 1) would be zero with all its derivatives, because J = 1 for every strain of
the tangent plane, and is left out.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import ufl

from shnapr.kinematics import Midsurface, dual_frame, layer_metric
from tigar_x import checks, compat


@dataclass(frozen=True)
class Hyperelastic:
    """Incompressible hyperelastic material of a thin shell.

    Attributes:
        psi: maps the Green strain E in the local Cartesian frame, UFL matrix of shape (3, 3) with the normal as third
            direction, to the energy per volume; unit: force/length^2. ``det(2 E + I) = 1`` holds for all strains it
            is asked for. Such as :func:`neo_hookean` or :func:`lee_sacks`.
        thickness: h > 0, number, Constant or UFL expression over the parametric mesh; unit: length.
        points: Gauss points through the thickness; 1 leaves a membrane.

    Raises:
        ValueError: psi is not callable, or a parameter is out of range.
    """

    psi: Callable[[Any], Any]
    thickness: Any
    points: int = 4

    def __post_init__(self) -> None:
        if not callable(self.psi):
            raise ValueError(f"psi = {self.psi!r}: a function of the Green strain is required")
        checks.parameter("thickness", self.thickness, checks.positive)
        object.__setattr__(self, "points", checks.whole("points", self.points, 1))

    def energy_density(self, reference: Midsurface, current: Midsurface) -> Any:
        """Strain energy per reference area, ``int psi d zeta`` over the thickness by Gauss's rule.

        Args:
            reference: reference configuration.
            current: current configuration.

        Returns:
            UFL scalar; unit: force/length.
        """
        half = self.thickness / 2
        return sum(
            float(weight) * half * self._energy(self.strain(reference, current, float(level) * half))
            for level, weight in zip(*np.polynomial.legendre.leggauss(self.points), strict=True)
        )

    def strain(self, reference: Midsurface, current: Midsurface, zeta: Any) -> Any:
        """Green strain in the local Cartesian frame of the reference layer, from the metrics a - 2 zeta b.

        Args:
            reference: reference configuration.
            current: current configuration.
            zeta: distance from the midsurface along A_3; unit: length.

        Returns:
            Strain in the tangent plane, shape (2, 2); of a curve, direction 2 is the generator, without strain.
        """
        G, g = layer_metric(reference, zeta), layer_metric(current, zeta)
        Q = dual_frame(G)
        E = Q * ((g - G) / 2) * Q.T
        return ufl.as_matrix([[E[0, 0], 0], [0, 0]]) if E.ufl_shape == (1, 1) else E

    def second_piola(self, strain: Any, zeta: Any) -> Any:
        """Plane stress that belongs to a strain: the derivative of the condensed energy.

        Args:
            strain: E from :meth:`strain`, shape (2, 2).
            zeta: distance from the midsurface, which does not matter here.

        Returns:
            S in the frame of the strain, shape (2, 2); unit: force/length^2.
        """
        E = ufl.variable(strain)
        S = ufl.diff(self._energy(E), E)
        return (S + S.T) / 2

    def squared_normal_stretch(self, strain: Any) -> Any:
        """``C_33 = 1/det C`` of the tangent plane.

        Args:
            strain: E from :meth:`strain`, shape (2, 2).

        Returns:
            UFL scalar.
        """
        return 1 / (1 + _excess(strain))

    def _energy(self, strain: Any) -> Any:
        """Energy per volume with the normal strain that incompressibility leaves."""
        E, excess = strain, _excess(strain)
        # not (C_33 - 1)/2, which loses small strains in the rounding of 1
        normal = -excess / (2 * (1 + excess))
        full = ufl.as_matrix([[E[0, 0], E[0, 1], 0], [E[1, 0], E[1, 1], 0], [0, 0, normal]])
        return compat.ask("psi", self.psi, full)


def _excess(strain: Any) -> Any:
    """``det C - 1`` of the tangent plane, from its Green strain."""
    return 2 * ufl.tr(strain) + 4 * ufl.det(strain)


def neo_hookean(mu: Any) -> Callable[[Any], Any]:
    """Neo-Hookean energy ``mu/2 (I_1 - 3)``.

    Args:
        mu: shear modulus > 0, number, Constant or UFL expression; unit: force/length^2.

    Returns:
        Function of the Green strain, for :class:`Hyperelastic`.

    Raises:
        ValueError: mu is out of range.
    """
    checks.parameter("mu", mu, checks.positive)
    return lambda E: mu * ufl.tr(E)  # I_1 - 3 = 2 tr E


def lee_sacks(c0: Any, c1: Any, c2: Any) -> Callable[[Any], Any]:
    """Isotropic Lee-Sacks energy ``c0/2 (I_1 - 3) + c1/2 (exp(c2 (I_1 - 3)^2) - 1)`` of soft tissue.

    For bovine pericardium c0 = 676080 dyn/cm^2, c1 = 132848 dyn/cm^2, c2 = 38.1878, with the thickness 0.0386 cm.

    Args:
        c0: shear modulus at small strains > 0, number, Constant or UFL expression; unit: force/length^2.
        c1: factor of the exponential >= 0; unit: force/length^2.
        c2: steepness of the exponential >= 0.

    Returns:
        Function of the Green strain, for :class:`Hyperelastic`.

    Raises:
        ValueError: a parameter is out of range.
    """
    checks.parameter("c0", c0, checks.positive)
    checks.parameter("c1", c1, checks.not_negative)
    checks.parameter("c2", c2, checks.not_negative)

    def psi(E: Any) -> Any:
        excess = 2 * ufl.tr(E)
        return c0 / 2 * excess + c1 / 2 * (ufl.exp(c2 * excess**2) - 1)

    return psi
