"""Which attempts a step gets, by the options of the coupling: what fails falls back to a multiplier that lags."""

import logging
from collections.abc import Sequence
from typing import Any

from coudalfish.sides.fluid import FluidSubproblem
from coudalfish.sides.shell import ShellSubproblem
from coudalfish.step.method import Attempt, Stepping
from coudalfish.step.options import CouplingOptions, PenaltyRule
from coudalfish.surface.exchange import along_normals
from coudalfish.surface.multiplier import Multiplier, held_points

log = logging.getLogger(__name__)


class Lagged:
    """The multiplier is what the step before left; fluid and shell are solved in turn.

    Args:
        smoothed: whether relaxation leaves its means over the fluid's vertices alone.
    """

    lag = 1.0

    def __init__(self, *, smoothed: bool) -> None:
        self._smoothed = smoothed

    def begin(self, step: Stepping) -> Multiplier:
        """See :class:`coudalfish.step.method.Method`."""
        means, sheets = step.vertex_functions if self._smoothed else None, step.shell.sheets
        held = held_points(step.comm, step.fluid.free, sheets, step.trace, step.n)
        of_points = {"held": held, "active": step.meeting.active, "weights": step.W}
        return Multiplier(along_normals(step.lam, step.n), step.n, sheets, vertex_functions=means, **of_points)


UNUSED = (
    "%s = %g has no effect: only plain fields are scaled near the surface, as the published algorithm's are,"
    " Flow(..., immersed='plain')"
)

FALLBACK: dict[str, Any] = {
    "multiplier": "lagged",
    "multiplier_direction": "normal",
    "penalty": PenaltyRule(2.0, 0.5),
    "relaxation": 0.5,
    "relaxation_mode": "smoothed",
}
"""What a step is coupled by that has failed with a converged multiplier: a lag needs a penalty that knows dt."""


def usual(fluid: FluidSubproblem) -> CouplingOptions:
    """The options of who names none.

    Args:
        fluid: the flow.
    """
    kinked = fluid.sides is not None and fluid.sides.is_kinked
    return CouplingOptions.sharp() if kinked else CouplingOptions()


def attempts(options: CouplingOptions, fluid: FluidSubproblem, shell: ShellSubproblem) -> Sequence[Attempt]:
    """The ways to take a step, each where those before have failed; the first one is what the options ask for.

    Args:
        options: how fluid and shell are coupled.
        fluid: the flow.
        shell: the immersed structure.
    """
    if fluid.sides is not None:
        for name in ("scale_m", "scale_c"):
            if (chosen := getattr(options, name)) != getattr(CouplingOptions, name):
                log.warning(UNUSED, name, chosen)
    lagged = Lagged(smoothed=options.relaxation_mode == "smoothed" and options.relaxation > 0.0)
    if options.multiplier == "lagged":
        return (Attempt(lagged, options),)
    from coudalfish.step.converged import PASSES, Converged  # who has a lagged multiplier needs nothing of it

    alone = options.with_(acceleration=0, second_attempt=False, max_passes=min(options.max_passes, PASSES))
    method, renewed = Converged(fluid, shell, options), alone.with_(tangent_update="pass")
    ways = [Attempt(method, alone)]
    if options.tangent_update != "pass":
        ways.append(Attempt(method, renewed, "assemble tangents in every pass"))
    ways.append(Attempt(method, renewed, "meet the shell where it was before the step", stays=True))
    known = fluid.density is not None and fluid.viscosity is not None
    changes = FALLBACK if known else {**FALLBACK, "penalty": options.penalty}
    return *ways, Attempt(Lagged(smoothed=True), options.with_(**changes), "fall back to a lagged multiplier")
