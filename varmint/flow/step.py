"""One time step of a flow: it is taken as a whole or not at all."""

from collections.abc import Callable, Sequence
from typing import Any

from tigar_x.fem.linear import SolveError
from tigar_x.fem.solve import FiniteElementSystem, NewtonReport
from tigar_x.fem.time_integration import TimeIntegrator
from varmint.flow.options import FlowError, FlowReport
from varmint.flow.state import FlowState


def flow_step(
    state: FlowState,
    time: TimeIntegrator,
    system: FiniteElementSystem,
    solve: Callable[[], NewtonReport],
    updates: Sequence[Callable[[float], None]],
    measure: Callable[[], Any] | None,
    *,
    has_solid: bool,
) -> FlowReport:
    """Advance a flow, and its mesh where that moves, by one step.

    Args:
        state: of the flow.
        time: its integrator.
        system: its equations.
        solve: Newton's method from the predicted state; raises SolveError where it fails.
        updates: to be called with t_alpha.
        measure: called with the new state before the clock moves; None: nothing is measured.
        has_solid: whether the mesh moves with a solid, while the equations are solved.

    Returns:
        The report.

    Raises:
        FlowError: the step failed; state, clocks and tangent are those before it, as after any other error.
    """
    moving, t, bring_back = state.moving, float(time.t.value), system.remember_tangent()
    clocks = (time,) if moving is None else (time, moving.time)
    try:
        for clock in clocks:
            clock.predict()
        if moving is not None:
            moving.move()
            moving.check()
        for update in updates:
            update(float(time.t_alpha.value))
        system.apply_boundary_values()
        done = solve()
        if moving is not None and has_solid:
            moving.check()
        measured = None if measure is None else measure()
    except BaseException as error:
        bring_back()
        for clock in clocks:
            clock.restore()
        if not isinstance(error, SolveError):
            raise
        raise FlowError(f"the step to t = {t:.6g} (dt = {time.step_size:.3g}) failed: {error}", t) from error
    t_alpha, linear = float(time.t_alpha.value), sum(done.linear_iterations)
    for clock in clocks:
        clock.advance()
    return FlowReport(time.time, done.norms, linear, done.tangents, measured, t_alpha)
