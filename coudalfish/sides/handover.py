"""What belongs to a residual that is handed over to the coupling, and whether it came along.

A residual alone does not say who keeps its data up to date: boundary values that change in time, scales of a band,
pressures of outlets, a mesh that moves. Forgotten, they stay what they were, and the run is wrong without a word. Here
everything that can be known of the residual is asked: what it is built of, and what its integrator says it needs.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any, Protocol, runtime_checkable

import numpy as np
import ufl
from mpi4py import MPI
from dolfinx import fem, mesh
from petsc4py import PETSc

from coudalfish.sides.mesh_motion import MovingMesh
from coudalfish.surface.band import BandScale, SurfaceBand
from tigar_x import compat
from tigar_x.fem.linear import LinearSolver
from tigar_x.fem.solve import RankOne
from tigar_x.fem.time_integration import TimeIntegrator


class Needs(Protocol):
    """What a flow needs of whoever steps it, such as ``varmint.flow.clock.FlowNeeds``."""

    @property
    def updates(self) -> Sequence[Callable[[float], None]]:
        """To be called with t_alpha at the start of every step."""

    @property
    def before(self) -> Sequence[Callable[[], None]]:
        """To be called before every assembly of the residual."""

    @property
    def rank_one(self) -> Sequence[RankOne]:
        """Loads whose tangent is dense."""

    @property
    def bcs(self) -> Sequence[Any]:
        """Strong boundary conditions without the pin of the pressure."""

    @property
    def moving(self) -> MovingMesh | None:
        """Motion of the mesh; None: it is fixed."""

    @property
    def solver(self) -> LinearSolver | PETSc.KSP | None:
        """Linear solver that was chosen for it; None: none was."""

    @property
    def is_closed(self) -> bool:
        """Whether a constant of its pressure remains."""

    @property
    def rho(self) -> fem.Constant:
        """Density."""

    @property
    def mu(self) -> fem.Constant:
        """Viscosity."""

    @property
    def scales(self) -> tuple[fem.Function, fem.Function] | None:
        """Factor of tau_M and divisor of tau_C near an immersed surface; None: they are not in its residual."""

    @property
    def sides(self) -> Any:
        """What differs on both sides of an immersed surface; None: nothing."""


@runtime_checkable
class Demanding(Protocol):
    """An integrator that knows what its residual needs."""

    @property
    def needs(self) -> Needs:
        """See there."""


def check_residual(residual: ufl.Form, timeInt: TimeIntegrator, domain: mesh.Mesh) -> None:
    """Check that a residual and its integrator belong together.

    Args:
        residual: residual.
        timeInt: integrator of its unknown.
        domain: mesh of the subproblem.

    Raises:
        ValueError: the residual is not built of the integrator's expressions, or lives on another mesh.
    """
    if timeInt.x.function_space.mesh is not domain:
        raise ValueError(f"the unknown {timeInt.x.name!r} lives on another mesh: that of the subproblem is required")
    coefficients = residual.coefficients()
    # at the end of the step the state before it need not be in the equations
    for function in (timeInt.x, timeInt.x_old)[: 1 + (timeInt.scheme.alpha_f < 1.0)]:
        if not any(c is function for c in coefficients):
            raise ValueError(
                f"the residual does not contain {function.name!r} of its integrator: one that is built from this"
                " integrator's expressions is required"
            )


def check_band(residual: ufl.Form, band: SurfaceBand | None) -> None:
    """Check that a residual has the scales of its band, and of no other.

    Args:
        residual: residual of the fluid.
        band: band of the subproblem; None: there is none.

    Raises:
        ValueError: it is not so.
    """
    coefficients = residual.coefficients()
    own = () if band is None else (band.scale_m, band.scale_c)
    if any(all(c is not scale for scale in own) for c in coefficients if isinstance(c, BandScale)):
        given = "None" if band is None else "another one"
        raise ValueError(f"band is {given}: the band whose scales the residual contains is required")
    if band is not None and not any(c is scale for scale in own for c in coefficients):
        raise ValueError(
            "band is given, and the residual has neither of its scales: give band.scale_m and band.scale_c to the"
            " form, or no band"
        )


def check_needs(
    timeInt: TimeIntegrator,
    *,
    bcs: Sequence[Any],
    updates: Sequence[Callable[[float], None]],
    before: Sequence[Callable[[], None]],
    rank_one: Sequence[RankOne],
    band: SurfaceBand | None,
    sides: Any,
    moving: MovingMesh | None,
    solver: LinearSolver | PETSc.KSP | None,
    density: float | None,
    viscosity: float | None,
) -> None:
    """Check that a flow's residual comes with all that the flow needs (collective).

    Args:
        timeInt: the flow's integrator; what does not know its needs, as that of a residual by hand, has none here.
        bcs: see :class:`coudalfish.sides.fluid.FluidSubproblem`, as the others.
        updates: see there.
        before: see there.
        rank_one: see there.
        band: see there.
        sides: see there.
        moving: see there.
        solver: see there.
        density: see there.
        viscosity: see there.

    Raises:
        ValueError: something was left behind, or is that of another flow.
    """
    if not isinstance(timeInt, Demanding):
        return
    needs = timeInt.needs
    hooks: tuple[tuple[str, Sequence[Any], Sequence[Any], str], ...] = (
        ("updates", updates, needs.updates, "boundary values that change in time"),
        ("before", before, needs.before, "what follows the flow's unknown: pressures of outlets, nodes of a solid"),
        ("rank_one", rank_one, needs.rank_one, "the tangent of outlets with a resistance"),
    )
    for name, given, needed, why in hooks:
        if any(item not in given for item in needed):
            raise ValueError(f"{name} leaves out those of the flow: {name}=flow.{name} is required for {why}")
    if needs.scales is not None and (band is None or band.scale_m is not needs.scales[0]):
        raise ValueError("band is not that of the flow: band=SurfaceBand(mesh, flow.scales) is required")
    if sides is not needs.sides:
        raise ValueError(
            "sides are not those of the flow, whose fields differ on both sides of a surface: the flow itself is"
            " required, CouDALFISh(flow, shell)"
        )
    if moving is not needs.moving:
        found = "None" if moving is None else "another one than the flow's"
        raise ValueError(f"moving is {found}: moving=flow.moving is required, which the residual is pulled back by")
    if needs.solver is not None and solver is None:
        raise ValueError(
            f"solver = None: the flow's options chose {needs.solver.name!r}, solver=flow.options.solver or another one"
            " is required"
        )
    for name, value, constant in (("density", density, needs.rho), ("viscosity", viscosity, needs.mu)):
        known = float(constant.value)
        if value is not None and not math.isclose(value, known, rel_tol=1e-9):
            raise ValueError(
                f"{name} = {value}: that of the flow, {known}, is required, or none without a penalty rule"
            )
    _check_conditions(timeInt, needs, compat.constrained_dofs(tuple(bcs)))


def _check_conditions(timeInt: TimeIntegrator, needs: Needs, constrained: Any) -> None:
    V = timeInt.x.function_space
    comm = V.mesh.comm
    left = np.setdiff1d(compat.constrained_dofs(tuple(needs.bcs)), constrained)
    if comm.allreduce(len(left), op=MPI.SUM):
        raise ValueError("bcs leaves out strong conditions of the flow: bcs=flow.bcs is required")
    if not needs.is_closed:
        return
    pressures = compat.component_space(V, V.mesh.geometry.dim)[1]
    if not comm.allreduce(int(np.isin(pressures, constrained).sum()), op=MPI.SUM):
        raise ValueError(
            "bcs: the flow is enclosed, and nothing fixes the constant of its pressure; a pin is required, which"
            ' flow.bcs has with FlowOptions(pressure="pin")'
        )
