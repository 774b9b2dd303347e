"""Which nodes of a mesh of tetrahedra get unknowns for what is different on both sides of a surface.

As in the plane, see :mod:`coudalfish.surface.enriched`, with areas of the polygons on which the signed distance is zero
in place of lengths of lines.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from mpi4py import MPI
from dolfinx import fem

from coudalfish.surface.cut_simplices import CutSimplices
from coudalfish.surface.distance import Sought
from coudalfish.surface.enriched import (
    COVERED,
    OFF_LINE,
    ROUNDED,
    SLIVER,
    Enriching,
    agreeing,
)
from coudalfish.surface.polygons import ZeroSet
from coudalfish.surface.surfaces import NearestOnSurfaces, Surfaces
from tigar_x import checks, compat
from tigar_x.compat import FloatArray

DIVIDED = 1e-8
"""Share of the volume of a node's cells that each part has to have for its pressure to jump."""
NEAR = 1.1
"""Distance of a node from the surface, in sizes of its largest cell, up to which sides are known: no cut cell has
others."""
REACH = 2.5
"""The same near its free edges, beyond which cells of nodes count that the surface may divide; in sizes of the largest
cell of the nodes with which it has a cell in common."""
EDGES = ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))
"""Of a tetrahedron."""


@dataclass(frozen=True, eq=False)
class EnrichmentInSpace:
    """What a surface does to a mesh.

    Attributes:
        phi: signed distance at the nodes, not a number far away, shape (nodes,); unit: length.
        cut: cells in which one of the nodes is enriched, ghosts as well.
        zero: what the surface covers of the polygons on which phi is zero, also in cells of which no node is enriched.
        jump: mask of the nodes at which the pressure jumps, shape (nodes,).
        kink: mask of the nodes at which the velocity is kinked, shape (nodes,).
        velocity: that of the surface at the nodes near it, zero at others, shape (nodes, 3); unit: length/time; None:
            it rests.
    """

    phi: FloatArray
    cut: CutSimplices
    zero: ZeroSet
    jump: Any
    kink: Any
    velocity: FloatArray | None = None

    def __post_init__(self) -> None:
        checks.freeze(self)

    @cached_property
    def known(self) -> FloatArray:
        """The signed distance, zero where it is not known, shape (nodes,)."""
        return np.where(np.isfinite(self.phi), self.phi, 0.0)


class EnrichingInSpace(Enriching):
    """Finds the enrichment of a mesh of tetrahedra by surfaces.

    Args:
        space: scalar linear space of the mesh.
        kinked: whether velocities are kinked; pressures always jump.
    """

    def __init__(self, space: fem.FunctionSpace, *, kinked: bool) -> None:
        super().__init__(space, kinked=kinked)
        ends = self.corners[:, EDGES]
        self.sizes = np.linalg.norm(ends[:, :, 1] - ends[:, :, 0], axis=2).max(axis=1)
        self._of_nodes = self._largest_around(space, self.sizes)
        self._of_neighbours = self._largest_around(space, self._of_nodes[self.vertices].max(axis=1))

    def _largest_around(self, space: fem.FunctionSpace, of_cells: FloatArray) -> FloatArray:
        """The largest values of the cells around every node (collective)."""
        largest = np.zeros(len(self.x))
        np.maximum.at(largest, self.vertices, of_cells[:, None])
        return compat.maximise(space, largest)

    def __call__(self, surfaces: Surfaces, v: FloatArray | None = None) -> EnrichmentInSpace:  # type: ignore[override]
        """By surfaces where they are (collective).

        Args:
            surfaces: the surfaces.
            v: velocities of their points, shape (points, 3); unit: length/time. None: they rest.
        """
        phi, near = self._signed(surfaces)
        cut = CutSimplices.of(self.vertices, phi)
        real, zero, covered = self._polygons(cut, surfaces)
        nodes = self.vertices[cut.cells]
        mine = np.where(real & (cut.cells < self.owned), 1.0, 0.0)[:, None]
        other = np.where(cut.values < 0.0, 1.0 - cut.negative_share[:, None], cut.negative_share[:, None])
        other = self._total(nodes, mine * other * self._areas[cut.cells, None])
        jump = (other > DIVIDED * self._support) & (other < (1.0 - DIVIDED) * self._support)
        whole, found = (of.of_cells(of.sizes())[:, None] * mine for of in (zero, covered))
        whole, found = (self._total(nodes, np.broadcast_to(sizes, nodes.shape)) for sizes in (whole, found))
        enough = found >= COVERED * (1.0 - ROUNDED) * whole
        jump &= enough
        kink = np.zeros_like(jump)
        if self._kinked:
            bent = mine * (cut.smaller_share[:, None] > SLIVER)
            kink = (self._total(nodes, np.broadcast_to(bent, nodes.shape)) > 0.0) & enough
        concerned = (jump | kink)[nodes].any(axis=1)
        velocity = None if v is None else near.values(v)
        return EnrichmentInSpace(phi, cut.only(real & concerned), covered, jump, kink, velocity)

    def _signed(self, surfaces: Surfaces) -> tuple[FloatArray, NearestOnSurfaces]:
        """Signed distances of the nodes, by normals of which those of different sheets agree (collective)."""
        far = REACH * self._of_neighbours
        ends = surfaces.near_ends(self.x, far)
        near = surfaces.nearest(self.x, Sought(self._every, NEAR * self._of_nodes), Sought(ends, far[ends]))
        phi, nearest = self._on_line(near.signed_distance()), near.sheet()
        number = int(surfaces.net.sheet.max(initial=-1)) + 1
        if number < 2:
            return phi, near
        edges = self.vertices[: self.owned][:, EDGES].reshape(-1, 2)
        a, b = nearest[edges].T
        between = (a != b) & (a >= 0) & (b >= 0)
        edges, a, b = edges[between], a[between], b[between]
        negative = phi[edges] < 0.0
        apart = surfaces.crossed(self.x[edges[:, 0]], self.x[edges[:, 1]], far[edges].max(axis=1))
        votes = np.zeros((number, number))
        np.add.at(votes, (a, b), np.where((negative[:, 0] != negative[:, 1]) == apart, 1.0, -1.0))
        self._comm.Allreduce(MPI.IN_PLACE, votes, op=MPI.SUM)
        turned = agreeing(votes + votes.T)
        return np.where(nearest < 0, phi, turned[nearest] * phi), near

    def _polygons(self, cut: CutSimplices, surfaces: Surfaces) -> tuple[Any, ZeroSet, ZeroSet]:
        """Mask of the cells that a surface or its continuation cuts, shape (cut,), the polygons and what is covered.

        In other cells the sign changes as they are half way between two surfaces.
        """
        corners, near_by = self.corners[cut.cells], 0.5 * self.sizes[cut.cells]
        zero, far = ZeroSet.of(cut, corners), self._of_neighbours[self.vertices[cut.cells]].max(axis=1)
        middles, around = zero.middles(), far[zero.rows]
        at_ends = surfaces.near_ends(middles, 2.0 * around)
        everywhere = Sought(np.arange(len(middles)), near_by[zero.rows])
        near = surfaces.nearest(middles, everywhere, Sought(at_ends, REACH * around[at_ends]))
        off, largest = np.abs(near.signed_distance()), np.abs(cut.values).max(axis=1, initial=0.0)
        real = zero.of_cells(np.where(off <= OFF_LINE * largest[zero.rows], 0.0, 1.0)) == 0.0
        rest = np.flatnonzero(~real)
        ends, negative = corners[rest], cut.values[rest] < 0.0
        for a, b in EDGES:
            crossed = surfaces.crossed(ends[:, a], ends[:, b], self.sizes[cut.cells[rest]])
            real[rest] |= (negative[:, a] != negative[:, b]) & crossed
        kept = real[zero.rows]
        covered = zero.only(kept).covered_by(surfaces, near_by, near.covered()[kept])
        return real, zero, covered
