"""A cylinder in a channel: steady flow, or vortices that it sheds.

The channel (0, 2.2) x (0, 0.41) holds a cylinder of diameter D = 0.1 slightly below its middle. The fluid enters with
a parabola of mean speed U = 1, does not slip on walls and cylinder, and leaves freely. With Re = U D/nu and the force F
on the cylinder per unit depth, the coefficients of drag and lift are 2 F/(rho U^2 D).

Sources: Schaefer and Turek, doi:10.1007/978-3-322-89849-4_39 (Re = 100: the middle of the intervals given there); John
and Matthies, doi:10.1002/fld.195 (Re = 20).
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from mpi4py import MPI

from tigar_x import checks
from tigar_x.compat import FloatArray
from tigar_x.fem.schemes import generalized_alpha
from varmint.conditions import Traction, Velocity
from varmint.flow.flow import Flow
from varmint.mesh.models import channel_with_cylinder
from varmint.profiles import parabola
from varmint.quantities import BoundaryForce, NodeValues

SPEED, DIAMETER, HEIGHT, FRONT_AND_REAR = 1.0, 0.1, 0.41, ((0.15, 0.2), (0.25, 0.2))
PUBLISHED = {
    (20.0, True): ("10.1002/fld.195", {"drag": 5.57953523384, "lift": 0.010618948146, "dp": 0.11752016697 / 0.2**2}),
    (100.0, False): ("10.1007/978-3-322-89849-4_39", {"drag_max": 3.23, "lift_max": 1.0, "strouhal": 0.3}),
}
"""DOI, and values by name, by Reynolds number and whether the flow is steady."""


@dataclass(frozen=True)
class Channel:
    """The channel and its discretisation.

    Attributes:
        reynolds: Reynolds number with the mean speed and the diameter.
        steady: whether to solve for the steady flow.
        degree: of velocity and pressure.
        size: of the cells far away; a sixth of it at the cylinder, half of it in the wake.
        dt: time step of the unsteady flow.
        rho_infinity: spectral radius of the time integration at infinite frequency.
    """

    reynolds: float = 100.0
    steady: bool = False
    degree: int = 2
    size: float = 0.04
    dt: float = 0.005
    rho_infinity: float = 0.5

    def build(self, *, ramp: float = 0.5, comm: MPI.Comm = MPI.COMM_WORLD, options: Any = None, **shape: Any) -> Flow:
        """The channel at rest.

        Args:
            ramp: time within which the inflow of an unsteady flow comes up.
            comm: communicator.
            options: of the flow.
            shape: of the cells and of the cylinder, see :func:`varmint.mesh.models.channel_with_cylinder`.
        """
        mesh = channel_with_cylinder(
            comm, size=self.size, cylinder_size=self.size / 6.0, wake_size=self.size / 2.0, **shape
        )
        clock: dict[str, Any] = {} if self.steady else {"dt": self.dt, "scheme": generalized_alpha(self.rho_infinity)}
        inflow = Velocity("inlet", parabola(HEIGHT, SPEED, ramp if clock else 0.0))
        mu = SPEED * DIAMETER / checks.positive("reynolds", self.reynolds)
        sides = [Velocity(("walls", "cylinder")), inflow, Traction("outlet")]
        return Flow(mesh, sides, rho=1.0, mu=mu, degree=self.degree, options=options, **clock)


class Coefficients:
    """Drag, lift and pressure difference of the present state, as the ``measure`` of a step.

    Args:
        flow: around the cylinder.
    """

    def __init__(self, flow: Flow) -> None:
        self._force, self._values = BoundaryForce(flow, "cylinder"), NodeValues(flow.w, FRONT_AND_REAR)

    def __call__(self) -> FloatArray:
        """Coefficients of drag and lift, and the difference (collective)."""
        front, rear = self._values()[:, -1]
        return np.append(self._force() * 2.0 / (SPEED**2 * DIAMETER), front - rear)
