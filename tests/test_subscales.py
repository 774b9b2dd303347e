"""Dynamic sub-scales: flows whose stabilisation does not know the time step."""

from functools import cache

import numpy as np
import pytest
import ufl
from mpi4py import MPI
from dolfinx import fem
from load import load_demo

from tigar_x import compat
from tigar_x.fem.linear import direct
from tigar_x.fem.schemes import backward_euler, generalized_alpha
from varmint.conditions import Slip, WeakVelocity
from varmint.errors import velocity_errors
from varmint.flow import Flow, FlowOptions
from varmint.forms.motion import PrescribedMotion
from varmint.mesh import box

CAVITY = load_demo("lid_driven_cavity")
NU, DRIFT = 0.01, (1.0, 0.5)


def vortices(x, t):
    """Taylor and Green's vortices, which drift: an exact flow without force."""
    y = [x[i] - DRIFT[i] * t for i in range(2)]
    decay = ufl.exp(-2 * NU * t)
    return ufl.as_vector(
        [DRIFT[0] + decay * ufl.sin(y[0]) * ufl.cos(y[1]), DRIFT[1] - decay * ufl.cos(y[0]) * ufl.sin(y[1])]
    )


def drifting(n, dt, rho_infinity=0.5, *, moving=False, comm=MPI.COMM_WORLD, cells="triangle", degree=1, **options):
    mesh = box(comm, (-np.pi,) * 2, (np.pi,) * 2, (n, n), cells)
    clock = {"dt": dt, "scheme": generalized_alpha(rho_infinity)}
    motion = None
    if moving:
        motion = PrescribedMotion(mesh, lambda y, t: 0.1 * ufl.sin(6 * t) * ufl.as_vector([ufl.sin(y[1]), 0]), **clock)
    chosen = FlowOptions(**({"subscales": "dynamic", "rtol": 1e-11, "solver": direct()} | options))
    walls = [WeakVelocity(mesh.facet_names, vortices)]
    flow = Flow(mesh, walls, rho=1.0, mu=NU, degree=degree, **clock, moving=motion, options=chosen)
    flow.start(vortices, projected=True)
    return flow


def marched(n, steps, end=1.0, **options):
    flow = drifting(n, end / steps, **options)
    for _ in range(steps):
        flow.take_step()
    return flow


def error(n, steps, **options):
    return velocity_errors(marched(n, steps, **options), vortices, 6)["L2_u"]


@pytest.mark.parametrize("dt", [1.0, 1e-4])
def test_steady_flow_does_not_know_the_step(dt):
    """Steps from the steady flow and its sub-scales stay there; quasi-static ones leave it."""
    steady = CAVITY.build(8, solver=direct(), rtol=1e-13, subscales="dynamic")
    steady.solve()
    walls = [WeakVelocity(steady.mesh.facet_names, lambda x, t: CAVITY.exact(x)[0])]
    changes = {}
    for subscales in ("dynamic", "quasi-static"):
        chosen = FlowOptions(C_I=6.0, pin_at=(0.0, 0.0), subscales=subscales, solver=direct(), rtol=1e-13)
        known = {"f": lambda x, t: CAVITY.force(x, 0.01), "dt": 1e12, "scheme": backward_euler()}
        flow = Flow(steady.mesh, walls, rho=1.0, mu=0.01, **known, options=chosen)
        flow.w.x.array[:] = steady.w.x.array
        flow.time.forget()
        flow.time.predict()
        flow.time.advance()  # within an endless step the sub-scales become those of steady flow
        flow.time.resume(0.0, dt)
        for _ in range(3):
            flow.take_step()
        changes[subscales] = np.abs(flow.w.x.array - steady.w.x.array).max() / np.abs(steady.w.x.array).max()
    assert changes["dynamic"] < 1e-8
    assert changes["quasi-static"] > 1e-5


def test_small_steps_do_not_cost_accuracy():
    few, many = error(12, 12), error(12, 240)
    assert many < 1.05 * few
    assert error(12, 240, subscales="quasi-static") > 5.0 * many


def test_rate_in_space():
    assert np.log2(error(8, 32) / error(16, 32)) > 1.7


@cache
def smooth_start():
    flow = drifting(8, 0.01, 0.0)
    for _ in range(40):
        flow.take_step()
    return flow.time.time, {name: f.x.array.copy() for name, f in flow.time.state.items()}


@pytest.mark.parametrize("rho_infinity", [0.0, 0.5, 1.0])
def test_order_two_in_time(rho_infinity):
    def end(steps):
        flow = drifting(8, 1.0 / steps, rho_infinity)
        t, state = smooth_start()
        for name, f in flow.time.state.items():
            f.x.array[:] = state[name]
        flow.time.resume(t, 1.0 / steps)
        for _ in range(steps):
            flow.take_step()
        return flow.w.x.array.reshape(-1, 3)[:, :2].copy()

    finest = end(128)
    errors = [np.sqrt(((end(n) - finest) ** 2).mean()) for n in (16, 32)]
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2.0, abs=0.15)


def test_rate_of_the_subscales():
    """What a step leaves satisfies ``dv'/dt + v'/tau = -r``: with backward Euler, of constants known by hand."""
    mesh = box(MPI.COMM_SELF, (0, 0), (1, 1), (2, 2))
    chosen = FlowOptions(subscales="dynamic", C_I=3.0)
    force = {"f": (2.0, 0.0), "scheme": backward_euler(), "dt": 0.1}
    flow = Flow(mesh, [Slip(mesh.facet_names)], rho=3.0, mu=0.2, **force, options=chosen)
    G = np.array([[2.0, -1.0], [-1.0, 1.0]]) * 16.0  # of one of the two kinds of triangles, up to a turn
    tau = 1.0 / np.sqrt(3.0 * (0.2 / 3.0) ** 2 * (G * G).sum())
    fine = 0.0
    for n in range(3):
        flow.w.x.array[:] = 0.0
        flow.time.predict()
        flow.time.advance()  # a state at rest that does not balance the force: the residual is -rho f
        fine = (fine / 0.1 + 6.0) / (1.0 / 0.1 + 1.0 / tau)
        values = flow.time.fine.x.array.reshape(-1, 2)
        np.testing.assert_allclose(values, np.tile([fine, 0.0], (len(values), 1)), rtol=1e-6, atol=1e-14)
        assert flow.time.time == pytest.approx(0.1 * (n + 1))


def test_a_failed_step_leaves_the_subscales():
    flow = marched(8, 4, end=0.4)
    before = {name: f.x.array.copy() for name, f in flow.time.state.items()}
    assert np.abs(before["subscale"]).max() > 0.0
    with pytest.raises(RuntimeError, match="measured"):
        flow.take_step(lambda: (_ for _ in ()).throw(RuntimeError("measured")))
    for name, f in flow.time.state.items():
        np.testing.assert_array_equal(f.x.array, before[name])


def test_a_new_start_forgets():
    flow = marched(8, 2, end=0.2)
    flow.start(vortices)
    assert not flow.time.fine.x.array.any()
    assert not flow.time.fine_rate.x.array.any()


@pytest.mark.mpi
def test_restart_goes_on(tmp_path):
    folder = MPI.COMM_WORLD.bcast(str(tmp_path))
    whole = drifting(8, 0.1)
    for _ in range(4):
        whole.take_step()
    first = drifting(8, 0.1)
    run = first.run(steps=2, out=folder, checkpoint_every=1, show=False)
    run.through()
    second = drifting(8, 0.1)
    second.run(steps=4, out=folder, checkpoint_every=1, restart="latest", show=False).through()
    assert second.time.time == pytest.approx(0.4)
    np.testing.assert_allclose(second.w.x.array, whole.w.x.array, atol=1e-10)


@pytest.mark.mpi
@pytest.mark.skipif(MPI.COMM_WORLD.size == 1, reason="compares with a run of one rank alone")
def test_any_number_of_ranks():
    together, alone = error(8, 8), error(8, 8, comm=MPI.COMM_SELF)
    assert together == pytest.approx(alone, rel=1e-8)


@pytest.mark.parametrize("options", [{"moving": True}, {"cells": "quadrilateral"}])
def test_moving_meshes_and_quadrilaterals(options):
    few, many = error(8, 8, **options), error(8, 64, **options)
    assert many < 1.15 * few


def test_unresolved_flow_survives():
    """Re = 1e4 in 16 cells, from rest, as quasi-static sub-scales do."""
    nu = 1e-4
    mesh = box(MPI.COMM_SELF, (0, 0), (1, 1), (16, 16))
    walls = [WeakVelocity(mesh.facet_names, lambda x, t: CAVITY.exact(x)[0])]
    options = FlowOptions(pin_at=(0.0, 0.0), subscales="dynamic")
    flow = Flow(mesh, walls, rho=1.0, mu=nu, f=lambda x, t: CAVITY.force(x, nu), dt=1 / 16, options=options)
    for _ in range(40):
        flow.take_step()
    assert np.abs(flow.w.x.array).max() < 3.0


def test_quasi_static_flows_have_nothing_of_it():
    flow = drifting(4, 0.1, subscales="quasi-static")
    assert flow.time.memory is None
    assert set(flow.time.state) == {"x", "xdot"}
    names = {c.name for c in flow.residual.coefficients() if isinstance(c, fem.Function)}
    assert names == {"w", "w_old", "w_dot_old"}


def test_a_time_step_in_tau_is_refused():
    with pytest.raises(ValueError, match=r"^tau_dt = 0\.1: dynamic sub-scales have no time step"):
        FlowOptions(subscales="dynamic", tau_dt=0.1)
    with pytest.raises(ValueError, match=r"^subscales = 'static'"):
        FlowOptions(subscales="static")


def test_values_at_points():
    """A linear vector at the points of a quadrature integrates as it does itself."""
    mesh = box(MPI.COMM_SELF, (0, 0), (2, 1), (3, 2))
    field = compat.PointField(mesh.domain, 2, 2)
    x = ufl.SpatialCoordinate(mesh.domain)
    values = compat.VectorAtPoints(ufl.as_vector([x[0], 2 * x[1]]), field.points, mesh.domain)
    field.assign(values(np.arange(12, dtype=np.int32)))
    dx = mesh.dx(degree=2)
    found = [compat.assemble_scalar(f) for f in compat.compile_forms(*(x[0] * field.function[i] * dx for i in (0, 1)))]
    np.testing.assert_allclose(found, [8 / 3, 2.0], rtol=1e-12)
