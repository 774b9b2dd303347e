"""Meshes as arrays with named groups, and the checks that such arrays are a mesh. Everything here is on one rank."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from tigar_x import checks
from tigar_x.compat import FloatArray

Numbers = NDArray[np.int64]

FACETS = {
    "triangle": np.array([[0, 1], [0, 2], [1, 2]]),
    "quadrilateral": np.array([[0, 1], [0, 2], [1, 3], [2, 3]]),
    "tetrahedron": np.array([[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]]),
    "hexahedron": np.array([[0, 1, 2, 3], [0, 1, 4, 5], [0, 2, 4, 6], [1, 3, 5, 7], [2, 3, 6, 7], [4, 5, 6, 7]]),
}
"""Vertices of the facets of every kind of cell, in dolfinx's ordering."""
DIMENSIONS = {"triangle": 2, "quadrilateral": 2, "tetrahedron": 3, "hexahedron": 3}
VERTICES = {"triangle": 3, "quadrilateral": 4, "tetrahedron": 4, "hexahedron": 8}
FLAT = 1e-10
"""Cells whose volume is smaller, relative to their diameter, have none."""


@dataclass(frozen=True, eq=False)
class MeshArrays:
    """A mesh as arrays, with named groups of facets and cells.

    Args:
        cell: "triangle", "quadrilateral", "tetrahedron" or "hexahedron".
        cells: vertices of the cells, shape (cells, vertices per cell), in dolfinx's ordering.
        x: coordinates of the vertices, shape (vertices, dimension of the cell).
        facets: for every name the vertices of its facets in any order, shape (facets, vertices per facet).
        cell_groups: for every name the numbers of its cells, shape (n,).
    """

    cell: str
    cells: Any
    x: Any
    facets: Mapping[str, Any] = field(default_factory=dict)
    cell_groups: Mapping[str, Any] = field(default_factory=dict)


def checked_arrays(arrays: MeshArrays) -> MeshArrays:
    """The same mesh once it is known to be one, without vertices that no cell has.

    Args:
        arrays: to check.

    Returns:
        Arrays in which the vertices of facets are sorted, and no facet or cell is twice in a group.

    Raises:
        ValueError: no cell, numbers out of range, or coordinates that are not finite; a cell without volume or, of
            quadrilaterals and hexahedra, with a Jacobian that changes sign; a facet of more than two cells, or of two
            on the same side of it; several parts; a group that is empty, has a facet that the mesh has not, or shares
            one with another group.
    """
    cell = checks.choice("cell", arrays.cell, tuple(FACETS))
    x = checks.array("x", arrays.x, (None, DIMENSIONS[cell]))
    cells = _numbers("cells", arrays.cells, len(x), VERTICES[cell])
    width = FACETS[cell].shape[1]
    rows = {name: _numbers(f"facets[{name!r}]", group, len(x), width) for name, group in arrays.facets.items()}
    groups = {
        name: np.unique(_numbers(f"cell_groups[{name!r}]", group, len(cells)))
        for name, group in arrays.cell_groups.items()
    }
    _check_jacobians(cell, cells, x)
    sides = cells[:, FACETS[cell]].reshape(-1, width)
    numbers = number_rows(np.sort(np.concatenate([sides, *rows.values()]), axis=1))
    pairs = _check_sides(cells, x, sides, numbers[: len(sides)])
    _check_connected(cells, x, pairs // len(FACETS[cell]))
    facets = _named_facets(rows, numbers[: len(sides)], numbers[len(sides) :])
    _check_disjoint("facets", facets)
    _check_disjoint("cell_groups", groups)

    used, renumbered = np.unique(cells, return_inverse=True)
    number = np.zeros(len(x), dtype=np.int64)
    number[used] = np.arange(len(used))
    vertices = np.sort(sides, axis=1)[np.unique(numbers[: len(sides)], return_index=True)[1]]
    kept = {name: number[vertices[chosen]] for name, chosen in facets.items()}
    return MeshArrays(cell, renumbered.reshape(cells.shape), x[used], kept, groups)


def number_rows(rows: Numbers) -> Numbers:
    """Numbers from 0 of the rows of a matrix; rows that are equal have the same, and none is left out."""
    order = np.lexsort(rows.T[::-1])
    new = np.zeros(len(rows), dtype=np.int64)
    new[1:] = (np.diff(rows[order], axis=0) != 0).any(axis=1)
    numbers = np.empty(len(rows), dtype=np.int64)
    numbers[order] = np.cumsum(new)
    return numbers


def _numbers(name: str, value: Any, count: int, width: int | None = None) -> Numbers:
    """Integers from 0 to ``count`` - 1, at least one, of shape (any, width) or, without a width, (any,)."""
    wanted = f"integers of shape {'(any,)' if width is None else f'(any, {width})'} are required"
    try:
        found = np.asarray(value)
    except ValueError as error:
        raise ValueError(f"{name} = {value!r}: {wanted}") from error
    if found.size == 0:
        raise ValueError(f"{name} is empty: {wanted}, at least one")
    if found.dtype.kind not in "iu" or found.shape[1:] != (() if width is None else (width,)):
        raise ValueError(f"{name} has type {found.dtype} and shape {found.shape}: {wanted}")
    for bad in (found.min(), found.max()):
        if not 0 <= bad < count:
            raise ValueError(f"{name} has {bad}: numbers from 0 to {count - 1} are required")
    return found.astype(np.int64)


def _place(cells: Numbers, x: FloatArray, i: int) -> str:
    """Number and midpoint of a cell."""
    return f"cell {i} at ({', '.join(f'{value:.6g}' for value in x[cells[i]].mean(axis=0))})"


def _gradients(cell: str) -> FloatArray:
    """Derivatives of the vertex functions at sampling points, shape (points, vertices, dimension).

    One point is enough for a simplex; otherwise the corners, the centre and the midpoints of edges and faces.
    """
    dim = DIMENSIONS[cell]
    if VERTICES[cell] == dim + 1:
        return np.concatenate([-np.ones((1, dim)), np.eye(dim)])[None]
    high = np.arange(2**dim)[:, None] >> np.arange(dim) & 1
    points = np.array(list(product((0.0, 0.5, 1.0), repeat=dim)))
    factors = np.where(high, points[:, None], 1.0 - points[:, None])
    others = [np.delete(factors, j, axis=2).prod(axis=2) for j in range(dim)]
    return np.stack(others, axis=2) * np.where(high, 1.0, -1.0)


def _check_jacobians(cell: str, cells: Numbers, x: FloatArray) -> None:
    corners = x[cells]
    dim, diameter = x.shape[1], np.linalg.norm(np.ptp(corners, axis=1), axis=1)
    rounding = 8.0 * np.finfo(float).eps * np.abs(x).max()
    zero = diameter ** (dim - 1) * (FLAT * diameter + rounding)
    low, high = np.full(len(cells), np.inf), np.full(len(cells), -np.inf)
    for gradient in _gradients(cell):
        determinant = np.linalg.det(np.einsum("vj,cvi->cij", gradient, corners))
        low, high = np.minimum(low, determinant), np.maximum(high, determinant)
    flat = np.maximum(-low, high) <= zero
    if flat.any():
        raise ValueError(f"{_place(cells, x, int(flat.argmax()))} has no volume: a positive one is required")
    bad = (low <= zero) & (high >= -zero)
    if bad.any():
        raise ValueError(
            f"the Jacobian of {_place(cells, x, int(bad.argmax()))} vanishes or changes sign: "
            "a convex cell is required, with its vertices in dolfinx's ordering (that of a tensor product)"
        )


def _check_sides(cells: Numbers, x: FloatArray, sides: Numbers, numbers: Numbers) -> Numbers:
    """Positions in ``sides`` of the facets that two cells share, shape (2, facets), once these cells do not overlap."""
    per_cell = len(sides) // len(cells)
    counts = np.bincount(numbers)
    if counts.max() > 2:
        first = int((counts[numbers] > 2).argmax())
        place = _place(cells, x, first // per_cell)
        raise ValueError(f"a facet of {place} has {counts[numbers[first]]} cells: one or two are required")
    order = np.argsort(numbers, kind="stable")
    equal = np.flatnonzero(np.diff(numbers[order]) == 0)
    pairs = np.stack([order[equal], order[equal + 1]])
    corners = x[sides[pairs[0]]]
    away = x[cells[pairs // per_cell]].mean(axis=2) - corners.mean(axis=1)
    left, right = np.einsum("pfi,fi->pf", away, _normals(corners))
    folded = np.flatnonzero(np.sign(left) == np.sign(right))
    if len(folded):
        one, other = pairs[:, folded[pairs[0, folded].argmin()]] // per_cell
        raise ValueError(
            f"{_place(cells, x, one)} and {_place(cells, x, other)} overlap: "
            "cells that share a facet are required to lie on different sides of it"
        )
    return pairs


def _normals(corners: FloatArray) -> FloatArray:
    """Vectors normal to facets at their centres, of any size; corners have shape (facets, vertices, dimension)."""
    if corners.shape[1] == 2:
        return (corners[:, 1] - corners[:, 0])[:, ::-1] * (1.0, -1.0)
    if corners.shape[1] == 3:
        return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return np.cross(corners[:, 3] - corners[:, 0], corners[:, 2] - corners[:, 1])


def _check_connected(cells: Numbers, x: FloatArray, pairs: Numbers) -> None:
    graph = coo_matrix((np.ones(pairs.shape[1], dtype=np.int8), pairs), shape=(len(cells),) * 2)
    count, part = connected_components(graph, directed=False)
    if count > 1:
        sizes = np.bincount(part)
        place = _place(cells, x, int((part == sizes.argmin()).argmax()))
        raise ValueError(
            f"the mesh has {count} parts that share no facet, the smallest with {sizes.min()} of {len(cells)} cells, "
            f"such as {place}: one part is required"
        )


def _named_facets(rows: Mapping[str, Numbers], sides: Numbers, numbers: Numbers) -> dict[str, Numbers]:
    """Numbers of the facets of every group, each once, when cells have them; ``numbers`` are those of all the rows."""
    known = np.zeros(max(sides.max(), numbers.max(initial=0)) + 1, dtype=bool)
    known[sides] = True
    rank = np.cumsum(known) - 1
    facets, start = {}, 0
    for name, group in rows.items():
        chosen = numbers[start : start + len(group)]
        start += len(group)
        if not known[chosen].all():
            missing = int((~known[chosen]).argmax())
            raise ValueError(f"facets[{name!r}][{missing}] = {group[missing]}: a facet of the mesh is required")
        facets[name] = np.unique(rank[chosen])
    return facets


def _check_disjoint(kind: str, groups: Mapping[str, Numbers]) -> None:
    if not groups:
        return
    every = np.concatenate(list(groups.values()))
    group = np.repeat(np.arange(len(groups)), [len(chosen) for chosen in groups.values()])
    order = np.argsort(every, kind="stable")
    twice = np.flatnonzero(np.diff(every[order]) == 0)
    if len(twice):
        names = list(groups)
        one, other = group[order[twice[0] : twice[0] + 2]]
        both = f"{kind}[{names[one]!r}] and {kind}[{names[other]!r}]"
        raise ValueError(f"{both} overlap: groups that share nothing are required")


def extruded_arrays(arrays: MeshArrays, depth: float, layers: int) -> MeshArrays:
    """Tetrahedra or hexahedra between z = 0 and a depth, over a mesh of triangles or quadrilaterals.

    Every prism over a triangle is cut in three by the order of its vertices' numbers, so that neighbours match.

    Args:
        arrays: the plane mesh, whose groups become those over it.
        depth: along z; unit: length.
        layers: of cells or prisms.

    Returns:
        The mesh; its further groups of facets are "back" (z = 0) and "front".
    """
    simplices = checks.choice("cell of arrays", arrays.cell, ("triangle", "quadrilateral")) == "triangle"
    depth, layers = checks.positive("depth", depth), checks.whole("layers", layers, 1)
    count, base = len(arrays.x), np.sort(arrays.cells, axis=1) if simplices else np.asarray(arrays.cells)
    step = count * np.arange(layers)[:, None, None, None]
    if simplices:
        a, b, c = base.T
        cut = np.array([[a, b, c, c + count], [a, b, b + count, c + count], [a, a + count, b + count, c + count]])
    else:
        cut = np.concatenate([base, base + count], axis=1).T[None]
    cells = (cut.transpose(0, 2, 1) + step).reshape(-1, cut.shape[1])
    z = np.linspace(0.0, depth, layers + 1)
    x = np.column_stack([np.tile(arrays.x, (layers + 1, 1)), np.repeat(z, count)])
    facets = {}
    for name, rows in arrays.facets.items():
        a, b = np.sort(rows, axis=1).T
        halves = np.array(
            [[a, b, b + count], [a, a + count, b + count]] if simplices else [[a, b, a + count, b + count]]
        )
        facets[name] = (halves.transpose(0, 2, 1) + step).reshape(-1, halves.shape[1])
    facets |= {"back": base, "front": base + layers * count}
    first = len(base) * np.arange(len(cells) // len(base))[:, None]
    groups = {name: (first + group).ravel() for name, group in arrays.cell_groups.items()}
    return MeshArrays("tetrahedron" if simplices else "hexahedron", cells, x, facets, groups)
