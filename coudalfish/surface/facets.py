"""Weights of the two sides on the boundary of the fluid, where a curve or surface crosses it between vertices.

A weight is one polynomial in each cell. On one facet it is the projection of the side's indicator on polynomials of
degree k. A cell with two facets on the boundary has on both of them the integrals of all polynomials of degree k over
the sides, if its own polynomials are of degree k + 1. Of degree k they have not enough freedom: they are then the
projection of the indicators on both, and have the integrals of what is continuous and of degree k alone, such as
penalties. Where three facets of a tetrahedron meet in a corner one integral in eighteen (k = 2) is determined by the
others, and it is right as far as it can be.
"""

from functools import cached_property

import numpy as np
from dolfinx import fem, mesh

from coudalfish.surface.cut_cells import CutCells, SideMoments, rule
from tigar_x import compat
from tigar_x.compat import FloatArray, IntArray
from tigar_x.fem.simplices import Division

NONE = 1e-9
"""Value of a node's function on a facet below which it is zero there."""


class FacetWeights:
    """Weights of the negative side on those facets of cut triangles or tetrahedra that are on the boundary.

    Args:
        space: discontinuous Lagrange space in which the weights are wanted.
        degree: k, that of the space or one less.
    """

    def __init__(self, space: fem.FunctionSpace, degree: int) -> None:
        self._space, self._d = space, space.mesh.topology.dim
        self._degree = compat.lagrange_degree(space)
        self._moments = SideMoments(self._d - 1, degree)
        self._walls = walls_of(space.mesh)
        sides = np.arange(self._d + 1)
        self._vertices = np.array([np.delete(sides, side) for side in sides])
        self._solutions: dict[int, FloatArray] = {}

    def __call__(self, cut: CutCells) -> tuple[IntArray, FloatArray]:
        """Those cut cells that have a facet on the boundary, and values at their nodes, shape (found, nodes)."""
        kinds = self._walls[cut.cells]
        there = np.flatnonzero(kinds)
        if not len(there):
            return cut.cells[:0], np.empty((0, len(self._integrals[0][0])))
        cells, kinds, values = cut.cells[there], kinds[there], cut.values[there]
        cell, side = np.nonzero(kinds[:, None] >> np.arange(self._d + 1) & 1)
        moments = np.zeros((len(cells), self._d + 1, len(self._moments.whole)))
        moments[cell, side] = self._of_facets(values[cell[:, None], self._vertices[side]])
        weights, moments = np.empty((len(cells), len(self._integrals[0][0]))), moments.reshape(len(cells), -1)
        for kind in np.unique(kinds):
            rows = kinds == kind
            weights[rows] = moments[rows] @ self._solution(kind)
        return cells, weights

    def _of_facets(self, values: FloatArray) -> FloatArray:
        """Moments over the negative parts of facets, of which some are not divided, shape (n, polynomials)."""
        negative = values < 0.0
        moments = np.where(negative[:, :1], self._moments.whole, 0.0)
        cut = np.flatnonzero((negative != negative[:, :1]).any(axis=1))
        if len(cut):
            moments[cut] = self._moments(Division(values[cut]))
        return moments

    @cached_property
    def _integrals(self) -> list[tuple[FloatArray, FloatArray]]:
        """Of products of the nodes' functions with each other, and with the polynomials, over every facet."""
        x, weights = rule(self._d - 1, 2 * self._degree)
        inside, found = np.column_stack([1.0 - x.sum(axis=1), x]), []
        for vertices in self._vertices:
            barycentric = np.zeros((len(x), self._d + 1))
            barycentric[:, vertices] = inside
            N = compat.tabulate(self._space, barycentric[:, 1:])
            N[np.abs(N) < NONE] = 0.0
            found.append((N.T @ (weights[:, None] * N), self._moments.polynomials(x).T @ (weights[:, None] * N)))
        return found

    def _solution(self, kind: int) -> FloatArray:
        """Nodal values out of moments over all facets, of which those on the boundary count.

        Of all values that have these moments they are the least ones in the mean square over the facets.
        """
        if kind not in self._solutions:
            on = kind >> np.arange(self._d + 1) & 1
            G = np.sum([mass for (mass, _), here in zip(self._integrals, on, strict=True) if here], axis=0)
            A = np.vstack([here * products for (_, products), here in zip(self._integrals, on, strict=True)])
            there = np.flatnonzero(np.diag(G) > 0.0)
            half = np.linalg.solve(G[np.ix_(there, there)], A[:, there].T)
            solution = np.zeros((len(A), len(G)))
            solution[:, there] = (half @ np.linalg.pinv(A[:, there] @ half, hermitian=True)).T
            self._solutions[kind] = solution
        return self._solutions[kind]


def walls_of(domain: mesh.Mesh) -> IntArray:
    """Which facets of every local cell are on the boundary, by bits: a facet has the number of the vertex opposite."""
    d = domain.topology.dim
    vertices = compat.connectivity(domain, d, 0).array.reshape(-1, d + 1)
    of_facets, cells_of = compat.connectivity(domain, d - 1, 0), compat.connectivity(domain, d - 1, d)
    facets = compat.exterior_facets(domain)
    cells = cells_of.array[cells_of.offsets[facets]]
    ends = of_facets.array.reshape(-1, d)[facets]
    inside = (vertices[cells][:, :, None] == ends[:, None]).any(axis=2)
    bits = np.zeros(len(vertices), dtype=np.int32)
    np.bitwise_or.at(bits, cells, (1 << (~inside).argmax(axis=1)).astype(np.int32))
    return bits
