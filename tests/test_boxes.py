"""Triangles near points and on lines, found by a tree of boxes: none is missed, of those equally near all are found."""

from itertools import pairwise

import numpy as np
import pytest
from test_nearest_surfaces import grid, surfaces

from coudalfish.surface.boxes import CORNER, EDGE, FACE, ROOM, Boxes
from coudalfish.surface.triangles import Triangles

RNG = np.random.default_rng(2)


def bent():
    """Triangles of a bent surface of very different size, four in a cell, and those of a second one."""
    one = grid(12, lambda u, v: np.column_stack([u**3, v**2, 0.3 * u * v + 0.1 * u**2]))
    other = grid(4, lambda u, v: np.column_stack([u, v, 0.5 + 0.2 * v * u]))
    return surfaces(one, other).triangles.x


def from_triangles(x, point):
    """Distances of a point: that of the foot in a triangle's plane, where it is within, or of the nearest side."""
    sides = []
    for k in range(3):
        a, arm = x[:, k], x[:, (k + 1) % 3] - x[:, k]
        t = np.clip(np.einsum("ni,ni->n", point - a, arm) / (arm**2).sum(axis=1), 0.0, 1.0)
        sides.append(np.linalg.norm(point - a - t[:, None] * arm, axis=1))
    foot = Triangles(x).in_plane(np.broadcast_to(point, (len(x), 3)), np.arange(len(x)))
    height = np.linalg.norm(point - np.einsum("nc,nci->ni", foot, x), axis=1)
    return np.where((foot >= 0.0).all(axis=1), height, np.min(sides, axis=0))


def test_nearest_places_of_triangles():
    x, points = RNG.standard_normal((400, 3, 3)), 1.5 * RNG.standard_normal((400, 3))
    found = [Boxes.around(x[k : k + 1]).nearest(points[k : k + 1], np.array([np.inf])) for k in range(400)]
    kind, inner, gap, distance = (
        np.concatenate([getattr(one, name) for one in found]) for name in found[0]._fields[2:]
    )
    weights = np.column_stack([1.0 - inner.sum(axis=1), inner])
    np.testing.assert_allclose(np.einsum("nc,nci->ni", weights, x) + gap, points, atol=1e-14)
    expected = [from_triangles(x[k : k + 1], points[k])[0] for k in range(400)]
    np.testing.assert_allclose(distance, expected, atol=1e-13)
    foot = Triangles(x).in_plane(points, np.arange(400))
    np.testing.assert_array_equal(kind == FACE, (foot >= 0.0).all(axis=1))
    for corner in range(3):
        np.testing.assert_allclose(weights[kind == EDGE + corner, corner], 0.0, atol=1e-15)
        np.testing.assert_allclose(weights[kind == CORNER + corner, corner], 1.0)
        assert (kind == EDGE + corner).sum() > 5
        assert (kind == CORNER + corner).sum() > 5


@pytest.mark.parametrize("parts", [1, 4])
def test_no_triangle_is_missed(parts):
    x = bent()
    points, limit = RNG.uniform(-0.3, 1.3, (400, 3)), RNG.uniform(-0.1, 0.5, 400)
    near = Boxes.around(x, parts).nearest(points, limit)
    least = np.array([from_triangles(x, point).min() for point in points])
    found = np.full(400, np.inf)
    found[near.point] = near.distance
    np.testing.assert_allclose(found, np.where(least <= limit, least, np.inf), atol=1e-14)
    assert (np.diff(near.point) >= 0).all()
    assert 50 < np.isfinite(found).sum() < 350
    given = np.column_stack([1.0 - near.inner.sum(axis=1), near.inner])
    places = np.einsum("nc,nci->ni", given, x[near.triangle])
    np.testing.assert_allclose(places + near.gap, points[near.point], atol=1e-14)


@pytest.mark.parametrize("parts", [1, 4])
def test_the_size_is_that_of_the_largest_leaf_and_takes_no_arrays(parts, monkeypatch):
    boxes = Boxes.around(bent(), parts)
    first = boxes._tree[-1]
    leaves = [boxes.x[boxes.order[a:b]].reshape(-1, 3) for a, b in pairwise(first)]
    expected = max(np.linalg.norm(np.ptp(x, axis=0)) for x in leaves if len(x))
    monkeypatch.delattr(np.linalg, "norm")
    assert boxes.size == pytest.approx(expected, rel=1e-15)


@pytest.mark.parametrize("parts", [1, 4])
def test_points_within_a_limit_are_those_with_a_nearest_place(parts):
    boxes = Boxes.around(bent(), parts)
    points, limit = RNG.uniform(-0.3, 1.3, (400, 3)), RNG.uniform(-0.1, 0.5, 400)
    near = boxes.nearest(points, limit)
    limit[near.point[::2]] = near.distance[::2]
    expected = np.zeros(400, dtype=bool)
    expected[near.point] = True
    np.testing.assert_array_equal(boxes.within(points, limit), expected)
    assert 50 < expected.sum() < 350
    assert not Boxes.around(np.empty((0, 3, 3))).within(points, limit).any()


def test_all_that_are_equally_near_are_found():
    """More of them than there is room for at first."""
    angle = np.linspace(0.0, 2.0 * np.pi, 2 * ROOM + 1)
    around = np.column_stack([np.cos(angle), np.sin(angle), -np.ones(len(angle))])
    fan = np.stack([np.zeros((2 * ROOM, 3)), around[:-1], around[1:]], axis=1)
    far = fan + np.array([5.0, 0.0, 0.0])
    points = np.array([[0.0, 0.0, 0.5], [0.0, 0.0, 9.0]])
    near = Boxes.around(np.concatenate([far, fan])).nearest(points, np.array([1.0, 2.0]))
    np.testing.assert_array_equal(near.point, 0)
    np.testing.assert_array_equal(np.sort(near.triangle), 2 * ROOM + np.arange(2 * ROOM))
    np.testing.assert_array_equal(near.kind, CORNER)
    np.testing.assert_allclose(near.distance, 0.5)


def test_triangles_without_area_are_their_edges():
    a, b, points = (RNG.standard_normal((50, 3)) for _ in range(3))
    near = Boxes.around(np.stack([a, b, b], axis=1)).nearest(points, np.full(50, np.inf))
    t = np.clip(np.einsum("pei,ei->pe", points[:, None] - a, b - a) / ((b - a) ** 2).sum(axis=1), 0.0, 1.0)
    expected = np.linalg.norm(points[:, None] - a - t[..., None] * (b - a), axis=2).min(axis=1)
    np.testing.assert_array_equal(near.point, np.arange(50))
    np.testing.assert_allclose(near.distance, expected, atol=1e-14)


@pytest.mark.parametrize("length", [0.02, 0.4])
def test_lines_that_pass_through_triangles(length):
    x = bent()
    start = RNG.uniform(-0.1, 1.1, (300, 3)) * [1.0, 1.0, 0.7]
    end = start + length * RNG.standard_normal((300, 3))
    line, triangle = Boxes.around(x, 4).pierced(start, end)
    found = np.zeros((300, len(x)), dtype=bool)
    found[line, triangle] = True
    edges = np.stack([x[:, 1] - x[:, 0], x[:, 2] - x[:, 0]], axis=-1)
    matrices = np.concatenate([np.broadcast_to(edges, (300, *edges.shape)), -np.ones((300, len(x), 3, 1))], axis=-1)
    matrices[..., 2] = (start - end)[:, None]
    u, v, t = np.moveaxis(np.linalg.solve(matrices, (start[:, None] - x[:, 0])[..., None])[..., 0], -1, 0)
    np.testing.assert_array_equal(found, (u >= 0.0) & (v >= 0.0) & (u + v <= 1.0) & (t >= 0.0) & (t <= 1.0))
    assert len(line) == found.sum() > 5


def test_lines_in_the_plane_of_a_triangle_and_through_its_edges():
    flat = Boxes.around(np.array([[[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]]))
    start = np.array([[-1.0, 0.2, 0.0], [-1.0, 0.2, 0.1], [0.5, 0.5, -0.1], [0.0, 0.0, 0.0], [0.6, 0.6, -0.1]])
    end = np.array([[1.0, 0.2, 0.0], [1.0, 0.2, 0.1], [0.5, 0.5, 0.3], [0.0, 0.0, 1.0], [0.6, 0.6, 0.1]])
    np.testing.assert_array_equal(flat.pierced(start, end)[0], [0, 2, 3])


def test_triangles_without_area_have_no_places():
    x = bent().copy()
    x[::3, 2] = 0.5 * (x[::3, 0] + x[::3, 1])
    points = RNG.uniform(0.0, 1.0, (200, 3))
    start, end = points, points + 0.3 * RNG.standard_normal((200, 3))
    boxes, sound = Boxes.of(Triangles(x), 4), Boxes.around(np.delete(x, np.arange(0, len(x), 3), axis=0))
    near, expected = (one.nearest(points, np.full(200, np.inf)) for one in (boxes, sound))
    assert (near.triangle % 3 > 0).all()
    np.testing.assert_allclose(near.distance, expected.distance)
    np.testing.assert_array_equal(boxes.pierced(start, end)[0], np.sort(sound.pierced(start, end)[0]))


def test_nothing():
    empty, some = Boxes.around(np.empty((0, 3, 3))), Boxes.around(bent(), 4)
    x = np.zeros((2, 3))
    for boxes, points in ((empty, x), (some, x[:0]), (some, x + 50.0)):
        assert not len(boxes.nearest(points, np.full(len(points), 1.0)).point)
        assert not len(boxes.pierced(points, points + 0.1)[0])
