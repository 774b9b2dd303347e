"""Gaps in space, see ``space.py``.

- :class:`Slit`: two plates in one plane leave a gap, through which a jump of pressure drives the fluid.
- :class:`Hole`: a plate with a round hole, likewise.
"""

import math
from dataclasses import dataclass

import ufl
from plane_gaps import slit_flow
from scene import COMM, Coupled, Found, Setting, immersed_flow, rigid, until_steady
from space import AROUND, IN_SPACE, OVER, from_above, rectangle

from tigar_x import generalized_alpha
from tigar_x.geometry import multipatch, surfaces
from tigar_x.geometry.gluing import glued
from varmint import Slip, Traction, box, flow_rate


@dataclass(frozen=True)
class Slit:
    """Two rigid plates in one plane across a channel (-1, 1) x (0, 1) with slip walls; between them is a gap.

    It is the slit of ``plane_gaps.py``, in space: the flow is the plane one, with the same references.

    Attributes:
        gap: see :class:`plane_gaps.Slit`, as for the others.
        reynolds: see there.
        cfl: see there.
        n: see there.
        layers: of cells along the third axis, in which the plates go from wall to wall.
        place: see there.
        middle: see there.
        per_cell: see there.
        steady: see there.
        most: see there.
    """

    gap: float = 1.0
    reynolds: float = 0.5
    cfl: float = 1.0
    n: int = 16
    layers: int = 1
    place: float = 0.37
    middle: float = 0.5
    per_cell: float = 2.0
    steady: float = 3e-3
    most: int = 150

    @property
    def reference(self) -> float:
        """Flow rate per depth for a jump and a density of one."""
        return slit_flow(self.gap / self.n, self.reynolds)

    def build(self, setting: Setting) -> Coupled:
        """The scene at rest, with the jump in its pressure and on the plates."""
        h = 1.0 / self.n
        depth = self.layers * h
        mesh = box(COMM, (-1.0, 0.0, 0.0), (1.0, 1.0, depth), (2 * self.n, self.n, self.layers))
        walls = Slip(("bottom", "top", "back", "front"))
        ends = [Traction("left", (1.0, 0.0, 0.0)), Traction("right"), walls]
        known = {"rho": 1.0, "mu": self.reference / self.reynolds, "scheme": generalized_alpha(0.0)}
        flow = immersed_flow(mesh, ends, setting, dt=self.cfl * h * self.gap * h / self.reference, **known)
        x, low, over = self.place * h, 0.5 + (self.middle - 0.5 * self.gap) * h, min(OVER, h)
        spans = (-over, low), (low + self.gap * h, 1.0 + over)
        across = (0.0, 0.0, depth + 2.0 * over)
        plates = [rectangle((x, a, -over), (0.0, b - a, 0.0), across, h / self.per_cell, degree=1) for a, b in spans]
        flow.start(pressure=lambda X, t: ufl.conditional(ufl.lt(X[0], x), 1.0, 0.0))
        return Coupled(flow, rigid(multipatch.disjoint(*plates)), setting, multiplier=1.0)

    def run(self, setting: Setting = IN_SPACE) -> Found:
        """Let it flow until it is steady.

        Figures: "flow" over the reference, "leak", what passes the plates according to the points on them, likewise,
        and "change", that of the flow at the end while the fluid passes a cell.
        """
        scene, reference = self.build(setting), self.reference * self.layers / self.n
        more = self.cfl, self.steady, self.most
        return scene.found(**until_steady(scene, flow_rate(scene.flow, "right"), reference, *more))


SLOWED = {20.0: 0.75}
"""Flow through a hole over that of slow flow, by ``space_fitted.py`` at some Reynolds numbers, within 1 %."""
ARRAY = 2.0 / (3.0 * math.pi) * 9.0336
"""By how much holes in a square array, whose walls are planes of symmetry, help each other, over (radius/side)^3.

The pressure of Sampson's flow far from its hole is at the plate ``mu Q/(pi r^3)`` on the one side and minus that on the
other, and 9.0336 is the sum of 1/r^3 over a square lattice of unit side, without its origin.
"""


@dataclass(frozen=True)
class Hole:
    """A rigid plate with a round hole across a channel (0, 1) x (0, 1) x (-1, 1) with slip walls.

    A jump of pressure of one drives the fluid, which starts at rest with the jump in its pressure and on the plate.
    Slow flow through a hole in a wall has the rate ``jump radius^3/(3 mu)`` (Sampson, doi:10.1098/rspl.1891.0009),
    which the images of the hole behind the walls raise a little, see ``ARRAY``; for faster flow see ``SLOWED``.

    Attributes:
        gap: diameter of the hole in cells of the fluid.
        reynolds: Reynolds number of the diameter and the mean velocity that slow flow would have; up to 1, where the
            flow counts as slow, or one of ``SLOWED``.
        cfl: time step times that mean velocity over the size of a cell.
        n: fluid cells across.
        length: of the channel to both sides.
        place: of the plate above the plane of the mesh in its middle, in cells of the fluid.
        middle: of the hole beside the middle of the channel, along the first two axes, likewise.
        per_cell: elements of the plate per cell of the fluid, about.
        steady: see :class:`Slit`.
        most: see there.
    """

    gap: float = 2.0
    reynolds: float = 0.5
    cfl: float = 1.0
    n: int = 16
    length: float = 0.5
    place: float = 0.37
    middle: tuple[float, float] = (0.13, 0.29)
    per_cell: float = 1.5
    steady: float = 3e-3
    most: int = 150

    @property
    def radius(self) -> float:
        """Of the hole."""
        return 0.5 * self.gap / self.n

    @property
    def mu(self) -> float:
        """Viscosity, from the mean velocity jump radius/(3 pi mu) of slow flow."""
        return self.radius * math.sqrt(2.0 / (3.0 * math.pi * self.reynolds))

    @property
    def reference(self) -> float:
        """Flow rate for a jump and a density of one."""
        return self.slow * (SLOWED[self.reynolds] if self.reynolds > 1.0 else 1.0)

    @property
    def slow(self) -> float:
        """Flow rate without inertia."""
        return self.radius**3 / (3.0 * self.mu) * (1.0 + ARRAY * self.radius**3)

    def build(self, setting: Setting) -> Coupled:
        """The scene at its start."""
        h, R, long = 1.0 / self.n, self.radius, round(self.length * self.n)
        mesh = box(COMM, (0.0, 0.0, -long * h), (1.0, 1.0, long * h), (self.n, self.n, 2 * long))
        known = {"rho": 1.0, "mu": self.mu, "scheme": generalized_alpha(0.0)}
        mean = R / (3.0 * math.pi * self.mu)
        flow = immersed_flow(mesh, [Slip(AROUND), *from_above(1.0)], setting, dt=self.cfl * h / mean, **known)
        center = (0.5 + self.middle[0] * h, 0.5 + self.middle[1] * h, self.place * h)
        outer = 0.75 + max(map(abs, self.middle)) * h * math.sqrt(2.0)
        elements = (round(self.per_cell * (outer - R) / h), max(8, round(self.per_cell * math.pi * (outer + R) / h)))
        plate = surfaces.annulus(inner=R, outer=outer, center=center, elements=elements, degrees=(2, 2))
        flow.start(pressure=lambda X, t: ufl.conditional(ufl.gt(X[2], center[2]), 1.0, 0.0))
        return Coupled(flow, rigid(glued(plate, within=True)), setting, multiplier=-1.0)  # its normals point up

    def run(self, setting: Setting = IN_SPACE) -> Found:
        """Let it flow until it is steady.

        Figures: "flow" over the reference, "discharge", the flow over ``area sqrt(2 jump/rho)``, "leak", what passes
        the plate according to the points on it over the reference, and "change", that of the flow at the end while
        the fluid passes a cell.
        """
        scene = self.build(setting)
        found = until_steady(scene, flow_rate(scene.flow, "back"), self.reference, self.cfl, self.steady, self.most)
        area = math.pi * self.radius**2
        return scene.found(discharge=found["flow"] * self.reference / (area * math.sqrt(2.0)), **found)
