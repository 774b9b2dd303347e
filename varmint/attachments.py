"""What a flow keeps beside its residual: solids in it, pressures of outlets, the pressure's constant.

Whoever steps the flow in its place has to take this over; :class:`FlowTime` has it at hand.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import ufl
from dolfinx import fem

from tigar_x import checks, compat
from tigar_x.compat import FloatArray
from tigar_x.linear import LinearSolver
from tigar_x.time_integration import TimeIntegrator
from varmint import ale
from varmint.conditions import Resistance
from varmint.motion import ElasticMotion, PrescribedMotion
from varmint.solids import Solid, solid_residual
from varmint.space import split

if TYPE_CHECKING:
    from varmint.flow import Flow


ROUNDED = 0.1
"""Displacement by length of a cell of which ``tigar_x.rounding.ROUNDING`` times is lost in a deformation gradient."""


class SolidInFlow:
    """A solid that shares nodes and velocities with the fluid around it.

    Its displacement follows from its velocity by the scheme of the mesh, ``x = x(x')``, so that the flow's unknowns are
    those of the solid as well; pressures strictly inside are held at zero.

    Args:
        solid: the solid.
        flow: the flow.
        moving: motion of the mesh around it.
        f: body force per mass; None: none.

    Attributes:
        fluid: cell groups of the fluid.
        residual: of the solid.
        condition: strong condition on the pressures inside.

    Raises:
        ValueError: mesh and flow differ in degree, or the mesh's motion covers other cells than the fluid.
    """

    def __init__(self, solid: Solid, flow: "Flow", moving: ElasticMotion, f: Any) -> None:
        mesh, time = flow.mesh, moving.time
        self.fluid = tuple(name for name in mesh.cell_names if name not in solid.groups)
        mesh.cells(*solid.groups)
        if moving.degree != flow.degree:
            raise ValueError(f"degree = {flow.degree}: that of the moving mesh, {moving.degree}, is required")
        if set(moving.cells) != set(self.fluid):
            raise ValueError(f"moving.cells = {moving.cells!r}: {self.fluid!r} is required, the cells of the fluid")
        self._moving, self._w = moving, flow.w
        velocity, _ = split(flow.w)
        displacement = time.at_level(time.x_from_rate(velocity))
        flow_time = flow.time
        acceleration = split(flow_time.xdot_alpha)[0] if flow_time is not None else None
        dx = mesh.dx(*solid.groups, degree=2 * flow.degree)
        self.residual = solid_residual(solid.material, displacement, acceleration, flow.fields.w, dx, f=f)

        d = mesh.domain.geometry.dim
        in_fluid = _touched(flow.V, mesh.cells(*self.fluid), d + 1)
        nodes = np.flatnonzero(~in_fluid)
        self.condition = compat.fixed_component(flow.V, d, nodes * (d + 1) + d)
        # nodes of the solid in the two spaces, whose nodes may be numbered differently
        own, other = compat.cell_dofs(time.x.function_space), compat.cell_dofs(flow.V)
        flow_node = np.empty(own.max(initial=-1) + 1, dtype=np.int64)
        flow_node[own] = other
        self._to = d * moving.solid_nodes[:, None] + np.arange(d)
        self._from = (d + 1) * flow_node[moving.solid_nodes][:, None] + np.arange(d)

        vertices, cells = compat.cell_vertices(mesh.domain), mesh.cells(*solid.groups)
        edges = vertices[:, :, None, :] - vertices[:, None, :, :]
        lengths = np.linalg.norm(edges, axis=-1)[:, *np.triu_indices(vertices.shape[1], 1)]
        sizes = np.zeros(len(in_fluid))
        np.maximum.at(sizes, compat.cell_dofs(flow.V)[cells], lengths.min(axis=1)[cells, None])
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
        flow: the flow.

    Attributes:
        pressure: Constant, in the residual.
        load: linear form, derivative of the residual by the pressure.
        slope: linear form, derivative of the pressure by the unknown.
    """

    def __init__(self, condition: Resistance, flow: "Flow") -> None:
        f = flow.fields
        domain, motion, ds = f.mesh.domain, f.motion, f.ds(condition.groups)
        n = ale.normal(domain, motion)
        self._condition = condition
        self.pressure = fem.Constant(domain, float(condition.pressure))
        self._rate = ale.per_area(ufl.dot(f.v, n), domain, motion) * ds
        self._compiled: Any = None
        level = 1.0 if flow.time is None else flow.time.x_factor
        self.load = ale.per_area(ufl.dot(f.w, n), domain, motion) * ds
        self.slope = fem.Constant(domain, condition.resistance * level) * self.load

    def flow_rate(self) -> float:
        """Flow rate at the present state (collective); unit: volume/time."""
        if self._compiled is None:
            (self._compiled,) = compat.compile_forms(self._rate)
        return compat.assemble_scalar(self._compiled)

    def update(self) -> None:
        """Bring the pressure to the present flow rate (collective)."""
        self.pressure.value = self._condition.pressure + self._condition.resistance * self.flow_rate()


@dataclass(frozen=True)
class Needs:
    """What a flow needs of whoever steps it, beside its residual.

    Attributes:
        updates: see :class:`varmint.flow.Flow`.
        before: see there.
        rank_one: see there.
        bcs: strong conditions without the pin of the pressure.
        moving: motion of the mesh; None: it is fixed.
        solver: linear solver that was chosen for it; None: none was.
        is_closed: whether a constant of its pressure remains.
    """

    updates: tuple[Callable[[float], None], ...]
    before: tuple[Callable[[], None], ...]
    rank_one: tuple[OutletPressure, ...]
    bcs: tuple[Any, ...]
    moving: PrescribedMotion | ElasticMotion | None
    solver: LinearSolver | None
    is_closed: bool


class FlowTime(TimeIntegrator):
    """Integrator of a flow, which tells whoever steps the flow what it needs.

    Attributes:
        needs: see there.
    """

    needs: Needs


def pressure_pin(V: fem.FunctionSpace, at: Any) -> Any:
    """Strong condition p = 0 at one vertex (collective).

    Args:
        V: space of velocity and pressure.
        at: point, whose nearest vertex is taken; None: the vertex with the smallest sum of coordinates.

    Returns:
        A dolfinx boundary condition.
    """
    domain = V.mesh
    d = domain.geometry.dim
    vertices = compat.cell_vertices(domain)[: compat.owned_cells(domain)].reshape(-1, d)
    if at is None:
        distance = vertices.sum(axis=1)
    else:
        distance = np.linalg.norm(vertices - checks.array("pin_at", at, (d,)), axis=1)
    best = int(np.argmin(distance)) if len(distance) else -1
    mine = (float(distance[best]), vertices[best].tolist()) if len(distance) else (np.inf, None)
    place = np.array(min(domain.comm.allgather(mine), key=lambda entry: entry[0])[1])
    size = float(np.ptp(vertices, axis=0).max()) if len(vertices) else 1.0
    return compat.pin_component(V, d, lambda x: np.linalg.norm(x[:d].T - place, axis=1) < 1e-9 * size)
