"""How a heart valve opens and closes: fields at the leaflets, meshes and time steps, beside the finest run.

The demo's valve opens under the systolic traction and is closed by the diastolic one. Every run is a process of its
own, which writes a row a step; one whose rows are in the folder is not repeated, and one that was cut short has the
figures of as far as it came. Errors are root mean squares over the time up to a common one, to which all that are
compared have come, and so are the CPU times beside them. Reversed at 0, the valve is closed from
rest. Of the closed valve, which swings, "leak" is the mean flow back and "leak_at_rest" that less what leaflets sweep.
"""

import csv
import logging
import math
import os
import subprocess
import sys
import time
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI
from load import load_demo

from coudalfish.valves import Leaflets, flow_through
from tigar_x import compat
from tigar_x.run import script
from tigar_x.run.figure import draw, lines
from tigar_x.run.history import FILE, History
from tigar_x.run.summary import table
from varmint.quantities import Measured, flow_rate

COLUMNS = (
    *("preset", "cells", "dt", "reversal", "until", "largest_flow", "largest_backflow", "closure_time", "leak"),
    *("leak_at_rest", "ringing", "opening", "last_opening", "speed", "speed_closed"),
    *("lowest_pressure", "highest_pressure"),
    *("asymmetry", "asymmetry_closed", "error_flow", "error_opening", "passes", "passes_max", "linear"),
    *("attempts", "cut", "cpu_s_opening", "cpu_s_touching", "cpu_s"),
)
OPEN = 0.25
"""Part of the time before the reversal that counts as opening in the costs of a step: no leaflets touch there."""


@dataclass(frozen=True)
class Case:
    """A run.

    Attributes:
        preset: of the demo.
        resolution: cells across the aorta.
        dt: time step [s].
        reversal: time at which the pressure is reversed [s]; 0: it closes the valve from the start.
        until: end [s].
    """

    preset: str
    resolution: int
    dt: float
    reversal: float
    until: float

    @property
    def name(self) -> str:
        """Of its folder."""
        return f"{self.preset}-{self.resolution}-{self.dt:g}-{self.reversal:g}"

    @property
    def words(self) -> list[str]:
        """The same on the command line."""
        one = {"presets": self.preset, "resolutions": self.resolution, "time-steps": f"{self.dt:g}"}
        one |= {"reversals": f"{self.reversal:g}", "until": f"{self.until:g}"}
        return [word for name, value in one.items() for word in (f"--{name}", str(value))]


def measure(case: Case, out: Path) -> None:
    """Run a case; its rows go into a folder of its name."""
    logging.getLogger().setLevel(logging.ERROR)
    demo = load_demo("heart_valve")
    scene = demo.Valve(resolution=case.resolution, dt=case.dt, preset=case.preset)
    flow, shell, fsi = scene.build(replace(demo.Data(), reversal=case.reversal))
    leaflets, rate = Leaflets(shell), Measured(q=flow_rate(flow, "inlet"))

    def highest(values: Any) -> float:
        return float(flow.mesh.domain.comm.allreduce(float(np.max(values)), op=MPI.MAX))

    def state() -> list[float]:
        w = flow.time.x.x.array.reshape(-1, 4)
        return [highest(np.linalg.norm(w[:, :3], axis=1)), -highest(-w[:, 3]), highest(w[:, 3])]

    def cpu() -> float:
        return float(flow.mesh.domain.comm.allreduce(time.process_time() - compat.compile_cpu_seconds()))

    def swept() -> float:
        at, W = fsi.shell, fsi.shell.quadrature.weights
        return -float((W * at.sheets.stretch(at.positions())) @ np.einsum("qi,qi->q", at.velocity(), at.normals()))

    history = {
        **{"swept": swept},
        **{"flow_rate": lambda: -rate()["q"], "linear": "linear_iterations", "attempts": "attempts"},
        **{
            ("speed", "lowest", "highest"): state,
            "slip": "monitors.normal_slip_max",
            "force_imbalance": "monitors.force_imbalance",
        },
        **leaflets.columns(),
        **{"cells": lambda: flow.mesh.size, "cpu_s": cpu},
    }
    fsi.run(until=case.until, out=out / case.name, overwrite=True, history=history, show=False).through()


def run(case: Case, out: Path) -> None:
    """Run a case in a process of its own, unless it has rows."""
    file = out / case.name / FILE
    if not file.exists():
        command = [sys.executable, str(Path(__file__).resolve()), "--worker", *case.words, "--out", str(out)]
        done = subprocess.run(command, capture_output=True, text=True, env={**os.environ, "OMP_NUM_THREADS": "1"})
        if done.returncode:
            print(f"{case.name}: {done.stderr[-2000:]}", flush=True)


def row(case: Case, past: History, finest: History, compared: float) -> dict[str, Any]:
    """A line of the table."""
    end, dt, q = float(past.t[-1]), case.dt, past.course("flow_rate")
    found = flow_through(q, max(case.reversal, float(past.t[0])))
    line = {name: getattr(case, name) for name in ("preset", "dt", "reversal")} | {"until": end}
    line |= {"cells": int(past["cells"][0]), "largest_flow": found["peak_flow_rate"]}
    line |= {name: found[name] for name in ("largest_backflow", "closure_time") if name in found}
    line |= {"opening": past["opening_area"].max(), "last_opening": past["opening_area"][-1]}
    line |= {"speed": past["speed"].max(), "lowest_pressure": past["lowest"].min()}
    line |= {"highest_pressure": past["highest"].max(), "asymmetry": past["asymmetry"].max()}
    if "closure_time" in found:
        closed = past.since(found["closure_time"])
        last = past.since(0.5 * (found["closure_time"] + end))
        line |= {"leak": -last.course("flow_rate").mean, "ringing": float(np.ptp(closed["flow_rate"])) / 2.0}
        line |= {"leak_at_rest": line["leak"] + last.course("swept").mean if "swept" in past else math.nan}
        line |= {"speed_closed": last["speed"].max(), "asymmetry_closed": last["asymmetry"][-1]}
    if end >= compared and finest.t[-1] >= compared:
        t = np.linspace(0.0, compared, 201)[1:]
        for name, column in (("flow", "flow_rate"), ("opening", "opening_area")):
            off = np.interp(t, past.t, past[column]) - np.interp(t, finest.t, finest[column])
            line[f"error_{name}"] = float(np.sqrt(np.mean(off**2)))
        line["cpu_s"] = float(np.interp(compared, past.t, past["cpu_s"]))
    seconds = np.diff(past["cpu_s"], prepend=past["cpu_s"][0])
    begun, touch = (past.t > 10.5 * dt) & (past.t < OPEN * case.reversal), past["contact_pairs"] > 0
    for name, some in (("opening", begun), ("touching", touch & (past.t > case.reversal))):
        if some.any():
            line[f"cpu_s_{name}"] = float(seconds[some].mean())
    line |= {"passes": past["passes"].mean(), "passes_max": int(past["passes"].max())}
    line |= {"linear": past["linear"].sum() / past["passes"].sum(), "attempts": int((past["attempts"] > 1).sum())}
    return line | {"cut": int((np.diff(past.t) < 0.9 * dt).sum())}


def plot(path: Path, rows: list[dict[str, Any]], curves: dict[str, History]) -> None:
    """Curves of flow rate and opening, and their errors against CPU time; the finest run has none."""
    groups: dict[str, list[dict[str, Any]]] = {}
    for line in rows:
        groups.setdefault(f"{line['preset']}, {line['cells']} cells", []).append(line)
    styles = {}
    presets, sizes = ([*dict.fromkeys(line[key] for line in rows)] for key in ("preset", "cells"))
    for name, some in groups.items():
        mark = "os^Dv"[sizes.index(some[0]["cells"]) % 5]
        styles[name] = {"fmt": f"C{presets.index(some[0]['preset'])}{mark}-", "markersize": 4}
    panels = []
    for key, what, unit in (
        ("flow_rate", "flow rate", "cm$^3$/s"),
        ("opening_area", "area within free edges", "cm$^2$"),
    ):
        courses = {name: (past.t, past[key]) for name, past in curves.items()}
        panels.append(lines(courses, x=("time", "s"), y=(what, unit)))
    for key, what, unit in (("flow", "flow rate", "cm$^3$/s"), ("opening", "opening", "cm$^2$")):
        known = {name: [s for s in some if s.get(f"error_{key}")] for name, some in groups.items()}
        errors = {
            name: ([line["cpu_s"] for line in some], [line[f"error_{key}"] for line in some])
            for name, some in known.items()
            if some
        }
        y = (f"error of the {what}, rms over time", unit)
        panels.append(lines(errors, x=("CPU time", "s"), y=y, styles=styles, xscale="log", yscale="log"))
    draw(path, *panels)


def tabulate(cases: Iterable[Case], finest: str, compared: float, out: Path) -> list[dict[str, Any]]:
    """The table of the runs that have rows, printed, as CSV and as a figure."""
    past = {case: History.read(out / case.name) for case in cases if (out / case.name / FILE).exists()}
    best = History.read(out / finest)
    rows = [row(case, found, best, compared) for case, found in past.items()]
    print(table(COLUMNS, [[line.get(name, "-") for name in COLUMNS] for line in rows]))
    with open(out / "valve_closing.csv", "w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS)
        writer.writeheader()
        writer.writerows(rows)
    middle = sorted({case.dt for case in past})[len({case.dt for case in past}) // 2]
    curves = {
        f"{line['preset']}, {line['cells']} cells": found
        for line, (case, found) in zip(rows, past.items(), strict=True)
        if case.dt == middle
    }
    plot(out / "valve_closing.png", rows, curves)
    return rows


def main(
    presets: str = "plain,jump,sharp",
    resolutions: str = "12,16,20",
    time_steps: str = "2e-4,1e-4,5e-5",
    reversals: str = "0.02",
    until: float = 0.045,
    finest: str = "",
    compared: float = 0.0,
    workers: int = 1,
    out: Path = Path("results/benchmarks/valve_closing"),
    worker: bool = False,
) -> None:
    """Open and close the heart valve.

    Args:
        presets: of the demo, separated by commas.
        resolutions: cells across the aorta, separated by commas.
        time_steps: in seconds, separated by commas.
        reversals: times at which the pressure is reversed, in seconds, separated by commas.
        until: end of the runs, in seconds.
        finest: folder of the run that errors refer to; none: that of the last preset, mesh and time step.
        compared: end of the time over which errors are taken, in seconds; 0: that of the runs.
        workers: number of runs at a time.
        out: folder of the results.
        worker: make the first run in this process, or on the ranks of this one.
    """
    cases = [
        Case(preset, int(n), float(dt), float(reversal), until)
        for reversal in reversals.split(",")
        for dt in time_steps.split(",")
        for n in resolutions.split(",")
        for preset in presets.split(",")
    ]
    if worker:
        measure(cases[0], out)
        return
    with ThreadPoolExecutor(workers) as pool:
        list(pool.map(lambda case: run(case, out), cases))
    tabulate(cases, finest or cases[-1].name, compared or until, out)


if __name__ == "__main__":
    script.command_line(main)
