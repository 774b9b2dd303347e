"""A model of a coupled step on many ranks, of counts on few and times on one.

The counts are those of ``rank_counts.py``, the times those of ``valve_breakdown.py``.

With N cells on P ranks, parts of the mesh are taken as cubes: the interfaces of one have ``(N/P)^(2/3) (1 - P^(-1/3))``
units, and it has 13 (1 - P^(-1/3)) neighbours. Points and divided cells lie on a surface, which meets of the order of
P^(2/3) parts: the fullest has CROWDED P^(1/3) times the mean. What every rank has of the shell is of the order of
N^(2/3). Messages cost a latency and their bytes; collectives of few bytes a latency for each doubling of the ranks, and
of many twice their bytes besides (Thakur, Rabenseifner and Gropp, doi:10.1177/1094342005051521). GMRES that
orthogonalises by modified Gram-Schmidt takes i (i + 1)/2 of them in i iterations.
"""

import json
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse as sp
from mpi4py import MPI
from rank_counts import KINDS, PRESETS, read
from scipy.optimize import nnls

from tigar_x import checks
from tigar_x.fem.coarse_solver import coarse_solver
from tigar_x.fem.two_level import MOST
from tigar_x.run import script
from tigar_x.run.summary import table, write_summary

HERE = Path(__file__).resolve()
COUNTED, TIMED = HERE.with_name("rank_counts.csv"), HERE.with_name("valve_breakdown.json")
"""Results of these that are kept."""
NEIGHBOURS = 13.0
"""Neighbours of a part that has nothing but neighbours; 14 in the densest packing of cells of least surface."""
CROWDED = 1.2
"""Points of the fullest part over their mean, for one doubling of the parts in each direction, over two."""
SHARED = ("fluid: Jacobian of divided cells", "placing: what is divided, polygons")
"""Parts of a step that are shared by where the surface is."""
EVEN = ("shell: tangent", "shell: residual")
"""Those of which each rank has as many of the shell's elements."""
REPLICATED = ("shell", "points", "multiplier", "monitors", "acceptance", "solves", "the rest", "placing")
"""What names of parts begin with that every rank does for all points; what is left is shared by cells."""


@dataclass(frozen=True)
class Network:
    """What messages cost.

    The default is a usual cluster: InfiniBand of 100 Gbit/s and about a microsecond (D. K. Panda, The MVAPICH2 project,
    SC'18, docslib.org/doc/1131852) with what MPI adds, for a node of 64 ranks.

    Attributes:
        latency: of a message; unit: s.
        bandwidth: of a node; unit: bytes/s.
        ranks_per_node: that share it.
    """

    latency: float = 2e-6
    bandwidth: float = 12.5e9
    ranks_per_node: int = 64

    def __post_init__(self) -> None:
        for name in ("latency", "bandwidth"):
            checks.positive(name, getattr(self, name))
        checks.whole("ranks_per_node", self.ranks_per_node, 1)

    def messages(self, number: float, of_bytes: float, ranks: int) -> float:
        """Seconds of messages of one rank."""
        return number * self.latency + of_bytes * min(ranks, self.ranks_per_node) / self.bandwidth

    def collectives(self, number: float, of_bytes: float, ranks: int) -> float:
        """Seconds of collectives."""
        return number * math.ceil(math.log2(ranks)) * self.latency + 2.0 * of_bytes / self.bandwidth


def interface(cells: float, ranks: int) -> float:
    """Size of the interfaces of one part, in units of a side of a cell's."""
    return float((cells / ranks) ** (2 / 3) * (1.0 - ranks ** (-1 / 3)))


def neighbours(ranks: int) -> float:
    """Neighbours of a part."""
    return float(min(ranks - 1.0, NEIGHBOURS * (1.0 - ranks ** (-1 / 3))))


def crowded(ranks: int) -> float:
    """Points of the fullest part over their mean."""
    return float(min(ranks, max(1.0, CROWDED * ranks ** (1 / 3))))


@dataclass(frozen=True)
class Counts:
    """What a step of one preset sends.

    Attributes:
        messages: to a neighbour, in an iteration and beside.
        exchanged: bytes for a unit of interface, likewise.
        collectives: in an iteration, but for orthogonalisation, in a solve, and beside.
        replicated: bytes of collectives for a unit of N^(2/3).
        memory: MiB of every rank, for a cell, and for a unit of N^(2/3).
    """

    messages: tuple[float, float]
    exchanged: tuple[float, float]
    collectives: tuple[float, float, float]
    replicated: float
    memory: tuple[float, float, float]

    @classmethod
    def of(cls, rows: Sequence[dict[str, Any]]) -> "Counts":
        """By least squares of relative errors from rows of ``rank_counts.py``, of one preset on several ranks.

        Raises:
            ValueError: the rows are of several presets, or of fewer than three runs on more than one rank.
        """
        some = [row for row in rows if row["ranks"] > 1]
        if len({row["preset"] for row in rows}) != 1 or len(some) < 3:
            raise ValueError(f"rows: three or more of one preset on several ranks are required, not {len(some)}")
        n, ones = [neighbours(int(r["ranks"])) for r in some], [1.0] * len(some)
        faces, its = [interface(r["cells"], int(r["ranks"])) for r in some], [r["iterations"] for r in some]
        sent, of_solves = [r["messages"] for r in some], [r["solve_messages"] for r in some]
        size, size_of_solves = [r["messages_bytes"] for r in some], [r["solve_message_bytes"] for r in some]
        rest = [_collectives(r) - r["solve_collectives"] for r in some]
        orthogonal = [r["solve_collectives"] - _orthogonal(r["iterations"], r["solves"]) for r in some]
        surface = [r["cells"] ** (2 / 3) for r in rows]
        of_ranks, of_faces = np.multiply(n, its), np.multiply(faces, its)
        memory = [r["cells"] / r["ranks"] for r in rows]
        return cls(
            (*_fit(of_solves, of_ranks), *_fit(np.subtract(sent, of_solves), n)),
            (*_fit(size_of_solves, of_faces), *_fit(np.subtract(size, size_of_solves), faces)),
            (*_fit(orthogonal, its, [r["solves"] for r in some]), *_fit(rest, ones)),
            *_fit([_collective_bytes(r) for r in some], [r["cells"] ** (2 / 3) for r in some]),
            _fit([r["memory_mib"] for r in rows], [1.0] * len(rows), memory, surface),
        )

    def predicted(self, cells: float, ranks: int, solves: float, iterations: float) -> dict[str, float]:
        """Counts of a step, by the names of the table's columns, messages those of one rank."""
        checks.whole("ranks", ranks, 1)
        for name, value in (("cells", cells), ("solves", solves), ("iterations", iterations)):
            checks.positive(name, value)
        to, faces, alone = neighbours(ranks), interface(cells, ranks), ranks == 1
        collectives = self.collectives[0] * iterations + self.collectives[1] * solves + self.collectives[2]
        replicated = self.replicated * cells ** (2 / 3)
        return {
            "messages": to * (self.messages[0] * iterations + self.messages[1]),
            "messages_bytes": faces * (self.exchanged[0] * iterations + self.exchanged[1]),
            "collectives": 0.0 if alone else collectives + _orthogonal(iterations, solves),
            "collectives_bytes": 0.0 if alone else replicated,
            "neighbours": to,
            "points_imbalance": crowded(ranks),
            "memory_mib": float(np.dot(self.memory, [1.0, cells / ranks, cells ** (2 / 3)])),
        }


def _orthogonal(iterations: float, solves: float) -> float:
    """Collectives of modified Gram-Schmidt, as many iterations in each solve."""
    each = iterations / solves
    return float(solves * each * (each + 1.0) / 2.0)


def _collectives(row: dict[str, Any]) -> float:
    return float(sum(row[kind] for kind in KINDS[1:]))


def _collective_bytes(row: dict[str, Any]) -> float:
    return float(sum(row[f"{kind}_bytes"] for kind in KINDS[1:]))


def _fit(values: Any, *columns: Any) -> tuple[float, ...]:
    """Coefficients, none of which is negative, of least relative errors."""
    scale = 1.0 / np.maximum(np.abs(values), 1e-30)
    return tuple(map(float, nnls(np.column_stack(columns) * scale[:, None], np.sign(values))[0]))


def measured(row: dict[str, Any]) -> dict[str, float]:
    """What :meth:`Counts.predicted` predicts, as it was counted."""
    names = ("messages", "messages_bytes", "neighbours", "points_imbalance", "memory_mib")
    return {name: row[name] for name in names} | {
        "collectives": _collectives(row),
        "collectives_bytes": _collective_bytes(row),
    }


@dataclass(frozen=True)
class Times:
    """CPU seconds of a step on one rank.

    Attributes:
        cells: for a cell.
        crowded: for a unit of N^(2/3), shared by where the surface is.
        even: likewise, shared evenly.
        replicated: likewise, of every rank.
    """

    cells: float
    crowded: float
    even: float
    replicated: float

    @classmethod
    def of(cls, run: dict[str, Any]) -> "Times":
        """From a run of ``valve_breakdown.py``."""
        surface, left = run["cells"] ** (2 / 3), dict(run["seconds"])
        crowded, even = (sum(left.pop(name, 0.0) for name in names) for names in (SHARED, EVEN))
        own = sum(left.pop(name) for name in list(left) if name.startswith(REPLICATED))
        return cls(sum(left.values()) / run["cells"], crowded / surface, even / surface, own / surface)


def coarse_seconds(nodes: int = MOST) -> tuple[float, float]:
    """CPU seconds of factors of the coarse level on one rank, and of a solve: nodes with 7 unknowns, 27 neighbours."""
    side = round(nodes ** (1 / 3))
    line = sp.diags([-1.0, 2.0, -1.0], [-1, 0, 1], shape=(side, side)) + sp.eye(side)
    node = sp.kron(sp.kron(abs(line), abs(line)), abs(line))
    A = (sp.kron(node, np.ones((7, 7))) + 1e3 * sp.eye(7 * side**3)).tocsc()
    start = time.process_time()
    factors = coarse_solver(A, A.diagonal(), MPI.COMM_SELF, [A.shape[0]])
    made = time.process_time()
    factors.solve(np.ones(A.shape[0]))
    solved = time.process_time()
    factors.destroy()
    return made - start, solved - made


def step(
    counts: Counts, times: Times, network: Network, cells: float, ranks: int, solves: float, iterations: float
) -> dict[str, float]:
    """Seconds of a step, by what they are spent in."""
    n, surface = counts.predicted(cells, ranks, solves, iterations), cells ** (2 / 3)
    return {
        "own cells": times.cells * cells / ranks,
        "points": times.crowded * surface * crowded(ranks) / ranks,
        "shell": times.even * surface / ranks,
        "every rank": times.replicated * surface,
        "messages": network.messages(n["messages"], n["messages_bytes"], ranks),
        "collectives": network.collectives(n["collectives"], n["collectives_bytes"], ranks),
    }


def main(
    counts: Path = COUNTED,
    breakdown: Path = TIMED,
    cells: str = "1e6,1e8",
    ranks: str = "1,64,1024",
    latency: float = Network.latency,
    bandwidth: float = Network.bandwidth,
    ranks_per_node: int = Network.ranks_per_node,
    out: Path = Path("results/benchmarks"),
) -> dict[str, Any]:
    """Compare the model with what was counted, and predict steps on many ranks.

    Args:
        counts: counts.csv of rank_counts.py.
        breakdown: summary.json of valve_breakdown.py.
        cells: sizes of the mesh to predict, separated by commas.
        ranks: numbers of ranks likewise.
        latency: of a message [s].
        bandwidth: of a node [bytes/s].
        ranks_per_node: that share it.
        out: folder of the results.

    Returns:
        The summary: coefficients, relative errors of counts, and seconds of predicted steps.
    """
    network, rows = Network(latency, bandwidth, ranks_per_node), read(counts)
    runs, found = json.loads(breakdown.read_text())["runs"], {}
    for preset in PRESETS:
        mine = [row for row in rows if row["preset"] == preset]
        some = [run for run in runs if run["preset"] == preset]
        if not mine or not some:
            continue
        model, times = Counts.of(mine), Times.of(max(some, key=lambda run: run["cells"]))
        errors = []
        for row in (row for row in mine if row["ranks"] > 1):
            guess = model.predicted(row["cells"], int(row["ranks"]), row["solves"], row["iterations"])
            ratios = {name: guess[name] / value for name, value in measured(row).items()}
            errors.append({"cells": row["cells"], "ranks": row["ranks"], **ratios})
        print(f"\n{preset}: predicted over counted")
        print(table(errors[0], [list(row.values()) for row in errors]))
        last = max((row for row in mine if row["ranks"] > 1), key=lambda row: (row["cells"], row["ranks"]))
        steps = []
        for n in map(float, cells.split(",")):
            for p in map(int, ranks.split(",")):
                parts = step(model, times, network, n, p, last["solves"], last["iterations"])
                memory = model.predicted(n, p, last["solves"], last["iterations"])["memory_mib"]
                steps.append({"cells": n, "ranks": p, "s": sum(parts.values()), **parts, "MiB a rank": memory})
        print(f"{preset}: seconds of a step, {last['iterations']:.0f} iterations in {last['solves']:.0f} solves")
        print(table(steps[0], [list(row.values()) for row in steps]))
        found[preset] = {"counts": vars(model), "times": vars(times), "errors": errors, "steps": steps}
    made, solved = coarse_seconds()
    print(f"\ncoarse level of {MOST} aggregates, on one rank: factors {made:.2f} s, a solve {1e3 * solved:.1f} ms")
    inputs = {"cells": cells, "ranks": ranks, **vars(network)}
    return write_summary(out / "rank_model", "rank_model", inputs, presets=found, coarse_s=(made, solved))


if __name__ == "__main__":
    script.command_line(main)
