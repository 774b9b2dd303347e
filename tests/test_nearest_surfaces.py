"""Signed distances from surfaces in space, closed and with edges, of several sheets and patches."""

import numpy as np
import pytest
from mpi4py import MPI

from coudalfish.surface.boundary import attached
from coudalfish.surface.boxes import CORNER
from coudalfish.surface.interface import Sought
from coudalfish.surface.net import Net
from coudalfish.surface.sheets import Sheets
from coudalfish.surface.surfaces import Surfaces
from tigar_x.fem.simplices import cross_products

RNG = np.random.default_rng(11)


def grid(n=4, f=lambda u, v: np.column_stack([u, v, 0.0 * u]), triangles=False, turned=False):
    """A patch over the unit square, of quadrilaterals or of two triangles each."""
    s = np.linspace(0.0, 1.0, n + 1)
    u, v = (part.ravel() for part in np.meshgrid(s, s, indexing="ij"))
    i = np.arange((n + 1) ** 2).reshape(n + 1, n + 1)
    cells = np.stack([i[:-1, :-1], i[1:, :-1], i[1:, 1:], i[:-1, 1:]], axis=-1).reshape(-1, 4)
    if triangles:
        cells = np.concatenate([cells[:, [0, 1, 2]], cells[:, [0, 2, 3]]])
    return f(u, v), cells[:, ::-1] if turned else cells


def surfaces(*patches, held=None):
    """Patches whose points are one place where they are at the same place."""
    x = np.concatenate([part for part, _ in patches])
    starts = np.cumsum([0] + [len(part) for part, _ in patches[:-1]])
    cells = np.concatenate([part + start for (_, part), start in zip(patches, starts, strict=True)])
    place = np.unique(np.round(x, 9), axis=0, return_inverse=True)[1].ravel()
    net = Net(cells, place)
    if held is None:
        return Surfaces(x, net)
    return Surfaces(x, Net(cells, place, net.edge_places[np.isin(net.edge_places, place[held(x)]).all(axis=1)]))


def cube(n=3, triangles=False):
    """Surface of the unit cube, with normals outwards."""
    faces = []
    for axis in range(3):
        for end in (0.0, 1.0):

            def face(u, v, axis=axis, end=end):
                return np.roll(np.column_stack([np.full(len(u), end), u, v]), axis, axis=1)

            faces.append(grid(n, face, triangles, turned=end == 0.0))
    return surfaces(*faces)


def moebius(elements=40, center=(0.5, 0.5, 0.55), radius=0.3, width=0.24):
    """A strip that is turned by half a turn on its way around."""
    s, t = np.linspace(0.0, 2.0 * np.pi, elements + 1), np.linspace(-0.5, 0.5, 7)
    u, v = (part.ravel() for part in np.meshgrid(s, t, indexing="ij"))
    out, up = radius + width * v * np.cos(0.5 * u), width * v * np.sin(0.5 * u)
    i = np.arange(len(u)).reshape(len(s), -1)
    cells = np.stack([i[:-1, :-1], i[1:, :-1], i[1:, 1:], i[:-1, 1:]], axis=-1).reshape(-1, 4)
    return np.array(center) + np.column_stack([out * np.cos(u), out * np.sin(u), up]), cells


def nearest(surface, x, reach=10.0):
    return surface.nearest(np.asarray(x, dtype=float), Sought(np.arange(len(x)), reach))


@pytest.mark.parametrize("triangles", [False, True])
@pytest.mark.parametrize("n", [1, 5])
def test_sides_of_a_closed_surface_with_sharp_edges(n, triangles):
    """By the normals of single faces points near edges and corners would be on the wrong side."""
    x = RNG.uniform(-0.5, 1.5, (2000, 3))
    outside = np.linalg.norm(np.maximum(np.maximum(-x, x - 1.0), 0.0), axis=1)
    inside = np.minimum(x, 1.0 - x).min(axis=1)
    surface = cube(n, triangles)
    near = nearest(surface, x)
    np.testing.assert_allclose(near.signed_distance(), np.where(inside > 0.0, inside, -outside), atol=1e-14)
    assert near.covered().all()
    assert not surface.net.ends.any()
    assert not len(surface.near_ends(x, 10.0))


def test_of_a_strip_with_half_a_turn_in_it_the_normals_cannot_agree():
    x, cells = moebius()
    np.testing.assert_array_equal(surfaces((x, cells)).net.one_sided, [True])
    triangles = np.concatenate([cells[:, [0, 1, 2]], cells[:, [0, 2, 3]]])
    np.testing.assert_array_equal(surfaces((x, triangles)).net.one_sided, [True])
    several = surfaces(
        grid(3), (x + np.array([2.0, 0.0, 0.0]), cells), grid(2, lambda u, v: np.column_stack([u, v, u + 2.0]))
    )
    np.testing.assert_array_equal(several.net.one_sided[several.net.sheet_of_points[[0, 20, -1]]], [False, True, False])
    for closed in (cube(2), cube(2, triangles=True)):
        assert not closed.net.one_sided.any()
    turned = surfaces(grid(2), grid(2, lambda u, v: np.column_stack([u + 1.0, v, 0.0 * u]), turned=True))
    assert turned.net.one_sided.all()  # cells whose normals do not agree, which a net of sheets does not have


def test_at_a_spike_the_side_is_that_of_the_mean_by_angles():
    """One of the faces that meet at the tip is divided in many: the mean by numbers points its way."""
    fan = [np.array([np.cos(a), np.sin(a), 0.0]) for a in np.deg2rad([0.0, 120.0, 240.0, *np.linspace(242, 358, 40)])]
    x = np.array([[0.0, 0.0, 1.5], *fan])
    cells = np.array([[0, k, k % (len(fan)) + 1] for k in range(1, len(fan) + 1)])
    surface = Surfaces(x, Net(cells, np.arange(len(x))))
    around = np.array([0.0, 0.0, 1.5]) + 0.05 * RNG.standard_normal((400, 3))
    near = nearest(surface, around)
    at_tip = near.places.kind[near._first] >= CORNER
    assert at_tip.sum() > 50
    assert (near.signed_distance()[at_tip] < 0.0).all()


def test_beyond_the_edge_of_a_blade_the_side_is_that_of_both_faces():
    x = np.array(
        [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.1], [1.0, 1.0, 0.1], [0.0, 1.0, -0.1], [1.0, 1.0, -0.1]]
    )
    blade = Surfaces(x, Net(np.array([[0, 1, 3, 2], [1, 0, 4, 5]]), np.arange(6)))
    angle = np.deg2rad(np.linspace(110.0, 250.0, 15))
    beyond = np.column_stack([np.full(15, 0.4), 0.1 * np.cos(angle), 0.1 * np.sin(angle)])
    np.testing.assert_allclose(nearest(blade, beyond).signed_distance(), -0.1)
    np.testing.assert_allclose(nearest(blade, [[0.4, 0.5, 0.0]]).signed_distance(), 0.05 / np.hypot(1.0, 0.1))


def test_behind_its_edges_a_plate_goes_straight_on():
    plate = surfaces(grid(4))
    x = np.array(
        [[0.5, 0.5, 0.2], [1.3, 0.5, 0.2], [1.3, 0.5, -0.3], [-0.2, 1.4, 0.1], [0.5, 1.0, 0.0], [0.5, 0.5, 3.0]]
    )
    near = nearest(plate, x, 1.0)
    np.testing.assert_allclose(near.signed_distance(), [-0.2, -0.2, 0.3, -0.1, 0.0, np.nan], atol=1e-15)
    np.testing.assert_array_equal(near.covered(), [True, False, False, False, True, False])
    np.testing.assert_array_equal(near.sheet(), [0, 0, 0, 0, 0, -1])
    np.testing.assert_array_equal(plate.near_ends(x, 0.37), [1, 4])


def test_where_it_is_attached_a_surface_covers_what_is_behind():
    plate = surfaces(grid(4), held=lambda x: x[:, 0] < 1e-9)
    x = np.array([[-0.3, 0.5, 0.1], [1.3, 0.5, 0.1], [0.5, 1.3, 0.1]])
    near = nearest(plate, x, 1.0)
    np.testing.assert_array_equal(near.covered(), [True, False, False])
    np.testing.assert_allclose(near.signed_distance(), -0.1)
    np.testing.assert_array_equal(plate.near_ends(x, 0.4), [1, 2])


@pytest.mark.parametrize("within", [False, True])
def test_at_the_poles_of_a_sphere_nothing_ends(within):
    """Sides of patches without length: there triangles have no area, and no normal of their own."""
    from tigar_x.geometry import surfaces as shapes
    from tigar_x.geometry.gluing import glued
    from tigar_x.geometry.patch import Patch
    from tigar_x.splines.spline import ExtractedSpline

    cap = shapes.sphere_cap(radius=1.0, angle=np.pi / 2.0, elements=(4, 8), degrees=(2, 2))
    other = Patch.from_points(cap.bases, cap.points * [1.0, 1.0, -1.0], cap.weights)
    sheets = Sheets.of(ExtractedSpline(glued(cap, other, within=within), MPI.COMM_SELF))
    sphere = Surfaces(sheets.X, Net.of(sheets))
    assert sphere.triangles.flat.sum() == 2 * 16
    assert not sphere.net.one_sided.any()
    assert not sphere.net.ends.any()
    x = np.concatenate([0.1 * RNG.standard_normal((200, 3)) + [0.0, 0.0, 1.0], [[0.0, 0.0, 1.3], [0.0, 0.0, -0.8]]])
    near, away = nearest(sphere, x), np.linalg.norm(x, axis=1) - 1.0
    inside = np.sign(near.signed_distance()[-1])
    np.testing.assert_allclose(inside * near.signed_distance(), -away, atol=0.02)
    assert near.covered().all()
    np.testing.assert_allclose(near.functions().sum(axis=1), 1.0)
    start, end = np.array([[0.0, 0.0, 0.5], [0.0, -0.3, 1.1]]), np.array([[0.0, 0.0, 1.5], [0.0, 0.3, 1.1]])
    np.testing.assert_array_equal(sphere.crossed(start, end, 0.1), [True, False])


def test_edges_near_a_wall_or_beyond_it_are_attached_to_it():
    plate = surfaces(grid(4, lambda u, v: np.column_stack([1.25 * u - 0.25, v, 0.5 + 0.0 * u])))
    assert len(attached(plate, cube(2), 1e-6, MPI.COMM_SELF)) == plate.net.ends.sum() == 16


@pytest.mark.parametrize("n", [1, 3])
def test_a_free_edge_from_wall_to_wall_is_not_attached_to_them(n):
    """However few elements it has."""
    points, cells = grid(n, lambda u, v: np.column_stack([0.6 * u, v, 0.5 + 0.0 * u]))
    plate = surfaces((points, cells))
    held = attached(plate, cube(2), 1e-6, MPI.COMM_SELF)
    assert len(held) == 3 * n
    net = Net(cells, plate.net.place, held)
    triangle, corner, *_ = net.at_free
    ends = np.array([np.delete(net.triangles[t], c) for t, c in zip(triangle, corner, strict=True)])
    assert len(ends) == n
    np.testing.assert_allclose(points[ends, 0], 0.6)


def test_what_is_near_edges_or_attached_asks_for_no_triangles():
    surface, walls = surfaces(grid(3)), cube()
    np.testing.assert_array_equal(surface.near_ends(np.array([[0.5, 1.2, 0.0], [0.5, 0.5, 0.0]]), 0.3), [0])
    assert len(attached(surface, walls, 0.01, MPI.COMM_SELF)) == len(surface.net.at_ends.points) == 12
    assert "triangles" not in vars(surface)
    np.testing.assert_array_equal(walls.span, [[0.0] * 3, [1.0] * 3])
    assert "span" in vars(walls)  # kept


def test_hat_functions_at_nearest_places():
    x = RNG.uniform(-0.3, 1.3, (200, 3)) * [1.0, 1.0, 0.1]
    for triangles in (False, True):
        plate = surfaces(grid(4, triangles=triangles))
        linear = plate.x @ np.array([[1.0, 2.0], [3.0, -1.0], [0.0, 0.0]]) + 0.5
        near = nearest(plate, x)
        at, going_on = near.functions() @ linear, near.values(linear)
        clipped = np.clip(x[:, :2], 0.0, 1.0)
        np.testing.assert_allclose(at, clipped @ [[1.0, 2.0], [3.0, -1.0]] + 0.5, atol=1e-14)
        np.testing.assert_allclose(going_on, x[:, :2] @ [[1.0, 2.0], [3.0, -1.0]] + 0.5, atol=1e-13)
    assert nearest(plate, [[0.5, 0.5, 5.0]], 1.0).functions().nnz == 0


def test_values_half_way_between_mirrored_surfaces_are_mirrored():
    low, high = (grid(3, lambda u, v, z=z: np.column_stack([u, v, z + 0 * u])) for z in (0.0, 1.0))
    pair = surfaces(low, high)
    v = np.where(pair.x[:, 2] < 0.5, 2.0, -2.0)[:, None]
    x = np.array([[0.4, 0.3, 0.5], [0.5, 0.5, 0.5], [1 / 3, 2 / 3, 0.5], [0.4, 0.3, 0.49]])
    np.testing.assert_allclose(nearest(pair, x).values(v).ravel(), [0.0, 0.0, 0.0, 2.0], atol=1e-14)
    assert pair.net.sheet.max() == 1
    other = [[0, 3, 4], [0, 4, 1], [1, 4, 2], [4, 5, 2], [3, 6, 4], [6, 7, 4], [4, 7, 8], [4, 8, 5]]
    unlike = surfaces(grid(2, triangles=True), (grid(2)[0] + [0.0, 0.0, 1.0], np.array(other)))
    v = np.where(unlike.x[:, 2] < 0.5, 2.0, -2.0)[:, None]
    at_corner = nearest(unlike, [[0.5, 0.5, 0.5]])  # of six triangles here and of eight there
    assert len(at_corner.places.point) == 2
    np.testing.assert_allclose(at_corner.values(v), 0.0, atol=1e-14)


def test_lines_that_cross_a_surface_or_its_continuation():
    plate = surfaces(grid(2), (grid(2)[0] + [0.0, 0.0, 1.0], grid(2)[1]))
    start = np.array([[0.2, 0.3, -0.1], [0.2, 0.3, 0.1], [1.1, 0.5, -0.1], [1.5, 0.5, -0.1], [0.3, 0.9, 0.5]])
    end = np.array([[0.4, 0.1, 0.1], [0.3, 0.4, 0.9], [1.1, 0.5, 0.1], [1.5, 0.5, 0.1], [0.3, 1.1, 1.5]])
    np.testing.assert_array_equal(plate.crossed(start, end, 1e-9), [True, False, False, False, True])
    np.testing.assert_array_equal(plate.crossed(start, end, 0.2), [True, False, True, False, True])
    of_each = np.array([0.2, 0.2, 0.05, 0.6, 0.2])
    np.testing.assert_array_equal(plate.crossed(start, end, of_each), [True, False, False, True, True])
    assert plate.crossed(start[:0], end[:0], 0.2).shape == (0,)


def test_patches_that_are_parametrised_against_each_other_have_one_side():
    from tigar_x.geometry import shapes
    from tigar_x.geometry.gluing import glued
    from tigar_x.splines.spline import ExtractedSpline

    parts = [
        shapes.parallelogram((0, 0, 0), (0.5, 0, 0), (0, 1, 0), elements=(3, 4), degrees=(2, 2)),
        shapes.parallelogram((1, 0, 0), (-0.5, 0, 0), (0, 1, 0), elements=(3, 4), degrees=(2, 2)),
    ]
    sheets = Sheets.of(ExtractedSpline(glued(*parts), MPI.COMM_SELF))
    surface = Surfaces(sheets.X, Net.of(sheets))
    x = np.array([[0.2, 0.5, 0.1], [0.8, 0.5, 0.1], [0.5, 0.5, 0.1], [0.5, 0.25, 0.1]])
    near = nearest(surface, x)
    phi = near.signed_distance()
    np.testing.assert_allclose(np.abs(phi), 0.1)
    assert len(set(np.sign(phi))) == 1
    assert set(near.sheet()) == {0}
    assert set(surface.net.sheet_of_points) == {0}
    assert not surface.net.one_sided.any()
    ends = surface.net.places_at_ends[surface.net.place]
    np.testing.assert_array_equal(ends, (np.abs(sheets.X[:, :2] - 0.5) > 0.5 - 1e-9).any(axis=1))


# -- one sheet of several, and surfaces that have moved ---------------------------------------------------------------


def waves(height, z, n=6):
    return grid(n, lambda u, v: np.column_stack([u, v, z + height * np.sin(3.0 * u + 2.0 * v)]))


def test_places_of_one_sheet_are_those_of_that_surface_alone():
    patches, x = (waves(0.1, 0.0), waves(0.05, 0.3), waves(-0.1, 0.6)), RNG.uniform(-0.2, 1.2, (200, 3))
    all_three, reach = surfaces(*patches), RNG.uniform(0.0, 0.5, 200)
    sought = Sought(np.arange(200), reach)
    for k, patch in enumerate(patches):
        alone, found = surfaces(patch).nearest(x, sought), all_three.nearest(x, sought, sheet=k)
        np.testing.assert_array_equal(found.signed_distance(), alone.signed_distance())
        np.testing.assert_array_equal(found.normals(), alone.normals())
        np.testing.assert_array_equal(found.covered(), alone.covered())
        np.testing.assert_array_equal(found.sheet(), np.where(np.isfinite(alone.signed_distance()), k, -1))
        np.testing.assert_array_equal(all_three.near_sheet(k, x, reach), alone.sheet() >= 0)
        assert 20 < (alone.sheet() >= 0).sum() < 180


def test_some_of_the_points_have_the_same_places():
    surface, x = surfaces(waves(0.1, 0.0)), RNG.uniform(-0.2, 1.2, (100, 3))
    whole, chosen = surface.nearest(x, Sought(np.arange(100), 0.4)), np.arange(3, 100, 4)
    some = whole.of(chosen)
    np.testing.assert_array_equal(some.signed_distance(), whole.signed_distance()[chosen])
    difference = some.functions() - whole.functions()[chosen]
    assert not difference.nnz or abs(difference).max() == 0.0
    np.testing.assert_array_equal(some.values(surface.x), whole.values(surface.x)[chosen])
    assert 5 < np.isfinite(some.signed_distance()).sum() < 25


def test_boxes_of_a_surface_that_has_moved_are_in_the_order_of_that_at_rest():
    rest, moved = waves(0.0, 0.0, 12), waves(0.4, 0.0, 12)
    net = Net(rest[1], np.arange(len(rest[0])), rest=rest[0])
    x, sought = RNG.uniform(-0.2, 1.2, (200, 3)), Sought(np.arange(200), 0.4)
    kept, fresh = Surfaces(moved[0], net), surfaces(moved)
    np.testing.assert_array_equal(kept._boxes.order, Surfaces(rest[0], net)._boxes.order)
    for name in ("signed_distance", "normals", "covered"):
        np.testing.assert_array_equal(*(getattr(surface.nearest(x, sought), name)() for surface in (kept, fresh)))


def test_products_across_are_those_of_numpy_to_the_last_bit():
    a, b = np.random.default_rng(31).standard_normal((2, 1000, 3))
    np.testing.assert_array_equal(cross_products(a, b), np.cross(a, b))
    assert cross_products(a[:0], b[:0]).shape == (0, 3)
