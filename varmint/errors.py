"""Errors of a flow whose exact velocity is known."""

from collections.abc import Callable
from typing import Any

import ufl

from tigar_x import compat
from varmint.flow.flow import Flow
from varmint.forms import ale
from varmint.forms.space import split


def velocity_errors(flow: Flow, exact: Callable[[Any, Any], Any], degree: int | None = None) -> dict[str, float]:
    """Norms of the error of the velocity at the end of the last step (collective).

    Args:
        flow: the flow.
        exact: UFL vector of position and time; at rest of a steady flow the time is zero.
        degree: of the quadrature; None: twice that of the flow.

    Returns:
        The seminorm of H1 and the norm of L2 by the names ``H1_u`` and ``L2_u``.
    """
    domain, motion = flow.mesh.domain, flow.fields.motion_end
    t = compat.Constant(domain, 0.0 if flow.time is None else flow.time.time)
    e = split(flow.w)[0] - exact(ale.position(domain, motion), t)
    dx = flow.mesh.dx(degree=2 * flow.degree if degree is None else degree)
    squares = [ale.per_volume(ufl.inner(f, f), motion) * dx for f in (ale.gradient(e, motion), e)]
    H1, L2 = map(compat.assemble_scalar, compat.compile_forms(*squares))
    return {"H1_u": float(H1**0.5), "L2_u": float(L2**0.5)}
