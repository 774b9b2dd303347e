"""Which nodes of a fluid's mesh get unknowns for what is different on both sides of a curve.

A pressure jumps at a node whose cells the curve divides into two parts. A velocity is kinked at every node of a cell
that is cut. At free ends a node takes part if the curve covers at least half of the zero line in its cells: where two
ends touch the surface is tight, and a gap of a cell and more lets the fluid through.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from mpi4py import MPI
from dolfinx import fem
from scipy.spatial import cKDTree

from coudalfish.surface.cut_cells import CutCells
from coudalfish.surface.distance import Curves, Nearest, Sought
from coudalfish.surface.meeting import Meeting
from tigar_x import checks, compat
from tigar_x.compat import FloatArray, IntArray

DIVIDED = 1e-5
"""Share of the area of a node's cells that each part has to have for its pressure to jump."""
SLIVER = 1e-6
"""Share of a cell below which its velocity is not kinked: it bends as good as nowhere."""
COVERED = 0.5
"""Share of the zero line in a node's cells that the curve has to cover."""
ROUNDED = 1e-9
"""Part of that share that sums in another order may lack."""
OFF_LINE = 1.0 / 3.0
"""Distance of the zero line from the curve, relative to that of the cell's farthest node, beyond which it is another
line, unless a curve crosses the cell where its sign changes: half way between two curves it may change as well."""
SAMPLES = 16
"""Places at which a piece of the zero line near a free end is asked whether the curve covers it."""
CORRECTIONS = 2
"""How often the signed distance is corrected by its means over the curve around every node."""
BESIDE = 0.1
"""Distance of the zero line from a place on the curve, relative to the cell, beyond which it is another curve's."""
ALONG = 1e-12
"""Distance, likewise, that is none: signs of nodes on the curve are not left to rounding."""
NEAR = 1.5
"""Distance from the curve, in sizes of the largest cell, up to which sides are known."""
REACH = 4.0
"""The same near its free ends."""
ON_LINE = 1e-12
"""Distance, in sizes of the largest cell, within which a node lies on a curve: rounding must not decide on its side."""


@dataclass(frozen=True, eq=False)
class Enrichment:
    """What a curve does to a mesh.

    Attributes:
        phi: signed distance at the nodes, corrected so that its zero line is where the curve is on average, not a
            number far away, shape (nodes,); unit: length.
        cut: cells in which one of the nodes is enriched, ghosts as well.
        jump: mask of the nodes at which the pressure jumps, shape (nodes,).
        kink: mask of the nodes at which the velocity is kinked, shape (nodes,).
        velocity: that of the curve at the nodes near it, zero at others, shape (nodes, d); unit: length/time; None: it
            rests.
    """

    phi: FloatArray
    cut: CutCells
    jump: Any
    kink: Any
    velocity: FloatArray | None = None

    def __post_init__(self) -> None:
        checks.freeze(self)

    @cached_property
    def known(self) -> FloatArray:
        """The signed distance, zero where it is not known, shape (nodes,)."""
        return np.where(np.isfinite(self.phi), self.phi, 0.0)


class Enriching:
    """Finds the enrichment of a mesh of triangles by curves.

    Args:
        space: scalar linear space of the mesh.
        kinked: whether velocities are kinked; pressures always jump.
    """

    def __init__(self, space: fem.FunctionSpace, *, kinked: bool) -> None:
        self._kinked, self._sum = kinked, fem.Function(space)
        self._comm = space.mesh.comm
        self.vertices = compat.cell_dofs(space)
        self.x = space.tabulate_dof_coordinates()[:, : space.mesh.geometry.dim]
        self._tree, self._every = cKDTree(self.x), np.arange(len(self.x))
        self.corners = self.x[self.vertices]
        arms = self.corners[:, 1:] - self.corners[:, :1]
        self._areas = 0.5 * np.abs(np.linalg.det(arms))
        size = float(np.linalg.norm(arms, axis=2).max(initial=0.0))
        self.largest = self._comm.allreduce(size, op=MPI.MAX)
        self.owned = compat.owned_cells(space.mesh)
        nodes, areas = self.vertices[: self.owned], self._areas[: self.owned]
        self._support = self._total(nodes, np.broadcast_to(areas[:, None], nodes.shape))

    def _total(self, nodes: IntArray, values: FloatArray) -> FloatArray:
        """Sums at all nodes, over the ranks, of values at some of them, which may be the same (collective)."""
        sums = np.asarray(np.bincount(nodes.ravel(), values.ravel(), len(self.x)), dtype=np.float64)
        if self._comm.size == 1:
            return sums
        self._sum.x.array[:] = sums
        compat.accumulate(self._sum)
        return np.asarray(self._sum.x.array.copy())

    def __call__(self, curves: Curves, meeting: Meeting | None = None, v: FloatArray | None = None) -> Enrichment:
        """By curves where they are (collective).

        Args:
            curves: the curves.
            meeting: how they meet the mesh, by which the signed distance is corrected; None: it is not.
            v: velocities of their points, shape (points, d); unit: length/time. None: they rest.
        """
        phi, near = self._distances(curves)
        if meeting is not None:
            phi = self._on_line(self._centred(phi, meeting))
        cut = CutCells.of(self.vertices, phi)
        lengths, share = self._lines(cut, curves)
        real, nodes = lengths >= 0.0, self.vertices[cut.cells]
        mine = np.where(real & (cut.cells < self.owned), 1.0, 0.0)[:, None]
        other = np.where(cut.values < 0.0, 1.0 - cut.negative_share[:, None], cut.negative_share[:, None])
        other = self._total(nodes, mine * other * self._areas[cut.cells, None])
        jump = (other > DIVIDED * self._support) & (other < (1.0 - DIVIDED) * self._support)
        whole, found = lengths[:, None] * mine, (lengths * share)[:, None] * mine
        of_nodes = np.broadcast_to(whole, nodes.shape), np.broadcast_to(found, nodes.shape)
        whole, found = (self._total(nodes, values) for values in of_nodes)
        covered = found >= COVERED * (1.0 - ROUNDED) * whole
        jump &= covered
        kink = np.zeros_like(jump)
        if self._kinked:
            bent = mine * (cut.smaller_share[:, None] > SLIVER)
            kink = (self._total(nodes, np.broadcast_to(bent, nodes.shape)) > 0.0) & covered
        concerned = (jump | kink)[nodes].any(axis=1)
        return Enrichment(phi, cut.only(real & concerned), jump, kink, None if v is None else near.values(v))

    def _centred(self, phi: FloatArray, meeting: Meeting) -> FloatArray:
        """Values with a zero line from which the curve departs to both sides alike (collective).

        The line between points of a bent curve is on its inner side, and a jump of the pressure there makes a pair with
        the forces on the curve.
        """
        (E, areas), nodes, cells = meeting.penalty, meeting.seen, meeting.location.cells
        E_t, values = E.T, phi[self.vertices[cells]]
        spread = np.where(cells >= 0, values.max(axis=1) - values.min(axis=1), 0.0)
        for _ in range(CORRECTIONS):
            off = E @ phi[nodes]
            size = np.abs(off)
            off[size <= ALONG * spread] = 0.0
            w = np.where(size <= BESIDE * spread, areas, 0.0)
            area, sums = (self._total(nodes, E_t @ values) for values in (w, w * off))
            phi = phi - np.divide(sums, area, out=np.zeros_like(sums), where=area > 0.0)
        return phi

    def _on_line(self, phi: FloatArray) -> FloatArray:
        """Values of which those are zero that rounding alone keeps from it: 0 counts as positive on every rank."""
        return np.where(np.abs(phi) <= ON_LINE * self.largest, 0.0, phi)

    def _distances(self, curves: Curves) -> tuple[FloatArray, Nearest]:
        """Signed distances of the nodes, by normals of which those of different curves agree (collective).

        Half way between two curves the side changes for no reason where their normals do not, and which way they are
        parametrised must not matter. So of every pair one is turned unless of the edges of the mesh that lead from the
        neighbourhood of the one into that of the other most stay on one side, or have two sides where they cross a
        curve or its continuation: two curves in one cell are as good as one. The first curve keeps its normals.
        """
        far, tree = REACH * self.largest, self._tree
        at_ends = Sought(curves.near_ends(self.x, far, tree), far)
        near = curves.nearest(self.x, Sought(self._every, NEAR * self.largest, tree), at_ends)
        phi = self._on_line(near.signed_distance())
        number = int(curves.chain.curve.max(initial=-1)) + 1
        if number < 2:
            return phi, near
        edges = self.vertices[: self.owned][:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
        nearest = near.curve()
        a, b = nearest[edges].T
        between = (a != b) & (a >= 0) & (b >= 0)
        edges, a, b = edges[between], a[between], b[between]
        negative = phi[edges] < 0.0
        apart = curves.crossed(self.x[edges[:, 0]], self.x[edges[:, 1]], far)
        votes = np.zeros((number, number))
        np.add.at(votes, (a, b), np.where((negative[:, 0] != negative[:, 1]) == apart, 1.0, -1.0))
        self._comm.Allreduce(MPI.IN_PLACE, votes, op=MPI.SUM)
        turned = agreeing(votes + votes.T)
        return np.where(nearest < 0, phi, turned[nearest] * phi), near

    def _lines(self, cut: CutCells, curves: Curves) -> tuple[FloatArray, FloatArray]:
        """Lengths of the zero line in cut cells, and the shares of them that the curve covers, shape (cut,).

        A length is -1 where no curve or its continuation cuts the cell, but the middle line between two curves that are
        elsewhere.
        """
        ends, n = cut.line(self.corners), len(cut.cells)
        arms, middle = ends[:, 1] - ends[:, 0], 0.5 * (ends[:, 0] + ends[:, 1])
        close = curves.near_ends(middle, 2.0 * self.largest)
        at = ((np.arange(SAMPLES) + 0.5) / SAMPLES)[:, None]
        samples = (ends[close, None, 0] + at * arms[close, None]).reshape(-1, middle.shape[1])
        x, in_middle = np.concatenate([middle, samples]), Sought(np.arange(n), OFF_LINE * NEAR * self.largest)
        near = curves.nearest(x, in_middle, Sought(np.arange(n, len(x)), REACH * self.largest))
        covered = near.covered().astype(np.float64)
        share = covered[:n]
        share[close] = covered[n:].reshape(-1, SAMPLES).mean(axis=1)
        off = np.abs(near.signed_distance()[:n])
        real = off <= OFF_LINE * np.abs(cut.values).max(axis=1, initial=0.0)
        rest = np.flatnonzero(~real)
        corners, negative = self.corners[cut.cells[rest]], cut.values[rest] < 0.0
        for a, b in ((0, 1), (1, 2), (2, 0)):
            crossed = curves.crossed(corners[:, a], corners[:, b], REACH * self.largest)
            real[rest] |= (negative[:, a] != negative[:, b]) & crossed
        return np.where(real, np.sqrt(np.einsum("ci,ci->c", arms, arms)), -1.0), share


def agreeing(votes: FloatArray) -> FloatArray:
    """Signs of things of which each pair wants to have the same one or not, by the strongest wishes first.

    Args:
        votes: symmetric matrix, positive where two want the same sign and negative where they do not.

    Returns:
        1 or -1 for each; of those that are connected the first one has 1.
    """
    signs, group = np.ones(len(votes)), np.arange(len(votes))
    a, b = np.triu_indices(len(votes), 1)
    for k in np.argsort(-np.abs(votes[a, b]), kind="stable"):
        i, j, vote = a[k], b[k], votes[a[k], b[k]]
        if vote != 0.0 and group[i] != group[j]:
            other = group == group[j]
            signs[other] *= signs[i] * signs[j] * np.sign(vote)
            group[other] = group[i]
    first = np.unique(group, return_index=True)
    return np.asarray(signs * signs[first[1]][np.searchsorted(first[0], group)])
