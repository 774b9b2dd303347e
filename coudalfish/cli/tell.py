"""The one place that writes to standard output."""

import sys


def say(text: str, end: str = "\n") -> None:
    """Write a text at once, on rank 0.

    Args:
        text: what to say.
        end: what follows it.
    """
    if rank() == 0:
        sys.stdout.write(text + end)
        sys.stdout.flush()


def rank() -> int:
    """Rank of this process."""
    from mpi4py import MPI

    return int(MPI.COMM_WORLD.rank)
