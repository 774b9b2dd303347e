"""Flow around a rigid cylinder that the mesh does not know: a closed curve immersed in a channel, at Re = 20.

The channel (0, 2.2) x (0, 0.41) holds a cylinder of diameter D = 0.1 around (0.2, 0.2). Fluid of density 1 and
viscosity 1e-3 enters with a parabola of mean speed U = 0.2, does not slip on walls and cylinder, and leaves freely.
The cylinder is a shell that does not move, with fluid inside. Time steps lead from the parabola to the steady flow.

With the force F of the fluid on the shell per unit depth, the coefficients of drag and lift are 2 F/(rho U^2 D). dp is
the difference of pressure over rho U^2 between the foremost and the rearmost point of the cylinder, extrapolated from
one and two cells away. The pressure inside has a constant of its own, which forces hardly notice: docs/benchmarks.md.

Source: the steady benchmark of Schaefer and Turek, with the values of John and Matthies, doi:10.1002/fld.195.
"""

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from mpi4py import MPI

from coudalfish import CouDALFISh, CouplingOptions
from shnapr import Shell, StVenantKirchhoff
from shnapr.supports import fixed
from tigar_x import PlaneField, Results, against, checks, draw, generalized_alpha, over_time, script, with_results
from tigar_x.geometry import surfaces
from tigar_x.run.summary import deviations
from tigar_x.splines import sampling
from varmint import Flow, FlowOptions, PointValues, Traction, Velocity, box, movie
from varmint.problems.cylinder import DIAMETER, FRONT_AND_REAR, HEIGHT, PUBLISHED
from varmint.profiles import parabola

TOY = {"cells": 10, "dt": 0.1, "until": 0.5}
SPEED, RHO, MU, LENGTH, CENTER = 0.2, 1.0, 1e-3, 2.2, np.mean(FRONT_AND_REAR, axis=0)
PRESETS = {
    "reference": ({"immersed": "plain"}, CouplingOptions.reference()),
    "plain": ({"immersed": "plain"}, CouplingOptions()),
    "converged": ({"immersed": "plain", "options": FlowOptions(subscales="dynamic")}, CouplingOptions.converged()),
    "sharp": ({"immersed": "jump and kink", "options": FlowOptions(subscales="dynamic")}, CouplingOptions.sharp()),
}
"""By name: what the flow has besides what all have, and how it is coupled."""


@dataclass(frozen=True)
class Immersed:
    """The channel and the cylinder, discretised.

    Attributes:
        cells: of the fluid across the channel's height.
        dt: time step.
        preset: the published algorithm, plain fields with a multiplier that lags, or what does not know the time step:
            a converged multiplier and dynamic sub-scales, with plain fields or, sharp, ones that jump and bend.
        diagonal: how the diagonals rise that make triangles of squares; alternating ones have no part in the lift.
    """

    cells: int = 40
    dt: float = 0.02
    preset: Literal[tuple(PRESETS)] = "sharp"
    diagonal: Literal["right", "left", "alternating"] = "right"

    def build(self) -> tuple[Flow, Shell, CouDALFISh]:
        """The parabola's flow and the cylinder, and both coupled."""
        n, more, options = checks.whole("cells", self.cells, 6), *PRESETS[self.preset]
        mesh = box(MPI.COMM_WORLD, (0, 0), (LENGTH, HEIGHT), (round(LENGTH / HEIGHT * n), n), diagonal=self.diagonal)
        sides = [Velocity(("bottom", "top")), Velocity("left", parabola(HEIGHT, SPEED)), Traction("right")]
        flow = Flow(mesh, sides, rho=RHO, mu=MU, dt=self.dt, scheme=generalized_alpha(0.0), **more)
        flow.start(parabola(HEIGHT, SPEED))
        parts = round(2.0 * np.pi * DIAMETER * n / HEIGHT)  # two in the length of a cell
        circle = surfaces.full_circle(radius=DIAMETER / 2.0, center=CENTER, elements=parts)
        shell = Shell(circle, StVenantKirchhoff(1.0, 0.3, 0.01), density=1.0, zero_dofs=fixed(circle))
        return flow, shell, CouDALFISh(flow, shell, options)


@with_results(checkpoint_every=0)
def main(results: Results, scene: Immersed, until: float = 8.0) -> dict[str, Any]:
    """March to the steady flow around an immersed cylinder, and compare its forces with the published ones.

    Args:
        until: end; the flow is steady from about 6 on.
    """
    flow, shell, fsi = scene.build()
    cell, columns = np.outer((-1.0, 1.0), (HEIGHT / scene.cells, 0.0)), {"t_alpha": "t_alpha", "passes": "passes"}
    near, far, inside = (PointValues(flow, x) for x in (FRONT_AND_REAR + cell, FRONT_AND_REAR + 2.0 * cell, [CENTER]))
    columns["drag", "lift"] = lambda report: np.divide(report.monitors.force, RHO * SPEED**2 * DIAMETER / 2.0)
    columns["dp"] = lambda: -np.diff((2.0 * near() - far())[:, -1])[0] / (RHO * SPEED**2)
    columns |= {"pressure_inside": lambda: inside()[0, -1] / (RHO * SPEED**2), "leak": "monitors.leak"}
    run = results.run(fsi, until=until, frames=20, series=[movie(flow, results.out / "fluid.vtkhdf")], history=columns)
    past, (doi, known) = run.through().history, PUBLISHED[20.0, True]
    if run.finished and results.viz:
        seen = {"length": "m", "immersed": sampling.line(shell.spline, 0, 129).positions(shell.y)}
        field = PlaneField(flow.w, sides=flow.sides)
        fields = field.speed("m/s", **seen), field.signed("pressure", "Pa", **seen)
        look = {"levels": {f"published {name}": known[name] for name in ("drag", "lift")}, "ylim": (-1.0, 8.0)}
        course = over_time(past, {"drag": "drag", "lift": "lift"}, y=("coefficient", "-"), time="s", **look)
        draw(results.out / "immersed_cylinder.png", *fields, course, columns=1, size=(10.0, 2.6))
    drag, qoi = past.course("drag").last(share=0.1), against({name: past[name][-1] for name in known}, known, doi)
    monitors = {"drift": np.ptp(drag.y) / abs(drag.y[-1]), "pressure_inside": past["pressure_inside"][-1]}
    return results.of_run(run, doi=doi, qoi=qoi, errors=deviations(qoi), monitors=monitors)


if __name__ == "__main__":
    script.command_line(main)
