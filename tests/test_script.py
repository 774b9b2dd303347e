"""What surrounds a run: command line, log, progress, costs, summary."""

import io
import json
import logging
import os
import signal
import threading
from dataclasses import dataclass
from functools import wraps
from pathlib import Path
from types import SimpleNamespace
from typing import Literal

import numpy as np
import pytest

from tigar_x import compat
from tigar_x.run import progress, script
from tigar_x.run.progress import Progress, Stopwatch, Termination, peak_rss_mib, rss_mib
from tigar_x.run.summary import Quantity, against, deviations, table, write_summary


@pytest.fixture(autouse=True)
def root_logger():
    """``command_line`` sets the root logger up; other tests get it back as it was."""
    root = logging.getLogger()
    handlers, level = root.handlers[:], root.level
    yield root
    root.handlers[:] = handlers
    root.setLevel(level)


# -- command line -----------------------------------------------------------------------------------------------------


def main(
    level: int = 2,
    time_step: float = 0.1,
    viz: bool = True,
    slow: bool = False,
    rule: Literal["lumped", "consistent"] = "lumped",
    degree: Literal[1, 2] = 1,
    out: Path = Path("results"),
    name: str = "membrane",
    seed: int | None = None,
    mesh: Path | None = None,
):
    """Solve a problem.

    More about it.

    Args:
        level: refinement,
            doubled each time.
        time_step: 50 % of the stable one.
        out: folder.

    Returns:
        level: not this line.
    """
    return dict(locals())


DEFAULTS = main()


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("", {}),
        ("--level 4", {"level": 4}),
        ("--level -1", {"level": -1}),
        ("--time-step 1e-3", {"time_step": 1e-3}),
        ("--time-step 1", {"time_step": 1.0}),
        ("--no-viz --slow", {"viz": False, "slow": True}),
        ("--viz --no-slow", {}),
        ("--rule consistent --degree 2", {"rule": "consistent", "degree": 2}),
        ("--out a/b --mesh m.xdmf", {"out": Path("a/b"), "mesh": Path("m.xdmf")}),
        ("--seed 7 --name 7", {"seed": 7, "name": "7"}),
    ],
)
def test_options_come_from_the_signature(line, expected):
    found = script.command_line(main, line.split())
    assert found == {**DEFAULTS, **expected}
    assert [type(v) for v in found.values()] == [type(v) for v in {**DEFAULTS, **expected}.values()]


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("--levels 3", "--levels"),
        ("3", "unrecognized arguments: 3"),
        ("--level 2.5", "--level: invalid int value: '2.5'"),
        ("--level", "--level: expected one argument"),
        ("--time-step fast", "--time-step: invalid float value: 'fast'"),
        ("--rule lump", "--rule: invalid choice: 'lump'"),
        ("--degree 3", "(choose from 1, 2)"),
        ("--viz yes", "unrecognized arguments: yes"),
        ("--no-level", "unrecognized arguments: --no-level"),
    ],
)
def test_bad_options_end_the_run(line, message, capsys):
    called = []

    @wraps(main)
    def guarded(**options):
        called.append(options)

    with pytest.raises(SystemExit) as caught:
        script.command_line(guarded, line.split())
    assert caught.value.code == 2
    assert message in capsys.readouterr().err
    assert not called


def test_help_comes_from_the_docstring(capsys):
    with pytest.raises(SystemExit) as caught:
        script.command_line(main, ["--help"])
    assert caught.value.code == 0
    words = " ".join(capsys.readouterr().out.split())
    assert "Solve a problem." in words
    assert "refinement, doubled each time." in words
    assert "50 % of the stable one." in words
    assert "not this line" not in words
    assert "{lumped,consistent}" in words
    assert "--no-viz" in words


def test_command_line_shows_the_log_of_the_packages_only(capsys):
    script.command_line(lambda: None, [])
    logging.getLogger("tigar_x.fem.solve").info("a step of ours")
    logging.getLogger("ffcx").info("a form compiler's chatter")
    logging.getLogger("ffcx").warning("a form compiler's warning")
    logging.getLogger("tigar_x_like").info("a stranger")
    text = capsys.readouterr().err
    assert text == "INFO tigar_x.fem.solve: a step of ours\nWARNING ffcx: a form compiler's warning\n"


# -- progress ---------------------------------------------------------------------------------------------------------


def run(n_steps, **options):
    progress = Progress(n_steps, **options)
    for n in progress:
        progress.show(SimpleNamespace(t=0.5 * n, passes=3, residuals=[(1.0, 2.0), (1.5e-4, 3e-9)]))


@pytest.mark.parametrize(("n_steps", "lines", "expected"), [(3, 10, [1, 2, 3]), (100, 4, [25, 50, 75, 100])])
def test_progress_logs_where_there_is_no_terminal(n_steps, lines, expected, caplog):
    with caplog.at_level(logging.INFO, logger="tigar_x.run.progress"):
        run(n_steps, lines=lines)
    messages = [r.getMessage() for r in caplog.records]
    assert [m.split("  ")[0] for m in messages] == [f"step {n}/{n_steps}" for n in expected]
    assert messages[-1].endswith(f"t = {0.5 * n_steps:g}  passes 3  residuals 1.5e-04, 3.0e-09")


def test_the_last_step_is_always_shown(caplog):
    with caplog.at_level(logging.INFO, logger="tigar_x.run.progress"):
        run(23, lines=5)
    steps = [r.getMessage().split()[1] for r in caplog.records]
    assert steps == ["4/23", "8/23", "12/23", "16/23", "20/23", "23/23"]


def test_progress_is_a_bar_in_a_terminal(monkeypatch, caplog):
    terminal = io.StringIO()
    terminal.isatty = lambda: True
    monkeypatch.setattr(progress.sys, "stderr", terminal)
    with caplog.at_level(logging.INFO, logger="tigar_x.run.progress"):
        run(8)
    _, *bars = terminal.getvalue().split("\r")
    assert [bar.count("#") for bar in bars] == [3, 6, 9, 12, 15, 18, 21, 24]
    assert all(bar.index("]") == 25 for bar in bars)
    assert terminal.getvalue().endswith("\n")
    assert not caplog.records


# -- being told to end ------------------------------------------------------------------------------------------------

SIGNALS = (signal.SIGTERM, signal.SIGUSR1, signal.SIGINT)


def handlers():
    return [signal.getsignal(number) for number in SIGNALS]


@pytest.mark.parametrize("number", SIGNALS)
def test_a_run_is_told_to_end(number, caplog):
    before = handlers()
    with Termination() as asked:
        assert not asked()
        assert not set(before) & set(handlers())
        os.kill(os.getpid(), number)
        assert asked()
        assert asked()
    assert handlers() == before
    assert f"{number.name}: ending after the step in progress" in caplog.text
    with Termination() as asked:
        assert not asked()


@pytest.fixture
def interrupts():
    """Python's own handler of Ctrl-C, which a process in the background or one that has used gmsh may not have."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("interrupts")
def test_the_second_interrupt_is_one():
    before = handlers()

    def run():
        with Termination() as asked:
            os.kill(os.getpid(), signal.SIGINT)
            assert asked()
            os.kill(os.getpid(), signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        run()
    assert handlers() == before


def test_a_thread_gets_no_signals():
    before, found = handlers(), []

    def run():
        with Termination() as asked:
            found.append((asked(), handlers()))

    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    assert found == [(False, before)]


def test_progress_goes_on_where_another_run_ended(caplog):
    progress = Progress(8, done=5)
    with caplog.at_level(logging.INFO, logger="tigar_x.run.progress"):
        assert [n for n in progress if progress.show(f"at {n}") is None] == [6, 7, 8]
    assert [record.getMessage() for record in caplog.records] == [f"step {n}/8  at {n}" for n in (6, 7, 8)]
    assert list(Progress(8, done=8)) == []


# -- costs ------------------------------------------------------------------------------------------------------------


def test_stopwatch_counts_what_is_not_compilation(monkeypatch):
    """The compiler is another process: while it works, time passes without CPU time of this one."""
    clock = SimpleNamespace(wall=100.0, cpu=50.0)
    fake = SimpleNamespace(perf_counter=lambda: clock.wall, process_time=lambda: clock.cpu)

    def spend(wall, cpu):
        clock.wall += wall
        clock.cpu += cpu

    monkeypatch.setattr(progress, "time", fake)
    monkeypatch.setattr(compat.forms, "time", fake)
    monkeypatch.setattr(compat.forms, "_compile", lambda _: spend(6.0, 1.0))
    form = SimpleNamespace(signature=lambda: "a form")
    watch = Stopwatch()
    for _ in range(2):
        with watch:
            spend(4.0, 3.0)
            compat.compile_forms(form)
        spend(1000.0, 1000.0)
    assert watch.wall_s == pytest.approx(8.0)
    assert watch.cpu_s == pytest.approx(6.0)


def test_stopwatch_stops_when_the_block_fails():
    watch = Stopwatch()
    with pytest.raises(RuntimeError, match="inside"), watch:
        raise RuntimeError("inside")
    assert watch.wall_s > 0.0


def test_memory():
    kept = np.ones(2**20)
    assert 8.0 < rss_mib() < peak_rss_mib() + 1.0
    assert kept.nbytes == 8 * 2**20


# -- summary ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Options:
    penalty: float
    rule: str | None = None


def test_summary(tmp_path):
    inputs = {"level": np.int64(3), "out": Path("a/b"), "seed": None, "options": Options(2.5)}
    results = {
        "errors": {"L2_u": np.float64(0.1), "H1_u": np.float32(0.5)},
        "qoi": {
            "tip": Quantity(0.58, 0.579, "10.1016/j.cma.2014.10.040"),
            "leak": Quantity(np.float64(1e-3)),
        },
        "monitors": [np.bool_(True), (1, 2.5)],
        "dofs_shell": None,
    }
    summary = write_summary(tmp_path / "new" / "folder", "membrane", inputs, **results)
    read = json.loads((tmp_path / "new" / "folder" / "summary.json").read_text())
    assert read == summary
    assert set(read) == {"demo", "inputs", "errors", "qoi", "monitors", "compile_s", "peak_rss_mib", "versions"}
    assert read["demo"] == "membrane"
    assert read["inputs"] == {"level": 3, "out": "a/b", "seed": None, "options": {"penalty": 2.5}}
    assert read["errors"] == {"L2_u": 0.1, "H1_u": 0.5}
    assert read["qoi"]["tip"] == {"value": 0.58, "published": 0.579, "doi": "10.1016/j.cma.2014.10.040"}
    assert read["qoi"]["leak"] == {"value": 1e-3}
    assert read["monitors"] == [True, [1, 2.5]]
    assert read["peak_rss_mib"] > 1.0
    assert {"dolfinx", "petsc", "python"} <= set(read["versions"])


def test_quantities_deviate_from_what_is_published_of_them():
    found = against({"low": 1.5, "high": 3.0, "alone": 7.0}, {"low": 2.0, "high": 2.0, "absent": 1.0}, "10.1/x")
    assert deviations(found) == {"low": 0.5, "high": 1.0}


@pytest.mark.parametrize("bad", [float("nan"), np.float64("inf"), np.float32("nan")])
def test_summary_refuses_what_is_not_finite(bad, tmp_path):
    write_summary(tmp_path, "membrane", {}, steps=3)
    before = (tmp_path / "summary.json").read_text()
    with pytest.raises(ValueError, match="JSON"):
        write_summary(tmp_path, "membrane", {}, errors={"L2_u": bad})
    assert (tmp_path / "summary.json").read_text() == before


def test_table():
    text = table(["case", "n", "error"], [["plane", 8, 0.0123456], ["one-layer", 128, 1e-9], ["x", 1, np.nan]])
    assert text.splitlines() == [
        "     case    n    error",
        "    plane    8  0.01235",
        "one-layer  128    1e-09",
        "        x    1      nan",
    ]
    assert table(["a", "bc"], []) == "a  bc"
    with pytest.raises(ValueError, match="argument"):
        table(["a", "b"], [[1, 2, 3]])


@pytest.mark.parametrize("time", ["first", "second"])
def test_tests_leave_the_levels_of_loggers_as_they_were(time):
    """Whichever comes first finds what the other has not set."""
    package, new = logging.getLogger("coudalfish"), logging.getLogger("coudalfish.made_by_a_test")
    assert (package.level, new.level) == (logging.NOTSET, logging.NOTSET)
    script.set_up_logging(logging.ERROR)
    package.setLevel(logging.ERROR)
    new.setLevel(logging.ERROR)
