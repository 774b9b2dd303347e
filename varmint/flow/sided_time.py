"""The clock of a flow whose fields differ on both sides of a surface."""

from typing import Any

import numpy as np
from dolfinx import fem

from varmint.flow.clock import FlowTime


class SidedTime(FlowTime):
    """Integrator of a flow with fields that differ on both sides of a surface, see :mod:`varmint.flow.sides`.

    Args:
        arguments: of the integrator that it is otherwise.

    Attributes:
        second: jump of the pressure, after the kink of the velocity, at the end of the step, of d + 1 components.
        second_old: the same at t_n.
        second_rate: its rate at t_n; that of the jump has no meaning.
        is_second: 1 where there is an unknown, 0 elsewhere, shape (local dofs,).
    """

    def __init__(self, *arguments: Any, **named: Any) -> None:
        super().__init__(*arguments, **named)
        V = self.x.function_space
        names = ("second", "second_old", "second_dot_old")
        self.second, self.second_old, self.second_rate = (fem.Function(V, name=name) for name in names)
        self.is_second = np.zeros(len(self.x.x.array))

    @property
    def unknowns(self) -> tuple[fem.Function, ...]:
        """All that a step solves for."""
        return *super().unknowns, self.second

    def predict(self) -> None:
        """As in other flows; jumps and kinks stay."""
        super().predict()
        self.second.x.array[:] = self.second_old.x.array

    def restore(self) -> None:
        """Put everything back to the last accepted state; the clock has not moved."""
        super().restore()
        self.second.x.array[:] = self.second_old.x.array

    def advance(self) -> None:
        """Accept the state and move the clock; what has become an unknown begins from zero, what is none has none."""
        s, there = self.scheme, self.is_second
        new, old, rate = (f.x.array for f in (self.second, self.second_old, self.second_rate))
        rate[:] = there * (s.a0 / self.step_size * (new - old) + s.a1 * rate)
        old[:] = new
        super().advance()
        self.forget_in(self.needs.sides.doubled.cells)  # where sub-scales follow from fields that are not those there

    def forget(self) -> None:
        """Take the present x as the state that the first step starts from, at rest before and the same on all sides."""
        super().forget()
        for function in (self.second, self.second_old, self.second_rate):
            function.x.array[:] = 0.0

    @property
    def state(self) -> dict[str, fem.Function]:
        """The last accepted state by name, jumps and kinks as well."""
        return {**super().state, "second": self.second_old, "second_rate": self.second_rate}
