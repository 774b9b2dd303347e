"""Taylor-Green vortex at Re = 100: unsteady flow against an exact solution, on fixed and moving meshes.

The benchmark of D. Kamensky, doi:10.1016/j.camwa.2020.01.023, figure 3, and the order of the time integration.
"""

from functools import cache

import numpy as np
import pytest
from mpi4py import MPI
from load import load_demo

from tigar_x.fem.linear import direct
from tigar_x.fem.schemes import generalized_alpha
from varmint.conditions import Slip
from varmint.flow import Flow, FlowOptions
from varmint.mesh import box

DEMO = load_demo("taylor_green")

# Errors of the published code (legacy FEniCS 2019.2 with VarMINT of 2022), measured with quadrature of degree 2k;
# (degree, N): (H1 seminorm, L2 norm) of the velocity at the end.
LEGACY = {
    (1, 8): (2.81, 9.18e-1),
    (1, 16): (1.32, 1.64e-1),
    (1, 32): (6.23e-1, 2.65e-2),
    (2, 8): (8.53e-1, 9.72e-2),
    (2, 16): (1.83e-1, 9.30e-3),
}


@cache
def errors(N, degree=1, dim=2, moving=False, viscosity_factor=1.0, alone=False):
    """H1 seminorm and L2 norm of the velocity's error after N steps, for a fluid of a multiple of the viscosity."""
    flow = DEMO.Vortex(dim, degree, moving).build(N, comm=MPI.COMM_SELF if alone else MPI.COMM_WORLD)
    flow.mu.value *= viscosity_factor
    flow.run(until=DEMO.END, show=False).through()
    assert flow.time.time == pytest.approx(DEMO.END)
    found = DEMO.errors(flow)
    return found["H1_u"], found["L2_u"]


def rates(sequence, *args, **options):
    """Errors on a sequence of meshes, shape (meshes, 2), and the rates of the finest pair, each halving the size."""
    table = np.array([errors(N, *args, **options) for N in sequence])
    return table, np.log2(table[-2] / table[-1])


@pytest.mark.mpi
@pytest.mark.parametrize(("degree", "N"), LEGACY)
def test_errors_of_the_published_code(degree, N):
    np.testing.assert_allclose(errors(N, degree), LEGACY[degree, N], rtol=0.01)


@pytest.mark.parametrize("moving", [False, True])
@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize(("degree", "sequence"), [(1, (16, 32)), (2, (8, 16))])
def test_rates(degree, sequence, dim, moving):
    """H1 of order k, and more than that in L2, on fixed and moving meshes, in the plane and extruded."""
    table, (rate_H1, rate_L2) = rates(sequence, degree, dim, moving)
    assert rate_H1 >= degree
    assert rate_L2 >= degree + 1
    assert (table[-1] < 1.2 * np.array(LEGACY[degree, sequence[-1]])).all()


def test_a_wrong_viscosity_does_not_converge():
    """A fluid five times as viscous decays to another vortex."""
    table, (rate_H1, rate_L2) = rates((16, 32), viscosity_factor=5.0)
    assert rate_H1 < 0.9
    assert rate_L2 < 1
    assert table[-1, 1] > 5 * LEGACY[1, 32][1]


@pytest.mark.mpi
@pytest.mark.skipif(MPI.COMM_WORLD.size == 1, reason="compares with a run of one rank alone")
@pytest.mark.parametrize("moving", [False, True])
def test_any_number_of_ranks(moving):
    """Every rank alone finds what all find together, to the tolerance of the steps."""
    np.testing.assert_allclose(errors(8, moving=moving), errors(8, moving=moving, alone=True), rtol=1e-5)


def vortex(dt, rho_infinity):
    """A vortex at rest whose stabilisation keeps its time step."""
    mesh = box(MPI.COMM_SELF, (-np.pi, -np.pi), (np.pi, np.pi), (8, 8))
    return Flow(
        mesh,
        [Slip(mesh.facet_names)],
        rho=1.0,
        mu=1.0 / DEMO.REYNOLDS,
        dt=dt,
        scheme=generalized_alpha(rho_infinity),
        options=FlowOptions(tau_dt=0.1, rtol=1e-11, solver=direct()),
    )


@cache
def smooth_start():
    """State and rate after a while of strongly damped small steps: what belongs together at the start of others."""
    flow = vortex(0.01, 0.0)
    flow.start(lambda x, t: DEMO.velocity(x, t - 0.5), projected=True)
    for _ in range(50):
        flow.take_step()
    return flow.w.x.array.copy(), flow.time.xdot_old.x.array.copy()


def end(steps, rho_infinity, consistent):
    flow = vortex(DEMO.END / steps, rho_infinity)
    state, rate = smooth_start()
    for f in (flow.w, flow.time.x_old):
        f.x.array[:] = state
    if consistent:
        flow.time.xdot_old.x.array[:] = rate
    for _ in range(steps):
        flow.take_step()
    return flow.w.x.array.reshape(-1, 3)[:, :2].copy()


def orders(rho_infinity, consistent=True):
    finest = end(128, rho_infinity, consistent)
    errors = [np.sqrt(((end(n, rho_infinity, consistent) - finest) ** 2).mean()) for n in (8, 16, 32)]
    return np.log2(np.array(errors[:-1]) / errors[1:])


@pytest.mark.parametrize("rho_infinity", [0.0, 0.5, 1.0])
def test_order_two_in_time(rho_infinity):
    """Against the finest step, with the stabilisation's time step kept and a rate that belongs to the state."""
    np.testing.assert_allclose(orders(rho_infinity), 2.0, atol=0.12)


@pytest.mark.parametrize("rho_infinity", [0.0, 0.5])
def test_a_zero_rate_at_the_start_costs_an_order(rho_infinity):
    assert (orders(rho_infinity, consistent=False) < 1.5).all()
