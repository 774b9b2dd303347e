"""Ribbons, the knots of closed polygons, and surfaces that go through each other."""

import numpy as np
import pytest

from shnapr.contact.piercings import piercings
from shnapr.problems.knots import Crossings
from tigar_x.geometry import shapes
from tigar_x.geometry.bspline import BSplineBasis, open_knots
from tigar_x.geometry.ribbon import CentreLine, ribbon

T = np.linspace(0.0, 2 * np.pi, 300, endpoint=False)
CLOSED = {
    "ring": (1, [np.cos(T), np.sin(T), 0 * T]),
    "twisted ring": (1, [np.cos(T) + 1.4 * np.cos(2 * T), np.sin(T) + 1.4 * np.sin(2 * T), np.sin(T)]),
    "trefoil": (3, [np.sin(T) + 2 * np.sin(2 * T), np.cos(T) - 2 * np.cos(2 * T), -np.sin(3 * T)]),
    "figure eight": (5, [(2 + np.cos(2 * T)) * np.cos(3 * T), (2 + np.cos(2 * T)) * np.sin(3 * T), np.sin(4 * T)]),
    "cinquefoil": (5, [(2 + np.cos(5 * T)) * np.cos(2 * T), (2 + np.cos(5 * T)) * np.sin(2 * T), np.sin(5 * T)]),
}


def rotation(seed):
    Q = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
    return Q * np.linalg.det(Q)


@pytest.mark.parametrize("name", CLOSED)
def test_determinant_of_a_knot_does_not_depend_on_where_it_is_seen_from(name):
    expected, curve = CLOSED[name]
    x = np.column_stack(curve)
    seen = [Crossings.of(x @ rotation(seed)) for seed in range(8)]
    assert {crossings.determinant for crossings in seen} == {expected}
    assert len({len(crossings.under) for crossings in seen}) > 1 or name == "ring"


def test_signs_of_a_trefoil_and_of_its_mirror_image():
    x = np.column_stack(CLOSED["trefoil"][1])
    here, mirrored = Crossings.of(x), Crossings.of(x * (1, 1, -1))
    assert abs(here.writhe) == 3
    assert mirrored.writhe == -here.writhe
    # one strand pulled through another one: nothing is tied any more
    k = round(here.under[0])
    x[k - 12 : k + 13, 2] += 3.0 * np.hanning(25)
    assert Crossings.of(x).determinant == 1


def test_a_straight_ribbon_is_a_strip():
    line = CentreLine.through([(0, 0, 1), (1, 1, 1), (3, 3, 1), (4, 4, 1)])
    assert line.length == pytest.approx(4 * 2**0.5, rel=1e-12)
    along, across = BSplineBasis(2, open_knots(2, np.linspace(0, line.length, 6))), shapes.uniform(2, 2)
    patch = ribbon(line, 0.5, (0, 0, 2), along, across)
    xi = np.random.default_rng(0).uniform(0, 1, (20, 2)) * (line.length, 1.0)
    expected = xi[:, :1] * np.array([1, 1, 0]) / 2**0.5 + (xi[:, 1:] - 0.5) * 0.5 * np.array([-1, 1, 0]) / 2**0.5
    np.testing.assert_allclose(patch.evaluate(xi), expected + np.array([0, 0, 1]), atol=1e-12)


def test_a_ribbon_around_a_circle_converges_to_a_ring():
    angle = np.linspace(0, 1.5 * np.pi, 41)
    line = CentreLine.through(np.column_stack([np.cos(angle), np.sin(angle), 0 * angle]))
    assert line.length == pytest.approx(1.5 * np.pi, rel=1e-5)
    errors = []
    for elements in (8, 16, 32):
        along = BSplineBasis(3, open_knots(3, np.linspace(0, line.length, elements + 1)))
        patch = ribbon(line, 0.4, (0, 0, 1), along, shapes.uniform(2, 1))
        s = np.linspace(0, line.length, 101)
        rims = [patch.evaluate(np.column_stack([s, np.full(101, v)])) for v in (0.0, 1.0)]
        radii = [np.linalg.norm(rim, axis=1) for rim in rims]
        errors.append(max(np.abs(radii[0] - 1.2).max(), np.abs(radii[1] - 0.8).max()))
    assert errors[-1] < 1e-4
    assert errors[1] < errors[0] / 6


def sheet(height, n=6):
    """Points and quadrilaterals of a square net with a height of its own in every point."""
    u, v = np.meshgrid(np.linspace(0, 1, n), np.linspace(0, 1, n), indexing="ij")
    number = np.arange(n * n).reshape(n, n)
    quads = np.stack([number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]], axis=-1).reshape(-1, 4)
    return np.column_stack([u.ravel(), v.ravel(), height(u, v).ravel()]), quads


def test_piercings():
    lower, quads = sheet(lambda u, v: 0 * u)
    both = np.concatenate([quads, quads + len(lower)])

    def count(height, **options):
        upper = sheet(height)[0] + np.array([0.013, 0.031, 0.0])
        return piercings(np.concatenate([lower, upper]), both, **options)

    assert piercings(lower, quads) == 0
    assert count(lambda u, v: 0.02 + 0 * u) == 0
    assert count(lambda u, v: 0.02 + 0.3 * (u - 0.48) ** 2) == 0
    through = count(lambda u, v: u - 0.47 + 0.1 * v)
    assert through > 5
    # what was near from the start is not looked at
    X = np.concatenate([lower, lower])
    assert count(lambda u, v: u - 0.47 + 0.1 * v, X=X, apart=2.0) == 0
    X[len(lower) :] += 9.0
    assert count(lambda u, v: u - 0.47 + 0.1 * v, X=X, apart=2.0) == through


def test_bad_input_is_named():
    line = CentreLine.through([(0, 0, 0), (1, 0, 0), (2, 0, 0)])
    along, across = BSplineBasis(2, open_knots(2, [0.0, 1.0, 2.0])), shapes.uniform(2, 1)
    with pytest.raises(ValueError, match="points = "):
        CentreLine.through([(0, 0, 0), (1, 0, 0), (1, 0, 0)])
    with pytest.raises(ValueError, match="width = 0"):
        ribbon(line, 0.0, (0, 0, 1), along, across)
    with pytest.raises(ValueError, match="facing = "):
        ribbon(line, 1.0, (1, 0, 0), along, across)
    with pytest.raises(ValueError, match="polygon has shape"):
        Crossings.of(np.zeros((4, 2)))
    with pytest.raises(ValueError, match="X has shape"):
        piercings(np.zeros((4, 3)), np.array([[0, 1, 2, 3]]), np.zeros((5, 3)))
