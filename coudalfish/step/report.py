"""What a step reports, and how it fails."""

from dataclasses import dataclass
from typing import Any

from coudalfish.surface.monitors import Monitors


@dataclass(frozen=True)
class ContactReport:
    """Contact of an accepted step, at the time ``t_alpha`` of its report.

    Attributes:
        pairs: number of interacting pairs of points.
        load: sum of the forces between them without regard to direction; unit: force.
        energy: of the potential; unit: energy.
        distance: smallest distance of an interacting pair, inf without any; unit: length.
        closing_ratio: largest approach in the whole step of two points that may interact, relative to the range of
            contact.
    """

    pairs: int
    load: float
    energy: float
    distance: float
    closing_ratio: float


@dataclass(frozen=True)
class StepReport:
    """What a step did.

    Attributes:
        t: time at its end, to which velocities and displacements belong: those of the fluid and of the shell, and what
            is written of them.
        t_alpha: time at which the equations hold, to which pressures, multiplier, slip, forces and contact belong: all
            of ``monitors`` and ``contact``.
        attempts: which attempt at the step this is, 1 for the first: under-relaxed ones, and those that options fall
            back to, follow.
        passes: block passes of the last attempt, each one solve of the fluid and one of the shell.
        residuals: norms (fluid, shell) of every test; unit: force.
        linear_iterations: iterations of the fluid's linear solver in all passes.
        penalty: beta.
        inactive_points: immersed points outside the fluid mesh.
        slip_ratio: ``max|lam| dt/(beta h)``, at ``t_alpha``.
        monitors: slip, leak, force and its balance, at ``t_alpha``; None when the step failed.
        contact: at ``t_alpha``; None when the step failed or the shell has no contact.
        measured: what the step's ``measure`` returned, which was called with the state at ``t``.
    """

    t: float
    t_alpha: float
    attempts: int
    passes: int
    residuals: tuple[tuple[float, float], ...]
    linear_iterations: int
    penalty: float
    inactive_points: int
    slip_ratio: float
    monitors: Monitors | None
    contact: ContactReport | None = None
    measured: Any = None


class StepError(RuntimeError):
    """A step that could not be accepted; the state is that of the last good step.

    Attributes:
        block: "mesh", "fluid", "shell" or "coupling".
        suspect: the number that most likely is to blame, in words.
        report: what was done until then.
    """

    def __init__(self, block: str, reason: str, suspect: str, report: StepReport) -> None:
        super().__init__(f"step to t = {report.t:g} failed in the {block} block: {reason}; suspect: {suspect}")
        self.block = block
        self.suspect = suspect
        self.report = report


class RejectedStepError(Exception):
    """Ends an attempt at a step from within.

    Args:
        block: "mesh", "fluid", "shell" or "coupling".
        reason: what happened.
    """

    def __init__(self, block: str, reason: str) -> None:
        super().__init__(block, reason)  # both, so that other ranks can be sent a copy
        self.block = block

    def __str__(self) -> str:
        return str(self.args[1])
