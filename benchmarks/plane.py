"""Plane scenes with known answers that judge what happens at an immersed surface, see ``scene.py``.

Lengths, densities and jumps of pressure are of the order of one, and h is the size of the fluid's cells.

- :class:`HeldSheet`: an arc or a straight sheet across a duct under a jump of pressure; nothing should flow.
- :class:`Ring`: a closed elastic ring that starts as an ellipse; its area should stay.
- :class:`Flag`: a flag that is held at one end flaps in a stream.
- In ``plane_swinging.py`` a string and a plate that swing, in ``plane_gaps.py`` a slit.
"""

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import ufl
from scene import COMM, IN_PLANE, Coupled, Found, Setting, immersed_flow, rigid

from coudalfish import CouDALFISh
from shnapr import DeadLoad, Shell, StVenantKirchhoff
from shnapr.supports import pinned
from tigar_x import generalized_alpha
from tigar_x.compat import FloatArray
from tigar_x.geometry import shapes
from tigar_x.geometry.gluing import glued
from tigar_x.geometry.patch import Patch
from tigar_x.run.course import Course
from varmint import Slip, Traction, Velocity, box
from varmint.mesh.named import grid

# -- at rest ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class HeldSheet:
    """Duct (0, 2) x (0, 1) with slip walls and a sheet across it that is held, under a jump of pressure.

    The exact velocity is zero. With plain fields the largest velocity over the jump is 3.0e-3, 1.5e-3, 7.8e-4
    for n = 16, 32, 64; long runs of shorter steps show whether a pattern of the multiplier grows.

    Attributes:
        n: fluid cells across.
        dt: time step.
        steps: after the load.
        ramp: steps in which the load is raised.
        rho: density.
        mu: viscosity.
        jump: of the pressure.
        place: of the sheet's ends beside the line of the mesh in the middle, in cells of the fluid.
        bow: height of its arc; 0: straight.
        per_cell: elements of the sheet per cell of the fluid.
    """

    n: int = 16
    dt: float = 1.0
    steps: int = 20
    ramp: int = 10
    rho: float = 1.0
    mu: float = 0.1
    jump: float = 1.0
    place: float = 0.37
    bow: float = 0.1
    per_cell: float = 2.0

    def build(self, setting: Setting) -> Coupled:
        """The scene at rest, without its load."""
        mesh, end = box(COMM, (0.0, 0.0), (2.0, 1.0), (2 * self.n, self.n)), self.ramp * self.dt

        def load(x: Any, t: Any) -> Any:
            return ufl.as_vector([self.jump * 0.5 * (1.0 - ufl.cos(math.pi * ufl.min_value(t / end, 1.0))), 0.0])

        ends = [Traction("left", load), Traction("right"), Slip(("bottom", "top"))]
        flow = immersed_flow(mesh, ends, setting, rho=self.rho, mu=self.mu, dt=self.dt, scheme=generalized_alpha(0.0))
        x = 1.0 + self.place / self.n
        line = shapes.line((x, 0.0), (x, 1.0), elements=round(self.per_cell * self.n))
        s = line.points[:, 1]
        arc = Patch.from_points(line.bases, line.points + np.outer(4.0 * self.bow * s * (1.0 - s), (1.0, 0.0)))
        return Coupled(flow, rigid(arc), setting)

    def run(self, setting: Setting = IN_PLANE) -> Found:
        """Load it, and let it rest.

        Figures: "velocity", the largest at a node, and "leak" through the sheet's length, over the jump; "grown", the
        velocity relative to that after half of the steps; "pattern" and "growth" of the multiplier, the largest
        difference from its mean, and its change in the second half of the steps per 1000 of them, over the jump; and
        how far its mean is off, "load".
        """
        scene = self.build(setting)
        fsi, half = scene.fsi, self.ramp + self.steps // 2
        W = fsi.shell.quadrature.weights
        for _ in range(half):
            scene.step()
        before, speed = self._along(fsi), fsi.fluid.speed()
        for _ in range(self.ramp + self.steps - half):
            report = scene.step()
        after, mean = self._along(fsi), float(np.average(self._along(fsi), weights=W))
        pattern = after - mean
        change = pattern - (before - np.average(before, weights=W))
        leak = report.monitors.leak / W.sum() if report.monitors else math.nan
        return scene.found(
            velocity=fsi.fluid.speed() / self.jump,
            leak=leak / self.jump,
            grown=fsi.fluid.speed() / speed if speed else 1.0,
            pattern=float(np.abs(pattern).max()) / self.jump,
            growth=float(np.abs(change).max()) / self.jump * 1000.0 / max(1, self.steps - self.steps // 2),
            load=mean / self.jump - 1.0,
        )

    @staticmethod
    def _along(fsi: CouDALFISh) -> FloatArray:
        """The multiplier along the normals."""
        return fsi.lam if fsi.lam.ndim == 1 else np.einsum("qi,qi->q", fsi.lam, fsi.shell.normals())

    def shifted(self, setting: Setting = IN_PLANE, places: int = 20) -> list[Found]:
        """The sheet at places that are equally spaced within a cell of the fluid."""
        return [replace(self, place=self.place + k / places).run(setting) for k in range(places)]


LOADED_ARC = HeldSheet(n=12, dt=0.01, steps=2000, ramp=60, mu=0.01, place=0.0)
"""What ``benchmarks/relaxation.py`` runs as well: without relaxation of the multiplier a pattern of it grows."""


@dataclass(frozen=True)
class Ring:
    """A closed elastic ring in the unit box, which its tension draws from an ellipse to a circle.

    Attributes:
        n: fluid cells along a side.
        dt: time step.
        steps: number of them.
        mu: viscosity; the density is one.
        axes: of the ellipse.
        tension: at the start.
        stiffness: E times the thickness.
        mass: of the ring per length.
        per_cell: elements per cell of the fluid, about.
    """

    n: int = 32
    dt: float = 0.02
    steps: int = 50
    mu: float = 0.1
    axes: tuple[float, float] = (0.3, 0.2)
    tension: float = 1.0
    stiffness: float = 1.0
    mass: float = 0.1
    per_cell: float = 2.0

    def build(self, setting: Setting) -> Coupled:
        """The scene at its start."""
        mesh = box(COMM, (0.0, 0.0), (1.0, 1.0), (self.n, self.n))
        walls = [Velocity(("left", "right", "bottom", "top"))]
        known = {"rho": 1.0, "mu": self.mu, "dt": self.dt, "scheme": generalized_alpha(0.5)}
        flow = immersed_flow(mesh, walls, setting, pin_at=(0.0, 0.0), **known)
        (a, b), number = self.axes, round(self.per_cell * self.n * math.pi * sum(self.axes))
        angles = 2.0 * math.pi * np.linspace(0.0, 1.0, number + 1)
        points = np.column_stack([0.5 + a * np.cos(angles), 0.5 + b * np.sin(angles)])
        points[-1] = points[0]
        ring = glued(Patch.from_points(shapes.uniform_bases([1], [number], 1), points), within=True)
        material = StVenantKirchhoff(self.stiffness / 0.01, 0.3, 0.01, prestress=(self.tension,), bending=False)
        return Coupled(flow, Shell(ring, material, density=self.mass / 0.01), setting)

    def run(self, setting: Setting = IN_PLANE) -> Found:
        """Let it go.

        Figures: "area", its change relative to the start, "lost", the largest on the way; "velocity" at the end over
        tension/mu; "roundness", smallest over largest distance from the centre.
        """
        scene = self.build(setting)
        areas = [self._area(scene)]
        for _ in range(self.steps):
            scene.step()
            areas.append(self._area(scene))
        change = np.array(areas) / areas[0] - 1.0
        away = np.linalg.norm(scene.shell.positions - scene.shell.positions.mean(axis=0), axis=1)
        return scene.found(
            area=float(change[-1]),
            lost=float(np.abs(change).max()),
            velocity=scene.fsi.fluid.speed() * self.mu / self.tension,
            roundness=float(away.min() / away.max()),
        )

    @staticmethod
    def _area(scene: Coupled) -> float:
        x, edges = scene.shell.positions, scene.fsi.shell.sheets.cells
        start, end = x[edges[:, 0]], x[edges[:, 1]]
        return abs(float(0.5 * np.sum(start[:, 0] * end[:, 1] - start[:, 1] * end[:, 0])))


# -- a free end -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Flag:
    """A flag of length one in a stream of speed and density one; its front end is held, it hangs along the stream.

    The data are those of a filament of Huang, Shin and Sung, doi:10.1016/j.jcp.2007.07.002: it starts straight and at
    rest, at an angle to the stream, and flaps for ever. It can stretch here, by about a thousandth. Near it the mesh is
    uniform, elsewhere its cells grow.

    Attributes:
        n: fluid cells in the length.
        dt: time step.
        until: end of the run; the last half of it counts.
        reynolds: Reynolds number of the length.
        mass: per area, over that of the fluid in a cube of its length.
        bending: stiffness over the mass.
        weight: per mass, along the stream.
        stretching: stiffness.
        angle: at the start.
        ahead: of the mesh, before the flag.
        behind: likewise.
        beside: likewise.
    """

    n: int = 16
    dt: float = 0.01
    until: float = 30.0
    reynolds: float = 200.0
    mass: float = 1.5
    bending: float = 1.5e-3
    weight: float = 0.5
    stretching: float = 1e3
    angle: float = 0.1 * math.pi
    ahead: float = 2.0
    behind: float = 5.0
    beside: float = 4.0

    def build(self, setting: Setting) -> Coupled:
        """The flag at rest in the stream."""
        x = _graded(-self.ahead, 1.0 + self.behind, (-0.25, 1.5), 1.0 / self.n)
        y = _graded(-self.beside, self.beside, (-0.625, 0.625), 1.0 / self.n)
        sides = [Velocity("left", (1.0, 0.0)), Slip(("bottom", "top")), Traction("right")]
        known = {"rho": 1.0, "mu": 1.0 / self.reynolds, "dt": self.dt, "scheme": generalized_alpha(0.5)}
        flow = immersed_flow(grid(COMM, (x, y)), sides, setting, **known)
        flow.start((1.0, 0.0))
        line = shapes.line((0.0, 0.0), (math.cos(self.angle), math.sin(self.angle)), elements=self.n, degree=2)
        thickness = math.sqrt(12.0 * self.bending * self.mass / self.stretching)
        material = StVenantKirchhoff(self.stretching / thickness, 0.0, thickness)
        load = DeadLoad((self.mass * self.weight, 0.0))
        known = {"density": self.mass / thickness, "zero_dofs": pinned(line, "u0"), "loads": [load]}
        return Coupled(flow, Shell(line, material, **known), setting)

    def run(self, setting: Setting = IN_PLANE) -> Found:
        """Let it flap.

        Figures: "amplitude" of its end across the stream, half of what it passes, "period" and "drag", means over the
        last half of the run, and "leak", the largest flow through it over that of the stream through its length.
        """
        scene = self.build(setting)
        end = math.sin(self.angle)
        for _ in range(round(self.until / self.dt)):
            scene.step(lambda: end + scene.shell.at("u1").displacement[1])
        late = scene.reports[len(scene.reports) // 2 :]
        course = Course([report.t for report in late], [report.measured for report in late])
        rises = course.rises(0.0)
        monitors = [report.monitors for report in scene.reports if report.monitors]
        return scene.found(
            amplitude=0.5 * float(np.ptp(course.y)),
            period=float(np.diff(rises).mean()) if len(rises) > 1 else math.nan,
            drag=float(np.mean([each.force[0] for each in monitors[len(scene.reports) // 2 :]])),
            leak=max(abs(each.leak) for each in monitors),
        )


def _graded(low: float, high: float, uniform: tuple[float, float], h: float, growth: float = 1.15) -> FloatArray:
    """Lines of a mesh that are h apart in a part of it; outside cells grow by a factor, about."""
    a, b = uniform
    sides = []
    for length in (a - low, high - b):
        count = math.ceil(math.log1p(length * (growth - 1.0) / (growth * h)) / math.log(growth))
        steps = growth ** np.arange(1, count + 1)
        sides.append(length * np.cumsum(steps) / steps.sum())
    return np.concatenate([a - sides[0][::-1], np.linspace(a, b, round((b - a) / h) + 1), b + sides[1]])
