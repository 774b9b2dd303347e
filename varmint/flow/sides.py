"""A flow whose fields differ on both sides of a surface that passes through its cells.

Nodes have the values of the side on which they lie. Those of cells that are divided may have a jump of the pressure and
a kink of the velocity as well, see :mod:`varmint.forms.sides`; where these are unknowns, and what is divided, whoever
knows the surface says at the start of a step.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, cast

import numpy as np
import ufl
from dolfinx import fem

from tigar_x import compat
from tigar_x.compat import FloatArray
from tigar_x.fem.divided import Doubled
from tigar_x.fem.time_integration import TimeIntegrator
from varmint.conditions import Condition
from varmint.flow.sided_time import SidedTime
from varmint.flow.sided_values import SidedValues
from varmint.flow.state import FlowState
from varmint.flow.terms import Interior, Term
from varmint.forms.sides import SIGNS, Sides, sided_residual, weighted
from varmint.forms.space import split

DEGREE = {"jump": 2, "jump and kink": 4}
"""What may differ on both sides, and the degree of the polynomials that weights of sides integrate exactly: that of the
product of two kinks, whose mass and penalty at walls are not positive otherwise, so that small steps diverge, and walls
at which a surface ends."""
KINDS = tuple(DEGREE)
WALLS = {2: 0, 3: 1}
"""By how much the degree of the weights on walls is higher, for each dimension of space. In the plane they are exact on
one side of a cell, and on two of them for what is continuous; with one degree more they are exact on two facets."""


class FlowSides(SidedValues):
    """What differs on both sides of a surface, and the equations of the cells that it divides.

    Args:
        state: of the flow, whose integrator is a :class:`SidedTime`.
        interior: its equations inside.
        conditions: on its boundary.
        kind: one of ``KINDS``.

    Attributes:
        is_kinked: whether velocities are kinked; pressures always jump.
        phi: linear function that is zero on the surface.
        size: linear function with its sizes at the nodes.
        length: Constant, in which kinks measure both; 1 until whoever knows the surface sets it. Unit: length.
        negative: weight of the negative side in divided cells, a polynomial in each.
        wall: the same on their facets on the boundary.
        carried: velocities of the surface at the nodes, and the same times the signs of phi there; empty without kinks.
        given: force that the surface gives to the nodes, into the rows of the unknown, this rank's share.
        terms: of the residual of divided cells, with the facet groups of their conditions or "fluid".
        doubled: equations of divided cells, and what is divided.
    """

    def __init__(self, state: FlowState, interior: Interior, conditions: Sequence[Condition], kind: str) -> None:
        domain, time = state.mesh.domain, cast(SidedTime, state.time)
        self._state = state
        d, self.is_kinked = domain.geometry.dim, kind == KINDS[1]
        degree, more, linear = DEGREE[kind], WALLS[d], compat.lagrange_space(domain, 1)
        self._degree, self._degree_on_walls = 2 * degree, 2 * degree + more
        walls = weights = compat.lagrange_space(domain, degree, discontinuous=True)
        if more:
            walls = compat.lagrange_space(domain, degree + more, discontinuous=True)
        self.phi, self.size = fem.Function(linear, name="phi"), fem.Function(linear, name="phi_size")
        self.negative, self.wall = fem.Function(weights, name="negative"), fem.Function(walls, name="wall_negative")
        self.length = compat.Constant(domain, 1.0)
        of_vectors = compat.lagrange_space(domain, 1, d)
        names = ("phi_velocity", "phi_velocity_signed") if self.is_kinked else ()
        self.carried = tuple(fem.Function(of_vectors, name=name) for name in names)
        self._both = fem.Function(compat.lagrange_space(domain, 1, 2 * (d + 1)), name="both")
        both = TimeIntegrator(self._both, time.step_size, time.scheme, algebraic=(d, 2 * d + 1))
        joined = (
            (time.x, time.second, both.x),
            (time.x_old, time.second_old, both.x_old),
            (time.xdot_old, time.second_rate, both.xdot_old),
        )
        self.given = np.zeros(len(time.x.x.array))
        clock = {both.dt: time.dt, both.t: time.t, both.t_alpha: time.t_alpha}
        terms: list[Term] = [(("fluid",), self._inside(state, interior, both))]
        terms += self._boundary(state, conditions, both)
        self.terms = [(groups, ufl.replace(term, clock)) for groups, term in terms]
        self.doubled = Doubled(sum((term for _, term in self.terms[1:]), self.terms[0][1]), joined, d)
        super().__init__(self.phi, self.length, self.doubled, state.w)

    def fields(self, s: float) -> tuple[Any, Any]:
        """Velocity and pressure on a side of divided cells at the end of the step, UFL, once they have been joined."""
        return self._sides(self.negative).fields(self._parts(self._both), s)

    def weight(self, s: float) -> Any:
        """Weight of a side in divided cells, UFL."""
        return self._sides(self.negative).weight(s)

    def _sides(self, negative: fem.Function) -> Sides:
        return Sides(self.phi, self.size, negative, self.length, cast(Any, self.carried) or None)

    def side_by_side(self, form: ufl.Form) -> ufl.Form:
        """A form of velocity and pressure at the end of the step, ``flow.w``, side by side in divided cells.

        Args:
            form: integrals over cells and over facets of the boundary; of no higher degree in divided cells than
                ``DEGREE`` for an exact result.

        Raises:
            ValueError: it has other integrals.
        """
        here, w = self.doubled.marker, self._state.w
        result = weighted(form, 1 - here)
        for integral in form.integrals():
            kind = integral.integral_type()
            if kind not in ("cell", "exterior_facet"):
                raise ValueError(
                    f"form has an integral of type {kind}: integrals over cells or the boundary are required"
                )
            weight, least = (self.negative, self._degree) if kind == "cell" else (self.wall, self._degree_on_walls)
            sides, finer = self._sides(weight), dict(integral.metadata())
            finer["quadrature_degree"] = max(finer.get("quadrature_degree", 0), least)
            for s in SIGNS:
                v, p = sides.fields(self._parts(self._both), s)
                side = ufl.replace(integral.integrand(), {w: ufl.as_vector([*v, p])})
                part = here * sides.weight(s) * side
                result += ufl.Form([integral.reconstruct(integrand=part, metadata=finer)])
        return result

    def rows(self, plain: ufl.Form, names: Sequence[str]) -> Callable[[], FloatArray]:
        """What assembles rows of the momentum at all local nodes, with what the surface gives to them.

        Without conditions on some facet groups they are minus the forces there.

        Args:
            plain: terms of cells that are not divided.
            names: facet groups.

        Returns:
            Function without arguments (collective), which gives shape (nodes, d).
        """
        kept = [form for groups, form in self.terms if not set(groups) & set(names)]
        forms = compat.partial_forms(plain, sum(kept[1:], kept[0]))
        total, m = fem.Function(self._state.V), self._d + 1

        def rows() -> FloatArray:
            doubled, both = self.doubled, np.zeros(len(self._both.x.array))
            doubled.join(last=True)
            total.x.array[:] = self.given
            compat.add_vector(total.x.array, forms[0].on(~doubled.cells))
            compat.add_vector(both, forms[1].on(doubled.cells))
            total.x.array.reshape(-1, m)[:] += both.reshape(-1, 2 * m)[doubled.node_of_z, :m]
            compat.accumulate(total)
            return np.asarray(total.x.array.reshape(-1, m)[:, : self._d])

        return rows

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
        finer = divided * mesh.dx(degree=max(degree, self._degree))
        parts = zip(compat.partial_forms(plain * mesh.dx(degree=degree), finer), (~cells, cells), strict=True)
        return float(sum(compat.assemble_scalar(form.on(chosen)) for form, chosen in parts))

    def _parts(self, f: Any) -> tuple[Any, Any, Any, Any]:
        """Velocity, pressure, kink and jump of a field of divided cells."""
        d = f.ufl_shape[0] // 2 - 1
        u, a = (ufl.as_vector([f[i + start] for i in range(d)]) for start in (0, d + 1))
        return u, f[d], a if self.is_kinked else None, f[2 * d + 1]

    def _inside(self, state: FlowState, interior: Interior, both: TimeIntegrator) -> ufl.Form:
        u_t, _, a_t, _ = self._parts(both.xdot_alpha)
        known = interior.data(None)
        for name in ("v_t", "scale_m", "scale_c", "motion"):
            del known[name]
        return sided_residual(
            self._sides(self.negative), self._parts(both.x_alpha), self._tests, (u_t, a_t),
            state.mesh.domain, dx=state.mesh.dx(degree=self._degree), **known,
        )  # fmt: skip

    def _boundary(self, state: FlowState, conditions: Sequence[Condition], both: TimeIntegrator) -> list[Term]:
        sides, terms = self._sides(self.wall), []
        of_sides = [(sides.fields(self._parts(both.x_alpha), s), sides.fields(self._tests, s), s) for s in SIGNS]
        for condition in conditions:
            total = ufl.Form([])
            for (v, p), (w, q), s in of_sides:
                term = condition.term(replace(state.fields, v=v, p=p, w=w, q=q, degree=self._degree_on_walls))
                if term is not None:
                    total += weighted(term, sides.weight(s))
            if not total.empty():
                terms.append((condition.groups, total))
        return terms

    @property
    def _tests(self) -> tuple[Any, Any, Any, Any]:
        return self._parts(ufl.TestFunction(self._both.function_space))
