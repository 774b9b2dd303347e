"""Quasi-static and dynamic sub-scales: errors against the time step in steady and unsteady flow, and what they cost.

Taylor and Green's vortices drift through the square (-pi, pi)^2 with the velocity (1, 1/2); the time is 1 at the end.
The steady cylinder (Re = 20) is marched until drag and lift stay. Steady flow alone is what a march should find.
"""

import time
from pathlib import Path
from typing import Any

import numpy as np
import ufl
from mpi4py import MPI

from tigar_x.run import script
from tigar_x.run.summary import table
from varmint import Flow, FlowOptions, WeakVelocity, box, velocity_errors
from varmint.problems.cylinder import PUBLISHED, Channel, Coefficients

NU, DRIFT, KINDS = 0.01, (1.0, 0.5), ("quasi-static", "dynamic")
VORTICES = ("k", "cells", "steps", "sub-scales", "L2 u", "H1 u", "Newton iterations", "ms a step")
CYLINDER = ("dt", "sub-scales", "drag, error %", "lift, error", "from steady flow, drag %", "steps", "ms a step")


def vortices(x: Any, t: Any) -> Any:
    """Velocity of the drifting vortices, exact without a force."""
    a, b = (x[i] - DRIFT[i] * t for i in range(2))
    decay = ufl.exp(-2 * NU * t)
    return ufl.as_vector([DRIFT[0] + decay * ufl.sin(a) * ufl.cos(b), DRIFT[1] - decay * ufl.cos(a) * ufl.sin(b)])


def drift(degree: int, cells: int, steps: int, kind: str) -> list[Any]:
    """Row of a run."""
    mesh = box(MPI.COMM_SELF, (-np.pi,) * 2, (np.pi,) * 2, (cells, cells))
    walls, options = WeakVelocity(mesh.facet_names, vortices), FlowOptions(subscales=kind)
    flow = Flow(mesh, walls, rho=1.0, mu=NU, degree=degree, dt=1.0 / steps, options=options)
    flow.start(vortices, projected=True)
    flow.compile()
    start = time.process_time()
    iterations = sum(flow.take_step().iterations for _ in range(steps)) / steps
    spent = 1e3 * (time.process_time() - start) / steps
    found = velocity_errors(flow, vortices, 2 * degree + 4)
    return [degree, cells, steps, kind, found["L2_u"], found["H1_u"], iterations, spent]


def march(size: float, dt: float, kind: str) -> list[Any]:
    """Row of the cylinder, from steady flow until nothing changes any more."""
    options, known = FlowOptions(subscales=kind), PUBLISHED[20.0, True][1]
    steady = Channel(20.0, steady=True, degree=1, size=size).build(options=options)
    steady.solve()
    alone = Coefficients(steady)()
    flow = Channel(20.0, degree=1, size=size, dt=dt, rho_infinity=0.0).build(
        options=FlowOptions(subscales=kind, rtol=1e-10), ramp=0.0
    )
    flow.w.x.array[:] = steady.w.x.array
    flow.time.forget()
    flow.compile()
    measure, steps, before = Coefficients(flow), 0, alone + 1.0
    start = time.process_time()
    while steps < 3000:
        now = flow.take_step(measure).measured
        steps += 1
        if steps % 20 == 0:
            if np.abs(now - before).max() < 1e-8 * dt:
                break
            before = now
    spent = 1e3 * (time.process_time() - start) / steps
    drag = 100.0 * (now[0] / known["drag"] - 1.0)
    return [dt, kind, drag, now[1] - known["lift"], 100.0 * (now[0] / alone[0] - 1.0), steps, spent]


def main(size: float = 0.06, out: Path = Path("results/benchmarks/flow_subscales")) -> None:
    """Compare sub-scales of flow.

    Args:
        size: of the cylinder's cells far away.
        out: folder of the results.
    """
    meshes = (1, 16), (1, 32), (2, 8), (2, 16)
    rows = [drift(*mesh, n * mesh[1], kind) for mesh in meshes for n in (1, 8, 64) for kind in KINDS]
    text = table(VORTICES, rows)
    text += "\n\n" + table(CYLINDER, [march(size, dt, kind) for dt in (0.05, 0.02, 0.005, 0.0025) for kind in KINDS])
    print(text)
    out.mkdir(parents=True, exist_ok=True)
    (out / "table.txt").write_text(text + "\n")


if __name__ == "__main__":
    script.command_line(main)
