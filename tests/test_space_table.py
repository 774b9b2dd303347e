"""The table of what settings do in space is made from files of results, and stands in the documents as it is made."""

import csv
from pathlib import Path

import pytest
from mpi4py import MPI
from load import load_demo
from space_membrane import Membrane
from space_table import END, HERE, ROWS, SETTINGS, START, main, read, short, table, valve_row
from surface import keep
from surface_space import STUDIES

DEFAULTS = Path(__file__).parent.parent / "docs" / "defaults.md"


def test_the_document_has_the_table_that_the_results_give(tmp_path):
    copy = tmp_path / "defaults.md"
    copy.write_text(DEFAULTS.read_text())
    main(into=copy)
    assert copy.read_text() == DEFAULTS.read_text()


def test_every_row_is_one_of_scenes_that_there_are():
    for row in ROWS:
        figures, scenes = STUDIES[row.study]
        assert set(row.cases) <= set(scenes), row.scene
        assert {figure.name for figure in row.figures} <= set(figures), row.scene


def found(path, **values):
    """Results of the sphere in a stream."""
    for case in ("n 8", "n 12"):
        lines = []
        for setting, (drag, step) in values.items():
            numbers = {"drag": drag, "CPU ms/step": step, "MiB": 100} if drag else {"failed": "no"}
            lines += [
                {"study": "obstacle", "case": case, "setting": setting, "name": n, "value": numbers[n]} for n in numbers
            ]
        keep(path, lines)
    return read(path)


def test_a_cell_has_figures_and_costs_over_those_of_plain_fields(tmp_path):
    results = found(tmp_path / "a.csv", plain=(3.664, 10.0), jump=(4.0304, 25.0), sharp=(None, None))
    (row,) = [row for row in ROWS if row.study == "obstacle" and "n 8" in row.cases]
    cells = {setting: row.cell(results, setting) for setting in SETTINGS}
    assert cells == {"plain": "+0 +0 - (1.0, 100)", "converged": "-", "jump": "+10 +10 - (2.5, 100)", "sharp": "fails"}
    text = table(results, [])
    assert text.endswith("median and range of the rows: jump 2.5 (2.5 to 2.5) and 1.0 (1.0 to 1.0).")
    assert [short(value) for value in (0.0, 1.23e-9, 0.0456, 0.99, 9.8, 12.3, 173.4)] == [
        *("0", "1.2e-09", "0.046", "0.99", "9.8", "12", "173")
    ]


def test_results_of_a_case_take_the_place_of_older_ones_alone(tmp_path):
    path = tmp_path / "a.csv"
    found(path, plain=(1.0, 10.0))
    keep(path, [{"study": "obstacle", "case": "n 12", "setting": "jump", "name": "drag", "value": 2.0}])
    results = read(path)
    assert set(results) == {("obstacle", "n 8", "plain"), ("obstacle", "n 12", "jump")}
    assert results["obstacle", "n 12", "jump"] == {"drag": "2"}


def test_the_heart_valve_has_a_row_where_it_has_been_run(tmp_path):
    path = tmp_path / "valve.csv"
    assert set(valve_row(path, 8409, 1e-4)[2:]) == {"-"}
    names = ("preset", "cells", "dt", "reversal", "error_flow", "last_opening", "cpu_s")
    rows = [
        ("plain", 8409, 1e-4, 0.02, 112.0, 5.0, 78.0),
        ("jump", 8409, 1e-4, 0.02, 12.6, 0.163, 156.0),
        ("jump", 8409, 1e-4, 0.0, 1.0, 1.0, 1.0),
        ("sharp", 8409, 5e-5, 0.02, 1.0, 1.0, 1.0),
    ]
    with open(path, "w", newline="") as file:
        csv.writer(file).writerows([names, *rows])
    assert valve_row(path, 8409, 1e-4)[2:] == ["112; 5 (1.0, -)", "-", "13; 0.16 (2.0, -)", "-"]
    assert table({}, valve_row(path, 8409, 1e-4)).splitlines()[-3].startswith("| heart valve, 8,409 cells")


def test_the_marks_are_there_once():
    text = DEFAULTS.read_text()
    assert text.count(START) == 1
    assert text.count(END) == 1
    assert (HERE / "surface_space.csv").exists()


@pytest.mark.mpi
def test_the_membrane_as_a_scene_has_the_errors_of_the_demo(tmp_path):
    of_demo = load_demo("manufactured").main(
        dim=3, level=1, preset="plain", dt_factor=2.0, out=MPI.COMM_WORLD.bcast(tmp_path, root=0), viz=False
    )
    assert Membrane(1).run().figures == pytest.approx(of_demo["errors_true"], rel=1e-9)
