"""Variational multiscale (VMS) residual of incompressible Navier-Stokes flow in any dimension and for any degree.

Source: Bazilevs et al., doi:10.1007/s00466-008-0315-x. All functions are pure: fields in, UFL out. A term that the
scene does not need (body force, unsteadiness, motion of the mesh, a surface band, second derivatives of linear
simplices) is not in the form.
"""

from dataclasses import dataclass
from functools import partial
from typing import Any

import ufl

from tigar_x import checks, compat
from varmint.forms.ale import Motion, advection, divergence, gradient, per_volume

EPSILON = 3e-16
"""Keeps the square root in tau_M differentiable where everything in it vanishes."""
DIVIDED, LONGEST = 0.5, 1.0
"""In cells that are divided: factor of tau_M, which goes with the area, of which a side has half on average, and how
long it is then at most, in time steps. Longer ones in some cells alone make pressures unstable: docs/theory.md."""


def stress(v: Any, p: Any, mu: Any, motion: Motion | None = None) -> Any:
    """Cauchy stress ``2 mu sym(grad v) - p I``.

    Args:
        v: velocity, shape (d,).
        p: pressure.
        mu: dynamic viscosity.
        motion: motion of the mesh; None: it is fixed.

    Returns:
        UFL tensor of shape (d, d); unit: force/area.
    """
    return 2 * mu * ufl.sym(gradient(v, motion)) - p * ufl.Identity(len(v))


def material_acceleration(v: Any, *, v_t: Any = None, f: Any = None, motion: Motion | None = None) -> Any:
    """Acceleration less force, ``v_t + (grad v) (v - v_mesh) - f``.

    Args:
        v: velocity, shape (d,).
        v_t: its time derivative at a point of the mesh; None: steady.
        f: body force per mass; None: none.
        motion: motion of the mesh; None: it is fixed.

    Returns:
        UFL vector of shape (d,); unit: length/time^2.
    """
    D = gradient(v, motion) * advection(v, motion)
    if v_t is not None:
        D += v_t
    return D if f is None else D - f


def momentum_residual(
    v: Any,
    p: Any,
    *,
    rho: Any,
    mu: Any,
    linear_simplex: bool,
    v_t: Any = None,
    f: Any = None,
    motion: Motion | None = None,
) -> Any:
    """Strong residual of the momentum balance, ``rho D - div sigma``.

    Args:
        v: velocity, shape (d,).
        p: pressure.
        rho: density.
        mu: dynamic viscosity.
        linear_simplex: whether v is linear on simplices with straight edges, where the viscous part vanishes.
        v_t: time derivative of v at a point of the mesh; None: steady.
        f: body force per mass; None: none.
        motion: motion of the mesh; None: it is fixed.

    Returns:
        UFL vector of shape (d,); unit: force/volume.
    """
    r_M = rho * material_acceleration(v, v_t=v_t, f=f, motion=motion) + gradient(p, motion)
    return r_M if linear_simplex else r_M - divergence(2 * mu * ufl.sym(gradient(v, motion)), motion)


def element_metric(domain: Any, motion: Motion | None = None, *, invariant: bool = False) -> Any:
    """Element metric ``G = 4 J^-T J^-1`` of the map from the reference cell of edge length 1.

    On simplices it depends on which vertex is numbered 0. The invariant one is that of the map from a regular simplex
    of edge length 2, ``G = J^-T E J^-1`` with E the products of its edge vectors: 4 of each with itself, 2 of two.

    Args:
        domain: mesh.
        motion: its motion; None: it is fixed.
        invariant: whether to take the invariant one; on tensor cells both are the same.

    Returns:
        UFL tensor of shape (d, d); unit: 1/length^2.
    """
    K = ufl.JacobianInverse(domain)
    if motion is not None:
        K = K * ufl.inv(motion.F)
    if not (invariant and compat.is_simplex(domain)):
        return 4 * K.T * K
    d = domain.geometry.dim
    E = ufl.as_matrix([[4.0 if i == j else 2.0 for j in range(d)] for i in range(d)])
    return K.T * E * K


@dataclass(frozen=True)
class Memory:
    """What dynamic sub-scales remember: at the level of the equations their rate is ``rate v' - past``.

    Attributes:
        rate: derivative of the rate by v' there; unit: 1/time.
        past: what is known of the rate from the steps before, shape (d,); unit: force/volume.
    """

    rate: Any
    past: Any


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
        v: advecting velocity relative to the mesh, shape (d,).
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
    return degree == 1 and compat.is_simplex(domain)


def fine_scales(
    v: Any,
    p: Any,
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
    motion: Motion | None = None,
    invariant: bool = False,
    v_tau: Any = None,
    memory: Memory | None = None,
    divided: bool = False,
) -> tuple[Any, Any]:
    """What the mesh does not resolve, modelled by the strong residuals.

    Quasi-static sub-scales are ``v' = -tau_M r_M``, ``p' = -tau_C rho div v``. Dynamic ones keep their rate,
    ``dv'/dt + v'/tau_M = -r_M``, and no time step is in tau_M and tau_C: steady flows do not know it (Codina,
    Principe, Guasch and Badia, doi:10.1016/j.cma.2007.01.002).

    Args:
        v: see :func:`interior_residual`, as all others but the memory.
        p: see there.
        domain: see there.
        rho: see there.
        mu: see there.
        degree: see there.
        v_t: see there.
        f: see there.
        dt: see there.
        C_I: see there.
        C_t: see there.
        scale_m: see there.
        scale_c: see there.
        motion: see there.
        invariant: see there.
        v_tau: see there.
        memory: of dynamic sub-scales, which have no use for dt and C_t; None: they are quasi-static.
        divided: see there.

    Returns:
        rho times the velocity v', shape (d,), and the pressure p'.
    """
    simple = is_linear_simplex(domain, degree) and (motion is None or motion.degree == 1)
    r_M = momentum_residual(v, p, rho=rho, mu=mu, linear_simplex=simple, v_t=v_t, f=f, motion=motion)
    tau = partial(
        stabilization_parameters, advection(v if v_tau is None else v_tau, motion),
        element_metric(domain, motion, invariant=invariant), nu=mu / rho,
        C_I=default_C_I(degree) if C_I is None else C_I, C_t=C_t, scale_m=scale_m, scale_c=scale_c,
    )  # fmt: skip
    tau_M, tau_C = tau(dt=dt if memory is None else None)
    p_fine = -tau_C * rho * divergence(v, motion)
    if divided:
        return -ufl.min_value(DIVIDED * tau(dt=None)[0], LONGEST * dt) * r_M, p_fine
    if memory is None:
        return -tau_M * r_M, p_fine
    return (memory.past - r_M) * (tau_M / (1 + memory.rate * tau_M)), p_fine


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
    motion: Motion | None = None,
    invariant: bool = False,
    v_tau: Any = None,
    memory: Memory | None = None,
    divided: bool = False,
    stresses: bool = True,
    quadrature_degree: int | None = None,
    dx: ufl.Measure | None = None,
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
        v_t: time derivative of v at a point of the mesh, at the intermediate level; None: steady.
        f: body force per mass; None: none.
        dt: full time step, given exactly when v_t is.
        C_I: see :func:`stabilization_parameters`; None: 3 for degree 1, else 6 k^4.
        C_t: see there.
        scale_m: factor of tau_M near an immersed surface; None: no surface.
        scale_c: divisor of tau_C near an immersed surface; None: no surface.
        motion: motion of the mesh at the intermediate level; None: it is fixed.
        invariant: see :func:`element_metric`.
        v_tau: velocity in tau_M and tau_C; None: v. See :func:`frozen_tangent`.
        memory: of dynamic sub-scales, see :func:`fine_scales`; None: they are quasi-static.
        divided: whether a surface divides the cells: v' has no rate, tau_M hardly a step, no stresses; dt is given.
        stresses: whether cross and Reynolds stress are there; with a memory they make unresolved flow diverge.
        quadrature_degree: None: 2 k, and 2 more for every degree of a mesh's displacement above 1.
        dx: cells to integrate over, with their quadrature; None: all.

    Returns:
        Residual form.

    Raises:
        ValueError: a number out of range, a wrong shape, one of v_t and dt alone, or a dx of no cells of the mesh.
    """
    k = checks.whole("degree", degree, 1)
    _check_numbers(rho=rho, mu=mu, dt=dt, C_I=C_I, C_t=C_t, scale_m=scale_m, scale_c=scale_c)
    _check_fields(v, v_t, dt, domain.geometry.dim)
    f = None if f is None else checks.vector("f", f, *v.ufl_shape)
    if dx is None:
        extra = 2 * (motion.degree - 1) if motion is not None else 0
        degree_q = 2 * k + extra if quadrature_degree is None else quadrature_degree
        dx = ufl.dx(domain=domain, metadata={"quadrature_degree": degree_q})
    checks.measure("dx", dx, domain, "cell")
    v_fine, p_fine = fine_scales(
        v, p, domain, rho=rho, mu=mu, degree=k, v_t=v_t, f=f, dt=dt, C_I=C_I, C_t=C_t, scale_m=scale_m,
        scale_c=scale_c, motion=motion, invariant=invariant, v_tau=v_tau, memory=memory, divided=divided,
    )  # fmt: skip
    D = material_acceleration(v, v_t=v_t, f=f, motion=motion)
    grad_v, grad_w, div_w = gradient(v, motion), gradient(w, motion), divergence(w, motion)
    galerkin = rho * ufl.inner(D, w) + ufl.inner(stress(v, p, mu, motion), grad_w) + q * divergence(v, motion)
    upwind = ufl.inner(grad_w * advection(v, motion) + gradient(q, motion) / rho, v_fine)
    if divided or not stresses:
        return per_volume(galerkin - upwind - p_fine * div_w, motion) * dx
    cross_stress = ufl.inner(w, grad_v * v_fine)
    reynolds_stress = ufl.inner(grad_w, ufl.outer(v_fine, v_fine)) / rho
    return per_volume(galerkin - upwind - p_fine * div_w + cross_stress - reynolds_stress, motion) * dx


def default_C_I(degree: int) -> float:
    """Constant of the viscous term in tau_M for a polynomial degree: 3 for degree 1, else 6 k^4."""
    return 3.0 if degree == 1 else 6.0 * degree**4


def frozen_tangent(residual: ufl.Form, x: Any, x_tau: Any) -> ufl.Form:
    """Tangent of a residual without the derivatives of the stabilisation parameters: smaller code, faster assembly.

    Args:
        residual: residual whose stabilisation parameters contain ``x_tau`` in place of ``x``.
        x: the unknown.
        x_tau: placeholder, a Coefficient of the same space.

    Returns:
        Bilinear form in which the placeholder is ``x`` again.
    """
    return ufl.replace(ufl.derivative(residual, x), {x_tau: x})


def _check_numbers(**numbers: Any) -> None:
    may_vanish = ("mu", "C_I", "C_t", "scale_m")
    for name, value in numbers.items():
        if value is not None or name in ("rho", "mu", "C_t"):
            checks.parameter(name, value, checks.not_negative if name in may_vanish else checks.positive)


def _check_fields(v: Any, v_t: Any, dt: Any, d: int) -> None:
    shape = getattr(v, "ufl_shape", None)
    if shape != (d,):
        raise ValueError(f"v has shape {shape}: a mesh of dimension {d} requires ({d},)")
    if (v_t is None) != (dt is None):
        raise ValueError("v_t and dt belong together: both are required for unsteady flow, neither for steady flow")
