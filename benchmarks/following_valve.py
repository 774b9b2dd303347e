"""A heart valve whose cells are small where its leaflets are: how it opens and closes, and what that costs.

The demo's valve in a coarse mesh that is bisected around the leaflets, and anew as they move. A row a step goes into
``history.csv``, and a run that was ended goes on from its last checkpoint.
"""

import json
import logging
import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
from mpi4py import MPI
from load import load_demo

from coudalfish import advance
from coudalfish.courant import CourantSteps
from coudalfish.refinement import Band, FollowingBand
from coudalfish.restart import CoupledState
from coudalfish.valves import Leaflets, quantities
from shnapr import ContactRecipe
from tigar_x import LinearSolver, direct, two_level
from tigar_x.ranks import on_root
from tigar_x.run import script
from tigar_x.run.history import FILE, History
from tigar_x.run.output import CSVSeries
from tigar_x.run.progress import peak_rss_mib
from tigar_x.run.restart import Restart
from varmint.mesh.aorta import aortic_root, sectors
from varmint.mesh.refined import Refinement
from varmint.quantities import Measured, flow_rate

COLUMNS = (
    *("flow_rate", "opening_area", "contact_pairs", "contact_load", "smallest_distance", "asymmetry", "leak", "passes"),
    *("linear", "attempts", "slip", "cells", "cell_size", "meshes", "dt", "cpu_mesh", "cpu_s"),
)
EXPECTED = "expected.npy"
"""Points around which the mesh of the last checkpoint was made."""


class FollowedValve:
    """The valve in its band of small cells.

    Args:
        scene: of the demo.
        base: size of the cells elsewhere [cm].
        band: of the small cells.
        ahead: steps of the largest size for which they are made.
        contact: range of contact [cm]; None: the demo's.
        solver: of the flow; None: the demo's.
        coupling: options of the coupling that are not the usual ones of such fields.
        expected: see :class:`coudalfish.refinement.FollowingBand`.
    """

    def __init__(
        self,
        scene: Any,
        base: float,
        band: Band,
        ahead: int,
        contact: float | None = None,
        solver: LinearSolver | None = None,
        coupling: dict[str, Any] | None = None,
        expected: Any = None,
    ) -> None:
        self.data, self._ahead = load_demo("heart_valve").Data(), ahead
        if contact is not None:
            self.data = replace(self.data, contact=with_range(self.data.contact, contact))
        meshes = Refinement(aortic_root(MPI.COMM_WORLD, size=base, radius=self.data.radius), sectors)
        shell, make = scene.leaflets(self.data), partial(scene.flow, data=self.data, solver=solver)
        known = {"ahead": ahead, "expected": expected}
        self.following = FollowingBand(meshes, make, shell, band, **known)
        fsi = self.following.fsi
        fsi.options = fsi.options.with_(**(coupling or {}))
        self.leaflets, self.cpu_mesh, self.rate = Leaflets(shell), 0.0, self._rate()
        self._largest = self.following.fsi.step_size

    def _rate(self) -> Measured:
        return Measured(q=flow_rate(self.following.flow, "inlet"))

    def step(self, dt: float) -> Any:
        """Take a step, and then change the mesh where that is due; the row, and whether the mesh is another one."""
        following, before = self.following, time.process_time()
        following.ahead = round(self._ahead * self._largest / dt)
        reports = advance(following.fsi, dt)
        after = time.process_time()
        report, contact, least = reports[-1], reports[-1].contact, self.leaflets
        nearest = min(contact.distance, following.fsi.contactContext_sh.kernel.r_max)
        row = [-self.rate()["q"], least.opening(), contact.pairs, contact.load, nearest, least.asymmetry()]
        row += [report.monitors.leak, *(sum(getattr(r, n) for r in reports) for n in ("passes", "linear_iterations"))]
        row += [max(r.attempts for r in reports), report.slip_ratio]
        row += [following.flow.mesh.size, following.fsi.fluid.mesh_size, following.number, dt]
        began = time.process_time()
        changed = following.follow()
        if changed:
            self.rate = self._rate()
        spent = time.process_time() - began
        self.cpu_mesh += spent
        return report.t, [*row, self.cpu_mesh, after - before + spent], changed


def with_range(contact: ContactRecipe, size: float) -> ContactRecipe:
    """The same contact at another range; the pressure of surfaces goes with the third power of it."""
    factor = size / contact.kernel.r_max
    kernel = replace(contact.kernel, r_max=size, stiffness=contact.kernel.stiffness / factor**3)
    return replace(contact, kernel=kernel, r_self=factor * contact.r_self)


def main(
    size: float = 0.115,
    base: float = 0.25,
    reach: float = 0.3,
    growth: float = 2.0,
    ahead: int = 8,
    leaflet_elements: int = 16,
    contact: float | None = None,
    preset: str = "jump",
    fill: int | None = None,
    accuracy: float | None = None,
    tangents: Literal["step", "pass"] | None = None,
    dt: float = 2e-4,
    halvings: int = 2,
    courant: float = 2.0,
    until: float = 0.2,
    checkpoint_every: int = 50,
    restart: bool = False,
    out: Path = Path("results/benchmarks/following_valve"),
) -> None:
    """Open and close the heart valve in a band of small cells.

    Args:
        size: length that edges of cells may have at the leaflets [cm].
        base: size of the cells elsewhere [cm].
        reach: how far from the leaflets cells are as small, in ``size``.
        growth: of cells beyond, per distance.
        ahead: steps for which the small cells are made.
        leaflet_elements: of a leaflet from post to post.
        contact: range of contact, or more where points are too far apart for it [cm]; None: the demo's.
        preset: of the demo.
        fill: of factors that are made anew for every matrix; None: the demo's recipe, which keeps them.
        accuracy: residuals at which a step ends, relative to its first ones or to the forces of coupling; None: usual.
        tangents: made for every step, or every pass of it; None: usual.
        dt: largest time step [s].
        halvings: of it at most, where the Courant number asks for it.
        courant: the largest one of cells; leaflets pass half as many in a step.
        until: end [s].
        checkpoint_every: number of largest steps between checkpoints.
        restart: go on from the last checkpoint.
        out: folder of the results.
    """
    logging.getLogger().setLevel(logging.WARNING)
    demo = load_demo("heart_valve")
    scene = demo.Valve(dt=dt, preset=preset, leaflet_elements=leaflet_elements)
    out.mkdir(parents=True, exist_ok=True)
    expected = np.load(out / EXPECTED) if restart else None
    solver = None if fill is None else two_level(fill, rtol=1e-5, fallback=direct())
    given = {"block_rtol": accuracy, "tangent_update": tangents}
    coupling = {name: value for name, value in given.items() if value is not None}
    band = Band(size, reach=reach, growth=growth)
    valve = FollowedValve(scene, base, band, ahead, contact, solver, coupling, expected)
    following = valve.following

    def keeps() -> Restart:
        return Restart(out / "checkpoints", CoupledState(following.fsi))

    kept, cpu, every = keeps(), 0.0, checkpoint_every * dt
    if restart:
        kept.read()
        cpu, valve.cpu_mesh = kept.extra["cpu_s"], kept.extra["cpu_mesh"]
        following.number = kept.extra["meshes"]
    with CSVSeries(out / FILE, COLUMNS, after=kept.after) as history:
        steps = CourantSteps(following.fsi, dt, flow=courant, shell=courant / 2, halvings=halvings)
        while following.fsi.timeInt_f.time < until - dt / 2 ** (halvings + 1):
            t, row, changed = valve.step(steps.size())
            cpu += row[-1]
            history.write(t, *row[:-1], cpu)
            if changed:
                kept = keeps()
                kept.after = t
            if abs(t / every - round(t / every)) < 1e-3:
                kept.step, kept.extra = (
                    round(t / every),
                    {
                        "cpu_s": cpu,
                        "cpu_mesh": valve.cpu_mesh,
                        "meshes": following.number,
                    },
                )
                kept.write()
                on_root(MPI.COMM_WORLD, lambda: np.save(out / EXPECTED, following.expected))
    past = History.read(out)
    found = {name: quantity.value for name, quantity in quantities(past, valve.data.reversal).items()}
    found |= {"cpu_s": cpu, "cpu_mesh": valve.cpu_mesh, "steps": len(past.t), "meshes": following.number}
    found |= {"cells_mean": past["cells"].mean(), "cells_max": past["cells"].max()}
    found |= {"cell_size": past["cell_size"].max(), "points": len(following.fsi.lam)}
    found |= {"peak_rss_mib": peak_rss_mib()}
    text = json.dumps(found, indent=1)
    on_root(MPI.COMM_WORLD, lambda: (out / "summary.json").write_text(text))
    if MPI.COMM_WORLD.rank == 0:
        print(text, flush=True)


if __name__ == "__main__":
    script.command_line(main)
