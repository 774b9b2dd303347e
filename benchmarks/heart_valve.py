"""What a step of the heart valve costs: against the published code, by its parts, by size and by ranks."""

import cProfile
import logging
import pstats
from pathlib import Path
from typing import Any

from breakdown import shares
from calibrate import calibrate, legacy_speed
from load import legacy_valve, load_demo, on_ranks, tell

from tigar_x.run import script
from tigar_x.run.progress import Stopwatch, peak_rss_mib, rss_mib
from tigar_x.run.summary import table, write_summary

HERE = Path(__file__).resolve()
WARM_UP = 10


def measure(resolution: int, elements: int, preset: str, steps: int, *, profiled: bool) -> dict[str, Any]:
    """Costs of steps of the valve that opens, on the ranks of this run."""
    demo = load_demo("heart_valve")
    logging.getLogger().setLevel(logging.ERROR)
    scene = demo.Valve(resolution=resolution, leaflet_elements=elements, preset=preset)
    flow, shell, fsi = scene.build(demo.Data())
    for _ in range(WARM_UP):
        fsi.takeStep()
    before, watch = rss_mib(), Stopwatch()
    with watch:
        reports = [fsi.takeStep() for _ in range(steps)]
    after = rss_mib()
    found = {
        "preset": preset,
        "cells": flow.mesh.size,
        "dofs_fluid": flow.unknowns,
        "nodes_shell": len(shell.positions),
        "passes_mean": sum(report.passes for report in reports) / steps,
        "linear_iterations_mean": sum(report.linear_iterations for report in reports) / steps,
        "cpu_s_per_step": watch.cpu_s / steps,
        "wall_s_per_step": watch.wall_s / steps,
        "growth_mib_per_step": (after - before) / steps,
        "peak_rss_mib": peak_rss_mib(),
    }
    if profiled:
        profile = cProfile.Profile()
        profile.enable()
        for _ in range(min(steps, 20)):
            fsi.takeStep()
        profile.disable()
        found["shares"] = shares(pstats.Stats(profile))
    return found


def run(ranks: int, resolution: int, elements: int, preset: str, steps: int) -> dict[str, Any]:
    """The same in processes of its own."""
    settings = ("--resolution", resolution, "--leaflet-elements", elements, "--presets", preset, "--steps", steps)
    return dict(on_ranks(ranks, HERE, "--worker", *settings))


def main(
    resolution: int = 20,
    leaflet_elements: int = 13,
    presets: str = "reference,plain",
    steps: int = 40,
    sweep: str = "8,12,16,20,26",
    ranks: str = "1,2",
    out: Path = Path("results/benchmarks/heart_valve"),
    worker: bool = False,
) -> dict[str, Any]:
    """Measure steps of the heart valve.

    Args:
        resolution: of the comparison, cells of the fluid across the aorta.
        leaflet_elements: of the comparison, from post to post; 0: by resolution.
        presets: those compared, separated by commas.
        steps: that are measured.
        sweep: resolutions of the sweep with the plain preset, with the leaflets of the comparison; empty: none.
        ranks: numbers of ranks, with the plain preset; empty: none.
        out: folder of the results.
        worker: measure the first preset on the ranks of this run and print the result.

    Returns:
        The summary; empty in a worker.
    """
    names = presets.split(",")
    if worker:
        tell(measure(resolution, leaflet_elements, names[0], steps, profiled=False))
        return {}
    index, published = legacy_speed(calibrate()), legacy_valve("heart_valve")
    compared = [measure(resolution, leaflet_elements, name, steps, profiled=True) for name in names]
    cost = published["cpu_s_per_step"]
    first = (published["cells"], published["nodes_shell"], published["passes_mean"], "-", cost, cost, "-")
    rows = [("published code", *first, published["growth_mib_per_step"])]
    for found in compared:
        scaled = found["scaled_cpu_s_per_step"] = found["cpu_s_per_step"] * index
        found["ratio"] = cost / scaled
        rows.append((found["preset"], found["cells"], found["nodes_shell"], found["passes_mean"],
                     found["linear_iterations_mean"], found["cpu_s_per_step"], scaled, found["ratio"],
                     found["growth_mib_per_step"]))  # fmt: skip
    print(f"speed of this machine by that of the published figures: {index:.3g}")
    header = ("what", "cells", "points", "passes", "linear", "CPU s/step", "scaled", "ratio", "MiB/step")
    print(table(header, rows))
    parts = compared[0]["shares"]
    print(table(("part of a step [%]", *names), [(p, *(100 * f["shares"][p] for f in compared)) for p in parts]))
    sizes = [run(1, int(r), leaflet_elements, "plain", steps) for r in sweep.split(",") if r]
    columns = ("cells", "dofs_fluid", "passes_mean", "linear_iterations_mean", "cpu_s_per_step", "peak_rss_mib")
    if sizes:
        print(table(columns, [[size[key] for key in columns] for size in sizes]))
    parallel = {n: run(int(n), resolution, leaflet_elements, "plain", steps) for n in ranks.split(",") if n}
    if parallel:
        keys = ("wall_s_per_step", "cpu_s_per_step", "passes_mean", "linear_iterations_mean")
        print(table(("ranks", *keys), [(n, *(found[key] for key in keys)) for n, found in parallel.items()]))
    return write_summary(
        out, "heart_valve", {"steps": steps}, speed=index, compared=compared, sweep=sizes, ranks=parallel
    )


if __name__ == "__main__":
    script.command_line(main)
