"""How the membranes of the manufactured problem lie, move and are passed along, as functions in UFL or of numbers."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import ufl


@dataclass(frozen=True)
class Shape:
    """How the membrane lies, moves and is passed along; functions of the positions across the first axis and the data.

    Attributes:
        rest: x_1 of the membrane at rest.
        profile: displacement along x_1 over V t, zero at the boundary.
        along: components (w_2, w_3) of what the fluid does along it on its right side; no divergence.
        curved: whether rest and profile vary in both directions across, in a cube.
    """

    rest: Callable[[Sequence[Any], Any], Any]
    profile: Callable[[Sequence[Any], Any], Any]
    along: Callable[[Sequence[Any], Any], Sequence[Any]]
    curved: bool


def _hump(s: Any, c: Any) -> Any:
    return c.L * s - s**2


EXTRUDED = Shape(lambda s, c: c.L / 2, lambda s, c: _hump(s[0], c), lambda s, c: (1.0, 0.0), False)
"""The published membrane, straight at rest."""
CURVED = Shape(
    lambda s, c: c.L / 2 - c.rise * ((s[0] - 0.5 * c.L) ** 2 + 0.6 * (s[1] - 0.45 * c.L) ** 2) / c.L,
    lambda s, c: 4 * _hump(s[0], c) * _hump(s[1], c) * (1 + (s[0] - s[1] / 2) / (2 * c.L)) / c.L**2,
    lambda s, c: (1 - s[1] / (2 * c.L), 0.3 + 0.6 * s[0] / c.L),
    True,
)
"""A dome without symmetry; neither its motion nor, with a curved surface at rest, its load is a spline."""


def course(x: Any, t: Any, c: Any, shape: Shape) -> SimpleNamespace:
    """Where the membrane is, at the positions across the first axis of points.

    Args:
        x: positions, of 2 or 3 components.
        t: time.
        c: the problem's data, as numbers or Constants.
        shape: of the membrane.

    Returns:
        ``G`` and its slopes ``dG``, the same at rest, ``G_0`` and ``dG_0``, ``speed`` dG/dt and its slopes ``dspeed``,
        ``along`` (w_2, w_3), and the coordinates ``s`` as variables, for more derivatives.
    """
    s = [ufl.variable(x[i]) for i in range(1, len(x))]

    def slopes(f: Any) -> list[Any]:
        return [ufl.diff(f, s_i) for s_i in s]

    G_0, speed = ufl.as_ufl(shape.rest(s, c)), c.V * shape.profile(s, c)
    G, along = G_0 + t * speed, shape.along(s, c)[: len(s)]
    known = {"G": G, "dG": slopes(G), "G_0": G_0, "dG_0": slopes(G_0), "speed": speed, "dspeed": slopes(speed)}
    return SimpleNamespace(**known, along=along, s=s)


def vector_of(first: Any, others: Sequence[Any]) -> Any:
    """UFL vector of components along the first axis and across."""
    return ufl.as_vector([first, *others])


def sum_of_products(one: Sequence[Any], other: Sequence[Any]) -> Any:
    """Sum of the products of as many factors."""
    return sum(a * b for a, b in zip(one, other, strict=True))
