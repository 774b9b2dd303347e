"""Knot vectors and B-spline bases against the recursion that defines them."""

import numpy as np
import pytest

from tigar_x.geometry.bspline import BSplineBasis, TensorBasis, open_knots, periodic_knots

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


def random_periodic(degree, seed, ends=1):
    """Random periodic basis, its first knot ``ends`` times, every other one with its own multiplicity."""
    rng = np.random.default_rng(seed)
    interior = np.sort(rng.uniform(-1.0, 2.0, 5))
    counts = rng.permutation(np.concatenate([[degree], rng.integers(1, degree + 1, 4)]))
    inside = np.repeat(interior, counts)
    return BSplineBasis(degree, np.concatenate([np.full(ends, -1.5), inside, np.full(ends, 2.5)]), periodic=True)


PERIODIC = [(p, m) for p in DEGREES for m in range(1, p + 1)]


def values(basis, xi, derivative=None):
    return TensorBasis((basis,)).evaluate(np.reshape(xi, (-1, 1)), derivative).toarray()


def coefficients(basis, seed=0):
    return np.random.default_rng(seed).uniform(-1, 1, basis.n)


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


# -- continuity -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("degree", "continuity"), [(p, c) for p in DEGREES for c in range(p)])
def test_knots_of_reduced_continuity(degree, continuity):
    m = degree - continuity
    knots = open_knots(degree, [0.0, 0.25, 1.0, 2.0], continuity)
    np.testing.assert_array_equal(knots, [0.0] * (degree + 1) + [0.25] * m + [1.0] * m + [2.0] * (degree + 1))
    assert BSplineBasis(degree, knots).n == degree + 1 + 2 * m
    around = periodic_knots(degree, [0.0, 0.25, 1.0, 2.0, 2.5, 3.0], continuity)
    np.testing.assert_array_equal(around, np.repeat([0.0, 0.25, 1.0, 2.0, 2.5, 3.0], m))
    assert BSplineBasis(degree, around, periodic=True).n == 5 * m


def test_greatest_continuity_is_the_default():
    np.testing.assert_array_equal(open_knots(3, [0, 1, 2]), open_knots(3, [0, 1, 2], 2))
    np.testing.assert_array_equal(periodic_knots(3, [0, 1, 2]), periodic_knots(3, [0, 1, 2], 2))


@pytest.mark.parametrize("make", [open_knots, periodic_knots])
@pytest.mark.parametrize("continuity", [-1, 3, 1.5, "C1"])
def test_continuity_out_of_range(make, continuity):
    with pytest.raises(ValueError, match=rf"continuity = {continuity!r}: one of 0, 1, 2 is required"):
        make(3, [0, 1, 2], continuity)


def jump(basis, derivative, low, high):
    """Difference of a spline's values or first derivatives at two parameters, without the sign."""
    below, above = values(basis, [low, high], derivative) @ coefficients(basis)
    return abs(above - below)


@pytest.mark.parametrize("degree", [2, 3, 4])
def test_splines_are_as_smooth_as_their_knots_say(degree):
    """The first derivative jumps at a knot of continuity 0, inside and at the seam of a period, and at no other."""
    for continuity in range(degree):
        ticks = np.array([0.0, 0.3, 0.7, 1.0, 1.6, 2.0])
        inside = BSplineBasis(degree, open_knots(degree, ticks, continuity))
        around = BSplineBasis(degree, periodic_knots(degree, ticks, continuity), periodic=True)
        places = [(basis, np.nextafter(x, 0.0), x) for basis in (inside, around) for x in ticks[1:-1]]
        for basis, low, high in [*places, (around, 2.0, 0.0)]:
            assert jump(basis, None, low, high) < 1e-13
            assert (jump(basis, 0, low, high) < 1e-11) == (continuity > 0)


# -- periodic bases ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("degree", "ends"), PERIODIC)
def test_periodic_functions_are_those_of_the_knots_wound_around(degree, ends):
    basis = random_periodic(degree, degree + ends, ends)
    period, n = 4.0, basis.n
    once = basis.knots[:n]
    wound = np.concatenate([once + k * period for k in range(-3, 4)])  # function i begins at its knot i
    xi = np.concatenate([np.random.default_rng(1).uniform(-1.5, 2.5, 30), basis.breakpoints])
    expected = np.zeros((len(xi), n))
    for j in range(len(wound) - degree - 1):
        expected[:, j % n] += [cox_de_boor(wound, degree, j, x) for x in xi]
    assert n == len(basis.knots) - ends
    np.testing.assert_allclose(values(basis, xi), expected, rtol=0, atol=1e-13)


@pytest.mark.parametrize(("degree", "ends"), PERIODIC)
def test_periodic_functions_sum_to_one_and_close(degree, ends):
    basis = random_periodic(degree, 7, ends)
    N = values(basis, np.linspace(-1.5, 2.5, 41))
    np.testing.assert_allclose(N.sum(axis=1), 1.0, rtol=0, atol=1e-14)
    np.testing.assert_allclose(N[-1], N[0], rtol=0, atol=1e-14)
    assert (N >= 0.0).all()
    assert ((N > 0.0).sum(axis=1) <= degree + 1).all()


def test_uniform_periodic_functions_are_shifts_of_one():
    basis = BSplineBasis(3, periodic_knots(3, np.arange(7.0)), periodic=True)
    xi = np.array([0.1, 0.4, 0.9])
    for k in range(6):
        np.testing.assert_allclose(np.roll(values(basis, xi + k), -k, axis=1), values(basis, xi), rtol=0, atol=1e-14)


@pytest.mark.parametrize(
    ("degree", "knots", "message"),
    [
        (2, [0, 1, 2], r"knots gives 2 periodic functions: degree 2 requires 3"),
        (3, [0, 0, 1, 1], r"knots gives 2 periodic functions: degree 3 requires 4"),
        (2, [0, 0, 0, 1, 2, 3, 3, 3], r"knots repeats its ends 3 and 3 times: equally many, 1 to 2, are required"),
        (2, [0, 0, 1, 2, 3], r"knots repeats its ends 2 and 1 times"),
        (2, [0, 1, 1, 1, 2, 3], r"knots repeats 1.0 3 times: at most 2"),
        (2, [0, 2, 1, 3], r"knots\[1:3\] = \[2. 1.\]: a non-decreasing"),
        (1, [0], r"knots has 1 entries"),
        (1, [1, 1], r"knots repeats its ends 2 and 2 times"),
    ],
)
def test_bad_periodic_knots(degree, knots, message):
    with pytest.raises(ValueError, match=message):
        BSplineBasis(degree, knots, periodic=True)


# -- first derivatives ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("degree", DEGREES)
@pytest.mark.parametrize("periodic", [False, True])
def test_derivatives_are_the_limits_of_differences(degree, periodic):
    basis = random_periodic(degree, 3) if periodic else random_basis(degree, 3)
    xi = np.random.default_rng(5).uniform(-1.49, 2.49, 60)
    xi = xi[np.abs(xi[:, None] - basis.breakpoints).min(axis=1) > 1e-3]
    h = 1e-5
    difference = (values(basis, xi + h) - values(basis, xi - h)) / (2 * h)
    derivative = values(basis, xi, 0)
    scale = np.abs(derivative).max()
    np.testing.assert_allclose(derivative, difference, rtol=0, atol=1e-5 * scale)
    np.testing.assert_allclose(derivative.sum(axis=1), 0.0, atol=1e-13 * scale)
    assert np.abs(derivative - values(basis, xi)).max() > 0.1


@pytest.mark.parametrize("degree", DEGREES)
def test_derivatives_at_the_knots_come_from_the_right_and_at_the_end_from_the_left(degree):
    basis = random_basis(degree, 11)
    x, step = basis.breakpoints, 1e-9
    at = values(basis, x, 0)
    beside = values(basis, np.append(x[:-1] + step, x[-1] - step), 0)
    np.testing.assert_allclose(at, beside, rtol=0, atol=1e-5 * np.abs(at).max())
    before = values(basis, x[1:-1] - step, 0)
    assert np.abs(before - at[1:-1]).max() > 0.1  # some knot is a kink


def test_derivatives_of_a_tensor_product():
    tensor = TensorBasis((random_basis(2, 6), random_periodic(3, 7), random_basis(1, 8)))
    xi = np.random.default_rng(9).uniform(-1.5, 2.5, (20, 3))
    functions = [values(basis, x) for basis, x in zip(tensor.directions, xi.T, strict=True)]
    for d in range(3):
        factors = list(functions)
        factors[d] = values(tensor.directions[d], xi[:, d], 0)
        expected = np.einsum("mi,mj,mk->mkji", *factors).reshape(20, -1)
        np.testing.assert_allclose(tensor.evaluate(xi, d).toarray(), expected, rtol=0, atol=1e-13)


def test_there_is_no_such_derivative():
    basis = BSplineBasis(1, open_knots(1, [0, 1]))
    with pytest.raises(ValueError, match=r"order = 2: one of 0, 1 is required"):
        basis.local([0.5], 2)
    with pytest.raises(ValueError, match=r"derivative = 2: one of 0, 1 is required"):
        TensorBasis((basis, basis)).evaluate([[0.5, 0.5]], 2)


# -- Greville points --------------------------------------------------------------------------------------------------


def test_greville_abscissae_of_known_knots():
    np.testing.assert_allclose(BSplineBasis(2, open_knots(2, [0, 1, 2])).greville, [0, 0.5, 1.5, 2], rtol=1e-15)
    np.testing.assert_allclose(BSplineBasis(2, open_knots(2, [0, 1, 2], 0)).greville, [0, 0.5, 1, 1.5, 2], rtol=1e-15)
    smooth, kinked = (BSplineBasis(2, periodic_knots(2, np.arange(5.0), c), periodic=True) for c in (1, 0))
    np.testing.assert_allclose(smooth.greville, [1.5, 2.5, 3.5, 0.5], rtol=1e-15)
    np.testing.assert_allclose(kinked.greville, [0.5, 1, 1.5, 2, 2.5, 3, 3.5, 0], rtol=1e-15)


@pytest.mark.parametrize(("degree", "ends"), PERIODIC)
def test_greville_abscissae_of_a_period_lie_within_it_where_their_functions_are(degree, ends):
    basis = random_periodic(degree, 5, ends)
    assert basis.greville.shape == (basis.n,)
    assert ((basis.greville >= -1.5) & (basis.greville <= 2.5)).all()
    assert (values(basis, basis.greville).diagonal() > 0.01).all()
    assert len(np.unique(np.round(basis.greville, 12))) == basis.n


@pytest.mark.parametrize("degree", DEGREES)
def test_interpolation_at_the_greville_points_is_the_inverse_of_evaluation(degree):
    tensor = TensorBasis((random_basis(degree, 1), random_periodic(degree, 2), random_basis(1, 3)))
    assert tensor.greville.shape == (tensor.n, 3)
    np.testing.assert_allclose(
        tensor.greville[:, 0], np.tile(tensor.directions[0].greville, tensor.n // tensor.directions[0].n)
    )
    wanted = np.random.default_rng(4).uniform(-1, 1, (tensor.n, 2))
    found = tensor.interpolate(tensor.evaluate(tensor.greville) @ wanted)
    np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-11)
    with pytest.raises(ValueError, match=r"values has shape \(3, 2\)"):
        tensor.interpolate(wanted[:3])


# -- bases that contain another ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "basis", [random_basis(2, 1), random_basis(3, 2), random_periodic(2, 3, 2), random_periodic(3, 4)]
)
def test_richer_bases_contain_the_present_one(basis):
    for richer in (basis.elevated(basis.degree + 2), basis.with_knots([0.1, 0.1, -1.2, 2.2])):
        single = TensorBasis((richer,))
        wanted = coefficients(basis)
        found = single.interpolate(values(basis, richer.greville) @ wanted[:, None])[:, 0]
        xi = np.linspace(-1.5, 2.5, 57)
        np.testing.assert_allclose(values(richer, xi) @ found, values(basis, xi) @ wanted, rtol=0, atol=1e-11)
        assert richer.n > basis.n
        assert richer.periodic == basis.periodic


def test_knots_that_are_there_are_not_added_again():
    third = 1 / 3
    basis = BSplineBasis(3, open_knots(3, [0.0, third, 1.0], 1))
    same = basis.with_knots([0.0, np.nextafter(third, 1.0), third, 1.0, 1.0])
    np.testing.assert_array_equal(same.knots, basis.knots)
    more = basis.with_knots([0.5, third, third, third, 0.5])
    np.testing.assert_array_equal(more.knots, [0, 0, 0, 0, third, third, third, 0.5, 0.5, 1, 1, 1, 1])
    np.testing.assert_array_equal(basis.with_knots([]).knots, basis.knots)
    np.testing.assert_array_equal(
        basis.find([0.0, 0.5, np.nextafter(third, 0.0), 1.0, 1.1, -0.1]), [0, -1, 1, 2, -1, -1]
    )


def test_bad_richer_bases():
    basis = BSplineBasis(2, open_knots(2, [0, 1]))
    with pytest.raises(ValueError, match=r"degrees = 1: an integer >= 2"):
        basis.elevated(1)
    with pytest.raises(ValueError, match=r"knots ranges over \[0.5, 1.5\]: knots in \[0.0, 1.0\] are required"):
        basis.with_knots([1.5, 0.5])
    with pytest.raises(ValueError, match=r"knots repeats 0.5 3 times: at most 2"):
        basis.with_knots([0.5] * 3)
    with pytest.raises(ValueError, match=r"knots\[0\] = nan"):
        basis.with_knots([np.nan])


# -- tensor products --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dim", [1, 2, 3])
def test_tensor_products_of_all_kinds_sum_to_one(dim):
    kinds = (random_periodic(2, 1, 2), random_basis(3, 2), random_periodic(1, 3))
    xi = np.random.default_rng(dim).uniform(-1.5, 2.5, (50, dim))
    for shift in range(3):
        tensor = TensorBasis((kinds * 2)[shift : shift + dim])
        N = tensor.evaluate(xi)
        np.testing.assert_allclose(N.sum(axis=1), 1.0, rtol=0, atol=1e-13)
        for d in range(dim):
            np.testing.assert_allclose(tensor.evaluate(xi, d).sum(axis=1), 0.0, atol=1e-11)


def test_no_points_at_all():
    tensor = TensorBasis((random_basis(2, 6), random_periodic(3, 7)))
    assert tensor.evaluate(np.zeros((0, 2))).shape == (0, tensor.n)
    assert tensor.evaluate(np.zeros((0, 2)), 1).shape == (0, tensor.n)
    v, j = random_basis(2, 6).local([])
    assert v.shape == j.shape == (0, 3)


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
