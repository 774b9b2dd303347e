"""Hat functions on the reference surface of a shell, coarser than its points: what a converged multiplier is made of.

A grid of its own lies over every patch, in lengths along the patch's own parameters, so that patches that are mirror
images have mirrored functions whatever the directions of their parameters. At joints of curves the functions go on.
"""

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

from coudalfish.surface.sheets import Sheets
from tigar_x import checks
from tigar_x.compat import FloatArray, IntArray
from tigar_x.splines.spline import ExtractedSpline

SAME_PARAMETER = 1e-9
"""Difference of parameters, relative to the patch, within which points are in one line of its grid."""
SMALL = 0.2
"""Area of a hat function relative to that of a cell of the grid below which it is merged with a neighbour."""


def hat_functions(spline: ExtractedSpline, sheets: Sheets, weights: FloatArray, size: float) -> sp.csr_matrix:
    """Hat functions at the points of a shell, which sum to one there but for the signs of the patches.

    Args:
        spline: lives whole on this rank, of tensor cells.
        sheets: how its points hang together; functions agree across joints along normals that do.
        weights: reference areas of the points, shape (points,).
        size: of the grid's cells, about; unit: length.

    Returns:
        Values, one column for every function, shape (points, functions).

    Raises:
        ValueError: the points of a patch are no tensor grid, as on triangles.
    """
    checks.positive("size", size)
    functions, xi = spline.geometry.functions, spline.scalar.V.tabulate_dof_coordinates()[:, : spline.dim]
    patch, X = functions.patch_of(xi), spline.node_positions
    blocks, rows = [], []
    for k in range(len(functions.bases)):
        mine = np.flatnonzero(patch == k)
        blocks.append(_patch_functions(xi[mine], X[mine], size))
        rows.append(mine)
    N = sp.block_diag(blocks, format="csc")
    N = N[:, np.diff(N.indptr) > 0].tocsr()[np.argsort(np.concatenate(rows))]  # elements may be larger than functions
    if spline.dim == 1:
        N = _joined(N, sheets.joints)
    N = _without_small_ones(N, weights, SMALL * size**spline.dim)
    return sp.csr_matrix(sp.diags(sheets.sign) @ N)


def _patch_functions(xi: FloatArray, X: FloatArray, size: float) -> sp.csr_matrix:
    """Products of hat functions of the lengths along the parameters, shape (points, functions)."""
    box = np.ptp(xi, axis=0)
    lines = [np.unique(np.round(x / (s * SAME_PARAMETER)), return_inverse=True) for x, s in zip(xi.T, box, strict=True)]
    places: list[IntArray] = [place.ravel() for _, place in lines]
    shape = tuple(len(values) for values, _ in lines)
    if np.prod(shape) != len(xi):
        raise ValueError(f"{len(xi)} points of a patch are no tensor grid of {shape}: tensor cells are required")
    grid = X[np.lexsort(places[::-1])].reshape(*shape, -1)
    result = sp.csr_matrix(np.ones((len(xi), 1)))
    for k, place in enumerate(places):
        steps = np.linalg.norm(np.diff(grid, axis=k), axis=-1)
        steps = steps.mean(axis=tuple(i for i in range(len(shape)) if i != k))
        along = np.append(0.0, np.cumsum(steps))[place]
        result = _products(result, _hats(along, along.max(), size))
    return result


def _hats(s: FloatArray, length: float, size: float) -> sp.csr_matrix:
    """Hat functions of a length on equal cells, shape (points, functions)."""
    cells = max(1, round(length / size))
    r = s * cells / length
    low = np.minimum(r.astype(np.int32), cells - 1)
    t = r - low
    rows = np.arange(len(s))
    values = (np.concatenate([1.0 - t, t]), (np.concatenate([rows, rows]), np.concatenate([low, low + 1])))
    N = sp.csr_matrix(values, shape=(len(s), cells + 1))
    N.eliminate_zeros()
    return N


def _products(A: sp.csr_matrix, B: sp.csr_matrix) -> sp.csr_matrix:
    """All products of a function of A with one of B."""
    a, b = sp.kron(A, np.ones((1, B.shape[1])), format="csr"), sp.kron(np.ones((1, A.shape[1])), B, format="csr")
    return a.multiply(b).tocsr()


def _joined(N: sp.csr_matrix, joints: IntArray) -> sp.csr_matrix:
    """The same functions with those summed that are one at both points of a joint."""
    ends = np.asarray(N.argmax(axis=1)).ravel()[joints]
    pairs = sp.coo_matrix((np.ones(len(ends)), ends.T), shape=(N.shape[1],) * 2)
    number, column = connected_components(pairs, directed=False)
    return N @ sp.csr_matrix((np.ones(len(column)), (np.arange(len(column)), column)), shape=(len(column), number))


def _without_small_ones(N: sp.csr_matrix, weights: FloatArray, least: float) -> sp.csr_matrix:
    """The same functions, of which the smallest is added to the one that it overlaps most, until all have an area."""
    area, overlap = N.T @ weights, (N.T @ sp.diags(weights) @ N).toarray()
    np.fill_diagonal(overlap, 0.0)
    column = np.arange(N.shape[1])
    while area.min() < least:
        small = int(area.argmin())
        other = int(overlap[small].argmax())
        if overlap[small, other] > 0.0:
            area[other] += area[small]
            overlap[other] += overlap[small]
            overlap[:, other] += overlap[:, small]
            overlap[other, other] = 0.0
            column[column == small] = other
        area[small], overlap[small], overlap[:, small] = np.inf, 0.0, 0.0  # merged, or a piece of its own
    kept, column = np.unique(column, return_inverse=True)
    return N @ sp.csr_matrix(
        (np.ones(len(column)), (np.arange(len(column)), column.ravel())), shape=(len(column), len(kept))
    )
