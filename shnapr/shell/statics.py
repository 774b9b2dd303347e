"""Equilibrium of a shell along its load."""

import math
from collections.abc import Callable, Sequence
from typing import Any

from mpi4py import MPI

from shnapr.shell.options import ShellOptions, newton_options
from tigar_x import checks
from tigar_x.fem.load_stepping import LoadReport, StepControl, follow_load
from tigar_x.fem.newton import newton
from tigar_x.fem.time_integration import LoadStepper
from tigar_x.ranks import agreed
from tigar_x.splines.spline_system import SplineSystem


class Statics:
    """Moves the load factor of a static shell, and its displacement with it.

    Args:
        system: the shell; its unknown is that of the factor.
        factor: load factor of the present state.
        updates: called with the load factor before every attempt.
        options: of Newton's method.
        copies: ranks that hold the same shell.
        after: called after every solve, with the state that it has found; None: nothing is.
    """

    def __init__(
        self,
        system: SplineSystem,
        factor: LoadStepper,
        options: ShellOptions,
        updates: Sequence[Callable[[float], None]],
        copies: MPI.Comm,
        after: Callable[[], None] | None,
    ) -> None:
        self._system, self._factor, self._options = system, factor, options
        self._updates, self._copies, self._after = updates, copies, after
        self._y = factor.x.x.array

    @property
    def reached(self) -> float:
        """Load factor of the present state."""
        return self._factor.time

    def solve(
        self,
        until: float,
        *,
        step: float | None,
        control: StepControl | None,
        extrapolate: bool,
        each: Callable[[float], None] | None,
    ) -> LoadReport:
        """Equilibrium at a load factor, see :meth:`shnapr.shell.Shell.solve`.

        Args:
            until: load factor.
            step: first step; None: all that is left.
            control: when steps are cut and grown; None: down to a thousandth of the first one, and never beyond it.
            extrapolate: whether steps start from the last increment in proportion.
            each: called with the load factor after every step; None: nothing is.

        Raises:
            SolveError: the load was not reached.
        """
        factor = self._factor
        chosen = newton_options(self._options, self._system) | {"reference": self._full_load()}

        def found(t: float) -> None:
            if self._after is not None:
                self._after()
            if each is not None:
                each(t)

        if checks.finite("until", until) <= factor.time:
            return self._again(until, found, chosen)
        if step is None and not factor.time:
            step = until
        first = factor.step_size = factor.step_size if step is None else step
        control = StepControl(smallest=1e-3 * first, largest=first) if control is None else control
        return follow_load(
            self._system, factor, until=until, control=control, updates=self._updates, each=found,
            extrapolate=extrapolate, comm=self._copies, **chosen,
        )  # fmt: skip

    def solve_linear(self) -> None:
        """See :meth:`shnapr.shell.Shell.solve_linear`.

        Raises:
            SolveError: the linear solver failed.
        """
        state = self._y.copy()
        self._load(1.0)
        self._y[:] = 0.0
        try:
            agreed(self._copies, self._increment, self._y)
        except BaseException:
            self._y[:] = state
            self._load(self._factor.time)
            raise
        self._factor.resume(1.0)
        if self._after is not None:
            self._after()

    def _increment(self) -> None:
        self._system.assemble_residual()
        self._system.assemble_tangent()
        self._system.subtract(self._system.solve())

    def _load(self, factor: float) -> None:
        self._factor.t.value = factor
        for update in self._updates:
            update(factor)

    def _full_load(self) -> float | None:
        """Norm of the residual of the undeformed shell under the full load; None where there is none."""
        state = self._y.copy()
        self._y[:] = 0.0
        self._load(1.0)
        try:
            norm = self._system.assemble_residual()
        finally:
            self._y[:] = state
            self._load(self._factor.time)
        return norm if math.isfinite(norm) and norm > 0.0 else None

    def _again(self, until: float, found: Callable[[float], None], chosen: dict[str, Any]) -> LoadReport:
        """Equilibrium at a load that is not above the present one, in one step."""
        state = self._y.copy()
        self._load(until)
        try:
            done = agreed(self._copies, lambda: newton(self._system, **chosen), self._y)
        except BaseException:
            self._y[:] = state
            self._load(self._factor.time)
            raise
        self._factor.resume(until)
        found(until)
        return LoadReport((until,), (len(done.step_lengths),), (0,))
