"""Homogeneous linear constraints between degrees of freedom, eliminated before anything is assembled.

Every constraint is a row of ``G U = 0``. :func:`null_space` solves them once by sparse elimination; the extraction
matrix becomes ``M T`` with ``U = T V`` and V the coefficients that remain free.
"""

from collections.abc import Sequence

import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike

from tigar_x import checks
from tigar_x.compat import FloatArray, IntArray
from tigar_x.multipatch import MultiPatch
from tigar_x.patch import Patch

ROUNDING = 1e-12
"""Entries below this, relative to the largest of their row, are zero."""


def tied(dofs: ArrayLike, to: ArrayLike, n: int, factor: ArrayLike = 1.0) -> sp.csr_matrix:
    """Constraints ``U[dofs] = factor U[to]``.

    Args:
        dofs: degrees of freedom, shape (k,).
        to: their partners, shape (k,).
        n: number of degrees of freedom.
        factor: one number or one for each, shape (k,).

    Returns:
        G, shape (k, n).
    """
    a, b = np.asarray(dofs), np.asarray(to)
    entries = np.concatenate([np.ones(len(a)), -np.broadcast_to(factor, a.shape)])
    return sp.csr_matrix((entries, (np.tile(np.arange(len(a)), 2), np.concatenate([a, b]))), shape=(len(a), n))


def symmetry(patch: Patch, side: str, normal: int) -> sp.csr_matrix:
    """Symmetry of a shell's displacement about a coordinate plane that its edge lies in.

    The displacement along the normal of the plane vanishes at the edge, and the other components have no slope across
    it: the second row of control points moves with the first. The coordinate lines must meet the plane at right
    angles, as those of a symmetric shape do.

    Args:
        patch: curve or surface.
        side: name of the edge.
        normal: axis normal to the plane.

    Returns:
        G, shape (constraints, n nsd).

    Raises:
        ValueError: no such side or axis, the edge does not lie in such a plane, or the coordinate lines leave it at
            another angle.
    """
    checks.choice("normal", normal, tuple(range(patch.nsd)))
    edge, next_row = _rows(patch, side)
    x0, x1 = patch.points[edge], patch.points[next_row]
    size = np.ptp(patch.points, axis=0).max()
    if np.ptp(x0[:, normal]) > 1e-8 * size:
        raise ValueError(f"side = {side!r} does not lie in a plane normal to axis {normal}")
    step = np.delete(x1 - x0, normal, axis=1)
    if np.abs(step).max() > 1e-8 * size or np.ptp(patch.weights[edge] / patch.weights[next_row]) > 1e-8:
        raise ValueError(f"side = {side!r}: coordinate lines must leave it along axis {normal}, the plane's normal")
    n, ratio = patch.n * patch.nsd, patch.weights[next_row] / patch.weights[edge]
    still = edge * patch.nsd + normal
    blocks = [sp.csr_matrix((np.ones(len(still)), (np.arange(len(still)), still)), shape=(len(still), n))]
    for c in range(patch.nsd):
        if c != normal:
            blocks.append(tied(next_row * patch.nsd + c, edge * patch.nsd + c, n, ratio))
    return sp.vstack(blocks, format="csr")


def _rows(patch: Patch, side: str) -> tuple[IntArray, IntArray]:
    """First and second row of functions next to a side, in the same order."""
    direction, end = patch.locate_side(side)
    grid = np.arange(patch.n).reshape([basis.n for basis in patch.bases], order="F")
    first, second = (0, 1) if end == 0 else (-1, -2)
    edge, next_row = (np.take(grid, row, axis=direction).ravel().astype(np.int32) for row in (first, second))
    return edge, next_row


def smooth_joints(geometry: MultiPatch, tolerance: float = 1e-6) -> sp.csr_matrix:
    """C1 joints of glued patches: the rows of control points on both sides stay collinear with the joint's.

    The homogeneous control points must satisfy ``P_joint = (s P_+ + P_-)/(s + 1)`` with one ratio s along the joint;
    the displacements are then made to do the same, which keeps the surface's tangent plane continuous.

    Args:
        geometry: glued patches (:func:`tigar_x.multipatch.glued`).
        tolerance: allowed departure of the geometry from collinearity, relative to its size.

    Returns:
        G, shape (constraints, n nsd).

    Raises:
        ValueError: the patches share no side, or meet at an angle.
    """
    numbered = [(k, name) for k, patch in enumerate(geometry.patches) for name in patch.open_sides]
    rows = {key: _global_rows(geometry, *key) for key in numbered}
    blocks: list[sp.csr_matrix] = []
    for i, one in enumerate(numbered):
        for other in numbered[:i]:
            if one[0] == other[0] or set(rows[one][0]) != set(rows[other][0]):
                continue
            blocks.append(_joint(geometry, rows[one], rows[other], f"sides {other} and {one}", tolerance))
    if not blocks:
        raise ValueError("geometry has no side that two patches share: glue patches at coincident control points first")
    scalar = sp.vstack(blocks, format="csr")
    return sp.kron(scalar, sp.identity(geometry.nsd), format="csr")


def _global_rows(geometry: MultiPatch, k: int, name: str) -> tuple[IntArray, IntArray]:
    first, second = _rows(geometry.patches[k], name)
    number = geometry.functions.global_numbers
    return number(k, first), number(k, second)


def _joint(
    geometry: MultiPatch, one: tuple[IntArray, IntArray], other: tuple[IntArray, IntArray], pair: str, tolerance: float
) -> sp.csr_matrix:
    """Constraints of one joint, one per function along it."""
    order = {function: i for i, function in enumerate(other[0])}
    match = np.array([order[function] for function in one[0]])
    joint, plus, minus = one[0], one[1], other[1][match]
    P = geometry.control
    forward, backward = P[plus] - P[joint], P[joint] - P[minus]
    ratio = float((forward * backward).sum() / (forward**2).sum())
    size = np.ptp(geometry.points, axis=0).max()
    if ratio <= 0.0 or np.abs(ratio * forward - backward).max() > tolerance * size:
        raise ValueError(f"{pair} meet at an angle: control points that are collinear across the joint are required")
    i = np.arange(len(joint))
    entries = np.concatenate([np.full(len(i), ratio), np.ones(len(i)), np.full(len(i), -1.0 - ratio)])
    columns = np.concatenate([plus, minus, joint])
    return sp.csr_matrix((entries, (np.tile(i, 3), columns)), shape=(len(i), geometry.n))


def null_space(constraints: Sequence[sp.spmatrix], fixed: IntArray, n: int) -> sp.csr_matrix:
    """Matrix T of all solutions ``U = T V`` of ``G U = 0`` with ``U[fixed] = 0``.

    Rows are eliminated one after the other, each by its largest entry; rows that follow from others drop out.

    Args:
        constraints: blocks of rows of G, each of shape (k, n).
        fixed: degrees of freedom that vanish.
        n: number of degrees of freedom.

    Returns:
        T, shape (n, free); rows of free degrees of freedom are unit vectors.

    Raises:
        ValueError: a block has another number of columns.
    """
    for i, block in enumerate(constraints):
        if block.shape[1] != n:
            raise ValueError(f"constraints[{i}] has {block.shape[1]} columns: {n} degrees of freedom are required")
    G = sp.vstack([*constraints], format="csr")
    solved: dict[int, dict[int, float]] = {int(dof): {} for dof in fixed}
    users: dict[int, set[int]] = {}
    for start, stop in zip(G.indptr[:-1], G.indptr[1:], strict=True):
        row: dict[int, float] = {}
        for j, value in zip(G.indices[start:stop].tolist(), G.data[start:stop].tolist(), strict=True):
            for k, factor in solved.get(j, {j: 1.0}).items():
                row[k] = row.get(k, 0.0) + value * factor
        scale = max(map(abs, row.values()), default=0.0)
        row = {k: v for k, v in row.items() if abs(v) > ROUNDING * scale}
        if scale <= ROUNDING * np.abs(G.data[start:stop]).max(initial=0.0) or not row:
            continue
        pivot = max(row, key=lambda k: (abs(row[k]), -k))
        own = row.pop(pivot)
        solution = {k: -v / own for k, v in row.items()}
        for user in users.pop(pivot, set()):
            factor = solved[user].pop(pivot)
            for k, v in solution.items():
                solved[user][k] = solved[user].get(k, 0.0) + factor * v
                users.setdefault(k, set()).add(user)
        solved[pivot] = solution
        for k in solution:
            users.setdefault(k, set()).add(pivot)
    return _as_matrix(solved, n)


def _as_matrix(solved: dict[int, dict[int, float]], n: int) -> sp.csr_matrix:
    free = np.setdiff1d(np.arange(n), np.fromiter(solved, dtype=np.int64, count=len(solved)))
    column = np.full(n, -1)
    column[free] = np.arange(len(free))
    entries = [(dof, k, v) for dof, solution in solved.items() for k, v in solution.items()]
    i, k, v = (np.array(part) for part in zip(*entries, strict=True)) if entries else (free[:0], free[:0], np.empty(0))
    rows, columns = np.concatenate([free, i]), np.concatenate([column[free], column[k]])
    data: FloatArray = np.concatenate([np.ones(len(free)), v])
    return sp.csr_matrix((data, (rows.astype(np.int64), columns.astype(np.int64))), shape=(n, len(free)))
