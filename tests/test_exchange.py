"""Forces, tangents and multiplier update of the coupling, as identities on arrays."""

import numpy as np
import pytest
import scipy.sparse as sp

from coudalfish.surface import exchange
from coudalfish.surface.monitors import monitors_of

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
    figures = monitors_of(u - y_dot, n, W, F, -(B.T @ F).sum(axis=0), F.sum(axis=0))
    assert figures.force_imbalance < 1e-14
    assert monitors_of(u - y_dot, n, W, F, 0.9 * -F.sum(axis=0), F.sum(axis=0)).force_imbalance > 1e-3


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


# -- smoothed relaxation ----------------------------------------------------------------------------------------------

ALL, REST = np.ones(POINTS, dtype=bool), np.zeros((POINTS, 2))


def one_hot(patches):
    """Functions that are one at the points of a patch: means over them are a projection."""
    _, patch = np.unique(patches, return_inverse=True)
    return sp.csr_matrix((np.ones(len(patch)), patch, np.arange(len(patch) + 1)))


def matrix(means):
    return np.column_stack([means @ column for column in np.eye(len(means.W))])


def relaxed(lam, n, W, patches, r, *, active=ALL, u=REST):
    means = exchange.VertexMeans(one_hot(patches), W)
    return exchange.updated_multiplier(lam, u, REST, n, active, penalty=BETA, relaxation=r, means=means)


@pytest.fixture
def patches():
    return np.array([2, 7, 7, 30, 2, 11]).repeat(5)


def test_means_over_patches_are_a_projection(arrays, patches):
    _, _, W, _, _, lam = arrays
    P = matrix(exchange.VertexMeans(one_hot(patches), W))
    for patch in np.unique(patches):
        mine = patches == patch
        np.testing.assert_allclose((P @ lam)[mine], np.average(lam[mine], weights=W[mine]), rtol=1e-13)
    np.testing.assert_allclose(P @ P, P, atol=1e-15)
    np.testing.assert_allclose(W @ P, W, rtol=1e-13)  # it is orthogonal in the area


def test_means_over_vertices_keep_constants_and_forces_and_damp_the_rest(arrays):
    """Smoothing is symmetric in the area, with eigenvalues from 0 to 1."""
    _, _, W, _, _, _ = arrays
    rng = np.random.default_rng(3)
    places = np.sort(rng.uniform(0.0, 5.0, POINTS))
    first, share = places.astype(int), places % 1.0
    columns, values = np.column_stack([first, first + 1]), np.column_stack([1.0 - share, share])
    N = sp.csr_matrix((values.ravel(), columns.ravel(), np.arange(0, 2 * POINTS + 1, 2)), shape=(POINTS, 7))
    P = matrix(exchange.VertexMeans(N, W))  # a vertex without points is no harm
    np.testing.assert_allclose(P.sum(axis=1), 1.0, rtol=1e-13)
    np.testing.assert_allclose(W @ P, W, rtol=1e-13)
    np.testing.assert_allclose(W[:, None] * P, (W[:, None] * P).T, atol=1e-15)
    values = np.sort(np.linalg.eigvals(P).real)
    assert values[0] > -1e-12
    assert values[-1] == pytest.approx(1.0)
    assert (values > 1e-9).sum() <= 6


@pytest.mark.parametrize("r", [0.1, 1.0])
def test_the_force_on_every_patch_is_kept(arrays, patches, r):
    """That of the multiplier before relaxation, so that no net flow leaks through a patch; uniformly it is not."""
    _, n, W, u, _, lam = arrays
    whole = exchange.updated_multiplier(lam, u, REST, n, ALL, penalty=BETA, relaxation=0.0)
    new = relaxed(lam, n, W, patches, r, u=u)
    uniform = exchange.updated_multiplier(lam, u, REST, n, ALL, penalty=BETA, relaxation=r)
    for patch in np.unique(patches):
        mine = patches == patch
        force = W[mine] @ whole[mine]
        assert W[mine] @ new[mine] == pytest.approx(force, rel=1e-12)
        assert W[mine] @ uniform[mine] == pytest.approx(force / (1.0 + r), rel=1e-12)


def test_a_pattern_without_force_decays_and_what_is_constant_stays(patches):
    """By 1/(1 + r) in every step."""
    n, W, r = np.tile([1.0, 0.0], (POINTS, 1)), np.ones(POINTS), 0.5
    sign = np.tile([1.0, -1.0], POINTS // 2)
    pairs = np.arange(POINTS) // 2
    lam = 3.0 + sign
    for step in range(1, 4):
        lam = relaxed(lam, n, W, pairs, r)
        np.testing.assert_allclose(lam, 3.0 + sign / 1.5**step, rtol=1e-13)
    np.testing.assert_allclose(relaxed(np.full(POINTS, 4.0), n, W, patches, r), 4.0, rtol=1e-13)


def test_one_point_per_patch_is_left_alone_and_one_patch_is_not_uniform(arrays):
    _, n, W, u, _, lam = arrays
    whole = exchange.updated_multiplier(lam, u, REST, n, ALL, penalty=BETA, relaxation=0.0)
    np.testing.assert_allclose(relaxed(lam, n, W, np.arange(POINTS), 0.7, u=u), whole, rtol=1e-12)
    together = relaxed(lam, n, W, np.zeros(POINTS, dtype=int), 1e12, u=u)
    np.testing.assert_allclose(together, np.average(whole, weights=W), rtol=1e-9)


def test_points_of_no_patch_and_patches_without_area(arrays, patches):
    """The former keep their multiplier; neither enters any mean, and nothing is undefined."""
    _, n, W, u, _, lam = arrays
    outside, empty = np.arange(POINTS) % 4 == 0, patches == 7
    patches = np.where(outside, -1, patches)
    W = np.where(outside | empty, 0.0, W)
    new = relaxed(lam, n, W, patches, 0.3, active=~outside, u=u)
    np.testing.assert_array_equal(new[outside], lam[outside])
    assert np.isfinite(new).all()
    mine = patches == 2
    whole = exchange.updated_multiplier(lam, u, REST, n, ~outside, penalty=BETA, relaxation=0.0)
    assert W[mine] @ new[mine] == pytest.approx(W[mine] @ whole[mine], rel=1e-12)
    nowhere = relaxed(lam, n, 0.0 * W, np.full(POINTS, -1), 0.3, active=np.zeros(POINTS, dtype=bool), u=u)
    np.testing.assert_array_equal(nowhere, lam)


def test_slip_is_averaged_over_the_area():
    """Along the normal; a point of no area, as one outside the fluid, has no slip."""
    slip, n = np.array([[0.0, 5.0], [2.0, 7.0], [9.0, 0.0]]), np.array([[1.0, 0.0]] * 3)
    figures = monitors_of(slip, n, np.array([1.0, 3.0, 0.0]), np.zeros((3, 2)), np.zeros(2), np.zeros(2))
    assert figures.normal_slip_rms == pytest.approx(np.sqrt(3.0))
    assert figures.normal_slip_max == 2.0
    assert figures.leak == 3.0 * 2.0
