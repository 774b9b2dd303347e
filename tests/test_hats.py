"""Functions of a multiplier on surfaces: they go on across joints, are one at poles, and follow symmetries."""

import tracemalloc

import numpy as np
import pytest
import scipy.sparse as sp
from mpi4py import MPI
from test_sheets import TURNS, quarter

from coudalfish.step.functions import Functions, nearest_coefficients
from coudalfish.surface.grids import Grids
from coudalfish.surface.hats import SMALL, hat_functions
from coudalfish.surface.sheets import Sheets
from tigar_x.geometry import shapes, surfaces
from tigar_x.geometry.gluing import glued
from tigar_x.geometry.multipatch import disjoint
from tigar_x.geometry.patch import Patch
from tigar_x.splines.spline import ExtractedSpline

RNG = np.random.default_rng(7)


class On:
    """Functions on a geometry, or on the spline that is made of it."""

    def __init__(self, geometry, size):
        spline = geometry if isinstance(geometry, ExtractedSpline) else ExtractedSpline(geometry, MPI.COMM_SELF)
        self.sheets, self.area = Sheets.of(spline), spline.node_areas
        N = hat_functions(spline, self.sheets, self.area, size)
        self.N, self.X, self.count = N.toarray(), self.sheets.X, N.shape[1]
        self.sizes = np.abs(self.N)
        assert N.nnz <= 4 * len(self.X)
        np.testing.assert_allclose(self.N.sum(axis=1), self.sheets.sign, atol=1e-12)
        if spline.dim == 2:
            assert (self.sizes.T @ self.area).min() >= (1.0 - 1e-8) * SMALL * size**2

    def gap(self):
        """The largest difference of a function at two points of a joint."""
        a, b = self.sheets.joints.T
        return np.abs(self.sheets.sign[a, None] * self.N[a] - self.sheets.sign[b, None] * self.N[b]).max()


def same_functions(N, M, atol=1e-12):
    """Whether the columns are the same but for their order."""
    assert N.shape == M.shape
    distance = np.abs(N[:, :, None] - M[:, None, :]).max(axis=0)
    assert sorted(distance.argmin(axis=1)) == list(range(N.shape[1]))
    assert distance.min(axis=1).max() < atol


def order(X, digits=9):
    """Points sorted by their places."""
    return np.lexsort(np.round(X, digits).T)


def turned(patch, angle):
    """A patch about the third axis."""
    return Patch.from_points(patch.bases, turned_points(patch.points, angle), patch.weights)


def turned_points(X, angle):
    """Points about the third axis."""
    c, s = np.cos(angle), np.sin(angle)
    return X @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])


# -- joints -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", TURNS)
def test_functions_on_joined_patches_do_not_depend_on_how_these_are_parametrised(name):
    """Four parts of a bent square, of which two are turned."""
    turn = TURNS[name]
    plain = On(glued(*(quarter(i, j) for i in (0, 1) for j in (0, 1))), 0.24)
    other = On(glued(quarter(0, 0), turn(quarter(0, 1)), quarter(1, 0), turn(quarter(1, 1))), 0.24)
    assert plain.count == 25
    assert other.gap() < 1e-12
    at, same = order(plain.X), order(other.X)
    np.testing.assert_allclose(plain.X[at], other.X[same], atol=1e-9)
    same_functions(plain.sizes[at], other.sizes[same])


def test_patches_of_different_lengths_have_the_same_lines_at_their_joint():
    """Where one has a mean length of 1 and the other of 2: six cells of a quarter, not four and eight."""
    bases = shapes.parallelogram((0, 0, 0), (1, 0, 0), (0, 1, 0), elements=(8, 8), degrees=(1, 1)).bases
    t = np.linspace(0.0, 1.0, 9)
    low = np.array([[x, y, 0.0] for y in t for x in t])
    high = np.array([[x * (1.0 + 2.0 * y), 1.0 + y, 0.0] for y in t for x in t])
    both = On(glued(Patch.from_points(bases, low), Patch.from_points(bases, high).swapped()), 0.25)
    assert both.gap() < 1e-12
    assert (both.sheets.sign < 0.0).any()
    assert on_joint(both) == 6 + 1
    alone = [on_joint(On(Patch.from_points(bases, X), 0.25)) for X in (low, high)]
    assert alone == [4 + 1, 8 + 1]


def on_joint(on):
    """How many functions there are at the height 1."""
    return np.count_nonzero(on.sizes[np.abs(on.X[:, 1] - 1.0) < 1e-9].max(axis=0) > 1e-12)


def plates(*azimuths):
    """Plates that meet on the third axis."""
    return [
        shapes.parallelogram((0, 0, 0), (np.cos(a), np.sin(a), 0), (0, 0, 1), elements=(4, 4), degrees=(1, 1))
        for a in azimuths
    ]


def test_where_three_sheets_meet_forces_on_them_have_nothing_to_do_with_each_other():
    """But the corner of a box, where every edge has two sides, is one point."""
    assert On(glued(*plates(0.0, 2.0)), 0.25).count == 2 * 25 - 5
    assert On(glued(*plates(0.0, 2.0, 4.0)), 0.25).count == 3 * 25
    x, y, z = np.eye(3)
    box = [shapes.parallelogram((0, 0, 0), a, b, elements=(4, 4), degrees=(1, 1)) for a, b in ((x, y), (z, y), (x, z))]
    corner = On(glued(*box), 0.25)
    assert corner.count == 3 * 25 - 3 * 5 + 1
    assert corner.gap() < 1e-12


def test_a_ribbon_of_one_side_has_a_seam():
    """Nothing has normals that agree there; everywhere else it does."""
    u = np.linspace(0.0, 2.0 * np.pi, 25)
    points = np.array(
        [
            [(1.0 + v * np.cos(t / 2.0)) * np.cos(t), (1.0 + v * np.cos(t / 2.0)) * np.sin(t), v * np.sin(t / 2.0)]
            for v in np.linspace(-0.2, 0.2, 5)
            for t in u
        ]
    )
    bases = shapes.parallelogram((0, 0, 0), (1, 0, 0), (0, 1, 0), elements=(24, 4), degrees=(1, 1)).bases
    ribbon = On(glued(Patch.from_points(bases, points), within=True), 0.4)
    assert len(ribbon.sheets.joints) == 5
    assert ribbon.gap() > 0.5
    assert ribbon.count == 2 * (16 + 1)


# -- closed surfaces and poles ----------------------------------------------------------------------------------------


def test_functions_on_a_closed_cylinder_go_round():
    """All of a ring are alike."""
    tube = surfaces.cylinder_panel(radius=1.0, length=2.0, angle=2.0 * np.pi, elements=(8, 24), degrees=(2, 2))
    on = On(tube, 0.4)
    assert on.count == 6 * 16
    assert on.gap() < 1e-12
    ends = np.abs(on.N[np.isin(on.X[:, 0].round(9), (0.0, 2.0))]).max(axis=0) > 0.5
    assert ends.sum() == 2 * 16
    area = np.sort(on.N.T @ on.area)
    np.testing.assert_allclose(area[:32], np.pi * 0.4 / 16, rtol=0.1)  # of hats between points of a coarse shell
    np.testing.assert_allclose(area[32:], np.pi * 0.8 / 16, rtol=0.1)


def sphere(elements=(6, 16)):
    cap = surfaces.sphere_cap(radius=1.0, angle=np.pi / 2.0, elements=elements, degrees=(2, 2))
    other = Patch.from_points(cap.bases, cap.points * [1.0, 1.0, -1.0], cap.weights)
    return glued(cap, other)


@pytest.mark.parametrize("size", [0.3, 0.4, 0.6])
def test_functions_on_a_sphere_have_one_at_every_pole_and_go_on_at_the_equator(size):
    on = On(sphere(), size)
    assert on.gap() < 1e-12
    assert set(on.sheets.sign) == {1.0, -1.0}
    for end in (-1.0, 1.0):
        pole = on.sizes[np.abs(on.X[:, 2] - end) < 1e-9]
        assert (pole > 0.0).any(axis=0).sum() == 1
        np.testing.assert_allclose(pole.max(axis=1), 1.0)
    at, same = order(on.X), order(on.X * [1.0, 1.0, -1.0])
    same_functions(on.sizes[at], on.sizes[same])


def test_parts_of_a_disc_that_meet_at_its_centre_have_one_function_there():
    """Quarters with a side that is a pole each, joined along their radii."""
    quarters = [
        surfaces.annulus(inner=1e-13, outer=1.0, angle=np.pi / 2.0, elements=(6, 5), degrees=(2, 2)) for _ in range(4)
    ]
    on = On(glued(*(turned(p, k * np.pi / 2.0) for k, p in enumerate(quarters))), 0.2)
    assert on.gap() < 1e-12
    centre = on.sizes[np.linalg.norm(on.X, axis=1) < 1e-9]
    assert (centre > 0.0).any(axis=0).sum() == 1
    at, same = order(on.X), order(turned_points(on.X, np.pi / 2.0))
    same_functions(on.sizes[at], on.sizes[same])


# -- leaflets ---------------------------------------------------------------------------------------------------------


def valve(elements, **more):
    return surfaces.trileaflet(elements=elements, degrees=(3, 3), **more)


@pytest.mark.parametrize(("cells", "factor"), [(10, 2.0), (13, 2.0), (13, 3.0), (16, 2.0), (16, 2.5), (20, 3.0)])
def test_leaflets_of_a_valve_have_functions_that_are_turned_images_and_mirrored_within_each(cells, factor):
    h = 2.2 / cells
    along = round(1.8 / h)
    on = On(disjoint(*valve((along, round(0.8 * along)))), factor * h)
    n, m = len(on.X) // 3, on.count // 3
    blocks = on.N.reshape(3, n, 3, m)
    for k in range(3):
        np.testing.assert_allclose(blocks[k, :, k], blocks[0, :, 0], atol=1e-12)
        assert not blocks[k, :, np.arange(3) != k].any()
    first = on.X[:n]
    radial, across = np.array([0.5, np.sqrt(0.75)]), np.array([-np.sqrt(0.75), 0.5])
    own = np.column_stack([first[:, :2] @ radial, first[:, :2] @ across, first[:, 2]])
    at, same = order(own), order(own * [1.0, -1.0, 1.0])
    same_functions(blocks[0, at, 0], blocks[0, same, 0])


def cusp(parts=6):
    """A third of a tent over a triangle with rounded sides, joined to its neighbours along its posts."""
    bases = shapes.parallelogram((0, 0, 0), (1, 0, 0), (0, 1, 0), elements=(parts, parts), degrees=(1, 1)).bases
    t = np.linspace(0.0, 1.0, parts + 1)
    angle = np.pi / 3.0 * (2.0 * t - 1.0)
    rows = [
        np.column_stack([r * np.cos(angle), r * np.sin(angle), 0.5 * r * np.sin(1.5 * angle) ** 2 * (1.0 - r)])
        for r in 0.3 + 0.7 * t
    ]
    return Patch.from_points(bases, np.concatenate(rows))


@pytest.mark.parametrize("reverse", [False, True])
def test_leaflets_that_are_joined_at_commissures_or_to_a_ring_are_one_sheet(reverse):
    """Whose functions are turned images of themselves, whichever way one of the leaflets is parametrised."""
    third = 2.0 * np.pi / 3.0
    angle = np.pi / 3.0 * (2.0 * np.linspace(0.0, 1.0, 7) - 1.0)
    rows = [np.column_stack([np.cos(angle), np.sin(angle), z + 0 * angle]) for z in (0.0, 0.2, 0.4)]
    bases = shapes.parallelogram((0, 0, 0), (1, 0, 0), (0, 1, 0), elements=(6, 2), degrees=(1, 1)).bases
    leaflets = [turned(cusp(), k * third) for k in range(3)]
    ring = [turned(Patch.from_points(bases, np.concatenate(rows)), k * third) for k in range(3)]
    if reverse:
        leaflets[1], ring[2] = leaflets[1].reversed(0), ring[2].swapped()
    for patches in (leaflets, leaflets + ring):
        spline = ExtractedSpline(glued(*patches), MPI.COMM_SELF)
        for size in (0.21, 0.3, 0.45):
            on = On(spline, size)
            assert on.gap() < 1e-12
            at = order(on.X, 7)
            same = order(turned_points(on.X, third), 7)
            np.testing.assert_allclose(on.X[at], turned_points(on.X, third)[same], atol=1e-6)
            same_functions(on.sizes[at], on.sizes[same])


# -- small functions and coefficients ---------------------------------------------------------------------------------


def test_a_function_that_overlaps_two_alike_is_merged_with_both():
    """A kite with two poles, symmetric about its axis: so are its functions."""
    bases = shapes.parallelogram((0, 0, 0), (1, 0, 0), (0, 1, 0), elements=(16, 16), degrees=(1, 1)).bases
    t = np.linspace(-1.0, 1.0, 17)
    for width in (0.2, 0.5, 0.8):
        kite = Patch.from_points(bases, np.array([[x * width * (1.0 - abs(y)), y, 0.0] for y in t for x in t]))
        on = On(kite, 0.25)
        at, same = order(on.X), order(on.X * [-1.0, 1.0, 1.0])
        same_functions(on.sizes[at], on.sizes[same])


def test_coefficients_of_functions_that_depend_on_each_other_are_found():
    """Finer than the points: what has no value at any of them, or is a sum of others there."""
    N = sp.csr_matrix(np.array([[1.0, 0, 0, 0], [0, 0.5, 0.5, 0], [0, 0.5, 0.5, 0], [0.3, 0.7, 0, 0]]))
    W, lam = RNG.uniform(0.5, 2.0, 4), RNG.normal(size=(4, 3))
    fit = nearest_coefficients(N, W)
    root = np.sqrt(W)[:, None]
    expected = np.linalg.lstsq(root * N.toarray(), root * lam, rcond=None)[0]
    np.testing.assert_allclose(N @ (fit @ lam), N @ expected, atol=1e-12)
    np.testing.assert_allclose(fit @ lam, expected, atol=1e-6)
    np.testing.assert_array_equal(fit @ lam[:, 0], (fit @ lam)[:, 0])


def test_vectors_of_functions_whose_normals_cancel_are_numbers():
    """As those of a closed surface that one function covers."""
    patch = shapes.parallelogram((0, 0, 0), (1, 0, 0), (0, 1, 0), elements=(2, 2), degrees=(1, 1))
    spline = ExtractedSpline(patch, MPI.COMM_SELF)
    sheets = Sheets.of(spline)
    functions = Functions(spline, sheets, spline.node_areas, 0.5, vector=True)
    n = np.zeros_like(sheets.X)
    values = functions.values(np.ones(functions.count), n, own_normals=True)
    np.testing.assert_allclose(np.linalg.norm(values, axis=1), np.sqrt(2.0))


def test_many_functions_at_many_points_are_cheap():
    """Nothing is points times functions: that were 460 MB here."""
    n = 121
    number = np.arange(n * n).reshape(n, n)
    cells = np.stack([number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]], axis=-1).reshape(-1, 4)
    t = np.linspace(0.0, 1.0, n)
    X = np.stack([*np.meshgrid(t, t, indexing="ij"), np.zeros((n, n))], axis=-1).reshape(-1, 3)
    sheets = Sheets(cells.astype(np.int32), np.empty((0, 2), dtype=np.int32), X, np.ones_like(X))
    tracemalloc.start()
    grids = Grids([number.astype(np.int32)], sheets, 1.0 / 62.0)
    N = grids.functions()
    fit = nearest_coefficients(N, np.full(n * n, 1.0 / n**2))
    fitted = N @ (fit @ X)
    largest = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert N.shape == (n * n, 63**2)
    np.testing.assert_allclose(fitted, X, atol=1e-12)
    assert largest < 40e6
