"""Hat functions on the reference surface of a shell, coarser than its points: what a converged multiplier is made of.

A grid of its own lies over every patch, in lengths along the patch's own parameters, so that patches that are mirror
images have mirrored functions whatever the directions of their parameters. At joints the functions go on, and at a pole
there is one.
"""

from itertools import pairwise

import numpy as np
import scipy.sparse as sp

from coudalfish.surface.grids import DIGITS, Grids, tensor_points
from coudalfish.surface.sheets import Sheets
from tigar_x import checks
from tigar_x.compat import FloatArray, IntArray
from tigar_x.splines.spline import ExtractedSpline

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
    patch = functions.patch_of(xi)
    numbers = [np.flatnonzero(patch == k) for k in range(len(functions.bases))]
    grids = Grids([tensor_points(xi[mine], mine) for mine in numbers], sheets, size)
    N = _summed(grids.functions(), grids.united()).tocsc()
    N = N[:, np.diff(N.indptr) > 0].tocsr()  # elements may be larger than functions
    N = _without_small_ones(N, weights, SMALL * size**spline.dim)
    return sp.csr_matrix(sp.diags(sheets.sign) @ N)


def _summed(N: sp.csr_matrix, column: IntArray) -> sp.csr_matrix:
    """Sums of the functions that get the same number."""
    shape = len(column), int(column.max()) + 1
    return sp.csr_matrix(N @ sp.csr_matrix((np.ones(shape[0]), (np.arange(shape[0]), column)), shape=shape))


def _without_small_ones(N: sp.csr_matrix, weights: FloatArray, least: float) -> sp.csr_matrix:
    """The same functions, of which the smallest is added to the one that it overlaps most, until all have an area.

    Where it overlaps several alike it is added to the smallest of them; where those are alike too, as at the axis of a
    symmetric patch, they become one function.
    """
    area, column = np.round(N.T @ weights / least, DIGITS), np.arange(N.shape[1])
    if area.min() >= 1.0:
        return N
    overlap = sp.csr_matrix(N.T @ sp.diags(weights) @ N)
    beside = [
        dict(zip(overlap.indices[a:b].tolist(), overlap.data[a:b].tolist(), strict=True))
        for a, b in pairwise(overlap.indptr)
    ]
    for k, shared in enumerate(beside):
        shared.pop(k, None)
    while area.min() < 1.0:
        small = int(area.argmin())
        others = _alike(beside[small], area)
        for k in others[1:] + [small] * bool(others):
            area[others[0]] = round(area[others[0]] + area[k], DIGITS)
            _move(beside, k, others[0])
            column[column == k] = others[0]
            area[k] = np.inf
        area[small] = np.inf  # merged, or a piece of its own
    return _summed(N, np.unique(column, return_inverse=True)[1].ravel())


def _alike(shared: dict[int, float], area: FloatArray) -> list[int]:
    """Which functions one that shares such areas with them is added to; the first is to keep its number."""
    largest = max(shared.values(), default=0.0)
    if largest <= 0.0:
        return []
    most = sorted(k for k, value in shared.items() if round(value / largest, DIGITS) == 1.0)
    least = min(area[k] for k in most)
    return [k for k in most if area[k] == least]


def _move(beside: list[dict[int, float]], k: int, to: int) -> None:
    """Make all that a function shares with others another one's."""
    for other, value in beside[k].items():
        del beside[other][k]
        if other != to:
            beside[to][other] = beside[other][to] = beside[to].get(other, 0.0) + value
    beside[k].clear()
