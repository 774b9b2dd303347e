"""Which attempts a step gets, by the options of the coupling: what fails falls back to a multiplier that lags."""

import logging
from collections.abc import Iterator, Sequence
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
    gives_way = "the multiplier lags behind the load, and the shell moves too slowly; reduce dt or raise the penalty"

    def __init__(self, *, smoothed: bool) -> None:
        self._smoothed = smoothed

    def begin(self, step: Stepping) -> Multiplier:
        """See :class:`coudalfish.step.method.Method`."""
        means, sheets = step.vertex_functions if self._smoothed else None, step.shell.sheets
        held = held_points(step.comm, step.fluid.free, sheets, step.trace, step.n)
        of_points = {"held": held, "active": step.meeting.active, "weights": step.W}
        return Multiplier(
            along_normals(step.lam, step.n), step.n, sheets, vertex_functions=means, comm=step.comm, **of_points
        )


UNUSED = (
    "{} = {:g} has no effect: only plain fields are scaled near the surface, as the published algorithm's are,"
    " Flow(..., immersed='plain')"
)
SUITED = "for Flow(..., immersed='jump') and 'jump and kink'"

FALLBACK: dict[str, Any] = {
    "multiplier": "lagged",
    "multiplier_direction": "normal",
    "penalty": PenaltyRule(2.0, 0.5),
    "relaxation": 0.5,
    "relaxation_mode": "smoothed",
}
"""What a step is coupled by that has failed with a converged multiplier: a lag needs a penalty that knows dt."""


def usual(fluid: FluidSubproblem) -> CouplingOptions:
    """The options of who names none: those with which the flow's fields have been measured, see docs/defaults.md.

    Args:
        fluid: the flow.
    """
    if fluid.sides is None:
        return CouplingOptions()
    if fluid.sides.is_kinked:
        return CouplingOptions.sharp()
    trace: Any = "exact" if fluid.mesh.geometry.dim == 2 else "nodes"  # surfaces in space have it whatever is chosen
    return CouplingOptions.converged(trace=trace, fluid_tangent="consistent")


def _unsuited(options: CouplingOptions, fluid: FluidSubproblem) -> Iterator[str]:
    """What of the options does not suit the fields of the flow, and what does, see docs/defaults.md."""
    sides = fluid.sides
    if options.multiplier_direction == "vector" and (sides is None or not sides.is_kinked):
        yield "multiplier_direction = 'vector' locks a velocity without a kink at the surface: 'normal' is advised"
    if sides is None:
        return
    for name in ("scale_m", "scale_c"):
        if (chosen := getattr(options, name)) != getattr(CouplingOptions, name):
            yield UNUSED.format(name, chosen)
    if options.multiplier == "lagged":
        yield f"multiplier = 'lagged' moves and leaks as much as with plain fields: {SUITED} 'converged' is advised"
    if options.trace == "nodes" and fluid.mesh.geometry.dim == 2:
        yield f"trace = 'nodes' pushes the fluid beside the line of its jump: {SUITED} 'exact' is advised"


def attempts(options: CouplingOptions, fluid: FluidSubproblem, shell: ShellSubproblem) -> Sequence[Attempt]:
    """The ways to take a step, each where those before have failed; the first one is what the options ask for.

    Args:
        options: how fluid and shell are coupled.
        fluid: the flow.
        shell: the immersed structure.
    """
    for warning in _unsuited(options, fluid):
        log.warning(warning)
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
