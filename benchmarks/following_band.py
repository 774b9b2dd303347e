"""A band of small cells that follows the manufactured membrane: errors and CPU time beside a uniform mesh.

In one process, one after the other, with the time step and the membrane of the level; forms are compiled before.
"""

import csv
import time
from functools import partial
from pathlib import Path
from typing import Any

from mpi4py import MPI

from coudalfish import CouplingOptions
from coudalfish.problems import manufactured as problem
from coudalfish.refinement import Band, FollowingBand
from tigar_x import script
from tigar_x.fem.schemes import generalized_alpha
from tigar_x.run.summary import table
from varmint import Flow, FlowOptions, NamedMesh, WeakVelocity, box
from varmint.mesh.refined import Refinement

DATA = problem.ProblemData()
KINDS = {
    "plain": ("plain", CouplingOptions),
    "jump": ("jump", partial(CouplingOptions.converged, fluid_tangent="consistent")),
    "sharp": ("jump and kink", CouplingOptions.sharp),
}
COLUMNS = ("preset", "level", "base", "meshes", "cells", "cpu_mesh", "cpu_s", "L2_u", "H1_u", "L2_p", "L2_y", "H1_y")


def flow_on(mesh: NamedMesh, fields: str, dt: float) -> Flow:
    """The flow, from its exact start."""
    c = script.constants(mesh.domain, DATA)

    def exact(name: str) -> Any:
        return lambda x, t: getattr(problem.exact_flow(x, t, c), name)

    walls = WeakVelocity(problem.walls_with_velocity(DATA, 2), exact("u"))
    known: dict[str, Any] = {"rho": c.rho, "mu": c.mu, "f": exact("f"), "immersed": fields, "dt": dt}
    pinned = FlowOptions(pin_at=[0.0, 0.0])
    return Flow(mesh, walls, **known, scheme=generalized_alpha(DATA.rho_infinity), options=pinned)


def run(
    preset: str, level: int, base: int, ahead: int, *, reach: float = 2.0, growth: float = 1.0, steps: int | None = None
) -> dict[str, Any]:
    """One run; with the base of the same level the mesh is uniform and stays."""
    (fields, options), cells = KINDS[preset], problem.cells_per_side(level)
    every, meshes = 2 * cells, Refinement(box(MPI.COMM_WORLD, *problem.fluid_box(DATA, 2, base)))
    make = partial(flow_on, fields=fields, dt=DATA.T / every)
    band = Band(2**0.5 * DATA.L / cells * (1 + 1e-6), reach=reach, growth=growth)  # the diagonals
    shell = problem.membrane(DATA, 2, problem.elements_per_side(DATA, level))
    following = FollowingBand(meshes, make, shell, band, ahead=ahead, options=options(), multiplier=DATA.DP)
    c = script.constants(following.flow.mesh.domain, DATA)
    start = [lambda x, t, name=name: getattr(problem.exact_flow(x, t, c), name) for name in ("u", "p")]
    following.flow.start(*start, projected=True)
    began, spent, count, steps = time.process_time(), 0.0, 0, steps or every
    for step in range(steps):
        if step and base < level:
            before = time.process_time()
            following.follow()
            spent += time.process_time() - before
        following.fsi.takeStep()
        count += following.flow.mesh.size
    cpu = time.process_time() - began
    errors = problem.errors(following.fsi, DATA, following.fsi.timeInt_f.time, 8)
    counts = {"preset": preset, "level": level, "base": base, "meshes": following.number, "cells": round(count / steps)}
    return {**counts, "cpu_mesh": spent, "cpu_s": cpu, **errors}


def main(
    presets: str = "plain,jump,sharp",
    level: int = 5,
    bases: str = "5,4,3",
    ahead: int = 24,
    reach: float = 1.0,
    growth: float = 2.0,
    out: Path = Path("results/benchmarks/following_band"),
) -> None:
    """Measure errors and CPU time of bands that follow the membrane, and of a uniform mesh.

    Args:
        presets: plain, jump and sharp fields, separated by commas.
        level: of the cells at the membrane, of its elements and of the time step.
        bases: levels of the cells elsewhere, separated by commas; the first one is what times are compared with.
        ahead: steps for which the small cells are made.
        reach: how far from the membrane cells are as small, in their size.
        growth: of cells beyond the band, per distance.
        out: folder of the results.
    """
    out.mkdir(parents=True, exist_ok=True)
    rows: list[dict[str, Any]] = []
    for preset in presets.split(","):
        run(preset, 1, 0, 1, steps=4)  # compiles
        rows += [run(preset, level, int(base), ahead, reach=reach, growth=growth) for base in bases.split(",")]
        print(table(COLUMNS, [[row[key] for key in COLUMNS] for row in rows]), flush=True)
    with open(out / "following_band.csv", "w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS)
        writer.writeheader()
        writer.writerows(rows)


if __name__ == "__main__":
    script.command_line(main)
