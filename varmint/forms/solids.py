"""Elasticity on the mesh of a flow: thick solids that conform to it, and the fictitious solid that moves it.

Sources: Bazilevs et al., doi:10.1007/s00466-008-0315-x; Stein, Tezduyar and Benney, doi:10.1115/1.1530635 (cells that
are stiffer the smaller they are).
"""

from dataclasses import dataclass
from typing import Any

import ufl

from tigar_x import checks


def _lame(youngs_modulus: Any, poisson_ratio: Any) -> tuple[Any, Any]:
    """Lame's parameters lambda and mu; unit: force/area."""
    E, nu = youngs_modulus, poisson_ratio
    return E * nu / ((1 + nu) * (1 - 2 * nu)), E / (2 * (1 + nu))


@dataclass(frozen=True)
class _Elastic:
    """Material of given stiffness.

    Attributes:
        youngs_modulus: E > 0; unit: force/area.
        poisson_ratio: nu, in (-1, 1/2).
        density: mass per reference volume, > 0.

    Raises:
        ValueError: a number is out of range.
    """

    youngs_modulus: Any
    poisson_ratio: Any
    density: Any

    def __post_init__(self) -> None:
        checks.parameter("youngs_modulus", self.youngs_modulus, checks.positive)
        checks.parameter("poisson_ratio", self.poisson_ratio, _compressible)
        checks.parameter("density", self.density, checks.positive)


def _compressible(name: str, value: Any) -> float:
    number = checks.finite(name, value)
    if not -1.0 < number < 0.5:
        raise ValueError(f"{name} = {value!r}: a number in (-1, 0.5) is required")
    return number


class StVenantKirchhoffSolid(_Elastic):
    """St. Venant-Kirchhoff solid, ``S = lambda tr(E) I + 2 mu E`` with Green's strain E; plane strain in the plane."""

    def first_piola_kirchhoff(self, F: Any) -> Any:
        """First Piola-Kirchhoff stress of a deformation gradient, shape (d, d); unit: force/area."""
        lam, mu = _lame(self.youngs_modulus, self.poisson_ratio)
        eye = ufl.Identity(F.ufl_shape[0])
        E = (F.T * F - eye) / 2
        return F * (lam * ufl.tr(E) * eye + 2 * mu * E)


class NeoHookeanSolid(_Elastic):
    """Neo-Hookean solid, ``psi = mu/2 (tr C - 2 ln J - d) + lambda/2 (ln J)^2``; plane strain in the plane."""

    def first_piola_kirchhoff(self, F: Any) -> Any:
        """First Piola-Kirchhoff stress of a deformation gradient, shape (d, d); unit: force/area."""
        lam, mu = _lame(self.youngs_modulus, self.poisson_ratio)
        F_inv_T = ufl.inv(F).T
        return mu * (F - F_inv_T) + lam * ufl.ln(ufl.det(F)) * F_inv_T


SolidMaterial = StVenantKirchhoffSolid | NeoHookeanSolid


def solid_residual(
    material: SolidMaterial, displacement: Any, acceleration: Any, w: Any, dx: Any, *, f: Any = None
) -> ufl.Form:
    """Balance of momentum of a solid, ``int rho a . w + P : grad w - rho f . w`` over its reference configuration.

    Args:
        material: of the solid.
        displacement: at the level of the equation, shape (d,); unit: length.
        acceleration: at the same level, shape (d,).
        w: test function of the velocity.
        dx: cells of the solid.
        f: body force per mass; None: none.

    Returns:
        Residual form.

    Raises:
        ValueError: f has another shape than the displacement, or the measure is none of cells.
    """
    checks.measure("dx", dx, None, "cell")
    f = None if f is None else checks.vector("f", f, *displacement.ufl_shape)
    F = ufl.Identity(len(displacement)) + ufl.grad(displacement)
    inertia = acceleration if f is None else acceleration - f
    return (material.density * ufl.inner(inertia, w) + ufl.inner(material.first_piola_kirchhoff(F), ufl.grad(w))) * dx


def mesh_residual(
    displacement: Any,
    w: Any,
    domain: Any,
    dx: Any,
    *,
    stiffening: Any = 3.0,
    size_stiffening: Any = 1.0,
    size: Any = 1.0,
) -> ufl.Form:
    """Balance of the fictitious solid that carries the inner nodes of a mesh along with its boundary.

    ``int F S : grad w`` with ``S = k (tr(E) I + 2 (E - tr(E)/3 I))`` and the stiffness ``k = J^-a (V/V_0)^-b`` of cells
    that are compressed (J = det F) or small (volume V of the reference cell).

    Args:
        displacement: of the mesh, shape (d,); unit: length.
        w: test function, shape (d,).
        domain: mesh.
        dx: cells that it moves.
        stiffening: exponent a; unit: 1.
        size_stiffening: exponent b; unit: 1.
        size: volume V_0 of a typical cell, where k is of order one.

    Returns:
        Residual form.

    Raises:
        ValueError: the measure is not one of the mesh's cells.
    """
    checks.measure("dx", dx, domain, "cell")
    d = len(displacement)
    F = ufl.Identity(d) + ufl.grad(displacement)
    E = (F.T * F - ufl.Identity(d)) / 2
    # no number where J < 0, so that no iteration passes through cells that are inside out
    k = ufl.sqrt(ufl.det(F)) ** (-2 * stiffening) * (abs(ufl.JacobianDeterminant(domain)) / size) ** (-size_stiffening)
    S = k * (ufl.tr(E) * ufl.Identity(d) + 2 * (E - ufl.tr(E) / 3 * ufl.Identity(d)))
    return ufl.inner(F * S, ufl.grad(w)) * dx


@dataclass(frozen=True)
class Solid:
    """An elastic solid in a flow.

    Attributes:
        material: of the solid.
        on: cell group that it fills, or several.
    """

    material: SolidMaterial
    on: str | tuple[str, ...] = "solid"

    def __post_init__(self) -> None:
        checks.kind("material", self.material, _Elastic, "a StVenantKirchhoffSolid or a NeoHookeanSolid")

    @property
    def groups(self) -> tuple[str, ...]:
        """Names of the cell groups."""
        return (self.on,) if isinstance(self.on, str) else tuple(self.on)
