"""What a converged multiplier is made of: few functions on the reference surface, and how they act in a step."""

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import LinearOperator, splu

from coudalfish.step.method import Stepping
from coudalfish.surface.exchange import along_normals, by_components, tractions
from coudalfish.surface.hats import hat_functions
from coudalfish.surface.sheets import Sheets
from tigar_x.compat import FloatArray
from tigar_x.splines.spline import ExtractedSpline

SHIFT = 1e-8
"""What is added to the matrix of the functions' products, relative to its largest, so that it can be factored."""
CORRECTIONS = 3
"""Repetitions that take it away: each leaves it over the least eigenvalue of functions that do not depend."""


@dataclass(frozen=True, eq=False)
class Acting:
    """The functions of a multiplier in a step.

    Attributes:
        H: forces per area at the points, zero where they act on nothing, shape (points d, coefficients).
        G: forces on the shell, shape (points d, coefficients), this rank's share.
        F: forces on the trace's nodes, shape (nodes d, coefficients), likewise.
        own_normals: whether the meeting has normals of its own.
    """

    H: sp.csr_matrix
    G: sp.csr_matrix
    F: sp.csr_matrix
    own_normals: bool


class Functions:
    """Hat functions, along the normals or as vectors.

    A vector has a coefficient for every component or, where the meeting has normals of its own, one along these and two
    across those of the shell: a pressure that jumps is then in equilibrium with the first.

    Args:
        spline: of the shell, of tensor cells.
        sheets: how its points hang together.
        weights: their reference areas, shape (points,).
        size: of the functions, about; unit: length.
        vector: whether they are vectors.

    Attributes:
        vector: as given.
        count: number of coefficients.
        areas_t: sizes of the functions at the points, shape (functions, points).

    Raises:
        ValueError: the shell's points are no tensor grid.
    """

    def __init__(
        self, spline: ExtractedSpline, sheets: Sheets, weights: FloatArray, size: float, *, vector: bool
    ) -> None:
        N = hat_functions(spline, sheets, weights, size)
        d, self.vector = spline.nsd, vector
        self._sizes, self._signs = sp.csr_matrix(abs(N)), sheets.sign
        self._N = self._sizes if vector else N  # a vector has no side
        self.areas_t = self._sizes.T.tocsr()
        self._fit = nearest_coefficients(self._N, weights)
        self._spread = sp.kron(self._N, np.eye(d) if vector else np.ones((d, 1)), format="csr")
        self._rows = np.repeat(np.arange(self._spread.shape[0]), np.diff(self._spread.indptr))
        self.count = self._spread.shape[1]

    def fitted(self, lam: FloatArray, n: FloatArray, *, own_normals: bool) -> FloatArray:
        """Coefficients that are nearest to a multiplier, shape (coefficients,).

        Args:
            lam: at the points, along the normals or a vector, shape (points,) or (points, d).
            n: normals, shape (points, d).
            own_normals: whether the meeting has normals of its own.
        """
        if not self.vector:
            return np.asarray(self._fit @ along_normals(lam, n))
        force = tractions(lam, n)
        if not own_normals:
            return np.asarray(self._fit @ force).ravel()
        n = self._signs[:, None] * n
        along = along_normals(force, n)
        across = self._fit @ (force - along[:, None] * n)
        parts = [self._fit @ along, *(np.einsum("fi,fi->f", across, t) for t in self._across(n))]
        return np.stack(parts, axis=1).ravel()

    def values(self, c: FloatArray, n: FloatArray, *, own_normals: bool) -> FloatArray:
        """The multiplier at the points, shape (points,) or, as a vector, (points, d).

        Args:
            c: coefficients, shape (coefficients,).
            n: normals, shape (points, d).
            own_normals: see :meth:`fitted`.
        """
        if not self.vector:
            return np.asarray(self._N @ c)
        if own_normals:
            return np.asarray((self._along_and_across(n) @ c).reshape(n.shape))
        return np.asarray(self._N @ c.reshape(-1, n.shape[1]))

    def acting(self, step: Stepping, acts: FloatArray) -> Acting:
        """The functions as they act in a step (collective).

        Args:
            step: the step.
            acts: one at points at which they act, zero at those where nothing can move, shape (points,).
        """
        d = step.n.shape[1]
        sizes = self._sizes if acts.all() else sp.csr_matrix(sp.diags(acts) @ self._sizes)
        own = step.meeting.normal_forces(sizes, self._signs[:, None] * step.n)
        if own is not None and self.vector:
            H = sp.csr_matrix(sp.diags(np.repeat(acts, d)) @ self._along_and_across(step.n))
        else:
            factors = np.broadcast_to(acts[:, None], step.n.shape) if self.vector else acts[:, None] * step.n
            spread = self._spread
            data = spread.data * factors.ravel()[self._rows]
            H = sp.csr_matrix((data, spread.indices, spread.indptr), shape=spread.shape)
        if own is not None and not self.vector:
            return Acting(H, own.at_points, own.at_nodes, own_normals=True)
        G = sp.csr_matrix(sp.diags(np.repeat(step.W, d)) @ H)
        F = by_components(step.trace.transposed, G, d)
        if step.comm.size > 1:
            share = step.trace.seen / np.maximum(step.trace.seen_by(step.comm), 1)  # who sees a point has the same
            G = sp.csr_matrix(sp.diags(np.repeat(share, d)) @ G)
        if own is None:
            return Acting(H, G, F, own_normals=False)
        return Acting(H, _with_own(G, own.at_points), _with_own(F, own.at_nodes), own_normals=True)

    def _across(self, n: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Two directions across the mean normal of each function, shape (functions, 3) each."""
        mean = self.areas_t @ n
        mean[~mean.any(axis=1), 2] = 1.0  # normals of a closed surface that is one function cancel
        mean /= np.linalg.norm(mean, axis=1)[:, None]
        axis = np.eye(3)[np.abs(mean).argmin(axis=1)]
        first = np.cross(mean, axis)
        first /= np.linalg.norm(first, axis=1)[:, None]
        return first, np.cross(mean, first)

    def _along_and_across(self, n: FloatArray) -> sp.csr_matrix:
        """Forces per area of the functions along normals and across them, shape (points 3, functions 3)."""
        n, N = self._signs[:, None] * n, self._N.tocoo()
        values = np.empty((N.nnz, 3, 3))
        of = values[:, :, 0] = n[N.row]
        for k, direction in enumerate(self._across(n), 1):
            t = direction[N.col]
            values[:, :, k] = t - along_normals(t, of)[:, None] * of
        values *= N.data[:, None, None]
        row = np.broadcast_to((3 * N.row)[:, None, None] + np.arange(3)[:, None], values.shape)
        column = np.broadcast_to((3 * N.col)[:, None, None] + np.arange(3), values.shape)
        shape = 3 * N.shape[0], 3 * N.shape[1]
        return sp.csr_matrix((values.ravel(), (row.ravel(), column.ravel())), shape=shape)


def _with_own(forces: sp.csr_matrix, along: sp.csr_matrix) -> sp.csr_matrix:
    """Forces of vectors whose first coefficients, of three, act along the meeting's own normals."""
    m = along.shape[1]
    place = sp.csr_matrix((np.ones(m), (np.arange(m), 3 * np.arange(m))), shape=(m, 3 * m))
    others = sp.diags(np.tile([0.0, 1.0, 1.0], m))
    return sp.csr_matrix(forces @ others + along @ place)


def nearest_coefficients(N: sp.csr_matrix, W: FloatArray) -> LinearOperator:
    """From multipliers to the coefficients of the functions that are nearest to them in the mean over areas.

    Of functions that depend on each other at the points, which they do where they are finer, they are the smallest.

    Args:
        N: functions at the points, shape (points, functions).
        W: areas, shape (points,).

    Returns:
        Shape (functions, points).
    """
    weighted = sp.csr_matrix(N.T @ sp.diags(W))
    products = sp.csc_matrix(weighted @ N)
    shift = SHIFT * products.diagonal().max() * sp.identity(N.shape[1], format="csc")
    solve = splu(products + shift, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}).solve

    def fitted(lam: FloatArray) -> FloatArray:
        c = solve(weighted @ lam)
        for _ in range(CORRECTIONS):
            c = c + solve(weighted @ (lam - N @ c))
        return np.asarray(c)

    return LinearOperator(N.shape[::-1], matvec=fitted, matmat=fitted, dtype=np.float64)
