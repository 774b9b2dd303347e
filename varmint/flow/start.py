"""How a flow starts: states given or projected, and rates and pressures that belong to a velocity."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import ufl
from dolfinx import fem

from tigar_x import checks, compat
from tigar_x.fem.linear import SolveError
from tigar_x.fem.projection import project
from tigar_x.fem.solve import FiniteElementSystem, newton
from tigar_x.fem.time_integration import TimeIntegrator
from varmint.conditions import Data
from varmint.flow.options import FlowError
from varmint.flow.state import FlowState
from varmint.forms.ale import divergence, per_volume
from varmint.forms.space import split


def set_state(state: FlowState, velocity: Data, pressure: Any, *, projected: bool) -> None:
    """Set the state at the present time; arguments as in :meth:`varmint.flow.flow.Flow.start`."""
    domain, d = state.mesh.domain, state.mesh.domain.geometry.dim
    x = ufl.SpatialCoordinate(domain)
    if state.moving is not None:
        x = x + state.moving.time.x_old
    t = compat.Constant(domain, 0.0 if state.time is None else state.time.time)
    u, p = compat.given("velocity", velocity, x, t), compat.given("pressure", pressure, x, t)
    components = [0.0] * d if u is None else list(checks.vector("velocity", u, d))
    checks.parameter("pressure", 0.0 if p is None else p, checks.finite)
    values = ufl.as_vector([*components, 0.0 if p is None else p])
    if projected:
        project(state.w, values)
    else:
        compat.interpolate(state.w, values)
    if state.time is not None:
        state.time.forget()


def consistent_start(
    state: FlowState,
    time: TimeIntegrator,
    residual: ufl.Form,
    tau_dt: float | None,
    updates: Sequence[Callable[[float], None]],
    bcs: Sequence[Any],
    **solver: Any,
) -> None:
    """Compute the rate and the pressure that belong to a flow's present velocity.

    The rate balances momentum and is solenoidal; the residual of continuity, which the velocity alone would have to
    balance, contributes its stabilisation.

    Args:
        state: of the flow, whose rate and pressure are overwritten.
        time: its integrator.
        residual: its residual.
        tau_dt: time step in tau_M; None: that of the integrator. Unit: time.
        updates: to be called with the time where strong values change.
        bcs: strong conditions.
        solver: see :class:`tigar_x.fem.solve.FiniteElementSystem`.

    Raises:
        FlowError: they could not be computed.
    """
    f, period = state.fields, time.dt if tau_dt is None else tau_dt
    change = divergence(period * split(time.xdot_alpha)[0] - f.v, f.motion)
    others = () if state.moving is None else (state.moving.time,)
    form, unknown = time.initial_form(residual + per_volume(f.q * change, f.motion) * state.dx, *others)
    _prescribe_rates(state, time, updates, bcs, unknown)
    system = FiniteElementSystem(form, unknown, bcs, **solver)
    try:
        newton(system, rtol=1e-10, max_iterations=10)
    except SolveError as error:
        raise FlowError(f"no consistent start: {error}", time.time) from error
    time.start(unknown)
    state.w.x.array[:] = time.x_old.x.array


def _prescribe_rates(
    state: FlowState,
    time: TimeIntegrator,
    updates: Sequence[Callable[[float], None]],
    bcs: Sequence[Any],
    unknown: fem.Function,
) -> None:
    """Rates of the strong values by central differences; a mesh has its acceleration."""
    dofs = compat.constrained_dofs(bcs)
    sides, end = [], float(time.t.value)
    delta = 1e-3 * time.step_size
    mesh = None if state.moving is None else state.moving.time
    for sign in (-1.0, 1.0):
        time.t.value = time.time + sign * delta
        if mesh is not None:
            velocity = mesh.xdot_old.x.array + sign * delta * mesh.xddot_old.x.array
            mesh.x.x.array[:] = mesh.x_from_rate_array(velocity, np.arange(len(velocity), dtype=np.int32))
        for update in updates:
            update(time.time)
        side = fem.Function(state.V)
        compat.apply_values(side, bcs)
        sides.append(side.x.array.copy())
    time.t.value = end
    if mesh is not None:
        mesh.restore()
    unknown.x.array[dofs] = ((sides[1] - sides[0]) / (2.0 * delta))[dofs]
