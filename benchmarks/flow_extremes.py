"""Stiff and extreme cases of flow: what ran, what was refused, what was observed.

Every case is a function of one value of its range and gives an :class:`Outcome`; `tests/test_flow_extremes.py` asserts
on the same outcomes that this script tabulates.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import ufl
from mpi4py import MPI
from load import load_demo

from tigar_x.fem.linear import direct, gmres_ilu
from tigar_x.fem.schemes import backward_euler, generalized_alpha
from tigar_x.run import script
from varmint.conditions import Slip, Traction, Velocity, WeakVelocity
from varmint.flow import Flow, FlowError, FlowOptions
from varmint.forms.motion import ElasticMotion
from varmint.forms.space import split
from varmint.mesh import box, grid
from varmint.problems.cylinder import DIAMETER, SPEED, Channel, Coefficients
from varmint.quantities import Measured, kinetic_energy

SIDES = ("left", "right", "bottom", "top")
SOLVERS = {"null space": gmres_ilu(), "pin": direct()}
HEADER = ("case", "value", "result", "iterations mean/max", "observed", "message")


@dataclass
class Outcome:
    """What a case did.

    Attributes:
        result: "ran", "no steady flow" or "stopped".
        observed: measured numbers by name.
        iterations: of every step or of the steady solve.
        message: of the error.
    """

    result: str = "ran"
    observed: dict[str, float] = field(default_factory=dict)
    iterations: list[int] = field(default_factory=list)
    message: str = "-"

    @property
    def is_finite(self) -> bool:
        """Whether all observed numbers are finite."""
        return all(math.isfinite(value) for value in self.observed.values())

    def cells(self, name: str, value: Any) -> list[str]:
        """A line of the table."""
        counts = f"{np.mean(self.iterations):.1f}/{max(self.iterations)}" if self.iterations else "-"
        observed = ", ".join(f"{key} {number:.3g}" for key, number in self.observed.items())
        return [name, str(value), self.result, counts, observed or "-", self.message[:160]]


def speed(flow: Flow) -> float:
    """Largest nodal speed."""
    d = flow.mesh.domain.geometry.dim
    v = flow.w.x.array.reshape(-1, d + 1)[:, :d]
    return float(flow.mesh.domain.comm.allreduce(np.sqrt((v**2).sum(axis=1)).max(initial=0.0), op=MPI.MAX))


def pressures(flow: Flow) -> Any:
    """Nodal pressures of this rank."""
    d = flow.mesh.domain.geometry.dim
    return flow.w.x.array.reshape(-1, d + 1)[:, d]


def steady(flow: Flow, measure: Callable[[Flow], Mapping[str, float]]) -> Outcome:
    """Outcome of a steady solve."""
    try:
        report = flow.solve()
    except FlowError as error:
        return Outcome("no steady flow", message=str(error))
    return Outcome(observed={"speed": speed(flow), **measure(flow)}, iterations=[report.iterations])


def stepped(flow: Flow, steps: int, measure: Callable[[Flow], Mapping[str, float]] = lambda flow: {}) -> Outcome:
    """Outcome of some steps."""
    iterations = []
    for _ in range(steps):
        try:
            iterations.append(flow.take_step().iterations)
        except FlowError as error:
            return Outcome("stopped", {"speed": speed(flow)}, iterations, str(error))
    return Outcome(observed={"speed": speed(flow), **measure(flow)}, iterations=iterations)


def lid(x: Any, t: Any) -> Any:
    """Velocity of a lid whose speed vanishes at its ends."""
    return ufl.as_vector([16.0 * x[0] ** 2 * (1 - x[0]) ** 2, 0.0])


def cavity(reynolds: float, n: int = 16, **more: Any) -> Flow:
    """Cavity with a moving lid; an infinite Reynolds number is a fluid without viscosity."""
    conditions = [WeakVelocity(("left", "right", "bottom")), WeakVelocity("top", lid)]
    return Flow(box(MPI.COMM_WORLD, (0, 0), (1, 1), (n, n)), conditions, rho=1.0, mu=1.0 / reynolds, **more)


def cavity_steady(reynolds: float) -> Outcome:
    """Steady flow in the cavity."""
    return steady(cavity(reynolds), lambda flow: {})


def cavity_stepped(reynolds: float) -> Outcome:
    """The cavity's flow from rest, with dt = h and as many steps as fill it once."""
    return stepped(cavity(reynolds, dt=1.0 / 16), 16)


def vortex(reynolds: float) -> Outcome:
    """The Taylor-Green vortex to its end, on a coarse mesh."""
    demo = load_demo("taylor_green")
    flow = demo.Vortex().build(8)
    flow.mu.value = 1.0 / reynolds
    energy = Measured(E=kinetic_energy(flow))
    start = energy()["E"]
    return stepped(flow, 8, lambda flow: {"energy kept": energy()["E"] / start})


def cavity_dt(dt: float) -> Outcome:
    """The cavity's flow at Re = 100 from rest in five steps of any size."""
    return stepped(cavity(100.0, dt=dt, scheme=backward_euler()), 5)


def cylinder(reynolds: float, dt: float | None) -> Flow:
    """Flow around a cylinder."""
    flow = Channel(min(reynolds, 1e9), dt is None, 1, 0.08, dt or 1.0).build(ramp=0.05)
    flow.mu.value = SPEED * DIAMETER / reynolds
    return flow


def cylinder_steady(reynolds: float) -> Outcome:
    """Steady flow around the cylinder."""
    return steady(cylinder(reynolds, None), lambda flow: {"drag": Coefficients(flow)()[0]})


def cylinder_stepped(reynolds: float) -> Outcome:
    """Twenty steps around the cylinder, from rest."""
    return stepped(cylinder(reynolds, 0.01), 20)


def stretched(ratio: float) -> Outcome:
    """Parabolic flow between plates in cells that are longer than wide; linear and steady, with two errors."""
    lines = (np.linspace(0.0, ratio, 9), np.linspace(0.0, 8.0, 9))
    mesh = grid(MPI.COMM_WORLD, lines, "triangle")
    parabola = lambda x, t: ufl.as_vector([x[1] * (8.0 - x[1]) / 16.0, 0.0])  # noqa: E731
    shear = lambda x, t: ufl.as_vector([0.0, 0.1 * (8.0 - 2.0 * x[1]) / 16.0])  # noqa: E731
    conditions = [Velocity(("bottom", "top")), Velocity("left", parabola), Traction("right", shear)]
    flow = Flow(mesh, conditions, rho=1.0, mu=0.1, degree=2)

    def error(flow: Flow) -> dict[str, float]:
        v = split(flow.w)[0]
        u = parabola(ufl.SpatialCoordinate(mesh.domain), 0.0)
        found = Measured(e=ufl.inner(v - u, v - u) * mesh.dx(degree=4), u=ufl.inner(u, u) * mesh.dx(degree=4))()
        return {"relative error": math.sqrt(found["e"] / found["u"])}

    return steady(flow, error)


def backflow(gamma: float) -> Outcome:
    """A pressure at the outlet drives the fluid back in through it, against none at the inlet; low viscosity."""
    mesh = box(MPI.COMM_WORLD, (0, 0), (4, 1), (32, 8))
    push = lambda x, t: ufl.as_vector([-20.0 * ufl.sin(8.0 * t), 0.0])  # noqa: E731
    flow = Flow(
        mesh,
        [Velocity(("bottom", "top")), Traction("left", gamma=gamma), Traction("right", push, gamma=gamma)],
        rho=1.0,
        mu=1e-3,
        dt=0.02,
    )
    energy = Measured(E=kinetic_energy(flow))
    return stepped(flow, 100, lambda flow: {"kinetic energy": energy()["E"]})


def at_rest(scheme: str) -> Outcome:
    """A fluid at rest in a closed box, and one under gravity."""
    gravity = (0.0, -9.81) if scheme == "gravity" else None
    flow = Flow(
        box(MPI.COMM_WORLD, (0, 0), (1, 1), (8, 8)), [Velocity(SIDES)], rho=1e3, mu=1e-3, dt=0.01, f=gravity,
        options=FlowOptions(rtol=1e-10),
    )  # fmt: skip
    return stepped(flow, 20, lambda flow: {"pressure range": float(np.ptp(pressures(flow)))})


def closed(pressure: str) -> Outcome:
    """A thousand steps in a closed cavity: the pressure's constant must not drift."""
    swing = lambda x, t: (1.0 + ufl.sin(2.0 * ufl.pi * t) / 2.0) * lid(x, t)  # noqa: E731
    flow = Flow(
        box(MPI.COMM_WORLD, (0, 0), (1, 1), (8, 8)),
        [WeakVelocity(("left", "right", "bottom")), WeakVelocity("top", swing)],
        rho=1.0, mu=0.01, dt=0.05, options=FlowOptions(pressure=pressure, solver=SOLVERS[pressure]),
    )  # fmt: skip
    means = []
    for _ in range(10):  # ten times five periods of the lid
        done = stepped(flow, 100, lambda flow: {"largest pressure": float(np.abs(pressures(flow)).max())})
        if done.result != "ran":
            return done
        means.append(float(np.mean(pressures(flow))))
    done.observed["drift of the mean pressure"] = abs(means[-1] - means[1])
    return done


def piston(stroke: float) -> Outcome:
    """A side of a box that moves in by a part of its length in ten steps, the mesh with it; the other side is open."""
    mesh = box(MPI.COMM_WORLD, (0, 0), (1, 1), (8, 8))
    scheme, dt = generalized_alpha(0.5), 0.1
    push = lambda y, t: ufl.as_vector([stroke * t, 0.0])  # noqa: E731
    slide = lambda y, t: ufl.as_vector([stroke * t * (1.0 - y[0]), 0.0])  # noqa: E731
    moving = ElasticMotion(mesh, {"left": push, "right": None, "bottom": slide, "top": slide}, dt, scheme)
    conditions = [Velocity("left"), Slip(("bottom", "top"), strong_if_moving=True), Traction("right")]
    flow = Flow(mesh, conditions, rho=1.0, mu=0.01, dt=dt, scheme=scheme, moving=moving)
    return stepped(flow, 10, lambda flow: {"smallest J": moving.smallest_volume_ratio()})


@dataclass(frozen=True)
class Case:
    """A case: its function, its values and what must hold."""

    run: Callable[[Any], Outcome]
    values: tuple[Any, ...]
    bound: str


REYNOLDS = (1.0, 1e2, 1e3, 1e4, 1e5, 1e6)
CASES = {
    "cavity, steady, Re": Case(cavity_steady, REYNOLDS, "finite, or no steady flow is named"),
    "cavity, 16 steps, Re (inf: mu = 0)": Case(cavity_stepped, (*REYNOLDS, math.inf), "finite; speed <= 1.3"),
    "cylinder, steady, Re": Case(cylinder_steady, (1.0, 20.0, 1e3, 1e6), "finite, or no steady flow is named"),
    "cylinder, 20 steps, Re (inf: mu = 0)": Case(cylinder_stepped, (1.0, *REYNOLDS[2:], math.inf), "finite"),
    "vortex, Re (inf: mu = 0)": Case(vortex, (1.0, 1e2, 1e4, math.inf), "energy never grows"),
    "cavity, 5 steps of dt": Case(cavity_dt, (1e-6, 1e-4, 1e-2, 1.0, 1e3), "finite"),
    "cells longer than wide, ratio": Case(stretched, (1.0, 10.0, 100.0, 1e3), "finite; error below 1e-6"),
    "backflow, gamma": Case(backflow, (0.0, 0.5, 1.0), "gamma >= 1/2: runs, and the energy is bounded"),
    "at rest": Case(at_rest, ("nothing", "gravity"), "stays at rest; hydrostatic pressure"),
    "closed cavity, 1000 steps, pressure by": Case(closed, ("null space", "pin"), "no drift of the constant"),
    "piston, stroke": Case(piston, (0.1, 0.5, 0.9, 1.1), "J > 0, or the inversion is named"),
}


@cache
def outcome(name: str, value: Any) -> Outcome:
    """Outcome of a case at a value."""
    return CASES[name].run(value)


def main(out: Path = Path("results/benchmarks/flow_extremes"), only: str = "") -> None:
    """Run the cases, and print and write their table as Markdown.

    Args:
        out: folder of the results.
        only: run the cases whose name contains this.
    """
    lines = [f"| {' | '.join(HEADER)} |", f"|{' --- |' * len(HEADER)}"]
    print("\n".join(lines))
    chosen = {name: case for name, case in CASES.items() if only in name}
    for name, case in chosen.items():
        for value in case.values:
            cells = outcome(name, value).cells(name, value)
            lines.append(f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |")
            print(lines[-1], flush=True)
    bounds = ["| case | must hold |", "| --- | --- |", *(f"| {name} | {case.bound} |" for name, case in chosen.items())]
    out.mkdir(parents=True, exist_ok=True)
    (out / "flow_extremes.md").write_text("\n".join([*lines, "", *bounds, ""]))
    print(f"\nwritten: {out / 'flow_extremes.md'}")


if __name__ == "__main__":
    script.command_line(main)
