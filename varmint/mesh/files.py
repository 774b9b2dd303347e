"""Meshes from files of gmsh and from XDMF."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from mpi4py import MPI
from scipy.spatial import cKDTree

from tigar_x import checks
from varmint.mesh.arrays import distributed
from varmint.mesh.elements import Block, Elements
from varmint.mesh.formats import xdmf_elements
from varmint.mesh.msh import msh_elements
from varmint.mesh.named import NamedMesh
from varmint.mesh.scripts import plain_script
from varmint.mesh.session import model_elements, opened

NEAR = 1e-9
"""Relative to the size of the mesh, how far the same point may be off in the file of the facets."""


def read_mesh(
    comm: MPI.Comm,
    path: Path | str,
    *,
    facets_path: Path | str | None = None,
    names: Mapping[str, int] | None = None,
    trust_script: bool = False,
) -> NamedMesh:
    """Mesh from a file, with its physical groups; rank 0 reads it.

    Args:
        comm: communicator.
        path: ``.msh`` of version 2 or 4, ``.xdmf`` of one grid or of a mesh of dolfinx with its tags, or ``.geo``,
            which gmsh meshes before. Cells of the highest dimension count: linear triangles, quadrilaterals,
            tetrahedra or hexahedra, of one kind. The number 0 is no group.
        facets_path: file of the facets and their groups, ``.msh`` or ``.xdmf``, when they have one of their own; its
            points are found by their coordinates.
        names: numbers of groups by the names that they are given. A group that is not there has its name in the file,
            or else its number.
        trust_script: whether a ``.geo`` file may do whatever gmsh's language can, which includes to start programs and
            to read and write files; otherwise see :func:`varmint.mesh.scripts.plain_script`.

    Returns:
        The distributed mesh.

    Raises:
        FileNotFoundError: on all ranks: there is no such file.
        ValueError: on all ranks: another suffix, or a file that cannot be read; a script that is refused; an element
            in two groups; cells that are mixed or not linear; a plane mesh not at one z; a number that no group has;
            facets elsewhere than in the mesh; or what :func:`varmint.mesh.checks.checked_arrays` raises.
        RuntimeError: on all ranks: gmsh is in use.
    """
    return distributed(comm, lambda: _elements(Path(path), facets_path, trust_script).arrays(names))


def _elements(path: Path, facets_path: Path | str | None, trust_script: bool) -> Elements:
    elements = _file(path, (".msh", ".xdmf", ".geo"), trust_script)
    return elements if facets_path is None else _joined(elements, _file(Path(facets_path), (".msh", ".xdmf"), False))


def _file(path: Path, suffixes: tuple[str, ...], trust_script: bool) -> Elements:
    suffix = checks.choice(f"suffix of {str(path)!r}", path.suffix.lower(), suffixes)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: there is no such file")
    if suffix == ".geo":
        return _geo_elements(path, trust_script)
    return msh_elements(path) if suffix == ".msh" else xdmf_elements(path)


def _geo_elements(path: Path, trust_script: bool) -> Elements:
    """Elements of the mesh that gmsh makes of a script."""
    with opened(path, None if trust_script else plain_script(path)) as gmsh:
        dim = max((dim for dim, _ in gmsh.model.getEntities()), default=0)
        return model_elements(gmsh, dim, str(path))


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
