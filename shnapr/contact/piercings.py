"""Whether surfaces go through each other."""

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from tigar_x import checks
from tigar_x.compat import FloatArray, IntArray


def piercings(x: ArrayLike, quads: IntArray, X: ArrayLike | None = None, apart: float = 0.0) -> int:
    """Number of pairs of an edge of a net of points and a triangle of it that the edge goes through.

    Args:
        x: points, shape (points, 3), in general position: edges that just touch do not count; unit: length.
        quads: quadrilaterals in cyclic order, each cut into two triangles, shape (quadrilaterals, 4).
        X: reference positions of the points, shape (points, 3); None: those of ``x``.
        apart: only edges and triangles whose centres have a larger distance in ``X`` are looked at.

    Returns:
        The number; zero for surfaces that do not cross.

    Raises:
        ValueError: an array has a wrong shape.
    """
    now = checks.array("x", x, (None, 3))
    before = now if X is None else checks.array("X", X, now.shape)
    triangles = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    sides = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    edges = np.unique(np.sort(sides, axis=1), axis=0)
    longest = np.linalg.norm(np.diff(now[edges], axis=1), axis=2).max()
    # half an edge, and two thirds of the longest height of a triangle, lie between the centres at most
    reach, rounding = 1.17 * longest, 1e-12 * longest**3
    found = cKDTree(now[edges].mean(axis=1)).query_ball_tree(cKDTree(now[triangles].mean(axis=1)), reach)
    e = np.repeat(np.arange(len(edges)), [len(near) for near in found])
    f = np.concatenate(found).astype(np.intp)
    far = np.linalg.norm(before[edges[e]].mean(axis=1) - before[triangles[f]].mean(axis=1), axis=1) > apart
    edge, triangle = edges[e[far]], triangles[f[far]]
    strangers = ~(edge[:, :, None] == triangle[:, None, :]).any(axis=(1, 2))
    p, q = now[edge[strangers]].transpose(1, 0, 2)
    a, b, c = now[triangle[strangers]].transpose(1, 0, 2)
    sides_of_plane = np.array([_volume(a, b, c, p), -_volume(a, b, c, q)])
    around = np.array([_volume(p, q, a, b), _volume(p, q, b, c), _volume(p, q, c, a)])
    return int(np.count_nonzero(_one_sign(sides_of_plane, rounding) & _one_sign(around, rounding)))


def _one_sign(values: FloatArray, rounding: float) -> NDArray[np.bool_]:
    """Columns of one sign."""
    return np.asarray((values > rounding).all(axis=0) | (values < -rounding).all(axis=0))


def _volume(a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray) -> FloatArray:
    """Six times the signed volumes of tetrahedra."""
    return np.asarray(np.einsum("ni,ni->n", np.cross(b - a, c - a), d - a))
