"""How a flow is discretised and solved, what a step reports, and how one fails."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

from petsc4py import PETSc

from tigar_x import checks
from tigar_x.fem.linear import LinearSolver
from tigar_x.fem.petsc_options import as_recipe

STEP_LINEAR_RTOL, STEADY_LINEAR_RTOL = 1e-3, 1e-4
"""Tolerance of iterative linear solvers relative to the residual of each Newton iteration."""
STALLED = 1e3
"""Multiple of the accepted residual that is accepted as well where rounding keeps Newton's method from going on."""
STEP_RTOL = {True: 1e-6, False: 1e-8}
"""Accepted residual of a step relative to its first one, for direct and for iterative linear solvers: what the latter
leave lies in the pressure more than in the velocity."""
STEADY_RTOL = 1e-12
"""Accepted residual of steady flow relative to its first one, which the penalty of weak conditions may dominate."""


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
        C_t: constant of the time-step term in tau_M and tau_C of quasi-static sub-scales.
        subscales: "quasi-static" ones have the time step in tau_M and tau_C; "dynamic" ones are remembered from step
            to step instead, so that errors do not grow where steps are small and steady flows do not know the step,
            and have no cross and Reynolds stress, see docs/flow.md.
        tau_dt: time step in tau_M, where it is not to change with the step; None: that of the step. Unit: time.
        invariant_metric: whether the element metric does not depend on the numbering of vertices.
        frozen_tangent: whether the tangent leaves out the derivatives of the stabilisation parameters.
        quadrature_degree: None: 2 k, and more where a mesh's displacement is not linear.
        pressure: how the constant of the pressure is fixed in a flow without an open boundary: by the null space of an
            iterative solver, which keeps the nodal mean, or by a pinned degree of freedom.
        pin_at: where the pressure is pinned to zero, at the nearest vertex; None: at the centroid of the mesh.
        solver: linear solver recipe, or a KSP; None: by size, see :func:`tigar_x.fem.linear.automatic`. PETSc options
            go first, under ``fluid_``.
        rtol: accepted residual relative to the first one of a step or solve; None: ``STEP_RTOL`` or ``STEADY_RTOL``.
        max_iterations: Newton iterations after which a step or solve has failed.
        keep: see :func:`tigar_x.fem.solve.newton`; in steady flow every iteration has a new tangent.

    Raises:
        ValueError: a number is out of range.
    """

    C_I: float | None = None
    C_t: float = 4.0
    subscales: Literal["quasi-static", "dynamic"] = "quasi-static"
    tau_dt: float | None = None
    invariant_metric: bool = False
    frozen_tangent: bool = False
    quadrature_degree: int | None = None
    pressure: Literal["automatic", "null space", "pin"] = "automatic"
    pin_at: Sequence[float] | None = None
    solver: LinearSolver | PETSc.KSP | None = None
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
        if self.solver is not None:
            as_recipe("solver", self.solver)
        checks.not_negative("C_t", self.C_t)
        checks.choice("subscales", self.subscales, ("quasi-static", "dynamic"))
        if self.subscales == "dynamic" and self.tau_dt is not None:
            raise ValueError(
                f"tau_dt = {self.tau_dt!r}: dynamic sub-scales have no time step in tau_M, None is required"
            )
        for name in ("invariant_metric", "frozen_tangent"):
            checks.flag(name, getattr(self, name))
        checks.choice("pressure", self.pressure, ("automatic", "null space", "pin"))
        checks.whole("max_iterations", self.max_iterations, 1)


@dataclass(frozen=True)
class FlowReport:
    """What a step or a steady solve did.

    Attributes:
        t: end of the step, to which velocities belong; 0 in steady flow.
        residuals: norms of the residual, from the first to the accepted one.
        linear_iterations: iterations of the linear solver in all.
        tangents: number of tangents that were assembled.
        measured: what the step's ``measure`` returned, which was called with the state at ``t``; forces from the
            equations, as of :class:`varmint.quantities.BoundaryForce`, are those at ``t_alpha``.
        t_alpha: time at which the equations hold, to which pressures and forces belong.
    """

    t: float
    residuals: tuple[float, ...]
    linear_iterations: int
    tangents: int
    measured: Any = None
    t_alpha: float = 0.0

    @property
    def iterations(self) -> int:
        """Number of Newton iterations."""
        return len(self.residuals) - 1
