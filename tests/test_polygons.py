"""Polygons on which a linear function is zero in tetrahedra, as lines in triangles: areas, normals, what they cover."""

import numpy as np
import pytest
from mpi4py import MPI
from dolfinx import mesh
from test_nearest_surfaces import grid, surfaces

from coudalfish.surface.covering import by_surfaces
from coudalfish.surface.cut_cells import CutCells
from coudalfish.surface.interface import Sought
from coudalfish.surface.polygons import ZeroSet
from coudalfish.surface.surfaces import Surfaces
from tigar_x import compat


def box(d, n):
    domain = mesh.create_unit_square(MPI.COMM_SELF, n, n) if d == 2 else mesh.create_unit_cube(MPI.COMM_SELF, n, n, n)
    space = compat.lagrange_space(domain, 1)
    return compat.cell_dofs(space), space.tabulate_dof_coordinates()[:, :d]


def zero_set(vertices, x, phi):
    cut = CutCells.of(vertices, phi)
    return cut, ZeroSet.of(cut, x[vertices[cut.cells]])


def sphere(x, radius=0.331, center=(0.51, 0.49, 0.52)):
    return np.linalg.norm(x - np.array(center)[: x.shape[1]], axis=1) - radius


def covered(zero, surface):
    middles = zero.middles()
    there = surface.nearest(middles, Sought(np.arange(len(middles)), 0.5)).covered()
    return by_surfaces(zero, surface, np.ones(len(middles)), there)


@pytest.mark.parametrize("d", [2, 3])
def test_a_plane_has_its_area_and_normal(d):
    vertices, x = box(d, 4)
    direction = np.array([1.0, 0.3, 0.2][:d])
    _, zero = zero_set(vertices, x, x @ direction - 0.7)
    unit, points = direction / np.linalg.norm(direction), zero.quadrature(3)
    np.testing.assert_allclose(zero.sizes().sum(), 1.0 / unit[0], rtol=1e-13)  # its shadow is a whole side of the box
    np.testing.assert_allclose(points.normals, np.broadcast_to(unit, points.normals.shape), atol=1e-13)
    np.testing.assert_allclose(points.x @ direction, 0.7, rtol=1e-13)
    np.testing.assert_allclose(np.einsum("pc,pci->pi", points.barycentric, x[vertices[points.cells]]), points.x)
    for power in (0, 1, 2, 3):
        moment = points.areas @ points.x[:, 1] ** power
        np.testing.assert_allclose(moment, 1.0 / (power + 1) / unit[0], rtol=1e-13)


@pytest.mark.parametrize("d", [2, 3])
def test_small_simplices_have_one_point(d):
    """Linear functions are integrated exactly, and others as good as."""
    vertices, x = box(d, 5)
    _, zero = zero_set(vertices, x, sphere(x))
    whole, few = zero.quadrature(2), zero.quadrature(2, 0.3)
    assert 0.5 * len(whole.areas) < len(few.areas) < 0.95 * len(whole.areas)
    np.testing.assert_allclose(few.areas.sum(), whole.areas.sum(), rtol=1e-13)
    np.testing.assert_allclose(few.areas @ few.x, whole.areas @ whole.x, rtol=1e-13)
    np.testing.assert_allclose(few.areas @ few.x**2, whole.areas @ whole.x**2, rtol=1e-4)
    assert (np.abs(few.areas @ few.x**2 - whole.areas @ whole.x**2) > 1e-9).any()


@pytest.mark.parametrize("d", [2, 3])
def test_areas_of_a_sphere_converge(d):
    errors = []
    for n in (8, 16):
        vertices, x = box(d, n)
        _, zero = zero_set(vertices, x, sphere(x))
        errors.append(abs(zero.sizes().sum() / ({2: 2.0 * np.pi * 0.331, 3: 4.0 * np.pi * 0.331**2}[d]) - 1.0))
    assert errors[1] < 0.4 * errors[0]
    assert errors[1] < 0.01


@pytest.mark.parametrize("d", [2, 3])
def test_a_pressure_that_jumps_is_in_equilibrium_with_forces_along_the_normals(d):
    """At all nodes inside: the integral of grad N over a side is that of N times the normal, to rounding."""
    vertices, x = box(d, 6)
    phi = sphere(x)
    cut, zero = zero_set(vertices, x, phi)
    corners = x[vertices]
    inverse = np.linalg.inv(corners[:, 1:] - corners[:, :1])
    slopes = np.concatenate([-inverse.sum(axis=2, keepdims=True), inverse], axis=2)  # (cells, d, vertices)
    volumes = np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1])) / (2 if d == 2 else 6)
    share = (phi[vertices] < 0.0).all(axis=1).astype(float)
    share[cut.cells] = cut.negative_share
    by_pressure, by_forces = np.zeros((2, len(x), d))
    np.add.at(by_pressure, vertices, np.moveaxis(slopes, 2, 1) * (share * volumes)[:, None, None])
    points = zero.quadrature()
    forces = points.barycentric[:, :, None] * (points.areas[:, None] * points.normals)[:, None]
    np.add.at(by_forces, vertices[points.cells], forces)
    inside = ((x > 1e-9) & (x < 1.0 - 1e-9)).all(axis=1)
    assert np.abs(by_forces[inside]).max() > 1e-3
    np.testing.assert_allclose(by_pressure[inside], by_forces[inside], atol=1e-15)


@pytest.mark.parametrize(("stretch", "size"), [(1.0, 0.55), (2.0, 0.55), (1.0, 3.0)])
def test_points_stand_for_areas_at_rest(stretch, size):
    """A plate within the box, or across it, that is stretched along one side."""
    center = np.array([0.5, 0.5, 0.43])
    points, cells = grid(5, lambda u, v: size * np.column_stack([u - 0.5, v - 0.5, 0.0 * u]) + center)
    plate = surfaces((points, cells))
    rest = Surfaces(points * [1.0 / stretch, 1.0, 1.0], plate.net).triangles.areas
    vertices, x = box(3, 7)
    _, zero = zero_set(vertices, x, x[:, 2] - 0.43)
    found = covered(zero, plate).quadrature()
    functions, areas = found.on(plate, plate.triangles.areas / rest, 0.5)
    inside = min(size, 1.0)
    np.testing.assert_allclose(found.areas.sum(), inside**2, rtol=1e-12 if size > 1.0 else 4e-3)  # corners are cut off
    np.testing.assert_allclose(areas, found.areas / stretch, rtol=1e-12)
    of_points = functions.T @ areas
    np.testing.assert_allclose(of_points.sum(), areas.sum(), rtol=1e-13)
    np.testing.assert_allclose(of_points @ points / of_points.sum(), center, atol=1e-5)


@pytest.mark.parametrize(("gap", "seen"), [(0.0, 0.0), (0.1, 0.1), (0.3, 0.3), (0.013, 0.0)])
def test_gaps_are_not_covered_if_they_are_not_too_narrow(gap, seen):
    """A gap between two plates that are held in one plane, and that is no wider than a cell."""
    low, high = (
        grid(3, lambda u, v, a=a, b=b: np.column_stack([a + (b - a) * u, 3.0 * v - 1.0, 0.43 + 0.0 * u]))
        for a, b in ((-1.0, 0.52 - 0.5 * gap), (0.52 + 0.5 * gap, 2.0))
    )
    vertices, x = box(3, 4)
    _, zero = zero_set(vertices, x, x[:, 2] - 0.43)
    found = covered(zero, surfaces(low, high))
    np.testing.assert_allclose(found.sizes().sum(), 1.0 - seen, atol=1e-12)
    whole, share = zero.of_cells(zero.sizes()), found.of_cells(found.sizes())
    assert (share <= whole * (1.0 + 1e-12)).all()
    assert ((share < 0.99 * whole).sum() > 4) == (seen > 0.0)


def test_what_is_not_cut_has_no_points():
    vertices, x = box(3, 2)
    cut, zero = zero_set(vertices, x, x[:, 0] + 1.0)
    points = covered(zero, surfaces(grid(2))).quadrature()
    assert len(cut.cells) == len(zero.rows) == len(points.areas) == 0
    assert points.barycentric.shape == (0, 4)
