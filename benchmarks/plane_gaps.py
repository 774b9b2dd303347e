"""A plane gap, see ``plane.py``.

- :class:`Slit`: two plates on one line leave a gap, through which a jump of pressure drives the fluid.
"""

import math
from dataclasses import dataclass

import ufl
from scene import COMM, IN_PLANE, Coupled, Found, Setting, immersed_flow, rigid, until_steady

from tigar_x import generalized_alpha
from tigar_x.geometry import multipatch, shapes
from varmint import Slip, Traction, box, flow_rate

DISCHARGE = {10.0: 0.60, 27.0: 0.67, 55.0: 0.67}
"""Flow over ``gap sqrt(2 jump/rho)`` of a slit at some Reynolds numbers, from meshes that fit the plates."""


def slit_flow(gap: float, reynolds: float) -> float:
    """Flow rate through a slit in a wall for a jump and a density of one.

    Args:
        gap: its width.
        reynolds: see :class:`Slit`.
    """
    if reynolds > 1.0:
        return DISCHARGE[reynolds] * gap * math.sqrt(2.0)
    return gap * math.sqrt(math.pi * reynolds / 32.0)


@dataclass(frozen=True)
class Slit:
    """Two rigid plates on one line across the duct (-1, 1) x (0, 1) with slip walls; between them is a gap.

    A jump of pressure of one drives the fluid. It starts at rest, with the jump in its pressure and on the plates. Slow
    flow through a slit in a wall has the rate ``pi gap^2 jump/(32 mu)``, faster flow that which is in ``DISCHARGE``;
    the viscosity follows from the Reynolds number, the flow rate over the kinematic viscosity. With plain fields
    0.07, 0.12, 0.50 of it pass gaps of 1, 2, 4 cells at a CFL number of 1.

    Attributes:
        gap: in cells of the fluid.
        reynolds: up to 1, where the flow counts as slow, or one of ``DISCHARGE``.
        cfl: time step times mean velocity in the gap over the size of a cell.
        n: fluid cells across.
        place: of the plates' line beside the line of the mesh in the middle, in cells of the fluid.
        middle: of the gap above the axis, likewise.
        per_cell: elements of the plates per cell of the fluid, about.
        steady: largest change of the flow relative to the reference that counts as none, while the fluid passes a
            cell in the gap.
        most: number of steps after which a steady flow is not waited for any longer.
    """

    gap: float = 1.0
    reynolds: float = 0.5
    cfl: float = 0.2
    n: int = 32
    place: float = 0.37
    middle: float = 0.5
    per_cell: float = 2.0
    steady: float = 1e-3
    most: int = 300

    @property
    def reference(self) -> float:
        """Flow rate for a jump and a density of one."""
        return slit_flow(self.gap / self.n, self.reynolds)

    @property
    def mu(self) -> float:
        """Viscosity."""
        return self.reference / self.reynolds

    def build(self, setting: Setting) -> Coupled:
        """The scene at rest."""
        h = 1.0 / self.n
        mesh = box(COMM, (-1.0, 0.0), (1.0, 1.0), (2 * self.n, self.n))
        ends = [Traction("left", (1.0, 0.0)), Traction("right"), Slip(("bottom", "top"))]
        dt = self.cfl * h * self.gap * h / self.reference
        flow = immersed_flow(mesh, ends, setting, rho=1.0, mu=self.mu, dt=dt, scheme=generalized_alpha(0.0))
        x, low = self.place * h, 0.5 + (self.middle - 0.5 * self.gap) * h
        spans = (0.0, low), (low + self.gap * h, 1.0)
        lines = [
            shapes.line((x, a), (x, b), elements=max(1, round(self.per_cell * self.n * (b - a)))) for a, b in spans
        ]
        flow.start(pressure=lambda X, t: ufl.conditional(ufl.lt(X[0], x), 1.0, 0.0))
        return Coupled(flow, rigid(multipatch.disjoint(*lines)), setting, multiplier=1.0)

    def run(self, setting: Setting = IN_PLANE) -> Found:
        """Let it flow until it is steady.

        Figures: "flow" over the reference, "leak", what passes the plates according to the points on them, likewise,
        and "change", that of the flow at the end while the fluid passes a cell.
        """
        scene = self.build(setting)
        more = self.cfl, self.steady, self.most
        return scene.found(**until_steady(scene, flow_rate(scene.flow, "right"), self.reference, *more))
