"""Stiff and extreme cases hold what they must; the cases are those that benchmarks/stability.py tabulates.

Every bound of a table row is asserted here. Where the library does not reach what one would wish, the test says so in
its docstring and asserts the strongest statement that is true.
"""

import csv

import numpy as np
import pytest
import stability
import stability_runs
import stability_scenes

from coudalfish import CouplingOptions


def outcomes(name):
    """Outcomes of the fast values of a case, by value."""
    return {value: stability.outcome(name, value) for value in stability.CASES[name].values}


def ran(results):
    """All of them ran; their figures by value."""
    assert results
    for value, outcome in results.items():
        assert outcome.result == "ran", f"{value}: {outcome.message}"
        assert outcome.passes_max <= 100
        assert np.isfinite(list(outcome.observed.values())).all()
    return {value: outcome.observed for value, outcome in results.items()}


def test_shell_mass():
    """Nine decades around the fluid's mass and four above it; no added-mass instability."""
    results = outcomes("shell mass rho_s")
    observed = ran(results)
    assert {min(observed), max(observed)} == {1e-9, 1e4}
    for rho_s, errors in observed.items():
        assert results[rho_s].passes_mean <= 5.0
        for norm in ("L2_u", "H1_u", "L2_p"):
            assert errors[norm] == pytest.approx(observed[1.0][norm], rel=0.05)


def test_shell_mass_of_a_released_membrane():
    results = outcomes("shell mass rho_s, released membrane")
    for rho_s, energy in ran(results).items():
        assert results[rho_s].passes_mean <= 5.0
        assert energy["largest rise per step"] < 1e-9
    assert results[1e-9].observed["last"] == pytest.approx(results[1e-3].observed["last"], rel=1e-2)


def test_stiff_sheets_are_walls():
    for observed in ran(outcomes("stiffness x 1e6")).values():
        assert observed["velocity differs by"] < 2e-3
        assert observed["multiplier differs by"] < 1e-3
        assert observed["deflection"] < 1e-5


def test_stiff_membrane_at_a_tight_tolerance():
    """The rounding of large tensions may hinder convergence; it must then be an error and not a result."""
    for outcome in outcomes("stiffness x 1e6, block_rtol = 1e-6").values():
        if outcome.result == "ran":
            assert outcome.observed["velocity differs by"] < 2e-3
        else:
            assert outcome.result == "stopped"
            assert "failed in the shell block: no convergence in 100 passes" in outcome.message


def test_penalty():
    """Errors within three times the best over two decades; C = 1e3 converges, and what does not, names beta."""
    results = outcomes("penalty beta = C mu/h")
    usual = {C: outcome for C, outcome in results.items() if C <= 10.0}
    observed = ran(usual)
    assert {min(usual), max(usual)} == {0.1, 10.0}
    for norm in ("L2_u", "H1_u", "L2_p", "L2_y", "H1_y"):
        errors = [figures[norm] for figures in observed.values()]
        assert max(errors) <= 3.0 * min(errors)
    assert results[100.0].result == results[1e3].result == "ran"
    assert "raise the penalty" in results[0.1].message
    stopped = [outcome for outcome in results.values() if outcome.result == "stopped"]
    assert stopped
    for outcome in stopped:
        assert "penalty beta" in outcome.message


def test_viscosity():
    """The default penalty does not vanish with viscosity.

    H1 u is not bounded so: its error is that of the mesh, which no longer resolves the layers.
    """
    observed = ran(outcomes("viscosity mu"))
    small = [figures["L2_u"] for mu, figures in observed.items() if mu <= 1e-3]
    assert len(small) >= 3
    assert max(small) <= 1.3 * observed[1e-3]["L2_u"]
    assert observed[10.0]["L2_u"] <= 1.3 * observed[0.1]["L2_u"]


def test_viscosity_with_a_penalty_that_vanishes_with_it():
    results = outcomes("viscosity mu, beta = mu/h")
    default = outcomes("viscosity mu")
    for mu, observed in ran(results).items():
        assert "raise the penalty" in results[mu].message
        assert observed["L2_u"] > 1.5 * default[mu].observed["L2_u"]


def test_small_time_steps():
    """Velocity and displacement do not suffer.

    The pressure does, below dt (|u|/h + nu/h^2) = 1e-3, where tau_M = dt/2 has nothing left to stabilise with, and no
    warning says so yet.
    """
    observed = ran(outcomes("time step x, first 5 steps of the manufactured problem"))
    for errors in observed.values():
        assert errors["L2_u"] <= observed[1.0]["L2_u"]
        assert errors["H1_u"] <= observed[1.0]["H1_u"]
        assert errors["L2_y"] <= observed[1.0]["L2_y"]
    assert observed[1e-2]["L2_p"] <= 1.5 * observed[1.0]["L2_p"]
    assert observed[1e-3]["L2_p"] <= 6.0 * observed[1.0]["L2_p"]


def test_time_steps_in_the_duct():
    results = outcomes("time step x, rho_infinity: duct")
    for (factor, _), observed in ran(results).items():
        assert observed["largest speed"] < 1.0
        assert 0.0 < observed["lam/jump"] < 2.0
        assert ("reduce dt" in results[factor, _].message) == (factor > 1.0)


def test_time_steps_in_the_closed_box():
    """Backward Euler and rho_infinity = 0 damp a large step's motion away, rho_infinity = 1 only keeps it bounded."""
    results = outcomes("time step x, rho_infinity: closed box")
    for (factor, rho), energy in ran(results).items():
        assert energy["largest"] <= 1.0 + 1e-9
        if rho is None:
            assert energy["largest rise per step"] < 1e-9
        if factor == 1e3 and rho != 1.0:
            assert energy["last"] < 1e-3
        assert ("reduce dt" in results[factor, rho].message) == (factor > 1.0)


def test_slip_after_a_load_change():
    """The slip law holds at the points for every jump.

    The volume that really passes follows it where grad-div is strong (scale_c = 1e-3); with the default 0.02 a little
    more passes between the points.
    """
    results = outcomes("pressure jump, dt = 0.01/sqrt(jump)")
    observed = ran(results)
    assert {1.0, 1e5} <= {load for load, _, _ in observed}
    for (_, _, scale_c), figures in observed.items():
        assert figures["slip/law"] == pytest.approx(1.0, abs=0.2)
        assert figures["outflow/law"] == pytest.approx(1.0, abs=0.05 if scale_c == 1e-3 else 0.2)
    for bow in (0.0, 0.1):
        speeds = [v["largest speed/sqrt(jump)"] for (_, b, s), v in observed.items() if b == bow and s == 1e-3]
        assert max(speeds) <= 1.1 * min(speeds)


def test_spurious_velocity_is_proportional_to_the_jump():
    """Over four decades; beyond, inertia makes it smaller."""
    results = outcomes("pressure jump at rest, dt = 0.01, beta = 5e3")
    observed = ran(results)
    for load, figures in observed.items():
        if load <= 1e4:
            assert "slip" not in results[load].message  # its multiplier is there from the start
        assert figures["slip/law"] == pytest.approx(1.0, abs=0.2)
        assert figures["largest speed/jump"] <= 1.001 * observed[1.0]["largest speed/jump"]
        if load <= 1e4:
            assert figures["largest speed/jump"] == pytest.approx(observed[1.0]["largest speed/jump"], rel=0.05)


def test_jumps_that_are_too_large_for_the_time_step_are_finite_and_warned_of():
    results = outcomes("pressure jump, dt = 0.01, defaults")
    for load, figures in ran(results).items():
        assert figures["slip ratio"] > 0.3
        assert "raise the penalty" in results[load].message


def test_steady_leak():
    for figures in ran(outcomes("leak with r > 0")).values():
        assert figures["leak/law"] == pytest.approx(1.0, abs=0.02)
        assert figures["outflow/law"] == pytest.approx(1.0, abs=0.1)


def test_impulsive_load():
    for figures in ran(outcomes("impulsive load 2e4, then -1e5 in one step")).values():
        assert figures["passes at the change"] <= 100


def test_energy_never_grows_with_backward_euler():
    for figures in ran(outcomes("energy: backward Euler, mu")).values():
        assert figures["largest rise per step"] < 1e-9
        assert figures["last"] < 0.2


def test_energy_is_bounded_with_generalized_alpha():
    for figures in ran(outcomes("energy: generalized-alpha, rho_infinity")).values():
        assert figures["largest"] <= 1.0 + 1e-9
        assert figures["last"] < 0.3


def test_point_spacing():
    """Flat up to one fluid cell, a sieve from one and a half; the warning starts at 0.75."""
    results = outcomes("point spacing / h")
    for ratio, figures in ran(results).items():
        assert ("immersed points are up to" in results[ratio].message) == (ratio > 0.75)
        if ratio <= 1.0:
            assert figures["outflow/law"] == pytest.approx(1.0, abs=0.3 if ratio == 0.7 else 0.2)
    assert results[1.5].observed["outflow/law"] > 2.0
    assert results[3.0].observed["outflow/law"] > results[1.5].observed["outflow/law"]


def test_rotated_and_translated_axes():
    for figures in ran(outcomes("rotated and translated axes (angle, shift)")).values():
        assert max(figures.values()) < 1e-10


def test_free_sheet_in_uniform_flow_of_any_direction():
    results = outcomes("free sheet in uniform flow, direction")
    assert len(results) == 8
    for figures in ran(results).values():
        assert max(figures.values()) < 1e-11


def test_taylor_hood_in_the_duct():
    """The slip law holds at the points; more passes between them, as these elements have no scaled band."""
    observed = ran(outcomes("Taylor-Hood elements in the duct, jump and grad-div"))
    for figures in observed.values():
        assert figures["slip/law"] == pytest.approx(1.0, abs=0.2)
    assert observed[1.0, 100.0]["outflow/law"] < 0.6 * observed[1.0, 1.0]["outflow/law"]
    assert observed[1.0, 100.0]["outflow/law"] < 3.0


def test_a_steady_run():
    """On a straight sheet nothing drifts.

    On an arc the multiplier has patterns that the fluid does not see; without r they grow by beta times the slip that
    the fluid's mesh cannot take away, while the mean stays.
    """
    results = {value[1]: figures for value, figures in ran(outcomes("long run: steps, sheet, r")).items()}
    assert results["straight"]["multiplier drifts by"] < 1e-4
    assert results["arc"]["its mean by"] < 1e-3
    assert results["arc"]["multiplier drifts by"] < 0.2
    assert max(figures["memory grows by [MiB]"] for figures in results.values()) < 1.0


# -- the table --------------------------------------------------------------------------------------------------------


def test_the_table_has_a_row_for_every_value_and_shows_what_the_user_sees(tmp_path, capsys):
    stability.main(tmp_path, only="viscosity mu, beta")
    rows = [line for line in (tmp_path / "stability.md").read_text().splitlines() if line.startswith("| viscosity")]
    assert len(rows) == 4  # three values and the bound
    assert all("raise the penalty" in row for row in rows[:3])
    assert rows[0] in capsys.readouterr().out
    with open(tmp_path / "stability.csv") as file:
        table = list(csv.DictReader(file))
    assert [float(row["value"]) for row in table] == [1e-3, 1e-4, 1e-6]
    assert all(row["result"] == "ran" and float(row["passes_mean"]) >= 1.0 for row in table)


def test_what_is_refused_and_what_stops_is_tabulated(monkeypatch):
    def refuse(value):
        return stability_runs.advance(stability_scenes.duct(mu=value).fsi, 1), {}

    def stop(value):
        options = CouplingOptions(block_rtol=1e-15, block_atol=0.0, max_passes=value)
        return stability_runs.advance(stability_scenes.box(options).fsi, 1), {}

    monkeypatch.setitem(stability.CASES, "refusal", stability_runs.Case("", (), (), refuse))
    monkeypatch.setitem(stability.CASES, "failure", stability_runs.Case("", (), (), stop))
    refused, stopped = stability.outcome("refusal", -1.0), stability.outcome("failure", 1)
    assert refused.result == "refused"
    assert "-1" in refused.message
    assert refused.cells()[3] == "-"
    assert stopped.result == "stopped"
    assert stopped.passes == (1,)
    assert "no convergence in 1 passes" in stopped.message


def test_a_state_that_is_not_finite_is_not_taken_for_a_result(monkeypatch):
    scene = stability_scenes.box()
    monkeypatch.setattr(scene.fsi, "takeStep", lambda: scene.fsi.lam.fill(np.nan))
    with pytest.raises(FloatingPointError, match="step 0 was accepted"):
        stability_runs.advance(scene.fsi, 1)
