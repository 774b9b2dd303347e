"""What a flow is made of before it has terms: its unknown, its clock, and the fields that terms are built of."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import ufl
from dolfinx import fem

from tigar_x import compat
from tigar_x.compat import IntArray
from tigar_x.fem.schemes import Scheme
from varmint.conditions import FlowFields
from varmint.flow.clock import FlowTime
from varmint.flow.options import FlowOptions
from varmint.forms.motion import ElasticMotion, PrescribedMotion
from varmint.forms.solids import Solid
from varmint.forms.space import equal_order_space, split
from varmint.mesh.named import NamedMesh


@dataclass(frozen=True, eq=False)
class FlowState:
    """Velocity and pressure of a flow and all that its terms are built of.

    Attributes:
        degree: polynomial degree k of velocity and pressure.
        V: space of velocity and pressure.
        w: velocity and pressure at the end of the step.
        time: integrator; None: steady flow.
        rate: time derivative of the velocity at the level of the equations, UFL; None: steady flow.
        fields: what conditions see, the mesh among it.
        moving: motion of the mesh; None: it is fixed.
        fluid_cells: cell groups of the fluid; none: all cells.
    """

    degree: int
    V: fem.FunctionSpace
    w: fem.Function
    time: FlowTime | None
    rate: Any
    fields: FlowFields
    moving: PrescribedMotion | ElasticMotion | None
    fluid_cells: tuple[str, ...]

    @property
    def outline(self) -> str:
        """Its sizes and its time in a few words."""
        when = "steady" if self.time is None else f"t = {self.time.time:g}, dt = {self.time.step_size:g}"
        return f"{compat.unknowns(self.V)} unknowns of degree {self.degree} in {self.fields.d}D, {when}"

    @property
    def mesh(self) -> NamedMesh:
        """Mesh with named groups."""
        return self.fields.mesh

    @property
    def fluid_cell_numbers(self) -> IntArray:
        """Local numbers of the fluid's cells, ghosts as well."""
        if self.fluid_cells:
            return self.mesh.cells(*self.fluid_cells)
        return np.arange(len(compat.cell_nodes(self.mesh.domain)), dtype=np.int32)

    @property
    def dx(self) -> ufl.Measure:
        """Measure of the fluid."""
        return self.mesh.dx(*self.fluid_cells, degree=self.fields.degree)

    @classmethod
    def at_rest(
        cls,
        mesh: NamedMesh,
        rho: Any,
        mu: Any,
        *,
        degree: int,
        dt: float | None,
        scheme: Scheme,
        moving: PrescribedMotion | ElasticMotion | None,
        solid: Solid | None,
        is_sided: bool,
        options: FlowOptions,
    ) -> "FlowState":
        """State of a flow at rest at time zero; arguments as in :class:`varmint.flow.flow.Flow`."""
        domain = mesh.domain
        density, viscosity = (
            value if isinstance(value, fem.Constant) else compat.Constant(domain, float(value)) for value in (rho, mu)
        )
        V = equal_order_space(domain, degree)
        w = fem.Function(V, name="w")
        motion = None if moving is None else moving.motion
        extra = 0 if motion is None else 2 * (motion.degree - 1)
        quadrature = 2 * degree + extra if options.quadrature_degree is None else options.quadrature_degree
        time = None if dt is None else _integrator(w, dt, scheme, options, quadrature, is_sided)
        if time is None:
            level, rate, t = w, None, compat.Constant(domain, 0.0)
        else:
            level, rate, t = time.x_alpha, split(time.xdot_alpha)[0], time.t
        t_alpha, end = t if time is None else time.t_alpha, None if moving is None else moving.end
        fields = FlowFields(
            mesh, *split(level), *split(ufl.TestFunction(V)), density, viscosity, t, t_alpha, motion, end,
            options.invariant_metric, quadrature,
        )  # fmt: skip
        fluid = () if solid is None else tuple(name for name in mesh.cell_names if name not in solid.groups)
        return cls(degree, V, w, time, rate, fields, moving, fluid)


def _integrator(
    w: fem.Function, dt: float, scheme: Scheme, options: FlowOptions, quadrature: int, is_sided: bool
) -> FlowTime:
    """The integrator; a flow imports those of its own kind alone."""
    kind: Any = FlowTime
    given: dict[str, Any] = {"algebraic": (w.ufl_shape[0] - 1,)}
    if options.subscales == "dynamic":
        from varmint.flow.subscales import DynamicTime

        kind, given = DynamicTime, {"degree": quadrature}
    if is_sided:
        from varmint.flow.sided_time import SidedTime

        kind = SidedTime if kind is FlowTime else type("SidedDynamicTime", (SidedTime, kind), {})
    time: FlowTime = kind(w, dt, scheme, **given)
    return time
