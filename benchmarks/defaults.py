"""Why the defaults of plain fields are what they are: a table per choice, on the manufactured fluid-membrane problem.

What hard steps get (acceleration, a second attempt, many passes) is tried with penalties far above the guideline mu/h,
the absolute tolerance in a duct under a steady load, see ``stability.duct``. CPU seconds of one process; within a table
they may be compared, as the runs follow each other directly.
"""

import csv
import logging
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from load import load_demo
from stability_runs import through_duct
from stability_scenes import duct

from coudalfish import CouplingOptions, PenaltyRule, StepError
from coudalfish.problems import manufactured as problem
from tigar_x.fem.linear import LinearSolver, direct, gmres_ilu
from tigar_x.run import script
from tigar_x.run.progress import Stopwatch

demo = load_demo("manufactured")

HEADER = ("setting", "steps", "passes", "linear", "CPU s", "L2 u", "H1 u", "L2 p", "L2 y")
STEADY_HEADER = ("setting", "steps", "passes", "CPU s", "slip rms")
PLAIN = CouplingOptions()
ILU = gmres_ilu(1)
MULTIPLIER_DATA: dict[str, dict[str, float]] = {
    "": {},
    ", dt x 4": {"dt_factor": 4.0},
    ", jump 30": {"DP": 30.0},
    ", mu = 1e-3": {"mu": 1e-3},
}
Study = tuple[str, list[tuple[Any, ...]]]


def run(
    setting: str,
    options: CouplingOptions = PLAIN,
    solver: LinearSolver = ILU,
    *,
    level: int,
    dt_factor: float = 1.0,
    projected: bool = False,
    **data: float,
) -> tuple[Any, ...]:
    """One row: what it cost and its errors (degree-8 quadrature), or why it failed."""
    chosen = replace(problem.ProblemData(), **data)
    steps = max(1, round(2 * problem.cells_per_side(level) / dt_factor))
    *_, fsi = demo.build(2, level, steps, options, solver, projected=projected, data=chosen)
    watch, reports = Stopwatch(), []
    try:
        with watch:
            for _ in range(steps):
                reports.append(fsi.takeStep())
    except StepError as error:
        return (setting, len(reports), *["-"] * 6, f"failed: {error}")
    errors = problem.errors(fsi, chosen, chosen.T, 8)
    passes, linear = sum(r.passes for r in reports), sum(r.linear_iterations for r in reports)
    return (setting, steps, passes, linear, watch.cpu_s, *(errors[n] for n in ("L2_u", "H1_u", "L2_p", "L2_y")))


def hard(C: float, **options: Any) -> tuple[Any, ...]:
    """One row: a penalty of C mu/h and what steps get that need many passes; level 3, dt x 4."""
    data = problem.ProblemData()
    mu_h = data.mu * problem.cells_per_side(3) / data.L
    name = ", ".join([f"C {C:g}", *(f"{key} {value}" for key, value in options.items())])
    return run(name, replace(PLAIN, penalty=C * mu_h, **options), level=3, dt_factor=4)


def steady(block_atol: float, *, steps: int = 600) -> tuple[Any, ...]:
    """One row: a duct with a sheet across it after its load has been raised; passes, CPU seconds and slip."""
    scene = duct(CouplingOptions(penalty=50.0, block_atol=block_atol), n=4, jump=0.0)
    through_duct(scene, 100, ramp=60)
    watch = Stopwatch()
    with watch:
        reports = [scene.fsi.takeStep() for _ in range(steps)]
    last = reports[-1].monitors
    return f"block_atol {block_atol:g}", steps, sum(r.passes for r in reports), watch.cpu_s, last.normal_slip_rms


def hard_steps() -> Iterator[Study]:
    """Tables of what only steps with many passes notice."""
    yield "acceleration, level 3, dt x 4", [hard(C, acceleration=a) for C in (10, 100, 1000) for a in (0, 1, 2, 5, 10)]
    yield (
        "accelerate_after, level 3, dt x 4",
        [hard(C, accelerate_after=n) for C in (10, 100, 1000) for n in (0, 3, 6, 12, 24)],
    )
    yield "max_passes, level 3, dt x 4", [hard(C, max_passes=n) for C in (1e3, 3e3, 1e4) for n in (20, 50, 100, 200)]
    yield (
        "second_attempt, level 3, dt x 4",
        [hard(C, second_attempt=s, acceleration=a) for C in (1e3, 1e4) for a in (5, 0) for s in (True, False)],
    )


def studies() -> Iterator[Study]:
    """All tables on the manufactured problem: title and rows."""
    yield (
        "presets, level 4",
        [
            run("reference", CouplingOptions.reference(), level=4, projected=True),
            run("plain", level=4),
            run("plain, dt x 2", level=4, dt_factor=2),
        ],
    )
    yield (
        "penalty C_1 and scale_c, level 4",
        [
            run(f"C_1 {C_1}, scale_c {s}", replace(PLAIN, penalty=PenaltyRule(C_1, 0.5), scale_c=s), level=4)
            for C_1 in (1.0, 2.0, 4.0, 8.0)
            for s in (0.1, 0.02, 0.01, 0.001)
        ],
    )
    yield (
        "scale_c under a pressure jump of 30, level 4",
        [run(f"scale_c {s}", replace(PLAIN, scale_c=s), level=4, DP=30.0) for s in (0.1, 0.02, 0.01, 0.001)],
    )
    yield (
        "scale_m, level 4",
        [run(f"scale_m {s}", replace(PLAIN, scale_m=s), level=4) for s in (1.0, 0.1, 1e-2, 1e-3, 1e-4)],
    )
    yield (
        "penalty C_2 at low viscosity (mu = 1e-3), level 4",
        [
            run(f"C_2 {C_2}", replace(PLAIN, penalty=PenaltyRule(2.0, C_2)), level=4, mu=1e-3)
            for C_2 in (0.0, 0.1, 0.5, 2.0)
        ],
    )
    yield (
        "multiplier, level 4",
        [
            run(name + change, options, level=4, **data)
            for change, data in MULTIPLIER_DATA.items()
            for name, options in (("lagged", PLAIN), ("converged", CouplingOptions.converged()))
        ],
    )
    yield (
        "block tolerance and fluid tangent, level 4, dt x 4",
        [
            run(f"{t}, block_rtol {r:g}", replace(PLAIN, fluid_tangent=t, block_rtol=r), level=4, dt_factor=4)
            for t in ("lumped", "consistent")
            for r in (1e-1, 1e-2, 1e-3, 1e-5)
        ],
    )
    yield (
        "normal, tangent update and stopping, level 4, dt x 4",
        [
            run("plain", level=4, dt_factor=4),
            run("normal of the iterate", replace(PLAIN, normal="iterate"), level=4, dt_factor=4),
            run("tangent in every pass", replace(PLAIN, tangent_update="pass"), level=4, dt_factor=4),
            run(
                "published stopping, 1e-3",
                replace(PLAIN, stopping="published", block_rtol=1e-3),
                level=4,
                dt_factor=4,
            ),
        ],
    )
    for level in (4, 5):
        yield (
            f"linear solver, level {level}, dt x 4",
            [
                run("MUMPS", PLAIN, direct(), level=level, dt_factor=4),
                *(
                    run(
                        f"GMRES, block ILU({k}), rtol {rtol:g}",
                        PLAIN,
                        gmres_ilu(k, rtol=rtol),
                        level=level,
                        dt_factor=4,
                    )
                    for k, rtol in ((0, 1e-8), (1, 1e-3), (1, 1e-6), (1, 1e-8), (2, 1e-8))
                ),
            ],
        )
    yield "time step, level 4", [run(f"dt x {f:g}", level=4, dt_factor=f) for f in (0.5, 1, 2, 4, 8, 16)]


def main(out: Path = Path("results/benchmarks"), hard_only: bool = False) -> None:
    """Run all studies; print them as Markdown and write them as CSV.

    Args:
        out: folder of the results.
        hard_only: only the studies of steps with many passes and of the absolute tolerance.
    """
    logging.getLogger("coudalfish").setLevel(logging.ERROR)
    out.mkdir(parents=True, exist_ok=True)
    with open(out / "defaults.csv", "w", newline="") as file:
        writer = csv.writer(file)
        for header, title, rows in tables(hard_only):
            print(f"\n**{title}**\n\n| {' | '.join(header)} |\n|{' --- |' * len(header)}")
            writer.writerow(("study", *header))
            for row in rows:
                print("| " + " | ".join(f"{c:.3g}" if isinstance(c, float) else str(c) for c in row) + " |", flush=True)
                writer.writerow((title, *row))


def tables(hard_only: bool) -> Iterator[tuple[tuple[str, ...], str, list[tuple[Any, ...]]]]:
    """Header, title and rows of each study."""
    for study in (hard_steps,) if hard_only else (studies, hard_steps):
        for title, rows in study():
            yield HEADER, title, rows
    rows = [steady(a) for a in (0.0, 1e-12, 1e-8, 1e-6, 1e-4)]
    yield STEADY_HEADER, "block_atol, 600 steps under a steady load", rows


if __name__ == "__main__":
    script.command_line(main)
