"""Weights of sides on the boundary: right integrals over its parts, in edges and corners as well."""

import numpy as np
import pytest
from mpi4py import MPI
from dolfinx import mesh

from coudalfish.surface.cut_cells import CutCells, rule
from coudalfish.surface.facets import FacetWeights, walls_of
from tigar_x import compat
from tigar_x.fem.simplices import Division
from varmint.flow.sides import DEGREE, WALLS

SELF, K = MPI.COMM_SELF, 2


def domain_of(d):
    """Cells with one and two facets on the boundary."""
    return mesh.create_unit_square(SELF, 3, 3) if d == 2 else mesh.create_unit_cube(SELF, 2, 2, 2)


def level(domain, *numbers):
    """A linear function at the vertices of all cells."""
    linear = compat.lagrange_space(domain, 1)
    d = domain.geometry.dim
    return compat.cell_dofs(linear), linear.tabulate_dof_coordinates()[:, :d] @ numbers[:d] - numbers[-1]


def on_facet(side, x):
    corners = np.delete(np.eye(x.shape[1] + 2), side, axis=0)
    return np.column_stack([1.0 - x.sum(axis=1), x]) @ corners


def monomials(x):
    """Up to degree K, of the coordinates on a facet."""
    powers = [p for p in np.ndindex(*[K + 1] * x.shape[1]) if sum(p) <= K]
    return np.stack([(x**p).prod(axis=1) for p in np.array(powers)], axis=1)


def of_negative_part(values):
    """Integrals of the monomials over the part of a facet where a linear function is negative."""
    x, w = rule(len(values) - 1, K)
    barycentric = np.column_stack([1.0 - x.sum(axis=1), x])
    if (values < 0.0).all() or (values >= 0.0).all():
        return (w @ monomials(x)) * (values < 0.0).all()
    division = Division(values[None])
    for parts in division.smaller if division.of_negative[0] else division.larger:
        return sum(
            share * (w @ monomials((barycentric @ part)[:, 1:]))
            for part, share in zip(parts.barycentric[0], parts.shares[0], strict=True)
        )


@pytest.mark.parametrize("plane", [(1.0, 0.37, 0.61, 0.29), (-0.4, 1.0, 0.3, 0.131), (-0.2, -0.3, -1.0, -0.4)])
@pytest.mark.parametrize("d", [2, 3])
def test_every_facet_has_the_integrals_of_its_part(d, plane):
    domain = domain_of(d)
    space = compat.lagrange_space(domain, K + 1, discontinuous=True)
    vertices, phi = level(domain, *plane)
    cut = CutCells.of(vertices, phi)
    cells, weights = FacetWeights(space, K)(cut)
    x, w = rule(d - 1, 2 * K + 1)
    several = set()
    for cell, nodal in zip(cells, weights, strict=True):
        bits = walls_of(domain)[cell]
        sides = np.flatnonzero(bits >> np.arange(d + 1) & 1)
        several.add(len(sides))
        for side in sides:
            here = compat.tabulate(space, on_facet(side, x)[:, 1:]) @ nodal
            expected = of_negative_part(np.delete(phi[vertices[cell]], side))
            np.testing.assert_allclose((w * here) @ monomials(x), expected, atol=1e-13)
    assert several == {1, 2} or (d == 2 and several == {1})
    walls = walls_of(domain)[cut.cells]
    np.testing.assert_array_equal(cells, cut.cells[walls > 0])


def test_where_three_facets_meet_one_integral_is_an_approximation():
    x = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.1, 1.1, 0.0], [0.2, 0.0, 0.9], [0.9, 0.8, 0.9]])
    domain = compat.create_mesh(SELF, "tetrahedron", [[0, 1, 2, 3], [1, 2, 3, 4]], x)
    space = compat.lagrange_space(domain, K + 1, discontinuous=True)
    vertices, phi = level(domain, 1.0, 0.37, 0.61, 0.29)
    x, w = rule(2, 2 * K + 1)
    off = []
    for cell, nodal in zip(*FacetWeights(space, K)(CutCells.of(vertices, phi)), strict=True):
        for side in np.flatnonzero(walls_of(domain)[cell] >> np.arange(4) & 1):
            here = compat.tabulate(space, on_facet(side, x)[:, 1:]) @ nodal
            off.append((w * here) @ monomials(x) - of_negative_part(np.delete(phi[vertices[cell]], side)))
    assert len(off) >= 3
    assert np.abs(off).max() < 1e-3


@pytest.mark.parametrize("kind", DEGREE)
@pytest.mark.parametrize("d", [2, 3])
def test_penalties_of_both_sides_are_positive_on_all_walls_of_a_cell(d, kind):
    """One, two and three facets of a cell, and random planes; with kinks as well."""
    x = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.1, 1.1, 0.0], [0.2, 0.0, 0.9], [0.9, 0.8, 0.9]])
    if d == 2:
        corner = compat.create_mesh(SELF, "triangle", [[0, 1, 2], [1, 2, 3]], x[[0, 1, 2, 4], :2])
    else:
        corner = compat.create_mesh(SELF, "tetrahedron", [[0, 1, 2, 3], [1, 2, 3, 4]], x)
    k, rng, least = DEGREE[kind], np.random.default_rng(4), dict.fromkeys(range(1, d + 1), 1.0)
    at, w = rule(d - 1, 2 * k + WALLS[d])
    for domain in (domain_of(d), corner):
        space = compat.lagrange_space(domain, k + WALLS[d], discontinuous=True)
        weights, walls = FacetWeights(space, k), walls_of(domain)
        for _ in range(6 if d == 3 else 12):
            normal = rng.standard_normal(d)
            _, away = level(domain, *normal, 0.0)
            vertices, phi = level(domain, *normal, rng.uniform(away.min(), away.max()))
            for cell, nodal in zip(*weights(CutCells.of(vertices, phi)), strict=True):
                sides, values = np.flatnonzero(walls[cell] >> np.arange(d + 1) & 1), phi[vertices[cell]]
                masses = np.zeros((3, *[d + 1 if kind == "jump" else 2 * (d + 1)] * 2))
                for side in sides:
                    N = on_facet(side, at)
                    negative = compat.tabulate(space, N[:, 1:]) @ nodal
                    for i, (s, weight) in enumerate(((-1.0, negative), (1.0, 1.0 - negative), (1.0, 1.0))):
                        psi = N @ (np.abs(values) - s * values) / np.abs(values).max()
                        fields = N if kind == "jump" else np.hstack([N, psi[:, None] * N])
                        masses[i] += fields.T @ ((w * weight)[:, None] * fields)
                found = np.linalg.eigvalsh(masses[:2]).min() / np.trace(masses[2])
                least[len(sides)] = min(least[len(sides)], found)
    assert min(least.values()) > -1e-14
    assert least[1] < 1.0 > least[2]


@pytest.mark.parametrize("d", [2, 3])
def test_on_one_facet_weights_are_the_same_in_spaces_of_both_degrees(d):
    """In one of them they have the integrals on any facets, in the other one on one facet of a cell."""
    domain = domain_of(d)
    low, high = (compat.lagrange_space(domain, k, discontinuous=True) for k in (K, K + 1))
    vertices, phi = level(domain, *(1.0, 0.2, 0.3)[:d], 0.3302)
    cut, checked = CutCells.of(vertices, phi), 0
    x = rule(d - 1, 4)[0]
    (cells, of_low), (_, of_high) = FacetWeights(low, K)(cut), FacetWeights(high, K)(cut)
    for cell, a, b in zip(cells, of_low, of_high, strict=True):
        sides = np.flatnonzero(walls_of(domain)[cell] >> np.arange(d + 1) & 1)
        if len(sides) == 1:
            at = on_facet(sides[0], x)[:, 1:]
            np.testing.assert_allclose(compat.tabulate(high, at) @ b, compat.tabulate(low, at) @ a, atol=1e-12)
            checked += 1
    assert checked
