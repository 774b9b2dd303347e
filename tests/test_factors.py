"""Factors that serve many right-hand sides."""

import numpy as np
import pytest
import scipy.sparse as sp
from mpi4py import MPI

from tigar_x.fem.factors import Factors
from tigar_x.fem.linear import SolveError


def banded(n: int, width: int, seed: int) -> np.ndarray:
    """Neither symmetric nor definite."""
    A = np.random.default_rng(seed).standard_normal((n, n))
    i, j = np.indices((n, n))
    A[abs(i - j) > width] = 0.0
    return A


def two_parts_and_held_rows() -> np.ndarray:
    """Rows in turn of two bands and of the diagonal, which store zeros beside it."""
    n, A = 60, np.zeros((180, 180))
    A[:120:2, :120:2], A[1:120:2, 1:120:2] = banded(n, 20, 0), banded(n, 20, 1)
    A[np.arange(120, 180), np.arange(120, 180)] = np.arange(1.0, 61.0)
    return A


def kinds(factors: Factors) -> list[str]:
    return [type(part[1]).__name__ for part in factors._parts]


def stored(A: np.ndarray) -> sp.csr_matrix:
    """With zeros, as PETSc has them in rows of unknowns that are held."""
    full = sp.csr_matrix(np.ones_like(A))
    full.data[:] = A.ravel()
    return full


def test_parts_are_factored_by_themselves():
    A, b = two_parts_and_held_rows(), np.random.default_rng(2).standard_normal((180, 5))
    b[::2, 0] = b[1::2, 1] = 0.0
    factors = Factors(stored(A))
    assert kinds(factors) == ["_Diagonal", "_Band", "_Band"]
    exact = np.linalg.solve(A, b)
    np.testing.assert_allclose(factors.solve(b), exact, rtol=1e-9, atol=1e-9 * np.abs(exact).max())
    np.testing.assert_allclose(factors.solve(b[:, 2]), exact[:, 2], rtol=1e-9, atol=1e-9 * np.abs(exact).max())


@pytest.mark.mpi
def test_ranks_share_the_parts():
    comm, A, b = MPI.COMM_WORLD, two_parts_and_held_rows(), np.random.default_rng(2).standard_normal((180, 5))
    b[::2, 0] = b[1::2, 1] = 0.0
    whole, shared = Factors(stored(A)), Factors(stored(A), comm)
    assert comm.allreduce(kinds(shared).count("_Band")) == 2
    for load in (b, b[:, 2]):
        found = shared.solve(load)
        np.testing.assert_array_equal(found, whole.solve(load))
        assert all(np.array_equal(other, found) for other in comm.allgather(found))
    A[1] = 0.0
    with pytest.raises(SolveError, match="singular"):
        Factors(sp.csr_matrix(A), comm)


def test_a_band_is_found_in_another_order():
    A, order = banded(200, 16, 3), np.random.default_rng(4).permutation(200)
    factors = Factors(sp.csr_matrix(A[order][:, order]))
    assert kinds(factors) == ["_Diagonal", "_Band"]
    b = np.arange(200.0)
    np.testing.assert_allclose(factors.solve(b), np.linalg.solve(A[order][:, order], b), rtol=1e-7)


def test_a_band_may_have_gaps_as_where_a_shell_touches_itself():
    """Sparse factors would reserve more memory than bands that are seven times as large as their entries."""
    A, rng = banded(600, 100, 7) + 50.0 * np.eye(600), np.random.default_rng(8)
    A[rng.random(A.shape) > 0.2] = 0.0
    A[np.arange(600), np.arange(600)] = 50.0
    factors, b = Factors(sp.csr_matrix(A)), np.arange(600.0)
    assert kinds(factors)[-1] == "_Band"
    np.testing.assert_allclose(factors.solve(b), np.linalg.solve(A, b), rtol=1e-9)


@pytest.mark.parametrize(("width", "far"), [(2, 0), (16, 1)])
def test_what_has_no_band_or_few_entries_gets_sparse_factors(width, far):
    A, rng = banded(300, width, 5) + 50.0 * np.eye(300), np.random.default_rng(6)
    A[rng.integers(0, 300, 200 * far), rng.integers(0, 300, 200 * far)] = 1.0
    factors = Factors(sp.csr_matrix(A))
    assert kinds(factors)[-1] == "SuperLU"
    b = rng.standard_normal((300, 3))
    np.testing.assert_allclose(factors.solve(b), np.linalg.solve(A, b), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("row", [0, 150])
def test_a_singular_matrix_is_refused(row):
    A = two_parts_and_held_rows()
    A[row], A[:, row] = 0.0, 0.0
    with pytest.raises(SolveError, match="tangent"):
        Factors(stored(A))


def test_a_part_that_is_singular_is_refused():
    A = two_parts_and_held_rows()
    A[:, 2] = A[:, 0] = np.where(np.arange(180) % 2 == 0, 1.0, 0.0) * (np.arange(180) < 40)
    with pytest.raises(SolveError, match="singular"):
        Factors(stored(A))
