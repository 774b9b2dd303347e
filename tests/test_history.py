"""Histories: what is measured step by step, what comes back from files, and what signals of known shape amount to."""

from functools import partial
from itertools import pairwise
from operator import attrgetter
from types import SimpleNamespace

import numpy as np
import pytest
import ufl
from mpi4py import MPI

from tigar_x.run.course import Course, Extreme
from tigar_x.run.history import History, Recorder, of_report

WORLD = MPI.COMM_WORLD
OMEGA, DELTA, MEAN, AMPLITUDE = 2 * np.pi * 1.7, 0.3, 0.4, 2.0


@pytest.fixture
def folder(tmp_path):
    """One folder for all ranks."""
    return WORLD.bcast(tmp_path, root=0)


def sine(n=4001, end=10.0, decay=0.0):
    """A sine of known mean, amplitude, frequency and decay."""
    t = np.linspace(0.0, end, n)
    return Course(t, MEAN + AMPLITUDE * np.exp(-decay * t) * np.sin(OMEGA * t))


# -- signals of known shape -------------------------------------------------------------------------------------------


def test_a_sine_has_its_mean_amplitude_and_frequency():
    found = sine().oscillation()
    assert found.frequency == pytest.approx(1.7, rel=1e-3)
    assert (found.mean, found.amplitude) == pytest.approx((MEAN, AMPLITUDE), rel=1e-3)
    assert sine().frequency() == pytest.approx(1.7, rel=1e-4)
    whole = sine(end=17 / 1.7)
    assert whole.mean == pytest.approx(MEAN, rel=1e-9)
    assert whole.integral == pytest.approx(MEAN * 10.0, rel=1e-9)


@pytest.mark.parametrize("factor", [0.5, 3.0])
def test_an_oscillation_goes_with_units_of_value_and_time(factor):
    course = sine(decay=0.01)
    found, scaled = course.oscillation(), Course(factor * course.t, factor**2 * course.y).oscillation()
    assert scaled.mean == pytest.approx(factor**2 * found.mean)
    assert scaled.amplitude == pytest.approx(factor**2 * found.amplitude)
    assert scaled.frequency == pytest.approx(found.frequency / factor)


def test_a_decay_is_that_of_the_envelope():
    """From cycle to cycle the range falls by exp(-decay period), which is what the logarithmic decrement says."""
    course = sine(decay=DELTA)
    ringing = course.ringing(MEAN)
    assert ringing.cycles == 16
    assert ringing.period == pytest.approx(1 / 1.7, rel=1e-3)
    assert ringing.log_decrement == pytest.approx(DELTA / 1.7, rel=1e-3)
    assert ringing.decay == pytest.approx(np.exp(-DELTA / 1.7), rel=1e-3)
    assert ringing.mean == pytest.approx(MEAN, rel=0.02)
    grows = Course(course.t, MEAN + (course.y - MEAN)[::-1]).ringing(MEAN)
    assert grows.log_decrement == pytest.approx(-DELTA / 1.7, rel=1e-2)


def test_cycles_are_whole_and_follow_each_other():
    course = sine()
    cycles = course.cycles(MEAN)
    assert len(cycles) == 16
    for one, other in pairwise(cycles):
        assert one.t[-1] == other.t[0]
    assert sum(c.integral for c in cycles) == pytest.approx(course.between(cycles[0].t[0], cycles[-1].t[-1]).integral)


@pytest.mark.parametrize("count", [1, 3, 16])
def test_the_mean_over_whole_cycles_is_that_of_the_sine(count):
    course = sine()
    part = course.last_cycles(count, MEAN)
    assert part.t[-1] - part.t[0] == pytest.approx(count / 1.7, rel=1e-2)
    assert part.t[-1] > course.t[-1] - 1 / 1.7
    assert part.mean == pytest.approx(MEAN, abs=0.01)
    assert abs(course[: len(course) - 400].mean - MEAN) > 0.01
    assert len(course.last_cycles(17, MEAN)) == len(course)


def test_cycles_are_those_of_the_late_level_and_peaks_those_above_the_middle():
    """What rings about a level after it came down from another one; ripples below are no peaks."""
    t = np.linspace(0.0, 9.9, 4001)
    settled = Course(t, np.where(t < 5.0, 9.0, np.sin(OMEGA * t)))
    assert len(settled.cycles()) == len(settled.between(5.0).cycles(0.0)) == 7
    rippled = Course(t, np.sin(2 * np.pi * 0.5 * t) + 0.2 * np.sin(2 * np.pi * 4.5 * t))
    assert rippled.peaks.y.min() > rippled.middle > rippled.troughs.y.max()
    assert len(rippled.peaks) < np.count_nonzero(np.diff(np.sign(np.diff(rippled.y))) < 0)


def test_without_oscillation_there_is_no_frequency():
    rising = Course(np.arange(5.0), np.arange(5.0))
    assert np.isnan(rising.frequency())
    assert np.isnan(rising.oscillation().frequency)
    assert (rising.oscillation().mean, rising.oscillation().amplitude) == (2.0, 2.0)
    ringing = rising.ringing()
    assert (ringing.cycles, ringing.mean) == (0, 2.0)
    assert np.isnan([ringing.period, ringing.decay, ringing.log_decrement]).all()
    for ask in (Course([], []).oscillation, Course([], []).ringing):
        with pytest.raises(ValueError, match="the course has no samples"):
            ask()


def test_passages_lie_between_samples():
    t = np.array([0.0, 1.0, 3.0, 4.0, 5.0])
    course = Course(t, np.array([-1.0, 1.0, -3.0, 0.0, 2.0]))
    np.testing.assert_allclose(course.rises(0.0), [0.5, 4.0])
    np.testing.assert_allclose(course.falls(0.0), [1.5])
    np.testing.assert_allclose(Course(t, 5.0 + course.y).rises(5.0), course.rises(0.0))
    assert course.rises() == pytest.approx(course.rises(course.y.mean()))
    assert course.first(lambda y: y > 1.5) == 5.0
    assert course.first(lambda y: y > 9.0) is None


def test_an_extreme_of_a_parabola_is_exact():
    t = np.linspace(0.0, 2.0, 21)
    course = Course(t, 3.0 - (t - 0.93) ** 2)
    found = course.highest(0.0, 2.0)
    assert (found.t, found.value) == pytest.approx((0.93, 3.0))
    assert Course(t, -course.y).lowest(0.0, 2.0) == Extreme(found.t, -found.value)
    flat = course.highest(0.0, 2.0, accuracy=0.04)
    assert (flat.t, flat.value) == pytest.approx((0.93, 3.0), abs=0.01)


def test_an_extreme_that_is_not_there_yet_is_none():
    t = np.linspace(0.0, 2.0, 21)
    course = Course(t, t)
    assert course.highest(0.0, 2.0) is None  # at an end of the window
    assert course.lowest(0.5, 1.5) is None
    assert sine().highest(0.0, 11.0) is None  # the samples end before
    assert course.highest(0.5, 0.55) is None  # too few


def test_flat_tops_are_read_in_the_middle():
    t = np.linspace(0.0, 1.0, 1001)
    course = Course(t, np.minimum(1.0, 10 * np.minimum(t, 1.0 - t) + 0.3) + 1e-6 * t)
    assert course.highest(0.0, 1.0, accuracy=0.01) is not None
    assert course.highest(0.0, 1.0, accuracy=0.01).t == pytest.approx(0.5, abs=1e-3)
    assert course.highest(0.0, 1.0).t > 0.9  # the last of the top


def test_what_is_driven_has_a_peak_and_a_trough_in_every_period():
    t = 1e3 * np.linspace(0.0, 3.0, 400)[1:]
    driven = Course(t, 0.45 + 0.13 * np.cos(2 * np.pi * (t / 1e3 - 0.27)))
    found = driven.extremes(1e3, 0.6, accuracy=0.005)
    assert list(found) == [f"{kind}_{n}" for n in (1, 2, 3) for kind in ("peak", "trough")]
    for n in (1, 2, 3):
        peak, trough = found[f"peak_{n}"], found[f"trough_{n}"]
        assert (peak.t, trough.t) == pytest.approx((1e3 * (n - 0.73), 1e3 * (n - 0.23)), abs=0.1)
        assert (peak.value, trough.value) == pytest.approx((0.58, 0.32), abs=1e-4)


def test_peaks_and_troughs_that_are_not_reached_or_at_an_end_of_their_part_are_left_out():
    t = np.linspace(0.0, 3.0, 400)[1:]
    y = np.cos(2 * np.pi * (t - 0.27))
    assert set(Course(t, y)[t < 1.7].extremes(1.0, 0.6)) == {"peak_1", "trough_1", "peak_2"}
    assert set(Course(t, y).extremes(1.0, 0.2)) == {"trough_1", "trough_2", "trough_3"}
    assert not Course(t, t).extremes(1.0, 0.6)
    assert not Course([], []).extremes(1.0)


@pytest.mark.parametrize(("period", "split", "name"), [(0.0, 0.5, "period = 0.0"), (1.0, 1.5, "split = 1.5")])
def test_periods_and_their_parts_are_checked(period, split, name):
    with pytest.raises(ValueError, match=name):
        sine().extremes(period, split)


def test_parts_of_a_course():
    course = Course(np.arange(11.0), np.arange(11.0) ** 2)
    assert list(course.between(2.0, 4.0).t) == [2, 3, 4]
    assert list(course.last(3.0).t) == [7, 8, 9, 10]
    assert list(course.last(share=0.2).t) == [8, 9, 10]
    assert list(course[course.t > 8.0].y) == [81, 100]
    assert repr(course[2:4]) == "Course(2 samples, t = 2 to 3)"
    assert len(Course([], []).last(1.0)) == 0
    for bad in ({}, {"duration": 1.0, "share": 0.5}):
        with pytest.raises(ValueError, match="one of them is required"):
            course.last(**bad)
    with pytest.raises(ValueError, match=r"share = 1.5"):
        course.last(share=1.5)


@pytest.mark.parametrize(
    ("t", "y", "reason"),
    [([0.0, 1.0], [0.0], r"shapes \(2,\) and \(1,\)"), ([0.0, 0.0], [1.0, 1.0], "t does not increase")],
)
def test_a_course_needs_increasing_times_and_as_many_values(t, y, reason):
    with pytest.raises(ValueError, match=reason):
        Course(t, y)


# -- columns ----------------------------------------------------------------------------------------------------------


def report(t, **parts):
    return SimpleNamespace(t=t, **parts)


class Measuring:
    """A measurement as an object, which takes nothing."""

    def __call__(self, scale=2.0):
        return {"a": 1.0 * scale, "b": [3.0, 4.0]}


def test_columns_come_from_the_report_or_from_nothing():
    given = report(2.0, inner=SimpleNamespace(x=5))
    assert of_report("inner.x")(given) == 5
    assert of_report(attrgetter("inner.x"))(given) == 5
    assert of_report(lambda r: r.t)(given) == 2.0
    assert of_report(lambda: 7)(given) == 7
    assert of_report(lambda k=8: k)(given) == 8
    assert of_report(partial(lambda r, k: k + r.t, k=1.0))(given) == 3.0
    assert of_report(Measuring())(given) == {"a": 2.0, "b": [3.0, 4.0]}


COLUMNS = {
    "passes": "passes",
    "force": lambda r: np.array([r.t, -r.t]),
    ("drag", "lift"): lambda: (1.5, 2),
    "all of it": Measuring(),
}
NAMES = ("passes", "force_1", "force_2", "drag", "lift", "a", "b_1", "b_2")


def recorded(path, times, after=None, columns=COLUMNS):
    with Recorder(columns, path, after=after) as recorder:
        for t in times:
            recorder.record(report(t, passes=round(10 * t)))
        return recorder.history


@pytest.mark.mpi
def test_numbers_vectors_and_names_become_columns_and_come_back(folder):
    path = folder / "history.csv"
    kept = recorded(path, [0.1, 0.2, 1 / 3])
    read = History.read(path)
    assert read.names == kept.names == NAMES
    assert (read.rows == kept.rows).all()
    np.testing.assert_array_equal(read.t, [0.1, 0.2, 1 / 3])
    np.testing.assert_array_equal(read["passes"], [1, 2, 3])
    np.testing.assert_array_equal(read.vector("force"), np.outer([0.1, 0.2, 1 / 3], [1, -1]))
    np.testing.assert_array_equal(read.vector("drag"), [[1.5]] * 3)
    np.testing.assert_array_equal(read.since(0.2).t, [0.2, 1 / 3])
    others = History(("x_1", "x_t1", "x_2"), [[0.0, 1.0, 9.0, 2.0]])
    np.testing.assert_array_equal(others.vector("x"), [[1.0, 2.0]])
    assert "lift" in read
    assert "force" not in read
    assert list(read) == ["t", *NAMES]
    assert read.course("a", "force_1").t[-1] == 1 / 3
    assert path.read_text().splitlines()[:2] == [
        "t,passes,force_1,force_2,drag,lift,a,b_1,b_2",
        "0.1,1,0.1,-0.1,1.5,2,2.0,3.0,4.0",
    ]
    with pytest.raises(KeyError, match=r"'thrust': one of \('t', 'passes'"):
        read["thrust"]
    assert repr(read).startswith("History(3 times, t = 0.1 to 0.333333; passes, force_1")


@pytest.mark.mpi
def test_a_history_that_goes_on_has_the_rows_until_then(folder):
    path, times = folder / "history.csv", [0.1, 0.2, 0.3, 0.4]
    whole = recorded(folder / "whole.csv", times)
    recorded(path, times[:3])
    assert (recorded(path, times[2:], after=0.2).rows == whole.rows).all()
    assert path.read_bytes() == (folder / "whole.csv").read_bytes()
    assert (recorded(path, [], after=0.2).rows == whole.rows[:2]).all()
    assert (recorded(None, times).rows == whole.rows).all()


@pytest.mark.mpi
def test_all_ranks_keep_what_the_first_one_measured():
    assert recorded(None, [1.0], columns={"rank": lambda: WORLD.rank})["rank"] == [0.0]


def test_a_history_that_goes_on_has_the_same_columns(tmp_path):
    path = tmp_path / "history.csv"
    recorded(path, [0.1])
    before = path.read_bytes()
    with pytest.raises(ValueError, match="columns"):
        recorded(path, [0.2], after=0.1, columns={"other": "t"})
    assert path.read_bytes() == before


@pytest.mark.parametrize(
    ("columns", "reason"),
    [
        ("monitors.leak", r"^history = 'monitors\.leak': columns by name, such as \{.* is required"),
        ({"a": "leak"}, r"^column = 'leak': .* has no 'leak'; one of .* is required"),
        ({"a": ufl.Form([])}, r"columns\['a'\] is a form: a function is required, such as varmint's Measured"),
        ({"a": 3.0}, r"columns\['a'\] = 3.0: a function or the name"),
        ({"a\n": "t"}, "column = 'a"),
        ({("a", "b"): lambda: [1.0]}, "1 numbers were measured, 2 are required"),
        ({"a": lambda: "much"}, "column 'a' = 'much': a number, a vector or a dict of them is"),
        ({"a": lambda: None}, "column 'a' = None: a number, a vector or a dict"),
        ({"t": "t"}, "is there twice"),
        ({"a": lambda: {"b": 1}, "b": "t"}, "is there twice"),
    ],
)
def test_what_is_no_column_is_refused(columns, reason, tmp_path):
    with pytest.raises(ValueError, match=reason):
        recorded(tmp_path / "history.csv", [0.1], columns=columns)


def test_a_vector_does_not_change_its_length(tmp_path):
    with pytest.raises(ValueError, match="were measured"):
        recorded(None, [1.0, 2.0], columns={"a": lambda r: np.ones(int(r.t))})


@pytest.mark.parametrize("text", ["", "time,x\n0,1\n", "t,x\n0,much\n", "t,x\n0,1\n0,1,2\n"])
def test_a_file_that_is_no_history_is_refused(text, tmp_path):
    (tmp_path / "history.csv").write_text(text)
    with pytest.raises(ValueError, match="not a history"):
        History.read(tmp_path / "history.csv")


def test_a_history_is_found_in_the_folder_of_its_run_and_tells_of_vectors(tmp_path):
    recorded(tmp_path / "history.csv", [0.1], columns={"force": lambda: [1.0, 2.0]})
    found = History.read(tmp_path)
    assert found.names == ("force_1", "force_2")
    with pytest.raises(KeyError, match=r"'force' is a vector: vector\('force'\)"):
        found["force"]


def test_rows_fit_the_names():
    with pytest.raises(ValueError, match=r"rows has shape \(2, 2\): \(times, 3\) is required"):
        History(["a", "b"], np.zeros((2, 2)))
