"""Homogeneous linear constraints between degrees of freedom, eliminated before anything is assembled.

Every constraint is a row of ``G U = 0``. :func:`null_space` solves them once by sparse elimination; the extraction
matrix becomes ``M T`` with ``U = T V`` and V the coefficients that remain free.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike

from tigar_x import checks
from tigar_x.compat import FloatArray, IntArray
from tigar_x.geometry.lines import Line, inner_lines, joints, rows_of
from tigar_x.geometry.multipatch import MultiPatch, as_multipatch, outside
from tigar_x.geometry.patch import Patch

ROUNDING = 1e-12
"""Entries below this, relative to the largest that went into their row, are zero."""
STRAIGHT = 1e-8
"""Departures from a plane or a direction below this, relative to the size of the model, are none."""


def tied(dofs: ArrayLike, to: ArrayLike, n: int, factor: ArrayLike = 1.0) -> sp.csr_matrix:
    """Constraints ``U[dofs] = factor U[to]``.

    Args:
        dofs: degrees of freedom, shape (k,).
        to: their partners, shape (k,).
        n: number of degrees of freedom.
        factor: one number or one for each, shape (k,).

    Returns:
        G, shape (k, n).

    Raises:
        ValueError: numbers that are out of range or not as many as their partners, or masks instead of numbers.
    """
    a, b = checks.indices("dofs", dofs, n).ravel(), checks.indices("to", to, n).ravel()
    if len(a) != len(b):
        raise ValueError(f"to has {len(b)} entries: {len(a)} are required, one for each of dofs")
    entries = np.concatenate([np.ones(len(a)), -np.broadcast_to(factor, a.shape)])
    return sp.csr_matrix((entries, (np.tile(np.arange(len(a)), 2), np.concatenate([a, b]))), shape=(len(a), n))


def symmetry(geometry: Patch | MultiPatch, side: str, normal: int, *, patch: int | None = None) -> sp.csr_matrix:
    """Symmetry of a shell's displacement about a coordinate plane that its edge lies in.

    The displacement along the normal of the plane vanishes at the edge, and the other components have no slope across
    it: the second row of control points moves with the first. The coordinate lines must meet the plane at right
    angles, as those of a symmetric shape do.

    Args:
        geometry: curve or surface, of one or several patches.
        side: name of the edge.
        normal: axis normal to the plane.
        patch: whose edge; None: those of that name of all patches but the ones that are glued to another edge.

    Returns:
        G, shape (constraints, n nsd).

    Raises:
        ValueError: no such side or axis, the edge does not lie in such a plane, or the coordinate lines leave it at
            another angle.
    """
    checks.choice("normal", normal, tuple(range(geometry.nsd)))
    whole = as_multipatch(geometry)
    blocks = [_mirror(whole, place, side, normal) for place in outside(whole, [side], patch)]
    return sp.vstack(blocks, format="csr")


def _mirror(geometry: MultiPatch, place: tuple[int, int, int], side: str, normal: int) -> sp.csr_matrix:
    """Symmetry at one side."""
    (edge, next_row), nsd = _rows(geometry, place), geometry.nsd
    x0, x1 = geometry.points[edge], geometry.points[next_row]
    if np.ptp(x0[:, normal]) > STRAIGHT * geometry.size:
        raise ValueError(f"side = {side!r} does not lie in a plane normal to axis {normal}")
    step, ratio = np.delete(x1 - x0, normal, axis=1), geometry.weights[next_row] / geometry.weights[edge]
    if np.abs(step).max(initial=0.0) > STRAIGHT * geometry.size or np.ptp(ratio) > STRAIGHT:
        raise ValueError(f"side = {side!r}: coordinate lines must leave it along axis {normal}, the plane's normal")
    n, still = geometry.n * nsd, edge * nsd + normal
    blocks = [sp.csr_matrix((np.ones(len(still)), (np.arange(len(still)), still)), shape=(len(still), n))]
    blocks += [tied(next_row * nsd + c, edge * nsd + c, n, ratio) for c in range(nsd) if c != normal]
    return sp.vstack(blocks)


def _rows(geometry: MultiPatch, place: tuple[int, int, int]) -> tuple[IntArray, IntArray]:
    """First and second row of functions next to a side (patch, direction, end), in the same order."""
    k, direction, end = place
    first, second = _local_rows(geometry.patches[k], direction, end)
    number = geometry.functions.global_numbers
    return number(k, first), number(k, second)


def _local_rows(patch: Patch, direction: int, end: int) -> tuple[IntArray, IntArray]:
    """The same in the numbering of the patch."""
    return rows_of(patch, direction, *((0, 1) if end == 0 else (-1, -2)))


def no_rotation(geometry: Patch | MultiPatch, *sides: str, patch: int | None = None) -> sp.csr_matrix:
    """Edges of a shell that do not turn, whether they move or not: a_3 stays normal to what is next to them.

    The second row of control points moves with the first, but for displacements within the tangent plane, taken at the
    Greville points of the edge. Together with the position (``pinned``) this is a clamped edge. Holding two full rows
    of control points would keep the edge's neighbourhood from stretching as well, an error that falls with the size of
    an element only.

    Args:
        geometry: curve in the plane or surface in space, of one or several patches.
        sides: names of the edges.
        patch: whose edges; None: those of that name of all patches but the ones that are glued to another edge.

    Returns:
        G, shape (constraints, n nsd).

    Raises:
        ValueError: no side is named, there is no such side, an edge has no normal, or the geometry is not a shell.
    """
    if not sides:
        raise ValueError("sides is empty: name at least one edge")
    size = (geometry.dim, geometry.nsd)
    if size not in ((1, 2), (2, 3)):
        raise ValueError(f"geometry has dimension {size[0]} in {size[1]} dimensions: 1 in 2, or 2 in 3 is required")
    whole = as_multipatch(geometry)
    return sp.vstack([_unturned(whole, place) for place in outside(whole, sides, patch)], format="csr")


def _unturned(geometry: MultiPatch, place: tuple[int, int, int]) -> sp.csr_matrix:
    """Edge without rotation at one side."""
    (edge, next_row), nsd = _rows(geometry, place), geometry.nsd
    normals = _edge_normals(geometry.patches[place[0]], *place[1:])
    weights = geometry.weights
    entries = [normals / weights[next_row, None], -normals / weights[edge, None]]
    columns = [row[:, None] * nsd + np.arange(nsd) for row in (next_row, edge)]
    rows = np.repeat(np.arange(len(edge)), nsd)
    data = np.concatenate([entry.ravel() for entry in entries])
    positions = (np.tile(rows, 2), np.concatenate([column.ravel() for column in columns]))
    return sp.csr_matrix((data, positions), shape=(len(edge), geometry.n * nsd))


def _edge_normals(patch: Patch, direction: int, end: int) -> FloatArray:
    """Unit normals at the Greville points of a side, shape (functions, nsd)."""
    xi = patch.basis.greville[_local_rows(patch, direction, end)[0]]
    normals, sizes = _area_vectors(patch, xi)
    for i in np.flatnonzero(np.linalg.norm(normals, axis=1) <= STRAIGHT * sizes):
        normals[i] = _limit_of_normals(patch, xi[i], direction)
    return np.asarray(normals / np.linalg.norm(normals, axis=1, keepdims=True))


def _area_vectors(patch: Patch, xi: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Normals times w^4 (in the plane: w^2), which are polynomials, and the size that they have where none is lost."""
    homogeneous, tangents = patch.basis.evaluate(xi) @ patch.control, []
    P, w = homogeneous[:, :-1], homogeneous[:, -1:]
    for d in range(patch.dim):
        slope = patch.basis.evaluate(xi, d) @ patch.control
        tangents.append(w * slope[:, :-1] - P * slope[:, -1:])
    normals = tangents[0][:, ::-1] * (1, -1) if patch.dim == 1 else np.cross(*tangents)
    return normals, np.prod([np.linalg.norm(tangent, axis=1) for tangent in tangents], axis=0)


def _limit_of_normals(patch: Patch, xi: FloatArray, direction: int) -> FloatArray:
    """Normal, of any length, that those of a side tend to at a point without one, as where two sides have one tangent.

    There the polynomial of :func:`_area_vectors` vanishes, and its derivative along the side points along the limit.
    """
    side = f"side {'uvw'[direction]}{int(xi[direction] == patch.basis.box[1, direction])}"
    if patch.dim == 2:
        along = 1 - direction
        ticks = patch.bases[along].breakpoints
        e = int(np.clip(np.searchsorted(ticks, xi[along], side="right"), 1, len(ticks) - 1))
        degree = 4 * patch.bases[along].degree
        to_element = np.polynomial.chebyshev.chebpts1(degree + 1)
        samples = np.tile(xi, (degree + 1, 1))
        samples[:, along] = ticks[e - 1] + (ticks[e] - ticks[e - 1]) * (1.0 + to_element) / 2.0
        values, sizes = _area_vectors(patch, samples)
        slopes = np.polynomial.chebyshev.chebder(np.polynomial.chebyshev.chebfit(to_element, values, degree))
        at = 2.0 * (xi[along] - ticks[e - 1]) / (ticks[e] - ticks[e - 1]) - 1.0
        limit = np.polynomial.chebyshev.chebval(at, slopes)
        if np.linalg.norm(limit) > STRAIGHT * sizes.max():
            return np.asarray(limit)
    raise ValueError(f"{side} has a point without a normal: no edge that collapses is allowed")


def smooth_joints(geometry: MultiPatch, size: int | None = None, *, tolerance: float = 1e-6) -> sp.csr_matrix:
    """C1 joints of glued sides: the rows of control points on both sides stay collinear with the joint's.

    The homogeneous control points must satisfy ``P_joint = (s P_+/a + P_-/b)/(s + 1)`` with one ratio s along the
    joint; the displacements are then made to do the same, which keeps the surface's tangent plane continuous. Here a
    and b are the weights of the two rows over those of the joint, as between arcs of a circle, or 1 where they vary.

    Args:
        geometry: glued patches (:func:`tigar_x.geometry.gluing.glued`).
        size: number of components of the field; None: ``nsd``.
        tolerance: allowed departure of the geometry from collinearity, relative to its size.

    Returns:
        G, shape (constraints, n size).

    Raises:
        ValueError: no side is shared, or patches meet at an angle.
    """
    found = joints(geometry)
    if not found:
        raise ValueError("geometry has no side that two patches share: glue patches at coincident control points first")
    return _smooth(geometry, found, size, tolerance)


def smooth_lines(geometry: Patch | MultiPatch, size: int | None = None, *, tolerance: float = 1e-6) -> sp.csr_matrix:
    """C1 across the lines inside patches where functions are only C0, like :func:`smooth_joints` for glued sides.

    Such lines follow knots that are repeated as often as the degree: where the spans of an arc of more than 90 degrees
    meet, and in surfaces that come from CAD.

    Args:
        geometry: curve or surface, of one or several patches.
        size: number of components of the field; None: ``nsd``.
        tolerance: allowed departure of the geometry from collinearity, relative to its size.

    Returns:
        G, shape (constraints, n size).

    Raises:
        ValueError: no knot is repeated so often, or the geometry has an angle there. (Of degree 1 every knot is such a
            line; a higher degree is the remedy.)
    """
    whole = as_multipatch(geometry)
    found = [replace(line, name=f"both sides of {line.name}") for line in inner_lines(whole) if line.degree > 1]
    if not found:
        raise ValueError("geometry has no line inside a patch, of degree 2 or more, where functions are only C0")
    return _smooth(whole, found, size, tolerance)


def _smooth(geometry: MultiPatch, lines: Sequence[Line], size: int | None, tolerance: float) -> sp.csr_matrix:
    """C1 across lines."""
    blocks = []
    for line in lines:
        one, other = (bank.functions(geometry) for bank in line.banks)
        blocks.append(_joint(geometry, one, other, line.name, tolerance))
    return sp.kron(sp.vstack(blocks), sp.identity(geometry.nsd if size is None else size), format="csr")


def _joint(
    geometry: MultiPatch, one: tuple[IntArray, IntArray], other: tuple[IntArray, IntArray], pair: str, tolerance: float
) -> sp.csr_matrix:
    """Constraints of one joint, one per function along it."""
    order = {function: i for i, function in enumerate(other[0])}
    match = np.array([order[function] for function in one[0]])
    joint, plus, minus = one[0], one[1], other[1][match]
    apart = (plus != joint) & (minus != joint)  # at a pole the rows meet
    joint, plus, minus = joint[apart], plus[apart], minus[apart]
    alpha, beta = _weight_ratios(geometry, joint, plus, minus)
    w = geometry.weights[:, None]
    P = np.column_stack([w * geometry.relative_points, w]) / w.max()
    forward, backward = P[plus] / alpha - P[joint], P[joint] - P[minus] / beta
    ratio = float((forward * backward).sum() / (forward**2).sum())
    if ratio <= 0.0 or np.abs(ratio * forward - backward).max() > tolerance:
        raise ValueError(f"{pair} meet at an angle: control points that are collinear across the joint are required")
    i = np.arange(len(joint))
    entries = np.repeat([ratio / alpha, 1.0 / beta, -1.0 - ratio], len(i))
    columns = np.concatenate([plus, minus, joint])
    return sp.csr_matrix((entries, (np.tile(i, 3), columns)), shape=(len(i), geometry.n))


def _weight_ratios(geometry: MultiPatch, joint: IntArray, plus: IntArray, minus: IntArray) -> tuple[float, float]:
    """Weights of two rows over those of the joint where these ratios are constant, else 1."""
    w = geometry.weights
    ratios = w[plus] / w[joint], w[minus] / w[joint]
    if any(np.ptp(ratio) > STRAIGHT for ratio in ratios):
        return 1.0, 1.0
    return float(ratios[0].mean()), float(ratios[1].mean())


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
        ValueError: a block has another number of columns, or an entry that is not finite.
    """
    for i, block in enumerate(constraints):
        if block.shape[1] != n:
            raise ValueError(f"constraints[{i}] has {block.shape[1]} columns: {n} degrees of freedom are required")
        if not np.isfinite(block.sum()):
            raise ValueError(f"constraints[{i}] has entries that are not finite: finite ones are required")
    G = sp.vstack([*constraints], format="csr")
    solved: dict[int, dict[int, float]] = {int(dof): {} for dof in fixed}
    users: dict[int, set[int]] = {}
    for start, stop in zip(G.indptr[:-1], G.indptr[1:], strict=True):
        row: dict[int, float] = {}
        largest = np.abs(G.data[start:stop]).max(initial=0.0)
        for j, value in zip(G.indices[start:stop].tolist(), G.data[start:stop].tolist(), strict=True):
            for k, factor in solved.get(j, {j: 1.0}).items():
                row[k] = row.get(k, 0.0) + value * factor
                largest = max(largest, abs(value * factor))
        row = {k: v for k, v in row.items() if abs(v) > ROUNDING * largest}
        if not row:
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
