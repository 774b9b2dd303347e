"""Several patches in one numbering: what gluing joins, what it refuses, and that it changes nothing else."""

import logging
import re
from itertools import pairwise, permutations, product

import numpy as np
import pytest
from mpi4py import MPI
from splines import energy, half_disc, poisson, quarter, radial, rectangle, turned

from tigar_x.geometry import shapes
from tigar_x.geometry.bspline import BSplineBasis, open_knots
from tigar_x.geometry.gluing import glued
from tigar_x.geometry.multipatch import MultiPatch, as_multipatch, disjoint
from tigar_x.geometry.patch import Patch
from tigar_x.splines.spline import ExtractedSpline


def weighted(patch, factor):
    return Patch.from_points(patch.bases, patch.points, factor * patch.weights)


def orientations(patch):
    """The same geometry by every order and sense of its parameters."""
    found = []
    for swaps in ((), ((0, 1),), ((0, 2),), ((1, 2),), ((0, 1), (1, 2)), ((0, 1), (0, 2))):
        if any(direction >= patch.dim for swap in swaps for direction in swap):
            continue
        turned_patch = patch
        for swap in swaps:
            turned_patch = turned_patch.swapped(*swap)
        for flips in product((False, True), repeat=patch.dim):
            result = turned_patch
            for direction in np.flatnonzero(flips):
                result = result.reversed(direction)
            found.append(result)
    return found


def moved(patch, scale=1.0, shift=0.0):
    return Patch.from_points(patch.bases, scale * (patch.points + shift), patch.weights)


def plain():
    """Two rectangles of different elements."""
    return rectangle((0, 1), (0, 1), (2, 2)), rectangle((1, 1.5), (0, 1), (1, 2))


def bent():
    """A rational quarter of an annulus between two squares, in a plane."""
    ring = quarter([(1.0, None), (2.0, None)]).with_degree(2).refined(1, 2)
    return rectangle((1, 2), (-1, 0)), ring, rectangle((-1, 0), (1, 2))


# -- what is glued ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("patches", "n"), [(plain(), 4 * 4 + 3 * 4 - 4), (bent(), 2 * 16 + 5 * 4 - 2 * 4)])
@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize("shift", [0.0, 1e4])
def test_size_and_place_of_the_model_do_not_matter(patches, n, scale, shift):
    assert glued(*(moved(patch, scale, shift) for patch in patches)).n == n
    apart = [moved(patch, scale, shift + 1e-5 * k) for k, patch in enumerate(patches)]
    assert glued(*apart).n == sum(patch.n for patch in patches)
    assert glued(*apart, tolerance=1e-4).n == n


def test_every_orientation_of_a_face_and_of_an_edge():
    box = shapes.box(lengths=(1, 1, 1), elements=(1, 2, 1), degrees=(2, 1, 3))
    beside = shapes.box(lengths=(1, 1, 1), origin=(1, 0, 0), elements=(1, 2, 1), degrees=(1, 1, 3))
    for other in orientations(beside):
        assert glued(box, other).n == box.n + beside.n - 3 * 4
    assert len(orientations(beside)) == 48
    diagonal = shapes.box(lengths=(1, 1, 1), origin=(1, 1, 0), elements=(1, 1, 1), degrees=(2, 2, 3))
    for other in orientations(diagonal)[::7]:
        assert glued(box, other).n == box.n + diagonal.n - 4


def test_numbers_follow_the_order_of_appearance():
    left, right = plain()
    both = glued(left, right)
    np.testing.assert_array_equal(both.functions.numbering[: left.n], np.arange(left.n))
    np.testing.assert_array_equal(both.side("u1", patch=0), both.side("u0", patch=1))
    np.testing.assert_array_equal(both.control[both.functions.numbering], np.concatenate([left.control, right.control]))
    np.testing.assert_array_equal(both.side("v0"), [*range(4), *range(16, 18)])
    np.testing.assert_array_equal(both.side_dofs("u0", components=[1], patch=0), 2 * left.side("u0") + 1)
    assert not both.rational
    assert disjoint(left, right).n == left.n + right.n


def test_a_corner_alone_is_glued():
    first, second = rectangle((0, 1), (0, 1)), rectangle((1, 2), (1, 3), (1, 3), (3, 1))
    assert glued(first, second).n == first.n + second.n - 1


def test_the_boundary():
    left, right = plain()
    assert glued(left, right).outer_sides == [(0, 0, 0), (0, 1, 0), (0, 1, 1), (1, 0, 1), (1, 1, 0), (1, 1, 1)]
    assert disjoint(left, right).outer_sides == disjoint(left, right).open_sides
    disc = turned(*radial(2, 2), quarters=4)
    assert as_multipatch(disc).outer_sides == [(0, 0, 0), (0, 0, 1), (0, 1, 1)]  # the pole has no length
    assert glued(disc, within=True).outer_sides == [(0, 1, 1)]
    assert glued(disc, within=True).collapsed(0, 1, 0)


def test_control_points_off_an_edge_are_not_glued_to_a_corner():
    """A control point that no edge passes through is no part of the geometry."""
    points = [[0, 0], [1, 0], [0, 1], [2, 1], [0, 2], [1, 2]]
    bulge = Patch.from_points(
        [BSplineBasis(1, open_knots(1, [0, 1])), BSplineBasis(2, open_knots(2, [0, 1]))], np.array(points, dtype=float)
    )
    beside = rectangle((2, 3), (1, 2), (1, 1))
    assert glued(bulge, beside).n == bulge.n + beside.n


# -- what is said of it -----------------------------------------------------------------------------------------------


def said(caplog, level):
    return [r.getMessage() for r in caplog.records if r.name == "tigar_x.geometry.joints" and r.levelno == level]


def test_what_is_joined_is_said(caplog):
    with caplog.at_level(logging.INFO):
        glued(*plain())
        glued(rectangle((0, 1), (0, 1)), rectangle((1, 2), (1, 3), (1, 3), (3, 1)))
    assert said(caplog, logging.INFO) == [
        "glued: 1 joints, 4 control points less: side u1 of patch 0 and side u0 of patch 1",
        "glued: 0 joints, 1 control points less",
    ]
    assert not said(caplog, logging.WARNING)


def rounded_rings(digits):
    """Quarters of two rings, one of which has coordinates of a file with few digits; two corners still meet."""
    inner, outer = (quarter([(r, None), (r + 1.0, None)]) for r in (1.0, 2.0))
    return inner, Patch.from_points(outer.bases, np.round(outer.points, digits), outer.weights)


def advised(text):
    return float(re.search(r"tolerance = (\S+) would do", text)[1])


def test_sides_that_come_near_but_not_near_enough_are_warned_of_with_a_tolerance_that_joins_them(caplog):
    for digits in (2, 4):
        inner, outer = rounded_rings(digits)
        caplog.clear()
        with caplog.at_level(logging.WARNING):
            assert glued(inner, outer).n == inner.n + outer.n - 2
        (near,) = said(caplog, logging.WARNING)
        assert "side v1 of patch 0 and side v0 of patch 1 come within" in near
        assert advised(near) < 10.0**-digits
        caplog.clear()
        with caplog.at_level(logging.WARNING):
            assert glued(inner, outer, tolerance=advised(near)).n == inner.n + outer.n - 5
        assert not said(caplog, logging.WARNING)


def test_where_they_touch_in_part_the_error_has_the_tolerance():
    inner, outer = rounded_rings(5)
    with pytest.raises(ValueError, match="touch but do not have the same functions") as caught:
        glued(inner, outer)
    assert glued(inner, outer, tolerance=advised(str(caught.value))).n == inner.n + outer.n - 5


def test_patches_of_which_none_are_joined_are_warned_of(caplog):
    with caplog.at_level(logging.WARNING):
        glued(rectangle((0, 1), (0, 1)), rectangle((1.03, 2), (0, 1)))
    (text,) = said(caplog, logging.WARNING)
    assert "nothing is joined: no control points of the 2 patches are within tolerance = 1e-08" in text


def test_near_ends_of_curves_are_warned_of(caplog):
    with caplog.at_level(logging.WARNING):
        glued(*path((0, 0), (1, 0), (1, 1)), shapes.line((1.003, 1), (2, 1), elements=2))
    (near,) = said(caplog, logging.WARNING)
    assert "side u1 of patch 1 and side u0 of patch 2 come within 0.003 of each other and are not joined" in near


@pytest.mark.parametrize(
    ("other", "message"),
    [
        (rectangle((1.001, 2), (0, 1), (2, 3)), "and do not have the same functions"),
        (rectangle((1.001, 2), (0.2, 0.8)), "and do not have the same functions"),
        (rectangle((1.001, 2), (0, 1), (2, 2)), "tolerance = 4.9e-04 would do"),
        (rectangle((1.03, 2), (0, 1)), None),
        (rectangle((1.03, 2), (0, 1), (2, 3)), None),
        (rectangle((1.001, 2), (1.1, 2.1)), None),
        (rectangle((1.001, 1.02), (0, 1)), None),  # as wide as 19 gaps: rather a sheet beside it
    ],
)
def test_what_counts_as_near(other, message, caplog):
    with caplog.at_level(logging.WARNING):
        glued(rectangle((0, 1), (0, 1)), other)
    near = [text for text in said(caplog, logging.WARNING) if "nothing is joined" not in text]
    assert len(near) == (message is not None)
    assert not near or message in near[0]


def test_control_points_too_dense_for_a_tolerance_are_said_to_be(caplog):
    with caplog.at_level(logging.WARNING):
        glued(rectangle((0, 1), (0, 1), (1, 80)), rectangle((1.009, 2), (0, 1), (1, 80)))
    assert "too dense for any tolerance" in said(caplog, logging.WARNING)[1]


# -- sides that stay open ---------------------------------------------------------------------------------------------


def bands(*slit):
    """Two rings of two patches each, the outer ones first; ``slit`` is kept open."""
    basis, r = radial(2, 1)
    halves = [turned(basis, start + r, quarters=2) for start in (2.0, 1.0)]
    rings = [Patch.from_points(p.bases, sign * p.points, p.weights) for p in halves for sign in (1.0, -1.0)]
    return glued(*rings, keep_open=slit)


def test_a_slit_between_patches_stays_open_to_its_tip():
    closed, inner, both = bands(), bands((2, "u0")), bands((0, "u0"), (2, "u0"))
    assert closed.n == 8 * 5
    assert inner.n == closed.n + 2  # the tip is joined
    assert both.n == closed.n + 5
    assert set(inner.outer_sides) - set(closed.outer_sides) == {(2, 0, 0), (3, 0, 1)}
    assert len(both.outer_sides) == len(closed.outer_sides) + 4
    assert bands((1, "u1"), (3, "u1")).n == both.n


@pytest.mark.mpi
def test_a_ring_with_a_slit_is_no_closed_one():
    opened = annulus(False)
    closed, slit = (glued(opened, within=True, keep_open=sides) for sides in ((), [(0, "u0")]))
    assert (slit.n, closed.n) == (opened.n, opened.n - 4)
    angle = np.linspace(0, 2 * np.pi, 30)
    points = 1.3 * np.stack([np.cos(angle), np.sin(angle)], axis=1)[1:-1]
    same_solution(*poisson(opened), *poisson(slit), points)
    assert abs(energy(*poisson(slit))[0] / energy(*poisson(closed))[0] - 1.0) > 1e-3


def test_a_disc_with_a_slit_and_rings_around_it():
    disc = turned(*radial(2, 2), quarters=4)
    assert glued(disc, within=True, keep_open=[(0, "u1")]).n == 9 * 3 + 1  # the pole is joined
    basis, r = radial(2, 2)
    pair = disc, turned(basis, 1.0 + r, quarters=4)
    assert glued(*pair, within=True).n == 8 * (3 + 3) + 1
    assert glued(*pair, within=True, keep_open=[(0, "u0"), (1, "u0")]).n == 9 * (3 + 3) + 1
    assert glued(*pair, within=True, keep_open=[(1, "u0")]).n == 8 * 3 + 1 + 9 * 3
    backwards = disc, pair[1].reversed(0)
    assert glued(*backwards, within=True, keep_open=[(0, "u0"), (1, "u1")]).n == 9 * (3 + 3) + 1


def test_crossing_curves_that_do_not_meet():
    lines = path((0, 0), (1, 0), (1, 1))
    assert glued(*lines, keep_open=[(1, "u0")]).n == 2 * 4


@pytest.mark.parametrize(
    ("keep_open", "message"),
    [
        ([(0, "u0")], r"keep_open\[0\] = \(0, 'u0'\): no other side is in that place, it would not be glued"),
        ([(1, "u0"), (1, "v0")], r"keep_open\[1\] = \(1, 'v0'\): no other side"),
        ([(2, "u0")], "patch = 2: one of 0, 1 is required"),
        ([(1, "w0")], "name = 'w0': one of"),
    ],
)
def test_sides_to_keep_open_that_are_not_glued_are_refused(keep_open, message):
    with pytest.raises(ValueError, match=message):
        glued(*plain(), keep_open=keep_open)


# -- what is refused --------------------------------------------------------------------------------------------------


def uneven(*knots):
    """The square right of the unit square, its knots along v given inside."""
    basis = BSplineBasis(2, np.concatenate([np.zeros(3), knots, np.ones(3)]))
    return rectangle((1, 2), (0, 1), (1, 1)).on([BSplineBasis(2, open_knots(2, [0, 1])), basis])


@pytest.mark.parametrize(
    "other",
    [
        rectangle((1, 2), (0, 0.5)),
        rectangle((1, 2), (0, 2), (2, 4)),
        rectangle((1, 2), (0.3, 0.7)),
        rectangle((1, 2), (-1, 5)),
        rectangle((1, 2), (0, 1), (2, 3)),
        rectangle((1, 2), (0, 1), (2, 2), (2, 3)),
        uneven(0.51),
        uneven(0.5, 0.5),
        Patch.from_points(uneven(0.5).bases, uneven(0.5).points, np.linspace(1.0, 1.1, uneven(0.5).n)),
    ],
    ids=["half", "double", "inside", "across", "elements", "degree", "knot", "multiplicity", "weights"],
)
def test_sides_that_touch_but_do_not_match_are_refused(other):
    square = rectangle((0, 1), (0, 1))
    for second in (other, other.swapped().reversed(1)):
        for pair in ((square, second), (second, square)):
            with pytest.raises(ValueError, match=r"side .. of patch 0 and side .. of patch 1 touch but"):
                glued(*pair)
    assert disjoint(square, other).n == square.n + other.n


def test_knots_are_compared_in_the_sense_of_the_edge():
    """Control points that coincide do not tell the sense of an edge; knots do."""
    u = BSplineBasis(1, open_knots(1, [0, 1]))
    v = BSplineBasis(2, np.array([0, 0, 0, 0.2, 0.5, 1, 1, 1]))
    ticks = np.array([0, 0.25, 0.5, 0.75, 1])

    def sheet(x, basis):
        grid = np.meshgrid(x, ticks, indexing="ij")
        return Patch.from_points([u, basis], np.column_stack([g.ravel(order="F") for g in grid]))

    mirrored = BSplineBasis(2, 1.0 - v.knots[::-1])
    assert glued(sheet((0, 1), v), sheet((1, 2), v)).n == 3 * 5
    assert glued(sheet((0, 1), v), sheet((1, 2), v).reversed(1)).n == 3 * 5
    for other in (sheet((1, 2), mirrored), sheet((1, 2), mirrored).reversed(1)):
        with pytest.raises(ValueError, match="touch but do not have the same functions"):
            glued(sheet((0, 1), v), other)


def test_sides_with_the_same_rational_functions_in_other_parameters_are_glued():
    """Weights in a geometric sequence change how fast a side is run along, and neither its shape nor its functions."""
    one, other = (shapes.parallelogram((k, 0), (1, 0), (0, 1), elements=(2, 1), degrees=(2, 2)) for k in (0, 1))
    other = Patch.from_points(other.bases, other.points, np.repeat(1.7 ** np.arange(3), 4))
    both = glued(one, other)
    assert both.n == 2 * 12 - 3
    v = np.linspace(0.0, 1.0, 6)
    x = other.evaluate(np.column_stack([0.0 * v, v]))
    assert np.abs(x[:, 1] - v).max() > 0.1
    s = ExtractedSpline(both, MPI.COMM_SELF)
    u = s.function(np.random.default_rng(0).normal(size=(both.n, 2)))
    ends = s.evaluate(u, np.column_stack([0.0 * v + 1.0, x[:, 1]])), s.evaluate(u, np.column_stack([0.0 * v, v]), 1)
    np.testing.assert_allclose(*ends, rtol=1e-12, atol=1e-13)


def test_faces_that_match_in_part_are_refused():
    box = shapes.box(lengths=(1, 1, 1), elements=(1, 1, 1), degrees=(1, 1, 1))
    with pytest.raises(ValueError, match="side u1 of patch 0 and side u0 of patch 1"):
        glued(box, shapes.box(lengths=(1, 1, 0.5), origin=(1, 0, 0), elements=(1, 1, 1), degrees=(1, 1, 1)))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: glued(), "patches is empty"),
        (lambda: disjoint(), "patches is empty"),
        (lambda: glued(rectangle((0, 1), (0, 1)), half_disc(), tolerance=0.0), r"tolerance = 0.0: a number > 0"),
        (lambda: glued(quarter(), half_disc()), r"patches have dim = \[1, 2\]: one and the same"),
        (lambda: disjoint(quarter(), turned(*radial(1, 1), z=[0, 0])), r"patches have dim = \[1, 2\]"),
        (lambda: disjoint(quarter(), shapes.line((0, 0, 0), (1, 0, 0), elements=1)), r"patches have nsd = \[2, 3\]"),
        (lambda: MultiPatch((quarter(),), np.arange(4)), r"numbering has shape \(4,\): 5 numbers from 0"),
        (lambda: MultiPatch((quarter(),), np.array([0, 1, 2, 3, 5])), "without gaps"),
        (lambda: disjoint(*plain()).side("u2"), r"name = 'u2': one of 'u0', 'u1', 'v0', 'v1' is required"),
        (lambda: disjoint(*plain()).side("u0", patch=2), r"patch = 2: one of 0, 1 is required"),
        (lambda: disjoint(*plain()).side("u0", 5), r"layers = 5: direction 0 has only 4 functions"),
        (lambda: disjoint(*plain()).side_dofs("u0", components=[2]), r"components = 2: one of 0, 1"),
    ],
)
def test_bad_arguments(make, message):
    with pytest.raises(ValueError, match=message):
        make()


# -- solutions do not depend on the description -----------------------------------------------------------------------


def same_solution(u, s, v, t, points, rtol=1e-10):
    np.testing.assert_allclose(energy(u, s), energy(v, t), rtol=rtol)
    values = s.evaluate_at(u, points)
    np.testing.assert_allclose(t.evaluate_at(v, points), values, rtol=0, atol=rtol * np.abs(values).max())


@pytest.mark.mpi
def test_any_order_and_orientation_of_two_patches():
    left, right = plain()
    points = np.random.default_rng(0).uniform((0, 0), (1.5, 1), (20, 2))
    reference = poisson(glued(left, right))
    for k, other in enumerate(orientations(right)):
        same_solution(*reference, *poisson(glued(*((left, other) if k % 2 else (other, left)))), points)
    alone = poisson(disjoint(left, right), fixed=glued(left, right).outer_sides)
    assert abs(energy(*alone)[0] / energy(*reference)[0] - 1.0) > 1e-3


@pytest.mark.mpi
def test_any_order_and_orientation_of_three_patches_with_weights():
    rng = np.random.default_rng(1)
    angle, r = rng.uniform(0, np.pi / 2, 10), rng.uniform(1, 2, 10)
    boxes = [rng.uniform(low, np.add(low, 1), (5, 2)) for low in ((1, -1), (-1, 1))]
    points = np.concatenate([np.stack([r * np.cos(angle), r * np.sin(angle)], axis=1), *boxes])
    reference = poisson(glued(*bent()))
    for order in permutations(range(3)):
        # a factor of all weights of a patch changes none of its functions
        patches = [weighted(orientations(bent()[k])[rng.integers(8)], rng.uniform(0.5, 2.0)) for k in order]
        same_solution(*reference, *poisson(glued(*patches)), points)


@pytest.mark.mpi
@pytest.mark.parametrize("degree", [2, 3])
def test_glued_halves_are_the_whole_with_a_knot_repeated(degree):
    knots = open_knots(degree, [0, 0.5, 1, 1.25, 1.5])
    whole = rectangle((0, 1.5), (0, 1), (1, 2), (degree, degree))
    v = whole.bases[1]
    whole = whole.on([BSplineBasis(degree, np.sort([*knots, *[1.0] * (degree - 1)]) / 1.5), v])
    halves = [rectangle(x, (0, 1), (2, 2), (degree, degree)) for x in ((0, 1), (1, 1.5))]
    points = np.random.default_rng(2).uniform((0, 0), (1.5, 1), (20, 2))
    assert glued(*halves).n == whole.n
    same_solution(*poisson(whole), *poisson(glued(*halves)), points, rtol=1e-11)
    smooth = poisson(rectangle((0, 1.5), (0, 1), (1, 2), (degree, degree)).on([BSplineBasis(degree, knots / 1.5), v]))
    assert abs(energy(*smooth)[0] / energy(*poisson(whole))[0] - 1.0) > 1e-6


def annulus(closed):
    basis, r = radial(2, 2)
    return turned(basis, 1.0 + r, quarters=4, closed=closed)


@pytest.mark.mpi
def test_a_ring_glued_to_itself_is_a_periodic_one():
    ring, opened = annulus(True), annulus(False)
    closed = glued(opened, within=True)
    assert closed.n == ring.n == opened.n - 4
    assert glued(opened).n == opened.n
    angle = np.linspace(0, 2 * np.pi, 30)
    points = 1.3 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    options = dict(load=lambda x: 1.0 + x[1])
    u, s = poisson(ring, **options)
    same_solution(u, s, *poisson(closed, **options), points)
    np.testing.assert_allclose(s.evaluate_at(u, points[:1]), s.evaluate_at(u, points[-1:]), rtol=1e-10)
    slit = poisson(opened, fixed=closed.outer_sides, **options)
    assert abs(energy(*slit)[0] / energy(u, s)[0] - 1.0) > 1e-3


@pytest.mark.mpi
def test_rings_are_glued_wherever_they_start():
    """Of two periodic patches one starts an eighth of a turn later and runs backwards."""
    inner = annulus(True)
    basis, r = radial(2, 2)
    outer = turned(basis, 2.0 + r, quarters=4, closed=True)
    half_turn = Patch.from_points(outer.bases, -outer.points, outer.weights)
    angle = np.linspace(0, 2 * np.pi, 20)
    points = np.concatenate([a * np.stack([np.cos(angle), np.sin(angle)], axis=1) for a in (1.5, 2.0, 2.5)])
    reference = poisson(glued(inner, outer))
    for other in (half_turn, half_turn.reversed(0), outer.reversed(0).swapped()):
        assert glued(inner, other).n == inner.n + outer.n - 8
        same_solution(*reference, *poisson(glued(other, inner)), points)


@pytest.mark.mpi
def test_a_pole_becomes_one_function():
    disc = turned(*radial(2, 2), quarters=4)
    whole = glued(disc, within=True)
    assert whole.n == 8 * 3 + 1
    halves = [turned(*radial(2, 2), quarters=2)]
    halves.append(Patch.from_points(halves[0].bases, -halves[0].points, halves[0].weights))
    both = glued(*halves, within=True)
    assert both.n == whole.n
    angle = np.linspace(0, 2 * np.pi, 10)
    points = np.concatenate([a * np.stack([np.cos(angle), np.sin(angle)], axis=1) for a in (0.0, 0.4, 0.9)])
    same_solution(*poisson(whole), *poisson(both), points, rtol=1e-9)


def path(*corners):
    return [shapes.line(a, b, elements=2, degree=2) for a, b in pairwise(corners)]


@pytest.mark.mpi
def test_curves():
    """-u'' = 1 along a path of three edges, with their arc length s: u = s (L - s)/2."""
    a, b, c = path((0, 0), (3, 4), (3, 5), (1, 5))
    for patches in ((a, b, c), (c, a.reversed(0), b), (b.reversed(0), c.reversed(0), a)):
        geometry = glued(*patches)
        assert geometry.n == 3 * 4 - 2
        u, s = poisson(geometry, load=lambda _: 1.0)
        found = s.evaluate_at(u, [[1.5, 2.0], [3, 4], [3, 4.5], [2, 5]])[:, 0]
        length = np.array([2.5, 5, 5.5, 7])
        np.testing.assert_allclose(found, length * (8 - length) / 2, rtol=1e-11)
    assert glued(*path((0, 0), (1, 0), (0, 1), (0, 0))).n == 3 * 4 - 3
    assert not glued(*path((0, 0), (1, 0), (0, 1), (0, 0))).outer_sides
    branches = [shapes.line((0, 0), end, elements=1, degree=2) for end in ((1, 0), (-1, 1), (0, -2))]
    assert glued(*branches).n == 3 * 3 - 2


@pytest.mark.mpi
def test_volumes():
    """-div grad u = 1 between two walls at a distance of 3: u = x (3 - x)/2."""
    boxes = [
        shapes.box(lengths=(length, 1, 1), origin=(x, 0, 0), elements=(1, 2, 1), degrees=(2, 2, 2))
        for x, length in ((0, 1), (1, 2))
    ]
    for other in (boxes[1], boxes[1].swapped(0, 2).reversed(1)):
        geometry = glued(other, boxes[0])
        ends = [
            side for side in geometry.outer_sides if np.ptp(geometry.points[geometry.side_functions(*side), 0]) == 0.0
        ]
        assert len(ends) == 2
        u, s = poisson(geometry, load=lambda _: 1.0, fixed=ends)
        points = np.random.default_rng(0).uniform((0, 0, 0), (3, 1, 1), (20, 3))
        x = points[:, 0]
        np.testing.assert_allclose(s.evaluate_at(u, points)[:, 0], x * (3 - x) / 2, atol=1e-10)


@pytest.mark.mpi
def test_patches_that_are_apart_are_two_problems():
    """Different degrees, weights and places: every patch has the solution that it has alone."""
    square, disc = rectangle((0, 1), (0, 2), (2, 3), (3, 2)), annulus(False)
    u, s = poisson(disjoint(square, disc), quadrature_degree=8)
    for k, patch in enumerate((square, disc)):
        v, alone = poisson(patch, quadrature_degree=8)
        xi = patch.basis.greville
        np.testing.assert_allclose(s.evaluate(u, xi, k), alone.evaluate(v, xi), rtol=0, atol=1e-11)
