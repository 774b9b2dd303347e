"""``CouDALFISh``: one time step of a flow coupled with an immersed thin structure.

The dynamic augmented Lagrangian method (Kamensky et al., doi:10.1016/j.cma.2014.10.040) with block iteration between
fluid and shell (Kamensky, doi:10.1016/j.camwa.2020.01.023).
"""

import logging
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from mpi4py import MPI

from coudalfish import exchange
from coudalfish.monitors import Monitors, measure
from coudalfish.options import CouplingOptions, PenaltyRule
from coudalfish.subproblems import FluidSubproblem, ShellSubproblem
from coudalfish.trace import Location, PointLocator, trace_matrix
from tigar_x import checks
from tigar_x.compat import FloatArray
from tigar_x.solve import SolveError

log = logging.getLogger(__name__)

SLIP_LIMIT = 0.3
"""Largest slip per load change relative to the fluid's cells, lam dt/(beta h), before a warning."""
SPACING_LIMIT = 0.75
"""Largest distance of immersed points relative to the fluid's cells before a warning."""
COURANT_LIMIT = 0.5
"""Largest displacement per step relative to the fluid's cells that explicit geometry bears well."""
GROWTH_LIMIT = 1e3
"""Growth of a residual within a step at which the step is given up."""
STALL = 0.5
"""A tangent that is kept during a step is assembled anew when a pass reduces a residual by less than this."""


@dataclass(frozen=True)
class StepReport:
    """What a step did.

    Attributes:
        t: time at its end.
        passes: block passes, each one solve of the fluid and one of the shell.
        residuals: norms (fluid, shell) of every test; unit: force.
        linear_iterations: iterations of the fluid's linear solver in all passes.
        penalty: beta.
        inactive_points: immersed points outside the fluid mesh.
        slip_ratio: ``max|lam| dt/(beta h)``.
        monitors: slip, leak and balance; None when the step failed.
    """

    t: float
    passes: int
    residuals: tuple[tuple[float, float], ...]
    linear_iterations: int
    penalty: float
    inactive_points: int
    slip_ratio: float
    monitors: Monitors | None


class StepError(RuntimeError):
    """A step that could not be accepted; the state is that of the last good step.

    Attributes:
        block: "fluid", "shell" or "coupling".
        suspect: the number that most likely is to blame, in words.
        report: what was done until then.
    """

    def __init__(self, block: str, reason: str, suspect: str, report: StepReport) -> None:
        super().__init__(f"step to t = {report.t:g} failed in the {block} block: {reason}; suspect: {suspect}")
        self.block = block
        self.suspect = suspect
        self.report = report


class _RejectedStepError(Exception):
    """Ends an attempted step."""

    def __init__(self, block: str, reason: str) -> None:
        super().__init__(reason)
        self.block = block


class CouDALFISh:
    """Couples a fluid subproblem with a shell subproblem.

    Args:
        fluid: the flow.
        shell: the immersed structure.
        options: how they are coupled.
        multiplier: initial multiplier, a number or shape (points,); unit: force/area.

    Attributes:
        mesh_f: fluid mesh.
        spline_sh: the shell's spline.
        timeInt_f: the flow's integrator.
        timeInt_sh: the shell's integrator.
        contactContext_sh: None: no contact.
        lam: multiplier at the immersed points, force of the fluid on the shell along its normal, shape (points,).

    Raises:
        ValueError: the subproblems do not fit each other or the options.
    """

    contactContext_sh = None

    def __init__(
        self,
        fluid: FluidSubproblem,
        shell: ShellSubproblem,
        options: CouplingOptions | None = None,
        *,
        multiplier: float | FloatArray = 0.0,
    ) -> None:
        self.fluid = fluid
        self.shell = shell
        self.options = CouplingOptions() if options is None else options
        self.mesh_f = fluid.mesh
        self.spline_sh = shell.spline
        self.timeInt_f = fluid.timeInt
        self.timeInt_sh = shell.timeInt
        self._check()
        points = shell.quadrature.points
        self.lam = np.broadcast_to(np.asarray(multiplier, dtype=np.float64), (len(points),)).copy()
        checks.array("multiplier", self.lam, (len(points),))
        self._locator = PointLocator(fluid.mesh)
        self._warned: set[str] = set()

    def _check(self) -> None:
        d, nsd = self.fluid.mesh.geometry.dim, self.shell.spline.nsd
        if d != nsd:
            raise ValueError(f"the shell lives in {nsd} dimensions, the fluid in {d}: they must be equal")
        times = self.timeInt_f.time, self.timeInt_sh.time, self.timeInt_f.step_size, self.timeInt_sh.step_size
        if not (math.isclose(times[0], times[1], abs_tol=1e-12 * times[2]) and math.isclose(times[2], times[3])):
            raise ValueError(f"clocks (t, dt): fluid {times[0::2]}, shell {times[1::2]}: they must be equal")
        if not math.isclose(self.timeInt_f.scheme.alpha_f, self.timeInt_sh.scheme.alpha_f):
            raise ValueError(
                f"alpha_f: fluid {self.timeInt_f.scheme.alpha_f}, shell {self.timeInt_sh.scheme.alpha_f}: both sides "
                "must share the intermediate level (use first_order_alpha_m=True and the same rho_infinity)"
            )
        if isinstance(self.options.penalty, PenaltyRule) and None in (self.fluid.density, self.fluid.viscosity):
            raise ValueError("a penalty rule needs the fluid's density and viscosity; give them or a number as penalty")

    @property
    def penalty(self) -> float:
        """The penalty beta of the step in progress; unit: force time/length^3."""
        rule = self.options.penalty
        if not isinstance(rule, PenaltyRule):
            return float(rule)
        mu, rho = self.fluid.viscosity or 0.0, self.fluid.density or 0.0
        beta = rule(mu=mu, rho=rho, h=self.fluid.mesh_size, dt=self.timeInt_f.step_size)
        return checks.positive("penalty by rule", beta)

    # -- one step -----------------------------------------------------------------------------------------------------

    def takeStep(self) -> StepReport:
        """Advance fluid and shell by one time step.

        Returns:
            The report.

        Raises:
            StepError: the step was not accepted; fields, multiplier and clocks are those of the last good step.
        """
        restore = self._save()
        step = _Step(self)
        try:
            report = step.run()
        except (_RejectedStepError, SolveError) as error:
            block = error.block if isinstance(error, _RejectedStepError) else step.block
            suspect, report = step.suspect(), step.report(None)
            restore()
            raise StepError(block, str(error), suspect, report) from error
        except BaseException:
            restore()
            raise
        self.timeInt_f.advance()
        self.timeInt_sh.advance()
        return report

    def _save(self) -> Callable[[], None]:
        """Remember what a step changes before it is accepted; the integrators' old states are not among it."""
        fields = [self.timeInt_f.x.x.array, self.timeInt_sh.x.x.array]
        saved = [array.copy() for array in fields]
        lam = self.lam

        def restore() -> None:
            for array, value in zip(fields, saved, strict=True):
                array[:] = value
            self.lam = lam

        return restore

    def warn_once(self, key: str, message: str, *numbers: Any) -> None:
        """Log a warning on rank 0 the first time it applies."""
        if key not in self._warned:
            self._warned.add(key)
            if self.fluid.comm.rank == 0:
                log.warning(message, *numbers)


class _Step:
    """One attempt at a step: the data that stay fixed during its block iteration, and the iteration."""

    def __init__(self, coupler: CouDALFISh) -> None:
        self.c = coupler
        self.fluid, self.shell, self.options = coupler.fluid, coupler.shell, coupler.options
        self.beta = coupler.penalty
        self.dt = coupler.timeInt_f.step_size
        self.block = "coupling"
        self.residuals: list[tuple[float, float]] = []
        self.passes = 0
        self.linear_iterations = 0
        self.spacing = 0.0
        self.inactive = 0
        self.floors: tuple[float, float] | None = None

    # -- set-up -------------------------------------------------------------------------------------------------------

    def run(self) -> StepReport:
        """Predict, iterate, update the multiplier."""
        self._predict()
        self._place()
        self._iterate()
        return self._finish()

    def _predict(self) -> None:
        for side in (self.fluid, self.shell):
            side.timeInt.predict()
            for update in side.updates:
                update(float(side.timeInt.t_alpha.value))
        self.fluid.system.apply_boundary_values()

    def _place(self) -> None:
        """Explicit geometry: points at the predictor, their cells, B, the band and the normals."""
        x = self.shell.positions()
        if not np.isfinite(x).all():
            raise _RejectedStepError("shell", "the predicted positions are not finite")
        location: Location = self.c._locator.locate(x)
        self.active = location.active
        self.inactive = int((~location.active).sum())
        self.W = np.where(location.active, self.shell.quadrature.weights, 0.0)
        self.trace = trace_matrix(self.fluid.velocity_space, location)
        if self.fluid.band is not None:
            self.fluid.band.update(location, scale_m=self.options.scale_m, scale_c=self.options.scale_c)
        self.n = self.shell.normals()
        self.spacing = self.shell.spacing(x)
        if self.spacing > SPACING_LIMIT * self.fluid.mesh_size:
            self.c.warn_once(
                "spacing",
                "immersed points are up to %.3g apart, %.2f times the fluid's cell size: the surface may leak "
                "(at most %g times is advised)",
                self.spacing,
                self.spacing / self.fluid.mesh_size,
                SPACING_LIMIT,
            )

    # -- block iteration ----------------------------------------------------------------------------------------------

    def _iterate(self) -> None:
        before = self.options.stopping == "before_solve"
        for k in range(self.options.max_passes + 1):
            self.u, self.y_dot = self.fluid.velocity_at(self.trace), self.shell.velocity()
            if self.options.normal == "iterate":
                self.n = self.shell.normals()
            norm_f = self._fluid_residual()
            if before and self._accepted(norm_f, self._shell_residual()):
                return
            if k == self.options.max_passes:
                break
            self._solve_fluid()
            self.u = self.fluid.velocity_at(self.trace)
            norm_s = self._shell_residual()
            self._solve_shell()
            self.passes = k + 1
            if not before and self._accepted(norm_f, norm_s):
                self.u, self.y_dot = self.fluid.velocity_at(self.trace), self.shell.velocity()
                if self.options.normal == "iterate":
                    self.n = self.shell.normals()
                return
        slower = int(np.argmax([self._ratio(i) for i in (0, 1)]))
        raise _RejectedStepError(
            ("fluid", "shell")[slower],
            f"no convergence in {self.options.max_passes} passes (residuals relative to the first: "
            f"fluid {self._ratio(0):.3g}, shell {self._ratio(1):.3g}, required {self.options.block_rtol:g})",
        )

    @property
    def forces(self) -> FloatArray:
        """Fluid on shell at the points."""
        return exchange.point_forces(self.u, self.y_dot, self.c.lam, self.n, self.W, penalty=self.beta)

    def _fluid_residual(self) -> float:
        self.block = "fluid"
        return self.fluid.assemble_residual(self.trace, self.forces, self.beta)

    def _shell_residual(self) -> float:
        self.block = "shell"
        return self.shell.assemble_residual(self.forces)

    def _assemble_tangents(self) -> bool:
        return self.passes == 0 or self.options.tangent_update == "pass" or self._stalled()

    def _stalled(self) -> bool:
        if len(self.residuals) < 2:
            return False
        return any(new > STALL * old for new, old in zip(self.residuals[-1], self.residuals[-2], strict=True))

    def _solve_fluid(self) -> None:
        self.block = "fluid"
        if self._assemble_tangents():
            consistent = self.options.fluid_tangent == "consistent"
            tangent = exchange.consistent_tangent if consistent else exchange.lumped_tangent
            part = tangent(self.trace.B, self.W, penalty=self.beta, factor=self.fluid.timeInt.x_factor)
            self.fluid.assemble_tangent(self.trace, part)
        self.linear_iterations += self.fluid.solve(first=self.passes == 0)

    def _solve_shell(self) -> None:
        self.block = "shell"
        if self._assemble_tangents():
            self.shell.assemble_tangent(self.W, self.beta)
        self.shell.solve()

    def _ratio(self, i: int) -> float:
        first, last = self.residuals[0][i], self.residuals[-1][i]
        return last / first if first else 0.0

    def _accepted(self, norm_f: float, norm_s: float) -> bool:
        """Test both residuals; anything that is not finite or grows without bound rejects the step."""
        self.block = "coupling"
        for block, norm in (("fluid", norm_f), ("shell", norm_s)):
            if not math.isfinite(norm):
                raise _RejectedStepError(block, f"the residual of pass {self.passes} is not finite")
        self.residuals.append((norm_f, norm_s))
        limits = self._limits() if self.options.stopping == "before_solve" else self.residuals[0]
        rtol = self.options.block_rtol
        small = [
            norm <= max(rtol * limit, floor)
            for norm, limit, floor in zip((norm_f, norm_s), limits, self._floors(), strict=True)
        ]
        for block, i in (("fluid", 0), ("shell", 1)):
            if not small[i] and self._ratio(i) > GROWTH_LIMIT:
                raise _RejectedStepError(block, f"the residual grew {self._ratio(i):.3g} times in {self.passes} passes")
        return all(small)

    def _limits(self) -> tuple[float, float]:
        """What the relative tolerance refers to: first residual or present coupling forces, whichever is smaller.

        The first residual alone would be dominated by data that change in time, such as walls with a strong penalty.
        """
        forces = self.forces
        coupling = self.fluid.coupling_norm(self.trace, forces), self.shell.coupling_norm(forces)
        return tuple(  # type: ignore[return-value]
            min(first, force) if force else first for first, force in zip(self.residuals[0], coupling, strict=True)
        )

    def _floors(self) -> tuple[float, float]:
        """Absolute tolerances: a fraction of the forces at work, so that a change of units changes nothing."""
        if self.options.block_atol == 0.0:
            return 0.0, 0.0
        if self.floors is None or self.passes == 1:
            part = np.abs(self.c.lam)[:, None] * np.abs(self.n) + self.beta * (np.abs(self.u) + np.abs(self.y_dot))
            magnitude = self.W[:, None] * part
            scale_f = self.fluid.momentum_scale() + self.fluid.coupling_norm(self.trace, magnitude)
            scale_s = self.shell.momentum_scale() + self.shell.coupling_norm(magnitude)
            atol = self.options.block_atol
            error = self.shell.rounding()
            error_f = self.W[:, None] * self.beta * self.shell.timeInt.xdot_factor * error
            self.floors = (
                atol * scale_f + self.fluid.coupling_norm(self.trace, error_f),
                atol * scale_s + self.shell.force_of(error),
            )
        return self.floors

    # -- end ----------------------------------------------------------------------------------------------------------

    def _finish(self) -> StepReport:
        slip = self.u - self.y_dot
        forces = self.forces
        lam = exchange.updated_multiplier(
            self.c.lam, self.u, self.y_dot, self.n, self.active, penalty=self.beta, relaxation=self.options.relaxation
        )
        if not np.isfinite(lam).all():
            raise _RejectedStepError("coupling", "the new multiplier is not finite")
        on_fluid = np.asarray(self.fluid.comm.allreduce(-(self.trace.B.T @ forces).sum(axis=0), op=MPI.SUM))
        monitors = measure(slip, self.n, self.W, forces, on_fluid, forces.sum(axis=0))
        self.c.lam = lam
        report = self.report(monitors)
        if report.slip_ratio > SLIP_LIMIT:
            self.c.warn_once(
                "slip",
                "slip ratio lam dt/(beta h) = %.3g exceeds %g: a load change moves the fluid through the shell by that "
                "part of a cell; raise the penalty (beta = %.3g) or reduce dt",
                report.slip_ratio,
                SLIP_LIMIT,
                self.beta,
            )
        return report

    def report(self, monitors: Monitors | None) -> StepReport:
        """What has been done so far."""
        return StepReport(
            t=self.c.timeInt_f.time + self.dt,
            passes=self.passes,
            residuals=tuple(self.residuals),
            linear_iterations=self.linear_iterations,
            penalty=self.beta,
            inactive_points=self.inactive,
            slip_ratio=float(np.abs(self.c.lam).max(initial=0.0)) * self.dt / (self.beta * self.fluid.mesh_size),
            monitors=monitors,
        )

    def suspect(self) -> str:
        """The number that exceeds its advised limit most, or a statement that none does."""
        h = self.fluid.mesh_size
        speed = self.fluid.speed()
        points = len(self.c.lam)
        numbers = {
            "slip ratio lam dt/(beta h) (raise the penalty beta)": (self.report(None).slip_ratio, SLIP_LIMIT),
            "Courant number |u| dt/h (reduce dt)": (speed * self.dt / h, COURANT_LIMIT),
            "point spacing/h (refine the shell)": (self.spacing / h, SPACING_LIMIT),
            "fraction of points outside the fluid mesh": (self.inactive / points, 0.5),
        }
        broken = [name for name, (value, _) in numbers.items() if not math.isfinite(value)]
        if broken:
            return f"{broken[0]} is not finite"
        name, (value, limit) = max(numbers.items(), key=lambda item: item[1][0] / item[1][1])
        if value > limit:
            return f"{name} = {value:.3g}, advised at most {limit:g}"
        return (
            f"penalty beta = {self.beta:.3g}; all other numbers are within limits, {name} = {value:.3g} comes nearest"
        )
