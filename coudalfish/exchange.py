"""Forces, tangents and multiplier update of the dynamic augmented Lagrangian method, on arrays and matrices.

Source: Kamensky et al., doi:10.1016/j.cma.2014.10.040; Kamensky, doi:10.1016/j.camwa.2020.01.023. The multiplier acts
along the shell's normal and is a force per reference area: +lam n is what the fluid does to the shell.
"""

from typing import Any

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from tigar_x.compat import FloatArray


def point_forces(
    u: FloatArray, y_dot: FloatArray, lam: FloatArray, n: FloatArray, W: FloatArray, *, penalty: float
) -> FloatArray:
    """Force that the fluid exerts on the shell at every point, ``W [beta (u - y') + lam n]``.

    Args:
        u: fluid velocity, shape (points, d).
        y_dot: shell velocity, shape (points, d).
        lam: multiplier, shape (points,); unit: force/area.
        n: shell normals, shape (points, d).
        W: reference areas, zero at inactive points, shape (points,).
        penalty: beta; unit: force time/length^3.

    Returns:
        Forces, shape (points, d).
    """
    return W[:, None] * (penalty * (u - y_dot) + lam[:, None] * n)


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
    return (B.T @ sp.diags(factor * penalty * W) @ B).tocsr()


def patch_means(patches: NDArray[np.int64], W: FloatArray) -> sp.csr_matrix:
    """Projection onto values that are constant per patch, ``sum_patch W x / sum_patch W`` at every point of a patch.

    Args:
        patches: number of the patch of every point, negative for points of none, shape (points,).
        W: reference areas, shape (points,).

    Returns:
        Matrix P, with empty rows at points of no patch or of one without area, shape (points, points).
    """
    inside = np.flatnonzero(patches >= 0)
    _, group = np.unique(patches[inside], return_inverse=True)
    members = sp.csr_matrix((np.ones(len(inside)), (group, inside)), shape=(group.max(initial=-1) + 1, len(patches)))
    area = members @ W
    share = np.divide(1.0, area, out=np.zeros_like(area), where=area > 0.0)
    return (members.T @ sp.diags(share) @ members @ sp.diags(W)).tocsr()


def updated_multiplier(
    lam: FloatArray,
    u: FloatArray,
    y_dot: FloatArray,
    n: FloatArray,
    active: Any,
    *,
    penalty: float,
    relaxation: float,
    means: sp.csr_matrix | None = None,
) -> FloatArray:
    """Multiplier of the next step; inactive points keep theirs.

    It follows from ``lam* = lam + beta (u - y') . n`` as ``lam*/(1 + r)`` or, with means P, as
    ``P lam* + (lam* - P lam*)/(1 + r)``. The latter damps variations inside a patch and keeps the force on it, so that
    no net flow leaks through it (compare Kamensky et al., doi:10.1016/j.camwa.2017.07.006).

    Args:
        lam: multiplier of this step, shape (points,).
        u: fluid velocity, shape (points, d).
        y_dot: shell velocity, shape (points, d).
        n: shell normals, shape (points, d).
        active: mask of the points in the fluid, shape (points,).
        penalty: beta.
        relaxation: r >= 0; without means a steady sheet leaks at the speed r lam/beta.
        means: from :func:`patch_means`; None: all of the multiplier is damped.

    Returns:
        New multiplier, shape (points,).
    """
    slip = np.einsum("qi,qi->q", u - y_dot, n)
    new = lam + penalty * slip
    kept = 0.0 if means is None else means @ new
    return np.where(active, kept + (new - kept) / (1.0 + relaxation), lam)
