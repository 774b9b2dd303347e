"""Two sheets in space with a film between them that the fluid's mesh does not resolve.

A node has two pressures, that on its own side and that behind the surface. Where sheets lie one above the other, with
normals that agree, there are three: below, in the film, and above. The film has the pressure of the side towards which
the sheets are pushed, so that the sheet on the other side carries the whole jump, and is pressed on the first one as
contact has it. Where normals of sheets disagree, as those of leaflets that close a valve, both sides have the same
pressure, and the film has one of its own.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from coudalfish.surface.interface import Sought
from coudalfish.surface.surfaces import NearestOnSurfaces, Surfaces
from tigar_x.compat import FloatArray, IntArray

FILM = 1.2
"""Distance of two sheets, in lengths of the longest edges of cells, up to which they have a film between them."""
AGREE = 0.5
"""Product of unit normals from which on they agree."""
WISH = 1e-6
"""What a node in a film counts for the signs of normals, relative to an edge that leads past the film."""


@dataclass(frozen=True, eq=False)
class Film:
    """Nodes near a film between the sheet that is nearest to them and another one.

    Attributes:
        other: number of that.
        nodes: their numbers.
        distance: from the other sheet, with the sign of its own normals; unit: length.
        agree: product of the unit normals of both sheets.
        away: from the nearest place to that on the other sheet, shape (nodes, 3); unit: length.
        pushed: force per area on both together, same shape.
    """

    other: int
    nodes: IntArray
    distance: FloatArray
    agree: FloatArray
    away: FloatArray
    pushed: FloatArray


class Films:
    """Films near the nodes of a mesh.

    Args:
        surfaces: the sheets.
        load: force per area by which the fluid pushes the points of the sheets, shape (points, 3).
        x: nodes, shape (m, 3); unit: length.
        near: their nearest places.
        sizes: of the cells around the nodes, shape (m,); unit: length.
    """

    def __init__(
        self, surfaces: Surfaces, load: FloatArray, x: FloatArray, near: NearestOnSurfaces, sizes: FloatArray
    ) -> None:
        self._sheet, self._phi = near.sheet(), near.signed_distance()
        gap, pushed, covered, first = _gaps(near), near.values(load), near.covered(), self._phi
        self._films = []
        for k in range(surfaces.sheets):
            here = np.flatnonzero((self._sheet >= 0) & (self._sheet != k) & covered)
            if not len(here):
                continue
            other = surfaces.alone(k).nearest(x, Sought(here, np.abs(first[here]) + FILM * sizes[here]))
            gaps, distance = _gaps(other), other.signed_distance()
            here = here[other.covered()[here]]
            away = gap[here] - gaps[here]
            close = np.linalg.norm(away, axis=1) <= FILM * sizes[here]
            here, away = here[close], away[close]
            normals = [np.sign(d[here])[:, None] * _unit(g[here]) for d, g in ((first, gap), (distance, gaps))]
            agree, load_here = np.einsum("ni,ni->n", *normals), pushed[here] + other.values(load)[here]
            self._films.append(Film(k, here, distance[here], agree, away, load_here))

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
            result[:, film.other] += np.bincount(self._sheet[film.nodes], WISH * film.agree, number)
        return result

    def signed_distance(self, turned: FloatArray) -> FloatArray:
        """From the nearest sheet or, near a film, from that which carries the jump, shape (m,); unit: length.

        Args:
            turned: signs of the sheets' normals.
        """
        result = np.where(self._sheet < 0, 1.0, turned[self._sheet]) * self._phi
        for film in self._films:
            here = self._sheet[film.nodes]
            above = turned[here] * turned[film.other] * film.agree > AGREE
            towards = np.einsum("ni,ni->n", film.pushed, film.away)
            carries = above & ((towards < 0.0) | ((towards == 0.0) & (film.other < here)))
            result[film.nodes[carries]] = turned[film.other] * film.distance[carries]
        return result


def _gaps(near: NearestOnSurfaces) -> FloatArray:
    """From the nearest places to the points, zero where one is farther, shape (m, 3); unit: length."""
    result = np.zeros((near.count, 3))
    point, first = np.unique(near.point, return_index=True)
    result[point] = near.gap[first]
    return result


def _unit(vectors: FloatArray) -> FloatArray:
    lengths = np.linalg.norm(vectors, axis=1)
    return np.asarray(vectors / np.where(lengths > 0.0, lengths, 1.0)[:, None])
