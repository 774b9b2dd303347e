"""Levels of time, weights and units: what would notice that one of them is not there."""

import numpy as np
import pytest
import ufl
from mpi4py import MPI
from dolfinx import fem
from scenes import sheet_in_flow

from coudalfish import CouplingOptions, FluidSubproblem
from coudalfish.surface import exchange
from coudalfish.surface.trace import PointLocator, trace_matrix
from tigar_x import compat
from tigar_x.fem.schemes import generalized_alpha
from tigar_x.fem.solve import FiniteElementSystem
from varmint.conditions import Traction, Velocity
from varmint.flow import Flow, FlowOptions
from varmint.flow.attachments import ROUNDED
from varmint.forms.motion import ElasticMotion
from varmint.forms.solids import Solid, StVenantKirchhoffSolid, mesh_residual, solid_residual
from varmint.mesh import box, named

COMM = MPI.COMM_SELF
SIDES = ("left", "right", "bottom", "top")


def dense(A):
    """PETSc's matrix of one rank as an array."""
    rows, columns = A.getSize()
    return A.getValues(np.arange(rows, dtype=np.int32), np.arange(columns, dtype=np.int32))


# -- penalty ----------------------------------------------------------------------------------------------------------


def test_penalty_tangent_of_a_rational_shell_is_the_slope_of_its_residual():
    s = sheet_in_flow(weights=lambda n: 1.0 + 0.6 * np.sin(np.arange(n)), solver=None)
    shell, beta, rng = s.shell, 7.0, np.random.default_rng(0)
    assert np.ptp(shell.quadrature.rational) > 0.3
    W, zero = shell.quadrature.weights, np.zeros((len(shell.quadrature.points), 2))
    shell.timeInt.predict()
    direction = rng.normal(size=(shell.spline.geometry.n, 2))
    start, step = shell.timeInt.x.x.array.copy(), shell.spline.function(direction).x.array

    def residual(t):
        shell.timeInt.x.x.array[:] = start + t * step
        found = []
        for penalty in (beta, 0.0):
            load = exchange.point_forces(zero, shell.velocity(), zero[:, 0], zero, W, penalty=penalty)
            shell.assemble_residual(load)
            found.append(shell.system.b.array_r.copy())
        return found[0] - found[1]

    slope = (residual(1.0) - residual(-1.0)) / 2.0
    shell.timeInt.x.x.array[:] = start
    parts = []
    for penalty in (beta, 0.0):
        shell.assemble_tangent(W, penalty)
        parts.append(dense(shell.system.A))
    np.testing.assert_allclose((parts[0] - parts[1]) @ direction.ravel(), slope, rtol=1e-9, atol=1e-9)
    assert np.abs(slope).max() > 0.1


def test_normals_and_points_of_the_shell_are_those_of_the_level():
    """A sheet that turns by a half in a step stands, at two thirds of it, along the chord between its ends."""
    s = sheet_in_flow((0.3, 0.2), solver=None)
    shell = s.shell
    np.testing.assert_allclose(shell.velocity(), np.tile([0.3, 0.2], (17, 1)), rtol=1e-14)  # before the step
    shell.timeInt.predict()
    X = shell.quadrature.points
    A = np.array([[0.0, -0.5], [0.5, 0.0]])
    shell.timeInt.x.x.array[:] = ((X - X[0]) @ A.T).ravel()
    x = shell.positions()
    np.testing.assert_allclose(x, X + 2 / 3 * (X - X[0]) @ A.T, rtol=1e-13)
    first, last = x[np.argmin(X[:, 1])], x[np.argmax(X[:, 1])]
    along = (last - first) / np.linalg.norm(last - first)
    np.testing.assert_allclose(shell.normals(), np.tile([along[1], -along[0]], (len(x), 1)), rtol=1e-12)


@pytest.mark.parametrize("kind", ["consistent", "lumped"])
def test_penalty_tangent_of_the_fluid_is_the_slope_of_its_forces(kind, monkeypatch):
    """In a step of rho_infinity = 1/2, whose equations hold at alpha_f = 2/3; a lumped one has the same row sums."""
    s = sheet_in_flow(traction=0.5, options=CouplingOptions(fluid_tangent=kind))
    parts, assemble = [], s.fluid.assemble_tangent

    def note(trace, part):
        parts.append((trace, part))
        assemble(trace, part)

    monkeypatch.setattr(s.fluid, "assemble_tangent", note)
    s.fsi.takeStep()
    trace, K = parts[0]
    W, beta = s.shell.quadrature.weights, s.fsi.penalty
    rng = np.random.default_rng(1)
    nodal = np.ones(len(trace.nodes)) if kind == "lumped" else rng.normal(size=len(trace.nodes))
    before = s.fluid.velocity_at(trace)
    s.w.x.array[s.fluid.velocity_dofs[trace.nodes, 1]] += nodal
    change = s.fluid.velocity_at(trace)[:, 1] - before[:, 1]
    np.testing.assert_allclose(K @ nodal, trace.transposed @ (beta * W * change), rtol=1e-10, atol=1e-12)
    assert np.abs(change).max() > 0.1


@pytest.mark.parametrize("kind", [exchange.consistent_tangent, exchange.lumped_tangent])
def test_held_velocities_stay_unit_rows_under_the_penalty(kind):
    """Points in cells at a wall whose nodes are held: their rows and columns feel nothing of the penalty."""
    flow = Flow(
        box(COMM, (0.0, 0.0), (1.0, 1.0), (4, 4)),
        [Velocity(("left", "bottom", "top")), Traction("right")],
        rho=1.0,
        mu=0.1,
        dt=0.1,
    )
    fluid = FluidSubproblem(flow.mesh.domain, flow.residual, flow.time, bcs=flow.bcs, updates=flow.updates)
    x = np.column_stack([np.linspace(0.02, 0.97, 20), np.full(20, 0.1)])
    trace = trace_matrix(fluid.velocity_space, PointLocator(flow.mesh.domain).locate(x))
    part = kind(trace.B, np.full(20, 0.05), penalty=30.0, factor=0.7)
    fluid.assemble_tangent(trace, 0.0 * part)
    plain = dense(fluid.system.A)
    fluid.assemble_tangent(trace, part)
    loaded = dense(fluid.system.A)
    held = fluid.system.constrained
    assert len(np.intersect1d(held, fluid.velocity_dofs[trace.nodes])) > 4
    unit = np.eye(len(loaded))
    np.testing.assert_array_equal(loaded[held], unit[held])
    np.testing.assert_array_equal(loaded[:, held], unit[:, held])
    assert np.abs(loaded - plain).max() > 0.1


# -- units and scales -------------------------------------------------------------------------------------------------


def test_residuals_go_with_the_unit_of_force():
    """In another unit of mass all forces change by a factor; continuity, a volume per time, has to be weighed."""
    found = []
    for unit in (1.0, 1e3):
        s = sheet_in_flow((0.0, 0.0), rho=unit, mu=0.1 * unit, rho_s=unit, stiffness=10.0 * unit, traction=0.5 * unit)
        report = s.fsi.takeStep()
        found.append(np.array(report.residuals) / unit)
    assert found[0].shape == found[1].shape
    np.testing.assert_allclose(found[1][:-1], found[0][:-1], rtol=1e-6, atol=1e-12)
    continuity = s.fluid.system.b.duplicate()
    continuity.array = 1.0 - s.fluid._is_velocity
    assert s.fluid.norm(continuity, 3.0) == pytest.approx(3.0 * s.fluid.norm(continuity, 1.0)) != 0.0
    small = continuity.duplicate()
    small.array = s.fluid._is_velocity + 1e-11 * (1.0 - s.fluid._is_velocity)
    ratio = s.fluid.norm(small, 1e11) / s.fluid.norm(small, 0.0)
    assert ratio == pytest.approx(np.sqrt(1.5), rel=1e-12)  # one continuity row beside two of momentum
    step = s.fsi.step()
    step._predict()
    step._place()
    s.w.x.array[:] = np.sin(np.arange(len(s.w.x.array)))  # no solenoidal flow
    step._evaluate()
    norm, rows = step._fluid_residual(), s.fluid.system.b.array_r.reshape(-1, 3)
    squares = (rows[:, :2] ** 2).sum() + (s.fsi.penalty * rows[:, 2]) ** 2 @ np.ones(len(rows))
    assert norm == pytest.approx(np.sqrt(squares), rel=1e-12)


def test_each_scale_of_the_band_is_its_own():
    s = sheet_in_flow(options=CouplingOptions(scale_m=0.3, scale_c=0.02))
    s.fsi.takeStep()
    for scale, value in ((s.fluid.band.scale_m, 0.3), (s.fluid.band.scale_c, 0.02)):
        assert set(scale.x.array) == {1.0, value}


# -- a flow's start, solids and the mesh around them ------------------------------------------------------------------


def test_a_consistent_start_does_not_know_the_step_where_tau_does_not():
    states = []
    for dt in (0.1, 0.003):
        flow = Flow(
            box(COMM, (0.0, 0.0), (1.0, 1.0), (4, 4)),
            [Velocity(SIDES)],
            rho=1.3,
            mu=0.7,
            dt=dt,
            f=lambda x, t: ufl.as_vector([ufl.sin(3 * x[1]), x[0] * x[1]]),
            options=FlowOptions(tau_dt=0.05),
        )
        flow.start(lambda x, t: 16 * ufl.as_vector([x[1] * (1 - x[1]), 0.0]) * x[0] * (1 - x[0]))
        flow.consistent_start()
        states.append(np.append(flow.w.x.array, flow.time.xdot_old.x.array))
    np.testing.assert_allclose(states[1], states[0], rtol=1e-6, atol=1e-7)
    assert np.abs(states[0]).max() > 0.1


@pytest.mark.parametrize("with_solid", [False, True])
def test_the_rate_of_a_consistent_start_keeps_the_volume_of_the_fluid_whatever_the_velocity_does(with_solid):
    """What flows in at that rate flows out, from a velocity that has sources everywhere."""
    scheme, dt, solid = generalized_alpha(0.5), 0.1, {}
    mesh = named(
        box(COMM, (0.0, 0.0), (1.0, 1.0), (4, 4)).domain,
        cells={"solid": lambda x: x[0] < 0.5 + 1e-9, "fluid": lambda x: x[0] > 0.5 - 1e-9},
        left=lambda x: np.isclose(x[0], 0.0),
        rest=[lambda x, i=i, v=v: np.isclose(x[i], v) for i, v in ((0, 1.0), (1, 0.0), (1, 1.0))],
    )
    if with_solid:
        moving = ElasticMotion(mesh, dict.fromkeys(("left", "rest")), dt, scheme, cells=("fluid",))
        solid = {"moving": moving, "solid": Solid(StVenantKirchhoffSolid(100.0, 0.3, 2.0))}
    flow = Flow(
        mesh, [Velocity("left"), Traction("rest")], rho=1.0, mu=0.1, dt=dt, scheme=scheme, f=(0.7, 0.3), **solid
    )
    flow.start(lambda x, t: ufl.as_vector([x[0], x[0] * x[1]]))
    flow.consistent_start()
    rate = ufl.as_vector([flow.time.xdot_old[0], flow.time.xdot_old[1]])
    forms = compat.compile_forms(
        ufl.div(rate) * mesh.dx(*flow.fluid_cells, degree=2), ufl.inner(rate, rate) * mesh.dx(degree=2)
    )
    change, size = (compat.assemble_scalar(form) for form in forms)
    assert abs(change) < 1e-8 * np.sqrt(size)
    assert size > 1e-3


@pytest.mark.parametrize("d", [2, 3])
def test_stress_of_the_fictitious_solid_by_numbers(d):
    """``F S`` of a uniform deformation with shear, against ``sum_i f_i x_i``, the virial of the nodal forces."""
    mesh = box(COMM, (0.0,) * d, (1.0,) * d, (2,) * d)
    V = compat.lagrange_space(mesh.domain, 1, d)
    u, x = fem.Function(V), ufl.SpatialCoordinate(mesh.domain)
    A = np.array([[0.1, 0.3, -0.1], [-0.2, 0.05, 0.2], [0.0, 0.1, -0.15]])[:d, :d]
    compat.interpolate(u, ufl.dot(ufl.as_matrix(A.tolist()), x))
    form = mesh_residual(u, ufl.TestFunction(V), mesh.domain, mesh.dx(degree=2), stiffening=0.0, size_stiffening=0.0)
    system = FiniteElementSystem(form, u)
    system.assemble_residual()
    forces = system.b.array_r.reshape(-1, d)
    virial = forces.T @ V.tabulate_dof_coordinates()[:, :d]
    F = np.eye(d) + A
    E = (F.T @ F - np.eye(d)) / 2
    S = np.trace(E) * np.eye(d) + 2 * (E - np.trace(E) / 3 * np.eye(d))
    np.testing.assert_allclose(virial, F @ S, rtol=1e-12, atol=1e-13)


def test_a_solid_resists_its_acceleration_and_carries_its_weight_with_its_density():
    mesh = box(COMM, (0.0, 0.0), (1.0, 0.5), (2, 2))
    V = compat.lagrange_space(mesh.domain, 1, 2)
    u, (a, f) = fem.Function(V), (fem.Constant(mesh.domain, value) for value in ((2.0, 3.0), (0.5, 7.0)))
    form = solid_residual(StVenantKirchhoffSolid(1.0, 0.3, 2.5), u, a, ufl.TestFunction(V), mesh.dx(degree=2), f=f)
    system = FiniteElementSystem(form, u)
    system.assemble_residual()
    np.testing.assert_allclose(
        system.b.array_r.reshape(-1, 2).sum(axis=0), 2.5 * 0.5 * np.array([1.5, -4.0]), rtol=1e-13
    )


def test_a_solid_in_a_flow_is_strained_at_the_level_of_its_equations():
    """rho_infinity = 1/2: its stress is that of alpha_f times the displacement that its velocity gives in a step."""
    half = lambda x: x[0] < 0.5 + 1e-9  # noqa: E731
    mesh = named(
        box(COMM, (0.0, 0.0), (1.0, 1.0), (4, 4)).domain,
        cells={"solid": half, "fluid": lambda x: x[0] > 0.5 - 1e-9},
        left=lambda x: np.isclose(x[0], 0.0),
        rest=[lambda x, i=i, v=v: np.isclose(x[i], v) for i, v in ((0, 1.0), (1, 0.0), (1, 1.0))],
    )
    scheme, dt = generalized_alpha(0.5), 0.1
    moving = ElasticMotion(mesh, dict.fromkeys(("left", "rest")), dt, scheme, cells=("fluid",))
    flow = Flow(
        mesh,
        [Velocity("left"), Traction("rest")],
        rho=1.0,
        mu=0.1,
        dt=dt,
        scheme=scheme,
        moving=moving,
        solid=Solid(StVenantKirchhoffSolid(100.0, 0.3, 1e-12)),
    )
    A = np.array([[0.5, 0.8], [-0.3, 0.2]])
    flow.time.predict()
    rate = moving.time.x_from_rate_array
    x = flow.V.tabulate_dof_coordinates()[:, :2]
    w = flow.w.x.array.reshape(-1, 3)
    w[:, :2] = x @ A.T
    nodes = moving.time.x.function_space.tabulate_dof_coordinates()[:, :2]
    shift = rate((nodes @ A.T).ravel(), np.arange(2 * len(nodes), dtype=np.int32)).reshape(-1, 2)
    gradient = np.linalg.lstsq(nodes, shift, rcond=None)[0].T
    assert np.abs(gradient).max() > 1e-3
    system = FiniteElementSystem(flow._solid.residual, flow.w)
    system.assemble_residual()
    virial = system.b.array_r.reshape(-1, 3)[:, :2].T @ x
    F = np.eye(2) + scheme.alpha_f * gradient
    P = StVenantKirchhoffSolid(100.0, 0.3, 1.0).first_piola_kirchhoff(ufl.as_matrix(F.tolist()))
    expected = 0.5 * np.array([[float(P[i, j](())) for j in range(2)] for i in range(2)])
    np.testing.assert_allclose(virial, expected, rtol=1e-9, atol=1e-10)
    # a velocity of the resolution, over its share, displaces a node by the edge of a cell at the level
    resolution = flow._solid.resolution().reshape(-1, 3) / ROUNDED
    in_solid = x[:, 0] < 0.5 + 1e-9
    np.testing.assert_array_equal(resolution[:, 2], 0.0)
    np.testing.assert_array_equal(resolution[~in_solid], 0.0)
    some, dofs = resolution[in_solid, :2].ravel(), np.arange(2 * in_solid.sum(), dtype=np.int32)
    np.testing.assert_allclose(scheme.alpha_f * rate(some, dofs), 0.25, rtol=1e-12)
