"""The immersed cylinder: published forces, what lies inside, the time step's part in the answer, and the benchmark."""

import csv
from functools import cache

import immersed_cylinder as benchmark
import numpy as np
import pytest
from load import load_demo

from tigar_x.run.history import History
from varmint.problems.cylinder import PUBLISHED

DEMO = load_demo("immersed_cylinder")
KNOWN = PUBLISHED[20.0, True][1]
PRESETS = ("converged", "plain")


@pytest.fixture(scope="module")
def steady(tmp_path_factory):
    """Runs to the steady flow, each once: quantities at the end by name, and the history."""

    @cache
    def run(**options):
        out = tmp_path_factory.mktemp("cylinder")
        summary = DEMO.main(out=out, viz=False, **options)
        return {name: x["value"] for name, x in summary["qoi"].items()}, History.read(out / "history.csv"), summary

    return lambda **options: run(**options)


@pytest.mark.parametrize("diagonal", ["right", "left"])
def test_forces_on_a_coarse_mesh(steady, diagonal):
    """20 cells, dt = .05: drag within an eighth, pressure within a quarter; the lift's sign is that of the diagonal."""
    found, past, summary = steady(cells=20, dt=0.05, until=4.0, preset="plain", diagonal=diagonal)
    assert found["drag"] == pytest.approx(KNOWN["drag"], rel=0.125)
    assert found["dp"] == pytest.approx(KNOWN["dp"], rel=0.25)
    assert abs(found["lift"] - KNOWN["lift"]) < 0.6
    assert np.sign(found["lift"]) == {"right": -1.0, "left": 1.0}[diagonal]
    assert summary["errors"]["drag"] == pytest.approx(abs(found["drag"] - KNOWN["drag"]))
    assert summary["qoi"]["lift"]["published"] == KNOWN["lift"]
    assert past["drag"][0] > 1.5 * found["drag"]  # the cylinder stops a flow that was there
    assert summary["monitors"]["drift"] < 0.03


def test_a_converged_multiplier_and_dynamic_subscales_do_not_know_the_time_step(steady):
    """The plain preset, a lagged multiplier and quasi-static sub-scales, does: its drag changes by a fifth."""
    found = {(p, dt): steady(cells=10, dt=dt, until=8.0, preset=p)[0] for p in PRESETS for dt in (0.2, 0.05)}
    for name in ("drag", "lift"):
        assert found["converged", 0.2][name] == pytest.approx(found["converged", 0.05][name], rel=1e-3)
    assert found["plain", 0.05]["drag"] > 1.15 * found["plain", 0.2]["drag"]


@pytest.mark.parametrize("diagonal", ["right", "left", "alternating"])
def test_fields_that_jump_and_bend_have_small_lifts(steady, diagonal):
    """20 cells, on any diagonals: the lift is off by less than 0.07, where that of plain ones is by 0.24 to 0.5."""
    found, _, summary = steady(cells=20, dt=0.1, until=4.0, preset="sharp", diagonal=diagonal)
    assert found["drag"] == pytest.approx(KNOWN["drag"], rel=0.125)
    assert found["dp"] == pytest.approx(KNOWN["dp"], rel=0.035 if diagonal == "alternating" else 0.03)
    assert abs(found["lift"] - KNOWN["lift"]) < 0.07
    assert summary["block_iterations_mean"] < 1.3


def test_fields_that_jump_and_bend_do_not_know_the_time_step(steady):
    """Nor does the pressure inside, which no condition sets."""
    (long, _, inside), (short, _, other) = (steady(cells=20, dt=dt, until=4.0, preset="sharp") for dt in (0.1, 0.025))
    assert short["drag"] == pytest.approx(long["drag"], rel=1e-3)
    assert short["lift"] == pytest.approx(long["lift"], abs=5e-3)
    pressures = [summary["monitors"]["pressure_inside"] for summary in (inside, other)]
    assert pressures[1] == pytest.approx(pressures[0], rel=1e-2)


def test_fields_that_jump_and_bend_start_at_once_with_steps_far_shorter_than_the_cells_own_time(steady):
    """The step is a fiftieth of tau_M; half of that in divided cells alone takes 15 passes a step, and cut ones."""
    _, past, summary = steady(cells=10, dt=1e-3, until=6e-3, preset="sharp")
    assert summary["steps"] == 6
    assert past["passes"].max() <= 4


def test_nothing_gets_through_a_closed_curve_with_a_converged_multiplier(steady):
    """A multiplier that lags lets some fluid in that the stabilisation's mass balance loses inside."""
    leaks = {p: abs(steady(cells=10, dt=0.2, until=8.0, preset=p)[1]["leak"][-1]) for p in PRESETS}
    through = DEMO.SPEED * DEMO.DIAMETER
    assert leaks["converged"] < 1e-8 * through
    assert leaks["plain"] > 1e-5 * through


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"preset": "finest"}, "preset = 'finest': one of 'reference', 'plain', 'converged', 'sharp' is required"),
        ({"diagonal": "up"}, "diagonal = 'up': one of 'right', 'left', 'alternating' is required"),
        ({"cells": 5}, "cells = 5: an integer >= 6 is required"),
        ({"dt": 0.0}, "dt = 0.0"),
    ],
)
def test_bad_options_are_named_before_computing(options, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        DEMO.main(out=tmp_path, **options)
    assert not list(tmp_path.iterdir())


def test_the_benchmark_makes_its_table_and_repeats_no_run(tmp_path, monkeypatch):
    monkeypatch.setattr(benchmark, "SIZES", {1: (0.15,)})
    asked = {"presets": "plain", "cells": "8", "time_steps": "0.25", "diagonals": "left", "until": 0.5}
    benchmark.main(**asked, out=tmp_path)
    with open(tmp_path / "immersed_cylinder.csv") as file:
        rows = list(csv.DictReader(file))
    assert [(row["flow"], row["diagonal"]) for row in rows] == [
        ("plain", "left"),
        ("fitted, degree 1", ""),
    ]
    for row in rows:
        assert float(row["drag_error_percent"]) == pytest.approx(100.0 * (float(row["drag"]) / KNOWN["drag"] - 1.0))
        assert float(row["lift_error"]) == pytest.approx(float(row["lift"]) - KNOWN["lift"])
        assert float(row["cpu_s"]) > 0.0
    assert (tmp_path / "immersed_cylinder.png").exists()

    def again(*_, **__):
        raise AssertionError("the run is there")

    monkeypatch.setattr(benchmark.subprocess, "run", again)
    benchmark.main(**asked, out=tmp_path)
