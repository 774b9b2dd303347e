"""Checkpoints: fields and numbers of a run in one file, written at once or not at all, read on any number of ranks.

A file is an uncompressed NumPy archive without pickled objects: the coordinates of nodes, the values of fields there,
and a record in JSON with the format, fingerprints of the meshes and what the run adds, under one SHA-256 digest.
"""

import hashlib
import io
import json
import logging
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI
from dolfinx import fem

from tigar_x import checks
from tigar_x.ranks import on_root
from tigar_x.run.nodal import Layout, difference, fingerprint
from tigar_x.run.summary import plain
from tigar_x.run.writing import replace_bytes

log = logging.getLogger(__name__)

FORMAT = 1
"""Version of the file's layout."""
NAME = "checkpoint_{:08d}.npz"
"""File name by number."""


class DamagedError(ValueError):
    """A checkpoint that is truncated or was changed."""


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """A checkpoint that has been found whole.

    Attributes:
        path: its file.
        number: under which it was written.
        record: what the run added, as JSON gives it back.
        fields: by name, where in the file its nodes are.
        arrays: what is in the file, on rank 0; nothing on the others.
    """

    path: Path
    number: int
    record: dict[str, Any]
    fields: dict[str, int]
    arrays: dict[str, Any]


class Checkpoints:
    """The checkpoints of a run (collective on ``MPI.COMM_WORLD``, as are all methods).

    Args:
        folder: where they are; made with the first one.
        fields: by name, the functions that are stored; each on all ranks, or whole on every one (``MPI.COMM_SELF``).
        keep: number of checkpoints to keep.

    Raises:
        ValueError: a field has two nodes in the same place, or ``keep`` is less than 1.
    """

    def __init__(self, folder: Path | str, fields: Mapping[str, fem.Function], *, keep: int = 2) -> None:
        self.folder = Path(folder)
        self.fields = dict(fields)
        self.keep = checks.whole("keep", keep, 1)
        spaces: list[tuple[fem.FunctionSpace, int]] = []
        self._layouts: list[Layout] = []
        self._layout: dict[str, int] = {}
        for name, function in self.fields.items():
            space = function.function_space
            known = next((k for other, k in spaces if other is space), None)
            if known is None:
                known = len(self._layouts)
                spaces.append((space, known))
                self._layouts.append(Layout(function, name))
            self._layout[name] = known
        self._meshes = [fingerprint(layout.space.mesh) for layout in self._layouts]

    # -- writing ------------------------------------------------------------------------------------------------------

    def write(self, number: int, record: Mapping[str, Any]) -> Path:
        """Write the present fields; older checkpoints are deleted only when this one is in place.

        Those with a larger number belong to what a run from an earlier checkpoint replaces, and are deleted as well.

        Args:
            number: of the checkpoint, such as that of the step.
            record: whatever JSON can hold.

        Returns:
            The file.

        Raises:
            OSError: it cannot be written; those that were there stay as they were.
            ValueError: the record is not finite or no JSON.
        """
        path = self.folder / NAME.format(checks.whole("number", number, 0))
        values = {name: self._layouts[k].gather(self.fields[name]) for name, k in self._layout.items()}
        on_root(MPI.COMM_WORLD, lambda: self._write(path, number, plain(dict(record)), values))
        return path

    def _write(self, path: Path, number: int, record: dict[str, Any], values: dict[str, list[Any]]) -> None:
        head = {
            "format": FORMAT,
            "number": number,
            "meshes": self._meshes,
            "fields": self._layout,
            "record": record,
        }
        try:
            arrays = {"head": np.array(json.dumps(head, allow_nan=False))}
        except TypeError as error:
            raise ValueError(f"record: JSON is required ({error})") from error
        for k, layout in enumerate(self._layouts):
            arrays |= {f"nodes/{k}/{i}": np.asarray(nodes.x) for i, (nodes, _) in enumerate(layout.parts)}
        for name, parts in values.items():
            arrays |= {f"values/{name}/{i}": part for i, part in enumerate(parts)}
        buffer = io.BytesIO()
        np.savez(buffer, digest=np.array(_digest(arrays)), **arrays)
        replace_bytes(path, buffer.getvalue())
        numbers = self.numbers()
        for other in {*numbers[: numbers.index(number)], *numbers[numbers.index(number) + self.keep :]}:
            (self.folder / NAME.format(other)).unlink(missing_ok=True)
        for part in self.folder.glob(NAME.replace("{:08d}", "*") + ".part"):
            part.unlink(missing_ok=True)

    def numbers(self) -> list[int]:
        """Numbers of the checkpoints in the folder, the largest first (not collective)."""
        found = (path.stem.rpartition("_")[2] for path in self.folder.glob(NAME.replace("{:08d}", "*")))
        numbers = sorted({int(number) for number in found if number.isdecimal()}, reverse=True)
        return [number for number in numbers if (self.folder / NAME.format(number)).exists()]

    # -- reading ------------------------------------------------------------------------------------------------------

    def find(self, which: int | str | Path = "latest") -> Checkpoint:
        """Read a checkpoint and check that it is whole and belongs to these fields; they stay as they are.

        Args:
            which: "latest": the one with the largest number that is whole, with a warning for every other; a number; or
                a file.

        Returns:
            The checkpoint.

        Raises:
            FileNotFoundError: there is none.
            ValueError: it is damaged, of another format, or of other fields or meshes; the message says which.
        """
        found = on_root(MPI.COMM_WORLD, lambda: self._find(which))
        told: Checkpoint = MPI.COMM_WORLD.bcast(found and replace(found, arrays={}))
        return found or told

    def _find(self, which: int | str | Path) -> Checkpoint:
        if str(which) == "latest":
            for number in self.numbers():
                path = self.folder / NAME.format(number)
                try:
                    return self._load(path)
                except DamagedError as error:
                    log.warning("%s; going back to the one before", error)
            raise FileNotFoundError(f"{self.folder}: there is no checkpoint that is whole")
        name = str(which)
        return self._load(self.folder / NAME.format(int(name)) if name.isdecimal() else Path(name))

    def _load(self, path: Path) -> Checkpoint:
        arrays = _read(path)
        head = json.loads(str(arrays["head"]))
        if head["format"] != FORMAT:
            raise ValueError(f"{path}: format {head['format']!r} was found, {FORMAT} is required")
        if sorted(head["fields"]) != sorted(self._layout):
            raise ValueError(f"{path}: fields {sorted(head['fields'])} were found, {sorted(self._layout)} are required")
        for name, k in self._layout.items():
            other = head["fields"][name]
            if reason := difference(head["meshes"][other], self._meshes[k]):
                raise ValueError(f"{path}: {name} is on another mesh: {reason}")
            for i, (nodes, dofs) in enumerate(self._layouts[k].parts):
                values = arrays.get(f"values/{name}/{i}")
                shape = None if values is None else values.shape
                if shape != (nodes.count, dofs.shape[1]):
                    required = f"{(nodes.count, dofs.shape[1])} (nodes, components) are required"
                    raise ValueError(f"{path}: {name} is of another degree or size: {shape} were found, {required}")
        return Checkpoint(path, head["number"], head["record"], head["fields"], arrays)

    def restore(self, checkpoint: Checkpoint) -> None:
        """Give the fields the values of a checkpoint.

        Args:
            checkpoint: as it was found.

        Raises:
            ValueError: the nodes of a field lie elsewhere; the fields stay as they are.
        """
        world, arrays, failure = MPI.COMM_WORLD, checkpoint.arrays, None
        values: dict[str, list[Any]] = {name: [] for name in self.fields}
        for name, k in self._layout.items():
            for i, (nodes, _) in enumerate(self._layouts[k].parts):
                found = arrays and (arrays[f"nodes/{checkpoint.fields[name]}/{i}"], arrays[f"values/{name}/{i}"])
                if nodes.comm.size < world.size:
                    found = world.bcast(found)
                try:
                    values[name].append(found[1][nodes.match(found[0])] if found else None)
                except ValueError as error:
                    failure = f"{checkpoint.path}: {name} is on another mesh: {error}"
        if failures := [text for text in world.allgather(failure) if text]:
            raise ValueError(failures[0])
        for name, parts in values.items():
            self._layouts[self._layout[name]].scatter(self.fields[name], parts)


def _digest(arrays: Mapping[str, Any]) -> str:
    """SHA-256 over names, types, shapes and contents."""
    total = hashlib.sha256()
    for name in sorted(arrays):
        array = arrays[name]
        total.update(f"{name} {array.dtype.str} {array.shape}\n".encode())
        total.update(array.tobytes())
    return total.hexdigest()


def _read(path: Path) -> dict[str, Any]:
    """All arrays of a checkpoint that is whole."""
    if not path.is_file():
        raise FileNotFoundError(f"{path}: there is no such checkpoint")
    try:
        with np.load(io.BytesIO(path.read_bytes()), allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
        digest = str(arrays.pop("digest"))
    except Exception as error:  # there is no end to what a damaged archive may raise
        raise DamagedError(f"{path}: not a checkpoint, or a truncated one ({error})") from error
    if digest != _digest(arrays):
        raise DamagedError(f"{path}: the contents do not agree with their digest")
    return arrays
