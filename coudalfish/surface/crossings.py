"""Where straight segments cross the cells of a fluid's mesh of triangles, and the pieces that lie between."""

from dataclasses import dataclass

import numpy as np
from mpi4py import MPI
from scipy.spatial import cKDTree

from coudalfish.surface.trace import INSIDE, PointLocator
from tigar_x import checks
from tigar_x.compat import FloatArray, IntArray

SAME_PLACE = 1e-9
"""Parameters of a segment that differ by less are one place."""


@dataclass(frozen=True, eq=False)
class Pieces:
    """Pieces of segments, each within one cell or outside the mesh, the same on every rank.

    Attributes:
        segment: which segment a piece belongs to, ascending, shape (pieces,).
        start: parameter where it starts, from 0 to 1 along the segment, shape (pieces,).
        end: parameter where it ends, shape (pieces,).
        cells: a cell of this rank that holds it, -1 where there is none, shape (pieces,).
    """

    segment: IntArray
    start: FloatArray
    end: FloatArray
    cells: IntArray

    def __post_init__(self) -> None:
        checks.freeze(self)


class CellsNearby:
    """Finds cells near segments: one tree of midpoints for every octave of sizes, so that graded meshes cost no more.

    Args:
        corners: vertices of the cells, shape (cells, vertices, d); unit: length.
    """

    def __init__(self, corners: FloatArray) -> None:
        middle = corners.mean(axis=1)
        radius = np.linalg.norm(corners - middle[:, None], axis=2).max(axis=1, initial=0.0)
        octave = np.floor(np.log2(radius))
        self._groups = []
        for one in np.unique(octave):
            cells = np.flatnonzero(octave == one)
            self._groups.append((cells, cKDTree(middle[cells]), float(radius[cells].max())))

    def pairs(self, a: FloatArray, b: FloatArray) -> tuple[IntArray, IntArray]:
        """All pairs (segment, cell) that may touch, and some that do not.

        Args:
            a: where the segments start, shape (segments, d).
            b: where they end, same shape.
        """
        middle, half = cKDTree(0.5 * (a + b)), 0.5 * float(np.linalg.norm(b - a, axis=1).max(initial=0.0))
        found = [(np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64))]
        for cells, tree, radius in self._groups:
            near = middle.sparse_distance_matrix(tree, (radius + half) * (1.0 + INSIDE), output_type="ndarray")
            found.append((near["i"], cells[near["j"]]))
        segments, cells = (np.concatenate(part) for part in zip(*found, strict=True))
        return segments, cells


def pieces_of(a: FloatArray, b: FloatArray, locator: PointLocator, nearby: CellsNearby, comm: MPI.Comm) -> Pieces:
    """Cut segments where they cross the boundaries of cells (collective).

    Args:
        a: where the segments start, the same on every rank, shape (segments, d); unit: length.
        b: where they end, same shape.
        locator: of the mesh.
        nearby: of the same cells.
        comm: of the mesh.

    Returns:
        Their pieces, which cover every segment whole.
    """
    segment, cell = nearby.pairs(a, b)
    at_a, at_b = locator.barycentric(cell, a[segment]), locator.barycentric(cell, b[segment])
    low, high = _inside(at_a, at_b)
    crossed = high - low > SAME_PLACE
    segment, cell, low, high = segment[crossed], cell[crossed], low[crossed], high[crossed]
    whole = np.arange(len(a))
    own = np.concatenate([segment, segment]), np.concatenate([low, high])
    shared = comm.allgather(own) if comm.size > 1 else [own]
    place = np.concatenate([whole, whole, *(part[0] for part in shared)])
    at = np.concatenate([np.zeros(len(a)), np.ones(len(a)), *(part[1] for part in shared)])
    at[at < SAME_PLACE], at[at > 1.0 - SAME_PLACE] = 0.0, 1.0
    order = np.lexsort((at, place))
    place, at = place[order], at[order]
    new = np.append(True, (np.diff(place) > 0) | (np.diff(at) > SAME_PLACE))
    place, at = place[new], at[new]
    within = place[1:] == place[:-1]
    place, start, end = place[:-1][within], at[:-1][within], at[1:][within]
    return Pieces(place, start, end, _owners(place + 0.5 * (start + end), segment + low, segment + high, cell))


def _inside(at_a: FloatArray, at_b: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Part of every segment, from parameter to parameter, in which no barycentric coordinate is negative."""
    change = at_b - at_a
    along = np.abs(change) <= INSIDE  # of a side of the cell: it is inside or outside as a whole
    with np.errstate(divide="ignore", invalid="ignore"):
        t = -at_a / change
    outside = np.where(at_a < -INSIDE, np.inf, -np.inf)
    low = np.where(along, outside, np.where(change > 0.0, t, -np.inf)).max(axis=1, initial=0.0)
    high = np.where(along | (change > 0.0), np.inf, t).min(axis=1, initial=1.0)
    return low, high


def _owners(middle: FloatArray, low: FloatArray, high: FloatArray, cell: IntArray) -> IntArray:
    """For every piece one of the cells whose part of the segment it lies in; all places as segment plus parameter."""
    first, last = np.searchsorted(middle, low), np.searchsorted(middle, high)
    count = np.maximum(last - first, 0)
    piece = np.repeat(first - np.cumsum(count) + count, count) + np.arange(count.sum())
    owners = np.full(len(middle), -1, dtype=np.int32)
    owners[piece] = np.repeat(cell, count)
    return owners
