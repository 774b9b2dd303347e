"""Sessions of gmsh, and the elements of its models and files."""

import inspect
import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import NamedTemporaryFile, TemporaryDirectory
from typing import Any

import numpy as np

from varmint.mesh.elements import Block, Elements

KINDS = {1: "line", 2: "triangle", 3: "quad", 4: "tetra", 5: "hexahedron", 15: "vertex"}
"""meshio's names of gmsh's linear elements."""
LEFT = 1000
"""Of how many further errors at most gmsh's parser is relieved after one."""
SHAPES = {2: "surface", 3: "volume"}
"""gmsh's words for what has cells of a dimension."""


@contextmanager
def session() -> Iterator[Any]:
    """The module gmsh, initialized and quiet; the handler of interrupts stays what it is.

    Raises:
        RuntimeError: gmsh is in use.
    """
    handler = signal.getsignal(signal.SIGINT)
    import gmsh

    if getattr(gmsh, "isInitialized", int)():
        raise RuntimeError("gmsh is in use: gmsh.finalize() is required before")
    known = inspect.signature(gmsh.initialize).parameters
    gmsh.initialize([], readConfigFiles=False, **({"interruptible": False} if "interruptible" in known else {}))
    try:
        _restore(handler)
        gmsh.option.setNumber("General.Terminal", 0)
        yield gmsh
    finally:
        gmsh.finalize()
        _restore(handler)


def _restore(handler: Any) -> None:
    if handler is not None and signal.getsignal(signal.SIGINT) != handler:
        signal.signal(signal.SIGINT, handler)


@contextmanager
def opened(path: Path, script: bytes | None = None) -> Iterator[Any]:
    """The module gmsh with a model from a file, which stands alone in a folder while gmsh reads it.

    gmsh runs what it finds in a file beside, of the same name with ``.opt`` added.

    Args:
        path: file name.
        script: what to read in its place; None: the file.

    Raises:
        ValueError: gmsh cannot read it, or what is done with the model fails.
        RuntimeError: gmsh is in use.
    """
    with TemporaryDirectory() as folder:
        alone = Path(folder) / f"mesh{path.suffix.lower()}"
        if script is None:
            os.symlink(path.resolve(), alone)
        else:
            alone.write_bytes(script)
        try:
            with session() as gmsh:
                gmsh.open(str(alone))
                yield gmsh
        except (ValueError, RuntimeError):
            raise
        except Exception as error:  # gmsh raises nothing more special
            _flush_parser()
            told = str(error).replace(str(alone), str(path)) or type(error).__name__
            raise ValueError(f"{path}: gmsh makes no mesh of it: {told}") from error


def _flush_parser() -> None:
    """Take from gmsh's parser the rest of a line with an error, or it goes on there with the next file."""
    with NamedTemporaryFile("w", suffix=".geo") as blank:
        blank.write(3 * "// nothing\n")
        blank.flush()
        for _ in range(LEFT):
            try:
                with session() as gmsh:
                    gmsh.open(blank.name)
                return
            except Exception:
                continue


def model_elements(gmsh: Any, dim: int, place: str) -> Elements:
    """Elements of the current model, which is meshed unless it has been.

    Args:
        gmsh: the module.
        dim: of the cells; where some of them are in groups, the others are left out.
        place: for messages.

    Raises:
        ValueError: nothing has this dimension, or an entity is in two groups.
    """
    if not gmsh.model.getEntities(dim):
        raise ValueError(f"{place} has nothing of dimension {dim}: a geometry that is synchronized is required")
    if not len(gmsh.model.mesh.getElements(dim)[0]):
        gmsh.model.mesh.generate(dim)
    blocks = _blocks(gmsh, dim, place)
    if any(block.dimension == dim and block.numbers.any() for block in blocks):
        blocks = [block for block in blocks if block.dimension < dim or block.numbers.any()]
    labels = {(d, tag): gmsh.model.getPhysicalName(d, tag) for d, tag in gmsh.model.getPhysicalGroups()}
    return Elements(place, _points(gmsh), blocks, {key: name for key, name in labels.items() if name})


def file_elements(gmsh: Any, place: str, labels: dict[tuple[int, int], str]) -> Elements:
    """All elements of a mesh that gmsh has read.

    Args:
        gmsh: the module.
        place: the file, for messages.
        labels: names of groups by dimension and number.

    Raises:
        ValueError: there are none of the highest dimension, or an entity is in two groups.
    """
    dim = max((dim for dim, _ in gmsh.model.getEntities()), default=0)
    if dim in SHAPES and not len(gmsh.model.mesh.getElements(dim)[0]):
        raise ValueError(
            f"{place} has no cell in any {SHAPES[dim]}: gmsh writes those in physical groups alone where there are "
            f"groups; a physical group of the {SHAPES[dim]}s is required, or Mesh.SaveAll = 1"
        )
    return Elements(place, _points(gmsh), _blocks(gmsh, dim, place), labels)


def _points(gmsh: Any) -> Any:
    return np.reshape(gmsh.model.mesh.getNodes()[1], (-1, 3))


def _blocks(gmsh: Any, dim: int, place: str) -> list[Block]:
    """Elements of the cells' dimension and of the facets', by entity."""
    tags, _, _ = gmsh.model.mesh.getNodes()
    point = np.full(int(tags.max(initial=0)) + 1, -1, dtype=np.int64)
    point[tags] = np.arange(len(tags))
    blocks = []
    for d, entity in gmsh.model.getEntities(dim) + gmsh.model.getEntities(dim - 1):
        number = _group(gmsh, d, entity, place)
        for kind, vertices in _elements(gmsh, d, entity):
            blocks.append(Block(kind, point[vertices], np.full(len(vertices), number)))
    return blocks


def _group(gmsh: Any, dim: int, entity: int, place: str) -> int:
    groups = [int(group) for group in gmsh.model.getPhysicalGroupsForEntity(dim, entity)]
    if len(groups) > 1:
        names = " and ".join(gmsh.model.getPhysicalName(dim, abs(group)) or str(group) for group in groups)
        raise ValueError(
            f"{place} has entity {entity} of dimension {dim} in groups {names}: one at most is required; "
            "a condition or a measure takes several groups, so let groups share nothing"
        )
    return groups[0] if groups else 0


def _elements(gmsh: Any, dim: int, entity: int) -> Iterator[tuple[str, Any]]:
    """Kind and vertices of the elements of an entity."""
    kinds, _, nodes = gmsh.model.mesh.getElements(dim, entity)
    for kind, flat in zip(kinds, nodes, strict=True):
        name, _, _, count, *_ = gmsh.model.mesh.getElementProperties(kind)
        yield KINDS.get(int(kind), name.lower()), np.asarray(flat, dtype=np.int64).reshape(-1, count)
