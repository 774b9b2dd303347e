"""Steps of a shell through time."""

from collections.abc import Callable, Sequence
from typing import Any

from mpi4py import MPI

from shnapr.shell.options import ShellError, ShellOptions, ShellReport, newton_options
from tigar_x.fem.linear import SolveError
from tigar_x.fem.newton import newton
from tigar_x.fem.schemes import Scheme
from tigar_x.fem.time_integration import TimeIntegrator
from tigar_x.ranks import agreed
from tigar_x.splines.spline_system import SplineSystem


def shell_step(
    system: SplineSystem,
    time: TimeIntegrator,
    options: ShellOptions,
    updates: Sequence[Callable[[float], None]],
    copies: MPI.Comm,
    measure: Callable[[], Any] | None,
) -> ShellReport:
    """Advance by one time step, see :meth:`shnapr.shell.Shell.take_step`.

    Args:
        system: the shell; its unknown is that of the integrator.
        time: its integrator.
        options: of Newton's method.
        updates: called with the time of the equations first.
        copies: ranks that hold the same shell.
        measure: called with the new state before the clock moves; None: nothing is.

    Raises:
        ShellError: the step failed; the state is that before it.
    """
    t, t_alpha = float(time.t.value), float(time.t_alpha.value)
    chosen = newton_options(options, system)
    try:
        time.predict()
        for update in updates:
            update(t_alpha)
        done = agreed(copies, lambda: newton(system, **chosen), time.x.x.array)
        measured = None if measure is None else measure()
    except BaseException as error:
        time.restore()
        if not isinstance(error, SolveError):
            raise
        raise ShellError(f"the step to t = {t:.6g} (dt = {time.step_size:.3g}) failed: {error}", t) from error
    time.advance()
    return ShellReport(time.time, t_alpha, done.norms, done.tangents, measured)


def check_binding(own: TimeIntegrator, dt: float, scheme: Scheme, t: float) -> None:
    """Check that a shell's clock is that of what it is coupled with.

    Args:
        own: the shell's.
        dt: time step of the other.
        scheme: scheme that goes with the other.
        t: time of the other.

    Raises:
        ValueError: they differ.
    """
    for name, has, needs in (("dt", own.step_size, dt), ("t", own.time, t), ("scheme", own.scheme, scheme)):
        if has != needs:
            raise ValueError(
                f"{name} = {has!r}: the shell has a clock of its own, and {needs!r} is required by what it is"
                " coupled with; make it without dt and scheme, and it gets those"
            )
