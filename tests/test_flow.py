"""A flow as one object: exact flows, outlets, closed flows, moving meshes, and steps that fail."""

from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np
import pytest
import ufl
from mpi4py import MPI
from dolfinx import fem
from flows import randomise, slope_error

from coudalfish.sides.fluid import FluidSubproblem
from tigar_x import compat
from tigar_x.fem.linear import SolveError, direct, gmres_ilu
from tigar_x.fem.schemes import backward_euler, generalized_alpha
from tigar_x.fem.solve import newton
from varmint.conditions import Resistance, Slip, Traction, Velocity, WeakVelocity
from varmint.flow import Flow, FlowError, FlowOptions
from varmint.flow.pressure import pressure_pin
from varmint.forms import ale
from varmint.forms.motion import ElasticMotion, MeshInversionError, PrescribedMotion
from varmint.forms.solids import Solid, StVenantKirchhoffSolid
from varmint.mesh import box, named
from varmint.quantities import Measured, flow_rate, volume

COMM = MPI.COMM_WORLD
SIDES = ("left", "right", "bottom", "top")
AT_CORNER = FlowOptions(pin_at=(0.0, 0.0))
EULER, ALPHA = backward_euler(), generalized_alpha(0.5)
SCHEMES = pytest.mark.parametrize("scheme", [EULER, ALPHA], ids=["euler", "alpha"])


def square(n=4, cell=None):
    return box(COMM, (0.0, 0.0), (1.0, 1.0), (n, n), cell)


def channel(cell=None):
    return box(COMM, (0.0, 0.0), (2.0, 1.0), (6, 4), cell)


def nodal_error(flow, velocity, pressure=None, *, end=True):
    """Largest nodal difference of the present velocity (and pressure) from UFL functions of present coordinates."""
    x = ale.position(flow.mesh.domain, flow.fields.motion_end)
    exact = fem.Function(flow.V)
    compat.interpolate(exact, ufl.as_vector([*velocity(x), 0.0 if pressure is None else pressure(x)]))
    size = exact.ufl_shape[0]
    error = np.abs(exact.x.array - flow.w.x.array).reshape(-1, size)[:, : size - (pressure is None)]
    return COMM.allreduce(error.max(initial=0.0), op=MPI.MAX)


def states(flow):
    """Copies of everything that a step may change."""
    kept = [flow.w, flow.time.x_old, flow.time.xdot_old]
    if flow.moving is not None:
        kept += [flow.moving.time.x, *(getattr(flow.moving.time, f"{name}_old") for name in ("x", "xdot", "xddot"))]
    clocks = [
        c.value.copy() for time in (flow.time, flow.moving and flow.moving.time) if time for c in (time.t, time.dt)
    ]
    return [f.x.array.copy() for f in kept] + clocks


def same(a, b):
    return all(np.array_equal(x, y) for x, y in zip(a, b, strict=True))


# -- exact flows ------------------------------------------------------------------------------------------------------

MU = 0.5


def parabola(x, t=None):
    return ufl.as_vector([x[1] * (1 - x[1]), 0 * x[0]])


def shear(x, t=None):
    return ufl.as_vector([x[1], 0 * x[0]])


def poiseuille(degree=2, mesh=None, weak=False, mu=MU, **options):
    """The traction at the outlet is that of the parabola at pressure zero."""
    wall = WeakVelocity if weak else Velocity
    return Flow(
        channel() if mesh is None else mesh,
        [
            wall(("bottom", "top")),
            Velocity("left", parabola),
            Traction("right", lambda x, t: ufl.as_vector([0 * x[0], mu * (1 - 2 * x[1])])),
        ],
        rho=1.3,
        mu=mu,
        degree=degree,
        **options,
    )


@pytest.mark.mpi
@pytest.mark.parametrize(("cell", "weak"), [(None, False), (None, True), ("quadrilateral", False)])
def test_poiseuille_flow_is_exact_for_degree_two(cell, weak):
    flow = poiseuille(mesh=channel(cell), weak=weak)
    report = flow.solve()
    assert nodal_error(flow, parabola, lambda x: 2 * MU * (2 - x[0])) < 1e-9
    assert report.t == 0.0
    assert report.iterations <= 5
    assert report.residuals[-1] <= 1e-9 * report.residuals[0]


@pytest.mark.mpi
def test_poiseuille_flow_is_not_exact_for_degree_one():
    flow = poiseuille(degree=1)
    flow.solve()
    assert 1e-4 < nodal_error(flow, parabola) < 0.1


@pytest.mark.mpi
@SCHEMES
def test_steps_lead_to_poiseuille_flow(scheme):
    flow = poiseuille(dt=1.0, scheme=scheme, options=FlowOptions(rtol=1e-10))
    for _ in range(20):
        flow.take_step()
    assert nodal_error(flow, parabola, lambda x: 2 * MU * (2 - x[0])) < 1e-6


@pytest.mark.mpi
@pytest.mark.parametrize("options", [dict(), dict(dt=1.0)], ids=["steady", "step"])
def test_an_exact_flow_is_a_good_start(options):
    """Rounding is all that its residual is, and nothing can be made better."""
    flow = poiseuille(**options)
    flow.start(parabola, lambda x, t: 2 * MU * (2 - x[0]))
    report = flow.solve() if flow.time is None else flow.take_step()
    assert nodal_error(flow, parabola, lambda x: 2 * MU * (2 - x[0])) < 1e-9
    assert report.iterations <= 1


@pytest.mark.mpi
def test_an_outlet_whose_tangential_velocity_alone_is_given():
    """Its normal component is free, and what is not prescribed there determines the pressure."""
    outlet = Velocity("right", (0.0, 0.0), (1,))
    flow = Flow(channel(), [Velocity(("bottom", "top")), Velocity("left", parabola), outlet], rho=1.3, mu=MU, degree=2)
    assert not flow.is_closed
    flow.solve()
    assert nodal_error(flow, parabola, lambda x: 2 * MU * (2 - x[0])) < 1e-9


def couette(mesh, **options):
    sheared = Traction("right", lambda x, t: ufl.as_vector([0 * x[0], MU + 0 * x[0]]))
    return Flow(mesh, [Velocity(("left", "bottom", "top"), shear), sheared], rho=1.3, mu=MU, **options)


@pytest.mark.mpi
@pytest.mark.parametrize("cell", [None, "quadrilateral"])
def test_couette_flow_is_exact(cell):
    flow = couette(square(cell=cell))
    flow.solve()
    assert nodal_error(flow, shear, lambda x: 0 * x[0]) < 1e-10


@pytest.mark.mpi
def test_couette_flow_in_space():
    """Slip on the sides of the depth."""
    mesh = box(COMM, (0.0, 0.0, 0.0), (1.0, 1.0, 0.5), (2, 2, 1))

    def velocity(x, t=None):
        return ufl.as_vector([x[1], 0 * x[0], 0 * x[0]])

    sheared = Traction("right", lambda x, t: ufl.as_vector([0 * x[0], MU + 0 * x[0], 0 * x[0]]))
    conditions = [Slip(("back", "front")), Velocity(("left", "bottom", "top"), velocity), sheared]
    flow = Flow(mesh, conditions, rho=1.3, mu=MU)
    flow.solve()
    assert nodal_error(flow, velocity, lambda x: 0 * x[0]) < 1e-10


@pytest.mark.mpi
def test_a_body_force_is_balanced_by_the_pressure():
    """A fluid at rest in a closed box under gravity: p = rho g . (x - x_0), from the first step on."""
    for given in (dict(), dict(dt=0.1)):
        flow = Flow(square(), [Velocity(SIDES)], rho=1.3, mu=MU, f=(0.4, -2.0), options=AT_CORNER, **given)
        _ = flow.solve() if flow.time is None else flow.take_step()
        assert nodal_error(flow, lambda x: (0.0, 0.0), lambda x: 1.3 * (0.4 * x[0] - 2.0 * x[1])) < 1e-11


@pytest.mark.mpi
def test_a_fluid_at_rest_stays_at_rest():
    for options in (dict(), dict(dt=0.1)):
        flow = Flow(square(), [Velocity(("left", "bottom", "top")), Traction("right")], rho=1.3, mu=MU, **options)
        report = flow.solve() if flow.time is None else flow.take_step()
        assert report.residuals == (0.0,)
        assert (report.iterations, report.linear_iterations, report.tangents) == (0, 0, 0)
        assert not flow.w.x.array.any()


# -- what is in the forms ---------------------------------------------------------------------------------------------


def test_a_steady_scene_has_one_coefficient_and_no_time():
    flow = poiseuille()
    assert [c.name for c in flow.residual.coefficients()] == ["w"]
    assert set(flow.residual.constants()) == {flow.rho, flow.mu}
    stepped = poiseuille(dt=0.1)
    assert {c.name for c in stepped.residual.coefficients()} == {"w", "w_old", "w_dot_old"}
    assert stepped.time.dt in stepped.residual.constants()


def test_the_time_step_of_the_stabilisation_may_be_fixed():
    """Then nothing but the rate depends on the time step."""
    flow = poiseuille(dt=0.1, options=FlowOptions(tau_dt=0.3))
    assert [float(c.value) for c in flow.residual.constants() if c.value.ndim == 0].count(0.3) == 1
    assert [float(c.value) for c in poiseuille(dt=0.1).residual.constants() if c.value.ndim == 0].count(0.3) == 0


@pytest.mark.mpi
def test_parameters_may_be_constants_that_change():
    mesh = channel()
    mu = fem.Constant(mesh.domain, MU)
    flow = poiseuille(mesh=mesh, mu=mu)
    assert flow.mu is mu
    for value in (MU, 3.0):
        mu.value = value
        flow.solve()
        assert nodal_error(flow, parabola, lambda x: 2 * mu * (2 - x[0])) < 1e-9


# -- outlets with a resistance ----------------------------------------------------------------------------------------


def pipe(R, *, rho, p_0=0.3, p_in=1.0, **options):
    """A channel between a pressure and an outlet with resistance, and the outward flow rates at its ends."""
    mesh = channel()
    inlet = Traction("left", (p_in, 0.0), gamma=0.0)
    conditions = [Velocity(("bottom", "top")), inlet, Resistance("right", R, p_0)]
    flow = Flow(mesh, conditions, rho=rho, mu=MU, degree=1, **options)
    return flow, Measured(inlet=flow_rate(flow, "left"), outlet=flow_rate(flow, "right"))


@cache
def resistance_of_the_channel():
    flow, rates = pipe(0.0, rho=1e-9)
    flow.solve()
    return (1.0 - 0.3) / rates()["outlet"]


@pytest.mark.mpi
def test_the_channels_own_resistance_is_that_of_poiseuille():
    """12 mu L/H^3, but for what the free ends add and few cells take away."""
    assert resistance_of_the_channel() == pytest.approx(12 * MU * 2.0, rel=0.1)


@pytest.mark.mpi
@pytest.mark.parametrize("R", [0.0, 1.0, 1e3, 1e6])
def test_resistances_in_series(R):
    """Without inertia the channel and its outlet are two resistances in series, and one Newton iteration finds them."""
    flow, rates = pipe(R, rho=1e-9)
    report = flow.solve()
    rate = rates()
    assert rate["outlet"] == pytest.approx((1.0 - 0.3) / (R + resistance_of_the_channel()), rel=1e-6)
    assert rate["outlet"] == pytest.approx(-rate["inlet"], rel=1e-8)
    assert report.iterations <= 3
    assert report.residuals[1] < 1e-6 * report.residuals[0]


@pytest.mark.mpi
@pytest.mark.parametrize("R", [0.0, 1.0, 1e3, 1e6])
@pytest.mark.parametrize(
    "options", [dict(), dict(dt=0.05), dict(dt=0.05, scheme=EULER)], ids=["steady", "alpha", "euler"]
)
def test_pressure_behind_an_outlet_follows_its_flow_rate(R, options):
    """The flow is the one whose outlet has the pressure p_0 + R Q; few iterations find it."""
    options = options | dict(options=FlowOptions(rtol=1e-10, keep=None))
    flow, _ = pipe(R, rho=1.0, p_in=20.0, **options)
    f = flow.fields
    rate = Measured(Q=ufl.dot(f.v, ufl.FacetNormal(flow.mesh.domain)) * f.ds(("right",)))  # of the equations' level
    report = flow.solve() if flow.time is None else flow.take_step(rate)
    Q = (rate() if flow.time is None else report.measured)["Q"]
    assert report.iterations <= 8
    p = 0.3 + R * Q
    given = Flow(
        flow.mesh,
        [Velocity(("bottom", "top")), Traction("left", (20.0, 0.0), gamma=0.0), Traction("right", (-p, 0.0))],
        rho=1.0, mu=MU, **options,
    )  # fmt: skip
    _ = given.solve() if given.time is None else given.take_step()
    scale = np.abs(given.w.x.array).max()
    np.testing.assert_allclose(flow.w.x.array, given.w.x.array, rtol=0, atol=1e-7 * scale)
    assert Q > 0.0


@pytest.mark.mpi
def test_two_outlets():
    """Large resistances divide the flow in the inverse ratio; each outlet has its own pressure."""
    mesh = square()
    conditions = [Velocity("left", parabola), Velocity("bottom"), Resistance("right", 2e5), Resistance("top", 1e5, 7.0)]
    flow = Flow(mesh, conditions, rho=1.0, mu=0.1)
    report = flow.solve()
    rates = Measured(**{side: flow_rate(flow, side) for side in SIDES})()
    assert report.iterations <= 8
    assert sum(rates.values()) == pytest.approx(0.0, abs=1e-9)
    assert 2e5 * rates["right"] == pytest.approx(1e5 * rates["top"] + 7.0, rel=1e-3)
    assert rates["right"] == pytest.approx(-rates["left"] / 3, rel=1e-3)
    behind = [float(outlet.pressure.value) for outlet in flow.rank_one]
    np.testing.assert_allclose(behind, [2e5 * rates["right"], 1e5 * rates["top"] + 7.0], rtol=1e-9)


@pytest.mark.mpi
def test_without_its_dense_part_the_tangent_of_a_resistance_does_not_converge():
    flow, _ = pipe(1e3, rho=1e-9)
    flow.system._low_rank = None
    with pytest.raises(SolveError):
        newton(flow.system, rtol=1e-6)


# -- closed flows -----------------------------------------------------------------------------------------------------


def lid(x, t):
    return ufl.as_vector([16 * (x[0] * (1 - x[0])) ** 2 * (1 + t), 0 * x[0]])


def cavity(pressure, n=5, mu=0.02, **given):
    solver = gmres_ilu(1, rtol=1e-11) if pressure == "null space" else None
    options = FlowOptions(pressure=pressure, solver=solver, rtol=1e-10, **given.pop("options", {}))
    walls = [Velocity(("left", "right", "bottom")), Velocity("top", lid)]
    return Flow(given.pop("mesh", None) or square(n), walls, rho=1.0, mu=mu, options=options, **given)


def nodal(flow):
    """Nodal values of this rank's own nodes, velocity then pressure."""
    d = flow.w.ufl_shape[0]
    return flow.w.x.array[: d * flow.V.dofmap.index_map.size_local].reshape(-1, d)


def mean_pressure(flow):
    p = nodal(flow)[:, -1]
    return COMM.allreduce(p.sum(), op=MPI.SUM) / COMM.allreduce(len(p), op=MPI.SUM)


@pytest.mark.mpi
@pytest.mark.parametrize("options", [dict(), dict(dt=0.1)], ids=["steady", "step"])
def test_the_constant_of_the_pressure(options):
    """By the null space and by a pin: the same velocity, and pressures that differ by a constant."""
    found = []
    for pressure in ("null space", "pin"):
        flow = cavity(pressure, **options)
        assert flow.is_closed
        _ = flow.solve() if flow.time is None else flow.take_step()
        values = nodal(flow).copy()
        values[:, -1] -= mean_pressure(flow)
        found.append((values, mean_pressure(flow)))
    (free, mean), (pinned, other) = found
    np.testing.assert_allclose(free, pinned, rtol=0, atol=1e-7)
    assert mean == pytest.approx(0.0, abs=1e-12)
    assert abs(other) > 1e-4
    assert COMM.allreduce(np.abs(pinned[:, :2]).max(initial=0.0), op=MPI.MAX) > 0.5


@pytest.mark.mpi
def test_the_nodal_mean_of_the_pressure_does_not_drift():
    flow = cavity("null space", dt=0.1)
    flow.start(pressure=3.0)
    for _ in range(25):
        flow.take_step()
        assert mean_pressure(flow) == pytest.approx(3.0, abs=1e-12)
    assert COMM.allreduce(np.ptp(nodal(flow)[:, 2]), op=MPI.MAX) > 0.1


@pytest.mark.mpi
@pytest.mark.parametrize(
    ("at", "vertex"),
    [(None, (0.4, 0.4)), ((0.5, 0.5), (0.4, 0.4)), ((0.55, 0.68), (0.6, 0.6)), ((5.0, -1.0), (1.0, 0.0))],
)
def test_where_the_pressure_is_pinned(at, vertex):
    flow = cavity("pin", options=dict(pin_at=at))
    flow.solve()
    x, p = flow.V.tabulate_dof_coordinates()[: len(nodal(flow)), :2], nodal(flow)[:, 2]
    here = np.isclose(x, vertex).all(axis=1)
    assert COMM.allreduce(int(here.sum()), op=MPI.SUM) == 1
    assert (p[here] == 0.0).all()
    assert (np.abs(p[~here]) > 1e-9).all()


def matrix(R):
    return ufl.as_matrix(R.tolist())


MOVES = {
    "quarter turn": [[0.0, -1.0], [1.0, 0.0]],
    "half turn": [[-1.0, 0.0], [0.0, -1.0]],
    "other turn": [[0.96, 0.28], [-0.28, 0.96]],
    "reflection": [[-1.0, 0.0], [0.0, 1.0]],
}


@pytest.mark.mpi
@pytest.mark.parametrize("move", MOVES.values(), ids=MOVES)
def test_the_pinned_pressure_turns_with_the_box(move):
    """The same box after a rotation or reflection about the origin has the same pressures."""
    R, mesh = np.array(move), square(4)
    plain = cavity("pin", 4)
    plain.solve()
    mesh.domain.geometry.x[:, :2] = mesh.domain.geometry.x[:, :2] @ R.T
    walls = [
        Velocity(("left", "right", "bottom")),
        Velocity("top", lambda x, t: ufl.dot(matrix(R), lid(matrix(R.T) * x, t))),
    ]
    turned = Flow(mesh, walls, rho=1.0, mu=0.02, options=plain.options)
    turned.solve()
    here, there = nodal(plain), nodal(turned)
    assert there[:, 2] == pytest.approx(here[:, 2], abs=1e-9)
    assert there[:, :2] == pytest.approx(here[:, :2] @ R.T, abs=1e-9)
    assert COMM.allreduce(np.ptp(here[:, 2]), op=MPI.MAX) > 0.01


def test_a_pin_stays_in_the_cells_that_it_may_have():
    """As in a fluid with a solid at its centre, where pressures are held already."""
    domain = square(4).domain
    m = named(domain, cells={"solid": lambda x: np.abs(x[:2] - 0.5).max(axis=0) < 0.3, "fluid": lambda x: x[0] < 0.3})
    V = compat.lagrange_space(domain, 1, 3)
    assert pinned(V, m) == pytest.approx([0.5, 0.5])
    assert pinned(V, m, "fluid") == pytest.approx([0.0, 0.5])


def pinned(V, mesh, *fluid):
    """Where the pressure of a flow in these cells is pinned."""
    dofs, own = pressure_pin(V, mesh, fluid, None).dof_indices()
    return V.tabulate_dof_coordinates()[dofs[:own] // 3, :2].ravel().tolist()


def test_what_fixes_the_pressure_by_default():
    """A pin for a direct solver, the null space for an iterative one, nothing where the flow is open."""
    small, forced = cavity("automatic"), replace(cavity("automatic").options, solver=gmres_ilu())
    assert small.recipe.is_direct
    assert small.pressure_dofs is None
    assert len(small.bcs) == len(small._bcs) + 1
    iterative = Flow(square(), [Velocity(SIDES)], rho=1.0, mu=1.0, options=forced)
    assert len(iterative.bcs) == len(iterative._bcs)
    assert len(iterative.pressure_dofs) > 0
    for solver in (None, gmres_ilu()):
        opened = Flow(
            square(), [Velocity(SIDES[1:]), Traction("left")], rho=1.0, mu=1.0, options=FlowOptions(solver=solver)
        )
        assert opened.pressure_dofs is None
        assert len(opened.bcs) == len(opened._bcs)


@pytest.mark.parametrize("at", [(0.5,), (0.5, 0.5, 0.5), (np.nan, 0.0), "corner"])
def test_places_that_cannot_be_pinned(at):
    with pytest.raises(ValueError, match="pin_at"):
        _ = cavity("pin", options=dict(pin_at=at)).bcs


# -- tangents ---------------------------------------------------------------------------------------------------------


def test_tangent():
    flow = cavity("pin", dt=0.1, n=3)
    randomise(flow.w, 1)
    assert slope_error(flow.residual, flow.w) < 1e-6
    frozen = cavity("pin", dt=0.1, n=3, mu=1e-3, options=dict(frozen_tangent=True))
    randomise(frozen.w, 1)
    assert 1e-4 < slope_error(frozen.residual, frozen.w, frozen.tangent) < 1.0


@pytest.mark.mpi
@pytest.mark.parametrize("options", [dict(keep=None), dict(keep=0.5), dict(frozen_tangent=True)], ids=str)
def test_what_the_tangent_is_does_not_change_the_flow(options):
    """Kept tangents are fewer, and frozen ones converge more slowly."""
    flows = [cavity("pin", dt=0.1, mu=1e-3, options=given) for given in (dict(keep=None), options)]
    reports = [[flow.take_step() for _ in range(4)] for flow in flows]
    np.testing.assert_allclose(flows[1].w.x.array, flows[0].w.x.array, rtol=0, atol=1e-8)
    tangents = [sum(report.tangents for report in each) for each in reports]
    iterations = [sum(report.iterations for report in each) for each in reports]
    assert tangents[0] == iterations[0]
    if options.get("keep"):
        assert tangents[1] < tangents[0] / 2
        assert iterations[1] > iterations[0]
    for report in (report for each in reports for report in each):
        assert report.residuals[-1] <= 1e-10 * report.residuals[0]
        assert report.linear_iterations == report.iterations  # of a direct solver


# -- order in time ----------------------------------------------------------------------------------------------------


def stirred(steps, rho_infinity, *, consistent, until=0.4):
    """State of a closed flow from rest, with a lid and a force that come up at a finite rate."""
    mesh = square(3)

    def speed(x, t):
        return ufl.as_vector([16 * (x[0] * (1 - x[0])) ** 2 * ufl.sin(3 * t), 0 * x[0]])

    def force(x, t):
        return ufl.cos(4 * t) * ufl.as_vector([x[1] ** 2, -x[0]])

    flow = Flow(
        mesh,
        [Velocity(("left", "right", "bottom")), Velocity("top", speed)],
        rho=1.0,
        mu=0.05,
        dt=until / steps,
        scheme=generalized_alpha(rho_infinity),
        f=force,
        options=FlowOptions(tau_dt=0.05, rtol=1e-10),
    )
    if consistent:
        flow.consistent_start()
    for _ in range(steps):
        flow.take_step()
    return nodal(flow)[:, :2].copy()


@pytest.mark.mpi
@pytest.mark.parametrize("rho_infinity", [0.0, 0.5])
def test_order_in_time(rho_infinity):
    """Second with a consistent start; first where the initial rate is zero."""
    rates = []
    for consistent in (True, False):
        states = [stirred(n, rho_infinity, consistent=consistent) for n in (8, 16, 32, 64)]
        steps = [COMM.allreduce(np.sum((a - b) ** 2), op=MPI.SUM) ** 0.5 for a, b in pairwise(states)]
        rates.append(np.log2(steps[-2] / steps[-1]))
        if consistent:
            assert steps[-1] < 1e-3 * COMM.allreduce(np.sum(states[-1] ** 2), op=MPI.SUM) ** 0.5
    assert rates[0] == pytest.approx(2.0, abs=0.2)
    assert rates[1] < 1.5


@pytest.mark.mpi
def test_a_consistent_start_balances_the_equations():
    """Prescribed rates at the walls, a solenoidal rate inside, and the pressure of the force at once."""
    flow = Flow(square(), [Velocity(SIDES)], rho=1.3, mu=MU, f=(0.4, -2.0), options=AT_CORNER, dt=0.1)
    flow.consistent_start()
    assert nodal_error(flow, lambda x: (0.0, 0.0), lambda x: 1.3 * (0.4 * x[0] - 2.0 * x[1])) < 1e-9
    assert np.abs(flow.time.xdot_old.x.array).max(initial=0.0) < 1e-9
    lidded = cavity("pin", dt=0.1)
    lidded.start(lambda x, t: lid(x, t))
    lidded.consistent_start()
    x, rate = lidded.V.tabulate_dof_coordinates(), lidded.time.xdot_old.x.array.reshape(-1, 3)
    top = np.isclose(x[:, 1], 1.0)
    np.testing.assert_allclose(rate[top, 0], 16 * (x[top, 0] * (1 - x[top, 0])) ** 2, atol=1e-7)
    np.testing.assert_array_equal(rate[np.isclose(x[:, 1], 0.0), :2], 0.0)
    assert lidded.time.time == 0.0
    assert float(lidded.time.t.value) == 0.1


def test_a_steady_flow_has_no_initial_rates():
    with pytest.raises(ValueError, match="dt = None: only an unsteady flow has initial rates"):
        cavity("pin").consistent_start()


# -- moving meshes ----------------------------------------------------------------------------------------------------

DT = 0.1


def swirl(x, t):
    """Inner nodes move, the boundary does not."""
    bump = 0.06 * ufl.sin(3 * t) * ufl.sin(ufl.pi * x[0]) * ufl.sin(ufl.pi * x[1])
    return ufl.as_vector([bump, -0.7 * bump])


def breathe(x, t):
    """Everything moves."""
    return ufl.as_vector([0.1 * ufl.sin(2 * t) * x[0] * (1 + x[1]), 0.2 * t**2 * ufl.sin(2 * x[0]) - 0.1 * t * x[1]])


@pytest.mark.mpi
@SCHEMES
@pytest.mark.parametrize("displacement", [swirl, breathe])
@pytest.mark.parametrize("outlet", [False, True])
def test_uniform_flow_stays_uniform_on_a_moving_mesh(outlet, displacement, scheme):
    mesh, U = square(), (0.7, -0.4)
    conditions = [
        Velocity(("left", "bottom", "top"), U),
        Traction("right", inflow=U) if outlet else Velocity("right", U),
    ]
    moving = PrescribedMotion(mesh, displacement, DT, scheme)
    flow = Flow(mesh, conditions, rho=1.3, mu=0.01, dt=DT, scheme=scheme, moving=moving)
    flow.start(U)
    for _ in range(4):
        flow.take_step()
    assert COMM.allreduce(np.abs(moving.time.x.x.array).max(initial=0.0), op=MPI.MAX) > 0.01
    assert nodal_error(flow, lambda x: U, lambda x: 0 * x[0]) < 1e-10


@pytest.mark.mpi
@pytest.mark.parametrize("displacement", [swirl, breathe])
def test_couette_flow_stays_on_a_moving_mesh(displacement):
    """What a node sees change because it moves is balanced by convection relative to the mesh, to rounding."""
    mesh = square()
    moving = PrescribedMotion(mesh, displacement, DT, EULER)
    options = FlowOptions(rtol=1e-10)
    flow = Flow(mesh, [Velocity(SIDES, shear)], rho=1.3, mu=0.01, dt=DT, scheme=EULER, moving=moving, options=options)
    flow.start(shear)
    before = flow.w.x.array.copy()
    for _ in range(4):
        flow.take_step()
    assert nodal_error(flow, shear) < 1e-10
    assert COMM.allreduce(np.abs(flow.w.x.array - before).max(initial=0.0), op=MPI.MAX) > 0.01


def piston(scheme, d=2, elastic=True):
    """A box whose left wall moves in; the right side is open."""
    size = (1.0, 0.5, 0.5)[:d]
    mesh = box(COMM, (0.0,) * d, size, (4, 2, 2)[:d])
    sides = ("bottom", "top", "back", "front")[: 2 * d - 2]

    def push(x, t):
        return ufl.as_vector([0.3 * ufl.sin(2 * t) * (1 - x[0]), *[0.0 * t] * (d - 1)])

    if elastic:
        moving = ElasticMotion(mesh, {"left": push, "right": None, **dict.fromkeys(sides, push)}, DT, scheme)
    else:
        moving = PrescribedMotion(mesh, push, DT, scheme)
    conditions = [Velocity("left"), Slip(sides, strong_if_moving=True), Traction("right")]
    options = FlowOptions(rtol=1e-12)
    return Flow(mesh, conditions, rho=1.3, mu=0.05, dt=DT, scheme=scheme, moving=moving, options=options)


@pytest.mark.mpi
@pytest.mark.parametrize("d", [2, 3])
def test_the_volume_that_the_mesh_gains_is_what_its_boundary_sweeps(d):
    """Between the steps' linearly interpolated geometries, with two Gauss points in time."""
    flow = piston(EULER, d)
    time, domain = flow.moving.time, flow.mesh.domain
    u, s = fem.Function(time.x.function_space), fem.Function(time.x.function_space)
    motion = ale.Motion(domain, u, s)
    flux = ale.per_area(ufl.dot(s, ale.normal(domain, motion)), domain, motion) * flow.mesh.ds(degree=4)
    (flux,), present = compat.compile_forms(flux), Measured(V=volume(flow))
    at = 0.5 - 0.5 / 3**0.5

    def swept(old, new):
        s.x.array[:] = (new - old) / DT
        total = 0.0
        for part in (at, 1 - at):
            u.x.array[:] = (1 - part) * old + part * new
            total += DT / 2 * compat.assemble_scalar(flux)
        return total

    for _ in range(2):
        V, old = present()["V"], time.x_old.x.array.copy()
        flow.take_step()
        gained = present()["V"] - V
        assert gained == pytest.approx(swept(old, time.x.x.array.copy()), rel=1e-10)
        assert gained < -1e-3


@pytest.mark.mpi
@pytest.mark.parametrize("elastic", [True, False], ids=["elastic", "prescribed"])
@SCHEMES
def test_what_a_piston_displaces_leaves(elastic, scheme):
    """The outflow is the rate at which the volume shrinks, at the level of the equations."""
    flow = piston(scheme, elastic=elastic)
    if not elastic:  # the fluid moves with the walls from the start
        flow.start(lambda x, t: ufl.as_vector([0.6 * (1 - x[0]), 0 * x[0]]))
    f, domain = flow.fields, flow.mesh.domain
    n = ale.normal(domain, f.motion)

    def through(v, *names):
        return ale.per_area(ufl.dot(v, n), domain, f.motion) * flow.mesh.ds(*names, degree=4)

    present = Measured(
        outflow=through(f.v, "right"), growth=through(f.motion.velocity), open=through(f.motion.velocity, "right")
    )
    for _ in range(3):
        now = flow.take_step(present).measured
        assert now["open"] == 0.0
        assert now["outflow"] == pytest.approx(-now["growth"], rel=1e-10)
        assert now["outflow"] > 0.05


@pytest.mark.mpi
def test_a_consistent_start_on_a_moving_mesh():
    """The fluid at a wall that moves has the wall's acceleration."""
    mesh = square()
    moving = PrescribedMotion(mesh, lambda x, t: ufl.as_vector([0.3 * t**2 * (1 - x[0]), 0.0 * t]), DT, ALPHA)
    conditions = [Velocity("left"), Slip(("bottom", "top"), strong_if_moving=True), Traction("right")]
    flow = Flow(mesh, conditions, rho=1.3, mu=0.05, dt=DT, scheme=ALPHA, moving=moving)
    flow.consistent_start()
    x, rate = flow.V.tabulate_dof_coordinates(), flow.time.xdot_old.x.array.reshape(-1, 3)
    np.testing.assert_allclose(rate[np.isclose(x[:, 0], 0.0), 0], 0.6, rtol=1e-6)


# -- steps that fail --------------------------------------------------------------------------------------------------


@pytest.mark.mpi
@SCHEMES
def test_a_step_that_fails_leaves_everything_as_it_was(scheme):
    flow = piston(scheme)
    flow.options = replace(flow.options, max_iterations=25, rtol=1e-9)
    flow.take_step()
    before = states(flow)
    flow.options = replace(flow.options, max_iterations=1)
    with pytest.raises(
        FlowError, match=r"the step to t = 0.2 \(dt = 0.1\) failed: Newton did not converge in 1"
    ) as failed:
        flow.take_step()
    assert failed.value.t == pytest.approx(2 * DT)
    assert same(states(flow), before)
    flow.options = replace(flow.options, max_iterations=25)
    for time in (flow.time, flow.moving.time):
        time.step_size = DT / 4
    report = flow.take_step()
    assert report.t == pytest.approx(1.25 * DT)
    assert not same(states(flow), before)


def test_a_step_that_fails_changes_nothing_in_what_follows():
    ended = []
    for fails in (False, True):
        flow = cavity("pin", dt=0.1, mu=1e-3, options=dict(keep=None))
        flow.take_step()
        if fails:
            flow.options = replace(flow.options, max_iterations=1)
            with pytest.raises(FlowError):
                flow.take_step()
            flow.options = replace(flow.options, max_iterations=25)
        flow.take_step()
        ended.append(flow.w.x.array.copy())
    np.testing.assert_array_equal(*ended)


@pytest.mark.mpi
def test_a_mesh_that_turns_inside_out_fails_the_step():
    mesh = square()
    moving = PrescribedMotion(mesh, lambda x, t: ufl.as_vector([-4 * t * x[0] * (1 - x[0]), 0.0 * t]), 0.2, EULER)
    flow = Flow(mesh, [Velocity(SIDES)], rho=1.0, mu=1.0, dt=0.2, scheme=EULER, moving=moving)
    flow.take_step()
    before = states(flow)
    with pytest.raises(FlowError, match=r"the step to t = 0.4 .* failed: the mesh is inside out at t = 0.4") as failed:
        flow.take_step()
    assert isinstance(failed.value.__cause__, MeshInversionError)
    assert same(states(flow), before)
    for time in (flow.time, moving.time):
        time.step_size = 0.02
    assert flow.take_step().t == pytest.approx(0.22)


@pytest.mark.mpi
def test_a_steady_flow_that_is_not_found():
    """The message names the viscosity, and state and viscosity are what they were."""
    flow = cavity("pin", mu=1e-3, options=dict(max_iterations=1))
    randomise(flow.w, 7)
    before = flow.w.x.array.copy()
    with pytest.raises(FlowError, match=r"^no steady flow at mu = 0.001: .* refine the mesh") as failed:
        flow.solve()
    assert failed.value.t is None
    np.testing.assert_array_equal(flow.w.x.array, before)
    assert float(flow.mu.value) == 1e-3
    flow.options = replace(flow.options, max_iterations=25)
    flow.solve()
    assert not np.array_equal(flow.w.x.array, before)


@pytest.mark.mpi
def test_steady_flow_by_way_of_higher_viscosities():
    """The flow that Newton's method finds at once where it may take more iterations."""
    found = []
    for limit in (40, 4):
        flow = cavity("pin", mu=0.01, options=dict(max_iterations=limit))
        report = flow.solve()
        assert float(flow.mu.value) == 0.01
        found.append((flow.w.x.array.copy(), report))
    np.testing.assert_allclose(found[1][0], found[0][0], rtol=0, atol=1e-9)
    assert found[1][1].tangents > found[1][1].iterations  # those on the way count


# -- starts -----------------------------------------------------------------------------------------------------------


@pytest.mark.mpi
def test_starts():
    """Interpolated or projected; the old state and the rate with it."""
    flow = cavity("pin", dt=0.1)
    randomise(flow.time.xdot_old, 1)
    for projected in (False, True):
        flow.start(shear, lambda x, t: 3 * x[0] - x[1], projected=projected)
        assert nodal_error(flow, shear, lambda x: 3 * x[0] - x[1]) < 1e-8
        np.testing.assert_array_equal(flow.time.x_old.x.array, flow.w.x.array)
        assert not flow.time.xdot_old.x.array.any()
    flow.start((1.0, 2.0), 3.0)
    assert nodal_error(flow, lambda x: (1.0, 2.0), lambda x: 3.0) < 1e-14
    flow.start()
    assert not flow.w.x.array.any()


@pytest.mark.mpi
def test_a_projection_is_not_an_interpolation():
    flow = cavity("pin", dt=0.1)
    nodes = []
    for projected in (False, True):
        flow.start(lambda x, t: ufl.as_vector([x[0] ** 2, 0 * x[0]]), projected=projected)
        nodes.append(flow.w.x.array.copy())
    difference = COMM.allreduce(np.abs(nodes[0] - nodes[1]).max(initial=0.0), op=MPI.MAX)
    assert 1e-4 < difference < 0.1


@pytest.mark.mpi
def test_a_start_on_a_moving_mesh_is_at_present_coordinates():
    mesh = square()
    moving = PrescribedMotion(mesh, lambda x, t: ufl.as_vector([0.2 + t, 0.1 * x[0]]), DT, EULER)
    flow = Flow(mesh, [Velocity(SIDES, shear)], rho=1.0, mu=1.0, dt=DT, scheme=EULER, moving=moving)
    flow.start(lambda x, t: x)
    assert nodal_error(flow, lambda x: x) < 1e-14


# -- in other hands ---------------------------------------------------------------------------------------------------


@pytest.mark.mpi
def test_the_fluid_of_a_coupling():
    """Its residual, conditions and integrator, stepped by a coupler's subproblem instead."""
    own, other = (cavity("pin", dt=0.1, mu=0.02) for _ in range(2))
    fluid = FluidSubproblem(other.mesh.domain, other.residual, other.time, bcs=other.bcs, updates=other.updates)
    for _ in range(2):
        own.take_step()
        other.time.predict()
        for update in fluid.updates:
            update(float(other.time.t_alpha.value))
        fluid.system.apply_boundary_values()
        newton(fluid.system, rtol=1e-10)
        other.time.advance()
    np.testing.assert_allclose(other.w.x.array, own.w.x.array, rtol=0, atol=1e-8)
    assert fluid.speed() == pytest.approx(1.2 * 16 * (0.4 * 0.6) ** 2)


# -- bad input --------------------------------------------------------------------------------------------------------

WALLS = [Velocity(SIDES)]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (dict(rho=0.0), r"^rho = 0.0: a number > 0"),
        (dict(rho=-1.0), r"^rho = -1.0: a number > 0"),
        (dict(rho=np.nan), r"^rho = nan"),
        (dict(mu=-0.1), r"^mu = -0.1: a number >= 0"),
        (dict(mu=np.inf), r"^mu = inf"),
        (dict(mu=0.0), r"^mu = 0.0: a number > 0 is required in steady flow"),
        (dict(mu=-0.1, dt=0.1), r"^mu = -0.1: a number >= 0"),
        (dict(dt=0.0), r"^dt = 0.0: a number > 0"),
        (dict(dt=-0.1), r"^dt = -0.1: a number > 0"),
        (dict(dt=np.nan), r"^dt = nan"),
        (dict(degree=0), r"^degree = 0: an integer >= 1"),
        (dict(degree=1.5), r"^degree = 1.5: an integer >= 1"),
        (dict(f=(1.0, 2.0, 3.0)), r"^f has shape \(3,\): shape \(2,\)"),
        (dict(f=(1.0, np.nan)), r"^f\[1\] = nan: a finite number"),
        (dict(f=lambda x, t: x[0]), r"^f has shape \(\): shape \(2,\)"),
        (dict(solid=Solid(StVenantKirchhoffSolid(1.0, 0.3, 1.0))), r"^dt = None: a time step is required"),
        (dict(dt=0.1, solid=Solid(StVenantKirchhoffSolid(1.0, 0.3, 1.0))), r"^moving = None: a solid .* ElasticMotion"),
    ],
)
def test_bad_input(change, message):
    with pytest.raises(ValueError, match=message):
        Flow(square(1), WALLS, **(dict(rho=1.0, mu=1.0) | change))


def test_bad_constants():
    mesh = square(1)
    for change in (dict(rho=fem.Constant(mesh.domain, -1.0)), dict(mu=fem.Constant(mesh.domain, 0.0))):
        (name,) = change
        with pytest.raises(ValueError, match=f"^{name} = .*a number > 0 is required"):
            Flow(mesh, WALLS, **(dict(rho=1.0, mu=1.0) | change))


def test_an_inviscid_fluid_may_be_stepped():
    Flow(square(1), WALLS, rho=1.0, mu=0.0, dt=0.1)


@pytest.mark.parametrize(
    ("dt", "message"),
    [
        (None, r"^dt = None: a time step is required where the mesh moves"),
        (0.2, r"^dt = 0.2: that of the moving mesh, 0.1"),
    ],
)
def test_flow_and_mesh_have_one_time_step(dt, message):
    mesh = square(1)
    moving = PrescribedMotion(mesh, swirl, 0.1, EULER)
    with pytest.raises(ValueError, match=message):
        Flow(mesh, WALLS, rho=1.0, mu=1.0, dt=dt, scheme=EULER, moving=moving)


def test_flow_and_mesh_have_one_scheme():
    """Else displacement, velocity and equations belong to different levels."""
    mesh = square(1)
    moving = PrescribedMotion(mesh, swirl, 0.1, EULER)
    with pytest.raises(ValueError, match=r"^scheme = "):
        Flow(mesh, WALLS, rho=1.0, mu=1.0, dt=0.1, scheme=ALPHA, moving=moving)


@pytest.mark.mpi
def test_flow_and_mesh_keep_one_time_step():
    """One that is changed for the flow alone would let the clocks drift apart."""
    mesh = square(1)
    moving = PrescribedMotion(mesh, swirl, 0.1, EULER)
    flow = Flow(mesh, WALLS, rho=1.0, mu=1.0, dt=0.1, scheme=EULER, moving=moving)
    flow.time.step_size = 0.05
    with pytest.raises(ValueError, match=r"^dt = 0.05: that of the moving mesh, 0.1, is required"):
        flow.take_step()


@pytest.mark.parametrize(
    ("velocity", "message"),
    [
        ((1.0, 2.0, 3.0), r"^velocity has shape \(3,\): shape \(2,\) is required"),
        ((1.0,), r"^velocity has shape \(1,\): shape \(2,\) is required"),
        (lambda x, t: x[0], r"^velocity has shape \(\): shape \(2,\) is required"),
        ((1.0, np.nan), r"^velocity\[1\] = nan: a finite number is required"),
    ],
)
def test_bad_starts(velocity, message):
    with pytest.raises(ValueError, match=message):
        cavity("pin", dt=0.1).start(velocity)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (dict(C_I=-1.0), r"^C_I = -1.0: a number >= 0"),
        (dict(C_t=np.nan), r"^C_t = nan"),
        (dict(tau_dt=0.0), r"^tau_dt = 0.0: a number > 0"),
        (dict(rtol=0.0), r"^rtol = 0.0: a number > 0"),
        (dict(keep=1.5), r"^keep = 1.5: a number from 0 to 1"),
        (dict(pressure="mean"), r"^pressure = 'mean': one of 'automatic', 'null space', 'pin'"),
        (dict(max_iterations=0), r"^max_iterations = 0: an integer >= 1"),
    ],
)
def test_bad_options(options, message):
    with pytest.raises(ValueError, match=message):
        FlowOptions(**options)


def test_steady_and_unsteady_flows_have_their_own_verbs():
    with pytest.raises(ValueError, match=r"^dt = None: a steady flow has no steps"):
        cavity("pin").take_step()
    with pytest.raises(ValueError, match=r"^dt = 0.1: a steady flow has none"):
        cavity("pin", dt=0.1).solve()


def test_a_null_space_needs_an_iterative_solver():
    flow = Flow(square(1), WALLS, rho=1.0, mu=1.0, options=FlowOptions(pressure="null space", solver=direct()))
    with pytest.raises(ValueError, match=r"^pressure = 'null space': an iterative solver is required"):
        flow.compile()
