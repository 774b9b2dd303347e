"""Plane scenes that ``stability.py`` makes stiff and extreme: a sheet across a duct, and one in a closed box."""

import math
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import ufl
from mpi4py import MPI
from dolfinx import fem, mesh

from coudalfish import (
    CouDALFISh,
    CouplingOptions,
    FluidSubproblem,
    ShellSubproblem,
    SurfaceBand,
)
from shnapr.loads import inertia
from shnapr.svk import StVenantKirchhoff
from shnapr.work import strain_energy, virtual_work
from tigar_x import compat
from tigar_x.fem.linear import direct
from tigar_x.fem.schemes import Scheme, backward_euler, generalized_alpha
from tigar_x.fem.time_integration import TimeIntegrator
from tigar_x.geometry import shapes
from tigar_x.geometry.patch import Patch
from tigar_x.splines.spline import ExtractedSpline
from varmint.forms.boundary import stable_neumann, weak_dirichlet
from varmint.forms.space import equal_order_space, split
from varmint.forms.vms import interior_residual
from varmint.mesh import named


def schemes(rho_infinity: float | None) -> tuple[Scheme, Scheme]:
    """Schemes of the flow and of the sheet; None: backward Euler."""
    if rho_infinity is None:
        return backward_euler(1), backward_euler(2)
    return generalized_alpha(rho_infinity), generalized_alpha(rho_infinity, 2, first_order_alpha_m=True)


def flow(
    domain: mesh.Mesh,
    dt: float,
    rho_infinity: float | None,
    boundary: Callable[..., ufl.Form],
    pins: Callable[[Any], list[Any]],
    *,
    rho: float,
    mu: float,
    grad_div: float | None = None,
    velocity: tuple[float, float] = (0.0, 0.0),
) -> FluidSubproblem:
    """A plane flow that starts with a uniform velocity.

    Args:
        boundary: the boundary's part of the residual, from v, p, their test functions, rho and mu.
        pins: strong conditions, from the space.
        grad_div: coefficient of the grad-div stabilisation of Taylor-Hood elements; None: equal orders with VMS.
    """
    V = equal_order_space(domain) if grad_div is None else compat.mixed_lagrange_space(domain, (2, 2), (1, 1))
    w = fem.Function(V, name="w")
    for i, value in enumerate(velocity):
        w.x.array[compat.component_space(V, i)[1]] = value
    time = TimeIntegrator(w, dt, schemes(rho_infinity)[0], algebraic=(2,))
    (v, p), (v_t, _), (z, q) = split(time.x_alpha), split(time.xdot_alpha), split(ufl.TestFunction(V))
    c_rho, c_mu = (fem.Constant(domain, float(value)) for value in (rho, mu))
    band = SurfaceBand(domain) if grad_div is None else None
    if band is None:
        dx, gamma = (
            ufl.dx(domain=domain, metadata={"quadrature_degree": 5}),
            fem.Constant(domain, float(grad_div or 0.0)),
        )
        sigma = 2 * c_mu * ufl.sym(ufl.grad(v)) - p * ufl.Identity(2)
        residual = c_rho * ufl.inner(v_t + ufl.grad(v) * v, z) + ufl.inner(sigma, ufl.grad(z))
        residual = (residual + (q + gamma * ufl.div(z)) * ufl.div(v)) * dx
    else:
        scales = {"scale_m": band.scale_m, "scale_c": band.scale_c}
        residual = interior_residual(v, p, z, q, domain, rho=c_rho, mu=c_mu, v_t=v_t, dt=time.dt, **scales)
    residual += boundary(v, p, z, q, c_rho, c_mu)
    return FluidSubproblem(domain, residual, time, bcs=pins(V), band=band, solver=direct(), density=rho, viscosity=mu)


def sheet(
    patch: Patch,
    dt: float,
    rho_infinity: float | None,
    fixed: Any,
    *,
    E: float = 10.0,
    thickness: float = 0.05,
    rho_s: float = 1.0,
    prestress: float = 0.0,
    displacement: Any = None,
    velocity: Any = None,
) -> SimpleNamespace:
    """A St. Venant-Kirchhoff sheet, without bending where its splines are linear.

    Args:
        fixed: spline coefficients that do not move.
        displacement: initial displacement of the control points.
        velocity: their initial velocity.
    """
    spline = ExtractedSpline(patch, MPI.COMM_SELF, quadrature_degree=4, zero_dofs=fixed)
    y, z = spline.function(displacement, name="y"), ufl.TestFunction(spline.V)
    time = TimeIntegrator(y, dt, schemes(rho_infinity)[1], xdot=spline.function(velocity))
    numbers = (E, thickness, rho_s, prestress)
    c_E, h, c_rho, N = (fem.Constant(spline.mesh, float(value)) for value in numbers)
    material = StVenantKirchhoff(c_E, 0.3, h, prestress=(N,), bending=patch.bases[0].degree > 1)
    residual = virtual_work(spline, lambda y: strain_energy(spline, material, y), time.x_alpha, z)
    residual += inertia(spline, time.xddot_alpha, z, density=c_rho, thickness=h)
    energy = strain_energy(spline, material, time.x_old)
    energy += c_rho * h / 2 * ufl.inner(time.xdot_old, time.xdot_old) * spline.dx
    return SimpleNamespace(problem=ShellSubproblem(spline, residual, time, solver=direct("petsc")), energy=energy)


def duct(
    options: CouplingOptions | None = None,
    *,
    n: int = 12,
    dt: float = 0.01,
    rho: float = 1.0,
    mu: float = 0.01,
    rho_infinity: float | None = 0.0,
    jump: float = 1.0,
    place: float = 1.0,
    bow: float = 0.0,
    elements: int | None = None,
    degree: int = 1,
    flexible: bool = False,
    slip: bool = True,
    grad_div: float | None = None,
    **material: float,
) -> SimpleNamespace:
    """Duct (0, 2) x (0, 1) with walls, loaded by a traction at its inflow, with a sheet across its middle.

    Args:
        n: fluid cells across.
        place: where the sheet stands; 1 is a line of the mesh.
        bow: height of its arc.
        elements: of the sheet; None: points half a fluid cell apart.
        flexible: whether only the ends of the sheet are fixed, or all of it.
        slip: whether the fluid slips along the walls.
    """
    domain = mesh.create_rectangle(MPI.COMM_WORLD, [[0.0, 0.0], [2.0, 1.0]], [2 * n, n], mesh.CellType.triangle)
    load = fem.Constant(domain, np.array([float(jump), 0.0]))
    ends = named(domain, inlet=lambda x: np.isclose(x[0], 0.0), outlet=lambda x: np.isclose(x[0], 2.0))
    inlet, outlet = ends.ds("inlet", degree=2), ends.ds("outlet", degree=2)

    def boundary(v: Any, p: Any, z: Any, q: Any, rho: Any, mu: Any) -> ufl.Form:
        loaded = stable_neumann(v, z, domain, inlet, rho=rho, traction=load)
        return loaded + stable_neumann(v, z, domain, outlet, rho=rho)

    def pins(V: Any) -> list[Any]:
        def walls(x: Any) -> Any:
            return np.isclose(x[1], 0.0) | np.isclose(x[1], 1.0)

        return [compat.pin_component(V, i, walls) for i in ((1,) if slip else (0, 1))]

    fluid = flow(domain, dt, rho_infinity, boundary, pins, rho=rho, mu=mu, grad_div=grad_div)
    line = shapes.line((place, 0.0), (place, 1.0), elements=elements or 2 * n // degree, degree=degree)
    s = line.points[:, 1]
    arc = line.points + np.outer(4.0 * bow * s * (1.0 - s), (1.0, 0.0))
    patch = Patch.from_points(line.bases, arc)
    clamped = np.concatenate([patch.side_dofs(side) for side in ("u0", "u1")])
    shell = sheet(patch, dt, rho_infinity, clamped if flexible else np.arange(2 * len(arc)), **material)
    fsi = CouDALFISh(fluid, shell.problem, options)
    v = split(fluid.timeInt.x)[0]
    return SimpleNamespace(
        fsi=fsi,
        load=load,
        outflow=v[0] * outlet,
        length=shell.problem.quadrature.weights.sum(),
    )


def box(
    options: CouplingOptions | None = None,
    *,
    n: int = 8,
    dt: float = 0.02,
    rho: float = 1.0,
    mu: float = 0.01,
    rho_infinity: float | None = None,
    velocity: tuple[float, float] = (0.0, 0.0),
    free: bool = False,
    amplitude: float = 0.1,
    angle: float = 0.0,
    shift: tuple[float, float] = (0.0, 0.0),
    **material: float,
) -> SimpleNamespace:
    """Closed unit box with a membrane between two walls, released from a wave, or with a free sheet in a uniform flow.

    Args:
        velocity: of the walls and of everything at the start.
        free: whether the sheet is free and straight.
        amplitude: of the wave, which leaves the volumes on both sides alone.
        angle: of the scene in space.
        shift: of the scene in space, after the rotation.
    """
    domain = mesh.create_rectangle(MPI.COMM_WORLD, [[0.0, 0.0], [1.0, 1.0]], [n, n], mesh.CellType.triangle)
    Q = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    domain.geometry.x[:, :2] = domain.geometry.x[:, :2] @ Q.T + shift
    g = fem.Constant(domain, Q @ velocity)

    def boundary(v: Any, p: Any, z: Any, q: Any, rho: Any, mu: Any) -> ufl.Form:
        walls = ufl.ds(domain=domain, metadata={"quadrature_degree": 2})
        return weak_dirichlet(v, p, z, q, g, domain, walls, rho=rho, mu=mu)

    def pins(V: Any) -> list[Any]:
        return [compat.pin_component(V, 2, lambda x: np.hypot(x[0] - shift[0], x[1] - shift[1]) < 0.1 / n)]

    fluid = flow(domain, dt, rho_infinity, boundary, pins, rho=rho, mu=mu, velocity=tuple(Q @ velocity))
    straight = shapes.line(*([(0.35, 0.25), (0.45, 0.75)] if free else [(0.47, 0.0), (0.47, 1.0)]), elements=2 * n)
    patch = Patch.from_points(straight.bases, straight.points @ Q.T + shift)
    s = straight.points[:, 1]
    wave = np.outer(0.0 * s if free else amplitude * np.sin(2.0 * np.pi * s), Q[:, 0])
    clamped = [] if free else np.concatenate([patch.side_dofs(side) for side in ("u0", "u1")])
    shell = sheet(
        patch, dt, rho_infinity, clamped, displacement=wave, velocity=np.tile(Q @ velocity, (len(s), 1)), **material
    )
    fsi = CouDALFISh(fluid, shell.problem, options)
    u = split(fluid.timeInt.x_old)[0]
    kinetic = rho / 2 * ufl.inner(u, u) * ufl.dx(domain=domain)
    return SimpleNamespace(fsi=fsi, rotation=Q, start=wave, energies=(kinetic, shell.energy))
