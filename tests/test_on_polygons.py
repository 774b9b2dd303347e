"""Surfaces that meet the fluid on polygons: averages, areas, action and reaction, the same on all ranks."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse as sp
from mpi4py import MPI
from dolfinx import fem, mesh
from test_enriched_space import ball, plate
from test_nearest_surfaces import grid, moebius, surfaces

from coudalfish.surface.enriched import Enriching
from coudalfish.surface.in_space import DividedSpace
from coudalfish.surface.on_polygons import OnPolygons
from tigar_x import compat

COMM = MPI.COMM_WORLD


def met(surface, n=5, comm=COMM, stretch=1.0):
    """A surface whose areas at rest are its present ones over a stretch."""
    space = compat.lagrange_space(mesh.create_unit_cube(comm, n, n, n), 1)
    e = Enriching(space, kinked=False)
    found = e(surface)
    points = found.zero.only(found.zero.cut.cells[found.zero.rows] < e.owned).quadrature()
    hats, areas = points.on(surface, np.full(len(surface.net.triangles), stretch), 0.5)
    whole = surface.net.functions.T @ np.bincount(
        surface.net.triangles.ravel(), np.repeat(surface.triangles.areas / 3.0, 3), surface.net.functions.shape[0]
    )
    return space, points, OnPolygons.of(points, hats, surface.net, areas, e.vertices, whole / stretch, None, comm)


def normals_of(surface):
    """At the points, of any length."""
    net, faces = surface.net, np.repeat(surface.triangles.normals[:, None], 3, axis=1)
    return net.sums(faces, net.corners)[net.place]


def ridge(z, turned=False, width=0.06):
    """Across the unit cube and beyond, with a fold whose two sides are nearer to each other than cells are long."""

    def f(u, v):
        x = 1.2 * u - 0.1
        return np.column_stack([x, 1.2 * v - 0.1, z + 0.25 * np.exp(-(((x - 0.47) / width) ** 2))])

    return grid(48, f, turned=turned)


def total(comm, values):
    result = np.array(values, dtype=float)
    comm.Allreduce(MPI.IN_PLACE, result, op=MPI.SUM)
    return result


@pytest.mark.mpi
def test_linear_velocities_are_averaged_over_hat_functions():
    """Of a plane surface, whose polygons lie in it."""
    surface = surfaces(plate(0.433))
    space, _, meeting = met(surface, stretch=1.5)
    f = fem.Function(space)
    f.interpolate(lambda x: 1.0 + 2.0 * x[0] - x[1] + 5.0 * x[2])
    found = total(COMM, meeting.trace.B @ f.x.array[meeting.seen])
    x = surface.x
    inside = ((x[:, :2] > 0.3) & (x[:, :2] < 0.7)).all(axis=1)
    assert inside.any()
    expected = 1.0 + 2.0 * x[:, 0] - x[:, 1] + 5.0 * 0.433
    np.testing.assert_allclose(found[inside], expected[inside], rtol=5e-3)
    np.testing.assert_allclose(meeting.W.sum(), 1.0 / 1.5, rtol=1e-12)
    np.testing.assert_array_equal(meeting.active, meeting.W > 0.0)
    assert not meeting.active.all()  # it goes on beyond the box


@pytest.mark.mpi
@pytest.mark.parametrize("surface", [ball(), surfaces(plate(0.433, low=0.31))], ids=["ball", "plate"])
def test_action_equals_reaction(surface):
    """Forces at points as well as along the normals of polygons: their sum, and where it acts, on either side."""
    _, points, meeting = met(surface)
    n = len(surface.x)
    forces = np.random.default_rng(3).standard_normal(n) * meeting.W
    at_nodes = total(COMM, (meeting.trace.transposed @ forces).sum())
    np.testing.assert_allclose(at_nodes, forces.sum(), atol=1e-13)
    normals = normals_of(surface)
    forces = meeting.normal_forces(sp.identity(n, format="csr"), normals)
    lam = np.random.default_rng(4).standard_normal(n)
    on_surface = total(COMM, forces.at_points @ lam).reshape(-1, 3)
    on_fluid = (forces.at_nodes @ lam).reshape(-1, 3)
    np.testing.assert_allclose(total(COMM, on_fluid.sum(axis=0)), on_surface.sum(axis=0), atol=1e-13)
    along = (
        np.einsum("gi,gi->g", points.normals, meeting.hats @ normals) > 0.0
    )  # whatever the signs of the polygons are
    expected = total(COMM, (points.normals * np.where(along, points.areas, -points.areas)[:, None]).sum(axis=0))
    of_one = total(COMM, forces.at_points @ np.ones(n)).reshape(-1, 3)
    np.testing.assert_allclose(of_one.sum(axis=0), expected, atol=1e-13)


def of_all_points(meeting, normals):
    """Forces on the surface of a pressure of one, shape (points, 3), and which share of the polygons is turned."""
    n = len(normals)
    of_functions = meeting.normal_forces(sp.identity(n, format="csr"), normals)
    forces = total(meeting.comm, of_functions.at_points @ np.ones(n)).reshape(-1, 3)
    against = np.einsum("gi,gi->g", meeting.hats @ normals, meeting.normals) < 0.0
    areas = meeting.penalty[1]
    share, whole = total(meeting.comm, [areas[against].sum(), areas.sum()])
    return forces, share / whole


@pytest.mark.mpi
@pytest.mark.parametrize("turned", [False, True])
def test_a_pressure_on_a_fold_is_that_on_the_section_of_the_box(turned):
    """Some polygons at the fold are turned by more than a right angle against the nearest place."""
    surface = surfaces(ridge(0.433, turned))
    forces, share = of_all_points(met(surface)[2], normals_of(surface))
    assert 0.03 < min(share, 1.0 - share) < 0.2
    np.testing.assert_allclose(forces.sum(axis=0), [0.0, 0.0, -1.0 if turned else 1.0], atol=1e-9)


@pytest.mark.mpi
def test_every_sheet_has_a_sign_of_its_own():
    surface = surfaces(ridge(0.15), ridge(0.55, turned=True), ridge(0.9))
    forces, _ = of_all_points(met(surface, n=8)[2], normals_of(surface))
    assert surface.sheets == 3
    sheet = surface.net.sheet_of_points
    for k in range(2):
        expected = 1.0 if (surface.triangles.normals[surface.net.sheet == k, 2] >= 0.0).all() else -1.0
        np.testing.assert_allclose(forces[sheet == k].sum(axis=0), [0.0, 0.0, expected], atol=1e-9)


@pytest.mark.mpi
def test_a_sheet_with_one_side_has_the_sign_of_each_polygon():
    """Beside one with two, a plate below."""
    strip = moebius()
    surface = surfaces(strip, plate(0.1))
    normals = normals_of(surface)
    _, points, meeting = met(surface, n=6)
    forces, share = of_all_points(meeting, normals)
    sheet, one_sided = surface.net.sheet_of_points, surface.net.one_sided
    assert one_sided.sum() == 1
    single = one_sided[sheet]
    of_strip = (meeting.hats @ single.astype(float)) > 0.5
    side = np.where(np.einsum("gi,gi->g", meeting.hats @ normals, points.normals) < 0.0, -1.0, 1.0)
    assert total(COMM, [(side[of_strip] > 0.0).sum(), (side[of_strip] < 0.0).sum()]).min() > 10
    assert 0.0 < share < 1.0
    expected = total(COMM, ((side * points.areas)[:, None] * points.normals)[of_strip].sum(axis=0))
    np.testing.assert_allclose(forces[single].sum(axis=0), expected, atol=1e-12)
    np.testing.assert_allclose(np.abs(forces[~single].sum(axis=0)), [0.0, 0.0, 1.0], atol=0.05)  # the strip is near


@pytest.mark.mpi
@pytest.mark.parametrize("surface", [ball(), surfaces(ridge(0.433))], ids=["ball", "ridge"])
def test_all_partitions_see_the_same(surface):
    found = []
    for comm in (COMM, MPI.COMM_SELF):
        space, _, meeting = met(surface, comm=comm)
        f = fem.Function(space)
        f.interpolate(lambda x: np.sin(3.0 * x[0]) + x[1] * x[2])
        seen = total(comm, meeting.trace.B @ f.x.array[meeting.seen])
        found.append((meeting.W, seen, of_all_points(meeting, normals_of(surface))[0]))
    for one, other in zip(*found, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-13)


def sheet(low):
    """A bent sheet of fine cells that begins in the cube and leaves it, or lies in it."""
    return surfaces(grid(24, lambda u, v: np.column_stack([low + 0.7 * u, 0.15 + 0.7 * v, 0.47 + 0.1 * u * v])))


@pytest.mark.mpi
@pytest.mark.parametrize("low", [0.15, 0.5])
def test_points_are_as_dense_where_the_nearest_triangles_are_known_as_where_they_are_sought(low):
    e = Enriching(compat.lagrange_space(mesh.create_unit_cube(COMM, 5, 5, 5), 1), kinked=False)
    fine = sheet(low)
    zero = e(fine).zero
    divided = DividedSpace.__new__(DividedSpace)
    divided._enriching, divided._kinked = e, False
    known = COMM.allreduce(int((zero.nearest >= 0).sum()))
    assert 20 < known < COMM.allreduce(len(zero.rows))  # others are parts, cut at edges
    kept, sought = (divided._points_of(z, fine) for z in (zero, replace(zero, nearest=None)))
    assert COMM.allreduce(len(kept.areas)) > COMM.allreduce(len(zero.quadrature(2, 0.25).areas))
    for name in ("cells", "barycentric", "areas", "x", "normals"):
        np.testing.assert_array_equal(getattr(kept, name), getattr(sought, name))
