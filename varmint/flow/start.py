"""How a flow starts: projected states, and rates and pressures that belong to a velocity."""

from typing import TYPE_CHECKING, Any

import numpy as np
import ufl
from dolfinx import fem
from ufl.algorithms import extract_coefficients
from ufl.algorithms.analysis import extract_constants

from tigar_x import compat
from tigar_x.fem.linear import SolveError
from tigar_x.fem.solve import FiniteElementSystem, newton
from tigar_x.fem.time_integration import TimeIntegrator
from varmint.flow.options import FlowError
from varmint.forms.ale import divergence, per_volume
from varmint.forms.space import split

if TYPE_CHECKING:
    from varmint.flow.flow import Flow


def varies(value: Any) -> bool:
    """Whether there is anything in an expression that may change from step to step."""
    expression = ufl.as_ufl(value)
    return bool(extract_coefficients(expression) or extract_constants(expression))


def project(function: fem.Function, expression: Any, degree: int) -> None:
    """Project in L2 (collective).

    Args:
        function: target.
        expression: UFL expression of the same shape.
        degree: of quadrature.
    """
    dx = ufl.dx(domain=function.function_space.mesh, metadata={"quadrature_degree": degree})
    residual = ufl.inner(function - expression, ufl.TestFunction(function.function_space)) * dx
    function.x.array[:] = 0.0  # else a start that is the projection already leaves nothing but rounding to reduce
    newton(FiniteElementSystem(residual, function), rtol=1e-10)


def consistent_start(flow: "Flow") -> None:
    """Compute the rate and the pressure that belong to a flow's present velocity.

    The rate balances momentum and is solenoidal; the residual of continuity, which the velocity alone would have to
    balance, contributes its stabilisation.

    Args:
        flow: the flow, whose rate and pressure are overwritten.

    Raises:
        FlowError: they could not be computed.
        ValueError: the flow is steady.
    """
    time = flow.time
    if time is None:
        raise ValueError("dt = None: only an unsteady flow has initial rates")
    others = () if flow.moving is None else (flow.moving.time,)
    for outlet in flow.rank_one:
        outlet.update()
    form, unknown = time.initial_form(_differentiated(flow, time), *others)
    _prescribe_rates(flow, time, unknown)
    system = FiniteElementSystem(form, unknown, flow.bcs, solver=flow.recipe, constant=flow.pressure_dofs)
    try:
        newton(system, rtol=1e-10, max_iterations=10)
    except SolveError as error:
        raise FlowError(f"no consistent start: {error}", time.time) from error
    time.start(unknown)
    flow.w.x.array[:] = time.x_old.x.array


def _differentiated(flow: "Flow", time: TimeIntegrator) -> ufl.Form:
    """The residual with the rate's divergence in place of the velocity's."""
    f, period = flow.fields, time.dt if flow.options.tau_dt is None else flow.options.tau_dt
    rate = split(time.xdot_alpha)[0]
    change = divergence(period * rate - f.v, f.motion)
    return flow.residual + per_volume(f.q * change, f.motion) * flow.mesh.dx(*flow.fluid_cells, degree=f.degree)


def _prescribe_rates(flow: "Flow", time: TimeIntegrator, unknown: fem.Function) -> None:
    """Rates of the strong values by central differences; a mesh has its acceleration."""
    dofs = compat.constrained_dofs(flow.bcs)
    sides, end = [], float(time.t.value)
    delta = 1e-3 * time.step_size
    mesh = None if flow.moving is None else flow.moving.time
    for sign in (-1.0, 1.0):
        time.t.value = time.time + sign * delta
        if mesh is not None:
            velocity = mesh.xdot_old.x.array + sign * delta * mesh.xddot_old.x.array
            mesh.x.x.array[:] = mesh.x_from_rate_array(velocity, np.arange(len(velocity), dtype=np.int32))
        for update in flow.updates:
            update(time.time)
        side = fem.Function(flow.V)
        compat.apply_values(side, flow.bcs)
        sides.append(side.x.array.copy())
    time.t.value = end
    if mesh is not None:
        mesh.restore()
    unknown.x.array[dofs] = ((sides[1] - sides[0]) / (2.0 * delta))[dofs]
