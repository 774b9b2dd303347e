"""One source for what every rank computes for itself.

A shell may live whole on every rank. Rounding differs between processors, so copies of one computation drift apart, and
ranks that decide by their own copy may part ways: some iterate on, others do not, and all wait for ever in the next
collective call. Decisions, and the state that they lead to, are therefore those of rank 0.
"""

from collections.abc import Callable
from typing import TypeVar

from mpi4py import MPI

from tigar_x.compat import FloatArray
from tigar_x.writing import portable, tried

T = TypeVar("T")


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

    Unlike :func:`tigar_x.writing.together` it waits for the slowest rank as long as that takes.

    Args:
        comm: the ranks.
        compute: no collective on ``comm``; what it decides on the way may differ between ranks.
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
