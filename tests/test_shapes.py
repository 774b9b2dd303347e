"""Flat shapes, what is swept from others, and interpolated maps: exact where they say so, at their rate elsewhere."""

import numpy as np
import pytest
from geometry import grid, measure, tangents

from tigar_x.geometry import shapes
from tigar_x.geometry.bspline import BSplineBasis, open_knots, periodic_knots
from tigar_x.geometry.patch import Patch

SCENES = {
    shapes.line: {"start": (0, 0), "end": (1, 0), "elements": 2},
    shapes.parallelogram: {
        **{"origin": (0, 0, 0), "edge_0": (1, 0, 0), "edge_1": (0, 1, 0)},
        **{"elements": (2, 2), "degrees": (1, 1)},
    },
    shapes.plate: {"lengths": (1, 2), "elements": (2, 2), "degrees": (1, 1)},
    shapes.strip: {"length": 1.0, "width": 0.5, "elements": (2, 2), "degrees": (1, 1)},
    shapes.box: {"lengths": (1, 2, 3), "elements": (2, 2, 2), "degrees": (1, 1, 1)},
}


# -- flat shapes ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("degree", [1, 2, 4])
@pytest.mark.parametrize("end", [(3.0, -1.0), (3.0, -1.0, 2.0)])
def test_line_has_constant_speed(degree, end):
    start = np.array([1.0, 2.0, -0.5])[: len(end)]
    patch = shapes.line(start, end, elements=3, degree=degree)
    s = np.linspace(0, 1, 11)[:, None]
    assert (patch.nsd, patch.basis.n, patch.rational) == (len(end), 3 + degree, False)
    assert len(patch.bases[0].breakpoints) == 4
    np.testing.assert_allclose(patch.evaluate(s), start + s * (np.array(end) - start), rtol=0, atol=1e-14)


def test_ends_of_a_line_have_the_names_that_are_given():
    line = shapes.line((0.0, 0.0), (0.0, 1.0), elements=3, side_names={"wall": (0, 1), "tip": (0, 0)})
    swept = shapes.extruded(line, (0.0, 0.0, 2.0))
    for patch in (line, swept):
        assert patch.points[patch.side("wall"), 1] == pytest.approx(1.0)
        assert patch.points[patch.side("tip"), 1] == pytest.approx(0.0)
    with pytest.raises(ValueError, match="root"):
        shapes.line((0.0, 0.0), (0.0, 1.0), elements=3, side_names={"root": (1, 0)})


@pytest.mark.parametrize("nsd", [2, 3])
def test_parallelogram_is_bilinear(nsd):
    corner, e0, e1 = (np.array(a, dtype=float)[:nsd] for a in ([1, 2, 3], [2, 0.5, 1], [-1, 1, 0]))
    patch = shapes.parallelogram(corner, e0, e1, elements=(4, 1), degrees=(2, 3))
    xi = np.random.default_rng(1).uniform(size=(30, 2))
    assert (patch.dim, patch.nsd) == (2, nsd)
    assert [basis.n for basis in patch.bases] == [6, 4]
    np.testing.assert_allclose(patch.evaluate(xi), corner + xi @ np.stack([e0, e1]), rtol=0, atol=1e-14)


@pytest.mark.parametrize("center", [(1.0, 2.0), (1.0, 2.0, 3.0)])
def test_plate_lies_around_its_center(center):
    patch = shapes.plate(lengths=(4, 1), center=center, elements=(3, 2), degrees=(2, 1))
    xi = np.random.default_rng(1).uniform(size=(30, 2))
    expected = np.tile(center, (30, 1))
    expected[:, :2] += (xi - 0.5) * [4, 1]
    np.testing.assert_allclose(patch.evaluate(xi), expected, rtol=0, atol=1e-14)
    assert measure(patch) == pytest.approx(4.0, rel=1e-14)


def test_strip_lies_around_its_middle_line():
    start, along, across = np.array([1.0, 2, 3]), np.array([0.0, 3, 4]), np.array([1.0, 7, 0])
    sizes = {"length": 5.0, "width": 0.5}
    patch = shapes.strip(start, along, across, **sizes, elements=(4, 1), degrees=(2, 2))
    middle = patch.evaluate([[0.0, 0.5], [0.4, 0.5], [1.0, 0.5]])
    np.testing.assert_allclose(middle, start + np.outer([0, 2.0, 5.0], along / 5), rtol=0, atol=1e-14)
    t, s = np.moveaxis(tangents(patch, grid(patch, 3)), -1, 0)
    np.testing.assert_allclose(t, np.tile(along, (9, 1)), rtol=0, atol=1e-13)
    np.testing.assert_allclose(np.linalg.norm(s, axis=1), 0.5, rtol=1e-13)
    np.testing.assert_allclose(s @ along, 0.0, atol=1e-13)
    assert (s @ across > 0.0).all()  # to the same side
    np.testing.assert_allclose(s @ np.cross(along, across), 0.0, atol=1e-13)  # in their plane
    flat = shapes.strip(length=1, width=1, elements=(1, 1), degrees=(1, 1), across=(3, 1, 0))
    assert [flat.locate_side(name) for name in ("start", "end", "edge_0", "edge_1")] == [(0, 0), (0, 1), (1, 0), (1, 1)]
    np.testing.assert_allclose(flat.points[flat.side("edge_1")], [[0, 0.5, 0], [1, 0.5, 0]], rtol=0, atol=1e-15)
    np.testing.assert_allclose(flat.points[flat.side("start")], [[0, -0.5, 0], [0, 0.5, 0]], rtol=0, atol=1e-15)


def test_box_is_trilinear():
    patch = shapes.box(lengths=(1, 2, 3), origin=(-1, 0, 5), elements=(2, 1, 3), degrees=(2, 1, 3))
    xi = np.random.default_rng(1).uniform(size=(30, 3))
    np.testing.assert_allclose(patch.evaluate(xi), xi * [1, 2, 3] + [-1, 0, 5], rtol=0, atol=1e-14)
    assert patch.n == 4 * 2 * 6
    assert measure(patch) == pytest.approx(6.0, rel=1e-14)
    assert (np.linalg.det(tangents(patch, xi)) > 0.0).all()


@pytest.mark.parametrize(
    ("shape", "change", "message"),
    [
        (shapes.line, {"end": (0, 0)}, r"end = \[0. 0.\]: a point other than start"),
        (shapes.line, {"end": (1, 0, 0)}, r"end has shape \(3,\): shape \(2\)"),
        (shapes.line, {"end": (1, np.nan)}, r"end\[1\] = nan"),
        (shapes.line, {"start": (0,), "end": (1,)}, r"start has 1 coordinates: 2 or 3"),
        (shapes.line, {"start": (0,) * 4, "end": (1,) * 4}, r"start has 4 coordinates"),
        (shapes.line, {"elements": 0}, r"elements = 0: an integer >= 1"),
        (shapes.line, {"elements": 2.5}, r"elements = 2.5"),
        (shapes.line, {"degree": 0}, r"degree = 0: an integer >= 1"),
        (shapes.parallelogram, {"edge_1": (-2, 0, 0)}, r"edge_1 = \[-2.  0.  0.\]: an edge that is not parallel"),
        (shapes.parallelogram, {"edge_1": (0, 0, 0)}, r"edge_1 = \[0. 0. 0.\]"),
        (shapes.parallelogram, {"edge_1": (0, 1)}, r"edge_1 has shape \(2,\): shape \(3\)"),
        (shapes.parallelogram, {"edge_0": (np.inf, 0, 0)}, r"edge_0\[0\] = inf"),
        (shapes.parallelogram, {"origin": (0,), "edge_0": (1,), "edge_1": (1,)}, r"origin has 1 coordinates: 2 or 3"),
        (shapes.parallelogram, {"elements": (2, 0)}, r"elements = 0"),
        (shapes.parallelogram, {"degrees": (0, 1)}, r"degree = 0"),
        (shapes.parallelogram, {"degrees": (1,)}, r"degrees = \(1,\): one number for each of the 2 directions"),
        (shapes.parallelogram, {"elements": 4}, r"elements = 4: one number for each of the 2 directions"),
        (shapes.plate, {"lengths": (1, 0)}, r"lengths\[1\] = 0.0: a number > 0"),
        (shapes.plate, {"lengths": (1, 1, 1)}, r"lengths has shape \(3,\): shape \(2\)"),
        (shapes.plate, {"center": (0,)}, r"center has 1 coordinates"),
        (shapes.plate, {"elements": (1, 1, 1)}, r"elements = \(1, 1, 1\)"),
        (shapes.strip, {"across": (-2, 0, 0)}, r"across = \[-2.  0.  0.\]: a direction that is not parallel to along"),
        (shapes.strip, {"along": (0, 0, 0)}, r"not parallel to along = \[0. 0. 0.\]"),
        (shapes.strip, {"start": (0, 0)}, r"start has shape \(2,\): shape \(3\)"),
        (shapes.strip, {"length": 0}, r"length = 0: a number > 0"),
        (shapes.strip, {"width": -1}, r"width = -1: a number > 0"),
        (shapes.strip, {"degrees": (1, 0)}, r"degree = 0"),
        (shapes.box, {"lengths": (1, -1, 1)}, r"lengths\[1\] = -1.0: a number > 0"),
        (shapes.box, {"lengths": (1, 1)}, r"lengths has shape \(2,\): shape \(3\)"),
        (shapes.box, {"origin": (0, 0)}, r"origin has shape \(2,\): shape \(3\)"),
        (shapes.box, {"degrees": (1, 1)}, r"degrees = \(1, 1\): one number for each of the 3 directions"),
    ],
)
def test_bad_flat_shapes(shape, change, message):
    shape(**SCENES[shape])
    with pytest.raises(ValueError, match=message):
        shape(**{**SCENES[shape], **change})


# -- interpolated maps ------------------------------------------------------------------------------------------------


def bases(dim, degree, elements):
    return [BSplineBasis(degree, open_knots(degree, np.linspace(0, 1, elements + 1)))] * dim


@pytest.mark.parametrize("degree", [1, 2, 3, 4])
def test_interpolation_reproduces_what_the_spline_contains(degree):
    patch = shapes.interpolated(lambda u, v: (u**degree, v**degree - u, (1 - u) * v, 2.0)[:3], bases(2, degree, 3))
    xi = grid(patch, 7)
    u, v = xi.T
    expected = np.stack([u**degree, v**degree - u, (1 - u) * v], axis=1)
    np.testing.assert_allclose(patch.evaluate(xi), expected, rtol=0, atol=1e-14)
    assert not patch.rational


def bulge(u, v):
    return np.exp(u) * np.cos(3 * v), np.exp(u) * np.sin(3 * v), np.sin(4 * u * v)


@pytest.mark.parametrize("degree", [1, 2, 3, 4])
def test_interpolation_converges_at_the_best_rate(degree):
    levels = np.array([4, 8, 16, 32])
    errors = []
    for elements in levels:
        patch = shapes.interpolated(bulge, bases(2, degree, elements))
        xi = grid(patch, 129)
        errors.append(np.abs(patch.evaluate(xi) - np.stack(bulge(*xi.T), axis=1)).max())
    rate = -np.polyfit(np.log(levels[1:]), np.log(errors[1:]), 1)[0]
    assert degree + 0.8 < rate < degree + 1.5
    assert errors[-1] < [2e-2, 2e-4, 1e-5, 5e-7][degree - 1]


def test_interpolation_of_curves_volumes_and_closed_curves():
    curve = shapes.interpolated(lambda u: (u, 3.0), bases(1, 2, 4), {"tip": (0, 1)})
    np.testing.assert_allclose(curve.evaluate([[0.3]]), [[0.3, 3.0]], rtol=0, atol=1e-15)
    assert curve.locate_side("tip") == (0, 1)
    volume = shapes.interpolated(lambda u, v, w: (u + w**2, v * u, w), bases(3, 2, 2))
    u, v, w = xi = np.random.default_rng(0).uniform(size=(3, 20))
    np.testing.assert_allclose(volume.evaluate(xi.T).T, [u + w**2, v * u, w], rtol=0, atol=1e-14)
    closed = BSplineBasis(3, periodic_knots(3, np.linspace(0, 2 * np.pi, 33)), periodic=True)
    circle = shapes.interpolated(lambda t: (np.cos(t), np.sin(t)), [closed])
    np.testing.assert_allclose(np.hypot(*circle.evaluate(grid(circle, 99)).T), 1.0, rtol=0, atol=2e-5)


@pytest.mark.parametrize(
    ("f", "message"),
    [
        (lambda u, v: (u, np.nan * v, v), r"values\[0, 1\] = nan"),
        (lambda u, v: (u,), r"control has 2 columns: a patch of dimension 2"),
        (lambda u, v: (u, v, u, v), r"control has 5 columns"),
        (lambda u, v: (u, v[:3]), r"broadcast"),
    ],
)
def test_bad_maps(f, message):
    with pytest.raises(ValueError, match=message):
        shapes.interpolated(f, bases(2, 2, 2))


# -- swept shapes -----------------------------------------------------------------------------------------------------


def arc(radius=1.0, height=0.0):
    """Quarter of a circle with its sides named."""
    basis = BSplineBasis(2, open_knots(2, [0, 1]))
    points = np.array([[radius, 0, height], [radius, radius, height], [0, radius, height]])
    return Patch.from_points([basis], points, [1, np.sqrt(0.5), 1], {"foot": (0, 0), "head": (0, 1)})


def test_ruled_surface_of_two_arcs_is_a_cone():
    cone = shapes.ruled(arc(2.0), arc(1.0, height=3.0), elements=4, degree=3)
    xi = grid(cone, 9)
    x, y, z = cone.evaluate(xi).T
    np.testing.assert_allclose(z, 3 * xi[:, 1], rtol=0, atol=1e-14)
    np.testing.assert_allclose(np.hypot(x, y), 2 - xi[:, 1], rtol=0, atol=1e-14)
    assert measure(cone) == pytest.approx(np.pi / 4 * 3.0 * np.hypot(1, 3), rel=1e-12)
    assert ([basis.degree for basis in cone.bases], len(cone.bases[1].breakpoints)) == ([2, 3], 5)
    np.testing.assert_allclose(cone.points[cone.side("head")][:, 0], 0.0, atol=1e-15)


def test_ruled_patches_take_the_knots_and_degrees_of_both():
    third = 1 / 3
    first = arc().with_degree(3).on([BSplineBasis(3, [0, 0, 0, 0, third, third, 1, 1, 1, 1])])
    second = shapes.line((0, 0, 1), (1, 0, 1), elements=6, degree=2)
    rescaled = Patch.from_points([BSplineBasis(2, 7.0 * second.bases[0].knots - 2.0)], second.points)
    patch = shapes.ruled(first, rescaled)
    u = np.linspace(0, 1, 25)
    bottom, top = (patch.evaluate(np.column_stack([u, np.full(25, v)])) for v in (0.0, 1.0))
    np.testing.assert_allclose(bottom, first.evaluate(u[:, None]), rtol=0, atol=1e-14)
    np.testing.assert_allclose(top, second.evaluate(u[:, None]), rtol=0, atol=1e-14)
    np.testing.assert_allclose(patch.bases[0].breakpoints, np.arange(7) / 6, rtol=0, atol=1e-15)
    np.testing.assert_array_equal(patch.bases[0].multiplicities, [4, 2, 2, 2, 2, 2, 4])  # degree 3, C1 of the line


def test_ruled_volume_between_two_surfaces():
    bottom = shapes.plate(lengths=(2, 2), elements=(2, 1), degrees=(1, 2))
    top = shapes.plate(lengths=(1, 1), center=(0, 0, 3), elements=(3, 1), degrees=(1, 1))
    frustum = shapes.ruled(bottom, top)
    assert frustum.dim == 3
    assert measure(frustum) == pytest.approx(3 / 3 * (4 + 1 + 2), rel=1e-13)
    np.testing.assert_allclose(frustum.evaluate([[1, 1, 0.5]]), [[0.75, 0.75, 1.5]], rtol=1e-14)


def test_extruded_curve_and_surface():
    wall = shapes.extruded(arc(2.0), (0, 1, 5), elements=3, degree=2)
    xi = grid(wall, 7)
    x, y, z = wall.evaluate(xi).T
    np.testing.assert_allclose(np.hypot(x, y - xi[:, 1]), 2.0, rtol=1e-14)
    np.testing.assert_allclose(z, 5 * xi[:, 1], rtol=0, atol=1e-14)
    assert wall.locate_side("head") == (0, 1)
    sheet = shapes.parallelogram((0, 0), (1, 0), (1, 2), elements=(2, 2), degrees=(1, 2))
    block = shapes.extruded(sheet, (0.5, 0, 3), elements=2)
    xi = np.random.default_rng(0).uniform(size=(20, 3))
    np.testing.assert_allclose(block.evaluate(xi), xi @ [[1, 0, 0], [1, 2, 0], [0.5, 0, 3]], rtol=0, atol=1e-14)
    assert measure(block) == pytest.approx(6.0, rel=1e-14)
    ribbon = shapes.extruded(shapes.line((0, 0), (1, 0), elements=2), (0, 2))
    assert (ribbon.dim, ribbon.nsd, measure(ribbon)) == (2, 2, pytest.approx(2.0, rel=1e-14))


def test_extruded_closed_curve_is_a_tube():
    closed = BSplineBasis(2, periodic_knots(2, np.linspace(0, 1, 6)), periodic=True)
    ring = shapes.interpolated(lambda t: (np.cos(2 * np.pi * t), np.sin(2 * np.pi * t), 0.0), [closed])
    tube = shapes.extruded(ring, (0, 0, 2))
    assert tube.open_sides == ("v0", "v1")
    t = np.linspace(0, 1, 9)
    top = tube.evaluate(np.column_stack([t, np.ones(9)]))
    np.testing.assert_allclose(top - ring.evaluate(t[:, None]), np.tile([0, 0, 2], (9, 1)), rtol=0, atol=1e-14)


FLAT = shapes.plate(lengths=(1, 1), elements=(1, 1), degrees=(1, 1))
BLOCK = shapes.box(lengths=(1, 1, 1), elements=(1, 1, 1), degrees=(1, 1, 1))
LOOP = shapes.interpolated(
    lambda t: (np.cos(t), np.sin(t), 1.0), [BSplineBasis(2, periodic_knots(2, np.arange(7.0)), True)]
)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: shapes.ruled(arc(), FLAT), r"end has dim = 2: 1 is required"),
        (lambda: shapes.ruled(arc(), shapes.line((0, 0), (1, 0), elements=1)), r"end has nsd = 2: 3 is required"),
        (lambda: shapes.ruled(BLOCK, BLOCK), r"start has dim = 3: a curve or a surface"),
        (lambda: shapes.ruled(arc(), arc()), r"end is the same as start"),
        (lambda: shapes.ruled(arc(), LOOP), r"end is periodic where start is not"),
        (lambda: shapes.ruled(arc(), arc(2), elements=0), r"elements = 0: an integer >= 1"),
        (lambda: shapes.ruled(arc(), arc(2), degree=0), r"degree = 0: an integer >= 1"),
        (lambda: shapes.extruded(BLOCK, (0, 0, 1)), r"start has dim = 3"),
        (lambda: shapes.extruded(arc(), (0, 0, 0)), r"vector = \[0. 0. 0.\]: a vector other than zero with 3"),
        (lambda: shapes.extruded(arc(), (0, 1)), r"vector = \[0. 1.\]: a vector other than zero with 3"),
        (lambda: shapes.extruded(arc(), (1,)), r"vector has 1 coordinates"),
        (lambda: shapes.extruded(FLAT, (0, 0, np.nan)), r"vector\[2\] = nan"),
        (lambda: shapes.extruded(shapes.plate(lengths=(1, 1), center=(0, 0), elements=(1, 1), degrees=(1, 1)), (0, 1)),
         r"control has 3 columns: a patch of dimension 3"),
    ],
)  # fmt: skip
def test_bad_swept_shapes(call, message):
    with pytest.raises(ValueError, match=message):
        call()
