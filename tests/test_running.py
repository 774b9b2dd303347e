"""Runs as iterators: what a run writes, when, and what is left of it however it ends."""

import logging
import os
import signal
from dataclasses import dataclass
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from mpi4py import MPI
from mpi_runs import SAME_RUN
from restarted import scene
from test_restart import flow
from test_shell import cantilever

from coudalfish import CouplingOptions
from shnapr.conditions import DeadLoad
from tigar_x.fem.cutting import cut_steps
from tigar_x.run.history import History
from tigar_x.run.output import CSVSeries
from tigar_x.run.progress import Progress
from tigar_x.run.running import Run
from tigar_x.run.tally import Tally
from varmint.conditions import Velocity
from varmint.flow import Flow, FlowError
from varmint.flow.movie import movie
from varmint.mesh import box

WORLD = MPI.COMM_WORLD


@pytest.fixture
def folder(tmp_path):
    """One folder for all ranks."""
    return WORLD.bcast(tmp_path, root=0)


@dataclass(frozen=True)
class Report:
    t: float
    passes: int
    residuals: tuple = ((1e-3, 1e-4),)
    linear_iterations: int = 7
    measured: float | None = None


class Logistic:
    """The logistic map as something to be stepped: a chaotic state tells the slightest difference of two runs."""

    def __init__(self, dt=0.1, failing=()):
        self.time, self.step_size, self.x, self.failing = 0.0, dt, 0.3, list(failing)
        self.fields, self.settings, self.sizes = {}, {}, {"dofs_fluid": 1}

    def take_step(self, measure=None):
        if self.failing and self.time > self.failing[0] - 1e-9:
            del self.failing[0]
            raise RuntimeError(f"too large at {self.time:g}")
        self.x = 3.9 * self.x * (1.0 - self.x)
        measured = None if measure is None else measure()
        self.time += self.step_size
        return Report(self.time, 1 + round(10 * self.x), measured=measured)

    def advance(self, interval, measure):
        return cut_steps(lambda: self.take_step(measure), [self], interval, RuntimeError)

    def monitors(self, report):
        return {"measured": report.passes}

    # the state that a restart asks for

    def state(self):
        return self

    def record(self):
        return {"time": self.time, "x": self.x, "dt": self.step_size}

    def check(self, record):
        pass

    def resume(self, record):
        self.time, self.x, self.step_size = record["time"], record["x"], record["dt"]


class Log:
    """A series that remembers when it wrote and how it ended."""

    def __init__(self, after=None):
        self.after, self.times, self.ended = after, [], None

    def write(self, t):
        self.times.append(round(t, 10))

    def __enter__(self):
        return self

    def __exit__(self, kind, error, trace):
        self.ended = "closed" if error is None else kind.__name__


def run_of(made, folder=None, **options):
    columns = {"x": lambda: made.x, "passes": "passes"}
    return Run(made, **{"out": folder, "history": columns, "inputs": {"level": 2}} | options)


# -- how far, and what is written when --------------------------------------------------------------------------------


@pytest.mark.mpi
@pytest.mark.parametrize("length", [{"until": 0.75}, {"steps": 7}, {"until": 0.65}])
def test_a_run_yields_the_report_of_every_step(length):
    made, whole = Logistic(), Logistic()
    reports = list(run_of(made, **length))
    expected = [whole.take_step() for _ in range({0.75: 8, 0.65: 6}.get(length.get("until"), 7))]
    assert reports == expected


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({}, range(1, 11)),
        ({"every": 3}, [3, 6, 9, 10]),
        ({"every": np.int64(4), "steps": 8}, [4, 8]),
        ({"every": 0.25}, [3, 5, 8, 10]),
        ({"every": 0.3}, [3, 6, 9, 10]),
        ({"every": 50.0}, [10]),
        ({"frames": 5}, [2, 4, 6, 8, 10]),
        ({"frames": 4}, [2, 4, 6, 8, 10]),
        ({"frames": 0}, []),
        ({"frames": 100}, range(1, 11)),
    ],
)
def test_series_write_every_so_many_steps_or_so_much_time_and_at_the_end(options, expected):
    log, written = Log(), []
    run = run_of(Logistic(), series=[log], **{"steps": 10} | options)
    for _ in run:
        written += [run.step] if run.writes else []
    assert written == list(expected)
    assert log.times == pytest.approx([0.1 * n for n in expected])
    assert log.ended == "closed"


def test_a_run_follows_a_step_size_that_its_body_changes():
    made, log = Logistic(), Log()
    run = run_of(made, until=1.0, every=0.2, series=[log])
    for report in run:
        if report.t > 0.45 and made.step_size == 0.1:
            made.step_size = 0.05
    assert (run.step, run.steps, run.finished) == (15, 15, True)
    assert made.time == pytest.approx(1.0)
    assert log.times == pytest.approx([0.2, 0.4, 0.6, 0.8, 1.0])


@pytest.mark.mpi
def test_measure_is_called_in_every_step_and_columns_after_it(folder):
    made = Logistic(failing=[0.2])
    order = []
    run = run_of(
        made,
        folder,
        steps=4,
        measure=lambda: order.append(("step", round(made.time, 10))) or made.x,
        history={"measured": "measured", "x": lambda: order.append(("row", round(made.time, 10))) or made.x},
    )
    for report in run:
        assert report is run.reports[-1]
        assert len(run.history) == run.step
        order.append(("body", run.step))
    cut = [("step", 0.2), ("step", 0.25), ("row", 0.3), ("body", 3)]
    assert order[6:10] == cut
    assert (run.history["measured"] == run.history["x"]).all()
    assert (History.read(folder / "history.csv").rows == run.history.rows).all()


def test_nothing_is_written_without_a_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run = run_of(Logistic(), steps=3)
    assert len(list(run)) == len(run.history) == 3
    assert not list(tmp_path.iterdir())
    for use in (run.checkpoint, lambda: run.summary("nothing")):
        with pytest.raises(ValueError, match="out = None: a folder is required"):
            use()
    with pytest.raises(ValueError, match="no columns"):
        _ = Run(Logistic(), steps=1).history
    with pytest.raises(RuntimeError, match="has been gone through"):
        iter(run)


# -- runs that go on --------------------------------------------------------------------------------------------------


@pytest.mark.mpi
@pytest.mark.parametrize("last", [3, 5, 9])
def test_a_run_that_dies_goes_on_to_the_same_rows_bit_for_bit(last, folder):
    """It dies in the step after the last one it has written, and goes on from the checkpoint before."""
    more = [partial(CSVSeries, folder / "whole.csv", ())], [partial(CSVSeries, folder / "one.csv", ())]
    whole = list(run_of(Logistic(), folder / "whole", steps=12, every=3, series=more[0]))
    for report in run_of(Logistic(), folder / "one", steps=12, every=3, series=more[1], checkpoint_every=2):
        if report.t > 0.1 * last - 1e-9:
            break  # without a checkpoint
    made, step = Logistic(), (last - 1) // 2 * 2
    run = run_of(made, folder / "one", steps=12, every=3, series=more[1], restart="latest")
    assert (run.step, run.after) == (step, pytest.approx(0.1 * step))
    assert list(run) == whole[step:]
    for name in ("{}/history.csv", "{}.csv"):
        assert (folder / name.format("one")).read_bytes() == (folder / name.format("whole")).read_bytes()
    assert len(run.history) == 12


@pytest.mark.mpi
def test_series_are_made_with_the_time_that_a_run_goes_on_from(folder):
    made = []

    def series(after):
        made.append(Log(after))
        return made[-1]

    list(run_of(Logistic(), folder, steps=4, checkpoint_every=2, every=3, series=[series]))
    run = run_of(Logistic(), folder, steps=8, restart=2, every=3, series=[series])
    assert len(made) == 1  # they are made when the loop begins
    list(run)
    assert [log.after for log in made] == [None, pytest.approx(0.2)]
    assert made[1].times == pytest.approx([0.3, 0.6, 0.8])


@pytest.mark.mpi
def test_costs_and_what_the_script_remembers_survive_a_restart(folder):
    def go(run):
        for report in run:
            run.extra["most"] = max(run.extra.get("most", 0), report.passes)
        return run

    whole = go(run_of(Logistic(failing=[0.3, 0.6]), folder / "whole", steps=8))
    go(run_of(Logistic(failing=[0.3]), folder / "one", steps=5, checkpoint_every=5))
    run = go(run_of(Logistic(failing=[0.6]), folder / "one", steps=8, restart="latest"))
    assert run.extra == whole.extra
    assert run.tally.cuts == whole.tally.cuts == 2
    kept = {"wall_s", "cpu_s", "compile_s", "peak_rss_mib", "rss_mib_step_10", "rss_mib_end"}
    one, other = ({k: v for k, v in r.summary("map").items() if k not in kept} for r in (run, whole))
    assert one == other
    assert one["inputs"] == {"level": 2}
    assert one["steps"] == 8
    assert one["dofs_fluid"] == 1
    assert one["block_iterations_max"] == one["monitors"]["measured_max"] == whole.extra["most"]
    assert one["block_iterations_mean"] > 1.0
    assert one["linear_iterations_mean"] == 7 * 10 / 8
    assert one["monitors"]["cut_steps"] == 2


def test_seconds_go_on_from_those_before():
    tally = Tally({"wall_s": 5.0, "cpu_s": 3.0})
    tally.watch.wall_s, tally.watch.cpu_s = 0.25, 0.125
    for _ in range(2):  # the watch has the sum already
        tally.add([Report(0.1, 1)])
    assert (tally.wall_s, tally.cpu_s) == (5.25, 3.125)
    assert str(tally) == "2 steps, 3.125 CPU s, 1.00 passes each"


@pytest.mark.mpi
def test_a_run_that_is_told_to_end_writes_a_checkpoint_and_goes_on(folder, caplog):
    made, log = Logistic(), Log()
    run = run_of(made, folder, steps=9, series=[log], every=4)
    with caplog.at_level(logging.INFO):
        for _ in run:
            if run.step == 5 and WORLD.rank == WORLD.size - 1:
                os.kill(os.getpid(), signal.SIGTERM)
    assert (run.step, run.finished, log.ended, log.times) == (5, False, "closed", [0.4])
    assert [path.name for path in (folder / "checkpoints").glob("*.npz")] == ["checkpoint_00000005.npz"]
    if WORLD.rank == 0:
        assert "ended after step 5 at t = 0.5, as told; restart = latest goes on from" in caplog.text
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    rest = run_of(Logistic(), folder, steps=9, restart="latest")
    assert len(list(rest)) == 4
    assert rest.finished
    whole = run_of(Logistic(), steps=9)
    list(whole)
    assert (rest.history.rows == whole.history.rows).all()


def test_a_run_without_a_folder_ends_when_told(caplog):
    run = run_of(Logistic(), steps=9)
    for _ in run:
        if run.step == 2:
            os.kill(os.getpid(), signal.SIGTERM)
    assert (run.step, run.finished) == (2, False)


# -- runs that end early ----------------------------------------------------------------------------------------------


@pytest.mark.mpi
def test_a_break_closes_the_files(folder):
    made, log = Logistic(), Log()
    run = run_of(made, folder, steps=9, series=[log, partial(CSVSeries, folder / "more.csv", ())])
    for _ in run:
        if run.step == 3:
            break
    assert (run.step, run.finished, log.ended) == (3, False, "closed")
    assert len(History.read(folder / "history.csv")) == 3
    assert len(History.read(folder / "more.csv")) == 3
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL


@pytest.mark.mpi
def test_an_error_in_the_body_closes_the_files(folder):
    log = Log()

    def body():
        for report in run_of(Logistic(), folder, steps=9, series=[log]):
            _ = 1 / (report.t < 0.25)

    with pytest.raises(ZeroDivisionError):
        body()
    assert log.ended == "closed"
    assert len(History.read(folder / "history.csv")) == 3


def test_an_error_in_a_step_leaves_the_files_and_is_raised(tmp_path):
    class Failing(Logistic):
        def advance(self, interval, measure):
            if self.time > 0.25:
                raise RuntimeError("no way")
            return super().advance(interval, measure)

    log = Log()
    run = run_of(Failing(), tmp_path, steps=9, series=[log])
    with pytest.raises(RuntimeError, match="no way"):
        list(run)
    assert log.ended == "RuntimeError"
    assert run.step == 3
    assert len(History.read(tmp_path / "history.csv")) == 3
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL


def test_series_that_were_made_are_left_when_the_next_one_cannot_be():
    log = Log()

    def broken(after):
        raise OSError("disk full")

    made = Logistic()
    with pytest.raises(OSError, match="disk full"):
        list(run_of(made, steps=2, series=[log, broken]))
    assert (log.ended, made.time) == ("OSError", 0.0)


def test_what_only_writes_and_closes_is_a_series_too():
    class Plain:
        closed = 0

        def write(self, t):
            self.t = t

        def close(self):
            self.closed += 1

    plain, bare = Plain(), SimpleNamespace(write=lambda t: None)
    list(run_of(Logistic(), steps=2, series=[plain, bare]))
    assert (plain.closed, plain.t) == (1, 0.2)


# -- cuts -------------------------------------------------------------------------------------------------------------


def test_a_step_that_fails_is_halved_and_the_next_interval_is_whole(caplog):
    made = Logistic(failing=[0.2, 0.2, 0.2])
    run = run_of(made, steps=4)
    counts = [len(run.reports) for _ in run]
    assert counts == [1, 1, 8, 1]
    assert (run.tally.cuts, made.step_size) == (7, 0.1)
    assert made.time == pytest.approx(0.4)
    assert "too large at 0.2; going on with dt = 0.05" in caplog.text


def test_a_step_is_not_halved_for_ever():
    made = Logistic(failing=[0.0] * 9)
    with pytest.raises(RuntimeError, match="too large at 0"):
        cut_steps(made.take_step, [made], 0.1, RuntimeError, halvings=2)
    assert (len(made.failing), made.step_size) == (6, 0.1)
    for bad in ({"halvings": -1}, {"interval": 0.0}):
        with pytest.raises(ValueError, match=next(iter(bad))):
            cut_steps(made.take_step, [made], **{"interval": 0.1, "failures": RuntimeError} | bad)


# -- progress ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("show", "line"),
    [
        (None, "step 4/20  t = 0.4  passes"),
        (lambda report: f"x at {report.t:.1f}", "step 4/20  x at 0.4"),
    ],
)
def test_progress_lines_say_where_the_run_is(show, line, caplog):
    with caplog.at_level(logging.INFO, logger="tigar_x"):
        list(run_of(Logistic(), steps=20, show=show))
    lines = [record.getMessage() for record in caplog.records]
    assert len(lines) == 10
    assert lines[1].startswith(line)
    if show is None:
        assert lines[1].endswith("residuals 1.0e-03, 1.0e-04")


def test_a_run_may_be_silent(caplog):
    with caplog.at_level(logging.INFO, logger="tigar_x"):
        list(run_of(Logistic(), steps=20, show=False))
    assert not caplog.records


# -- what is refused --------------------------------------------------------------------------------------------------


@pytest.mark.mpi
def test_a_folder_with_results_is_refused_before_any_step(folder):
    list(run_of(Logistic(), folder, steps=3))
    before = (folder / "history.csv").read_bytes()
    made, called = Logistic(), []
    with pytest.raises(FileExistsError, match="has the results of an earlier run"):
        run_of(made, folder, steps=3, series=[called.append])
    assert (made.time, called, (folder / "history.csv").read_bytes()) == (0.0, [], before)
    WORLD.barrier()
    list(run_of(made, folder, steps=2, overwrite=True))
    assert len(History.read(folder / "history.csv")) == 2


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"until": 0.0}, "until = 0.0: a time later"),
        ({"steps": 3, "history": {"x": 3}}, "a function or the name"),
        ({"steps": 3, "checkpoint_every": 1, "inputs": {"x": float("inf")}}, "finite JSON is required"),
        ({"steps": 3, "series": [3]}, "series: 3 can neither write nor be called"),
    ],
)
def test_what_is_refused_deletes_nothing(options, reason, tmp_path):
    list(run_of(Logistic(), tmp_path, steps=3))
    before = (tmp_path / "history.csv").read_bytes()
    with pytest.raises(ValueError, match=reason):
        run_of(Logistic(), tmp_path, overwrite=True, **options)
    assert (tmp_path / "history.csv").read_bytes() == before


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"steps": 1, "measure": {"a": len}}, r"measure = \{'a': .*: a function is required"),
        ({}, "until = None, steps = None: one of them is required"),
        ({"until": 1.0, "steps": 3}, "until = 1.0, steps = 3: one of them is required"),
        ({"until": 0.0}, "until = 0.0: a time later than t = 0, where the run begins, is required"),
        ({"until": float("nan")}, "until = nan"),
        ({"steps": -1}, "steps = -1"),
        ({"steps": 3, "every": 0}, "every = 0"),
        ({"steps": 3, "every": -0.5}, "every = -0.5"),
        ({"steps": 3, "every": 2, "frames": 2}, "every = 2, frames = 2: one of them is allowed"),
        ({"steps": 3, "frames": -1}, "frames = -1"),
        ({"steps": 3, "checkpoint_every": -1}, "checkpoint_every = -1"),
        ({"steps": 3, "series": [3]}, "series: 3 can neither write nor be called"),
        ({"steps": 3, "restart": "latest"}, "out = None: a folder is required with restart = 'latest'"),
        ({"steps": 3, "checkpoint_every": 2}, "out = None: a folder is required"),
        ({"steps": 3, "history": {"x": 3}}, "a function or the name"),
    ],
)
def test_bad_options_are_refused(options, reason):
    with pytest.raises(ValueError, match=reason):
        Run(Logistic(), **options)


def test_a_checkpoint_that_is_not_there_is_refused(tmp_path):
    with pytest.raises(FileNotFoundError):
        run_of(Logistic(), tmp_path, steps=3, restart="latest")


def test_the_bar_of_a_run_ends_its_line(monkeypatch, capsys):
    monkeypatch.setattr("sys.stderr.isatty", lambda: True)
    list(run_of(Logistic(), steps=3))
    text = capsys.readouterr().err
    assert text.endswith("\n")
    assert text.count("\n") == 1
    assert "step 3/3" in text
    assert Progress(3)._n == 3


def test_an_end_between_steps_is_told_before_the_first_of_them(caplog):
    run = run_of(Logistic(), until=0.67)
    assert [r.getMessage() for r in caplog.records] == [
        "until = 0.67 is no whole number of steps of 0.1 away: the run ends at t = 0.7"
    ]
    caplog.clear()
    run.through()
    assert not caplog.records
    run_of(Logistic(), until=0.7), run_of(Logistic(), steps=3)
    assert not caplog.records


def test_one_series_need_not_be_in_a_list():
    log = Log()
    run_of(Logistic(), steps=2, series=log).through()
    assert log.times == [0.1, 0.2]


# -- a coupled scene and a flow ---------------------------------------------------------------------------------------


@pytest.mark.mpi
def test_a_coupled_run_is_its_steps(folder):
    made, whole = scene().fsi, scene().fsi
    run = made.run(
        until=0.2,
        out=folder,
        checkpoint_every=2,
        history={"t_alpha": "t_alpha", "leak": "monitors.leak"},
        measure=lambda: made.lam.max(),
    )
    reports = list(run)
    expected = [whole.takeStep(lambda: whole.lam.max()) for _ in range(4)]
    values = {"rtol": 0, "atol": max(SAME_RUN, 1e-10) * np.abs(whole.timeInt_f.x.x.array).max()}
    for found, wanted in zip(reports, expected, strict=True):
        assert found.t == pytest.approx(wanted.t)
        assert abs(found.passes - wanted.passes) <= (SAME_RUN > 0.0)
        assert found.measured == pytest.approx(wanted.measured, rel=max(SAME_RUN, 1e-9))
    np.testing.assert_allclose(made.timeInt_f.x.x.array, whole.timeInt_f.x.x.array, **values)
    assert run.history["leak"] == pytest.approx([r.monitors.leak for r in expected], rel=1e-6, abs=1e-12)
    resumed = scene().fsi
    again = resumed.run(until=0.2, out=folder, restart=2, history={"t_alpha": "t_alpha", "leak": "monitors.leak"})
    list(again)
    np.testing.assert_allclose(resumed.timeInt_f.x.x.array, made.timeInt_f.x.x.array, **values)
    np.testing.assert_allclose(again.history.rows, run.history.rows, rtol=1e-8, atol=max(SAME_RUN, 1e-10))
    found = again.summary("sheet", monitors={"more": 1})
    assert found["dofs_fluid"] == 75
    assert found["dofs_shell"] == 2 * 17
    leak = again.history["leak"]
    assert leak.min() < 0.0
    assert found["monitors"]["leak_max"] == pytest.approx(np.abs(leak).max(), rel=1e-6)
    assert found["steps"] == 4
    assert set(found["monitors"]) == {
        *("cut_steps", "slip_ratio_max", "normal_slip_max", "leak_max", "force_imbalance_max", "more")
    }


@pytest.mark.mpi
@pytest.mark.parametrize("moves", [False, True])
def test_a_run_of_a_flow_is_its_steps_and_goes_on(moves, folder):
    made, whole, resumed = flow(moves), flow(moves), flow(moves)
    run = made.run(until=0.4, out=folder, checkpoint_every=2, history={"iterations": "iterations"}, show=False)
    reports = list(run)
    expected = [whole.take_step() for _ in range(4)]
    assert [report.t for report in reports] == [report.t for report in expected]
    list(resumed.run(until=0.4, out=folder, restart=2, history={"iterations": "iterations"}, show=False))
    for other in (whole, resumed):
        np.testing.assert_allclose(other.w.x.array, made.w.x.array, rtol=0, atol=max(SAME_RUN, 1e-10))
    found = run.summary("cavity")
    assert found["dofs_fluid"] == 75
    assert found["newton_iterations_mean"] == np.mean([report.iterations for report in expected])
    assert found["tangents_mean"] == np.mean([report.tangents for report in expected])


def test_a_step_of_a_flow_on_a_moving_mesh_is_cut():
    """Flow and mesh keep one clock through it."""
    made, attempts = flow(moves=True), []

    def failing():
        attempts.append(made.time.step_size)
        if made.time.step_size > 0.06:
            raise FlowError("too large", 0.0)

    run = made.run(steps=1, measure=failing, show=False)
    list(run)
    assert attempts == pytest.approx([0.1, 0.05, 0.05])
    assert made.time.time == made.moving.time.time == pytest.approx(0.1)
    assert made.time.step_size == made.moving.time.step_size == 0.1


def test_a_movie_of_a_flow_has_the_displacement_of_a_mesh_that_moves():
    fields = [set(movie(flow(moves), "flow.vtkhdf").keywords) for moves in (False, True)]
    assert fields == [{"velocity", "pressure"}, {"velocity", "pressure", "mesh_displacement"}]


def test_an_interrupt_in_a_step_of_a_flow_leaves_the_state_before_it():
    made = flow(moves=True)
    before = made.w.x.array.copy()

    def interrupt():
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        made.take_step(interrupt)
    assert not made.time.in_step
    assert not made.moving.time.in_step
    np.testing.assert_array_equal(made.w.x.array, before)


def test_a_run_of_a_shell_is_its_steps():
    made, whole = (cantilever(DeadLoad((0.0, 50.0)), dt=0.01) for _ in range(2))
    run = made.run(until=0.03, history={"energy": lambda: made.energies().elastic}, show=False)
    assert [report.residuals for report in run] == [whole.take_step().residuals for _ in range(3)]
    assert (made.y.x.array == whole.y.x.array).all()
    assert run.history["energy"][-1] == made.energies().elastic > 0.0


def test_what_has_no_clock_cannot_be_run():
    steady = Flow(
        box(WORLD, (0.0, 0.0), (1.0, 1.0), (1, 1)), [Velocity(("left", "right", "bottom", "top"))], rho=1.0, mu=1.0
    )
    for made in (steady, cantilever()):
        with pytest.raises(ValueError, match="dt = None"):
            made.run(steps=1)


# -- presets ----------------------------------------------------------------------------------------------------------


def test_single_options_are_changed_by_name():
    options = CouplingOptions(block_rtol=1e-4)
    assert options.with_(relaxation=0.5) == CouplingOptions(block_rtol=1e-4, relaxation=0.5)
    assert CouplingOptions.reference(penalty=500.0, block_rtol=1e-2) == CouplingOptions.reference().with_(
        penalty=500.0, block_rtol=1e-2
    )
    assert CouplingOptions.converged(multiplier_size=3.0).multiplier_size == 3.0
    with pytest.raises(TypeError, match="relaxtion is no option of the coupling: one of penalty, multiplier,"):
        options.with_(relaxtion=0.5)
    with pytest.raises(ValueError, match="relaxation = -1"):
        CouplingOptions.reference(relaxation=-1.0)
