"""A piston on springs in a channel: a frequency that the mass of the fluid lowers.

A stiff plate of mass m per area spans the channel (0, L) x (0, H), whose walls are without friction and whose ends are
open. Springs of stiffness k per area hold it; fluid and plate start with the same velocity, and move as one body:

    y = A sin(omega t),    omega^2 = k/(m + rho L),    f = rho L A omega^2 sin(omega t),

f being the fluid's force on the plate per area, and k such that the period is 1. A multiplier that lags by a step is
like a spring of stiffness beta/dt between both (beta: the penalty): they swing too slowly, the more so the larger dt.
"""

from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import numpy as np
from mpi4py import MPI

from coudalfish import CouDALFISh, CouplingOptions
from shnapr import Shell, StVenantKirchhoff
from tigar_x import PlaneField, Results, VTUSeries, checks, draw, generalized_alpha, lines, script, shapes, with_results
from varmint import Flow, Slip, Traction, box, movie

TOY = {"cells": 8, "steps_per_period": 8, "until": 1.5}
LENGTH, HEIGHT, PLACE, AMPLITUDE, RHO, MU, OMEGA = 1.0, 0.25, 0.52, 0.01, 1.0, 1e-3, 2.0 * np.pi
FORCE, STIFF = HEIGHT * RHO * LENGTH * AMPLITUDE * OMEGA**2, StVenantKirchhoff(1e8, 0.0, thickness=0.01)
PRESETS = {"plain": CouplingOptions} | {k: getattr(CouplingOptions, k) for k in ("reference", "converged", "sharp")}


@dataclass(frozen=True)
class Springs:
    """A load of our own: springs along the channel, of a stiffness per area."""

    stiffness: float

    def term(self, fields: Any) -> Any:
        """Residual form."""
        return self.stiffness * fields.y[0] * fields.z[0] * fields.spline.dx


@dataclass(frozen=True)
class Piston:
    """The piston, discretised.

    Attributes:
        mass_ratio: mass of the plate by that of the fluid.
        steps_per_period: number of time steps in a period.
        cells: of the fluid along the channel, 4 or more.
        preset: published coupling, plain fields with a multiplier that lags, or converged, or fields that jump, sharp.
    """

    mass_ratio: float = 1.0
    steps_per_period: int = 50
    cells: int = 16
    preset: Literal["reference", "plain", "converged", "sharp"] = "sharp"

    def build(self, **options: Any) -> tuple[Flow, Shell, CouDALFISh]:
        """Fluid and plate on their way through the middle, and both coupled; with more options of the coupling."""
        n, steps = checks.whole("cells", self.cells, 4), checks.whole("steps_per_period", self.steps_per_period, 2)
        mass, start = RHO * LENGTH * checks.positive("mass_ratio", self.mass_ratio), (AMPLITUDE * OMEGA, 0.0)
        mesh = box(MPI.COMM_WORLD, (0.0, 0.0), (LENGTH, HEIGHT), (n, max(1, round(n * HEIGHT / LENGTH))))
        sides = Slip(("bottom", "top")), Traction(("left", "right"), gamma=0.0)  # what comes back in is as fast
        known = {"dt": 1.0 / steps, "scheme": generalized_alpha(0.5), "immersed": self.preset == "sharp" or "plain"}
        flow = Flow(mesh, sides, rho=RHO, mu=MU, **known)
        flow.start(start)
        line = shapes.line((PLACE, 0.0), (PLACE, HEIGHT), elements=n // 2, degree=2)
        springs, across = Springs((mass + RHO * LENGTH) * OMEGA**2), 1 + 2 * np.arange(line.basis.n)
        plate = Shell(line, STIFF, density=mass / STIFF.thickness, loads=[springs], zero_dofs=across)
        plate.start(velocity=np.tile(start, (line.basis.n, 1)))
        return flow, plate, CouDALFISh(flow, plate, PRESETS[self.preset](**options))


@with_results(checkpoint_every=0)
def main(results: Results, piston: Piston, until: float = 2.2) -> dict[str, Any]:
    """Let a piston swing with the fluid around it, and compare its frequency and the force on it with the exact ones.

    Args:
        until: end, which is the number of periods.
    """
    out, (flow, plate, fsi) = results.out, piston.build()
    sines = {"y": ("t", AMPLITUDE, "length"), "force_1": ("t_alpha", FORCE, "force/depth")}
    files = movie(flow, out / "fluid.vtkhdf"), partial(VTUSeries, out / "plate", plate.spline, y=plate.y)
    history = {"t_alpha": "t_alpha", "y": lambda: plate.at("u0").displacement[0], "force": "monitors.force"}
    run = results.run(fsi, until=until, frames=44, series=files, history=history).through()
    past, errors, panels = run.history, {}, []
    for name, (t, largest, unit) in sines.items():
        curves = {"exact": (past[t], largest * np.sin(OMEGA * past[t])), "computed": (past[t], past[name])}
        errors[name] = np.abs(past[name] - curves["exact"][1])[1:].max() / largest
        panels.append(lines(curves, x=("$t$", "time"), y=(name, unit), styles={"exact": {"c": "0.6", "linewidth": 4}}))
    if run.finished and results.viz:
        seen = {"length": "length", "immersed": [plate.positions]}
        pressure = PlaneField(flow.w, sides=flow.sides).signed("pressure", "force/area", **seen)
        draw(out / "piston.png", [pressure], panels, size=(5.5, 3.0))
    passages = [*past.course("y").rises(0.0), *past.course("y").falls(0.0)]
    qoi = {"frequency": {"value": len(passages) / (2.0 * max(passages)), "exact": 1.0}} if passages else {}
    return results.of_run(run, qoi=qoi, errors=errors, inputs={"options": fsi.options})


if __name__ == "__main__":
    script.command_line(main)
