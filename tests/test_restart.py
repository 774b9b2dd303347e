"""Runs that go on from a checkpoint are the runs that were never ended, and nothing of the state is superfluous."""

import logging
import os
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import contextmanager
from dataclasses import replace
from unittest import mock

import numpy as np
import pytest
import restarted
import test_moving_coupler as moving
from mpi4py import MPI
from divided import CONVERGED, FLAP, TIGHT, channel
from load import load_demo
from mpi_runs import MPIRUN, SAME_RUN, mpirun, outside
from on_disk import ROOT, read_vtkhdf
from test_coupled_contact import approaching
from test_sided import membrane

from coudalfish import PenaltyRule
from coudalfish.restart import CoupledState
from coudalfish.step import condensed
from tigar_x.fem.linear import SolveError
from tigar_x.fem.schemes import generalized_alpha
from tigar_x.run.restart import Integrators, Restart
from varmint.conditions import Velocity
from varmint.flow import Flow, FlowOptions
from varmint.forms.motion import ElasticMotion, PrescribedMotion
from varmint.mesh import box

WORLD = MPI.COMM_WORLD
STEPS, BREAK = 6, 3


@pytest.fixture
def folder(tmp_path):
    """One folder for all ranks."""
    return WORLD.bcast(tmp_path, root=0)


def elastic(mesh, scheme):
    """A mesh whose nodes are balanced to 1e-10 of a cell, whatever tangent an earlier step has left."""
    return ElasticMotion(mesh, dict.fromkeys(moving.SIDES, moving.breathing), moving.DT, scheme, rtol=1e-12)


def rational(n):
    return np.random.default_rng(0).uniform(0.5, 2.0, n)


def dynamic():
    """A flap in a flow with sub-scales of their own, whose fields differ on both sides of it."""
    return channel(FLAP, subscales="dynamic", options=CONVERGED.with_(**TIGHT)).fsi


class Fallen:
    """The same, which falls back to a lagged multiplier in the step before the break."""

    def __init__(self):
        self.fsi = dynamic()
        self.take_step, self.fsi.takeStep = self.fsi.takeStep, self

    def __call__(self):
        if round(self.fsi.timeInt_f.time / self.fsi.step_size) != BREAK - 1:
            return self.take_step()
        with mock.patch.object(condensed.CondensedSystem, "solve", side_effect=SolveError("as told")) as failing:
            report = self.take_step()
        assert failing.call_count == 3
        assert np.abs(self.fsi.lam).max() > 0.0
        return report


def on_moving_mesh(motion):
    """A sheet on a mesh that moves; means over its vertices would feel what is left of solves tenfold."""
    return moving.scene(motion, sheet_velocity=(0.5, 0.0), n=4, options=moving.TIGHT.with_(relaxation=0.0))


COUPLED = {
    "plain": lambda: restarted.scene().fsi,
    "taylor_hood": lambda: restarted.scene(taylor_hood=True).fsi,
    "rational": lambda: restarted.scene(weights=rational).fsi,
    "default": lambda: restarted.scene(options=None).fsi,
    "contact": lambda: approaching(speed=6.0, dt=0.004, options=restarted.TIGHT).fsi,  # in steps 4 and 5
    "moving": lambda: on_moving_mesh(moving.prescribed(moving.bubble)),
    "elastic": lambda: on_moving_mesh(elastic),
    "both sides": lambda: membrane("jump and kink", level=1, block_rtol=1e-10)[1],
    "dynamic": dynamic,
    "fallen": lambda: Fallen().fsi,
}


def restart_of(folder, fsi, **options):
    return Restart(folder, CoupledState(fsi), **options)


def go(run, advance, steps):
    for _ in run.steps(range(run.step + 1, steps + 1)):
        advance()


def assert_same(found, expected, rtol):
    """Arrays agree relative to their largest entry, on this rank."""
    for a, b in zip(found, expected, strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=rtol * np.abs(b).max(initial=0.0))


@pytest.mark.mpi
@pytest.mark.parametrize("name", COUPLED)
def test_a_coupled_run_goes_on_as_if_it_had_not_ended(name, folder):
    make = COUPLED[name]
    whole = make()
    go(restart_of(folder, whole, every=BREAK), whole.takeStep, STEPS)
    fsi = make()
    run = restart_of(folder, fsi)
    run.read(BREAK)
    assert (run.step, run.after) == (BREAK, fsi.timeInt_f.time)
    assert run.after == pytest.approx(BREAK * fsi.step_size)
    assert (fsi.timeInt_f.x.x.array == fsi.timeInt_f.x_old.x.array).all()
    go(run, fsi.takeStep, STEPS)
    assert run.step == STEPS
    assert_same(moving.state(fsi), moving.state(whole), 1e-8 if name == "elastic" else max(SAME_RUN, 1e-10))


def forget(name):
    """Set one part of the state back to what it was before the first step."""

    def change(fsi):
        if name == "lam":
            fsi.lam = 0.0 * fsi.lam
            return
        side, field = name.split(".")
        integrator = getattr(fsi, side).timeInt
        integrator.state[field].x.array[:] = 0.0
        integrator.restore()

    return change


@pytest.mark.parametrize(
    ("name", "part"),
    [
        *(("plain", part) for part in ("lam", "fluid.x", "fluid.xdot", "shell.x", "shell.xdot", "shell.xddot")),
        *(("both sides", part) for part in ("fluid.second", "fluid.second_rate")),
        *(("dynamic", part) for part in ("fluid.subscale", "fluid.subscale_rate")),
    ],
)
def test_each_part_of_the_state_matters(name, part, tmp_path):
    """What the comparison above would say if a part were not restored."""
    whole = COUPLED[name]()
    go(restart_of(tmp_path, whole, every=BREAK), whole.takeStep, STEPS)
    fsi = COUPLED[name]()
    run = restart_of(tmp_path, fsi)
    run.read(BREAK)
    forget(part)(fsi)
    go(run, fsi.takeStep, STEPS)
    with pytest.raises(AssertionError):
        assert_same(moving.state(fsi), moving.state(whole), 1e-5)


@pytest.mark.mpi
def test_a_run_goes_on_with_the_floors_of_its_residuals(folder):
    """The first test of a step takes those of the step before; before the first step there are none."""
    whole, fsi = restarted.scene().fsi, restarted.scene().fsi
    run = restart_of(folder, whole, every=1)
    run.write()
    go(run, whole.takeStep, 1)
    for step, floors in ((1, whole.floors), (0, None)):
        restart_of(folder, fsi).read(step)
        assert fsi.floors == floors
    assert whole.floors is not None


def flow(moves=False):
    """A flow that a wall drives, on a mesh at rest or not; tangents are new in every iteration."""
    mesh, scheme = box(WORLD, (0.0, 0.0), (1.0, 1.0), (4, 4)), generalized_alpha(0.5)
    motion = PrescribedMotion(mesh, moving.bubble, 0.1, scheme) if moves else None
    walls = [
        Velocity(("left", "right", "bottom"), (0.0, 0.0)),
        Velocity("top", lambda x, t: (t * x[0] * (1 - x[0]), 0)),
    ]
    options = FlowOptions(keep=None, rtol=1e-12)
    return Flow(mesh, walls, rho=1.0, mu=0.01, dt=0.1, scheme=scheme, moving=motion, options=options)


@pytest.mark.mpi
@pytest.mark.parametrize("moves", [False, True])
def test_a_flow_alone_goes_on(moves, folder):
    def state(made):
        parts = {"flow": made.time} | ({"mesh": made.moving.time} if moves else {})
        return Integrators(**parts)

    whole, resumed = flow(moves), flow(moves)
    go(Restart(folder, state(whole), every=BREAK), whole.take_step, STEPS)
    run = Restart(folder, state(resumed))
    run.read(BREAK)
    go(run, resumed.take_step, STEPS)
    assert resumed.time.time == whole.time.time
    parts = zip(state(resumed).fields.values(), state(whole).fields.values(), strict=True)
    for a, b in parts:
        assert np.abs(b.x.array).max() > 1e-3
        assert_same([a.x.array], [b.x.array], max(SAME_RUN, 1e-10))


# -- what a restart takes over and what it refuses --------------------------------------------------------------------


@pytest.mark.mpi
def test_extra_step_size_and_names(folder):
    fsi = restarted.scene().fsi
    fsi.step_size = 0.03
    run = restart_of(folder, fsi, every=2)
    assert (run.step, run.after, run.extra) == (0, None, {})
    assert run.named(folder / "flow.xdmf") == folder / "flow.xdmf"
    peaks = run.extra.setdefault("peaks", [])
    for step in run.steps(range(1, 4)):
        fsi.takeStep()
        peaks.append(np.float64(step))
    fsi = restarted.scene().fsi
    run = restart_of(folder, fsi)
    run.read()
    assert (run.step, run.extra) == (2, {"peaks": [1.0, 2.0]})
    assert run.named(folder / "flow.xdmf") == folder / "flow_000002.xdmf"
    assert fsi.step_size == 0.03
    assert float(fsi.timeInt_f.t.value) == float(fsi.timeInt_sh.t.value) == pytest.approx(0.09)
    assert list(run.steps(range(run.step + 1, 3))) == []


def test_settings_that_differ_are_named(tmp_path, caplog):
    options = replace(restarted.TIGHT, penalty=PenaltyRule(1.0, 0.5))
    inputs = {"level": 2, "scale": np.float64(0.5), "names": ("a", "b"), "gone": None}
    restart_of(tmp_path, restarted.scene(options=options).fsi, inputs=inputs).write()
    other = restarted.scene(options=replace(options, penalty=PenaltyRule(2.0, 0.5), block_rtol=1e-9), dt=0.1)
    run = restart_of(tmp_path, other.fsi, inputs={"level": 3, "scale": 0.5, "names": ["a", "b"], "new": 1})
    with caplog.at_level(logging.WARNING):
        run.read()
    texts = [record.getMessage().partition("was written with ")[2] or record.getMessage() for record in caplog.records]
    assert texts == [
        "inputs.gone = None, now it is 'absent'",
        "inputs.level = 2, now it is 3",
        "inputs.new = 'absent', now it is 1",
        "options.block_rtol = 1e-11, now it is 1e-09",
        "options.penalty.C_1 = 1.0, now it is 2.0",
        "fluid goes on with its dt = 0.05, not 0.1; assign to change it",
        "shell goes on with its dt = 0.05, not 0.1; assign to change it",
    ]
    caplog.clear()
    restart_of(tmp_path, restarted.scene(options=options).fsi, inputs=inputs).read()
    assert not caplog.records


def test_a_new_run_does_not_replace_the_checkpoints_of_another(tmp_path):
    fsi = restarted.scene().fsi
    run = restart_of(tmp_path, fsi, every=2)
    go(run, fsi.takeStep, 3)
    kept = sorted(tmp_path.iterdir())
    other = restart_of(tmp_path, fsi)
    for use in (lambda: list(other.steps([1])), other.write):
        with pytest.raises(FileExistsError, match=f"{tmp_path} has checkpoints of an earlier run, up to step 2: go on"):
            use()
    assert sorted(tmp_path.iterdir()) == kept
    assert list(run.steps([])) == []  # they are its own
    other.read()
    assert list(other.steps([])) == []


@pytest.mark.mpi
@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"n": 5}, "fluid.x is on another mesh: number of cells 32 was found, 50 is required"),
        ({"density_of_points": 8}, "shell.x is on another mesh: number of cells 16 was found, 8 is required"),
        ({"taylor_hood": True}, "fluid.x is of another degree or size"),
        ({"ends": ((0.35, 0.25), (0.45, 0.7))}, "the shell of the checkpoint has another shape"),
    ],
)
def test_another_scene_is_refused_and_stays_as_it_is(change, reason, folder):
    fsi = restarted.scene().fsi
    fsi.takeStep()
    restart_of(folder, fsi).write()
    other = restarted.scene(**change).fsi
    before = moving.state(other)
    run = restart_of(folder, other)
    with pytest.raises(ValueError, match=reason):
        run.read()
    assert (run.step, run.after) == (0, None)
    for a, b in zip(moving.state(other), before, strict=True):
        np.testing.assert_array_equal(a, b)


def test_other_integrators_are_refused(tmp_path):
    made = flow(moves=True)
    Restart(tmp_path, Integrators(flow=made.time, mesh=made.moving.time)).write()
    with pytest.raises(ValueError, match=r"fields .*'mesh.xdot'\] were found, \['flow.x', 'flow.xdot'\] are required"):
        Restart(tmp_path, Integrators(flow=made.time)).read()
    with pytest.raises(ValueError, match="at least one is required"):
        Integrators()


def test_bad_input_is_refused_before_the_run(tmp_path):
    fsi = restarted.scene().fsi
    with pytest.raises(ValueError, match="every = -1"):
        restart_of(tmp_path, fsi, every=-1)
    for bad in (float("inf"), object()):
        with pytest.raises(ValueError, match=r"inputs = .*: finite JSON is required"):
            restart_of(tmp_path, fsi, inputs={"bad": bad})


def test_a_demo_that_is_told_to_end_goes_on(tmp_path, monkeypatch):
    """The history, the series and the summary of the demo are those of a run that was never ended."""
    demo = load_demo("manufactured")
    toy = demo.TOY | {"preset": "plain"}  # what a converged multiplier keeps for its solver is not in checkpoints
    whole = demo.main(**toy, out=tmp_path / "whole")
    step = demo.CouDALFISh.takeStep

    def told_to_end(fsi, measure=None):
        report = step(fsi, measure)
        if report.t > 0.4:
            os.kill(os.getpid(), signal.SIGTERM)
        return report

    with monkeypatch.context() as patch:
        patch.setattr(demo.CouDALFISh, "takeStep", told_to_end)
        assert demo.main(**toy, out=tmp_path / "ended") == {}
    assert [path.name for path in (tmp_path / "ended" / "checkpoints").iterdir()] == ["checkpoint_00000005.npz"]
    resumed = demo.main(**toy, out=tmp_path / "ended", restart="latest")
    for key in ("errors", "block_iterations_mean", "linear_iterations_mean", "monitors", "inputs"):
        assert resumed[key] == whole[key]
    for name in ("history.csv", "shell.pvd"):
        assert (tmp_path / "ended" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()
    ended, finished = (read_vtkhdf(tmp_path / run / "fluid.vtkhdf") for run in ("ended", "whole"))
    np.testing.assert_array_equal(ended[0], finished[0])
    assert [t for t, _ in ended[2]] == [t for t, _ in finished[2]]
    for (_, found), (_, expected) in zip(ended[2], finished[2], strict=True):
        for name, values in expected.items():
            np.testing.assert_allclose(found[name], values, rtol=1e-9, atol=1e-9)


# -- runs that are killed or told to end ------------------------------------------------------------------------------

LONG = 2000
SCRIPT = ROOT / "tests" / "restarted.py"
ALONE = pytest.mark.skipif(WORLD.size > 1, reason="starts runs of its own")


def history(folder):
    return np.loadtxt(folder / "history.csv", delimiter=",", skiprows=1)


def assert_same_history(folder, expected, rtol):
    """Columns agree relative to their largest entry, as far as the expected history goes."""
    found = history(folder)[: len(expected)]
    assert_same(found.T, expected.T, rtol)


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory):
    """History of the run that nothing happens to."""
    folder = tmp_path_factory.mktemp("whole")
    restarted.main(folder, 8)
    return history(folder)


@contextmanager
def started(folder, steps, *arguments):
    """The run as a process of its own, which is dead at the end, and a function that gives what it said.

    Its errors go to a file: a pipe that nobody reads while the steps are waited for would be full one day.
    """
    command = [sys.executable, SCRIPT, folder, str(steps), *arguments]
    with tempfile.TemporaryFile("w+") as errors:

        def said():
            errors.seek(0)
            return errors.read()

        pipes = {"stdout": subprocess.PIPE, "stderr": errors, "text": True}
        with subprocess.Popen(command, **pipes, env=outside(), cwd=ROOT / "tests") as process:
            try:
                yield process, said
            finally:
                process.kill()


def after_step(process, number, said):
    """Wait until a step is done."""
    for line in process.stdout:
        if line.strip() == str(number):
            return
    raise RuntimeError(f"the run ended before step {number}: {said()}")


@ALONE
@pytest.mark.parametrize("seed", [0, 1])
def test_a_run_that_is_killed_goes_on(seed, tmp_path, uninterrupted):
    """At a random step, at a random moment: in a step, in a checkpoint or between them."""
    rng = np.random.default_rng(seed)
    step, delay = int(rng.integers(1, 6)), float(rng.uniform(0.0, 0.03))
    with started(tmp_path, LONG) as (process, said):
        after_step(process, step, said)
        time.sleep(delay)
        process.kill()
    assert process.returncode == -signal.SIGKILL
    done = len(history(tmp_path))
    print(f"killed {delay:.3f} s after step {step}; {done} steps are in the history")
    with started(tmp_path, 8 if done < 8 else done + 1, "latest") as (process, said):
        process.communicate(timeout=300)
        errors = said()
    assert process.returncode == 0, errors
    assert "going on after step" in errors
    assert_same_history(tmp_path, uninterrupted, 1e-10)


@ALONE
def test_a_run_that_dies_while_it_writes_goes_on_from_the_checkpoint_before(tmp_path, uninterrupted):
    """The write of the third checkpoint ends half-way, with the process."""
    code = f"""
import os, signal, sys
from pathlib import Path
import restarted
from tigar_x.run import output

def half(file_descriptor, sync=os.fsync):
    part = next(Path({str(tmp_path)!r}).glob("checkpoints/*00000003.npz.part"), None)
    if part is not None:
        os.truncate(part, part.stat().st_size // 2)
        os.kill(os.getpid(), signal.SIGKILL)
    sync(file_descriptor)

os.fsync = half
restarted.main(Path({str(tmp_path)!r}), 8)
"""
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, env=outside(), cwd=ROOT / "tests", capture_output=True, text=True)
    assert done.returncode == -signal.SIGKILL, done.stderr
    left = sorted(path.name for path in (tmp_path / "checkpoints").iterdir())
    assert left == [f"checkpoint_0000000{n}.npz" for n in (1, 2)] + ["checkpoint_00000003.npz.part"]
    restarted.main(tmp_path, 8, "latest")
    assert_same_history(tmp_path, uninterrupted, 1e-10)
    assert not list((tmp_path / "checkpoints").glob("*.part"))


@ALONE
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_run_that_is_told_to_end_writes_a_checkpoint_first(number, tmp_path, uninterrupted):
    with started(tmp_path, LONG) as (process, said):
        after_step(process, 2, said)
        process.send_signal(number)
        process.communicate(timeout=300)
        errors = said()
    assert process.returncode == 0, errors
    done = len(history(tmp_path))
    last = tmp_path / "checkpoints" / f"checkpoint_{done:08d}.npz"
    assert f"ended after step {done} at t = {0.05 * done:.6g}, as told; restart = latest goes on from {last}" in errors
    assert last.exists()
    if done < 8:
        restarted.main(tmp_path, 8, "latest")
    assert_same_history(tmp_path, uninterrupted, 1e-10)


@ALONE
@pytest.mark.skipif(MPIRUN is None, reason="no mpirun")
def test_one_rank_goes_on_where_two_ended_and_the_other_way_round(tmp_path, uninterrupted):
    done = mpirun(2, SCRIPT, tmp_path, 3)
    assert done.returncode == 0, done.stderr
    restarted.main(tmp_path, 5, "latest")
    done = mpirun(2, SCRIPT, tmp_path, 8, "latest")
    assert done.returncode == 0, done.stderr
    assert "going on after step 5" in done.stderr
    assert_same_history(tmp_path, uninterrupted, 1e-8)
