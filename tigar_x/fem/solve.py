"""Nonlinear systems in finite element spaces; the Newton loop that solves them comes from :mod:`tigar_x.fem.newton`.

Increments are subtracted throughout: ``K dx = R``, ``x <- x - dx``.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import ufl
from dolfinx import fem
from petsc4py import PETSc

from tigar_x import checks, compat
from tigar_x.compat import FloatArray, IntArray
from tigar_x.fem import rounding
from tigar_x.fem.kept import KeptMatrix
from tigar_x.fem.linear import LinearSolver, PreparedSolver, chosen, direct
from tigar_x.fem.low_rank import LowRank, RankOne
from tigar_x.fem.newton import NewtonReport, System, newton
from tigar_x.fem.nodes import RowNodes

__all__ = ["FiniteElementSystem", "NewtonReport", "RankOne", "System", "newton"]


class FiniteElementSystem:
    """A residual in a finite element space with strong boundary conditions.

    Args:
        residual: UFL residual R(x; test).
        x: the unknown.
        bcs: strong conditions; their values enter through :meth:`apply_boundary_values`.
        tangent: UFL tangent; None: the derivative of the residual.
        solver: linear solver recipe, or a KSP; None: direct.
        constant: dofs of a field that the equations determine up to a constant, such as the pressure of an enclosed
            flow: the part of the residual that no state can balance is taken out, and so is the constant of every
            increment. Needs an iterative solver. None: there is no such field.
        rank_one: loads whose tangent is dense.
        before: called before every assembly of the residual, to bring along what follows the unknown.
        resolution: gives what rounding of each local dof refers to beside its own value, shape (dofs,), as a solid's
            velocity that deforms it by one. None: nothing.
        weak: gives the mask of the local nodes, shape (nodes,), at which the last unknown, a pressure, has a weak
            diagonal (collective); None: nothing is known of that.
        prefix: of the PETSc options that go before the recipe's, see :mod:`tigar_x.fem.petsc_options`.

    Attributes:
        A: tangent matrix.
        b: residual vector, with ghosts.
        recipe: linear solver recipe.
        iterations: linear iterations of the last solve.
        has_tangent: whether a tangent has been assembled.
        layout: number of times that the vectors were made, with sizes that differ where the unknowns do.

    Raises:
        ValueError: an argument is of another kind, as where they come in another order.
    """

    def __init__(
        self,
        residual: ufl.Form,
        x: fem.Function,
        bcs: Sequence[Any] = (),
        *,
        tangent: ufl.Form | None = None,
        solver: LinearSolver | PETSc.KSP | None = None,
        constant: IntArray | None = None,
        rank_one: Sequence[RankOne] = (),
        before: Sequence[Callable[[], None]] = (),
        resolution: Callable[[], FloatArray] | None = None,
        weak: Callable[[], Any] | None = None,
        prefix: str = "",
    ) -> None:
        checks.kind("residual", residual, ufl.Form, "a form, and then the unknown")
        checks.kind("x", x, fem.Function, "the unknown function, after the residual")
        checks.listed("bcs", bcs)
        compat.free_dropped(x.function_space.mesh.comm)
        self.x = x
        self.bcs = tuple(bcs)
        self.recipe = chosen(solver, direct(), prefix)
        self.constrained = compat.constrained_dofs(self.bcs)
        self.iterations = self.layout = 0
        self._weak, self._floating, self._keeping = weak, constant is not None, self.recipe.keeping()
        self._make(residual, ufl.derivative(residual, x) if tangent is None else tangent)
        self._null = None if constant is None else self._null_space(constant)
        self._low_rank = LowRank(rank_one, x.function_space, self.constrained) if rank_one else None
        self._before = tuple(before)
        self._resolution = resolution

    def _make(self, residual: ufl.Form, tangent: ufl.Form) -> None:
        """Compile the equations, and make what they are assembled into."""
        self._residual, whole, self._tangent = compat.equations(residual, tangent)
        blocked = self.x.function_space.dofmap.index_map_bs > 1
        A = compat.create_matrix(whole, self.recipe.matrix if blocked else "aij")
        self._lay_out(self, A, compat.create_vector(self.x.function_space))

    def _lay_out(self, owner: Any, A: PETSc.Mat, b: PETSc.Vec) -> None:
        """Take over a matrix and a vector, which are freed with their owner."""
        self.A, self.b, self._dx = A, b, b.duplicate()
        compat.freed_with(owner, A, b, self._dx)
        nodes = self.nodes_of_rows() if self.recipe.needs_nodes else None
        self._solver = PreparedSolver(self.recipe, A, nodes, self._keeping)
        self._kept = KeptMatrix(A)
        self.has_tangent = False
        self.layout += 1

    def nodes_of_rows(self) -> RowNodes | None:
        """What a preconditioner may know of this rank's nodes; None: the components have none in common."""
        V, bs = self.x.function_space, self.x.function_space.dofmap.index_map_bs
        if bs == 1:
            return None
        own, held = V.dofmap.index_map.size_local, np.zeros(len(self.x.x.array), dtype=bool)
        held[self.constrained] = True
        weak = self._weak
        marks = None if weak is None else (lambda: weak()[:own])
        return RowNodes(
            V.tabulate_dof_coordinates()[:own], held.reshape(-1, bs)[:own], weak=marks, floating=self._floating
        )

    def _null_space(self, constant: IntArray) -> PETSc.NullSpace:
        """Of the tangent and of its transpose, attached to it."""
        direction = self.b.duplicate()
        direction.set(0.0)
        owned = constant[constant < direction.getLocalSize()]
        direction.array_w[owned] = 1.0
        direction.normalize()
        null = PETSc.NullSpace().create(vectors=[direction], comm=self.A.comm)
        self.A.setNullSpace(null)
        compat.freed_with(self, direction, null)
        return null

    def apply_boundary_values(self) -> None:
        """Write the prescribed values into the unknown."""
        compat.apply_values(self.x, self.bcs)

    def assemble_residual(self, load: Callable[[FloatArray], None] | None = None) -> float:
        """Assemble the residual.

        Args:
            load: adds further contributions to this rank's array (owned dofs, then ghosts).

        Returns:
            Its Euclidean norm.
        """
        for update in self._before:
            update()
        compat.assemble_vector(self.b, self._residual)
        with self.b.localForm() as local:
            if load is not None:
                load(local.array_w)
        self.b.ghostUpdate(PETSc.InsertMode.ADD, PETSc.ScatterMode.REVERSE)
        owned = self.constrained[self.constrained < self.b.getLocalSize()]
        self.b.array_w[owned] = 0.0
        if self._null is not None:
            self._null.remove(self.b)
        return float(self.b.norm())

    def assemble_tangent(self, add: Callable[[PETSc.Mat], None] | None = None) -> None:
        """Assemble the tangent.

        Args:
            add: adds further contributions by local indices; must leave rows and columns of constrained dofs alone.
        """
        self._kept.replacing()
        compat.assemble_matrix(self.A, self._tangent, self.bcs)
        if add is not None:
            self.A.assemble()
            add(self.A)
        self.A.assemble()
        self.has_tangent = True
        if self._low_rank is not None:
            self._low_rank.forget()

    def remember_tangent(self) -> Callable[[], None]:
        """Remember the present tangent; the result brings it back. For steps that keep tangents and may fail."""
        had = self.has_tangent
        self._kept.remember(had)

        def bring_back() -> None:
            self._kept.bring_back()
            self.has_tangent = had
            if self._low_rank is not None:
                self._low_rank.forget()

        return bring_back

    def solve(self, reference: float | None = None) -> PETSc.Vec:
        """Solve for the increment.

        Args:
            reference: norm that an iterative solver's relative tolerance refers to; None: that of the residual.

        Returns:
            The increment, valid until the next solve.

        Raises:
            SolveError: the linear solver failed.
        """
        if self._low_rank is None:
            self.iterations = self._solver.solve(self.b, self._dx, reference)
        else:
            self.iterations = self._low_rank.solve(self.b, self._dx, self._solver, self.A, reference)
        if self._null is not None:
            self._null.remove(self._dx)
        return self._dx

    def multiply(self, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """The product of the tangent, with loads of ``rank_one``, and a vector (collective).

        Args:
            x: vector.
            y: overwritten by the product.
        """
        self.A.mult(x, y)
        if self._low_rank is not None:
            self._low_rank.add_product(x, y)

    def preconditioner(self) -> PETSc.PC:
        """That of the linear solver, for the tangent as it is (collective); ``rank_one`` is not in it.

        Raises:
            SolveError: it could not be made.
        """
        return self._solver.preconditioner()

    def served(self, iterations: float) -> None:
        """Take note of how many iterations a solve with that has taken, infinitely many if it failed."""
        self._solver.served(iterations)

    @property
    def linear_rtol(self) -> float:
        """Reduction of the residual's norm at which the linear solver stops; 0 for a factorisation."""
        return self._solver.rtol

    def reference_norm(self) -> float:
        """Norm of the residual that relative tolerances may refer to (collective), without the loads of ``rank_one``.

        A large resistance makes much of the least change of a flow rate.
        """
        return float(self.b.norm()) if self._low_rank is None else self._low_rank.rest(self.b)

    def without_loads(self, vector: PETSc.Vec) -> PETSc.Vec:
        """The vector of forces, out of which the loads of ``rank_one`` are taken (collective)."""
        if self._low_rank is not None:
            self._low_rank.remove(vector)
        return vector

    def rounding(self) -> float:
        """Size of the rounding error in the residual, from the last tangent and the present state (collective)."""
        if not self.has_tangent:
            return 0.0
        x, sizes = compat.petsc_vector(self.x), None if self._resolution is None else self._resolution()
        low_rank = 0.0 if self._low_rank is None else self._low_rank.rounding(x)
        return rounding.ROUNDING * (rounding.of_tangent(self.A, x, sizes, self.constrained) + low_rank)

    @property
    def local_size(self) -> int:
        """Number of local dofs, ghosts as well."""
        return len(self.x.x.array)

    @property
    def entries(self) -> IntArray:
        """Where local dofs are in this rank's part of a vector of the system, -1: nowhere, shape (local size,)."""
        own = np.arange(self.local_size)
        return np.where(own < self.b.getLocalSize(), own, -1)

    def owned(self, local: FloatArray) -> FloatArray:
        """This rank's entries of a vector of the system out of values at local dofs, ghosts as well."""
        return local[: self.b.getLocalSize()]

    def to_local(self, vector: PETSc.Vec) -> FloatArray:
        """A vector of the system at local dofs, ghosts as well (collective), shape (local size,)."""
        vector.ghostUpdate(PETSc.InsertMode.INSERT, PETSc.ScatterMode.FORWARD)
        with vector.localForm() as local:
            return local.array_r.copy()

    def from_local(self, local: FloatArray, vector: PETSc.Vec) -> None:
        """Overwrite a vector of the system by contributions of all ranks to local dofs (collective)."""
        with vector.localForm() as form:
            form.array_w[:] = local
        vector.ghostUpdate(PETSc.InsertMode.ADD, PETSc.ScatterMode.REVERSE)

    def state(self) -> PETSc.Vec:
        """The unknown as a vector of the system."""
        return compat.petsc_vector(self.x)

    def subtract(self, increment: PETSc.Vec) -> None:
        """Subtract an increment from the unknown, ghosts included."""
        self.x.x.array[: increment.getLocalSize()] -= increment.array_r
        self.x.x.scatter_forward()
