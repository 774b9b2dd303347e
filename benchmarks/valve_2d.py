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
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import calibrate
import numpy as np
from load import legacy_valve, load_demo

from coudalfish import CouplingOptions, PenaltyRule, StepError
from coudalfish.problems.valve_2d import off_body_fitted, swings
from tigar_x.compat import FloatArray
from tigar_x.fem.linear import LinearSolver, direct, gmres_ilu
from tigar_x.run import script
from tigar_x.run.course import Course
from tigar_x.run.figure import draw, lines
from tigar_x.run.progress import Stopwatch, peak_rss_mib, rss_mib
from tigar_x.run.summary import table

PLAIN = CouplingOptions()
REFERENCE = replace(CouplingOptions.reference(), block_rtol=1e-2)
SMOOTHED = replace(PLAIN, relaxation=0.5)
TIGHT = replace(PLAIN, penalty=PenaltyRule(2.0, 2.0), block_rtol=0.1)
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


@dataclass(frozen=True)
class Case:
    """A run: what it is called and what it is built with.

    Attributes:
        setting: name within its study.
        dim: dimension of space.
        elements: across the channel.
        options: of the coupling.
        preset: of the demo, for what else belongs to the options.
        mirrored: whether the cells mirror each other.
        dt_factor: time step relative to the published one.
        leaflet_elements: of each leaflet.
        degree: of the leaflets.
        invariant_metric: of the stabilisation.
        solver: of the flow; None: by size.
        rho_infinity: of the time integration.
    """

    setting: str
    dim: int = 2
    elements: int = 24
    options: CouplingOptions = PLAIN
    preset: str = "plain"
    mirrored: bool = True
    dt_factor: float = 1.0
    leaflet_elements: int = 16
    degree: int = 2
    invariant_metric: bool = False
    solver: LinearSolver | None = None
    rho_infinity: float = 0.0

    @property
    def cost(self) -> float:
        """Rough size of the run."""
        return float(self.elements**3.3) * (6 if self.dim == 3 else 1) / self.dt_factor


def finest_case(elements: int) -> Case:
    """The run that errors refer to."""
    return Case(f"2D plain with C_2 = 2, {elements}", 2, elements, TIGHT, leaflet_elements=32)


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


def options_studies(elements: int) -> dict[str, list[Case]]:
    """Settings with plain fields, one at a time."""

    def varied(name: str, values: Iterable[Any], make: Callable[[Any], CouplingOptions]) -> list[Case]:
        return [Case(f"{name} {value}", elements=elements, options=make(value)) for value in values]

    def cases(**settings: dict[str, Any]) -> list[Case]:
        return [Case(name.replace("_", " "), elements=elements, **what) for name, what in settings.items()]

    d = PLAIN
    return {
        "plain": cases(plain={}),
        "C_1": varied("C_1", (0.5, 1.0, 4.0, 8.0), lambda c: replace(d, penalty=PenaltyRule(c, 0.5))),
        "C_2": varied("C_2", (0.0, 0.1, 1.0, 2.0, 4.0), lambda c: replace(d, penalty=PenaltyRule(2.0, c))),
        "scale_c": varied("scale_c", (1.0, 0.1, 0.01, 0.001), lambda s: replace(d, scale_c=s)),
        "scale_m": varied("scale_m", (1.0, 0.1, 0.01, 0.0001), lambda s: replace(d, scale_m=s)),
        "relaxation": [
            *varied("r", (0.0, 1e-5, 1e-3, 1e-2), lambda r: replace(d, relaxation=r, relaxation_mode="uniform")),
            *varied("smoothed r", (0.1, 0.5, 2.0), lambda r: replace(d, relaxation=r)),
        ],
        "block_rtol": [
            *varied("block_rtol", (1e-1, 1e-3), lambda r: replace(d, block_rtol=r)),
            Case("block_rtol 0.1 and C_2 2.0", elements=elements, options=TIGHT),
            Case("block_rtol 0.1 and smoothed r 0.5", elements=elements, options=replace(SMOOTHED, block_rtol=0.1)),
        ],
        "block iteration": [
            Case("consistent tangent", elements=elements, options=replace(d, fluid_tangent="consistent")),
            Case("normal of the iterate", elements=elements, options=replace(d, normal="iterate")),
            Case("tangent in every pass", elements=elements, options=replace(d, tangent_update="pass")),
            Case("published stopping", elements=elements, options=replace(d, stopping="published")),
        ],
        "solver": [
            Case("MUMPS", elements=elements, solver=direct()),
            *(Case(f"ILU(1), rtol {r:g}", elements=elements, solver=gmres_ilu(1, rtol=r)) for r in (1e-4, 1e-6)),
            Case("ILU(2), rtol 1e-08", elements=elements, solver=gmres_ilu(2)),
        ],
        "discretisation": cases(
            leaflet_elements_8={"leaflet_elements": 8},
            leaflet_elements_32={"leaflet_elements": 32},
            degree_3={"degree": 3},
            published_mesh={"mirrored": False},
            invariant_metric={"invariant_metric": True},
            published_mesh_and_invariant_metric={"mirrored": False, "invariant_metric": True},
            rho_infinity_0_5={"rho_infinity": 0.5},
        ),
    }


def mesh_study(dim: int, elements: Iterable[int]) -> list[Case]:
    """Presets on meshes; the reference preset has the published mesh."""
    cases = []
    for n in elements:
        cases.append(Case(f"{dim}D reference, {n}", dim, n, REFERENCE, mirrored=False))
        cases.append(Case(f"{dim}D plain, {n}", dim, n))
        if dim == 2:
            cases.append(Case(f"{dim}D plain, published mesh, {n}", dim, n, mirrored=False))
            cases.append(Case(f"{dim}D plain, smoothed multiplier, {n}", dim, n, SMOOTHED))
    return cases


def sides_study(elements: Iterable[int], factors: Iterable[float]) -> list[Case]:
    """Multipliers and fields on meshes, and with several time steps on the first one."""
    chosen, factors = list(elements), list(factors)
    settings = {
        "plain": (PLAIN, "plain"),
        "not relaxed": (replace(PLAIN, relaxation=0.0), "plain"),
        "r = 0.5": (SMOOTHED, "plain"),
        "converged": (CouplingOptions.converged(), "plain"),
        "sharp": (CouplingOptions.sharp(), "sharp"),
    }
    runs = [(n, 1.0) for n in chosen] + [(chosen[0], factor) for factor in factors]
    return [
        Case(f"{name}, {n}, dt x {factor:g}", elements=n, options=options, preset=preset, dt_factor=factor)
        for n, factor in runs
        for name, (options, preset) in settings.items()
    ]


def step_study(elements: int, factors: Iterable[float]) -> list[Case]:
    """Presets with several time steps."""
    presets = (("plain", PLAIN, True), ("reference", REFERENCE, False))
    return [
        Case(f"{name}, {elements}, dt x {factor:g}", 2, elements, options, mirrored=mirrored, dt_factor=factor)
        for name, options, mirrored in presets
        for factor in factors
    ]


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
