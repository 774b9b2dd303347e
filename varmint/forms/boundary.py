"""Boundary terms of the flow: weak Dirichlet conditions, slip, and stable Neumann conditions.

Sources: Bazilevs and Hughes, doi:10.1016/j.compfluid.2005.07.012; Esmaily-Moghadam et al.,
doi:10.1007/s00466-011-0599-0. On a moving mesh areas, normals and the direction of the flow are the present ones, the
latter relative to the mesh.
"""

from typing import Any

import ufl

from tigar_x import checks
from varmint.forms.ale import Motion, advection, gradient, normal, per_area
from varmint.forms.vms import element_metric, stress


def _inflow(v: Any, n: Any) -> Any:
    """Negative part of v.n, ``min(v.n, 0)``."""
    flux = ufl.dot(v, n)
    return (flux - abs(flux)) / 2


def _strength(n: Any, mu: Any, penalty: Any, domain: Any, motion: Motion | None, invariant: bool) -> Any:
    """Penalty ``P mu sqrt(n.G n)`` of a velocity."""
    return penalty * mu * ufl.sqrt(ufl.dot(n, element_metric(domain, motion, invariant=invariant) * n))


def weak_dirichlet(
    v: Any,
    p: Any,
    w: Any,
    q: Any,
    g: Any,
    domain: Any,
    ds: Any,
    *,
    rho: Any,
    mu: Any,
    symmetric: bool = True,
    penalty: Any = None,
    motion: Motion | None = None,
    invariant: bool = False,
) -> ufl.Form:
    """Weakly imposed velocity v = g (Nitsche's method with inflow term).

    Args:
        v: velocity, shape (d,).
        p: pressure.
        w: test function of v.
        q: test function of p.
        g: prescribed velocity, shape (d,).
        domain: mesh.
        ds: exterior facet measure, restricted to the facets of the condition.
        rho: density.
        mu: dynamic viscosity.
        symmetric: sign of the adjoint viscous term: +1 (symmetric) or -1.
        penalty: dimensionless factor P of ``P mu sqrt(n.G n)``; None: 1000 in the symmetric variant, else absent.
        motion: motion of the mesh; None: it is fixed.
        invariant: see :func:`varmint.forms.vms.element_metric`.

    Returns:
        Residual form.

    Raises:
        ValueError: rho, mu or penalty no scalar or out of range, g of a wrong shape, or a measure that is not one of
            the mesh's boundary.
    """
    checks.parameter("rho", rho, checks.positive)
    checks.parameter("mu", mu, checks.not_negative)
    checks.measure("ds", ds, domain, "exterior_facet")
    checks.flag("symmetric", symmetric)
    g = checks.vector("g", g, *v.ufl_shape)
    n = normal(domain, motion)
    sign = 1 if symmetric else -1
    jump = v - g
    R = -ufl.inner(stress(v, p, mu, motion) * n, w) - rho * _inflow(advection(v, motion), n) * ufl.inner(jump, w)
    R -= ufl.inner(2 * mu * sign * ufl.sym(gradient(w, motion)) * n + q * n, jump)
    P = 1e3 if penalty is None and symmetric else penalty
    if P is not None:
        checks.parameter("penalty", P, checks.not_negative)
        R += _strength(n, mu, P, domain, motion, invariant) * ufl.inner(jump, w)
    return per_area(R, domain, motion) * ds


def weak_slip(
    v: Any,
    p: Any,
    w: Any,
    q: Any,
    domain: Any,
    ds: Any,
    *,
    rho: Any,
    mu: Any,
    penalty: Any = 1e3,
    motion: Motion | None = None,
    invariant: bool = False,
) -> ufl.Form:
    """Impermeable wall without friction: the symmetric weak condition above for the normal component alone.

    Args:
        v: velocity, shape (d,).
        p: pressure.
        w: test function of v.
        q: test function of p.
        domain: mesh.
        ds: exterior facet measure, restricted to the facets of the condition.
        rho: density.
        mu: dynamic viscosity.
        penalty: dimensionless factor P of ``P mu sqrt(n.G n)``.
        motion: motion of the mesh, which the fluid follows along the normal; None: it is fixed.
        invariant: see :func:`varmint.forms.vms.element_metric`.

    Returns:
        Residual form.

    Raises:
        ValueError: rho, mu or penalty no scalar or out of range, or a measure that is not one of the mesh's boundary.
    """
    checks.measure("ds", ds, domain, "exterior_facet")
    checks.parameter("rho", rho, checks.positive)
    checks.parameter("mu", mu, checks.not_negative)
    checks.parameter("penalty", penalty, checks.not_negative)
    n = normal(domain, motion)
    jump, w_n = ufl.dot(advection(v, motion), n), ufl.dot(w, n)
    R = -ufl.dot(n, stress(v, p, mu, motion) * n) * w_n - rho * _inflow(advection(v, motion), n) * jump * w_n
    R -= (ufl.dot(n, 2 * mu * ufl.sym(gradient(w, motion)) * n) + q) * jump
    R += _strength(n, mu, penalty, domain, motion, invariant) * jump * w_n
    return per_area(R, domain, motion) * ds


def stable_neumann(
    v: Any,
    w: Any,
    domain: Any,
    ds: Any,
    *,
    rho: Any,
    traction: Any = None,
    g: Any = None,
    gamma: Any = 1.0,
    motion: Motion | None = None,
) -> ufl.Form:
    """Traction on an open boundary, stabilised where the flow comes back in.

    Args:
        v: velocity, shape (d,).
        w: test function of v.
        domain: mesh.
        ds: exterior facet measure, restricted to the facets of the condition.
        rho: density.
        traction: prescribed force per present area, shape (d,); None: free of traction.
        g: velocity of the fluid that comes back in; None: zero.
        gamma: factor of the stabilisation; 1/2 is the smallest that bounds the energy.
        motion: motion of the mesh; None: it is fixed.

    Returns:
        Residual form.

    Raises:
        ValueError: rho or gamma no scalar or out of range, traction or g of a wrong shape, or a measure that is not one
            of the mesh's boundary.
    """
    checks.measure("ds", ds, domain, "exterior_facet")
    checks.parameter("rho", rho, checks.positive)
    checks.parameter("gamma", gamma, checks.not_negative)
    traction, g = (
        None if field is None else checks.vector(name, field, *v.ufl_shape)
        for name, field in (("traction", traction), ("g", g))
    )
    n = normal(domain, motion)
    R = -gamma * rho * _inflow(advection(v, motion), n) * ufl.inner(v if g is None else v - g, w)
    if traction is not None:
        R -= ufl.inner(traction, w)
    return per_area(R, domain, motion) * ds
