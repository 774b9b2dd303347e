"""Error against run time of an immersed cylinder at Re = 20, beside the same flow in meshes that fit the cylinder.

The immersed flow marches to its steady state, by `demos/immersed_cylinder.py`: every run is a process of its own, and
one whose result is in the folder is not repeated. The fitted flow is solved for, by Newton's method.
"""

import csv
import json
import os
import subprocess
import sys
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from itertools import product
from pathlib import Path
from typing import Any

import calibrate
import numpy as np

from tigar_x.run import script
from tigar_x.run.figure import draw, lines
from tigar_x.run.history import FILE, History
from tigar_x.run.progress import Stopwatch
from tigar_x.run.summary import table
from varmint.problems.cylinder import PUBLISHED, Channel, Coefficients

DEMO = Path(__file__).resolve().parent.parent / "demos" / "immersed_cylinder.py"
KNOWN = PUBLISHED[20.0, True][1]
SIZES = {1: (0.08, 0.04, 0.02, 0.01), 2: (0.12, 0.08, 0.04, 0.02)}
"""Of the cells of fitted meshes far from the cylinder, by degree."""
SETTLED = 5e-3
"""Relative to the drag at the end, how much the drag may still change of a flow that has settled."""
COLUMNS = (
    *("flow", "diagonal", "cells", "dt", "steps", "passes", "drag", "drag_error_percent", "lift", "lift_error"),
    *("dp", "dp_error_percent", "pressure_inside", "settled", "drift_percent", "cpu_s", "cpu_s_scaled", "dofs_fluid"),
)


def run(folder: Path, preset: str, diagonal: str, cells: int, dt: float, until: float) -> Path:
    """The folder of a run of the demo, which is made unless it is there."""
    out = folder / f"{preset}-{diagonal}-{cells}-{dt:g}-{until:g}"
    if not (out / "summary.json").exists():
        options = {"preset": preset, "diagonal": diagonal, "cells": cells, "dt": dt, "until": until, "out": out}
        words = [word for name, value in options.items() for word in (f"--{name}", str(value))]
        command = [sys.executable, str(DEMO), "--no-viz", "--overwrite", *words]
        done = subprocess.run(command, capture_output=True, text=True, env={**os.environ, "OMP_NUM_THREADS": "1"})
        if done.returncode:
            raise RuntimeError(f"{' '.join(command)} failed:\n{done.stderr}")
    return out


def errors(found: dict[str, float]) -> dict[str, float]:
    """Quantities with their errors: of drag and pressure in percent, of the lift as a difference."""
    percent = {f"{name}_error_percent": 100.0 * (found[name] / KNOWN[name] - 1.0) for name in ("drag", "dp")}
    return {**found, **percent, "lift_error": found["lift"] - KNOWN["lift"]}


def immersed(out: Path, speed: float) -> dict[str, Any]:
    """Line of the table of a run of the demo."""
    summary, drag = json.loads((out / "summary.json").read_text()), History.read(out / FILE).course("drag")
    inputs, monitors = summary["inputs"], summary["monitors"]
    moving = np.flatnonzero(np.abs(drag.y / drag.y[-1] - 1.0) > SETTLED)
    return {
        "flow": inputs["preset"],
        **{name: inputs[name] for name in ("diagonal", "cells", "dt")},
        "steps": summary["steps"],
        "passes": summary["block_iterations_mean"],
        **errors({name: quantity["value"] for name, quantity in summary["qoi"].items()}),
        "pressure_inside": monitors["pressure_inside"],
        "settled": float(drag.t[min(moving[-1] + 1, len(drag) - 1)]),
        "drift_percent": 100.0 * monitors["drift"],
        "cpu_s": summary["cpu_s"],
        "cpu_s_scaled": summary["cpu_s"] * speed,
        "dofs_fluid": summary["dofs_fluid"],
    }


def fitted(degree: int, size: float, speed: float) -> dict[str, Any]:
    """Line of the table of the steady flow in a mesh that fits the cylinder."""
    flow, watch = Channel(20.0, steady=True, degree=degree, size=size).build(), Stopwatch()
    flow.compile()
    with watch:
        flow.solve()
    found = errors(dict(zip(("drag", "lift", "dp"), Coefficients(flow)(), strict=True)))
    times = {"cpu_s": watch.cpu_s, "cpu_s_scaled": watch.cpu_s * speed}
    return {"flow": f"fitted, degree {degree}", **found, **times, "dofs_fluid": flow.unknowns}


def plot(path: Path, rows: list[dict[str, Any]]) -> None:
    """Errors of drag and lift against scaled CPU time, a line for every preset and time step, of one diagonal."""
    courses: dict[tuple[str, float | None], list[dict[str, Any]]] = {}
    for row in rows:
        if row.get("diagonal") in (None, rows[0]["diagonal"]):
            courses.setdefault((row["flow"], row.get("dt")), []).append(row)
    flows, steps = ([*dict.fromkeys(key[i] for key in courses)] for i in (0, 1))
    names = {(flow, dt): flow if dt is None else f"{flow}, dt = {dt:g}" for flow, dt in courses}
    styles = {}
    for (flow, dt), name in names.items():
        mark = "ks-" if dt is None else f"C{flows.index(flow)}{'ov^D'[steps.index(dt) % 4]}-"
        styles[name] = {"fmt": mark, "markersize": 4, "fillstyle": "none" if flow.endswith("degree 1") else "full"}
    panels = []
    for error, axis in (("drag_error_percent", ("error of the drag", "%")), ("lift_error", ("error of the lift", "-"))):
        drawn = {
            names[key]: ([row["cpu_s_scaled"] for row in some], [abs(row[error]) for row in some])
            for key, some in courses.items()
        }
        panels.append(lines(drawn, x=("CPU time, scaled", "s"), y=axis, styles=styles, xscale="log", yscale="log"))
    draw(path, *panels, size=(6.5, 5.0))


def shown(rows: Iterable[dict[str, Any]]) -> list[list[Any]]:
    """Cells of the table."""
    return [[row.get(name, "-") for name in COLUMNS] for row in rows]


def main(
    presets: str = "plain,reference,converged,sharp",
    cells: str = "20,40",
    time_steps: str = "0.05,0.02,0.005",
    diagonals: str = "right,left",
    until: float = 8.0,
    workers: int = 1,
    out: Path = Path("results/benchmarks/immersed_cylinder"),
) -> None:
    """Measure errors of drag, lift and pressure and CPU time, immersed and fitted.

    Args:
        presets: of the coupling, separated by commas.
        cells: numbers of fluid cells across the channel, separated by commas.
        time_steps: separated by commas.
        diagonals: of the fluid's cells, separated by commas.
        until: end of the runs.
        workers: number of runs at a time.
        out: folder of the results.
    """
    here = calibrate.calibrate()
    speed = calibrate.legacy_speed(here)
    print(f"calibration {here}: {speed:.2f} times the speed of the machine of legacy.csv", flush=True)
    numbers = [int(n) for n in cells.split(",")]
    steps = [float(dt) for dt in time_steps.split(",")]
    cases = list(product(presets.split(","), diagonals.split(","), steps, numbers))
    with ThreadPoolExecutor(workers) as pool:
        folders = list(pool.map(lambda case: run(out / "runs", *case[:2], case[3], case[2], until), cases))
    rows = [immersed(folder, speed) for folder in folders]
    rows += [fitted(degree, size, speed) for degree, sizes in SIZES.items() for size in sizes]
    text = table(COLUMNS, shown(rows))
    print(text)
    with open(out / "immersed_cylinder.csv", "w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS)
        writer.writeheader()
        writer.writerows(rows)
    plot(out / "immersed_cylinder.png", rows)
    print(f"\nwritten: {out / 'immersed_cylinder.csv'}, {out / 'immersed_cylinder.png'}")


if __name__ == "__main__":
    script.command_line(main)
