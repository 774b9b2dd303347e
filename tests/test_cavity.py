"""Regularised lid-driven cavity (spec 6.1): steady flow against an exact solution, on sequences of meshes."""

from functools import cache

import numpy as np
import pytest
import ufl
from dolfinx import fem, mesh
from mpi4py import MPI

from tigar_x import compat
from tigar_x.solve import FiniteElementSystem, newton
from varmint.boundary import weak_dirichlet
from varmint.space import equal_order_space, split
from varmint.vms import interior_residual

REYNOLDS = 100.0

# Errors of the published code on triangles, degree-2k quadrature: shared/verification.md section 2, measured with
# legacy FEniCS 2019.2 and the VarMINT of 2022; (degree, N): (H1 seminorm, L2 norm) of the velocity.
LEGACY = {
    (1, 8): (6.64e-1, 2.33e-2),
    (1, 16): (3.21e-1, 6.20e-3),
    (1, 32): (1.59e-1, 1.56e-3),
    (2, 4): (None, None),
    (2, 8): (9.52e-2, 2.15e-3),
    (2, 16): (2.19e-2, 1.98e-4),
}


def exact(x):
    """Velocity and pressure."""
    X, Y = x[0], x[1]
    u_1 = 8 * (X**4 - 2 * X**3 + X**2) * (4 * Y**3 - 2 * Y)
    u_2 = -8 * (4 * X**3 - 6 * X**2 + 2 * X) * (Y**4 - Y**2)
    return ufl.as_vector([u_1, u_2]), ufl.sin(ufl.pi * X) * ufl.sin(ufl.pi * Y)


@cache
def errors(N, degree, cell="triangle", share=1.0, drift=(0.0, 0.0), comm=MPI.COMM_WORLD):
    """H1 seminorm and L2 norm of the velocity's error, with ``share`` of the body force, in a frame that drifts."""
    domain = mesh.create_unit_square(comm, N, N, getattr(mesh.CellType, cell))
    V = equal_order_space(domain, degree)
    state = fem.Function(V)
    (v, p), (w, q) = split(state), split(ufl.TestFunction(V))
    nu = fem.Constant(domain, 1 / REYNOLDS)
    u, pressure = exact(ufl.SpatialCoordinate(domain))
    u += fem.Constant(domain, np.array(drift))
    f = ufl.grad(u) * u + ufl.grad(pressure) - nu * ufl.div(ufl.grad(u) + ufl.grad(u).T)
    f *= fem.Constant(domain, share)
    scheme = {"quadrature_degree": 2 * degree}
    residual = interior_residual(v, p, w, q, domain, rho=1.0, mu=nu, degree=degree, f=f, C_I=6 * degree**4)
    residual += weak_dirichlet(v, p, w, q, u, domain, ufl.ds(domain=domain, metadata=scheme), rho=1.0, mu=nu)
    pin = compat.pin_component(V, 2, lambda x: np.isclose(x[0], 0) & np.isclose(x[1], 0))
    newton(FiniteElementSystem(residual, state, [pin]), rtol=1e-9)
    e, dx = v - u, ufl.dx(domain=domain, metadata=scheme)
    forms = compat.compile_forms(ufl.inner(ufl.grad(e), ufl.grad(e)) * dx, ufl.inner(e, e) * dx)
    return tuple(compat.assemble_scalar(form) ** 0.5 for form in forms)


