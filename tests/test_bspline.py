"""Knot vectors and B-spline bases against the recursion that defines them."""

import numpy as np
import pytest

from tigar_x.bspline import BSplineBasis, TensorBasis, open_knots

DEGREES = (1, 2, 3, 4)


def cox_de_boor(knots, degree, i, xi):
    """N_{i,p} at one parameter, as the recursion is written down (0/0 = 0, last span closed)."""
    if degree == 0:
        last = knots[i + 1] == knots[-1] and xi == knots[-1]
        return float(knots[i] <= xi < knots[i + 1] or (last and knots[i] < knots[i + 1]))
    left, right = knots[i + degree] - knots[i], knots[i + degree + 1] - knots[i + 1]
    value = 0.0
    if left > 0.0:
        value += (xi - knots[i]) / left * cox_de_boor(knots, degree - 1, i, xi)
    if right > 0.0:
        value += (knots[i + degree + 1] - xi) / right * cox_de_boor(knots, degree - 1, i + 1, xi)
    return value


def random_basis(degree, seed):
    """Random breakpoints on a shifted interval, every interior one with its own multiplicity from 1 to degree."""
    rng = np.random.default_rng(seed)
    interior = np.sort(rng.uniform(-1.0, 2.0, 4))
    counts = np.concatenate([[degree], rng.integers(1, degree + 1, 3)])  # one knot as often as is allowed
    inside = np.repeat(interior, rng.permutation(counts))
    return BSplineBasis(degree, np.concatenate([np.full(degree + 1, -1.5), inside, np.full(degree + 1, 2.5)]))


def values(basis, xi):
    return TensorBasis((basis,)).evaluate(np.reshape(xi, (-1, 1))).toarray()


@pytest.mark.parametrize("degree", DEGREES)
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_recursion_and_partition_of_unity(degree, seed):
    basis = random_basis(degree, seed)
    inside = np.random.default_rng(seed + 10).uniform(-1.5, 2.5, 30)
    xi = np.concatenate([inside, basis.breakpoints])  # at the knots as well: functions are at least C0
    N = values(basis, xi)
    expected = [[cox_de_boor(basis.knots, degree, i, x) for i in range(basis.n)] for x in xi]
    assert N.shape == (len(xi), len(basis.knots) - degree - 1)
    np.testing.assert_allclose(N, expected, rtol=0, atol=1e-13)
    np.testing.assert_allclose(N.sum(axis=1), 1.0, rtol=0, atol=1e-14)
    assert N.min() >= 0.0
    assert ((N > 0.0).sum(axis=1) <= degree + 1).all()


@pytest.mark.parametrize("degree", DEGREES)
def test_greville_abscissae_reproduce_linear_functions(degree):
    basis = random_basis(degree, 4)
    xi = np.linspace(-1.5, 2.5, 37)
    assert basis.greville.shape == (basis.n,)
    np.testing.assert_allclose(values(basis, xi) @ basis.greville, xi, rtol=0, atol=1e-13)
    if degree > 1:  # squares need other coefficients, so the identity above is not a property of any coefficients
        assert np.abs(values(basis, xi) @ basis.greville**2 - xi**2).max() > 1e-2


@pytest.mark.parametrize("degree", DEGREES)
def test_ends_are_interpolated(degree):
    basis = random_basis(degree, 5)
    N = values(basis, [-1.5, 2.5])
    np.testing.assert_allclose(N, np.eye(basis.n)[[0, -1]], rtol=1e-15, atol=0)


@pytest.mark.parametrize("degree", DEGREES)
def test_parameters_outside_by_rounding_are_moved_to_the_end(degree):
    basis = BSplineBasis(degree, open_knots(degree, [0.0, 1.0, 3.0]))
    np.testing.assert_array_equal(values(basis, [-1e-13, 3.0 + 1e-12]), values(basis, [0.0, 3.0]))


def test_local_indices_are_those_of_the_span():
    basis = BSplineBasis(2, open_knots(2, [0, 1, 2, 3]))
    v, j = basis.local([0.5, 1.5, 2.5])
    np.testing.assert_array_equal(j, [[0, 1, 2], [1, 2, 3], [2, 3, 4]])
    np.testing.assert_allclose(v[1], [0.125, 0.75, 0.125], rtol=1e-14)


@pytest.mark.parametrize("degree", DEGREES)
def test_open_knots(degree):
    knots = open_knots(degree, [0.0, 0.25, 2.0])
    np.testing.assert_array_equal(knots, [0.0] * (degree + 1) + [0.25] + [2.0] * (degree + 1))
    basis = BSplineBasis(degree, knots)
    assert basis.n == degree + 2
    np.testing.assert_array_equal(basis.breakpoints, [0.0, 0.25, 2.0])


def test_knots_closer_than_rounding_are_one():
    knots = np.array([0, 0, 0, 0.5, 0.5 + 2e-15, 1, 1, 1])
    basis = BSplineBasis(2, knots)
    np.testing.assert_array_equal(basis.breakpoints, [0, 0.5, 1])
    np.testing.assert_array_equal(basis.knots, [0, 0, 0, 0.5, 0.5, 1, 1, 1])
    apart = BSplineBasis(2, np.where(knots == knots[4], 0.5 + 1e-13, knots))
    assert len(apart.breakpoints) == 4


def test_basis_owns_its_knots():
    knots = open_knots(1, [0.0, 1.0])
    basis = BSplineBasis(1, knots)
    knots[0] = -7.0
    assert basis.knots[0] == 0.0
    with pytest.raises(ValueError, match="read-only"):
        basis.knots[0] = -7.0


def test_tensor_product_counts_the_first_direction_fastest():
    first, second, third = random_basis(2, 6), random_basis(1, 7), random_basis(3, 8)
    tensor = TensorBasis((first, second, third))
    xi = np.random.default_rng(9).uniform(-1.5, 2.5, (20, 3))
    N = tensor.evaluate(xi)
    M, L = first.n, second.n
    assert tensor.n == M * L * third.n == N.shape[1]
    A, B, C = (values(basis, x) for basis, x in zip(tensor.directions, xi.T, strict=True))
    for i, j, k in np.ndindex(M, L, third.n):
        column = N[:, [k * M * L + j * M + i]].toarray()[:, 0]
        np.testing.assert_allclose(column, A[:, i] * B[:, j] * C[:, k], rtol=0, atol=1e-14)
    np.testing.assert_allclose(N.sum(axis=1), 1.0, rtol=0, atol=1e-13)
    assert np.abs(N.data).min() >= 1e-15


@pytest.mark.parametrize(
    ("degree", "knots", "message"),
    [
        (1, [0, 0, 0.6, 0.4, 1, 1], r"knots\[2:4\] = \[0.6 0.4\]: a non-decreasing"),
        (2, [0, 0, 0, 0.5, 0.5, 0.5, 1, 1, 1], r"knots repeats 0.5 3 times: at most 2"),
        (1, [0, 0, 0.25, 0.5, 0.5, 1, 1], r"knots repeats 0.5 2 times: at most 1"),
        (2, [0, 0, 0.5, 1, 1, 1], r"knots repeats its ends 2 and 3 times: 3"),
        (2, [0, 0, 0, 0.5, 1, 1], r"knots repeats its ends 3 and 2 times: 3"),
        (1, [0, 0, 0, 1, 1, 1], r"knots repeats its ends 3 and 3 times: 2"),
        (2, [0.3] * 6, r"knots repeats its ends"),
        (3, [0, 0, 0, 1, 1, 1], r"knots has 6 entries: degree 3 requires at least 8"),
        (1, [], r"knots has 0 entries"),
        (1, [[0, 0], [1, 1]], r"knots has shape \(2, 2\)"),
        (1, [0, 0, np.nan, 1, 1], r"knots\[2\] = nan"),
        (1, [0, 0, np.inf, np.inf], r"knots\[2\] = inf"),
        (0, [0, 1], r"degree = 0: an integer >= 1"),
        (1.5, [0, 0, 1, 1], r"degree = 1.5: an integer >= 1"),
    ],
)
def test_bad_knots(degree, knots, message):
    with pytest.raises(ValueError, match=message):
        BSplineBasis(degree, knots)


@pytest.mark.parametrize(
    ("xi", "message"),
    [
        ([0.5, 1.1], r"xi ranges over \[0.5, 1.1\]: values in \[0.0, 1.0\]"),
        ([-0.1, 0.5], r"xi ranges over \[-0.1, 0.5\]"),
        ([0.5, np.nan], r"xi\[1\] = nan"),
        ([[0.5]], r"xi has shape \(1, 1\)"),
    ],
)
def test_bad_parameters(xi, message):
    with pytest.raises(ValueError, match=message):
        BSplineBasis(1, open_knots(1, [0, 1])).local(xi)


def test_bad_points_of_a_tensor_product():
    basis = BSplineBasis(1, open_knots(1, [0, 1]))
    with pytest.raises(ValueError, match=r"xi has shape \(2, 3\): shape \(any, 2\)"):
        TensorBasis((basis, basis)).evaluate(np.zeros((2, 3)))
    with pytest.raises(ValueError, match=r"xi ranges over"):
        TensorBasis((basis, basis)).evaluate([[0.5, 2.0]])


@pytest.mark.parametrize("breakpoints", [[0, 1, 1, 2], [0, 2, 1], [], [1.0]])
def test_open_knots_refuses_what_is_not_increasing(breakpoints):
    with pytest.raises(ValueError, match="breakpoints"):
        open_knots(2, breakpoints)


def test_a_whole_number_of_any_type_is_a_degree():
    basis = BSplineBasis(2.0, open_knots(2, [0, 1, 2]))
    assert basis.n == 4
    np.testing.assert_allclose(values(basis, [0.0, 2.0]), np.eye(4)[[0, 3]], rtol=1e-15)
