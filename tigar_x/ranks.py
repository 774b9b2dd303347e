"""What ranks do alone, for all, or for themselves, and how they agree.

A rank that raises alone leaves the others waiting for it in the next collective call, so whatever one rank does for all
goes through :func:`on_root` or :func:`root_only`, and what each rank does for itself but may fail on some through
:func:`together`.

A shell may live whole on every rank. Rounding differs between processors, so copies of one computation drift apart, and
ranks that decide by their own copy may part ways: some iterate on, others do not, and all wait for ever in the next
collective call. Decisions, and the state that they lead to, are therefore those of rank 0: :func:`first`,
:func:`share`, :func:`agreed`.
"""

import functools
import pickle
import time
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

import numpy as np
from mpi4py import MPI

from tigar_x.compat import FloatArray

P = ParamSpec("P")
T = TypeVar("T")
PATIENCE = 2.0
"""Seconds that a rank that failed waits for the others."""


def first(comm: MPI.Comm, value: T) -> T:
    """What rank 0 has, on every rank (collective)."""
    return value if comm.size == 1 else comm.bcast(value)


def share(comm: MPI.Comm, *arrays: FloatArray) -> None:
    """Overwrite arrays, of the same shapes on every rank, by those of rank 0 (collective)."""
    if comm.size > 1:
        for array in arrays:
            comm.Bcast(array)


def agreed(comm: MPI.Comm, compute: Callable[[], T], *arrays: FloatArray) -> T:
    """What rank 0 finds by a computation that every rank makes, on every rank (collective).

    Unlike :func:`tigar_x.ranks.together` it waits for the slowest rank as long as that takes.

    Args:
        comm: the ranks.
        compute: what it decides on the way may differ between ranks; no collective on ``comm`` hangs on it. Its own are
            those of :func:`summed`, which fail on all ranks.
        arrays: what it changes, to become that of rank 0 as well.

    Returns:
        The result of rank 0.

    Raises:
        Exception: its own on the ranks where the computation failed, that of the lowest one of them on the others.
    """
    if comm.size == 1:
        return compute()
    result, error = tried(compute)
    found = comm.allgather((error and portable(error), result if comm.rank == 0 else None))
    failures = [failure for failure, _ in found if failure is not None]
    if failures:
        raise error or failures[0]
    share(comm, *arrays)
    return found[0][1]


def summed(comm: MPI.Comm, size: int, work: Callable[[], FloatArray]) -> FloatArray:
    """Sum over the ranks of what each finds for itself, the same on every rank; where one fails all do (collective).

    Args:
        comm: the ranks.
        size: number of values, the same on every rank.
        work: finds this rank's share, shape (size,); no collective on ``comm``.

    Returns:
        The sum, shape (size,).

    Raises:
        Exception: its own on the ranks that failed, that of the lowest one of them on the others.
    """
    share, error = tried(work)
    total = np.zeros(size + 1)
    if error is None:
        total[:size] = share
    else:
        total[size] = 1.0
    comm.Allreduce(MPI.IN_PLACE, total, op=MPI.SUM)
    if total[size]:
        failures = [told for told in comm.allgather(error and portable(error)) if told is not None]
        raise error or failures[0]
    return total[:size]


def total(comm: MPI.Comm, share: FloatArray) -> FloatArray:
    """Sum over the ranks of arrays of the same shape, on all of them (collective); of one rank the array itself."""
    if comm.size == 1:
        return share
    result = np.empty(share.shape)
    comm.Allreduce(np.ascontiguousarray(share), result, op=MPI.SUM)
    return result


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


def median(comm: MPI.Comm, values: FloatArray) -> float:
    """Median of the values of all ranks (collective), by counts: none of them leaves its rank.

    Args:
        comm: communicator.
        values: those of this rank, not negative; there is one on some rank.
    """
    bits = np.sort(np.ascontiguousarray(values, dtype=np.float64)).view(np.int64)  # in the order of the numbers
    count = comm.allreduce(len(bits))
    low, high = -1, int(comm.allreduce(bits[-1] if len(bits) else 0, op=MPI.MAX))
    rank = (count - 1) // 2
    while high - low > 1:  # more than `rank` values are <= high, no more than that <= low
        middle = (low + high) // 2
        more = comm.allreduce(int(np.searchsorted(bits, middle, "right"))) > rank
        low, high = (low, middle) if more else (middle, high)
    if count % 2 == 1 or comm.allreduce(int(np.searchsorted(bits, high, "right"))) > rank + 1:
        following = high
    else:
        larger = bits[np.searchsorted(bits, high, "right") :][:1]
        following = int(comm.allreduce(int(larger[0]) if len(larger) else np.iinfo(np.int64).max, op=MPI.MIN))
    return float(np.array([high, following]).view(np.float64).mean())


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
