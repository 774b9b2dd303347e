"""The two sides of the coupling: a fluid residual in a finite element space, and a shell residual on a spline."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import scipy.sparse as sp
import ufl
from mpi4py import MPI
from dolfinx import fem, mesh
from petsc4py import PETSc

from coudalfish.sides.handover import check_band, check_needs, check_residual
from coudalfish.sides.mesh_motion import MeshMotion, check_displacement
from coudalfish.sides.scales import largest_speed, median_size
from coudalfish.surface.band import SurfaceBand
from coudalfish.surface.sheets import Normals, Sheets
from coudalfish.surface.trace import TraceMatrix
from shnapr.contact.self_contact import ContactForces, SelfContact
from shnapr.contact.system import ContactSystem
from tigar_x import checks, compat
from tigar_x.compat import FloatArray
from tigar_x.fem.linear import LinearSolver, automatic
from tigar_x.fem.solve import FiniteElementSystem, RankOne
from tigar_x.fem.time_integration import TimeIntegrator
from tigar_x.splines.quadrature import NodalQuadrature
from tigar_x.splines.spline import ExtractedSpline
from tigar_x.splines.spline_system import SplineSystem

ROUNDING = 1e-15
"""Rounding error of a residual relative to the terms in it."""


class FluidSubproblem:
    """A flow, given by any UFL residual whose unknown has d velocity components and then the pressure.

    The node-blocked equal-order space is the fast path; a mixed space such as Taylor-Hood works as well.

    Args:
        mesh_f: fluid mesh of triangles or tetrahedra.
        residual_f: residual built from the expressions of ``timeInt_f``.
        timeInt_f: integrator of the unknown (velocity, pressure), with the pressure algebraic.
        bcs: strong boundary conditions.
        band: the band whose scales the residual contains; None: the residual contains none.
        moving: motion of the mesh that is pulled back in the residual; None: the mesh is fixed.
        solver: linear solver recipe; None: by size and layout, see :func:`tigar_x.fem.linear.automatic`.
        tangent: UFL tangent; None: the derivative of the residual.
        updates: called with t_alpha at the start of every step, for data that are not UFL expressions in time.
        before: called before every assembly of the residual, see :class:`tigar_x.fem.solve.FiniteElementSystem`.
        rank_one: loads whose tangent is dense, see there.
        density: rho, that of the residual, needed by a penalty rule; unit: mass/volume.
        viscosity: mu, likewise.
        mesh_size: size h of the cells near the surface, for a penalty rule and for warnings; None: see below.

    Attributes:
        mesh_size: h, as given or the median over the cells of their shortest edges, at rest; unit: length.
        free: mask of the velocities that no strong condition holds, shape (nodes, d).
        moving: as given.

    Raises:
        ValueError: the unknown has not d + 1 components, points cannot be located in the mesh that moves, or something
            that belongs to the residual was not handed over, see :mod:`coudalfish.sides.handover`.
    """

    def __init__(
        self,
        mesh_f: mesh.Mesh,
        residual_f: ufl.Form,
        timeInt_f: TimeIntegrator,
        *,
        bcs: Sequence[Any] = (),
        band: SurfaceBand | None = None,
        moving: MeshMotion | None = None,
        solver: LinearSolver | None = None,
        tangent: ufl.Form | None = None,
        updates: Sequence[Callable[[float], None]] = (),
        before: Sequence[Callable[[], None]] = (),
        rank_one: Sequence[RankOne] = (),
        density: float | None = None,
        viscosity: float | None = None,
        mesh_size: float | None = None,
    ) -> None:
        self.mesh = mesh_f
        self.comm = mesh_f.comm
        self.timeInt = timeInt_f
        self.band = band
        self.moving = moving
        if moving is not None:
            check_displacement(moving, mesh_f)
        self.updates = tuple(updates)
        self.density = None if density is None else checks.positive("density", density)
        self.viscosity = None if viscosity is None else checks.not_negative("viscosity", viscosity)
        d, V = mesh_f.geometry.dim, timeInt_f.x.function_space
        if timeInt_f.x.ufl_shape != (d + 1,):
            raise ValueError(f"the fluid unknown has shape {timeInt_f.x.ufl_shape}: ({d + 1},) is required")
        check_residual(residual_f, timeInt_f, mesh_f)
        check_band(residual_f, band)
        hooks: Any = {"updates": updates, "before": before, "rank_one": rank_one, "bcs": bcs}
        check_needs(timeInt_f, moving=moving, solver=solver, density=density, viscosity=viscosity, **hooks)
        components = [compat.component_space(V, i) for i in range(d)]
        self.velocity_space = components[0][0]
        self.velocity_dofs = np.column_stack([dofs for _, dofs in components])
        self.mesh_size = median_size(mesh_f) if mesh_size is None else checks.positive("mesh_size", mesh_size)

        size, block = V.dofmap.index_map.size_global, V.dofmap.index_map_bs
        recipe = automatic(size * block, blocked=block > 1) if solver is None else solver
        self.system = FiniteElementSystem(
            residual_f, timeInt_f.x, bcs, tangent=tangent, solver=recipe, before=before, rank_one=rank_one
        )
        self.free = ~np.isin(self.velocity_dofs, self.system.constrained)
        owned = self.system.b.getLocalSize()
        self._is_velocity = np.zeros(owned)
        self._is_velocity[self.velocity_dofs[self.velocity_dofs < owned]] = 1.0
        self._product, self._reference = self.system.b.duplicate(), 0.0

    def velocity_at(self, trace: TraceMatrix) -> FloatArray:
        """Velocity u_alpha at the points, the same on every rank (collective), shape (points, d)."""
        dofs, a = self.velocity_dofs[trace.nodes], self.timeInt.x_factor
        local = trace.B @ (a * self.timeInt.x.x.array[dofs] + (1.0 - a) * self.timeInt.x_old.x.array[dofs])
        if self.comm.size == 1:
            return local
        total = np.empty_like(local)
        self.comm.Allreduce(local, total, op=MPI.SUM)
        return total

    def assemble_residual(self, trace: TraceMatrix, forces: FloatArray, impedance: float) -> float:
        """Assemble the residual with the coupling forces.

        Args:
            trace: where the points are.
            forces: fluid on shell at the points, shape (points, d).
            impedance: pressure per velocity that makes continuity rows comparable with momentum rows.

        Returns:
            ``sqrt(|R_momentum|^2 + impedance^2 |R_continuity|^2)``; unit: force.
        """
        dofs = self.velocity_dofs[trace.nodes]
        nodal = np.where(self.free[trace.nodes], trace.transposed @ forces, 0.0)

        def load(b: FloatArray) -> None:
            b[dofs] += nodal

        self.system.assemble_residual(load)
        return self.norm(self.system.b, impedance)

    def norm(self, vector: PETSc.Vec, impedance: float) -> float:
        """Norm of a residual-like vector in units of force (collective)."""
        array = vector.array_r
        weights = self._is_velocity + impedance**2 * (1.0 - self._is_velocity)
        square = np.einsum("i,i,i->", weights, array, array)
        return float(np.sqrt(self.comm.allreduce(float(square), op=MPI.SUM)))

    def coupling_norm(self, trace: TraceMatrix, forces: FloatArray) -> float:
        """Norm of point forces on the fluid's nodes (collective; a node of two ranks counts in parts); unit: force."""
        nodal = trace.transposed @ forces
        return float(np.sqrt(self.comm.allreduce(float(np.sum(nodal**2)), op=MPI.SUM)))

    def momentum_scale(self) -> float:
        """Size of the terms that balance in the flow but at outlets' resistances: tangent times state; unit: force."""
        if not self.system.has_tangent:
            return 0.0
        self.system.A.mult(compat.petsc_vector(self.timeInt.x), self._product)
        return self.norm(self.system.without_loads(self._product), 0.0)

    def assemble_tangent(self, trace: TraceMatrix, penalty_tangent: sp.csr_matrix) -> None:
        """Assemble the tangent with the penalty's part.

        Args:
            trace: where the points are.
            penalty_tangent: part of one velocity component, shape (len(trace.nodes), len(trace.nodes)).
        """

        def add(A: PETSc.Mat) -> None:
            for dofs, free in zip(self.velocity_dofs[trace.nodes].T, self.free[trace.nodes].T, strict=True):
                K = penalty_tangent
                if not free.all():
                    mask = sp.diags(free.astype(float))
                    K = (mask @ K @ mask).tocsr()
                rows, columns = dofs.astype(PETSc.IntType), dofs[K.indices].astype(PETSc.IntType)
                A.setValuesLocalIJV(
                    K.indptr.astype(PETSc.IntType), columns, K.data, PETSc.InsertMode.ADD_VALUES, rowmap=rows
                )

        self.system.assemble_tangent(add)

    def solve(self, *, first: bool) -> int:
        """Solve for the increment and subtract it.

        Args:
            first: whether this is the step's first solve; later ones need not be more accurate than earlier ones.

        Returns:
            Linear iterations.

        Raises:
            SolveError: the linear solver failed.
        """
        norm = self.system.reference_norm()
        self._reference = norm if first else max(norm, self._reference)
        self.system.subtract(self.system.solve(self._reference))
        return self.system.iterations

    @property
    def linear_accuracy(self) -> float:
        """Residual that the linear solver leaves in a step by its own tolerance, 0 for a direct one; unit: force."""
        return self.system.recipe.rtol * self._reference

    def speed(self) -> float:
        """Largest nodal speed relative to the mesh on any rank (collective); unit: length/time."""
        return largest_speed(self.timeInt, self.moving, self.velocity_space, self.velocity_dofs)


class ShellSubproblem:
    """A shell on a spline that every rank holds whole.

    Args:
        spline_sh: the midsurface, on ``MPI.COMM_SELF``.
        residual_sh: residual built from the expressions of ``timeInt_sh``.
        timeInt_sh: integrator of the homogeneous displacement.
        solver: linear solver recipe; None: direct.
        tangent: UFL tangent; None: the derivative of the residual.
        updates: called with t_alpha at the start of every step.
        contact: contact of the shell, or of several in one spline, with itself, on ``NodalQuadrature.of(spline_sh)``;
            None: there is none, and no object for it.

    Attributes:
        quadrature: the immersed points.
        sheets: how they hang together.
        normals: gives the normals at the intermediate level, shape (points, d).
        contact: as given.

    Raises:
        ValueError: the spline is distributed, or the residual is not built from the integrator's expressions.
    """

    def __init__(
        self,
        spline_sh: ExtractedSpline,
        residual_sh: ufl.Form,
        timeInt_sh: TimeIntegrator,
        *,
        solver: LinearSolver | None = None,
        tangent: ufl.Form | None = None,
        updates: Sequence[Callable[[float], None]] = (),
        contact: SelfContact | None = None,
    ) -> None:
        check_residual(residual_sh, timeInt_sh, spline_sh.mesh)
        self.spline = spline_sh
        self.timeInt = timeInt_sh
        self.updates = tuple(updates)
        self.contact = contact
        self.quadrature = NodalQuadrature.of(spline_sh) if contact is None else contact.quadrature
        y: fem.Function = timeInt_sh.x
        jacobian = ufl.derivative(residual_sh, y) if tangent is None else tangent
        self.system = (
            SplineSystem(spline_sh, residual_sh, jacobian, solver, unknown=y)
            if contact is None
            else ContactSystem(spline_sh, residual_sh, jacobian, contact, unknown=y, time=timeInt_sh, solver=solver)
        )
        self.sheets = Sheets.of(spline_sh)
        self.normals = Normals(spline_sh, timeInt_sh, self.sheets.sign)

    def _physical(self, array: FloatArray) -> FloatArray:
        return array.reshape(-1, self.spline.nsd) / self.quadrature.rational[:, None]

    def positions(self) -> FloatArray:
        """Points at the intermediate level, shape (points, d); unit: length."""
        return self.quadrature.points + self._physical(self.timeInt.x_alpha_array())

    def velocity(self) -> FloatArray:
        """Velocity y'_alpha of the points, or that of the last state between steps, shape (points, d)."""
        time = self.timeInt
        return self._physical(time.xdot_alpha_array() if time.in_step else time.xdot_old.x.array)

    def assemble_residual(self, forces: FloatArray) -> float:
        """Assemble the residual with the coupling forces.

        Args:
            forces: fluid on shell at the points, shape (points, d).

        Returns:
            Euclidean norm of the extracted residual; unit: force.
        """
        return self.system.assemble_residual(-forces / self.quadrature.rational[:, None])

    def momentum_scale(self) -> float:
        """Size of the terms that balance in the shell: the last tangent times the motion in this step; unit: force."""
        return self.system.product_norm(self.timeInt.x.x.array - self.timeInt.x_old.x.array)

    def rounding(self) -> FloatArray:
        """Rounding error of positions at the points, from the shell's own size, shape (points, d); unit: length."""
        x = self.quadrature.points + self._physical(self.timeInt.x.x.array)
        return ROUNDING * (x - x.mean(axis=0))

    def force_of(self, displacement: FloatArray) -> float:
        """Norm of the last tangent times a displacement of the points, shape (points, d); unit: force.

        The signs alternate from point to point, as those of rounding may: a smooth displacement would meet no
        resistance in a sheet that is straight.
        """
        signs = 1.0 - 2.0 * (np.arange(len(displacement)) % 2)
        return self.system.product_norm((signs * self.quadrature.rational)[:, None] * np.abs(displacement))

    def coupling_norm(self, forces: FloatArray) -> float:
        """Norm of point forces on the spline's functions; unit: force."""
        return float(np.linalg.norm(self.system.extract(forces / self.quadrature.rational[:, None])))

    @property
    def touching(self) -> ContactForces | None:
        """Contact at the state of the last residual; None where no points interact."""
        forces = self.system.forces if isinstance(self.system, ContactSystem) else None
        return forces if forces is not None and forces.pairs else None

    def closing_ratio(self) -> float:
        """Largest approach in a step of two points that may interact in it, relative to the range of contact."""
        if self.contact is None:
            return 0.0
        x, v, dt = self.positions(), self.velocity(), self.timeInt.step_size
        if not (np.isfinite(x).all() and np.isfinite(v).all()):
            return np.inf
        return self.contact.closing_speed(x, v, dt) * dt / self.contact.kernel.r_max

    def renew_contact(self) -> None:
        """Bring the tangent's part of contact, and nothing else of it, to the present state."""
        if isinstance(self.system, ContactSystem):
            self.system.renew_contact()

    def assemble_tangent(self, W: FloatArray, penalty: float, *, positive: bool = False) -> None:
        """Assemble the tangent with the penalty's part, which is diagonal before extraction.

        Args:
            W: reference areas, zero at inactive points, shape (points,).
            penalty: beta.
            positive: whether to leave out what makes the tangent of contact indefinite.
        """
        if isinstance(self.system, ContactSystem):
            self.system.positive = positive
        diagonal = self.timeInt.xdot_factor * penalty * W / self.quadrature.rational**2
        self.system.assemble_tangent(np.repeat(diagonal[:, None], self.spline.nsd, axis=1))

    def solve(self) -> None:
        """Solve for the increment and subtract it.

        Raises:
            SolveError: the linear solver failed.
        """
        self.system.subtract(self.system.solve())

    def spacing(self, x: FloatArray) -> float:
        """Largest distance between neighbouring points along the element edges of the deformed shell.

        Args:
            x: positions of the points, shape (points, d).

        Returns:
            Unit: length.
        """
        a, b = self.sheets.edges.T
        return float(np.linalg.norm(x[a] - x[b], axis=1).max(initial=0.0))
