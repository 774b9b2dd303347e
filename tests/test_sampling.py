"""Points of splines at fixed parameters: lines, sides, nets, marks and what they enclose."""

import numpy as np
import pytest
import ufl
from mpi4py import MPI
from splines import half_disc, quarter, rectangle

from tigar_x.geometry import surfaces
from tigar_x.geometry.multipatch import disjoint
from tigar_x.splines import sampling
from tigar_x.splines.constraints import tied
from tigar_x.splines.projection import LumpedProjector
from tigar_x.splines.spline import ExtractedSpline

pytestmark = pytest.mark.mpi


def on_one_rank(geometry, **options):
    return ExtractedSpline(geometry, MPI.COMM_SELF, **options)


@pytest.fixture(scope="module")
def disc():
    """A rational patch with a pole, distributed over the ranks."""
    return ExtractedSpline(half_disc())


@pytest.fixture(scope="module")
def two():
    """Two rectangles of other parameters, [0, 1] x [0, 1] and [2, 4] x [0, 1], on every rank."""
    return on_one_rank(disjoint(rectangle((0, 1), (0, 1)), rectangle((2, 4), (0, 1), elements=(3, 1), degrees=(3, 2))))


def stretched(spline, factor):
    """Displacement that makes every position a multiple of itself."""
    return spline.function((factor - 1.0) * spline.geometry.control[:, :-1])


def test_a_circle_stays_a_circle_when_it_grows(disc):
    rim = sampling.side(disc, "v1", 21, patch=0)
    assert rim.reference.shape == (21, 2)
    np.testing.assert_allclose(np.linalg.norm(rim.positions(), axis=-1), 1.0, atol=1e-14)
    np.testing.assert_allclose(np.linalg.norm(rim.positions(stretched(disc, 3.0)), axis=-1), 3.0, atol=1e-12)


def test_samples_are_those_of_evaluation_patch_by_patch(two):
    y = two.function(np.random.default_rng(1).uniform(-1, 1, two.geometry.points.shape))
    xi = np.array([[[0.0, 0.0], [0.3, 0.7]], [[1.0, 0.5], [1.0, 1.0]], [[0.2, 0.2], [0.9, 0.1]]])
    found = sampling.marks(two, xi)
    for k, patch in enumerate(two.geometry.patches):
        exact = patch.evaluate(xi.reshape(-1, 2)) + two.evaluate(y, xi.reshape(-1, 2), k)
        np.testing.assert_allclose(found.positions(y)[k], exact.reshape(3, 2, 2), atol=1e-13)
    alone = sampling.marks(two, xi, patch=1)
    np.testing.assert_allclose(alone.positions(y), found.positions(y)[1], atol=1e-14)


def test_lines_sides_and_nets_lie_where_their_names_say(two):
    y_half = sampling.line(two, 0, 5).reference
    assert y_half.shape == (2, 5, 2)
    np.testing.assert_allclose(y_half[1], np.column_stack([np.linspace(2, 4, 5), np.full(5, 0.5)]), atol=1e-14)
    np.testing.assert_allclose(sampling.line(two, 1, 3, at=1.0, patch=0).reference[:, 0], 1.0, atol=1e-14)
    first, second = sampling.side(two, "u0", 3).reference
    np.testing.assert_allclose(first, [[0, 0], [0, 0.5], [0, 1]], atol=1e-14)
    np.testing.assert_allclose(second, [[2, 0], [2, 0.5], [2, 1]], atol=1e-14)
    net = sampling.net(two, (3, 2), patch=1).reference
    assert net.shape == (3, 2, 2)
    np.testing.assert_allclose(net[:, 1], [[2, 1], [3, 1], [4, 1]], atol=1e-14)


def test_own_names_of_sides_are_known():
    leaves = on_one_rank(disjoint(*surfaces.trileaflet(elements=(4, 3), degrees=(2, 2))))
    free, low = sampling.side(leaves, "free", 9), sampling.side(leaves, "v0", 9)
    assert free.reference.shape == (3, 9, 3)
    np.testing.assert_array_equal(free.reference, low.reference)


def test_fields_of_any_size_and_values_at_nodes_are_sampled(disc):
    x = disc.F
    scalar = disc.project(2.0 + x[0])
    pair = disc.project(ufl.as_vector([x[1], 1.0, x[0]]))
    net = sampling.net(disc, 5, patch=0)
    X = net.reference
    np.testing.assert_allclose(net.values(scalar), 2.0 + X[..., 0], atol=1e-10)
    np.testing.assert_allclose(net.values(pair)[..., [2, 0]], X, atol=1e-10)
    np.testing.assert_allclose(net.values(disc.nodal(scalar)), net.values(scalar), atol=1e-10)
    np.testing.assert_allclose(net.values(disc.nodal(scalar).ravel()), net.values(scalar), atol=1e-10)
    lumped = LumpedProjector(disc, 1)
    np.testing.assert_allclose(net.values(lumped(lumped.compile(ufl.as_ufl(1.5)))), 1.5, atol=1e-10)


def test_constraints_do_not_hide_a_part_of_a_field():
    """A field that breaks the conditions of its spline, as a start may, is sampled as it is."""
    plate = rectangle((0, 1), (0, 1))
    spline = on_one_rank(plate, constraints=(tied(plate.side_dofs("u0"), plate.side_dofs("u1"), 2 * plate.basis.n),))
    y = spline.free(2).function(np.column_stack([plate.points[:, 1], plate.points[:, 0]]))
    corner = sampling.marks(spline, [[0.0, 0.0], [0.0, 1.0]], patch=0)
    np.testing.assert_allclose(corner.values(y), [[0.0, 0.0], [1.0, 0.0]], atol=1e-12)


def test_the_outline_is_closed_and_encloses_the_patch():
    disc = on_one_rank(half_disc())
    points = sampling.outline(disc, 201).reference
    np.testing.assert_array_equal(points[0, 0], points[0, -1])
    # the parameters u, along the circle, and v, along the radius, are a left-handed pair
    assert sampling.enclosed_area(points) == pytest.approx(-np.pi / 2, rel=1e-4)
    assert sampling.enclosed_area(points[0, ::-1]) == pytest.approx(np.pi / 2, rel=1e-4)


def test_areas_are_those_that_an_axis_sees():
    square = np.array([[0, 0, 0], [1, 0, 1], [1, 1, 1], [0, 1, 0]], dtype=float)
    assert sampling.enclosed_area(square) == pytest.approx(1.0)
    assert sampling.enclosed_area(square, (0, 0, -3.0)) == pytest.approx(-1.0)
    assert sampling.enclosed_area(square, (-1.0, 0, 1.0)) == pytest.approx(np.sqrt(2.0))
    assert sampling.enclosed_area(square.reshape(2, 2, 3)) == pytest.approx(1.0)


def test_a_curve_is_sampled_at_one_number():
    curve = on_one_rank(quarter())
    np.testing.assert_array_equal(sampling.marks(curve, 0.3).reference, sampling.marks(curve, [0.3]).reference)


def test_what_cannot_be_sampled_is_refused(two):
    curve = on_one_rank(quarter())
    with pytest.raises(ValueError, match=r"xi\[1\] = \[0.2 1.1\]: parameters within patch 0"):
        sampling.marks(two, [[0.0, 0.0], [0.2, 1.1]])
    with pytest.raises(ValueError, match="patch = 2"):
        sampling.net(two, 3, patch=2)
    with pytest.raises(ValueError, match="samples = 1"):
        sampling.line(curve, 0, 1)
    with pytest.raises(ValueError, match="direction = 1"):
        sampling.line(curve, 1, 3)
    with pytest.raises(ValueError, match="1 parameters: a surface"):
        sampling.outline(curve, 3)
    with pytest.raises(ValueError, match="samples = \\(3,\\)"):
        sampling.net(two, (3,))
    with pytest.raises(ValueError, match="field has shape"):
        sampling.line(curve, 0, 3).values(np.zeros(2))
    with pytest.raises(ValueError, match="length of axis = 0"):
        sampling.enclosed_area(np.eye(3), (0, 0, 0))
