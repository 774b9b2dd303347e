"""A flow as one object: mesh, fluid and conditions become residual, boundary values, solver and steps.

What the scene does not have is not in its forms, see :mod:`varmint.vms`; what is compiled is compiled at the first
solve. The residual, its conditions and its integrator can be given to a coupler instead of being solved here.
"""

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np
import ufl
from mpi4py import MPI
from dolfinx import fem

from tigar_x import checks, compat
from tigar_x.compat import IntArray
from tigar_x.line_search import LineSearch
from tigar_x.linear import LinearSolver, SolveError, automatic
from tigar_x.solve import FiniteElementSystem, NewtonReport, newton
from tigar_x.time_integration import Scheme, TimeIntegrator, generalized_alpha
from varmint.ale import divergence, per_volume
from varmint.conditions import Condition, Data, Fields, Resistance, given
from varmint.attachments import OutletPressure, SolidInFlow, pressure_pin
from varmint.mesh import NamedMesh
from varmint.motion import ElasticMotion, PrescribedMotion
from varmint.solids import Solid
from varmint.space import equal_order_space, split
from varmint.vms import frozen_tangent, interior_residual

log = logging.getLogger(__name__)

STEP_RTOL = 1e-6
"""Accepted residual of a step relative to its first one."""
STEADY_RTOL = 1e-12
"""Accepted residual of steady flow relative to its first one, which the penalty of weak conditions may dominate."""
STALLED = 1e3
"""Multiple of the accepted residual that is accepted as well where rounding keeps Newton's method from going on."""
FACTOR, SMALLEST_FACTOR, HIGHEST_FACTOR = 4.0, 1.1, 1e9
"""Where Newton's method fails in steady flow: by which factor's square the viscosity is raised first, the smallest step
down to go on with, and how far it is raised at most."""


class FlowError(RuntimeError):
    """A step or a steady solve that failed; the flow is in the state before it.

    Attributes:
        t: time of the step; None: steady flow.
    """

    def __init__(self, message: str, t: float | None = None) -> None:
        super().__init__(message)
        self.t = t


@dataclass(frozen=True)
class FlowOptions:
    """How a flow is discretised and solved.

    Attributes:
        C_I: constant of the viscous term in tau_M; None: 3 for degree 1, else 6 k^4.
        C_t: constant of the time-step term in tau_M.
        tau_dt: time step in tau_M, where it is not to change with the step; None: that of the step. Unit: time.
        invariant_metric: whether the element metric does not depend on the numbering of vertices.
        frozen_tangent: whether the tangent leaves out the derivatives of the stabilisation parameters.
        quadrature_degree: None: 2 k, and more where a mesh's displacement is not linear.
        pressure: how the constant of the pressure is fixed in a flow without an open boundary: by the null space of an
            iterative solver, which keeps the nodal mean, or by a pinned degree of freedom.
        pin_at: where the pressure is pinned to zero; None: the vertex with the smallest sum of coordinates.
        solver: linear solver recipe; None: by size, see :func:`tigar_x.linear.automatic`.
        rtol: accepted residual relative to the first one of a step or solve; None: ``STEP_RTOL`` or ``STEADY_RTOL``.
        max_iterations: Newton iterations after which a step or solve has failed.
        keep: see :func:`tigar_x.solve.newton`; in steady flow every iteration has a new tangent.

    Raises:
        ValueError: a number is out of range.
    """

    C_I: float | None = None
    C_t: float = 4.0
    tau_dt: float | None = None
    invariant_metric: bool = False
    frozen_tangent: bool = False
    quadrature_degree: int | None = None
    pressure: Literal["automatic", "null space", "pin"] = "automatic"
    pin_at: Sequence[float] | None = None
    solver: LinearSolver | None = None
    rtol: float | None = None
    max_iterations: int = 25
    keep: float | None = 0.2

    def __post_init__(self) -> None:
        for name, check in (
            ("C_I", checks.not_negative),
            ("tau_dt", checks.positive),
            ("rtol", checks.positive),
            ("keep", lambda n, x: checks.within(n, x, 0.0, 1.0)),
        ):
            if getattr(self, name) is not None:
                check(name, getattr(self, name))
        checks.not_negative("C_t", self.C_t)
        checks.choice("pressure", self.pressure, ("automatic", "null space", "pin"))
        checks.whole("max_iterations", self.max_iterations, 1)


@dataclass(frozen=True)
class FlowReport:
    """What a step or a steady solve did.

    Attributes:
        t: end of the step; 0 in steady flow.
        residuals: norms of the residual, from the first to the accepted one.
        linear_iterations: iterations of the linear solver in all.
        tangents: number of tangents that were assembled.
        measured: what the step's ``measure`` returned.
    """

    t: float
    residuals: tuple[float, ...]
    linear_iterations: int
    tangents: int
    measured: Any = None

    @property
    def iterations(self) -> int:
        """Number of Newton iterations."""
        return len(self.residuals) - 1


class Flow:
    """Incompressible flow on a mesh with named facets.

    Args:
        mesh: mesh.
        conditions: conditions on facet groups; every boundary facet needs one.
        rho: density > 0, a number or Constant; unit: mass/volume.
        mu: dynamic viscosity >= 0 (> 0 in steady flow), a number or Constant.
        degree: polynomial degree k of velocity and pressure.
        dt: time step; None: steady flow. Unit: time.
        scheme: first-order scheme; None: generalized-alpha with rho_infinity = 1/2.
        f: body force per mass; None: none.
        moving: motion of the mesh, with the same time step and scheme; None: it is fixed.
        solid: elastic solid in some cells of the mesh, which ``moving`` has to leave out; None: fluid alone.
        scale_m: factor of tau_M near an immersed surface; None: no surface.
        scale_c: divisor of tau_C near an immersed surface; None: no surface.
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
        bcs: strong boundary conditions.
        updates: to be called with t_alpha at the start of every step by whoever steps the flow.
        is_closed: whether no boundary is open, so that a constant of the pressure remains.

    Raises:
        ValueError: a number, shape or name is not allowed, or a boundary facet has no condition or two.
    """

    def __init__(
        self,
        mesh: NamedMesh,
        conditions: Sequence[Condition],
        *,
        rho: Any,
        mu: Any,
        degree: int = 1,
        dt: float | None = None,
        scheme: Scheme | None = None,
        f: Data = None,
        moving: PrescribedMotion | ElasticMotion | None = None,
        solid: Solid | None = None,
        scale_m: Any = None,
        scale_c: Any = None,
        options: FlowOptions | None = None,
    ) -> None:
        domain, self.options = mesh.domain, FlowOptions() if options is None else options
        d = domain.geometry.dim
        self._check(rho, mu, dt, moving, solid)
        _check_cover(mesh, conditions)
        self.mesh, self.conditions, self.degree = mesh, tuple(conditions), degree
        self.rho, self.mu = (
            value if isinstance(value, fem.Constant) else fem.Constant(domain, float(value)) for value in (rho, mu)
        )
        self.V = equal_order_space(domain, degree)
        self.w = fem.Function(self.V, name="w")
        self.moving = moving
        self.time: TimeIntegrator | None = None
        level, rate, t, t_alpha = self.w, None, fem.Constant(domain, 0.0), None
        if dt is not None:
            self.time = TimeIntegrator(self.w, dt, generalized_alpha(0.5) if scheme is None else scheme, algebraic=(d,))
            level, rate, t, t_alpha = self.time.x_alpha, split(self.time.xdot_alpha)[0], self.time.t, self.time.t_alpha
        self._steady_time = t if dt is None else None
        (self.v, self.p), (w, q) = split(level), split(ufl.TestFunction(self.V))
        motion = None if moving is None else moving.motion
        extra = 0 if motion is None else 2 * (motion.degree - 1)
        quadrature = 2 * degree + extra if self.options.quadrature_degree is None else self.options.quadrature_degree
        self.fields = Fields(
            mesh, self.v, self.p, w, q, self.rho, self.mu, t, t if t_alpha is None else t_alpha, motion,
            None if moving is None else moving.end, self.options.invariant_metric, quadrature,
        )  # fmt: skip
        force = None if f is None else self.fields.vector("f", f)
        self._solid = None if solid is None else SolidInFlow(solid, self, moving, force)
        self._interior = {"v_t": rate, "f": force, "scale_m": scale_m, "scale_c": scale_c}
        self._outlets: list[OutletPressure] = []
        self.terms = self._terms()
        self._values: list[Callable[[], None]] = []
        self._bcs = [] if self._solid is None else [self._solid.condition]
        self._prescribe()
        self.is_closed = not any(condition.is_open for condition in conditions)

    def _check(self, rho: Any, mu: Any, dt: Any, moving: Any, solid: Any) -> None:
        checks.parameter("rho", rho, checks.positive)
        checks.parameter("mu", mu, checks.not_negative if dt is not None else _positive_if_steady)
        if dt is not None:
            checks.positive("dt", dt)
        elif moving is not None or solid is not None:
            raise ValueError("dt = None: a time step is required where the mesh moves or a solid is in the flow")
        if moving is not None and dt != moving.time.step_size:
            raise ValueError(f"dt = {dt!r}: that of the moving mesh, {moving.time.step_size!r}, is required")
        if solid is not None and not isinstance(moving, ElasticMotion):
            raise ValueError(f"moving = {moving!r}: a solid in the flow requires an ElasticMotion of the other cells")

    # -- forms --------------------------------------------------------------------------------------------------------

    def _terms(self) -> list[tuple[tuple[str, ...], ufl.Form]]:
        terms = [(("fluid",), self.interior(self.v))]
        if self._solid is not None:
            terms.append((("solid",), self._solid.residual))
        for condition in self.conditions:
            if isinstance(condition, Resistance):
                outlet = OutletPressure(condition, self)
                self._outlets.append(outlet)
                term: ufl.Form | None = condition.term_with(self.fields, outlet.pressure)
            else:
                term = condition.term(self.fields)
            if term is not None:
                terms.append((condition.groups, term))
        return terms

    def interior(self, v_tau: Any) -> ufl.Form:
        """Residual in the fluid, with a velocity of its own in the stabilisation parameters."""
        f, o = self.fields, self.options
        dt: Any = None
        if self.time is not None:
            dt = self.time.dt if o.tau_dt is None else fem.Constant(self.mesh.domain, float(o.tau_dt))
        return interior_residual(
            f.v, f.p, f.w, f.q, self.mesh.domain, rho=self.rho, mu=self.mu, degree=self.degree, dt=dt, C_I=o.C_I,
            C_t=o.C_t, motion=f.motion, invariant=o.invariant_metric, v_tau=v_tau,
            dx=self.mesh.dx(*self.fluid_cells, degree=f.degree), **self._interior,
        )  # fmt: skip

    @property
    def fluid_cells(self) -> tuple[str, ...]:
        """Cell groups of the fluid; none: all cells."""
        return () if self._solid is None else self._solid.fluid

    @property
    def residual(self) -> ufl.Form:
        """The whole residual."""
        return sum((form for _, form in self.terms[1:]), self.terms[0][1])

    @property
    def tangent(self) -> ufl.Form | None:
        """Tangent where it is not the derivative of the residual."""
        if not self.options.frozen_tangent:
            return None
        x_tau = fem.Function(self.V)
        frozen = self.interior(ufl.replace(self.v, {self.w: x_tau}))
        rest = sum((form for _, form in self.terms[2:]), self.terms[1][1]) if len(self.terms) > 1 else None
        tangent = frozen_tangent(frozen, self.w, x_tau)
        return tangent if rest is None else tangent + ufl.derivative(rest, self.w)

    # -- boundary values ----------------------------------------------------------------------------------------------

    def _prescribe(self) -> None:
        for condition in self.conditions:
            for item in condition.strong(self.fields):
                values, bc = compat.prescribed_component(self.V, item.component, item.facets)
                interpolate = compat.Interpolation(values, ufl.as_ufl(item.value))
                interpolate()
                if _varies(item.value):
                    self._values.append(interpolate)
                self._bcs.append(bc)

    @property
    def bcs(self) -> list[Any]:
        """Strong boundary conditions, with the pinned pressure where that is what fixes its constant."""
        pin = self.is_closed and not self._by_null_space
        return [*self._bcs, pressure_pin(self.V, self.options.pin_at)] if pin else self._bcs

    @property
    def updates(self) -> tuple[Callable[[float], None], ...]:
        """To be called with t_alpha at the start of every step by whoever steps the flow."""
        return tuple(lambda _, refresh=refresh: refresh() for refresh in self._values)

    # -- systems ------------------------------------------------------------------------------------------------------

    @cached_property
    def recipe(self) -> LinearSolver:
        """Linear solver recipe."""
        if self.options.solver is not None:
            return self.options.solver
        index_map = self.V.dofmap.index_map
        return automatic(index_map.size_global * self.V.dofmap.index_map_bs, blocked=True)

    @property
    def _by_null_space(self) -> bool:
        chosen = self.options.pressure
        return chosen == "null space" or (chosen == "automatic" and not self.recipe.is_direct)

    @property
    def _pressure_dofs(self) -> IntArray | None:
        """Where the pressure lies in the unknown, if its constant is left to the null space."""
        if not (self.is_closed and self._by_null_space):
            return None
        return compat.component_space(self.V, self.mesh.domain.geometry.dim)[1]

    @cached_property
    def system(self) -> FiniteElementSystem:
        """Compiled system."""
        before: list[Callable[[], None]] = [outlet.update for outlet in self._outlets]
        if self._solid is not None:
            before.append(self._solid.move_mesh)
        return FiniteElementSystem(
            self.residual, self.w, self.bcs, tangent=self.tangent, solver=self.recipe,
            constant=self._pressure_dofs, rank_one=self._outlets, before=before,
        )  # fmt: skip

    def compile(self) -> None:
        """Compile the forms now instead of at the first solve."""
        _ = self.system

    @property
    def unknowns(self) -> int:
        """Global number of unknowns."""
        return int(self.V.dofmap.index_map.size_global * self.V.dofmap.index_map_bs)

    # -- states -------------------------------------------------------------------------------------------------------

    def start(self, velocity: Data = None, pressure: Any = None, *, project: bool = False) -> None:
        """Set the state at the present time.

        Args:
            velocity: UFL vector, numbers, or a callable of coordinates and time; None: at rest.
            pressure: UFL scalar, number or callable; None: zero.
            project: whether to project in L2 instead of interpolating at the nodes.
        """
        domain, d = self.mesh.domain, self.mesh.domain.geometry.dim
        x = ufl.SpatialCoordinate(domain)
        if self.moving is not None:
            x = x + self.moving.time.x_old
        t = fem.Constant(domain, 0.0 if self.time is None else self.time.time)
        u, p = given(velocity, x, t), given(pressure, x, t)
        components = [0.0] * d if u is None else [u[i] for i in range(d)]
        state = ufl.as_vector([*components, 0.0 if p is None else p])
        if project:
            _project(self.w, state, 2 * self.degree + 2)
        else:
            compat.interpolate(self.w, state)
        if self.time is not None:
            self.time.x_old.x.array[:] = self.w.x.array
            self.time.xdot_old.x.array[:] = 0.0

    def consistent_start(self) -> None:
        """Compute the rate and the pressure that belong to the present velocity, for second order in time.

        The rate balances momentum and is solenoidal; the residual of continuity, which the velocity alone would have to
        balance, contributes its stabilisation.

        Raises:
            FlowError: they could not be computed.
        """
        time = self.time
        if time is None:
            raise ValueError("dt = None: only an unsteady flow has initial rates")
        others = () if self.moving is None else (self.moving.time,)
        form, unknown = time.initial_form(self._differentiated(time), *others)
        self._prescribe_rates(unknown)
        constant = self._pressure_dofs
        system = FiniteElementSystem(form, unknown, self.bcs, solver=self.recipe, constant=constant)
        try:
            newton(system, rtol=1e-10, max_iterations=10)
        except SolveError as error:
            raise FlowError(f"no consistent start: {error}", time.time) from error
        time.start(unknown)
        self.w.x.array[:] = time.x_old.x.array

    def _differentiated(self, time: TimeIntegrator) -> ufl.Form:
        """The residual with the rate's divergence in place of the velocity's."""
        f, period = self.fields, time.dt if self.options.tau_dt is None else self.options.tau_dt
        rate = split(time.xdot_alpha)[0]
        change = divergence(period * rate - f.v, f.motion)
        dx = self.mesh.dx(*self.fluid_cells, degree=f.degree)
        return self.residual + per_volume(f.q * change, f.motion) * dx

    def _prescribe_rates(self, unknown: fem.Function) -> None:
        """Rates of the strong values by central differences."""
        time = self.time
        dofs = compat.constrained_dofs(self._bcs)
        if not len(dofs) or time is None:
            return
        sides, end = [], float(time.t.value)
        delta = 1e-3 * time.step_size
        for sign in (-1.0, 1.0):
            time.t.value = time.time + sign * delta
            for refresh in self._values:
                refresh()
            side = fem.Function(self.V)
            compat.apply_values(side, self._bcs)
            sides.append(side.x.array.copy())
        time.t.value = end
        unknown.x.array[dofs] = ((sides[1] - sides[0]) / (2.0 * delta))[dofs]

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
        time = self.time
        if time is None:
            raise ValueError("dt = None: a steady flow has no steps")
        try:
            time.predict()
            if self.moving is not None:
                self.moving.time.predict()
                self.moving.move()
                self.moving.check()
            for update in self.updates:
                update(float(time.t_alpha.value))
            self.system.apply_boundary_values()
            done = self._newton(keep=self.options.keep)
            if self._solid is not None and self.moving is not None:
                self.moving.check()
            measured = None if measure is None else measure()
        except SolveError as error:
            t = float(time.t.value)
            time.restore()
            if self.moving is not None:
                self.moving.time.restore()
            raise FlowError(f"the step to t = {t:.6g} (dt = {time.step_size:.3g}) failed: {error}", t) from error
        time.advance()
        if self.moving is not None:
            self.moving.time.advance()
        return FlowReport(time.time, done.norms, sum(done.linear_iterations), done.tangents, measured)

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
        before, mu = self.w.x.array.copy(), float(self.mu.value)
        try:
            return self._continued(mu)
        except SolveError as error:
            self.w.x.array[:] = before
            raise FlowError(
                f"no steady flow at mu = {mu:.3g}: {error}; refine the mesh, start from a similar flow, or step"
                " through time"
            ) from error
        finally:
            self.mu.value = mu

    def _continued(self, mu: float) -> FlowReport:
        """Newton's method, with steady flows at higher viscosities on the way where it needs them."""
        linear, tangents, above = 0, 0, None
        start, waiting = self.w.x.array.copy(), [mu]
        while True:
            self.mu.value = waiting[-1]
            try:
                self.system.apply_boundary_values()
                done = self._newton(line_search=LineSearch(), stalled=STALLED)
            except SolveError as error:
                here = waiting[-1]
                if (above is not None and above < SMALLEST_FACTOR * here) or here > HIGHEST_FACTOR * mu:
                    reached = "at none" if above is None else f"down to mu = {above:.3g}"
                    raise SolveError(f"steady flow was found {reached}; {error}") from error
                waiting.append(FACTOR**2 * here if above is None else (here * above) ** 0.5)
                log.info("no steady flow at mu = %.3g yet; next, mu = %.3g", here, waiting[-1])
                self.w.x.array[:] = start
                continue
            linear += sum(done.linear_iterations)
            tangents += done.tangents
            above, start = waiting.pop(), self.w.x.array.copy()
            if not waiting:
                return FlowReport(0.0, done.norms, linear, tangents)

    def _newton(self, **options: Any) -> NewtonReport:
        o, system = self.options, self.system
        rtol = o.rtol if o.rtol is not None else STEADY_RTOL if self.time is None else STEP_RTOL
        return newton(system, rtol=rtol, atol=system.rounding(), max_iterations=o.max_iterations, **options)


def _positive_if_steady(name: str, value: Any) -> float:
    if checks.not_negative(name, value) == 0.0:
        raise ValueError(
            f"{name} = {value!r}: a number > 0 is required in steady flow, whose stabilisation has no bound"
            " where the fluid rests"
        )
    return float(value)


def _varies(value: Any) -> bool:
    from ufl.algorithms import extract_coefficients
    from ufl.algorithms.analysis import extract_constants

    expression = ufl.as_ufl(value)
    return bool(extract_coefficients(expression) or extract_constants(expression))


def _project(function: fem.Function, expression: Any, degree: int) -> None:
    dx = ufl.dx(domain=function.function_space.mesh, metadata={"quadrature_degree": degree})
    residual = ufl.inner(function - expression, ufl.TestFunction(function.function_space)) * dx
    newton(FiniteElementSystem(residual, function), rtol=1e-10)


def _check_cover(mesh: NamedMesh, conditions: Sequence[Condition]) -> None:
    domain = mesh.domain
    if not conditions:
        raise ValueError("conditions is empty: every boundary facet needs one")
    named = [mesh.facets(*condition.groups) for condition in conditions]
    exterior = compat.exterior_facets(domain)
    covered = np.unique(np.concatenate(named))
    counts = np.array([len(np.setdiff1d(exterior, covered)), len(exterior)])
    missing, total = domain.comm.allreduce(counts, op=MPI.SUM)
    if missing:
        used = {name for condition in conditions for name in condition.groups}
        free = [name for name in mesh.facet_names if name not in used]
        raise ValueError(
            f"{missing} of {total} boundary facets have no condition: facet groups without one are"
            f" {', '.join(map(repr, free)) or 'none, but some facets belong to no group'}"
        )
    seen: set[str] = set()
    for condition in conditions:
        for name in condition.groups:
            if name in seen:
                raise ValueError(f"facet group {name!r} has two conditions: one is allowed")
            seen.add(name)
