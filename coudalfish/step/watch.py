"""What is out of its limits in a coupled run: warnings while it goes on, and the suspect when a step fails.

A warning advises what has been measured to help, see docs/stability.md.
"""

import logging
import math
from typing import Any, NamedTuple, Protocol

import numpy as np
import scipy.sparse as sp

from coudalfish.sides.fluid import FluidSubproblem
from coudalfish.sides.scales import directions, extent
from coudalfish.sides.shell import ShellSubproblem
from coudalfish.step.acceptance import Acceptance
from coudalfish.step.method import Method
from coudalfish.step.report import StepReport
from coudalfish.surface.exchange import VertexMeans, tractions
from coudalfish.surface.slip import SHARE_OF_LOAD, WINDOW, SlipWindow, root_mean_square
from tigar_x.compat import FloatArray

log = logging.getLogger(__name__)

SLIP_LIMIT = 0.3
"""Largest slip per load change relative to the fluid's cells, lam dt/(beta h), before a warning."""
NORMAL_SLIP_LIMIT = 0.1
"""Largest slip along the normal relative to the speed before a warning."""
TANGENTIAL_SLIP_LIMIT = 0.15
"""Largest slip along the shell relative to the speed before a warning."""
SPACING_LIMIT = 0.75
"""Largest distance of immersed points relative to the fluid's cells before a warning."""
PENALTY_LIMIT = 100.0
"""Largest penalty relative to the impedance of the flow at which block iteration converges well."""
TIME_STEP_LIMIT = 1e-3
"""Smallest time step relative to the scales of the fluid's cells, dt (|u|/h + nu/h^2), before a warning."""
CLOSING_LIMIT = 0.3
"""Largest approach of two points in a step relative to the range of contact before a warning."""
COURANT_LIMIT = 0.5
"""Largest displacement per step relative to the fluid's cells that explicit geometry bears well."""
OTHER_UNITS = 10.0
"""Ratio of the sizes of shell and fluid from which their units are doubted."""

CLOSING = "approach of touching points in the step/range of contact (reduce dt or the contact's stiffness)"


class Figure(NamedTuple):
    """A number with its limit."""

    value: float
    limit: float

    @property
    def excess(self) -> float:
        """Value relative to the limit, inf where it is not finite."""
        return self.value / self.limit if math.isfinite(self.value) else math.inf

    def __str__(self) -> str:
        """As a message has it."""
        if not math.isfinite(self.value):
            return " is not finite"
        return f" = {self.value:.3g}, advised at most {self.limit:g}"


class Watched(Protocol):
    """What is looked at of a step.

    Attributes:
        dt: time step.
        beta: penalty.
        lam: multiplier, shape (points,).
        method: kind of the multiplier.
        n: normals, shape (points, d).
        W: reference areas, zero at points outside the fluid, shape (points,).
        u: velocity of the fluid at the points, shape (points, d).
        y_dot: their own velocity, shape (points, d).
        spacing: largest distance of neighbouring points; unit: length.
        inactive: number of points outside the fluid.
        block: where the step is.
        acceptance: what judges its residuals.
    """

    dt: float
    beta: float
    lam: FloatArray
    method: Method
    n: FloatArray
    W: FloatArray
    u: FloatArray
    y_dot: FloatArray
    spacing: float
    inactive: int
    block: str
    acceptance: Acceptance

    @property
    def vertex_functions(self) -> sp.csr_matrix:
        """Linear functions of the fluid mesh's vertices at the points (collective)."""


class Watch:
    """Watches the steps of one coupled run.

    Args:
        fluid: the flow.
        shell: the immersed structure.
    """

    def __init__(self, fluid: FluidSubproblem, shell: ShellSubproblem) -> None:
        self._shell = shell
        self.move_to(fluid)
        self._exceeded: dict[str, tuple[float, Figure]] = {}  # since when, and how much at the start of this step
        self._slip = SlipWindow()
        self._warned: set[str] = set()

    def move_to(self, fluid: FluidSubproblem) -> None:
        """Watch the steps of another side of the fluid from here on (collective)."""
        self._fluid, self._sizes = fluid, extent(fluid.mesh)
        self._directions = directions(fluid.system.constrained, fluid.velocity_dofs, fluid.comm)
        self._speed: float | None = None

    def warn_once(self, key: str, message: str, *numbers: Any) -> None:
        """Log a warning on rank 0 the first time it applies."""
        if key not in self._warned:
            self._warned.add(key)
            if self._fluid.comm.rank == 0:
                log.warning(message, *numbers)

    # -- before the passes --------------------------------------------------------------------------------------------

    def spacing(self, x: FloatArray) -> float:
        """Largest distance of neighbouring points along what can flow; unit: length.

        Args:
            x: positions of the points, shape (points, d).
        """
        return self._shell.spacing(x * self._directions)

    def placed(self, step: Watched, x: FloatArray) -> None:
        """Look at a step whose points have been placed (collective).

        Args:
            step: the step.
            x: positions of the points, shape (points, d).
        """
        h = self._fluid.mesh_size
        if step.spacing > SPACING_LIMIT * h:
            self.warn_once(
                "spacing",
                "immersed points are up to %.3g apart, %.2f times the fluid's cell size: the surface may leak "
                "(at most %g times is advised; refine the shell)",
                step.spacing,
                step.spacing / h,
                SPACING_LIMIT,
            )
        self._warn_of_points_outside(step, x)
        if self._speed is None:
            self._speed = self._fluid.speed()
        self._note(self._fluid.timeInt.time, self._figures(step, self._speed))

    def _note(self, t: float, figures: dict[str, Figure]) -> None:
        """Remember which numbers are beyond their limits, those that left them first in front."""
        for name, figure in figures.items():
            if figure.excess <= 1.0:
                self._exceeded.pop(name, None)
            else:
                self._exceeded[name] = self._exceeded.get(name, (t, figure))[0], figure

    def _warn_of_points_outside(self, step: Watched, x: FloatArray) -> None:
        sizes = np.ptp(x, axis=0)
        ratio = sizes.max() / self._sizes.max()
        here = f"the shell spans {_lengths(sizes)}, the fluid {_lengths(self._sizes)}"
        if ratio > OTHER_UNITS or sizes.max() < self._fluid.mesh_size:
            here += f", whose cells have the size {self._fluid.mesh_size:.3g}; are their units of length the same?"
        if step.inactive == len(x):
            self.warn_once("outside", "no point of the shell is in the fluid: they do not act on each other; %s", here)
        elif step.inactive:
            self.warn_once(
                "outside",
                "%d of %d points of the shell are outside the fluid, which does not act on them; %s",
                step.inactive,
                len(x),
                here,
            )
        elif sizes.max() < self._fluid.mesh_size:
            self.warn_once("small shell", "the shell is smaller than a cell of the fluid: %s", here)

    # -- after the passes ---------------------------------------------------------------------------------------------

    def finished(self, step: Watched, report: StepReport) -> None:
        """Look at a step that has been accepted (collective).

        Args:
            step: the step, with the velocities that its multiplier follows from.
            report: what it reports.
        """
        self._speed = self._fluid.speed()
        self._warn_of_small_step(step, self._speed)
        self._warn_of_slip(step, self._speed)
        if report.contact is not None:
            self._warn_of_contact(step, report.t, report.contact.closing_ratio)

    def _warn_of_slip(self, step: Watched, speed: float) -> None:
        h, dt, beta = self._fluid.mesh_size, step.dt, step.beta
        both = np.hstack([tractions(step.lam, step.n), step.u - step.y_dot])
        lam, slip = np.hsplit(VertexMeans(step.vertex_functions, step.W) @ both, 2)
        ratio = float(np.linalg.norm(lam, axis=1).max(initial=0.0)) * step.method.lag * dt / (beta * h)
        moved = root_mean_square(step.W, step.y_dot)
        rest = self._rest(root_mean_square(step.W, lam), dt)
        now = self._slip.add(slip, step.n, step.W, max(speed, moved, rest))
        # a load that is there already moves nothing through the shell: the more a change would, the less has to be seen
        if ratio > SLIP_LIMIT and now is not None and ratio * now.normal > SLIP_LIMIT * NORMAL_SLIP_LIMIT:
            self.warn_once(
                "slip",
                "slip ratio lam dt/(beta h) = %.3g exceeds %g while the fluid passes the shell with %.2g of the speed: "
                "a change of load by lam moves the fluid through the shell by that part of a cell; where loads go on "
                "changing reduce dt or raise the penalty (beta = %.3g)",
                ratio,
                SLIP_LIMIT,
                now.normal,
                beta,
            )
        found = self._slip.slip
        if found is not None and found.normal > NORMAL_SLIP_LIMIT:
            self.warn_once(
                "normal slip",
                "over %d steps the fluid passed the shell with %.2g of the speed (at most %g is advised): %s "
                "(beta = %.3g)",
                WINDOW,
                found.normal,
                NORMAL_SLIP_LIMIT,
                step.method.gives_way,
                beta,
            )
        if found is not None and found.tangential > TANGENTIAL_SLIP_LIMIT:
            self.warn_once(
                "tangential slip",
                "over %d steps the fluid slid along the shell with %.2g of the speed (at most %g is advised): refine "
                "its mesh there; a larger penalty or a smaller dt drags a layer of the flow along and need not help",
                WINDOW,
                found.tangential,
                TANGENTIAL_SLIP_LIMIT,
            )

    def _rest(self, lam: float, dt: float) -> float:
        """Speed below which a sheet under a load counts as at rest."""
        rho, mu, h = self._fluid.density, self._fluid.viscosity, self._fluid.mesh_size
        if rho is None or mu is None:
            return 0.0
        return SHARE_OF_LOAD * lam / (rho * h / dt + mu / h)

    def _warn_of_contact(self, step: Watched, t: float, closing: float) -> None:
        self._note(t, {CLOSING: Figure(closing, CLOSING_LIMIT)})
        if closing > CLOSING_LIMIT:
            self.warn_once(
                "closing",
                "points approach each other by %.3g of the range of contact in a step: surfaces may pass each other "
                "(at most %g is advised; reduce dt)",
                closing,
                CLOSING_LIMIT,
            )
        spacing = 0.0 if self._shell.contact is None else self._shell.contact.spacing_ratio
        if spacing > SPACING_LIMIT:
            self.warn_once(
                "contact spacing",
                "points are up to %.3g times the range of contact apart: surfaces may pass between them (at most %g is "
                "advised; refine the shell or raise r_max)",
                spacing,
                SPACING_LIMIT,
            )

    def _warn_of_small_step(self, step: Watched, speed: float) -> None:
        rho, mu, h = self._fluid.density, self._fluid.viscosity, self._fluid.mesh_size
        if rho is None or mu is None:
            return
        scale = step.dt * (mu / (rho * h**2) + speed / h)
        if scale < TIME_STEP_LIMIT:
            self.warn_once(
                "time step",
                "dt (|u|/h + nu/h^2) = %.3g is below %g: the stabilisation vanishes with dt and the pressure may "
                "oscillate; raise dt or refine the fluid mesh",
                scale,
                TIME_STEP_LIMIT,
            )

    # -- failure ------------------------------------------------------------------------------------------------------

    def _figures(self, step: Watched, speed: float) -> dict[str, Figure]:
        """Numbers that have limits, by name with the remedy."""
        fluid, h, lag = self._fluid, self._fluid.mesh_size, step.method.lag
        slip = float(np.abs(step.lam).max(initial=0.0)) * lag * step.dt / (step.beta * h)
        figures = {
            "slip ratio lam dt/(beta h) (raise the penalty beta or reduce dt)": Figure(slip, SLIP_LIMIT),
            "Courant number |u - u_mesh| dt/h (reduce dt)": Figure(speed * step.dt / h, COURANT_LIMIT),
            "point spacing/h (refine the shell)": Figure(step.spacing / h, SPACING_LIMIT),
            "fraction of points outside the fluid mesh": Figure(step.inactive / len(step.lam), 0.5),
        }
        # whether all converges that is solved for at once depends neither on the flow's own solver nor on the penalty
        if step.acceptance.limits[0] > 0.0:
            leftover = lag * fluid.linear_accuracy / step.acceptance.limits[0]
            figures["linear solver's residual/accepted residual (tighten its rtol)"] = Figure(leftover, 1.0)
        if fluid.viscosity is not None and fluid.density is not None:
            impedance = fluid.viscosity / h + fluid.density * h / step.dt
            name = "penalty/impedance of the flow, beta/(mu/h + rho h/dt) (lower the penalty beta)"
            figures[name] = Figure(lag * step.beta / impedance, PENALTY_LIMIT)
        return figures

    def suspect(self, step: Watched) -> str:
        """The number that left its limit first and the one that exceeds it most, or a statement that none does."""
        if step.block == "mesh":
            return "the motion of the mesh in this step (reduce dt)"
        figures = self._figures(step, self._fluid.speed())
        if self._shell.touching is not None:
            figures[CLOSING] = Figure(self._shell.closing_ratio(), CLOSING_LIMIT)
        worst = max(figures, key=lambda name: figures[name].excess)
        most = worst + str(figures[worst])
        if not self._exceeded:
            if figures[worst].excess > 1.0:
                return most
            return (
                f"all numbers are within limits, {worst} = {figures[worst].value:.3g} comes nearest; penalty beta ="
                f" {step.beta:.3g}"
            )
        first = min(self._exceeded, key=lambda name: (self._exceeded[name][0], -self._exceeded[name][1].excess))
        since, figure = self._exceeded[first]
        told = first + str(figure)
        if since < self._fluid.timeInt.time:
            told += f", since t = {since:.4g}"
        return told if worst == first else f"{told}; then {most}"


def _lengths(sizes: FloatArray) -> str:
    return " x ".join(f"{size:.3g}" for size in sizes)
