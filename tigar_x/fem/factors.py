"""Factors of one matrix that serve many right-hand sides.

A matrix of several shells in one spline, of which some unknowns are held, is made of parts that know nothing of each
other. Those of tensor splines are banded: LAPACK factors some hundred such rows in a tenth of the time that general
sparse factors take. What is not banded, as shells that touch each other, gets these.
"""

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp
from mpi4py import MPI
from scipy.sparse.csgraph import connected_components, reverse_cuthill_mckee
from scipy.sparse.linalg import splu

from tigar_x import ranks
from tigar_x.compat import FloatArray, IntArray
from tigar_x.fem.linear import SolveError

WIDE = 8.0
"""Room for a band and its pivots, relative to the entries of the matrix, from which on factors are sparse: up to there
bands, as of one leaflet that touches itself, take a third of the time, and sparse factors reserve twenty times the
memory."""
FEW = 30
"""Entries of a row on average up to which they are, too: those of curves cost next to nothing."""


class _Inverse(Protocol):
    """A matrix, inverted."""

    def solve(self, b: FloatArray, /) -> FloatArray:
        """The inverse times a vector, or each of some columns."""


class Factors:
    """Factors of a square matrix.

    Args:
        A: the matrix; zeros that it stores are removed.
        comm: ranks that have the same matrix and share its parts, so that solves are collective; None: there are none.

    Raises:
        SolveError: it is singular.
    """

    def __init__(self, A: sp.csr_matrix, comm: MPI.Comm | None = None) -> None:
        A.eliminate_zeros()
        self._parts: list[tuple[Any, _Inverse]] = []
        self._comm: MPI.Comm | None = None
        if A.nnz <= FEW * np.count_nonzero(np.diff(A.indptr) > 1):
            self._parts.append((slice(None), _sparse(A)))
            return
        part = connected_components(A, directed=False)[1]
        sizes = np.bincount(part)
        large = np.flatnonzero(sizes > 1)

        def factored(mine: Any) -> FloatArray:
            alone = np.flatnonzero((sizes[part] == 1) & mine[part])
            self._parts.append((alone, _Diagonal.of(A.diagonal()[alone])))
            for k in large[mine[large]]:
                rows = np.flatnonzero(part == k)
                self._parts.append(_of_part(A[rows][:, rows], rows))
            return np.empty(0)

        if comm is None or len(large) < 2:
            factored(np.ones(len(sizes), dtype=bool))
        else:
            self._comm = comm
            ranks.summed(comm, 0, lambda: factored(_shares(sizes, comm.size) == comm.rank))

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
            x[np.ix_(np.arange(len(b))[rows], columns)] = inverse.solve(given[:, columns])
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


def _of_part(A: sp.csr_matrix, rows: IntArray) -> tuple[IntArray, _Inverse]:
    """Some rows in an order, and the inverse of their matrix in it: as they are, or that of Cuthill and McKee."""
    n = len(rows)
    row = np.repeat(np.arange(n), np.diff(A.indptr))
    for order in (np.arange, lambda _: reverse_cuthill_mckee(A)):
        chosen = order(n)
        place = np.empty(n, dtype=np.int64)
        place[chosen] = np.arange(n)
        column = place[A.indices]
        below = place[row] - column
        lower, upper = int(below.max()), int(-below.min())
        if (2 * lower + upper + 1) * n <= WIDE * A.nnz:
            return rows[chosen], _Band.of(below, column, A.data, lower, upper)
    return rows, _sparse(A)


def _sparse(A: sp.csr_matrix) -> Any:
    """Sparse factors of a matrix."""
    try:
        return splu(A.tocsc(), permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})
    except RuntimeError as error:
        raise SolveError(f"tangent: {error}") from None


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

    @classmethod
    def of(cls, below: IntArray, column: IntArray, data: FloatArray, lower: int, upper: int) -> "_Band":
        """By its entries, how far below the main diagonal they are and in which columns."""
        band = np.zeros((2 * lower + upper + 1, int(column.max()) + 1), order="F")
        band[lower + upper + below, column] = data
        factors, pivots, info = la.lapack.dgbtrf(band, lower, upper, overwrite_ab=1)
        if info != 0:
            raise SolveError("tangent: its factor is exactly singular")
        return cls(lower, upper, factors, pivots)

    def solve(self, b: FloatArray) -> FloatArray:
        """See :class:`_Inverse`."""
        return np.asarray(la.lapack.dgbtrs(self.factors, self.lower, self.upper, b, self.pivots)[0])
