"""Two sheets in space with a film between them that the fluid's mesh does not resolve.

A node has two pressures, that on its own side and that behind the surface. Where sheets lie one above the other, with
normals that agree, there are three: below, in the film, and above. The film has the pressure of the side towards which
the sheets are pushed, so that the sheet on the other side carries the whole jump, and is pressed on the first one as
contact has it. Which one that is holds for the whole film of two sheets; a step whose multiplier says the opposite of
the one from which it started is taken again, as the first one under a sudden load. Where normals of sheets disagree, as
those of leaflets that close a valve, both sides have the same pressure, and the film has one of its own.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from mpi4py import MPI

from coudalfish.surface.interface import Sought
from coudalfish.surface.surfaces import NearestOnSurfaces, Surfaces
from tigar_x.compat import FloatArray, IntArray

FILM = 1.2
"""Distance of two sheets, in lengths of the longest edges of cells, up to which they have a film between them."""
AGREE = 0.5
"""Product of unit normals from which on they agree."""
WISH = 1e-6
"""What a node in a film counts for the signs of normals, relative to an edge that leads past the film."""
ROUNDED = 1e-9
"""Part of that distance that rounding may lack."""
ALIKE = 0.8
"""Part of the push that all loads of two sheets together would have on them from which on they push one way."""


@dataclass(frozen=True, eq=False)
class Film:
    """Nodes near a film between the sheet that is nearest to them and another one.

    Attributes:
        other: number of that.
        nodes: their numbers.
        covered: mask of those that are not beyond a free end of either.
        distance: from the other sheet, with the sign of its own normals; unit: length.
        agree: product of the unit normals of both sheets.
        away: from the nearest place to that on the other sheet, shape (nodes, 3); unit: length.
        places: the nearest ones, and those on the other sheet.
    """

    other: int
    nodes: IntArray
    covered: Any
    distance: FloatArray
    agree: FloatArray
    away: FloatArray
    places: tuple[NearestOnSurfaces, NearestOnSurfaces]

    def work(self, load: FloatArray) -> FloatArray:
        """Work of forces per area on both sheets that would move from the first one to the other.

        Args:
            load: at the corners of the triangles, shape (corners, 3).

        Returns:
            At the nodes, shape (nodes,).
        """
        one, other = (near.of_corners(load) for near in self.places)
        return np.asarray(np.einsum("ni,ni->n", one + other, self.away))


class Films:
    """Films near the nodes of a mesh.

    Args:
        comm: of the mesh.
        surfaces: the sheets.
        load: force per area by which the fluid pushes the points of the sheets, shape (points, 3).
        x: nodes, shape (m, 3); unit: length.
        near: their nearest places.
        sizes: of the cells around the nodes, shape (m,); unit: length.
        owned: number of the nodes that are this rank's, which are the first: sums are over those of all ranks.

    Attributes:
        carrying: number of the sheet from which the signed distance of each node is, -1: of none, shape (m,).
    """

    carrying: IntArray

    def __init__(
        self,
        comm: MPI.Comm,
        surfaces: Surfaces,
        load: FloatArray,
        x: FloatArray,
        near: NearestOnSurfaces,
        sizes: FloatArray,
        owned: int,
    ) -> None:
        self._comm, self._load, self._number, self._owned = comm, load, surfaces.sheets, owned
        self._functions = surfaces.net.functions
        self._sheet, self._phi = near.sheet(), near.signed_distance()
        gap, covered, first, distances = near.gaps(), near.covered(), near.normals(), near.distances()
        self._films: list[Film] = []
        for k in range(surfaces.sheets):
            here, reach = np.flatnonzero((self._sheet >= 0) & (self._sheet != k)), FILM * sizes
            here = here[surfaces.near_sheet(k, x[here] - gap[here], (1.0 + ROUNDED) * reach[here])]
            sought = Sought(np.arange(len(here)), distances[here] + reach[here])
            other = surfaces.nearest(x[here], sought, sheet=k)
            away = gap[here] - other.gaps()
            close = np.flatnonzero((other.sheet() == k) & (np.linalg.norm(away, axis=1) <= reach[here]))
            here, away, other = here[close], away[close], other.of(close)
            agree = np.einsum("ni,ni->n", first[here], other.normals())
            there, places = covered[here] & other.covered(), (near.of(here), other)
            self._films.append(Film(k, here, there, other.signed_distance(), agree, away, places))

    def past(self, edges: IntArray, nearest: IntArray) -> Any:
        """Mask of edges that neither begin nor end at a film between the sheets that are nearest to their ends.

        Args:
            edges: pairs of nodes, shape (n, 2).
            nearest: numbers of these sheets, same shape.
        """
        result = np.ones(len(edges), dtype=bool)
        for film in self._films:
            there = np.zeros(len(self._sheet), dtype=bool)
            there[film.nodes] = True
            for here, opposite in ((0, 1), (1, 0)):
                result &= ~(there[edges[:, here]] & (nearest[:, opposite] == film.other))
        return result

    def wishes(self, number: int) -> FloatArray:
        """That normals of sheets with a film between them agree, where nothing else speaks for or against it.

        Args:
            number: of the sheets.

        Returns:
            Shape (number, number), positive where they do.
        """
        result = np.zeros((number, number))
        for film in self._films:
            wish = WISH * film.agree * (film.covered & (film.nodes < self._owned))
            result[:, film.other] += np.bincount(self._sheet[film.nodes], wish, number)
        return result

    def signed_distance(self, turned: FloatArray) -> FloatArray:
        """From the nearest sheet or, near a film, from that which carries the jump, shape (m,) (collective).

        Args:
            turned: signs of the sheets' normals.

        Returns:
            Unit: length.
        """
        self._turned, self.carrying = turned, self._sheet.copy()
        result = np.where(self._sheet < 0, 1.0, turned[self._sheet]) * self._phi
        self._at_first = pushed, _ = self._pushed(self._load)
        self._carries = (pushed < 0.0) | ((pushed == 0.0) & np.tri(self._number, dtype=bool))
        for film in self._films:
            carries = self._above(film) & self._carries[self._sheet[film.nodes], film.other]
            result[film.nodes[carries]] = turned[film.other] * film.distance[carries]
            self.carrying[film.nodes[carries]] = film.other
        return result

    def suit(self, load: FloatArray) -> bool:
        """Whether those sheets carry the jump that should under a load, where that is as clear as it was (collective).

        Args:
            load: force per area, see above.
        """
        (pushed, together), (before, all_before) = self._pushed(load), self._at_first
        clear = (np.abs(pushed) > ALIKE * together) & (np.abs(before) >= ALIKE * all_before)
        return not (((pushed < 0.0) != self._carries) & clear).any()

    def _above(self, film: Film) -> Any:
        """Mask of its nodes where the sheets lie one above the other with normals that agree."""
        agree = self._turned[self._sheet[film.nodes]] * self._turned[film.other] * film.agree > AGREE
        return agree & film.covered

    def _pushed(self, load: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Work of a load on two sheets that would move from the first one to the other (collective).

        Returns:
            Sums over the nodes of their films and sums of the sizes, shape (sheets, sheets) each.
        """
        sums, load = np.zeros((2, self._number, self._number)), self._functions @ load
        for film in self._films:
            above = self._above(film) & (film.nodes < self._owned)
            if not above.any():
                continue
            here, work = self._sheet[film.nodes[above]], film.work(load)[above]
            for total, values in zip(sums, (work, np.abs(work)), strict=True):
                total[:, film.other] += np.bincount(here, values, self._number)
        self._comm.Allreduce(MPI.IN_PLACE, sums, op=MPI.SUM)
        return sums[0] - sums[0].T, sums[1] + sums[1].T
