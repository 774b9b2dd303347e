"""Coupled steps on a background mesh that moves: points among displaced cells, one clock, failures of the motion."""

import gc
import json
from dataclasses import replace

import numpy as np
import pytest
import ufl
from mpi4py import MPI
from dolfinx import fem
from flows import moved_to
from mpi_runs import MPIRUN, mpirun
from scenes import free_sheet, sheet_in_flow
from test_solids import beam_flow

from coudalfish import CouDALFISh, CouplingOptions, FluidSubproblem, StepError, SurfaceBand, advance
from coudalfish.sides.mesh_motion import check_levels, displacement_of_cells
from coudalfish.surface.trace import PointLocator, trace_matrix
from tigar_x import compat
from tigar_x.fem.linear import SolveError, direct
from tigar_x.fem.schemes import generalized_alpha
from tigar_x.fem.time_integration import TimeIntegrator
from varmint.conditions import WeakVelocity
from varmint.flow import Flow, FlowOptions
from varmint.forms.motion import ElasticMotion, PrescribedMotion
from varmint.mesh import box
from varmint.quantities import BoundaryForce

COMM = MPI.COMM_WORLD
TIGHT = CouplingOptions(block_rtol=1e-11, block_atol=1e-13)
SMOOTHED = replace(TIGHT, relaxation=0.5, relaxation_mode="smoothed")
SIDES = ("left", "right", "bottom", "top")
DT = 0.1


def bubble(x, t):
    """Moves the inner nodes only; cells shear and change their sizes by a third."""
    s = ufl.sin(ufl.pi * x[0]) * ufl.sin(ufl.pi * x[1]) * ufl.sin(5.0 * t)
    return ufl.as_vector([0.1 * s, -0.08 * s])


def breathing(x, t):
    """Moves the walls as well."""
    return ufl.as_vector([0.2 * (x[0] - 0.5) * ufl.sin(4.0 * t), 0.1 * ufl.sin(3.0 * t) * x[0]])


def prescribed(displacement, degree=1):
    return lambda mesh, scheme: PrescribedMotion(mesh, displacement, DT, scheme, degree)


def elastic(mesh, scheme):
    return ElasticMotion(mesh, dict.fromkeys(SIDES, breathing), DT, scheme)


def scene(motion=None, *, velocity=(0.0, 0.0), sheet_velocity=None, walls=None, n=6, options=TIGHT, mu=0.1, **sheet):
    """A free sheet in a box, whose walls have the velocity of the flow, on a mesh that moves or not."""
    mesh, scheme = box(COMM, (0.0, 0.0), (1.0, 1.0), (n, n), "triangle"), generalized_alpha(0.5)
    moving = None if motion is None else motion(mesh, scheme)
    flow = Flow(
        mesh,
        [WeakVelocity(SIDES, velocity if walls is None else walls)],
        rho=1.0,
        mu=mu,
        dt=DT,
        scheme=scheme,
        moving=moving,
        immersed="plain",
        options=FlowOptions(pressure="pin"),
    )
    flow.start(velocity if walls is None else walls)
    fluid = FluidSubproblem(
        mesh.domain,
        flow.residual,
        flow.time,
        bcs=flow.bcs,
        updates=flow.updates,
        band=SurfaceBand(mesh.domain, flow.scales),
        moving=moving,
        solver=direct(),
        density=1.0,
        viscosity=mu,
    )
    shell = free_sheet(velocity if sheet_velocity is None else sheet_velocity, dt=DT, **sheet)
    fsi = CouDALFISh(fluid, shell.shell, options)
    fsi.flow, fsi.y = flow, shell.y
    return fsi


def state(fsi):
    """Everything that a step may change."""
    arrays = [fsi.lam.copy(), np.array([float(time.t.value) for time in fsi.integrators])]
    for time in fsi.integrators:
        arrays += [f.x.array.copy() for f in (time.x, *time.state.values())]
    return arrays


def largest(values):
    return COMM.allreduce(float(np.abs(values).max(initial=0.0)), op=MPI.MAX)


# -- coupled steps ----------------------------------------------------------------------------------------------------


@pytest.mark.mpi
@pytest.mark.parametrize("motion", [prescribed(bubble), prescribed(breathing), elastic])
def test_free_sheet_in_uniform_flow_translates_exactly(motion):
    """The mesh that moves past the points is invisible (geometric conservation)."""
    velocity = np.array([0.3, 0.2])
    fsi = scene(motion, velocity=tuple(velocity))
    for step in range(1, 5):
        report = fsi.takeStep()
        shift = np.tile(velocity * DT * step, (17, 1))
        np.testing.assert_allclose(fsi.spline_sh.nodal(fsi.y), shift, atol=1e-10)
        w = fsi.timeInt_f.x.x.array.reshape(-1, 3)
        assert largest(w - [0.3, 0.2, 0.0]) < 1e-9
        assert np.abs(fsi.lam).max() < 1e-9
        assert report.monitors.normal_slip_max < 1e-10
    assert largest(fsi.fluid.moving.time.x.x.array) > 0.05
    assert [time.time for time in fsi.integrators] == pytest.approx([4 * DT] * 3)


def test_a_motion_of_no_displacement_changes_nothing():
    results = []
    for motion in (None, prescribed(lambda x, t: ufl.as_vector([0.0 * x[0], 0.0 * t]))):
        fsi = scene(motion, sheet_velocity=(0.5, 0.0))
        for _ in range(4):
            fsi.takeStep()
        results.append(np.concatenate([fsi.timeInt_f.x.x.array, fsi.y.x.array, fsi.lam]))
    assert np.abs(results[0]).max() > 0.01
    np.testing.assert_allclose(results[0], results[1], atol=1e-10)


def stream(x, t):
    """Plane Poiseuille flow."""
    return ufl.as_vector([x[1] * (1.0 - x[1]) + 0.0 * t, 0.0 * x[0]])


LOOSE = CouplingOptions(block_rtol=1e-6)


def carried(motion, n):
    """Displacement and velocity of a sheet that starts from rest in a channel flow and is carried on."""
    fsi = scene(motion, walls=stream, n=n, elements=2 * n, options=LOOSE)
    for _ in range(5):
        fsi.takeStep()
    return [fsi.spline_sh.nodal(f) for f in (fsi.y, fsi.timeInt_sh.xdot_old)]


@pytest.mark.mpi
@pytest.mark.parametrize("motion", [prescribed(bubble), prescribed(breathing), elastic])
def test_a_sheet_in_a_channel_does_not_notice_the_mesh(motion):
    """It differs from that on the fixed mesh by less and less on finer meshes; rho_infinity is 1/2."""
    errors = []
    for n in (6, 12, 24):
        pairs = list(zip(carried(motion, n), carried(None, n), strict=True))
        errors.append([np.abs(moved - fixed).max() for moved, fixed in pairs])
        assert np.abs(pairs[0][1]).max() > 0.08
    displacement, velocity = np.array(errors).T
    assert displacement[0] > 1.3 * displacement[1] > 1.6 * displacement[2]
    assert velocity[0] > 1.5 * velocity[1] > 2.2 * velocity[2]
    assert displacement[-1] < 5e-4
    assert velocity[-1] < 1e-3


def test_points_located_in_the_mesh_at_rest_would_be_noticed(monkeypatch):
    """The agreement above does not come by itself."""
    monkeypatch.setattr(PointLocator, "displace", lambda self, u: None)
    wrong, fixed = carried(prescribed(bubble), 12)[1], carried(None, 12)[1]
    assert np.abs(wrong - fixed).max() > 1e-2


def test_a_solid_in_the_flow_moves_the_mesh_in_every_pass():
    """With a sheet that is outside all along, the steps are those that the flow takes by itself."""
    alone, flow = (beam_flow(0.5, generalized_alpha(0.5), rho=1.0, mu=0.5, rtol=1e-9, pressure="pin") for _ in "ab")
    fluid = FluidSubproblem(
        flow.mesh.domain,
        flow.residual,
        flow.time,
        bcs=flow.bcs,
        updates=flow.updates,
        before=flow.before,
        moving=flow.moving,
        density=1.0,
        viscosity=0.5,
    )
    fsi = CouDALFISh(fluid, free_sheet(dt=0.5, ends=((3.0, 0.0), (3.0, 1.0))).shell, CouplingOptions(block_rtol=1e-8))
    for _ in range(3):
        alone.take_step()
        fsi.takeStep()
        scale = np.abs(alone.w.x.array).max()
        np.testing.assert_allclose(flow.w.x.array, alone.w.x.array, atol=1e-5 * scale)
        u, expected = (f.moving.time.x.x.array for f in (flow, alone))
        np.testing.assert_allclose(u, expected, atol=1e-5 * np.abs(expected).max())
    assert np.abs(u).max() > 1e-5


@pytest.mark.mpi
def test_a_coupled_step_measures_what_the_step_of_its_flow_measures():
    """With a sheet that is outside all along; before the clocks move, at the time of the equations."""
    alone = scene(walls=stream).flow
    with pytest.raises(ValueError, match="the flow is coupled with a shell: take the steps of what couples them"):
        alone.take_step()
    alone.time.partner = None
    fsi = scene(walls=stream, ends=((3.0, 0.0), (3.0, 1.0)))
    expected, force = BoundaryForce(alone, *SIDES), BoundaryForce(fsi.flow, *SIDES)
    for step in (fsi.takeStep, lambda measure: advance(fsi, DT, measure=measure)[0]):
        own, report = alone.take_step(expected), step(force)
        assert (report.t, report.t_alpha) == pytest.approx((own.t, own.t_alpha), rel=1e-14)
        assert report.t - report.t_alpha == pytest.approx(DT / 3)
        assert np.abs(own.measured).max() > 1e-3
        np.testing.assert_allclose(report.measured, own.measured, atol=1e-6 * np.abs(own.measured).max())
        with pytest.raises(RuntimeError, match="the force is asked for between steps"):
            force()


@pytest.mark.mpi
def test_a_measure_that_fails_leaves_the_state_before_the_step():
    fsi = scene(sheet_velocity=(0.5, 0.0))
    before = state(fsi)

    def fail():
        assert fsi.timeInt_f.in_step
        raise KeyError("measure")

    with pytest.raises(KeyError, match="measure"):
        fsi.takeStep(fail)
    for old, new in zip(before, state(fsi), strict=True):
        np.testing.assert_array_equal(old, new)
    assert not any(time.in_step for time in fsi.integrators)


def test_the_mesh_is_checked_before_and_after_the_passes(monkeypatch):
    fsi = scene(prescribed(bubble), sheet_velocity=(0.5, 0.0))
    before, checks = state(fsi), []

    def check():
        checks.append(1)
        if len(checks) % 2 == 0:  # of two attempts
            raise SolveError("turned inside out by a pass")

    monkeypatch.setattr(fsi.fluid.moving, "check", check)
    with pytest.raises(StepError, match="mesh block: turned inside out by a pass") as caught:
        fsi.takeStep()
    assert caught.value.report.passes > 0
    for old, new in zip(before, state(fsi), strict=True):
        np.testing.assert_array_equal(old, new)


# -- where points are -------------------------------------------------------------------------------------------------


def displaced(domain, seed, size):
    """Displacement of the vertices of owned cells, and as a function."""
    V = compat.lagrange_space(domain, 1, domain.geometry.dim)
    u = fem.Function(V)
    x = V.tabulate_dof_coordinates()
    phases = np.random.default_rng(seed).uniform(0.0, 6.0, (2, domain.geometry.dim))
    for i in range(domain.geometry.dim):
        u.x.array[i :: domain.geometry.dim] = size * np.sin(7.0 * x @ np.array([1.0, 0.7, 0.4]) + phases[0, i])
    return u, u.x.array.reshape(-1, domain.geometry.dim)[compat.cell_dofs(V)[: compat.owned_cells(domain)]]


@pytest.mark.mpi
@pytest.mark.parametrize("cell", ["triangle", "tetrahedron"])
def test_points_are_found_in_displaced_cells(cell):
    """As a brute force search in the moved mesh finds them, from step to step; the mesh itself stays where it is."""
    d = 2 if cell == "triangle" else 3
    domain = box(COMM, (0.0,) * d, (1.0,) * d, (5,) * d, cell).domain
    rest = domain.geometry.x.copy()
    x = np.random.default_rng(3).uniform(-0.05, 1.05, (80, d))
    locator = PointLocator(domain)
    for step, size in enumerate((0.02, 0.021, 0.05, 0.05, 0.0)):
        u, at_cells = displaced(domain, step // 2, size)
        locator.displace(at_cells)
        location = locator.locate(x)
        np.testing.assert_array_equal(domain.geometry.x, rest)
        with moved_to(domain, u):
            vertices = compat.cell_vertices(domain)[: compat.owned_cells(domain)]
        A = np.concatenate([np.moveaxis(vertices, 1, 2), np.ones((len(vertices), 1, d + 1))], axis=1)
        b = np.einsum("cij,qj->cqi", np.linalg.inv(A), np.column_stack([x, np.ones(len(x))]))
        inside = COMM.allreduce((b.min(axis=2) > -1e-10).any(axis=0).astype(int), op=MPI.SUM) > 0
        np.testing.assert_array_equal(location.active, inside)
        assert 40 < inside.sum() < 80
        mine = location.owned
        found = np.einsum("qv,qvi->qi", location.barycentric[mine], vertices[location.cells[mine]])
        np.testing.assert_allclose(found, x[mine], atol=1e-13)
        assert (COMM.allreduce(mine.astype(int), op=MPI.SUM) == inside).all()


def test_the_tree_is_made_only_when_points_leave_their_cells(monkeypatch):
    domain = box(COMM, (0.0, 0.0), (1.0, 1.0), (5, 5), "triangle").domain
    made = []
    tree = compat.bounding_box_tree
    monkeypatch.setattr(compat, "bounding_box_tree", lambda *a: made.append(1) or tree(*a))
    locator, x = PointLocator(domain), np.full((4, 2), 0.45) + 0.02 * np.eye(4, 2)
    for size, trees in ((0.0, 1), (1e-3, 1), (2e-3, 1), (0.2, 2)):
        locator.displace(np.full((compat.owned_cells(domain), 3, 2), size))
        assert locator.locate(x).active.all()
        assert len(made) == trees


@pytest.mark.mpi
@pytest.mark.parametrize("motion", [prescribed(bubble), prescribed(breathing)])
def test_points_and_velocities_belong_to_the_level_of_the_equations(motion):
    """Velocities that are linear in space at the nodes of both steps are so at the points, but for curved paths."""
    fsi = scene(motion)
    mesh_time, flow_time = fsi.fluid.moving.time, fsi.timeInt_f
    mesh_time.advance()  # so that the mesh has a displacement at the old step
    mesh_time.predict()
    fsi.fluid.moving.move()
    V = mesh_time.x.function_space
    X, A = V.tabulate_dof_coordinates()[:, :2], np.array([[0.3, -1.2], [0.7, -0.3]])
    for w, u in ((flow_time.x, mesh_time.x), (flow_time.x_old, mesh_time.x_old)):
        w.x.array.reshape(-1, 3)[:, :2] = (X + u.x.array.reshape(-1, 2)) @ A.T
    assert largest(mesh_time.x.x.array - mesh_time.x_old.x.array) > 0.02
    locator, x = PointLocator(fsi.mesh_f), fsi.shell.positions()
    locator.displace(displacement_of_cells(fsi.fluid.moving))
    trace = trace_matrix(fsi.fluid.velocity_space, locator.locate(x))
    np.testing.assert_allclose(fsi.fluid.velocity_at(trace), x @ A.T, atol=1e-13)
    flow_time.x.x.array.reshape(-1, 3)[:, :2] = mesh_time.rates()[0].reshape(-1, 2) + np.array([3.0, -4.0])
    assert fsi.fluid.speed() == pytest.approx(5.0)  # past the mesh
    assert largest(mesh_time.rates()[0] - mesh_time.xdot_old.x.array) > 0.01


PROGRAM = """
import json
import numpy as np
from mpi4py import MPI
from test_moving_coupler import SMOOTHED, TIGHT, bubble, elastic, prescribed, scene, stream
figures = []
for motion, options in ((prescribed(bubble), TIGHT), (elastic, TIGHT), (prescribed(bubble), SMOOTHED)):
    fsi = scene(motion, walls=stream, options=options)
    reports = [fsi.takeStep() for _ in range(3)]
    figures += [fsi.spline_sh.nodal(fsi.y).tolist(), fsi.lam.tolist(), [r.passes for r in reports]]
    owned = fsi.timeInt_f.x.function_space.dofmap.index_map.size_local * 3
    kinetic = float(np.sum(fsi.timeInt_f.x.x.array[:owned].reshape(-1, 3)[:, :2] ** 2))
    figures.append(MPI.COMM_WORLD.allreduce(kinetic))
if MPI.COMM_WORLD.rank == 0:
    print(json.dumps(figures))
"""


@pytest.mark.skipif(COMM.size > 1 or MPIRUN is None, reason="already parallel, or no mpirun")
def test_two_ranks_find_the_same():
    one, two = (mpirun(ranks, "-c", PROGRAM) for ranks in (1, 2))
    assert one.returncode == two.returncode == 0, one.stderr[-2000:] + two.stderr[-2000:]
    for a, b in zip(*(json.loads(done.stdout.splitlines()[-1]) for done in (one, two)), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-8)


# -- failures ---------------------------------------------------------------------------------------------------------


def folding(x, t):
    """Inside out from t = 0.25 on; the gradient is then below -1."""
    s = ufl.conditional(ufl.gt(t, 0.25), 0.7, 0.02 * t)
    return ufl.as_vector([-s * ufl.sin(ufl.pi * x[0]), 0.0 * x[1]])


@pytest.mark.mpi
def test_a_mesh_that_is_inside_out_stops_the_step():
    fsi = scene(prescribed(folding), velocity=(0.3, 0.0))
    fsi.takeStep()
    fsi.takeStep()
    before = state(fsi)
    message = r"failed in the mesh block: the mesh is inside out.*suspect: the motion of the mesh"
    with pytest.raises(StepError, match=message) as caught:
        fsi.takeStep()
    assert caught.value.block == "mesh"
    assert caught.value.report.passes == 0
    for old, new in zip(before, state(fsi), strict=True):
        np.testing.assert_array_equal(old, new)
    fsi.step_size = 0.04
    assert fsi.takeStep().t == pytest.approx(0.24)


@pytest.mark.mpi
def test_nodes_without_balance_stop_the_step():
    def crushed(x, t):
        return ufl.as_vector([-1.5 * t / DT * x[0], 0.0 * x[1]])

    fsi = scene(lambda mesh, scheme: ElasticMotion(mesh, {"left": None, "right": crushed}, DT, scheme))
    before = state(fsi)
    with pytest.raises(StepError, match="mesh block") as caught:
        fsi.takeStep()
    assert caught.value.block == "mesh"
    for old, new in zip(before, state(fsi), strict=True):
        np.testing.assert_array_equal(old, new)


@pytest.mark.mpi
def test_a_later_failure_restores_the_mesh():
    fsi = scene(prescribed(bubble), sheet_velocity=(0.5, 0.0))
    fsi.takeStep()
    before = state(fsi)
    fsi.options = CouplingOptions(block_rtol=1e-15, block_atol=0.0, max_passes=1)
    with pytest.raises(StepError, match="no convergence in 1 passes"):
        fsi.takeStep()
    for old, new in zip(before, state(fsi), strict=True):
        np.testing.assert_array_equal(old, new)


@pytest.mark.mpi
def test_cells_that_are_inside_out_where_points_are_located():
    """On one rank, and all of them learn of it."""
    domain = box(COMM, (0.0, 0.0), (1.0, 1.0), (3, 3), "triangle").domain
    u = np.zeros((compat.owned_cells(domain), 3, 2))
    if COMM.rank == COMM.size - 1:
        corner, *others = compat.cell_vertices(domain)[0]
        u[0, 0] = sum(others) - 2.0 * corner  # to the other side of its edge
    locator = PointLocator(domain)
    with pytest.raises(SolveError, match="flat or inside out"):
        locator.displace(u)


# -- clocks and input -------------------------------------------------------------------------------------------------


def test_one_step_size():
    fsi = scene(prescribed(bubble))
    fsi.step_size = 0.03
    assert [time.step_size for time in fsi.integrators] == [0.03] * 3
    fsi.takeStep()
    assert [time.time for time in fsi.integrators] == [0.03] * 3
    assert fsi.fluid.moving.time in fsi.integrators


def couple(fsi, moving):
    """The scene with another motion."""
    fluid = FluidSubproblem(
        fsi.mesh_f,
        fsi.flow.residual,
        fsi.timeInt_f,
        bcs=fsi.flow.bcs,
        updates=fsi.flow.updates,
        band=fsi.fluid.band,
        moving=moving,
        density=1.0,
        viscosity=0.1,
    )
    return CouDALFISh(fluid, fsi.shell)


def test_what_is_refused():
    fsi = scene(prescribed(bubble))
    mesh = fsi.flow.mesh
    with pytest.raises(ValueError, match="displacement of degree 2: 1 is required"):
        couple(fsi, PrescribedMotion(mesh, bubble, DT, generalized_alpha(0.5), 2))
    with pytest.raises(ValueError, match="moving displaces another mesh"):
        couple(fsi, scene(prescribed(bubble)).fluid.moving)
    with pytest.raises(ValueError, match=r"order, alpha_f of the mesh: 2, 1.0: 2 and the fluid's 0.666"):
        check_levels(PrescribedMotion(mesh, bubble, DT, generalized_alpha(0.0)), fsi.timeInt_f)
    fsi.flow.moving.time.step_size = 0.2
    with pytest.raises(ValueError, match=r"clocks \(t, dt\): fluid \(0.0, 0.1\), mesh \(0.0, 0.2\)"):
        CouDALFISh(fsi.fluid, fsi.shell)
    fsi.flow.moving.time.step_size = DT
    fsi.flow.moving.time.advance()
    with pytest.raises(ValueError, match=r"clocks \(t, dt\).*must be equal"):
        couple(fsi, fsi.flow.moving)
    quads = box(COMM, (0.0, 0.0), (1.0, 1.0), (2, 2), "quadrilateral")
    with pytest.raises(ValueError, match="quadrilateral"):
        PointLocator(quads.domain)


def test_absence():
    """On a fixed mesh there is no integrator, no displaced vertex and nothing else of a motion."""
    gc.collect()
    before = sum(isinstance(item, TimeIntegrator) for item in gc.get_objects())
    fsi = sheet_in_flow((0.0, 0.0)).fsi
    fsi.takeStep()
    assert sum(isinstance(item, TimeIntegrator) for item in gc.get_objects()) - before == 2
    assert fsi.fluid.moving is None
    assert fsi.integrators == (fsi.timeInt_f, fsi.timeInt_sh)
    assert fsi.locator._displaced is None
