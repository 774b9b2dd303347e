"""How much of the speed fluid and shell differ by, as far as the fluid's mesh resolves it."""

from collections import deque
from dataclasses import dataclass

import numpy as np

from tigar_x.compat import FloatArray

WINDOW = 20
"""Steps over which slip and speed are averaged: one step alone may be a start or a turning point."""
SHARE_OF_LOAD = 0.3
"""Share of the speed that its load would give the fluid of a cell in a step, below which a sheet counts as at rest."""


@dataclass(frozen=True)
class RelativeSlip:
    """Slip relative to the speed, root mean squares over the surface and the last steps.

    Attributes:
        normal: along the shell's normal.
        tangential: along the shell.
    """

    normal: float
    tangential: float


def root_mean_square(W: FloatArray, x: FloatArray) -> float:
    """Over the active surface, of vectors.

    Args:
        W: areas, zero at inactive points, shape (points,).
        x: values, shape (points, components).
    """
    area = float(W.sum())
    return float(np.sqrt((W * (x**2).sum(axis=1)).sum() / area)) if area else 0.0


class SlipWindow:
    """Slip of the last steps."""

    def __init__(self) -> None:
        self._squares: deque[tuple[float, float, float]] = deque(maxlen=WINDOW)

    def add(self, slip: FloatArray, n: FloatArray, W: FloatArray, speed: float) -> RelativeSlip | None:
        """Take in a step.

        Args:
            slip: smoothed u - y' at the points, shape (points, d); unit: length/time.
            n: normals of any length, shape (points, d).
            W: areas, zero at inactive points, shape (points,).
            speed: what the slip is compared with.

        Returns:
            Slip of this step alone; None: nothing moves.
        """
        length = np.linalg.norm(n, axis=1, keepdims=True)
        unit = np.divide(n, length, out=np.zeros_like(n), where=length > 0.0)
        normal = (slip * unit).sum(axis=1, keepdims=True) * unit
        parts = root_mean_square(W, normal), root_mean_square(W, slip - normal)
        self._squares.append((parts[0] ** 2, parts[1] ** 2, speed**2))
        return RelativeSlip(parts[0] / speed, parts[1] / speed) if speed > 0.0 else None

    @property
    def slip(self) -> RelativeSlip | None:
        """Slip over the last steps; None: they have been too few, or nothing moves."""
        if len(self._squares) < WINDOW:
            return None
        normal, tangential, speed = np.sqrt(np.array(self._squares).sum(axis=0))
        return RelativeSlip(float(normal / speed), float(tangential / speed)) if speed > 0.0 else None
