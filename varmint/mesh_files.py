"""Meshes from files of gmsh and from XDMF."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from tigar_x import checks
from varmint.mesh import NamedMesh
from varmint.mesh_arrays import distributed
from varmint.mesh_elements import Block, Elements
from varmint.mesh_gmsh import geo_elements

TAGS = ("gmsh:physical", "cell_tags", "name_to_read")
"""Names under which XDMF files have the numbers of groups; any other is taken where there is just one."""
NEAR = 1e-9
"""Relative to the size of the mesh, how far the same point may be off in the file of the facets."""


def read(
    comm: MPI.Comm,
    path: Path | str,
    *,
    facets_path: Path | str | None = None,
    names: Mapping[str, int] | None = None,
) -> NamedMesh:
    """Mesh from a file, with its physical groups; rank 0 reads it.

    Args:
        comm: communicator.
        path: ``.msh`` or ``.xdmf``, which meshio reads, or ``.geo``, which gmsh meshes before. Cells of the highest
            dimension count: linear triangles, quadrilaterals, tetrahedra or hexahedra, of one kind. Where a ``.msh``
            of version 4 has groups, all its elements need one (gmsh's option ``Mesh.SaveAll`` is off).
        facets_path: file of the facets and their groups, ``.msh`` or ``.xdmf``, when they have one of their own; its
            points are found by their coordinates.
        names: numbers of groups by the names that they are given. A group that is not there has its name in the file,
            or else its number.

    Returns:
        The distributed mesh.

    Raises:
        FileNotFoundError: on all ranks: there is no such file.
        ValueError: on all ranks: another suffix, or a file that cannot be read; cells that are mixed or not linear; a
            plane mesh not at one z; a number that no group has; facets elsewhere than in the mesh; or what
            :func:`varmint.mesh_checks.checked_arrays` raises.
    """
    return distributed(comm, lambda: _elements(Path(path), facets_path).arrays(names))


def _elements(path: Path, facets_path: Path | str | None) -> Elements:
    elements = _file(path, (".msh", ".xdmf", ".geo"))
    return elements if facets_path is None else _joined(elements, _file(Path(facets_path), (".msh", ".xdmf")))


def _file(path: Path, suffixes: tuple[str, ...]) -> Elements:
    suffix = checks.choice(f"suffix of {str(path)!r}", path.suffix.lower(), suffixes)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: there is no such file")
    if suffix == ".geo":
        return geo_elements(path)
    import meshio

    reader = meshio.gmsh.read if suffix == ".msh" else meshio.xdmf.read
    try:
        found = reader(str(path))
    except Exception as error:  # truncated files make meshio raise many things
        raise ValueError(f"{path} cannot be read as {suffix}: {type(error).__name__}: {error}") from error
    _check_one_group_each(found, path)
    numbers = _numbers(found, path)
    blocks = [
        Block(block.type, np.asarray(block.data, dtype=np.int64), number)
        for block, number in zip(found.cells, numbers, strict=True)
        if block.type != "vertex"
    ]
    labels = {(int(dim), int(number)): name for name, (number, dim) in found.field_data.items()}
    return Elements(str(path), np.asarray(found.points, dtype=np.float64), blocks, labels)


def _numbers(found: Any, path: Path) -> list[NDArray[np.int64]]:
    """Numbers of the groups of the elements of every block, zero where there are none."""
    whole = [
        name
        for name, data in found.cell_data.items()
        if name != "gmsh:geometrical" and all(np.asarray(part).dtype.kind in "iu" for part in data)
    ]
    known = [name for name in TAGS if name in whole] or whole
    if not known:
        return [np.zeros(len(block.data), dtype=np.int64) for block in found.cells]
    if known[0] not in TAGS and len(known) > 1:
        names = ", ".join(map(repr, known))
        raise ValueError(f"{path} has several integer cell data, {names}: one, or one named {TAGS[0]!r}, is required")
    return [np.asarray(part, dtype=np.int64).reshape(-1) for part in found.cell_data[known[0]]]


def _check_one_group_each(found: Any, path: Path) -> None:
    """Refuse elements in several named groups, of which meshio keeps the first."""
    sets = {name: parts for name, parts in (found.cell_sets or {}).items() if name in found.field_data}
    for i in range(len(found.cells)):
        names = [name for name, parts in sets.items() if parts[i] is not None and len(parts[i])]
        if len(names) > 1:
            raise ValueError(f"{path} has elements in groups {' and '.join(map(repr, names))}: one at most is required")


def _joined(cells: Elements, facets: Elements) -> Elements:
    """The elements of the first and the facets of the second, over the points of the first."""
    dim = max((block.dimension for block in cells.blocks), default=0)
    sides = [block for block in facets.blocks if block.dimension == dim - 1]
    if not any(len(block.vertices) for block in sides):
        raise ValueError(f"{facets.place} has no elements of dimension {dim - 1}: facets of the mesh are required")
    width = min(cells.points.shape[1], facets.points.shape[1])
    x, y = cells.points[:, :width], facets.points[:, :width]
    distance, point = cKDTree(x).query(y)
    used = np.unique(np.concatenate([block.vertices.ravel() for block in sides]))
    far = used[~(distance[used] <= NEAR * np.ptp(x, axis=0).max())]
    if len(far):
        raise ValueError(
            f"{facets.place} has a facet with a vertex at {y[far[0]]}: a vertex of {cells.place} is required"
        )
    moved = [Block(block.kind, point[block.vertices], block.numbers) for block in sides]
    kept = [block for block in cells.blocks if block.dimension == dim]
    labels = {key: name for key, name in cells.labels.items() if key[0] == dim}
    labels |= {key: name for key, name in facets.labels.items() if key[0] == dim - 1}
    return Elements(cells.place, cells.points, [*kept, *moved], labels)
