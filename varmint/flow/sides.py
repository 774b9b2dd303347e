"""A flow whose fields differ on both sides of a surface that passes through its cells.

Nodes have the values of the side on which they lie. Those of cells that are divided may have a jump of the pressure and
a kink of the velocity as well, see :mod:`varmint.forms.sides`; where these are unknowns, and what is divided, whoever
knows the surface says at the start of a step.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, cast

import ufl
from dolfinx import fem

from tigar_x import compat
from tigar_x.fem.divided import Doubled
from tigar_x.fem.time_integration import TimeIntegrator
from varmint.conditions import Condition, Resistance
from varmint.flow.sided_time import SidedTime
from varmint.flow.sided_values import SidedValues
from varmint.flow.state import FlowState
from varmint.flow.terms import Interior
from varmint.forms.sides import SIGNS, Sides, sided_residual, weighted
from varmint.forms.space import split

DEGREE = {"jump": 2, "jump and kink": 4}
"""What may differ on both sides, and the degree of the polynomials that weights of sides integrate exactly: that of the
product of two kinks, whose mass is not positive otherwise, so that small steps diverge."""
KINDS = tuple(DEGREE)
WALL_DEGREE = 2
"""The same on the boundary."""


class FlowSides(SidedValues):
    """What differs on both sides of a surface, and the equations of the cells that it divides.

    Args:
        state: of the flow, whose integrator is a :class:`SidedTime`.
        interior: its equations inside.
        conditions: on its boundary.
        kind: one of ``KINDS``.

    Attributes:
        is_kinked: whether velocities are kinked; pressures always jump.
        phi: linear function of which the surface is the zero line.
        size: linear function with its sizes at the nodes.
        negative: weight of the negative side in divided cells, a polynomial in each.
        wall: the same on their facets on the boundary.
        doubled: equations of divided cells, and what is divided.
    """

    def __init__(self, state: FlowState, interior: Interior, conditions: Sequence[Condition], kind: str) -> None:
        domain, time = state.mesh.domain, cast(SidedTime, state.time)
        self._state = state
        d, self.is_kinked = domain.geometry.dim, kind == KINDS[1]
        self._degree, linear = 2 * DEGREE[kind], compat.lagrange_space(domain, 1)
        weights, walls = (compat.lagrange_space(domain, k, discontinuous=True) for k in (DEGREE[kind], WALL_DEGREE))
        self.phi, self.size = fem.Function(linear, name="phi"), fem.Function(linear, name="phi_size")
        self.negative, self.wall = fem.Function(weights, name="negative"), fem.Function(walls, name="wall_negative")
        self._both = fem.Function(compat.lagrange_space(domain, 1, 2 * (d + 1)), name="both")
        both = TimeIntegrator(self._both, time.step_size, time.scheme, algebraic=(d, 2 * d + 1))
        joined = (
            (time.x, time.second, both.x),
            (time.x_old, time.second_old, both.x_old),
            (time.xdot_old, time.second_rate, both.xdot_old),
        )
        residual = self._inside(state, interior, both) + self._boundary(state, conditions, both)
        residual = ufl.replace(residual, {both.dt: time.dt, both.t: time.t, both.t_alpha: time.t_alpha})
        self.doubled = Doubled(residual, joined, d)
        super().__init__(self.phi, self.doubled, state.w)

    def fields(self, s: float) -> tuple[Any, Any]:
        """Velocity and pressure on a side of divided cells at the end of the step, UFL, once they have been joined."""
        return Sides(self.phi, self.size, self.negative).fields(self._parts(self._both), s)

    def weight(self, s: float) -> Any:
        """Weight of a side in divided cells, UFL."""
        return Sides(self.phi, self.size, self.negative).weight(s)

    def integral(self, f: Callable[[Any, Any, Any], Any], degree: int = 4) -> float:
        """Integral over the flow at the end of the last step, side by side in divided cells (collective).

        Args:
            f: UFL scalar of the velocity, the pressure and the side, which is -1 or 1, or 0 in cells that are not near
                the surface, as UFL or as a number; of no higher degree in divided cells than ``DEGREE`` for an exact
                result.
            degree: of the quadrature, in divided cells at least twice ``DEGREE``.
        """
        self.doubled.join(last=True)
        side = ufl.conditional(ufl.lt(self.phi, 0.0), SIGNS[0], SIGNS[1])
        plain = f(*split(self._state.w), ufl.conditional(ufl.gt(self.size, 0.0), side, 0.0))
        divided = sum(self.weight(s) * f(*self.fields(s), s) for s in SIGNS)
        mesh, cells = self._state.mesh, self.doubled.cells
        parts = (
            (plain * mesh.dx(degree=degree), ~cells),
            (divided * mesh.dx(degree=max(degree, self._degree)), cells),
        )
        return float(sum(compat.assemble_scalar(compat.PartialForm(form).on(chosen)) for form, chosen in parts))

    def _parts(self, f: Any) -> tuple[Any, Any, Any, Any]:
        """Velocity, pressure, kink and jump of a field of divided cells."""
        d = f.ufl_shape[0] // 2 - 1
        u, a = (ufl.as_vector([f[i + start] for i in range(d)]) for start in (0, d + 1))
        return u, f[d], a if self.is_kinked else None, f[2 * d + 1]

    def _inside(self, state: FlowState, interior: Interior, both: TimeIntegrator) -> ufl.Form:
        u_t, _, a_t, _ = self._parts(both.xdot_alpha)
        known = interior.data(None)
        for name in ("v_t", "memory", "scale_m", "scale_c", "motion"):
            del known[name]
        return sided_residual(
            Sides(self.phi, self.size, self.negative), self._parts(both.x_alpha), self._tests, (u_t, a_t),
            state.mesh.domain, dx=state.mesh.dx(degree=self._degree), **known,
        )  # fmt: skip

    def _boundary(self, state: FlowState, conditions: Sequence[Condition], both: TimeIntegrator) -> ufl.Form:
        residual, sides = ufl.Form([]), Sides(self.phi, self.size, self.wall)
        for s in SIGNS:
            v, p = sides.fields(self._parts(both.x_alpha), s)
            w, q = sides.fields(self._tests, s)
            fields = replace(state.fields, v=v, p=p, w=w, q=q, degree=2 * WALL_DEGREE)
            for condition in conditions:
                term = condition.term(fields)
                if term is not None:
                    residual += weighted(term, sides.weight(s))
        return residual

    @property
    def _tests(self) -> tuple[Any, Any, Any, Any]:
        return self._parts(ufl.TestFunction(self._both.function_space))


def check_immersed(state: FlowState, conditions: Sequence[Condition], kind: str, solid: Any) -> None:
    """Check that what differs on both sides of a surface can do so in a flow.

    Args:
        state: of the flow.
        conditions: on its boundary.
        kind: one of ``KINDS``.
        solid: solid in the flow; None: none.

    Raises:
        ValueError: it cannot.
    """
    reasons = (
        (state.time is None, "dt = None: a flow that advances in time"),
        (state.degree != 1, f"degree = {state.degree}: degree 1"),
        (compat.cell_name(state.mesh.domain) != "triangle", "mesh: triangles in the plane"),
        (state.moving is not None, "moving: a mesh that is fixed"),
        (solid is not None, "solid: None"),
        (any(isinstance(condition, Resistance) for condition in conditions), "conditions: no Resistance"),
    )
    for found, what in reasons:
        if found:
            raise ValueError(f"immersed = {kind!r}, {what} is required")
