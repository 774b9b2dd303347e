"""Checkpoints: fields and numbers of a run in one file, written at once or not at all, read on any number of ranks.

A file is an uncompressed NumPy archive without pickled objects: the coordinates of nodes, the values of fields there,
and a record in JSON with the format, fingerprints of the meshes and what the run adds, under one SHA-256 digest. On
several ranks each writes what it has of the distributed fields, into a folder beside the file; this is written last and
has the digests of these parts. No field is whole anywhere but where every rank has it.
"""

import json
import logging
import secrets
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI
from dolfinx import fem

from tigar_x import checks
from tigar_x.ranks import on_root, together
from tigar_x.run.archives import DamagedError, read_archive, write_archive
from tigar_x.run.nodal import Layout, difference, fingerprint
from tigar_x.run.summary import plain

log = logging.getLogger(__name__)

FORMAT = 2
"""Version of the file's layout; the first one had no parts."""
PARTS = "checkpoint_{:08d}.parts"
"""Name by number of the folder of the parts of the ranks."""
NAME = "checkpoint_{:08d}.npz"
"""File name by number."""


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """A checkpoint that has been found whole.

    Attributes:
        path: its file.
        number: under which it was written.
        record: what the run added, as JSON gives it back.
        fields: by name, where in the file its nodes are.
        parts: files with what single ranks have written.
    """

    path: Path
    number: int
    record: dict[str, Any]
    fields: dict[str, int]
    parts: tuple[Path, ...]


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
        head = {"format": FORMAT, "number": number, "meshes": self._meshes, "fields": self._layout, "record": record}
        head |= {"shapes": self._shapes(), "parts": {}}
        on_root(MPI.COMM_WORLD, lambda: _json(head))
        written = self._write_part(number) if MPI.COMM_WORLD.size > 1 else None
        try:
            on_root(MPI.COMM_WORLD, lambda: self._write(path, number, head, written))
        except Exception:
            if written is not None:
                _withdraw(self.folder / PARTS.format(number) / written[MPI.COMM_WORLD.rank][0])
            raise
        return path

    def _shapes(self) -> dict[str, list[list[int]]]:
        """Numbers of nodes and components of all parts of fields."""
        return {
            name: [[nodes.count, dofs.shape[1]] for nodes, dofs in self._layouts[k].parts]
            for name, k in self._layout.items()
        }

    def _arrays(self, *, shared: bool) -> dict[str, Any]:
        """Nodes of this rank and values there, of fields that are distributed or of those that every rank has whole."""
        arrays: dict[str, Any] = {}
        for k, layout in enumerate(self._layouts):
            if (layout.parts[0][0].comm.size > 1) is shared:
                arrays |= {f"nodes/{k}/{i}": np.asarray(nodes.x) for i, (nodes, _) in enumerate(layout.parts)}
                for name in (name for name, of in self._layout.items() if of == k):
                    values = self.fields[name].x.array
                    arrays |= {f"values/{name}/{i}": values[dofs] for i, (_, dofs) in enumerate(layout.parts)}
        return arrays

    def _write_part(self, number: int) -> list[tuple[str, str]]:
        """Write this rank's part of the distributed fields (collective).

        Returns:
            Names of the files of all ranks, which no earlier one has, and their digests.
        """
        world = MPI.COMM_WORLD
        name = f"{world.bcast(secrets.token_hex(4))}.{world.rank}.npz"
        path = self.folder / PARTS.format(number) / name
        try:
            digest = together(world, lambda: write_archive(path, self._arrays(shared=True)))
        except Exception:
            _withdraw(path)
            raise
        return list(world.allgather((name, digest)))

    def _write(self, path: Path, number: int, head: dict[str, Any], parts: list[tuple[str, str]] | None) -> None:
        arrays = {"head": _json(head | {"parts": dict(parts or ())})}
        write_archive(path, arrays | self._arrays(shared=False))
        numbers = self.numbers()
        for other in {*numbers[: numbers.index(number)], *numbers[numbers.index(number) + self.keep :]}:
            (self.folder / NAME.format(other)).unlink(missing_ok=True)
        for part in self.folder.glob(NAME.replace("{:08d}", "*") + ".part"):
            part.unlink(missing_ok=True)
        for folder in self.folder.glob(PARTS.replace("{:08d}", "*")):
            used = dict(parts or ()) if folder.name == PARTS.format(number) else None
            whole = folder.with_suffix(".npz").exists()
            for file in folder.iterdir():
                if not whole or (used is not None and file.name not in used):
                    file.unlink(missing_ok=True)
            if not any(folder.iterdir()):
                folder.rmdir()

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
        name = str(which)
        if name != "latest":
            return self._load(self.folder / NAME.format(int(name)) if name.isdecimal() else Path(name))
        for number in MPI.COMM_WORLD.bcast(on_root(MPI.COMM_WORLD, self.numbers)):
            try:
                return self._load(self.folder / NAME.format(number))
            except DamagedError as error:
                if MPI.COMM_WORLD.rank == 0:
                    log.warning("%s; going back to the one before", error)
        raise FileNotFoundError(f"{self.folder}: there is no checkpoint that is whole")

    def _load(self, path: Path) -> Checkpoint:
        """A checkpoint whose file rank 0 has looked at, and each rank at some of its parts."""
        world = MPI.COMM_WORLD
        head = world.bcast(on_root(world, lambda: self._head(path)))
        folder, parts = path.with_suffix(".parts"), list(head.get("parts", {}).items())
        together(world, lambda: _require(folder, parts[world.rank :: world.size]))
        files = tuple(folder / name for name, _ in parts)
        return Checkpoint(path, head["number"], head["record"], head["fields"], files)

    def _head(self, path: Path) -> Any:
        arrays = read_archive(path)
        head = json.loads(str(arrays["head"]))
        if not 1 <= head["format"] <= FORMAT:
            raise ValueError(f"{path}: format {head['format']!r} was found, {FORMAT} or less is required")
        if sorted(head["fields"]) != sorted(self._layout):
            raise ValueError(f"{path}: fields {sorted(head['fields'])} were found, {sorted(self._layout)} are required")
        for name, k in self._layout.items():
            if reason := difference(head["meshes"][head["fields"][name]], self._meshes[k]):
                raise ValueError(f"{path}: {name} is on another mesh: {reason}")
            values = [
                arrays.get(f"values/{name}/{i}") for i in range(len(self._layouts[k].parts))
            ]  # of the first format
            found = head.get("shapes", {name: [None if part is None else list(part.shape) for part in values]})[name]
            if found != self._shapes()[name]:
                texts = [
                    ", ".join(str(part and tuple(part)) for part in parts) for parts in (found, self._shapes()[name])
                ]
                required = f"{texts[1]} (nodes, components) are required"
                raise ValueError(f"{path}: {name} is of another degree or size: {texts[0]} were found, {required}")
        return head

    def restore(self, checkpoint: Checkpoint) -> None:
        """Give the fields the values of a checkpoint (collective); each rank reads those at its nodes.

        Args:
            checkpoint: as it was found.

        Raises:
            ValueError: the nodes of a field lie elsewhere; the fields stay as they are.
        """
        values = together(MPI.COMM_WORLD, lambda: self._read(checkpoint))
        for name, parts in values.items():
            for (_, dofs), part in zip(self._layouts[self._layout[name]].parts, parts, strict=True):
                self.fields[name].x.array[dofs] = part
            self.fields[name].x.scatter_forward()

    def _read(self, checkpoint: Checkpoint) -> dict[str, list[Any]]:
        """Values of the fields at the nodes that this rank owns."""
        values = {
            name: [np.full(dofs.shape, np.nan) for _, dofs in self._layouts[k].parts]
            for name, k in self._layout.items()
        }
        missing = {name: [np.ones(len(part), dtype=bool) for part in parts] for name, parts in values.items()}
        for path in (checkpoint.path, *checkpoint.parts):
            with np.load(path, allow_pickle=False) as archive:
                for name, k in self._layout.items():
                    for i, (nodes, _) in enumerate(self._layouts[k].parts):
                        places = f"nodes/{checkpoint.fields[name]}/{i}"
                        if places in archive.files:
                            here, there = nodes.find(archive[places])
                            values[name][i][here] = archive[f"values/{name}/{i}"][there]
                            missing[name][i][here] = False
        for name, parts in missing.items():
            if left := sum(int(part.sum()) for part in parts):
                raise ValueError(f"{checkpoint.path}: {name} is on another mesh: {left} nodes were not found")
        return values


def _json(head: Mapping[str, Any]) -> Any:
    """A head as an array."""
    try:
        return np.array(json.dumps(plain(dict(head)), allow_nan=False))
    except TypeError as error:
        raise ValueError(f"record: JSON is required ({error})") from error


def _withdraw(path: Path) -> None:
    """Delete the parts of a checkpoint that has failed on all ranks (collective)."""
    path.unlink(missing_ok=True)
    MPI.COMM_WORLD.barrier()
    if MPI.COMM_WORLD.rank == 0:
        with suppress(OSError):  # it has parts of an earlier checkpoint of this number
            path.parent.rmdir()


def _require(folder: Path, parts: list[tuple[str, str]]) -> None:
    """Raise what a damaged checkpoint raises where one of some parts is missing or has another digest."""
    for name, digest in parts:
        try:
            read_archive(folder / name, digest)
        except FileNotFoundError as error:
            raise DamagedError(f"{folder / name}: a part of a checkpoint is missing") from error
