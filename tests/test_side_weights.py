"""Triangles and tetrahedra that a curve or a surface cuts: weights that integrate over their sides."""

from itertools import combinations, pairwise, product

import numpy as np
import pytest

from coudalfish.surface.cut_cells import CutCells, SideWeights, rule
from varmint.flow.sides import DEGREE

RNG = np.random.default_rng(7)
VALUES = {
    2: [(-1.0, 2.0, 3.0), (1.0, -2.0, -0.5), (0.3, 0.7, -1e-4), (-1e-9, 1.0, 1.0), (-1.0, 0.0, 2.0)],
    3: [
        *[tuple(RNG.uniform(0.1, 1.0, 4) * signs) for signs in product((-1, 1), repeat=4) if len(set(signs)) == 2],
        (-1e-9, 1.0, 1.0, 1.0), (-1.0, -2.0, 1e-5, 1e-4), (-1.0, 0.0, 0.0, 1.0), (-1.0, -1e-6, 3.0, 0.0),
    ],
}  # fmt: skip
CASES = [(d, values) for d in VALUES for values in VALUES[d]]


def cut_of(values):
    values = np.asarray(values, dtype=float)
    return CutCells.of(np.arange(len(values))[None], values)


AT, WEIGHTS = np.polynomial.legendre.leggauss(5)
AT, WEIGHTS = 0.5 * (AT + 1.0), 0.5 * WEIGHTS


def over_negative_side(f, values):
    """By slices of a simplex along its first axis, on each of which the function is cut as a line or a triangle."""
    d = len(values) - 1
    slope, offset = np.asarray(values[1:]) - values[0], values[0]
    if d == 1:
        ends = np.array([0.0, 1.0])
        root = -offset / slope[0] if slope[0] else np.inf
        if offset < 0.0 or (offset == 0.0 and slope[0] < 0.0):
            ends[1] = root if 0.0 <= root <= 1.0 and slope[0] > 0.0 else 1.0
        else:
            ends[0] = root if 0.0 <= root <= 1.0 and slope[0] < 0.0 else 1.0
        size = ends[1] - ends[0]
        return size * (WEIGHTS @ f((ends[0] + AT * size)[:, None]))
    breaks = [0.0, 1.0]  # slices change their kind at the heights of the vertices and where edges are cut
    for b, a in combinations(range(d + 1), 2):
        if (values[a] < 0.0) != (values[b] < 0.0):
            t = values[a] / (values[a] - values[b])
            breaks.append((1.0 - t) * (a == 1) + t * (b == 1))
    breaks = np.unique(np.clip(breaks, 0.0, 1.0))
    total = 0.0
    for low, high in pairwise(breaks):
        for s, w in zip(low + AT * (high - low), (high - low) * WEIGHTS, strict=True):
            corners = [offset + s * slope[0], *(offset + s * slope[0] + (1.0 - s) * slope[1:])]

            def slice_of(y, s=s):
                return f(np.column_stack([np.full(len(y), s), (1.0 - s) * y]))

            total += w * (1.0 - s) ** (d - 1) * over_negative_side(slice_of, corners)
    return total


@pytest.mark.parametrize("degree", [1, 2, 4])
@pytest.mark.parametrize(("d", "values"), CASES)
def test_weights_integrate_over_the_side(d, values, degree):
    """Times all polynomials of degree k, at the points of any rule of degree 2 k, as over the side itself."""
    x, w = rule(d, 2 * degree)
    cut = cut_of(values)
    c = SideWeights(degree, x)(cut)[0]
    powers = np.array([p for p in product(range(degree + 1), repeat=d) if sum(p) <= degree])

    def f(y):
        return (y[:, None] ** powers).prod(axis=2)

    np.testing.assert_allclose((w * c) @ f(x), over_negative_side(f, values), atol=5e-15)
    np.testing.assert_allclose(cut.negative_share, w @ c / w.sum(), atol=1e-13)


def test_what_is_unknown_is_not_cut():
    phi = np.array([0.0, 1.0, 2.0, -1.0, np.nan])
    cut = CutCells.of(np.array([[0, 1, 2, 1], [0, 1, 2, 3], [3, 1, 2, 4]]), phi)
    np.testing.assert_array_equal(cut.cells, [1])
    np.testing.assert_array_equal(cut.only(np.array([False])).cells, [])


@pytest.mark.parametrize("kind", DEGREE)
@pytest.mark.parametrize("d", [2, 3])
def test_masses_of_both_sides_are_positive_however_cells_are_cut(d, kind):
    """Of linear velocities, with kinks as well, by weights of the degree that flows take; with one less they are not,
    which would make small steps diverge: the degree is that of a product of two fields in space as in the plane."""
    rng = np.random.default_rng(d)
    signs = np.array([s for s in product((-1, 1), repeat=d + 1) if len(set(s)) == 2])
    values = np.tile(signs, (20, 1)) * 10.0 ** rng.uniform(-4.0, 0.0, (20 * len(signs), d + 1))
    cut = CutCells(np.arange(len(values)), values)
    least = []
    for degree in (DEGREE[kind], DEGREE[kind] - 1):
        x, w = rule(d, 2 * DEGREE[kind])
        negative, N = SideWeights(degree, x)(cut), np.column_stack([1.0 - x.sum(axis=1), x])
        found = []
        for s, weight in ((-1.0, negative), (1.0, 1.0 - negative)):
            fields = np.broadcast_to(N, (len(values), *N.shape))
            if kind != "jump":
                psi = (np.abs(values) - s * values) @ N.T / np.abs(values).max(axis=1)[:, None]
                fields = np.concatenate([fields, psi[..., None] * fields], axis=2)
            mass, whole = (np.einsum("ng,ngi,ngj->nij", of, fields, fields) for of in (w * weight, w + 0.0 * weight))
            found.append(np.linalg.eigvalsh(mass)[:, 0] / np.trace(whole, axis1=1, axis2=2))
        least.append(np.min(found))
    assert least[0] > -1e-14
    assert least[1] < -1e-3
