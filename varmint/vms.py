"""Variational multiscale (VMS) residual of incompressible Navier-Stokes flow in any dimension and for any degree.

Source: Bazilevs et al., doi:10.1007/s00466-008-0315-x. All functions are pure: fields in, UFL out. A term that the
scene does not need (body force, unsteadiness, a surface band, second derivatives of linear simplices) is not in the
form.
"""

from typing import Any

import ufl

from tigar_x import checks, compat

EPSILON = 3e-16
"""Keeps the square root in tau_M differentiable where everything in it vanishes."""


def stress(v: Any, p: Any, mu: Any) -> Any:
    """Cauchy stress ``2 mu sym(grad v) - p I``.

    Args:
        v: velocity, shape (d,).
        p: pressure.
        mu: dynamic viscosity.

    Returns:
        UFL tensor of shape (d, d); unit: force/area.
    """
    return 2 * mu * ufl.sym(ufl.grad(v)) - p * ufl.Identity(len(v))


def material_acceleration(v: Any, *, v_t: Any = None, f: Any = None) -> Any:
    """Acceleration less force, ``v_t + (grad v) v - f``.

    Args:
        v: velocity, shape (d,).
        v_t: its partial time derivative; None: steady.
        f: body force per mass; None: none.

    Returns:
        UFL vector of shape (d,); unit: length/time^2.
    """
    D = ufl.grad(v) * v
    if v_t is not None:
        D += v_t
    return D if f is None else D - f


def momentum_residual(
    v: Any, p: Any, *, rho: Any, mu: Any, linear_simplex: bool, v_t: Any = None, f: Any = None
) -> Any:
    """Strong residual of the momentum balance, ``rho D - div sigma``.

    Args:
        v: velocity, shape (d,).
        p: pressure.
        rho: density.
        mu: dynamic viscosity.
        linear_simplex: whether v is linear on simplices, where the viscous part vanishes.
        v_t: partial time derivative of v; None: steady.
        f: body force per mass; None: none.

    Returns:
        UFL vector of shape (d,); unit: force/volume.
    """
    r_M = rho * material_acceleration(v, v_t=v_t, f=f) + ufl.grad(p)
    return r_M if linear_simplex else r_M - ufl.div(2 * mu * ufl.sym(ufl.grad(v)))


def element_metric(domain: Any) -> Any:
    """Element metric ``G = 4 J^-T J^-1`` of the map from the reference cell of edge length 1.

    On simplices it depends on which vertex is numbered 0.

    Args:
        domain: mesh.

    Returns:
        UFL tensor of shape (d, d); unit: 1/length^2.
    """
    K = ufl.JacobianInverse(domain)
    return 4 * K.T * K


def stabilization_parameters(
    v: Any,
    G: Any,
    *,
    nu: Any,
    dt: Any = None,
    C_I: Any = 3.0,
    C_t: Any = 4.0,
    scale_m: Any = None,
    scale_c: Any = None,
) -> tuple[Any, Any]:
    """Stabilisation parameters tau_M and tau_C.

    ``m = v.G v + C_I nu^2 G:G (+ C_t/dt^2)``, ``tau_M = s_m/sqrt(m)``, ``tau_C = sqrt(m)/(s_c tr G)``. With
    ``s_c = s_m`` this is the published scaling near an immersed surface (doi:10.1016/j.camwa.2020.01.023).

    Args:
        v: advecting velocity, shape (d,).
        G: element metric.
        nu: kinematic viscosity.
        dt: full time step; None: steady, without that term.
        C_I: constant of the viscous term; 3 for linear elements, 6 k^4 has been used for degree k.
        C_t: constant of the time-step term.
        scale_m: factor s_m in (0, 1] of tau_M near an immersed surface; None: no surface.
        scale_c: divisor s_c in (0, 1] of tau_C near an immersed surface; None: no surface.

    Returns:
        tau_M (unit: time) and tau_C (unit: length^2/time).
    """
    m = ufl.dot(v, G * v) + C_I * nu**2 * ufl.inner(G, G) + EPSILON
    if dt is not None:
        m += C_t / dt**2
    root = ufl.sqrt(m)
    tau_M, tau_C = 1 / root, root / ufl.tr(G)
    if scale_m is not None:
        tau_M *= scale_m
    if scale_c is not None:
        tau_C /= scale_c
    return tau_M, tau_C


def is_linear_simplex(domain: Any, degree: int) -> bool:
    """Whether second derivatives of the discrete velocity vanish: degree 1 on a simplex."""
    return degree == 1 and compat.cell_name(domain) in ("interval", "triangle", "tetrahedron")


def interior_residual(
    v: Any,
    p: Any,
    w: Any,
    q: Any,
    domain: Any,
    *,
    rho: Any,
    mu: Any,
    degree: int = 1,
    v_t: Any = None,
    f: Any = None,
    dt: Any = None,
    C_I: Any = None,
    C_t: Any = 4.0,
    scale_m: Any = None,
    scale_c: Any = None,
    quadrature_degree: int | None = None,
) -> ufl.Form:
    """VMS residual in the interior: Galerkin terms, SUPG, PSPG, grad-div, cross-stress and Reynolds stress.

    Args:
        v: velocity at the intermediate level, shape (d,); unit: length/time.
        p: pressure; unit: force/area.
        w: test function of v.
        q: test function of p.
        domain: mesh of dimension d = 2 or 3.
        rho: density > 0; unit: mass/volume.
        mu: dynamic viscosity >= 0.
        degree: polynomial degree k of v.
        v_t: partial time derivative of v at the intermediate level; None: steady.
        f: body force per mass; None: none.
        dt: full time step, given exactly when v_t is.
        C_I: see :func:`stabilization_parameters`; None: 3 for degree 1, else 6 k^4.
        C_t: see there.
        scale_m: factor of tau_M near an immersed surface; None: no surface.
        scale_c: divisor of tau_C near an immersed surface; None: no surface.
        quadrature_degree: None: 2 k.

    Returns:
        Residual form.

    Raises:
        ValueError: a number out of range, v or f of a wrong shape, v_t without dt or dt without v_t.
    """
    k = checks.whole("degree", degree, 1)
    _check_numbers(rho=rho, mu=mu, dt=dt, C_I=C_I, C_t=C_t, scale_m=scale_m, scale_c=scale_c)
    _check_fields(v, f, v_t, dt, domain.geometry.dim)

    dx = ufl.dx(
        domain=domain, metadata={"quadrature_degree": 2 * k if quadrature_degree is None else quadrature_degree}
    )
    D = material_acceleration(v, v_t=v_t, f=f)
    r_M = momentum_residual(v, p, rho=rho, mu=mu, linear_simplex=is_linear_simplex(domain, k), v_t=v_t, f=f)
    constant = (3.0 if k == 1 else 6.0 * k**4) if C_I is None else C_I
    tau_M, tau_C = stabilization_parameters(
        v, element_metric(domain), nu=mu / rho, dt=dt, C_I=constant, C_t=C_t, scale_m=scale_m, scale_c=scale_c
    )
    v_fine = -tau_M * r_M
    p_fine = -tau_C * rho * ufl.div(v)
    galerkin = rho * ufl.inner(D, w) + ufl.inner(stress(v, p, mu), ufl.grad(w)) + q * ufl.div(v)
    advection = ufl.inner(ufl.grad(w) * v + ufl.grad(q) / rho, v_fine)
    cross_stress = ufl.inner(w, ufl.grad(v) * v_fine)
    reynolds_stress = ufl.inner(ufl.grad(w), ufl.outer(v_fine, v_fine)) / rho
    return (galerkin - advection - p_fine * ufl.div(w) + cross_stress - reynolds_stress) * dx


def _check_numbers(**numbers: Any) -> None:
    may_vanish = ("mu", "C_I", "C_t", "scale_m")
    for name, value in numbers.items():
        checks.parameter(name, value, checks.not_negative if name in may_vanish else checks.positive)


def _check_fields(v: Any, f: Any, v_t: Any, dt: Any, d: int) -> None:
    if v.ufl_shape != (d,):
        raise ValueError(f"v has shape {v.ufl_shape}: a mesh of dimension {d} requires ({d},)")
    if f is not None and f.ufl_shape != v.ufl_shape:
        raise ValueError(f"f has shape {f.ufl_shape}: shape {v.ufl_shape} is required")
    if (v_t is None) != (dt is None):
        raise ValueError("v_t and dt belong together: both are required for unsteady flow, neither for steady flow")
