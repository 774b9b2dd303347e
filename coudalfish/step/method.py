"""What a multiplier is to the step that it acts in."""

from dataclasses import dataclass
from typing import Protocol

import scipy.sparse as sp
from mpi4py import MPI

from coudalfish.sides.fluid import FluidSubproblem
from coudalfish.sides.shell import ShellSubproblem
from coudalfish.step.acceptance import Acceptance
from coudalfish.step.options import CouplingOptions
from coudalfish.surface.meeting import Meeting
from coudalfish.surface.trace import TraceMatrix
from tigar_x.compat import FloatArray


class Stepping(Protocol):
    """What a multiplier sees of its step, once the points are placed.

    Attributes:
        comm: of the fluid.
        fluid: the flow.
        shell: the immersed structure.
        options: how they are coupled.
        beta: penalty.
        lam: multiplier that the step starts from, shape (points,).
        n: normals, shape (points, d).
        meeting: where the surface is in the fluid.
        trace: of the fluid's velocity at the points.
        W: reference areas, zero at points outside the fluid, shape (points,).
        u: velocity of the fluid at the points, shape (points, d).
        y_dot: their own velocity, shape (points, d).
        block: where the step is.
        passes: finished ones.
        linear_iterations: of the fluid's solver in all passes.
        acceptance: what judges the residuals.
        positive: whether the shell's tangent leaves out what makes that of contact indefinite, as a converged
            multiplier in space needs it, where a light shell does not make up for it.
    """

    comm: MPI.Comm
    fluid: FluidSubproblem
    shell: ShellSubproblem
    options: CouplingOptions
    beta: float
    lam: FloatArray
    n: FloatArray
    meeting: Meeting
    trace: TraceMatrix
    W: FloatArray
    u: FloatArray
    y_dot: FloatArray
    block: str
    passes: int
    linear_iterations: int
    acceptance: Acceptance
    positive: bool

    @property
    def vertex_functions(self) -> sp.csr_matrix:
        """Linear functions of the fluid mesh's vertices at the points (collective)."""

    def alternate(self) -> float:
        """One solve of the fluid, then one of the shell; returns the residual that the shell had."""

    def penalty_tangent(self, *, consistent: bool) -> sp.csr_matrix:
        """What the fluid's tangent has of the penalty, for one component."""

    def shell_residual(self) -> float:
        """Residual of the shell under the present forces."""

    def solve_shell(self, fresh: bool) -> None:
        """One step of Newton's for the shell."""


@dataclass(frozen=True, eq=False)
class Turned:
    """Forces of a multiplier that acts along normals that the meeting has of its own.

    Attributes:
        at_points: of its part that acts, fluid on shell, shape (points, d); unit: force.
        at_nodes: the same on the nodes of the trace, shape (nodes, d), this rank's share.
    """

    at_points: FloatArray
    at_nodes: FloatArray


class StepMultiplier(Protocol):
    """The multiplier of one step.

    Attributes:
        acting: multiplier without that of points that neither side can move, shape (points,).
        whole: multiplier of the whole surface, shape (points,).
    """

    acting: FloatArray
    whole: FloatArray

    @property
    def turned(self) -> Turned | None:
        """Forces along normals of the meeting's own; None: it acts along the shell's, or is a vector."""

    def advance(self, step: Stepping) -> float:
        """One pass; returns the residual of the shell with the new flow (collective)."""

    def satisfied(self, step: Stepping) -> bool:
        """Whether the multiplier's own equation is satisfied, as far as the step is to do that (collective)."""

    def updated(
        self, u: FloatArray, y_dot: FloatArray, n: FloatArray, *, penalty: float, relaxation: float
    ) -> FloatArray:
        """Multiplier of the next step, shape (points,)."""


class Method(Protocol):
    """A kind of multiplier, of one run.

    Attributes:
        lag: share of it that is as the step before left it, while fluid and shell are solved in turn: a change of load
            by that much moves fluid through the shell. 0: all are solved for at once.
        gives_way: why fluid may pass the shell nevertheless, and what helps.
    """

    lag: float
    gives_way: str

    def begin(self, step: Stepping) -> StepMultiplier:
        """The multiplier of a step whose points have been placed (collective)."""


@dataclass(frozen=True, eq=False)
class Attempt:
    """One way to take a step.

    Attributes:
        method: kind of the multiplier.
        options: of the coupling.
        what: what is said of it where those before have failed.
        stays: whether the fluid meets the shell where the step before has left it, not where it is predicted.
    """

    method: Method
    options: CouplingOptions
    what: str = ""
    stays: bool = False
