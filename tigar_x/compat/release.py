"""Which dolfinx this is, and the arrays that all releases are brought to."""

from typing import Any

import dolfinx
import numpy as np
from numpy.typing import NDArray

from tigar_x.moved import guide

__getattr__ = guide(__name__)

VERSION = tuple(int(part) for part in dolfinx.__version__.split(".")[:2])
"""Major and minor number of the dolfinx in use."""
if VERSION not in ((0, 5), (0, 9), (0, 11)):
    raise ImportError(f"dolfinx {dolfinx.__version__} was found: this library runs on dolfinx 0.5, 0.9 and 0.11")

IntArray = NDArray[np.int32]
FloatArray = NDArray[np.float64]


def as_table(connectivity: Any) -> IntArray:
    """Connectivity with as many entries in every row as a matrix; an adjacency list in 0.5, an array afterwards."""
    return connectivity.array.reshape(connectivity.num_nodes, -1) if VERSION < (0, 9) else connectivity
