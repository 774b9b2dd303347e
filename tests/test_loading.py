"""The way along a load: what is measured after every step, and where it goes."""

from types import SimpleNamespace

import numpy as np
import pytest

from tigar_x.fem.load_stepping import LoadReport
from tigar_x.run.history import History
from tigar_x.run.loading import follow


class Spring:
    """A static problem of one number, y = 3 t, loaded in steps of a given size or of the last one."""

    def __init__(self):
        self.y, self.t, self.size, self.given = 0.0, 0.0, 1.0, []

    def solve(self, until, *, each, step=None):
        self.given.append(step)
        self.size, loads = step or self.size, []
        while self.t < until - 1e-12:
            self.t = min(self.t + self.size, until)
            self.y = 3.0 * self.t
            loads.append(self.t)
            each(self.t)
        return LoadReport(tuple(loads), (2,) * len(loads), (0,) * len(loads))


def results_in(folder, viz=True):
    return SimpleNamespace(out=folder, viz=viz)


class Written:
    def __init__(self):
        self.times, self.closed = [], False

    def write(self, t):
        self.times.append(t)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.closed = True


def test_states_are_measured_from_the_start_on():
    spring, states = Spring(), []
    path = follow(spring.solve, {"y": lambda: spring.y}, until=(0.5, 1.0), step=0.25, each=states.append)
    assert path.loads == (0.0, 0.25, 0.5, 0.75, 1.0) == tuple(states)
    np.testing.assert_array_equal(path.history["y"], 3.0 * np.array(path.loads))
    assert path.final("y") == 3.0
    assert (path.report.loads, path.iterations) == ((0.25, 0.5, 0.75, 1.0), 8)
    assert spring.given == [0.25, None]  # the second load goes on as the first one ended
    assert path.results() | {"wall_s": 0, "cpu_s": 0} == {
        "steps": 4, "newton_iterations": 8, "cuts": 0, "wall_s": 0, "cpu_s": 0,
    }  # fmt: skip


def test_files_are_those_of_the_script(tmp_path):
    spring, shown, hidden = Spring(), Written(), Written()
    follow(spring.solve, {"y": lambda: spring.y}, series=[lambda: shown], results=results_in(tmp_path), step=0.5)
    assert shown.times == [0.5, 1.0]
    assert shown.closed
    np.testing.assert_array_equal(History.read(tmp_path / "history.csv").t, [0.0, 0.5, 1.0])
    follow(Spring().solve, {"y": lambda: 0.0}, series=[hidden], results=results_in(tmp_path / "other", viz=False))
    assert not hidden.times
    assert (tmp_path / "other" / "history.csv").exists()


def test_files_are_finished_when_a_load_is_not_reached(tmp_path):
    def fails(until, *, each):
        each(0.5)
        raise RuntimeError("no equilibrium")

    shown = Written()
    with pytest.raises(RuntimeError, match="no equilibrium"):
        follow(fails, {"y": lambda: 1.0}, series=[shown], results=results_in(tmp_path))
    assert shown.closed
    assert History.read(tmp_path / "history.csv").t.tolist() == [0.0, 0.5]
