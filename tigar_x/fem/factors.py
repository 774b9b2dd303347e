"""Factors of one matrix that serve many right-hand sides.

A matrix of several shells in one spline, of which some unknowns are held, is made of parts that know nothing of each
other. Those of tensor splines are banded: LAPACK factors some hundred such rows in a tenth of the time that general
sparse factors take. What is not banded, as shells that touch each other, gets these. What is symmetric and positive
definite, as where all forces have potentials, has a factor of Cholesky's: of a third of the size in a band, and of half
of it and of the time elsewhere, where CHOLMOD is at hand.
"""

from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp
from mpi4py import MPI
from petsc4py import PETSc
from scipy.sparse.csgraph import connected_components, reverse_cuthill_mckee
from scipy.sparse.linalg import splu

from tigar_x import compat, ranks
from tigar_x.compat import FloatArray, IntArray
from tigar_x.fem.linear import SolveError

WIDE = 8.0
"""Room for a band and its pivots, relative to the entries of the matrix, from which on factors are sparse: up to there
bands, as of one leaflet that touches itself, take a third of the time, and sparse factors reserve twenty times the
memory."""
ROUNDED = 1e-13
"""Difference of two entries, relative to the largest one, that is rounding in a symmetric matrix."""
FEW = 30
"""Entries of a row on average up to which they are, too: those of curves cost next to nothing."""


class _Inverse(Protocol):
    """A matrix, inverted."""

    def solve(self, b: FloatArray, /) -> FloatArray:
        """The inverse times a vector, or each of some columns."""


class Factors:
    """Factors of a square matrix.

    Args:
        A: the matrix.
        comm: ranks that have the same matrix and share its parts, so that solves are collective; None: there are none.
        like: the layout of a former matrix's, which serves again where the same entries are zero.

    Attributes:
        layout: parts and bands.

    Raises:
        SolveError: it is singular.
    """

    def __init__(self, A: sp.csr_matrix, comm: MPI.Comm | None = None, like: "BandLayout | None" = None) -> None:
        stored = A.data != 0.0
        self.layout = like if like is not None and like.suits(A, stored) else BandLayout(A, stored)
        self._parts: list[tuple[IntArray, _Inverse]] = []
        self._comm = comm if len(self.layout.large) > 1 else None
        if self._comm is None:
            self._factor(A, 0, 1)
        else:
            at = self._comm.rank, self._comm.size
            ranks.summed(self._comm, 0, lambda: self._factor(A, *at))

    def _factor(self, A: sp.csr_matrix, rank: int, number: int) -> FloatArray:
        """Factor the parts that are of a rank."""
        layout = self.layout
        mine = _shares(layout.sizes, number) == rank
        alone = layout.alone[mine[layout.part[layout.alone]]]
        self._parts.append((alone, _Diagonal.of(A.diagonal()[alone])))
        for k in layout.large[mine[layout.large]]:
            rows, band = layout.rows_of(k)
            self._parts.append((rows, _sparse(A[rows][:, rows]) if band is None else band.factored(A.data)))
        return np.empty(0)

    def solve(self, b: FloatArray) -> FloatArray:
        """The inverse times a vector, or each of some columns; those that are zero in a part cost nothing there."""
        if self._comm is None:
            return self._solved(b)
        sums = ranks.summed(self._comm, b.size, lambda: self._solved(b).ravel(order="F"))
        return sums.reshape(b.shape, order="F")

    def _solved(self, b: FloatArray) -> FloatArray:
        """That in the parts of this rank, zero elsewhere."""
        x = np.zeros_like(b, order="F")
        for rows, inverse in self._parts:
            given = b[rows]
            if b.ndim == 1:
                x[rows] = inverse.solve(given)
                continue
            columns = np.flatnonzero(given.any(axis=0))
            x[np.ix_(rows, columns)] = inverse.solve(given[:, columns])
        return x


def _shares(sizes: IntArray, number: int) -> IntArray:
    """Which rank takes which part: each part, the largest ones first, is of the rank that has the least to do."""
    work, owner = np.zeros(number), np.zeros(len(sizes), dtype=np.int64)
    for k in np.argsort(-sizes, kind="stable"):
        if sizes[k] == 1:
            break
        owner[k] = work.argmin()
        work[owner[k]] += float(sizes[k]) ** 2
    return owner.astype(np.int32)


class BandLayout:
    """Parts of a matrix, and where its entries are in their bands; it hangs on which of the entries are zero alone.

    Args:
        A: the matrix.
        stored: which of its entries are not zero.

    Attributes:
        part: of every row.
        sizes: rows of the parts.
        large: parts of several rows.
        alone: rows that are parts of their own.
    """

    def __init__(self, A: sp.csr_matrix, stored: Any) -> None:
        self._indptr, self._indices, self._stored = A.indptr, A.indices, stored
        indptr = np.concatenate([[0], np.cumsum(stored)])[A.indptr]
        numbers = 1 + np.flatnonzero(stored)
        self._numbers = sp.csr_matrix((numbers, A.indices[stored], indptr), shape=A.shape)
        self._few = len(numbers) <= FEW * np.count_nonzero(np.diff(indptr) > 1)
        every = np.zeros(len(indptr) - 1, dtype=np.int32)
        self.part = every if self._few else connected_components(self._numbers, directed=False)[1]
        self.sizes = np.bincount(self.part)
        self.large = np.flatnonzero(self.sizes > 1)
        self.alone = np.flatnonzero(self.sizes[self.part] == 1)
        self._rows: dict[int, tuple[IntArray, _Banded | None]] = {}

    def suits(self, A: sp.csr_matrix, stored: Any) -> bool:
        """Whether it is that of a matrix as well."""
        pairs = ((stored, self._stored), (A.indices, self._indices), (A.indptr, self._indptr))
        return all(np.array_equal(one, other) for one, other in pairs)

    def rows_of(self, part: int) -> "tuple[IntArray, _Banded | None]":
        """Rows of a part, in the order of a band as they are or in that of Cuthill and McKee; None: there is none."""
        if part not in self._rows:
            self._rows[part] = self._found(np.flatnonzero(self.part == part))
        return self._rows[part]

    def _found(self, rows: IntArray) -> "tuple[IntArray, _Banded | None]":
        if self._few:
            return rows, None
        A, n = self._numbers[rows][:, rows], len(rows)
        row = np.repeat(np.arange(n), np.diff(A.indptr))
        for order in (np.arange, lambda _: reverse_cuthill_mckee(A)):
            chosen = order(n)
            place = np.empty(n, dtype=np.int64)
            place[chosen] = np.arange(n)
            column = place[A.indices]
            below = place[row] - column
            lower, upper = int(below.max()), int(-below.min())
            if (2 * lower + upper + 1) * n <= WIDE * A.nnz:
                return rows[chosen], _Banded(n, lower, upper, A.data - 1, below, column)
        return rows, None


def _sparse(A: sp.csr_matrix) -> Any:
    """Sparse factors of a matrix."""
    A.eliminate_zeros()
    many = A.nnz > FEW * A.shape[0] and PETSc.Sys.hasExternalPackage("suitesparse")
    if many and abs(A - A.T).max() <= ROUNDED * abs(A).max():
        with suppress(PETSc.Error):  # it is not definite
            return _SparseDefinite(A)
    try:
        return splu(A.tocsc(), permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})
    except RuntimeError as error:
        raise SolveError(f"tangent: {error}") from None


class _SparseDefinite:
    """Cholesky's factor of a sparse matrix that is symmetric and positive definite, by CHOLMOD.

    Args:
        A: the matrix.

    Raises:
        PETSc.Error: it is not definite.
    """

    _PREFIX, _QUIET = "sparse_definite_", "mat_cholmod_print"

    def __init__(self, A: sp.csr_matrix) -> None:
        matrix, pc, options = compat.matrix_of(A), PETSc.PC().create(PETSc.COMM_SELF), PETSc.Options(self._PREFIX)
        compat.freed_with(self, pc, matrix)
        matrix.setOption(PETSc.Mat.Option.SPD, True)
        pc.setOperators(matrix)
        pc.setOptionsPrefix(self._PREFIX)
        pc.setType("cholesky")
        pc.setFactorSolverType("cholmod")
        options[self._QUIET] = 0  # of what is not definite it would tell as well
        try:
            pc.setUp()
        finally:
            options.delValue(self._QUIET)
        self._pc = pc
        self._b, self._x = matrix.createVecs()
        compat.freed_with(self, self._b, self._x)

    def solve(self, b: FloatArray) -> FloatArray:
        """See :class:`_Inverse`."""
        if b.ndim == 1:
            self._b.array_w[:] = b
            self._pc.apply(self._b, self._x)
            return np.array(self._x.array_r)
        given, found = (
            PETSc.Mat().createDense(b.shape, array=array, comm=PETSc.COMM_SELF)
            for array in (np.asfortranarray(b), np.empty(b.shape, order="F"))
        )
        given.assemble()
        found.assemble()
        self._pc.getFactorMatrix().matSolve(given, found)
        x = found.getDenseArray().copy(order="F")
        given.destroy()
        found.destroy()
        return np.asarray(x)


@dataclass(frozen=True, eq=False)
class _Diagonal:
    """A diagonal matrix."""

    diagonal: FloatArray

    @classmethod
    def of(cls, diagonal: FloatArray) -> "_Diagonal":
        """By its entries."""
        if not diagonal.all():
            raise SolveError("tangent: a row is zero")
        return cls(diagonal)

    def solve(self, b: FloatArray) -> FloatArray:
        """See :class:`_Inverse`."""
        return np.asarray((b.T / self.diagonal).T)


@dataclass(frozen=True, eq=False)
class _Banded:
    """Where entries of a matrix are in a band.

    Attributes:
        n: rows.
        lower: diagonals below the main one.
        upper: those above.
        numbers: of the entries in the matrix.
        below: how far below the main diagonal they are.
        column: their columns.
    """

    n: int
    lower: int
    upper: int
    numbers: IntArray
    below: IntArray
    column: IntArray

    @cached_property
    def _halves(self) -> tuple[tuple[IntArray, IntArray], ...]:
        """Entries on and below the main diagonal and their places in a band, and those of the transposed matrix."""
        row, result = self.column + self.below, []
        for below, column in ((self.below, self.column), (-self.below, row)):
            kept = np.flatnonzero(below >= 0)
            result.append((self.numbers[kept], column[kept] * (self.lower + 1) + below[kept]))
        return tuple(result)

    def factored(self, data: FloatArray) -> _Inverse:
        """Factors of the matrix with some entries: Cholesky's where it has them."""
        if self.lower == self.upper:
            lower, transposed = (self._half(data[numbers], places) for numbers, places in self._halves)
            if np.abs(lower - transposed).max() <= ROUNDED * np.abs(lower).max():
                factor, info = la.lapack.dpbtrf(lower, lower=1, overwrite_ab=1)
                if info == 0:
                    return _Definite(factor)
        band = np.zeros((2 * self.lower + self.upper + 1, self.n), order="F")
        band[self.lower + self.upper + self.below, self.column] = data[self.numbers]
        factors, pivots, info = la.lapack.dgbtrf(band, self.lower, self.upper, overwrite_ab=1)
        if info != 0:
            raise SolveError("tangent: its factor is exactly singular")
        return _Band(self.lower, self.upper, factors, pivots)

    def _half(self, values: FloatArray, places: IntArray) -> FloatArray:
        half = np.zeros(self.n * (self.lower + 1))
        half[places] = values
        return half.reshape(self.n, -1).T


@dataclass(frozen=True, eq=False)
class _Band:
    """Factors of a banded matrix.

    Attributes:
        lower: diagonals below the main one.
        upper: those above.
        factors: as LAPACK has them.
        pivots: likewise.
    """

    lower: int
    upper: int
    factors: FloatArray
    pivots: IntArray

    def solve(self, b: FloatArray) -> FloatArray:
        """See :class:`_Inverse`."""
        return np.asarray(la.lapack.dgbtrs(self.factors, self.lower, self.upper, b, self.pivots)[0])


@dataclass(frozen=True, eq=False)
class _Definite:
    """Cholesky's factor of a banded matrix that is symmetric and positive definite, as LAPACK has it."""

    factor: FloatArray

    def solve(self, b: FloatArray) -> FloatArray:
        """See :class:`_Inverse`."""
        return np.asarray(la.lapack.dpbtrs(self.factor, b, lower=1)[0])
