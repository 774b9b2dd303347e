"""Numbers at points of cells of a flow whose fields differ on both sides of a surface."""

from typing import Any

import numpy as np
from dolfinx import fem
from scipy.spatial import cKDTree

from tigar_x import compat
from tigar_x.compat import FloatArray, IntArray
from tigar_x.fem.divided import Doubled
from tigar_x.fem.simplices import SidedSimplices


class SidedValues:
    """Velocity and pressure on one side or the other; in cells that are not divided both are the same.

    Args:
        phi: linear function that is zero on the surface.
        length: in which kinks measure phi.
        doubled: what is divided.
        function: velocity and pressure at the end of the step.

    Attributes:
        function: as given.
    """

    def __init__(self, phi: fem.Function, length: fem.Constant, doubled: Doubled, function: fem.Function) -> None:
        self._length = length
        self.function, self._phi, self._doubled, self._both = function, phi, doubled, doubled.joined[0][2]
        self._d = function.function_space.mesh.geometry.dim
        spaces = (f.function_space for f in (function, self._both, phi))
        self._nodes, self._of_both, self._of_phi = map(compat.cell_dofs, spaces)
        x = function.function_space.tabulate_dof_coordinates()[:, : self._d]
        self._corners = x[self._nodes]

    def is_divided(self, cells: IntArray) -> Any:
        """Mask of those of some cells that are divided."""
        return self._doubled.cells[cells]

    def level(self, cells: IntArray, barycentric: FloatArray) -> FloatArray:
        """Values of phi; arguments as in :meth:`at`."""
        return np.asarray(np.einsum("nk,nk->n", barycentric, self._phi.x.array[self._of_phi[cells]]))

    def side(self, cells: IntArray, barycentric: FloatArray) -> FloatArray:
        """Sides on which points of cells lie, -1 or 1; arguments as in :meth:`at`."""
        return np.where(self.level(cells, barycentric) < 0.0, -1.0, 1.0)

    def barycentric(self, cells: IntArray, x: FloatArray) -> FloatArray:
        """Barycentric coordinates of points in cells, shape (n, d + 1); x of shape (n, d)."""
        corners = self._corners[cells]
        inner = np.einsum("ndk,nk->nd", self._slopes(cells), x - corners[:, 0])
        inner[:, 0] += 1.0
        return inner

    def nearest_divided(self, x: FloatArray, reach: float) -> IntArray:
        """Divided cells of this rank or of ghosts whose middles are nearest to points, -1 where none is in reach.

        Args:
            x: points, shape (n, d); unit: length.
            reach: largest distance of a middle, in shortest edges of its cell.
        """
        cells = np.flatnonzero(self._doubled.cells)
        if not len(cells):
            return np.full(len(x), -1)
        corners = self._corners[cells]
        distance, nearest = cKDTree(corners.mean(axis=1)).query(x)
        a, b = np.triu_indices(self._d + 1, 1)
        shortest = np.linalg.norm(corners[:, a] - corners[:, b], axis=2).min(axis=1)
        return np.where(distance <= reach * shortest[nearest], cells[nearest], -1)

    def _slopes(self, cells: IntArray) -> FloatArray:
        """Gradients of the barycentric coordinates, shape (n, d + 1, d)."""
        corners = self._corners[cells]
        inner = np.linalg.inv(np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2))
        return np.concatenate([-inner.sum(axis=1, keepdims=True), inner], axis=1)

    def _nodal(self, cells: IntArray) -> tuple[FloatArray, FloatArray]:
        """Means and differences at the nodes of cells, (velocity, pressure) and (kink over length, jump)."""
        self._doubled.join(last=True)
        m = self._d + 1
        mean, more = self.function.x.array.reshape(-1, m)[self._nodes[cells]], np.zeros((len(cells), m, m))
        there = self.is_divided(cells)
        both = self._both.x.array.reshape(-1, 2 * m)[self._of_both[cells[there]]]
        mean[there], more[there] = both[..., :m], both[..., m:]
        more[..., :-1] /= float(self._length.value)
        return mean, more

    def at(self, cells: IntArray, barycentric: FloatArray, s: FloatArray | float | None) -> FloatArray:
        """Velocity and pressure.

        Args:
            cells: local numbers, shape (n,).
            barycentric: coordinates there, shape (n, d + 1).
            s: sides, -1 or 1, one or shape (n,); None: those on which the points lie.

        Returns:
            Shape (n, d + 1).
        """
        s = self.side(cells, barycentric) if s is None else np.broadcast_to(s, len(cells))
        mean, more = self._nodal(cells)
        values, differences = (np.einsum("nk,nki->ni", barycentric, f) for f in (mean, more))
        phi = self._phi.x.array[self._of_phi[cells]]
        psi = np.einsum("nk,nk->n", barycentric, np.abs(phi) - s[:, None] * phi)
        values[:, :-1] += psi[:, None] * differences[:, :-1]
        values[:, -1] += 0.5 * s * differences[:, -1]
        return np.asarray(values)

    def gradient_at(self, cells: IntArray, barycentric: FloatArray, s: FloatArray) -> FloatArray:
        """Gradient of the velocity, (n, d, d), component first; arguments as in :meth:`at`."""
        (mean, more), slopes = self._nodal(cells), self._slopes(cells)
        phi = self._phi.x.array[self._of_phi[cells]]
        bend = np.abs(phi) - s[:, None] * phi
        psi = np.einsum("nk,nk->n", barycentric, bend)
        kink = np.einsum("nk,nki->ni", barycentric, more[..., :-1])
        nodal = mean[..., :-1] + psi[:, None, None] * more[..., :-1]
        smooth = np.einsum("nki,nkj->nij", nodal, slopes)
        return np.asarray(smooth + np.einsum("ni,nk,nkj->nij", kink, bend, slopes))

    def mean_gradient_at(self, cells: IntArray, barycentric: FloatArray, s: float) -> FloatArray:
        """Gradient of the velocity from means around nodes over what lies on a side, by size (collective).

        A kink is not well determined where a cell has little on a side; in the mean that counts little.

        Args:
            cells: local numbers, shape (n,).
            barycentric: coordinates there, shape (n, d + 1).
            s: side, -1 or 1.

        Returns:
            Shape (n, d, d), component first.
        """
        V, pieces, d = self.function.function_space, self.pieces(), self._d
        whole = np.setdiff1d(np.arange(compat.owned_cells(V.mesh)), pieces.cells)
        middle = np.full((len(whole), d + 1), 1.0 / (d + 1))
        on_side, mine = self.side(whole, middle) == s, pieces.side == s
        of = np.concatenate([whole[on_side], pieces.cells[mine]])
        at = np.concatenate([middle[on_side], pieces.barycentric[mine].mean(axis=1)])
        share = np.concatenate([np.ones(on_side.sum()), np.abs(np.linalg.det(pieces.barycentric[mine]))])
        size = share / np.abs(np.linalg.det(self._slopes(of)[:, 1:]))
        grad = self.gradient_at(of, at, np.full(len(of), s)).reshape(-1, d * d)
        sums, nodes = fem.Function(self._phi.function_space), self._of_phi
        totals = []
        for values in (size, *(size * component for component in grad.T)):
            sums.x.array[:] = np.bincount(nodes[of].ravel(), np.repeat(values, d + 1), len(sums.x.array))
            compat.accumulate(sums)
            totals.append(sums.x.array.copy())
        means = np.column_stack(totals[1:]) / np.where(totals[0] > 0.0, totals[0], 1.0)[:, None]
        return np.asarray(np.einsum("nk,nki->ni", barycentric, means[nodes[cells]]).reshape(-1, d, d))

    def pieces(self) -> SidedSimplices:
        """Pieces of the cells of this rank that are divided."""
        owned = compat.owned_cells(self.function.function_space.mesh)
        cells = np.flatnonzero(self._doubled.cells[:owned])
        return SidedSimplices.of(cells, self._phi.x.array[self._of_phi[cells]])

    def of_pieces(self, pieces: SidedSimplices) -> FloatArray:
        """Velocity and pressure at the vertices of pieces, on their sides, shape (pieces, d + 1, d + 1)."""
        size = self._d + 1
        cells, s = np.repeat(pieces.cells, size), np.repeat(pieces.side, size)
        return self.at(cells, pieces.barycentric.reshape(-1, size), s).reshape(-1, size, size)
