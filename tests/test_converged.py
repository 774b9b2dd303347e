"""A multiplier that is converged in the step: what it is made of, what it solves, and what it falls back to."""

from itertools import pairwise

import numpy as np
import pytest
import restarted
from mpi4py import MPI
from mpi_runs import SAME_RUN
from scenes import free_sheet, sheet_in_flow
from scipy.sparse import csr_matrix
from test_coupled_contact import approaching
from test_watch import piston

from coudalfish import CouDALFISh, CouplingOptions, PenaltyRule, StepError
from coudalfish.restart import CoupledState
from coudalfish.step import condensed
from coudalfish.step.attempts import FALLBACK, attempts
from coudalfish.step.converged import Converged
from coudalfish.step.functions import nearest_coefficients
from coudalfish.surface.hats import hat_functions
from coudalfish.surface.sheets import Sheets
from tigar_x.fem.linear import SolveError, direct, gmres_ilu
from tigar_x.fem.schemes import generalized_alpha
from tigar_x.geometry import shapes
from tigar_x.geometry.bspline import BSplineBasis, periodic_knots
from tigar_x.geometry.gluing import glued
from tigar_x.geometry.multipatch import disjoint
from tigar_x.geometry.patch import Patch
from tigar_x.run.restart import Restart
from tigar_x.splines.spline import ExtractedSpline
from varmint.conditions import Resistance, Slip, Traction
from varmint.flow import Flow, FlowOptions
from varmint.mesh import box

TIGHT = CouplingOptions.converged(block_rtol=1e-9, block_atol=1e-13)


def in_flow(options=TIGHT, **changes):
    """A sheet that a flow takes along."""
    return sheet_in_flow((0.0, 0.0), sheet_velocity=(0.5, 0.2), dt=0.05, n=8, options=options, **changes)


# -- functions --------------------------------------------------------------------------------------------------------


def hats_on(geometry, size):
    """Points, their signs, and the functions there."""
    spline = ExtractedSpline(geometry, MPI.COMM_SELF)
    sheets = Sheets.of(spline)
    return sheets, hat_functions(spline, sheets, spline.node_areas, size).toarray(), spline.node_areas


def test_functions_sum_to_one_and_are_linear_between_the_lines_of_a_grid_of_their_own():
    sheets, N, _ = hats_on(shapes.line((0.0, 0.0), (1.2, 0.9), elements=10), 0.26)
    s = np.hypot(*sheets.X.T)
    assert N.shape[1] == 7
    np.testing.assert_allclose(N, np.maximum(0.0, 1.0 - np.abs(s[:, None] / 0.25 - np.arange(7))), atol=1e-12)


def test_where_elements_are_larger_than_functions_there_are_none_without_points():
    """A strip of one element across, on which functions of a third of its width are wanted."""
    strip = shapes.parallelogram((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.3, 0.0), elements=(20, 1), degrees=(1, 1))
    _, N, areas = hats_on(strip, 0.1)
    assert N.shape[1] == 2 * 11
    assert (areas @ N > 0.0).all()
    np.testing.assert_allclose(N.sum(axis=1), 1.0, atol=1e-12)


def test_leaflets_that_are_mirror_images_have_functions_that_are():
    """Whichever way each of them is parametrised, and whatever its length is to the grid's cells."""
    low, high = shapes.line((2.0, 0.0), (2.0, 0.7), elements=9), shapes.line((2.0, 0.9), (2.0, 1.6), elements=9)
    for other in (high, high.reversed(0)):
        sheets, N, _ = hats_on(disjoint(low, other), 0.3)
        mirrored = np.argsort(np.abs(sheets.X[:, 1] - 0.8), kind="stable").reshape(-1, 2)
        below = sheets.X[mirrored[:, 0], 1] < 0.8
        pairs = np.where(below[:, None], mirrored, mirrored[:, ::-1])
        first, second = N[pairs[:, 0]][:, :3], N[pairs[:, 1]][:, 3:]
        turned = other is high
        np.testing.assert_allclose(first, second[:, ::-1] if turned else second, atol=1e-12)


def test_functions_go_on_across_joints_along_normals_that_agree():
    """A bent line in two parts, the second one parametrised backwards, and a closed line."""
    ends = (0.0, 0.0), (1.0, 0.0), (1.5, 1.0)
    parts = [shapes.line(*pair, elements=8) for pair in pairwise(ends)]
    sheets, N, _ = hats_on(glued(parts[0], parts[1].reversed(0)), 0.25)
    assert N.shape[1] == 4 + 1 + 4
    assert set(sheets.sign) == {1.0, -1.0}
    a, b = sheets.joints[0]
    np.testing.assert_array_equal(sheets.sign[a] * N[a], sheets.sign[b] * N[b])
    np.testing.assert_allclose(N.sum(axis=1), sheets.sign, atol=1e-13)
    loop = [shapes.line(*pair, elements=8) for pair in pairwise((*ends, ends[0]))]
    assert hats_on(glued(*loop), 0.25)[1].shape[1] == 4 + 4 + 7


def test_functions_of_a_closed_curve_go_on_at_its_seam():
    """One patch without ends: every function is as large as the others."""
    circle = BSplineBasis(2, periodic_knots(2, np.linspace(0.0, 2.0 * np.pi, 33)), periodic=True)
    sheets, N, area = hats_on(shapes.interpolated(lambda t: (np.cos(t), np.sin(t)), [circle]), 2.0 * np.pi / 8.0)
    assert N.shape[1] == 8
    np.testing.assert_allclose(N.T @ area, area.sum() / 8.0, rtol=5e-3)
    (a, b), *others = sheets.joints
    assert not others
    np.testing.assert_array_equal(N[a], N[b])


def test_functions_on_surfaces_are_products():
    sheets, N, area = hats_on(
        shapes.parallelogram((0, 0, 0), (1, 0, 0), (0, 0.5, 0), elements=(8, 4), degrees=(1, 1)), 0.25
    )
    assert N.shape[1] == 5 * 3
    linear = sheets.X @ [2.0, -1.0, 0.0] + 3.0
    np.testing.assert_allclose(N @ (nearest_coefficients(csr_matrix(N), area) @ linear), linear, atol=1e-12)


@pytest.mark.parametrize(("size", "width", "left"), [(0.2, 1.0, 19), (0.125, 0.3, 21), (0.125, 0.05, 4)])
def test_small_functions_are_merged_with_their_neighbours(size, width, left):
    """On triangles, whose grid's lines have no length at one end: no more than has to be."""
    triangle = Patch.from_points(
        shapes.parallelogram((0, 0, 0), (1, 0, 0), (0, 1, 0), elements=(8, 8), degrees=(1, 1)).bases,
        np.array([[r * (1 - t), r * t * width, 0.0] for t in np.linspace(0, 1, 9) for r in np.linspace(0, 1, 9)]),
    )
    _, N, area = hats_on(triangle, size)
    assert (N.T @ area).min() >= 0.2 * size**2
    assert N.shape[1] == left
    np.testing.assert_allclose(N.sum(axis=1), 1.0, atol=1e-12)


def test_a_short_curve_has_a_function_of_its_own_and_takes_none_from_others():
    _, N, _ = hats_on(
        disjoint(shapes.line((0, 0), (0.3, 0), elements=4), shapes.line((0, 1), (3, 1), elements=12)), 1.0
    )
    np.testing.assert_array_equal(np.unique(N[:, 0]), [0.0, 1.0])
    assert N.shape[1] == 1 + 4


def test_coefficients_are_those_of_the_nearest_multiplier_in_the_mean_over_areas():
    sheets, N, area = hats_on(shapes.line((0.0, 0.0), (1.2, 0.9), elements=10), 0.26)
    area, lam = area * (1.0 + sheets.X[:, 0]), np.cos(7.0 * sheets.X[:, 0])
    np.testing.assert_allclose(
        N.T @ (area * (lam - N @ (nearest_coefficients(csr_matrix(N), area) @ lam))), 0.0, atol=1e-14
    )


# -- steps ------------------------------------------------------------------------------------------------------------


@pytest.mark.mpi
@pytest.mark.parametrize("mass_ratio", [1.0, 1e-4])
def test_a_piston_on_a_spring_comes_back_in_time_at_fifty_steps_a_period(warned, mass_ratio):
    """With a multiplier that lags it is 14 and 18 percent late."""
    found = piston(50, mass_ratio=mass_ratio, multiplier="converged", penalty=PenaltyRule(10.0, 0.0))
    assert found.frequency == pytest.approx(1.0, abs=0.003)
    assert not any("passed the shell" in text or "fall back" in text for text in warned())


@pytest.mark.mpi
@pytest.mark.parametrize("solver", [direct(), gmres_ilu(1)], ids=["direct", "gmres"])
@pytest.mark.parametrize(("normal", "trace"), [("predictor", "nodes"), ("iterate", "nodes"), ("predictor", "exact")])
def test_a_step_converges_as_newton_s_method_does_and_no_fluid_passes_in_the_mean(solver, normal, trace):
    s = in_flow(TIGHT.with_(normal=normal, trace=trace), solver=solver, traction=0.2)
    for _ in range(3):
        report = s.fsi.takeStep()
        norms = np.array(report.residuals)
        assert report.attempts == 1
        assert report.passes <= 5
        assert norms[1, 0] < (1e-2 if report.passes > 1 else 1e-6) * norms[0, 0]
    # the leak is one over the present area, the functions' means are over that at rest
    assert abs(report.monitors.leak) < 1e-3 * report.monitors.normal_slip_max
    assert report.monitors.force_imbalance < 1e-12


def test_the_multiplier_is_one_of_its_functions_and_is_what_the_next_step_starts_from():
    s = in_flow()
    s.fsi.takeStep()
    functions, n = s.fsi.attempts[0].method.functions, np.zeros((len(s.fsi.lam), 2))
    values = functions.values(functions.fitted(s.fsi.lam, n, own_normals=False), n, own_normals=False)
    np.testing.assert_allclose(values, s.fsi.lam, rtol=0.0, atol=1e-12 * np.abs(s.fsi.lam).max())
    assert np.abs(s.fsi.lam).max() > 0.0


@pytest.mark.mpi
def test_a_vector_leaves_no_slip_in_the_means_of_its_functions(monkeypatch):
    sides = ((0.35, 0.25), (0.4, 0.5)), ((0.45, 0.75), (0.4, 0.5))  # joined, with normals to different sides
    s = in_flow(TIGHT.with_(multiplier_direction="vector"), traction=0.2, ends=sides, join=True)
    slip = []
    monkeypatch.setattr(s.fsi.watch, "finished", lambda step, report: slip.append(step.u - step.y_dot))
    for _ in range(2):
        assert s.fsi.takeStep().attempts == 1
    assert s.fsi.lam.shape == (len(s.shell.quadrature.points), 2)
    N, W = s.fsi.attempts[0].method.functions.areas_t.T, s.shell.quadrature.weights[:, None]
    np.testing.assert_allclose(N.sum(axis=1), 1.0, atol=1e-13)
    assert np.abs(N.T @ (W * slip[-1])).max() < 1e-6 * (N.T @ (W * np.abs(slip[-1]))).max()


@pytest.mark.mpi
def test_a_vector_falls_back_to_its_part_along_the_normals(monkeypatch):
    options = CouplingOptions.converged(multiplier_direction="vector")
    s = in_flow(options, ends=((0.4, 0.25), (0.4, 0.75)))
    s.fsi.takeStep()

    def fails(self, *arguments):
        raise SolveError("no solution")

    monkeypatch.setattr(condensed.CondensedSystem, "solve", fails)
    assert s.fsi.takeStep().attempts == 4
    assert np.abs(s.fsi.lam[:, 1]).max() < 5e-2 * np.abs(s.fsi.lam[:, 0]).max()
    monkeypatch.undo()
    assert s.fsi.takeStep().attempts == 1


def test_the_direction_of_the_multiplier_may_change_between_steps():
    for first, then in (("vector", "normal"), ("normal", "vector")):
        s = in_flow(CouplingOptions.converged(multiplier_direction=first), ends=((0.4, 0.25), (0.4, 0.75)))
        s.fsi.takeStep()
        s.fsi.options = s.fsi.options.with_(multiplier_direction=then)
        for _ in range(2):
            assert s.fsi.takeStep().attempts == 1
        along, across = np.abs(s.fsi.lam[:, 0]).max(), np.abs(s.fsi.lam[:, 1]).max()
        assert s.fsi.lam.shape == (len(s.shell.quadrature.weights), 2)
        assert along > 0.0
        assert across < 5e-2 * along or then == "vector"


@pytest.mark.parametrize("kind", ["plain", "vector", "contact"])
def test_a_run_goes_on_from_a_checkpoint(kind, tmp_path):
    make = {
        "plain": lambda: in_flow().fsi,
        "vector": lambda: in_flow(TIGHT.with_(multiplier_direction="vector")).fsi,
        "contact": lambda: approaching(speed=6.0, dt=0.004, options=TIGHT).fsi,  # in steps 4 and 5
    }[kind]
    whole, first, second = make(), make(), make()
    for _ in range(6):
        report = whole.takeStep()
        assert report.attempts == 1
    for _ in range(3):
        first.takeStep()
    Restart(tmp_path, CoupledState(first), every=1).write()
    Restart(tmp_path, CoupledState(second), every=1).read()
    for _ in range(3):
        second.takeStep()
    for one, other in zip(restarted.norms(whole), restarted.norms(second), strict=True):
        assert other == pytest.approx(one, rel=1e-10, abs=1e-13)


def test_contact_keeps_sheets_apart():
    s = approaching(options=CouplingOptions.converged())
    pairs = []
    for _ in range(40):
        report = s.fsi.takeStep()
        assert report.attempts == 1
        pairs.append(report.contact.pairs)
    assert max(pairs) > 0


@pytest.mark.mpi
def test_points_outside_the_fluid_have_no_multiplier(warned):
    ends = ((0.55, 0.5), (0.93, 0.5))
    options = CouplingOptions.converged(multiplier_size=1.0)  # one of them ends up outside
    s = sheet_in_flow((0.0, 0.0), sheet_velocity=(0.5, 0.0), ends=ends, rho_s=100.0, options=options)
    inactive = []
    for _ in range(12):
        report = s.fsi.takeStep()
        assert report.attempts == 1
        inactive.append(report.inactive_points)
    assert inactive[0] == 0
    assert 4 < inactive[6] < inactive[-1]
    assert not any("fall back" in text for text in warned())


@pytest.mark.mpi
def test_a_sheet_that_does_not_move():
    """It is the flow alone that answers its multiplier."""
    s = in_flow(held=True)
    for _ in range(2):
        report = s.fsi.takeStep()
        assert report.attempts == 1
        assert report.linear_iterations < 15 * report.passes
    assert abs(report.monitors.leak) < 1e-8


@pytest.mark.mpi
def test_a_closed_curve_keeps_what_is_in_it(warned):
    """Four light sheets that are joined, dropped into a flow: with a multiplier that lags the seventh step fails."""
    corners = (0.3, 0.3), (0.7, 0.32), (0.68, 0.7), (0.32, 0.68)
    sides = list(pairwise((*corners, corners[0])))
    start = {"ends": sides, "join": True, "stiffness": 50.0, "sheet_velocity": (0.0, 0.0)}
    s = sheet_in_flow(n=12, dt=0.05, mu=0.01, options=CouplingOptions.converged(), **start)
    before = area_inside(s)
    for _ in range(10):
        assert s.fsi.takeStep().attempts == 1
    assert np.abs(s.fsi.spline_sh.nodal(s.fsi.timeInt_sh.x)).max() > 0.05
    assert area_inside(s) == pytest.approx(before, rel=1e-3)
    assert not any("fall back" in text for text in warned())


def area_inside(s):
    """Area of the polygon of a closed curve's points."""
    a, b = (s.shell.quadrature.points + s.fsi.spline_sh.nodal(s.fsi.timeInt_sh.x))[s.shell.sheets.cells.T]
    return 0.5 * np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])


@pytest.mark.mpi
def test_outlets_with_a_large_resistance():
    """Their dense part is in the products: the flow rate follows from the resistance."""
    mesh = box(MPI.COMM_WORLD, (0.0, 0.0), (1.0, 0.25), (8, 4))
    sides = [Traction("left", (1.0, 0.0)), Slip(("bottom", "top")), Resistance("right", 1e3)]
    known = {"rho": 1.0, "mu": 0.1, "dt": 0.05, "scheme": generalized_alpha(0.5), "immersed": True}
    flow = Flow(mesh, sides, **known, options=FlowOptions(solver=direct()))
    sheet = free_sheet(ends=((0.52, 0.02), (0.52, 0.23)), dt=0.05)
    fsi = CouDALFISh(flow, sheet.shell, CouplingOptions.converged())
    for _ in range(2):
        report = fsi.takeStep()
    assert (report.passes, report.attempts) == (1, 1)


def test_factors_of_the_shell_s_tangent_serve_products_and_its_own_solution():
    s = in_flow()
    s.fsi.takeStep()
    system, W = s.shell.system, s.shell.quadrature.weights
    b = np.random.default_rng(0).random(system.b.getLocalSize())
    found = []
    for beta in (1.0, 2.0):
        s.shell.assemble_tangent(W, beta)
        system.b.array_w[:] = b
        before = system.solve().array_r.copy()
        found.append(system.inverse(b))
        np.testing.assert_allclose(found[-1], before, rtol=1e-9)
        np.testing.assert_array_equal(system.solve().array_r, found[-1])
    assert np.abs(found[1] - found[0]).max() > 1e-3 * np.abs(found[0]).max()


def watched(monkeypatch):
    """Whether preconditioners of flow and multiplier are kept, for every pass."""
    kept, plain = [], Converged.prepared

    def watching(self, at):
        kept.append((at.fluid.system._solver.keeps, self.preconditioner is not None))
        return plain(self, at)

    monkeypatch.setattr(Converged, "prepared", watching)
    return kept


@pytest.mark.mpi
def test_preconditioners_are_kept_as_the_flow_s_recipe_says(monkeypatch):
    found = []
    for growth in (None, 3.0):
        s, kept = in_flow(solver=gmres_ilu(1, rebuild_growth=growth)), watched(monkeypatch)
        passes = [s.fsi.takeStep().passes for _ in range(3)]
        starts = np.cumsum([0, *passes[:-1]])
        for of_flow, of_multiplier in (kept[k] for k in starts[1:]):
            assert (of_flow, of_multiplier) == (growth is not None, growth is not None)
        assert kept[0] == (False, False)
        found.append(restarted.norms(s.fsi))
    assert found[1] == pytest.approx(found[0], rel=1e-6)


@pytest.mark.mpi
def test_preconditioners_with_which_a_step_has_failed_are_not_kept(monkeypatch):
    s = in_flow(solver=gmres_ilu(1, rebuild_growth=3.0))
    s.fsi.takeStep()
    kept = watched(monkeypatch)
    monkeypatch.setattr(condensed, "ITERATIONS", 1)
    with pytest.raises(StepError):
        s.fsi.takeStep()
    assert kept[:2] == [(True, True), (False, False)]


# -- what fails -------------------------------------------------------------------------------------------------------


@pytest.mark.mpi
def test_a_step_that_fails_falls_back_to_a_lagged_smoothed_multiplier_and_says_so_once(warned, monkeypatch):
    fallen, lagged = in_flow(CouplingOptions.converged()), in_flow(CouplingOptions(**FALLBACK))
    monkeypatch.setattr(condensed, "ITERATIONS", 1)
    for _ in range(3):
        reports = [s.fsi.takeStep() for s in (fallen, lagged)]
    assert [report.attempts for report in reports] == [4, 1]
    assert restarted.norms(fallen.fsi) == pytest.approx(restarted.norms(lagged.fsi), rel=max(SAME_RUN, 1e-12))
    assert sum("fall back to a lagged multiplier" in text for text in warned()) == (MPI.COMM_WORLD.rank == 0)


def test_a_step_that_fails_is_first_tried_with_tangents_in_every_pass(warned, monkeypatch):
    tried, whole = in_flow(CouplingOptions.converged()), in_flow(CouplingOptions.converged(tangent_update="pass"))
    solve, calls = condensed.CondensedSystem.solve, []

    def fails_once(*arguments):
        calls.append(0)
        if len(calls) == 1:
            raise SolveError("as told")
        return solve(*arguments)

    whole.fsi.takeStep()
    monkeypatch.setattr(condensed.CondensedSystem, "solve", fails_once)
    tried.fsi.takeStep()
    assert len(calls) > 1
    assert restarted.norms(tried.fsi) == pytest.approx(restarted.norms(whole.fsi), rel=1e-12)
    assert sum("assemble tangents in every pass" in text for text in warned()) == (MPI.COMM_WORLD.rank == 0)
    assert not any("fall back to a lagged multiplier" in text for text in warned())


@pytest.mark.mpi
def test_a_step_that_goes_on_failing_meets_the_shell_where_it_was(warned, monkeypatch):
    s = in_flow(CouplingOptions.converged())
    solve, place, met = condensed.CondensedSystem.solve, s.fsi.fluid.place, []

    def places(meeting, sheets, x, *arguments, **scales):
        met.append(x)
        return place(meeting, sheets, x, *arguments, **scales)

    def fails_twice(*arguments):
        if len(met) < 3:
            raise SolveError("as told")
        return solve(*arguments)

    start = s.shell.quadrature.points
    monkeypatch.setattr(s.fsi.fluid, "place", places)
    monkeypatch.setattr(condensed.CondensedSystem, "solve", fails_twice)
    report = s.fsi.takeStep()
    assert (report.attempts, len(met)) == (3, 3)
    assert np.abs(met[0] - start).max() > 1e-3
    np.testing.assert_array_equal(met[1], met[0])
    np.testing.assert_array_equal(met[2], start)
    moved = s.fsi.spline_sh.nodal(s.fsi.timeInt_sh.x)
    assert np.abs(moved).max() > 1e-3
    assert sum("meet the shell where it was before the step" in text for text in warned()) == (MPI.COMM_WORLD.rank == 0)


@pytest.mark.mpi
def test_a_lagged_multiplier_that_fails_as_well_is_tried_with_caution(monkeypatch):
    s, calls = in_flow(CouplingOptions.converged()), []
    solve = type(s.fsi.fluid).solve

    def fails_once(self, first):
        calls.append(first)
        if len(calls) == 2:
            raise SolveError("as told")
        return solve(self, first=first)

    monkeypatch.setattr(condensed, "ITERATIONS", 1)
    monkeypatch.setattr(type(s.fsi.fluid), "solve", fails_once)
    assert s.fsi.takeStep().attempts == 5


def test_a_penalty_that_cannot_follow_from_the_fluid_stays_what_it_is():
    s = in_flow(CouplingOptions.converged(penalty=3.0))
    known = attempts(s.fsi.options, s.fluid, s.shell)
    s.fluid.density = None
    unknown = attempts(s.fsi.options, s.fluid, s.shell)
    assert [ways[-1].options.penalty for ways in (known, unknown)] == [FALLBACK["penalty"], 3.0]


def test_a_step_that_fails_in_every_way_leaves_the_last_good_state(monkeypatch):
    s = in_flow(CouplingOptions.converged())
    s.fsi.takeStep()
    before = restarted.norms(s.fsi)

    def fails(self):
        raise SolveError("no solution")

    monkeypatch.setattr(type(s.shell), "solve", fails)
    with pytest.raises(StepError, match="no solution"):
        s.fsi.takeStep()
    assert restarted.norms(s.fsi) == before


def test_a_multiplier_that_lags_is_normal():
    with pytest.raises(ValueError, match="'normal' is required"):
        CouplingOptions(multiplier_direction="vector")


def test_a_converged_multiplier_is_tested_before_a_pass_solves():
    with pytest.raises(ValueError, match="stopping 'before_solve' is required"):
        CouplingOptions.reference(multiplier="converged")
