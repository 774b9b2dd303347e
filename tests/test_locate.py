"""Closest points against closed forms and against a search on fine grids."""

import numpy as np
import pytest
from scipy.spatial import cKDTree
from splines import PATCHES, half_disc

from tigar_x.geometry import shapes
from tigar_x.geometry.bspline import BSplineBasis, TensorBasis, open_knots, periodic_knots
from tigar_x.geometry.gluing import glued
from tigar_x.geometry.locate import closest_points
from tigar_x.geometry.multipatch import disjoint
from tigar_x.geometry.patch import Patch


def crumpled(degrees, nsd, periodic=False, seed=0):
    """Rational patch over three elements a direction that folds over itself, on parameters of unequal ranges."""
    rng = np.random.default_rng(seed)
    bases = []
    for direction, p in enumerate(degrees):
        closed = periodic and direction == 0
        ticks = (direction + 1.0) * np.linspace(-1.0, 1.0, (5 if closed else 3) + 1)
        bases.append(BSplineBasis(p, (periodic_knots if closed else open_knots)(p, ticks), closed))
    points = np.zeros((int(np.prod([basis.n for basis in bases])), nsd))
    greville = TensorBasis(tuple(bases)).greville
    points[:, : len(degrees)] = greville / np.abs(greville).max(axis=0)
    points += 0.5 * rng.uniform(-1, 1, points.shape)
    return Patch.from_points(bases, points, rng.uniform(0.7, 1.4, len(points)))


def grid(patch, ticks):
    axes = [np.linspace(*basis.knots[[0, -1]], ticks) for basis in patch.bases]
    return np.column_stack([axis.ravel() for axis in np.meshgrid(*axes)])


def random_parameters(patch, m, seed=1):
    low, high = patch.basis.box
    return low + (high - low) * np.random.default_rng(seed).uniform(size=(m, patch.dim))


@pytest.mark.parametrize(
    ("degrees", "nsd", "periodic", "ticks"),
    [
        ((2,), 2, False, 20001),
        ((3,), 3, True, 20001),
        ((2, 3), 2, False, 500),
        ((3, 2), 3, False, 500),
        ((2, 2), 3, True, 500),
        ((2, 1, 2), 3, False, 50),
    ],
)
@pytest.mark.parametrize("seed", [0, 1])
def test_nothing_on_a_fine_grid_is_closer(degrees, nsd, periodic, ticks, seed):
    patch = crumpled(degrees, nsd, periodic, seed)
    on = patch.evaluate(random_parameters(patch, 60))
    away = np.random.default_rng(2).uniform(-2.5, 2.5, (60, nsd))
    found = closest_points(patch, np.concatenate([on, away]))
    low, high = patch.basis.box
    assert (found.xi >= low).all()
    assert (found.xi <= high).all()
    assert not found.patch.any()
    assert found.distance[:60].max() < 1e-13
    x = patch.evaluate(found.xi)
    np.testing.assert_allclose(np.linalg.norm(x[60:] - away, axis=1), found.distance[60:], rtol=1e-12, atol=1e-13)
    tree = cKDTree(patch.evaluate(grid(patch, ticks)))
    assert (found.distance[60:] <= tree.query(away)[0] + 1e-13).all()
    coarse = cKDTree(patch.evaluate(grid(patch, 30)))  # the sibling that must fail: a coarse grid is not closer
    assert (found.distance[60:] < coarse.query(away)[0] - 1e-13).any()


def test_distance_from_a_circle():
    """From inside and outside; the centre is equally far from all points."""
    arc = PATCHES["arc"]()
    angle, r = np.meshgrid(np.linspace(0, np.pi / 2, 7), [0.0, 1e-3, 0.5, 0.999, 1.0, 1.5, 1e3])
    x = (r[..., None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)).reshape(-1, 2)
    found = closest_points(arc, x)
    np.testing.assert_allclose(found.distance, np.abs(r.ravel() - 1.0), rtol=1e-12, atol=1e-12)
    away = r.ravel() > 0.0
    np.testing.assert_allclose(arc.evaluate(found.xi)[away], (x / r.reshape(-1, 1).clip(1e-9))[away], atol=1e-7)


def test_points_beyond_a_side_end_on_it():
    plate = shapes.parallelogram((0, 0, 0), (2, 0, 0), (0, 1, 0), elements=(3, 2), degrees=(2, 2))
    x = np.array([[-1, 0.3, 0], [3, 4, 0], [0.7, 9, 2], [1, 0.5, -2], [2, 1, 0]])
    found = closest_points(plate, x)
    np.testing.assert_allclose(plate.evaluate(found.xi), np.clip(x, 0, [2, 1, 0]), atol=1e-12)
    np.testing.assert_allclose(found.distance, [1, np.sqrt(10), np.sqrt(68), 2, 0], atol=1e-12)


def test_points_in_a_volume():
    box = shapes.box(lengths=(1, 2, 3), origin=(5, 0, 0), elements=(2, 2, 2), degrees=(1, 2, 2))
    x = np.random.default_rng(0).uniform((5, 0, 0), (6, 2, 3), (20, 3))
    found = closest_points(box, x)
    np.testing.assert_allclose(found.xi, (x - [5, 0, 0]) / [1, 2, 3], atol=1e-12)
    assert closest_points(box, [[4.5, 1.0, 1.0]]).distance == pytest.approx([0.5], abs=1e-12)


def test_a_pole():
    """The map from parameters has no inverse at the centre of a disc."""
    disc = half_disc()
    x = np.array([[0, 0], [1e-9, 0], [0.3, 0.4], [0, -0.5], [-1.5, 2.0]])
    found = closest_points(disc, x)
    np.testing.assert_allclose(found.distance, [0, 0, 0, 0.5, 1.5], atol=1e-12)


@pytest.mark.parametrize("glue", [glued, disjoint])
def test_the_nearest_of_several_patches(glue):
    left = shapes.parallelogram((0, 0), (1, 0), (0, 1), elements=(2, 2), degrees=(2, 2))
    right = shapes.parallelogram((1, 0), (3, 0), (0, 1), elements=(2, 2), degrees=(2, 2)).swapped().reversed(0)
    geometry = glue(left, right)
    x = np.array([[0.3, 0.2], [3.5, 0.9], [1.0, 0.5], [-1.0, 0.5], [5.0, 0.5]])
    found = closest_points(geometry, x)
    np.testing.assert_array_equal(found.patch[[0, 1, 3, 4]], [0, 1, 0, 1])
    np.testing.assert_allclose(found.distance, [0, 0, 0, 1, 1], atol=1e-12)
    for k, patch in enumerate((left, right)):
        here = found.patch == k
        gap = np.linalg.norm(patch.evaluate(found.xi[here]) - x[here], axis=1)
        np.testing.assert_allclose(gap, found.distance[here], atol=1e-12)


def test_a_fine_patch_behind_a_coarse_one():
    """Samples of the fine patch are nearer, points of the coarse one are."""
    coarse = shapes.parallelogram((0, 0, 0), (8, 0, 0), (0, 8, 0), elements=(1, 1), degrees=(1, 1))
    fine = shapes.parallelogram((0, 0, -0.2), (8, 0, 0), (0, 8, 0), elements=(40, 40), degrees=(1, 1))
    x = [[1.0, 1.0, 0.1], [3.1, 4.9, 0.3]]
    for geometry, owner in ((disjoint(coarse, fine), 0), (disjoint(fine, coarse), 1)):
        found = closest_points(geometry, x)
        np.testing.assert_array_equal(found.patch, owner)
        np.testing.assert_allclose(found.distance, [0.1, 0.3], rtol=1e-12)


@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_size_does_not_matter(scale):
    patch = crumpled((2, 2), 3)
    same = Patch.from_points(patch.bases, scale * (patch.points + 10.0), patch.weights)
    x = np.random.default_rng(3).uniform(-2, 2, (20, 3))
    expected, found = closest_points(patch, x), closest_points(same, scale * (x + 10.0))
    np.testing.assert_allclose(found.distance / scale, expected.distance, rtol=1e-10)
    np.testing.assert_allclose(found.xi, expected.xi, atol=1e-6)


def test_no_points_and_bad_points():
    arc = PATCHES["arc"]()
    assert closest_points(arc, np.empty((0, 2))).xi.shape == (0, 1)
    with pytest.raises(ValueError, match=r"points has shape \(1, 3\)"):
        closest_points(arc, [[0.0, 0.0, 0.0]])
    with pytest.raises(ValueError, match=r"points\[0, 1\] = nan"):
        closest_points(arc, [[0.0, np.nan]])
