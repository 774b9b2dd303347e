"""The leaflet against its planes: balance of forces, symmetry, contact, refinement, and the steps that close it."""

from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
from load import load_demo

from shnapr.problems.leaflet import Closing, Leaflet

DEMO = load_demo("leaflet")
EDGE = np.linspace(0.0, 1.0, 101)[:, None] * (1.0, 0.0)


@cache
def closed(elements=10, *, degree=2, step=0.1, tolerance=1e-9, **data):
    leaflet = Closing(Leaflet(degree, elements, tolerance=tolerance, **data))
    return SimpleNamespace(leaflet=leaflet, path=leaflet.close(step=step))


@pytest.mark.parametrize("stiffness", [1e8, 1e9, 1e10])
def test_forces_balance(stiffness):
    forces = closed(stiffness=stiffness).leaflet.forces()
    assert forces.imbalance < 1e-9
    P = np.linalg.norm(forces.pressure)
    # the planes carry a part, and the pressure pushes upstream and to the axis
    assert np.linalg.norm(forces.contact) > 0.1 * P
    assert forces.contact[0] < -0.1 * P
    assert forces.pressure[0] > 0.1 * P
    assert forces.pressure[2] < -0.1 * P
    assert abs(forces.pressure[1]) < 1e-12 * P


def test_forces_do_not_balance_before_newton_has_converged():
    assert closed(tolerance=0.1).leaflet.forces().imbalance > 1e-5


def test_the_boundary_tells_the_resultant_of_the_pressure():
    """int a_3 da = 1/2 int x cross dx, with another boundary another resultant."""
    leaflet = closed().leaflet
    forces = leaflet.forces()
    assert forces.boundary_error < 1e-13
    open_one = Closing(Leaflet(2, 10)).forces(1.0)
    assert open_one.boundary_error < 1e-13
    assert np.linalg.norm(forces.pressure - open_one.pressure) > 0.05 * np.linalg.norm(forces.pressure)


def test_the_leaflet_is_symmetric():
    leaflet = closed().leaflet
    assert leaflet.asymmetry() < 1e-12
    other = Closing(Leaflet(2, 5))
    assert other.asymmetry() < 1e-12
    other.shell.y.x.array[1::3] = 1e-6
    assert other.asymmetry() > 1e-6


def test_depth_goes_with_pressure_over_stiffness():
    """A stiffer plane is entered less deeply, and the mean depth stays near P/k: curvature brings the factor."""
    depths = {k: closed(stiffness=k).leaflet.mean_depth() for k in (1e8, 1e9, 1e10)}
    assert depths[1e8] > 4 * depths[1e9] > 16 * depths[1e10]
    for k, depth in depths.items():
        assert 0.2 * 1e5 / k < depth < 6 * 1e5 / k
    assert all(-closed(stiffness=k).path.final("distance_2") < 0.01 for k in depths)


def test_the_free_edge_meets_the_planes():
    run, beyond = closed(20, degree=3), closed(stiffness=1e-3)
    assert run.path.final("touching") > 0.85
    assert run.path.final("centre_radius") < 0.1 * 0.15  # a tenth of the opening
    assert run.path.final("distance_1") > -0.003
    # without planes the edge passes where they are
    assert beyond.path.final("distance_1") < -0.1
    before = run.leaflet.distances(run.leaflet.shell.spline.geometry.evaluate(EDGE)).min()
    assert before > 0.014  # nothing touches in the open leaflet


def test_any_steps_lead_to_the_same_state():
    """Even a single one; energies and forces grow along the way."""
    ten, one = closed(), closed(step=1.0)
    assert len(ten.path.report.loads) == 10
    assert len(one.path.report.loads) == 1
    np.testing.assert_allclose(one.leaflet.shell.positions, ten.leaflet.shell.positions, atol=1e-7)
    for name in ("pressure", "energy", "contact_force"):
        assert (np.diff(ten.path.history[name]) > 0).all(), name


def test_the_leaflet_converges():
    """Against 40 elements, which the slow test computes: a coarse one cannot bend into the edge between the planes."""
    runs = [closed(n, degree=3) for n in (10, 20)]
    finest = {"energy": 13068.8, "centre_radius": 0.01108, "centre_z": 0.44313}  # of 40 elements
    for name, value in finest.items():
        errors = [abs(run.path.final(name) - value) for run in runs]
        assert errors[1] < 0.3 * errors[0], name
    assert abs(runs[1].path.final("centre_z") - finest["centre_z"]) < 2e-3


@pytest.mark.slow
def test_rates_of_convergence(tmp_path):
    summary = DEMO.main(elements=40, levels=3, out=tmp_path, viz=False)
    assert all(rate > 2.0 for rate in summary["rates"].values()), summary["rates"]
    assert summary["errors"]["force_balance"] < 1e-8
    assert summary["qoi"]["centre_z"]["value"] == pytest.approx(0.44313, abs=1e-4)


@pytest.mark.slow
def test_smooth_planes_give_nearly_the_same():
    """Smoothing over s holds the leaflet back by less than s."""
    hard, smooth = closed(), closed(smoothing=1e-3)
    distance = np.abs(hard.leaflet.shell.positions - smooth.leaflet.shell.positions).max()
    assert 1e-4 < distance < 3e-3
    assert smooth.leaflet.forces().imbalance < 1e-9


BAD = {
    "pressure = 0.0": dict(pressure=0.0),
    "thickness = -1.0": dict(thickness=-1.0),
    "stiffness = nan": dict(stiffness=float("nan")),
    "smoothing = -0.1": dict(smoothing=-0.1),
    "step = 0.0": dict(step=0.0),
    "degree = 1": dict(degree=1),
    "elements = 5: a multiple of 2": dict(elements=5, levels=2),
}


@pytest.mark.parametrize("message", BAD)
def test_bad_input_is_named_before_computing(message, tmp_path):
    with pytest.raises(ValueError, match=f"^{message}.* required"):
        DEMO.main(out=tmp_path / "out", viz=False, **BAD[message])
    assert not (tmp_path / "out").exists()
