"""The flow as the coupling sees it: a residual in a finite element space, and what the coupling adds to it."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
import scipy.sparse as sp
import ufl
from mpi4py import MPI
from dolfinx import mesh
from petsc4py import PETSc

from coudalfish.sides.handover import check_band, check_needs, check_residual
from coudalfish.sides.mesh_motion import MovingMesh, check_displacement
from coudalfish.sides.scales import largest_speed, median_size
from coudalfish.surface.band import SurfaceBand
from coudalfish.surface.meeting import Meeting
from coudalfish.surface.sheets import Sheets
from coudalfish.surface.trace import TraceMatrix
from tigar_x import checks, compat, ranks
from tigar_x.compat import FloatArray, IntArray
from tigar_x.fem.linear import LinearSolver, automatic, chosen
from tigar_x.fem.solve import FiniteElementSystem, RankOne
from tigar_x.fem.time_integration import TimeIntegrator


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
        solver: linear solver recipe, or a KSP; None: by size and layout, see :func:`tigar_x.fem.linear.automatic`.
            PETSc options go first, under ``fluid_``.
        tangent: UFL tangent; None: the derivative of the residual.
        updates: called with t_alpha at the start of every step, for data that are not UFL expressions in time.
        before: called before every assembly of the residual, see :class:`tigar_x.fem.solve.FiniteElementSystem`.
        rank_one: loads whose tangent is dense, see there.
        density: rho, that of the residual, needed by a penalty rule; unit: mass/volume.
        viscosity: mu, likewise.
        mesh_size: size h of the cells near the surface, for a penalty rule and for warnings; None: see below.

    Attributes:
        mesh_size: h, as given or the median over the cells of their shortest edges, at rest; unit: length.
        trace_dofs: local dofs of the velocities that a trace may stand for, shape (nodes, d).
        free: mask of those that no strong condition holds, shape (nodes, d).
        moving: as given.
        sides: what differs on both sides of the surface, see :mod:`coudalfish.sides.sided_fluid`; None: nothing.

    Raises:
        ValueError: the unknown has not d + 1 components, points cannot be located in the mesh that moves, or something
            that belongs to the residual was not handed over, see :mod:`coudalfish.sides.handover`.
    """

    sides: Any = None

    def __init__(
        self,
        mesh_f: mesh.Mesh,
        residual_f: ufl.Form,
        timeInt_f: TimeIntegrator,
        *,
        bcs: Sequence[Any] = (),
        band: SurfaceBand | None = None,
        moving: MovingMesh | None = None,
        solver: LinearSolver | PETSc.KSP | None = None,
        tangent: ufl.Form | None = None,
        updates: Sequence[Callable[[float], None]] = (),
        before: Sequence[Callable[[], None]] = (),
        rank_one: Sequence[RankOne] = (),
        density: float | None = None,
        viscosity: float | None = None,
        mesh_size: float | None = None,
    ) -> None:
        checks.kind("mesh_f", mesh_f, mesh.Mesh, "a mesh of dolfinx, such as the domain of a NamedMesh,")
        checks.kind("residual_f", residual_f, ufl.Form, "a form, such as the residual of a flow,")
        checks.kind("timeInt_f", timeInt_f, TimeIntegrator, "the TimeIntegrator of an unsteady flow")
        for name, hooks in (("bcs", bcs), ("updates", updates), ("before", before), ("rank_one", rank_one)):
            checks.listed(name, hooks)
        self.mesh = mesh_f
        self.comm = mesh_f.comm
        self.timeInt = timeInt_f
        self.band = band
        self.moving = moving
        if band is not None:
            checks.kind("band", band, SurfaceBand, "a SurfaceBand")
        if moving is not None:
            checks.having(
                "moving", moving, "time degree move check", "the motion of a mesh, such as a PrescribedMotion,"
            )
            check_displacement(moving, mesh_f)
        self.updates = tuple(updates)
        self.density = None if density is None else checks.positive("density", density)
        self.viscosity = None if viscosity is None else checks.not_negative("viscosity", viscosity)
        d, V = mesh_f.geometry.dim, timeInt_f.x.function_space
        if timeInt_f.x.ufl_shape != (d + 1,):
            raise ValueError(f"the fluid unknown has shape {timeInt_f.x.ufl_shape}: ({d + 1},) is required")
        check_residual(residual_f, timeInt_f, mesh_f)
        check_band(residual_f, band)
        given: Any = {"updates": updates, "before": before, "rank_one": rank_one, "bcs": bcs}
        parts: Any = {"band": band, "sides": self.sides, "moving": moving, "solver": solver}
        check_needs(timeInt_f, **parts, density=density, viscosity=viscosity, **given)
        components = [compat.component_space(V, i) for i in range(d)]
        self.velocity_space = components[0][0]
        self.velocity_dofs = np.column_stack([dofs for _, dofs in components])
        self.mesh_size = median_size(mesh_f) if mesh_size is None else checks.positive("mesh_size", mesh_size)

        size, block = V.dofmap.index_map.size_global, V.dofmap.index_map_bs
        recipe = chosen(solver, self._recipe(size * block, blocked=block > 1), "fluid_")
        weak = None if band is None else partial(band.surrounded, V)
        more: Any = {"tangent": tangent, "solver": recipe, "before": before, "rank_one": rank_one, "weak": weak}
        self.system = self._make_system(residual_f, bcs, **more, prefix="fluid_")
        self.free = ~np.isin(self.velocity_dofs, self.system.constrained)
        self.trace_dofs, self._reference = self.velocity_dofs, 0.0
        self._measure()

    def _recipe(self, unknowns: int, *, blocked: bool) -> LinearSolver:
        """Linear solver where the user has chosen none."""
        return automatic(unknowns, blocked=blocked, immersed=self.mesh.geometry.dim)

    def _make_system(self, residual: ufl.Form, bcs: Sequence[Any], **options: Any) -> FiniteElementSystem:
        return FiniteElementSystem(residual, self.timeInt.x, bcs, **options)

    def _measure(self) -> None:
        """What norms of the system's vectors are made with, which have to be made anew when those are others."""
        marks = np.zeros(self.system.local_size)
        marks[self.trace_dofs] = 1.0
        self._is_velocity = self.system.owned(marks)
        self._product = self.system.b.duplicate()
        compat.freed_with(self._is_velocity, self._product)  # made anew together

    def __repr__(self) -> str:
        parts = [f"{compat.unknowns(self.timeInt.x.function_space)} unknowns in {self.mesh.geometry.dim}D"]
        parts += [word for word, part in (("band", self.band), ("moving mesh", self.moving)) if part is not None]
        return f"FluidSubproblem({', '.join(parts)})"

    def place(
        self,
        meeting: Meeting,
        sheets: Sheets,
        x: FloatArray,
        v: FloatArray,
        load: Callable[[], FloatArray],
        *,
        scale_m: float,
        scale_c: float,
    ) -> Meeting:
        """Prepare the flow for a surface that has been placed in it (collective).

        Args:
            meeting: where it meets the fluid.
            sheets: how its points hang together.
            x: their positions, shape (points, d); unit: length.
            v: their velocities, same shape; unit: length/time.
            load: gives the multiplier that the step starts from, same shape; unit: force/area.
            scale_m: factor of tau_M near the surface.
            scale_c: divisor of tau_C there.

        Returns:
            The meeting as the flow's fields have it.
        """
        if self.band is not None:
            self.band.update(meeting.location, scale_m=scale_m, scale_c=scale_c)
        return meeting

    def suits(self, load: Callable[[], FloatArray]) -> bool:
        """Whether a step that ends with a multiplier should have placed the surface as this one did (collective).

        Args:
            load: gives the multiplier at the end, shape (points, d); unit: force/area.
        """
        return True

    def remember(self) -> Callable[[], None]:
        """Remember what :meth:`place` changes; the result brings it back."""
        scales = () if self.band is None else (self.band.scale_m, self.band.scale_c)
        saved = [scale.x.array.copy() for scale in scales]

        def bring_back() -> None:
            for scale, values in zip(scales, saved, strict=True):
                scale.x.array[:] = values

        return bring_back

    def _levels(self) -> tuple[FloatArray, FloatArray]:
        """Unknowns at the end of the step and at its start, local dofs."""
        return self.timeInt.x.x.array, self.timeInt.x_old.x.array

    def names(self, nodes: IntArray) -> IntArray:
        """Names that all ranks have for nodes of a trace.

        Args:
            nodes: local nodes.
        """
        return np.asarray(self.velocity_space.dofmap.index_map.local_to_global(nodes.astype(np.int32)))

    def diagonal(self) -> FloatArray:
        """Diagonal of the tangent at local dofs, ghosts as well (collective)."""
        self.system.A.getDiagonal(self._product)
        return self.system.to_local(self._product)

    def velocity_at(self, trace: TraceMatrix) -> FloatArray:
        """Velocity u_alpha at the points, the same on every rank (collective), shape (points, d)."""
        return ranks.total(self.comm, trace.B @ self._seen(trace))

    def power(self, forces: sp.csr_matrix, trace: TraceMatrix, less: FloatArray) -> FloatArray:
        """Power of forces on the trace's nodes by velocities u_alpha, less another one (collective), shape (n,).

        Args:
            forces: this rank's share, shape (nodes d, n).
            trace: of the nodes.
            less: what is subtracted, this rank's share, shape (n,).
        """
        return ranks.total(self.comm, forces.T @ self._seen(trace).ravel() - less)

    def _seen(self, trace: TraceMatrix) -> FloatArray:
        dofs, a = self.trace_dofs[trace.nodes], self.timeInt.x_factor
        x, x_old = self._levels()
        return np.asarray(a * x[dofs] + (1.0 - a) * x_old[dofs])

    def assemble_residual(
        self, trace: TraceMatrix, forces: FloatArray, impedance: float, beside: FloatArray | float = 0.0
    ) -> float:
        """Assemble the residual with the coupling forces.

        Args:
            trace: where the points are.
            forces: fluid on shell at the points, shape (points, d).
            impedance: pressure per velocity that makes continuity rows comparable with momentum rows.
            beside: fluid on shell at the trace's nodes, beside what those do there, shape (nodes, d), this rank's
                share.

        Returns:
            ``sqrt(|R_momentum|^2 + impedance^2 |R_continuity|^2)``; unit: force.
        """
        dofs = self.trace_dofs[trace.nodes]
        nodal = np.where(self.free[trace.nodes], trace.transposed @ forces + beside, 0.0)

        def load(b: FloatArray) -> None:
            b[dofs] += nodal

        self.system.assemble_residual(load)
        return self.norm(self.system.b, impedance)

    def norm(self, vector: PETSc.Vec, impedance: float) -> float:
        """Norm of a residual-like vector in units of force (collective)."""
        array = vector.array_r
        weights = self.as_forces(impedance**2)
        square = np.einsum("i,i,i->", weights, array, array)
        return float(np.sqrt(self.comm.allreduce(float(square), op=MPI.SUM)))

    def as_forces(self, impedance: float) -> FloatArray:
        """Factors of the rows of a vector of the system: one of momentum, an impedance of continuity."""
        return np.asarray(self._is_velocity + impedance * (1.0 - self._is_velocity))

    def coupling_norm(self, trace: TraceMatrix, forces: FloatArray, beside: FloatArray | float = 0.0) -> float:
        """Norm of forces on the fluid's nodes (collective; a node of two ranks counts in parts); unit: force.

        Args:
            trace: see :meth:`assemble_residual`.
            forces: see there.
            beside: see there.
        """
        nodal = trace.transposed @ forces + beside
        return float(np.sqrt(self.comm.allreduce(float(np.sum(nodal**2)), op=MPI.SUM)))

    def received(self, trace: TraceMatrix, forces: FloatArray, beside: FloatArray | float = 0.0) -> FloatArray:
        """Sum of the forces on the fluid (collective), shape (d,): those on nodes, as kinks vanish there.

        Args:
            trace: see :meth:`assemble_residual`.
            forces: see there.
            beside: see there.
        """
        nodal = (trace.transposed @ forces + beside)[trace.nodes < len(self.velocity_dofs)]
        return -np.asarray(self.comm.allreduce(nodal.sum(axis=0), op=MPI.SUM))

    def momentum_scale(self) -> float:
        """Size of the terms that balance in the flow but at outlets' resistances: tangent times state; unit: force."""
        if not self.system.has_tangent:
            return 0.0
        self.system.A.mult(self.system.state(), self._product)
        return self.norm(self.system.without_loads(self._product), 0.0)

    def assemble_tangent(self, trace: TraceMatrix, penalty_tangent: sp.csr_matrix) -> None:
        """Assemble the tangent with the penalty's part.

        Args:
            trace: where the points are.
            penalty_tangent: part of one velocity component, shape (len(trace.nodes), len(trace.nodes)).
        """

        def add(A: PETSc.Mat) -> None:
            K = penalty_tangent
            row = np.repeat(np.arange(K.shape[0]), np.diff(K.indptr))
            for dofs, free in zip(self.trace_dofs[trace.nodes].T, self.free[trace.nodes].T, strict=True):
                data = K.data if free.all() else K.data * (free[row] * free[K.indices])
                rows, columns = dofs.astype(PETSc.IntType), dofs[K.indices].astype(PETSc.IntType)
                A.setValuesLocalIJV(
                    K.indptr.astype(PETSc.IntType), columns, data, PETSc.InsertMode.ADD_VALUES, rowmap=rows
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
        return self.system.linear_rtol * self._reference

    def speed(self) -> float:
        """Largest nodal speed relative to the mesh on any rank (collective); unit: length/time."""
        return largest_speed(self.timeInt, self.moving, self.velocity_space, self.velocity_dofs)
