"""The residual of a flow as terms, and the boundary values that hold strongly."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import ufl
from dolfinx import fem, mesh
from ufl.algorithms import extract_coefficients
from ufl.algorithms.analysis import extract_constants

from tigar_x import compat
from varmint.conditions import Condition, Resistance
from varmint.flow.attachments import OutletPressure
from varmint.flow.options import FlowOptions
from varmint.flow.state import FlowState
from varmint.forms.vms import fine_scales, frozen_tangent, interior_residual

Term = tuple[tuple[str, ...], ufl.Form]
"""Part of a residual, with the facet groups of its condition, "fluid" or "solid"."""


@dataclass(frozen=True, eq=False)
class Interior:
    """What the equations of the fluid inside are built of.

    Attributes:
        state: of the flow.
        options: of the flow.
        f: body force per mass; None: none.
        scale_m: factor of tau_M near an immersed surface; None: no surface.
        scale_c: divisor of tau_C near an immersed surface; None: no surface.
        is_sided: whether fields differ on both sides of a surface.
    """

    state: FlowState
    options: FlowOptions
    f: Any
    scale_m: Any
    scale_c: Any
    is_sided: bool

    def residual(self, v_tau: Any) -> ufl.Form:
        """Residual in the fluid.

        Cross and Reynolds stress are left out beside cells that a surface divides, as in these: between the two kinds
        they cost accuracy where viscosity is small, and long steps diverge with them.

        Args:
            v_tau: velocity in the stabilisation parameters.
        """
        f, cells = self.state.fields, {"domain": self.state.mesh.domain, "dx": self.state.dx}
        stresses = self.options.subscales == "quasi-static" and not self.is_sided
        return interior_residual(f.v, f.p, f.w, f.q, **cells, **self.data(v_tau), stresses=stresses)

    @property
    def fine_velocity(self) -> Any:
        """Velocity of the sub-scales times rho, UFL."""
        f = self.state.fields
        return fine_scales(f.v, f.p, self.state.mesh.domain, **self.data(f.v))[0]

    def data(self, v_tau: Any) -> dict[str, Any]:
        """What the residual takes beside its fields, by name; v_tau as there."""
        s, f, o = self.state, self.state.fields, self.options
        dt: Any = None
        if s.time is not None:
            dt = s.time.dt if o.tau_dt is None else compat.Constant(s.mesh.domain, float(o.tau_dt))
        return dict(
            rho=f.rho, mu=f.mu, degree=s.degree, v_t=s.rate, f=self.f, dt=dt, C_I=o.C_I, C_t=o.C_t,
            scale_m=self.scale_m, scale_c=self.scale_c, motion=f.motion, invariant=o.invariant_metric, v_tau=v_tau,
            memory=None if s.time is None else s.time.memory,
        )  # fmt: skip

    def frozen_tangent(self) -> ufl.Form:
        """Tangent of the residual without the derivatives of the stabilisation parameters."""
        w, x_tau = self.state.w, fem.Function(self.state.V)
        frozen = self.residual(ufl.replace(self.state.fields.v, {w: x_tau}))
        return frozen_tangent(frozen, w, x_tau)


def surface_scales(domain: mesh.Mesh) -> tuple[fem.Function, fem.Function]:
    """Factor of tau_M and divisor of tau_C near an immersed surface, cell by cell; both are one.

    Args:
        domain: mesh.
    """
    cells = compat.lagrange_space(domain, 0)
    scales = fem.Function(cells, name="scale_m"), fem.Function(cells, name="scale_c")
    for scale in scales:
        scale.x.array[:] = 1.0
    return scales


def boundary_terms(conditions: Sequence[Condition], state: FlowState) -> tuple[list[Term], list[OutletPressure]]:
    """Terms of boundary conditions, and the pressures that some of them contain.

    Args:
        conditions: the conditions.
        state: of the flow.

    Returns:
        The terms of those that have one, and the pressures of outlets with a resistance.
    """
    terms: list[Term] = []
    outlets: list[OutletPressure] = []
    for condition in conditions:
        if isinstance(condition, Resistance):
            outlet = OutletPressure(condition, state)
            outlets.append(outlet)
            term: ufl.Form | None = condition.term_with(state.fields, outlet.pressure)
        else:
            term = condition.term(state.fields)
        if term is not None:
            terms.append((condition.groups, term))
    return terms, outlets


def strong_values(
    conditions: Sequence[Condition], state: FlowState
) -> tuple[list[Any], tuple[Callable[[float], None], ...]]:
    """Values that conditions impose at nodes (collective).

    Args:
        conditions: the conditions.
        state: of the flow.

    Returns:
        Boundary conditions of dolfinx, and what brings those that may change to the present time.
    """
    bcs: list[Any] = []
    changing: list[Callable[[], None]] = []
    for condition in conditions:
        for item in condition.strong(state.fields):
            values, bc = compat.prescribed_component(state.V, item.component, item.facets)
            interpolate = compat.Interpolation(values, ufl.as_ufl(item.value))
            interpolate()
            if _varies(item.value):
                changing.append(interpolate)
            bcs.append(bc)
    return bcs, tuple(lambda _, refresh=refresh: refresh() for refresh in changing)


def _varies(value: Any) -> bool:
    """Whether there is anything in an expression that may change from step to step."""
    expression = ufl.as_ufl(value)
    return bool(extract_coefficients(expression) or extract_constants(expression))
