"""What the plane scenes of benchmarks/plane.py say of the library, and what they are measured by."""

import math
from dataclasses import replace

import numpy as np
import pytest
from plane import LOADED_ARC, Flag, HeldSheet, Ring
from plane_gaps import DISCHARGE, Slit
from plane_swinging import Plate, String, damped_frequency
from scene import Setting
from surface import STUDIES, setting_of

from coudalfish import CouplingOptions, PenaltyRule
from varmint import FlowOptions

CONVERGED = Setting(CouplingOptions.converged())
SHARP = setting_of("sharp")


# -- at rest ----------------------------------------------------------------------------------------------------------


@pytest.mark.mpi
def test_what_flows_at_a_held_arc_under_pressure_goes_down_with_the_mesh_and_up_with_the_pressure():
    coarse, fine, light = HeldSheet(8).run(), HeldSheet(16).run(), HeldSheet(8, jump=1e-3).run()
    assert fine.figures["velocity"] < 0.65 * coarse.figures["velocity"] < 6e-3
    assert light.figures["velocity"] == pytest.approx(coarse.figures["velocity"], rel=0.05)
    assert abs(fine.figures["load"]) < 2e-3
    assert max(coarse.imbalance, fine.imbalance) < 1e-12


@pytest.mark.mpi
def test_a_converged_multiplier_has_no_pattern_that_grows():
    arc = replace(LOADED_ARC, n=6, steps=200)
    lagged, converged = arc.run(Setting(CouplingOptions(relaxation=0.0))), arc.run(CONVERGED)
    assert lagged.figures["growth"] > 0.2
    assert converged.figures["growth"] < 0.02
    assert converged.figures["pattern"] < 0.1
    assert converged.passes.mean() < 1.1 < lagged.passes.mean()


@pytest.mark.mpi
def test_nothing_flows_at_a_straight_sheet_that_holds_a_jump_and_its_steps_are_not_hard():
    """There is no speed that what is left of the slip could be small against."""
    found = HeldSheet(8, bow=0.0, ramp=3, steps=3).run(SHARP)
    assert found.figures["velocity"] < 1e-8
    assert [report.attempts for report in found.reports] == [1] * 6
    assert found.passes.max() <= 2


@pytest.mark.mpi
def test_kinks_at_a_held_arc_do_not_grow_at_small_steps():
    """With weights of their sides of degree 2 or 3 their mass is not positive, and the steps diverge at once."""
    found = HeldSheet(16, dt=1e-3, steps=20, ramp=5, mu=0.01).run(SHARP)
    assert found.figures["velocity"] < 1e-3
    assert found.passes.max() <= 2
    assert found.imbalance < 1e-12


@pytest.mark.mpi
def test_with_jump_and_kink_next_to_nothing_flows_at_an_arc_whatever_the_pressure():
    """Forces beside the place of the jump, or a jump on the arc's inner side, move ten times as much."""
    light, heavy = HeldSheet(16).run(SHARP), HeldSheet(16, jump=1e5, dt=1e5**-0.5).run(SHARP)
    assert light.figures["velocity"] < 6e-5
    assert heavy.figures["velocity"] == pytest.approx(light.figures["velocity"], rel=0.2)
    assert max(abs(light.figures["leak"]), abs(heavy.figures["leak"])) < 1e-7


def test_a_shifted_sheet_stands_where_it_is_said_to():
    places = [found.figures["velocity"] for found in HeldSheet(4, ramp=3, steps=3).shifted(places=3)]
    alone = [HeldSheet(4, ramp=3, steps=3, place=0.37 + shift).run().figures["velocity"] for shift in (0, 1 / 3, 2 / 3)]
    assert places == pytest.approx(alone, rel=1e-12)
    assert len(set(np.round(places, 6))) == 3


# -- swinging ---------------------------------------------------------------------------------------------------------


def test_a_damped_frequency_is_found_in_its_samples():
    w, t = 6.1 + 0.4j, np.arange(80) / 50
    assert damped_frequency((np.exp(1j * (w * t + 0.7))).real, 0.02) == pytest.approx(w, rel=1e-10)


def test_the_exact_string_is_that_of_an_inviscid_fluid_with_thin_layers():
    """It loses what the slip U of an inviscid fluid loses in a layer, U^2 sqrt(rho mu omega/8) on a side."""
    for m in (1.0, 1e-3):
        thin = String(mass_ratio=m, mu=1e-6, place=0.0)
        slip = 1.0 / math.tanh(math.pi)
        lost, mass = slip**2 * math.sqrt(math.pi * thin.mu / 4.0), thin.mass + 2.0 * slip / math.pi
        assert thin.exact().real == pytest.approx(2.0 * math.pi, rel=1e-3)
        assert thin.exact().imag == pytest.approx(2.0 * lost / mass, rel=5e-3)


@pytest.mark.mpi
@pytest.mark.parametrize("mass_ratio", [1.0, 1e-4])
def test_a_string_swings_at_its_frequency_with_a_converged_multiplier(mass_ratio):
    """A lagged one makes it late, or is a spring that swings along."""
    string = String(16, 25, 2, mass_ratio)
    lagged, converged = string.run(), string.run(CONVERGED)
    assert lagged.figures["error"] > 0.09
    assert abs(converged.figures["frequency"]) < 0.03
    assert converged.figures["leak"] < 1e-6
    assert converged.imbalance < 1e-12
    assert abs(string.run(SHARP).figures["frequency"]) < 0.01


@pytest.mark.mpi
def test_a_ring_keeps_its_area_with_a_converged_multiplier():
    ring = Ring(16, steps=25)
    lagged, converged = ring.run(), ring.run(CONVERGED)
    assert lagged.figures["lost"] > 0.1
    assert converged.figures["lost"] < 0.02
    assert converged.figures["roundness"] > 0.9
    assert converged.imbalance < 1e-12
    assert ring.run(SHARP).figures["lost"] < 6e-4


def test_the_exact_layers_of_a_plate_are_those_of_a_half_space():
    plate = Plate(1.0)
    assert plate.exact() == pytest.approx(-2.0 * plate.mu * (1.0 + 1.0j) * plate.n, rel=1e-9)


@pytest.mark.mpi
def test_a_plate_drags_its_layers_along():
    thick, thin = (Plate(delta, n=16, steps_per_period=25, periods=2).run(CONVERGED) for delta in (4.0, 1.0))
    assert thick.figures["error"] < 0.12
    assert thin.figures["error"] < 0.3
    assert max(thick.imbalance, thin.imbalance) < 1e-12


@pytest.mark.mpi
@pytest.mark.parametrize(("delta", "most"), [(4.0, 0.01), (1.0, 0.06), (0.25, 0.3)])
def test_kinks_resolve_the_layers_of_a_plate_down_to_a_quarter_of_a_cell(delta, most):
    assert Plate(delta, steps_per_period=40, periods=2).run(SHARP).figures["error"] < most


@pytest.mark.mpi
def test_a_fluid_that_slips_a_little_follows_layers_that_are_thinner_than_a_cell():
    """They are not in the space of a velocity with a kink, which makes too much of the fluid swing along."""
    slipping = CouplingOptions.sharp(multiplier_direction="normal", penalty=PenaltyRule(80.0, 0.0))
    found = Plate(0.25, n=16, steps_per_period=40, periods=2).run(replace(SHARP, options=slipping))
    assert found.figures["error"] < 0.12
    assert found.passes.max() == 1


# -- a gap ------------------------------------------------------------------------------------------------------------


@pytest.mark.mpi
def test_more_flows_through_a_wider_slit_and_nothing_through_the_plates():
    narrow, wide = (Slit(gap, n=16, cfl=1.0).run(CONVERGED) for gap in (2.0, 4.0))
    assert 0.3 < narrow.figures["flow"] < wide.figures["flow"] < 1.0
    assert max(abs(narrow.figures["leak"]), abs(wide.figures["leak"])) < 1e-8
    assert max(narrow.figures["change"], wide.figures["change"]) < 1e-3
    assert wide.imbalance < 1e-12


@pytest.mark.mpi
def test_with_jump_and_kink_what_flows_through_a_gap_of_one_cell_and_more_is_right_at_any_step():
    for gap in (1.0, 2.0, 4.0):
        flows = [Slit(gap, n=16, cfl=cfl).run(SHARP).figures["flow"] for cfl in (0.2, 1.0)]
        assert flows == pytest.approx([1.0, 1.0], abs=0.2)
        assert flows[0] == pytest.approx(flows[1], rel=0.05)


def test_fast_flow_through_a_gap_of_one_cell_is_right_at_small_steps_with_either_kind_of_sub_scales():
    """With the time step in tau_M too little flows, 0.68, and with tau_M whole too much, 1.29; on 32 cells 0.80."""
    for subscales in ("quasi-static", "dynamic"):
        setting = replace(SHARP, flow=replace(SHARP.flow, subscales=subscales))
        assert Slit(reynolds=10.0, n=16, steady=2e-3, most=120).run(setting).figures["flow"] == pytest.approx(
            1.0, abs=0.22
        )


def test_a_slit_has_the_viscosity_that_its_flow_belongs_to():
    slow, fast = Slit(2.0), Slit(2.0, reynolds=10.0)
    assert slow.reference == pytest.approx(math.pi * (2.0 / 32) ** 2 / (32 * slow.mu))
    assert fast.reference == pytest.approx(DISCHARGE[10.0] * 2.0 / 32 * math.sqrt(2.0))
    for slit in (slow, fast):
        assert slit.reference / slit.mu == pytest.approx(slit.reynolds)


# -- a free end -------------------------------------------------------------------------------------------------------


@pytest.mark.mpi
def test_a_flag_starts_at_once_and_flaps_in_few_passes_at_its_time_step_and_at_ten_times_that():
    """With cross and Reynolds stress of the sub-scales the second large step diverges."""
    around, setting = {"ahead": 1.0, "behind": 2.0, "beside": 1.5}, replace(SHARP, flow=FlowOptions())
    small, large = (Flag(dt=dt, until=until, **around).run(setting) for dt, until in ((0.01, 0.25), (0.1, 1.0)))
    assert small.passes.mean() <= 1.5
    assert max(small.passes.max(), large.passes.max()) <= 6
    assert large.passes.mean() <= 3.5
    assert {report.attempts for report in (*small.reports, *large.reports)} == {1}
    assert max(small.figures["leak"], large.figures["leak"]) < 2e-3


# -- settings ---------------------------------------------------------------------------------------------------------


def test_a_setting_is_read_from_text():
    assert setting_of("plain").options == CouplingOptions()
    assert setting_of("converged(trace='exact')").options == CouplingOptions.converged(trace="exact")
    setting = setting_of("plain(penalty=(10, 0), immersed='other', C_t=1.0)")
    assert setting.options == CouplingOptions(penalty=PenaltyRule(10, 0))
    assert (setting.immersed, setting.flow.C_t) == ("other", 1.0)
    assert setting.flow.solver == Setting().flow.solver
    fields = {text: setting_of(text).immersed for text in ("plain", "sharp", "sharp(immersed='jump')")}
    assert list(fields.values()) == ["plain", "jump and kink", "jump"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("unknown", "'unknown' is no preset"),
        ("plain(1)", "preset or preset"),
        ("'plain'", "preset or preset"),
        ("plain(trace=print())", "malformed"),
        ("plain(nothing=1)", "nothing is no option"),
    ],
)
def test_a_text_that_is_no_setting_is_refused(text, message):
    with pytest.raises((ValueError, TypeError), match=message):
        setting_of(text)


def test_every_case_of_the_benchmark_names_figures_that_its_scene_documents():
    for figures, scenes in STUDIES.values():
        for scene in scenes.values():
            assert all(f'"{name}"' in type(scene).run.__doc__ for name in figures)
