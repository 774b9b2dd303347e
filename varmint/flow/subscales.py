"""Dynamic sub-scales: what the mesh does not resolve has a rate as well, and is remembered from step to step.

Source: Codina, Principe, Guasch and Badia, doi:10.1016/j.cma.2007.01.002. There ``dv'/dt + v'/tau_M = -r_M`` is solved
at every point of the quadrature; here by the time integration of the flow itself, so that its order stays.
"""

from typing import Any

from dolfinx import fem

from tigar_x import compat
from tigar_x.compat import IntArray
from tigar_x.fem.schemes import Scheme
from varmint.flow.clock import FlowTime
from varmint.forms.vms import Memory


class DynamicTime(FlowTime):
    """Integrator of a flow with dynamic sub-scales, which it advances with the flow.

    With the first-order scheme of the flow, ``v'_alpha = alpha_f v' + (1 - alpha_f) v'_n`` and alike for rates, the
    rate at the level of the equations is ``s v'_alpha - g``: s is a Constant, g follows from the last step.

    Args:
        w: velocity and pressure.
        dt: time step; unit: time.
        scheme: first-order scheme.
        degree: of the quadrature inside.

    Attributes:
        memory: s and g.
        fine: rho times the velocity of the sub-scales at t_n, all points of a cell together.
        fine_rate: its rate.
    """

    memory: Memory

    def __init__(self, w: fem.Function, dt: float, scheme: Scheme, degree: int) -> None:
        d = w.ufl_shape[0] - 1
        super().__init__(w, dt, scheme, algebraic=(d,))
        domain = w.function_space.mesh
        self._past, self._rate = compat.PointField(domain, degree, d), compat.Constant(domain, self._factor)
        self.memory = Memory(self._rate, self._past.function)
        space = compat.lagrange_space(domain, 0, d * len(self._past.points))
        self.fine, self.fine_rate = (fem.Function(space, name=name) for name in ("subscale", "subscale_rate"))
        self._rows, self._width = compat.cell_dofs(space)[:, 0], d * len(self._past.points)

    def follow(self, velocity: Any, cells: IntArray) -> None:
        """Say what the sub-scales are at the level of the equations.

        Args:
            velocity: rho times their velocity, UFL, shape (d,).
            cells: local numbers of the fluid's cells.
        """
        self._velocity, self._cells = velocity, cells
        self._values: compat.VectorAtPoints | None = None

    @property
    def _factor(self) -> float:
        return self.xdot_factor / self.x_factor

    def predict(self) -> None:
        """As in flows without sub-scales; what is known of their rate follows from the present step size."""
        super().predict()
        s, self._rate.value = self.scheme, self._factor
        kept = s.alpha_m * s.a1 + 1.0 - s.alpha_m
        past = self._factor * self.fine.x.array - kept * self.fine_rate.x.array
        self._past.assign(past.reshape(-1, self._width)[self._rows])

    def advance(self) -> None:
        """Accept the state and the sub-scales that belong to it, and move the clock."""
        if self._values is None:
            self._values = compat.VectorAtPoints(self._velocity, self._past.points, self.x.function_space.mesh)
        s, rows = self.scheme, self._rows[self._cells]
        level = self._values(self._cells)
        fine, rate = (f.x.array.reshape(-1, self._width) for f in (self.fine, self.fine_rate))
        change = (level - fine[rows]) / s.alpha_f
        fine[rows] += change
        rate[rows] = s.a0 / self.step_size * change + s.a1 * rate[rows]
        super().advance()

    def forget(self) -> None:
        """Take the present x as the state that the first step starts from, with neither rates nor sub-scales."""
        super().forget()
        for function in (self.fine, self.fine_rate):
            function.x.array[:] = 0.0

    def forget_in(self, cells: Any) -> None:
        """Leave nothing of the sub-scales of some cells, a mask of shape (cells,)."""
        for function in (self.fine, self.fine_rate):
            function.x.array.reshape(-1, self._width)[self._rows[cells]] = 0.0

    @property
    def state(self) -> dict[str, fem.Function]:
        """The last accepted state by name, that of the sub-scales as well."""
        return {**super().state, "subscale": self.fine, "subscale_rate": self.fine_rate}
