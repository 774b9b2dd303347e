"""Flows and shells that are objects of their own as the two sides of the coupling, by what they have and not by type.

They know what a script would otherwise repeat: residual, tangent, integrator, conditions, updates, scales of the
surface's band, density and viscosity.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any, Protocol, cast

import ufl

from coudalfish.sides.fluid import FluidSubproblem
from coudalfish.sides.handover import Demanding
from coudalfish.sides.shell import ShellSubproblem
from coudalfish.surface.band import SurfaceBand
from tigar_x.fem.linear import LinearSolver
from tigar_x.fem.schemes import Scheme
from tigar_x.fem.time_integration import TimeIntegrator
from tigar_x.splines.spline import ExtractedSpline


class ImmersedFlow(Protocol):
    """A flow in which a surface may be immersed, such as ``varmint.Flow(..., immersed=True)``.

    Its integrator tells what else belongs to it, see :class:`coudalfish.sides.handover.Needs`.
    """

    @property
    def residual(self) -> ufl.Form:
        """The whole residual."""

    @property
    def tangent(self) -> ufl.Form | None:
        """Tangent; None: the derivative of the residual."""

    @property
    def bcs(self) -> Sequence[Any]:
        """Strong conditions, with a pin of the pressure where nothing else determines its constant."""

    @property
    def time(self) -> TimeIntegrator | None:
        """Integrator of velocity and pressure; None: steady flow."""


class ImmersedShell(Protocol):
    """A shell that may be immersed in a flow, such as ``shnapr.shell.Shell``."""

    @property
    def spline(self) -> ExtractedSpline:
        """The midsurface."""

    @property
    def time(self) -> TimeIntegrator | None:
        """Integrator of the homogeneous displacement; None: the shell has no clock yet."""

    @property
    def residual(self) -> ufl.Form:
        """The whole residual."""

    @property
    def tangent(self) -> ufl.Form | None:
        """Tangent; None: the derivative of the residual."""

    @property
    def contact(self) -> Any:
        """Contact with itself; None: none."""

    @property
    def solver(self) -> LinearSolver | None:
        """Linear solver; None: direct."""

    @property
    def updates(self) -> Sequence[Callable[[float], None]]:
        """To be called with t_alpha at the start of every step."""

    def bind(self, dt: float, scheme: Scheme, t: float = 0.0) -> None:
        """Take over the clock of a flow, or check that the own one agrees."""

    def release(self) -> None:
        """Give back the clock that :meth:`bind` brought, as no coupling came of it."""


OF_FLOWS = ("residual", "tangent", "bcs", "time")
OF_SHELLS = ("spline", "time", "residual", "tangent", "contact", "solver", "updates", "bind", "release")


@contextmanager
def undone(shell: ShellSubproblem | ImmersedShell) -> Iterator[None]:
    """What fails within leaves a shell without the clock that it got there, so that it can be given another one.

    Args:
        shell: the shell's side as the script gave it.
    """
    had_none = getattr(shell, "time", False) is None
    try:
        yield
    except BaseException:
        if had_none and not isinstance(shell, ShellSubproblem) and shell.time is not None:
            shell.release()
        raise


def both_sides(
    flow: FluidSubproblem | ImmersedFlow, shell: ShellSubproblem | ImmersedShell
) -> tuple[FluidSubproblem, ShellSubproblem]:
    """Flow and shell as the two sides of the coupling (collective); nothing is compiled before they fit.

    Args:
        flow: a :class:`FluidSubproblem`, or a flow.
        shell: a :class:`ShellSubproblem`, or a shell, which gets the clock of the flow and the companion of its scheme
            where it has none.

    Raises:
        ValueError: one is something else, is a flow in which nothing can be immersed, or does not fit the other.
    """
    if not isinstance(flow, FluidSubproblem):
        wanted = "a flow, such as varmint's Flow(..., immersed=True), or FluidSubproblem"
        _check_kind("fluid", flow, OF_FLOWS, OF_SHELLS, wanted)
    if not isinstance(shell, ShellSubproblem):
        _check_kind("shell", shell, OF_SHELLS, OF_FLOWS, "a shell, such as shnapr's Shell, or ShellSubproblem")
    time = flow.timeInt if isinstance(flow, FluidSubproblem) else flow_time(flow)
    spline, domain = shell.spline, time.x.function_space.mesh
    if domain.geometry.dim != spline.nsd:
        raise ValueError(
            f"the shell lives in {spline.nsd} dimensions, the fluid in {domain.geometry.dim}: they must be equal"
        )
    if spline.mesh.comm.size > 1:
        raise ValueError(
            "the shell's spline is distributed: comm=MPI.COMM_SELF is required, every rank holds the whole"
        )
    _check_partners(flow, shell, time)
    if not isinstance(shell, ShellSubproblem):
        shell.bind(time.step_size, time.scheme, time.time)
    return fluid_side(flow), shell_side(shell)


def flow_time(flow: ImmersedFlow) -> TimeIntegrator:
    """The integrator of a flow in which a surface may be immersed.

    Args:
        flow: the flow.

    Raises:
        ValueError: it is steady, has no surface in its equations, or does not tell what belongs to them.
    """
    time = flow.time
    if time is None:
        raise ValueError("fluid is a steady flow (dt = None): one that advances in time is required")
    if not isinstance(time, Demanding):
        raise ValueError("fluid.time tells no needs of the flow: give its residual to a FluidSubproblem instead")
    if time.needs.scales is None and time.needs.sides is None:
        raise ValueError("fluid was made without a surface in its equations: Flow(..., immersed=True) is required")
    return time


def fluid_side(flow: FluidSubproblem | ImmersedFlow, *, mesh_size: float | None = None) -> FluidSubproblem:
    """A flow as the fluid's side of the coupling (collective).

    Args:
        flow: a :class:`FluidSubproblem`, or a flow.
        mesh_size: see :class:`FluidSubproblem`.

    Raises:
        ValueError: nothing can be immersed in it.
    """
    if isinstance(flow, FluidSubproblem):
        return flow
    time = flow_time(flow)
    domain, needs = time.x.function_space.mesh, cast(Demanding, time).needs
    kind: Any = FluidSubproblem
    if needs.sides is not None:
        from coudalfish.sides.sided_fluid import SidedFluid  # other flows need nothing of it

        kind = partial(SidedFluid, sides=needs.sides)
    made: FluidSubproblem = kind(
        domain,
        flow.residual,
        time,
        bcs=flow.bcs,
        band=None if needs.scales is None else SurfaceBand(domain, needs.scales),
        moving=needs.moving,
        solver=needs.solver,
        tangent=flow.tangent,
        updates=needs.updates,
        before=needs.before,
        rank_one=needs.rank_one,
        density=float(needs.rho.value),
        viscosity=float(needs.mu.value),
        mesh_size=mesh_size,
    )
    return made


def shell_side(shell: ShellSubproblem | ImmersedShell) -> ShellSubproblem:
    """A shell that has a clock as the shell's side of the coupling.

    Args:
        shell: a :class:`ShellSubproblem`, or a shell.

    Raises:
        ValueError: it has no clock.
    """
    if isinstance(shell, ShellSubproblem):
        return shell
    if shell.time is None:
        raise ValueError("shell.time = None: a shell with a clock is required, which shell.bind(dt, scheme) gives it")
    return ShellSubproblem(
        shell.spline,
        shell.residual,
        shell.time,
        solver=shell.solver,
        tangent=shell.tangent,
        updates=shell.updates,
        contact=shell.contact,
    )


def _check_partners(flow: Any, shell: Any, time: TimeIntegrator) -> None:
    """Refuse flows and shells that are coupled with others: two couplers would move one clock."""
    own = shell.timeInt if isinstance(shell, ShellSubproblem) else shell.time
    if not isinstance(flow, FluidSubproblem) and time.partner not in (None, own):
        raise ValueError(
            "fluid is coupled with another shell: make it anew; several shells in one flow are patches of one geometry,"
            " as tigar_x.geometry.multipatch.disjoint(*patches)"
        )
    if not isinstance(shell, ShellSubproblem) and own is not None and own.partner not in (None, time):
        raise ValueError("shell is coupled with another flow: make it anew")


def _check_kind(name: str, given: Any, names: Sequence[str], others: Sequence[str], wanted: str) -> None:
    """Refuse what lacks one of the names, with a word for what changed places."""
    if all(_has(given, each) for each in names):
        return
    swapped = isinstance(given, FluidSubproblem | ShellSubproblem) or all(_has(given, each) for each in others)
    hint = "; CouDALFISh(fluid, shell) is the order of its arguments" if swapped else ""
    raise ValueError(f"{name} = {given!r}: {wanted} is required{hint}")


def _has(given: Any, name: str) -> bool:
    """Whether there is an attribute, without asking for its value: a form may be expensive."""
    return hasattr(type(given), name) or name in getattr(given, "__dict__", ())
