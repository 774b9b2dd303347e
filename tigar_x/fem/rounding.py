"""Rounding in Newton's method: how large it is in a residual, when nothing else is left, and what to say of it."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from petsc4py import PETSc

from tigar_x.compat import FloatArray, IntArray

ROUNDING = 2e-15
"""Rounding error of a residual relative to what the tangent makes of the state."""
IDLE = 5
"""Iterations without a lower residual after which nothing more is expected, if their increments are small as well."""
LOWER = 0.5
"""Part of the lowest residual so far that counts as lower."""
SMALL = 1e-5
"""Length of an increment by the longest one, below which the state no longer changes but by rounding."""
NEAR = 1e8
"""First residual by its rounding error up to which a start is a solution, as far as half of the digits can tell."""


def of_tangent(A: PETSc.Mat, x: PETSc.Vec, resolution: FloatArray | None, constrained: IntArray) -> float:
    """Norm of what a tangent makes of a state with signs at random, as its rounding errors have them (collective).

    Args:
        A: tangent.
        x: state.
        resolution: what is added to the size of each local dof; None: nothing.
        constrained: local dofs whose rows are left out.
    """
    sizes, product = x.duplicate(), x.duplicate()
    n = product.getLocalSize()
    signs = np.random.default_rng(A.comm.rank).choice([-1.0, 1.0], n)
    sizes.array_w[:] = signs * (np.abs(x.array_r) + (0.0 if resolution is None else resolution[:n]))
    A.mult(sizes, product)
    product.array_w[constrained[constrained < n]] = 0.0
    norm = float(product.norm())
    for vector in (sizes, product):
        vector.destroy()
    return norm


def stagnates(norms: Sequence[float], lengths: Sequence[float]) -> bool:
    """Whether the last iterations have changed neither the residual nor the state.

    A residual that rises for some iterations, as in thin shells, moves the state by increments that are not small; so
    does an iteration that goes round in circles.

    Args:
        norms: residual norms, from the first one on.
        lengths: norms of the increments that were subtracted.
    """
    if len(norms) <= IDLE + 1 or len(lengths) < IDLE:
        return False
    best, last = min(norms[:-IDLE]), norms[-IDLE:]
    return min(last) > LOWER * best and max(lengths[-IDLE:]) < SMALL * max(lengths)


def stagnation(norms: Sequence[float], lengths: Sequence[float], target: float) -> str:
    """What to say of it.

    Args:
        norms: residual norms, from the first one on.
        lengths: norms of the increments that were subtracted.
        target: accepted residual.
    """
    part = max(lengths[-IDLE:]) / max(lengths)
    return (
        f"Newton stagnates at a residual of {min(norms):.2e}, {target:.2e} is accepted: the last {IDLE} of"
        f" {len(norms) - 1} iterations have not lowered it, and moved the state by {part:.0e} of the longest increment."
        " Rounding is most of that residual (raise rtol or atol), or the tangent is not its derivative"
    )


def is_solved(system: Any, first: float, last: float) -> bool:
    """Whether rounding leaves such a residual, and half of the digits of the first one or less (collective).

    Args:
        system: has ``rounding()``, or its rounding is not known and nothing is left to it.
        first: residual at the start.
        last: residual that steps no longer lower.
    """
    estimate = getattr(system, "rounding", None)
    error = 0.0 if estimate is None else float(estimate())
    return last <= error and first <= NEAR * error
