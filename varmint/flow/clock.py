"""The clock of a flow, and what a flow needs of whoever steps it."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from dolfinx import fem
from petsc4py import PETSc

from tigar_x.fem.linear import LinearSolver
from tigar_x.fem.low_rank import RankOne
from tigar_x.fem.time_integration import TimeIntegrator
from varmint.forms.motion import ElasticMotion, PrescribedMotion
from varmint.forms.vms import Memory


@dataclass(frozen=True)
class FlowNeeds:
    """What a flow needs of whoever steps it, beside its residual.

    Attributes:
        updates: see :class:`varmint.flow.flow.Flow`.
        before: see there.
        rank_one: see there.
        bcs: strong conditions without the pin of the pressure.
        moving: motion of the mesh; None: it is fixed.
        solver: linear solver that was chosen for it; None: none was.
        is_closed: whether a constant of its pressure remains.
        rho: density.
        mu: viscosity.
        scales: factor of tau_M and divisor of tau_C near an immersed surface, cell by cell; None: there is none.
        sides: what differs on both sides of one, see :class:`varmint.flow.sides.FlowSides`; None: nothing.
    """

    updates: tuple[Callable[[float], None], ...]
    before: tuple[Callable[[], None], ...]
    rank_one: tuple[RankOne, ...]
    bcs: tuple[Any, ...]
    moving: PrescribedMotion | ElasticMotion | None
    solver: LinearSolver | PETSc.KSP | None
    is_closed: bool
    rho: fem.Constant
    mu: fem.Constant
    scales: tuple[fem.Function, fem.Function] | None
    sides: Any


class FlowTime(TimeIntegrator):
    """Integrator of a flow, which tells whoever steps the flow what it needs.

    Attributes:
        needs: see there.
        memory: of dynamic sub-scales; None: they are quasi-static.
    """

    needs: FlowNeeds
    memory: Memory | None = None

    def forget(self) -> None:
        """Take the present x as the state that the first step starts from, at rest before."""
        self.x_old.x.array[:] = self.x.x.array
        self.xdot_old.x.array[:] = 0.0

    def forget_in(self, cells: Any) -> None:
        """Leave nothing of what is remembered of single cells, a mask of shape (cells,); there is nothing."""
