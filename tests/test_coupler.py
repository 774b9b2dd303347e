"""Coupled steps: invariants, acceptance, and what happens when a step fails."""

import logging
from dataclasses import replace

import numpy as np
import pytest
from mpi4py import MPI
from scenes import sheet_in_flow

from coudalfish import CouDALFISh, CouplingOptions, PenaltyRule, StepError
from tigar_x import compat
from tigar_x.fem.linear import gmres_ilu
from tigar_x.fem.schemes import backward_euler, generalized_alpha
from tigar_x.fem.time_integration import TimeIntegrator

TIGHT = CouplingOptions(block_rtol=1e-11, block_atol=1e-13)


def state(scene):
    """Everything that a step may change."""
    fields = [scene.w, scene.y]
    for time in (scene.fluid.timeInt, scene.shell.timeInt):
        fields += [time.x_old, time.xdot_old] + ([time.xddot_old] if time.scheme.order == 2 else [])
    clocks = [float(t.timeInt.t.value) for t in (scene.fluid, scene.shell)]
    return [f.x.array.copy() for f in fields] + [scene.fsi.lam.copy(), np.array(clocks)]


@pytest.mark.mpi
@pytest.mark.parametrize("velocity", [(0.3, 0.2), (-0.1, 0.4)])
@pytest.mark.parametrize("taylor_hood", [False, True])
def test_free_sheet_in_uniform_flow_translates_exactly(velocity, taylor_hood):
    scene = sheet_in_flow(velocity, options=TIGHT, taylor_hood=taylor_hood)
    for step in range(1, 4):
        report = scene.fsi.takeStep()
        shift = np.array(velocity) * 0.1 * step
        np.testing.assert_allclose(scene.shell.spline.nodal(scene.y), np.tile(shift, (17, 1)), atol=1e-10)
        assert np.abs(scene.fsi.lam).max() < 1e-9
        assert abs(report.monitors.leak) < 1e-10
        assert report.monitors.normal_slip_max < 1e-10


@pytest.mark.mpi
def test_rational_sheet_translates_exactly_and_balances():
    """Weights enter positions, velocities, normals, forces and tangents of the coupling."""

    def weights(n):
        return np.random.default_rng(0).uniform(0.5, 2.0, n)

    scene = sheet_in_flow((0.3, 0.2), options=TIGHT, weights=weights)
    for step in range(1, 4):
        scene.fsi.takeStep()
        np.testing.assert_allclose(scene.shell.spline.nodal(scene.y) - np.array([0.03, 0.02]) * step, 0.0, atol=1e-10)
    normals = scene.shell.normals()
    assert np.abs(normals - normals.mean(axis=0)).max() < 1e-10
    assert np.linalg.norm(normals[0]) == pytest.approx(1.0, abs=1e-10)
    pushed = sheet_in_flow((0.0, 0.0), sheet_velocity=(0.5, 0.0), options=TIGHT, weights=weights)
    report = pushed.fsi.takeStep()
    spline, time = pushed.shell.spline, pushed.shell.timeInt
    (momentum,) = compat.compile_forms(0.05 * spline.rationalize(time.xddot_old)[0] * spline.dx)
    assert report.monitors.force[0] < 0.0
    rate = time.scheme.alpha_m * compat.assemble_scalar(momentum)
    assert rate == pytest.approx(report.monitors.force[0], rel=1e-9)


@pytest.mark.mpi
@pytest.mark.parametrize("taylor_hood", [False, True])
def test_sheet_that_moves_through_fluid_at_rest_is_slowed_and_pushes_back(taylor_hood):
    scene = sheet_in_flow((0.0, 0.0), sheet_velocity=(0.5, 0.0), taylor_hood=taylor_hood, options=TIGHT)
    reports = [scene.fsi.takeStep() for _ in range(3)]
    assert max(report.monitors.force_imbalance for report in reports) < 1e-11
    assert reports[0].monitors.force[0] < 0.0
    velocity = scene.shell.spline.nodal(scene.shell.timeInt.xdot_old)[:, 0]
    assert velocity.mean() < 0.45
    assert np.abs(scene.w.x.array).max() > 1e-3


@pytest.mark.parametrize("change", [{"fluid_tangent": "consistent"}, {"normal": "iterate"}, {"tangent_update": "pass"}])
def test_the_way_to_the_solution_does_not_change_it(change):
    """Tangents only steer the iteration; the normal of the iterate differs from the predictor's at second order."""
    results = []
    for options in (TIGHT, replace(TIGHT, **change)):
        scene = sheet_in_flow((0.0, 0.0), sheet_velocity=(0.5, 0.0), options=options)
        for _ in range(3):
            scene.fsi.takeStep()
        results.append(np.concatenate([scene.w.x.array, scene.y.x.array]))
    difference = np.abs(results[0] - results[1]).max()
    assert difference < (1e-4 if "normal" in change else 1e-8)


@pytest.mark.mpi
def test_smoothed_relaxation_changes_the_multiplier_alone_and_keeps_its_force():
    """In one step, whose fields are solved with the multiplier before it; in uniform mode the force shrinks."""
    lams, states = {}, []
    r = 0.5
    for mode, relaxation in (("none", 0.0), ("uniform", r), ("smoothed", r)):
        changes = {} if mode == "none" else {"relaxation_mode": mode}
        options = replace(TIGHT, relaxation=relaxation, **changes)
        scene = sheet_in_flow((0.0, 0.0), sheet_velocity=(0.5, 0.0), density_of_points=32, options=options)
        scene.fsi.takeStep()
        lams[mode] = scene.fsi.lam
        states.append(np.concatenate([scene.w.x.array, scene.y.x.array]))
    W = scene.shell.quadrature.weights
    for other in states[1:]:
        np.testing.assert_allclose(other, states[0], atol=1e-9)
    whole = lams["none"]
    np.testing.assert_allclose(lams["uniform"], whole / (1.0 + r), rtol=1e-12)
    assert W @ lams["smoothed"] == pytest.approx(W @ whole, rel=1e-9)
    assert np.abs(lams["smoothed"] - whole).max() > 1e-3 * np.abs(whole).max()


def test_data_of_both_sides_are_asked_for_at_the_level_of_the_equations():
    """rho_infinity = 1/2: two thirds of the step."""
    scene, asked = sheet_in_flow((0.0, 0.0)), []
    for side in (scene.fluid, scene.shell):
        side.updates = (asked.append,)
    for _ in range(2):
        assert scene.fsi.takeStep().t_alpha == asked[-1]
    np.testing.assert_allclose(asked, 0.1 * np.array([2 / 3, 2 / 3, 5 / 3, 5 / 3]), rtol=1e-13)


def test_published_stopping_costs_a_superfluous_pass():
    passes = []
    for stopping in ("before_solve", "published"):
        options = CouplingOptions(stopping=stopping, tangent_update="pass", block_rtol=1e-3)
        scene = sheet_in_flow((0.0, 0.0), sheet_velocity=(0.5, 0.0), options=options)
        passes.append(sum(scene.fsi.takeStep().passes for _ in range(3)))
    assert passes[0] < passes[1]


def test_nothing_to_do_is_accepted_without_a_solve():
    scene = sheet_in_flow((0.0, 0.0), rho_infinity=0.0)
    report = scene.fsi.takeStep()
    assert report.passes == 0
    assert not scene.w.x.array.any()
    assert not scene.y.x.array.any()


@pytest.mark.mpi
def test_points_outside_are_inactive_on_both_sides():
    """A sheet that lies outside moves ballistically, keeps its multiplier and leaves the fluid alone."""
    ends = ((1.5, 0.2), (1.6, 0.8))
    scene = sheet_in_flow((0.0, 0.0), sheet_velocity=(0.5, 0.1), ends=ends, options=TIGHT)
    scene.fsi.lam[:] = 3.0
    report = scene.fsi.takeStep()
    assert report.inactive_points == 17
    np.testing.assert_allclose(scene.shell.spline.nodal(scene.y), np.tile([0.05, 0.01], (17, 1)), atol=1e-12)
    assert (scene.fsi.lam == 3.0).all()
    assert np.abs(scene.w.x.array).max() < 1e-12
    assert report.monitors.force == (0.0, 0.0)


@pytest.mark.mpi
def test_sheet_that_sticks_out_feels_the_fluid_only_inside():
    scene = sheet_in_flow((0.0, 0.0), sheet_velocity=(0.0, 0.3), ends=((0.5, 0.5), (1.5, 0.5)), options=TIGHT)
    report = scene.fsi.takeStep()
    assert report.inactive_points == 8
    assert report.monitors.force_imbalance < 1e-11
    assert np.abs(scene.fsi.lam[scene.shell.quadrature.points[:, 0] > 1.0]).max() == 0.0


def test_a_change_of_units_changes_nothing():
    """The same physics in other units of length, time and mass gives the same passes and scaled results."""
    length, time, mass = 100.0, 1e-3, 1e3
    plain = sheet_in_flow((0.0, 0.0), sheet_velocity=(0.5, 0.2))
    u, stress = length / time, mass / (length * time**2)
    # per unit depth: lengths of the depth scale too, so forces per depth are stress * length
    scaled = sheet_in_flow(
        (0.0, 0.0),
        sheet_velocity=(0.5 * u, 0.2 * u),
        length=length,
        dt=0.1 * time,
        rho=mass / length**3,
        mu=0.1 * stress * time,
        rho_s=mass / length**3,
        stiffness=10.0 * stress,
    )
    for _ in range(3):
        reports = [scene.fsi.takeStep() for scene in (plain, scaled)]
        assert reports[0].passes == reports[1].passes
        assert reports[0].slip_ratio == pytest.approx(reports[1].slip_ratio, rel=1e-6)
    y = [scene.shell.spline.nodal(scene.y) for scene in (plain, scaled)]
    np.testing.assert_allclose(y[1] / length, y[0], rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(scaled.fsi.lam / stress, plain.fsi.lam, rtol=1e-5, atol=1e-8)
    np.testing.assert_allclose(np.array(scaled.fsi.floors) / (stress * length), plain.fsi.floors, rtol=1e-4)


# -- failure ----------------------------------------------------------------------------------------------------------


@pytest.mark.mpi
def test_a_failed_step_restores_the_last_good_state_and_can_be_repeated():
    options = CouplingOptions(block_rtol=1e-13, block_atol=0.0, max_passes=1)
    scene = sheet_in_flow((0.0, 0.0), sheet_velocity=(0.5, 0.0), options=options)
    before = state(scene)
    with pytest.raises(StepError, match="no convergence in 1 passes") as caught:
        scene.fsi.takeStep()
    for old, new in zip(before, state(scene), strict=True):
        np.testing.assert_array_equal(old, new)
    assert caught.value.block in ("fluid", "shell")
    assert caught.value.suspect
    assert caught.value.report.passes == 1
    scene.fsi.options = CouplingOptions()
    assert scene.fsi.takeStep().t == pytest.approx(0.1)


@pytest.mark.mpi
@pytest.mark.parametrize("side", ["fluid", "shell"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_data_that_are_not_finite_are_refused_and_named(side, value):
    scene = sheet_in_flow((0.1, 0.0))
    scene.fsi.takeStep()
    before = state(scene)
    (scene.g if side == "fluid" else scene.load).value[0] = value
    with pytest.raises(StepError, match="not finite") as caught:
        scene.fsi.takeStep()
    assert caught.value.block == side
    for old, new in zip(before, state(scene), strict=True):
        np.testing.assert_array_equal(old, new)
    (scene.g if side == "fluid" else scene.load).value[0] = 0.1 if side == "fluid" else 0.0
    scene.fsi.takeStep()


def test_interruption_by_anything_else_restores_too():
    scene = sheet_in_flow((0.0, 0.0), sheet_velocity=(0.5, 0.0))
    before = state(scene)

    def fail(t_alpha):
        scene.w.x.array[:] = 7.0
        raise KeyboardInterrupt

    scene.fluid.updates = (fail,)
    with pytest.raises(KeyboardInterrupt):
        scene.fsi.takeStep()
    for old, new in zip(before, state(scene), strict=True):
        np.testing.assert_array_equal(old, new)


def test_suspect_is_the_slip_ratio_when_the_penalty_is_too_small():
    options = CouplingOptions(penalty=1e-4, block_rtol=1e-15, block_atol=0.0, max_passes=2)
    scene = sheet_in_flow((0.0, 0.0), sheet_velocity=(0.5, 0.0), options=options)
    scene.fsi.lam[:] = 1.0
    with pytest.raises(StepError, match=r"slip ratio .*raise the penalty beta.* advised at most 0.3"):
        scene.fsi.takeStep()


def test_suspect_is_the_linear_solver_when_its_tolerance_is_too_loose():
    options = CouplingOptions(block_rtol=1e-9, max_passes=5)
    loose = gmres_ilu(1, rtol=1e-2)
    scene = sheet_in_flow((0.0, 0.0), sheet_velocity=(0.5, 0.0), options=options, solver=loose)
    with pytest.raises(StepError, match=r"suspect: linear solver's residual.*tighten its rtol"):
        scene.fsi.takeStep()


def test_warnings_once_for_slip_and_for_spacing(caplog):
    options = CouplingOptions(penalty=1e-2)
    scene = sheet_in_flow((0.0, 0.0), density_of_points=2, options=options)
    scene.fsi.lam[:] = 1.0
    with caplog.at_level(logging.WARNING, logger="coudalfish"):
        reports = [scene.fsi.takeStep() for _ in range(2)]
    texts = [record.getMessage() for record in caplog.records]
    assert sum("slip ratio" in text for text in texts) == 1
    assert sum("immersed points are up to" in text for text in texts) == 1
    assert all(report.slip_ratio > 0.3 for report in reports)


# -- input ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("penalty", 0.0),
        ("penalty", np.nan),
        ("relaxation", -1.0),
        ("relaxation_mode", "by cell"),
        ("scale_m", 0.0),
        ("scale_c", 2.0),
        ("fluid_tangent", "exact"),
        ("normal", "final"),
        ("stopping", "never"),
        ("tangent_update", "never"),
        ("block_rtol", -1e-3),
        ("block_atol", np.inf),
        ("max_passes", 0),
    ],
)
def test_bad_options_are_named(option, value):
    with pytest.raises(ValueError, match=f"{option} = .*required"):
        CouplingOptions(**{option: value})


def test_bad_penalty_rules():
    with pytest.raises(ValueError, match="C_1 = -1"):
        PenaltyRule(-1.0, 0.0)
    with pytest.raises(ValueError, match="C_1 = C_2 = 0"):
        PenaltyRule(0.0, 0.0)


def test_penalty_rule():
    fsi = sheet_in_flow(options=CouplingOptions(penalty=PenaltyRule(2.0, 0.5))).fsi
    h = 1.0 / 6.0
    assert fsi.fluid.mesh_size == pytest.approx(h)
    assert fsi.penalty == pytest.approx(2.0 * 0.1 / h + 0.5 * 1.0 * h / 0.1)


def test_reference_options_are_the_published_algorithm():
    options = CouplingOptions.reference()
    assert options.penalty == PenaltyRule(1.0, 0.0)
    assert options.scale_m == options.scale_c == 1e-3
    assert (options.relaxation, options.relaxation_mode) == (0.0, "uniform")
    assert (options.fluid_tangent, options.normal, options.stopping) == ("lumped", "iterate", "published")


@pytest.mark.mpi
@pytest.mark.parametrize(
    "settings",
    [
        {"velocity": (0.0, 0.0), "traction": 1.0},
        {"velocity": (0.0, 0.0), "sheet_velocity": (0.5, 0.0)},
        {"velocity": (0.3, 0.2)},
        {"velocity": (0.3, 0.2), "traction": 1.0},
        {"velocity": (0.3, 0.2), "sheet_velocity": (0.0, 0.0)},
        {"velocity": (0.0, 0.0)},
    ],
    ids=["loaded", "sheet moves", "all moves", "all moves and is loaded", "flow moves", "nothing moves"],
)
def test_the_published_algorithm_starts_from_rest_and_from_uniform_flow(settings):
    """Where one residual, or both, begin with nothing but rounding; it comes to what tight stopping gives."""
    options = CouplingOptions(penalty=2.0, relaxation=0.0, block_rtol=1e-8, normal="iterate", scale_c=1e-3)
    given = {"options": options} | settings
    exact, published = sheet_in_flow(**given), sheet_in_flow(**given)
    published.fsi.options = replace(CouplingOptions.reference(), penalty=2.0)
    for _ in range(3):
        exact.fsi.takeStep()
        assert published.fsi.takeStep().passes < 30
    y, expected = published.y.x.array, exact.y.x.array
    np.testing.assert_allclose(y, expected, rtol=0.0, atol=2e-3 * np.abs(expected).max() + 1e-12)


def test_subproblems_must_fit():
    scene, other = sheet_in_flow(), sheet_in_flow(dt=0.05)
    with pytest.raises(ValueError, match=r"clocks \(t, dt\).*must be equal"):
        CouDALFISh(scene.fluid, other.shell)
    with pytest.raises(ValueError, match=r"alpha_f: fluid 0\.66.*, shell 1: .*same rho_infinity"):
        CouDALFISh(scene.fluid, sheet_in_flow(rho_infinity=0.0).shell)
    scene.fluid.density = None
    with pytest.raises(ValueError, match="penalty rule needs the fluid's density"):
        CouDALFISh(scene.fluid, scene.shell)
    for multiplier in (np.nan, np.ones(3), np.ones((17, 2)), "much", None, np.full(17, np.inf)):
        with pytest.raises(ValueError, match=r"^multiplier.*required"):
            CouDALFISh(scene.fluid, scene.shell, CouplingOptions(penalty=1.0), multiplier=multiplier)
    start = CouDALFISh(scene.fluid, scene.shell, CouplingOptions(penalty=1.0), multiplier=np.arange(17))
    np.testing.assert_array_equal(start.lam, np.arange(17.0))


@pytest.mark.parametrize(
    ("side", "scheme", "message"),
    [
        ("shell", generalized_alpha(0.5, 2), r"^alpha_m: fluid 0\.8333.*, shell 1: .*first_order_alpha_m=True"),
        ("shell", backward_euler(2), r"^alpha_f: fluid 0\.6666.*, shell 1: .*same rho_infinity"),
        ("shell", generalized_alpha(0.5, 2, first_order_alpha_m=True), None),
        ("shell", generalized_alpha(0.5), None),
        ("fluid", generalized_alpha(0.5), r"^algebraic = \(\) of the fluid's integrator: \(2,\) is required"),
        ("fluid", generalized_alpha(0.5, 2), "^order of the fluid's scheme = 2: 1 is required"),
    ],
)
def test_both_sides_share_all_levels_and_the_pressure_is_not_integrated(side, scheme, message):
    """At rho_infinity = 1/2 the shell's own alpha_m would be 1, the fluid's is 5/6."""
    scene = sheet_in_flow()
    x = scene.fluid.timeInt.x if side == "fluid" else scene.shell.timeInt.x
    getattr(scene, side).timeInt = TimeIntegrator(x, 0.1, scheme)
    if message is None:
        CouDALFISh(scene.fluid, scene.shell)
        return
    with pytest.raises(ValueError, match=message):
        CouDALFISh(scene.fluid, scene.shell)


@pytest.mark.parametrize(("name", "value"), [("rho", 0.0), ("mu", -1.0), ("dt", 0.0), ("stiffness", -1.0)])
def test_bad_physics_is_refused_before_computing(name, value):
    with pytest.raises(ValueError, match=f"= {value}"):
        sheet_in_flow(**{name: value})


def test_memory_does_not_grow():
    from tigar_x.run.progress import rss_mib

    scene = sheet_in_flow((0.0, 0.0), sheet_velocity=(0.02, 0.0))
    for _ in range(20):
        scene.fsi.takeStep()
    start = rss_mib()
    for _ in range(150):
        scene.fsi.takeStep()
    assert rss_mib() - start < 2.0
    assert MPI.COMM_WORLD.size >= 1


@pytest.mark.mpi
def test_a_shell_that_is_fixed_is_a_wall():
    """It stays where it is to the last bit, and takes the force of the flow against it."""
    scene = sheet_in_flow((0.3, 0.0), sheet_velocity=(0.0, 0.0), held=True)
    for _ in range(2):
        report = scene.fsi.takeStep()
    assert not scene.y.x.array.any()
    assert report.monitors.force[0] > 0.01
    assert report.monitors.force_imbalance < 1e-9
