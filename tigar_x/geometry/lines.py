"""Lines of a surface, or points of a curve, where functions are only C0: glued sides, and knots of full multiplicity.

A field has no slope of its own there. A thin shell turns about such a line as about a hinge, unless constraints make it
smooth (:mod:`tigar_x.splines.constraints`) or supports hold it.
"""

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from scipy.spatial import cKDTree

from tigar_x.compat import FloatArray, IntArray
from tigar_x.geometry.bspline import BSplineBasis, TensorBasis
from tigar_x.geometry.joints import side_name
from tigar_x.geometry.multipatch import MultiPatch
from tigar_x.geometry.patch import Patch

INSIDE = np.array([0.2, 0.5, 0.8])
"""Where the elements along a line are looked at; the same from both ends."""
SAME_PLACE = 1e-6
"""Points of two banks that are closer, relative to the size of the geometry, are one point of their line."""
STIFF = 1e-3
"""A rotation that conditions reduce to this part of it is none."""


def rows_of(patch: Patch, direction: int, row: int, next_row: int) -> tuple[IntArray, IntArray]:
    """Functions of a patch in two rows across a direction, in the same order; a negative row counts from the end."""
    grid = np.arange(patch.n, dtype=np.int32).reshape([basis.n for basis in patch.bases], order="F")
    return np.take(grid, row, axis=direction).ravel(), np.take(grid, next_row, axis=direction).ravel()


@dataclass(frozen=True, eq=False)
class Bank:
    """One of the two sides of a line: a row of functions on it, and the next row.

    Attributes:
        patch: whose functions they are.
        direction: across the line.
        row: number of the univariate function that is one on the line.
        next_row: of its neighbour on this side.
        slope: derivative of that neighbour across the line, away from it; minus that of the first one.
    """

    patch: int
    direction: int
    row: int
    next_row: int
    slope: float

    def functions(self, geometry: MultiPatch) -> tuple[IntArray, IntArray]:
        """Both rows in the numbering of the geometry, in the same order."""
        first, second = (geometry.functions.global_numbers(self.patch, row) for row in self.local(geometry))
        return first, second

    def local(self, geometry: MultiPatch) -> tuple[IntArray, IntArray]:
        """Both rows in the numbering of the patch."""
        return rows_of(geometry.patches[self.patch], self.direction, self.row, self.next_row)


@dataclass(frozen=True, eq=False)
class Line:
    """A line where functions are only C0.

    Attributes:
        name: what messages call it.
        banks: its two sides.
        degree: of the functions across it, the lower one of the two sides.
    """

    name: str
    banks: tuple[Bank, Bank]
    degree: int


def joints(geometry: MultiPatch) -> list[Line]:
    """Lines where two sides are glued to each other; of more than two sides, each pair."""
    sides = [side for side in geometry.open_sides if not geometry.collapsed(*side)]
    keys = [geometry.side_functions(*side).tobytes() for side in sides]
    degrees = [geometry.patches[k].bases[direction].degree for k, direction, _ in sides]
    return [
        Line(
            f"{side_name(*sides[j])} and {side_name(*sides[i])}",
            (_end(geometry, sides[i]), _end(geometry, sides[j])),
            min(degrees[i], degrees[j]),
        )
        for i in range(len(sides))
        for j in range(i)
        if keys[i] == keys[j]
    ]


def inner_lines(geometry: MultiPatch) -> list[Line]:
    """Lines inside patches, along knots that are repeated as often as the degree; the seam of a periodic patch too."""
    found = []
    for k, patch in enumerate(geometry.patches):
        for direction, basis in enumerate(patch.bases):
            repeated = np.flatnonzero(basis.multiplicities >= basis.degree)
            last = len(basis.breakpoints) - 1
            for i in repeated[(repeated < last) & ((repeated > 0) | basis.periodic)]:
                name = f"the line {'uvw'[direction]} = {basis.breakpoints[i]:.6g} of patch {k}"
                found.append(Line(name, _both(k, direction, basis, int(i)), basis.degree))
    return found


def _end(geometry: MultiPatch, side: tuple[int, int, int]) -> Bank:
    """The bank that ends at a side."""
    k, direction, end = side
    basis = geometry.patches[k].bases[direction]
    step = np.diff(basis.breakpoints)[-end]
    first = (basis.n - 1) * end
    return Bank(k, direction, first, first + 1 - 2 * end, basis.degree / step)


def _both(k: int, direction: int, basis: BSplineBasis, i: int) -> tuple[Bank, Bank]:
    """The banks of a repeated knot."""
    row = int(TensorBasis((basis,)).evaluate([[basis.breakpoints[i]]]).argmax())
    steps = np.diff(basis.breakpoints)
    after = Bank(k, direction, row, (row + 1) % basis.n, basis.degree / steps[i])
    before = Bank(k, direction, row, (row - 1) % basis.n, basis.degree / steps[i - 1])
    return after, before


def folds(geometry: MultiPatch, admissible: sp.spmatrix) -> list[Line]:
    """Lines about which the two banks of a shell can turn against each other.

    Args:
        geometry: curve in the plane or surface in space, of one or several patches.
        admissible: coefficients (function * nsd + component) of the displacement from those that conditions leave free,
            shape (n nsd, free).

    Returns:
        The lines.
    """
    return [line for line in joints(geometry) + inner_lines(geometry) if _turns(line, geometry, admissible)]


def _turns(line: Line, geometry: MultiPatch, admissible: sp.spmatrix) -> bool:
    (x, sense, one), (y, other_sense, other) = (_rotation(bank, geometry) for bank in line.banks)
    distance, match = cKDTree(y).query(x)
    met = distance <= SAME_PLACE * geometry.size
    same = np.sign((sense * other_sense[match]).sum(axis=1))
    relative = (one - sp.diags(same) @ other[match])[met]
    largest, left = (abs(rows).max(axis=1).toarray().ravel() for rows in (relative, relative @ admissible))
    return bool((left > STIFF * largest).any())


def _rotation(bank: Bank, geometry: MultiPatch) -> tuple[FloatArray, FloatArray, sp.csr_matrix]:
    """By how much a bank turns about its line when it is displaced.

    The angle is ``n . du/dnu`` with the unit vector nu along the bank, away from the line and normal to it, and
    n = t x nu with the line's tangent t. When both banks of a line turn alike, so do these angles.

    Returns:
        Points on the line and its tangent there (1 for the line through a point of a curve), shape (m, nsd) each, and
        rows of the angle, shape (m, n nsd).
    """
    along = [basis for d, basis in enumerate(geometry.patches[bank.patch].bases) if d != bank.direction]
    first, second = bank.local(geometry)
    values = slopes = sp.csr_matrix(np.ones((1, 1)))
    if along:
        ticks = along[0].breakpoints
        s = (ticks[:-1, None] + np.diff(ticks)[:, None] * INSIDE).reshape(-1, 1)
        values, slopes = (TensorBasis((along[0],)).evaluate(s, derivative) for derivative in (None, 0))
    own, beside = (_spread(values, row, geometry, bank.patch) for row in (first, second))
    w = own @ geometry.weights
    x = (own @ geometry.control)[:, :-1] / w[:, None]
    a, across = _physical(bank.slope * (beside - own), own, w, x, geometry)
    if not along:
        length = np.linalg.norm(a, axis=1, keepdims=True)
        return x, np.ones((1, 1)), _dotted(np.stack([-a[:, 1], a[:, 0]], axis=1) / length**2, across)
    t, stretch = _physical(_spread(slopes, first, geometry, bank.patch), own, w, x, geometry)
    length = np.linalg.norm(t, axis=1, keepdims=True)
    shear = (a * t).sum(axis=1, keepdims=True) / length**2
    nu = a - shear * t
    normal = np.cross(t, nu) / (length * (nu**2).sum(axis=1, keepdims=True))
    return x, t, _dotted(normal, across) - _dotted(shear * normal, stretch)


def _spread(values: sp.csr_matrix, row: IntArray, geometry: MultiPatch, patch: int) -> sp.csr_matrix:
    """Values of a row of functions of a patch in the columns of the geometry's functions."""
    functions = geometry.functions
    factors = 1.0 if functions.factors is None else functions.factors[functions.offsets[patch] + row]
    place = np.arange(len(row)), functions.global_numbers(patch, row)
    return values @ sp.csr_matrix((np.broadcast_to(factors, len(row)), place), shape=(len(row), geometry.n))


def _physical(
    slopes: sp.csr_matrix, values: sp.csr_matrix, w: FloatArray, x: FloatArray, geometry: MultiPatch
) -> tuple[FloatArray, sp.csr_matrix]:
    """Derivative of the position, and rows of that of physical fields, from rows of homogeneous derivatives."""
    rows = sp.diags(1.0 / w) @ (slopes - sp.diags((slopes @ geometry.weights) / w) @ values)
    return rows @ geometry.control[:, :-1], rows.tocsr()


def _dotted(vectors: FloatArray, rows: sp.csr_matrix) -> sp.csr_matrix:
    """Rows of the component of a vector field along vectors, shape (m, n nsd), from those of a scalar one."""
    parts = [sp.kron(sp.diags(v) @ rows, np.eye(1, vectors.shape[1], c)) for c, v in enumerate(vectors.T)]
    return sum(parts[1:], parts[0]).tocsr()
