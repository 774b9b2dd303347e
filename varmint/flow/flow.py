"""A flow as one object: mesh, fluid and conditions become residual, boundary values, solver and steps.

What the scene does not have is not in its forms, see :mod:`varmint.forms.vms`; what is compiled is compiled at the
first solve. A flow that is made for it (``immersed=True``) can be given to a coupler instead of being solved here.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import ufl

from tigar_x import checks, compat
from tigar_x.compat import IntArray
from tigar_x.fem.line_search import LineSearch
from tigar_x.fem.linear import LinearSolver, automatic, chosen
from tigar_x.fem.schemes import Scheme, generalized_alpha
from tigar_x.fem.solve import FiniteElementSystem, NewtonReport, newton
from varmint.conditions import Condition, Data
from varmint.flow.attachments import OutletPressure, SolidInFlow
from varmint.flow.checks import check_clock, check_cover, check_kinds, check_numbers, fields_at_surface
from varmint.flow.clock import FlowNeeds, FlowTime
from varmint.flow.options import (
    STALLED,
    STEADY_LINEAR_RTOL,
    STEADY_RTOL,
    STEP_LINEAR_RTOL,
    STEP_RTOL,
    FlowError,
    FlowOptions,
    FlowReport,
)
from varmint.flow.pressure import by_null_space, pressure_pin
from varmint.flow.start import consistent_start, set_state
from varmint.flow.state import FlowState
from varmint.flow.steady import solve_steady
from varmint.flow.step import flow_step
from varmint.flow.terms import Interior, Term, boundary_terms, strong_values, surface_scales
from varmint.forms.motion import ElasticMotion, PrescribedMotion
from varmint.forms.solids import Solid
from varmint.mesh.named import NamedMesh

if TYPE_CHECKING:
    from tigar_x.run.running import Run

__all__ = ["Flow", "FlowError", "FlowOptions", "FlowReport"]

PREFIX = "fluid_"
"""Of the PETSc options of a flow's linear solver."""


class Flow(checks.Made):
    """Incompressible flow on a mesh with named facets.

    Args:
        mesh: mesh.
        conditions: conditions on facet groups, or the only one; every boundary facet needs one.
        rho: density > 0, a number or Constant; unit: mass/volume.
        mu: dynamic viscosity >= 0 (> 0 in steady flow), a number or Constant.
        degree: polynomial degree k of velocity and pressure.
        dt: time step; None: steady flow. Unit: time.
        scheme: first-order scheme; None: generalized-alpha with rho_infinity = 1/2.
        f: body force per mass; None: none.
        moving: motion of the mesh, with the same time step and scheme; None: it is fixed.
        solid: elastic solid in some cells of the mesh, which ``moving`` has to leave out; None: fluid alone.
        immersed: whether a surface may be immersed in the flow, with the best fields that the flow can have; or which:
            "jump and kink" if pressure and velocity gradient differ on both sides (of degree 1 on triangles or
            tetrahedra whose mesh does not move, without a solid and Resistance), the default in the plane; "jump" if
            the pressure does, the default in space; "plain" if the equations have factors of the stabilisation
            parameters near the surface instead, the default of other flows.
        options: see there.

    Attributes:
        mesh: as given.
        rho: Constant.
        mu: Constant.
        V: space of velocity and pressure.
        w: velocity and pressure at the end of the step.
        time: integrator; None: steady flow.
        fields: what the conditions see.
        v: velocity at the level of the equations, UFL.
        p: pressure, UFL.
        terms: parts of the residual, each with the facet groups of its condition, "fluid" or "solid".
        scales: factor of tau_M and divisor of tau_C near an immersed surface, cell by cell, one until a coupler sets
            them; None: no surface, or one at which the fields differ.
        sides: what differs on both sides of an immersed surface; None: nothing.
        updates: to be called with t_alpha at the start of every step by whoever steps the flow.
        is_closed: whether no boundary is open and no solid compressible, so that a constant of the pressure remains.

    Raises:
        ValueError: a number, shape or name is not allowed, or a boundary facet has no condition or two.
    """

    _ELSEWHERE: ClassVar[Mapping[str, str]] = {
        "dt": "time.step_size",
        "step_size": "time.step_size",
        "density": "rho.value",
        "viscosity": "mu.value",
    }
    _PARTS = ("mesh", "conditions", "degree", "moving", "time", "scales", "w")

    def __init__(
        self,
        mesh: NamedMesh,
        conditions: Condition | Sequence[Condition],
        *,
        rho: Any,
        mu: Any,
        degree: int = 1,
        dt: float | None = None,
        scheme: Scheme | None = None,
        f: Data = None,
        moving: PrescribedMotion | ElasticMotion | None = None,
        solid: Solid | None = None,
        immersed: bool | Literal["plain", "jump", "jump and kink"] = False,
        options: FlowOptions | None = None,
    ) -> None:
        self.options = FlowOptions() if options is None else options
        scheme = generalized_alpha(0.5) if scheme is None else scheme
        conditions = (conditions,) if isinstance(conditions, Condition) else conditions
        check_kinds(mesh, conditions, scheme, moving, solid, self.options)
        check_numbers(rho, mu, dt, scheme, moving, solid)
        check_cover(mesh, conditions)
        self.mesh, self.conditions, self.degree, self.moving = mesh, tuple(conditions), degree, moving
        kind = fields_at_surface(immersed, mesh, self.conditions, degree=degree, dt=dt, moving=moving, solid=solid)
        is_sided = kind is not None and kind != "plain"
        state = FlowState.at_rest(
            mesh, rho, mu, degree=degree, dt=dt, scheme=scheme, moving=moving, solid=solid,
            is_sided=is_sided, options=self.options,
        )  # fmt: skip
        self._state, self.V, self.w, self.time, self.fields = state, state.V, state.w, state.time, state.fields
        self.rho, self.mu, self.v, self.p = self.fields.rho, self.fields.mu, self.fields.v, self.fields.p
        force = None if f is None else self.fields.vector("f", f)
        self._solid = SolidInFlow(solid, state, moving, force) if solid and isinstance(moving, ElasticMotion) else None
        self.scales = surface_scales(mesh.domain) if kind == "plain" else None
        scale_m, scale_c = self.scales or (None, None)
        self._interior = Interior(state, self.options, force, scale_m, scale_c, is_sided)
        self.terms: list[Term] = [(("fluid",), self._interior.residual(self.v))]
        follow = getattr(state.time, "follow", None)
        if follow is not None:  # dynamic sub-scales
            follow(self._interior.fine_velocity, state.fluid_cell_numbers)
        if self._solid is not None:
            self.terms.append((("solid",), self._solid.residual))
        boundary, self._outlets = boundary_terms(self.conditions, state)
        self.terms += boundary
        self.sides = self._sides(str(kind)) if is_sided else None
        values, self.updates = strong_values(self.conditions, state)
        self._bcs = values if self._solid is None else [self._solid.condition, *values]
        # a solid that can be compressed determines the pressure of a fluid that is enclosed with it
        self.is_closed = solid is None and not any(condition.is_open(self.fields) for condition in conditions)
        if self.time is not None:
            hooks, bcs, solver = (self.updates, self.before, self.rank_one), tuple(self._bcs), self.options.solver
            fluid, surface = (self.is_closed, self.rho, self.mu), (self.scales, self.sides)
            self.time.needs = FlowNeeds(*hooks, bcs, moving, solver, *fluid, *surface)
        self._is_made = True

    def _sides(self, kind: str) -> Any:
        """What differs on both sides of a surface."""
        from varmint.flow.sides import FlowSides  # other flows need nothing of it

        return FlowSides(self._state, self._interior, self.conditions, kind)

    @property
    def is_immersed(self) -> bool:
        """Whether a surface may be immersed."""
        return self.scales is not None or self.sides is not None

    def __repr__(self) -> str:
        return f"Flow({self._state.outline}, {'; '.join(map(str, self.conditions))})"

    # -- equations ----------------------------------------------------------------------------------------------------

    @property
    def fluid_cells(self) -> tuple[str, ...]:
        """Cell groups of the fluid; none: all cells."""
        return self._state.fluid_cells

    @property
    def residual(self) -> ufl.Form:
        """The whole residual."""
        return sum((form for _, form in self.terms[1:]), self.terms[0][1])

    @property
    def tangent(self) -> ufl.Form | None:
        """Tangent where it is not the derivative of the residual."""
        if not self.options.frozen_tangent:
            return None
        tangent = self._interior.frozen_tangent()
        rest = [form for _, form in self.terms[1:]]
        return tangent + ufl.derivative(sum(rest[1:], rest[0]), self.w) if rest else tangent

    @property
    def bcs(self) -> list[Any]:
        """Strong boundary conditions, with the pinned pressure where that is what fixes its constant."""
        pinned = self.is_closed and not self._by_null_space
        pin = [pressure_pin(self.V, self.mesh, self.fluid_cells, self.options.pin_at)] if pinned else []
        return [*self._bcs, *pin]

    @property
    def _by_null_space(self) -> bool:
        return by_null_space(self.options.pressure, self.recipe, immersed=self.is_immersed)

    @property
    def rank_one(self) -> tuple[OutletPressure, ...]:
        """Pressures of outlets with a resistance, whose tangent is dense, for whoever solves the flow."""
        return tuple(self._outlets)

    @property
    def before(self) -> tuple[Callable[[], None], ...]:
        """To be called before every assembly of the residual by whoever solves the flow."""
        solid = () if self._solid is None else (self._solid.move_mesh,)
        return (*(outlet.update for outlet in self._outlets), *solid)

    # -- systems ------------------------------------------------------------------------------------------------------

    @cached_property
    def recipe(self) -> LinearSolver:
        """Linear solver recipe, as PETSc's options with the prefix ``fluid_`` change it."""
        dimension = int(self.mesh.domain.geometry.dim)
        kept = self.time is not None and self.options.keep is not None
        rtol = STEADY_LINEAR_RTOL if self.time is None else STEP_LINEAR_RTOL
        known = {"immersed" if self.is_immersed else "dimension": dimension, "ranks": self.mesh.domain.comm.size}
        default = automatic(self.unknowns, blocked=True, kept=kept, rtol=rtol, **known)
        return chosen(self.options.solver, default, PREFIX)

    @property
    def pressure_dofs(self) -> IntArray | None:
        """Where the pressure lies in the unknown, if its constant is left to the null space."""
        left = self.is_closed and self._by_null_space
        return compat.component_space(self.V, self.mesh.domain.geometry.dim)[1] if left else None

    @cached_property
    def system(self) -> FiniteElementSystem:
        """Compiled system."""
        return FiniteElementSystem(
            self.residual, self.w, self.bcs, tangent=self.tangent, solver=self.recipe, constant=self.pressure_dofs,
            rank_one=self.rank_one, before=self.before, resolution=getattr(self._solid, "resolution", None),
            prefix=PREFIX,
        )  # fmt: skip

    def compile(self) -> None:
        """Compile the forms now instead of at the first solve."""
        _ = self.system

    @property
    def unknowns(self) -> int:
        """Global number of unknowns."""
        return compat.unknowns(self.V)

    # -- states -------------------------------------------------------------------------------------------------------

    def start(self, velocity: Data = None, pressure: Any = None, *, projected: bool = False) -> None:
        """Set the state at the present time.

        Args:
            velocity: UFL vector, numbers, or a callable of coordinates and time; None: at rest.
            pressure: UFL scalar, number or callable; None: zero.
            projected: whether to project in L2 instead of interpolating at the nodes.

        Raises:
            ValueError: the velocity is not a finite vector of shape (d,), or the pressure not finite.
        """
        set_state(self._state, velocity, pressure, projected=projected)

    def consistent_start(self) -> None:
        """Compute the rate and the pressure that belong to the present velocity, for second order in time.

        Raises:
            FlowError: they could not be computed.
            ValueError: the flow is steady.
        """
        if self.time is None:
            raise ValueError("dt = None: only an unsteady flow has initial rates")
        for outlet in self._outlets:
            outlet.update()
        consistent_start(
            self._state, self.time, self.residual, self.options.tau_dt, self.updates, self.bcs,
            solver=self.recipe, constant=self.pressure_dofs, prefix=PREFIX,
        )  # fmt: skip

    # -- solving ------------------------------------------------------------------------------------------------------

    def take_step(self, measure: Callable[[], Any] | None = None) -> FlowReport:
        """Advance by one time step.

        Args:
            measure: called with the new state before the clock moves; what it returns is in the report.

        Returns:
            The report.

        Raises:
            FlowError: the step failed; the state is that before it.
        """
        time = self._own_clock()
        check_clock(time, self.moving)
        return flow_step(
            self._state, time, self.system, lambda: self._newton(keep=self.options.keep), self.updates, measure,
            has_solid=self._solid is not None,
        )  # fmt: skip

    def _own_clock(self) -> FlowTime:
        """The integrator, if the flow may step."""
        if self.time is None:
            raise ValueError("dt = None: a steady flow has no steps")
        if self.time.partner is not None:
            raise ValueError("the flow is coupled with a shell: take the steps of what couples them")
        return self.time

    def run(self, *, halvings: int = 6, **options: Any) -> "Run":
        """A run of many steps, as an iterator of their reports.

        Args:
            halvings: how often a step that fails may be halved.
            options: see :class:`tigar_x.run.running.Run`.

        Raises:
            ValueError: the flow is steady or coupled, or an option is not allowed.
        """
        from tigar_x.run.running import Run  # single steps need nothing of it
        from tigar_x.run.stepping import IntegratorStepper

        integrators: dict[str, Any] = {"flow": self._own_clock()} | (
            {} if self.moving is None else {"mesh": self.moving.time}
        )
        sizes = {"dofs_fluid": self.unknowns}
        stepper = IntegratorStepper(self.take_step, FlowError, halvings=halvings, sizes=sizes, **integrators)
        return Run(stepper, **options)

    def solve(self) -> FlowReport:
        """Solve for the steady flow, from the present state.

        Newton's method with a line search comes first. Where it fails the viscosity is raised until it succeeds, and
        comes down again with each solution as the next start, in steps that are halved where it fails again.

        Returns:
            The report.

        Raises:
            FlowError: no steady flow was found; the state is that before.
        """
        if self.time is not None:
            raise ValueError(f"dt = {self.time.step_size!r}: a steady flow has none")
        return solve_steady(self._state, self.system, lambda: self._newton(line_search=LineSearch(), stalled=STALLED))

    def _newton(self, **options: Any) -> NewtonReport:
        o, system = self.options, self.system
        default = STEADY_RTOL if self.time is None else STEP_RTOL[self.recipe.is_direct]
        options |= {"atol": system.rounding, "reference": system.reference_norm, "max_iterations": o.max_iterations}
        return newton(system, rtol=default if o.rtol is None else o.rtol, **options)
