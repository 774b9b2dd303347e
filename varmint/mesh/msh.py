"""Elements of gmsh's .msh files, and the head of these."""

from pathlib import Path
from typing import BinaryIO

from varmint.mesh.elements import Elements
from varmint.mesh.formats import msh2_elements
from varmint.mesh.session import file_elements, opened

FORMATS = ("2", "4")
"""Versions of the format, before the point."""


def msh_elements(path: Path) -> Elements:
    """Elements of a .msh file.

    Groups belong to entities in version 4, which gmsh reads, and to elements in version 2, which meshio reads: in files
    of other programs one entity may have elements of many groups.

    Args:
        path: file name.

    Raises:
        ValueError: no .msh file of these versions, or a damaged one; an entity in two groups; groups without elements.
        RuntimeError: gmsh is in use.
    """
    version, sections, labels = _head(path)
    if version == "2" and "$ParametricNodes" not in sections:
        return msh2_elements(path, labels)
    with opened(path) as gmsh:
        return file_elements(gmsh, str(path), labels)


def _head(path: Path) -> tuple[str, set[str], dict[tuple[int, int], str]]:
    """Version, names of the sections up to the nodes, and names of groups by dimension and number.

    gmsh takes a file that begins in another way for a script of its own, and runs it.
    """
    sections: set[str] = set()
    version, labels = "", {}
    with path.open("rb") as file:
        start = file.read(11)
        if not start.startswith((b"$MeshFormat", b"$Comments")):
            what = f"it begins with {start!r}" if start else "it is empty"
            raise ValueError(f"{path} cannot be read as .msh: {what}, '$MeshFormat' is required")
        file.seek(0)
        for line in file:
            text = line.decode("utf-8", errors="replace").strip()
            if text.startswith("$"):
                sections.add(text)
            if text in ("$Nodes", "$ParametricNodes", "$Elements"):
                break
            if text == "$MeshFormat":
                version = file.readline()[:20].decode("utf-8", errors="replace").strip().partition(" ")[0]
            elif text == "$PhysicalNames":
                labels = _labels(path, file)
    if version.partition(".")[0] not in FORMATS:
        raise ValueError(f"{path} cannot be read as .msh: version {version!r}, one of 2, 4 is required")
    return version.partition(".")[0], sections, labels


def _labels(path: Path, file: BinaryIO) -> dict[tuple[int, int], str]:
    """Names of groups by dimension and number, of the lines up to the end of the section."""
    labels: dict[tuple[int, int], str] = {}
    file.readline()
    for line in file:
        text = line.decode("utf-8", errors="replace").strip()
        if text.startswith("$"):
            break
        try:
            dim, number, name = text.split(None, 2)
            labels[int(dim), int(number)] = name.strip('"')
        except ValueError as error:
            raise ValueError(
                f"{path} has {text!r} among the names of groups: dimension, number and name are required"
            ) from error
    return labels
