"""What settings of the coupling and of the flow's fields do at an immersed surface: error, time and memory.

The scenes are those of ``plane.py``, ``plane_swinging.py`` and ``plane_gaps.py``. Every run is a process of its own, so
that CPU seconds, without form compilation, and memory are its alone; within a table they may be compared, as the runs
follow each other directly.

A setting is a preset of the coupling's options, ``plain`` (the options as they are), ``converged``, ``sharp`` and so
on, with changes to them, ``plain(relaxation=0.2, penalty=(10, 0))``; ``immersed`` is that of the flow, plain but for
``sharp`` and for ``jump``, a pressure that jumps alone, with a normal multiplier that is converged. Options of the flow
are taken too.
"""

import ast
import csv
import logging
import multiprocessing
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from plane import LOADED_ARC, Flag, HeldSheet, Ring
from plane_gaps import Slit
from plane_swinging import Plate, String
from scene import IN_PLANE, Found, Setting

from coudalfish import CouplingOptions, PenaltyRule, StepError
from tigar_x.run import script
from tigar_x.run.progress import peak_rss_mib
from varmint import FlowOptions

JUMP = CouplingOptions.converged(fluid_tangent="consistent")
IMMERSED = {"sharp": "jump and kink", "jump": "jump"}
"""What the flow's fields know of the surface, by presets for which they are not plain."""
COSTS = ("leaked", "steps", "passes mean/max", "hard", "CPU ms/step", "MiB")
Study = tuple[tuple[str, ...], dict[str, Any]]
"""Names of the figures that count, and scenes by name."""
Job = tuple[str, str, tuple[str, ...], Any, bool]
"""Study, case, figures and scene of a run, and whether its sheet is shifted through a cell."""

LOADED = {"2000 steps": LOADED_ARC, "dt x 10": replace(LOADED_ARC, dt=0.1, steps=200, ramp=6)}
STUDIES: dict[str, Study] = {
    "arc": (("velocity", "leak"), {f"n {n}": HeldSheet(n) for n in (16, 32, 64)} | {"dt x 10": HeldSheet(dt=10.0)}),
    "straight sheet": (
        ("velocity", "leak"),
        {f"n {n}": HeldSheet(n, bow=0.0) for n in (16, 32, 64)} | {"dt x 10": HeldSheet(bow=0.0, dt=10.0)},
    ),
    "arc, jump": (("velocity", "leak"), {f"{j:g}": HeldSheet(jump=j, dt=j**-0.5) for j in (1.0, 1e2, 1e3, 1e5)}),
    "loaded arc": (("velocity", "grown", "pattern", "growth"), LOADED),
    "string": (
        ("frequency", "damping", "leak"),
        {
            **{f"mass {m:g}": String(mass_ratio=m) for m in (1.0, 1e-2, 1e-4)},
            "n 32, 100 steps": String(32, 100),
            **{f"mass {m:g}, dt x 10": String(steps_per_period=5, mass_ratio=m) for m in (1.0, 1e-4)},
        },
    ),
    "ring": (
        ("area", "lost", "velocity"),
        {"n 16": Ring(16), "n 32": Ring(32), "mu 0.01": Ring(mu=0.01)}
        | {f"mu {mu:g}, dt x 10": Ring(mu=mu, dt=0.2, steps=5) for mu in (0.1, 0.01)},
    ),
    "plate": (
        ("error", "drag", "inertia"),
        {
            **{f"delta {d:g} h": Plate(d) for d in (4.0, 1.0, 0.25)},
            **{f"delta {d:g} h, dt x 10": Plate(d, steps_per_period=10) for d in (4.0, 1.0, 0.25)},
        },
    ),
    "slit": (
        ("flow", "leak"),
        {
            f"Re {re:g}, CFL {cfl:g}, gap {gap:g} h": Slit(gap, re, cfl)
            for re in (0.5, 10.0, 27.0, 55.0)
            for cfl in (0.2, 1.0)
            for gap in (1.0, 2.0, 4.0)
        }
        | {f"Re {re:g}, CFL 10, gap 1 h, dt x 10": Slit(1.0, re, 10.0) for re in (0.5, 10.0)},
    ),
    "flag": (("amplitude", "period", "drag", "leak"), {"n 16": Flag(), "n 16, dt x 10": Flag(dt=0.1)}),
}
PLACES = 20
SHIFTED: dict[str, HeldSheet] = {"arc": HeldSheet(), "straight": HeldSheet(bow=0.0)}


def setting_of(text: str, start: Setting = IN_PLANE) -> Setting:
    """A setting from text, see the module.

    Args:
        text: see there.
        start: with the options of the flow that the text does not change.

    Raises:
        ValueError: it is no such text.
        TypeError: there is no such option.
    """
    node = ast.parse(text.strip(), mode="eval").body
    call = node if isinstance(node, ast.Call) else ast.Call(node, [], [])
    if not isinstance(call.func, ast.Name) or call.args or None in [item.arg for item in call.keywords]:
        raise ValueError(f"{text!r}: preset or preset(option=value, ...) is required")
    given = {str(item.arg): ast.literal_eval(item.value) for item in call.keywords}
    if isinstance(given.get("penalty"), tuple):
        given["penalty"] = PenaltyRule(*given["penalty"])
    of_flow = {name: given.pop(name) for name in {f.name for f in fields(FlowOptions)} & set(given)}
    name = call.func.id
    immersed = given.pop("immersed", IMMERSED.get(name, start.immersed))
    known = {"plain": CouplingOptions(), "jump": JUMP}
    preset = known[name] if name in known else getattr(CouplingOptions, name, None)
    if preset is None:
        raise ValueError(f"{name!r} is no preset of CouplingOptions")
    options = (preset if isinstance(preset, CouplingOptions) else preset()).with_(**given)
    return Setting(options, immersed, replace(start.flow, **of_flow))


def measure(scene: Any, text: str, shifted: bool = False, start: Setting = IN_PLANE) -> dict[str, Any]:
    """Run a scene with a setting: its figures and costs, or why it failed."""
    logging.getLogger("coudalfish").setLevel(logging.ERROR)
    try:
        setting = setting_of(text, start)
        if shifted and isinstance(scene, HeldSheet):
            found = scene.shifted(setting, PLACES)
            speeds = [each.figures["velocity"] for each in found]
            figures = {"smallest": min(speeds), "largest": max(speeds), "ratio": max(speeds) / max(min(speeds), 1e-300)}
            return figures | costs(found[-1])
        found_once = scene.run(setting)
        return found_once.figures | costs(found_once)
    except (StepError, ValueError) as error:
        return {"failed": str(error)}


def costs(found: Found) -> dict[str, Any]:
    """What a run cost; "leaked" is the volume through the surface, and "hard" are steps with more than one attempt."""
    leaks = np.abs([report.monitors.leak for report in found.reports if report.monitors])
    return {
        "leaked": float(np.diff([0.0, *(report.t for report in found.reports if report.monitors)]) @ leaks),
        "steps": len(found.reports),
        "passes mean/max": f"{found.passes.mean():.2f}/{found.passes.max()}",
        "hard": sum(report.attempts > 1 for report in found.reports),
        "CPU ms/step": 1e3 * found.watch.cpu_s / len(found.reports),
        "MiB": round(peak_rss_mib()),
    }


def jobs(only: str, studies: dict[str, Study] = STUDIES) -> Iterator[Job]:
    """The runs of studies whose study and case contain a text."""
    for study, (figures, scenes) in studies.items():
        for case, scene in scenes.items():
            if only in f"{study}: {case}":
                yield study, case, figures, scene, False


def shifted_jobs(only: str) -> Iterator[Job]:
    """The runs of sheets that are shifted, likewise."""
    for case, scene in SHIFTED.items():
        if only in f"shifted: {case}":
            yield "shifted", case, ("smallest", "largest", "ratio"), scene, True


def keep(path: Path, rows: Sequence[dict[str, Any]]) -> None:
    """Put the rows of a case into a file of results, in the place of those that it has of the case.

    Args:
        path: of the file.
        rows: of one study and case.
    """
    old: list[dict[str, Any]] = []
    if path.exists():
        with open(path, newline="") as file:
            old = [row for row in csv.DictReader(file) if any(row[key] != rows[0][key] for key in ("study", "case"))]
    with open(path, "w", newline="") as file:
        writer = csv.DictWriter(file, ("study", "case", "setting", "name", "value"), lineterminator="\n")
        writer.writeheader()
        for row in (*old, *rows):
            value = row["value"]
            writer.writerow({**row, "value": f"{value:.6g}" if isinstance(value, float) else value})


def tabulate(runs: Iterable[Job], settings: str, path: Path, start: Setting = IN_PLANE) -> None:
    """Run scenes with settings; print a table for each study as Markdown, and write them all as CSV.

    Args:
        runs: what to run; other cases keep the results that the file has of them.
        settings: separated by semicolons, see the module.
        path: file of the results.
        start: see :func:`setting_of`.
    """
    chosen = [text.strip() for text in settings.split(";")]
    for text in chosen:
        setting_of(text, start)
    path.parent.mkdir(parents=True, exist_ok=True)
    last = ""
    with multiprocessing.get_context("spawn").Pool(1, maxtasksperchild=1) as pool:
        for study, case, figures, scene, shifted in runs:
            if study != last:
                header = ("case", "setting", *figures, *COSTS)
                print(f"\n**{study}**\n\n| {' | '.join(header)} |\n|{' --- |' * len(header)}")
            last, rows = study, []
            for text in chosen:
                found = pool.apply(measure, (scene, text, shifted, start))
                rows += [{"study": study, "case": case, "setting": text, "name": n, "value": found[n]} for n in found]
                shown = [found.get(name, "-") for name in (*figures, *COSTS)]
                shown[-1] = found.get("failed", shown[-1])
                cells = [f"{x:.3g}" if isinstance(x, float | np.floating) else str(x) for x in (case, text, *shown)]
                print(f"| {' | '.join(cells)} |", flush=True)
            keep(path, rows)
    print(f"\nwritten: {path}")


def main(settings: str = "plain; converged; sharp", only: str = "", out: Path = Path("results/surface")) -> None:
    """Run the scenes with the settings; print a table for each study as Markdown, and write them all as CSV.

    Args:
        settings: separated by semicolons, see the module.
        only: run the cases whose study and name, "slit: Re 0.5, CFL 1, gap 2 h", contain this.
        out: folder of the results.
    """
    tabulate([*jobs(only), *shifted_jobs(only)], settings, out / "surface.csv")


if __name__ == "__main__":
    script.command_line(main)
