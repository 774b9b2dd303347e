"""Linear iterations and time of the fluid's solves of an opening or closed heart valve, by recipe, ranks and size.

The runs of all recipes take their steps in turn in one process, so that ratios of their CPU seconds, of the slowest
rank, are those of one machine at one time. With fields that jump, a solve is one of flow, shell and multiplier
together. At the end every recipe solves the first system of another step of the first run, and its pressure at the
nodes of the band, where there is one, is compared with that of MUMPS.
"""

import json
import logging
import time
from collections.abc import Callable
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
NAMES = ("preset", "state", "cells", "ranks", "recipe", "solves", "mean", "largest", "failed", "mumps", "attempts")
COLUMNS = (*NAMES, "solve_ms", "ratio", "error_p", "most_rss_mib")


def recipes(names: str, keep: bool = True) -> dict[str, LinearSolver | None]:
    """Linear solvers by name, as "ilu2", with one level, or "two1"; the number is that of levels of fill.

    "demo" is None, for what the demo chooses. Others keep a preconditioner for further solves, or make each a new one.
    """
    kinds, common = {"ilu": gmres_ilu, "two": two_level}, {"rtol": 1e-5, "fallback": direct()}
    common["rebuild_growth"] = 1.5 if keep else None
    return {n: None if n == "demo" else kinds[n[:3]](int(n[3:]), **common) for n in names.split(",")}


class Fallbacks(logging.Handler):
    """Counts the solves that another recipe has to take over meanwhile, by their warnings."""

    LOG = logging.getLogger("tigar_x.fem.linear")

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.count = 0

    def __enter__(self) -> "Fallbacks":
        self.LOG.setLevel(logging.WARNING)
        self.LOG.addHandler(self)
        return self

    def __exit__(self, *error: object) -> None:
        self.LOG.removeHandler(self)

    def emit(self, record: logging.LogRecord) -> None:
        """One more."""
        self.count += "using" in str(record.msg)


class Solves:
    """Seconds and iterations of a coupled run's solves for its flow, and how many failed.

    One that fails with factors of a former matrix is repeated with new ones; what then needs MUMPS or another attempt
    at the step, is told by the run.

    Args:
        fsi: the run; with a converged multiplier solves are those of the condensed system.
    """

    def __init__(self, fsi: Any) -> None:
        self.seconds, self.iterations, self.failed = 0.0, [], 0
        system, method = fsi.fluid.system, fsi.attempts[0].method
        if hasattr(method, "prepared"):
            prepared = self._timed(method.prepared)

            def watched(at: Any) -> Any:
                found = prepared(at)
                if "solve" not in vars(found):
                    found.solve = self._counted(found, found.solve)
                return found

            method.prepared = watched
            system.served = self._noted(system.served)
        else:
            system.solve = self._counted(system, system.solve)
            system._solver.served = self._noted(system._solver.served)

    def _noted(self, served: Callable[[float], None]) -> Callable[[float], None]:
        def noted(iterations: float) -> None:
            self.failed += int(np.isinf(iterations))
            served(iterations)

        return noted

    def _timed(self, work: Callable[..., Any]) -> Callable[..., Any]:
        def timed(*arguments: Any) -> Any:
            start = time.process_time()
            try:
                return work(*arguments)
            finally:
                self.seconds += time.process_time() - start

        return timed

    def _counted(self, system: Any, solve: Callable[..., Any]) -> Callable[..., Any]:
        timed = self._timed(solve)

        def counted(*arguments: Any) -> Any:
            try:
                return timed(*arguments)
            finally:
                self.iterations.append(system.iterations)

        return counted


def pressure_errors(fsi: Any, chosen: dict[str, LinearSolver | None]) -> list[float]:
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
            every = (recipe or system.recipe for recipe in chosen.values())
            found.extend(norm(pressure(recipe) - exact) / norm(exact) for recipe in every)
        return solve(*arguments)

    system.solve = first
    fsi.takeStep()
    return found


def measure(
    resolution: int, preset: str, closed: bool, steps: int, names: str, errors: bool, keep: bool
) -> list[dict[str, Any]]:
    """Runs on the ranks of this process."""
    logging.getLogger("coudalfish").setLevel(logging.ERROR)
    demo, comm, chosen = load_demo("heart_valve"), MPI.COMM_WORLD, recipes(names, keep)
    data = demo.Data(systolic=-1e5) if closed else demo.Data()
    valve = demo.Valve(resolution=resolution, preset=preset)
    runs, watched, cells = [], [], 0
    for recipe in chosen.values():
        flow, _, fsi = valve.build(data, solver=recipe)
        runs.append(fsi)
        watched.append(Solves(fsi))
        cells = flow.mesh.size
    attempts, taken_over = [0] * len(runs), [0] * len(runs)
    for _ in range(steps):
        for k, fsi in enumerate(runs):
            with Fallbacks() as fallbacks:
                attempts[k] = max(attempts[k], fsi.takeStep().attempts)
            taken_over[k] += fallbacks.count
    seconds = [comm.allreduce(each.seconds, op=MPI.MAX) / steps for each in watched]
    found = pressure_errors(runs[0], chosen) if errors else [0.0] * len(chosen)
    memory = comm.allreduce(peak_rss_mib(), op=MPI.MAX)
    rows = []
    for k, (name, each) in enumerate(zip(chosen, watched, strict=True)):
        counts = each.iterations
        where = (preset, "closed" if closed else "opening", cells, comm.size, name)
        numbers = (len(counts), float(np.mean(counts)), max(counts), each.failed, taken_over[k], attempts[k])
        costs = (1e3 * seconds[k], seconds[k] / seconds[0], found[k], memory)
        rows.append(dict(zip(COLUMNS, (*where, *numbers, *costs), strict=True)))
    return rows


def main(
    ranks: str = "1,2,4,8,16",
    resolutions: str = "20",
    presets: str = "plain",
    states: str = "opening,closed",
    steps: int = 20,
    solvers: str = "demo",
    errors: bool = False,
    keep: bool = True,
    out: Path = Path("results/benchmarks/solvers"),
    worker: str | None = None,
) -> None:
    """Measure the fluid's solves of the heart valve.

    Memory is that of the rank that has most, with the runs of all recipes.

    Args:
        ranks: numbers of ranks, separated by commas.
        resolutions: cells across the aorta, separated by commas.
        presets: of the valve, separated by commas.
        states: opening, closed or both.
        steps: of every run.
        solvers: recipes with one level (ilu) or two, and their levels of fill, as ilu2,two1; ratios are those to the
            first one. "demo" is the demo's own.
        errors: whether to compare pressures with those of MUMPS; of presets with a band.
        keep: whether a preconditioner of these serves several solves; the demo's own always may.
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
                    arguments = resolution, preset, state == "closed", steps, solvers, errors, keep
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
