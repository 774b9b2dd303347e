"""What has been computed last is not computed again while what it depends on stays the same."""

from collections.abc import Callable
from typing import Any

import numpy as np
from mpi4py import MPI

from tigar_x import ranks


class Known:
    """A number, such as the norm of a residual that stays assembled, and the arrays that it was computed from.

    Args:
        comm: of the ranks that compute it together.
    """

    def __init__(self, comm: MPI.Comm) -> None:
        self._comm, self._value = comm, np.nan
        self._arrays: tuple[Any, ...] | None = None

    def __call__(self, compute: Callable[[], float], *arrays: Any) -> float:
        """The number (collective): by all ranks anew, or what it was.

        Args:
            compute: computes it; that of rank 0 counts.
            arrays: all that change meanwhile of what it depends on.
        """
        known = self._arrays is not None and all(map(np.array_equal, arrays, self._arrays))
        if not ranks.first(self._comm, known):
            self._arrays = None
            self._value = ranks.agreed(self._comm, compute)
            self._arrays = tuple(array.copy() for array in arrays)
        return self._value
