"""Simplices of any dimension that a linear function divides, as those of their sides and of where it is zero."""

from itertools import product

import numpy as np
import pytest

from tigar_x.fem.simplices import Division, SidedSimplices

RNG = np.random.default_rng(3)
PATTERNS = {d: [s for s in product((-1, 1), repeat=d + 1) if len(set(s)) == 2] for d in (1, 2, 3, 4)}


def divided(d, each=3):
    """Simplices of all patterns of signs."""
    signs = np.repeat(PATTERNS[d], each, axis=0)
    return signs * RNG.uniform(0.1, 1.0, signs.shape)


def sides(division):
    """Both sides with their signs."""
    sign = np.where(division.of_negative, -1.0, 1.0)
    return [(parts, sign[parts.rows]) for parts in division.smaller] + [
        (parts, -sign[parts.rows]) for parts in division.larger
    ]


@pytest.mark.parametrize("d", PATTERNS)
def test_parts_fill_the_simplices_and_are_on_their_sides(d):
    division = Division(divided(d))
    filled, smaller = np.zeros((2, len(division.values)))
    for parts, sign in sides(division):
        phi = np.einsum("npvk,nk->npv", parts.barycentric, division.values[parts.rows])
        assert (phi * sign[:, None, None] > -1e-14).all()
        assert (np.isclose(phi, 0.0).any(axis=2)).all()  # every part reaches to where it is zero
        if d > 1:
            assert (np.linalg.det(parts.barycentric) > 0.0).all()
        np.testing.assert_allclose(parts.shares, np.abs(np.linalg.det(parts.barycentric)), rtol=1e-13)
        filled[parts.rows] += parts.shares.sum(axis=1)
    for parts in division.smaller:
        smaller[parts.rows] = parts.shares.sum(axis=1)
    np.testing.assert_allclose(filled, 1.0)
    np.testing.assert_allclose(division.smaller_share, smaller)


@pytest.mark.parametrize("d", PATTERNS)
def test_parts_do_not_overlap(d):
    """A random point is in one of them."""
    division = Division(divided(d, 1))
    x = RNG.dirichlet(np.ones(d + 1), (len(division.values), 40))
    count = np.zeros(x.shape[:2], dtype=int)
    for parts, _ in sides(division):
        inner = np.einsum("ngk,npkv->npgv", x[parts.rows], np.linalg.inv(parts.barycentric))
        count[parts.rows] += (inner > 0.0).all(axis=-1).sum(axis=1)
    np.testing.assert_array_equal(count, 1)


@pytest.mark.parametrize(("signs", "small", "large", "zero"), [((-1, 1, 1, 1), 1, 3, 1), ((1, -1, 1, -1), 3, 3, 2)])
def test_a_tetrahedron_is_divided_in_as_many_parts_as_there_must_be(signs, small, large, zero):
    division = Division(np.array([signs], dtype=float))
    found = [
        [part.barycentric.shape[1] for part in parts] for parts in (division.smaller, division.larger, division.zero)
    ]
    assert found == [[small], [large], [zero]]


@pytest.mark.parametrize("d", [2, 3])
def test_where_it_is_zero_the_parts_have_the_area_of_the_section(d):
    """By the divergence theorem: the integral of grad phi over a side is that of phi's normal over its boundary."""
    division = Division(divided(d))
    corners = np.vstack([np.zeros(d), np.eye(d)]) + 0.2 * RNG.standard_normal((len(division.values), d + 1, d))
    thin = 1e-6  # the volume between two level sets is the area times their distance
    slopes = np.linalg.inv(corners[:, 1:] - corners[:, :1])
    gradient = np.einsum("nij,nj->ni", slopes, division.values[:, 1:] - division.values[:, :1])
    volume = np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1])) / (2 if d == 2 else 6)
    negative = [
        np.where(moved.of_negative, moved.smaller_share, 1.0 - moved.smaller_share) * volume
        for moved in (Division(division.values + thin), Division(division.values - thin))
    ]
    expected = (negative[1] - negative[0]) * np.linalg.norm(gradient, axis=1) / (2.0 * thin)
    area = np.zeros(len(volume))
    for parts in division.zero:
        x = np.einsum("npvk,nki->npvi", parts.barycentric, corners[parts.rows])
        arms = x[:, :, 1:] - x[:, :, :1]
        gram = np.linalg.det(arms @ np.swapaxes(arms, -1, -2))
        area[parts.rows] = np.sqrt(gram).sum(axis=1) / (1 if d == 2 else 2)
        phi = np.einsum("npvk,nk->npv", parts.barycentric, division.values[parts.rows])
        np.testing.assert_allclose(phi, 0.0, atol=1e-14)
    np.testing.assert_allclose(area, expected, rtol=1e-7)


def test_zero_counts_as_positive():
    division = Division(np.array([[-1.0, 0.0, 0.0, 0.0], [-1.0, -2.0, -1.0, 0.0], [-1.0, 0.0, -1.0, 0.0]]))
    np.testing.assert_array_equal(division.of_negative, [True, False, True])
    np.testing.assert_allclose(division.smaller_share, [1.0, 0.0, 1.0], atol=1e-15)


@pytest.mark.parametrize("d", [2, 3])
def test_pieces_of_cells_have_volumes_and_sides(d):
    values = divided(d)
    cells = RNG.permutation(len(values)) + 5
    sided = SidedSimplices.of(cells, values)
    volumes = np.linalg.det(sided.barycentric)
    assert (volumes > 0.0).all()
    np.testing.assert_allclose(np.bincount(sided.cells, volumes)[cells], 1.0)
    phi = np.einsum("pvk,pk->pv", sided.barycentric, values[np.argsort(cells)][sided.cells - 5])
    assert (phi * sided.side[:, None] > -1e-14).all()


def test_parts_without_volume_are_no_pieces():
    at_vertex, at_face = (-1.0, 0.0, 0.0, 2.0), (-1.0, 0.0, 0.0, 0.0)
    assert sorted(SidedSimplices.of(np.array([0]), np.array([at_vertex])).side) == [-1.0, 1.0]
    assert SidedSimplices.of(np.array([0]), np.array([at_face])).side.tolist() == [-1.0]
    assert SidedSimplices.of(np.array([], dtype=int), np.empty((0, 4))).barycentric.shape == (0, 4, 4)
