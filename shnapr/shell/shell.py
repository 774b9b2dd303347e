"""A shell as one object: geometry, material, supports and loads become residual, tangent, system, solves and steps.

What the scene does not have is not in its forms, and no module is imported for it. Forms are compiled at the first
solve. Instead of being solved here, residual, tangent and integrator can be given to a coupler, which brings the clock:
see :meth:`Shell.bind`.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import scipy.sparse as sp
import ufl
from mpi4py import MPI
from dolfinx import fem
from numpy.typing import ArrayLike

from shnapr.conditions import Fields, Load
from shnapr.loads import inertia
from shnapr.parameters import with_constants
from shnapr.planes import RigidPlane, plane_contact
from shnapr.shell.options import ShellError, ShellOptions, ShellReport, newton_options
from shnapr.shell.quantities import Energies, Places, derivative_of, on_side, resultant
from shnapr.shell.statics import Statics
from shnapr.shell.supported import supported
from shnapr.work import Material, internal_tangent, internal_work, strain_energy
from tigar_x import checks, compat
from tigar_x.compat import FloatArray
from tigar_x.fem.eigen import Eigenpairs, eigenmodes
from tigar_x.fem.linear import LinearSolver, SolveError, direct
from tigar_x.fem.load_stepping import LoadReport, StepControl
from tigar_x.fem.newton import NewtonReport, newton
from tigar_x.fem.schemes import Scheme, companion, generalized_alpha
from tigar_x.fem.time_integration import LoadStepper, TimeIntegrator
from tigar_x.geometry.multipatch import MultiPatch
from tigar_x.geometry.patch import Patch
from tigar_x.ranks import agreed
from tigar_x.splines.quadrature import NodalQuadrature
from tigar_x.splines.spline import ExtractedSpline
from tigar_x.splines.spline_system import SplineSystem

if TYPE_CHECKING:
    from shnapr.contact.self_contact import SelfContact

__all__ = ["Shell"]


class Contact(Protocol):
    """Recipe of contact, such as :class:`shnapr.contact.ContactRecipe`."""

    def of(self, quadrature: NodalQuadrature) -> "SelfContact":
        """The contact between points."""


class Shell:
    """A thin shell, or several in one geometry: a surface in space, or a curve in the plane per unit depth.

    Without a time step it is static, until a coupler brings one. Numbers of material, loads and planes become
    Constants, under the same names in the attributes: to change one compiles nothing.

    Args:
        geometry: patches, or a spline that has its supports.
        material: see :class:`shnapr.work.Material`.
        density: rho_s >= 0, a number or Constant; None: none, for statics. Unit: mass/volume.
        clamped: names of edges whose position and tangent plane are held, see :func:`shnapr.supports.clamped`.
        pinned: names of edges whose position is held.
        zero_dofs: further coefficients (function * nsd + component) that do not move, such as those of
            :func:`shnapr.supports.pinned` in some directions or of :func:`shnapr.supports.fixed`.
        constraints: linear constraints, see :mod:`tigar_x.splines.constraints`.
        loads: see :mod:`shnapr.conditions`.
        planes: rigid planes that it may touch.
        contact: of the shell with itself; None: none.
        dt: time step; None: statics, or that of a coupler. Unit: time.
        scheme: second-order scheme; None: generalized-alpha with rho_infinity = 1/2.
        updates: called with the time of the equations at the start of every step, in statics with the load factor of
            every attempt, for data that are not UFL.
        quadrature_degree: of every integral; None: twice the largest degree.
        solver: linear solver recipe; None: direct.
        options: of Newton's method.
        comm: where the spline lives: on ``MPI.COMM_SELF`` every rank has a copy of the whole.
        copies: ranks with a copy of this shell, which take the same steps; of a distributed shell there is one.

    Attributes:
        spline: the midsurface.
        material: with Constants for numbers.
        density: Constant; None: none.
        loads: with Constants for numbers.
        planes: likewise.
        y: homogeneous displacement at the end of the step.
        time: integrator of y; None: statics.
        contact: nonlocal contact; None: none.
        solver: linear solver recipe.
        updates: as given.
        options: of Newton's method.

    Raises:
        ValueError: a number, shape or name is not allowed, or something that one argument needs is not given.
    """

    def __init__(
        self,
        geometry: Patch | MultiPatch | ExtractedSpline,
        material: Material,
        *,
        density: Any = None,
        clamped: Sequence[str] = (),
        pinned: Sequence[str] = (),
        zero_dofs: ArrayLike | Sequence[int] = (),
        constraints: Sequence[sp.spmatrix] = (),
        loads: Sequence[Load] = (),
        planes: Sequence[RigidPlane] = (),
        contact: Contact | None = None,
        dt: float | None = None,
        scheme: Scheme | None = None,
        updates: Sequence[Callable[[float], None]] = (),
        quadrature_degree: int | None = None,
        solver: LinearSolver | None = None,
        options: ShellOptions | None = None,
        comm: MPI.Comm = MPI.COMM_SELF,
        copies: MPI.Comm = MPI.COMM_WORLD,
    ) -> None:
        if density is not None:
            checks.parameter("density", density, checks.not_negative)
        if dt is None and scheme is not None:
            raise ValueError("dt = None with a scheme: a time step is required, or neither")
        self.spline = supported(
            geometry, comm, clamped=clamped, pinned=pinned, zero_dofs=zero_dofs, constraints=constraints,
            quadrature_degree=quadrature_degree,
        )  # fmt: skip
        domain = self.spline.mesh
        self.copies = copies if domain.comm.size == 1 else MPI.COMM_SELF
        self.material = with_constants(domain, material)
        self.density = compat.Constant(domain, float(density)) if isinstance(density, int | float) else density
        self.loads = tuple(with_constants(domain, load) for load in loads)
        self.planes = tuple(_plane(domain, plane) for plane in planes)
        self.solver = direct() if solver is None else solver
        self.updates = tuple(updates)
        self.options = ShellOptions() if options is None else options
        self.contact = None if contact is None else contact.of(NodalQuadrature.of(self.spline))
        self.y = self.spline.function(name="y")
        self._test = ufl.TestFunction(self.spline.V)
        self._velocity: fem.Function | None = None
        self._factor = LoadStepper(self.y, 1.0)
        self.time: TimeIntegrator | None = None
        self._rest: list[ufl.Form] = []
        if dt is None:
            self._collect()
        else:
            self._set_clock(dt, generalized_alpha(0.5, 2) if scheme is None else scheme, 0.0)

    def __repr__(self) -> str:
        geometry = self.spline.geometry
        kind = "a curve" if self.spline.dim == 1 else "a surface"
        parts = [f"{kind} of {geometry.n} functions", type(self.material).__name__]
        parts += [type(load).__name__ for load in self.loads] + ["RigidPlane"] * len(self.planes)
        parts += [] if self.contact is None else ["contact"]
        parts.append("statics" if self.time is None else f"t = {self.time.time:g}, dt = {self.time.step_size:g}")
        return f"Shell({', '.join(parts)})"

    # -- clock --------------------------------------------------------------------------------------------------------

    def bind(self, dt: float, scheme: Scheme, t: float = 0.0) -> None:
        """Give a shell that has no clock one that others have as well, or check that its own agrees.

        Displacement and velocity are then those that it has, such as of a static solve before.

        Args:
            dt: time step; unit: time.
            scheme: of second order; for one of first order, as a flow has, its companion is taken.
            t: time of the present state.

        Raises:
            ValueError: the shell has no density, or a clock of its own that differs.
        """
        wanted = companion(scheme) if scheme.order == 1 else scheme
        own = self.time
        if own is None:
            self._set_clock(dt, wanted, t)
            return
        for name, has, needs in (("dt", own.step_size, dt), ("t", own.time, t), ("scheme", own.scheme, wanted)):
            if has != needs:
                raise ValueError(
                    f"{name} = {has!r}: the shell has a clock of its own, and {needs!r} is required by what it is"
                    " coupled with; make it without dt and scheme, and it gets those"
                )

    def _set_clock(self, dt: float, scheme: Scheme, t: float) -> None:
        if self.density is None:
            raise ValueError("density = None: one is required of a shell that moves in time (dt is given)")
        checks.choice("order of scheme", scheme.order, (2,))
        self.time = TimeIntegrator(self.y, dt, scheme, t=t, xdot=self._velocity)
        self._collect()

    # -- forms --------------------------------------------------------------------------------------------------------

    def _fields(self) -> Fields:
        time = self.time
        at: tuple[Any, ...] = (self.y, None, self._factor.t)
        if time is not None:
            at = (time.x_alpha, time.xdot_alpha, time.t_alpha)
        y, v, t = at
        thickness = getattr(self.material, "thickness", None)
        return Fields(self.spline, y, v, self._test, t, time is None, self.density, thickness)

    def _collect(self) -> None:
        """Terms of the residual but that of the material, now that the clock is known."""
        fields = self._fields()
        terms = self._acting(fields)
        if self.time is not None:
            mass = fields.mass("a shell that moves in time")
            terms.insert(0, inertia(self.spline, self.time.xddot_alpha, fields.z, **mass))
        self._rest = terms
        for name in ("residual", "tangent", "system", "_energy_forms"):
            self.__dict__.pop(name, None)

    def _acting(self, fields: Fields) -> list[ufl.Form]:
        """Terms of loads and planes."""
        terms = [load.term(fields) for load in self.loads]
        planes = [plane_contact(self.spline, plane, fields.y, fields.z) for plane in self.planes]
        return [*(term for term in terms if term is not None), *planes]

    @cached_property
    def residual(self) -> ufl.Form:
        """Residual without contact, at the level of the equations."""
        fields = self._fields()
        return sum(self._rest, internal_work(self.spline, self.material, fields.y, fields.z))

    @cached_property
    def tangent(self) -> ufl.Form:
        """Derivative of the residual by y."""
        fields = self._fields()
        own = internal_tangent(self.spline, self.material, fields.y, fields.z, self.y)
        return derivative_of(self._rest, self.y, own)

    @cached_property
    def system(self) -> SplineSystem:
        """Compiled system."""
        forms = (self.spline, self.residual, self.tangent)
        if self.contact is None:
            return SplineSystem(*forms, self.solver, unknown=self.y)
        from shnapr.contact.system import ContactSystem

        return ContactSystem(*forms, self.contact, unknown=self.y, time=self.time, solver=self.solver)

    def compile(self) -> None:
        """Compile the forms now instead of at the first solve."""
        _ = self.system

    @property
    def unknowns(self) -> int:
        """Number of coefficients that move."""
        return int(self.system.b.getSize()) - len(self.spline.zero_dofs)

    # -- states -------------------------------------------------------------------------------------------------------

    def start(self, displacement: Any = None, velocity: Any = None) -> None:
        """Set the state at the present time; in statics the load factor is zero again.

        Args:
            displacement: coefficients of shape (functions, nsd), or a UFL vector over the reference configuration (such
                as of ``shell.spline.F``), which is projected; None: undeformed.
            velocity: likewise; None: at rest. Before a coupler binds the shell it is kept for it.

        Raises:
            ValueError: a shape is not allowed.
        """
        y, v = (self._state(name, data) for name, data in (("displacement", displacement), ("velocity", velocity)))
        self.y.x.array[:] = y
        if self.time is None:
            self._velocity = self.spline.function(name="velocity")
            self._velocity.x.array[:] = v
            self._factor.resume(0.0)
            return
        self.time.x_old.x.array[:], self.time.xdot_old.x.array[:] = y, v
        self.time.xddot_old.x.array[:] = 0.0

    def _state(self, name: str, data: Any) -> FloatArray | float:
        if data is None:
            return 0.0
        if isinstance(data, ufl.core.expr.Expr):
            checks.vector(name, data, self.spline.nsd)
            return np.array(self.spline.project(data, constrained=True).x.array)
        coefficients = checks.array(name, data, (self.spline.geometry.n, self.spline.nsd))
        return np.array(self.spline.function(coefficients).x.array)

    @property
    def positions(self) -> FloatArray:
        """Present positions of this rank's nodes, shape (nodes, nsd); unit: length."""
        return self.spline.node_positions + self.spline.nodal(self.y)

    def at(self, place: ArrayLike | str, *, along: float = 0.5, patch: int = 0) -> Places:
        """Where points of the shell are (collective).

        Args:
            place: parameters within a patch, shape (points, parametric dimension) or that of one point; or the name of
                a side, such as that of a tip.
            along: of a side of a surface: how far along it the point is, from 0 to 1.
            patch: which patch.

        Returns:
            The places.

        Raises:
            ValueError: there is no such side or patch, or a parameter lies outside of it.
        """
        parameters = on_side(self.spline, place, along, patch) if isinstance(place, str) else place
        xi = np.atleast_2d(np.asarray(parameters, dtype=float))
        return Places.of(self.spline, self.y, xi, patch)

    # -- solving ------------------------------------------------------------------------------------------------------

    def solve(
        self,
        until: float = 1.0,
        *,
        step: float | None = None,
        control: StepControl | None = None,
        extrapolate: bool = False,
        each: Callable[[float], None] | None = None,
    ) -> LoadReport:
        """Equilibrium at a load factor, by load steps from the present state.

        Steps are cut where Newton's method fails. Loads that are not above the present one take one step.

        Args:
            until: load factor.
            step: first step of the load factor; None: all that is left.
            control: when steps are cut and grown; None: see :class:`tigar_x.fem.load_stepping.StepControl`, and no
                step is larger than the first one.
            extrapolate: whether steps start from the last increment in proportion.
            each: called with the load factor after every step.

        Returns:
            How the load was reached.

        Raises:
            ValueError: the shell has a clock.
            ShellError: the load was not reached; the state is the last equilibrium on the way, or that before.
        """
        statics = self._statics("solve")
        try:
            return statics.solve(until, self.options, step=step, control=control, extrapolate=extrapolate, each=each)
        except SolveError as error:
            reached = self._factor.time
            raise ShellError(f"no equilibrium at a load factor of {until:g}: {error}", reached) from error

    def solve_linear(self) -> None:
        """Displacement of the linear theory at the full load: one increment from the undeformed shell.

        Raises:
            ValueError: the shell has a clock.
            SolveError: the linear solver failed.
        """
        self._statics("solve_linear").solve_linear()

    def take_step(self, measure: Callable[[], Any] | None = None) -> ShellReport:
        """Advance by one time step.

        Args:
            measure: called with the new state before the clock moves; what it returns is in the report.

        Returns:
            The report.

        Raises:
            ValueError: the shell has no clock.
            ShellError: the step failed; the state is that before it.
        """
        time = self.time
        if time is None:
            raise ValueError("dt = None: a shell without a clock takes no steps; solve() finds its equilibrium")
        t, t_alpha = float(time.t.value), float(time.t_alpha.value)
        try:
            time.predict()
            for update in self.updates:
                update(t_alpha)
            done = agreed(self.copies, self._newton, self.y.x.array)
            measured = None if measure is None else measure()
        except Exception as error:
            time.restore()
            if not isinstance(error, SolveError):
                raise
            raise ShellError(f"the step to t = {t:.6g} (dt = {time.step_size:.3g}) failed: {error}", t) from error
        time.advance()
        return ShellReport(time.time, t_alpha, done.norms, done.tangents, measured)

    def _newton(self) -> NewtonReport:
        return newton(self.system, **newton_options(self.options, self.system))

    def _statics(self, name: str) -> Statics:
        if self.time is not None:
            raise ValueError(f"dt = {self.time.step_size!r}: {name}() is for shells without a clock; take_step()")
        return Statics(self.system, self._factor, self.updates, self.copies)

    # -- what follows from a state ------------------------------------------------------------------------------------

    @cached_property
    def _energy_forms(self) -> list[Any]:
        forms = [strain_energy(self.spline, self.material, self.y)]
        if self.time is not None:
            v, mass = self.spline.rationalize(self.time.xdot_old), self._fields().mass("kinetic energy")
            forms.append(mass["density"] * mass["thickness"] / 2 * ufl.inner(v, v) * self.spline.dx)
        return list(compat.compile_forms(*forms))

    def energies(self) -> Energies:
        """Energies of the present state (collective)."""
        elastic, *kinetic = (compat.assemble_scalar(form) for form in self._energy_forms)
        touching = 0.0
        if self.contact is not None:
            touching = self.contact.evaluate(self.positions, tangent=False).energy
        return Energies(elastic, kinetic[0] if kinetic else 0.0, touching)

    def support_force(self) -> FloatArray:
        """Resultant of the forces of supports and constraints on the shell (collective), shape (nsd,).

        It is what all other forces leave; those of contact with itself cancel. They belong to the equations: in time
        ask in the ``measure`` of a step.

        Raises:
            ValueError: no step is in progress.
        """
        if self.time is not None and not self.time.in_step:
            raise ValueError("support_force() between steps: ask for it in take_step(measure=...), in the equations")
        return resultant(self.spline, self.residual)

    def modes(self, count: int, *, shift: float = 0.0, backend: str | None = None) -> Eigenpairs:
        """Modes of vibration about the present state, and their squared circular frequencies.

        Args:
            count: number of modes.
            shift: see :func:`tigar_x.fem.eigen.eigenpairs`; a free shell needs a negative one.
            backend: see there.

        Returns:
            The modes, as homogeneous displacements, by increasing frequency.

        Raises:
            ValueError: the shell has no density, or touches itself in this state.
            SolveError: see :func:`tigar_x.fem.eigen.eigenpairs`.
        """
        if self.contact is not None and self.contact.evaluate(self.positions, tangent=False).pairs:
            raise ValueError("modes() of a shell that touches itself: contact has no part in them")
        t = self._factor.t if self.time is None else self.time.t
        fields = replace(self._fields(), y=self.y, v=None, t=t)
        stiffness = internal_tangent(self.spline, self.material, self.y, self._test, self.y)
        stiffness = derivative_of(self._acting(fields), self.y, stiffness)
        mass = inertia(self.spline, ufl.TrialFunction(self.spline.V), self._test, **fields.mass("modes"))
        return eigenmodes(self.spline, stiffness, mass, count, shift=shift, backend=backend)


def _plane(domain: Any, plane: RigidPlane) -> RigidPlane:
    """A plane whose point and stiffness are Constants where they are numbers."""
    checks.kind("planes", plane, RigidPlane, "a RigidPlane")
    return with_constants(domain, plane, "point", "stiffness")
