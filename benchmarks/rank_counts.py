"""What a step of the opening heart valve does on several ranks: iterations, messages, collectives, imbalance, memory.

Counts, and no times: they are the same on a few cores, however many ranks share them. ``messages.c`` counts what each
process sends, by whichever library. ``rank_model.py`` makes a model of a step of these numbers.
"""

import csv
import ctypes
import functools
import logging
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI
from load import load_demo, on_ranks, tell
from solvers import recipes

from coudalfish.step.condensed import CondensedSystem
from tigar_x import checks, compat
from tigar_x.compat import FloatArray
from tigar_x.run import script
from tigar_x.run.progress import peak_rss_mib
from tigar_x.run.summary import table, write_summary

HERE = Path(__file__).resolve()
PRESETS = ("plain", "jump")
KINDS = ("messages", "allreduces", "broadcasts", "gathers", "others")
"""What is counted, see ``messages.c``; all but the first are collectives."""
COLUMNS = (
    *("preset", "resolution", "cells", "points", "ranks", "passes", "solves", "iterations"),
    *(f"{kind}{what}" for kind in KINDS for what in ("", "_bytes")),
    *("solve_messages", "solve_message_bytes", "solve_collectives", "most_messages", "most_message_bytes"),
    *("cells_imbalance", "points_imbalance", "ghost_share", "neighbours", "memory_mib", "memory_growth_mib"),
)
"""Of the table, one row a run: numbers of a step, of messages the mean over the ranks and the most that one sends."""


def counter(folder: Path) -> Path:
    """The library that counts, compiled in a folder.

    Raises:
        FileNotFoundError: there is no compiler for MPI, mpicc.
        RuntimeError: it fails.
    """
    library = folder / "messages.so"
    command = ["mpicc", "-shared", "-fPIC", "-O2", str(HERE.with_name("messages.c")), "-o", str(library)]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"{' '.join(command)} failed:\n{done.stderr[-2000:]}")
    return library


class Counts:
    """What this process has sent so far, and what of it since something began inside functions that are watched."""

    def __init__(self) -> None:
        try:
            self._read = ctypes.CDLL(None).messages_read
        except AttributeError:
            raise RuntimeError("messages.c is not loaded: run rank_counts.py without --worker") from None
        self.watched, self.calls = np.zeros(2 * len(KINDS)), 0

    def now(self) -> FloatArray:
        """Numbers and bytes of each kind, one beside the other."""
        values = np.zeros(2 * len(KINDS))
        self._read(ctypes.c_void_p(values.ctypes.data))
        return values

    def watch(self, owner: Any, name: str) -> None:
        """Watch a method of an object, or of all of a class, from now on."""
        method: Callable[..., Any] = getattr(owner, name)

        @functools.wraps(method)
        def watched(*arguments: Any, **named: Any) -> Any:
            before = self.now()
            try:
                return method(*arguments, **named)
            finally:
                self.watched += self.now() - before
                self.calls += 1

        setattr(owner, name, watched)


def neighbours(comm: MPI.Comm, nodes: Any) -> set[int]:
    """Ranks whose nodes this one sees as ghosts, by its index map (collective)."""
    starts = np.array(comm.allgather(nodes.local_range[0]))
    return {int(rank) for rank in np.searchsorted(starts, nodes.ghosts, side="right") - 1}


def measure(preset: str, resolution: int, steps: int, before: int, solver: str) -> dict[str, Any]:
    """A row of the table, on the ranks of this run (collective)."""
    logging.getLogger("coudalfish").setLevel(logging.ERROR)
    demo, comm = load_demo("heart_valve"), MPI.COMM_WORLD
    counts, points = Counts(), [0]
    flow, _, fsi = demo.Valve(resolution=resolution, preset=preset).build(
        demo.Data(), solver=recipes(solver)[solver] if solver else None
    )
    place = fsi.fluid.place

    def placed(*arguments: Any, **named: Any) -> Any:
        meeting = place(*arguments, **named)
        points[0] = int((meeting.location.cells >= 0).sum())
        return meeting

    fsi.fluid.place = placed
    counts.watch(fsi.fluid.system if preset == "plain" else CondensedSystem, "solve")
    for _ in range(before):
        fsi.takeStep()
    counts.watched[:], counts.calls = 0.0, 0
    memory, start = peak_rss_mib(), counts.now()
    reports = [fsi.takeStep() for _ in range(steps)]
    sent, inside = (counts.now() - start) / steps, counts.watched / steps
    owned, nodes = compat.owned_cells(flow.V.mesh), flow.V.dofmap.index_map
    ghosts = len(compat.cell_dofs(flow.V)) - owned
    mine = [*sent, inside[0], inside[1], inside[2::2].sum(), owned, ghosts, points[0], peak_rss_mib(), memory]
    rows = np.array(comm.allgather([*map(float, mine), len(neighbours(comm, nodes))]))
    mean, most = rows.mean(axis=0), rows.max(axis=0)
    n = 2 * len(KINDS)
    known = {"preset": preset, "resolution": resolution, "cells": flow.mesh.size, "ranks": comm.size}
    known |= {"points": round(rows[:, n + 5].sum()), "passes": np.mean([r.passes for r in reports])}
    known |= {"solves": counts.calls / steps, "iterations": np.mean([r.linear_iterations for r in reports])}
    known |= {f"{kind}{what}": mean[2 * k + j] for k, kind in enumerate(KINDS) for j, what in enumerate(("", "_bytes"))}
    known |= dict(zip(("solve_messages", "solve_message_bytes", "solve_collectives"), mean[n : n + 3], strict=True))
    known |= {"most_messages": most[0], "most_message_bytes": most[1]}
    known |= {"cells_imbalance": most[n + 3] / mean[n + 3], "points_imbalance": most[n + 5] / max(mean[n + 5], 1.0)}
    known |= {"ghost_share": mean[n + 4] / mean[n + 3], "neighbours": mean[-1]}
    known |= {"memory_mib": most[n + 6], "memory_growth_mib": most[n + 6] - most[n + 7]}
    return {name: known[name] for name in COLUMNS}


def run(ranks: int, preset: str, resolution: int, steps: int, before: int, solver: str = "") -> dict[str, Any]:
    """A row of the table, in processes of its own."""
    settings = ("--presets", preset, "--resolutions", resolution, "--steps", steps, "--before", before)
    settings += ("--solver", solver)
    with tempfile.TemporaryDirectory() as folder:
        return dict(on_ranks(ranks, HERE, "--worker", *settings, preload=counter(Path(folder))))


def read(path: Path) -> list[dict[str, Any]]:
    """Rows of a table that :func:`main` has written.

    Raises:
        ValueError: it has other columns, or no rows.
    """
    with path.open(newline="") as file:
        reader = csv.DictReader(file)
        rows = [{key: value if key == "preset" else float(value) for key, value in row.items()} for row in reader]
        if tuple(reader.fieldnames or ()) != COLUMNS or not rows:
            raise ValueError(f"{path}: a table of rank_counts.py is required, with columns {', '.join(COLUMNS)}")
    return rows


def main(
    presets: str = "plain,jump",
    resolutions: str = "12,20",
    ranks: str = "1,2,4,8,16",
    steps: int = 5,
    before: int = 3,
    solver: str = "",
    out: Path = Path("results/benchmarks"),
    worker: bool = False,
) -> dict[str, Any] | None:
    """Count what steps of the opening heart valve do on several numbers of ranks.

    Args:
        presets: "plain", "jump" or both, separated by commas.
        resolutions: cells across the aorta, separated by commas.
        ranks: numbers of ranks, separated by commas.
        steps: steps that are counted.
        before: steps that are taken first.
        solver: of the flow, as "ilu2" or "two1", see solvers.py; default: that of the demo.
        out: folder of the results, in which counts.csv is written.
        worker: count on the ranks of this run and print the row, instead of starting others.

    Returns:
        The summary; None with --worker.
    """
    for name, value in (("steps", steps), ("before", before)):
        checks.whole(name, value, 1)
    for preset in presets.split(","):
        checks.choice("presets", preset, PRESETS)
    if worker:
        tell(measure(presets, int(resolutions), steps, before, solver))
        return None
    rows = []
    folder = out / "rank_counts"
    folder.mkdir(parents=True, exist_ok=True)
    for preset in presets.split(","):
        for resolution in map(int, resolutions.split(",")):
            for count in map(int, ranks.split(",")):
                rows.append(run(count, preset, resolution, steps, before, solver))
                with (folder / "counts.csv").open("w", newline="") as file:
                    writer = csv.DictWriter(file, COLUMNS)
                    writer.writeheader()
                    writer.writerows(rows)
    shown = ("preset", "cells", "ranks", "solves", "iterations", "messages", "messages_bytes", "allreduces")
    shown += ("cells_imbalance", "points_imbalance", "neighbours", "memory_mib")
    print(table(shown, [[row[name] for name in shown] for row in rows]))
    inputs = {
        "presets": presets,
        "resolutions": resolutions,
        "ranks": ranks,
        "steps": steps,
        "before": before,
        "solver": solver,
    }
    return write_summary(folder, "rank_counts", inputs, rows=rows)


if __name__ == "__main__":
    script.command_line(main)
