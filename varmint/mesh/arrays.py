"""Meshes from arrays with named groups of facets and cells, distributed over the ranks."""

from collections.abc import Callable, Mapping, Sequence
from itertools import permutations
from typing import Any

import numpy as np
from mpi4py import MPI
from dolfinx import mesh
from numpy.typing import ArrayLike

from tigar_x import checks, compat
from tigar_x.compat import FloatArray, IntArray
from tigar_x.ranks import on_root
from varmint.mesh.checks import DIMENSIONS, VERTICES, MeshArrays, checked_arrays, number_rows
from varmint.mesh.named import NamedMesh, equal_parts, named, sides_of, tagged


def from_arrays(
    comm: MPI.Comm,
    cell: str,
    cells: ArrayLike | None,
    x: ArrayLike | None,
    *,
    facets: Mapping[str, ArrayLike] | None = None,
    cell_groups: Mapping[str, ArrayLike] | None = None,
) -> NamedMesh:
    """Mesh of affine or multilinear cells from arrays, once they are known to be a mesh.

    Args:
        comm: communicator; rank 0 gives the whole mesh, what the others give does not count.
        cell: "triangle", "quadrilateral", "tetrahedron" or "hexahedron".
        cells: vertices of the cells, shape (cells, vertices per cell), in dolfinx's ordering.
        x: coordinates, shape (vertices, dimension of the cell); vertices that no cell has are dropped; unit: length.
        facets: for every name the vertices of its facets in any order, shape (facets, vertices per facet); the facets
            may lie on the boundary or inside.
        cell_groups: for every name the numbers of its cells, shape (n,).

    Returns:
        The distributed mesh.

    Raises:
        ValueError: on all ranks: see :func:`varmint.mesh.checks.checked_arrays`.
    """
    return distributed(comm, lambda: MeshArrays(cell, cells, x, facets or {}, cell_groups or {}))


def mirrored_box(
    comm: MPI.Comm,
    lower: ArrayLike,
    upper: ArrayLike,
    elements: Sequence[int],
    *,
    axis: int = 1,
    original: str = "lower",
) -> NamedMesh:
    """Rectangle or box of simplices of equal size whose halves mirror each other, as do the numbers of vertices.

    Args:
        comm: communicator.
        lower: corner with the least coordinates, shape (d,), d = 2 or 3; unit: length.
        upper: opposite corner, same shape.
        elements: numbers of intervals along the axes, an even one along ``axis``.
        axis: normal to the plane between the halves.
        original: the half that is cut as :func:`varmint.mesh.named.box` cuts it, "lower" or "upper".

    Returns:
        The mesh; its sides have the names of :func:`varmint.mesh.named.box`.

    Raises:
        ValueError: another dimension, axis or half, a corner that is not above the lower one, numbers of intervals that
            are not positive, or an odd one along the axis.
    """
    lines = equal_parts(lower, upper, elements)
    d, counts = len(lines), tuple(len(line) - 1 for line in lines)
    if counts[checks.choice("axis", axis, tuple(range(d)))] % 2:
        raise ValueError(f"elements[{axis}] = {counts[axis]}: an even number is required")
    is_upper = checks.choice("original", original, ("lower", "upper")) == "upper"

    def make() -> MeshArrays:
        places = np.indices(counts).reshape(d, -1).T
        edges = [np.eye(d, dtype=int)[list(order)].cumsum(axis=0) for order in permutations(range(d))]
        paths = np.pad(edges, ((0, 0), (1, 0), (0, 0)))  # a simplex has the vertices of a way from corner to corner
        vertices = places[:, None, None] + paths
        image = (places[:, axis] < counts[axis] // 2) == is_upper
        vertices[image, ..., axis] = places[image, None, None, axis] + 1 - paths[..., axis]
        cells = np.ravel_multi_index(tuple(np.moveaxis(vertices, -1, 0)), [n + 1 for n in counts]).reshape(-1, d + 1)
        x = np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1).reshape(-1, d)
        return MeshArrays("triangle" if d == 2 else "tetrahedron", cells, x)

    return named(distributed(comm, make).domain, **sides_of(lines))


def checked(domain: mesh.Mesh) -> mesh.Mesh:
    """Check a mesh as :func:`from_arrays` does; rank 0 gathers it.

    Args:
        domain: mesh of linear cells of dimension 2 or 3.

    Returns:
        The same mesh.

    Raises:
        ValueError: on all ranks: cells of higher degree or of another dimension than space, or what
            :func:`varmint.mesh.checks.checked_arrays` raises; cells have the numbers that they were made with.
    """
    comm, cell = domain.comm, checks.choice("cell of domain", compat.cell_name(domain), tuple(DIMENSIONS))
    dim = domain.geometry.dim
    if dim != DIMENSIONS[cell]:
        raise ValueError(f"domain has cells {cell!r} in {dim} dimensions: {DIMENSIONS[cell]} are required")
    nodes = compat.cell_nodes(domain)
    if comm.allreduce(nodes.shape[1] != VERTICES[cell], op=MPI.LOR):
        raise ValueError("domain has curved cells: cells of degree 1 are required")
    numbers, owned_nodes = compat.global_nodes(domain)
    cells = numbers[nodes[: compat.owned_cells(domain)]]
    original = compat.input_numbers(domain)[0][: len(cells)]
    original = original if len(original) == len(cells) else np.arange(len(cells))
    pieces = comm.gather((original, cells, numbers[:owned_nodes], domain.geometry.x[:owned_nodes, :dim]))

    def gathered() -> None:
        order, every, points, x = (np.concatenate(piece) for piece in zip(*(pieces or []), strict=True))
        checked_arrays(MeshArrays(cell, every[np.argsort(order)], x[np.argsort(points)]))

    on_root(comm, gathered)
    return domain


Owners = Callable[[FloatArray, int], IntArray]
"""From the middles of simplices, shape (cells, d), and the number of ranks to the rank of each, shape (cells,)."""


def _owner(comm: MPI.Comm, owners: Owners, middles: FloatArray) -> IntArray:
    """Ranks of the cells on rank 0, and none on the others (collective)."""
    found = on_root(comm, lambda: owners(middles, comm.size))
    return np.empty(0, dtype=np.int64) if found is None else found


def distributed(comm: MPI.Comm, make: Callable[[], MeshArrays], owners: Owners | None = None) -> NamedMesh:
    """Mesh from arrays that rank 0 makes, once they are known to be one.

    Args:
        comm: communicator.
        make: function that makes the arrays; only rank 0 calls it.
        owners: which rank gets which simplex; only rank 0 calls it. None: as few facets between ranks as possible.

    Returns:
        The distributed mesh.

    Raises:
        ValueError: on all ranks: see :func:`varmint.mesh.checks.checked_arrays`. What else ``make`` raises, all ranks
            raise as well.
    """
    checks.kind("comm", comm, MPI.Comm, "a communicator, such as MPI.COMM_WORLD,")
    arrays = on_root(comm, lambda: checked_arrays(make()))
    cell, facets, groups = comm.bcast(arrays and (arrays.cell, arrays.facets, arrays.cell_groups))
    dim = DIMENSIONS[cell]
    cells = np.zeros((0, VERTICES[cell]), dtype=np.int64) if arrays is None else arrays.cells
    x = np.zeros((0, dim)) if arrays is None else arrays.x
    owner = None if owners is None or comm.size == 1 else _owner(comm, owners, x[cells].mean(axis=1))
    domain = compat.create_mesh(comm, cell, cells, x, owner)
    cell_numbers, node_numbers = compat.input_numbers(domain)
    found = {name: np.flatnonzero(np.isin(cell_numbers, group)) for name, group in groups.items()}
    sides = _matched(np.sort(node_numbers[compat.facet_nodes(domain)], axis=1), facets) if facets else {}
    exterior = compat.exterior_facets(domain)
    inner = [comm.allreduce(not np.isin(side, exterior).all(), op=MPI.LOR) for side in sides.values()]
    inner_names = tuple(name for name, has in zip(sides, inner, strict=True) if has)
    facet_tags, cell_tags = tagged(domain, "facet", sides), tagged(domain, "cell", found)
    return NamedMesh(domain, facet_tags, cell_tags, tuple(sides), tuple(found), inner_names)


def _matched(local: Any, groups: Mapping[str, Any]) -> dict[str, IntArray]:
    """Positions in ``local``, a matrix of sorted vertices, of the rows of every group."""
    numbers = number_rows(np.concatenate([local, *groups.values()]))
    here, start, found = numbers[: len(local)], len(local), {}
    for name, rows in groups.items():
        found[name] = np.flatnonzero(np.isin(here, numbers[start : start + len(rows)])).astype(np.int32)
        start += len(rows)
    return found
