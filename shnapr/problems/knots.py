"""Knots that curves in space make, by their crossings.

Source of the invariant: R. H. Fox, "A quick trip through knot theory", in Topology of 3-Manifolds, Prentice-Hall 1962.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from tigar_x import checks
from tigar_x.compat import FloatArray


@dataclass(frozen=True, eq=False)
class Crossings:
    """Crossings of a closed polygon seen from above, along its lower passages.

    Attributes:
        over: places of the upper strands along the polygon, counted in vertices, shape (crossings,).
        under: places of the lower strands, ascending.
        signs: +1 where the upper strand has to turn to the left to point along the lower one, else -1.
    """

    over: FloatArray
    under: FloatArray
    signs: FloatArray

    def __post_init__(self) -> None:
        checks.freeze(self)

    @classmethod
    def of(cls, polygon: ArrayLike) -> "Crossings":
        """Crossings of a closed polygon.

        Args:
            polygon: its vertices, shape (any, 3), in general position: no three strands cross in one place.

        Returns:
            The crossings.

        Raises:
            ValueError: the polygon has a wrong shape.
        """
        x = checks.array("polygon", polygon, (None, 3))
        ahead = np.roll(x, -1, axis=0) - x
        i, j = np.triu_indices(len(x), 2)
        turn = _turn(ahead[i], ahead[j])
        crossing = turn != 0.0
        i, j, turn = i[crossing], j[crossing], turn[crossing]
        a, b, gap = ahead[i], ahead[j], x[j] - x[i]
        s, t = _turn(gap, b) / turn, _turn(gap, a) / turn
        # the first and the last side share a vertex
        hit = (s >= 0.0) & (s < 1.0) & (t >= 0.0) & (t < 1.0) & ~((i == 0) & (j == len(x) - 1))
        i, j, s, t, a, b, gap, turn = (value[hit] for value in (i, j, s, t, a, b, gap, turn))
        first_below = s * a[:, 2] < gap[:, 2] + t * b[:, 2]
        under, over = np.where(first_below, (i + s, j + t), (j + t, i + s))
        order = np.argsort(under)
        signs = np.sign(np.where(first_below, -turn, turn))
        return cls(over[order], under[order], signs[order])

    @property
    def writhe(self) -> int:
        """Sum of the signs."""
        return int(self.signs.sum())

    @property
    def determinant(self) -> int:
        """Determinant of the knot, the same in all positions that a closed curve takes without passing itself.

        It is 1 for a ring, 3 for a trefoil, and that of two knots tied one after the other is the product of theirs. It
        comes as a minor of the matrix which says that at every crossing twice the colour of the upper arc is the sum of
        those of the lower ones; arcs run from one lower passage to the next.
        """
        n = len(self.under)
        if n == 0:
            return 1
        rows, matrix = np.arange(n), np.zeros((n, n))
        np.add.at(matrix, (rows, np.searchsorted(self.under, self.over) % n), 2.0)
        np.add.at(matrix, (rows, rows), -1.0)
        np.add.at(matrix, (rows, (rows + 1) % n), -1.0)
        return round(abs(np.linalg.det(matrix[1:, 1:])))


def joined(first: FloatArray, second: FloatArray) -> FloatArray:
    """Closed polygon of two lines along the second axis, each from its end at x_2 > 0.

    Args:
        first: its vertices, shape (any, 3).
        second: likewise; the ends of both are joined around the outside.
    """
    aside = np.array([0.0, 2.0 * max(np.abs(first[:, 1]).max(), np.abs(second[:, 1]).max()), 0.0])
    far = [first[-1] - aside, second[-1] - aside, second[0] + aside, first[0] + aside]
    return np.concatenate([first, far[:2], second[::-1], far[2:]])


def _turn(a: FloatArray, b: FloatArray) -> FloatArray:
    """Third component of the cross products, positive where b points to the left of a."""
    return np.asarray(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
