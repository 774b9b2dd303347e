"""Residuals below which a step has nothing left to solve for."""

from coudalfish.sides.fluid import FluidSubproblem
from coudalfish.sides.shell import ShellSubproblem
from coudalfish.surface.trace import TraceMatrix
from tigar_x import ranks
from tigar_x.compat import FloatArray

ROUNDED = 1e-13
"""Residual relative to the terms that balance in it below which it is rounding, whatever the options ask for."""


def residual_floors(
    fluid: FluidSubproblem,
    shell: ShellSubproblem,
    trace: TraceMatrix,
    terms: FloatArray,
    stiffness: FloatArray,
    *,
    atol: float,
    solved: bool,
) -> tuple[float, float]:
    """A fraction of the terms that balance in each block, and what rounding of positions makes of it (collective).

    Args:
        fluid: the flow.
        shell: the shell.
        trace: where the points are.
        terms: absolute values of the coupling's terms at the points, shape (points, d); unit: force.
        stiffness: derivative of the penalty's forces by the displacement of the points, shape (points,).
        atol: the fraction; rounding is the least.
        solved: whether the tangents are those of the present attempt; before its first solve they are of another step,
            perhaps of one that failed, and do not count.

    Returns:
        Of fluid and shell, the same on every rank; unit: force.
    """
    fraction, error = max(atol, ROUNDED), shell.rounding()
    scale_f, scale_s, rounded_s = fluid.coupling_norm(trace, terms), shell.coupling_norm(terms), 0.0
    if solved:
        scale_f += fluid.momentum_scale()
        scale_s += shell.momentum_scale()
        rounded_s = shell.force_of(error)
    floor_f = fraction * scale_f + fluid.coupling_norm(trace, stiffness[:, None] * error)
    return floor_f, ranks.first(fluid.comm, fraction * scale_s + rounded_s)
