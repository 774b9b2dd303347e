"""What is measured of a heart valve: openings, marks and symmetry of its leaflets, and what a flow rate amounts to."""

from types import SimpleNamespace

import numpy as np
import pytest
from mpi4py import MPI

from coudalfish.valves import Leaflets, flow_through, turn
from tigar_x.geometry import shapes, surfaces
from tigar_x.geometry.multipatch import disjoint
from tigar_x.run.course import Course
from tigar_x.splines.projection import Projected
from tigar_x.splines.spline import ExtractedSpline


def leaflets_of(spline, contact=None):
    y = spline.function(name="y")
    return Leaflets(SimpleNamespace(spline=spline, y=y, contact=contact)), y


@pytest.fixture(scope="module")
def spline():
    patches = surfaces.trileaflet(radius=1.1, elements=(5, 4), degrees=(3, 3))
    return ExtractedSpline(disjoint(*patches), MPI.COMM_SELF, quadrature_degree=4)


def test_leaflets_at_rest(spline):
    leaflets, _ = leaflets_of(spline)
    assert leaflets.asymmetry() < 1e-12
    r, z = np.moveaxis(leaflets.heights(), -1, 0)
    np.testing.assert_allclose(r[:, 0], 0.15, rtol=0.08)  # free edges: opening of the geometry
    np.testing.assert_allclose(z[:, 0], 0.86, rtol=1e-2)
    np.testing.assert_allclose(np.hypot(*leaflets.marks()[:, :, :2].T), r.T, rtol=1e-14)


def test_the_area_within_the_free_edges_is_that_of_their_polygon(spline):
    exact = 0.0
    s = np.linspace(-1.0, 1.0, 20001)
    a = np.pi / 3 - 0.028 / 2.2
    x_c, y_c = 1.13 * np.cos(a), 1.13 * np.sin(a)
    x, y = np.sqrt(0.15**2 + (x_c**2 - 0.15**2) * s**2), y_c * s
    for k in range(surfaces.LEAFLETS):
        turned = turn(np.pi / 3 + 2 * np.pi / 3 * k)[:2, :2] @ [x, y]
        exact += 0.5 * np.sum(turned[0, :-1] * turned[1, 1:] - turned[0, 1:] * turned[1, :-1])
    gaps = 3 * 0.5 * 1.13**2 * np.sin(0.028 / 1.1)  # triangles between neighbouring commissures
    # the coarse splines of this scene follow the free edge's sharp bend in the middle only roughly
    assert leaflets_of(spline)[0].opening() == pytest.approx(exact + gaps, rel=0.12)


def test_one_leaflet_that_moves_alone_breaks_the_symmetry(spline):
    """A displacement d of one of three leaves the mean by 2 d/3, and the others by d/3."""
    leaflets, y = leaflets_of(spline)
    coefficients = np.zeros((spline.geometry.n, 3))
    coefficients[spline.geometry.functions.global_numbers(1, np.arange(spline.geometry.patches[1].basis.n)), 2] = 0.3
    y.x.array[:] = spline.function(coefficients).x.array
    assert leaflets.asymmetry() == pytest.approx(0.3 * np.sqrt((4 + 1 + 1) / 27), rel=1e-10)
    assert leaflets.heights()[1, 0, 1] - leaflets.heights()[0, 0, 1] == pytest.approx(0.3, rel=1e-10)


def test_columns_of_contact_are_there_with_contact_alone(spline):
    without = leaflets_of(spline)[0].columns()
    touching = leaflets_of(spline, SimpleNamespace(kernel=SimpleNamespace(r_max=0.1)))[0].columns()
    assert set(touching) - set(without) == {"contact_pairs", "contact_load", "smallest_distance"}
    far, near = (SimpleNamespace(contact=SimpleNamespace(distance=d)) for d in (np.inf, 0.05))
    assert [touching["smallest_distance"](report) for report in (far, near)] == [0.1, 0.05]
    (names,) = (name for name in without if isinstance(name, tuple))
    assert names[:4] == ("tip_r_0", "tip_z_0", "belly_r_0", "belly_z_0")
    assert np.shape(without[names]()) == (3, 2, 2)
    assert len(names) == 12


def test_a_curve_is_no_valve():
    with pytest.raises(ValueError, match=r"^shell: dimension 1 in 2: a surface in space is required"):
        leaflets_of(ExtractedSpline(shapes.line((0, 0), (1, 0), elements=2, degree=2), MPI.COMM_SELF))


def test_a_projected_field_follows_the_state(spline):
    """Linear functions are in the space but for what lumping smooths; constants are exact."""
    y = spline.function(name="y")
    field = Projected(spline, y[0] ** 2 + 1.0)
    np.testing.assert_allclose(field(), 1.0, rtol=1e-12)
    assert field().shape == spline.node_weights.shape
    y.x.array[:] = spline.function(np.tile([2.0, 0.0, 0.0], (spline.geometry.n, 1))).x.array
    np.testing.assert_allclose(field(), 5.0, rtol=1e-12)


# -- flow rates -------------------------------------------------------------------------------------------------------


def test_leak_of_a_flow_that_rings_down():
    t = np.linspace(0.0, 0.3, 6001)
    ringing = -3.0 + 40.0 * np.exp(-(t - 0.12) / 0.05) * np.sin(2 * np.pi * (t - 0.12) / 0.01)
    q = np.where(t <= 0.1, 300.0 * np.sin(np.pi * t / 0.1), np.where(t < 0.12, -200.0 * (0.12 - t) / 0.02, ringing))
    found = flow_through(Course(t, q), 0.1)
    assert found["closure_time"] == pytest.approx(0.12, abs=1e-3)
    assert found["peak_flow_rate"] == pytest.approx(300.0, rel=1e-4)
    assert found["stroke_volume"] == pytest.approx(300.0 * 0.2 / np.pi, rel=1e-3)
    assert found["mean_leak"] == pytest.approx(3.0, rel=0.05)
    assert found["mean_leak_relative"] == pytest.approx(0.01, rel=0.05)
    assert found["oscillation_decay"] == pytest.approx(np.exp(-0.01 / 0.05), rel=0.01)
    assert found["oscillation_period"] == pytest.approx(0.01, rel=0.01)
    assert found["largest_backflow"] == pytest.approx(200.0, rel=0.01)


def test_a_flow_that_starts_to_go_back_twice_closes_after_the_second_time():
    q = Course(np.arange(8.0), [1.0, 1.0, -1.0, 0.5, -4.0, -2.0, 0.5, 0.5])
    assert flow_through(q, 1.0)["closure_time"] == 6.0


def test_a_valve_that_never_closes_has_no_closure():
    t = np.linspace(0.0, 0.2, 401)
    found = flow_through(Course(t, np.where(t <= 0.1, 100.0, -50.0)), 0.1)
    assert set(found) == {"peak_flow_rate", "stroke_volume", "largest_backflow"}
    assert set(flow_through(Course(t[:100], t[:100]), 0.1)) == {"peak_flow_rate", "stroke_volume"}


def test_a_reversal_before_the_first_sample_is_refused():
    with pytest.raises(ValueError, match=r"^reversal = -1.0: a time after the first sample is required"):
        flow_through(Course(np.linspace(0.0, 1.0, 5), np.ones(5)), -1.0)
