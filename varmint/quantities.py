"""Quantities derived from a flow: forces, flow rates, energies, values at points, wall shear stress, vorticity.

Functionals are UFL forms of the state at the end of a step; :class:`Measured` compiles some of them once and evaluates
them as often as is wanted. Forces come from the equations themselves: the residual of the fluid tested with a unit
velocity on the boundary, which converges faster than the integral of stresses (John and Matthies,
doi:10.1002/fld.195, for the benchmark of a cylinder in a channel).
"""

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
import ufl
from mpi4py import MPI
from dolfinx import fem
from petsc4py import PETSc

from tigar_x import checks, compat
from tigar_x.compat import FloatArray
from varmint.flow.attachments import OutletPressure
from varmint.flow.flow import Flow
from varmint.forms import ale
from varmint.forms.space import split


def _velocity(flow: Flow) -> Any:
    return split(_flow(flow).w)[0]


def _flow(flow: Any) -> Flow:
    """The argument, if it is a flow, else ValueError."""
    checked: Flow = checks.kind("flow", flow, Flow, "a Flow")
    return checked


def _sided(flow: Flow, form: ufl.Form) -> ufl.Form:
    """A form of the flow's fields, side by side where these differ on both sides of a surface."""
    return form if flow.sides is None else flow.sides.side_by_side(form)


def _in_fluid(flow: Flow, integrand: Any) -> ufl.Form:
    dx = flow.mesh.dx(*_flow(flow).fluid_cells, degree=flow.fields.degree + 1)
    return _sided(flow, ale.per_volume(integrand, flow.fields.motion_end) * dx)


def flow_rate(flow: Flow, *names: str) -> ufl.Form:
    """``int v . n`` over facet groups, positive outwards; unit: volume/time.

    Args:
        flow: the flow.
        names: facet groups.
    """
    domain, motion = _flow(flow).mesh.domain, flow.fields.motion_end
    flux = ufl.dot(_velocity(flow), ale.normal(domain, motion))
    return _sided(flow, ale.per_area(flux, domain, motion) * flow.mesh.ds(*names, degree=flow.fields.degree))


def outlet(flow: Flow, name: str) -> OutletPressure:
    """Outlet with a resistance: ``float(outlet.pressure.value)`` and ``outlet.flow_rate()``.

    Args:
        flow: the flow.
        name: facet group of the outlet.

    Raises:
        ValueError: there is no such outlet.
    """
    outlets = {group: one for one in _flow(flow).rank_one for group in one.groups}
    return outlets[checks.choice("name", name, tuple(outlets))]


def area(flow: Flow, *names: str) -> ufl.Form:
    """Present area of facet groups.

    Args:
        flow: the flow.
        names: facet groups.
    """
    domain = _flow(flow).mesh.domain
    one = compat.Constant(domain, 1.0)
    return ale.per_area(one, domain, flow.fields.motion_end) * flow.mesh.ds(*names, degree=flow.fields.degree)


def volume(flow: Flow) -> ufl.Form:
    """Present volume of the fluid.

    Args:
        flow: the flow.
    """
    return _in_fluid(flow, compat.Constant(_flow(flow).mesh.domain, 1.0))


def kinetic_energy(flow: Flow) -> ufl.Form:
    """``int rho/2 |v|^2``; unit: energy.

    Args:
        flow: the flow.
    """
    v = _velocity(flow)
    return _in_fluid(flow, flow.rho / 2 * ufl.dot(v, v))


def dissipation(flow: Flow) -> ufl.Form:
    """Power that the resolved flow loses to viscosity, ``int 2 mu |sym(grad v)|^2``; unit: energy/time.

    Args:
        flow: the flow.
    """
    strain = ufl.sym(ale.gradient(_velocity(flow), flow.fields.motion_end))
    return _in_fluid(flow, 2 * flow.mu * ufl.inner(strain, strain))


def squared_divergence(flow: Flow) -> ufl.Form:
    """``int (div v)^2``, the square of the norm of what is left of the divergence.

    Args:
        flow: the flow.
    """
    return _in_fluid(flow, ale.divergence(_velocity(flow), flow.fields.motion_end) ** 2)


class Measured:
    """Functionals, compiled once.

    Args:
        forms: functionals by name.
    """

    def __init__(self, **forms: ufl.Form) -> None:
        self._forms = dict(zip(forms, compat.compile_forms(*forms.values()), strict=True))

    def __call__(self) -> dict[str, float]:
        """Present values by name (collective)."""
        return {name: compat.assemble_scalar(form) for name, form in self._forms.items()}


class BoundaryForce:
    """Force of the fluid on facet groups, from the fluid's residual at the level of the equations.

    Where a group ends at another one with values at the nodes, the nodes that both share carry a part of the other's
    force as well, a difference of first order; on bodies by themselves, and beside other conditions, there is none.

    In a step the equations hold at the time t_alpha of the report, and only until the clocks move: the force of an
    unsteady flow is asked for as ``measure`` of :meth:`varmint.Flow.take_step` or of a coupled step. In the latter
    the nodes of the facets carry what an immersed surface gives to them as well, unless fields differ on its sides.

    Args:
        flow: the flow.
        names: facet groups, of the boundary or between fluid and solid; a weak condition on them must be on no other.

    Raises:
        ValueError: no such group, or a condition that reaches beyond the groups.
    """

    def __init__(self, flow: Flow, *names: str) -> None:
        self._d = _flow(flow).mesh.domain.geometry.dim
        terms = []
        for groups, form in flow.terms:
            inside = [name in names for name in groups]
            if any(inside) and not all(inside):
                raise ValueError(
                    f"names = {names!r}: one shares a condition with {groups!r}; conditions of their own are required"
                )
            if not any(inside) and groups != ("solid",):
                terms.append(form)
        rest = sum(terms[1:], terms[0])
        self._sided = None if flow.sides is None else flow.sides.rows(rest, names)
        if self._sided is None:
            (self._form,) = compat.compile_forms(rest)
            self._b = compat.create_vector(flow.V)
            compat.freed_with(self, self._b)
        nodes = compat.nodes_on_facets(flow.V, flow.mesh.facets(*names))
        self._nodes = nodes[nodes < flow.V.dofmap.index_map.size_local]
        self._comm, self._time = flow.mesh.domain.comm, flow.time

    def __call__(self) -> FloatArray:
        """Force of the fluid on the facets (collective), shape (d,); per unit depth in the plane.

        Raises:
            RuntimeError: an unsteady flow is between steps, where no equations hold.
        """
        if self._time is not None and not self._time.in_step:
            raise RuntimeError(
                f"the force is asked for between steps, at t = {self._time.time:.6g}: it follows from the equations of"
                " a step; give it to the step as measure=, and find it in report.measured"
            )
        rows = (self._plain_rows() if self._sided is None else self._sided())[self._nodes]
        return -np.asarray(self._comm.allreduce(rows.sum(axis=0), op=MPI.SUM))

    def _plain_rows(self) -> FloatArray:
        """Rows of the momentum at the nodes of this rank (collective), shape (nodes, d)."""
        compat.assemble_vector(self._b, self._form)
        self._b.ghostUpdate(PETSc.InsertMode.ADD, PETSc.ScatterMode.REVERSE)
        return np.asarray(self._b.array_r.reshape(-1, self._d + 1)[:, : self._d])


class PointValues:
    """Velocity and pressure at points of the mesh at rest.

    Args:
        flow: the flow.
        points: shape (n, d).
        side: where fields differ on both sides of a surface, the side in cells that it divides: -1, to which the
            shell's normals point, or 1; None: that on which a point lies.

    Raises:
        ValueError: a point lies in no cell, or a side is asked for where nothing differs.
    """

    def __init__(
        self, flow: Flow, points: Sequence[Sequence[float]] | FloatArray, *, side: Literal[-1, 1] | None = None
    ) -> None:
        d = _flow(flow).mesh.domain.geometry.dim
        if side is not None and flow.sides is None:
            raise ValueError(f"side = {side}: a flow with sides is required, Flow(..., immersed='jump and kink')")
        self._side = None if side is None else checks.choice("side", side, (-1, 1))
        self._function, self._sides, self._comm = flow.w, flow.sides, flow.mesh.domain.comm
        self.points = checks.array("points", points, (None, d))
        cells = compat.cells_of_points(flow.mesh.domain, self.points)
        owners = np.array(self._comm.allgather(cells)) >= 0
        lost = ~owners.any(axis=0)
        if lost.any():
            raise ValueError(
                f"points[{int(lost.argmax())}] = {self.points[lost.argmax()].tolist()}: a point of the mesh is required"
            )
        self._mine = owners.argmax(axis=0) == self._comm.rank
        self._cells = cells[self._mine]

    def __call__(self) -> FloatArray:
        """Values (collective), shape (n, d + 1): velocity, then pressure."""
        values = np.zeros((len(self.points), self.points.shape[1] + 1))
        points, sides = self.points[self._mine], self._sides
        if sides is not None:
            at = self._cells, sides.barycentric(self._cells, points)
            values[self._mine] = sides.at(*at, self._side)
        elif self._mine.any():
            x = np.pad(points, ((0, 0), (0, 3 - points.shape[1])))
            values[self._mine] = self._function.eval(x, self._cells).reshape(len(x), -1)
        return np.asarray(self._comm.allreduce(values, op=MPI.SUM))


class NodeValues:
    """Values of a function at its nodes that are nearest to points, on the mesh at rest.

    Of nodes that are equally near the one with the largest coordinates counts, whatever the ranks.

    Args:
        function: in a scalar or blocked Lagrange space.
        points: shape (n, d).
    """

    def __init__(self, function: fem.Function, points: Sequence[Sequence[float]] | FloatArray) -> None:
        V = self._V = function.function_space
        self._function, self._comm = function, V.mesh.comm
        wanted = checks.array("points", points, (None, V.mesh.geometry.dim))
        x = V.tabulate_dof_coordinates()[: V.dofmap.index_map.size_local, : wanted.shape[1]]
        every = self._comm.allgather(np.array([_nearest(x, point) for point in wanted]))
        owners = [min(range(len(every)), key=lambda rank: tuple(every[rank][i][1:])) for i in range(len(wanted))]
        self._mine = np.array(owners, dtype=int) == self._comm.rank
        self._nodes = every[self._comm.rank][self._mine, 0].astype(int)

    def __call__(self) -> FloatArray:
        """Values (collective), shape (n, components)."""
        size = self._V.dofmap.index_map_bs
        values = np.zeros((len(self._mine), size))
        values[self._mine] = self._function.x.array.reshape(-1, size)[self._nodes]
        return np.asarray(self._comm.allreduce(values, op=MPI.SUM))


def _nearest(x: FloatArray, point: FloatArray) -> FloatArray:
    """Number of the node nearest to a point, its distance and its coordinates with opposite signs; infinite if none."""
    away = np.linalg.norm(x - point, axis=1)
    least = away.min(initial=np.inf)
    near = np.flatnonzero(away <= least * (1.0 + 1e-9) + 1e-12)
    if not len(near):
        return np.full(2 + len(point), np.inf)
    node = max(near, key=lambda i: tuple(np.round(x[i], 9)))
    return np.array([node, round(float(least), 9), *-np.round(x[node], 9)])


class NodalField:
    """An expression as a continuous linear field, by lumped projection.

    Args:
        flow: the flow.
        name: of the field.
        expression: UFL scalar or vector; near a surface with fields that differ on both sides a mean of both.
        measure: what it is averaged over around every vertex; vertices that it does not reach are zero.
        weight: factor of the measure, such as J on a moving mesh.

    Attributes:
        field: the function.

    Raises:
        ValueError: the measure is not one of the mesh's cells or boundary.
    """

    def __init__(self, flow: Flow, name: str, expression: Any, measure: ufl.Measure, weight: Any = 1.0) -> None:
        checks.measure("measure", measure, _flow(flow).mesh.domain, "cell", "exterior_facet")
        shape = expression.ufl_shape
        V = compat.lagrange_space(flow.mesh.domain, 1, shape[0] if shape else 1)
        self.field = fem.Function(V, name=name)
        z = ufl.TestFunction(V)
        ones = z if not shape else sum(z[i] for i in range(shape[0]))
        load = _sided(flow, weight * ufl.inner(expression, z) * measure)
        self._load, self._mass = compat.compile_forms(load, weight * ones * measure)
        self._b = [compat.create_vector(V) for _ in range(2)]
        compat.freed_with(self, *self._b)

    def __call__(self) -> fem.Function:
        """Project the present state (collective)."""
        for vector, form in zip(self._b, (self._load, self._mass), strict=True):
            compat.assemble_vector(vector, form)
            vector.ghostUpdate(PETSc.InsertMode.ADD, PETSc.ScatterMode.REVERSE)
        load, mass = (vector.array_r for vector in self._b)
        reached = mass > 0.0
        self.field.x.array[: len(load)] = np.where(reached, load / np.where(reached, mass, 1.0), 0.0)
        self.field.x.scatter_forward()
        return self.field


def vorticity(flow: Flow) -> NodalField:
    """Curl of the velocity, a scalar in the plane; unit: 1/time.

    Args:
        flow: the flow.
    """
    motion = _flow(flow).fields.motion_end
    g = ale.gradient(_velocity(flow), motion)
    if flow.mesh.domain.geometry.dim == 2:
        curl: Any = g[1, 0] - g[0, 1]
    else:
        curl = ufl.as_vector([g[2, 1] - g[1, 2], g[0, 2] - g[2, 0], g[1, 0] - g[0, 1]])
    weight = 1.0 if motion is None else ufl.det(motion.F)
    return NodalField(flow, "vorticity", curl, flow.mesh.dx(*flow.fluid_cells, degree=flow.fields.degree), weight)


def wall_shear_stress(flow: Flow, *names: str) -> NodalField:
    """Tangential part of the viscous traction of the fluid on boundary facets; unit: force/area.

    Args:
        flow: the flow.
        names: facet groups of the boundary.
    """
    domain, motion = flow.mesh.domain, flow.fields.motion_end
    n = ale.normal(domain, motion)
    traction = -2 * flow.mu * ufl.sym(ale.gradient(_velocity(flow), motion)) * n
    shear = traction - ufl.dot(traction, n) * n
    measure = flow.mesh.ds(*names, degree=flow.fields.degree)
    return NodalField(flow, "wall_shear_stress", shear, measure, ale.per_area(1.0, domain, motion))
