"""Closed surfaces in space, see ``space.py``.

- :class:`Sphere`: a closed membrane whose tension the pressure inside balances; nothing should move.
- :class:`Obstacle`: a rigid sphere in a stream; ``space_fitted.py`` has its drag.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scene import COMM, Coupled, Found, Setting, immersed_flow, rigid
from space import AROUND, IN_SPACE, along_normals, pressure_error

from shnapr import Shell, StVenantKirchhoff
from tigar_x import generalized_alpha
from tigar_x.compat import FloatArray
from tigar_x.geometry import shapes
from tigar_x.geometry.gluing import glued
from tigar_x.geometry.multipatch import MultiPatch
from varmint import PointValues, Slip, Traction, Velocity, box


def ball(radius: float, center: Sequence[float], elements: int, *, quarter: bool = False) -> MultiPatch:
    """A sphere of six quadratic patches without poles, whose normals point outwards.

    Args:
        radius: of the sphere.
        center: likewise.
        elements: in half of a patch's side, an eighth of a circle.
        quarter: whether to leave out what is more than an element below the middle of the second and third axis.
    """
    h, patches = 1.0 / elements, []
    for axis, sign in ((0, 1), (0, -1), (1, 1), (2, 1), (1, -1), (2, -1)):
        if quarter and sign < 0 and axis:
            continue
        one, other = ((axis + k) % 3 for k in ((1, 2) if sign > 0 else (2, 1)))
        starts = [-h if quarter and k else -1.0 for k in (one, other)]

        def surface(u: FloatArray, v: FloatArray, at: Any = (axis, sign, one, other, starts)) -> FloatArray:
            k, s, i, j, low = at
            x = np.empty((3, len(u)))
            x[k] = s
            for m, parameter, start in ((i, u, low[0]), (j, v, low[1])):
                x[m] = np.tan(0.25 * math.pi * (start + (1.0 - start) * parameter))
            return np.asarray(np.asarray(center)[:, None] + radius * x / np.linalg.norm(x, axis=0))

        numbers = [round((1.0 - start) * elements) for start in starts]
        patches.append(shapes.interpolated(surface, shapes.uniform_bases([2, 2], numbers, 2)))
    return glued(*patches)


@dataclass(frozen=True)
class Sphere:
    """A closed membrane in the unit cube, full of fluid and at rest: its tension balances the pressure inside.

    The fluid starts without pressure, which is zero in a corner. The exact velocity is zero, and the pressure inside
    the jump.

    Attributes:
        n: fluid cells along a side.
        dt: time step.
        steps: number of them.
        mu: viscosity; the density is one.
        jump: of the pressure.
        radius: of the sphere.
        center: of the sphere, out of the mesh's symmetry.
        stiffness: E times the thickness over the tension.
        mass: per area.
        per_cell: elements per cell of the fluid, about.
    """

    n: int = 8
    dt: float = 0.05
    steps: int = 5
    mu: float = 0.1
    jump: float = 1.0
    radius: float = 0.3
    center: tuple[float, float, float] = (0.513, 0.507, 0.491)
    stiffness: float = 10.0
    mass: float = 0.1
    per_cell: float = 1.0

    def build(self, setting: Setting) -> Coupled:
        """The scene at its start."""
        mesh = box(COMM, (0.0,) * 3, (1.0,) * 3, (self.n,) * 3)
        known = {"rho": 1.0, "mu": self.mu, "dt": self.dt, "scheme": generalized_alpha(0.5)}
        flow = immersed_flow(mesh, [Velocity((*AROUND, "back", "front"))], setting, pin_at=(0.0,) * 3, **known)
        eighth = 0.25 * math.pi * self.radius
        membrane = ball(self.radius, self.center, max(2, round(eighth * self.per_cell * self.n)))
        tension, t = 0.5 * self.jump * self.radius, 0.01
        elastic = {"prestress": (tension, tension, 0.0), "bending": False}
        material = StVenantKirchhoff(self.stiffness * tension / t, 0.3, t, **elastic)
        return Coupled(flow, Shell(membrane, material, density=self.mass / t), setting)

    def run(self, setting: Setting = IN_SPACE) -> Found:
        """Let it go.

        Figures: "velocity", the largest at a node, times the viscosity over the tension; "volume", its change relative
        to the start; "inside", how far the pressure in the middle is off over the jump, "pressure", its error in L2
        likewise; "load" and "pattern" of the multiplier as of :class:`HeldSurface`; "roundness", smallest over largest
        distance from the centre.
        """
        scene = self.build(setting)
        start = self._volume(scene)
        for _ in range(self.steps):
            scene.step()
        lam, W = along_normals(scene), scene.fsi.shell.quadrature.weights
        mean, away = float(np.average(lam, weights=W)), np.linalg.norm(scene.shell.positions - self.center, axis=1)
        middle = PointValues(scene.flow, [self.center])()[0, 3]

        def outside(x: FloatArray) -> FloatArray:
            return np.asarray(np.linalg.norm(x - self.center, axis=1) - self.radius)

        error = pressure_error(
            scene.flow, lambda x: np.where(outside(x) < 0.0, self.jump, 0.0), lambda x: np.abs(outside(x))
        )
        return scene.found(
            velocity=scene.fsi.fluid.speed() * self.mu / (0.5 * self.jump * self.radius),
            volume=self._volume(scene) / start - 1.0,
            inside=middle / self.jump - 1.0,
            pressure=error / self.jump,
            load=abs(mean) / self.jump - 1.0,
            pattern=float(np.abs(lam - mean).max()) / self.jump,
            roundness=float(away.min() / away.max()),
        )

    def _volume(self, scene: Coupled) -> float:
        """By the triangles about the middles of its quadrilaterals."""
        x, quads = scene.shell.positions - self.center, scene.fsi.shell.sheets.cells
        corners = x[quads]
        return abs(float(sum(
            np.linalg.det(np.stack([corners[:, i], corners[:, j], corners.mean(axis=1)], axis=1)).sum()
            for i, j in ((0, 1), (1, 2), (2, 3), (3, 0))
        ))) / 6.0  # fmt: skip


@dataclass(frozen=True)
class Obstacle:
    """A rigid sphere of diameter one on the axis of the channel (-1.5, 2.5) x (-1, 1) x (-1, 1) with slip walls.

    A quarter of it is computed, with planes of symmetry through the axis. Fluid of density one comes in with speed one.

    Attributes:
        n: fluid cells in the diameter.
        dt: time step.
        until: end, at which the flow counts as steady.
        before: time step with which it is marched to its steady state before; None: that of the run.
        reynolds: Reynolds number of the diameter.
        place: of the sphere's middle along the channel, in cells of the fluid.
        per_cell: elements of the sphere per cell of the fluid, about.
    """

    n: int = 16
    dt: float = 0.1
    until: float = 6.0
    before: float | None = None
    reynolds: float = 20.0
    place: float = 0.37
    per_cell: float = 1.0

    def build(self, setting: Setting) -> Coupled:
        """The scene at its start, in a uniform stream."""
        mesh = box(COMM, (-1.5, 0.0, 0.0), (2.5, 1.0, 1.0), (4 * self.n, self.n, self.n))
        dt = self.dt if self.before is None else self.before
        known = {"rho": 1.0, "mu": 1.0 / self.reynolds, "dt": dt, "scheme": generalized_alpha(0.0)}
        sides = [Velocity("left", (1.0, 0.0, 0.0)), Slip(("bottom", "top", "back", "front")), Traction("right")]
        flow = immersed_flow(mesh, sides, setting, **known)
        flow.start((1.0, 0.0, 0.0))
        elements = max(2, round(0.125 * math.pi * self.per_cell * self.n))
        return Coupled(flow, rigid(ball(0.5, (self.place / self.n, 0.0, 0.0), elements, quarter=True)), setting)

    def run(self, setting: Setting = IN_SPACE) -> Found:
        """Let it flow.

        Figures: "drag" of the whole sphere over that of a unit square in the stream, ``2 F/(rho U^2 D^2)``; "change",
        that in the last twentieth of the run relative to it; "slip", the root mean square of what passes the sphere.
        """
        scene, until = self.build(setting), self.until
        if self.before is not None:
            for _ in range(round(until / self.before)):
                scene.step()
            scene.fsi.step_size, until = self.dt, 0.1 * until
        for _ in range(round(until / self.dt)):
            scene.step()
        end = scene.reports[-1].t
        drag = [8.0 * report.monitors.force[0] for report in scene.reports if report.monitors]
        late = [d for d, report in zip(drag, scene.reports, strict=True) if report.t >= end - 0.05 * self.until]
        monitors = scene.reports[-1].monitors
        return scene.found(
            drag=drag[-1],
            change=float(np.ptp(late)) / drag[-1],
            slip=monitors.normal_slip_rms if monitors else math.nan,
        )
