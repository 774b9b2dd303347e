"""The same errors on any number of ranks, and what a second rank brings."""

import json
import logging
from pathlib import Path
from typing import Any, Literal

from mpi4py import MPI
from load import load_demo, on_ranks

from coudalfish import CouplingOptions
from coudalfish.problems import manufactured as problem
from tigar_x.fem.linear import direct
from tigar_x.run import script
from tigar_x.run.progress import Stopwatch
from tigar_x.run.summary import table

HERE = Path(__file__).resolve()
NORMS = ("L2_u", "H1_u", "L2_p", "L2_y", "H1_y")
TIGHT = CouplingOptions(block_rtol=1e-11, block_atol=1e-14)


def measure(dim: int, level: int, tight: bool, steps: int) -> dict[str, Any]:
    """Errors after some steps, and wall seconds per step, on the ranks of this run."""
    logging.getLogger("coudalfish").setLevel(logging.ERROR)
    data, whole = problem.ProblemData(), 2 * problem.cells_per_side(level)
    options, solver = (TIGHT, direct()) if tight else (CouplingOptions(), None)
    *_, fsi = load_demo("manufactured").build(dim, level, whole, options, solver, projected=False, data=data)
    fsi.takeStep()
    watch = Stopwatch()
    with watch:
        for _ in range(steps - 1):
            fsi.takeStep()
    errors = problem.errors(fsi, data, fsi.timeInt_f.time, 2)
    return {"errors": errors, "wall_s_per_step": watch.wall_s / max(1, steps - 1)}


def run(ranks: int, dim: int, level: int, tight: bool, steps: int) -> dict[str, Any]:
    """The same in processes of its own."""
    settings = ("--dim", dim, "--level", level, "--tight" if tight else "--no-tight", "--steps", steps)
    return dict(on_ranks(ranks, HERE, "--worker", *settings))


def main(
    dim: Literal[2, 3] = 2,
    level: int = 2,
    tight: bool = True,
    ranks: str = "1,2,3",
    steps: int = 10,
    worker: bool = False,
) -> None:
    """Compare runs of the manufactured fluid-membrane problem on several numbers of ranks.

    Args:
        dim: dimension of space, 2 or 3 (one layer).
        level: refinement level.
        tight: direct solves and a block tolerance of 1e-11, instead of the defaults.
        ranks: numbers of ranks, separated by commas.
        steps: steps of the published size.
        worker: measure on the ranks of this run and print the result, instead of starting others.
    """
    if worker:
        result = measure(dim, level, tight, steps)
        if MPI.COMM_WORLD.rank == 0:
            print(json.dumps(result))
        return
    counts = [int(count) for count in ranks.split(",")]
    results = [run(count, dim, level, tight, steps) for count in counts]
    first = results[0]
    rows = [
        (
            count,
            max(abs(r["errors"][norm] / first["errors"][norm] - 1.0) for norm in NORMS),
            r["wall_s_per_step"],
            first["wall_s_per_step"] / r["wall_s_per_step"],
        )
        for count, r in zip(counts, results, strict=True)
    ]
    print(f"{dim}D level {level}, {steps} steps, {'tight' if tight else 'default'} tolerances")
    print(table(("ranks", "largest relative difference of a norm", "wall s per step", "speed-up"), rows))


if __name__ == "__main__":
    script.command_line(main)
