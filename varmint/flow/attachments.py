"""What a flow keeps beside its residual: solids in it, pressures of outlets.

Whoever steps the flow in its place has to take this over; :class:`varmint.flow.clock.FlowNeeds` has it at hand.
"""

from typing import Any

import numpy as np
import ufl
from dolfinx import fem

from tigar_x import compat
from tigar_x.compat import FloatArray
from varmint.conditions import Resistance
from varmint.flow.state import FlowState
from varmint.forms import ale
from varmint.forms.motion import ElasticMotion
from varmint.forms.solids import Solid, solid_residual
from varmint.forms.space import split

ROUNDED = 0.1
"""Displacement by length of a cell of which ``ROUNDING`` times is lost in a deformation gradient, see
:mod:`tigar_x.fem.rounding`."""


class SolidInFlow:
    """A solid that shares nodes and velocities with the fluid around it.

    Its displacement follows from its velocity by the scheme of the mesh, ``x = x(x')``, so that the flow's unknowns are
    those of the solid as well; pressures strictly inside are held at zero.

    Args:
        solid: the solid.
        state: of the flow.
        moving: motion of the mesh around it.
        f: body force per mass; None: none.

    Attributes:
        residual: of the solid.
        condition: strong condition on the pressures inside.

    Raises:
        ValueError: mesh and flow differ in degree, or the mesh's motion covers other cells than the fluid.
    """

    def __init__(self, solid: Solid, state: FlowState, moving: ElasticMotion, f: Any) -> None:
        mesh, time, fluid = state.mesh, moving.time, state.fluid_cells
        mesh.cells(*solid.groups)
        if moving.degree != state.degree:
            raise ValueError(f"degree = {state.degree}: that of the moving mesh, {moving.degree}, is required")
        if set(moving.cells) != set(fluid):
            raise ValueError(f"moving.cells = {moving.cells!r}: {fluid!r} is required, the cells of the fluid")
        self._moving, self._w = moving, state.w
        velocity, _ = split(state.w)
        displacement = time.at_level(time.x_from_rate(velocity))
        dx = mesh.dx(*solid.groups, degree=2 * state.degree)
        self.residual = solid_residual(solid.material, displacement, state.rate, state.fields.w, dx, f=f)

        d = mesh.domain.geometry.dim
        in_fluid = _touched(state.V, mesh.cells(*fluid), d + 1)
        nodes = np.flatnonzero(~in_fluid)
        self.condition = compat.fixed_component(state.V, d, nodes * (d + 1) + d)
        # nodes of the solid in the two spaces, whose nodes may be numbered differently
        own, other = compat.cell_dofs(time.x.function_space), compat.cell_dofs(state.V)
        flow_node = np.empty(own.max(initial=-1) + 1, dtype=np.int64)
        flow_node[own] = other
        self._to = d * moving.solid_nodes[:, None] + np.arange(d)
        self._from = (d + 1) * flow_node[moving.solid_nodes][:, None] + np.arange(d)

        cells, sizes = mesh.cells(*solid.groups), np.zeros(len(in_fluid))
        lengths = compat.shortest_edges(mesh.domain)[cells, None]
        np.maximum.at(sizes, compat.cell_dofs(state.V)[cells], lengths)
        self._lengths = np.repeat(sizes[:, None], d + 1, axis=1) * (np.arange(d + 1) < d)

    def resolution(self) -> FloatArray:
        """What rounds off in a strain, ``F = 1 + grad u``, as velocities that lead there, shape (dofs of the flow,)."""
        time = self._moving.time
        return ROUNDED * self._lengths.ravel() * time.scheme.a0 / (time.x_factor * time.step_size)

    def displacement(self) -> FloatArray:
        """Displacement of the solid's nodes that belongs to the present velocity, shape (nodes, d)."""
        return self._moving.time.x_from_rate_array(self._w.x.array[self._from], self._to)

    def move_mesh(self) -> None:
        """Put the mesh where the solid is, and the nodes of the fluid after it.

        Raises:
            SolveError: the nodes found no balance.
        """
        self._moving.time.x.x.array[self._to] = self.displacement()
        self._moving.relax()


def _touched(V: fem.FunctionSpace, cells: Any, size: int) -> Any:
    """Which local nodes belong to cells, of any rank (collective)."""
    marker = fem.Function(V)
    nodes = np.unique(compat.cell_dofs(V)[cells])
    marker.x.array[size * nodes] = 1.0
    compat.accumulate(marker)
    return marker.x.array[::size] > 0.5


class OutletPressure:
    """Pressure of an outlet with a resistance, see :class:`varmint.conditions.Resistance`.

    Args:
        condition: the condition.
        state: of the flow.

    Attributes:
        groups: facet groups.
        pressure: Constant, in the residual: after a step the pressure in its equations, at their level of time.
        load: linear form, derivative of the residual by the pressure.
        slope: linear form, derivative of the pressure by the unknown.
    """

    def __init__(self, condition: Resistance, state: FlowState) -> None:
        f = state.fields
        domain, motion, ds = f.mesh.domain, f.motion, f.ds(condition.groups)
        n = ale.normal(domain, motion)
        self._condition, self.groups = condition, condition.groups
        self.pressure = compat.Constant(domain, float(condition.pressure))
        self._rate = ale.per_area(ufl.dot(f.v, n), domain, motion) * ds
        self._compiled: Any = None
        level = 1.0 if state.time is None else state.time.x_factor
        self.load = ale.per_area(ufl.dot(f.w, n), domain, motion) * ds
        self.slope = compat.Constant(domain, condition.resistance * level) * self.load

    def flow_rate(self) -> float:
        """Flow rate at the present state, in a step that of its equations (collective); unit: volume/time."""
        if self._compiled is None:
            (self._compiled,) = compat.compile_forms(self._rate)
        return compat.assemble_scalar(self._compiled)

    def update(self) -> None:
        """Bring the pressure to the present flow rate (collective)."""
        self.pressure.value = self._condition.pressure + self._condition.resistance * self.flow_rate()
