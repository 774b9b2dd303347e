"""The heart valve: its scene, what it records, and short runs."""

import json
import math

import numpy as np
import pytest
import ufl
import valve_extremes
from mpi4py import MPI
from dolfinx import fem, mesh
from load import load_demo
from mpi_runs import mpirun

from coudalfish import CouplingOptions
from coudalfish.step.watch import CLOSING_LIMIT
from tigar_x.geometry import surfaces

demo = load_demo("heart_valve")


@pytest.fixture(scope="module")
def valve():
    return demo.build(demo.Data(), 6)


def levels(waveform, times):
    domain = mesh.create_unit_interval(MPI.COMM_SELF, 1)
    t = fem.Constant(domain, 0.0)
    value = demo.pressure(waveform, t, demo.Data())
    result = []
    for time in times:
        t.value = time
        result.append(float(ufl.as_ufl(value)((), mapping={t: time})))
    return np.array(result)


def test_the_step_changes_sign_at_the_published_time():
    np.testing.assert_array_equal(levels("step", [0.0, 0.05, 0.0999, 0.1, 0.2]), [2e4, 2e4, 2e4, -1e5, -1e5])


def test_the_pulse_is_smooth_and_has_the_levels_of_the_step():
    np.testing.assert_allclose(levels("pulse", [0.0, 0.05, 0.2]), [0.0, 2e4, -1e5], atol=1e-9)
    times = np.linspace(0.0, 0.2, 2001)
    change = np.abs(np.diff(levels("pulse", times)))
    assert change.max() < 1.2e5 * math.pi / 2 / 0.02 * 1e-4 * 1.05


def test_the_scene_at_rest(valve):
    leaflets = valve.leaflets
    assert leaflets.asymmetry() < 1e-12
    assert leaflets.piercings() == 0
    marks = leaflets.marks()
    np.testing.assert_allclose(np.hypot(*marks[:, 0, :2].T), 0.15, rtol=0.08)  # free edges: opening of the geometry
    np.testing.assert_allclose(marks[:, 0, 2], 0.86, rtol=1e-2)
    area = sum(valve.fsi.shell.quadrature.weights)
    assert area == pytest.approx(3 * 2.040, rel=5e-3)


def test_the_area_within_the_free_edges_is_that_of_their_polygon(valve):
    exact = 0.0
    s = np.linspace(-1.0, 1.0, 20001)
    a = np.pi / 3 - 0.028 / 2.2
    x_c, y_c = 1.13 * np.cos(a), 1.13 * np.sin(a)
    x, y = np.sqrt(0.15**2 + (x_c**2 - 0.15**2) * s**2), y_c * s
    for k in range(surfaces.LEAFLETS):
        turned = demo.turn(np.pi / 3 + 2 * np.pi / 3 * k)[:2, :2] @ [x, y]
        exact += 0.5 * np.sum(turned[0, :-1] * turned[1, 1:] - turned[0, 1:] * turned[1, :-1])
    gaps = 3 * 0.5 * 1.13**2 * np.sin(0.028 / 1.1)  # triangles between neighbouring commissures
    # the coarse splines of this scene follow the free edge's sharp bend in the middle only roughly
    assert valve.leaflets.opening() == pytest.approx(exact + gaps, rel=0.12)


def test_range_of_contact_suits_the_points(valve):
    contact = valve.leaflets.contact
    spacing = np.sqrt(np.mean(contact.quadrature.weights))
    assert spacing == pytest.approx(demo.SPACING * contact.kernel.r_max)
    assert contact.kernel.r_max < contact.r_self
    growth = contact.kernel.r_max / 0.035
    assert growth > 1.0  # this scene's points are farther apart than those of the published range
    assert contact.kernel.stiffness == pytest.approx(1e11 / growth**3)


def test_fine_leaflets_have_the_published_range():
    leaflets = demo.Leaflets(demo.Data(), (20, 16), 3, 5e-5, "svk")
    assert leaflets.contact.kernel.r_max == 0.035
    assert leaflets.contact.kernel.stiffness == 1e11


def test_clamped_edges_do_not_move(valve):
    valve.fsi.takeStep()
    leaflets = valve.leaflets
    moved = leaflets.positions - leaflets.spline.node_positions
    xi = leaflets.spline.V.tabulate_dof_coordinates()[:, :2]
    u, v = xi[:, 0] % 2.0, xi[:, 1]
    held = np.isclose(u, 0.0) | np.isclose(u, 1.0) | np.isclose(v, 1.0)
    assert np.abs(moved[held]).max() == 0.0
    assert np.abs(moved[~held]).max() > 0.0


def history(q, t=None, reversal=0.1):
    t = np.linspace(0.0, 0.2, len(q)) if t is None else t
    rows = np.zeros((len(q), 1 + len(demo.COLUMNS)))
    rows[:, 0], rows[:, 1 + demo.COLUMNS.index("flow_rate")] = t, q
    return demo.History(rows, reversal)


def test_leak_of_a_flow_that_rings_down():
    t = np.linspace(0.0, 0.3, 6001)
    ringing = -3.0 + 40.0 * np.exp(-(t - 0.12) / 0.05) * np.sin(2 * np.pi * (t - 0.12) / 0.01)
    q = np.where(t <= 0.1, 300.0 * np.sin(np.pi * t / 0.1), np.where(t < 0.12, -200.0 * (0.12 - t) / 0.02, ringing))
    past = history(q, t)
    found = {name: quantity.value for name, quantity in past.quantities().items()}
    assert past.closure == pytest.approx(0.12, abs=1e-3)
    assert found["peak_flow_rate"] == pytest.approx(300.0, rel=1e-4)
    assert found["mean_leak"] == pytest.approx(3.0, rel=0.05)
    assert found["mean_leak_relative"] == pytest.approx(0.01, rel=0.05)
    assert found["oscillation_decay"] == pytest.approx(np.exp(-0.01 / 0.05), rel=0.01)
    assert found["oscillation_period"] == pytest.approx(0.01, rel=0.01)
    assert found["largest_backflow"] == pytest.approx(200.0, rel=0.01)


def test_a_valve_that_never_closes_has_no_closure():
    q = np.where(np.linspace(0.0, 0.2, 401) <= 0.1, 100.0, -50.0)
    past = history(q)
    assert past.closure is None
    assert "mean_leak" not in past.quantities()


def test_a_run_that_goes_on_is_the_same_as_one_that_does_not_end(tmp_path):
    settings = {"resolution": 5, "dt": 1e-4, "frames": 0, "viz": False}
    whole = demo.main(**settings, until=8e-4, out=tmp_path / "whole")
    demo.main(**settings, until=4e-4, checkpoint_every=2, out=tmp_path / "parts")
    parts = demo.main(**settings, until=8e-4, restart="latest", out=tmp_path / "parts")
    assert parts["steps"] == whole["steps"] == 8
    one, other = (np.loadtxt(tmp_path / name / "history.csv", delimiter=",", skiprows=1) for name in ("whole", "parts"))
    np.testing.assert_allclose(other, one, rtol=1e-6, atol=1e-9)


def test_two_ranks_give_the_same_history(tmp_path):
    """To the tolerance of the linear solver, whose preconditioner knows the ranks."""
    settings = ("--resolution", 5, "--dt", 1e-4, "--until", 5e-4, "--frames", 0, "--no-viz")
    rows = []
    for ranks in (1, 2):
        done = mpirun(ranks, demo.__file__, *settings, "--out", tmp_path / str(ranks))
        assert done.returncode == 0, done.stderr[-2000:]
        rows.append(np.loadtxt(tmp_path / str(ranks) / "history.csv", delimiter=",", skiprows=1))
    np.testing.assert_allclose(rows[1], rows[0], rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("settings", [{"material": "lee-sacks"}, {"waveform": "pulse"}, {"outlet_resistance": 50.0}])
def test_variants_run(tmp_path, settings):
    summary = demo.main(resolution=5, until=2e-4, frames=1, viz=False, out=tmp_path, **settings)
    assert math.isfinite(summary["qoi"]["peak_flow_rate"]["value"])
    assert json.loads((tmp_path / "summary.json").read_text())["monitors"]["piercings"] == 0


@pytest.mark.parametrize(
    ("settings", "name"),
    [
        ({"resolution": 2}, "resolution"),
        ({"grading": 0.5}, "grading"),
        ({"dt": 0.0}, "dt"),
        ({"until": -1.0}, "until"),
        ({"degree": 1}, "degree"),
        ({"outlet_resistance": -1.0}, "outlet_resistance"),
        ({"frames": -1}, "frames"),
        ({"leaflet_elements": -3}, "leaflet_elements"),
    ],
)
def test_what_is_refused(tmp_path, settings, name):
    with pytest.raises(ValueError, match=name):
        demo.main(out=tmp_path, **settings)


CASES = valve_extremes.cases()


@pytest.mark.parametrize("name", ["contact stiffness x 100", "E x 100", "E x 0.1", "pressure x 10", "massless shell"])
def test_extreme_cases_begin(name):
    outcome = valve_extremes.run(CASES[name], until=3e-4, resolution=6)
    assert outcome.is_finite
    assert outcome.result == "ran"
    assert len(outcome.cells(name)) == len(valve_extremes.HEADER)


def test_a_case_that_cannot_go_on_says_what_to_change():
    """A step that is allowed no pass at all fails, whatever it is cut to."""
    case = CASES["as it is"]
    outcome = valve_extremes.run(
        case, until=3e-4, resolution=6, options=CouplingOptions(max_passes=1, block_rtol=1e-14)
    )
    assert outcome.result.startswith("stopped")
    assert "suspect" in outcome.message
    assert outcome.valve.fsi.timeInt_f.time == 0.0


@pytest.mark.slow
@pytest.mark.parametrize("name", list(CASES))
def test_extreme_cases_to_the_end(name):
    """Each runs, or stops and says what to change; nothing that is not finite is accepted; leaflets do not cross.

    Those that approach each other too fast may, and the run has said so.
    """
    outcome = valve_extremes.run(CASES[name])
    assert outcome.is_finite
    assert outcome.result == "ran" or "suspect" in outcome.message
    assert outcome.piercings == 0 or outcome.closing_ratio > CLOSING_LIMIT


@pytest.mark.slow
def test_the_valve_opens_closes_and_holds(tmp_path):
    """A coarse run of the published waveform; finer ones are in docs/heart_valve.md."""
    summary = demo.main(resolution=16, leaflet_elements=16, dt=1e-4, viz=False, frames=40, out=tmp_path)
    found = {name: quantity["value"] for name, quantity in summary["qoi"].items()}
    assert 200.0 < found["peak_flow_rate"] < 300.0
    assert found["largest_opening_area"] > 2.0
    assert 300.0 < found["largest_backflow"] < 600.0
    assert 0.105 < found["closure_time"] < 0.15
    assert found["final_opening_area"] < 0.2
    assert found["largest_contact_load"] > 1e4
    assert abs(found["mean_leak_relative"]) < 0.02
    assert found["oscillation_decay"] < 0.9
    assert summary["monitors"]["piercings"] == 0
    assert summary["monitors"]["asymmetry_max"] < 0.1
