"""A multiplier that is an unknown of the step: Newton's method on fluid, shell and multiplier together.

It is made of few functions on the shell's reference surface, and is what lets no fluid pass in their means: nothing
lags, so that neither the time step nor the penalty decides how far shell and fluid slip.
"""

import numpy as np
import scipy.sparse as sp

from coudalfish.sides.fluid import FluidSubproblem
from coudalfish.sides.shell import ShellSubproblem
from coudalfish.step.condensed import CondensedSystem, Linearised, Preconditioner
from coudalfish.step.method import Stepping
from coudalfish.step.options import CouplingOptions
from coudalfish.surface.exchange import along_normals, tractions
from coudalfish.surface.hats import hat_functions
from coudalfish.surface.multiplier import held_points
from tigar_x import ranks
from tigar_x.compat import FloatArray

PASSES = 20
"""Passes after which Newton's method has failed, if the options allow more."""
INNER = 3
"""Steps of Newton's that the shell takes alone in a pass, at most."""
INNER_SHARE = 0.1
"""Share of the residual that is accepted of the shell which they leave."""
MANY = 200
"""Functions from which on the multiplier's preconditioner is kept from step to step; a restart then makes it anew."""
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

    def __init__(self, fluid: FluidSubproblem, shell: ShellSubproblem, options: CouplingOptions) -> None:
        size = options.multiplier_size * fluid.mesh_size
        N = hat_functions(shell.spline, shell.sheets, shell.quadrature.weights, size)
        d, self.vector = shell.spline.nsd, options.multiplier_direction == "vector"
        self.functions = sp.csr_matrix(abs(N)) if self.vector else N  # a vector has no side
        self.functions_t, self.areas_t = self.functions.T.tocsr(), abs(N).T.tocsr()
        self.fit = nearest_coefficients(self.functions, shell.quadrature.weights)
        self._spread = sp.kron(self.functions, np.eye(d) if self.vector else np.ones((d, 1)), format="csr")
        self._rows = np.repeat(np.arange(self._spread.shape[0]), np.diff(self._spread.indptr))
        self.displacements_t = shell.displacements.T.tocsr()
        self.system, self._layout = CondensedSystem(fluid, self._spread.shape[1]), fluid.system.layout
        self.preconditioner: Preconditioner | None = None
        self.iterations: int | None = None

    def begin(self, step: Stepping) -> "ConvergedMultiplier":
        """See :class:`coudalfish.step.method.Method`."""
        if self.functions.shape[1] <= MANY:
            self.preconditioner = None
        return ConvergedMultiplier(self, step)

    def forces(self, directions: FloatArray) -> sp.csr_matrix:
        """The functions as forces per area at the points, shape (points d, coefficients).

        Args:
            directions: normals, or of a vector its factors, shape (points, d).
        """
        H = self._spread
        return sp.csr_matrix((H.data * directions.ravel()[self._rows], H.indices, H.indptr), shape=H.shape)

    def prepared(self, at: Linearised) -> CondensedSystem:
        """The system at a state whose tangents have been assembled (collective)."""
        if at.fluid.system.layout != self._layout:
            self.system = CondensedSystem(at.fluid, self._spread.shape[1])
            self._layout = at.fluid.system.layout
        if self.preconditioner is None:
            self.preconditioner, self.iterations = Preconditioner(at), None
        self.preconditioner.at = self.system.at = at
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
    """The multiplier of one step, ``sum_k c_k N_k`` along the normals.

    It starts from the coefficients whose multiplier is nearest to what the step before left: the same ones, unless that
    was another kind of step.

    Args:
        method: of the run.
        step: the step, whose points have been placed.

    Attributes:
        acting: see :class:`coudalfish.step.method.StepMultiplier`.
        whole: likewise.
    """

    def __init__(self, method: Converged, step: Stepping) -> None:
        self._method, self._N = method, method.functions
        self._held = held_points(step.comm, step.fluid.free, step.shell.sheets, step.trace, step.n)
        self._vector = method.vector
        self._c = method.fit @ (tractions if self._vector else along_normals)(step.lam, step.n)
        ranks.share(step.comm, self._c)
        self._reference = 0.0
        self._renew()

    def _renew(self) -> None:
        self.whole = np.asarray(self._N @ self._c)
        self.acting = np.where(self._held[:, None] if self._vector else self._held, 0.0, self.whole)

    def advance(self, step: Stepping) -> float:
        """See :class:`coudalfish.step.method.StepMultiplier`."""
        before = step.shell_residual()
        every = step.passes == 0 or step.options.tangent_update == "pass"
        fresh = every or not step.acceptance.within_reach
        at = self._linearised(step, fresh)
        step.block = "fluid"
        system = self._method.prepared(at)
        r_s = ranks.first(step.comm, step.shell.system.b.array_r.copy())
        r_c = at.H_t @ (at.W * (step.u - step.y_dot).ravel())
        norm, c = system.solve(step.fluid.system.b, r_s, r_c, self._reference, step.acceptance.limits[0])
        self._reference = max(self._reference, norm)
        self._method.solved(system.iterations)
        step.linear_iterations += system.iterations
        step.fluid.system.subtract(system.increment)
        self._c = self._c - c.reshape(self._c.shape)
        self._renew()
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
            ranks.agreed(step.comm, lambda: shell.assemble_tangent(step.W, step.beta))
        acts = np.where(self._held, 0.0, 1.0)[:, None]
        return Linearised(
            fluid=step.fluid,
            trace=step.trace,
            part=self._part,
            W=np.repeat(step.W, d),
            H=self._method.forces(np.repeat(acts, d, axis=1) if self._vector else acts * step.n),
            P=shell.displacements,
            P_t=self._method.displacements_t,
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
        active = np.where(self._held, 0.0, step.W)
        areas = self._method.areas_t @ active
        slip = step.u - step.y_dot
        if not self._vector:
            slip = np.einsum("qi,qi->q", slip, step.n)[:, None]
        sums = self._method.functions_t @ (active[:, None] * slip)
        areas = np.broadcast_to(areas[:, None], sums.shape)
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


def nearest_coefficients(N: sp.csr_matrix, W: FloatArray) -> FloatArray:
    """From multipliers to the coefficients of the functions that are nearest to them in the mean over areas.

    Args:
        N: functions at the points, shape (points, functions).
        W: areas, shape (points,).

    Returns:
        Shape (functions, points).
    """
    root = np.sqrt(W)
    return np.asarray(np.linalg.pinv(root[:, None] * N.toarray(), rcond=1e-10) * root)
