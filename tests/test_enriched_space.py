"""Nodes of tetrahedra that surfaces enrich: closed surfaces, plates with edges, gaps, several sheets."""

from functools import partial

import numpy as np
import pytest
from mpi4py import MPI
from dolfinx import mesh
from test_nearest_surfaces import cube, grid, surfaces

from coudalfish.surface import enriched
from coudalfish.surface.enriched import Enriching
from coudalfish.surface.films import Films
from coudalfish.surface.surfaces import Surfaces
from tigar_x import compat

COMM = MPI.COMM_WORLD


def enriching(n=5, comm=COMM, kinked=True):
    return Enriching(compat.lagrange_space(mesh.create_unit_cube(comm, n, n, n), 1), kinked=kinked)


def graded(n=7, comm=COMM):
    """Cells ten times as high at the top as at the bottom."""
    domain = mesh.create_unit_cube(comm, n, n, n)
    z = domain.geometry.x[:, 2]
    z[:] = (np.exp(2.3 * z) - 1.0) / (np.exp(2.3) - 1.0)
    return Enriching(compat.lagrange_space(domain, 1), kinked=True)


def by_the_largest(e):
    """The same with the size of the largest cell of the mesh everywhere."""
    for name in ("sizes", "_of_nodes", "_of_neighbours"):
        values = getattr(e, name)
        values[:] = COMM.allreduce(float(values.max(initial=0.0)), op=MPI.MAX)
    return e


def ball(radius=0.31, center=(0.51, 0.49, 0.52)):
    """A cube blown up to a sphere."""
    boxed = cube(6)
    x = boxed.x - 0.5
    return Surfaces(np.array(center) + radius * x / np.linalg.norm(x, axis=1)[:, None], boxed.net)


def plate(z, low=-0.3, high=1.3, turned=False):
    return grid(5, lambda u, v: np.column_stack([low + (high - low) * u, 1.6 * v - 0.3, z + 0.0 * u]), turned=turned)


@pytest.mark.mpi
def test_a_closed_surface_has_its_volume_and_every_node_is_enriched():
    e = enriching(8)
    found = e(ball())
    owned = found.cut.cells < e.owned
    volumes = np.abs(np.linalg.det(e.corners[:, 1:] - e.corners[:, :1])) / 6.0
    inside = (volumes[found.cut.cells] * found.cut.negative_share)[owned].sum()
    uncut = np.setdiff1d(np.arange(e.owned), found.cut.cells)
    middle = np.linalg.norm(e.corners[uncut].mean(axis=1) - [0.51, 0.49, 0.52], axis=1)
    inside = COMM.allreduce(float(volumes[uncut][middle > 0.31].sum()) + float(inside))  # normals point inwards
    assert inside == pytest.approx(1.0 - 4.0 / 3.0 * np.pi * 0.31**3, rel=0.02)
    nodes = e.vertices[found.cut.cells]
    assert found.jump[nodes].all()
    assert found.kink[nodes].all()
    assert not enriching(4, kinked=False)(ball()).kink.any()


@pytest.mark.mpi
def test_all_partitions_enrich_the_same_nodes():
    for surface in (ball(), surfaces(plate(0.433, low=0.21))):
        masks = []
        for comm in (COMM, MPI.COMM_SELF):
            e = enriching(5, comm)
            found = e(surface)
            index = np.round(e.x * 5).astype(int) @ [36, 6, 1]
            both = np.zeros((2, 216))
            both[:, index] = found.jump, found.kink
            masks.append(comm.allreduce(both, op=MPI.SUM) > 0)
        np.testing.assert_array_equal(*masks)


@pytest.mark.parametrize(("gap", "closed"), [(0.0, True), (0.3, True), (3.0, False)])
def test_small_gaps_between_free_edges_are_closed_and_wide_ones_open(gap, closed):
    h = 1.0 / 6.0
    whole = enriching(6)(surfaces(plate(0.433)))
    parts = surfaces(plate(0.433, high=0.5 - 0.5 * gap * h), plate(0.433, low=0.5 + 0.5 * gap * h))
    found = enriching(6)(parts)
    assert np.array_equal(found.kink, whole.kink) == closed
    assert np.array_equal(found.jump, whole.jump) == closed
    assert not (found.kink & ~whole.kink).any()


def dome(low=-0.2, high=0.57):
    """Bent, with free edges, and farther above in larger cells."""
    return grid(
        9, lambda u, v: np.column_stack([low + (high - low) * u, 1.4 * v - 0.2, 0.05 + 0.6 * u**2 + 0.2 * v * (1 - v)])
    )


PLACED = {
    "ball": ball,
    "plate": lambda: surfaces(plate(0.433, low=0.21)),
    "dome": lambda: surfaces(dome()),
    "gap": lambda: surfaces(dome(), dome(1.3, 0.62)),
    "two": lambda: surfaces(dome(), plate(0.71, high=0.7, turned=True)),
}


@pytest.mark.mpi
@pytest.mark.parametrize("make", [enriching, graded])
@pytest.mark.parametrize("name", PLACED)
def test_sizes_of_cells_nearby_are_enough(name, make):
    """The same nodes are enriched as with sides that are known in sizes of the largest cell of the mesh."""
    e, surface = make(7), PLACED[name]()
    few = e(surface)
    whole = by_the_largest(e)(surface)
    for mask in ("jump", "kink"):
        np.testing.assert_array_equal(getattr(few, mask), getattr(whole, mask))
    np.testing.assert_array_equal(few.cut.cells, whole.cut.cells)
    np.testing.assert_array_equal(few.zero.barycentric, whole.zero.barycentric)
    known = (np.isfinite(found.phi).sum() for found in (few, whole))
    few, whole = (COMM.allreduce(int(number)) for number in known)
    assert few == whole if make is enriching else few < whole


@pytest.mark.parametrize("seed", range(4))
def test_sides_are_known_far_enough_behind_free_edges(seed, monkeypatch):
    """Plates that lie anywhere enrich the same nodes if sides are known farther from them."""
    rng, masks = np.random.default_rng(seed), []
    parts = []
    for _ in range(2):
        frame, center = np.linalg.qr(rng.standard_normal((3, 3)))[0], rng.uniform(0.35, 0.65, 3)
        parts.append(grid(6, lambda u, v, f=frame, c=center: c + 0.5 * np.column_stack([u - 0.5, v - 0.5]) @ f[:2]))
    for near, reach in ((enriched.NEAR, enriched.REACH), (2.5, 6.0)):
        monkeypatch.setattr(enriched, "NEAR", near)
        monkeypatch.setattr(enriched, "REACH", reach)
        e = enriching(9, MPI.COMM_SELF)
        masks.append([np.array([found.jump, found.kink]) for found in (e(surfaces(part)) for part in parts)])
    assert np.count_nonzero(masks[0]) > 100
    np.testing.assert_array_equal(*masks)


def test_nothing_is_divided_beyond_a_free_edge():
    e = enriching(8)
    found = e(surfaces(plate(0.433, low=0.61)))
    x = e.x[found.jump | found.kink, 0]
    assert x.min() > 0.61 - 2.0 / 8.0
    assert len(x) > 20
    covered = found.zero.sizes().sum()
    assert covered == pytest.approx(0.39, rel=1e-12)


@pytest.mark.parametrize("sheets", [1, 2])
def test_of_several_sheets_pressures_do_not_jump_where_they_cut_off_nothing_but_a_tip(sheets):
    """What would be unknown there has grown to 1e6 times the pressure between closed leaflets."""
    n, least = 6, {1: 1e-8, 2: 1e-5}[sheets]

    def oblique(height):
        def place(u, v):
            x, y = 1.6 * u - 0.3, 1.6 * v - 0.3
            return np.column_stack([x, y, height + 0.01 / n - 0.31 * (x - 0.5) + 0.17 * (y - 0.5)])

        return grid(5, place)

    e = enriching(n, kinked=False)
    found = e(surfaces(*[oblique(height) for height in (0.5, 1.4)[:sheets]]))
    cells, negative = found.cut.cells, found.cut.negative_share[:, None]
    volumes = np.abs(np.linalg.det(e.corners[:, 1:] - e.corners[:, :1]))
    nodes, share = e.vertices[cells], np.where(found.phi[e.vertices[cells]] < 0.0, 1.0 - negative, negative)
    other = np.bincount(nodes.ravel(), (volumes[cells, None] * share).ravel(), len(e.x))
    part = other / np.bincount(e.vertices.ravel(), np.repeat(volumes, 4), len(e.x))
    assert ((part > 1e-8) & (part < 1e-5)).sum() > 1
    np.testing.assert_array_equal(found.jump, (part > least) & (part < 1.0 - least))


@pytest.mark.parametrize("turned", [False, True])
def test_nothing_is_cut_half_way_between_two_plates(turned):
    """And which way they are parametrised does not matter."""
    e, z = enriching(8), (0.29, 0.62)
    found = e(surfaces(plate(z[0]), plate(z[1], turned=turned)))
    cells = np.unique(np.concatenate([e(surfaces(plate(height))).cut.cells for height in z]))
    np.testing.assert_array_equal(found.cut.cells, cells)


def test_two_plates_in_one_cell_divide_it_as_one():
    e = enriching(6)
    one, pair = e(surfaces(plate(0.42))), e(surfaces(plate(0.42), plate(0.45, turned=True)))
    np.testing.assert_array_equal(pair.kink, one.kink)
    near = np.isfinite(one.phi) & np.isfinite(pair.phi)
    np.testing.assert_array_equal(np.sign(pair.phi[near]), np.sign(one.phi[near]))


def leaflet(gap, *, mirrored=False, height=0.66):
    """From a wall to the middle plane, and up along it: normals of one point up and of the mirrored one down."""
    z = np.array([0.31, 0.36, 0.36 + 0.5 * (height - 0.36), height])
    x = np.array([-0.1, 0.5 - 0.5 * gap, 0.5 - 0.5 * gap, 0.5 - 0.5 * gap])

    def place(u, v):
        across, up = (np.interp(3.0 * u, np.arange(4), values) for values in (x, z))
        return np.column_stack([1.0 - across if mirrored else across, 1.6 * v - 0.3, up])

    return grid(6, place)


@pytest.mark.mpi
@pytest.mark.parametrize("gap", [0.02, 0.06])
def test_both_outer_sides_of_sheets_that_touch_with_free_edges_are_one_side(gap):
    """Edges of the mesh that lead over both free edges cross both continuations, and say nothing about the normals."""
    e, two = enriching(7, kinked=False), surfaces(leaflet(gap), leaflet(gap, mirrored=True))
    phi = e(two, films=partial(Films, COMM, two, np.zeros_like(two.x))).phi
    x, _, z = e.x.T
    above, below = np.isfinite(phi) & (z > 0.45) & (abs(x - 0.5) > 0.5 * gap), np.isfinite(phi) & (z < 0.3)
    assert len(set(COMM.allreduce(list(phi[above] < 0.0)))) == 1
    assert len(set(COMM.allreduce(list(phi[below] < 0.0)))) == 1
    assert set(COMM.allreduce(list(phi[above] < 0.0))) != set(COMM.allreduce(list(phi[below] < 0.0)))


def test_three_plates_in_a_star_divide_their_own_cells_alone():
    """Not all of their normals can agree: the side changes half way between two of them as well."""
    parts = []
    for angle in np.deg2rad([30.0, 100.0, 270.0]):
        along = np.array([np.cos(angle), np.sin(angle)])

        def leaf(u, v, along=along):
            return np.column_stack([0.51 + np.outer(0.06 + 0.8 * u, along), 1.4 * v - 0.2])

        parts.append(grid(6, leaf))
    e = enriching(8)
    cut = e(surfaces(*parts)).cut.cells
    alone = np.unique(np.concatenate([e(surfaces(part)).cut.cells for part in parts]))
    outer = np.linalg.norm(e.corners.mean(axis=1)[:, :2] - 0.51, axis=1) > 0.3
    np.testing.assert_array_equal(cut[outer[cut]], alone[outer[alone]])
    assert outer[cut].sum() > 100


def test_along_faces_of_cells_pressures_jump_there_and_velocities_are_not_kinked():
    e = enriching(4)
    found = e(surfaces(plate(0.5)))
    np.testing.assert_array_equal(np.flatnonzero(found.jump), np.flatnonzero(np.abs(e.x[:, 2] - 0.5) < 1e-9))
    assert not found.kink.any()


def test_velocities_of_the_surface_at_nodes():
    e, surface = enriching(5), surfaces(plate(0.433))
    v = surface.x @ np.array([[1.0, 0.0, 0.0], [0.0, 2.0, 1.0], [0.0, 0.0, 0.0]])
    found = e(surface, v=v)
    near = np.abs(e.x[:, 2] - 0.433) < 0.2
    expected = e.x @ np.array([[1.0, 0.0, 0.0], [0.0, 2.0, 1.0], [0.0, 0.0, 0.0]])
    np.testing.assert_allclose(found.velocity[near], expected[near], atol=1e-12)


@pytest.mark.mpi
@pytest.mark.parametrize("normal", [1.0, -1.0])
def test_one_node_of_a_wall_that_is_cut_off_joins_the_other_side(normal):
    """As where an edge of a surface meets a wall between nodes; its pressure would be one of no flow."""

    def across(size):  # the corner at the origin
        a, b, c = np.full((3, 3), -0.5) + (size + 1.5) * np.eye(3)
        return surfaces(grid(4, lambda u, v: a + np.outer(u, b - a) + np.outer(v, c - a), turned=normal < 0.0))

    e = enriching(4, kinked=False)
    small, large = e(across(0.1)), e(across(0.45))
    assert not small.jump.any()
    assert not small.cut.cells.size
    sides = COMM.allgather(set((small.phi < 0.0)[np.isfinite(small.phi)].tolist()))
    assert len(set.union(*sides)) == 1
    assert COMM.allreduce(int(large.jump.sum())) > 5
