"""One rank's part of a system on a spline that several ranks hold whole: each integrates some of the cells.

Each of these ranks, as those of a flow in which a shell is immersed, takes a contiguous part of the elements, extracts
what it has integrated, and one sum over the ranks gives all of them the same.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import scipy.sparse as sp
import ufl
from mpi4py import MPI
from petsc4py import PETSc

from tigar_x import compat, ranks
from tigar_x.compat import FloatArray, IntArray
from tigar_x.fem.extracted import Extracted


class Part:
    """The part of a system that a rank integrates.

    Args:
        comm: the ranks that hold the spline.
        space: the extracted spline, or a space on it, on one rank.
        residual: UFL residual in ``space.V``, see :class:`tigar_x.compat.PartialForm`.
        tangent: its tangent.

    Attributes:
        comm: as given.

    Raises:
        ValueError: a form has integrals that cannot be confined to some elements.
    """

    def __init__(self, comm: MPI.Comm, space: Extracted, residual: ufl.Form, tangent: ufl.Form) -> None:
        self.comm = comm
        forms = compat.partial_forms(residual, tangent)
        cells = compat.cell_dofs(space.V)
        part = np.empty(len(cells), dtype=np.int64)
        part[_along(space.V.mesh)] = comm.size * np.arange(len(cells)) // max(1, len(cells))
        mine = part == comm.rank
        self._residual, self._tangent = (form.on(mine) for form in forms)
        size, count = space.V.dofmap.index_map_bs, compat.unknowns(space.V)
        owner = np.full(count // size, comm.size)
        np.minimum.at(owner, cells, part[:, None])
        self._first = np.repeat(owner == comm.rank, size)
        nodes = np.unique(cells[mine])
        self._dofs: IntArray = (size * nodes[:, None] + np.arange(size)).ravel()
        self._mine = np.flatnonzero(self._first[self._dofs])
        rows = space.rows[self._dofs]
        seen = np.unique(rows.indices)
        self._columns, self._n = seen, rows.shape[1]
        self._A = _matrix(cells[mine], nodes, size, len(owner))
        self._M = compat.matrix_of(rows[:, seen])
        self._M_T = self._M.transpose(PETSc.Mat())
        self._A_M = self._A.matMult(self._M)
        self._K = self._M_T.matMult(self._A_M)
        self._x, self._diagonal = self._A.createVecs()
        self._load, self._b = self._M.createVecRight(), compat.create_vector(space.V)
        made = (self._A, self._M, self._M_T, self._A_M, self._K, self._x, self._diagonal, self._load, self._b)
        compat.freed_with(self, *made)
        self.integrate(None)
        self._lay_out()

    def _lay_out(self) -> None:
        """The pattern of the sum over the ranks, and where the entries of this rank's part are in it (collective)."""
        indptr, columns, _ = self._K.getValuesCSR()
        row = self._columns[np.repeat(np.arange(len(self._columns)), np.diff(indptr))]
        keys = row * np.int64(self._n) + self._columns[columns]
        every = np.unique(np.concatenate(self.comm.allgather(keys)))
        self._places = np.searchsorted(every, keys)
        self._values = np.zeros(len(every))
        indptr = np.searchsorted(every, np.arange(self._n + 1) * np.int64(self._n))
        csr = (indptr.astype(PETSc.IntType), (every % self._n).astype(PETSc.IntType), self._values)
        self._sum = PETSc.Mat().createAIJWithArrays((self._n, self._n), csr, comm=MPI.COMM_SELF)
        self._sum.setOption(PETSc.Mat.Option.KEEP_NONZERO_PATTERN, True)
        compat.freed_with(self, self._sum)

    def residual(self, load: FloatArray | None) -> FloatArray:
        """The residual of the whole, extracted (collective), shape (coefficients,).

        Args:
            load: values to add to the residual at all degrees of freedom before extraction; None: none.
        """

        def share() -> FloatArray:
            compat.assemble_vector(self._b, self._residual)
            self._diagonal.array_w[:] = self._b.array_r[self._dofs]
            if load is not None:
                self._diagonal.array_w[self._mine] += load.ravel()[self._dofs[self._mine]]
            return self._share_of_extracted()

        return ranks.summed(self.comm, self._n, share)

    def _share_of_extracted(self) -> FloatArray:
        """What extraction makes of this part's values in the work space, zero elsewhere, shape (coefficients,)."""
        self._M.multTranspose(self._diagonal, self._load)
        result = np.zeros(self._n)
        result[self._columns] = self._load.array_r
        return result

    def integrate(self, diagonal: FloatArray | None) -> None:
        """Have the tangent integrated anew where it is extracted next.

        Args:
            diagonal: values to add to the diagonal of the whole, at all degrees of freedom; None: none.
        """
        self._diagonal_of = None if diagonal is None else np.where(self._first, diagonal.ravel(), 0.0)[self._dofs]
        self._total: FloatArray | None = None

    def _share(self) -> FloatArray:
        """This rank's part of the extracted tangent, in the pattern of the whole."""
        compat.assemble_matrix(self._A, self._tangent)
        self._A.assemble()
        if self._diagonal_of is not None:
            self._diagonal.array_w[:] = self._diagonal_of
            self._A.setDiagonal(self._diagonal, PETSc.InsertMode.ADD_VALUES)
        self._A.matMult(self._M, result=self._A_M)
        self._M_T.matMult(self._A_M, result=self._K)
        values = np.zeros(len(self._values))
        values[self._places] = self._K.getValuesCSR()[2]
        return values

    def extracted(self) -> PETSc.Mat:
        """``M^T A M`` of the whole (collective), valid until the next one."""
        if self._total is None:
            self._total = ranks.summed(self.comm, len(self._values), self._share)
        self._values[:] = self._total
        self._sum.assemble()
        return self._sum

    def product(self, nodal: FloatArray) -> FloatArray:
        """``M^T A x`` of the whole (collective), shape (coefficients,).

        Args:
            nodal: x at all degrees of freedom.
        """

        def share() -> FloatArray:
            self._x.array_w[:] = nodal.ravel()[self._dofs]
            self._A.mult(self._x, self._diagonal)
            return self._share_of_extracted()

        return ranks.summed(self.comm, self._n, share)

    def gathered(self, extract: Callable[[], sp.csr_matrix]) -> sp.csr_matrix:
        """The sum of sparse matrices (collective).

        Args:
            extract: finds this rank's share.
        """
        share, error = ranks.tried(extract)
        own = None if share is None else (share.data, share.indices, share.indptr)
        parts = self.comm.allgather((error and ranks.portable(error), own))
        failures = [told for told, _ in parts if told is not None]
        if failures:
            raise error or failures[0]
        shape = self._n, self._n
        return sum((sp.csr_matrix(part, shape=shape) for _, part in parts), start=sp.csr_matrix(shape))


def confined(*forms: ufl.Form) -> bool:
    """Whether forms can be integrated in some of the elements alone."""
    try:
        for form in forms:
            compat.PartialForm(form)
    except ValueError:
        return False
    return True


def _along(domain: Any) -> IntArray:
    """An order of the cells in which those are together that are close to each other along the first direction."""
    return np.lexsort(compat.cell_vertices(domain).mean(axis=1).T[::-1])


def _matrix(cells: IntArray, nodes: IntArray, size: int, count: int) -> PETSc.Mat:
    """A matrix of some cells' nodes, into which their forms are assembled by the numbers of the whole."""
    place = np.full(count, -1, dtype=PETSc.IntType)
    place[nodes] = np.arange(len(nodes))
    own = place[cells]
    row, column = np.repeat(own, own.shape[1], axis=1).ravel(), np.tile(own, (1, own.shape[1])).ravel()
    pattern = sp.csr_matrix((np.ones(len(row)), (row, column)), shape=(len(nodes), len(nodes)))
    A = compat.matrix_of(sp.csr_matrix(sp.kron(pattern, np.ones((size, size)))), size)
    numbers = PETSc.LGMap().create(place, bsize=size, comm=MPI.COMM_SELF)
    A.setLGMap(numbers, numbers)
    numbers.destroy()
    return A
