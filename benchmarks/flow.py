"""Error against run time and memory of the steady cavity and of the decaying vortex, beside the published code.

Every mesh is solved in a process of its own, which compiles or loads the forms first and then solves some times, of
which the fastest counts. CPU seconds are those of the solve or the time loop.
"""

import csv
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import calibrate
from load import load_demo

from tigar_x import compat
from tigar_x.run import script
from tigar_x.run.figure import draw, lines
from tigar_x.run.progress import Stopwatch, peak_rss_mib
from tigar_x.run.summary import table, write_summary

HERE = Path(__file__).resolve()
SEQUENCES = {1: (8, 16, 32, 64), 2: (8, 16, 32, 64), 3: (4, 8, 16, 32), 4: (2, 4, 8, 16)}
LONG = 1.0  # CPU seconds from which on a point of the published code counts for the comparison
WANTED = 5.0
COLUMNS = ("problem", "cells", "degree", "elements", "unknowns", "H1_u", "L2_u", "cpu_s", "peak_rss_mib")


def solve(problem: str, cells: str, degree: int, elements: int, repeats: int) -> dict[str, Any]:
    """Errors and the smallest CPU time of some solves on one mesh."""
    demo = load_demo(problem)
    times = []
    for _ in range(repeats):
        if problem == "lid_driven_cavity":
            flow = demo.build(elements, degree, cells=cells)
        else:
            flow = demo.Vortex(degree=degree, cells=cells).build(elements)
        flow.compile()
        watch = Stopwatch()
        with watch:
            flow.solve() if problem == "lid_driven_cavity" else flow.run(until=demo.END, show=False).through()
        times.append(watch.cpu_s)
    memory, errors = peak_rss_mib(), demo.errors(flow)
    return {
        "problem": problem,
        "cells": cells,
        "degree": degree,
        "elements": elements,
        "unknowns": flow.unknowns,
        "H1_u": errors["H1_u"],
        "L2_u": errors["L2_u"],
        "cpu_s": min(times),
        "peak_rss_mib": memory,
        "compile_s": compat.compile_seconds(),
    }


def run(problem: str, cells: str, degree: int, elements: int, repeats: int) -> dict[str, Any]:
    """The same in a process of its own."""
    command = [sys.executable, str(HERE), "--worker", json.dumps([problem, cells, degree, elements, repeats])]
    done = subprocess.run(command, capture_output=True, text=True, env={**os.environ, "OMP_NUM_THREADS": "1"})
    if done.returncode:
        raise RuntimeError(f"{' '.join(command)} failed:\n{done.stderr}")
    return dict(json.loads(done.stdout.splitlines()[-1]))


def legacy() -> list[dict[str, Any]]:
    """Figures of the published code."""
    lines = (HERE.parent / "legacy_flow.csv").read_text().splitlines()
    rows = []
    for entry in csv.DictReader(line for line in lines if not line.startswith("#")):
        numbers = {name: float(entry[name]) for name in ("H1_u", "L2_u", "cpu_s")}
        counts = {name: int(entry[name]) for name in ("degree", "elements")}
        rows.append({"problem": entry["problem"], **counts, **numbers})
    return rows


def speedups(rows: list[dict[str, Any]], speed: float) -> list[list[Any]]:
    """For every long run of the published code the cheapest of ours with at most its H1 error."""
    table = []
    for old in legacy():
        mine = [r for r in rows if r["problem"] == old["problem"] and r["H1_u"] <= 1.005 * old["H1_u"]]
        if old["cpu_s"] < LONG or not mine:
            continue
        best = min(mine, key=lambda r: r["cpu_s"])
        scaled = best["cpu_s"] * speed
        same = [r for r in mine if (r["degree"], r["elements"]) == (old["degree"], old["elements"])]
        same_mesh = [r for r in same if r["cells"] == "triangle"]
        table.append(
            [
                old["problem"],
                f"k={old['degree']} N={old['elements']}",
                old["H1_u"],
                old["cpu_s"],
                f"{best['cells']} k={best['degree']} N={best['elements']}",
                best["H1_u"],
                scaled,
                old["cpu_s"] / scaled,
                old["cpu_s"] / (same_mesh[0]["cpu_s"] * speed) if same_mesh else "-",
            ]
        )
    return table


def plot(path: Path, rows: list[dict[str, Any]], speed: float) -> None:
    """H1 errors against scaled CPU time; the published code's points are black."""
    panels = []
    for problem in ("lid_driven_cavity", "taylor_green"):
        courses: dict[str, Any] = {}
        styles: dict[str, Any] = {}
        for cells, style in (("triangle", "-"), ("quadrilateral", "--")):
            for degree in sorted(SEQUENCES):
                mine = [r for r in rows if (r["problem"], r["cells"], r["degree"]) == (problem, cells, degree)]
                if mine:
                    name = f"k = {degree}, {cells}s"
                    courses[name] = [r["cpu_s"] * speed for r in mine], [r["H1_u"] for r in mine]
                    styles[name] = {"fmt": f"C{degree - 1}o{style}", "markersize": 4}
        for degree, marker in ((1, "s"), (2, "^")):
            old = [r for r in legacy() if (r["problem"], r["degree"]) == (problem, degree)]
            name = f"published code, k = {degree}"
            courses[name] = [r["cpu_s"] for r in old], [r["H1_u"] for r in old]
            styles[name] = {"fmt": f"k{marker}:", "fillstyle": "none"}
        axes = {"x": ("CPU time, scaled", "s"), "y": ("H1 seminorm of the velocity's error", "-")}
        panels.append(lines(courses, **axes, styles=styles, title=problem, xscale="log", yscale="log"))
    draw(path, *panels)


def main(
    problems: str = "lid_driven_cavity,taylor_green",
    cells: str = "triangle,quadrilateral",
    degrees: str = "1,2,3,4",
    repeats: int = 3,
    out: Path = Path("results/benchmarks/flow"),
    worker: str | None = None,
) -> None:
    """Measure errors, CPU time and memory of cavity and vortex, and compare them with the published code.

    Args:
        problems: demos, separated by commas.
        cells: of the meshes, separated by commas.
        degrees: of velocity and pressure, separated by commas.
        repeats: solves on every mesh, of which the fastest counts.
        out: folder of the results.
        worker: one mesh as JSON, which is solved in this process, instead of all.
    """
    if worker:
        print(json.dumps(solve(*json.loads(worker))))
        return
    here = calibrate.calibrate()
    speed = calibrate.legacy_speed(here)
    rows = [
        run(problem, kind, degree, n, repeats)
        for problem in problems.split(",")
        for kind in cells.split(",")
        for degree in (int(d) for d in degrees.split(","))
        for n in SEQUENCES[degree]
    ]
    text = table(COLUMNS, [[r[name] for name in COLUMNS] for r in rows])
    text += "\n\nAs accurate in H1 as the published code where it took a second or more; scaled CPU seconds\n"
    header = ("problem", "published", "H1_u", "CPU s", "cheapest here", "H1_u", "CPU s", "ratio", "ratio, same mesh")
    gains = speedups(rows, speed)
    text += table(header, gains)
    smallest = min((row[-2] for row in gains), default=0.0)
    text += f"\n\nsmallest ratio {smallest:.3g}, {WANTED:g} wanted; machine {speed:.3g} times as fast: {here}\n"
    print(text)
    inputs = {"problems": problems, "cells": cells, "degrees": degrees, "repeats": repeats}
    write_summary(out, "flow", inputs, runs=rows, calibration=here, speed=speed)
    (out / "table.txt").write_text(text)
    plot(out / "flow.png", rows, speed)


if __name__ == "__main__":
    script.command_line(main)
