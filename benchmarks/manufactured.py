"""Error against run time and memory of the manufactured fluid-membrane problem: levels x presets x time steps.

Every run is a process of its own, after one that compiles the forms, so that CPU time and memory are its alone.
"""

import csv
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import calibrate
import numpy as np

from tigar_x.run import script
from tigar_x.run.figure import draw, lines
from tigar_x.run.summary import table

CURVED = "curved"
"""In place of a dimension: three, with a membrane that is curved and moves differently everywhere."""
HERE = Path(__file__).resolve().parent
DEMO = HERE.parent / "demos" / "manufactured.py"
NORMS = ("L2_u", "H1_u", "L2_p", "L2_y", "H1_y")
FIRST = ("level", "dt_factor", "steps", "passes_mean")
COLUMNS = (
    *("dim", "curved", "preset", *FIRST),
    *NORMS,
    *(f"{norm}_true" for norm in NORMS),
    *("cpu_s", "cpu_s_scaled", "wall_s", "cpu_s_per_step", "peak_rss_mib", "rss_growth_mib", "dofs_fluid"),
)


def run(out: Path, dim: int | str, preset: str, level: int, dt_factor: float) -> dict[str, Any]:
    """One run of the demo in its own process; its summary."""
    folder = out / "runs" / f"{dim}d-{preset}-{level}-{dt_factor:g}"
    which = ["--dim", "3", "--curved"] if dim == CURVED else ["--dim", str(dim)]
    command = [sys.executable, str(DEMO), "--no-viz", "--overwrite", *which, "--preset", preset]
    command += ["--level", str(level), "--dt-factor", str(dt_factor), "--out", str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, env={**os.environ, "OMP_NUM_THREADS": "1"})
    if done.returncode:
        raise RuntimeError(f"{' '.join(command)} failed:\n{done.stderr}")
    return dict(json.loads((folder / "summary.json").read_text()))


def row(summary: dict[str, Any], speed: float) -> dict[str, Any]:
    """One line of the table; scaled CPU seconds are those of the machine of legacy.csv."""
    inputs = summary["inputs"]
    return {
        "dim": inputs["dim"],
        "curved": inputs["curved"],
        "preset": inputs["preset"],
        "level": inputs["level"],
        "dt_factor": inputs["dt_factor"],
        "steps": summary["steps"],
        "passes_mean": summary["block_iterations_mean"],
        **summary["errors"],
        **{f"{norm}_true": summary["errors_true"][norm] for norm in NORMS},
        "cpu_s": summary["cpu_s"],
        "cpu_s_scaled": summary["cpu_s"] * speed,
        "wall_s": summary["wall_s"],
        "cpu_s_per_step": summary["cpu_s"] / summary["steps"],
        "peak_rss_mib": summary["peak_rss_mib"],
        "rss_growth_mib": summary["rss_mib_end"] - summary["rss_mib_step_10"],
        "dofs_fluid": summary["dofs_fluid"],
    }


def legacy() -> list[dict[str, Any]]:
    """Figures of the published code, in the same columns."""
    lines = [line for line in (HERE / "legacy.csv").read_text().splitlines() if not line.startswith("#")]
    rows = [{key: float(value) for key, value in entry.items()} for entry in csv.DictReader(lines)]
    return [{**r, "preset": "legacy", "cpu_s_scaled": r["cpu_s_per_step"] * r["steps"]} for r in rows]


def slopes(rows: list[dict[str, Any]], lowest: int = 2) -> dict[str, float] | None:
    """Fitted orders in h of the true errors from a level upwards; None with fewer than two levels."""
    used = [r for r in rows if r["level"] >= lowest]
    if len(used) < 2:
        return None
    log_h = [-r["level"] * np.log(2.0) for r in used]
    return {norm: float(np.polyfit(log_h, np.log([r[f"{norm}_true"] for r in used]), 1)[0]) for norm in NORMS}


def speedups(rows: list[dict[str, Any]]) -> list[tuple[Any, ...]]:
    """Scaled CPU time of the cheapest run that is as accurate as the finest published one, for some sets of norms."""
    yardstick = legacy()[-1]
    result = []
    for norms in (("H1_u",), ("H1_u", "L2_y"), ("L2_u", "H1_u", "L2_p", "L2_y", "H1_y")):
        good = [r for r in rows if not r["curved"] and all(r[norm] <= yardstick[norm] for norm in norms)]
        if good:
            best = min(good, key=lambda r: r["cpu_s_scaled"])
            ratio = yardstick["cpu_s_scaled"] / best["cpu_s_scaled"]
            what = f"{best['dim']}D {best['preset']} {best['level']} dt x {best['dt_factor']:g}"
            result.append((" + ".join(norms), what, best["cpu_s_scaled"], yardstick["cpu_s_scaled"], ratio))
    return result


def plot(path: Path, groups: dict[str, list[dict[str, Any]]]) -> None:
    """Four norms against scaled CPU time, one line per preset and time step."""
    styles = {n: {"fmt": "ks-" if n.startswith("published") else "o-"} for n in groups}
    times = {name: [r["cpu_s_scaled"] for r in rows] for name, rows in groups.items()}
    panels = [
        lines(
            {name: (times[name], [r[norm] for r in rows]) for name, rows in groups.items()},
            x=("CPU time, scaled", "s"),
            y=(f"{norm.replace('_', ' ')} error", "-"),
            styles=styles,
            xscale="log",
            yscale="log",
        )
        for norm in ("L2_u", "H1_u", "L2_p", "L2_y")
    ]
    draw(path, *panels)


def main(
    dims: str = "2",
    levels: str = "1,2,3,4,5",
    presets: str = "reference,plain,sharp",
    dt_factors: str = "1,2,4,8",
    out: Path = Path("results/benchmarks"),
) -> None:
    """Measure errors, CPU time and memory, and compare them with the published code.

    Args:
        dims: dimensions, 2 (plane), 3 (one layer) and "curved" (a curved membrane across a cube), separated by commas.
        levels: refinement levels, separated by commas.
        presets: presets, separated by commas; the reference preset runs with its own time step only.
        dt_factors: time steps of the others relative to the published one, separated by commas.
        out: folder of the results.
    """
    kinds = [CURVED if dim == CURVED else int(dim) for dim in dims.split(",")]
    here = calibrate.calibrate()
    speed = calibrate.legacy_speed(here)
    print(f"calibration {here}: {speed:.2f} times the speed of the machine of legacy.csv")
    chosen = [int(level) for level in levels.split(",")]
    groups: dict[str, list[dict[str, Any]]] = {}
    for dim, preset in [(dim, preset) for dim in kinds for preset in presets.split(",")]:
        run(out, dim, preset, 1, 1.0)  # compiles
        for factor in [1.0] if preset == "reference" else [float(f) for f in dt_factors.split(",")]:
            name = f"{dim if dim == CURVED else f'{dim}D'} {preset}, dt x {factor:g}"
            groups[name] = [row(run(out, dim, preset, level, factor), speed) for level in chosen]
            print(f"\n{name}")
            print(table(FIRST + NORMS + ("cpu_s", "peak_rss_mib"), _cells(groups[name])))
            fitted = slopes(groups[name])
            if fitted:
                print(
                    "orders in h (true errors, from level 2): " + ", ".join(f"{k} {v:.2f}" for k, v in fitted.items())
                )

    rows = [r for group in groups.values() for r in group]
    with open(out / "manufactured.csv", "w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS)
        writer.writeheader()
        writer.writerows(rows)
    published = {"published code": legacy()} if kinds != [CURVED] else {}
    plot(out / "error_against_time.png", groups | published)
    if published:
        print("\nAs accurate as the published code at level 4, CPU seconds scaled to its machine")
        print(table(["norms", "cheapest run", "CPU s", "published code", "ratio"], speedups(rows)))
    print(f"\nwritten: {out / 'manufactured.csv'}, {out / 'error_against_time.png'}")


def _cells(rows: list[dict[str, Any]]) -> list[list[Any]]:
    return [[r[key] for key in FIRST + NORMS + ("cpu_s", "peak_rss_mib")] for r in rows]


if __name__ == "__main__":
    script.command_line(main)
