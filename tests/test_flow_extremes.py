"""Stiff and extreme flows: the outcomes that `benchmarks/flow_extremes.py` tabulates, and what must hold for them."""

import math

import pytest
from flow_extremes import CASES, REYNOLDS, outcome

SLOW = {("cylinder, steady, Re", 1e3), ("cylinder, steady, Re", 1e6)}
ALL = [
    pytest.param(name, value, marks=pytest.mark.slow if (name, value) in SLOW else [])
    for name, case in CASES.items()
    for value in case.values
]
GMSH = pytest.importorskip("gmsh")


@pytest.mark.parametrize(("name", "value"), ALL)
def test_finite_or_named(name, value):
    """Every flow that is accepted is finite; every other one is an error that says what and why."""
    found = outcome(name, value)
    assert found.is_finite
    assert found.result == "ran" or len(found.message) > 40
    if found.result == "no steady flow":
        assert "no steady flow at mu" in found.message
        assert "down to mu" in found.message


@pytest.mark.parametrize("reynolds", [*REYNOLDS, math.inf])
def test_steps_run_at_any_reynolds_number(reynolds):
    for name in ("cavity, 16 steps, Re (inf: mu = 0)", "cylinder, 20 steps, Re (inf: mu = 0)"):
        if reynolds in CASES[name].values:
            assert outcome(name, reynolds).result == "ran"
    assert outcome("cavity, 16 steps, Re (inf: mu = 0)", reynolds).observed["speed"] <= 1.3


@pytest.mark.parametrize("reynolds", [1.0, 1e2, 1e4, math.inf])
def test_energy_never_grows(reynolds):
    found = outcome("vortex, Re (inf: mu = 0)", reynolds)
    assert 0.0 < found.observed["energy kept"] < 1.0


@pytest.mark.parametrize("ratio", [1.0, 10.0, 100.0, 1e3])
def test_stretched_cells_keep_an_exact_flow(ratio):
    assert outcome("cells longer than wide, ratio", ratio).observed["relative error"] < 1e-9


def test_backflow():
    """With the stabilisation the flow gains no energy from what comes back in: the more of it, the less."""
    energies = [outcome("backflow, gamma", gamma).observed["kinetic energy"] for gamma in (0.0, 0.5, 1.0)]
    assert energies[2] < energies[1] < 20.0
    assert all(outcome("backflow, gamma", gamma).result == "ran" for gamma in (0.5, 1.0))


def test_rest():
    nothing, gravity = (outcome("at rest", value) for value in ("nothing", "gravity"))
    assert nothing.observed == {"speed": 0.0, "pressure range": 0.0}
    assert sum(nothing.iterations) == 0
    assert gravity.observed["speed"] < 1e-9
    assert gravity.observed["pressure range"] == pytest.approx(9810.0, rel=1e-6)


@pytest.mark.parametrize("pressure", ["null space", "pin"])
def test_the_constant_of_the_pressure_does_not_drift(pressure):
    """Over eight hundred steps of a lid that swings."""
    found = outcome("closed cavity, 1000 steps, pressure by", pressure)
    assert found.result == "ran"
    assert found.observed["drift of the mean pressure"] < 1e-3 * found.observed["largest pressure"]


def test_piston():
    assert outcome("piston, stroke", 0.5).observed["smallest J"] == pytest.approx(0.5, abs=0.02)
    stopped = outcome("piston, stroke", 1.1)
    assert stopped.result == "stopped"
    assert "mesh" in stopped.message
