"""A shell as one object: geometry, material, supports and loads become residual, tangent, system, solves and steps.

What the scene does not have is not in its forms, and no module is imported for it. Forms are compiled at the first
solve. Instead of being solved here, residual, tangent and integrator can be given to a coupler, which brings the clock:
see :meth:`Shell.bind`.
"""

import logging
from collections.abc import Callable
from functools import cached_property
from typing import TYPE_CHECKING, Any

from shnapr.shell.dynamics import shell_step
from shnapr.shell.equations import Displacements
from shnapr.shell.options import ShellError, ShellReport
from shnapr.shell.quantities import Energies, EnergyForms, resultant
from shnapr.shell.scene import Scene
from tigar_x import compat
from tigar_x.compat import FloatArray
from tigar_x.fem.linear import SolveError
from tigar_x.fem.time_integration import TimeIntegrator

log = logging.getLogger(__name__)

if TYPE_CHECKING:
    from shnapr.shell.statics import Statics
    from tigar_x.fem.eigen import Eigenpairs
    from tigar_x.fem.load_stepping import LoadReport, StepControl
    from tigar_x.run.running import Run

__all__ = ["Shell"]


class Shell(Scene):
    """A thin shell, or several in one geometry: a surface in space, or a curve in the plane per unit depth.

    Without a time step it is static, until a coupler brings one. Numbers of material and loads become Constants, under
    the same names in the attributes: to change one compiles nothing.

    Args:
        geometry: patches, or a spline that has its supports.
        material: see :class:`shnapr.work.Material`.
        density: rho_s >= 0, a number or Constant; None: none, for statics. Unit: mass/volume.
        clamped: names of edges whose position and tangent plane are held, see :func:`shnapr.supports.clamped`.
        pinned: names of edges whose position is held.
        zero_dofs: further coefficients (function * nsd + component) that do not move, such as those of
            :func:`shnapr.supports.pinned` in some directions or of :func:`shnapr.supports.fixed`.
        constraints: linear constraints, see :mod:`tigar_x.splines.constraints`.
        loads: what acts on it, see :mod:`shnapr.conditions`; rigid planes (:mod:`shnapr.planes`) as well.
        contact: of the shell with itself, such as a :class:`shnapr.ContactRecipe`; None: none.
        dt: time step; None: statics, or that of a coupler. Unit: time.
        scheme: second-order scheme; None: generalized-alpha with rho_infinity = 1/2.
        updates: called with the time of the equations at the start of every step, in statics with the load factor of
            every attempt, for data that are not UFL.
        formulation: "mixed" takes membrane forces as unknowns too, for statics of thin shells, see :mod:`shnapr.mixed`.
        quadrature_degree: of every integral; None: twice the largest degree.
        solver: linear solver recipe, or a KSP; None: direct. PETSc options go first, under ``shell_``.
        options: of Newton's method.
        comm: where the spline lives: on ``MPI.COMM_SELF`` every rank has a copy of the whole.
        copies: ranks with a copy of this shell, which take the same steps; of a distributed shell there is one.

    Attributes:
        spline: the midsurface.
        material: with Constants for numbers.
        density: Constant; None: none.
        loads: with Constants for numbers.
        y: homogeneous displacement at the end of the step.
        time: integrator of y; None: statics.
        contact: nonlocal contact; None: none.
        solver: linear solver recipe.
        updates: as given.
        options: of Newton's method.

    Raises:
        ValueError: a number, shape or name is not allowed, or something that one argument needs is not given.
    """

    # -- solving ------------------------------------------------------------------------------------------------------

    def solve(
        self,
        until: float = 1.0,
        *,
        step: float | None = None,
        control: "StepControl | None" = None,
        extrapolate: bool = False,
        each: Callable[[float], None] | None = None,
    ) -> "LoadReport":
        """Equilibrium at a load factor, by load steps from the present state.

        Steps are cut where Newton's method fails. Loads that are not above the present one take one step.

        Args:
            until: load factor.
            step: first step of the load factor; None: the whole way, or from a loaded state what would have come next.
            control: when steps are cut and grown; None: down to a thousandth of the first one, and never beyond it.
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
            return statics.solve(until, step=step, control=control, extrapolate=extrapolate, each=each)
        except SolveError as error:
            raise ShellError(f"no equilibrium at a load factor of {until:g}: {error}", statics.reached) from error

    def solve_linear(self) -> None:
        """Displacement of the linear theory at the full load: one increment from the undeformed shell.

        Raises:
            ValueError: the shell has a clock.
            SolveError: the linear solver failed; the state is that before.
        """
        self._statics("solve_linear").solve_linear()

    def _statics(self, name: str) -> "Statics":
        from shnapr.shell.statics import Statics

        clock = self._equations.clock
        if isinstance(clock, TimeIntegrator):
            raise ValueError(f"dt = {clock.step_size!r}: {name}() is for shells without a clock; take_step()")
        after = None if isinstance(self._equations, Displacements) else self._equations.tell
        return Statics(self.system, clock, self.options, self.updates, self.copies, after)

    def take_step(self, measure: Callable[[], Any] | None = None) -> ShellReport:
        """Advance by one time step.

        Args:
            measure: called with the new state before the clock moves; what it returns is in the report.

        Returns:
            The report.

        Raises:
            ValueError: the shell has no clock, or is coupled.
            ShellError: the step failed; the state is that before it.
        """
        time = self._own_clock()
        return shell_step(self.system, time, self.options, self.updates, self.copies, measure)

    def _own_clock(self) -> TimeIntegrator:
        """The integrator, if the shell may step."""
        if self.time is None:
            raise ValueError("dt = None: a shell without a clock takes no steps; solve() finds its equilibrium")
        if self.time.partner is not None:
            raise ValueError("the shell is coupled with a flow: take the steps of what couples them")
        return self.time

    def run(self, *, halvings: int = 6, **options: Any) -> "Run":
        """A run of many steps, as an iterator of their reports.

        Args:
            halvings: how often a step that fails may be halved.
            options: see :class:`tigar_x.run.running.Run`.

        Raises:
            ValueError: the shell has no clock or is coupled, or an option is not allowed.
        """
        from tigar_x.run.running import Run  # single steps need nothing of it
        from tigar_x.run.stepping import IntegratorStepper

        time = self._own_clock()
        sizes = {"dofs_shell": self.spline.geometry.n * self.spline.nsd}
        return Run(IntegratorStepper(self.take_step, ShellError, halvings=halvings, sizes=sizes, shell=time), **options)

    # -- what follows from a state ------------------------------------------------------------------------------------

    @cached_property
    def _energies(self) -> EnergyForms:
        return EnergyForms(self.spline, self._in_displacements("energies()").energies(), self.contact)

    def energies(self) -> Energies:
        """Energies of the present state (collective)."""
        return self._energies(self.positions)

    def support_force(self) -> FloatArray:
        """Resultant of the forces of supports and constraints on the shell (collective), shape (nsd,).

        It is what all other forces leave; those of contact with itself cancel. They belong to the equations: in time
        ask in the ``measure`` of a step.

        Raises:
            ValueError: no step is in progress, or membrane forces are unknowns.
        """
        self._in_displacements("support_force()")
        if self.time is not None and not self.time.in_step:
            raise ValueError("support_force() between steps: ask for it in take_step(measure=...), in the equations")
        return resultant(self.spline, self.residual)

    def piercings(self) -> int:
        """Number of places where the shell, a surface with contact, goes through itself at present; more than 0 warns.

        Raises:
            ValueError: it has no contact, whose r_self tells what is far along the surface.
        """
        from shnapr.contact.piercings import piercings

        if self.contact is None:
            raise ValueError("contact = None: a shell with contact is required")
        quads, X = compat.subcells(self.spline.V)[1], self.spline.node_positions
        number = piercings(self.positions, quads, X, self.contact.r_self)
        if number and self.copies.rank == 0:
            log.warning("the shell goes through itself in %d places: reduce dt or refine it", number)
        return number

    def modes(self, count: int, *, shift: float = 0.0, backend: str | None = None) -> "Eigenpairs":
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
        from tigar_x.fem.eigen import eigenmodes

        forms = self._in_displacements("modes()").vibration()
        if self.contact is not None and self.contact.evaluate(self.positions, tangent=False).pairs:
            raise ValueError("modes() of a shell that touches itself: contact has no part in them")
        return eigenmodes(self.spline, *forms, count, shift=shift, backend=backend)
