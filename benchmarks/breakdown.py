"""Where the time of a step goes: shares of assembly, solve, shell and coupling, by Python's profiler."""

import cProfile
import logging
import pstats
from pathlib import Path
from typing import Any, Literal

from load import load_demo

from coudalfish import CouplingOptions
from coudalfish.problems import manufactured as problem
from tigar_x.run import script
from tigar_x.run.progress import Stopwatch, peak_rss_mib
from tigar_x.run.summary import table, write_summary

demo = load_demo("manufactured")

# Cumulative times of (file, function); what a function does inside another one of the table is taken from that one.
FLUID, STEP = "coudalfish/sides/fluid.py", "coudalfish/step/attempt.py"
PARTS = {
    "fluid: assembly": [(FLUID, "assemble_residual"), (FLUID, "assemble_tangent")],
    "fluid: linear solve": [(FLUID, "solve")],
    "coupling: location, B, band": [
        ("coudalfish/surface/trace.py", "locate"),
        ("coudalfish/surface/trace.py", "trace_matrix"),
        ("coudalfish/surface/band.py", "update"),
    ],
    "coupling: forces and tangent": [
        (FLUID, "load"),
        (FLUID, "add"),
        (FLUID, "velocity_at"),
        (STEP, "forces"),
        ("coudalfish/surface/exchange.py", "lumped_tangent"),
        ("coudalfish/surface/exchange.py", "consistent_tangent"),
    ],
    "coupling: normals, multiplier, monitors": [("coudalfish/surface/sheets.py", "__call__"), (STEP, "_finish")],
    "acceptance test": [(STEP, "_accepted")],
    "shell": [(STEP, "shell_residual"), (STEP, "solve_shell")],
}


def cumulative(stats: pstats.Stats, file: str, function: str, caller: str | None = None) -> float:
    """Cumulative seconds of a function, over all callers or those of one name."""
    total = 0.0
    for (path, _, name), (_, _, _, time, callers) in stats.stats.items():  # type: ignore[attr-defined]
        if name == function and Path(path).as_posix().endswith(file):
            if caller is None:
                total += time
            else:
                total += sum(entry[3] for (_, _, other), entry in callers.items() if other == caller)
    return total


def shares(stats: pstats.Stats) -> dict[str, float]:
    """Share of every part in a step.

    Raises:
        ValueError: nothing is found of a part: its functions have other names.
    """
    whole = cumulative(stats, "coudalfish/coupler.py", "takeStep")
    seconds = {part: sum(cumulative(stats, *place) for place in places) for part, places in PARTS.items()}
    seconds["fluid: assembly"] -= cumulative(stats, FLUID, "load") + cumulative(stats, FLUID, "add")
    seconds["acceptance test"] -= cumulative(stats, STEP, "forces", "_accepted")
    seconds["shell"] -= cumulative(stats, STEP, "forces", "<lambda>")  # of the shell's residual
    missing = [part for part, value in seconds.items() if value <= 0.0]
    if missing:
        raise ValueError(f"PARTS: nothing is found of {', '.join(missing)}")
    seconds["the rest"] = whole - sum(seconds.values())
    return {part: value / whole for part, value in seconds.items()}


def main(
    dim: Literal[2, 3] = 2,
    level: int = 5,
    preset: Literal["reference", "plain"] = "plain",
    steps: int = 20,
    out: Path = Path("results/benchmarks"),
) -> dict[str, Any]:
    """Profile some steps of the manufactured fluid-membrane problem.

    Args:
        dim: dimension of space, 2 or 3 (one layer).
        level: refinement level.
        preset: the published algorithm, or this library's with plain fields.
        steps: steps to profile, after one that is not.
        out: folder of the results.

    Returns:
        CPU seconds per step, without the profiler, and the shares.
    """
    logging.getLogger("coudalfish").setLevel(logging.ERROR)
    reference = preset == "reference"
    options = CouplingOptions.reference() if reference else CouplingOptions()
    whole = 2 * problem.cells_per_side(level)
    *_, fsi = demo.build(dim, level, whole, options, projected=reference, data=problem.ProblemData())
    fsi.takeStep()
    watch, profile = Stopwatch(), cProfile.Profile()
    with watch:
        for _ in range(steps):
            fsi.takeStep()
    profile.enable()
    for _ in range(steps):
        fsi.takeStep()
    profile.disable()
    parts = shares(pstats.Stats(profile))
    per_step = watch.cpu_s / steps
    print(f"{dim}D level {level} {preset}: {per_step:.4f} CPU s per step, peak {peak_rss_mib():.0f} MiB")
    print(table(("part", "% of a step"), [(part, 100.0 * share) for part, share in parts.items()]))
    coupling = sum(share for part, share in parts.items() if part.startswith("coupling"))
    print(f"coupling in all: {100 * coupling:.1f} %")
    name = f"breakdown-{dim}d-{level}-{preset}"
    return write_summary(out / name, name, {"steps": steps}, cpu_s_per_step=per_step, shares=parts)


if __name__ == "__main__":
    script.command_line(main)
