"""Elements of the files that meshio reads: gmsh's of version 2, whose elements have tags of their own, and XDMF."""

import logging
import os
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from varmint.mesh.checks import number_rows
from varmint.mesh.elements import Block, Elements

log = logging.getLogger(__name__)

TAGS = ("gmsh:physical", "cell_tags", "name_to_read")
"""Names under which XDMF files have the numbers of groups; any other is taken where there is just one."""

LINES = {"PolyLine": "Polyline", "PolyVertex": "Polyvertex"}
"""meshio's names for dolfinx's of kinds of cells."""


def msh2_elements(path: Path, labels: dict[tuple[int, int], str]) -> Elements:
    """Elements of a file of gmsh of version 2.

    Args:
        path: file name.
        labels: names of groups by dimension and number.

    Raises:
        ValueError: meshio cannot read it, or it has names of groups only.
    """
    import meshio

    elements = _converted(_read(meshio.gmsh.read, path), str(path), labels)
    dim = max((block.dimension for block in elements.blocks), default=0)
    names = [name for (d, _), name in labels.items() if d >= dim - 1]
    if names and not any(block.numbers.any() for block in elements.blocks):
        raise ValueError(
            f"{path} has the names {', '.join(map(repr, names))} and no element in a group: with Mesh.SaveAll = 1 gmsh "
            "leaves groups out of version 2; Mesh.SaveAll = 0 or Mesh.MshFileVersion = 4.1 is required"
        )
    return elements


def xdmf_elements(path: Path) -> Elements:
    """Elements of an XDMF file: of one grid, or of a mesh of dolfinx with the grids of its tags.

    Args:
        path: file name.

    Raises:
        ValueError: no XDMF, one that meshio cannot read, tags of other cells, or several sets of tags of one dimension.
    """
    try:
        root = ElementTree.parse(path).getroot()
    except (ElementTree.ParseError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} cannot be read as .xdmf: {_found(path)}, which is no XML ({error})") from error
    if root.tag != "Xdmf":
        raise ValueError(f"{path} cannot be read as .xdmf: its element is <{root.tag}>, <Xdmf> is required")
    grids = root.findall("Domain/Grid")
    uniform = [grid for grid in grids if grid.get("GridType", "Uniform") == "Uniform"]
    if not uniform:
        what = ", ".join(f"a grid of type {grid.get('GridType')!r}" for grid in grids) or "no grid"
        raise ValueError(f"{path} cannot be read as .xdmf: it has {what}, a uniform one, which is a mesh, is required")
    import meshio

    if len(grids) == 1 and not any(
        kind in LINES for item in grids[0].iter("Topology") for kind in item.attrib.values()
    ):
        return _converted(_read(meshio.xdmf.read, path), str(path), None)
    return _with_tags(path, uniform)


def _read(reader: Callable[[str], Any], path: Path, name: str | None = None) -> Any:
    try:
        return reader(name or str(path))
    except Exception as error:  # truncated files make meshio raise many things
        reason = str(error) or "its structure is another one than meshio knows"
        raise ValueError(f"{path} cannot be read as {path.suffix}: {type(error).__name__}: {reason}") from error


def _found(path: Path) -> str:
    """What a file of another kind begins with."""
    with path.open("rb") as file:
        start = file.read(20)
    return f"it begins with {start!r}" if start else "it is empty"


def _converted(found: Any, place: str, labels: dict[tuple[int, int], str] | None) -> Elements:
    """Elements of a mesh of meshio; labels that are None are those that it has."""
    if labels is None:
        labels = {(int(dim), int(number)): name for name, (number, dim) in found.field_data.items()}
    blocks = [
        Block(block.type, np.asarray(block.data, dtype=np.int64), number)
        for block, number in zip(found.cells, _numbers(found, place), strict=True)
        if block.type != "vertex"
    ]
    return Elements(place, np.asarray(found.points, dtype=np.float64), blocks, labels)


def _numbers(found: Any, place: str) -> list[NDArray[np.int64]]:
    """Numbers of the groups of the elements of every block, zero where there are none."""
    data = {
        name: [
            _column(part, len(block.data), f"{place} has cell data {name!r}")
            for part, block in zip(parts, found.cells, strict=True)
        ]
        for name, parts in found.cell_data.items()
        if name != "gmsh:geometrical"
    }
    whole = [name for name, parts in data.items() if all(p.dtype.kind in "iu" and p.shape[1] == 1 for p in parts)]
    known = [name for name in TAGS if name in data]
    for name in known:
        if not all(part.shape[1] == 1 and np.array_equal(part, np.rint(part)) for part in data[name]):
            raise ValueError(f"{place} has cell data {name!r} that are not whole: numbers of groups are required")
    known = known or whole
    if known and known[0] not in TAGS and len(known) > 1:
        names = ", ".join(map(repr, known))
        raise ValueError(f"{place} has several integer cell data, {names}: one, or one named {TAGS[0]!r}, is required")
    if others := sorted(set(data) - set(known)):
        log.warning(
            "%s: cell data %s are no groups: integers, or the name %r, are required for that",
            place, ", ".join(map(repr, others)), TAGS[0],
        )  # fmt: skip
    if not known:
        return [np.zeros(len(block.data), dtype=np.int64) for block in found.cells]
    return [part.astype(np.int64).reshape(-1) for part in data[known[0]]]


def _column(values: Any, count: int, what: str) -> NDArray[Any]:
    """Data of the elements of a block, shape (elements, components); zero where elements have none."""
    found = np.asarray(values)
    if len(found) == 0:
        return np.zeros((count, 1), dtype=np.int64)
    if len(found) != count:
        raise ValueError(f"{what} for {len(found)} of {count} elements of one kind: all or none are required")
    return found.reshape(count, -1)


def _with_tags(path: Path, grids: list[ElementTree.Element]) -> Elements:
    """The mesh of dolfinx that comes first, and the tags of cells and facets that refer to its geometry."""
    geometry = grids[0].find("Geometry")
    if geometry is None or any(grid.find("Geometry") is not None for grid in grids[1:]):
        raise ValueError(f"{path} has several meshes: one, and grids of tags that refer to its geometry, are required")
    first, *others = (_converted(_grid(path, grid, geometry), str(path), {}) for grid in grids)
    cells = [block for block in first.blocks if len(block.vertices)]
    dim = max((block.dimension for block in cells), default=0)
    tags: dict[int, list[tuple[str, Block]]] = {dim: [], dim - 1: []}
    for grid, elements in zip(grids[1:], others, strict=True):
        for block in elements.blocks:
            tags.setdefault(block.dimension, []).append((grid.get("Name", ""), block))
    for d, kind in ((dim, "cells"), (dim - 1, "facets")):
        if len(tags[d]) > 1:
            names = ", ".join(repr(name) for name, _ in tags[d])
            raise ValueError(f"{path} has several tags of {kind}, {names}: one of them is required")
    cells = [_tagged(path, block, *tags[dim][0]) if tags[dim] else block for block in cells]
    return Elements(str(path), first.points, [*cells, *(block for _, block in tags[dim - 1])])


def _grid(path: Path, grid: ElementTree.Element, geometry: ElementTree.Element) -> Any:
    """One grid, read by meshio from a file that has no other."""
    import meshio

    root = ElementTree.Element("Xdmf", Version="3.0")
    alone = ElementTree.SubElement(ElementTree.SubElement(root, "Domain"), "Grid", Name=grid.get("Name", ""))
    alone.extend(
        ElementTree.fromstring(ElementTree.tostring(part)) for part in (geometry, *grid) if "}" not in part.tag
    )
    for twice in alone.findall("Geometry")[1:]:
        alone.remove(twice)
    for topology in alone.iter("Topology"):
        topology.attrib |= {key: LINES.get(value, value) for key, value in topology.attrib.items()}
    with TemporaryDirectory() as folder:
        for k, item in enumerate(alone.iter("DataItem")):
            if item.get("Format") == "HDF":
                name, _, inside = (item.text or "").strip().rpartition(":")
                os.symlink((path.parent / name).resolve(), Path(folder) / f"{k}.h5")
                item.text = f"{k}.h5:{inside}"
        single = str(Path(folder) / "grid.xdmf")
        ElementTree.ElementTree(root).write(single)
        return _read(meshio.xdmf.read, path, single)


def _tagged(path: Path, cells: Block, name: str, tags: Block) -> Block:
    """Cells with the numbers that tags give to them, zero where they give none."""
    if tags.vertices.shape[1:] != cells.vertices.shape[1:]:
        raise ValueError(f"{path}: tags {name!r} are of {tags.kind!r}, {cells.kind!r} are required")
    rows = number_rows(np.sort(np.concatenate([cells.vertices, tags.vertices]), axis=1))
    here, there = rows[: len(cells.vertices)], rows[len(cells.vertices) :]
    if not np.isin(there, here).all():
        raise ValueError(f"{path}: tags {name!r} are of other cells than those of the mesh")
    number = np.zeros(rows.max() + 1, dtype=np.int64)
    number[there] = tags.numbers
    return Block(cells.kind, cells.vertices, number[here])
