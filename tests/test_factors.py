"""Factors that serve many right-hand sides."""

import numpy as np
import pytest
import scipy.sparse as sp
from mpi4py import MPI
from petsc4py import PETSc

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


@pytest.mark.skipif(not PETSc.Sys.hasExternalPackage("suitesparse"), reason="PETSc has no CHOLMOD")
def test_what_is_definite_without_a_band_has_a_factor_of_half_the_size(capfd):
    A, rng = symmetric(300, 16, 5) + 60.0 * np.eye(300), np.random.default_rng(6)
    i, j = rng.integers(0, 300, (2, 200))
    A[i, j] = A[j, i] = 1.0
    b = rng.standard_normal((300, 3))
    skew = A.copy()
    skew[i[0], j[0]] += 1e-9
    for B, kind in ((A, "_SparseDefinite"), (A - 60.0 * np.eye(300), "SuperLU"), (skew, "SuperLU")):
        factors = Factors(sp.csr_matrix(B))
        assert kinds(factors)[-1] == kind
        for load in (b, b[:, :0], b[:, 1]):
            np.testing.assert_allclose(factors.solve(load), np.linalg.solve(B, load), rtol=1e-9, atol=1e-9)
    assert capfd.readouterr() == ("", "")


def symmetric(n: int, width: int, seed: int) -> np.ndarray:
    A = banded(n, width, seed)
    return A + A.T


def test_a_symmetric_band_that_is_definite_has_a_factor_of_a_third_of_the_size():
    shift, b = 60.0 * np.eye(200), np.random.default_rng(9).standard_normal((200, 4))
    definite, indefinite, skew = symmetric(200, 20, 10) + shift, symmetric(200, 20, 10), banded(200, 20, 10) + shift
    assert np.linalg.eigvalsh(definite)[0] > 0.0 > np.linalg.eigvalsh(indefinite)[0]
    for A, kind in ((definite, "_Definite"), (indefinite, "_Band"), (skew, "_Band")):
        factors = Factors(sp.csr_matrix(A))
        assert kinds(factors)[-1] == kind
        np.testing.assert_allclose(factors.solve(b), np.linalg.solve(A, b), rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(factors.solve(b[:, 0]), np.linalg.solve(A, b[:, 0]), rtol=1e-9, atol=1e-9)
    definite[20, 0] += 1e-9
    assert kinds(Factors(sp.csr_matrix(definite)))[-1] == "_Band"
    definite[0, 20] = 0.0  # a place that only one triangle has
    assert kinds(Factors(sp.csr_matrix(definite)))[-1] == "_Band"


@pytest.mark.parametrize("wide", [False, True])
def test_a_layout_serves_again_where_the_same_entries_are_zero_and_changes_no_bit(wide):
    A = two_parts_and_held_rows() if not wide else symmetric(180, 20, 11) + 60.0 * np.eye(180)
    former, b = Factors(stored(A)), np.random.default_rng(12).standard_normal((180, 3))
    B = A * (1.0 + 0.1 * (A + A.T))
    again, anew = Factors(stored(B), like=former.layout), Factors(stored(B))
    assert again.layout is former.layout is not anew.layout
    np.testing.assert_array_equal(again.solve(b), anew.solve(b))
    B[0, 2] = B[2, 0] = 0.0
    assert Factors(stored(B), like=again.layout).layout is not again.layout
    assert Factors(sp.csr_matrix(B), like=again.layout).layout is not again.layout
    np.testing.assert_allclose(
        Factors(stored(B), like=again.layout).solve(b), np.linalg.solve(B, b), rtol=1e-8, atol=1e-8
    )


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
