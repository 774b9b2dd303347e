"""``CouDALFISh``: a flow coupled with an immersed thin structure, advanced step by step.

The dynamic augmented Lagrangian method (Kamensky et al., doi:10.1016/j.cma.2014.10.040) with block iteration between
fluid and shell (Kamensky, doi:10.1016/j.camwa.2020.01.023).
"""

import logging
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from coudalfish.sides.fluid import FluidSubproblem
from coudalfish.sides.mesh_motion import check_levels
from coudalfish.sides.objects import ImmersedFlow, ImmersedShell, both_sides, fluid_side, undone
from coudalfish.sides.shell import ShellSubproblem
from coudalfish.step.attempt import Outcome, Start, Step
from coudalfish.step.attempts import attempts, usual
from coudalfish.step.levels import check_schemes
from coudalfish.step.method import Attempt
from coudalfish.step.options import CouplingOptions, PenaltyRule
from coudalfish.step.report import RejectedStepError, StepError, StepReport
from coudalfish.step.watch import Watch
from coudalfish.surface.exchange import tractions
from coudalfish.surface.meeting import meets
from coudalfish.surface.trace import PointLocator
from tigar_x import checks, ranks
from tigar_x.compat import FloatArray
from tigar_x.fem.linear import SolveError
from tigar_x.fem.time_integration import TimeIntegrator
from tigar_x.moved import guide

if TYPE_CHECKING:
    from tigar_x.run.running import Run

__getattr__ = guide(__name__)
log = logging.getLogger(__name__)


class CouDALFISh(checks.Made):
    """Couples a flow with an immersed shell.

    Args:
        fluid: the flow, such as varmint's ``Flow(..., immersed=True)``; or a :class:`FluidSubproblem`, of a residual
            by hand.
        shell: the immersed structure, such as shnapr's ``Shell``, which gets the flow's time step and the companion of
            its scheme; or a :class:`ShellSubproblem`.
        options: how they are coupled; None: as suits the flow's fields at the shell, ``CouplingOptions()`` where they
            are plain, ``CouplingOptions.converged(fluid_tangent="consistent")`` where the pressure jumps (in the plane
            with the exact trace as well), ``CouplingOptions.sharp()`` where velocities may also be kinked.
        multiplier: initial multiplier along the normals, a number or shape (points,), or where it is a vector also
            shape (points, d); unit: force/area.

    Attributes:
        fluid: side of the fluid.
        shell: side of the shell.
        mesh_f: fluid mesh.
        spline_sh: the shell's spline.
        timeInt_f: the flow's integrator.
        timeInt_sh: the shell's integrator.
        contactContext_sh: the shell's contact; None: no contact.
        locator: finds the immersed points in the fluid mesh.
        floors: residuals (fluid, shell) below which the last step had nothing left to solve for; unit: force.
        watch: what is out of its limits.
        lam: multiplier at the immersed points, force of the fluid on the shell along its normal, shape (points,), or
            as a vector, shape (points, d), by the options.

    Raises:
        ValueError: the subproblems do not fit each other or the options.
    """

    _PARTS = ("fluid", "shell", "mesh_f", "spline_sh", "timeInt_f", "timeInt_sh", "contactContext_sh")
    _ELSEWHERE: ClassVar[Mapping[str, str]] = {"dt": "step_size", "multiplier": "lam"}

    def __init__(
        self,
        fluid: FluidSubproblem | ImmersedFlow,
        shell: ShellSubproblem | ImmersedShell,
        options: CouplingOptions | None = None,
        *,
        multiplier: float | FloatArray = 0.0,
    ) -> None:
        if options is not None:
            checks.kind("options", options, CouplingOptions, "CouplingOptions")
        with undone(shell):
            self._couple(fluid, shell, options, multiplier)

    def _couple(
        self,
        fluid: FluidSubproblem | ImmersedFlow,
        shell: ShellSubproblem | ImmersedShell,
        options: CouplingOptions | None,
        multiplier: float | FloatArray,
    ) -> None:
        self.fluid, self.shell = both_sides(fluid, shell)
        self.options = usual(self.fluid) if options is None else options
        self.spline_sh = self.shell.spline
        self.timeInt_sh = self.shell.timeInt
        self.contactContext_sh = self.shell.contact
        self._take(self.fluid)
        self.watch = Watch(self.fluid, self.shell)
        self.lam = self._initial(multiplier)
        self.floors: tuple[float, float] | None = None
        self._pair()
        self.shell.share(self.fluid.comm)
        self._is_made = True

    def _take(self, fluid: FluidSubproblem) -> None:
        """Take over a side of the fluid, and what is made for it (collective)."""
        self.fluid, self.mesh_f, self.timeInt_f = fluid, fluid.mesh, fluid.timeInt
        self._check()
        self.locator = PointLocator(self.mesh_f)
        of_points = self.shell.sheets, self.shell.quadrature.weights
        on_polygons = fluid.sides is not None and self.mesh_f.geometry.dim == 3
        kind = "nodes" if on_polygons else self.options.trace  # polygons then have the exact trace
        self._meets = meets(kind, fluid.velocity_space, *of_points)
        self._attempts = self.options, attempts(self.options, fluid, self.shell)

    def _pair(self) -> None:
        """Tell the integrators that others advance with them."""
        self.timeInt_sh.partner = self.timeInt_f
        for integrator in self.integrators:
            if integrator is not self.timeInt_sh:
                integrator.partner = self.timeInt_sh

    def move_to(self, fluid: FluidSubproblem | ImmersedFlow) -> None:
        """Go on with another flow, such as the same one on another mesh, from the present state (collective).

        It gets the state of the present one, see :func:`coudalfish.sides.transfer.transfer`, and its clock; shell,
        multiplier and warnings stay. Between two steps; what fails leaves everything as it was.

        Args:
            fluid: see the class; of the same scheme, on a fixed mesh of the same region, and coupled with nothing.

        Raises:
            ValueError: it does not fit.
        """
        from coudalfish.sides.transfer import transfer  # runs on one mesh need nothing of it

        side, old = fluid_side(fluid), self.fluid
        if side.timeInt.partner is not None or side.moving is not None or old.moving is not None:
            raise ValueError(f"fluid = {fluid!r}: a flow on a fixed mesh that is coupled with nothing is required")
        if (type(side), side.timeInt.scheme) != (type(old), old.timeInt.scheme):
            raise ValueError(f"fluid = {fluid!r}: a flow with the fields and the scheme of {old!r} is required")
        transfer(old, side)
        self._is_made = False
        try:
            self._take(side)
        except BaseException:
            self._take(old)
            raise
        finally:
            self._is_made = True
        self.watch.move_to(side)
        self.shell.share(side.comm)  # that of the present one goes with its mesh
        self._pair()

    def __repr__(self) -> str:
        time = self.timeInt_f
        return f"CouDALFISh({self.fluid!r}, {self.shell!r}, t = {time.time:g}, dt = {time.step_size:g})"

    def _initial(self, multiplier: float | FloatArray) -> FloatArray:
        points, d = self.shell.quadrature.points.shape
        one, vector = np.ndim(multiplier) == 0, self.options.multiplier_direction == "vector"
        given = np.full(points, checks.finite("multiplier", multiplier)) if one else multiplier
        if vector and np.ndim(given) == 1:
            given = tractions(checks.array("multiplier", given, (points,)), self.shell.normals())
        return checks.array("multiplier", given, (points, d) if vector else (points,)).copy()

    def _check(self) -> None:
        self._check_clocks()
        check_schemes(self.timeInt_f, self.timeInt_sh)
        if self.fluid.moving is not None:
            check_levels(self.fluid.moving, self.timeInt_f)
        if isinstance(self.options.penalty, PenaltyRule) and None in (self.fluid.density, self.fluid.viscosity):
            raise ValueError("a penalty rule needs the fluid's density and viscosity; give them or a number as penalty")

    def _check_clocks(self) -> None:
        first, *others = self.integrators
        for name, other in zip(("shell", "mesh"), others, strict=False):
            same_t = math.isclose(first.time, other.time, abs_tol=1e-12 * first.step_size)
            if not (same_t and math.isclose(first.step_size, other.step_size)):
                clocks = f"fluid {first.time, first.step_size}, {name} {other.time, other.step_size}"
                raise ValueError(
                    f"clocks (t, dt): {clocks}: they must be equal; the step_size of what couples them sets all"
                )

    @property
    def integrators(self) -> tuple[TimeIntegrator, ...]:
        """All that advance together: fluid, shell, and the fluid's mesh where it moves."""
        moving = self.fluid.moving
        both = self.timeInt_f, self.timeInt_sh
        return both if moving is None else (*both, moving.time)

    @property
    def step_size(self) -> float:
        """Step size of all integrators; assign to change it. Unit: time."""
        return self.timeInt_f.step_size

    @step_size.setter
    def step_size(self, value: float) -> None:
        for integrator in self.integrators:
            integrator.step_size = value

    @property
    def penalty(self) -> float:
        """The penalty beta of the step in progress; unit: force time/length^3."""
        return self._penalty(self.options)

    def _penalty(self, options: CouplingOptions) -> float:
        rule = options.penalty
        if not isinstance(rule, PenaltyRule):
            return float(rule)
        mu, rho = self.fluid.viscosity or 0.0, self.fluid.density or 0.0
        beta = rule(mu=mu, rho=rho, h=self.fluid.mesh_size, dt=self.timeInt_f.step_size)
        return checks.positive("penalty by rule", beta)

    # -- one step -----------------------------------------------------------------------------------------------------

    def takeStep(self, measure: Callable[[], Any] | None = None) -> StepReport:
        """Advance fluid and shell by one time step.

        Args:
            measure: called with the new state before the clocks move; what it returns is in the report.

        Returns:
            The report.

        Raises:
            StepError: the step was not accepted; fields, multiplier and clocks are those of the last good step.
            ValueError: a side has another clock.
        """
        self._check_clocks()
        self._share()
        restore = self._save()
        try:
            outcome = self._attempt(restore)
            self.lam, self.floors, report = outcome.lam, outcome.floors, outcome.report
            if measure is not None:
                report = replace(report, measured=measure())
        except BaseException:
            restore()
            raise
        for integrator in self.integrators:
            integrator.advance()
        return report

    take_step = takeStep

    def run(self, **options: Any) -> "Run":
        """A run of many steps, as an iterator of their reports, see :class:`tigar_x.run.running.Run`.

        Args:
            options: of the run, and ``halvings``: how often a step that fails may be halved.
        """
        from coudalfish.run import run  # single steps need nothing of it

        return run(self, **options)

    def _share(self) -> None:
        """Begin from one state on all ranks: their copies of the shell differ by rounding."""
        shell = (function.x.array for function in self.timeInt_sh.state.values())
        ranks.share(self.fluid.comm, *shell, self.lam)

    @property
    def attempts(self) -> Sequence[Attempt]:
        """The ways to take a step by the present options, each for where those before fail."""
        if self._attempts[0] is not self.options:
            self._attempts = self.options, attempts(self.options, self.fluid, self.shell)
        return self._attempts[1]

    def step(self, attempt: Attempt | None = None, *, cautious: bool = False) -> Step:
        """An attempt at the next step, which has not begun.

        Args:
            attempt: which; None: the first one.
            cautious: see :class:`coudalfish.step.attempt.Step`.
        """
        chosen = self.attempts[0] if attempt is None else attempt
        start = Start(self.lam, self.floors, self._penalty(chosen.options))
        parts = self.fluid, self.shell, chosen, start
        return Step(*parts, self._meets, self.locator, self.watch, cautious=cautious)

    def _attempt(self, restore: Callable[[], None]) -> Outcome:
        """Run the step, and once more if the multiplier that it leaves would have the surface placed otherwise."""
        outcome = self._first_that_works(restore)
        if outcome.suits:
            return outcome
        restore()
        self.lam, first = outcome.lam, outcome.report
        second = self._first_that_works(restore)
        both = {name: getattr(first, name) + getattr(second.report, name) for name in ("passes", "linear_iterations")}
        return replace(second, report=replace(second.report, **both))

    def _first_that_works(self, restore: Callable[[], None]) -> Outcome:
        """Run the step in the way that the options ask for, and where that fails in the next one."""
        ways = self.attempts
        for k, attempt in enumerate(ways):
            try:
                outcome = self._run(attempt, restore)
            except StepError as error:
                if k == len(ways) - 1:
                    raise
                text = "%s; from here on such steps %s (attempt %d)"
                self.watch.warn_once(ways[k + 1].what, text, error, ways[k + 1].what, k + 2)
                restore()
            else:
                break
        return replace(outcome, report=replace(outcome.report, attempts=outcome.report.attempts + k))

    def _run(self, attempt: Attempt, restore: Callable[[], None]) -> Outcome:
        """Run the step, and once more with caution when it does not converge; the first failure gives the diagnosis."""
        first = self.step(attempt)
        try:
            return first.run()
        except (RejectedStepError, SolveError) as error:
            failure = first.failure(error)
            if not (attempt.options.second_attempt and first.passes):
                raise failure from error
        restore()
        log.log(logging.WARNING if self.fluid.comm.rank == 0 else logging.DEBUG, "%s; attempting it again", failure)
        try:
            return self.step(attempt, cautious=True).run()
        except (RejectedStepError, SolveError) as error:
            raise failure from error

    def _save(self) -> Callable[[], None]:
        """Remember what a step changes before it is accepted; the integrators' old states are not among it."""
        fields = [function.x.array for integrator in self.integrators for function in integrator.unknowns]
        saved, bring_back = [array.copy() for array in fields], self.fluid.remember()
        lam, floors, cells = self.lam, self.floors, self.locator.cells

        def restore() -> None:
            for array, value in zip(fields, saved, strict=True):
                array[:] = value
            bring_back()
            self.lam, self.floors, self.locator.cells = lam, floors, cells
            for integrator in self.integrators:
                integrator.in_step = False

        return restore
