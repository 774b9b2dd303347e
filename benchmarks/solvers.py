"""Linear iterations and time of the fluid's solves of an opening or closed heart valve, by recipe, ranks and size.

The runs of all recipes take their steps in turn in one process, so that ratios of their CPU seconds, of the slowest
rank, are those of one machine at one time. At the end every recipe solves the first system of another step of the
first run, and its pressure at the nodes of the band is compared with that of MUMPS.
"""

import json
import time
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI
from load import load_demo, on_ranks, tell

from tigar_x.fem.linear import LinearSolver, PreparedSolver, direct, gmres_ilu, two_level
from tigar_x.run import script
from tigar_x.run.progress import peak_rss_mib
from tigar_x.run.summary import table, write_summary

HERE = Path(__file__).resolve()
NAMES = ("preset", "state", "cells", "ranks", "recipe", "solves", "mean", "largest", "failed", "solve_ms", "ratio")
COLUMNS = (*NAMES, "error_p", "peak_rss_mib")


def recipes(names: str) -> dict[str, LinearSolver]:
    """Linear solvers by name, as "ilu2", with one level, or "two1"; the number is that of levels of fill."""
    kinds, common = {"ilu": gmres_ilu, "two": two_level}, {"rtol": 1e-5, "rebuild_growth": 1.5, "fallback": direct()}
    return {name: kinds[name[:3]](int(name[3:]), **common) for name in names.split(",")}


class Solves:
    """Seconds and iterations of a system's solves, and how many needed a fallback."""

    def __init__(self, system: Any) -> None:
        self.seconds, self.iterations, self.failed = 0.0, [], 0
        self._system, self._solve, self._served = system, system.solve, system._solver.served
        system.solve, system._solver.served = self._timed, self._noted

    def _noted(self, iterations: float) -> None:
        self.failed += int(np.isinf(iterations))
        self._served(iterations)

    def _timed(self, *arguments: Any) -> Any:
        start = time.process_time()
        try:
            return self._solve(*arguments)
        finally:
            self.seconds += time.process_time() - start
            self.iterations.append(self._system.iterations)


def pressure_errors(fsi: Any, chosen: dict[str, LinearSolver]) -> list[float]:
    """Errors of the increment of the pressure in the band relative to MUMPS, by recipe."""
    system, V = fsi.fluid.system, fsi.fluid.timeInt.x.function_space
    own, size = V.dofmap.index_map.size_local, V.dofmap.index_map_bs
    nodes, found, solve = system.nodes_of_rows(), [], system.solve

    def pressure(recipe: LinearSolver) -> Any:
        x = system.b.duplicate()
        PreparedSolver(recipe, system.A, nodes).solve(system.b, x)
        return x.array_r.reshape(-1, size)[fsi.fluid.band.surrounded(V)[:own], -1]

    def norm(p: Any) -> float:
        return float(np.sqrt(fsi.fluid.comm.allreduce(float(p @ p))))

    def first(*arguments: Any) -> Any:
        if not found:
            exact = pressure(direct())
            found.extend(norm(pressure(recipe) - exact) / norm(exact) for recipe in chosen.values())
        return solve(*arguments)

    system.solve = first
    fsi.takeStep()
    return found


def measure(resolution: int, preset: str, closed: bool, steps: int, names: str, errors: bool) -> list[dict[str, Any]]:
    """Runs on the ranks of this process."""
    demo, comm, chosen = load_demo("heart_valve"), MPI.COMM_WORLD, recipes(names)
    data = demo.Data(systolic=-1e5) if closed else demo.Data()
    valve = demo.Valve(resolution=resolution, preset=preset)
    runs, watched, cells = [], [], 0
    for recipe in chosen.values():
        flow, _, fsi = valve.build(data, solver=recipe)
        runs.append(fsi)
        watched.append(Solves(fsi.fluid.system))
        cells = flow.mesh.size
    for _ in range(steps):
        for fsi in runs:
            fsi.takeStep()
    seconds = [comm.allreduce(each.seconds, op=MPI.MAX) / steps for each in watched]
    found = pressure_errors(runs[0], chosen) if errors else [0.0] * len(chosen)
    memory = comm.allreduce(peak_rss_mib(), op=MPI.SUM)
    rows = []
    for name, each, share, error in zip(chosen, watched, seconds, found, strict=True):
        counts = each.iterations
        where = (preset, "closed" if closed else "opening", cells, comm.size, name)
        numbers = (len(counts), float(np.mean(counts)), max(counts), each.failed, 1e3 * share, share / seconds[0])
        rows.append(dict(zip(COLUMNS, (*where, *numbers, error, memory), strict=True)))
    return rows


def main(
    ranks: str = "1,2,4,8,16",
    resolutions: str = "20",
    presets: str = "plain",
    states: str = "opening,closed",
    steps: int = 20,
    solvers: str = "ilu2,two1",
    errors: bool = False,
    out: Path = Path("results/benchmarks/solvers"),
    worker: str | None = None,
) -> None:
    """Measure the fluid's solves of the heart valve.

    Args:
        ranks: numbers of ranks, separated by commas.
        resolutions: cells across the aorta, separated by commas.
        presets: of the valve whose fluid has a band: plain, reference.
        states: opening, closed or both.
        steps: of every run.
        solvers: recipes with one level (ilu) or two, and their levels of fill; ratios are those to the first one.
        errors: whether to compare pressures with those of MUMPS.
        out: folder of the results.
        worker: one run as JSON, on the ranks of this process, instead of all.
    """
    if worker:
        tell(measure(*json.loads(worker)))
        return
    rows: list[dict[str, Any]] = []
    for preset in presets.split(","):
        for state in states.split(","):
            for resolution in map(int, resolutions.split(",")):
                for count in map(int, ranks.split(",")):
                    arguments = resolution, preset, state == "closed", steps, solvers, errors
                    rows += on_ranks(count, HERE, "--worker", json.dumps(arguments))
                    print(
                        table(COLUMNS, [[r[c] for c in COLUMNS] for r in rows[-len(solvers.split(",")) :]]), flush=True
                    )
    text = table(COLUMNS, [[r[c] for c in COLUMNS] for r in rows])
    print(text)
    write_summary(out, "solvers", {"presets": presets, "states": states, "steps": steps}, runs=rows)
    (out / "table.txt").write_text(text + "\n")


if __name__ == "__main__":
    script.command_line(main)
