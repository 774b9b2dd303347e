"""A multiplier that is an unknown of the step: Newton's method on fluid, shell and multiplier together.

It is made of few functions on the shell's reference surface, and is what lets no fluid pass in their means: nothing
lags, so that neither the time step nor the penalty decides how far shell and fluid slip.
"""

import numpy as np

from coudalfish.sides.fluid import FluidSubproblem
from coudalfish.sides.shell import ShellSubproblem
from coudalfish.step.condensed import CondensedSystem
from coudalfish.step.functions import Acting, Functions
from coudalfish.step.linearised import Linearised
from coudalfish.step.method import Stepping, Turned
from coudalfish.step.options import CouplingOptions
from coudalfish.step.preconditioner import Preconditioner
from coudalfish.step.seen import Seen
from coudalfish.surface.multiplier import held_points
from tigar_x import ranks
from tigar_x.compat import FloatArray
from tigar_x.fem.linear import SolveError

PASSES = 20
"""Passes after which Newton's method has failed, if the options allow more."""
INNER = 3
"""Steps of Newton's that the shell takes alone in a pass, at most."""
INNER_SHARE = 0.1
"""Share of the residual that is accepted of the shell which they leave."""
MANY = 200
"""Functions from which on the multiplier's preconditioner is kept from step to step, as it is where the flow's recipe
keeps that of the flow; a restart then makes it anew."""
GROWTH = 1.5
"""Growth of the linear iterations at which the multiplier's preconditioner is made anew."""
TIGHT = 0.1
"""Slip in the means of the multiplier's functions that is accepted, relative to the speeds, over that of forces."""

SOLVED = 1e-8
"""Such slip which the linear solver may leave."""
UNSEEN = 5.0 * SOLVED
"""Penalty of a slip relative to the multiplier that solves leave as well, which is all where nothing moves."""


class Converged:
    """Multipliers of one run, and what they keep from step to step.

    Args:
        fluid: the flow.
        shell: the immersed structure.
        options: how they are coupled.

    Raises:
        ValueError: the shell's points are no tensor grid.
    """

    lag = 0.0
    gives_way = (
        "it does so between the functions of the multiplier; reduce multiplier_size, or refine the shell and the"
        " fluid's mesh there; a smaller dt does not help"
    )

    def __init__(self, fluid: FluidSubproblem, shell: ShellSubproblem, options: CouplingOptions) -> None:
        size, vector = options.multiplier_size * fluid.mesh_size, options.multiplier_direction == "vector"
        of_shell = shell.spline, shell.sheets, shell.quadrature.weights
        self.functions = Functions(*of_shell, size, vector=vector)
        self.system, self._layout = CondensedSystem(fluid, self.functions.count), fluid.system.layout
        self.preconditioner: Preconditioner | None = None
        self.iterations: int | None = None

    def begin(self, step: Stepping) -> "ConvergedMultiplier":
        """See :class:`coudalfish.step.method.Method`."""
        if self.functions.count <= MANY and step.fluid.system.recipe.rebuild_growth is None:
            self.preconditioner = None
        return ConvergedMultiplier(self, step)

    def prepared(self, at: Linearised) -> CondensedSystem:
        """The system at a state whose tangents have been assembled (collective)."""
        if at.fluid.system.layout != self._layout:
            self.system = CondensedSystem(at.fluid, self.functions.count)
            self._layout = at.fluid.system.layout
        self.system.seen = Seen.of(at)
        if self.preconditioner is None:
            self.preconditioner, self.iterations = Preconditioner(self.system.seen), None
        self.preconditioner.fluid = at.fluid.system.preconditioner()
        self.system.preconditioner = self.preconditioner
        return self.system

    def solved(self, iterations: int) -> None:
        """Take note of how many iterations the last solve has taken."""
        if self.iterations is None:
            self.iterations = iterations
        elif iterations > GROWTH * self.iterations + 2:
            self.preconditioner = None


class ConvergedMultiplier:
    """The multiplier of one step, ``sum_k c_k N_k`` along the normals or as a vector.

    It starts from the coefficients whose multiplier is nearest to what the step before left: the same ones, unless that
    was another kind of step.

    Args:
        method: of the run.
        step: the step, whose points have been placed.

    Attributes:
        acting: see :class:`coudalfish.step.method.StepMultiplier`.
        whole: likewise.
        turned: likewise.
    """

    turned: Turned | None

    def __init__(self, method: Converged, step: Stepping) -> None:
        self._method, self._functions = method, method.functions
        self._held = held_points(step.comm, step.fluid.free, step.shell.sheets, step.trace, step.n)
        self._n, self._at = step.n, self._functions.acting(step, np.where(self._held, 0.0, 1.0))
        self._own = self._at.own_normals
        self._c = self._functions.fitted(step.lam, step.n, own_normals=self._own)
        ranks.share(step.comm, self._c)
        if self._own:  # what acted on nothing is no load by which the next step could place the surface
            self._c[self._at.H.multiply(self._at.H).T @ np.repeat(step.W, step.n.shape[1]) == 0.0] = 0.0
        self._reference = 0.0
        self._renew(step)

    def _renew(self, step: Stepping) -> None:
        self.whole = self._functions.values(self._c, step.n, own_normals=self._own)
        self.acting = np.where(self._held[:, None] if self.whole.ndim == 2 else self._held, 0.0, self.whole)
        self.turned = None
        at, shape = self._acting(step), (-1, step.n.shape[1])
        if self._own:
            at_points = ranks.total(step.comm, at.G @ self._c)
            self.turned = Turned(at_points.reshape(shape), (at.F @ self._c).reshape(shape))

    def _acting(self, step: Stepping) -> Acting:
        """The functions along the present normals, which may follow the iterate."""
        if step.n is not self._n:
            self._n, self._at = step.n, self._functions.acting(step, np.where(self._held, 0.0, 1.0))
        return self._at

    def _slip(self, step: Stepping) -> FloatArray:
        """Power of the functions' forces by the velocity of the fluid relative to the shell, shape (coefficients,)."""
        at = self._acting(step)
        return step.fluid.power(at.F, step.trace, at.G.T @ step.y_dot.ravel())

    def advance(self, step: Stepping) -> float:
        """See :class:`coudalfish.step.method.StepMultiplier`."""
        before = step.shell_residual()
        every = step.passes == 0 or step.options.tangent_update == "pass"
        fresh = every or not step.acceptance.within_reach
        at = self._linearised(step, fresh)
        step.block = "fluid"
        system = self._method.prepared(at)
        r_s = ranks.first(step.comm, step.shell.system.b.array_r.copy())
        limit = step.acceptance.limits[0]
        try:
            norm, c = system.solve(step.fluid.system.b, r_s, self._slip(step), self._reference, limit)
        except SolveError:
            self._method.preconditioner = None
            raise
        self._reference = max(self._reference, norm)
        self._method.solved(system.iterations)
        step.linear_iterations += system.iterations
        step.fluid.system.subtract(system.increment)
        self._c = self._c - c
        self._renew(step)
        step.u = step.fluid.velocity_at(step.trace)
        self._move_shell(step)
        return before

    def _linearised(self, step: Stepping, fresh: bool) -> Linearised:
        """Tangents, assembled anew or kept, and the parts of the system."""
        shell, d = step.shell, step.n.shape[1]
        if fresh:
            step.block = "fluid"
            self._part = step.penalty_tangent(consistent=True)
            step.fluid.assemble_tangent(step.trace, self._part)
            step.block = "shell"
            ranks.agreed(step.comm, lambda: shell.assemble_tangent(step.W, step.beta, positive=step.positive))
        acting = self._acting(step)
        return Linearised(
            fluid=step.fluid,
            trace=step.trace,
            part=self._part,
            W=np.repeat(step.W, d),
            H=acting.H,
            G=acting.G,
            F=acting.F,
            P=shell.displacements,
            solve_shell=shell.system.inverse,
            beta=step.beta,
            a_s=shell.timeInt.xdot_factor,
        )

    def _move_shell(self, step: Stepping) -> None:
        """The shell under the new forces: it bends, while the system is linear."""
        step.shell_residual()
        for k in range(INNER):
            step.solve_shell(k > 0)
            step.y_dot = step.shell.velocity()
            if step.shell_residual() <= INNER_SHARE * step.acceptance.limits[1]:
                return

    def satisfied(self, step: Stepping) -> bool:
        """See :class:`coudalfish.step.method.StepMultiplier`."""
        sums = self._slip(step)
        areas = self._functions.areas_t @ np.where(self._held, 0.0, step.W)
        areas = np.repeat(areas, len(sums) // len(areas))
        mean = float((np.divide(sums**2, areas, out=np.zeros_like(sums), where=areas > 0.0)).sum())
        speed = float((step.W[:, None] * (step.u**2 + step.y_dot**2)).sum())
        accepted = max(TIGHT * step.options.block_rtol, SOLVED)
        carried = float((step.W * self.whole.T**2).sum()) / step.beta**2
        return bool(ranks.first(step.comm, mean <= accepted**2 * speed + UNSEEN**2 * carried))

    def updated(
        self, u: FloatArray, y_dot: FloatArray, n: FloatArray, *, penalty: float, relaxation: float
    ) -> FloatArray:
        """What it is; nothing is left to update."""
        return self.whole
