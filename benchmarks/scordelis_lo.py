"""Error against run time and memory of the Scordelis-Lo roof: degrees x elements, beside the published code.

Every run is a process of its own, after one that compiles the forms, so that CPU time and memory are its alone; of some
such runs the fastest counts in every stage.
"""

import csv
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import calibrate

from tigar_x.run import script
from tigar_x.run.figure import draw, lines
from tigar_x.run.summary import table, write_summary

HERE = Path(__file__).resolve().parent
DEMO = HERE.parent / "demos" / "scordelis_lo.py"
CONVERGED = 0.3005924565  # degrees 4 and 5 agree on it; 0.3006 was published
STAGES = {"extraction": "geometry and extraction", "forms": "forms", "product": "M^T A M", "solve": "solve"}
COLUMNS = ("degree", "elements", "sinking", "legacy", "error", *STAGES, "CPU s", "scaled", "peak MiB")

# What must hold for the finest cubic roof that the published code was timed with: scaled CPU seconds, and MiB.
TARGET_ROOF = (3, 32)
TARGETS = {"extraction": 0.3, "forms": 0.2, "product": 0.15, "peak_rss_mib": 269.0}


def run(out: Path, cells: str, degree: int, elements: int) -> dict[str, Any]:
    """One run of the demo in its own process; its summary."""
    folder = out / "runs" / f"{cells}-{degree}-{elements}"
    command = [sys.executable, str(DEMO), "--no-viz", "--overwrite", "--cells", cells, "--degree", str(degree)]
    command += ["--elements", str(elements), "--out", str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, env={**os.environ, "OMP_NUM_THREADS": "1"})
    if done.returncode:
        raise RuntimeError(f"{' '.join(command)} failed:\n{done.stderr}")
    return dict(json.loads((folder / "summary.json").read_text()))


def row(summaries: list[dict[str, Any]], speed: float) -> dict[str, Any]:
    """The fastest of some runs of one roof; scaled CPU seconds are those of the machine of the published figures."""
    first = summaries[0]
    sinking = first["qoi"]["sinking"]["value"]
    stages = {
        name: min(summary["stages_cpu_s"][stage] for summary in summaries) * speed for name, stage in STAGES.items()
    }
    cpu_s = min(summary["cpu_s"] for summary in summaries)
    return {
        "degree": first["inputs"]["degree"],
        "elements": first["inputs"]["elements"],
        "unknowns": first["unknowns"],
        "sinking": sinking,
        "error": abs(sinking / CONVERGED - 1.0),
        "scaled_cpu_s": stages,
        "cpu_s": cpu_s,
        "cpu_s_scaled": cpu_s * speed,
        "peak_rss_mib": max(summary["peak_rss_mib"] for summary in summaries),
    }


def legacy() -> dict[tuple[int, int], dict[str, float]]:
    """Figures of the published code by degree and elements; those that were not measured are absent."""
    lines = (HERE / "legacy_scordelis_lo.csv").read_text().splitlines()
    found = {}
    for entry in csv.DictReader(line for line in lines if not line.startswith("#")):
        key = int(entry.pop("degree")), int(entry.pop("elements"))
        found[key] = {name: float(value) for name, value in entry.items() if value}
    return found


def cells_of(r: dict[str, Any], known: dict[tuple[int, int], dict[str, float]]) -> list[Any]:
    """A line of the table."""
    published = known.get((r["degree"], r["elements"]), {}).get("sinking")
    return [
        r["degree"],
        r["elements"],
        f"{r['sinking']:.6f}",
        "-" if published is None else f"{published:.6f}",
        r["error"],
        *r["scaled_cpu_s"].values(),
        r["cpu_s"],
        r["cpu_s_scaled"],
        r["peak_rss_mib"],
    ]


def against_targets(r: dict[str, Any], old: dict[str, float]) -> str:
    """What must hold for one roof, beside what the published code needed."""
    here = {**r["scaled_cpu_s"], "peak_rss_mib": r["peak_rss_mib"]}
    before = {"extraction": old["extraction_cpu_s"], "forms": old["assembly_cpu_s"], "product": "in forms"}
    before["peak_rss_mib"] = old["peak_rss_mib"]
    rows = [
        (name, here[name], target, before[name], "yes" if here[name] <= target else "NO")
        for name, target in TARGETS.items()
    ]
    total = sum(old[name] for name in ("extraction_cpu_s", "assembly_cpu_s", "solve_cpu_s"))
    text = table(("scaled CPU s, MiB", "here", "target", "published code", "reached"), rows)
    ours = r["cpu_s_scaled"]
    return f"{text}\nall stages: {ours:.3f} s, published code {total:.1f} s: a factor of {total / ours:.0f}"


def plot(path: Path, rows: list[dict[str, Any]], old: dict[tuple[int, int], dict[str, float]]) -> None:
    """Errors against scaled CPU time and against elements; the published code's points are squares."""
    timed: dict[str, Any] = {}
    refined: dict[str, Any] = {}
    square = {"fmt": "ks", "fillstyle": "none", "markersize": 9}
    styles: dict[str, Any] = {"published code": square}
    for i, degree in enumerate(sorted({r["degree"] for r in rows})):
        mine, name = [r for r in rows if r["degree"] == degree], f"p = {degree}"
        errors = [r["error"] for r in mine]
        timed[name], refined[name] = (
            ([r["cpu_s_scaled"] for r in mine], errors),
            ([r["elements"] for r in mine], errors),
        )
        styles[name] = {"fmt": f"C{i}o-"}
        points = [(n, abs(v["sinking"] / CONVERGED - 1.0)) for (p, n), v in sorted(old.items()) if p == degree]
        if points:
            refined[f"_{degree}"], styles[f"_{degree}"] = tuple(zip(*points, strict=True)), square
    before = [v for v in old.values() if "solve_cpu_s" in v]
    seconds = [v["extraction_cpu_s"] + v["assembly_cpu_s"] + v["solve_cpu_s"] for v in before]
    timed["published code"] = seconds, [abs(v["sinking"] / CONVERGED - 1.0) for v in before]
    axes = {"y": ("relative error of the deflection", "-"), "styles": styles, "xscale": "log", "yscale": "log"}
    left, right = ("CPU time, scaled", "s"), ("elements per side", "-")
    draw(path, lines(timed, x=left, **axes), lines(refined, x=right, **axes))


def main(
    degrees: str = "2,3,4,5",
    elements: str = "4,8,16,32",
    cells: str = "quad",
    repeats: int = 3,
    out: Path = Path("results/benchmarks/scordelis_lo"),
) -> dict[str, Any]:
    """Measure errors, CPU time by stage and memory of the roof, and compare them with the published code.

    Args:
        degrees: of the splines, separated by commas.
        elements: per side, separated by commas.
        cells: "quad" or "tri".
        repeats: processes per roof, of which the fastest counts.
        out: folder of the results.

    Returns:
        The summary.
    """
    here = calibrate.calibrate()
    speed = calibrate.legacy_speed(here)
    old = legacy()
    counts = [int(n) for n in elements.split(",")]
    rows = []
    for degree in (int(p) for p in degrees.split(",")):
        run(out, cells, degree, counts[0])  # compiles
        for n in counts:
            rows.append(row([run(out, cells, degree, n) for _ in range(repeats)], speed))
    text = table(COLUMNS, [cells_of(r, old) for r in rows])
    text += f"\nCPU seconds of stages are scaled: the machine is {speed:.2f} times as fast as the legacy one: {here}\n"
    finest = [r for r in rows if (r["degree"], r["elements"]) == TARGET_ROOF]
    if finest:
        text += f"\ndegree {TARGET_ROOF[0]}, {TARGET_ROOF[1]} elements per side:\n"
        text += against_targets(finest[0], old[TARGET_ROOF]) + "\n"
    print(text)
    inputs = {"degrees": degrees, "elements": elements, "cells": cells, "repeats": repeats}
    summary = write_summary(out, "scordelis_lo", inputs, roofs=rows, calibration=here, speed=speed)
    (out / "table.txt").write_text(text)
    plot(out / "scordelis_lo.png", rows, old)
    return summary


if __name__ == "__main__":
    script.command_line(main)
