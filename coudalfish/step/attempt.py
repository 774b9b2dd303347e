"""One attempt at a time step: explicit geometry, block iteration, multiplier.

The steps of Kamensky, doi:10.1016/j.camwa.2020.01.023, with convergence tested before a pass solves.
"""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
import scipy.sparse as sp

from coudalfish.sides.fluid import FluidSubproblem
from coudalfish.sides.mesh_motion import MovingMesh, displacement_of_cells
from coudalfish.sides.shell import ShellSubproblem
from coudalfish.step.acceleration import Anderson
from coudalfish.step.acceptance import Acceptance
from coudalfish.step.floors import residual_floors
from coudalfish.step.known import Known
from coudalfish.step.method import Attempt, StepMultiplier
from coudalfish.step.report import ContactReport, RejectedStepError, StepError, StepReport
from coudalfish.step.watch import Watch
from coudalfish.surface import exchange
from coudalfish.surface.meeting import Meets
from coudalfish.surface.monitors import Monitors, monitors_of
from coudalfish.surface.trace import PointLocator
from tigar_x import ranks
from tigar_x.compat import FloatArray

UNDER_RELAXATION = 0.5
"""Share of the shell's increments that a cautious attempt takes."""


@dataclass(frozen=True)
class Start:
    """What a step starts from.

    Attributes:
        lam: multiplier, shape (points,); unit: force/area.
        floors: residuals (fluid, shell) below which the step before had nothing left to solve for; None: there was
            none; unit: force.
        penalty: beta; unit: force time/length^3.
    """

    lam: FloatArray
    floors: tuple[float, float] | None
    penalty: float


@dataclass(frozen=True)
class Outcome:
    """What a step gives beside the fields of its sides.

    Attributes:
        report: what it did.
        lam: multiplier of the next step, shape (points,); unit: force/area.
        floors: as those of :class:`Start`.
        suits: whether a step that starts from this multiplier would place the surface in the same way.
    """

    report: StepReport
    lam: FloatArray
    floors: tuple[float, float] | None
    suits: bool = True


class Step:
    """The data that stay fixed during a step, and the iteration.

    Args:
        fluid: the flow.
        shell: the immersed structure.
        attempt: how they are coupled, and the kind of the multiplier.
        start: what the step starts from.
        meets: how the surface meets the fluid.
        locator: finds points in the fluid's mesh.
        watch: what looks for numbers out of their limits.
        cautious: under-relax the shell, accelerate from the start and assemble tangents in every pass.

    Attributes:
        block: where the attempt is, "mesh", "fluid", "shell" or "coupling".
        lam: multiplier that the step starts from, at its end that of the next one, shape (points,).
        method: kind of the multiplier.
        positive: whether the shell's tangent leaves out what makes that of contact indefinite.
        multiplier: that of the step, once the points are placed.
    """

    multiplier: StepMultiplier

    def __init__(
        self,
        fluid: FluidSubproblem,
        shell: ShellSubproblem,
        attempt: Attempt,
        start: Start,
        meets: Meets,
        locator: PointLocator,
        watch: Watch,
        *,
        cautious: bool = False,
    ) -> None:
        self.fluid, self.shell, self.comm = fluid, shell, fluid.comm
        self.method, self.stays = attempt.method, attempt.stays
        options = attempt.options
        self.options = replace(options, tangent_update="pass", accelerate_after=0) if cautious else options
        self.meets, self.locator, self.watch, self.cautious = meets, locator, watch, cautious
        self.lam, self.floors, self.beta = start.lam, start.floors, start.penalty
        self.anderson = Anderson(max(self.options.acceleration, 1))
        self.dt, self.block = fluid.timeInt.step_size, "coupling"
        self.positive = cautious or (self.method.lag == 0.0 and shell.spline.nsd == 3)
        self.acceptance, self._of_shell = Acceptance(self.options), Known(self.comm)
        self.passes, self.linear_iterations, self.inactive, self.spacing = 0, 0, 0, 0.0

    # -- set-up -------------------------------------------------------------------------------------------------------

    def run(self) -> Outcome:
        """Predict, iterate, update the multiplier."""
        self._predict()
        self._place()
        self._iterate()
        if self.fluid.moving is not None:
            self.block = "mesh"
            self.fluid.moving.check()  # a solid in the flow has moved it in every pass
        return self._finish()

    def _predict(self) -> None:
        if self.fluid.moving is not None:
            self._move(self.fluid.moving)
        for side in (self.fluid, self.shell):
            side.timeInt.predict()
            for update in side.updates:
                update(float(side.timeInt.t_alpha.value))
        ranks.share(self.comm, self.shell.timeInt.x.x.array)
        self.fluid.system.apply_boundary_values()

    def _move(self, moving: MovingMesh) -> None:
        """The mesh at the end of the step, and its cells at the intermediate level."""
        self.block = "mesh"
        moving.time.predict()
        moving.move()
        moving.check()
        self.locator.displace(displacement_of_cells(moving))
        self.block = "coupling"

    def _place(self) -> None:
        """Explicit geometry: points where the fluid meets them, their cells, B, the band and the normals."""
        with self._met():
            x = ranks.first(self.comm, self.shell.positions())
            if not np.isfinite(x).all():
                raise RejectedStepError("shell", "the predicted positions are not finite")
            self.n = self.shell.normals()
        v = ranks.first(self.comm, self.shell.velocity())
        scales = {"scale_m": self.options.scale_m, "scale_c": self.options.scale_c}
        load = partial(exchange.tractions, self.lam, self.n)
        where_it_is = self.meets(x, self.locator)
        meeting = self.fluid.place(where_it_is, self.shell.sheets, x, v, load, **scales)
        self.meeting, self.W, self.trace = meeting, meeting.W, meeting.trace
        seen = meeting.active | where_it_is.active if meeting.active.any() else meeting.active
        self.inactive = int((~seen).sum())
        self.multiplier = self.method.begin(self)
        self.spacing = self.watch.spacing(x)
        self.watch.placed(self, x)

    @contextmanager
    def _met(self) -> Iterator[None]:
        """The shell where the fluid meets it, meanwhile."""
        if not self.stays:
            yield
            return
        time = self.shell.timeInt
        predicted = time.x.x.array.copy()
        time.x.x.array[:] = time.x_old.x.array
        try:
            yield
        finally:
            time.x.x.array[:] = predicted

    @cached_property
    def vertex_functions(self) -> sp.csr_matrix:
        """Linear functions of the fluid mesh's vertices at the points, made where something asks (collective)."""
        return self.meeting.vertex_functions()

    # -- block iteration ----------------------------------------------------------------------------------------------

    def _iterate(self) -> None:
        before = self.options.stopping == "before_solve"
        for _ in range(self.options.max_passes):
            self._evaluate()
            norm_f = self._fluid_residual()
            if before and self._accepted(norm_f, self.shell_residual()):
                return
            norm_s = self.multiplier.advance(self)
            self.passes += 1
            if not before and self._accepted(norm_f, norm_s):
                self._evaluate()
                return
        self._evaluate()
        if before and self._accepted(self._fluid_residual(), self.shell_residual()):
            return
        raise self.acceptance.failure()

    def alternate(self) -> float:
        """One solve of the fluid, then one of the shell; returns the residual that the shell had."""
        begins = self.accelerated and self.passes == self.options.accelerate_after
        fresh = self.passes == 0 or begins or self.acceptance.stalled or self.options.tangent_update == "pass"
        self._solve_fluid(fresh)
        self.u = self.fluid.velocity_at(self.trace)
        norm_s = self.shell_residual()
        self.acceptance.note(0.0, norm_s)
        self.solve_shell(fresh)
        return norm_s

    @property
    def accelerated(self) -> bool:
        """Whether the iteration has been so slow that it gets Anderson acceleration and the consistent tangent."""
        return self.options.acceleration > 0 and self.passes >= self.options.accelerate_after

    def _evaluate(self) -> None:
        """Velocities, and normals if they follow the iterate, at the points."""
        self.u, self.y_dot = self.fluid.velocity_at(self.trace), self.shell.velocity()
        if self.options.normal == "iterate":
            self.n = self.shell.normals()

    @property
    def forces(self) -> FloatArray:
        """Fluid on shell at the points."""
        turned, (forces, _) = self.multiplier.turned, self._traced
        return forces if turned is None else forces + turned.at_points

    @property
    def _traced(self) -> tuple[FloatArray, FloatArray | float]:
        """Those of them that act on the fluid by the trace, and this rank's share of others at the trace's nodes."""
        lam, turned = self.multiplier.acting, self.multiplier.turned
        if turned is None:
            return exchange.point_forces(self.u, self.y_dot, lam, self.n, self.W, penalty=self.beta), 0.0
        return self.beta * self.W[:, None] * (self.u - self.y_dot), turned.at_nodes

    def _fluid_residual(self) -> float:
        self.block = "fluid"
        forces, beside = self._traced
        return self._finite(self.fluid.assemble_residual(self.trace, forces, self.beta, beside))

    def shell_residual(self) -> float:
        """Residual of the shell under the present forces (collective), assembled unless it is."""
        self.block, forces, y = "shell", self.forces, self.shell.timeInt.x.x.array
        return self._finite(self._of_shell(partial(self.shell.assemble_residual, forces), forces, y))

    def _finite(self, norm: float) -> float:
        if not math.isfinite(norm):
            raise RejectedStepError(self.block, f"the residual of pass {self.passes} is not finite")
        return norm

    def _solve_fluid(self, fresh: bool) -> None:
        self.block = "fluid"
        if fresh:
            consistent = self.options.fluid_tangent == "consistent" or self.accelerated
            self.fluid.assemble_tangent(self.trace, self.penalty_tangent(consistent=consistent))
        self.linear_iterations += self.fluid.solve(first=self.passes == 0)

    def penalty_tangent(self, *, consistent: bool) -> sp.csr_matrix:
        """What the fluid's tangent has of the penalty, for one component, or its row sums."""
        tangent = exchange.consistent_tangent if consistent else exchange.lumped_tangent
        return tangent(*self.meeting.penalty, penalty=self.beta, factor=self.fluid.timeInt.x_factor)

    def solve_shell(self, fresh: bool) -> None:
        """One step of Newton's for the shell (collective)."""
        self.block = "shell"
        y = self.shell.timeInt.x.x.array
        ranks.agreed(self.comm, lambda: self._move_shell(y, fresh))
        ranks.share(self.comm, y)

    def _move_shell(self, y: FloatArray, fresh: bool) -> None:
        if fresh:
            self.shell.assemble_tangent(self.W, self.beta, positive=self.positive)
        elif self.shell.touching is not None:
            self.shell.renew_contact()
        before = y.copy()
        self.shell.solve()
        if self.cautious:
            y[:] = before + UNDER_RELAXATION * (y - before)
        if self.accelerated:
            y[:] = self.anderson.next(before, y)

    def _accepted(self, norm_f: float, norm_s: float) -> bool:
        self.block = "coupling"
        coupling = self.fluid.coupling_norm(self.trace, *self._traced), self.shell.coupling_norm(self.forces)
        small = self.acceptance.test((norm_f, norm_s), ranks.first(self.comm, coupling), self._floors)
        return small and self.multiplier.satisfied(self)

    def _floors(self) -> tuple[float, float]:
        """See :func:`residual_floors`; before the first solve those of the step before are good enough."""
        if self.passes == 0 and self.floors is not None:
            return self.floors
        pushed, moved = exchange.tractions(self.multiplier.acting, self.n), np.abs(self.u) + np.abs(self.y_dot)
        terms, stiffness = np.abs(pushed) + self.beta * moved, self.beta * self.shell.timeInt.xdot_factor
        state = self.fluid, self.shell, self.trace, self.W[:, None] * terms, self.W * stiffness
        self.floors = residual_floors(*state, atol=self.options.block_atol, solved=self.passes > 0)
        return self.floors

    # -- end ----------------------------------------------------------------------------------------------------------

    def _finish(self) -> Outcome:
        u, y_dot, n, W, r = self.u, self.y_dot, self.n, self.W, self.options.relaxation
        (traced, beside), only_held = self._traced, self.multiplier.whole - self.multiplier.acting
        held = W[:, None] * exchange.tractions(only_held, n)
        forces, on_fluid = self.forces + held, self.fluid.received(self.trace, traced + held, beside)
        lam = self.multiplier.updated(u, y_dot, n, penalty=self.beta, relaxation=r)
        lam = exchange.tractions(lam, n) if self.lam.ndim == 2 else lam
        ranks.share(self.comm, lam)
        if not np.isfinite(lam).all():
            raise RejectedStepError("coupling", "the new multiplier is not finite")
        areas, self.lam = W * self.shell.sheets.stretch(self.shell.positions()), lam
        monitors = monitors_of(u - y_dot, n, W, forces, on_fluid, forces.sum(axis=0), areas=areas)
        report = ranks.first(self.comm, self.report(monitors, self._contact()))
        self.watch.finished(self, report)
        return Outcome(report, lam, self.floors, self.fluid.suits(partial(exchange.tractions, lam, n)))

    def _contact(self) -> ContactReport | None:
        if self.shell.contact is None:
            return None
        closing, found = self.shell.closing_ratio(), self.shell.touching
        state = (0, 0.0, 0.0, math.inf) if found is None else (found.pairs, found.load, found.energy, found.distance)
        return ContactReport(*state, closing)

    def report(self, monitors: Monitors | None, contact: ContactReport | None = None) -> StepReport:
        """What has been done so far."""
        lagging = self.method.lag * float(np.abs(self.lam).max(initial=0.0))
        return StepReport(
            t=self.fluid.timeInt.time + self.dt,
            t_alpha=float(self.fluid.timeInt.t_alpha.value),
            attempts=2 if self.cautious else 1,
            passes=self.passes,
            residuals=tuple(self.acceptance.history),
            linear_iterations=self.linear_iterations,
            penalty=self.beta,
            inactive_points=self.inactive,
            slip_ratio=lagging * self.dt / (self.beta * self.fluid.mesh_size),
            monitors=monitors,
            contact=contact,
        )

    def failure(self, error: Exception) -> StepError:
        """The error that tells the user which block failed, why, and which number is suspect."""
        block = error.block if isinstance(error, RejectedStepError) else self.block
        suspect, touching = self.watch.suspect(self), self.shell.touching
        if block == "shell" and touching is not None:
            suspect += f"; {touching.pairs} pairs touch: reduce dt or smooth the kernel of contact"
        return StepError(block, str(error), suspect, self.report(None))
