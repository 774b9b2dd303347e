"""Small coupled scenes that several tests share."""

from types import SimpleNamespace

import numpy as np
import ufl
from mpi4py import MPI
from dolfinx import fem, mesh

from coudalfish import CouDALFISh, CouplingOptions, FluidSubproblem, ShellSubproblem, SurfaceBand
from shnapr.loads import inertia
from shnapr.supports import fixed
from shnapr.svk import StVenantKirchhoff
from shnapr.work import strain_energy, virtual_work
from tigar_x import compat
from tigar_x.fem.linear import direct
from tigar_x.fem.schemes import generalized_alpha
from tigar_x.fem.time_integration import TimeIntegrator
from tigar_x.geometry import shapes
from tigar_x.geometry.gluing import glued
from tigar_x.geometry.multipatch import disjoint
from tigar_x.geometry.patch import Patch
from tigar_x.splines.quadrature import NodalQuadrature
from tigar_x.splines.spline import ExtractedSpline
from varmint.forms.boundary import weak_dirichlet
from varmint.forms.space import equal_order_space, split
from varmint.forms.vms import interior_residual


def taylor_hood_residual(v, p, w, q, domain, *, rho, mu, v_t):
    """Galerkin residual of an inf-sup stable pair, with grad-div stabilisation."""
    dx = ufl.dx(domain=domain, metadata={"quadrature_degree": 5})
    D = v_t + ufl.grad(v) * v
    sigma = 2 * mu * ufl.sym(ufl.grad(v)) - p * ufl.Identity(len(v))
    return (rho * ufl.inner(D, w) + ufl.inner(sigma, ufl.grad(w)) + (q + ufl.div(w)) * ufl.div(v)) * dx


def sheet_in_flow(
    velocity=(0.3, 0.2),
    *,
    n=6,
    dt=0.1,
    rho=1.0,
    mu=0.1,
    rho_s=1.0,
    density_of_points=16,
    ends=((0.35, 0.25), (0.45, 0.75)),
    rho_infinity=0.5,
    options=None,
    taylor_hood=False,
    moving=True,
    sheet_velocity=None,
    traction=0.0,
    solver=None,
    length=1.0,
    stiffness=10.0,
    weights=None,
    contact=None,
    held=False,
    join=False,
):
    """Free elastic sheets in a box whose walls move with a uniform velocity; lengths scale with ``length``.

    Those that are ``held`` do not move at all.
    """
    L = length
    domain = mesh.create_rectangle(MPI.COMM_WORLD, [np.zeros(2), np.full(2, L)], [n, n], mesh.CellType.triangle)
    V = compat.mixed_lagrange_space(domain, (2, 2), (1, 1)) if taylor_hood else equal_order_space(domain)
    w = fem.Function(V, name="w")
    if moving:
        for i, value in enumerate(velocity):
            w.x.array[compat.component_space(V, i)[1]] = value
    time = TimeIntegrator(w, dt, generalized_alpha(rho_infinity), algebraic=(2,))
    (v, p), (v_t, _), (z, q) = split(time.x_alpha), split(time.xdot_alpha), split(ufl.TestFunction(V))
    g = fem.Constant(domain, np.array(velocity, dtype=float))
    c_rho, c_mu = fem.Constant(domain, float(rho)), fem.Constant(domain, float(mu))
    band = None
    if taylor_hood:
        residual = taylor_hood_residual(v, p, z, q, domain, rho=c_rho, mu=c_mu, v_t=v_t)
    else:
        band = SurfaceBand(domain)
        scales = {"scale_m": band.scale_m, "scale_c": band.scale_c}
        residual = interior_residual(v, p, z, q, domain, rho=c_rho, mu=c_mu, v_t=v_t, dt=time.dt, **scales)
    ds = ufl.ds(domain=domain, metadata={"quadrature_degree": 2})
    residual += weak_dirichlet(v, p, z, q, g, domain, ds, rho=c_rho, mu=c_mu)
    pin = compat.pin_component(V, 2, lambda x: np.isclose(x[0], 0.0) & np.isclose(x[1], 0.0))
    fluid = FluidSubproblem(
        domain, residual, time, bcs=[pin], band=band, solver=solver or direct(), density=rho, viscosity=mu
    )

    sheet = free_sheet(
        velocity if sheet_velocity is None else sheet_velocity,
        ends=L * np.array(ends),
        elements=density_of_points,
        dt=dt,
        rho_infinity=rho_infinity,
        rho_s=rho_s,
        thickness=0.05 * L,
        stiffness=stiffness,
        traction=traction,
        weights=weights,
        contact=contact,
        held=held,
        join=join,
    )
    fsi = CouDALFISh(fluid, sheet.shell, CouplingOptions() if options is None else options)
    return SimpleNamespace(fsi=fsi, fluid=fluid, w=w, g=g, mu=c_mu, domain=domain, **vars(sheet))


def free_sheet(
    velocity=(0.0, 0.0),
    *,
    ends=((0.35, 0.25), (0.45, 0.75)),
    elements=16,
    dt=0.1,
    rho_infinity=0.5,
    rho_s=1.0,
    thickness=0.05,
    stiffness=10.0,
    traction=0.0,
    weights=None,
    contact=None,
    held=False,
    join=False,
):
    """Straight elastic sheets without supports, each with a uniform velocity; ``contact`` makes it of the points."""
    lines = [
        shapes.line(*pair, elements=elements, degree=1 if weights is None else 2)
        for pair in np.reshape(np.asarray(ends, dtype=float), (-1, 2, 2))
    ]
    if weights is not None:
        lines = [Patch.from_points(line.bases, line.points, weights(line.basis.n)) for line in lines]
    velocities = np.broadcast_to(np.asarray(velocity, dtype=float), (len(lines), 2))
    patch = lines[0] if len(lines) == 1 else (glued if join else disjoint)(*lines)
    spline = ExtractedSpline(patch, MPI.COMM_SELF, quadrature_degree=6, zero_dofs=fixed(patch) if held else ())
    y = spline.function(name="y")
    time = TimeIntegrator(
        y,
        dt,
        generalized_alpha(rho_infinity, 2, first_order_alpha_m=True),
        xdot=spline.function(patch.weights[:, None] * np.repeat(velocities, lines[0].basis.n, axis=0)[: patch.n]),
    )
    z = ufl.TestFunction(spline.V)
    E, h, c_rho_s = (fem.Constant(spline.mesh, float(x)) for x in (stiffness, thickness, rho_s))
    material = StVenantKirchhoff(E, 0.3, h, bending=False)
    residual = virtual_work(spline, lambda u: strain_energy(spline, material, u), time.x_alpha, z)
    residual += inertia(spline, time.xddot_alpha, z, density=c_rho_s, thickness=h)
    load = fem.Constant(spline.mesh, np.array([float(traction), 0.0]))
    residual -= ufl.inner(load, spline.rationalize(z)) * spline.dx
    touching = None if contact is None else contact(NodalQuadrature.of(spline))
    shell = ShellSubproblem(spline, residual, time, solver=direct("petsc"), contact=touching)
    return SimpleNamespace(shell=shell, y=y, load=load)
