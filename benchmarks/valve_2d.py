"""Error against run time of the plane valve: dimensions, presets, meshes and time steps, and settings one at a time.

Errors are those of the displacement of both leaflets' tips along the channel, root mean squares over 0 < t < 3 against
the finest run, which has four times the others' inertial penalty so that little slips through; and those of the top
tip over 0.15 < t < 1 against a body-fitted solution with leaflets of the real thickness and of none. Every run is a
process of its own; a run whose result is in the folder is not repeated.
"""

import csv
import json
import logging
import multiprocessing
from pathlib import Path
from typing import Any

import calibrate
import numpy as np
from load import legacy_valve, load_demo
from valve_2d_cases import (
    Case,
    finest_case,
    mesh_study,
    options_studies,
    sides_study,
    step_study,
)

from coudalfish import StepError
from coudalfish.problems.valve_2d import off_body_fitted, swings
from tigar_x.compat import FloatArray
from tigar_x.run import script
from tigar_x.run.course import Course
from tigar_x.run.figure import draw, lines
from tigar_x.run.progress import Stopwatch, peak_rss_mib, rss_mib
from tigar_x.run.summary import table

COLUMNS = (
    *("study", "setting", "dim", "elements", "mirrored", "dt_factor", "steps", "passes_mean", "passes_max", "linear"),
    *(
        "error",
        "top_rms_thick",
        "top_rms_thin",
        "peak_1",
        "trough_1",
        "peak_2",
        "trough_2",
        "peak_3",
        "trough_3",
        "asymmetry",
        "leaked_share",
    ),
    *("slip_ratio", "cpu_s", "cpu_s_scaled", "cpu_s_per_step_scaled", "peak_rss_mib", "rss_growth_mib", "dofs_fluid"),
)
SHOWN = (
    *("setting", "passes_mean", "linear", "error", "peak_2", "trough_2", "leaked_share", "slip_ratio"),
    "cpu_s_scaled",
)
SHOWN_OF_MESHES = (
    *("setting", "steps", "passes_mean", "passes_max", "error", "top_rms_thick", "top_rms_thin", "peak_1", "trough_1"),
    *(
        "peak_2",
        "trough_2",
        "peak_3",
        "trough_3",
        "asymmetry",
        "leaked_share",
        "slip_ratio",
        "cpu_s_scaled",
        "peak_rss_mib",
        "rss_growth_mib",
    ),
)


def measure(case: Case) -> dict[str, Any]:
    """Run a case: its costs, monitors and the history of its tips; with "failed" when a step failed."""
    logging.getLogger("coudalfish").setLevel(logging.ERROR)
    demo = load_demo("valve_2d")
    names = ("dim", "elements", "leaflet_elements", "degree", "preset", "mirrored", "dt_factor", "invariant_metric")
    valve = demo.Valve(**{name: getattr(case, name) for name in names})
    flow, shell, fsi = valve.build(case.options, case.solver, rho_inf=case.rho_infinity)
    watch, reports, rows, memory, failed = Stopwatch(), [], [], [], None
    try:
        for _ in range(round(3.0 / fsi.step_size)):
            with watch:
                reports.append(fsi.takeStep())
            rows.append((reports[-1].t, *(float(shell.at("tip", patch=k).displacement[0]) for k in (0, 1))))
            memory.append(rss_mib())
    except StepError as error:
        failed = str(error)
    passes = [report.passes for report in reports] or [0]
    leak = np.array([report.monitors.leak for report in reports])
    fastest = [float(demo.inflow((0.0, demo.HEIGHT / 2.0), t, fsi.step_size)[0]) for t, *_ in rows]
    entered = sum(2.0 * demo.HEIGHT / 3.0 * speed for speed in fastest)
    return {
        "failed": failed,
        "history": rows,
        "steps": len(reports),
        "passes_mean": float(np.mean(passes)),
        "passes_max": max(passes),
        "linear": sum(report.linear_iterations for report in reports) / max(1, sum(passes)),
        "leaked_share": float(np.abs(leak).sum() / entered) if len(rows) else 0.0,
        "slip_ratio": max((report.slip_ratio for report in reports), default=0.0),
        "cpu_s": watch.cpu_s,
        "peak_rss_mib": peak_rss_mib(),
        "rss_growth_mib": memory[-1] - memory[min(9, len(memory) - 1)] if memory else 0.0,
        "dofs_fluid": flow.unknowns,
    }


def curve(history: list[list[float]], t: FloatArray) -> FloatArray:
    """Displacements of both tips at times, shape (2, times)."""
    rows = np.vstack([np.zeros(3), history])
    return np.array([np.interp(t, rows[:, 0], rows[:, i]) for i in (1, 2)])


def row(study: str, case: Case, result: dict[str, Any], finest: list[list[float]]) -> dict[str, Any]:
    """One line of the table."""
    line: dict[str, Any] = {"study": study, "setting": case.setting, "dim": case.dim, "elements": case.elements}
    line |= {"mirrored": case.mirrored, "dt_factor": case.dt_factor}
    line |= {key: result[key] for key in COLUMNS if key in result}
    line["cpu_s_per_step_scaled"] = result["cpu_s_scaled"] / max(1, result["steps"])
    if result["failed"]:
        return line
    t = np.linspace(0.0, 3.0, 601)
    here = curve(result["history"], t)
    line["error"] = float(np.sqrt(np.mean((here - curve(finest, t)) ** 2)))
    line["asymmetry"] = float(np.abs(here[1] - here[0]).max())
    times, _, top = np.array(result["history"]).T
    found = off_body_fitted(times, top) | swings(Course(times, top))
    return line | {name: value for name, value in found.items() if name in COLUMNS}


def plot(path: Path, rows: list[dict[str, Any]], curves: dict[str, FloatArray]) -> None:
    """Error against run time, and curves of the top tip."""
    groups: dict[str, list[dict[str, Any]]] = {}
    for r in rows:
        if "error" in r and r["study"] in ("meshes", "time steps"):
            name = r["setting"].rsplit(", ", 1)[0]
            groups.setdefault(name + ", time steps" if r["study"] == "time steps" else name, []).append(r)
    errors = {n: ([r["cpu_s_scaled"] for r in group], [r["error"] for r in group]) for n, group in groups.items()}
    styles = {name: {"fmt": "o--" if name.endswith("time steps") else "o-"} for name in groups}
    seconds, rms = ("CPU time, scaled", "s"), ("error of the tips, rms over time", "length")
    tips = {name: (np.linspace(0.0, 3.0, len(x)), x) for name, x in curves.items()}
    shown = {"xlim": (0.6, 2.0), "ylim": (0.28, 0.62)}
    draw(
        path,
        lines(errors, x=seconds, y=rms, styles=styles, xscale="log", yscale="log"),
        lines(tips, x=("$t$", "time"), y=("top tip along the channel", "length"), **shown),
    )


def main(
    dims: str = "2,3",
    elements: str = "16,24,32",
    finest: int = 64,
    settings_elements: int = 16,
    dt_factors: str = "1,2,4,8",
    out: Path = Path("results/benchmarks/valve_2d"),
) -> None:
    """Measure errors of the tips, CPU time and memory, and compare them with the published code.

    Args:
        dims: dimensions, 2 (plane) and 3 (one layer), separated by commas.
        elements: fluid cells across the channel, separated by commas.
        finest: cells of the run that errors refer to.
        settings_elements: cells of the runs with other settings.
        dt_factors: time steps relative to the published one, separated by commas.
        out: folder of the results.
    """
    here = calibrate.calibrate()
    speed = calibrate.legacy_speed(here)
    print(f"calibration {here}: {speed:.2f} times the speed of the machine of legacy_valves.csv", flush=True)
    chosen = [int(n) for n in elements.split(",")]
    factors = [float(f) for f in dt_factors.split(",")]
    studies = {"finest": [finest_case(finest)]}
    studies["meshes"] = [case for dim in dims.split(",") for case in mesh_study(int(dim), chosen)]
    studies["time steps"] = step_study(max(chosen), factors)
    studies["sides"] = sides_study((min(chosen), max(chosen)), (3.0, 10.0))
    studies |= options_studies(settings_elements)
    results = run_all(studies, out / "runs", speed)
    reference, t = next(iter(results.values()))["history"], np.linspace(0.0, 3.0, 601)
    rows, curves = [], {}
    for study, cases in studies.items():
        lines = [row(study, case, results[key(study, case)], reference) for case in cases]
        ends = min(chosen), max(chosen)
        for case in cases if study in ("finest", "meshes") else []:
            if study == "finest" or (case.dim == 2 and case.elements in ends and "published" not in case.setting):
                curves[case.setting] = curve(results[key(study, case)]["history"], t)[1]
        shown = SHOWN_OF_MESHES if study in ("finest", "meshes", "time steps", "sides") else SHOWN
        print(f"\n**{study}**\n\n| {' | '.join(shown)} |\n|{' --- |' * len(shown)}")
        for line in lines:
            values = [line.get(name, "-") for name in shown]
            print("| " + " | ".join(f"{v:.3g}" if isinstance(v, float) else str(v) for v in values) + " |")
        rows += lines
    with open(out / "valve_2d.csv", "w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS)
        writer.writeheader()
        writer.writerows(rows)
    plot(out / "valve_2d.png", rows, curves)
    compare(rows)


def key(study: str, case: Case) -> str:
    """Name of a run's file."""
    return f"{study}-{case.setting}".replace(" ", "_")


def run_all(studies: dict[str, list[Case]], folder: Path, speed: float) -> dict[str, dict[str, Any]]:
    """Results of all runs; those that are not in the folder are made, each in its own process, the finest one first."""
    folder.mkdir(parents=True, exist_ok=True)
    every = {key(study, case): case for study, cases in studies.items() for case in cases}
    with multiprocessing.get_context("spawn").Pool(1, maxtasksperchild=1) as pool:
        for name, case in sorted(every.items(), key=lambda item: (not item[0].startswith("finest"), item[1].cost)):
            file = folder / f"{name}.json"
            if not file.exists():
                result = pool.apply(measure, (case,))
                file.write_text(json.dumps(result | {"cpu_s_scaled": result["cpu_s"] * speed}))
                print(f"{name}: {result['cpu_s']:.3g} CPU s {result['failed'] or ''}", flush=True)
    return {name: json.loads((folder / f"{name}.json").read_text()) for name in every}


def compare(rows: list[dict[str, Any]], elements: int = 16) -> None:
    """Print what runs cost that are as fine as that of the published code, relative to it."""
    published = legacy_valve("valve_2d")
    step = published["cpu_s_per_step"]
    beside = [
        (
            r["setting"],
            r["dofs_fluid"],
            r["passes_mean"],
            r["cpu_s_per_step_scaled"],
            step / r["cpu_s_per_step_scaled"],
            512 * step / r["cpu_s_scaled"],
            r["rss_growth_mib"] / r["steps"],
        )
        for r in rows
        if r["study"] == "meshes" and r["elements"] == elements
    ]
    growth = published["growth_mib_per_step"]
    beside.append(("published code", int(published["dofs_fluid"]), published["passes_mean"], step, 1.0, 1.0, growth))
    header = ("run", "fluid unknowns", "passes", "CPU s/step (scaled)", "ratio", "ratio of runs to T = 3", "MiB/step")
    print()
    print(table(header, beside))


if __name__ == "__main__":
    script.command_line(main)
