"""Taylor-Green vortex at Re = 100: unsteady flow against an exact solution, with the step size tied to the mesh.

The benchmark of D. Kamensky, doi:10.1016/j.camwa.2020.01.023, figure 3.
"""

from functools import cache

import numpy as np
import pytest
import ufl
from mpi4py import MPI
from dolfinx import fem, mesh

from tigar_x import compat
from tigar_x.solve import FiniteElementSystem, newton
from tigar_x.time_integration import TimeIntegrator, generalized_alpha
from varmint.space import equal_order_space, split
from varmint.vms import interior_residual

REYNOLDS, END = 100.0, 1.0

# Errors of the published code (legacy FEniCS 2019.2 with VarMINT of 2022), measured with quadrature of degree 2k;
# (degree, N): (H1 seminorm, L2 norm) of the velocity at the end.
LEGACY = {
    (1, 8): (2.81, 9.18e-1),
    (1, 16): (1.32, 1.64e-1),
    (1, 32): (6.23e-1, 2.65e-2),
    (2, 8): (8.53e-1, 9.72e-2),
    (2, 16): (1.83e-1, 9.30e-3),
}
SEQUENCES = {1: (8, 16, 32), 2: (8, 16)}


def exact(x, t, nu):
    """Velocity; its pressure (cos 2x + cos 2y)/4 exp(-4 nu t) needs no force."""
    return ufl.exp(-2 * nu * t) * ufl.as_vector([ufl.sin(x[0]) * ufl.cos(x[1]), -ufl.cos(x[0]) * ufl.sin(x[1])])


def project(function, expression):
    """L2 projection. The published errors start from it; nodal interpolation nearly doubles the L2 errors."""
    dx = ufl.dx(metadata={"quadrature_degree": 6})
    newton(
        FiniteElementSystem(ufl.inner(function - expression, ufl.TestFunction(function.function_space)) * dx, function)
    )


@cache
def errors(N, degree=1, viscosity_factor=1.0, alone=False):
    """H1 seminorm and L2 norm of the velocity's error after N steps, for a fluid of a multiple of the viscosity."""
    comm = MPI.COMM_SELF if alone else MPI.COMM_WORLD
    domain = mesh.create_rectangle(comm, [np.full(2, -np.pi), np.full(2, np.pi)], [N, N], mesh.CellType.triangle)
    x, nu = ufl.SpatialCoordinate(domain), fem.Constant(domain, 1 / REYNOLDS)
    V = equal_order_space(domain, degree)
    state = fem.Function(V)
    project(state, ufl.as_vector([*exact(x, 0.0, nu), 0.0]))
    time = TimeIntegrator(state, END / N, generalized_alpha(1.0), algebraic=(2,))  # implicit midpoint rule
    (v, p), (v_t, _), (w, q) = split(time.x_alpha), split(time.xdot_alpha), split(ufl.TestFunction(V))
    flow = dict(rho=1.0, mu=fem.Constant(domain, viscosity_factor / REYNOLDS), degree=degree, C_I=6 * degree**4)
    residual = interior_residual(v, p, w, q, domain, v_t=v_t, dt=time.dt, **flow)
    bcs = [compat.pin_component(V, i, lambda x, i=i: np.isclose(np.abs(x[i]), np.pi)) for i in (0, 1)]
    bcs.append(compat.pin_component(V, 2, lambda x: np.isclose(x[0], -np.pi) & np.isclose(x[1], -np.pi)))
    system = FiniteElementSystem(residual, state, bcs)
    for _ in range(N):
        time.predict()
        system.apply_boundary_values()
        newton(system, rtol=1e-6)
        time.advance()
    assert time.time == pytest.approx(END)
    e = split(state)[0] - exact(x, fem.Constant(domain, END), nu)
    dx = ufl.dx(domain=domain, metadata={"quadrature_degree": 2 * degree})
    forms = compat.compile_forms(ufl.inner(ufl.grad(e), ufl.grad(e)) * dx, ufl.inner(e, e) * dx)
    return tuple(compat.assemble_scalar(form) ** 0.5 for form in forms)


def rates(sequence, *args):
    """Errors on a sequence of meshes, shape (meshes, 2), and the rates of the finest pair, each halving the size."""
    table = np.array([errors(N, *args) for N in sequence])
    return table, np.log2(table[-2] / table[-1])


@pytest.mark.mpi
@pytest.mark.parametrize("degree", [1, 2])
def test_errors_and_rates(degree):
    """H1 of order k; in L2 1.6 more than that at these sizes for degree 1, 3.4 for degree 2."""
    table, (rate_H1, rate_L2) = rates(SEQUENCES[degree], degree)
    assert rate_H1 >= degree
    assert rate_L2 >= degree + 1
    np.testing.assert_allclose(table, [LEGACY[degree, N] for N in SEQUENCES[degree]], rtol=0.01)


def test_a_wrong_viscosity_does_not_converge():
    """A fluid five times as viscous decays to another vortex."""
    table, (rate_H1, rate_L2) = rates(SEQUENCES[1], 1, 5.0)
    assert rate_H1 < 0.9
    assert rate_L2 < 1
    assert table[-1, 1] > 5 * LEGACY[1, 32][1]


@pytest.mark.mpi
@pytest.mark.skipif(MPI.COMM_WORLD.size == 1, reason="compares with a run of one rank alone")
def test_any_number_of_ranks():
    """Every rank alone finds what all find together."""
    np.testing.assert_allclose(errors(8), errors(8, alone=True), rtol=1e-8)
