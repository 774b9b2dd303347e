"""Stiff and extreme cases of the heart valve: what ran, what was refused or cut, what was observed.

A coarse valve opens for a short time and is closed by a reversed pressure; every case changes one number of that scene.
Solves of the flow are watched: their iterations, how many failed, how many MUMPS had to take over, and how many steps
needed another attempt.
`tests/test_heart_valve.py` asserts on the first steps of the same cases, the slow tests on the whole.
"""

import logging
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from load import load_demo
from solvers import Fallbacks, Solves

from coudalfish import CouDALFISh, CouplingOptions, StepError, advance
from coudalfish.valves import Leaflets
from tigar_x.run import script
from tigar_x.run.progress import Stopwatch
from tigar_x.run.summary import write_summary

demo = load_demo("heart_valve")
SHORT = demo.Data(reversal=0.02)
DT, UNTIL, RESOLUTION, ELEMENTS = 1e-4, 0.05, 10, 10
HEADER = (
    "case",
    "preset",
    "result",
    "cut steps",
    "passes mean/max",
    "iterations of a solve, mean/max",
    "failed solves, MUMPS",
    "second attempts",
    "CPU s",
    "largest opening",
    "last opening",
    "smallest distance/range",
    "piercings",
    "closing/range",
    "slip ratio",
    "message",
)


@dataclass(frozen=True)
class Case:
    """A changed scene: data, and a factor of the time step."""

    data: Any
    dt_factor: float = 1.0


def scaled(name: str, factor: float, part: str = "") -> Case:
    """One number of the data, or of a part of them, times a factor."""
    if not part:
        return Case(replace(SHORT, **{name: factor * getattr(SHORT, name)}))
    whole = getattr(SHORT, part)
    return Case(replace(SHORT, **{part: replace(whole, **{name: factor * getattr(whole, name)})}))


def with_stiffness(factor: float) -> Case:
    """Contact of another stiffness."""
    kernel = replace(SHORT.contact.kernel, stiffness=factor * SHORT.contact.kernel.stiffness)
    return Case(replace(SHORT, contact=replace(SHORT.contact, kernel=kernel)))


def cases() -> dict[str, Case]:
    """All cases by name."""
    found = {"as it is": Case(SHORT)}
    for factor in (0.1, 10.0, 100.0):
        found[f"contact stiffness x {factor:g}"] = with_stiffness(factor)
    for factor in (0.1, 10.0, 100.0):
        found[f"E x {factor:g}"] = scaled("youngs_modulus", factor, "leaflet")
    found["thickness x 0.5"] = scaled("thickness", 0.5, "leaflet")
    found["pressure x 10"] = Case(replace(SHORT, systolic=10.0 * SHORT.systolic, diastolic=10.0 * SHORT.diastolic))
    found["dt x 4"] = Case(SHORT, 4.0)
    found["massless shell"] = scaled("rho_s", 1e-9)
    found["mu x 0.01"] = scaled("mu", 0.01)
    return found


@dataclass
class Outcome:
    """What a case did; ``fsi`` is its last accepted state, ``rows`` are opening areas and smallest distances."""

    fsi: CouDALFISh
    preset: str
    solves: Solves
    rows: list[tuple[float, float]]
    reports: list[Any]
    result: str = "ran"
    message: str = "-"
    cuts: int = 0
    mumps: int = 0
    piercings: int = 0
    cpu_s: float = 0.0

    @property
    def is_finite(self) -> bool:
        """Whether the last accepted state and all that was recorded is finite."""
        fsi = self.fsi
        fields = (fsi.timeInt_f.x_old, fsi.timeInt_f.xdot_old, fsi.timeInt_sh.x_old, fsi.timeInt_sh.xdot_old)
        arrays = [*(f.x.array for f in fields), fsi.lam, np.array(self.rows)]
        return all(bool(np.isfinite(array).all()) for array in arrays)

    @property
    def closing_ratio(self) -> float:
        """Largest approach of two points in a step, relative to the range of contact."""
        return max((report.contact.closing_ratio for report in self.reports), default=0.0)

    def cells(self, name: str) -> list[str]:
        """A line of the table."""
        if not self.rows:
            return [name, self.preset, self.result, *["-"] * (len(HEADER) - 4), self.message]
        passes = [report.passes for report in self.reports]
        openings, distances = np.transpose(self.rows)
        numbers = (
            openings.max(),
            openings[-1],
            distances.min() / self.fsi.contactContext_sh.kernel.r_max,
            self.piercings,
            self.closing_ratio,
            max(report.slip_ratio for report in self.reports),
        )
        shown, linear = (f"{number:.3g}" for number in numbers), self.solves.iterations
        more = sum(report.attempts > 1 for report in self.reports)
        return [name, self.preset, self.result, str(self.cuts), f"{np.mean(passes):.1f}/{max(passes)}",
                f"{np.mean(linear):.1f}/{max(linear)}", f"{self.solves.failed}, {self.mumps}", str(more),
                f"{self.cpu_s:.0f}", *shown, self.message]  # fmt: skip


def run(
    case: Case,
    *,
    until: float = UNTIL,
    resolution: int = RESOLUTION,
    options: CouplingOptions | None = None,
    preset: Any = "plain",
) -> Outcome:
    """Run a case until it ends or a step fails for good; every tenth step is looked at for leaflets that cross."""
    dt = case.dt_factor * DT
    elements = ELEMENTS if resolution <= RESOLUTION else 0
    scene = demo.Valve(resolution=resolution, leaflet_elements=elements, dt=dt, preset=preset)
    _, shell, fsi = scene.build(case.data, options)
    leaflets, watch = Leaflets(shell), Stopwatch()
    outcome = Outcome(fsi, preset, Solves(fsi), [], [])
    for n in range(1, round(until / dt) + 1):
        try:
            with watch, Fallbacks() as fallbacks:
                reports = advance(fsi, dt, halvings=4)
        except StepError as error:
            outcome.result, outcome.message = f"stopped at t = {fsi.timeInt_f.time:.4g}", str(error)
            break
        finally:
            outcome.mumps += fallbacks.count
        outcome.reports += reports
        outcome.cuts += len(reports) - 1
        outcome.rows.append((leaflets.opening(), min(reports[-1].contact.distance, shell.contact.kernel.r_max)))
        if n % 10 == 0:
            outcome.piercings = max(outcome.piercings, shell.piercings())
    outcome.cpu_s = watch.cpu_s
    return outcome


def main(
    only: str = "",
    presets: str = "plain,jump",
    resolution: int = RESOLUTION,
    until: float = UNTIL,
    out: Path = Path("results/benchmarks/valve_extremes"),
) -> dict[str, Any]:
    """Run the stiff and extreme cases of the heart valve and print a table.

    Args:
        only: a part of the names of the cases to run; empty: all.
        presets: of the valve, separated by commas.
        resolution: cells across the aorta; leaflets suit them where they are more than the default.
        until: end of every run.
        out: folder of the results.

    Returns:
        The summary.
    """
    script.set_up_logging(logging.ERROR)
    rows = []
    for name, case in cases().items():
        for preset in presets.split(",") if only in name else ():
            outcome = run(case, until=until, resolution=resolution, preset=preset)
            rows.append([*outcome.cells(name), "finite" if outcome.is_finite else "NOT FINITE"])
            print(" | ".join(rows[-1]), flush=True)
    lines = [HEADER, ["---"] * len(HEADER), *(row[:-1] for row in rows)]
    table = "\n".join(f"| {' | '.join(cell.replace('|', '/') for cell in line)} |" for line in lines)
    out.mkdir(parents=True, exist_ok=True)
    (out / "valve_extremes.md").write_text(table + "\n")
    finite = all(row[-1] == "finite" for row in rows)
    inputs = {"presets": presets, "resolution": resolution, "until": until}
    return write_summary(out, "valve_extremes", inputs, rows=rows, all_finite=bool(finite))


if __name__ == "__main__":
    script.command_line(main)
