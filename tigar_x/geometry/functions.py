"""The functions of one or several patches in one numbering, over one parametric plane.

A single patch keeps its own parameters. Of several, patch k is scaled to the unit box and moved to [2 k, 2 k + 1] in
the first direction, so that every point of the plane belongs to at most one patch (Kamensky and Bazilevs,
doi:10.1016/j.cma.2018.10.002).
"""

from dataclasses import dataclass
from functools import cached_property
from itertools import permutations
from typing import Any, Literal

import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike

from tigar_x import checks
from tigar_x.compat import FloatArray, IntArray
from tigar_x.geometry.bspline import TensorBasis

Cells = Literal["tensor", "simplex"]
CELL_NAMES = {
    "tensor": ("interval", "quadrilateral", "hexahedron"),
    "simplex": ("interval", "triangle", "tetrahedron"),
}


@dataclass(frozen=True, eq=False)
class ParametricCells:
    """The cells of a parametric mesh as arrays.

    Attributes:
        cell: UFL name of the cell.
        cells: vertices of the cells in dolfinx's ordering, shape (cells, vertices per cell).
        x: coordinates of the vertices, shape (vertices, parametric dimension).
    """

    cell: str
    cells: IntArray
    x: FloatArray


@dataclass(frozen=True, eq=False)
class SplineFunctions:
    """Spline functions of one or several patches.

    Attributes:
        bases: tensor-product bases, one per patch, of one parametric dimension.
        numbering: function of every raw function (those of all patches one after the other); raw functions of one
            number are glued together. None: no two are.
        factors: what raw functions are multiplied by before those of one number are added, as their weights may differ
            from the weight of the sum (along a pole, for example). None: all are 1.

    Raises:
        ValueError: no basis, bases of several dimensions, or a numbering or factors that do not belong to them.
    """

    bases: tuple[TensorBasis, ...]
    numbering: IntArray | None = None
    factors: FloatArray | None = None

    def __post_init__(self) -> None:
        if not self.bases:
            raise ValueError("bases is empty: one patch or more is required")
        dims = {basis.dim for basis in self.bases}
        if len(dims) != 1:
            raise ValueError(f"bases have parametric dimensions {sorted(dims)}: one and the same is required")
        raw = int(self.offsets[-1])
        if self.factors is not None:
            object.__setattr__(self, "factors", checks.array("factors", self.factors, (raw,)))
            checks.freeze(self)
        if self.numbering is None:
            return
        numbering = np.asarray(self.numbering)
        used = np.unique(numbering)
        object.__setattr__(self, "numbering", numbering)
        if numbering.shape != (raw,) or not np.array_equal(used, np.arange(len(used))):
            raise ValueError(f"numbering has shape {numbering.shape}: {raw} numbers from 0 without gaps required")
        checks.freeze(self)

    @property
    def dim(self) -> int:
        """Parametric dimension."""
        return self.bases[0].dim

    @cached_property
    def offsets(self) -> IntArray:
        """First raw function of every patch, and their number, shape (patches + 1,)."""
        return np.cumsum([0, *(basis.n for basis in self.bases)]).astype(np.int32)

    @cached_property
    def n(self) -> int:
        """Number of functions."""
        return int(self.offsets[-1] if self.numbering is None else self.numbering.max() + 1)

    @cached_property
    def first(self) -> IntArray:
        """The first raw function of every number, shape (n,)."""
        raw = np.arange(self.n) if self.numbering is None else np.unique(self.numbering, return_index=True)[1]
        return raw.astype(np.int32)

    @property
    def degrees(self) -> tuple[int, ...]:
        """Largest polynomial degree in every direction."""
        return tuple(int(p) for p in np.max([basis.degrees for basis in self.bases], axis=0))

    def global_numbers(self, patch: int, functions: IntArray) -> IntArray:
        """Numbers of functions of a patch.

        Args:
            patch: which patch.
            functions: numbers within the patch.

        Returns:
            Numbers of the functions, in the same order.
        """
        raw = self.offsets[patch] + functions
        return np.asarray(raw if self.numbering is None else self.numbering[raw], dtype=np.int32)

    def to_plane(self, patch: int, xi: FloatArray) -> FloatArray:
        """Points of the parametric plane from parameters of a patch, shape (m, dimension)."""
        if len(self.bases) == 1:
            return xi
        low, high = self.bases[patch].box
        return (xi - low) / (high - low) + 2.0 * patch * np.eye(self.dim)[0]

    def from_plane(self, patch: int, points: FloatArray) -> FloatArray:
        """Parameters of a patch from points of the parametric plane, shape (m, dimension)."""
        if len(self.bases) == 1:
            return points
        low, high = self.bases[patch].box
        return low + (points - 2.0 * patch * np.eye(self.dim)[0]) * (high - low)

    @cached_property
    def boxes(self) -> FloatArray:
        """Lower and upper corner of every patch in the parametric plane, shape (patches, 2, dimension)."""
        return np.stack([self.to_plane(k, basis.box) for k, basis in enumerate(self.bases)])

    def breakpoints(self, patch: int) -> list[FloatArray]:
        """Ends of the Bezier elements of a patch in the parametric plane, one array per direction."""
        ticks = [basis.breakpoints for basis in self.bases[patch].directions]
        if len(self.bases) == 1:
            return ticks
        return [(t - t[0]) / (t[-1] - t[0]) + (2.0 * patch if i == 0 else 0.0) for i, t in enumerate(ticks)]

    def require_elements(self, name: str, other: Any) -> None:
        """Refuse functions that are not polynomials on every Bezier element of these.

        Args:
            name: what the message calls them.
            other: other functions.

        Raises:
            ValueError: they have other patches, or a breakpoint that these do not have.
        """
        if len(other.bases) != len(self.bases) or other.dim != self.dim:
            found = f"{len(other.bases)} patches of dimension {other.dim}"
            raise ValueError(f"{name} has {found}: {len(self.bases)} of dimension {self.dim} are required")
        for k in range(len(self.bases)):
            for direction, (mine, others) in enumerate(zip(self.breakpoints(k), other.breakpoints(k), strict=True)):
                slack = 1e-12 * (mine[-1] - mine[0])
                gaps = np.abs(others[:, None] - mine[None, :]).min(axis=1)
                if (gaps > slack).any() or np.abs(others[[0, -1]] - mine[[0, -1]]).max() > slack:
                    found = f"patch {k} has breakpoints {others} in direction {direction}"
                    raise ValueError(f"{name}: {found}: only those of the geometry, {mine}, are allowed")

    def cells(self, kind: Cells) -> ParametricCells:
        """Bezier elements of the patches; patches share no vertices, their connection is a matter of extraction.

        Args:
            kind: "tensor" for intervals, quadrilaterals and hexahedra; "simplex" for the same cut in 2 triangles or 6
                tetrahedra along the diagonal from the least to the largest corner.

        Returns:
            The cells.
        """
        checks.choice("cells", kind, tuple(CELL_NAMES))
        ends = (slice(None, -1), slice(1, None))
        corners = [tuple(ends[(c >> d) & 1] for d in range(self.dim)) for c in range(2**self.dim)]
        boxes, points, first = [], [], 0
        for patch in range(len(self.bases)):
            grid = np.meshgrid(*self.breakpoints(patch), indexing="ij")
            points.append(np.column_stack([g.ravel(order="F") for g in grid]))
            number = first + np.arange(grid[0].size).reshape(grid[0].shape, order="F")
            boxes.append(np.column_stack([number[corner].ravel(order="F") for corner in corners]))
            first += grid[0].size
        cells = np.concatenate(boxes)
        if kind == "simplex" and self.dim > 1:
            paths = [np.cumsum([0, *(2**axis for axis in order)]) for order in permutations(range(self.dim))]
            cells = np.concatenate([cells[:, path] for path in paths])
        return ParametricCells(CELL_NAMES[kind][self.dim - 1], cells.astype(np.int32), np.concatenate(points))

    def patch_of(self, points: FloatArray) -> IntArray:
        """Patch nearest to each point of the parametric plane, shape (m,)."""
        if len(self.bases) == 1:
            return np.zeros(len(points), dtype=np.int32)
        nearest = np.floor(points[:, 0] / 2.0 + 0.25)
        return np.clip(nearest, 0, len(self.bases) - 1).astype(np.int32)

    def evaluate(self, points: ArrayLike) -> sp.csr_matrix:
        """Values of all functions at points of the parametric plane.

        Args:
            points: shape (m, dimension), each within a patch.

        Returns:
            Sparse matrix of shape (m, n); rows sum to one where there are no factors.
        """
        x = checks.array("points", points, (None, self.dim))
        owner = self.patch_of(x)
        order = np.argsort(owner, kind="stable")
        blocks = [basis.evaluate(self.from_plane(k, x[owner == k])) for k, basis in enumerate(self.bases)]
        raw = sp.block_diag(blocks, format="csr") if len(blocks) > 1 else blocks[0]
        if len(blocks) > 1:
            back = np.empty_like(order)
            back[order] = np.arange(len(order))
            raw = raw[back]
        if self.factors is not None:
            raw.data *= self.factors[raw.indices]
        if self.numbering is None:
            return raw
        merged = sp.csr_matrix((raw.data, self.numbering[raw.indices], raw.indptr), shape=(len(x), self.n))
        merged.sum_duplicates()
        return merged


def within_patch(functions: Any, patch: int, xi: FloatArray) -> FloatArray:
    """Points of the parametric plane from parameters that lie within a patch.

    Args:
        functions: with ``boxes`` and ``to_plane``.
        patch: which patch.
        xi: shape (m, dimension).

    Returns:
        Points, shape (m, dimension).

    Raises:
        ValueError: a parameter lies outside of the patch.
    """
    x = np.asarray(functions.to_plane(patch, xi))
    low, high = functions.boxes[patch]
    outside = ((x < low - 1e-12 * (high - low)) | (x > high + 1e-12 * (high - low))).any(axis=1)
    if outside.any():
        i = int(outside.argmax())
        raise ValueError(f"xi[{i}] = {xi[i]}: parameters within patch {patch} are required")
    return x
