"""How files are written: by rank 0 alone, at once or not at all, with errors that all ranks raise.

A rank that raises alone leaves the others waiting for it in the next collective call, so whatever one rank does for all
goes through ``on_root`` or ``root_only``, and what each rank does for itself but may fail on some through ``together``,
all of :mod:`tigar_x.ranks`.
"""

import os
from contextlib import suppress
from pathlib import Path
from typing import TypeVar

from mpi4py import MPI

from tigar_x.ranks import on_root

T = TypeVar("T")

RESULTS = (
    *("summary.json", "history.csv", "*.pvd", "*.vtu", "*.xdmf", "*.h5", "*.vtkhdf", "*.steps/*.h5"),
    *("checkpoints/checkpoint_*.npz", "checkpoints/checkpoint_*.parts/*.npz", "frames/*.png"),
)
"""What runs leave in their folders, but for pictures that any run draws again."""


def claim(out: Path, *, overwrite: bool = False, restart: str = "") -> None:
    """Refuse a folder with the results of an earlier run, before a run replaces them one by one (collective).

    Args:
        out: folder of the results.
        overwrite: whether to delete the results of the earlier run.
        restart: checkpoint from which the run goes on; empty: it is new.

    Raises:
        FileExistsError: on all ranks: there are results, and the run neither goes on nor may overwrite them.
        ValueError: both are asked for.
    """
    if overwrite and restart:
        raise ValueError(f"restart = {restart!r} goes on with what overwrite = True deletes: one of them is allowed")
    on_root(MPI.COMM_WORLD, lambda: None if restart else _cleared(out, overwrite))


def _cleared(out: Path, overwrite: bool) -> None:
    found = [path for pattern in RESULTS for path in sorted(out.glob(pattern))]
    if found and not overwrite:
        names = ", ".join(str(path.relative_to(out)) for path in found[:3]) + (", ..." if len(found) > 3 else "")
        advice = "another folder, or overwrite = True (--overwrite), which deletes them"
        if any(path.suffix == ".npz" for path in found):
            advice += ', or restart = "latest" (--restart latest), which goes on from the last checkpoint'
        raise FileExistsError(f"out = {out} has the results of an earlier run ({names}): {advice}, is required")
    for path in found:
        path.unlink(missing_ok=True)


def replace_text(path: Path, text: str) -> None:
    """Write a text file so that a reader finds the old or the new content, never a part.

    Args:
        path: file name.
        text: content.
    """
    replace_bytes(path, text.encode())


def replace_bytes(path: Path, content: bytes) -> None:
    """Write a binary file so that a reader finds the old or the new content, never a part, whatever dies meanwhile.

    Args:
        path: file name; its folder is made.
        content: content.

    Raises:
        OSError: it cannot be written; an old file stays as it was.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(path.name + ".part")
    try:
        with open(part, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(part, path)
    except BaseException:
        part.unlink(missing_ok=True)
        raise
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        with suppress(OSError):  # not every file system can
            os.fsync(folder)  # or the new name may be lost with the machine
    finally:
        os.close(folder)
