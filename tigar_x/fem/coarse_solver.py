"""Solutions on the coarse level of :mod:`tigar_x.fem.two_level`, which all ranks have.

What is all but singular there, as constants of few aggregates may be, gets no correction.
"""

from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Protocol

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp
from mpi4py import MPI
from petsc4py import PETSc
from scipy.sparse.linalg import splu

from tigar_x.compat import FloatArray

DENSE = 600
"""Unknowns up to which factors are dense."""
SHARED = 8_000
"""Unknowns from which on the ranks share the factors: general sparse ones of as many take seconds on each."""
SINGULAR, SHIFT = 1e-9, 1e-6
"""Pivots, relative to the matrix's own diagonal, that count as zero; what is added there then."""
ROOM = 100
"""Memory for pivots that shared factors have not foreseen, in per cent of their own."""

_FAILED = 76  # PETSc's code for an error of another library


class CoarseSolver(Protocol):
    """Factors of a coarse matrix."""

    def solve(self, b: FloatArray) -> FloatArray:
        """The solution on every rank, of a right-hand side that every rank has (collective)."""

    def destroy(self) -> None:
        """Free them (collective)."""


def coarse_solver(A: sp.csc_matrix, sizes: FloatArray, comm: MPI.Comm, counts: Sequence[int]) -> CoarseSolver:
    """Factors of a coarse matrix (collective).

    Args:
        A: the coarse matrix, on every rank.
        sizes: what rounding makes of a zero on its diagonal is small compared with these, shape (rows,).
        comm: the ranks.
        counts: rows of each rank.
    """
    scale = 1.0 / np.sqrt(sizes)
    scaled = (sp.diags(scale) @ A @ sp.diags(scale)).tocsc()
    if A.shape[0] >= SHARED:
        return _Shared(scaled, scale, comm, counts)
    return _Own(scale, _dense(scaled) if A.shape[0] <= DENSE else _sparse(scaled))


def _shifted(A: sp.csc_matrix) -> sp.csc_matrix:
    return (A + SHIFT * sp.identity(A.shape[0])).tocsc()


def _dense(A: sp.csc_matrix) -> Callable[[FloatArray], FloatArray]:
    dense = A.toarray()
    factors = la.lu_factor(dense, check_finite=False)
    if np.abs(factors[0].diagonal()).min(initial=np.inf) > SINGULAR:
        return lambda b: np.asarray(la.lu_solve(factors, b, check_finite=False))
    inverse = la.pinv(dense, rtol=SINGULAR)
    return lambda b: np.asarray(inverse @ b)


def _sparse(A: sp.csc_matrix) -> Callable[[FloatArray], FloatArray]:
    options = {"SymmetricMode": True, "DiagPivotThresh": 0.0}
    more = {"permc_spec": "MMD_AT_PLUS_A", "diag_pivot_thresh": 0.0, "options": options}
    sparse = None
    with suppress(RuntimeError):  # SuperLU has met a pivot that is exactly zero
        sparse = splu(A, **more)
    if sparse is None or np.abs(sparse.U.diagonal()).min() <= SINGULAR:
        sparse = splu(_shifted(A), **more)
    return lambda b: np.asarray(sparse.solve(b))


class _Own:
    """Factors that every rank has."""

    def __init__(self, scale: FloatArray, inverse: Callable[[FloatArray], FloatArray]) -> None:
        self._scale, self._inverse = scale, inverse

    def solve(self, b: FloatArray) -> FloatArray:
        """See :class:`CoarseSolver`."""
        return self._scale * self._inverse(self._scale * b)

    def destroy(self) -> None:
        """Nothing is PETSc's."""


class _Shared:
    """Factors of MUMPS that ranks share."""

    def __init__(self, A: sp.csc_matrix, scale: FloatArray, comm: MPI.Comm, counts: Sequence[int]) -> None:
        self._scale, self._comm, self._counts = scale, comm, counts
        first = sum(counts[: comm.rank])
        self._mine = slice(first, first + counts[comm.rank])
        if self._factor(A) > 0:
            self.destroy()
            self._factor(_shifted(A))

    def _factor(self, A: sp.csc_matrix) -> int:
        """Number of pivots that count as zero."""
        rows, own = A.tocsr()[self._mine], self._counts[self._comm.rank]
        rows.sort_indices()
        csr = rows.indptr.astype(PETSc.IntType), rows.indices.astype(PETSc.IntType), rows.data
        matrix = PETSc.Mat().createAIJ(((own, None), (own, None)), csr=csr, comm=self._comm)
        matrix.assemble()
        pc = PETSc.PC().create(self._comm)
        pc.setOperators(matrix)
        pc.setType("lu")
        pc.setFactorSolverType("mumps")
        pc.setFactorSetUpSolverType()
        factors = pc.getFactorMatrix()
        for number, value in ((8, 0), (14, ROOM), (24, 1)):  # no scaling, which would make much of what is all but zero
            factors.setMumpsIcntl(number, value)
        factors.setMumpsCntl(3, -SINGULAR)  # below zero: the size itself, not relative to the matrix
        self._given, self._found = matrix.createVecs()
        self._pc, self._owned = pc, (self._given, self._found, pc, matrix)
        pc.setUp()
        if factors.getMumpsInfog(1) < 0:
            self.destroy()
            raise PETSc.Error(_FAILED)
        return int(factors.getMumpsInfog(28))

    def solve(self, b: FloatArray) -> FloatArray:
        """See :class:`CoarseSolver`."""
        self._given.array_w[:] = (self._scale * b)[self._mine]
        self._pc.apply(self._given, self._found)
        every = np.empty_like(b)
        self._comm.Allgatherv(self._found.array_r, (every, self._counts))
        return self._scale * every

    def destroy(self) -> None:
        """See :class:`CoarseSolver`."""
        for thing in self._owned:
            thing.destroy()
