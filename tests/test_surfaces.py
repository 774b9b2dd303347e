"""Round surfaces are exact, with their areas in closed form; the leaflets of a valve are as they were designed."""

import numpy as np
import pytest
from mpi4py import MPI
from geometry import grid, jacobian, measure, normals, tangents
from scipy.spatial import cKDTree
from splines import integral

from tigar_x.geometry import surfaces
from tigar_x.geometry.patch import Patch
from tigar_x.geometry.shapes import extruded, ruled
from tigar_x.splines.spline import ExtractedSpline

PI = np.pi
ROOF = np.deg2rad(80)
LATE = 1.9  # an angle beyond a right one


def on_circle(x, radius, center=(0.0, 0.0)):
    return np.hypot(x[:, 0] - center[0], x[:, 1] - center[1]) - radius


def in_roof(x):
    return np.hypot(x[:, 1], x[:, 2]) - 25.0


def on_sphere(x):
    return np.linalg.norm(x, axis=1) - 3.0


SHAPES = {
    # factory and its sizes, its area, its smallest degrees
    "square disc": (surfaces.disc, {"radius": 2.0}, 4 * PI, (2, 2)),
    "polar disc": (surfaces.disc, {"radius": 2.0, "kind": "polar", "center": (1, 2)}, 4 * PI, (1, 2)),
    "ring": (surfaces.annulus, {"inner": 1.0, "outer": 2.0}, 3 * PI, (1, 2)),
    "sector": (surfaces.annulus, {"inner": 1.0, "outer": 2.0, "angle": LATE}, 1.5 * LATE, (1, 2)),
    "roof": (surfaces.cylinder_panel, {"radius": 25.0, "length": 50.0, "angle": ROOF}, 1250 * ROOF, (1, 2)),
    "tube": (surfaces.cylinder_panel, {"radius": 25.0, "length": 50.0, "angle": 2 * PI}, 2500 * PI, (1, 2)),
    "cap": (surfaces.sphere_cap, {"radius": 3.0, "angle": 0.7}, 18 * PI * (1 - np.cos(0.7)), (2, 2)),
    "large cap": (surfaces.sphere_cap, {"radius": 3.0, "angle": LATE}, 18 * PI * (1 - np.cos(LATE)), (2, 2)),
}
CLOSED = ("polar disc", "ring", "tube", "cap", "large cap")


def make(name, elements=(3, 5), degrees=None):
    factory, sizes, _, lowest = SHAPES[name]
    return factory(**sizes, elements=elements, degrees=lowest if degrees is None else degrees)


# -- round surfaces ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", SHAPES)
@pytest.mark.parametrize("more", [0, 1, 2])
def test_areas(name, more):
    patch = make(name, degrees=[p + more for p in SHAPES[name][3]])
    assert measure(patch, points=14) == pytest.approx(SHAPES[name][2], rel=1e-12)


@pytest.mark.mpi
@pytest.mark.parametrize("name", ["square disc", "sector", "roof", "cap"])
def test_areas_by_finite_elements(name):
    spline = ExtractedSpline(make(name, degrees=(3, 3)), MPI.COMM_SELF, quadrature_degree=14)
    assert integral(1.0 * spline.dx) == pytest.approx(SHAPES[name][2], rel=1e-9)


@pytest.mark.mpi
def test_volume_by_finite_elements():
    pipe = extruded(make("ring", elements=(1, 8), degrees=(2, 2)), (0, 0, 4), degree=2)
    spline = ExtractedSpline(pipe, MPI.COMM_SELF, quadrature_degree=8)
    assert integral(1.0 * spline.dx) == pytest.approx(12 * PI, rel=1e-8)


@pytest.mark.parametrize("name", [name for name in SHAPES if name != "square disc"])
def test_without_its_weights_a_shape_is_another_one(name):
    patch = make(name, elements=(1, 1))
    plain = Patch.from_points(patch.bases, patch.points)
    assert abs(measure(plain) / SHAPES[name][2] - 1.0) > 1e-3


@pytest.mark.parametrize("degree", [2, 3, 4, 6])
@pytest.mark.parametrize(
    ("name", "curve", "distance"),
    [
        ("square disc", ("u0", "u1", "v0", "v1"), lambda x: on_circle(x, 2.0)),
        ("polar disc", ("rim",), lambda x: on_circle(x, 2.0, (1.0, 2.0))),
        ("ring", ("inner",), lambda x: on_circle(x, 1.0)),
        ("ring", ("outer",), lambda x: on_circle(x, 2.0)),
        ("sector", ("inner",), lambda x: on_circle(x, 1.0)),
        ("roof", (), in_roof),
        ("tube", (), in_roof),
        ("cap", (), on_sphere),
        ("large cap", (), on_sphere),
    ],
)
def test_points_lie_on_the_circle_the_cylinder_or_the_sphere(name, curve, distance, degree):
    patch = make(name, degrees=(degree, degree), elements=(4, 6))
    xi = grid(patch, 33)
    if curve:
        places = [patch.locate_side(side) for side in curve]
        xi = np.concatenate([xi[xi[:, direction] == end] for direction, end in places])
    x = patch.evaluate(xi)
    assert np.abs(distance(x)).max() < 1e-14 * np.abs(x).max()


@pytest.mark.parametrize("degree", [2, 3, 4])
def test_a_circle_is_a_closed_curve_of_equal_parts(degree):
    """Anticlockwise from the first axis, in the plane or in space."""
    plane, space = (
        surfaces.full_circle(radius=2.0, center=center, elements=8, degree=degree)
        for center in ((1.0, 2.0), (1.0, 2.0, 3.0))
    )
    xi = np.linspace(0.0, 1.0, 33)[:, None]
    x = plane.evaluate(xi)
    assert np.abs(on_circle(x, 2.0, (1.0, 2.0))).max() < 1e-14
    assert measure(plane, points=14) == pytest.approx(4 * PI, rel=1e-12)
    np.testing.assert_allclose(x[[0, 8, 16, 32]], [[3, 2], [1, 4], [-1, 2], [3, 2]], rtol=0, atol=1e-14)
    np.testing.assert_allclose(space.evaluate(xi), np.insert(x, 2, 3.0, axis=1), rtol=0, atol=1e-14)
    assert plane.bases[0].periodic
    np.testing.assert_allclose(plane.bases[0].breakpoints, np.arange(9) / 8, rtol=0, atol=1e-15)


@pytest.mark.parametrize(
    ("change", "message"),
    [({"degree": 1}, "degree = 1"), ({"radius": 0.0}, "radius = 0"), ({"elements": 0}, "elements")],
)
def test_a_bad_circle_is_refused(change, message):
    with pytest.raises(ValueError, match=message):
        surfaces.full_circle(**({"radius": 1.0, "elements": 4} | change))


@pytest.mark.parametrize("name", SHAPES)
def test_parts_are_equal_besides_the_ends_of_the_arcs(name):
    patch = make(name, elements=(3, 5), degrees=(3, 4))
    spans = {"sector": 2, "roof": 1, "square disc": 1}.get(name, 4)
    np.testing.assert_allclose(
        patch.bases[1].breakpoints, np.union1d(np.arange(6) / 5, np.arange(spans + 1) / spans), rtol=0, atol=1e-15
    )
    thirds = np.arange(4) / 3 if name != "large cap" else [0, 1 / 3, 1 / 2, 2 / 3, 1]  # two spans along its meridian
    np.testing.assert_allclose(patch.bases[0].breakpoints, thirds, rtol=0, atol=1e-15)
    assert patch.basis.degrees == (3, 4)
    matching = make(name, elements=(4, 8), degrees=(2, 3))
    assert [len(basis.breakpoints) for basis in matching.bases] == [5, 9]


@pytest.mark.parametrize("name", CLOSED)
def test_full_circles_are_smooth_from_degree_four_on(name):
    for degree, repeats in ((2, 2), (3, 3), (4, 3), (5, 4)):
        around = make(name, elements=(1, 8), degrees=(2, degree)).bases[1]
        assert around.periodic
        np.testing.assert_array_equal(around.multiplicities, [repeats, 1] * 4 + [repeats])


@pytest.mark.parametrize("name", ["square disc", "polar disc", "ring", "sector"])
def test_flat_shapes_lie_where_their_center_says(name):
    factory, sizes, area, lowest = SHAPES[name]
    options = {**sizes, "elements": (2, 2), "degrees": lowest}
    plane, space = (factory(**{**options, "center": c}) for c in ((3.0, -1.0), (3.0, -1.0, 7.0)))
    xi = grid(plane, 9)
    assert (plane.nsd, space.nsd) == (2, 3)
    np.testing.assert_allclose(space.evaluate(xi)[:, :2], plane.evaluate(xi), rtol=0, atol=1e-15)
    np.testing.assert_allclose(space.evaluate(xi)[:, 2], 7.0, rtol=1e-15)
    assert measure(plane, lambda x: x[0]) == pytest.approx(
        3.0 * area + (0.0 if name != "sector" else 7.0 / 3.0 * np.sin(LATE)), rel=1e-12
    )
    inside = xi[(xi > 0.0).all(axis=1) & (xi < 1.0).all(axis=1)]
    assert (np.linalg.det(tangents(plane, inside)) > 0.0).all()


def test_disc_kinds_differ_where_they_are_singular():
    square, polar = make("square disc"), make("polar disc")
    np.testing.assert_allclose(jacobian(square, grid(square, 2)), 0.0, atol=1e-13)  # corners
    assert jacobian(square, [[0.5, 0.5], [0.5, 0.0], [0.0, 0.5]]).min() > 1.0
    pole = polar.evaluate(np.column_stack([np.zeros(9), np.linspace(0, 1, 9)]))
    np.testing.assert_allclose(pole, np.tile([1, 2], (9, 1)), rtol=0, atol=1e-15)
    np.testing.assert_allclose(polar.points[polar.side("pole")], np.tile([1, 2], (len(polar.side("pole")), 1)))
    assert not square.side_names
    assert set(polar.side_names) == {"pole", "rim"}


def test_ring_and_sector_have_their_sides():
    ring, sector = make("ring"), make("sector")
    assert set(ring.side_names) == {"inner", "outer"}
    assert set(sector.side_names) == {"inner", "outer", "start", "end"}
    s = np.linspace(0, 1, 5)
    first, last = (sector.evaluate(np.column_stack([s, np.full(5, v)])) for v in (0, 1))
    np.testing.assert_allclose(first, np.outer(1 + s, [1, 0, 0]), rtol=0, atol=1e-15)
    np.testing.assert_allclose(last, np.outer(1 + s, [np.cos(LATE), np.sin(LATE), 0]), rtol=0, atol=1e-15)
    assert (sector.locate_side("start"), sector.locate_side("end")) == ((1, 0), (1, 1))


def test_roof_lies_along_its_axis_with_its_crown_up():
    roof = make("roof", elements=(2, 2), degrees=(3, 3))
    corners = roof.evaluate([[0, 0], [1, 0], [0, 1], [1, 1], [0.5, 0.5]])
    y, z = 25 * np.sin(ROOF / 2), 25 * np.cos(ROOF / 2)
    expected = [[0, -y, z], [50, -y, z], [0, y, z], [50, y, z], [25, 0, 25]]
    np.testing.assert_allclose(corners, expected, rtol=0, atol=1e-13)
    xi = grid(roof, 7)
    outwards = roof.evaluate(xi) * [0, 1, 1] / 25
    np.testing.assert_allclose(normals(roof, xi), outwards, rtol=0, atol=1e-13)
    for name, axis, value in (("end_0", 0, 0), ("end_1", 0, 50), ("straight_0", 1, -y), ("straight_1", 1, y)):
        np.testing.assert_allclose(roof.points[roof.side(name)][:, axis], value, rtol=0, atol=1e-13)
    assert set(make("tube").side_names) == {"end_0", "end_1"}
    assert len(make("roof", degrees=(3, 3), elements=(32, 32)).bases[1].breakpoints) == 33


def test_cap_hangs_on_its_pole():
    cap = make("large cap", degrees=(3, 3))
    pole, rim = (cap.points[cap.side(name)] for name in ("pole", "rim"))
    np.testing.assert_allclose(pole, np.tile([0, 0, 3], (len(pole), 1)), rtol=0, atol=1e-14)
    np.testing.assert_allclose(rim[:, 2], 3 * np.cos(LATE), rtol=1e-13)
    xi = np.random.default_rng(0).uniform(0.01, 1, (40, 2))
    np.testing.assert_allclose(normals(cap, xi), cap.evaluate(xi) / 3, rtol=0, atol=1e-11)


def test_volumes_between_round_surfaces():
    shell = ruled(
        *(surfaces.sphere_cap(radius=r, angle=1.2, elements=(2, 4), degrees=(2, 2)) for r in (1.0, 2.0)), degree=2
    )
    assert measure(shell) == pytest.approx(2 * PI / 3 * (8 - 1) * (1 - np.cos(1.2)), rel=1e-12)
    pipe = extruded(make("ring"), (0, 0, 4), elements=2)
    assert measure(pipe) == pytest.approx(12 * PI, rel=1e-12)
    assert pipe.open_sides == ("u0", "u1", "w0", "w1")
    assert (np.linalg.det(tangents(pipe, grid(pipe, 4))) > 0.0).all()
    rod = extruded(make("square disc"), (0, 0, 4))
    assert measure(rod) == pytest.approx(16 * PI, rel=1e-12)


BAD = {
    "any": [
        ({"elements": (2, 0)}, r"elements = 0: an integer >= 1"),
        ({"elements": 2}, r"elements = 2: one number for each of the 2 directions"),
        ({"elements": (2, 2, 2)}, r"elements = \(2, 2, 2\)"),
        ({"degrees": (2,)}, r"degrees = \(2,\): one number for each of the 2 directions"),
        ({"degrees": (2, 1)}, r"degrees = 1: an integer >= 2"),
        ({"degrees": (2, 2.5)}, r"degrees = 2.5: an integer >= 2"),
    ],
    "polar disc": [
        ({"radius": 0.0}, r"radius = 0.0: a number > 0"),
        ({"radius": np.nan}, r"radius = nan"),
        ({"kind": "round"}, r"kind = 'round': one of 'square', 'polar'"),
        ({"center": (0,)}, r"center has 1 coordinates: 2 or 3"),
        ({"center": (0, np.inf)}, r"center\[1\] = inf"),
    ],
    "sector": [
        ({"inner": 0}, r"inner = 0: a number > 0"),
        ({"outer": 1.0}, r"outer = 1.0: a number > inner = 1.0"),
        ({"outer": np.inf}, r"outer = inf: a finite number"),
        ({"angle": 0}, r"angle = 0: a number > 0"),
        ({"angle": 6.3}, r"angle = 6.3: a number <= 6.28319"),
    ],
    "roof": [
        ({"radius": -25}, r"radius = -25: a number > 0"),
        ({"length": 0}, r"length = 0: a number > 0"),
        ({"angle": 80}, r"angle = 80: a number <= 6.28319"),
        ({"angle": -1}, r"angle = -1: a number > 0"),
    ],
    "cap": [
        ({"radius": "R"}, r"radius = 'R': a finite number"),
        ({"angle": PI}, r"angle = 3.14159.*: less than pi is required"),
        ({"angle": 4.0}, r"angle = 4.0: a number <= 3.14159"),
        ({"degrees": (1, 2)}, r"degrees = 1: an integer >= 2"),
    ],
}


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [(name, *case) for name in SHAPES for case in (*BAD["any"], *BAD.get(name, ()))],
)
def test_bad_round_surfaces(name, change, message):
    factory, sizes, _, lowest = SHAPES[name]
    with pytest.raises(ValueError, match=message):
        factory(**{**sizes, "elements": (2, 2), "degrees": lowest, **change})


# -- leaflets ---------------------------------------------------------------------------------------------------------


def designed(u, v, index):
    """The leaflet as it is defined, with its default sizes."""
    R, delta, gap, z_b, z_p, z_t, d, h_f, b = 1.1, 0.03, 0.028, -0.06, 0.60, 0.94, 0.15, 0.08, 0.12
    s, R_a, a, phi = 2 * u - 1, R + delta, PI / 3 - gap / (2 * R), PI / 3 + 2 * PI * index / 3
    x_c, y_c = R_a * np.cos(a), R_a * np.sin(a)
    A = np.array([R_a * np.cos(a * s), R_a * np.sin(a * s), z_b + (z_p - z_b) * s**2])
    F = np.array([np.sqrt(d**2 + (x_c**2 - d**2) * s**2), y_c * s, z_t - h_f * (1 - s**2)])
    X = (1 - v) * F + v * A
    X[2] -= 4 * b * (1 - s**2) * v * (1 - v)
    turn = np.array([[np.cos(phi), -np.sin(phi), 0], [np.sin(phi), np.cos(phi), 0], [0, 0, 1]])
    return (turn @ X).T


@pytest.fixture(scope="module")
def valve():
    return surfaces.trileaflet()


@pytest.mark.parametrize("index", [0, 1, 2])
def test_leaflets_follow_the_design(valve, index):
    xi = grid(valve[index], 161)
    coarse = surfaces.leaflet(index, elements=(10, 8))
    fine_error, coarse_error = (
        np.linalg.norm(patch.evaluate(xi) - designed(*xi.T, index), axis=1).max() for patch in (valve[index], coarse)
    )
    assert coarse_error == pytest.approx(2e-4, rel=0.15)
    assert fine_error == pytest.approx(2e-5, rel=0.3)
    other = np.linalg.norm(valve[index].evaluate(xi) - designed(*xi.T, (index + 1) % 3), axis=1)
    assert other.max() > 1.0


def test_leaflets_are_cubic_patches_that_are_three_turns_of_one(valve):
    for index, patch in enumerate(valve):
        assert (patch.basis.degrees, patch.n, patch.rational) == ((3, 3), 23 * 19, False)
        assert [len(basis.breakpoints) - 1 for basis in patch.bases] == [20, 16]
        azimuth = 2 * PI * index / 3
        turn = np.array([[np.cos(azimuth), np.sin(azimuth)], [-np.sin(azimuth), np.cos(azimuth)]])
        np.testing.assert_allclose(patch.points[:, :2] @ turn.T, valve[0].points[:, :2], rtol=0, atol=1e-14)
        np.testing.assert_allclose(patch.points[:, 2], valve[0].points[:, 2], rtol=0, atol=1e-14)


def test_area_of_a_leaflet(valve):
    assert measure(valve[0], points=5) == pytest.approx(2.040, abs=5e-4)


def test_leaflets_keep_their_distance(valve):
    clouds = [patch.evaluate(grid(patch, 101)) for patch in valve]
    for first, second in ((0, 1), (1, 2), (2, 0)):
        gaps = cKDTree(clouds[first]).query(clouds[second])[0]
        assert gaps.min() == pytest.approx(0.0288, abs=1e-4)
    posts = [patch.evaluate(np.column_stack([[end, end], [0.0, 1.0]])) for patch, end in ((valve[0], 1), (valve[1], 0))]
    np.testing.assert_allclose(np.linalg.norm(posts[0] - posts[1], axis=1), 0.0288, rtol=0, atol=1e-4)


def test_leaflet_is_nowhere_degenerate(valve):
    xi = grid(valve[0], 81)
    size = jacobian(valve[0], xi)
    assert 0.55 < size.min() < 0.57
    assert 3.2 < size.max() < 3.4
    a, b = np.moveaxis(tangents(valve[0], xi), -1, 0)
    cosine = np.abs((a * b).sum(axis=1)) / np.linalg.norm(a, axis=1) / np.linalg.norm(b, axis=1)
    assert 33.0 < np.degrees(np.arccos(cosine.max())) < 34.0


def test_normal_points_upstream_and_inwards(valve):
    xi = grid(valve[2], 41)
    n, x = normals(valve[2], xi), valve[2].evaluate(xi)
    assert n[:, 2].max() < 1e-12  # horizontal at the posts
    assert n[(xi[:, 0] > 0.0) & (xi[:, 0] < 1.0), 2].max() < 0.0
    assert (n[:, :2] * x[:, :2]).sum(axis=1).max() < 0.0


def test_sides_of_a_leaflet(valve):
    patch = valve[1]
    s = np.linspace(0, 1, 21)
    zero, one = np.zeros(21), np.ones(21)
    for name, u, v in (("post_0", zero, s), ("post_1", one, s), ("free", s, zero), ("attachment", s, one)):
        expected = designed(u, v, 1)
        direction, end = patch.locate_side(name)
        xi = np.insert(s[:, None], direction, end, axis=1)
        np.testing.assert_allclose(patch.evaluate(xi), expected, rtol=0, atol=3e-5)
    for name in ("post_0", "post_1"):
        post = patch.points[patch.side(name)]
        np.testing.assert_allclose(post[:, :2], np.tile(post[0, :2], (len(post), 1)), rtol=0, atol=1e-14)
        assert (post[:, 2].min(), post[:, 2].max()) == pytest.approx((0.60, 0.94), abs=1e-14)


def test_attachment_lies_below_the_sinuses(valve):
    """On the cylindrical wall, so that nothing leaks past it (the sinuses are spheres; see the valve's walls)."""
    for index, patch in enumerate(valve):
        x, y, z = patch.evaluate(np.column_stack([np.linspace(0, 1, 401), np.ones(401)])).T
        alpha = np.arctan2(y, x) - (PI / 3 + 2 * PI * index / 3)
        square = 0.88**2 - 1.1**2 - 0.55**2 + 1.21 * np.cos(alpha)
        wall = square > 0.0  # the sinus cuts the wall at this azimuth
        assert 300 < wall.sum() < 401
        assert (0.68 - np.sqrt(square[wall]) - z[wall]).min() == pytest.approx(0.0045, abs=5e-4)
        np.testing.assert_allclose(np.hypot(x, y), 1.13, rtol=0, atol=3e-5)


@pytest.mark.parametrize(
    ("change", "moves"),
    [
        ({"radius": 1.2}, "attachment"),
        ({"overlap": 0.0}, "attachment"),
        ({"gap": 0.1}, "post_0"),
        ({"z_bottom": -0.1}, "attachment"),
        ({"z_post": 0.5}, "attachment"),
        ({"z_top": 1.0}, "free"),
        ({"opening": 0.3}, "free"),
        ({"sag": 0.0}, "free"),
        ({"belly": 0.0}, None),
    ],
)
def test_every_parameter_of_a_leaflet_matters(valve, change, moves):
    patch = surfaces.leaflet(0, **change)
    moved = np.linalg.norm(patch.points - valve[0].points, axis=1)
    assert moved.max() > 0.02
    if moves:
        assert moved[patch.side(moves)].max() > 0.02
    else:  # between the edges only
        assert max(moved[patch.side(name)].max() for name in patch.side_names) < 1e-13
    assert (surfaces.trileaflet(**change)[0].control == patch.control).all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"index": 3}, r"index = 3: one of 0, 1, 2"),
        ({"radius": 0.0}, r"radius = 0.0: a number > 0"),
        ({"overlap": -0.01}, r"overlap = -0.01: a number >= 0"),
        ({"gap": 0.0}, r"gap = 0.0: a number > 0"),
        ({"gap": 2.4}, r"gap = 2.4: less than a third of the wall, 2.30383"),
        ({"z_bottom": np.nan}, r"z_bottom = nan"),
        ({"z_post": -0.06}, r"z_bottom, z_post, z_top = -0.06, -0.06, 0.94: increasing heights"),
        ({"z_top": 0.5}, r"z_bottom, z_post, z_top = -0.06, 0.6, 0.5"),
        ({"opening": 0.0}, r"opening = 0.0: a number > 0"),
        ({"sag": -0.1}, r"sag = -0.1: a number >= 0"),
        ({"belly": np.inf}, r"belly = inf"),
        ({"elements": (20, 0)}, r"elements = 0"),
        ({"degrees": (3, 0)}, r"degree = 0"),
        ({"degrees": (3, 3, 3)}, r"degrees = \(3, 3, 3\): one number for each of the 2 directions"),
    ],
)
def test_bad_leaflets(change, message):
    with pytest.raises(ValueError, match=message):
        surfaces.leaflet(**{"index": 0, **change})
