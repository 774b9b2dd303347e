"""St. Venant-Kirchhoff material of a thin shell (Kiendl et al., doi:10.1016/j.cma.2009.08.013)."""

from dataclasses import dataclass
from typing import Any

import ufl

from shnapr.kinematics import Midsurface, curvature_change, local_voigt, membrane_strain
from tigar_x import checks


@dataclass(frozen=True)
class StVenantKirchhoff:
    """Isotropic St. Venant-Kirchhoff material of a thin shell.

    Every parameter is a number, a dolfinx Constant (so that a sweep compiles nothing again) or a UFL expression over
    the parametric mesh (so that it may vary in space). Numbers and Constants are checked.

    Attributes:
        youngs_modulus: E > 0; unit: force/length^2.
        poisson_ratio: nu in (-1, 0.5].
        thickness: h > 0; unit: length.
        prestress: membrane resultant N_0 in the local Cartesian frame, (N_11, N_22, N_12) for a surface, (N_11,) for a
            curve; unit: force/length. None: no such term.
        bending_prestress: moment resultant M_0 in the same form; unit: force. None: no such term.
        bending: whether curvature enters the energy; False makes a membrane.

    Raises:
        ValueError: a parameter is no number, Constant or UFL scalar (a prestress: no vector), or is out of range.
    """

    youngs_modulus: Any
    poisson_ratio: Any
    thickness: Any
    prestress: Any = None
    bending_prestress: Any = None
    bending: bool = True

    def __post_init__(self) -> None:
        checks.parameter("youngs_modulus", self.youngs_modulus, checks.positive)
        checks.parameter("thickness", self.thickness, checks.positive)
        checks.parameter("poisson_ratio", self.poisson_ratio, checks.poisson)
        for name in ("prestress", "bending_prestress"):
            if getattr(self, name) is not None:
                checks.vector(name, getattr(self, name))
        checks.flag("bending", self.bending)
        if self.bending_prestress is not None and not self.bending:
            raise ValueError("bending_prestress is given with bending = False: a membrane carries no moments")

    def plane_stress(self, strains: int) -> Any:
        """Stiffness E/(1 - nu^2) [...] in Voigt notation.

        Args:
            strains: 3 for a surface; 1 for a curve, whose strain along e_3 is zero.

        Returns:
            UFL matrix of shape (strains, strains); unit: force/length^2.
        """
        nu = self.poisson_ratio
        factor = self.youngs_modulus / (1 - nu**2)
        if strains == 1:
            return ufl.as_matrix([[factor]])
        return factor * ufl.as_matrix([[1, nu, 0], [nu, 1, 0], [0, 0, (1 - nu) / 2]])

    def energy_density(self, reference: Midsurface, current: Midsurface) -> Any:
        """Strain energy per reference area: ``eps . (h/2 D eps + N_0) + kap . (h^3/24 D kap + M_0)``.

        Args:
            reference: reference configuration.
            current: current configuration.

        Returns:
            UFL scalar; unit: force/length.
        """
        h = self.thickness
        eps = local_voigt(reference, membrane_strain(reference, current))
        D = self.plane_stress(len(eps))
        W = h / 2 * ufl.dot(eps, D * eps)
        if self.prestress is not None:
            W += ufl.dot(checks.vector("prestress", self.prestress, len(eps)), eps)
        if self.bending:
            kap = local_voigt(reference, curvature_change(reference, current))
            W += h**3 / 24 * ufl.dot(kap, D * kap)
            if self.bending_prestress is not None:
                W += ufl.dot(checks.vector("bending_prestress", self.bending_prestress, len(eps)), kap)
        return W

    def strain(self, reference: Midsurface, current: Midsurface, zeta: Any) -> Any:
        """Green strain eps + zeta kappa in the local Cartesian frame of the reference midsurface.

        Args:
            reference: reference configuration.
            current: current configuration.
            zeta: distance from the midsurface along A_3; unit: length.

        Returns:
            Strain in the tangent plane, shape (2, 2); of a curve, direction 2 is the generator, without strain.
        """
        covariant = membrane_strain(reference, current)
        if self.bending:
            covariant += zeta * curvature_change(reference, current)
        e = local_voigt(reference, covariant)
        if len(e) == 1:
            return ufl.as_matrix([[e[0], 0], [0, 0]])
        return ufl.as_matrix([[e[0], e[2] / 2], [e[2] / 2, e[1]]])

    def second_piola(self, strain: Any, zeta: Any) -> Any:
        """Plane stress that belongs to a strain, ``D E + N_0/h + 12 zeta M_0/h^3``.

        Args:
            strain: E from :meth:`strain`, shape (2, 2).
            zeta: distance from the midsurface along A_3; unit: length.

        Returns:
            S in the frame of the strain, shape (2, 2); unit: force/length^2.
        """
        S = self.plane_stress(3) * ufl.as_vector([strain[0, 0], strain[1, 1], strain[0, 1] + strain[1, 0]])
        h = self.thickness
        for name, factor in (("prestress", 1 / h), ("bending_prestress", 12 * zeta / h**3)):
            value = getattr(self, name)
            if value is not None:
                S += factor * _padded(value)
        return ufl.as_matrix([[S[0], S[2]], [S[2], S[1]]])

    def squared_normal_stretch(self, strain: Any) -> Any:
        """``C_33 = 1 - 2 nu/(1 - nu) (E_11 + E_22)``, for which the stress along the normal is zero.

        Args:
            strain: E from :meth:`strain`, shape (2, 2).

        Returns:
            UFL scalar; negative at strains that are beyond this material.
        """
        nu = self.poisson_ratio
        return 1 - 2 * nu / (1 - nu) * ufl.tr(strain)


def _padded(resultant: Any) -> Any:
    """A prestress in Voigt notation for two directions; along the generator of a curve there is none."""
    vector = resultant if hasattr(resultant, "ufl_shape") else ufl.as_vector(list(resultant))
    return vector if len(vector) == 3 else ufl.as_vector([vector[0], 0, 0])
