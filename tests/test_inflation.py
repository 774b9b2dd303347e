"""The inflated plate: energy against work, plate theory, symmetry and its quarter, and what it does near its limit."""

from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
import ufl
from load import load_demo

from shnapr import loads
from shnapr.kinematics import midsurface
from shnapr.loads import dead_load
from shnapr.problems.inflation import CASES, MIDDLE, Inflated, Plate, imbalance
from shnapr.shell import ShellError
from tigar_x import compat
from tigar_x.run.convergence import observed_rates

DEMO = load_demo("inflation")
NEO_HOOKEAN = CASES["neo-hookean"]


def inflated(
    elements=8, *, degree=2, points=2, quarter=True, step=0.125, growth=1.0, tolerance=1e-9, each=None, **data
):
    """A small plate, in equal steps."""
    plate = Inflated(
        Plate(degree=degree, elements=elements, points=points, quarter=quarter, tolerance=tolerance, **data)
    )
    sections = []

    def record(t):
        sections.append(plate.position(MIDDLE))
        if each is not None:
            each(t)

    path = plate.inflate(step=step, growth=growth, each=record)
    return SimpleNamespace(plate=plate, path=path, sections=sections, imbalance=imbalance(path))


def columns(path):
    return np.column_stack([path.history[name] for name in ("pressure", "height", "volume", "energy")])


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

    monkeypatch.setattr(loads, "follower_pressure", dead)
    assert inflated(step=1 / 16).imbalance > 0.05


def test_the_energy_of_pericardium():
    run = inflated(material="lee-sacks", step=1 / 16)
    assert run.imbalance < 1e-4
    # the exponential keeps strains small where the neo-Hookean part alone would not
    assert 1.1 < run.plate.at_nodes()[:, 0].max() < 1.4


def test_small_pressure_gives_plate_theory():
    """Clamped square plate (Timoshenko and Woinowsky-Krieger, table 35, with more digits): w = 0.0012653 P a^4/D."""
    P = 1e-4
    w = 0.0012653 * P * 16.0 / (NEO_HOOKEAN.moduli["mu"] * NEO_HOOKEAN.thickness**3 / 3.0)
    counts = (8, 16, 32)
    runs = [inflated(n, pressure=P, step=1.0, tolerance=1e-6) for n in counts]
    errors = [abs(run.path.final("height") / w - 1.0) for run in runs]
    assert fitted_rate(1.0 / np.array(counts), errors) >= 1.9
    assert errors[-1] < 4e-3
    # a linear plate: W = P V/2
    assert runs[-1].path.final("energy") == pytest.approx(P * runs[-1].path.final("volume") / 2, rel=1e-4)


def test_large_deflections_converge():
    """At a fifth of the pressure; at the full one the edges bend with the radius of the thickness."""
    runs = [inflated(n, pressure=100.0, growth=1.5) for n in (8, 16, 32)]
    names = ("height", "volume", "energy")
    rates = observed_rates([{name: run.path.final(name) for name in names} for run in runs])
    assert all(rates[name] >= 0.9 for name in ("height", "volume", "energy")), rates
    change = np.diff([run.path.final("height") for run in runs])
    assert (change > 0).all()
    assert change[-1] < 0.03 * runs[-1].path.final("height")


def test_the_plate_is_symmetric():
    whole = of_two_points(quarter=False)
    assert whole.plate.asymmetry() < 1e-12
    # the same measure sees another solution that is not
    whole.plate.shell.y.x.array[::3] += 1e-6 * whole.plate.shell.spline.node_positions[:, 1] ** 2
    assert whole.plate.asymmetry() > 1e-7


def test_a_quarter_is_the_whole():
    """Quadratic splines that are C1 at the middle line are those with the conditions of symmetry."""
    whole, quarter = inflated(quarter=False), of_two_points()
    np.testing.assert_allclose(columns(quarter.path), columns(whole.path), rtol=1e-9, atol=1e-12)
    for one, other in zip(quarter.sections, whole.sections, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-10)
    np.testing.assert_allclose(quarter.plate.at_nodes().max(axis=0), whole.plate.at_nodes().max(axis=0), rtol=1e-8)


def test_thickness_and_area():
    """Incompressible: the thickness ratio integrated over the current area is the area of the plate."""
    plate = of_two_points().plate
    spline = plate.shell.spline
    ratio = plate.stretches()[1]
    measure = type(spline.dx)(ufl.sqrt(ufl.det(midsurface(spline, plate.shell.y).metric)), spline.dx.measure)
    (area,) = compat.compile_forms(ratio * measure)
    assert compat.assemble_scalar(area) == pytest.approx(1.0, rel=1e-12)


def test_steps_grow_and_end_at_the_limit_load():
    easy = inflated(step=0.05, growth=1.5)
    assert len(easy.path.report.loads) < 15
    reached = []
    with pytest.raises(ShellError, match="loading ended at"):
        inflated(4, pressure=2e3, growth=1.5, each=reached.append)
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
