"""The inflated plate: energy against work, plate theory, symmetry and its quarter, and what it does near its limit."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import ufl
from load import load_demo

from shnapr.loads import dead_load
from tigar_x.fem.linear import SolveError

DEMO = load_demo("inflation")
NEO_HOOKEAN = DEMO.CASES["neo-hookean"]


def inflated(elements=8, *, degree=2, points=2, quarter=True, step=0.125, growth=1.0, case=NEO_HOOKEAN, **other):
    """A small plate, in equal steps."""
    plate = DEMO.Plate(case, degree, elements, points, ramp=2.0, quarter=quarter)
    return DEMO.inflate(plate, step=step, growth=growth, **dict(tolerance=1e-9) | other)


@cache
def of_two_points(**other):
    return inflated(**other)


def fitted_rate(sizes, errors):
    return np.polyfit(np.log(sizes), np.log(errors), 1)[0]


def test_energy_is_the_work_of_the_pressure():
    """The error is that of cubic splines, of fourth order in the load step."""
    steps = (1 / 8, 1 / 16, 1 / 32)
    errors = [of_two_points(step=step).imbalance for step in steps]
    assert fitted_rate(steps, errors) >= 4.0
    assert errors[-1] < 1e-6


def test_a_pressure_that_does_not_follow_has_another_work(monkeypatch):
    def dead(spline, pressure, y, z):
        return dead_load(spline, pressure * ufl.as_vector([0, 0, 1]), z)

    monkeypatch.setattr(DEMO, "follower_pressure", dead)
    assert inflated(step=1 / 16).imbalance > 0.05


def test_the_energy_of_pericardium():
    run = inflated(case=DEMO.CASES["lee-sacks"], step=1 / 16)
    assert run.imbalance < 1e-4
    # the exponential keeps strains small where the neo-Hookean part alone would not
    assert 1.1 < DEMO.at_nodes(run.plate)[:, 0].max() < 1.4


def test_small_pressure_gives_plate_theory():
    """Clamped square plate (Timoshenko and Woinowsky-Krieger, table 35, with more digits): w = 0.0012653 P a^4/D."""
    P = 1e-4
    w = 0.0012653 * P * 16.0 / (NEO_HOOKEAN.moduli["mu"] * NEO_HOOKEAN.thickness**3 / 3.0)
    counts = (8, 16, 32)
    runs = [inflated(n, case=replace(NEO_HOOKEAN, pressure=P), step=1.0, tolerance=1e-6) for n in counts]
    errors = [abs(run.path[-1, 1] / w - 1.0) for run in runs]
    assert fitted_rate(1.0 / np.array(counts), errors) >= 1.9
    assert errors[-1] < 4e-3
    # a linear plate: W = P V/2
    assert runs[-1].path[-1, 3] == pytest.approx(P * runs[-1].path[-1, 2] / 2, rel=1e-4)


def test_large_deflections_converge():
    """At a fifth of the pressure; at the full one the edges bend with the radius of the thickness."""
    case = replace(NEO_HOOKEAN, pressure=100.0)
    runs = [inflated(n, case=case, growth=1.5) for n in (8, 16, 32)]
    rates = DEMO.observed_rates(runs)
    assert all(rates[name] >= 0.9 for name in ("height", "volume", "energy")), rates
    change = np.diff([run.path[-1, 1] for run in runs])
    assert (change > 0).all()
    assert change[-1] < 0.03 * runs[-1].path[-1, 1]


def test_the_plate_is_symmetric():
    whole = of_two_points(quarter=False)
    assert whole.asymmetry < 1e-12
    # the same measure sees another solution that is not
    whole.plate.y.x.array[::3] += 1e-6 * whole.plate.spline.node_positions[:, 1] ** 2
    assert whole.asymmetry > 1e-7


def test_a_quarter_is_the_whole():
    """Quadratic splines that are C1 at the middle line are those with the conditions of symmetry."""
    whole, quarter = inflated(quarter=False), of_two_points()
    np.testing.assert_allclose(quarter.path, whole.path, rtol=1e-9, atol=1e-12)
    for one, other in zip(quarter.sections, whole.sections, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-10)
    np.testing.assert_allclose(
        DEMO.at_nodes(quarter.plate).max(axis=0), DEMO.at_nodes(whole.plate).max(axis=0), rtol=1e-8
    )


def test_thickness_and_area():
    """Incompressible: the thickness ratio integrated over the current area is the area of the plate."""
    plate = of_two_points().plate
    current = DEMO.midsurface(plate.spline, plate.y)
    ratio = plate.stretches()[1]
    measure = type(plate.spline.dx)(ufl.sqrt(ufl.det(current.metric)), plate.spline.dx.measure)
    (area,) = DEMO.compat.compile_forms(ratio * measure)
    assert DEMO.compat.assemble_scalar(area) == pytest.approx(1.0, rel=1e-12)


def test_steps_grow_and_end_at_the_limit_load():
    easy = inflated(step=0.05, growth=1.5)
    assert len(easy.load.loads) < 15
    reached = []
    with pytest.raises(SolveError, match="loading ended at"):
        inflated(4, case=replace(NEO_HOOKEAN, pressure=2e3), growth=1.5, each=reached.append)
    assert 0.25e3 < 2e3 * reached[-1] ** 2 < 1e3


@pytest.mark.slow
def test_the_published_plate(tmp_path):
    """16 x 16 elements, four points, 100 equal steps; the state does not depend on the steps that led there."""
    data = dict(elements=16, degree=2, points=4, out=tmp_path, overwrite=True, viz=False)
    steps = DEMO.main(**data, ramp=1.0, step=0.01, growth=1.0)
    assert steps["steps"] == 100
    grown = DEMO.main(**data)
    assert grown["steps"] < 20
    for name in ("height", "volume", "energy"):
        assert grown["qoi"][name]["value"] == pytest.approx(steps["qoi"][name]["value"], rel=1e-6), name
    assert grown["qoi"]["height"]["value"] == pytest.approx(0.86544, rel=1e-4)  # as measured when this was written
    assert steps["errors"]["energy_balance"] < 1e-4


BAD = {
    "pressure = 0.0": dict(pressure=0.0),
    "step = -1.0": dict(step=-1.0),
    "ramp = nan": dict(ramp=float("nan")),
    "degree = 1": dict(degree=1),
    "elements = 6: a multiple of 4": dict(elements=6, levels=2),
    "growth = 0.5": dict(growth=0.5),
    "material = 'steel'": dict(material="steel"),
}


@pytest.mark.parametrize("message", BAD)
def test_bad_input_is_named_before_computing(message, tmp_path):
    with pytest.raises(ValueError, match=f"^{message}.* required"):
        DEMO.main(out=tmp_path / "out", viz=False, **BAD[message])
    assert not (tmp_path / "out").exists()
