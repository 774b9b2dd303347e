"""Boundary terms of the flow: weak Dirichlet conditions and stable Neumann conditions.

Sources: Bazilevs and Hughes, doi:10.1016/j.compfluid.2005.07.012; Esmaily-Moghadam et al.,
doi:10.1007/s00466-011-0599-0.
"""

from typing import Any

import ufl

from tigar_x import checks
from varmint.vms import element_metric, stress


def _inflow(v: Any, n: Any) -> Any:
    """Negative part of v.n, ``min(v.n, 0)``."""
    flux = ufl.dot(v, n)
    return (flux - abs(flux)) / 2


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

    Returns:
        Residual form.

    Raises:
        ValueError: rho, mu or penalty out of range, or g of a wrong shape.
    """
    checks.parameter("rho", rho, checks.positive)
    checks.parameter("mu", mu, checks.not_negative)
    if g.ufl_shape != v.ufl_shape:
        raise ValueError(f"g has shape {g.ufl_shape}: shape {v.ufl_shape} is required")
    n = ufl.FacetNormal(domain)
    sign = 1 if symmetric else -1
    jump = v - g
    R = -ufl.inner(stress(v, p, mu) * n, w) - rho * _inflow(v, n) * ufl.inner(jump, w)
    R -= ufl.inner(2 * mu * sign * ufl.sym(ufl.grad(w)) * n + q * n, jump)
    P = 1e3 if penalty is None and symmetric else penalty
    if P is not None:
        checks.parameter("penalty", P, checks.not_negative)
        strength = P * mu * ufl.sqrt(ufl.dot(n, element_metric(domain) * n))
        R += strength * ufl.inner(jump, w)
    return R * ds


def stable_neumann(
    v: Any, w: Any, domain: Any, ds: Any, *, rho: Any, traction: Any = None, g: Any = None, gamma: Any = 1.0
) -> ufl.Form:
    """Traction on an open boundary, stabilised where the flow comes back in.

    Args:
        v: velocity, shape (d,).
        w: test function of v.
        domain: mesh.
        ds: exterior facet measure, restricted to the facets of the condition.
        rho: density.
        traction: prescribed force per area, shape (d,); None: free of traction.
        g: velocity of the fluid that comes back in; None: zero.
        gamma: factor of the stabilisation; 1/2 is the smallest that bounds the energy.

    Returns:
        Residual form.

    Raises:
        ValueError: rho or gamma out of range, traction or g of a wrong shape.
    """
    checks.parameter("rho", rho, checks.positive)
    checks.parameter("gamma", gamma, checks.not_negative)
    for name, field in (("traction", traction), ("g", g)):
        if field is not None and field.ufl_shape != v.ufl_shape:
            raise ValueError(f"{name} has shape {field.ufl_shape}: shape {v.ufl_shape} is required")
    n = ufl.FacetNormal(domain)
    R = -gamma * rho * _inflow(v, n) * ufl.inner(v if g is None else v - g, w)
    if traction is not None:
        R -= ufl.inner(traction, w)
    return R * ds
