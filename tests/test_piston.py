"""A piston on springs: the frequency that the fluid's mass lowers, and the force of that mass."""

import numpy as np
import pytest
from load import load_demo

from coudalfish import CouplingOptions

DEMO = load_demo("piston")


def swung(steps, options=None, **discretisation):
    """Displacements of a piston after each of some steps, and the fluid's force on it relative to the exact one."""
    _, plate, fsi = DEMO.Piston(**discretisation).build(**(options or {}))
    y, force = [], []
    for _ in range(steps):
        report = fsi.takeStep()
        y.append(plate.at("u0").displacement[0])
        force.append(report.monitors.force[0] / (DEMO.FORCE * np.sin(DEMO.OMEGA * report.t_alpha)))
    return np.array(y), np.array(force)


def frequency(y, steps_per_period):
    """By the first time that the piston comes back to the middle."""
    n = int(np.argmax(y < 0.0))
    return 0.5 * steps_per_period / (n + y[n - 1] / (y[n - 1] - y[n]))


@pytest.mark.mpi
@pytest.mark.parametrize("mass_ratio", [1.0, 1e-2, 1e-4])
def test_a_converged_multiplier_gives_the_frequency_at_fifty_steps_a_period(mass_ratio):
    """Within half a percent, in one pass a step; the lagged one is more than a tenth too slow."""
    found, late = (frequency(swung(36, mass_ratio=mass_ratio, preset=name)[0], 50) for name in ("converged", "plain"))
    assert found == pytest.approx(1.0, abs=0.005)
    assert late < 0.9


@pytest.mark.mpi
def test_the_force_on_a_heavy_piston_is_that_of_the_added_mass_from_the_first_step_on():
    """With fields that jump, within .35 percent, which are the scheme's, at any mass; with others 5 percent are off in
    the first step, and a lagged multiplier has hardly begun."""
    for mass_ratio in (100.0, 1.0):
        _, force = swung(12, mass_ratio=mass_ratio, preset="sharp")
        np.testing.assert_allclose(force, 1.0, rtol=4e-3)
    heavy = {"mass_ratio": 100.0, "preset": "converged"}
    _, plain = swung(4, **heavy)
    assert 0.04 < np.abs(plain - 1.0).max() < 0.06
    assert 0.01 < np.abs(plain[1:] - 1.0).max() < 0.02
    _, narrow = swung(4, {"scale_c": 1e-3}, **heavy)
    np.testing.assert_allclose(narrow[1:], 1.0, rtol=0.01)
    _, late = swung(4, mass_ratio=100.0, preset="plain")
    assert late.max() < 0.15


@pytest.mark.mpi
@pytest.mark.parametrize("mass_ratio", [100.0, 1.0, 1e-4])
def test_a_piston_at_five_steps_a_period_is_as_late_as_the_scheme_whatever_its_mass(mass_ratio):
    """No step is a hard one, and fields that jump do not change the frequency."""
    found = {}
    for preset in ("converged", "sharp"):
        _, plate, fsi = DEMO.Piston(mass_ratio, 5, preset=preset).build()
        y = []
        for _ in range(12):
            report = fsi.takeStep()
            assert report.attempts == 1
            assert report.passes <= 3
            y.append(plate.at("u0").displacement[0])
        found[preset] = frequency(np.array(y), 5)
    assert found["sharp"] == pytest.approx(found["converged"], rel=1e-3)
    assert found["sharp"] == pytest.approx(0.88, abs=0.02)


@pytest.mark.mpi
def test_the_fluid_moves_as_one_body_with_the_plate():
    """No viscosity slows it down, and what flows back in at the open ends is as fast as what flows out."""
    flow, _, fsi = DEMO.Piston(preset="converged").build(scale_m=1e-5, scale_c=1e-5)
    for _ in range(25):
        fsi.takeStep()
    u = flow.w.x.array.reshape(-1, 3)[:, :2] / (DEMO.AMPLITUDE * DEMO.OMEGA)
    np.testing.assert_allclose(u, np.tile([-1.0, 0.0], (len(u), 1)), rtol=0.0, atol=2e-3)


def test_presets_are_those_of_the_coupling():
    made = {name: DEMO.Piston(cells=4, preset=name).build()[2].options for name in DEMO.PRESETS}
    assert made["reference"] == CouplingOptions.reference()
    assert made["plain"] == CouplingOptions()
    assert made["converged"] == CouplingOptions.converged()
    assert made["sharp"] == CouplingOptions.sharp()
