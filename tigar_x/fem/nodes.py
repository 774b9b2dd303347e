"""What a preconditioner may know of the nodes behind the rows of a matrix, and aggregates of them."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tigar_x.compat import FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class RowNodes:
    """The nodes of this rank's rows of a node-blocked matrix.

    Attributes:
        x: where they are, shape (nodes, 3).
        held: mask of the unknowns that strong conditions hold, shape (nodes, unknowns of a node).
        group: nodes of different groups are in different aggregates, shape (nodes,); None: there is one group.
        weak: gives the mask of the nodes whose last unknown, a pressure, has a weak diagonal, shape (nodes,)
            (collective); None: no node has.
        floating: whether that unknown is determined up to a constant.
    """

    x: FloatArray
    held: Any
    group: IntArray | None = None
    weak: Callable[[], Any] | None = None
    floating: bool = False


def aggregates(x: FloatArray, size: int, group: IntArray | None = None) -> NDArray[np.int64]:
    """Aggregates of points: boxes that are halved across their longest side until they are small enough.

    Args:
        x: the points, shape (points, d).
        size: points of an aggregate, at most.
        group: points of different groups are in different aggregates, shape (points,); None: there is one group.

    Returns:
        Number of each point's aggregate, from zero on, shape (points,).
    """
    number, count = np.empty(len(x), dtype=np.int64), 0
    labels = np.zeros(len(x), dtype=np.int64) if group is None else group
    parts = [np.flatnonzero(labels == label) for label in np.unique(labels)[::-1]]
    while parts:
        part = parts.pop()
        if len(part) <= size:
            number[part], count = count, count + 1
            continue
        along = x[part, np.argmax(np.ptp(x[part], axis=0))]
        half = len(part) // 2
        order = np.argpartition(along, half)
        parts += [part[order[half:]], part[order[:half]]]
    return number
