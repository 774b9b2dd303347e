"""Errors of a flow whose exact velocity is known."""

from collections.abc import Callable
from typing import Any

import ufl

from tigar_x import compat
from varmint.flow.flow import Flow
from varmint.forms import ale
from varmint.forms.sides import SIGNS
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


def integral_by_sides(flow: Flow, f: Callable[[Any, Any, Any], Any], degree: int = 4) -> float:
    """Integral at the end of the last step over a flow whose fields differ on both sides of a surface (collective).

    Args:
        flow: made with ``immersed="jump"`` or ``"jump and kink"``, and coupled.
        f: UFL scalar of the velocity, the pressure and the side, which is -1 or 1, or 0 in cells that are not near the
            surface, as UFL or as a number; of degree 2 or less in divided cells for an exact result.
        degree: of the quadrature.

    Raises:
        ValueError: nothing differs in the flow.
    """
    sides = flow.sides
    if sides is None:
        raise ValueError("flow has no sides: Flow(..., immersed='jump and kink') is required")
    doubled, dx = sides.doubled, flow.mesh.dx(degree=degree)
    doubled.join(last=True)
    side = ufl.conditional(ufl.lt(sides.phi, 0.0), -1.0, 1.0)
    v, p = split(flow.w)
    plain = f(v, p, ufl.conditional(ufl.gt(sides.size, 0.0), side, 0.0))
    divided = 0
    for s in SIGNS:
        v, p = sides.fields(s)
        divided += sides.weight(s) * f(v, p, s)
    parts = (plain, ~doubled.cells), (divided, doubled.cells)
    return float(sum(compat.assemble_scalar(compat.PartialForm(g * dx).on(cells)) for g, cells in parts))
