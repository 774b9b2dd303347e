"""Potentials of contact: how strongly two points repel each other, by their distance."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from tigar_x import checks
from tigar_x.compat import FloatArray


class Kernel(Protocol):
    """Potential phi(r) of a pair of points per product of their weights; arrays in, arrays out."""

    @property
    def r_max(self) -> float:
        """Distance from which on the potential vanishes; unit: length."""

    def energy(self, r: FloatArray) -> FloatArray:
        """Potential phi, zero at r_max, of distances r >= 0."""

    def slope(self, r: FloatArray) -> FloatArray:
        """First derivative phi' at distances r >= 0; negative where the points repel each other."""

    def curvature(self, r: FloatArray) -> FloatArray:
        """Second derivative phi'' at distances r >= 0."""


@dataclass(frozen=True)
class LinearKernel:
    """Repulsion that grows linearly from r_max inwards: ``phi' = -k (r_max - r)``.

    Attributes:
        r_max: range > 0; unit: length.
        stiffness: k > 0; unit: force/length^5, in the plane force/length^4 (per unit depth).

    Raises:
        ValueError: a parameter is out of range.
    """

    r_max: float
    stiffness: float

    def __post_init__(self) -> None:
        checks.positive("r_max", self.r_max)
        checks.positive("stiffness", self.stiffness)

    def energy(self, r: FloatArray) -> FloatArray:
        """Potential ``k (r_max - r)^2/2`` at distances r."""
        return self.stiffness * np.maximum(self.r_max - r, 0.0) ** 2 / 2.0

    def slope(self, r: FloatArray) -> FloatArray:
        """First derivative phi' at distances r."""
        return -self.stiffness * np.maximum(self.r_max - r, 0.0)

    def curvature(self, r: FloatArray) -> FloatArray:
        """Second derivative phi'' at distances r; jumps from k to zero at r_max."""
        return np.where(r < self.r_max, self.stiffness, 0.0)


@dataclass(frozen=True)
class SmoothedKernel:
    """The linear repulsion with a quadratic onset over a length ``L = s r_max``, so that phi'' is continuous.

    ``phi' = -k (r_max - r)^2/(2 L)`` for ``r_max - r < L``, else ``-k (r_max - r - L/2)``.

    Attributes:
        r_max: range > 0; unit: length.
        stiffness: k > 0; unit: force/length^5, in the plane force/length^4 (per unit depth).
        smoothing: s in (0, 1].

    Raises:
        ValueError: a parameter is out of range.
    """

    r_max: float
    stiffness: float
    smoothing: float

    def __post_init__(self) -> None:
        checks.positive("r_max", self.r_max)
        checks.positive("stiffness", self.stiffness)
        if not 0.0 < checks.finite("smoothing", self.smoothing) <= 1.0:
            raise ValueError(f"smoothing = {self.smoothing!r}: a number in (0, 1] is required")

    def _onset(self, r: FloatArray) -> tuple[float, FloatArray, FloatArray]:
        """Length L of the onset, overlap r_max - r, and the part of the overlap within L."""
        length, overlap = self.smoothing * self.r_max, np.maximum(self.r_max - r, 0.0)
        return length, overlap, np.minimum(overlap, length)

    def energy(self, r: FloatArray) -> FloatArray:
        """Potential ``k (a^3 - (a - c)^3)/(6 L)`` at distances r, with the overlap a and its part c within L."""
        length, a, c = self._onset(r)
        return self.stiffness * c * (3.0 * a * (a - c) + c**2) / (6.0 * length)

    def slope(self, r: FloatArray) -> FloatArray:
        """First derivative phi' at distances r."""
        length, a, c = self._onset(r)
        return -self.stiffness * c * (2.0 * a - c) / (2.0 * length)

    def curvature(self, r: FloatArray) -> FloatArray:
        """Second derivative phi'' at distances r."""
        length, _, c = self._onset(r)
        return self.stiffness * c / length
