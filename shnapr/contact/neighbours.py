"""Which points of a shell are neighbours along its surface, and which are only close to each other in space."""

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

from tigar_x.compat import FloatArray
from tigar_x.splines.quadrature import NodalQuadrature

WAY = 2.0
"""Longest way between neighbours, relative to their largest distance: ways go from node to node, and around bends."""
SAME_PLACE = 1e-8
"""Points closer than this, relative to the size of the shell, are one: there, patches are joined."""
BATCH = 512
"""Points from which ways are measured at once: it bounds the memory."""

IndexArray = NDArray[np.intp]


def way_apart(quadrature: NodalQuadrature, distance: float) -> IndexArray:
    """Pairs of points that are close in space and not along the surface, in the reference configuration.

    A way goes from node to node within the cells, and from patch to patch where these have a node in the same place.

    Args:
        quadrature: the points; those of weight zero are left out, but ways may lead over them.
        distance: pairs up to this far apart are looked at; the way between them is longer than twice that. Unit:
            length.

    Returns:
        Pairs (i, j) with i < j, in ascending order, shape (pairs, 2); none if the quadrature has no cells.
    """
    none = np.empty((0, 2), dtype=np.intp)
    if quadrature.cells is None or not len(quadrature.points):
        return none
    X = quadrature.points
    near = cKDTree(X).query_pairs(distance, output_type="ndarray")
    near = near[(quadrature.weights[near] > 0.0).all(axis=1)]
    near = near[np.lexsort((near[:, 1], near[:, 0]))]
    net = _net(X, quadrature.cells)
    found = [none]
    for first in range(0, len(X), BATCH):
        start, stop = np.searchsorted(near[:, 0], (first, first + BATCH))
        pairs = near[start:stop]
        sources, row = np.unique(pairs[:, 0], return_inverse=True)
        if len(sources):
            ways = dijkstra(net, directed=False, indices=sources, limit=WAY * distance)
            found.append(pairs[~np.isfinite(ways[row, pairs[:, 1]])])
    return np.concatenate(found)


def _net(X: FloatArray, cells: NDArray[np.int32]) -> sp.csr_matrix:
    """Lengths between the nodes of every cell, and next to nothing between nodes in the same place."""
    n, size = len(X), cells.shape[1]
    within = np.stack([np.repeat(cells, size, axis=1).ravel(), np.tile(cells, (1, size)).ravel()], axis=1)
    same = cKDTree(X).query_pairs(SAME_PLACE * np.ptp(X, axis=0).max(), output_type="ndarray")
    pairs = np.unique(np.concatenate([within[within[:, 0] < within[:, 1]], same]).astype(np.intp), axis=0)
    lengths = np.linalg.norm(np.subtract(*(X[end] for end in pairs.T)), axis=1)
    # an edge of length zero would be none
    return sp.csr_matrix((np.maximum(lengths, np.finfo(float).tiny), tuple(pairs.T)), shape=(n, n))
