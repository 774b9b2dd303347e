"""Surfaces across a mesh of one layer of cells between two walls: weights, facets, polygons, enriched nodes."""

import numpy as np
import pytest
from mpi4py import MPI
from dolfinx import mesh
from test_nearest_surfaces import grid, surfaces

from coudalfish.surface.boundary import attached, boundary
from coudalfish.surface.cut_cells import CutCells, SideWeights, rule
from coudalfish.surface.enriched import Enriching
from coudalfish.surface.facets import FacetWeights, walls_of
from coudalfish.surface.net import Net
from coudalfish.surface.polygons import ZeroSet
from coudalfish.surface.surfaces import Surfaces
from tigar_x import compat

DEPTH = 0.2
VERTICES = np.array([np.delete(np.arange(4), side) for side in range(4)])


def layer(n=5, depth=DEPTH):
    return mesh.create_box(MPI.COMM_SELF, [[0.0] * 3, [1.0, depth, 1.0]], [n, 1, n])


def facets(x, bits):
    """Wall facets: cells, sides, and normals outwards times areas."""
    cell, side = np.nonzero(bits[:, None] >> np.arange(4) & 1)
    corners = np.take_along_axis(x[cell], VERTICES[side][..., None], 1)
    area = 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    inwards = np.einsum("fi,fi->f", area, x[cell, side] - corners[:, 0]) > 0.0
    return cell, side, np.where(inwards[:, None], -area, area)


PHI = {
    "plane": lambda x: x @ [0.3, 0.0, 1.0] - 0.53,
    "slanting": lambda x: x @ [0.3, 0.9, 1.0] - 0.57,
    "bent": lambda x: np.linalg.norm(x - [0.51, -0.3, 0.47], axis=1) - 0.46,
    "along facets": lambda x: x[:, 0] - 0.4,
    "through an edge": lambda x: x[:, 0] + x[:, 2] - 0.4 + 0.7 * x[:, 1],
}


@pytest.mark.parametrize("name", PHI)
@pytest.mark.parametrize("depth", [DEPTH, 0.03, 0.7])
def test_pressures_of_one_side_are_in_equilibrium_on_polygons_and_walls(name, depth):
    """At every node: the integral of grad N over the side is that of N times the normals around it."""
    domain = layer(depth=depth)
    space, linear = compat.lagrange_space(domain, 3, discontinuous=True), compat.lagrange_space(domain, 1)
    weights = compat.lagrange_space(domain, 2, discontinuous=True)
    vertices, x = compat.cell_dofs(linear), linear.tabulate_dof_coordinates()
    phi, corners = PHI[name](x), x[vertices]
    cut = CutCells.of(vertices, phi)
    inverse = np.linalg.inv(corners[:, 1:] - corners[:, :1])
    slopes = np.concatenate([-inverse.sum(axis=2, keepdims=True), inverse], axis=2)
    volumes = np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1])) / 6.0
    inside = (phi[vertices] < 0.0).all(axis=1).astype(float)
    share = inside.copy()
    at, w = rule(3, 2)
    share[cut.cells] = SideWeights(2, compat.node_points(weights))(cut) @ compat.tabulate(weights, at).T @ w * 6.0
    np.testing.assert_allclose(share[cut.cells], cut.negative_share, atol=1e-12)
    by_pressure, by_forces = np.zeros((2, len(x), 3))
    np.add.at(by_pressure, vertices, np.moveaxis(slopes, 2, 1) * (share * volumes)[:, None, None])
    points = ZeroSet.of(cut, corners[cut.cells]).quadrature()
    forces = points.barycentric[:, :, None] * (points.areas[:, None] * points.normals)[:, None]
    np.add.at(by_forces, vertices[points.cells], forces)
    found, nodal = FacetWeights(space, 2)(cut)
    of_cells = np.broadcast_to(inside[:, None], (len(vertices), nodal.shape[1])).copy()
    of_cells[found] = nodal
    at, w = rule(2, 4)
    within = np.column_stack([1.0 - at.sum(axis=1), at])
    for cell, side, area in zip(*facets(corners, walls_of(domain)), strict=True):
        barycentric = np.zeros((len(at), 4))
        barycentric[:, VERTICES[side]] = within
        here = compat.tabulate(space, barycentric[:, 1:]) @ of_cells[cell]
        by_forces[vertices[cell]] += 2.0 * np.outer((w * here) @ barycentric, area)
    several = np.unique([bin(bits).count("1") for bits in walls_of(domain)[cut.cells]])
    assert several.max() >= 2
    np.testing.assert_allclose(by_pressure, by_forces, atol=1e-14 if several.max() < 3 else 1e-4)


def wall_to_wall(low, margin=0.0, n=6):
    """A plate from one wall to the other, or as good as, beyond the right end of the box."""
    return grid(n, lambda u, v: np.column_stack([low + 1.2 * u, margin + (DEPTH - 2.0 * margin) * v, 0.433 + 0.0 * u]))


@pytest.mark.parametrize("margin", [0.0, -0.1, 0.004])
def test_a_plate_from_wall_to_wall_covers_the_layer_up_to_its_free_edge(margin):
    domain = layer(8)
    plate, walls = surfaces(wall_to_wall(0.61, margin)), boundary(domain)
    surface = Surfaces(plate.x, Net(plate.net.cells, plate.net.place, attached(plate, walls, 0.01, domain.comm)))
    e = Enriching(compat.lagrange_space(domain, 1), kinked=True)
    found = e(surface)
    off = 1e-3 if margin > 0.0 else 1e-12  # round the corner of the free edge
    assert found.zero.sizes().sum() == pytest.approx(0.39 * DEPTH, rel=off)
    functions, areas = found.zero.quadrature().on(surface, np.ones(len(surface.net.triangles)), 0.1)
    assert (functions.T @ areas).sum() == pytest.approx(0.39 * DEPTH, rel=off)
    near = np.abs(e.x[:, 2] - 0.433) < 1.0 / 8.0
    for mask in (found.jump, found.kink):
        np.testing.assert_array_equal(mask[near & (e.x[:, 0] > 0.7)], True)
        assert not mask[~near | (e.x[:, 0] < 0.49)].any()
    whole = e(surfaces(wall_to_wall(-0.1, margin=-0.1)))
    beyond = e.x[:, 0] > 0.74
    np.testing.assert_array_equal(found.jump[beyond], whole.jump[beyond])
