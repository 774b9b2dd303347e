"""Meshes that move: by a given map, or as a fictitious elastic solid that follows its boundary and solids inside it.

The displacement is a second-order variable of the generalized-alpha scheme of the flow, so that displacement, velocity
and the flow's equations belong to one level.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import ufl
from mpi4py import MPI
from dolfinx import fem
from petsc4py import PETSc

from tigar_x import checks, compat
from tigar_x.compat import FloatArray, IntArray
from tigar_x.fem.line_search import LineSearch
from tigar_x.fem.linear import LinearSolver, SolveError
from tigar_x.fem.schemes import Scheme, companion
from tigar_x.fem.solve import FiniteElementSystem, newton
from tigar_x.fem.time_integration import TimeIntegrator
from varmint.forms.ale import Motion
from varmint.forms.solids import mesh_residual
from varmint.mesh.named import NamedMesh, require_named

Displacement = Callable[[Any, Any], Any]
"""Displacement as UFL vector, from the coordinates at rest and the time."""


NEGLIGIBLE = 1e-10
"""Part of a typical cell's size that the nodes of an elastic mesh may be off their balance."""


MOST_PARTS = 16
"""Into how many parts the displacement of a boundary in a step is divided at most."""


class MeshInversionError(SolveError):
    """A motion that turns cells of the mesh inside out."""


class MeshMotion:
    """Displacement of a mesh in time, and its check.

    Args:
        mesh: the mesh at rest.
        dt: step size; unit: time.
        scheme: first-order scheme of the flow, whose second-order companion integrates the mesh.
        degree: polynomial degree of the displacement.

    Attributes:
        mesh: as given.
        time: integrator of the displacement.
        motion: displacement and velocity at the level of the equations, for forms.
    """

    def __init__(self, mesh: NamedMesh, dt: float, scheme: Scheme, degree: int = 1) -> None:
        require_named(mesh)
        domain = mesh.domain
        self.mesh = mesh
        V = compat.lagrange_space(domain, checks.whole("degree", degree, 1), domain.geometry.dim)
        self.time = TimeIntegrator(fem.Function(V, name="mesh_displacement"), dt, companion(scheme))
        self.degree = degree
        self.motion = Motion(domain, self.time.x_alpha, self.time.xdot_alpha, degree)
        self._corners = _Corners(V)

    @property
    def end(self) -> Motion:
        """Displacement and velocity at the end of the step."""
        return Motion(self.mesh.domain, self.time.x, self.time.xdot, self.degree)

    def smallest_volume_ratio(self) -> float:
        """Smallest ratio J of present to initial volume at the nodes of the cells (collective)."""
        return self._corners.smallest(self.time.x, self.mesh.domain.comm)[0]

    def check(self) -> None:
        """Check that no cell is inside out (collective).

        Raises:
            MeshInversionError: J <= 0 at a node of some cell, or a displacement that is not finite.
        """
        J, where = self._corners.smallest(self.time.x, self.mesh.domain.comm)
        if not J > 0.0:
            place = ", ".join(f"{coordinate:.4g}" for coordinate in where)
            raise MeshInversionError(
                f"the mesh is inside out at t = {float(self.time.t.value):.6g}: a cell at ({place}) has the ratio of"
                f" volumes J = {J:.3g}, > 0 is required; take smaller steps, a finer mesh where it is compressed, or"
                " stiffer small cells"
            )


class _Corners:
    """det F at the nodes of all cells of a mesh that a Lagrange space displaces."""

    def __init__(self, V: fem.FunctionSpace) -> None:
        domain = V.mesh
        self._size = domain.geometry.dim
        owned = compat.owned_cells(domain)
        self._dofs = compat.cell_dofs(V)[:owned]
        points = compat.node_points(V)
        self._gradients = compat.tabulate_gradients(V, points)  # (points, functions, d)
        x = compat.cell_vertices(domain)[:owned]
        self._middles = x.mean(axis=1)
        corner = compat.tabulate_gradients(compat.lagrange_space(domain, 1), points)  # (points, vertices, d)
        self._inverse = np.linalg.inv(np.einsum("cvi,pvj->cpij", x, corner))

    def smallest(self, u: fem.Function, comm: MPI.Comm) -> tuple[float, FloatArray]:
        values = u.x.array.reshape(-1, self._size)[self._dofs]
        with np.errstate(invalid="ignore"):  # what is not finite counts as inside out
            grad = np.einsum("cni,pnj->cpij", values, self._gradients) @ self._inverse
            J = np.linalg.det(np.eye(self._size) + grad).min(axis=1, initial=np.inf)
        J = np.where(np.isfinite(J), J, -np.inf)
        worst = int(np.argmin(J)) if len(J) else -1
        mine = (float(J[worst]), self._middles[worst]) if len(J) else (np.inf, np.zeros(self._size))
        found = comm.allgather(mine)
        return found[int(np.argmin([value for value, _ in found]))]


class PrescribedMotion(MeshMotion):
    """A mesh that moves by a given map.

    Args:
        mesh: the mesh at rest.
        displacement: from coordinates at rest and time to the displacement, in UFL.
        dt: step size; unit: time.
        scheme: first-order scheme of the flow.
        degree: polynomial degree of the displacement, which is interpolated at the nodes.

    Raises:
        ValueError: the displacement has a wrong shape.
    """

    def __init__(self, mesh: NamedMesh, displacement: Displacement, dt: float, scheme: Scheme, degree: int = 1) -> None:
        super().__init__(mesh, dt, scheme, degree)
        domain, time = mesh.domain, self.time
        x, t = ufl.SpatialCoordinate(domain), ufl.variable(time.t)
        u = checks.vector("displacement", compat.ask("displacement", displacement, x, t), domain.geometry.dim)
        rate = ufl.diff(u, t)
        self._move = compat.Interpolation(time.x, u)
        end, time.t.value = float(time.t.value), time.time
        self._move()
        time.x_old.x.array[:] = time.x.x.array
        compat.Interpolation(time.xdot_old, rate)()
        compat.Interpolation(time.xddot_old, ufl.diff(rate, t))()
        time.t.value = end

    def move(self) -> None:
        """Displace the mesh to the end of the step."""
        self._move()


class ElasticMotion(MeshMotion):
    """A mesh whose inner nodes follow its boundary as those of a fictitious elastic solid, see ``mesh_residual``.

    Args:
        mesh: the mesh at rest.
        displacements: for every facet group that moves or is held the displacement from coordinates at rest and time,
            in UFL, or None for a group that is held. Nodes of other boundary groups move freely.
        dt: step size; unit: time.
        scheme: first-order scheme of the flow.
        degree: polynomial degree of the displacement.
        cells: cell groups that the fictitious solid fills; none: all. The nodes of other cells, which a solid in the
            flow moves, are held where that has put them.
        stiffening: exponent for cells that are compressed.
        size_stiffening: exponent for cells that are small.
        rtol: accuracy of the nodes' balance relative to the largest residual of a step.
        solver: linear solver recipe, or a KSP; None: direct. PETSc options go first, under ``mesh_``.

    Attributes:
        cells: as given.
        solid_nodes: nodes (block dofs) of all other cells.

    Raises:
        ValueError: a group does not exist, a displacement has a wrong shape, or a number is out of range.
    """

    def __init__(
        self,
        mesh: NamedMesh,
        displacements: Mapping[str, Displacement | None],
        dt: float,
        scheme: Scheme,
        degree: int = 1,
        *,
        cells: Sequence[str] = (),
        stiffening: float = 3.0,
        size_stiffening: float = 1.0,
        rtol: float = 1e-6,
        solver: LinearSolver | PETSc.KSP | None = None,
    ) -> None:
        super().__init__(mesh, dt, scheme, degree)
        checks.kind("displacements", displacements, Mapping, "a mapping from facet groups, such as {'walls': None},")
        self.cells = tuple(checks.listed("cells", cells))
        self._rtol = checks.positive("rtol", rtol)
        exponents = {"stiffening": stiffening, "size_stiffening": size_stiffening}
        for name, value in exponents.items():
            checks.not_negative(name, value)
        u, domain = self.time.x, mesh.domain
        V, x = u.function_space, ufl.SpatialCoordinate(mesh.domain)
        self._data = []
        held: list[IntArray] = []
        for name, data in displacements.items():
            dofs = compat.nodes_on_facets(V, mesh.facets(name))
            held.append(dofs)
            if data is not None:
                target, label = fem.Function(V), f"displacements[{name!r}]"
                value = checks.vector(label, compat.ask(label, data, x, self.time.t), domain.geometry.dim)
                self._data.append((compat.Interpolation(target, value), target, self._unblocked(dofs)))
        if cells:
            inside = np.setdiff1d(np.arange(len(compat.cell_nodes(domain)), dtype=np.int32), mesh.cells(*cells))
            marker = fem.Function(V)  # a node of this rank may touch the solid in cells of another alone
            marker.x.array.reshape(-1, domain.geometry.dim)[compat.cell_dofs(V)[inside]] = 1.0
            compat.accumulate(marker)
            in_solid = marker.x.array[:: domain.geometry.dim] > 0.5
            self.solid_nodes: IntArray = np.flatnonzero(in_solid).astype(np.int32)
            held.append(self.solid_nodes)
        if not held:
            raise ValueError("displacements is empty: at least one facet group has to be held or moved")
        fixed = compat.fixed_nodes(V, np.unique(np.concatenate(held)))
        dx = mesh.dx(degree=2 * degree)  # also where all nodes are held, whose rows would else be empty
        one, volume = compat.Constant(domain, 1.0), abs(ufl.JacobianDeterminant(domain))
        sums = [compat.assemble_scalar(form) for form in compat.compile_forms(volume * dx, one * dx)]
        size = compat.Constant(domain, sums[0] / sums[1])
        self._length = (sums[0] / sums[1]) ** (1.0 / domain.geometry.dim)
        residual = mesh_residual(u, ufl.TestFunction(V), domain, dx, size=size, **exponents)
        self._system = FiniteElementSystem(residual, u, [fixed], solver=solver, prefix="mesh_")
        self._reference = 0.0
        self._began_at: float | None = None
        self._bring_back = self._system.remember_tangent()

    def _unblocked(self, nodes: IntArray) -> IntArray:
        d = self.mesh.domain.geometry.dim
        return (d * nodes[:, None] + np.arange(d)).ravel()

    def begin(self) -> None:
        """A new step, whose largest residual so far is the reference of all that follow.

        One from the same time as the last repeats a step that failed, whose tangents are forgotten.
        """
        self._reference = 0.0
        if self._began_at == self.time.time:
            self._bring_back()
        self._began_at = self.time.time
        self._bring_back = self._system.remember_tangent()

    def move(self) -> None:
        """Displace boundaries with data to the end of the step, and all other nodes along with them.

        Where that is too far for the cells at the boundary it is done in up to 16 parts.

        Raises:
            SolveError: the nodes found no balance.
        """
        self.begin()
        for interpolate, *_ in self._data:
            interpolate()
        x, parts = self.time.x.x.array, 1
        while True:
            try:
                for part in range(parts):
                    for _, target, dofs in self._data:
                        x[dofs] += (target.x.array[dofs] - x[dofs]) / (parts - part)
                    self.relax()
                return
            except SolveError:
                if parts == MOST_PARTS or not self._data:
                    raise
                parts *= 4
                self.time.restore()

    def relax(self) -> None:
        """Let the free nodes find their balance, with all others where they are.

        Raises:
            SolveError: they found none.
        """
        norm = self._system.assemble_residual()
        if not np.isfinite(norm):
            self.check()
            raise SolveError("the forces on the nodes of the mesh are not finite")
        self._reference = max(norm, self._reference)
        r, system, search = self._reference, self._system, LineSearch()
        try:
            newton(system, rtol=self._rtol, reference=r, atol=self._atol, line_search=search, keep=0.3)
        except SolveError as error:
            t = float(self.time.t.value)
            raise SolveError(f"the nodes of the moving mesh find no balance at t = {t:.6g}: {error}") from error

    def _atol(self) -> float:
        """Force that moves nodes by a negligible part of a cell."""
        if not self._system.has_tangent:
            return 0.0
        return NEGLIGIBLE * self._length * float(self._system.A.norm(PETSc.NormType.INFINITY))
