"""Triangles that the zero line of a linear function divides, and the triangles of which their two sides are made."""

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from dolfinx import fem

from tigar_x import checks, compat
from tigar_x.compat import FloatArray, IntArray

FLAT = 1e-12
"""Share of the area of a triangle below which a part of it is none."""


def alone(values: FloatArray) -> tuple[IntArray, Any]:
    """The vertex that is alone on its side, and whether that is the negative one; zero counts as positive.

    Args:
        values: the function at the vertices of divided triangles, shape (n, 3).
    """
    negative = values < 0.0
    of_negative = negative.sum(axis=1) == 1
    return np.where(of_negative, negative.argmax(axis=1), (~negative).argmax(axis=1)), of_negative


def corner(values: FloatArray) -> FloatArray:
    """Barycentric coordinates of the triangle at that vertex, itself and both ends of the zero line, shape (n, 3, 3).

    Args:
        values: as in :func:`alone`.
    """
    lone, _ = alone(values)
    row = np.arange(len(lone))
    result = np.zeros((len(lone), 3, 3))
    result[row, 0, lone] = 1.0
    for end in (1, 2):
        other = (lone + end) % 3
        phi = values[row, lone]
        t = phi / (phi - values[row, other])
        result[row, end, lone], result[row, end, other] = 1.0 - t, t
    return result


@dataclass(frozen=True, eq=False)
class SidedPieces:
    """Triangles within cells, each on one side.

    Attributes:
        cells: the cell of each, shape (pieces,).
        barycentric: coordinates of its vertices there, in the direction in which the cell goes, shape (pieces, 3, 3).
        side: -1 or 1, shape (pieces,).
    """

    cells: IntArray
    barycentric: FloatArray
    side: FloatArray

    def __post_init__(self) -> None:
        checks.freeze(self)

    @classmethod
    def of(cls, cells: IntArray, values: FloatArray) -> "SidedPieces":
        """Those of divided cells, without such as have no area.

        Args:
            cells: their numbers, shape (n,).
            values: as in :func:`alone`.
        """
        lone, of_negative = alone(values)
        tip, row = corner(values), np.arange(len(lone))
        (p, q), (b, c) = (tip[:, 1], tip[:, 2]), (np.eye(3)[(lone[row] + end) % 3] for end in (1, 2))
        parts = np.stack([tip, np.stack([p, b, c], axis=1), np.stack([p, c, q], axis=1)], axis=1).reshape(-1, 3, 3)
        sign = np.where(of_negative, -1.0, 1.0)
        side = np.column_stack([sign, -sign, -sign]).ravel()
        real = np.abs(np.linalg.det(parts)) > FLAT
        return cls(np.repeat(cells, 3)[real], parts[real], side[real])

    def linear(self, function: fem.Function) -> FloatArray:
        """Values of a linear function that is the same on both sides, shape (pieces, 3, components)."""
        V = function.function_space
        nodal = function.x.array.reshape(-1, V.dofmap.index_map_bs)[compat.cell_dofs(V)[self.cells]]
        return np.asarray(self.barycentric @ nodal)


class Sided(Protocol):
    """A linear function with more values than those at its nodes, such as varmint's ``Flow(...).sides``.

    Attributes:
        function: the function.
    """

    @property
    def function(self) -> fem.Function:
        """The function."""

    def pieces(self) -> SidedPieces:
        """Pieces of the cells of this rank that are divided."""

    def of_pieces(self, pieces: SidedPieces) -> FloatArray:
        """The function at the vertices of pieces, on their sides, shape (pieces, 3, components)."""
