"""The two sides of the coupling: a fluid residual in a finite element space, and a shell residual on a spline."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import scipy.sparse as sp
import ufl
from dolfinx import fem, mesh
from mpi4py import MPI
from petsc4py import PETSc

from coudalfish.band import SurfaceBand
from shnapr.kinematics import midsurface
from tigar_x import checks, compat
from tigar_x.compat import FloatArray
from tigar_x.extraction import subcells
from tigar_x.quadrature import NodalQuadrature
from tigar_x.solve import FiniteElementSystem, LinearSolver, SplineSystem
from tigar_x.spline import ExtractedSpline
from tigar_x.time_integration import TimeIntegrator


class FluidSubproblem:
    """A flow, given by any UFL residual whose unknown has d velocity components and then the pressure.

    The node-blocked equal-order space is the fast path; a mixed space such as Taylor-Hood works as well.

    Args:
        mesh_f: fluid mesh of triangles or tetrahedra.
        residual_f: residual built from the expressions of ``timeInt_f``.
        timeInt_f: integrator of the unknown (velocity, pressure), with the pressure algebraic.
        bcs: strong boundary conditions.
        band: the band whose scales the residual contains; None: the residual contains none.
        solver: linear solver recipe; None: direct.
        tangent: UFL tangent; None: the derivative of the residual.
        updates: called with t_alpha at the start of every step, for data that are not UFL expressions in time.
        density: rho, needed by a penalty rule; unit: mass/volume.
        viscosity: mu, needed by a penalty rule.

    Attributes:
        mesh_size: median over the cells of (d! volume)^(1/d): the leg of a right simplex; unit: length.

    Raises:
        ValueError: the unknown has not d + 1 components.
    """

    def __init__(
        self,
        mesh_f: mesh.Mesh,
        residual_f: ufl.Form,
        timeInt_f: TimeIntegrator,
        *,
        bcs: Sequence[Any] = (),
        band: SurfaceBand | None = None,
        solver: LinearSolver | None = None,
        tangent: ufl.Form | None = None,
        updates: Sequence[Callable[[float], None]] = (),
        density: float | None = None,
        viscosity: float | None = None,
    ) -> None:
        self.mesh = mesh_f
        self.comm = mesh_f.comm
        self.timeInt = timeInt_f
        self.band = band
        self.updates = tuple(updates)
        self.density = None if density is None else checks.positive("density", density)
        self.viscosity = None if viscosity is None else checks.not_negative("viscosity", viscosity)
        d = mesh_f.geometry.dim
        if timeInt_f.x.ufl_shape != (d + 1,):
            raise ValueError(f"the fluid unknown has shape {timeInt_f.x.ufl_shape}: ({d + 1},) is required")
        V = timeInt_f.x.function_space
        components = [compat.component_space(V, i) for i in range(d)]
        self.velocity_space = components[0][0]
        self.velocity_dofs = np.column_stack([dofs for _, dofs in components])
        self.mesh_size = self._median_size()

        self.system = FiniteElementSystem(residual_f, timeInt_f.x, bcs, tangent=tangent, solver=solver)
        self.free = ~np.isin(self.velocity_dofs, self.system.constrained)
        owned = self.system.b.getLocalSize()
        self._velocity_owned = np.zeros(owned, dtype=bool)
        self._velocity_owned[self.velocity_dofs[self.velocity_dofs < owned]] = True
        self._diagonal = self.system.b.duplicate()
        self._product = self.system.b.duplicate()
        self._has_tangent = False

    def _median_size(self) -> float:
        x = compat.cell_vertices(self.mesh)[: compat.owned_cells(self.mesh)]
        sizes = np.abs(np.linalg.det(x[:, 1:] - x[:, :1])) ** (1.0 / self.mesh.geometry.dim)
        return float(np.median(np.concatenate(self.comm.allgather(sizes))))

    def velocity_at(self, B: sp.csr_matrix) -> FloatArray:
        """Velocity u_alpha at the points, the same on every rank (collective), shape (points, d)."""
        a = self.timeInt.x_factor
        x, x_old = self.timeInt.x.x.array, self.timeInt.x_old.x.array
        local = B @ (a * x[self.velocity_dofs] + (1.0 - a) * x_old[self.velocity_dofs])
        if self.comm.size == 1:
            return local
        total = np.empty_like(local)
        self.comm.Allreduce(local, total, op=MPI.SUM)
        return total

    def assemble_residual(self, B: sp.csr_matrix, forces: FloatArray, impedance: float) -> float:
        """Assemble the residual with the coupling forces.

        Args:
            B: trace matrix.
            forces: fluid on shell at the points, shape (points, d).
            impedance: pressure per velocity that makes continuity rows comparable with momentum rows.

        Returns:
            ``sqrt(|R_momentum|^2 + impedance^2 |R_continuity|^2)``; unit: force.
        """
        nodal = np.where(self.free, B.T @ forces, 0.0)

        def load(b: FloatArray) -> None:
            np.add.at(b, self.velocity_dofs, nodal)

        self.system.assemble_residual(load)
        return self.norm(self.system.b, impedance)

    def norm(self, vector: PETSc.Vec, impedance: float) -> float:
        """Norm of a residual-like vector in units of force."""
        array = vector.array_r
        momentum = float(np.sum(array[self._velocity_owned] ** 2))
        continuity = float(np.sum(array[~self._velocity_owned] ** 2))
        total = self.comm.allreduce(momentum + impedance**2 * continuity, op=MPI.SUM)
        return float(np.sqrt(total))

    def force_scale(self, B: sp.csr_matrix, magnitude: FloatArray) -> float:
        """Size of the forces in the flow: momentum part of the tangent times the state, and the coupling's share.

        Args:
            B: trace matrix.
            magnitude: sum of the absolute coupling forces at the points, shape (points,).

        Returns:
            Unit: force.
        """
        own = 0.0
        if self._has_tangent:
            self.system.A.mult(compat.petsc_vector(self.timeInt.x), self._product)
            own = self.norm(self._product, 0.0)
        coupling = float(np.sum((B.T @ magnitude) ** 2))
        return own + float(np.sqrt(self.comm.allreduce(coupling, op=MPI.SUM)))

    def assemble_tangent(self, diagonal: FloatArray | None, matrix: sp.csr_matrix | None) -> None:
        """Assemble the tangent with the penalty's part.

        Args:
            diagonal: lumped part for every velocity component, shape (nodes,); None: none.
            matrix: consistent part for one velocity component, shape (nodes, nodes); None: none.
        """

        def add(A: PETSc.Mat) -> None:
            if diagonal is not None:
                with self._diagonal.localForm() as local:
                    local.set(0.0)
                    values = np.where(self.free, diagonal[:, None], 0.0)
                    np.add.at(local.array_w, self.velocity_dofs, values)
                self._diagonal.ghostUpdate(PETSc.InsertMode.ADD, PETSc.ScatterMode.REVERSE)
                A.setDiagonal(self._diagonal, PETSc.InsertMode.ADD_VALUES)
            if matrix is not None:
                self._add_matrix(A, matrix)

        self.system.assemble_tangent(add)
        self._has_tangent = True

    def _add_matrix(self, A: PETSc.Mat, K: sp.csr_matrix) -> None:
        for component, dofs in enumerate(self.velocity_dofs.T):
            mask = sp.diags(self.free[:, component].astype(float))
            part = (mask @ K @ mask).tocsr()
            rows = np.flatnonzero(np.diff(part.indptr))
            indptr = np.concatenate([[0], np.cumsum(np.diff(part.indptr)[rows])]).astype(PETSc.IntType)
            columns = dofs[part.indices].astype(PETSc.IntType)
            A.setValuesLocalIJV(
                indptr, columns, part.data, PETSc.InsertMode.ADD_VALUES, dofs[rows].astype(PETSc.IntType)
            )

    def solve(self) -> int:
        """Solve for the increment and subtract it.

        Returns:
            Linear iterations.

        Raises:
            SolveError: the linear solver failed.
        """
        self.system.subtract(self.system.solve())
        return self.system.iterations

    def speed(self) -> float:
        """Largest nodal speed on any rank; unit: length/time."""
        v = self.timeInt.x.x.array[self.velocity_dofs]
        return float(self.comm.allreduce(np.sqrt((v**2).sum(axis=1)).max(initial=0.0), op=MPI.MAX))


class ShellSubproblem:
    """A shell on a spline that every rank holds whole.

    Args:
        spline_sh: the midsurface, on ``MPI.COMM_SELF``.
        residual_sh: residual built from the expressions of ``timeInt_sh``.
        timeInt_sh: integrator of the homogeneous displacement.
        solver: linear solver recipe; None: direct.
        tangent: UFL tangent; None: the derivative of the residual.
        updates: called with t_alpha at the start of every step.

    Attributes:
        quadrature: the immersed points.

    Raises:
        ValueError: the spline is distributed.
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
    ) -> None:
        self.spline = spline_sh
        self.timeInt = timeInt_sh
        self.updates = tuple(updates)
        self.quadrature = NodalQuadrature.of(spline_sh)
        y: fem.Function = timeInt_sh.x
        jacobian = ufl.derivative(residual_sh, y) if tangent is None else tangent
        self.system = SplineSystem(spline_sh, residual_sh, jacobian, solver, unknown=y)
        cells = subcells(spline_sh.extraction)
        self._edges = np.stack([cells, np.roll(cells, 1, axis=1)], axis=-1).reshape(-1, 2)
        self._projector = spline_sh.lumped_projector
        normal = midsurface(spline_sh, spline_sh.rationalize(timeInt_sh.x_alpha)).normal
        self._normal = self._projector.compile(normal)

    def _physical(self, array: FloatArray) -> FloatArray:
        return array.reshape(-1, self.spline.nsd) / self.quadrature.rational[:, None]

    def positions(self) -> FloatArray:
        """Points at the intermediate level, shape (points, d); unit: length."""
        return self.quadrature.points + self._physical(self.timeInt.x_alpha_array())

    def velocity(self) -> FloatArray:
        """Velocity y'_alpha of the points, shape (points, d)."""
        return self._physical(self.timeInt.xdot_alpha_array())

    def normals(self) -> FloatArray:
        """Lumped projection of a_3 at the intermediate level, not renormalised, shape (points, d)."""
        return self._projector(self._normal)

    def assemble_residual(self, forces: FloatArray) -> float:
        """Assemble the residual with the coupling forces.

        Args:
            forces: fluid on shell at the points, shape (points, d).

        Returns:
            Euclidean norm of the extracted residual; unit: force.
        """
        return self.system.assemble_residual(-forces / self.quadrature.rational[:, None])

    def force_scale(self, magnitude: FloatArray) -> float:
        """Size of the coupling forces on the spline's functions; unit: force."""
        nodal = np.repeat((magnitude / self.quadrature.rational)[:, None], self.spline.nsd, axis=1)
        return float(np.linalg.norm(self.system.extract(nodal)))

    def assemble_tangent(self, W: FloatArray, penalty: float) -> None:
        """Assemble the tangent with the penalty's part, which is diagonal before extraction.

        Args:
            W: reference areas, zero at inactive points, shape (points,).
            penalty: beta.
        """
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
        return float(np.linalg.norm(x[self._edges[:, 0]] - x[self._edges[:, 1]], axis=1).max(initial=0.0))
