"""Systems on splines: ``M^T A M``, ``M^T b``. Increments are subtracted, as in :mod:`tigar_x.fem.solve`."""

from typing import TYPE_CHECKING

import numpy as np
import scipy.sparse as sp
import ufl
from mpi4py import MPI
from dolfinx import fem
from numpy.typing import ArrayLike
from petsc4py import PETSc

from tigar_x import checks, compat
from tigar_x.compat import FloatArray
from tigar_x.fem import rounding
from tigar_x.fem.extracted import Extracted
from tigar_x.fem.linear import LinearSolver, PreparedSolver, SolveError, chosen, direct

if TYPE_CHECKING:
    from tigar_x.fem.factors import BandLayout, Factors
    from tigar_x.splines.part import Part


class SplineSystem:
    """A residual on a spline, extracted: ``M^T A M``, ``M^T b``, with zero rows and columns at the zero dofs.

    Args:
        space: the extracted spline, for its ``V``, or another space on it.
        residual: UFL residual in ``space.V``.
        tangent: UFL tangent; the unknown is what the caller differentiated by.
        solver: linear solver recipe, or a KSP; None: direct.
        unknown: what :meth:`subtract` moves; None: the caller adds increments itself.
        zero_dofs: spline coefficients whose increments vanish; None: those of the space.
        prefix: of the PETSc options that go before the recipe's, see :mod:`tigar_x.fem.petsc_options`.

    Attributes:
        b: extracted residual.
        iterations: linear iterations of the last solve.

    Raises:
        ValueError: a zero dof is out of range, a mask is given, or arguments come in another order.
    """

    def __init__(
        self,
        space: Extracted,
        residual: ufl.Form,
        tangent: ufl.Form,
        solver: LinearSolver | PETSc.KSP | None = None,
        *,
        unknown: fem.Function | None = None,
        zero_dofs: ArrayLike | None = None,
        prefix: str = "",
    ) -> None:
        checks.having("space", space, "V M", "an ExtractedSpline, or a space on one,")
        checks.kind("residual", residual, ufl.Form, "a form, after the space")
        checks.kind("tangent", tangent, ufl.Form, "a form, after the space and the residual")
        compat.free_dropped(space.V.mesh.comm)
        self.space = space
        self.unknown = unknown
        self._forms = residual, tangent
        self._residual, self._tangent = compat.compile_forms(residual, tangent)
        self._A_fe = compat.create_matrix(self._tangent, "aij")
        self._b_fe = compat.create_vector(space.V)
        self._diagonal = self._b_fe.duplicate()
        self._dx_fe = self._b_fe.duplicate()
        self.b = space.M.createVecRight()
        self._dx = self.b.duplicate()
        self._product = self.b.duplicate()  # work space: making vectors again and again would leak in petsc4py
        first, last = self.b.getOwnershipRange()
        given = space.zero_dofs if zero_dofs is None else zero_dofs
        fixed = checks.indices("zero_dofs", given, space.M.size[1]).ravel().astype(PETSc.IntType)
        self._zero = fixed[(fixed >= first) & (fixed < last)]
        self._zero_local = self._zero - first
        self._A: PETSc.Mat | None = None
        self._own: PETSc.Mat | None = None  # the form's part, whose product is reused
        self._A_fe_M: PETSc.Mat | None = None
        self._M_T = space.M.transpose(PETSc.Mat())  # two products with it take two thirds of the time of PETSc's PtAP
        made = (self._A_fe, self._b_fe, self._diagonal, self._dx_fe, self.b, self._dx, self._product, self._M_T)
        compat.freed_with(self, *made)
        self._recipe = chosen(solver, direct(), prefix)
        self._solver: PreparedSolver | None = None
        self._factors: Factors | None = None
        self._layout: BandLayout | None = None  # of factors
        self._part: Part | None = None
        self._by_factors, self.iterations = False, 0

    def share(self, comm: MPI.Comm) -> None:
        """Integrate and extract a part on each of the ranks that hold the spline whole (collective), from here on.

        Whatever integrates or extracts is collective then. Forms that cannot be confined to elements stay whole. What
        MUMPS would solve is solved by :class:`tigar_x.fem.factors.Factors`, of which bands take less.

        Args:
            comm: the ranks, one of which alone shares nothing; later, what takes the place of the former communicator.
        """
        self._by_factors = self._recipe == direct()
        if self._part is not None:
            self._part.comm, self._factors = comm, None
        elif comm.size > 1:
            from tigar_x.splines.part import Part, confined  # one rank needs nothing of it

            if confined(*self._forms):
                self._part = Part(comm, self.space, *self._forms)
                self._A_fe.destroy()
                self._own = self._A = None

    @property
    def is_shared(self) -> bool:
        """Whether each rank integrates and extracts a part, see :meth:`share`."""
        return self._part is not None

    @property
    def has_tangent(self) -> bool:
        """Whether a tangent has been assembled."""
        return self._A is not None

    @property
    def A(self) -> PETSc.Mat:
        """Extracted tangent of the last :meth:`assemble_tangent`."""
        if self._A is None:
            raise SolveError("no tangent has been assembled yet")
        return self._A

    def assemble_residual(self, load: FloatArray | None = None) -> float:
        """Assemble and extract the residual.

        Args:
            load: nodal values to add to the finite element residual, shape (nodes, nsd).

        Returns:
            Euclidean norm of the extracted residual.
        """
        if self._part is None:
            self._integrate_residual(load)
        else:
            self.b.array_w[:] = self._part.residual(load)
        self.b.array_w[self._zero_local] = 0.0
        return float(self.b.norm())

    def _integrate_residual(self, load: FloatArray | None) -> None:
        """Overwrite ``b`` by the residual and nodal values, extracted."""
        compat.assemble_vector(self._b_fe, self._residual)
        if load is not None:
            with self._b_fe.localForm() as local:
                local.array_w += load.ravel()
        self._b_fe.ghostUpdate(PETSc.InsertMode.ADD, PETSc.ScatterMode.REVERSE)
        self.space.M.multTranspose(self._b_fe, self.b)

    def extract(self, nodal: FloatArray) -> FloatArray:
        """``M^T`` of nodal values, zero at the zero dofs.

        Args:
            nodal: shape (nodes, nsd), this rank's share.

        Returns:
            This rank's spline values.
        """
        self._diagonal.array_w[:] = nodal.ravel()
        self.space.M.multTranspose(self._diagonal, self._product)
        self._product.array_w[self._zero_local] = 0.0
        return self._product.array_r.copy()

    def product_norm(self, nodal: FloatArray) -> float:
        """Norm of ``M^T A_FE x`` without the zero dofs, zero before the first tangent.

        Args:
            nodal: homogeneous nodal values x, this rank's owned dofs first, any shape of that size.

        Returns:
            Euclidean norm; unit of the residual.
        """
        if self._A is None:
            return 0.0
        if self._part is not None:
            self._product.array_w[:] = self._part.product(nodal)
        else:
            self._dx_fe.array_w[:] = nodal.ravel()[: self._dx_fe.getLocalSize()]
            self._A_fe.mult(self._dx_fe, self._diagonal)
            self.space.M.multTranspose(self._diagonal, self._product)
        self._product.array_w[self._zero_local] = 0.0
        return float(self._product.norm())

    def rounding(self) -> float:
        """Size of the rounding error in the residual, from the last tangent (collective); unit of the residual.

        What the tangent makes of positions and unknown with signs at random, as their rounding errors have them.
        """
        if self.unknown is None:
            return 0.0
        sizes = np.abs(self.unknown.x.array)
        positions = getattr(self.space, "node_positions", None)
        if positions is not None:
            sizes = sizes + np.abs(positions - positions[:1]).ravel()
        signs = np.random.default_rng(self.space.V.mesh.comm.rank).choice([-1.0, 1.0], len(sizes))
        return rounding.ROUNDING * self.product_norm(signs * sizes)

    def assemble_tangent(self, diagonal: FloatArray | None = None, pairs: sp.spmatrix | None = None) -> None:
        """Assemble, extract and constrain the tangent; the symbolic product of the form's part is made once.

        Args:
            diagonal: values to add to the diagonal of the finite element matrix, shape (nodes, nsd).
            pairs: finite element matrix of forces between any nodes, such as contact, over the dofs (node * nsd +
                component) of a spline that lives on one rank; where that is shared, each rank's share of them.
        """
        self.integrate_tangent(diagonal)
        self.extract_tangent(pairs)

    def integrate_tangent(self, diagonal: FloatArray | None = None) -> None:
        """First half of :meth:`assemble_tangent`: the finite element matrix.

        Args:
            diagonal: see there.
        """
        if self._part is not None:
            self._part.integrate(diagonal)
            return
        compat.assemble_matrix(self._A_fe, self._tangent)
        self._A_fe.assemble()
        if diagonal is not None:
            self._diagonal.array_w[:] = diagonal.ravel()
            self._A_fe.setDiagonal(self._diagonal, PETSc.InsertMode.ADD_VALUES)

    def extract_tangent(self, pairs: sp.spmatrix | None = None) -> None:
        """Second half of :meth:`assemble_tangent`: ``M^T A M`` of that matrix, constrained.

        Args:
            pairs: see there.
        """
        if self._part is not None:
            first, self._own = self._own is None, self._part.extracted()
            if first:
                self._refuse_empty_rows(self._own)
        elif self._own is None:
            self._A_fe_M = self._A_fe.matMult(self.space.M)
            self._own = self._M_T.matMult(self._A_fe_M)
            self._own.setOption(PETSc.Mat.Option.KEEP_NONZERO_PATTERN, True)
            compat.freed_with(self, self._A_fe_M, self._own)
            self._refuse_empty_rows(self._own)
        else:
            self._A_fe.matMult(self.space.M, result=self._A_fe_M)
            self._M_T.matMult(self._A_fe_M, result=self._own)
        between = None if pairs is None else self._extracted(pairs)
        if between is not None and between.nnz:
            self._bind(self._with_pairs(self._own, between))
        elif self._A is not self._own:
            self._bind(self._own)
        self.A.zeroRowsColumns(self._zero, diag=1.0)
        self._factors = None

    def _refuse_empty_rows(self, A: PETSc.Mat) -> None:
        """PETSc can put no one on a diagonal that is not stored, and would stop one rank only."""
        empty = any(len(A.getRow(int(row))[0]) == 0 for row in self._zero)
        if self.space.V.mesh.comm.allreduce(empty, op=MPI.LOR):
            raise SolveError("tangent has no entries at a zero dof: integrate it over all elements of the spline")

    def _bind(self, A: PETSc.Mat) -> None:
        """Solve with another matrix; one with pairs has a new pattern every time."""
        if self._solver is not None:
            self._solver.destroy()
        if self._A is not None and self._A is not self._own:
            self._A.destroy()
        self._A, self._solver = A, PreparedSolver(self._recipe, A)

    def _extracted(self, pairs: sp.spmatrix) -> sp.csr_matrix:
        """What forces between nodes are between coefficients."""
        rows = self.space.rows
        if rows.shape[0] != pairs.shape[0]:
            raise ValueError(f"pairs has shape {pairs.shape}: a spline on one rank with {rows.shape[0]} dofs is needed")

        def extracted() -> sp.csr_matrix:
            return (rows.T @ (pairs @ rows)).tocsr() if pairs.nnz else sp.csr_matrix((rows.shape[1],) * 2)

        return extracted() if self._part is None else self._part.gathered(extracted)

    def _with_pairs(self, form_part: PETSc.Mat, between: sp.csr_matrix) -> PETSc.Mat:
        """Extracted tangent with the forces between coefficients."""
        indptr, columns, values = form_part.getValuesCSR()
        total = sp.csr_matrix((values, columns, indptr), shape=form_part.size) + between
        A = compat.matrix_of(total, comm=form_part.comm)
        A.setOption(PETSc.Mat.Option.KEEP_NONZERO_PATTERN, True)
        return A

    def solve(self) -> PETSc.Vec:
        """Solve for the increment of the spline coefficients, by the factors of :meth:`inverse` where it has made them.

        Returns:
            The increment, valid until the next solve.

        Raises:
            SolveError: no tangent yet, or the linear solver failed.
        """
        if self._solver is None:
            raise SolveError("no tangent has been assembled yet")
        if self._factors is None and not self._by_factors:
            self.iterations = self._solver.solve(self.b, self._dx)
        else:
            self._dx.array_w[:], self.iterations = self.inverse(self.b.array_r), 1
        return self._dx

    def inverse(self, load: FloatArray) -> FloatArray:
        """The tangent's inverse times spline values that are zero at the zero dofs, on one rank.

        Factors of its own serve many such products, each of which costs no more than two substitutions.

        Args:
            load: spline values, or columns of them.

        Returns:
            Spline coefficients, of the same shape.

        Raises:
            SolveError: no tangent yet, or it is singular.
        """
        if self._factors is None:
            from tigar_x.fem.factors import Factors  # few systems are asked for this

            comm = None if self._part is None else self._part.comm
            A = sp.csr_matrix(self.A.getValuesCSR()[::-1], shape=self.A.size)  # entries, columns, starts of rows
            self._factors = Factors(A, comm, like=self._layout)
            self._layout = self._factors.layout
        return self._factors.solve(load)

    def add(self, u: fem.Function, increment: PETSc.Vec, factor: float = 1.0) -> None:
        """Add ``factor * M increment`` to a function of ``space.V``, ghosts included."""
        self.space.M.mult(increment, self._dx_fe)
        u.x.array[: self._dx_fe.getLocalSize()] += factor * self._dx_fe.array_r
        u.x.scatter_forward()

    def subtract(self, increment: PETSc.Vec) -> None:
        """Subtract an increment from the unknown."""
        if self.unknown is None:
            raise SolveError("the system was made without its unknown")
        self.add(self.unknown, increment, -1.0)


def solve_linear(system: SplineSystem) -> None:
    """Solve a linear problem: one increment from any start.

    Args:
        system: residual and tangent of a problem that is linear in its unknown.

    Raises:
        SolveError: the linear solver failed.
    """
    system.assemble_residual()
    system.assemble_tangent()
    system.subtract(system.solve())
