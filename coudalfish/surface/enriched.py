"""Which nodes of a fluid's mesh get unknowns for what is different on both sides of curves or surfaces.

A pressure jumps at a node whose cells are divided into two parts. A velocity is kinked at every node of a cell that is
cut. At free ends a node takes part if at least half of where the signed distance is zero in its cells is covered: where
two ends touch the surface is tight, and a gap of a cell and more lets the fluid through.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations
from typing import Any, Protocol

import numpy as np
from mpi4py import MPI
from dolfinx import fem
from scipy.spatial import cKDTree

from coudalfish.surface.covering import AROUND, AT_END, Covering, by_curves, by_surfaces
from coudalfish.surface.cut_cells import CutCells
from coudalfish.surface.interface import Interface, Nearest, Sought
from coudalfish.surface.meeting import Meeting
from coudalfish.surface.polygons import ZeroSet, longest_edges
from tigar_x import checks, compat, ranks
from tigar_x.compat import FloatArray, IntArray

DIVIDED = {2: 1e-5, 3: 1e-8}
"""Share of the volume of a node's cells that each part has to have for its pressure to jump, by the dimension."""
IN_FILMS = 1e-5
"""The same in space where there are several sheets, with films between them: where a tip is cut off, .02 cells deep,
jumps grow without bound. A sheet alone has them, and is in equilibrium to rounding at rest."""
SLIVER = 1e-6
"""Share of a cell below which its velocity is not kinked: it bends as good as nowhere."""
COVERED = 0.5
"""Share of where the signed distance is zero in a node's cells that has to be covered."""
ROUNDED = 1e-9
"""Part of that share that sums in another order may lack."""
OFF_LINE = 1.0 / 3.0
"""Distance of where it is zero from the surface, relative to that of the cell's farthest node, beyond which it is
somewhere else, unless the surface crosses the cell where its sign changes: half way between two of them it may change
as well."""
CORRECTIONS = 2
"""How often the signed distance is corrected by its means over the curve around every node."""
BESIDE = 0.1
"""Distance of the zero line from a place on the curve, relative to the cell, beyond which it is another curve's."""
ALONG = 1e-12
"""Distance, likewise, that is none: signs of nodes on the curve are not left to rounding."""
BEHIND = {2: 0.0, 3: AT_END}
"""Distance from free ends, in sizes of cells, up to which the signed distance tells what continuations cut; elsewhere
it is what crosses edges, by the dimension."""
NEAR = 1.1
"""Distance of a node from the surface, in sizes of its largest cell, up to which sides are known: no cut cell has
others."""
REACH = 3.0
"""The same near free ends, behind which cells of nodes count that the surface may divide; in sizes of the largest cell
of the nodes with which it has a cell in common. One surface needs 2; where three leaflets meet 2.5 is too little."""
CONTINUED = 1.0
"""How far a surface is continued behind its free ends where that counts as cutting a cell, in sizes of the cell: half
way between two surfaces the sign changes as well, and farther continuations meet that by chance."""
ON_LINE = 1e-12
"""Distance, in sizes of the largest cell, within which a node lies on the surface: its side is not left to rounding."""


class ThinFilms(Protocol):
    """Films between sheets that are too thin for the mesh, see :class:`coudalfish.surface.films.Films`."""

    def past(self, edges: IntArray, nearest: IntArray) -> Any:
        """Mask of edges that lead past them."""

    def wishes(self, number: int) -> FloatArray:
        """Which signs of normals sheets wish that have a film between them."""

    def signed_distance(self, turned: FloatArray) -> FloatArray:
        """From the sheets that carry the jump of the pressure."""


FindFilms = Callable[[FloatArray, Any, FloatArray, int], ThinFilms]
"""From nodes, their nearest places, the sizes of the cells around them, and how many of them are this rank's."""


@dataclass(frozen=True, eq=False)
class Enrichment:
    """What curves or surfaces do to a mesh.

    Attributes:
        phi: signed distance at the nodes, corrected so that it is zero where the curve or surface is on average, not a
            number far away, shape (nodes,); unit: length.
        cut: cells in which one of the nodes is enriched, ghosts as well.
        zero: what is covered of the lines or polygons on which phi is zero, also in cells of which no node is enriched.
        jump: mask of the nodes at which the pressure jumps, shape (nodes,).
        kink: mask of the nodes at which the velocity is kinked, shape (nodes,).
        velocity: that of the surface at the nodes near it, zero at others, shape (nodes, d); unit: length/time; None:
            it rests.
    """

    phi: FloatArray
    cut: CutCells
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


class Enriching:
    """Finds the enrichment of a mesh of triangles by curves, or of tetrahedra by surfaces.

    Args:
        space: scalar linear space of the mesh.
        kinked: whether velocities are kinked; pressures always jump.

    Attributes:
        x: the nodes, shape (nodes, d); unit: length.
        vertices: those of the cells, shape (cells, d + 1).
        corners: where these are, shape (cells, d + 1, d); unit: length.
        owned: number of the cells that are this rank's, which are the first.
        sizes: lengths of the longest edges of the cells, shape (cells,).
    """

    def __init__(self, space: fem.FunctionSpace, *, kinked: bool) -> None:
        self._kinked, self._sum = kinked, fem.Function(space)
        self._comm = space.mesh.comm
        self.vertices = compat.cell_dofs(space)
        self.x = space.tabulate_dof_coordinates()[:, : space.mesh.geometry.dim]
        self._tree, self._every = cKDTree(self.x), np.arange(len(self.x))
        self.corners = self.x[self.vertices]
        self._d = self.x.shape[1]
        self._edges = np.array(list(combinations(range(self._d + 1), 2)))
        self._covering: Covering = by_curves if self._d == 2 else by_surfaces
        arms = self.corners[:, 1:] - self.corners[:, :1]
        self._volumes = np.abs(np.linalg.det(arms))  # but for a factor
        self._set_sizes(space)
        self._pockets = None
        if self._d == 3:
            from coudalfish.surface.pockets import Pockets  # the plane needs none

            self._pockets = Pockets(space, self._of_nodes, self._total)
        self.owned, self._owned_nodes = compat.owned_cells(space.mesh), space.dofmap.index_map.size_local
        nodes = self.vertices[: self.owned]
        self._support = self._total(nodes, self._volumes[: self.owned, None])

    def _set_sizes(self, space: fem.FunctionSpace) -> None:
        """Longest edges of cells, of the cells of nodes, and of those of the nodes around (collective)."""
        self.sizes = longest_edges(self.corners)
        self._largest = self._comm.allreduce(float(self.sizes.max(initial=0.0)), op=MPI.MAX)
        self._of_nodes = self._largest_around(space, self.sizes)
        self._of_neighbours = self._largest_around(space, self._of_nodes[self.vertices].max(axis=1))

    def _largest_around(self, space: fem.FunctionSpace, of_cells: FloatArray) -> FloatArray:
        """The largest values of the cells around every node (collective)."""
        largest = np.zeros(len(self.x))
        np.maximum.at(largest, self.vertices, of_cells[:, None])
        return compat.maximise(space, largest)

    def _total(self, nodes: IntArray, values: FloatArray) -> FloatArray:
        """Sums at all nodes, over the ranks, of values at nodes of cells, each or one a cell (collective)."""
        values = np.broadcast_to(values, nodes.shape)
        sums = np.asarray(np.bincount(nodes.ravel(), values.ravel(), len(self.x)), dtype=np.float64)
        if self._comm.size == 1:
            return sums
        self._sum.x.array[:] = sums
        compat.accumulate(self._sum)
        return np.asarray(self._sum.x.array.copy())

    @property
    def nothing(self) -> Enrichment:
        """That without a surface."""
        nodes, d = self.x.shape
        cut = CutCells(np.empty(0, dtype=np.int32), np.empty((0, d + 1)))
        zero = ZeroSet.of(cut, np.empty((0, d + 1, d)))
        return Enrichment(np.full(nodes, np.nan), cut, zero, *np.zeros((2, nodes), dtype=bool))

    def __call__(
        self,
        interface: Interface,
        meeting: Meeting | None = None,
        v: FloatArray | None = None,
        films: FindFilms | None = None,
    ) -> Enrichment:
        """By curves or surfaces where they are (collective).

        Args:
            interface: the curves or surfaces.
            meeting: how they meet the mesh, by which the signed distance is corrected; None: it is not.
            v: velocities of their points, shape (points, d); unit: length/time. None: they rest.
            films: finds films between sheets; None: they are not looked for.
        """
        phi, near = self._distances(interface, films)
        if meeting is not None:
            phi = self._on_line(self._centred(phi, meeting))
        if self._pockets is not None:
            phi = self._pockets.joined(phi, 2.0 * ON_LINE * self._largest)
        cut = CutCells.of(self.vertices, phi)
        zero, real, covered = ranks.together(self._comm, lambda: self._covered(cut, interface))
        nodes, share = self.vertices[cut.cells], cut.negative_share[:, None]
        mine = np.where(real & (cut.cells < self.owned), 1.0, 0.0)[:, None]
        other = np.where(cut.values < 0.0, 1.0 - share, share)
        other = self._total(nodes, mine * other * self._volumes[cut.cells, None])
        least = IN_FILMS if self._d == 3 and interface.sheets > 1 else DIVIDED[self._d]
        jump = (other > least * self._support) & (other < (1.0 - least) * self._support)
        whole, found = (self._total(nodes, of.of_cells(of.sizes())[:, None] * mine) for of in (zero, covered))
        enough = found >= COVERED * (1.0 - ROUNDED) * whole
        jump &= enough
        kink = np.zeros_like(jump)
        if self._kinked:
            bent = np.where(cut.smaller_share[:, None] > SLIVER, mine, 0.0)
            kink = (self._total(nodes, bent) > 0.0) & enough
        concerned = (jump | kink)[nodes].any(axis=1)
        velocity = None if v is None else near.values(v)
        return Enrichment(phi, cut.only(real & concerned), covered, jump, kink, velocity)

    def _centred(self, phi: FloatArray, meeting: Meeting) -> FloatArray:
        """Values with a zero line from which the curve, or surface, departs to both sides alike (collective).

        The line between points of a bent curve is on its inner side, and a jump of the pressure there makes a pair with
        the forces on the curve. The polygons inside of a sphere are smaller than it is: a pressure would be larger.
        """
        (E, areas), nodes, cells = meeting.penalty, meeting.seen, meeting.location.cells
        E_t, spread, mine = E.T, np.zeros(len(cells)), np.flatnonzero(cells >= 0)
        values = phi[self.vertices[cells[mine]]]
        spread[mine] = values.max(axis=1) - values.min(axis=1)
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
        return np.where(np.abs(phi) <= ON_LINE * self._largest, 0.0, phi)

    def _distances(self, interface: Interface, films: FindFilms | None) -> tuple[FloatArray, Nearest]:
        """Signed distances of the nodes, by normals of which those of different sheets agree (collective).

        Half way between two sheets the side changes for no reason where their normals do not, and which way they are
        parametrised must not matter. So of every pair one is turned unless of the edges of the mesh that lead from the
        neighbourhood of the one into that of the other most stay on one side, or have two sides where they cross a
        sheet or its continuation: two sheets in one cell are as good as one. The first one keeps its normals.
        """
        near, phi, thin, votes = ranks.together(self._comm, lambda: self._voted(interface, films))
        if interface.sheets < 2:
            return phi, near
        self._comm.Allreduce(MPI.IN_PLACE, votes, op=MPI.SUM)
        turned = agreeing(votes + votes.T)
        if thin is not None:
            return thin.signed_distance(turned), near
        nearest = near.sheet()
        return np.where(nearest < 0, phi, turned[nearest] * phi), near

    def _voted(
        self, interface: Interface, films: FindFilms | None
    ) -> tuple[Nearest, FloatArray, ThinFilms | None, FloatArray]:
        """Nearest places, signed distances, films and what this rank's edges say of pairs of sheets."""
        far = REACH * self._of_neighbours
        ends, nearby = interface.near_ends(self.x, far), NEAR * self._of_nodes
        near = interface.nearest(self.x, Sought(self._every, nearby, self._tree), Sought(ends, far[ends]))
        phi, number = self._on_line(near.signed_distance()), interface.sheets
        votes = np.zeros((number, number))
        if number < 2:
            return near, phi, None, votes
        nearest = near.sheet()
        sheets = nearest[self.vertices[: self.owned]]
        mixed = (sheets != sheets[:, :1]).any(axis=1)
        edges = self.vertices[: self.owned][mixed][:, self._edges].reshape(-1, 2)
        a, b = nearest[edges].T
        between = (a != b) & (a >= 0) & (b >= 0)
        thin = None if films is None else films(self.x, near, self._of_nodes, self._owned_nodes)
        if thin is not None:
            between[between] = thin.past(edges[between], nearest[edges[between]])
        edges, several = np.unique(np.sort(edges[between], axis=1), axis=0, return_counts=True)
        a, b = nearest[edges].T
        negative = phi[edges] < 0.0
        apart = interface.crossed(self.x[edges[:, 0]], self.x[edges[:, 1]], far[edges].max(axis=1))
        np.add.at(votes, (a, b), np.where((negative[:, 0] != negative[:, 1]) == apart, several, -several))
        if thin is not None:
            votes += thin.wishes(number)
        return near, phi, thin, votes

    def _covered(self, cut: CutCells, interface: Interface) -> tuple[ZeroSet, Any, ZeroSet]:
        """Where the signed distance is zero, which cells a surface or its continuation cuts, and what it covers there.

        In other cells the sign changes as they are half way between two surfaces, shape (cut,).
        """
        corners, sizes = np.take(self.corners, cut.cells, axis=0), self.sizes[cut.cells]
        zero, far = ZeroSet.of(cut, corners), self._of_neighbours[self.vertices[cut.cells]].max(axis=1)
        middles, around = zero.middles(), far[zero.rows]
        at_ends = interface.near_ends(middles, BEHIND[self._d] * around)
        reach = AROUND * sizes[zero.rows]
        everywhere = Sought(np.arange(len(middles)), reach)
        near = interface.nearest(middles, everywhere, Sought(at_ends, REACH * around[at_ends]))
        off, largest = np.abs(near.signed_distance()), np.abs(cut.values).max(axis=1, initial=0.0)
        real = zero.of_cells(np.where(off <= OFF_LINE * largest[zero.rows], 0.0, 1.0)) == 0.0
        a, b = self._edges.T
        cell, edge = np.nonzero(((cut.values[:, a] < 0.0) != (cut.values[:, b] < 0.0)) & ~real[:, None])
        start, end = corners[cell, a[edge]], corners[cell, b[edge]]
        real[cell[interface.crossed(start, end, CONTINUED * sizes[cell])]] = True
        kept = real[zero.rows]
        if self._d == 3:
            zero = replace(zero, nearest=near.triangle(reach))  # type: ignore[attr-defined]
        covered = self._covering(zero.only(kept), interface, sizes[zero.rows[kept]], near.covered()[kept])
        return zero, real, covered


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
