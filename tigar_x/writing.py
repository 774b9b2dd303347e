"""How files are written: by rank 0 alone, at once or not at all, with errors that all ranks raise.

A rank that raises alone leaves the others waiting for it in the next collective call, so whatever one rank does for all
goes through :func:`on_root` or :func:`root_only`, and what each rank does for itself but may fail on some through
:func:`together`.
"""

import functools
import os
import pickle
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import numpy as np
from mpi4py import MPI

P = ParamSpec("P")
T = TypeVar("T")

RESULTS = (
    *("summary.json", "history.csv", "*.pvd", "*.vtu", "*.xdmf", "*.h5", "*.vtkhdf", "*.steps/*.h5"),
    *("checkpoints/checkpoint_*.npz", "frames/*.png"),
)
"""What runs leave in their folders, but for pictures that any run draws again."""
PATIENCE = 2.0
"""Seconds that a rank that failed waits for the others."""


def on_root(comm: MPI.Comm, work: Callable[[], T]) -> T | None:
    """What a function returns on rank 0, None on the others; when it raises, all ranks raise the same (collective).

    Args:
        comm: communicator.
        work: function that only rank 0 calls; it must not communicate.
    """
    result, failure = None, None
    if comm.rank == 0:
        result, failure = tried(work)
    told = comm.bcast(failure and portable(failure))
    if told is not None:
        raise failure or told
    return result


def root_only(work: Callable[P, T]) -> Callable[P, T | None]:
    """Decorator: all ranks call the function (collective), rank 0 of all does the work, see :func:`on_root`."""

    @functools.wraps(work)
    def called(*args: P.args, **kwargs: P.kwargs) -> T | None:
        return on_root(MPI.COMM_WORLD, lambda: work(*args, **kwargs))

    return called


def together(comm: MPI.Comm, work: Callable[[], T]) -> T:
    """What a function returns on each rank; when it raises on some, all ranks raise (collective).

    Args:
        comm: communicator.
        work: function that every rank calls.

    Raises:
        Exception: its own on the ranks that failed, that of the lowest one of them on the others. Where these wait for
            it inside ``work``, the rank that failed raises alone.
    """
    result, failure = tried(work)
    if failure is None:
        comm.Ibarrier().Wait()
    elif not all_come(comm):
        raise failure
    failures = [told for told in comm.allgather(failure and portable(failure)) if told is not None]
    if failures:
        raise failure or failures[0]
    return result  # type: ignore[return-value]  # it has not failed


def all_come(comm: MPI.Comm, seconds: float = PATIENCE) -> bool:
    """Whether all ranks call this, or :func:`together`, within a time; where not, the run should end."""
    request, last = comm.Ibarrier(), time.monotonic() + seconds
    while not request.Test():
        if time.monotonic() > last:
            return False
        time.sleep(0.001)
    return True


def gathered(comm: MPI.Comm, rows: Any) -> Any:
    """Rows of all ranks, one rank's after the other's, on rank 0; None elsewhere (collective).

    Args:
        comm: communicator.
        rows: array of this rank, of the same shape but for its length on all.
    """
    if comm.size == 1:
        return rows
    parts = comm.gather(np.ascontiguousarray(rows))
    return None if parts is None else np.concatenate(parts)


def tried(work: Callable[[], T]) -> tuple[T | None, Exception | None]:
    """What a function returns, and what it raises."""
    try:
        return work(), None
    except Exception as error:
        return None, error


def portable(failure: Exception) -> Exception:
    """The exception, or one with its name and words where it cannot be sent to other ranks."""
    try:
        pickle.loads(pickle.dumps(failure))
    except Exception:
        return RuntimeError(f"{type(failure).__name__}: {failure}")
    return failure


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
