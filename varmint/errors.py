"""Errors of a flow whose exact velocity is known."""

from collections.abc import Callable
from typing import Any

import ufl

from tigar_x import compat
from varmint.flow.flow import Flow
from varmint.forms import ale
from varmint.forms.space import split


def velocity_errors(flow: Flow, exact: Callable[..., Any], degree: int | None = None) -> dict[str, float]:
    """Norms of the error of the velocity at the end of the last step (collective).

    Args:
        flow: the flow.
        exact: UFL vector of position and time, and in a flow whose fields differ on both sides of a surface of the side
            as well, see :func:`integral_by_sides`; at rest of a steady flow the time is zero.
        degree: of the quadrature; None: twice that of the flow.

    Returns:
        The seminorm of H1 and the norm of L2 by the names ``H1_u`` and ``L2_u``.
    """
    domain, motion = flow.mesh.domain, flow.fields.motion_end
    t = compat.Constant(domain, 0.0 if flow.time is None else flow.time.time)
    x, degree = ale.position(domain, motion), 2 * flow.degree if degree is None else degree
    if flow.sides is not None:

        def square(v: Any, s: Any) -> Any:
            return ufl.inner(v - exact(x, t, s), v - exact(x, t, s))

        def of_gradient(v: Any, s: Any) -> Any:
            e = ufl.grad(v - exact(x, t, s))
            return ufl.inner(e, e)

        H1, L2 = (flow.sides.integral(lambda v, p, s, f=f: f(v, s), degree) for f in (of_gradient, square))
        return {"H1_u": H1**0.5, "L2_u": L2**0.5}
    e = split(flow.w)[0] - exact(x, t)
    dx = flow.mesh.dx(degree=degree)
    squares = [ale.per_volume(ufl.inner(f, f), motion) * dx for f in (ale.gradient(e, motion), e)]
    H1, L2 = map(compat.assemble_scalar, compat.compile_forms(*squares))
    return {"H1_u": float(H1**0.5), "L2_u": float(L2**0.5)}


def integral_by_sides(flow: Flow, f: Callable[[Any, Any, Any], Any], degree: int = 4) -> float:
    """Integral at the end of the last step over a flow whose fields differ on both sides of a surface (collective).

    Args:
        flow: made with ``immersed="jump"`` or ``"jump and kink"``, and coupled.
        f: UFL scalar of the velocity, the pressure and the side, see :meth:`varmint.flow.sides.FlowSides.integral`.
        degree: of the quadrature.

    Raises:
        ValueError: nothing differs in the flow.
    """
    if flow.sides is None:
        raise ValueError("flow has no sides: Flow(..., immersed='jump and kink') is required")
    return float(flow.sides.integral(f, degree))
