"""Coupled steps of flows whose fields differ on both sides of curves: failures, units, ranks, walls, ends."""

import numpy as np
import pytest
from mpi4py import MPI
from divided import CONVERGED, FLAP, INSIDE, LAGGED, TIGHT, channel, everything, line
from test_repeated_steps import assert_same, assert_same_report, changed, interrupted

from coudalfish import CouDALFISh, CouplingOptions, StepError
from coudalfish.surface.distance import Curves
from shnapr import ContactRecipe, LinearKernel, Shell, StVenantKirchhoff
from tigar_x import compat
from tigar_x.fem.linear import SolveError, direct, gmres_ilu
from tigar_x.geometry import shapes
from tigar_x.geometry.gluing import glued
from tigar_x.geometry.multipatch import disjoint
from tigar_x.geometry.patch import Patch
from varmint import Flow, FlowOptions, Traction, Velocity, box

pytestmark = pytest.mark.mpi
COMM = MPI.COMM_WORLD
STICKING = (Velocity(("bottom", "top")),)
ACROSS = ((0.43, 0.0), (0.46, 1.0))
TIPS = ((0.44, 0.0), (0.44, 0.42)), ((0.44, 0.58), (0.44, 1.0))


def steps(s, number=3):
    """Take steps; the last report."""
    return [s.fsi.takeStep() for _ in range(number)][-1]


def figures(s):
    """Numbers that do not depend on the ranks: norms of the fluid's fields, the shell and the multiplier."""
    time, V = s.flow.time, s.flow.V
    owned = V.dofmap.index_map.size_local * V.dofmap.index_map_bs
    squares = np.array([np.sum(f.x.array[:owned] ** 2) for f in (time.x, time.second_old, time.xdot_old)])
    squares = V.mesh.comm.allreduce(squares, op=MPI.SUM)
    return [*np.sqrt(squares), *s.shell.y.x.array, *s.fsi.lam.ravel()]


# -- failures ---------------------------------------------------------------------------------------------------------

SCENES = {
    "converged": lambda: channel(FLAP),
    "lagged": lambda: channel(INSIDE, clamped=(), options=LAGGED),
    "jump": lambda: channel(FLAP, immersed="jump", options=CONVERGED.with_(multiplier_direction="normal")),
    "iterative": lambda: channel(FLAP, n=10, solver=gmres_ilu(1)),
    "dynamic": lambda: channel(FLAP, subscales="dynamic"),
}


def broken_tangent(fsi):
    """Whatever is tried fails once the surface has been placed."""

    def fail(*_):
        raise SolveError("as told")

    with changed(fsi.fluid, assemble_tangent=fail), pytest.raises(StepError, match="as told"):
        fsi.takeStep()


def too_few_passes(fsi):
    """All attempts run, and move the shell."""
    options = fsi.options.with_(block_rtol=1e-15, block_atol=0.0, max_passes=1)
    with changed(fsi, options=options), pytest.raises(StepError, match="no convergence"):
        fsi.takeStep()


def too_long(fsi):
    """What is divided is elsewhere when it fails."""
    with changed(fsi, step_size=4.0 * fsi.step_size):
        too_few_passes(fsi)


FAILURES = too_few_passes, too_long, broken_tangent, interrupted


@pytest.mark.parametrize("name", SCENES if COMM.size == 1 else ("converged", "lagged"))
def test_a_step_after_failures_is_that_without_them(name):
    plain, tried = (SCENES[name]().fsi for _ in "ab")
    for number in range(3):
        before = everything(tried)
        for fail in FAILURES if number != 1 else FAILURES[::-1]:
            fail(tried)
            assert_same(everything(tried), before, 0.0)
        expected, report = plain.takeStep(), tried.takeStep()
        assert_same_report(report, expected)
        assert_same(everything(tried), everything(plain))


def test_a_step_that_is_halved_leaves_nothing_of_the_long_one():
    whole, halves = (channel(FLAP) for _ in "ab")
    steps(whole, 1)
    steps(halves, 1)
    halves.fsi.step_size /= 2.0
    expected = steps(halves, 2)
    assemble, calls = whole.fsi.fluid.assemble_tangent, []

    def refuse(*arguments):
        """In all attempts."""
        calls.append(0)
        if len(calls) <= 4:
            raise SolveError("as told")
        assemble(*arguments)

    whole.fsi.fluid.assemble_tangent = refuse
    for report in whole.fsi.run(until=whole.fsi.timeInt_f.time + 0.05, halvings=1):
        assert report.attempts == 1
    halves.fsi.step_size = whole.fsi.step_size  # of the next step
    assert expected.t == pytest.approx(whole.fsi.timeInt_f.time)
    assert_same(everything(whole.fsi), everything(halves.fsi), 1e-9)  # times are rounded


def test_divided_cells_remember_no_sub_scales():
    """Those of the plain fields mean nothing there: they would be what a cell begins with that is whole again."""
    s = channel(FLAP, subscales="dynamic")
    for _ in range(2):
        steps(s, 1)
        time, divided = s.flow.time, s.flow.sides.doubled.cells
        for f in (time.fine, time.fine_rate):
            values = np.abs(f.x.array.reshape(len(divided), -1)[compat.cell_dofs(f.function_space)[:, 0]]).max(axis=1)
            assert values[divided].max(initial=0.0) == 0.0
            assert COMM.allreduce(float(values[~divided].max()), op=MPI.MAX) > 1e-3


# -- units and ranks --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("options", [CONVERGED, LAGGED], ids=["converged", "lagged"])
@pytest.mark.parametrize("units", [(1e3, 1.0, 1.0), (1.0, 1e-3, 1.0), (1.0, 1.0, 1e3)], ids=["length", "time", "mass"])
def test_steps_are_the_same_in_all_units(units, options):
    """Kinks have to be velocities for that, or their equations would count in norms by the unit of length."""
    s, scaled = channel(FLAP, options=options), channel(FLAP, options=options, units=units)
    for _ in range(3):
        report, other = steps(s, 1), steps(scaled, 1)
        assert (other.passes, other.attempts) == (report.passes, 1)
        # linear iterations end by norms that are rounded
        assert abs(other.linear_iterations - report.linear_iterations) <= 1
    L, T, M = units
    np.testing.assert_allclose(scaled.shell.y.x.array / L, s.shell.y.x.array, rtol=0.0, atol=1e-7)
    force = M / (L * T**2)
    np.testing.assert_allclose(scaled.fsi.lam / force, s.fsi.lam, rtol=0.0, atol=1e-5 * np.abs(s.fsi.lam).max())


CLAMPED = ("start", "end")
RANKED = {
    "flap": ((FLAP,), CONVERGED),
    "lagged": ((FLAP,), LAGGED),
    "tips": (TIPS, CONVERGED),
    "inside": ((INSIDE,), CONVERGED),
}


@pytest.mark.skipif(COMM.size == 1, reason="compares several ranks with one")
@pytest.mark.parametrize("name", RANKED)
def test_several_ranks_take_the_steps_of_one(name):
    lines, options = RANKED[name]
    found, passes = [], []
    for comm in (MPI.COMM_SELF, COMM):
        mesh = box(comm, (0.0, 0.0), (1.0, 1.0), (8, 8))
        clamped = () if name == "inside" else ("start", "end") if name == "tips" else ("start",)
        s = channel(*lines, mesh=mesh, options=options.with_(**TIGHT), clamped=clamped)
        passes.append([s.fsi.takeStep().passes for _ in range(5)])
        found.append(figures(s))
    assert passes[0] == passes[1]
    np.testing.assert_allclose(found[1], found[0], rtol=1e-8, atol=1e-8 * np.abs(found[0][3:]).max())


# -- walls and ends ---------------------------------------------------------------------------------------------------


def test_where_a_wall_holds_the_velocity_it_is_not_kinked():
    s = channel(ACROSS, walls=STICKING, clamped=("start", "end"), inflow=(0.0, 0.0))
    steps(s, 1)
    V, second = s.flow.V, s.flow.time.is_second.reshape(-1, 3)
    x = V.tabulate_dof_coordinates()[:, :2]
    on_wall = np.abs(x[:, 1] - 0.5) > 0.5 - 1e-9
    held = np.zeros(len(x))
    for i in (0, 1):
        held += second[:, i] * on_wall
    assert not held.any()
    assert COMM.allreduce(int((second[:, 2] * on_wall).sum()), op=MPI.SUM) >= 4
    slipping = channel(ACROSS, clamped=("start", "end"), inflow=(0.0, 0.0))
    steps(slipping, 1)
    second = slipping.flow.time.is_second.reshape(-1, 3)[on_wall]
    assert not second[:, 1].any()
    assert COMM.allreduce(int(second[:, 0].sum()), op=MPI.SUM) >= 4


@pytest.mark.parametrize("walls", [None, STICKING], ids=["slip", "sticking"])
def test_a_sheet_between_walls_is_tight(walls):
    """It is held across a channel into which a pressure pushes; fields that know nothing of it let fluid pass."""
    leaks = []
    for kind, options in (("jump and kink", CONVERGED), ("plain", CouplingOptions())):
        pushed = Traction("left", (1.0, 0.0))
        s = channel(ACROSS, inlet=pushed, walls=walls, immersed=kind, options=options, held=True)
        leaks.append(abs(steps(s, 10).monitors.leak))
    assert leaks[0] < 1e-6
    assert leaks[1] > 1e-3


def test_which_way_sheets_are_parametrised_does_not_matter():
    """Two leaflets whose tips are a cell apart; between them one normal is not the other."""
    low, high = TIPS
    shells = []
    for end in (high, high[::-1]):
        sides = {"start": (0, 0), "end": (0, 1)} if end is high else {"start": (0, 1), "end": (0, 0)}
        upper = shapes.line(*end, elements=12, degree=2, side_names=sides)
        s = channel(geometry=disjoint(line(low), upper), options=CONVERGED.with_(**TIGHT), clamped=CLAMPED)
        steps(s)
        at = [s.shell.at(side, patch=k).displacement for k, side in ((0, "end"), (1, "start"))]
        shells.append([*at, np.abs(s.shell.y.x.array).max()])
    for found, expected in zip(*shells, strict=True):
        np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-8)
    assert shells[0][-1] > 1e-2


def ring(radius=0.23, elements=6):
    """Four quarters of a circle, glued, every other one parametrised backwards."""
    quarters = []
    for k in range(4):
        line_of = shapes.line((0.0, 0.0), (1.0, 0.0), elements=elements, degree=2)
        angle = 0.5 * np.pi * (k + line_of.points[:, 0])
        quarter = Patch.from_points(line_of.bases, 0.51 + radius * np.column_stack([np.cos(angle), np.sin(angle)]))
        quarters.append(quarter.reversed(0) if k % 2 else quarter)
    return glued(*quarters)


def area(fsi):
    """Within the closed curve of a shell."""
    curves = Curves.of(fsi.shell.sheets, fsi.shell.positions())
    a, b = curves.x[curves.chain.segments].transpose(1, 0, 2)
    return abs(0.5 * float((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum()))


def test_a_closed_ring_of_several_patches_keeps_its_area():
    """A flow takes it along and deforms it; fields that know nothing of it let fluid pass."""
    changes = []
    for kind, options in (("jump and kink", CONVERGED), ("plain", CouplingOptions())):
        s = channel(geometry=ring(), n=12, dt=0.02, clamped=(), immersed=kind, options=options)
        before = area(s.fsi)
        assert all(s.fsi.takeStep().attempts == 1 for _ in range(8))
        changes.append(abs(area(s.fsi) / before - 1.0))
        if s.flow.sides is not None:
            own = s.flow.V.dofmap.index_map.size_local
            counts = COMM.allreduce(s.flow.sides.doubled.second[:own].sum(axis=0), op=MPI.SUM)
            assert counts.min() > 30
            assert counts[0] == counts[1] == counts[2]
    assert changes[0] < 0.1 * changes[1]


@pytest.mark.mpi
def test_sheets_that_run_into_each_other_press_the_fluid_out_and_touch():
    """With what a flow and a shell get by themselves. Both are in one cell then; the fluid between them leaves as fast
    as they come, and they part again. Without contact they come nearer."""
    apart = []
    for contact in (ContactRecipe(LinearKernel(0.06, 1e7), 0.072, spacing=None), None):
        ends = [((x, 0.2), (x, 0.8)) for x in (0.4, 0.6)]
        geometry, known = disjoint(*map(line, ends)), {"rho": 1.0, "mu": 0.01, "dt": 0.005}
        mesh, walls = box(COMM, (0.0, 0.0), (1.0, 1.0), (8, 8)), [Velocity(("left", "right", "bottom", "top"))]
        flow = Flow(mesh, walls, **known, immersed=True, options=FlowOptions(solver=direct(), pressure="pin"))
        shell = Shell(geometry, StVenantKirchhoff(10.0, 0.3, 0.05), density=1000.0, contact=contact)
        half = geometry.n // 2
        shell.start(velocity=np.repeat([[1.0, 0.0], [-1.0, 0.0]], half, axis=0))
        fsi, gaps = CouDALFISh(flow, shell), []
        assert fsi.options == CouplingOptions.sharp()
        for _ in range(28 if contact else 20):
            report = fsi.takeStep()
            assert report.attempts == 1
            assert report.passes <= 4
            x = shell.positions[:, 0]
            gaps.append(x[len(x) // 2 :].min() - x[: len(x) // 2].max())
            if contact is None and len(gaps) == 16:
                fastest = np.abs(flow.w.x.array.reshape(-1, 3)[:, :2]).max()
                assert COMM.allreduce(fastest, op=MPI.MAX) > 5.0  # 0.3 by 2 over the gap is 12
        apart.append(gaps)
    touching, free = apart
    assert 0.03 < min(touching) < 0.06
    assert touching[-1] > min(touching) + 0.02
    assert free[-1] < 0.02


def test_a_sheet_that_leaves_the_fluid_divides_what_is_left_in_it():
    s = channel(((0.8, 0.5), (1.4, 0.55)), clamped=())
    report = steps(s)
    assert report.attempts == 1
    assert report.inactive_points > 5
    found = s.flow.sides.doubled
    x = compat.cell_vertices(s.flow.mesh.domain).mean(axis=1)[found.cells]
    assert COMM.allreduce(float(x[:, 0].max(initial=0.0)), op=MPI.MAX) > 0.9
    assert COMM.allreduce(float(x[:, 0].min(initial=1.0)), op=MPI.MIN) > 0.65


def test_a_sheet_that_is_nowhere_in_the_fluid_divides_nothing():
    """Dynamic sub-scales have no cross and Reynolds stress in flows without sides either."""
    away = {"clamped": (), "subscales": "dynamic"}
    s, other = (channel(((x, 0.5), (x + 0.4, 0.55)), **away) for x in (1.9, 1e3))
    free = channel(((1.9, 0.5), (2.3, 0.55)), immersed="plain", **away)
    for each in (s, other, free):
        steps(each)
    assert not s.flow.sides.doubled.cells.any()
    for each in (other, free):
        np.testing.assert_allclose(each.flow.w.x.array, s.flow.w.x.array, rtol=0.0, atol=1e-6)


def test_along_lines_of_the_mesh_pressures_jump_and_steps_converge():
    """Where phi is rounded to zero at nodes; on which side of them it is decides only what the tip's cells are."""
    places = 0.5, 0.5 - 1e-9, 0.5 + 1e-9
    found = [channel(((x, 0.0), (x, 0.53)), options=CONVERGED.with_(**TIGHT)) for x in places]
    for each in found:
        assert steps(each).attempts == 1
    tips = np.array([each.shell.at("end").displacement[:2] for each in found])
    assert min(np.abs(tips[0] - tip).max() for tip in tips[1:]) < 1e-6
    np.testing.assert_allclose(tips[:, 0], tips[0, 0], rtol=0.02)
