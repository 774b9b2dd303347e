"""What a flow keeps beside its residual: solids in it, pressures of outlets, the pressure's constant.

Whoever steps the flow in its place has to take this over; :class:`FlowTime` has it at hand.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import ufl
from mpi4py import MPI
from dolfinx import fem

from tigar_x import checks, compat
from tigar_x.compat import FloatArray
from tigar_x.fem.linear import LinearSolver
from tigar_x.fem.time_integration import TimeIntegrator
from varmint.conditions import Resistance
from varmint.forms import ale
from varmint.forms.motion import ElasticMotion, PrescribedMotion
from varmint.forms.solids import Solid, solid_residual
from varmint.forms.space import split

if TYPE_CHECKING:
    from varmint.flow.flow import Flow

NEAR = 1e-9
"""Relative to the size of the mesh, by how much a vertex may be farther than the nearest and count as nearest."""


ROUNDED = 0.1
"""Displacement by length of a cell of which ``ROUNDING`` times is lost in a deformation gradient, see
:mod:`tigar_x.fem.rounding`."""


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

        cells, sizes = mesh.cells(*solid.groups), np.zeros(len(in_fluid))
        lengths = compat.shortest_edges(mesh.domain)[cells, None]
        np.maximum.at(sizes, compat.cell_dofs(flow.V)[cells], lengths)
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
        groups: facet groups.
        pressure: Constant, in the residual: after a step the pressure in its equations, at their level of time.
        load: linear form, derivative of the residual by the pressure.
        slope: linear form, derivative of the pressure by the unknown.
    """

    def __init__(self, condition: Resistance, flow: "Flow") -> None:
        f = flow.fields
        domain, motion, ds = f.mesh.domain, f.motion, f.ds(condition.groups)
        n = ale.normal(domain, motion)
        self._condition, self.groups = condition, condition.groups
        self.pressure = compat.Constant(domain, float(condition.pressure))
        self._rate = ale.per_area(ufl.dot(f.v, n), domain, motion) * ds
        self._compiled: Any = None
        level = 1.0 if flow.time is None else flow.time.x_factor
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


@dataclass(frozen=True)
class Needs:
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
    """

    updates: tuple[Callable[[float], None], ...]
    before: tuple[Callable[[], None], ...]
    rank_one: tuple[OutletPressure, ...]
    bcs: tuple[Any, ...]
    moving: PrescribedMotion | ElasticMotion | None
    solver: LinearSolver | None
    is_closed: bool
    rho: fem.Constant
    mu: fem.Constant


class FlowTime(TimeIntegrator):
    """Integrator of a flow, which tells whoever steps the flow what it needs.

    Attributes:
        needs: see there.
    """

    needs: Needs


def pressure_pin(flow: "Flow") -> Any:
    """Strong condition p = 0 at the vertex of the fluid next to ``pin_at``, or else to its centroid (collective).

    It depends on the mesh alone, not on its partition: of several vertices that are as near it is the one with the
    smallest coordinates, the first one first. A vertex that alone is nearest to the centroid turns with the mesh. Of
    several, as in a box with odd numbers of cells, no rule can choose one that does: the box is the same after a turn
    that exchanges them.

    Args:
        flow: the flow.

    Returns:
        A dolfinx boundary condition.
    """
    V, domain, at = flow.V, flow.mesh.domain, flow.options.pin_at
    d, comm, owned = domain.geometry.dim, domain.comm, compat.owned_cells(domain)
    cells = flow.mesh.cells(*flow.fluid_cells) if flow.fluid_cells else np.arange(owned)
    corners = compat.cell_vertices(domain)[cells[cells < owned]]
    target = _centroid(comm, corners) if at is None else checks.array("pin_at", at, (d,))
    vertices = corners.reshape(-1, d)
    ends = np.array(comm.allgather((vertices.min(axis=0, initial=np.inf), vertices.max(axis=0, initial=-np.inf))))
    near = NEAR * float((ends[:, 1].max(axis=0) - ends[:, 0].min(axis=0)).max())
    distance = np.linalg.norm(vertices - target, axis=1)
    least = comm.allreduce(float(distance.min(initial=np.inf)), op=MPI.MIN)
    found = comm.allgather(min(map(tuple, vertices[distance <= least + near].tolist()), default=None))
    place = np.array(min(vertex for vertex in found if vertex is not None))
    return compat.pin_component(V, d, lambda x: np.linalg.norm(x[:d].T - place, axis=1) < near)


def _centroid(comm: MPI.Comm, corners: FloatArray) -> FloatArray:
    """Centroid of cells with vertices of shape (cells, vertices, d), by their midpoints and sizes there (collective).

    Neither depends on the numbering of vertices.
    """
    count, d = corners.shape[1:]
    if count == d + 1:
        jacobians = corners[:, 1:] - corners[:, :1]
    else:
        signs = (np.arange(count)[:, None] >> np.arange(d) & 1) - 0.5
        jacobians = np.einsum("vj,cvi->cji", signs, corners)
    sizes = np.abs(np.linalg.det(jacobians))
    moments = np.append(sizes @ corners.mean(axis=1), sizes.sum())
    total = np.sum(comm.allgather(moments), axis=0)
    return np.asarray(total[:-1] / total[-1])
