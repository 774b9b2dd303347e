"""Fields that differ on both sides of a line or surface that passes through cells, and the equations there.

The two sides are those of a nodal function phi, s = -1 where it is negative and s = 1 elsewhere. A pressure is
``p = p_mean + s/2 j``: it jumps by j. A velocity is ``v = u + psi a`` with ``psi = (sum_i N_i |phi_i| - s phi)/l``:
it is continuous, psi vanishes at the nodes, and the slope along grad phi falls by 2 |grad phi| a/l where phi is zero.
Where that line moves psi changes, and the rate ``u_t + psi a_t + psi_t a`` of v at a fixed place jumps across it.
With a length l of the size of cells a is a velocity, so that norms of a system are the same in all units.
The equations are written once for every side, with its sign as a number and a weight that integrates over it. Who knows
the surface sets phi and the weight.
"""

from dataclasses import dataclass
from typing import Any

import ufl

from varmint.forms.vms import interior_residual

SIGNS = (-1.0, 1.0)
"""Of the two sides."""


@dataclass(frozen=True)
class Sides:
    """The two sides of a nodal function.

    Attributes:
        phi: linear function, whose sign tells the sides.
        size: linear function with the values |phi| at the nodes.
        negative: weight of the negative side in a cell, a polynomial of the degree that it integrates exactly; the
            positive side has the rest.
        length: l, a number or Constant; unit: that of phi.
        carried: velocities with which phi is carried along at the nodes, and the same times the signs of phi there, two
            linear functions; None: phi stays.
    """

    phi: Any
    size: Any
    negative: Any
    length: Any = 1.0
    carried: tuple[Any, Any] | None = None

    def weight(self, s: float) -> Any:
        """Weight of a side."""
        return self.negative if s < 0.0 else 1 - self.negative

    def velocity(self, u: Any, a: Any, s: float) -> Any:
        """Velocity, its rate or its test function on a side.

        Args:
            u: part that is linear in cells, shape (d,).
            a: kink, same shape; None: there is none.
            s: side.
        """
        return u if a is None else u + (self.size - s * self.phi) / self.length * a

    def rate(self, u_t: Any, a_t: Any, a: Any, s: float) -> Any:
        """Rate of the velocity on a side at a fixed place.

        Args:
            u_t: rate of u, shape (d,).
            a_t: rate of the kink, same shape; None: there is none.
            a: kink, likewise.
            s: side.
        """
        rate = self.velocity(u_t, a_t, s)
        if a is None or self.carried is None:
            return rate
        v, signed = self.carried
        return rate - ufl.dot(signed - s * v, ufl.grad(self.phi)) / self.length * a

    @staticmethod
    def pressure(p: Any, j: Any, s: float) -> Any:
        """Pressure or its test function on a side, from its mean p and its jump j."""
        return p + s / 2 * j

    def fields(self, parts: tuple[Any, Any, Any, Any], s: float) -> tuple[Any, Any]:
        """Velocity and pressure on a side.

        Args:
            parts: velocity u, pressure p, kink a and jump j; an a that is None: there are no kinks.
            s: side.
        """
        u, p, a, j = parts
        return self.velocity(u, a, s), self.pressure(p, j, s)


def weighted(form: ufl.Form, weight: Any) -> ufl.Form:
    """A form with all its integrands times a weight."""
    return ufl.Form([integral.reconstruct(integrand=weight * integral.integrand()) for integral in form.integrals()])


def sided_residual(
    sides: Sides,
    unknowns: tuple[Any, Any, Any, Any],
    tests: tuple[Any, Any, Any, Any],
    rates: tuple[Any, Any],
    domain: Any,
    *,
    rho: Any,
    mu: Any,
    smoothing: Any = 0.1,
    dx: ufl.Measure,
    **known: Any,
) -> ufl.Form:
    """Residual in cells that are divided: Galerkin terms, SUPG, PSPG and grad-div on either side.

    Cross stress and Reynolds stress are left out, with which impulsive starts fail. About half of what flows through a
    gap of one cell between two ends is mass flux of PSPG, tau_M times slopes of the pressure: so tau_M here is half of
    what it would be in steady flow, and a time step at most. Kinks in cells of which one side is small are as good as
    free, and are therefore smoothed by ``smoothing mu (h/l)^2 grad a : grad b`` over whole cells.

    Args:
        sides: the sides.
        unknowns: velocity u, pressure p, kink a and jump j, at the intermediate level; a None: there are no kinks.
        tests: their test functions.
        rates: those of u and a at fixed phi.
        domain: mesh of triangles or tetrahedra.
        rho: density.
        mu: dynamic viscosity.
        smoothing: dimensionless factor.
        dx: the divided cells, with a quadrature that the weights of the sides go with.
        known: see :func:`varmint.forms.vms.interior_residual`.

    Returns:
        Residual form.
    """
    (u, p, a, j), (w, q, b, k), (u_t, a_t) = unknowns, tests, rates
    residual = ufl.Form([])
    for s in SIGNS:
        fields = *sides.fields((u, p, a, j), s), *sides.fields((w, q, b, k), s)
        rate = sides.rate(u_t, a_t, a, s)
        side = interior_residual(*fields, domain, rho=rho, mu=mu, v_t=rate, dx=dx, divided=True, **known)
        residual += weighted(side, sides.weight(s))
    if a is None:
        return residual
    d = domain.geometry.dim
    h_squared = (ufl.CellVolume(domain) * (2 if d == 2 else 6)) ** (2 / d)
    slopes = ufl.inner(ufl.grad(a), ufl.grad(b))
    return residual + smoothing * mu * h_squared / sides.length**2 * slopes * dx
