"""St. Venant-Kirchhoff shell: strain energy and virtual work (Kiendl et al., doi:10.1016/j.cma.2009.08.013)."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import ufl

from shnapr.kinematics import Midsurface, curvature_change, local_voigt, membrane_strain, midsurface
from tigar_x import checks
from tigar_x.spline import ExtractedSpline


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
        ValueError: a parameter is out of range.
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
            checks.entries(name, getattr(self, name))
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
            W += ufl.dot(_resultant("prestress", self.prestress, len(eps)), eps)
        if self.bending:
            kap = local_voigt(reference, curvature_change(reference, current))
            W += h**3 / 24 * ufl.dot(kap, D * kap)
            if self.bending_prestress is not None:
                W += ufl.dot(_resultant("bending_prestress", self.bending_prestress, len(eps)), kap)
        return W


def _resultant(name: str, value: Any, strains: int) -> Any:
    vector = value if hasattr(value, "ufl_shape") else ufl.as_vector(list(value))
    if vector.ufl_shape != (strains,):
        raise ValueError(f"{name} has shape {vector.ufl_shape}: shape ({strains},) is required")
    return vector


def strain_energy(spline: ExtractedSpline, material: StVenantKirchhoff, y: Any) -> ufl.Form:
    """Elastic energy of the displaced shell.

    Args:
        spline: the midsurface.
        material: the material.
        y: homogeneous displacement y^h, shape (nsd,); unit: length.

    Returns:
        Functional; unit: energy (per depth in the plane).
    """
    current = midsurface(spline, spline.rationalize(y))
    return material.energy_density(midsurface(spline), current) * spline.dx


def virtual_work(spline: ExtractedSpline, energy: Callable[[Any], ufl.Form], y: Any, z: Any) -> ufl.Form:
    """Virtual work of an energy at any displacement, such as the intermediate one of a time step.

    The energy is differentiated at a placeholder that is then replaced by ``y``; nothing of how ``y`` depends on the
    unknown (factors alpha_f) enters.

    Args:
        spline: the midsurface.
        energy: maps a displacement to the energy.
        y: homogeneous displacement, an expression of shape (nsd,).
        z: test function in ``spline.V``.

    Returns:
        Residual form dW(y)[z].
    """
    placeholder = ufl.Coefficient(spline.V)
    return ufl.replace(ufl.derivative(energy(placeholder), placeholder, z), {placeholder: y})
