"""Velocities at an inlet."""

from collections.abc import Callable
from typing import Any

import ufl

from tigar_x import checks


def parabola(height: float, mean: float, ramp: float = 0.0, dim: int = 2) -> Callable[[Any, Any], Any]:
    """Parabolic velocity along the first axis between walls at x_2 = 0 and a height, coming up smoothly from rest.

    Args:
        height: distance of the walls; unit: length.
        mean: its mean; unit: velocity.
        ramp: time within which it comes up, by half a cosine; 0: at once. Unit: time.
        dim: number of components, 2 or 3.

    Returns:
        Function of position and time, for a condition.

    Raises:
        ValueError: a number is out of range.
    """
    checks.positive("height", height)
    checks.not_negative("ramp", ramp)
    checks.choice("dim", dim, (2, 3))

    def velocity(x: Any, t: Any) -> Any:
        profile = 6.0 * mean * x[1] * (height - x[1]) / height**2
        rise = ufl.conditional(ufl.lt(t, ramp), (1 - ufl.cos(ufl.pi * t / ramp)) / 2, 1.0) if ramp else 1.0
        return ufl.as_vector([profile * rise, *[0.0] * (dim - 1)])

    return velocity
