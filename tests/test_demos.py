"""Every demo on disk runs at toy size and leaves what it promises."""

import csv
import importlib
import inspect
import json
import subprocess
import sys
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest
from load import load_demo
from on_disk import DEMOS, ROOT, read_vtkhdf, read_vtkhdf_meshes

from tigar_x.run import writing

BEFORE_THE_END = {
    "cylinder": 1 / 3,
    "turek_hron_fsi3": 1 / 3,
    "manufactured": 0.0,
    "immersed_cylinder": 0.0,
    "valve_2d": 0.0,
    "heart_valve": 0.0,
    "piston": 1 / 3,
}
"""In steps, the time to which forces, pressures and leak belong; 1 - alpha_f."""
COMMON = {"demo", "inputs", "compile_s", "wall_s", "cpu_s", "peak_rss_mib", "versions"}


def test_there_are_demos():
    assert "manufactured" in DEMOS


@pytest.mark.parametrize("name", DEMOS)
def test_demo_at_toy_size(name, tmp_path):
    demo = load_demo(name)
    summary = demo.main(**demo.TOY, out=tmp_path, viz=True)
    written = json.loads((tmp_path / "summary.json").read_text())
    assert written == json.loads(json.dumps(summary))
    assert set(written) >= COMMON
    assert written["demo"] == name
    assert written.get("errors") or written.get("qoi")
    assert all(value > 0.0 for value in written.get("errors", {}).values())
    for path in tmp_path.glob("*.vtkhdf"):
        sharp = written["inputs"].get("preset") in ("jump", "sharp")
        times = [t for t, *_ in (read_vtkhdf_meshes(path) if sharp else read_vtkhdf(path)[2])]
        assert times
        assert times == sorted(set(times))
    for path in tmp_path.glob("*.pvd"):
        entries = ET.parse(path).findall(".//DataSet")
        assert len(entries) == written.get("steps", 1)
        assert all((tmp_path / entry.get("file")).exists() for entry in entries)
    assert list(tmp_path.glob("*.png"))
    if name in BEFORE_THE_END:
        with open(tmp_path / "history.csv") as file:
            t, t_alpha = np.array([(row["t"], row["t_alpha"]) for row in csv.DictReader(file)], dtype=float).T
        np.testing.assert_allclose(t - t_alpha, BEFORE_THE_END[name] * np.diff(t, prepend=0.0), rtol=1e-9, atol=1e-15)


@pytest.mark.parametrize("name", DEMOS)
def test_every_option_is_on_the_command_line_and_no_other(name):
    script = ROOT / "demos" / f"{name}.py"
    shown = subprocess.run([sys.executable, script, "--help"], capture_output=True, text=True, check=True).stdout
    assert all(option in shown for option in ("--out", "--viz", "--no-viz", "--overwrite"))
    wrong = subprocess.run([sys.executable, script, "--no-such-option", "1"], capture_output=True, text=True)
    assert wrong.returncode == 2
    assert "--no-such-option" in wrong.stderr


def test_manufactured_in_space_at_toy_size(tmp_path):
    demo = load_demo("manufactured")
    summary = demo.main(**demo.TOY, dim=3, out=tmp_path, viz=True)
    assert summary["dofs_fluid"] == 4 * 2 * 7 * 7
    assert {path.suffix for path in tmp_path.iterdir()} >= {
        ".json",
        ".vtkhdf",
        ".steps",
        ".pvd",
        ".vtu",
        ".csv",
        ".png",
    }


def test_manufactured_with_a_curved_membrane_at_toy_size(tmp_path):
    demo = load_demo("manufactured")
    summary = demo.main(dim=3, curved=True, level=0, out=tmp_path, viz=True)
    assert summary["dofs_fluid"] == 4 * 4**3
    assert summary["inputs"]["curved"]
    assert (tmp_path / "manufactured.png").exists()
    with pytest.raises(ValueError, match=r"curved = True, dim = 2: a membrane that is curved needs dim = 3"):
        demo.main(curved=True, out=tmp_path / "plane")


@pytest.mark.parametrize("name", DEMOS)
def test_no_viz_writes_numbers_alone(name, tmp_path):
    demo = load_demo(name)
    demo.main(**demo.TOY, out=tmp_path, viz=False)
    assert {path.name for path in tmp_path.iterdir()} in ({"summary.json"}, {"summary.json", "history.csv"})


@pytest.mark.parametrize("name", DEMOS)
def test_the_results_of_an_earlier_run_are_not_overwritten(name, tmp_path):
    (tmp_path / "history.csv").write_text("t,hours of work\n")
    demo = load_demo(name)
    with pytest.raises(
        FileExistsError, match=r"has the results of an earlier run \(history.csv\): another folder, or ov"
    ):
        demo.main(**demo.TOY, out=tmp_path)
    assert [path.read_text() for path in tmp_path.iterdir()] == ["t,hours of work\n"]


@pytest.mark.parametrize(
    ("benchmark", "case"), [("manufactured", (2, "plain", 1, 1.0)), ("scordelis_lo", ("quad", 2, 2))]
)
def test_benchmarks_run_a_demo_again_in_the_same_folder(benchmark, case, tmp_path, monkeypatch):
    """A first run compiles, the next ones count: the demo takes the folder that has the results of the first one."""
    module, demo, folders = importlib.import_module(benchmark), load_demo(benchmark), []

    def as_the_demo(command, **_):
        folder = Path(command[command.index("--out") + 1])
        writing.claim(folder, overwrite="--overwrite" in command)
        writing.replace_text(folder / "summary.json", "{}")
        folders.append(folder)
        return subprocess.CompletedProcess(command, 0)

    assert "overwrite" in inspect.signature(demo.main).parameters
    monkeypatch.setattr(module.subprocess, "run", as_the_demo)
    for _ in range(2):
        assert module.run(tmp_path, *case) == {}
    assert folders[0] == folders[1]


@pytest.mark.parametrize(
    ("option", "value"), [("dt_factor", 0.0), ("dt_factor", float("nan")), ("level", -1), ("level", 1.5)]
)
def test_bad_input_is_named_before_computing(option, value, tmp_path):
    with pytest.raises(ValueError, match=f"{option} = {value}"):
        load_demo("manufactured").main(out=tmp_path, **{option: value})
    assert not list(tmp_path.iterdir())
