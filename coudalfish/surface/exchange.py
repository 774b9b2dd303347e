"""Forces, tangents and multiplier update of the dynamic augmented Lagrangian method, on arrays and matrices.

Source: Kamensky et al., doi:10.1016/j.cma.2014.10.040; Kamensky, doi:10.1016/j.camwa.2020.01.023. The multiplier acts
along the shell's normal and is a force per reference area: +lam n is what the fluid does to the shell.
"""

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import scipy.sparse as sp

from tigar_x.compat import FloatArray


def tractions(lam: FloatArray, n: FloatArray) -> FloatArray:
    """A multiplier as force per area, shape (points, d).

    Args:
        lam: along the normals, shape (points,), or a vector already, shape (points, d).
        n: normals, shape (points, d).
    """
    return lam[:, None] * n if lam.ndim == 1 else lam


def along_normals(lam: FloatArray, n: FloatArray) -> FloatArray:
    """The part of a multiplier along the normals, shape (points,).

    Args:
        lam: shape (points,) or (points, d).
        n: normals of any length, shape (points, d).
    """
    if lam.ndim == 1:
        return lam
    square = np.einsum("qi,qi->q", n, n)
    return np.divide(np.einsum("qi,qi->q", lam, n), square, out=np.zeros_like(square), where=square > 0.0)


def by_components(A: sp.spmatrix, forces: sp.spmatrix, d: int) -> sp.csr_matrix:
    """A matrix times all components of forces, ``(A x I) F``.

    Args:
        A: shape (m, n).
        forces: those of functions, shape (n d, functions).
        d: number of components.

    Returns:
        Shape (m d, functions).
    """
    if not A.shape[1]:  # a rank may have no points
        return sp.csr_matrix((d * A.shape[0], forces.shape[1]))
    F = forces.tobsr((d, 1))
    beside = sp.bsr_matrix((F.data.reshape(-1, 1, d), F.indices, F.indptr), shape=(A.shape[1], d * F.shape[1]))
    product = A.tocsr().tobsr((1, 1)) @ beside  # components beside each other: one product for all
    blocks = product.data.reshape(-1, d, 1), product.indices, product.indptr
    return sp.bsr_matrix(blocks, shape=(d * A.shape[0], F.shape[1])).tocsr()


def point_forces(
    u: FloatArray, y_dot: FloatArray, lam: FloatArray, n: FloatArray, W: FloatArray, *, penalty: float
) -> FloatArray:
    """Force that the fluid exerts on the shell at every point, ``W [beta (u - y') + lam n]``.

    Args:
        u: fluid velocity, shape (points, d).
        y_dot: shell velocity, shape (points, d).
        lam: multiplier, shape (points,) or, as a vector, (points, d); unit: force/area.
        n: shell normals, shape (points, d).
        W: reference areas, zero at inactive points, shape (points,).
        penalty: beta; unit: force time/length^3.

    Returns:
        Forces, shape (points, d).
    """
    return W[:, None] * (penalty * (u - y_dot) + tractions(lam, n))


def lumped_tangent(B: sp.csr_matrix, W: FloatArray, *, penalty: float, factor: float) -> sp.csr_matrix:
    """Row sums of the penalty tangent of the fluid as a diagonal matrix, ``factor diag(B^T beta W)``.

    Since ``diag(B^T beta W) - B^T diag(beta W) B`` is positive semidefinite, this is a safe, over-damped replacement.

    Args:
        B: trace matrix, shape (points, nodes).
        W: reference areas, zero at inactive points, shape (points,).
        penalty: beta.
        factor: derivative of u_alpha with respect to the unknown.

    Returns:
        Matrix for one velocity component, shape (nodes, nodes).
    """
    diagonal, n = factor * penalty * (B.T @ W), B.shape[1]
    return sp.csr_matrix((diagonal, np.arange(n), np.arange(n + 1)), shape=(n, n))


def consistent_tangent(B: sp.csr_matrix, W: FloatArray, *, penalty: float, factor: float) -> sp.csr_matrix:
    """Penalty tangent of the fluid, ``factor B^T diag(beta W) B``.

    It couples only nodes of one cell, so a fluid matrix already has its non-zeros.

    Args:
        B: trace matrix, shape (points, nodes).
        W: reference areas, zero at inactive points, shape (points,).
        penalty: beta.
        factor: derivative of u_alpha with respect to the unknown.

    Returns:
        Matrix for one velocity component, shape (nodes, nodes).
    """
    weighted = B.T.tocsr()
    weighted.data *= (factor * penalty * W)[weighted.indices]
    return weighted @ B


class Means(Protocol):
    """A smoothing of values at points."""

    def __matmul__(self, x: FloatArray) -> FloatArray:
        """Smoothed values, shape (points,)."""


@dataclass(frozen=True, eq=False)
class VertexMeans:
    """Smoothing of values at points over the vertices of the fluid's mesh, ``N (N^T W x / N^T W)``.

    It leaves constants as they are, keeps the integral of every x, and is symmetric in the area W. What varies within
    cells, as patterns of the multiplier do, is not in it.

    Attributes:
        N: linear functions of vertices at the points, from
            :meth:`coudalfish.surface.trace.PointLocator.vertex_functions`.
        W: reference areas, zero at inactive points, shape (points,).
    """

    N: sp.csr_matrix
    W: FloatArray

    def __matmul__(self, x: FloatArray) -> FloatArray:
        """Smoothed values of shape (points,) or (points, components), zero at points outside the mesh."""
        area = self.N.T @ self.W
        sums = self.N.T @ (self.W * x.T).T
        means = np.divide(sums.T, area, out=np.zeros_like(sums.T), where=area > 0.0)
        return np.asarray(self.N @ means.T)


def updated_multiplier(
    lam: FloatArray,
    u: FloatArray,
    y_dot: FloatArray,
    n: FloatArray,
    active: Any,
    *,
    penalty: float,
    relaxation: float,
    means: Means | None = None,
) -> FloatArray:
    """Multiplier of the next step; inactive points keep theirs.

    It follows from ``lam* = lam + beta (u - y') . n`` as ``lam*/(1 + r)`` or, with means P, as
    ``P lam* + (lam* - P lam*)/(1 + r)``. The latter damps what the fluid's mesh cannot resolve and keeps what P keeps,
    see :class:`coudalfish.surface.multiplier.SheetMeans`, so that there is no net leak (compare the projection of
    Kamensky et
    al., doi:10.1016/j.camwa.2017.07.006).

    Args:
        lam: multiplier of this step, shape (points,).
        u: fluid velocity, shape (points, d).
        y_dot: shell velocity, shape (points, d).
        n: shell normals, shape (points, d).
        active: mask of the points in the fluid, shape (points,).
        penalty: beta.
        relaxation: r >= 0; without means a steady sheet leaks at the speed r lam/beta.
        means: see the text; None: all of the multiplier is damped.

    Returns:
        New multiplier, shape (points,).
    """
    slip = np.einsum("qi,qi->q", u - y_dot, n)
    new = lam + penalty * slip
    kept = 0.0 if means is None else means @ new
    return np.where(active, kept + (new - kept) / (1.0 + relaxation), lam)
