"""Steady flow by continuation: where Newton's method fails, flows of higher viscosity lead to the wanted one."""

import logging
from collections.abc import Callable

from dolfinx import fem

from tigar_x.fem.linear import SolveError
from tigar_x.fem.solve import FiniteElementSystem, NewtonReport
from varmint.flow.options import FlowError, FlowReport
from varmint.flow.state import FlowState

log = logging.getLogger(__name__)

FACTOR, SMALLEST_FACTOR, HIGHEST_FACTOR = 4.0, 1.1, 1e9
"""Where Newton's method fails in steady flow: by which factor's square the viscosity is raised first, the smallest step
down to go on with, and how far it is raised at most."""


def solve_steady(state: FlowState, system: FiniteElementSystem, solve: Callable[[], NewtonReport]) -> FlowReport:
    """Solve for the steady flow from the present state, at its viscosity or with others on the way.

    Args:
        state: of the flow.
        system: its equations.
        solve: see :func:`continued`.

    Returns:
        The report.

    Raises:
        FlowError: no steady flow was found; the state is that before.
    """
    constant = state.fields.mu
    before, mu = state.w.x.array.copy(), float(constant.value)
    system.apply_boundary_values()
    try:
        return continued(solve, state.w, constant)
    except SolveError as error:
        state.w.x.array[:] = before
        raise FlowError(
            f"no steady flow at mu = {mu:.3g}: {error}; refine the mesh, start from a similar flow, or step through"
            " time"
        ) from error
    finally:
        constant.value = mu


def continued(solve: Callable[[], NewtonReport], w: fem.Function, mu: fem.Constant) -> FlowReport:
    """Solve for the steady flow at the present viscosity, with flows at higher ones on the way where it needs them.

    Args:
        solve: Newton's method from the present state at the present viscosity; raises SolveError where it fails.
        w: the state, overwritten.
        mu: the viscosity, at the end as it was.

    Returns:
        The report.

    Raises:
        SolveError: no flow was found; state and viscosity are then those of the last attempt.
    """
    target = float(mu.value)
    linear, tangents, above = 0, 0, None
    start, waiting = w.x.array.copy(), [target]
    while True:
        mu.value = waiting[-1]
        try:
            done = solve()
        except SolveError as error:
            here = waiting[-1]
            if (above is not None and above < SMALLEST_FACTOR * here) or here > HIGHEST_FACTOR * target:
                reached = "at none" if above is None else f"down to mu = {above:.3g}"
                raise SolveError(f"steady flow was found {reached}; {error}") from error
            waiting.append(FACTOR**2 * here if above is None else (here * above) ** 0.5)
            log.info("no steady flow at mu = %.3g yet; next, mu = %.3g", here, waiting[-1])
            w.x.array[:] = start
            continue
        linear += sum(done.linear_iterations)
        tangents += done.tangents
        above, start = waiting.pop(), w.x.array.copy()
        if not waiting:
            return FlowReport(0.0, done.norms, linear, tangents)
