"""Patches as data, their sides, and the same geometry described otherwise."""

import numpy as np
import pytest
from mpi4py import MPI
from geometry import grid

from coudalfish.surface.trace import Location
from tigar_x.geometry import shapes
from tigar_x.geometry.bspline import BSplineBasis, open_knots, periodic_knots
from tigar_x.geometry.gluing import glued
from tigar_x.geometry.locate import closest_points
from tigar_x.geometry.patch import SIDES, Patch
from tigar_x.splines.quadrature import NodalQuadrature
from tigar_x.splines.spline import ExtractedSpline

QUADRATIC = BSplineBasis(2, open_knots(2, [0, 1]))
LINE = BSplineBasis(1, open_knots(1, [0, 1, 2]))  # 3 functions


def quarter_circle(radius=1.0):
    points = radius * np.array([[1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    return Patch.from_points([QUADRATIC], points, [1.0, np.sqrt(0.5), 1.0])


def surface(n0=4, n1=3, nsd=3):
    """Linear patch with n0 x n1 functions and arbitrary control points."""
    bases = [BSplineBasis(1, open_knots(1, np.arange(n))) for n in (n0, n1)]
    return Patch.from_points(bases, np.random.default_rng(0).uniform(size=(n0 * n1, nsd)))


def any_patch(dim, periodic=(), rational=True, side_names=None):
    """Patch with arbitrary control points on arbitrary knots, degree 2, 3, 1 in its directions."""
    rng = np.random.default_rng(dim)
    ticks = (np.array([-1.0, 0.5, 1.0, 2.3, 2.7]), np.array([0.1, 0.4, 0.7, 1.1, 1.3]), np.array([5.0, 6.0, 8.0]))
    bases = []
    for d, (p, x) in enumerate(zip((2, 3, 1), ticks[:dim], strict=False)):
        inner = np.repeat(x[1:-1], np.arange(1, len(x) - 1) % p + 1)
        ends = 1 + d if d in periodic else p + 1
        knots = np.concatenate([np.full(ends, x[0]), inner, np.full(ends, x[-1])])
        bases.append(BSplineBasis(p, knots, d in periodic))
    n = int(np.prod([basis.n for basis in bases]))
    weights = rng.uniform(0.5, 2.0, n) if rational else None
    return Patch.from_points(bases, rng.uniform(-1.0, 1.0, (n, 3)), weights, side_names)


KINDS = {
    "curve": lambda **options: any_patch(1, **options),
    "surface": lambda **options: any_patch(2, **options),
    "volume": lambda **options: any_patch(3, **options),
    "closed curve": lambda **options: any_patch(1, periodic=(0,), **options),
    "tube": lambda **options: any_patch(2, periodic=(1,), **options),
    "torus": lambda **options: any_patch(2, periodic=(0, 1), **options),
}


def distances(points, others):
    """From each point to the nearest of the others."""
    return np.linalg.norm(points[:, None] - others[None], axis=-1).min(axis=1)


def side_points(patch, name):
    """Points of a side, at the same parameters whichever way these run."""
    direction, end = patch.locate_side(name)
    xi = grid(patch, 5)
    low, high = patch.basis.box[:, direction]
    xi = xi[xi[:, direction] == (high if end else low)]
    return patch.evaluate(xi)


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
    with pytest.raises(ValueError, match=r"bases has 4 directions: 1, 2 or 3 are supported"):
        Patch.from_points([LINE] * 4, np.zeros((81, 3)))
    with pytest.raises(ValueError, match=r"bases has 0 directions"):
        Patch.from_points([], np.zeros((1, 3)))
    with pytest.raises(ValueError, match=r"control has 2 columns: a patch of dimension 2"):
        Patch.from_points([LINE] * 2, np.zeros((9, 1)))


# -- sides ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "layers", "expected"),
    [
        # functions 8  9 10 11
        #           4  5  6  7
        #           0  1  2  3  (u to the right, v up)
        ("u0", 1, [0, 4, 8]),
        ("u1", 1, [3, 7, 11]),
        ("u0", 2, [0, 1, 4, 5, 8, 9]),
        ("u1", 2, [2, 3, 6, 7, 10, 11]),
        ("v0", 1, [0, 1, 2, 3]),
        ("v1", 1, [8, 9, 10, 11]),
        ("v1", 2, [4, 5, 6, 7, 8, 9, 10, 11]),
        ("v0", 3, list(range(12))),
    ],
)
def test_sides_of_a_surface(name, layers, expected):
    patch = surface()
    np.testing.assert_array_equal(patch.side(name, layers), expected)
    all_components = [3 * f + c for f in expected for c in range(3)]
    np.testing.assert_array_equal(patch.side_dofs(name, layers), all_components)
    np.testing.assert_array_equal(
        patch.side_dofs(name, layers, components=(2, 0)), [3 * f + c for f in expected for c in (0, 2)]
    )


@pytest.mark.parametrize("name", ["u0", "u1", "v0", "v1", "w0", "w1"])
def test_one_layer_carries_the_side(name):
    """Only the functions of one layer do not vanish on the side; two layers carry the derivative across it as well."""
    patch = shapes.box(lengths=(1, 1, 1), elements=(3, 2, 1), degrees=(2, 3, 2))
    direction, end = patch.locate_side(name)
    s = np.linspace(0, 1, 9)
    for distance, layers, power in ((0.0, 1, 1), (1e-5, 2, 2)):
        xi = np.stack([axis.ravel() for axis in np.meshgrid(s, s, s, indexing="ij")], axis=1)
        xi[:, direction] = abs(end - distance)
        N = np.abs(patch.basis.evaluate(xi).toarray()).max(axis=0)
        beyond = np.setdiff1d(np.arange(patch.basis.n), patch.side(name, layers))
        assert N[beyond].max() <= 50.0 * distance**power
        assert N[patch.side(name, layers)].min() > 10.0 * distance**power


def test_sides_of_a_curve():
    patch = shapes.line((0, 0), (1, 1), elements=3, degree=2)  # 5 functions
    np.testing.assert_array_equal(patch.side("u0"), [0])
    np.testing.assert_array_equal(patch.side("u1", 2), [3, 4])
    np.testing.assert_array_equal(patch.side_dofs("u1", 2, components=[1]), [7, 9])
    assert patch.side_dofs("u0", components=[]).size == 0


def test_sides_of_a_volume():
    patch = shapes.box(lengths=(1, 2, 3), elements=(1, 2, 3), degrees=(1, 1, 1))
    for name, (direction, end) in SIDES.items():
        points = patch.points[patch.side(name)]
        assert (points[:, direction] == end * (direction + 1.0)).all()
        assert len(points) == [12, 8, 6][direction]
    corner = np.intersect1d(np.intersect1d(patch.side("u1"), patch.side("v0")), patch.side("w1"))
    np.testing.assert_array_equal(patch.points[corner], [[1, 0, 3]])


def test_speaking_names_of_sides():
    names = {"root": (0, 0), "tip": (0, 1), "hem": (1, 0)}
    patch = any_patch(2, side_names=names)
    for name, plain in (("root", "u0"), ("tip", "u1"), ("hem", "v0")):
        np.testing.assert_array_equal(patch.side(name, 2), patch.side(plain, 2))
        np.testing.assert_array_equal(patch.side_dofs(name, 1, [1]), patch.side_dofs(plain, 1, [1]))
    assert not np.array_equal(patch.side("root"), patch.side("tip"))
    names["hem"] = (1, 1)  # the patch keeps its own
    assert patch.locate_side("hem") == (1, 0)


def test_a_periodic_direction_has_no_sides():
    tube = KINDS["tube"]()
    assert tube.open_sides == ("u0", "u1")
    assert KINDS["torus"]().open_sides == ()
    for name in ("v0", "v1"):
        with pytest.raises(ValueError, match=rf"name = '{name}': one of 'u0', 'u1' is required"):
            tube.side(name)
    with pytest.raises(ValueError, match=r"name = 'u0': one of nothing is required"):
        KINDS["closed curve"]().side("u0")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("w0",), r"name = 'w0': one of 'u0', 'u1', 'v0', 'v1' is required"),
        (("top",), r"name = 'top': one of 'u0'"),
        ((0,), r"name = 0: one of 'u0'"),
        (("u0", 0), r"layers = 0: an integer >= 1"),
        (("u1", 1.5), r"layers = 1.5: an integer >= 1"),
        (("u0", 5), r"layers = 5: direction 0 has only 4"),
        (("v0", 4), r"layers = 4: direction 1 has only 3"),
    ],
)
def test_unknown_sides(arguments, message):
    with pytest.raises(ValueError, match=message):
        surface().side(*arguments)
    with pytest.raises(ValueError, match=message):
        surface().side_dofs(*arguments)


@pytest.mark.parametrize(
    ("side_names", "message"),
    [
        ({"top": (2, 0)}, r"side_names\['top'\] = \(2, 0\): one of \(0, 0\), \(0, 1\), \(1, 0\), \(1, 1\) is"),
        ({"top": (0, 2)}, r"side_names\['top'\] = \(0, 2\)"),
        ({"top": 1}, r"side_names\['top'\] = 1"),
        ({"u0": (1, 1)}, r"side_names contains 'u0': a name other than u0, u1"),
    ],
)
def test_names_for_no_side(side_names, message):
    with pytest.raises(ValueError, match=message):
        any_patch(2, side_names=side_names)


def test_no_name_for_a_side_of_a_periodic_direction():
    assert KINDS["tube"](side_names={"rim": (0, 1)}).locate_side("rim") == (0, 1)
    with pytest.raises(ValueError, match=r"side_names\['seam'\] = \(1, 0\): one of \(0, 0\), \(0, 1\) is"):
        KINDS["tube"](side_names={"seam": (1, 0)})


def test_unknown_components_and_directions():
    with pytest.raises(ValueError, match=r"components = 2: one of 0, 1 is"):
        surface(nsd=2).side_dofs("u0", components=[0, 2])
    with pytest.raises(ValueError, match=r"name = 'v0': one of 'u0', 'u1' is required"):
        quarter_circle().side("v0")


def test_control_points_in_a_region():
    patch = shapes.plate(lengths=(2, 2), elements=(2, 2), degrees=(1, 1))
    np.testing.assert_array_equal(patch.where(lambda x: x[0] > 0.5), patch.side("u1"))
    np.testing.assert_array_equal(patch.where(lambda x: x[0] + x[1] < -1.5), [0])
    with pytest.raises(ValueError, match=r"selects no control point"):
        patch.where(lambda x: x[2] > 0.0)
    with pytest.raises(ValueError, match=r"predicate returned bool of shape \(3,\): bool of shape \(9,\) required"):
        patch.where(lambda x: x.max(axis=1) > 0.0)
    with pytest.raises(ValueError, match=r"predicate returned float64"):
        patch.where(lambda x: x[0])


# -- the same geometry, described otherwise ---------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("rational", [False, True])
def test_richer_bases_leave_the_geometry(kind, rational):
    patch = KINDS[kind](rational=rational)
    xi = grid(patch, 7)
    x = patch.evaluate(xi)
    for other in (patch.refined(3), patch.with_degree(4), patch.with_degree(4).refined(2), patch.refined(1)):
        np.testing.assert_allclose(other.evaluate(xi), x, rtol=0, atol=3e-14)
        assert other.rational == rational
        assert [basis.periodic for basis in other.bases] == [basis.periodic for basis in patch.bases]
    assert patch.refined(3).n > patch.n


@pytest.mark.parametrize("kind", KINDS)
def test_refinement_and_elevation_change_what_they_say(kind):
    patch = KINDS[kind]()
    for direction, basis in enumerate(patch.bases):
        parts, degrees = [1] * patch.dim, [b.degree for b in patch.bases]
        parts[direction], degrees[direction] = 3, basis.degree + 2
        finer, higher = patch.refined(*parts), patch.with_degree(*degrees)
        for d, (old, fine, high) in enumerate(zip(patch.bases, finer.bases, higher.bases, strict=True)):
            if d != direction:
                np.testing.assert_array_equal(fine.knots, old.knots)
                np.testing.assert_array_equal(high.knots, old.knots)
        fine, high = finer.bases[direction], higher.bases[direction]
        np.testing.assert_allclose(np.diff(fine.breakpoints), np.repeat(np.diff(basis.breakpoints) / 3, 3), rtol=1e-13)
        np.testing.assert_array_equal(fine.multiplicities[::3], basis.multiplicities)
        assert (np.delete(fine.multiplicities, np.s_[::3]) == 1).all()
        assert high.degree == basis.degree + 2
        np.testing.assert_array_equal(high.multiplicities - high.degree, basis.multiplicities - basis.degree)


@pytest.mark.parametrize("kind", KINDS)
def test_reversed_and_swapped_leave_the_geometry(kind):
    patch = KINDS[kind]()
    xi = grid(patch, 7)
    x = patch.evaluate(xi)
    for direction in range(patch.dim):
        low, high = patch.basis.box[:, direction]
        backwards = xi.copy()
        backwards[:, direction] = low + high - xi[:, direction]
        turned = patch.reversed(direction)
        np.testing.assert_array_equal(turned.basis.box, patch.basis.box)
        np.testing.assert_allclose(turned.evaluate(backwards), x, rtol=0, atol=1e-14)
        assert np.abs(turned.evaluate(xi) - x).max() > 0.1
        np.testing.assert_array_equal(turned.reversed(direction).control, patch.control)
        for other in range(direction):
            exchanged = xi.copy()
            exchanged[:, [direction, other]] = xi[:, [other, direction]]
            swapped = patch.swapped(other, direction)
            np.testing.assert_allclose(swapped.evaluate(exchanged), x, rtol=0, atol=1e-14)


@pytest.mark.parametrize("dim", [1, 2, 3])
def test_named_sides_stay_in_place(dim):
    names = {f"side {name}": place for name, place in list(SIDES.items())[: 2 * dim]}
    patch = any_patch(dim, side_names=names)
    others = [patch.refined(2), patch.with_degree(3), *(patch.reversed(d) for d in range(dim))]
    if dim == 3:
        others += [patch.swapped(0, 2).reversed(1), patch.swapped(1, 2).swapped(0, 1)]
    if dim == 2:
        others += [patch.swapped().reversed(0)]
    for other in others:
        for name in names:
            here, there = side_points(patch, name), side_points(other, name)
            assert distances(here, there).max() < 1e-13
    assert distances(side_points(patch, "side u0"), side_points(patch, "side u1")).max() > 0.1


def test_bases_that_do_not_contain_the_present_one():
    patch = any_patch(1)  # degree 2 on -1, 0.5 (twice), 1, 2.3 (twice), 2.7
    basis = patch.bases[0]
    without = np.delete(basis.knots, np.flatnonzero(basis.knots == 0.5)[0])
    longer = np.where(basis.knots == 2.7, 3.0, basis.knots)
    closed = BSplineBasis(2, periodic_knots(2, basis.breakpoints, 0), True)
    lower = BSplineBasis(1, open_knots(1, basis.breakpoints))
    smooth = BSplineBasis(4, open_knots(4, basis.breakpoints))  # of a higher degree, but smoother than the geometry
    for other in (BSplineBasis(2, without), BSplineBasis(2, longer), closed, lower, smooth):
        with pytest.raises(ValueError, match=r"bases\[0\] has degree \d on .*: degree 2 on .* is not in it"):
            patch.on([other])
    with pytest.raises(ValueError, match=r"bases has 2 directions: 1 are required"):
        patch.on([basis, basis])
    np.testing.assert_allclose(patch.on([basis]).control, patch.control, rtol=0, atol=1e-14)


def test_breakpoints_that_differ_by_rounding_are_the_same():
    basis = BSplineBasis(2, open_knots(2, [0.0, 0.3, 1.0]))
    patch = Patch.from_points([basis], np.random.default_rng(0).uniform(size=(4, 2)))
    other = patch.on([BSplineBasis(2, open_knots(2, [0.0, np.nextafter(0.3, 1.0), 0.6, 1.0]))])
    xi = np.linspace(0, 1, 21)[:, None]
    np.testing.assert_allclose(other.evaluate(xi), patch.evaluate(xi), rtol=0, atol=1e-14)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda p: p.refined(), r"parts = \(\): one number, or one for each of the 2"),
        (lambda p: p.refined(2, 2, 2), r"parts = \(2, 2, 2\)"),
        (lambda p: p.refined(2, 0), r"parts = 0: an integer >= 1"),
        (lambda p: p.with_degree(), r"degrees = \(\): one, or one for each of the 2"),
        (lambda p: p.with_degree(4, 2), r"degrees = 2: an integer >= 3"),
        (lambda p: p.with_degree(3.5), r"degrees = 3.5"),
        (lambda p: p.reversed(2), r"direction = 2: one of 0, 1"),
        (lambda p: p.swapped(0, 2), r"second = 2: one of 0, 1"),
        (lambda p: p.swapped(-1, 0), r"first = -1: one of 0, 1"),
    ],
)
def test_bad_changes(change, message):
    with pytest.raises(ValueError, match=message):
        change(any_patch(2))


# -- splipy -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("rational", [False, True])
def test_there_and_back_through_splipy(kind, rational):
    patch = KINDS[kind](rational=rational)
    there = patch.to_splipy()
    assert [there.periodic(d) for d in range(patch.dim)] == [basis.periodic for basis in patch.bases]
    ticks = [np.linspace(low, high, 7) for low, high in patch.basis.box.T]
    np.testing.assert_allclose(there(*ticks).reshape(-1, 3), patch.evaluate(grid(patch, 7)), rtol=0, atol=1e-13)
    back = Patch.from_splipy(there, {"first": (0, 0)} if "u0" in patch.open_sides else None)
    np.testing.assert_allclose(back.control, patch.control, rtol=0, atol=1e-15)
    for old, new in zip(patch.bases, back.bases, strict=True):
        np.testing.assert_allclose(new.knots, old.knots, rtol=0, atol=1e-14)
    if patch.open_sides:
        assert back.locate_side("first") == (0, 0)


def test_shapes_made_by_splipy():
    from splipy import curve_factory, surface_factory, volume_factory

    circle = Patch.from_splipy(curve_factory.circle(2.0))
    assert (circle.dim, circle.nsd, circle.n, circle.bases[0].periodic) == (1, 2, 8, True)
    np.testing.assert_allclose(np.hypot(*circle.evaluate(grid(circle, 41)).T), 2.0, rtol=1e-14)
    for shape in (surface_factory.torus(1, 3), surface_factory.sphere(2), volume_factory.cylinder(1, 2), "square"):
        shape = surface_factory.disc(type="square") if shape == "square" else shape
        patch = Patch.from_splipy(shape)
        ticks = [np.linspace(low, high, 9) for low, high in patch.basis.box.T]
        expected = shape(*ticks).reshape(-1, patch.nsd)
        np.testing.assert_allclose(patch.evaluate(grid(patch, 9)), expected, rtol=0, atol=1e-14)


def test_splipy_with_another_continuity_at_its_start():
    from splipy import BSplineBasis as Knots
    from splipy import Curve

    knots = Knots(3, np.arange(-2, 6), periodic=0)  # one knot where continuity 0 is that of two
    curve = Curve(knots, np.random.default_rng(0).uniform(size=(4, 2)))
    with pytest.raises(ValueError, match=r"shape has .* in direction 0: 2 knots at both ends required"):
        Patch.from_splipy(curve)


def test_what_splipy_has_and_a_patch_has_not_is_refused():
    """A trimmed surface would become the whole one."""
    from splipy import BSplineBasis as Knots
    from splipy import Curve, TrimmedSurface

    corners = [(0.25, 0.25), (0.75, 0.25), (0.75, 0.75), (0.25, 0.75)]
    loop = [Curve(Knots(2), [a, b]) for a, b in zip(corners, corners[1:] + corners[:1], strict=True)]
    with pytest.raises(ValueError, match=r"^shape = TrimmedSurface: .* has to be cut into patches first$"):
        Patch.from_splipy(TrimmedSurface(Knots(2), Knots(2), loops=[loop]))
    for other in (None, "disc", surface()):
        with pytest.raises(ValueError, match=r"^shape = .*: a splipy Curve, Surface or Volume is required"):
            Patch.from_splipy(other)


# -- frozen -----------------------------------------------------------------------------------------------------------


def test_arrays_of_frozen_data_cannot_be_written_to():
    """A write to a copy would be lost without a word."""
    line = shapes.line((0, 0), (1, 0), elements=2, degree=2)
    spline = ExtractedSpline(line, MPI.COMM_SELF)
    both = glued(line, shapes.line((1, 0), (2, 0), elements=2, degree=2))
    quadrature, closest = NodalQuadrature.of(spline), closest_points(line, [[0.5, 0.1]])
    location = Location(np.array([0]), np.array([[0.2, 0.3, 0.5]]), np.array([True]))
    arrays = {
        "points": line.points, "weights": line.weights, "control": line.control, "knots": line.bases[0].knots,
        "of several": both.points, "their control": both.control, "numbering": both.numbering,
        "function numbers": both.functions.numbering, "immersed": quadrature.points, "areas": quadrature.weights,
        "rational": quadrature.rational, "closest": closest.xi, "distances": closest.distance,
        "cells": location.cells, "barycentric": location.barycentric, "active": location.active,
    }  # fmt: skip
    for name, array in arrays.items():
        assert not array.flags.writeable, name
    with pytest.raises(ValueError, match="read-only"):
        line.points[0] = 0.0
    assert spline.node_positions.flags.writeable
