"""Grids over the patches of a shell, coarser than its points, that go on across the joints of the patches.

The lines of a patch's grid lie at equal lengths along its parameters. Where two patches are joined along a side both
have the same lines there: all directions that are linked across joints share their numbers of cells, and the mean of
their lengths.
"""

from collections import defaultdict
from dataclasses import dataclass
from itertools import product

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

from coudalfish.surface.sheets import Sheets
from tigar_x import checks
from tigar_x.compat import FloatArray, IntArray

SAME_PARAMETER = 1e-9
"""Difference of parameters, relative to the patch, within which points are in one line of its grid."""
COLLAPSED = 1e-8
"""Length of a side, relative to the patch, up to which it is a pole."""
DIGITS = 9
"""Decimal places to which numbers are one where a choice follows from them: images of one patch then choose alike."""

Side = tuple[int, int, int]
"""Patch, direction and end (0 or 1) of a side; of a curve an end."""


@dataclass(frozen=True, eq=False)
class GridLine:
    """Cells of equal lengths along one direction of patches.

    Attributes:
        along: lengths at the points, from 0, shape (points,); unit: length.
        cells: number of the cells.
    """

    along: FloatArray
    cells: int

    def __post_init__(self) -> None:
        checks.freeze(self)

    def hats(self, *, backwards: bool) -> tuple[IntArray, FloatArray]:
        """Number of the cell of every point, and the value there of the second of the cell's two functions.

        Args:
            backwards: whether the points are in the opposite order.
        """
        r = self.along * self.cells / self.along.max()
        low = np.minimum(r.astype(np.int32), self.cells - 1)
        way = -1 if backwards else 1
        return low[::way], (r - low)[::way]


@dataclass(frozen=True, eq=False)
class Joint:
    """Two sides that are one.

    Attributes:
        sides: both of them.
        turned: whether the points along them run in opposite directions.
    """

    sides: tuple[Side, Side]
    turned: bool

    def agrees(self, sign: list[float]) -> bool:
        """Whether signs of the patches make their normals agree here.

        Args:
            sign: of every patch.
        """
        (a, *one), (b, *other) = self.sides
        opposite = -_way(*one) * _way(*other) * (-1.0 if self.turned else 1.0)
        return sign[a] * sign[b] == opposite


def _way(direction: int, end: int) -> float:
    """Whether a side, or the end of a curve, is run along forwards or backwards around the patch."""
    return (1.0 if end else -1.0) * (-1.0 if direction else 1.0)


def tensor_points(xi: FloatArray, numbers: IntArray) -> IntArray:
    """Points of a patch in the order of its parameters, one axis a direction.

    Args:
        xi: parameters, shape (points, dim).
        numbers: of the points, shape (points,).

    Returns:
        Numbers, shape (lines of the first direction, ...).

    Raises:
        ValueError: the points are no tensor grid.
    """
    box = np.ptp(xi, axis=0)
    lines = [np.unique(np.round(x / (s * SAME_PARAMETER)), return_inverse=True) for x, s in zip(xi.T, box, strict=True)]
    shape = tuple(len(values) for values, _ in lines)
    if np.prod(shape) != len(xi):
        raise ValueError(f"{len(xi)} points of a patch are no tensor grid of {shape}: tensor cells are required")
    places = [place.ravel() for _, place in lines]
    return numbers[np.lexsort(places[::-1])].reshape(shape)


class Grids:
    """Grids over all patches of a shell.

    Args:
        points: of every patch, see :func:`tensor_points`.
        sheets: how they hang together.
        size: of the cells, about; unit: length.

    Attributes:
        lines: of every patch and direction, along the direction in which linked patches run together.
        backwards: whether it is against the patch's own, likewise.
        first: number of the first grid point of every patch.
        count: number of the grid's points, those of all patches one after the other.
    """

    def __init__(self, points: list[IntArray], sheets: Sheets, size: float) -> None:
        self._points, self._sheets, self._dim = points, sheets, points[0].ndim
        sides = list(product(range(len(points)), range(self._dim), (0, 1)))
        self._poles = [side for side in sides if self._collapsed(side)]
        self._joints = _joints({side: sheets.places[self._along(side)] for side in sides if side not in self._poles})
        self.lines: dict[tuple[int, int], GridLine] = {}
        self.backwards: dict[tuple[int, int], bool] = {}
        for linked in self._linked():
            line = self._line(linked, size)
            self.lines |= dict.fromkeys(linked, line)
        self._shapes = [tuple(self.lines[k, d].cells + 1 for d in range(self._dim)) for k in range(len(points))]
        self.first = np.concatenate([[0], np.cumsum([np.prod(shape) for shape in self._shapes])]).astype(np.int32)
        self.count = int(self.first[-1])

    def _along(self, side: Side) -> IntArray:
        """Points along a side."""
        k, direction, end = side
        return np.take(self._points[k], -end, axis=direction).ravel()

    def _collapsed(self, side: Side) -> bool:
        """Whether a side is a pole."""
        if self._dim == 1:
            return False
        x = self._sheets.X
        return bool(
            (
                np.ptp(x[self._along(side)], axis=0) <= COLLAPSED * np.ptp(x[self._points[side[0]]], axis=(0, 1)).max()
            ).all()
        )

    def _linked(self) -> list[list[tuple[int, int]]]:
        """Directions that run along joints of each other; each is told its way among them."""
        links: dict[tuple[int, int], list[tuple[tuple[int, int], bool]]] = defaultdict(list)
        for joint in self._joints if self._dim > 1 else []:
            (a, c, _), (b, d, _) = joint.sides
            links[a, 1 - c].append(((b, 1 - d), joint.turned))
            links[b, 1 - d].append(((a, 1 - c), joint.turned))
        groups = []
        for start in product(range(len(self._points)), range(self._dim)):
            if start in self.backwards:
                continue
            self.backwards[start], group = False, [start]
            for one in group:  # which grows
                for other, turned in links[one]:
                    if other not in self.backwards:
                        self.backwards[other] = self.backwards[one] != turned
                        group.append(other)
            groups.append(group)
        return groups

    def _line(self, linked: list[tuple[int, int]], size: float) -> GridLine:
        """Cells of the mean length of directions that are linked."""
        steps = []
        for k, d in linked:
            lengths = np.linalg.norm(np.diff(self._sheets.X[self._points[k]], axis=d), axis=-1)
            rows = np.moveaxis(lengths, d, 0).reshape(lengths.shape[d], -1)
            steps.append(rows[::-1] if self.backwards[k, d] else rows)
        mean = np.concatenate(steps, axis=1).mean(axis=1)
        along = np.append(0.0, np.cumsum(mean))
        return GridLine(along, max(1, round(round(along[-1] / size, DIGITS))))

    # -- functions ----------------------------------------------------------------------------------------------------

    def functions(self) -> sp.csr_matrix:
        """Products of hat functions of the lengths, at every patch's own grid points, shape (points, count)."""
        rows, columns, values = [], [], []
        for k, (points, shape) in enumerate(zip(self._points, self._shapes, strict=True)):
            hats = [self.lines[k, d].hats(backwards=self.backwards[k, d]) for d in range(self._dim)]
            for corner in product((0, 1), repeat=self._dim):
                places = np.ix_(*(low + up for (low, _), up in zip(hats, corner, strict=True)))
                factors = np.ix_(*(t if up else 1.0 - t for (_, t), up in zip(hats, corner, strict=True)))
                rows.append(points.ravel())
                columns.append(self.first[k] + np.ravel_multi_index(np.broadcast_arrays(*places), shape).ravel())
                values.append(np.prod(np.broadcast_arrays(*factors), axis=0).ravel())
        entries = np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))
        N = sp.csr_matrix(entries, shape=(len(self._sheets.X), self.count))
        N.eliminate_zeros()
        return N

    def united(self) -> IntArray:
        """Number of the function to which that of a grid point belongs, shape (count,).

        Those at a pole are one, and so are those that are the same along a joint of two sides along which the normals
        agree. Where three sheets meet the forces on them have nothing to do with each other.
        """
        sign = [float(self._sheets.sign[points.flat[0]]) for points in self._points]
        pairs = [np.empty((0, 2), dtype=np.int32)]
        for joint in self._joints:
            if joint.agrees(sign):
                pairs.append(np.stack([self._grid_points(side) for side in joint.sides], axis=1))
        for pole in self._poles:
            found = self._grid_points(pole)
            pairs.append(np.stack([found[:-1], found[1:]], axis=1))
        ends = np.concatenate(pairs)
        graph = sp.coo_matrix((np.ones(len(ends)), ends.T), shape=(self.count,) * 2)
        return np.asarray(connected_components(graph, directed=False)[1], dtype=np.int32)

    def _grid_points(self, side: Side) -> IntArray:
        """Numbers of the grid's points along a side, in the direction of the line."""
        k, direction, end = side
        own = self.first[k] + np.arange(np.prod(self._shapes[k]), dtype=np.int32).reshape(self._shapes[k])
        return np.take(own, -int(bool(end) != self.backwards[k, direction]), axis=direction).ravel()


def _joints(places: dict[Side, IntArray]) -> list[Joint]:
    """Pairs of sides whose points are the same places, those left out where more than two sides are."""
    groups: dict[tuple[int, ...], list[tuple[Side, bool]]] = defaultdict(list)
    for side, along in places.items():
        forwards = tuple(along.tolist())
        key = min(forwards, forwards[::-1])
        groups[key].append((side, key != forwards))
    pairs = [group for group in groups.values() if len(group) == 2]
    return [Joint((one, other), way != back) for (one, way), (other, back) in pairs]
