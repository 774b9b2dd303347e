"""Forces, tangents and multiplier update of the coupling, as identities on arrays."""

import numpy as np
import pytest
import scipy.sparse as sp

from coudalfish import exchange
from coudalfish.monitors import measure

RNG = np.random.default_rng(0)
POINTS, NODES, BETA = 30, 12, 3.7


@pytest.fixture
def arrays():
    B = sp.csr_matrix(RNG.dirichlet(np.ones(NODES), POINTS))
    n = RNG.normal(size=(POINTS, 2))
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    W = RNG.uniform(0.1, 1.0, POINTS)
    return B, n, W, RNG.normal(size=(POINTS, 2)), RNG.normal(size=(POINTS, 2)), RNG.normal(size=POINTS)


def test_action_equals_reaction(arrays):
    B, n, W, u, y_dot, lam = arrays
    F = exchange.point_forces(u, y_dot, lam, n, W, penalty=BETA)
    np.testing.assert_allclose((B.T @ F).sum(axis=0), F.sum(axis=0), rtol=1e-13)
    figures = measure(u - y_dot, n, W, F, -(B.T @ F).sum(axis=0), F.sum(axis=0))
    assert figures.force_imbalance < 1e-14
    assert measure(u - y_dot, n, W, F, 0.9 * -F.sum(axis=0), F.sum(axis=0)).force_imbalance > 1e-3


def test_forces_by_hand():
    W, lam, n = np.array([2.0]), np.array([5.0]), np.array([[0.6, 0.8]])
    F = exchange.point_forces(np.array([[1.0, 0.0]]), np.array([[0.0, 2.0]]), lam, n, W, penalty=3.0)
    np.testing.assert_allclose(F, [[2 * (3 * 1 + 5 * 0.6), 2 * (3 * -2 + 5 * 0.8)]])


def test_tangents_are_derivatives_of_the_forces(arrays):
    """Row sums agree, the lumped tangent dominates, the consistent one is the derivative."""
    B, n, W, _, y_dot, lam = arrays
    factor = 0.7
    K = exchange.consistent_tangent(B, W, penalty=BETA, factor=factor).toarray()
    D = exchange.lumped_tangent(B, W, penalty=BETA, factor=factor).toarray()
    np.testing.assert_allclose(np.diag(D), K.sum(axis=1), rtol=1e-12)
    assert np.linalg.eigvalsh(D - K).min() > -1e-12
    nodal, step = RNG.normal(size=(NODES, 2)), RNG.normal(size=(NODES, 2))

    def residual(x):
        return B.T @ exchange.point_forces(factor * B @ x, y_dot, lam, n, W, penalty=BETA)

    np.testing.assert_allclose(residual(nodal + step) - residual(nodal), K @ step, rtol=1e-10, atol=1e-12)
    assert not np.allclose(K, exchange.consistent_tangent(B, W, penalty=2 * BETA, factor=factor).toarray())


def test_consistent_tangent_couples_nodes_of_one_cell_only():
    B = sp.csr_matrix([[0.2, 0.3, 0.5, 0.0], [0.0, 0.1, 0.2, 0.7]])
    K = exchange.consistent_tangent(B, np.ones(2), penalty=1.0, factor=1.0)
    assert K[0, 3] == 0.0
    assert K.nnz == 14


def test_inactive_points_feel_nothing_and_keep_their_multiplier(arrays):
    _, n, W, u, y_dot, lam = arrays
    active = np.arange(POINTS) % 3 != 0
    F = exchange.point_forces(u, y_dot, lam, n, np.where(active, W, 0.0), penalty=BETA)
    assert not F[~active].any()
    assert F[active].all()
    new = exchange.updated_multiplier(lam, u, y_dot, n, active, penalty=BETA, relaxation=0.1)
    np.testing.assert_array_equal(new[~active], lam[~active])
    assert (new[active] != lam[active]).all()


@pytest.mark.parametrize("relaxation", [0.0, 1e-2])
def test_steady_state_of_the_multiplier_is_a_porous_screen(relaxation):
    """With r > 0 a constant slip w balances lam = beta w/r; with r = 0 the multiplier grows by beta w per step."""
    n, lam, w = np.array([[1.0, 0.0]]), np.zeros(1), np.array([[1e-3, 5.0]])
    for _ in range(4000):
        lam = exchange.updated_multiplier(lam, w, 0 * w, n, np.array([True]), penalty=BETA, relaxation=relaxation)
    expected = BETA * 1e-3 / relaxation if relaxation else 4000 * BETA * 1e-3
    np.testing.assert_allclose(lam, expected, rtol=1e-9)
