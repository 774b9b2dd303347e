"""Patches as data, their sides, and the factories of simple shapes."""

import numpy as np
import pytest

from tigar_x import shapes
from tigar_x.bspline import BSplineBasis, open_knots
from tigar_x.patch import Patch

QUADRATIC = BSplineBasis(2, open_knots(2, [0, 1]))
LINE = BSplineBasis(1, open_knots(1, [0, 1, 2]))  # 3 functions


def quarter_circle(radius=1.0):
    points = radius * np.array([[1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    return Patch.from_points([QUADRATIC], points, [1.0, np.sqrt(0.5), 1.0])


def surface(n0=4, n1=3, nsd=3):
    """Linear patch with n0 x n1 functions and arbitrary control points."""
    bases = [BSplineBasis(1, open_knots(1, np.arange(n))) for n in (n0, n1)]
    return Patch.from_points(bases, np.random.default_rng(0).uniform(size=(n0 * n1, nsd)))


# -- geometry ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("radius", [1.0, 25.0])
def test_rational_quarter_circle(radius):
    arc = quarter_circle(radius)
    x = arc.evaluate(np.linspace(0, 1, 21)[:, None])
    np.testing.assert_allclose(np.hypot(*x.T), radius, rtol=1e-14)
    np.testing.assert_allclose(x[[0, -1]], arc.points[[0, -1]], rtol=0, atol=1e-14 * radius)
    assert arc.rational
    # the same control points without weights are a parabola, which leaves the circle
    plain = Patch.from_points(arc.bases, arc.points)
    assert not plain.rational
    assert abs(np.hypot(*plain.evaluate([[0.5]])[0]) / radius - 1.0) > 0.05


def test_homogeneous_control_points():
    patch = Patch.from_points([QUADRATIC], [[1, 2], [3, 4], [5, 7]], [1, 0.5, 2])
    np.testing.assert_array_equal(patch.control, [[1, 2, 1], [1.5, 2, 0.5], [10, 14, 2]])
    np.testing.assert_array_equal(patch.points, [[1, 2], [3, 4], [5, 7]])
    np.testing.assert_array_equal(patch.weights, [1, 0.5, 2])
    assert (patch.dim, patch.nsd) == (1, 2)


def test_a_common_factor_of_the_weights_changes_nothing():
    arc = quarter_circle()
    scaled = Patch(arc.bases, 3.0 * arc.control)
    xi = np.linspace(0, 1, 7)[:, None]
    np.testing.assert_allclose(scaled.evaluate(xi), arc.evaluate(xi), rtol=0, atol=1e-15)


def test_patch_owns_its_control_points():
    control = np.array([[0.0, 0, 1], [1, 0, 1], [2, 1, 1]])
    patch = Patch((LINE,), control)
    control[:] = np.nan
    assert np.isfinite(patch.control).all()
    with pytest.raises(ValueError, match="read-only"):
        patch.control[0, 0] = 3.0


@pytest.mark.parametrize(
    ("control", "message"),
    [
        (np.ones((4, 3)), r"control has shape \(4, 3\): shape \(3, any\)"),
        (np.ones(3), r"control has shape \(3,\)"),
        (np.ones((3, 1)), r"control has 1 columns: a patch of dimension 1 takes 2 to 4"),
        (np.ones((3, 5)), r"control has 5 columns"),
        ([[0, 0, 1], [1, np.nan, 1], [2, 0, 1]], r"control\[1, 1\] = nan"),
        ([[0, 0, 1], [1, 0, 1], [np.inf, 0, 1]], r"control\[2, 0\] = inf"),
        ([[0, 0, 1], [1, 0, 0], [2, 0, 1]], r"weight of control point 1 = 0.0: weights > 0"),
        ([[0, 0, 1], [1, 0, 1], [2, 0, -0.5]], r"weight of control point 2 = -0.5"),
    ],
)
def test_bad_control_points(control, message):
    with pytest.raises(ValueError, match=message):
        Patch((LINE,), control)


def test_bad_patches_from_points():
    points = np.zeros((3, 2))
    with pytest.raises(ValueError, match=r"weights has shape \(2,\): shape \(3\)"):
        Patch.from_points([LINE], points, [1, 1])
    with pytest.raises(ValueError, match=r"weights\[1\] = nan"):
        Patch.from_points([LINE], points, [1, np.nan, 1])
    with pytest.raises(ValueError, match=r"weight of control point 0 = 0.0"):
        Patch.from_points([LINE], points, [0, 1, 1])
    with pytest.raises(ValueError, match=r"points\[2, 1\] = nan"):
        Patch.from_points([LINE], [[0, 0], [1, 1], [2, np.nan]])
    with pytest.raises(ValueError, match=r"bases has 3 directions: 1 or 2"):
        Patch.from_points([LINE] * 3, np.zeros((27, 3)))
    with pytest.raises(ValueError, match=r"control has 2 columns: a patch of dimension 2"):
        Patch.from_points([LINE] * 2, np.zeros((9, 1)))


# -- sides ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("direction", "end", "layers", "expected"),
    [
        # functions 8  9 10 11
        #           4  5  6  7
        #           0  1  2  3  (direction 0 to the right)
        (0, 0, 1, [0, 4, 8]),
        (0, 1, 1, [3, 7, 11]),
        (0, 0, 2, [0, 1, 4, 5, 8, 9]),
        (0, 1, 2, [2, 3, 6, 7, 10, 11]),
        (1, 0, 1, [0, 1, 2, 3]),
        (1, 1, 1, [8, 9, 10, 11]),
        (1, 1, 2, [4, 5, 6, 7, 8, 9, 10, 11]),
        (1, 0, 3, list(range(12))),
    ],
)
def test_sides_of_a_surface(direction, end, layers, expected):
    patch = surface()
    np.testing.assert_array_equal(patch.side(direction, end, layers), expected)
    all_components = [3 * f + c for f in expected for c in range(3)]
    np.testing.assert_array_equal(patch.side_dofs(direction, end, layers), all_components)
    np.testing.assert_array_equal(
        patch.side_dofs(direction, end, layers, components=(2, 0)), [3 * f + c for f in expected for c in (0, 2)]
    )


@pytest.mark.parametrize(("direction", "end"), [(0, 0), (0, 1), (1, 0), (1, 1)])
def test_one_layer_carries_the_side(direction, end):
    """Only the functions of one layer do not vanish on the side; two layers carry the derivative across it as well."""
    patch = shapes.parallelogram((0, 0), (1, 0), (0, 1), elements=(3, 2), degrees=(2, 3))
    s = np.linspace(0, 1, 9)
    for distance, layers, power in ((0.0, 1, 1), (1e-5, 2, 2)):
        xi = np.column_stack([s, s])
        xi[:, direction] = abs(end - distance)
        N = np.abs(patch.basis.evaluate(xi).toarray()).max(axis=0)
        beyond = np.setdiff1d(np.arange(patch.basis.n), patch.side(direction, end, layers))
        assert N[beyond].max() <= 50.0 * distance**power
        assert N[patch.side(direction, end, layers)].min() > 10.0 * distance**power


def test_sides_of_a_curve():
    patch = shapes.line((0, 0), (1, 1), elements=3, degree=2)  # 5 functions
    np.testing.assert_array_equal(patch.side("u0"), [0])
    np.testing.assert_array_equal(patch.side("u1", 2), [3, 4])
    np.testing.assert_array_equal(patch.side_dofs("u1", 2, components=[1]), [7, 9])
    assert patch.side_dofs("u0", components=[]).size == 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((2, 0, 1), r"direction = 2: one of 0, 1 is required"),
        ((-1, 0, 1), r"direction = -1"),
        ((0, 2, 1), r"end = 2: one of 0, 1 is required"),
        ((0, -1, 1), r"end = -1"),
        ((0, 0, 0), r"layers = 0: an integer >= 1"),
        ((0, 0, 1.5), r"layers = 1.5: an integer >= 1"),
        ((0, 0, 5), r"layers = 5: direction 0 has only 4"),
        ((1, 0, 4), r"layers = 4: direction 1 has only 3"),
    ],
)
def test_unknown_sides(arguments, message):
    with pytest.raises(ValueError, match=message):
        surface().side(*arguments)
    with pytest.raises(ValueError, match=message):
        surface().side_dofs(*arguments)


def test_unknown_components_and_directions():
    with pytest.raises(ValueError, match=r"components = 2: one of 0, 1 is"):
        surface(nsd=2).side_dofs("u0", components=[0, 2])
    with pytest.raises(ValueError, match=r"direction = 1: one of 0 is required"):
        quarter_circle().side("v0")


# -- shapes -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("degree", [1, 2, 4])
@pytest.mark.parametrize("end", [(3.0, -1.0), (3.0, -1.0, 2.0)])
def test_line_has_constant_speed(degree, end):
    start = np.array([1.0, 2.0, -0.5])[: len(end)]
    patch = shapes.line(start, end, elements=3, degree=degree)
    s = np.linspace(0, 1, 11)[:, None]
    assert (patch.nsd, patch.basis.n, patch.rational) == (len(end), 3 + degree, False)
    assert len(patch.bases[0].breakpoints) == 4
    np.testing.assert_allclose(patch.evaluate(s), start + s * (np.array(end) - start), rtol=0, atol=1e-14)


@pytest.mark.parametrize("nsd", [2, 3])
def test_parallelogram_is_bilinear(nsd):
    corner, e0, e1 = (np.array(a, dtype=float)[:nsd] for a in ([1, 2, 3], [2, 0.5, 1], [-1, 1, 0]))
    patch = shapes.parallelogram(corner, e0, e1, elements=(4, 1), degrees=(2, 3))
    xi = np.random.default_rng(1).uniform(size=(30, 2))
    assert (patch.dim, patch.nsd) == (2, nsd)
    assert [basis.n for basis in patch.bases] == [6, 4]
    np.testing.assert_allclose(patch.evaluate(xi), corner + xi @ np.stack([e0, e1]), rtol=0, atol=1e-14)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"end": (0, 0)}, r"end = \[0. 0.\]: a point other than start"),
        ({"end": (1, 0, 0)}, r"end has shape \(3,\): shape \(2\)"),
        ({"end": (1, np.nan)}, r"end\[1\] = nan"),
        ({"start": (0,), "end": (1,)}, r"start has 1 coordinates: 2 or 3"),
        ({"start": (0,) * 4, "end": (1,) * 4}, r"start has 4 coordinates"),
        ({"elements": 0}, r"elements = 0: an integer >= 1"),
        ({"elements": 2.5}, r"elements = 2.5"),
        ({"degree": 0}, r"degree = 0: an integer >= 1"),
    ],
)
def test_bad_lines(change, message):
    with pytest.raises(ValueError, match=message):
        shapes.line(**{"start": (0, 0), "end": (1, 0), "elements": 2, **change})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"edge_1": (-2, 0, 0)}, r"edge_1 = \[-2.  0.  0.\]: an edge that is not parallel"),
        ({"edge_1": (0, 0, 0)}, r"edge_1 = \[0. 0. 0.\]"),
        ({"edge_1": (0, 1)}, r"edge_1 has shape \(2,\): shape \(3\)"),
        ({"edge_0": (np.inf, 0, 0)}, r"edge_0\[0\] = inf"),
        ({"origin": (0,), "edge_0": (1,), "edge_1": (1,)}, r"origin has 1 coordinates: 2 or 3"),
        ({"elements": (2, 0)}, r"elements = 0"),
        ({"degrees": (0, 1)}, r"degree = 0"),
        ({"degrees": (1,)}, r"degrees"),
    ],
)
def test_bad_parallelograms(change, message):
    scene = {"origin": (0, 0, 0), "edge_0": (1, 0, 0), "edge_1": (0, 1, 0), "elements": (2, 2), "degrees": (1, 1)}
    with pytest.raises(ValueError, match=message):
        shapes.parallelogram(**{**scene, **change})
