"""Two surfaces in one cell, see ``space.py``.

- :class:`Pair`: two plates within one cell, which a pressure pushes against each other.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from scene import COMM, Coupled, Found, Setting, immersed_flow, rigid
from space import AROUND, IN_SPACE, ITERATIVE, from_above, iterations, rectangle

from shnapr import ContactRecipe, LinearKernel, Shell, StVenantKirchhoff
from shnapr.supports import fixed
from tigar_x import generalized_alpha
from tigar_x.geometry import multipatch
from varmint import Slip, box


@dataclass(frozen=True)
class Pair:
    """Two plates across the unit cube with slip walls, less than a cell apart; a pressure acts on the upper one.

    The lower plate is held. The upper one is held as well, or moves along the third axis alone and rests on contact,
    which balances the jump at the distance from which it starts. Then the exact velocity is zero, and the fluid
    between the plates has no pressure.

    Attributes:
        apart: distance of the plates, in cells of the fluid.
        n: fluid cells along a side.
        dt: time step.
        steps: number of them.
        rho: density.
        mu: viscosity.
        jump: of the pressure.
        touching: whether the upper plate moves and contact holds it.
        place: of the lower plate above the mesh's plane below the middle, in cells of the fluid.
        slope: of both along the first two axes.
        thickness: of the plates.
        youngs_modulus: over the jump.
        density: of the plates.
    """

    apart: float = 0.5
    n: int = 8
    dt: float = 1e-4
    steps: int = 50
    rho: float = 1.0
    mu: float = 0.04
    jump: float = 1e5
    touching: bool = False
    place: float = 0.3
    slope: tuple[float, float] = (0.0, 0.0)
    thickness: float = 0.04
    youngs_modulus: float = 1e3
    density: float = 1.0

    def build(self, setting: Setting) -> Coupled:
        """The scene at rest, without its load."""
        h = 1.0 / self.n
        gap = self.apart * h
        mesh = box(COMM, (0.0,) * 3, (1.0,) * 3, (self.n,) * 3)
        known = {"rho": self.rho, "mu": self.mu, "dt": self.dt, "scheme": generalized_alpha(0.5)}
        if setting.flow.solver is None:
            setting = replace(setting, flow=replace(setting.flow, solver=ITERATIVE))
        flow = immersed_flow(mesh, [Slip(AROUND), *from_above(self.jump)], setting, **known)
        low, (a, b) = (self.n // 2 - 1 + self.place) * h, self.slope
        # twice as many points as the range of contact needs, which is as long as the plates are apart, and a third more
        size = min(h, gap) if self.touching else h
        plates = [
            rectangle((0.0, 0.0, z - 0.5 * (a + b)), (1.0, 0.0, a), (0.0, 1.0, b), size) for z in (low, low + gap)
        ]
        geometry = multipatch.disjoint(*plates)
        material = StVenantKirchhoff(self.youngs_modulus * self.jump, 0.3, self.thickness)
        if not self.touching:
            return Coupled(flow, rigid(geometry), setting)
        reach = gap / 0.75
        # plates at a distance d press with pi k d (range - d)^2
        contact = ContactRecipe(
            LinearKernel(reach, self.jump / (math.pi * gap * (reach - gap) ** 2)), r_self=1.3 * reach, spacing=None
        )
        upper = fixed(geometry, patch=1)
        held = np.union1d(fixed(geometry, patch=0), upper[upper % 3 != 2])
        return Coupled(flow, Shell(geometry, material, density=self.density, zero_dofs=held, contact=contact), setting)

    def run(self, setting: Setting = IN_SPACE) -> Found:
        """Let the pressure act.

        Figures: "velocity", the largest at a node at the end, and "highest", the largest on the way; "leak", the sum
        of the flows through both; "force" of the fluid on both along the third axis, how far it is off, over the jump;
        "distance" of the middles over that at the start, less one; "contact", how far its load is off, likewise, or
        nan without it; "iterations" of the linear solver per pass.
        """
        scene = self.build(setting)
        speeds = []
        for _ in range(self.steps):
            report = scene.step()
            speeds.append(scene.fsi.fluid.speed())
        monitors, touch = report.monitors, report.contact
        x = scene.shell.positions.reshape(2, -1, 3)[..., 2].mean(axis=1)
        return scene.found(
            velocity=speeds[-1],
            highest=max(speeds),
            leak=monitors.leak if monitors else math.nan,
            force=abs(monitors.force[2]) / self.jump - 1.0 if monitors else math.nan,
            distance=float(abs(x[1] - x[0])) * self.n / self.apart - 1.0,
            contact=touch.load / self.jump - 1.0 if touch else math.nan,
            iterations=iterations(scene),
        )
