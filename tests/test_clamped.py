"""Edges that do not turn: which displacements the constraints allow."""

import numpy as np
import pytest

from shnapr.supports import clamped, fixed, pinned
from tigar_x.geometry import shapes, surfaces
from tigar_x.geometry.gluing import glued
from tigar_x.geometry.patch import Patch
from tigar_x.splines.constraints import no_rotation

PANEL = surfaces.cylinder_panel(radius=2.0, length=1.5, angle=1.2, elements=(3, 4), degrees=(3, 3))


def violation(geometry, field, *sides):
    """Largest row of G U for a displacement of the control points."""
    U = field * geometry.weights[:, None]
    return np.abs(no_rotation(geometry, *sides) @ U.ravel()).max()


@pytest.mark.parametrize("side", ["end_0", "end_1", "straight_0", "straight_1"])
def test_panel(side):
    """Motions and stretches along the surface are free, turning is not."""
    x = PANEL.points
    assert violation(PANEL, np.ones_like(x) * (0.3, -0.2, 0.7), side) < 1e-14
    along = np.zeros_like(x)
    along[:, 0] = x[:, 0] ** 2
    assert violation(PANEL, along, side) < 1e-14
    angle = 0.1
    turned = x @ np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]).T - x
    assert violation(PANEL, turned, "end_0") > 1e-3
    x_axis = x @ np.array([[1, 0, 0], [0, np.cos(angle), -np.sin(angle)], [0, np.sin(angle), np.cos(angle)]]).T - x
    assert violation(PANEL, x_axis, "straight_0") > 1e-3
    assert no_rotation(PANEL, side).shape == (len(PANEL.side(side)), PANEL.n * 3)


@pytest.mark.parametrize("side", ["end_0", "end_1", "straight_0", "straight_1"])
def test_normals_of_a_cylinder_are_radial(side):
    """Also where the weight varies across the edge, which the slope of the homogeneous points alone would not see."""
    edge = PANEL.side(side)
    G = no_rotation(PANEL, side).toarray().reshape(len(edge), PANEL.n, 3)
    for row in G:
        (first,) = edge[np.abs(row[edge]).max(axis=1) > 0.0]
        (second,) = np.flatnonzero(np.abs(np.delete(row, first, axis=0)).max(axis=1) > 0.0)
        second += second >= first
        x = PANEL.evaluate(PANEL.basis.greville[[first]])[0]
        np.testing.assert_allclose(row[second] * PANEL.weights[second], [0.0, x[1] / 2.0, x[2] / 2.0], atol=1e-13)
        np.testing.assert_allclose(row[first] * PANEL.weights[first], [0.0, -x[1] / 2.0, -x[2] / 2.0], atol=1e-13)


def test_straight_beam():
    """Across the axis the second control point moves with the first, along it as it likes."""
    line = shapes.line((0.0, 0.0), (3.0, 0.0), elements=4, degree=2)
    G = no_rotation(line, "u0", "u1").toarray()
    expected = np.zeros((2, line.n * 2))
    expected[0, [1, 3]] = -1.0, 1.0
    expected[1, [-1, -3]] = -1.0, 1.0
    np.testing.assert_allclose(np.abs(G), np.abs(expected), atol=1e-15)
    np.testing.assert_allclose(G.sum(axis=1), 0.0, atol=1e-15)


def test_two_rows_are_clamped_and_one_is_pinned():
    line, sheet = (
        shapes.line((0.0, 0.0), (3.0, 0.0), elements=4, degree=2),
        shapes.parallelogram((0, 0, 0), (1, 0, 0), (0, 1, 0), elements=(3, 2), degrees=(2, 2)),
    )
    np.testing.assert_array_equal(clamped(line, "u1", "u0"), [0, 1, 2, 3, 8, 9, 10, 11])
    np.testing.assert_array_equal(pinned(line, "u0"), [0, 1])
    np.testing.assert_array_equal(pinned(line, "u1", components=[1]), [11])
    lowest = np.sort(np.unique(sheet.points[:, 1]))
    for held, rows in ((clamped(sheet, "v0"), 2), (pinned(sheet, "v0"), 1)):
        functions = np.flatnonzero(np.isin(sheet.points[:, 1], lowest[:rows]))
        np.testing.assert_array_equal(held, (3 * functions[:, None] + np.arange(3)).ravel())


def test_what_is_no_edge_of_a_shell_is_refused():
    with pytest.raises(ValueError, match="sides is empty"):
        no_rotation(PANEL)
    with pytest.raises(ValueError, match="name = 'u2'"):
        no_rotation(PANEL, "u2")
    box = shapes.box(lengths=(1, 1, 1), elements=(2, 2, 2), degrees=(2, 2, 2))
    with pytest.raises(ValueError, match="dimension 3 in 3"):
        no_rotation(box, "u0")
    cap = surfaces.sphere_cap(radius=1.0, angle=1.0, elements=(2, 4), degrees=(2, 2))
    with pytest.raises(ValueError, match="side u0 has a point without a normal"):
        no_rotation(cap, "pole")
    assert no_rotation(cap, "rim").shape[0] == len(cap.side("rim"))


@pytest.mark.parametrize("side", ["u0", "u1", "v0", "v1"])
def test_the_edges_of_a_square_disc_do_not_turn_though_two_of_them_meet_in_one_tangent(side):
    """Where they meet, the normal is the limit of those beside it; on a tilted disc it is that of its plane."""
    flat = surfaces.disc(radius=2.0, elements=(3, 2), degrees=(3, 2))
    tilt = np.eye(4)
    tilt[:2, 2] = 0.3, -0.2
    disc = Patch(flat.bases, flat.control @ tilt)
    normal = np.array([-0.3, 0.2, 1.0]) / np.sqrt(1.13)
    rows = no_rotation(disc, side).toarray().reshape(-1, disc.n, 3)
    assert rows.shape[0] == len(disc.side(side))
    lengths = np.linalg.norm(rows, axis=2)
    assert ((lengths > 0).sum(axis=1) == 2).all()
    np.testing.assert_allclose(rows @ normal, lengths * np.sign(rows[..., 2]), rtol=0, atol=1e-9)
    x = disc.points
    in_plane = np.column_stack([x[:, 1] ** 2, x[:, 0] * x[:, 1], 0.3 * x[:, 1] ** 2 - 0.2 * x[:, 0] * x[:, 1]])
    assert violation(disc, in_plane, side) < 1e-9
    assert violation(disc, normal * x[:, :1], side) > 1e-2


def test_whole_shells_are_fixed():
    left, right = (shapes.plate(lengths=(1, 1), center=(x, 0, 0), elements=(2, 1), degrees=(2, 1)) for x in (0, 1))
    both = glued(left, right)
    np.testing.assert_array_equal(fixed(left), np.arange(3 * left.n))
    np.testing.assert_array_equal(fixed(both), np.arange(3 * both.n))
    second = fixed(both, patch=1)
    assert len(second) == 3 * right.n
    np.testing.assert_array_equal(np.unique(both.points[second[::3] // 3][:, 0]), np.unique(right.points[:, 0]))
    with pytest.raises(ValueError, match=r"^patch = 2: one of 0, 1"):
        fixed(both, patch=2)
