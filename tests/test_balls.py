"""Cells that may be near points or on lines: none is missed, and few are found that are not."""

import numpy as np
import pytest
from test_nearest_surfaces import grid, surfaces

from coudalfish.surface.balls import Balls
from coudalfish.surface.triangles import Triangles


def cells(n=12):
    """Quadrilaterals of a bent surface of very different size, four triangles each, and those of a second one."""
    bent = grid(n, lambda u, v: np.column_stack([u**3, v**2, 0.3 * u * v + 0.1 * u**2]))
    other = grid(4, lambda u, v: np.column_stack([u, v, 0.5 + 0.2 * v * u]))
    triangles = surfaces(bent, other).triangles
    return triangles, Balls.of(triangles, 4)


def test_cells_near_points():
    rng = np.random.default_rng(2)
    triangles, balls = cells()
    x, bound = rng.uniform(-0.3, 1.3, (80, 3)), rng.uniform(0.0, 0.5, 80)
    each = np.arange(len(triangles.x))
    distance = np.array([np.linalg.norm(triangles.nearest(np.tile(p, (len(each), 1)), each)[1], axis=1) for p in x])
    there = distance.reshape(80, -1, 4).min(axis=2) <= bound[:, None]
    i, k = balls.near(x, bound, np.full(80, -1))
    found = np.zeros_like(there)
    found[i, k] = True
    assert len(i) == found.sum()
    assert (found | ~there).all()
    assert there.sum() > 300
    assert found.sum() < 2 * there.sum()
    known = there.argmax(axis=1)
    i, k = balls.near(x, bound, known)
    found[np.arange(80), known] = False
    np.testing.assert_array_equal(
        np.unique(i * 1000 + k), np.flatnonzero(found) // found.shape[1] * 1000 + found.nonzero()[1]
    )


@pytest.mark.parametrize("length", [0.02, 0.4])
def test_cells_on_lines(length):
    rng = np.random.default_rng(3)
    triangles, balls = cells()
    start = rng.uniform(-0.1, 1.1, (300, 3)) * [1.0, 1.0, 0.7]
    end = start + length * rng.standard_normal((300, 3))
    each = np.arange(len(triangles.x))
    there = np.array(
        [triangles.crossed(*(np.tile(p, (len(each), 1)) for p in line), each) for line in zip(start, end, strict=True)]
    )
    there = there.reshape(300, -1, 4).any(axis=2)
    line, k = balls.pierced(start, end)
    found = np.zeros_like(there)
    found[line, k] = True
    assert (found | ~there).all()
    assert there.any()
    assert found.sum() < 3 * there.sum() + 60


def test_a_line_along_a_face_may_pass_through_it():
    flat = Triangles(np.array([[[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]]))
    start, end = np.array([[-1.0, 0.2, 0.0], [-1.0, 0.2, 0.1]]), np.array([[1.0, 0.2, 0.0], [1.0, 0.2, 0.1]])
    np.testing.assert_array_equal(Balls.of(flat).pierced(start, end)[0], [0])
