"""The multiplier in a step, and what becomes of it: means over the fluid's vertices, and points that are held."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np
import scipy.sparse as sp
from mpi4py import MPI
from scipy.sparse.csgraph import connected_components

from coudalfish.surface.exchange import VertexMeans, updated_multiplier
from coudalfish.surface.sheets import Sheets
from coudalfish.surface.trace import TraceMatrix
from tigar_x import ranks
from tigar_x.compat import FloatArray

DEPENDENT = 1e-8
"""Normals of a sheet that vary by less, relative to its mean, are those of a plane."""
HELD = 1e-2
"""A point is held when what moves at its nodes has less than this weight there."""


class Alternating(Protocol):
    """A step that solves fluid and shell in turn."""

    def alternate(self) -> float:
        """One solve of each; returns the residual that the shell had with the new flow."""


class Multiplier:
    """The multiplier of a step, which lags behind it by one.

    At points that neither side can move it acts on nothing and has no equation: it is carried over from the nearest
    other points, so that forces and largest values are those of the whole surface.

    Args:
        lam: multiplier, shape (points,).
        n: normals at the start of the step, shape (points, d).
        sheets: how the points hang together.
        held: mask of the points that neither side can move, shape (points,).
        active: mask of the points in the fluid, shape (points,).
        weights: reference areas of the points, shape (points,).
        vertex_functions: of the fluid's mesh at the points; None: relaxation is uniform.
        comm: ranks that have all this; None: there is one.

    Attributes:
        acting: multiplier without that of points that are held, shape (points,).
        whole: all of it, shape (points,).
        turned: None, as it acts along the shell's normals.
    """

    turned: None = None

    def __init__(
        self,
        lam: FloatArray,
        n: FloatArray,
        sheets: Sheets,
        *,
        held: Any,
        active: Any,
        weights: FloatArray,
        vertex_functions: sp.csr_matrix | None,
        comm: MPI.Comm | None = None,
    ) -> None:
        self._held, self._lam, self._active, self._sheets = held, lam, active, sheets
        self.whole = lam
        self.acting = np.where(held, 0.0, lam)
        W = np.where(active & ~held, weights, 0.0)
        self._means = None if vertex_functions is None else SheetMeans(vertex_functions, W, n, sheets, comm)

    def advance(self, step: Alternating) -> float:
        """One pass: fluid and shell in turn."""
        return step.alternate()

    def satisfied(self, step: Alternating) -> bool:
        """It has no equation in the step."""
        return True

    def updated(
        self, u: FloatArray, y_dot: FloatArray, n: FloatArray, *, penalty: float, relaxation: float
    ) -> FloatArray:
        """Multiplier of the next step, see :func:`coudalfish.surface.exchange.updated_multiplier`."""
        state, r = (self.acting, u, y_dot, n, self._active), relaxation
        lam = updated_multiplier(*state, penalty=penalty, relaxation=r, means=self._means)
        return carried_over(np.where(self._held, self._lam, lam), self._active, self._held, self._sheets)


@dataclass(frozen=True, eq=False)
class SheetMeans:
    """Smoothing of the multiplier within sheets, ``S = K + (1 - K) P (1 - K)``.

    P are means over the fluid's vertices, in which points of different sheets, or of two layers of a folded one, do not
    meet, and which count the multiplier along normals that agree across joints. K is the projection, orthogonal in the
    area W, on the multipliers that are constant on a sheet or a component of its normals. So S keeps for every sheet
    the flow's measure ``int lam`` and the force ``int lam n``; it is symmetric in W with eigenvalues from 0 to 1, and
    does not depend on the directions in which patches are parametrised. On plane sheets it is P.

    Attributes:
        N: linear functions of vertices at the points, from
            :meth:`coudalfish.surface.trace.PointLocator.vertex_functions`.
        W: reference areas, zero at points that take no part, shape (points,).
        n: normals, shape (points, d).
        sheets: how the points hang together.
        comm: ranks that have the same, each of which takes some of the vertices; None: there is one.
    """

    N: sp.csr_matrix
    W: FloatArray
    n: FloatArray
    sheets: Sheets
    comm: MPI.Comm | None = None

    @cached_property
    def _means(self) -> VertexMeans:
        N = self.N
        if self.comm is not None and self.comm.size > 1:
            own = sp.csr_matrix((N.data * (N.indices % self.comm.size == self.comm.rank), N.indices, N.indptr), N.shape)
            own.eliminate_zeros()
            N = own
        return VertexMeans(apart(N, self.sheets), self.W)

    @cached_property
    def _kept(self) -> list[tuple[Any, FloatArray]]:
        """Points of each sheet, and the orthonormal multipliers on them that are kept, as columns."""
        blocks, root = [], np.sqrt(self.W)
        all_parts = np.column_stack([self.sheets.sign, self.n])
        for k in range(self.sheets.sheet.max(initial=-1) + 1):
            mine = np.flatnonzero(self.sheets.sheet == k)
            parts = all_parts[mine]
            _, size, V = np.linalg.svd(root[mine, None] * parts, full_matrices=False)
            rank = int((size > DEPENDENT * size.max(initial=0.0)).sum())
            blocks.append((mine, parts @ (V[:rank].T / size[:rank])))
        return blocks

    def _keep(self, x: FloatArray) -> FloatArray:
        kept, load = np.zeros_like(x), self.W * x
        for mine, columns in self._kept:
            kept[mine] = columns @ (columns.T @ load[mine])
        return kept

    def __matmul__(self, x: FloatArray) -> FloatArray:
        """Smoothed multiplier, shape (points,) (collective)."""
        kept, sign = self._keep(x), self.sheets.sign
        smooth = sign * (self._means @ (sign * (x - kept)))
        if self.comm is not None:
            smooth = ranks.total(self.comm, smooth)
        return kept + smooth - self._keep(smooth)


def apart(N: sp.csr_matrix, sheets: Sheets) -> sp.csr_matrix:
    """The same functions with a column of its own for every part of a vertex's points that hangs together."""
    N = N.copy()
    N.sum_duplicates()
    count = np.diff(N.indptr)
    point = np.repeat(np.arange(len(count)), count)
    keys = point * np.int64(N.shape[1]) + N.indices  # ascending
    a, b = sheets.links.T
    entry = np.repeat(N.indptr[a] - np.cumsum(count[a]) + count[a], count[a]) + np.arange(count[a].sum())
    wanted = np.repeat(b, count[a]) * np.int64(N.shape[1]) + N.indices[entry]
    other = np.minimum(np.searchsorted(keys, wanted), max(len(keys) - 1, 0))
    same = keys[other] == wanted
    pairs = (np.ones(int(same.sum())), (entry[same], other[same]))
    parts, column = connected_components(sp.coo_matrix(pairs, shape=(len(keys),) * 2), directed=False)
    return sp.csr_matrix((N.data, column, N.indptr), shape=(N.shape[0], parts))


def held_points(comm: MPI.Comm, free: Any, sheets: Sheets, trace: TraceMatrix, n: FloatArray) -> Any:
    """Points at which neither side can move along the normal, so that no slip drives the multiplier (collective).

    Args:
        comm: of the fluid.
        free: mask of the fluid's velocities that no strong condition holds, shape (nodes, d).
        sheets: how the points hang together, and how far the shell can move them.
        trace: where the points are.
        n: normals, shape (points, d).

    Returns:
        Mask, shape (points,).
    """
    if ranks.first(comm, bool((sheets.mobility > HELD).all())):
        return np.zeros(len(n), dtype=bool)
    mobility = np.asarray(trace.B @ free[trace.nodes].astype(float))
    total = np.empty_like(mobility)
    comm.Allreduce(mobility, total, op=MPI.SUM)
    return (np.abs(n) * np.maximum(total, sheets.mobility)).sum(axis=1) <= HELD * np.abs(n).sum(axis=1)


def carried_over(lam: FloatArray, known: Any, wanted: Any, sheets: Sheets) -> FloatArray:
    """Multiplier with that of the nearest known points along the sheet where it is not determined.

    Args:
        lam: multiplier, shape (points,).
        known: mask of the points whose multiplier is taken over.
        wanted: mask of the points that take it; without a known neighbour they keep theirs.
        sheets: how the points hang together.

    Returns:
        Shape (points,).
    """
    result, known = sheets.sign * lam, known & ~wanted
    a, b = sheets.both_ways
    there = (wanted & ~known)[a]
    a, b = a[there], b[there]
    while True:
        use = known[b] & ~known[a]
        if not use.any():
            return sheets.sign * result
        total, number = np.bincount(a[use], result[b[use]], len(lam)), np.bincount(a[use], minlength=len(lam))
        result = np.where(number > 0, total / np.maximum(number, 1), result)
        known = known | (number > 0)
