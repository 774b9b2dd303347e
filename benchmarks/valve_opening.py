"""CPU time of a step of the opening heart valve, "jump" relative to plain fields, and of placing the leaflets in it.

Both runs take their steps in turn in one process, so that what else the machine does touches both.
"""

import logging
from pathlib import Path
from typing import Any

from load import load_demo

from coudalfish import CouDALFISh
from tigar_x.run import script
from tigar_x.run.progress import Stopwatch
from tigar_x.run.summary import table, write_summary

demo = load_demo("heart_valve")
PRESETS = ("plain", "jump")


def opening(resolution: int, steps: int, before: int) -> dict[str, Any]:
    """Steps of both presets at one resolution.

    Args:
        resolution: cells of the fluid across the aorta.
        steps: steps that are timed.
        before: steps that are taken first.

    Returns:
        Cells, CPU seconds of a step of each preset, and of placing the leaflets in it.
    """
    runs: dict[str, CouDALFISh] = {}
    for preset in PRESETS:
        flow, _, runs[preset] = demo.Valve(resolution=resolution, preset=preset).build(demo.Data())
    for _ in range(before):
        for fsi in runs.values():
            fsi.takeStep()
    watches, placing = {preset: Stopwatch() for preset in PRESETS}, Stopwatch()
    place = runs["jump"].fluid.place

    def watched(*arguments: Any, **named: Any) -> Any:
        with placing:
            return place(*arguments, **named)

    runs["jump"].fluid.place = watched  # type: ignore[method-assign]
    for _ in range(steps):
        for preset, fsi in runs.items():
            with watches[preset]:
                fsi.takeStep()
    seconds = {preset: watch.cpu_s / steps for preset, watch in watches.items()}
    return {"cells": flow.mesh.size, **seconds, "placing": placing.cpu_s / steps}


def main(
    resolutions: str = "12,16,20",
    steps: int = 20,
    before: int = 10,
    out: Path = Path("results/benchmarks"),
) -> dict[str, Any]:
    """Compare the presets "plain" and "jump" while the heart valve opens.

    Args:
        resolutions: cells across the aorta, separated by commas.
        steps: steps that are timed of each preset.
        before: steps that are taken first.
        out: folder of the results.

    Returns:
        Milliseconds of a step on average, and of placing, and how often the former is the latter.
    """
    logging.getLogger("coudalfish").setLevel(logging.ERROR)
    found = [opening(int(n), steps, before) for n in resolutions.split(",")]
    means = {preset: [1e3 * one[preset] for one in found] for preset in PRESETS}
    ratios = [one["jump"] / one["plain"] for one in found]
    cells, placing = [one["cells"] for one in found], [1e3 * one["placing"] for one in found]
    heads = ("cells", "plain [ms]", "jump [ms]", "ratio", "of it placing [ms]")
    print(table(heads, list(zip(cells, means["plain"], means["jump"], ratios, placing, strict=True))))
    inputs = {"resolutions": resolutions, "steps": steps, "before": before}
    name = "valve_opening"
    return write_summary(out / name, name, inputs, cells=cells, step_ms=means, ratios=ratios, placing_ms=placing)


if __name__ == "__main__":
    script.command_line(main)
