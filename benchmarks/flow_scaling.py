"""Iterations, time and memory of flow solves against the number of unknowns, by linear solver, on one and two ranks.

The flow is that in a square or cubic cavity whose lid moves, at Re = 100: steady, or unsteady with steps of a cell over
the lid's speed. Every run is a process of its own, or several of them; seconds are CPU seconds of the first rank.
"""

import json
import time
from pathlib import Path
from typing import Any

import numpy as np
import ufl
from mpi4py import MPI
from load import on_ranks, tell

from tigar_x.fem.linear import LinearSolver, direct, gmres_ilu, multigrid
from tigar_x.run import script
from tigar_x.run.progress import Stopwatch, peak_rss_mib
from tigar_x.run.summary import table, write_summary
from varmint.conditions import WeakVelocity
from varmint.flow import Flow, FlowOptions
from varmint.mesh import box

HERE = Path(__file__).resolve()
WALLS = {2: ("left", "right", "bottom"), 3: ("left", "right", "bottom", "back", "front")}
SIZES = {2: (64, 128, 256, 400, 577), 3: (16, 24, 32, 48)}
LIMITS = {
    ("gmres_ilu", 2): 128,
    ("direct", 3): 16,
}  # cells per side beyond which a recipe needs too much time or memory
NAMES = (
    "dim",
    "kind",
    "recipe",
    "elements",
    "ranks",
    "unknowns",
    "newton",
    "linear",
    "tangent_s",
    "solve_s",
    "total_s",
)
COLUMNS = (*NAMES, "wall_s", "peak_rss_mib")


def recipes(rtol: float, dim: int) -> dict[str, LinearSolver | None]:
    """Linear solvers by name; "automatic" is the library's choice, and "multigrid" as it chooses it."""
    aggressive = int(dim == 3 or MPI.COMM_WORLD.size == 1)
    return {
        "automatic": None,
        "direct": direct(),
        "gmres_ilu": gmres_ilu(1, rtol=rtol, max_iterations=400),
        "multigrid": multigrid(rtol=rtol, aggressive=aggressive),
    }


def lid(x: Any, t: Any) -> Any:
    """Velocity of a lid whose speed vanishes at its edges."""
    d = len(x)
    profile = 16.0 * x[0] ** 2 * (1 - x[0]) ** 2
    if d == 3:
        profile *= 16.0 * x[2] ** 2 * (1 - x[2]) ** 2
    return ufl.as_vector([profile] + [0.0] * (d - 1))


class Timed:
    """CPU seconds inside a method of an object, added up."""

    def __init__(self, thing: Any, name: str) -> None:
        self.seconds, self._call = 0.0, getattr(thing, name)
        setattr(thing, name, self)

    def __call__(self, *arguments: Any, **options: Any) -> Any:
        start = time.process_time()
        try:
            return self._call(*arguments, **options)
        finally:
            self.seconds += time.process_time() - start


def measure(dim: int, kind: str, recipe: str, n: int, steps: int) -> dict[str, Any]:
    """One run on the ranks of this process."""
    steady = kind == "steady"
    solver = recipes(1e-4 if steady else 1e-3, dim)[recipe]
    flow = Flow(
        box(MPI.COMM_WORLD, [0.0] * dim, [1.0] * dim, [n] * dim),
        [WeakVelocity(WALLS[dim]), WeakVelocity("top", lid)],
        rho=1.0,
        mu=0.01,
        dt=None if steady else 1.0 / n,
        options=FlowOptions(solver=solver, rtol=1e-8 if steady else None),
    )
    flow.compile()
    tangent, solve = Timed(flow.system, "assemble_tangent"), Timed(flow.system, "solve")
    watch = Stopwatch()
    with watch:
        reports = [flow.solve()] if steady else [flow.take_step() for _ in range(steps)]
    newton = sum(report.iterations for report in reports)
    return {
        "dim": dim,
        "kind": kind,
        "recipe": flow.recipe.name if recipe == "automatic" else recipe,
        "elements": n,
        "ranks": MPI.COMM_WORLD.size,
        "unknowns": flow.unknowns,
        "newton": newton / len(reports),
        "linear": sum(report.linear_iterations for report in reports) / max(newton, 1),
        "tangent_s": tangent.seconds / len(reports),
        "solve_s": solve.seconds / len(reports),
        "total_s": watch.cpu_s / len(reports),
        "wall_s": watch.wall_s / len(reports),
        "peak_rss_mib": MPI.COMM_WORLD.allreduce(peak_rss_mib(), op=MPI.SUM),
    }


def run(ranks: int, *arguments: Any) -> dict[str, Any]:
    """The same in processes of its own."""
    return dict(on_ranks(ranks, HERE, "--worker", json.dumps(arguments)))


def growth(rows: list[dict[str, Any]]) -> list[list[Any]]:
    """Exponents of the number of unknowns, over the three largest of every series on one rank."""
    table = []
    for key in sorted({(r["dim"], r["kind"], r["recipe"]) for r in rows}):
        mine = [r for r in rows if (r["dim"], r["kind"], r["recipe"]) == key and r["ranks"] == 1][-3:]
        if len(mine) == 3:
            n = np.log([r["unknowns"] for r in mine])
            slopes = [np.polyfit(n, np.log([r[q] for r in mine]), 1)[0] for q in ("linear", "solve_s", "total_s")]
            table.append([*key, *(f"{slope:.2f}" for slope in slopes)])
    return table


def main(
    dims: str = "2,3",
    kinds: str = "steady,unsteady",
    solvers: str = "direct,gmres_ilu,multigrid",
    ranks: str = "1,2",
    elements: str = "",
    steps: int = 4,
    out: Path = Path("results/benchmarks/flow_scaling"),
    worker: str | None = None,
) -> None:
    """Measure flow solves on finer and finer meshes.

    Args:
        dims: dimensions of space, separated by commas.
        kinds: steady, unsteady or both, separated by commas.
        solvers: linear solvers, separated by commas: automatic, direct, gmres_ilu, multigrid.
        ranks: numbers of ranks, separated by commas; more than one on the second largest mesh alone.
        elements: cells per side, separated by commas; default: 64 to 577 in the plane, 16 to 48 in space.
        steps: of unsteady flow.
        out: folder of the results.
        worker: one run as JSON, on the ranks of this process, instead of all.
    """
    if worker:
        tell(measure(*json.loads(worker)))
        return
    rows: list[dict[str, Any]] = []
    print(table(COLUMNS, []))
    for dim in (int(d) for d in dims.split(",")):
        sizes = [int(n) for n in elements.split(",")] if elements else list(SIZES[dim])
        for kind in kinds.split(","):
            for solver in solvers.split(","):
                for n in (n for n in sizes if n <= LIMITS.get((solver, dim), n)):
                    for count in (int(c) for c in ranks.split(",")):
                        if count == 1 or n in sizes[-2:-1]:
                            rows.append(run(count, dim, kind, solver, n, steps))
                            print(
                                "  ".join(
                                    f"{rows[-1][c]:.4g}" if isinstance(rows[-1][c], float) else str(rows[-1][c])
                                    for c in COLUMNS
                                ),
                                flush=True,
                            )
    text = table(COLUMNS, [[r[c] for c in COLUMNS] for r in rows])
    text += "\n\nexponents of the number of unknowns, over the three largest meshes on one rank\n"
    text += table(("dim", "kind", "recipe", "linear iterations", "solve", "total"), growth(rows)) + "\n"
    print(text)
    write_summary(out, "flow_scaling", {"dims": dims, "kinds": kinds, "solvers": solvers}, runs=rows)
    (out / "table.txt").write_text(text)


if __name__ == "__main__":
    script.command_line(main)
