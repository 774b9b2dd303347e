"""Meshes of simplices that are finer in places: bisected from a base mesh, with its groups.

Where an edge of a triangle is halved, the longest edge of the triangle is halved as well, in the faces of tetrahedra
too; cells are then cut at the longest of their edges that are halved, and their parts likewise. The cut of a face
depends on the face alone, so that cells fit together. Source: A. Plaza and G. F. Carey, "Local refinement of simplicial
grids based on the skeleton", doi:10.1016/S0168-9274(99)00022-7.

The cells are cut on rank 0, as meshes of gmsh are made there, so that the mesh does not depend on the ranks.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import combinations
from typing import Any, cast

import numpy as np

from tigar_x import compat, ranks
from tigar_x.compat import FloatArray
from varmint.mesh.arrays import Owners, distributed
from varmint.mesh.checks import MeshArrays, Numbers
from varmint.mesh.named import NamedMesh, require_named

ROUNDS = 40
"""How often edges may be halved one after the other."""
SLACK = 1e-9
"""Relative difference within which an edge is no longer than another or than what is wanted."""

Sizes = Callable[[FloatArray], FloatArray]


class Refinement:
    """Makes finer meshes from a base mesh, each anew, so that cells are as large as there where nothing asks for less.

    Args:
        base: mesh of triangles or tetrahedra.
        owners: of the cells of the finer meshes, see :func:`varmint.mesh.arrays.distributed`.

    Attributes:
        base: as given.

    Raises:
        ValueError: it has other cells.
    """

    def __init__(self, base: NamedMesh, owners: Owners | None = None) -> None:
        require_named(base)
        if not compat.is_simplex(base.domain):
            raise ValueError(f"base has cells {compat.cell_name(base.domain)!r}: triangles or tetrahedra are required")
        self.base, self._owners = base, owners  # the base's communicator lives as long as it does
        self._arrays = _gathered(base)

    def mesh(self, sizes: Sizes) -> NamedMesh:
        """The base mesh with edges halved until they are short enough (collective).

        Args:
            sizes: function of the corners of cells, shape (cells, d + 1, d), which gives the largest length that edges
                of each may have, shape (cells,), and infinity where any may be; only rank 0 calls it. Unit: length.

        Returns:
            The mesh, with the groups of the base; vertices of the base come first.

        Raises:
            ValueError: on all ranks: a size is not positive, or so small that it is not reached.
        """
        arrays = cast(MeshArrays, self._arrays)
        return distributed(self.base.domain.comm, lambda: bisected(arrays, sizes), self._owners)


def bisected(arrays: MeshArrays, sizes: Sizes) -> MeshArrays:
    """Arrays of a mesh of simplices with edges halved until they are short enough.

    Args:
        arrays: of a mesh of simplices.
        sizes: see :meth:`Refinement.mesh`.

    Returns:
        The arrays, with the same groups.

    Raises:
        ValueError: a size is not positive, or so small that it is not reached.
    """
    cells, x = np.asarray(arrays.cells, dtype=np.int64), np.asarray(arrays.x, dtype=np.float64)
    names, groups = list(arrays.facets), list(arrays.cell_groups)
    facets = [np.asarray(arrays.facets[name], dtype=np.int64) for name in names]
    group = np.zeros(len(cells), dtype=np.int64)
    for number, name in enumerate(groups, start=1):
        group[arrays.cell_groups[name]] = number
    wanted = _checked(sizes(x[cells]), len(cells))
    for _ in range(ROUNDS):
        edges = _Edges.of(cells, x)
        marked = edges.too_long(wanted)
        if not marked.any():
            break
        edges.close(marked)
        middle = np.where(marked, len(x) + np.cumsum(marked) - 1, -1)
        cells, parent = edges.cut(cells, middle)
        facets = [edges.cut(rows, middle)[0] for rows in facets]
        group, x = group[parent], np.concatenate([x, x[edges.ends[marked]].mean(axis=1)])
        wanted, is_new = wanted[parent], np.bincount(parent)[parent] > 1
        wanted[is_new] = _checked(sizes(x[cells[is_new]]), int(is_new.sum()))
    else:
        raise ValueError(f"sizes: cells have been halved {ROUNDS} times and are too large: larger sizes are required")
    chosen = {name: np.flatnonzero(group == number) for number, name in enumerate(groups, start=1)}
    return MeshArrays(arrays.cell, cells, x, dict(zip(names, facets, strict=True)), chosen)


@dataclass(frozen=True, eq=False)
class _Edges:
    """Edges of simplices.

    Attributes:
        ends: their vertices, sorted, shape (edges, 2).
        keys: one number for each pair of ends, sorted, shape (edges,).
        of_cells: edges of the cells, shape (cells, edges of each).
        length: shape (edges,).
        place: their places in an order by length, shape (edges,).
    """

    ends: Numbers
    keys: Numbers
    of_cells: Numbers
    length: FloatArray
    place: Numbers

    @classmethod
    def of(cls, cells: Numbers, x: FloatArray) -> "_Edges":
        """Edges of cells."""
        every = _keys(cells)
        keys, numbers = np.unique(every, return_inverse=True)
        ends = np.column_stack(np.divmod(keys, SHIFT))
        length = np.linalg.norm(np.diff(x[ends], axis=1)[:, 0], axis=1)
        place = np.empty(len(keys), dtype=np.int64)
        # of edges that are equal but for rounding the one with the lowest ends comes first
        place[np.argsort(np.round(length / length.max() / SLACK), kind="stable")] = np.arange(len(keys))
        return cls(ends, keys, numbers.reshape(every.shape), length, place)

    def too_long(self, wanted: FloatArray) -> Any:
        """Mask of the edges that are longer than a cell wants."""
        allowed = np.full(len(self.length), np.inf)
        np.minimum.at(allowed, self.of_cells, wanted[:, None])
        return self.length > (1.0 + SLACK) * allowed

    def close(self, marked: Any) -> None:
        """Mark the longest edge of every triangle that has one that is marked."""
        pairs = list(combinations(range(3 if self.of_cells.shape[1] == 3 else 4), 2))
        triangles = combinations(range(max(map(max, pairs)) + 1), 3)
        of_triangles = [[pairs.index(pair) for pair in combinations(triangle, 2)] for triangle in triangles]
        sides = self.of_cells[:, of_triangles].reshape(-1, 3)
        longest = np.take_along_axis(sides, self.place[sides].argmax(axis=1)[:, None], axis=1)[:, 0]
        while True:
            more = longest[marked[sides].any(axis=1)]
            if marked[more].all():
                return
            marked[more] = True

    def cut(self, simplices: Numbers, middle: Numbers) -> tuple[Numbers, Numbers]:
        """Cut simplices until none has an edge that is halved.

        Args:
            simplices: cells or facets, shape (simplices, vertices).
            middle: number of the vertex in the middle of an edge, -1: it is not halved.

        Returns:
            The simplices, and of which one each is a part.
        """
        pairs = np.array(list(combinations(range(simplices.shape[1]), 2)))
        done, parents, parent = [], [], np.arange(len(simplices))
        while len(simplices):
            keys = _keys(simplices)
            number = np.minimum(np.searchsorted(self.keys, keys), len(self.keys) - 1)
            is_halved = (self.keys[number] == keys) & (middle[number] >= 0)
            first = np.where(is_halved, self.place[number], -1).argmax(axis=1)
            rows, whole = np.arange(len(simplices)), ~is_halved.any(axis=1)
            done.append(simplices[whole])
            parents.append(parent[whole])
            new, halves = middle[number[rows, first]], []
            for end in (0, 1):
                half = simplices.copy()
                half[rows, pairs[first, end]] = new
                halves.append(half[~whole])
            simplices, parent = np.concatenate(halves), np.tile(parent[~whole], 2)
        order = np.argsort(np.concatenate(parents), kind="stable")
        return np.concatenate(done)[order], np.concatenate(parents)[order]


SHIFT = np.int64(2**31)
"""By which the first vertex of an edge is multiplied for its key."""


def _keys(simplices: Numbers) -> Numbers:
    """One number for each edge of simplices, shape (simplices, edges of each)."""
    pairs = np.sort(simplices[:, list(combinations(range(simplices.shape[1]), 2))], axis=2)
    return np.asarray(pairs[..., 0] * SHIFT + pairs[..., 1])


def _checked(sizes: FloatArray, cells: int) -> FloatArray:
    found = np.asarray(sizes, dtype=np.float64)
    if found.shape != (cells,) or not (found > 0.0).all():
        raise ValueError(
            f"sizes gave shape {found.shape}, from {found.min(initial=np.inf):g}: {cells} > 0 are required"
        )
    return found


def _gathered(mesh: NamedMesh) -> MeshArrays | None:
    """A mesh as arrays on rank 0, None elsewhere; cells and vertices have the numbers that it was made with."""
    domain, comm = mesh.domain, mesh.domain.comm
    cell_numbers, node_numbers = compat.input_numbers(domain)
    nodes, dim = compat.cell_nodes(domain), domain.geometry.dim
    owned, marks = compat.owned_cells(domain), np.zeros(len(nodes), dtype=np.int64)
    for number, name in enumerate(mesh.cell_names, start=1):
        marks[mesh.cells(name)] = number
    cells = np.column_stack([cell_numbers[:owned], marks[:owned], node_numbers[nodes[:owned]]])
    points = np.column_stack([node_numbers, domain.geometry.x[:, :dim]])
    sides = [np.sort(node_numbers[compat.facet_nodes(domain)[mesh.facets(name)]], axis=1) for name in mesh.facet_names]
    every = [ranks.gathered(comm, part) for part in (cells, points, *sides)]
    if comm.rank:
        return None
    cells, points, *sides = every
    cells = cells[np.argsort(cells[:, 0], kind="stable")]
    numbers, first = np.unique(points[:, 0], return_index=True)
    of_number = numbers.astype(np.int64)
    facets = {
        name: np.searchsorted(of_number, np.unique(rows, axis=0))
        for name, rows in zip(mesh.facet_names, sides, strict=True)
    }
    groups = {name: np.flatnonzero(cells[:, 1] == k) for k, name in enumerate(mesh.cell_names, start=1)}
    corners = np.searchsorted(of_number, cells[:, 2:])
    return MeshArrays(compat.cell_name(domain), corners, points[first, 1:], facets, groups)
