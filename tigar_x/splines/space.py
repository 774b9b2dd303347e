"""``SplineSpace``: spline fields as finite element functions with an extraction matrix."""

from collections.abc import Sequence
from functools import cached_property

import numpy as np
import scipy.sparse as sp
from dolfinx import fem, mesh
from numpy.typing import ArrayLike
from petsc4py import PETSc

from tigar_x import checks, compat
from tigar_x.compat import FloatArray, IntArray
from tigar_x.fem.linear import PreparedSolver, direct
from tigar_x.splines.constraints import null_space
from tigar_x.splines.extraction import Evaluable, element_degree, node_matrix, petsc_matrix, set_nodal


class SplineSpace:
    """Spline fields over a parametric mesh.

    A field of several parts is a mixed one, such as velocity and pressure of different degree. Coefficients count
    function * size + component through the first part, then the next.

    Args:
        domain: parametric mesh.
        parts: functions and number of components of every part.
        zero_dofs: coefficients whose increments vanish.
        constraints: further homogeneous linear constraints between coefficients, blocks of rows ``G U = 0`` (see
            :mod:`tigar_x.splines.constraints`).

    Attributes:
        V: Lagrange space; blocked for one part of several components, mixed for several parts.
        M: extraction matrix (PETSc) from free coefficients to nodal values. Without constraints all are free.
        zero_dofs: columns of ``M`` whose increments vanish; empty with constraints, which drop these columns.
        n: number of coefficients, constrained ones included.
        fixed: the coefficients given as zero dofs, sorted.
        constraints: all rows of G, shape (constraints, n).

    Raises:
        ValueError: no part, a zero dof out of range, a mask of them, or constraints of another size.
    """

    def __init__(
        self,
        domain: mesh.Mesh,
        *parts: tuple[Evaluable, int],
        zero_dofs: ArrayLike | Sequence[int] = (),
        constraints: Sequence[sp.spmatrix] = (),
    ) -> None:
        if not parts:
            raise ValueError("parts is empty: one field or more is required")
        compat.free_dropped(domain.comm)
        self.mesh = domain
        self.parts = tuple((functions, checks.whole("size", size, 1)) for functions, size in parts)
        simplices = compat.is_simplex(domain)
        shapes = [(element_degree(functions.degrees, simplices), size) for functions, size in self.parts]
        if len(shapes) == 1:
            self.V = compat.lagrange_space(domain, *shapes[0])
        else:
            self.V = compat.mixed_lagrange_space(domain, *shapes)
        self.sizes = tuple(functions.n * size for functions, size in self.parts)
        self.n = sum(self.sizes)
        fixed: IntArray = np.unique(checks.indices("zero_dofs", zero_dofs, self.n))
        self.fixed = fixed
        self._T = null_space(constraints, fixed, self.n) if len(constraints) else None
        self.constraints = sp.vstack([sp.csr_matrix((0, self.n)), *constraints], format="csr")
        self.zero_dofs = fixed if self._T is None else fixed[:0]
        self.M = petsc_matrix(self.rows, domain.comm)
        compat.freed_with(self, self.M)

    @property
    def admissible(self) -> sp.csr_matrix:
        """All coefficients from those that conditions leave free, shape (n, free)."""
        if self._T is not None:
            return self._T
        return sp.identity(self.n, format="csr")[:, np.setdiff1d(np.arange(self.n), self.fixed)]

    @cached_property
    def rows(self) -> sp.csr_matrix:
        """This rank's rows of ``M``: its owned nodal values from all free coefficients."""
        return self._rows if self._T is None else self._rows @ self._T

    @cached_property
    def nodes(self) -> sp.csr_matrix:
        """Values of the functions of a space of one part at this rank's nodes, shape (nodes, functions)."""
        if len(self.parts) > 1:
            raise ValueError("the space has several parts: their nodes differ")
        return node_matrix(self.parts[0][0], self.V)

    @cached_property
    def _rows(self) -> sp.csr_matrix:
        """Extraction of this rank's owned nodal values, before constraints."""
        dofmap = self.V.dofmap
        owned = dofmap.index_map.size_local * dofmap.index_map_bs
        if len(self.parts) == 1:
            return sp.kron(self.nodes, sp.identity(self.parts[0][1]), format="csr")[:owned]
        total = owned + dofmap.index_map.num_ghosts * dofmap.index_map_bs
        rows, first, component = sp.csr_matrix((total, self.n)), 0, 0
        for functions, size in self.parts:
            for c in range(size):
                scalar, parent = compat.component_space(self.V, component)
                values = node_matrix(functions, scalar).tocoo()
                place = (parent[values.row], first + values.col * size + c)
                rows += sp.csr_matrix((values.data, place), shape=rows.shape)
                component += 1
            first += functions.n * size
        return rows[:owned]

    # -- fields -------------------------------------------------------------------------------------------------------

    def function(self, coefficients: ArrayLike | None = None, name: str = "f") -> fem.Function:
        """Field of the space.

        Args:
            coefficients: homogeneous spline coefficients, shape (functions, size) for one part, (n,) for several;
                None: zero.
            name: name for output.

        Returns:
            The homogeneous field.
        """
        u = fem.Function(self.V, name=name)
        if coefficients is None:
            return u
        if len(self.parts) == 1:
            functions, size = self.parts[0]
            set_nodal(u, self.nodes @ checks.array("coefficients", coefficients, (functions.n, size)))
        else:
            values = self._rows @ checks.array("coefficients", coefficients, (self.n,))
            u.x.array[: len(values)] = values
            u.x.scatter_forward()
        return u

    def coefficients(self, u: fem.Function) -> FloatArray:
        """Spline coefficients of a field of the space, on every rank: the least squares solution of ``M U = u``.

        Args:
            u: homogeneous field.

        Returns:
            Coefficients, shape (functions, size) for one part, (n,) for several.

        Raises:
            ValueError: the field is not one of this space.
        """
        found = compat.unknowns(u.function_space)
        if found != self.M.size[0]:
            raise ValueError(f"u has {found} nodal values: a field of this space, with {self.M.size[0]}, is required")
        nodal, rest, load, increment = self._work
        nodal.array_w[:] = u.x.array[: nodal.getLocalSize()]
        total = np.zeros(increment.getLocalSize())
        for _ in range(2):  # the second pass takes away the rounding of the normal equations
            self.M.multTranspose(nodal, load)
            self._normal_equations.solve(load, increment)
            total += increment.array_r
            self.M.mult(increment, rest)
            nodal.axpy(-1.0, rest)
        free = np.concatenate(self.mesh.comm.allgather(total))
        U = free if self._T is None else self._T @ free
        return U.reshape(-1, self.parts[0][1]) if len(self.parts) == 1 else U

    @cached_property
    def _work(self) -> tuple[PETSc.Vec, PETSc.Vec, PETSc.Vec, PETSc.Vec]:
        right, left = self.M.createVecs()
        return left, left.duplicate(), right, right.duplicate()

    @cached_property
    def _normal_equations(self) -> PreparedSolver:
        return PreparedSolver(direct(), self.M.transposeMatMult(self.M))
