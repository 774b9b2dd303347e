"""One source for what every rank computes for itself.

The shell lives whole on every rank. Rounding differs between processors, so copies of one computation drift apart, and
ranks that decide by their own copy may part ways: some iterate on, others do not, and all wait for ever. What a step
decides by, and the shell's state, are therefore those of rank 0.
"""

from collections.abc import Callable
from typing import Any, TypeVar

from mpi4py import MPI

from coudalfish.report import RejectedStepError
from tigar_x.compat import FloatArray
from tigar_x.linear import SolveError

T = TypeVar("T")
KNOWN = (SolveError, RejectedStepError)
"""Errors that can be sent to other ranks as they are."""


def first(comm: MPI.Comm, value: T) -> T:
    """What rank 0 has, on every rank (collective)."""
    return value if comm.size == 1 else comm.bcast(value)


def share(comm: MPI.Comm, *arrays: FloatArray) -> None:
    """Overwrite arrays, of the same shapes on every rank, by those of rank 0 (collective)."""
    if comm.size > 1:
        for array in arrays:
            comm.Bcast(array)


def agreed(comm: MPI.Comm, compute: Callable[[], T]) -> T:
    """What rank 0 finds by a computation that every rank makes, on every rank (collective).

    Unlike :func:`tigar_x.writing.together` it waits for the slowest rank as long as that takes.

    Args:
        comm: the ranks.
        compute: no collective on ``comm``.

    Returns:
        The result of rank 0.

    Raises:
        SolveError: the computation failed so on some rank; raised on all. Other errors are raised where they occur,
            and as a SolveError elsewhere.
        RejectedStepError: see SolveError.
    """
    if comm.size == 1:
        return compute()
    result: Any = None
    error: Exception | None = None
    try:
        result = compute()
    except Exception as raised:
        error = raised
    told = error if error is None or isinstance(error, KNOWN) else SolveError(f"rank {comm.rank}: {error!r}")
    found = comm.allgather((told, result if comm.rank == 0 else None))
    failures = [failure for failure, _ in found if failure is not None]
    if failures:
        raise error or failures[0]
    agreed_on: T = found[0][1]
    return agreed_on
