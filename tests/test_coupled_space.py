"""Surfaces in flows of tetrahedra whose fields differ on both sides of them, coupled."""

import math
from dataclasses import replace

import numpy as np
import pytest
import restarted
import ufl
from mpi4py import MPI
from dome import TIGHT, dome
from load import load_demo
from scenes import sheet_in_flow
from space import IN_SPACE, HeldSurface
from space_bodies import Obstacle, Sphere
from space_contact import Pair
from surface import setting_of

from coudalfish import CouplingOptions
from coudalfish.restart import CoupledState
from coudalfish.sides.shell import ShellSubproblem
from coudalfish.step import condensed
from coudalfish.surface.boxes import Boxes
from coudalfish.surface.covering import by_surfaces
from coudalfish.surface.polygons import ZeroPoints
from shnapr.contact import LinearKernel, SelfContact
from tigar_x.fem.linear import SolveError
from tigar_x.run.progress import rss_mib
from tigar_x.run.restart import Restart

pytestmark = pytest.mark.mpi
JUMP = CouplingOptions.converged(fluid_tangent="consistent", block_rtol=1e-10, block_atol=1e-14)


@pytest.mark.parametrize(
    ("immersed", "options"),
    [
        ("plain", CouplingOptions()),
        ("jump", CouplingOptions.converged(fluid_tangent="consistent")),
        ("jump and kink", CouplingOptions.sharp()),
    ],
)
def test_who_names_no_options_gets_those_that_suit_the_fields(immersed, options):
    assert dome(immersed, None).fsi.options == options


def test_a_surface_holds_a_pressure_that_jumps_without_any_options():
    """With a multiplier that lags, velocities are .1 on the way."""
    scene = HeldSurface(4, dt=0.05, ramp=1, steps=2)
    found = scene.run(replace(IN_SPACE, options=None, immersed="jump"))
    assert found.figures["highest"] < 1e-6


@pytest.mark.parametrize("case", ["jump", "sharp"])
def test_an_elastic_sheet_moves_with_the_fluid(case):
    s = dome(*{"jump": ("jump", JUMP), "sharp": ("jump and kink", TIGHT)}[case])
    before = s.shell.positions.copy()
    for _ in range(4):
        report = s.fsi.takeStep()
        assert report.attempts == 1
        assert report.passes <= 3
        assert report.monitors.force_imbalance < 1e-12
        assert abs(report.monitors.leak) < 1e-2 * report.monitors.normal_slip_max
    moved = s.shell.positions - before
    assert moved[:, 2].min() < -1e-3
    assert moved[:, 2].max() < 1e-4
    pushed = s.fsi.lam if case == "jump" else s.fsi.lam[:, 2]
    assert np.abs(pushed).max() < 2.0 * 0.3


def test_points_within_the_fluid_are_not_outside_of_it_however_many_there_are():
    """Some of them are closer to each other than the places at which polygons are integrated over."""
    s = dome("jump", CouplingOptions.converged(fluid_tangent="consistent"), n=2, elements=10)
    outside = np.abs(s.shell.positions[:, :2] - 0.5).max(axis=1) > 0.5
    assert 0 < s.fsi.takeStep().inactive_points <= outside.sum()


def test_the_unknowns_of_a_step_are_where_newtons_method_ends():
    """A wrong derivative by the forces on the nodes would leave more than a square of the first residual."""
    s = dome(options=TIGHT)
    for _ in range(3):
        report = s.fsi.takeStep()
        first, second = (norms[0] for norms in report.residuals[:2])
        assert second < 2e-3 * first


@pytest.mark.parametrize("place", [(Boxes, "nearest"), (by_surfaces, None), (ZeroPoints, "on")], ids=str)
def test_what_fails_on_one_rank_while_a_surface_is_placed_fails_on_all(place, monkeypatch):
    """The other ranks would wait for it in the sums over nodes that come next."""
    s, (owner, name) = dome("jump", JUMP, n=2), place
    s.fsi.takeStep()
    before = s.flow.time.x.x.array.copy()

    def fails(*arguments, **named):
        raise MemoryError("no room")

    def fails_on_the_last(*arguments, **named):
        return (fails if MPI.COMM_WORLD.rank == MPI.COMM_WORLD.size - 1 else kept)(*arguments, **named)

    with monkeypatch.context() as patch:
        if name is None:
            kept = by_surfaces
            patch.setattr(s.fsi.fluid._dividing._enriching, "_covering", fails_on_the_last)
        else:
            kept = getattr(owner, name)
            patch.setattr(owner, name, fails_on_the_last)
        with pytest.raises(MemoryError, match="no room"):
            s.fsi.takeStep()
    np.testing.assert_array_equal(s.flow.time.x.x.array, before)
    assert s.fsi.takeStep().attempts == 1


def test_a_step_that_fails_falls_back_and_the_next_one_goes_on(monkeypatch):
    s = dome(options=CouplingOptions.sharp())
    s.fsi.takeStep()

    def fails(self, *arguments):
        raise SolveError("no solution")

    with monkeypatch.context() as patch:
        patch.setattr(condensed.CondensedSystem, "solve", fails)
        assert s.fsi.takeStep().attempts == 4
    assert s.fsi.takeStep().attempts == 1


def test_solves_go_on_where_their_residual_stays_for_long(monkeypatch):
    """GMRES that loses orthogonality ends nowhere, as in a steady stream, where hardly anything is left to solve."""
    monkeypatch.setattr(condensed, "RTOL", 1e-14)
    monkeypatch.setattr(condensed, "ROUNDED", 1e-16)
    s = Obstacle(4).build(setting_of("sharp", IN_SPACE))
    assert s.step().attempts == 1


@pytest.mark.parametrize("immersed", ["jump", "jump and kink"])
def test_a_run_goes_on_from_a_checkpoint(immersed, tmp_path):
    options = TIGHT if immersed == "jump and kink" else JUMP
    folder = MPI.COMM_WORLD.bcast(tmp_path, root=0)
    whole, second = (dome(immersed, options).fsi for _ in range(2))
    for _ in range(2):
        whole.takeStep()
    Restart(folder, CoupledState(whole), every=1).write()
    Restart(folder, CoupledState(second), every=1).read()
    for fsi in (whole, second):
        for _ in range(2):
            fsi.takeStep()
    for one, other in zip(restarted.norms(whole), restarted.norms(second), strict=True):
        assert other == pytest.approx(one, rel=1e-10, abs=1e-13)


def swinging(case):
    """A sheet that a pressure moves up and down through the cells."""
    loose = CouplingOptions.converged(trace="nodes", fluid_tangent="consistent")
    fields = {"jump": ("jump", loose), "sharp": ("jump and kink", CouplingOptions.sharp())}[case]
    return dome(*fields, pressure=lambda t: 2.0 * ufl.sin(2.0 * math.pi * t / 1.37))


@pytest.mark.parametrize(
    ("case", "settled", "steps"),
    [
        ("jump", 25, 35),
        pytest.param("jump", 100, 400, marks=pytest.mark.slow),
        pytest.param("sharp", 100, 400, marks=pytest.mark.slow),
    ],
)
def test_memory_is_flat_while_other_cells_are_cut_in_every_step(case, settled, steps):
    """The smallest matrix of the flow has a fifth of a MiB."""
    s, middle = swinging(case), []
    for k in range(settled + steps):
        s.fsi.takeStep()
        middle.append(s.shell.at((0.5, 0.5)).displacement[2])
        if k == settled - 1:
            start = rss_mib()
    assert np.ptp(middle) > 1.0 / 3.0  # a cell
    assert rss_mib() - start < 1.5


def test_a_closed_sphere_keeps_what_is_in_it():
    """With a multiplier that lags a twentieth of it is lost."""
    found = Sphere(6, steps=3).run(setting_of("sharp", IN_SPACE))
    assert abs(found.figures["volume"]) < 1e-3


@pytest.mark.parametrize("apart", [0.3, 0.5])
def test_of_two_tilted_sheets_with_a_film_between_one_carries_the_jump(apart):
    """Nodes lie between them in some places. Signs from the nearest sheet leave speeds of 160 to 200."""
    pair = Pair(apart, slope=(0.31, 0.17), n=6, steps=4)
    found = pair.run(setting_of("jump", IN_SPACE))
    assert found.figures["highest"] < 1e-2
    assert found.figures["force"] == pytest.approx(0.0, abs=1e-4)


def test_the_load_is_asked_for_where_a_film_needs_it_alone():
    """A sheet that is alone, as any curve in the plane, needs none."""

    def asked(fsi):
        place, times = fsi.fluid.place, []

        def spied(meeting, sheets, x, v, load, **scales):
            return place(meeting, sheets, x, v, lambda: times.append(load()) or times[-1], **scales)

        fsi.fluid.place = spied
        fsi.takeStep()
        return len(times)

    assert asked(dome("jump", JUMP, n=2).fsi) == 0
    assert asked(Pair(0.5, n=4).build(setting_of("jump", IN_SPACE)).fsi) > 0


@pytest.mark.mpi
def test_two_sheets_in_one_place_carry_half_of_the_jump_each():
    """Their functions are the same: without a shift the multiplier's preconditioner is singular, and speeds are 7."""
    found = Pair(1e-6, n=4, steps=1).run(setting_of("jump", IN_SPACE))
    assert found.figures["highest"] < 1e-4
    assert found.figures["force"] == pytest.approx(0.0, abs=1e-6)


@pytest.mark.mpi
def test_two_sheets_that_a_sudden_pressure_presses_together_do_not_bounce():
    """Nothing tells before the first step which of them carries it: by the wrong one they are a tenth apart at once."""
    pair = Pair(0.5, n=4, touching=True, steps=3)
    found = pair.run(setting_of("jump", IN_SPACE))
    assert found.figures["distance"] == pytest.approx(0.0, abs=0.01)
    assert found.figures["contact"] == pytest.approx(0.0, abs=0.15)
    assert found.figures["force"] == pytest.approx(0.0, abs=0.06)


def in_plane(options):
    """Two sheets that come near each other."""
    ends = ((0.4, 0.2), (0.4, 0.8)), ((0.45, 0.2), (0.45, 0.8))
    velocity = [(1.0, 0.0), (-1.0, 0.0)]

    def contact(quadrature):
        return SelfContact(quadrature, LinearKernel(0.06, 1e3), 0.07, neighbours="surface")

    return sheet_in_flow(
        (0.0, 0.0), ends=ends, sheet_velocity=velocity, contact=contact, n=4, dt=0.005, options=options
    ).fsi


def pressed(options):
    """Two plates in space that touch, in a flow whose fields are the same on both sides."""
    setting = setting_of("plain" if options.multiplier == "lagged" else "converged", IN_SPACE)
    return Pair(0.5, n=4, touching=True).build(setting).fsi


@pytest.mark.parametrize(
    ("scene", "options", "expected"),
    [
        (pressed, CouplingOptions.converged(), True),
        (pressed, CouplingOptions(), False),
        (in_plane, CouplingOptions.converged(), False),
        (in_plane, CouplingOptions(), False),
    ],
)
def test_a_converged_multiplier_in_space_has_a_positive_tangent_of_contact(scene, options, expected, monkeypatch):
    fsi, asked, assemble = scene(options), [], ShellSubproblem.assemble_tangent

    def noted(self, W, penalty, *, positive=False):
        asked.append(positive)
        assemble(self, W, penalty, positive=positive)

    monkeypatch.setattr(ShellSubproblem, "assemble_tangent", noted)
    assert fsi.takeStep().attempts == 1
    assert fsi.shell.touching is not None
    assert set(asked) == {expected}


def test_leaflets_that_a_sudden_pressure_closes_take_one_attempt_a_step():
    """With all of contact's tangent five of them take two to four attempts, and up to 42 passes."""
    demo = load_demo("heart_valve")
    fsi = demo.Valve(resolution=6, dt=2e-4, preset="jump").build(replace(demo.Data(), systolic=-1e5))[2]
    reports = [fsi.takeStep() for _ in range(36)]
    assert sum(report.contact.pairs > 0 for report in reports) > 10
    assert [report.attempts for report in reports] == [1] * 36
    assert max(report.passes for report in reports) <= 8


def test_the_pressure_in_a_sphere_is_that_of_its_tension():
    """Polygons on its inner side, where the signed distance of the nodes is zero, would make it 8 % higher."""
    found = Sphere(8, steps=4).run(setting_of("jump", IN_SPACE))
    assert found.figures["inside"] == pytest.approx(0.0, abs=2e-3)
    assert found.figures["load"] == pytest.approx(0.0, abs=5e-3)
