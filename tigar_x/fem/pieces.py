"""Triangles that the zero line of a linear function divides."""

from typing import Any

import numpy as np

from tigar_x.compat import FloatArray, IntArray


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
