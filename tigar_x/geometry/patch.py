"""A spline geometry as data: degrees, knots and homogeneous control points."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tigar_x import checks
from tigar_x.compat import FloatArray, IntArray
from tigar_x.geometry import splipy_objects
from tigar_x.geometry.bspline import BSplineBasis, TensorBasis, require_containing
from tigar_x.geometry.functions import SplineFunctions
from tigar_x.geometry.net import ControlNet

SIDES = {f"{axis}{end}": (direction, end) for direction, axis in enumerate("uvw") for end in (0, 1)}
"""Names of the sides: the direction that is normal to the side, and its start (0) or end (1)."""


@dataclass(frozen=True, eq=False, repr=False)
class Patch(ControlNet):
    """One B-spline or NURBS patch: a curve (parametric dimension 1), a surface (2) or a volume (3).

    Attributes:
        bases: univariate bases, one per parametric direction.
        control: homogeneous control points (w x, w), first direction fastest, shape (n, nsd + 1); unit: length.
        side_names: further names of sides beside "u0", "u1", "v0", ..., each with its direction and end.

    Raises:
        ValueError: wrong shape, non-finite control points, weights that are not positive, or a name for no side.
    """

    bases: tuple[BSplineBasis, ...]
    control: FloatArray
    side_names: Mapping[str, tuple[int, int]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if len(self.bases) not in (1, 2, 3):
            raise ValueError(f"bases has {len(self.bases)} directions: 1, 2 or 3 are supported")
        object.__setattr__(self, "bases", tuple(self.bases))
        object.__setattr__(self, "control", self._check_control())
        allowed = tuple(SIDES[name] for name in self.open_sides)
        for name, place in self.side_names.items():
            if name in SIDES:
                raise ValueError(f"side_names contains {name!r}: a name other than {', '.join(SIDES)} is required")
            checks.choice(f"side_names[{name!r}]", place, allowed)
        object.__setattr__(self, "side_names", dict(self.side_names))

    @classmethod
    def from_points(
        cls,
        bases: Sequence[BSplineBasis],
        points: ArrayLike,
        weights: ArrayLike | None = None,
        side_names: Mapping[str, tuple[int, int]] | None = None,
    ) -> "Patch":
        """Patch from physical control points.

        Args:
            bases: univariate bases.
            points: control points, first direction fastest, shape (n, nsd); unit: length.
            weights: NURBS weights, shape (n,); None: a B-spline.
            side_names: further names of sides.

        Returns:
            The patch.
        """
        x = checks.array("points", points, (None, None))
        w = np.ones(len(x)) if weights is None else checks.array("weights", weights, (len(x),))
        return cls(tuple(bases), np.column_stack([x * w[:, None], w]), side_names or {})

    @classmethod
    def from_splipy(cls, shape: Any, side_names: Mapping[str, tuple[int, int]] | None = None) -> "Patch":
        """Patch from a splipy Curve, Surface or Volume.

        Args:
            shape: the splipy object.
            side_names: further names of sides.

        Returns:
            The patch, periodic where the object is.

        Raises:
            ValueError: another object, a trimmed surface, whose boundary curves a patch does not have, or a periodic
                object whose start does not have the continuity that splipy says.
        """
        bases, columns = splipy_objects.from_splipy(shape)
        return cls(bases, columns, side_names or {})

    def to_splipy(self) -> Any:
        """The patch as splipy Curve, Surface or Volume, with weights where it has any."""
        return splipy_objects.to_splipy(self.bases, self.control, rational=self.rational)

    @cached_property
    def basis(self) -> TensorBasis:
        """Tensor-product basis."""
        return TensorBasis(self.bases)

    @cached_property
    def functions(self) -> SplineFunctions:  # type: ignore[override]
        """The functions, in the patch's own parameters."""
        return SplineFunctions((self.basis,))

    def evaluate(self, xi: ArrayLike) -> FloatArray:
        """Physical points of parameters.

        Args:
            xi: shape (m, parametric dimension).

        Returns:
            Points, shape (m, nsd).
        """
        homogeneous = self.basis.evaluate(xi) @ self.control
        return homogeneous[:, :-1] / homogeneous[:, -1:]

    # -- sides --------------------------------------------------------------------------------------------------------

    def locate_side(self, name: str) -> tuple[int, int]:
        """Direction and end of a side.

        Args:
            name: "u0", "u1", "v0", ... or one of ``side_names``.

        Returns:
            The direction normal to the side, and 0 for its start or 1 for its end.

        Raises:
            ValueError: there is no such side; the message lists those there are.
        """
        (known,) = self.side_places()
        return known[checks.choice("name", name, tuple(known))]

    def locate_sides(self, names: Sequence[str], patch: int | None = None) -> list[tuple[int, int, int]]:
        """Sides by name, see :meth:`tigar_x.geometry.net.ControlNet.locate_sides`."""
        checks.choice("patch", patch, (None, 0))
        return [(0, *self.locate_side(name)) for name in names or self.open_sides]

    def side_places(self) -> list[dict[str, tuple[int, int]]]:
        """Sides by name, see :meth:`tigar_x.geometry.net.ControlNet.side_places`."""
        return [{name: SIDES[name] for name in self.open_sides} | dict(self.side_names)]

    @property
    def open_sides(self) -> tuple[str, ...]:
        """Plain names of all sides: two in every direction that is not periodic."""
        return tuple(name for name, (d, _) in SIDES.items() if d < self.dim and not self.bases[d].periodic)

    def side_functions(self, patch: int, direction: int, end: int, layers: int = 1) -> IntArray:
        """Functions next to a side, see :meth:`tigar_x.geometry.net.ControlNet.side_functions`."""
        n = self.bases[direction].n
        if checks.whole("layers", layers, 1) > n:
            raise ValueError(f"layers = {layers}: direction {direction} has only {n} functions")
        rows = np.arange(layers) if end == 0 else np.arange(n - layers, n)
        return np.sort(np.take(self._grid, rows, axis=direction).ravel()).astype(np.int32)

    def side(self, name: str, layers: int = 1) -> IntArray:
        """Functions next to a side.

        Args:
            name: "u0", "u1", "v0", ... or one of ``side_names``.
            layers: rows of functions: 1 fixes the position of the side, 2 its tangent as well.

        Returns:
            Function numbers, sorted.

        Raises:
            ValueError: there is no such side or not that many layers.
        """
        return self.side_functions(0, *self.locate_side(name), layers)

    def side_dofs(self, name: str, layers: int = 1, components: Sequence[int] | None = None) -> IntArray:
        """Degrees of freedom of a vector field next to a side.

        Args:
            name: see :meth:`side`.
            layers: rows of functions, see :meth:`side`.
            components: components of the field; None: all ``nsd``.

        Returns:
            Numbers function * nsd + component, sorted.

        Raises:
            ValueError: no such side, layer or component.
        """
        return self.dofs(self.side(name, layers), components)

    @property
    def _grid(self) -> NDArray[np.int64]:
        return np.arange(self.basis.n).reshape([basis.n for basis in self.bases], order="F")

    # -- the same geometry, described otherwise -----------------------------------------------------------------------

    def on(self, bases: Sequence[BSplineBasis]) -> "Patch":
        """The same geometry on richer bases: knots inserted, degrees elevated, or both.

        The control points follow from interpolation at the Greville points, which is exact because the richer space
        contains the geometry.

        Args:
            bases: univariate bases over the same ranges, each containing the present one.

        Returns:
            The patch.

        Raises:
            ValueError: a basis does not contain the present one.
        """
        if len(bases) != self.dim:
            raise ValueError(f"bases has {len(bases)} directions: {self.dim} are required")
        for direction, (old, new) in enumerate(zip(self.bases, bases, strict=True)):
            require_containing(f"bases[{direction}]", old, new)
        richer = TensorBasis(tuple(bases))
        control = richer.interpolate(self.basis.evaluate(richer.greville) @ self.control)
        if not self.rational:
            control[:, -1] = 1.0
        return replace(self, bases=tuple(bases), control=control)

    def refined(self, *parts: int) -> "Patch":
        """The same geometry with every Bezier element cut in equal parts.

        Args:
            parts: number of parts, one for all directions or one per direction; 1 leaves a direction alone.

        Returns:
            The patch; the continuity at the new knots is p - 1.

        Raises:
            ValueError: not as many numbers as directions, or a number below 1.
        """
        cuts = [checks.whole("parts", k, 1) for k in (parts * self.dim if len(parts) == 1 else parts)]
        if len(cuts) != self.dim:
            raise ValueError(f"parts = {parts}: one number, or one for each of the {self.dim} directions is required")
        return self.on([basis.with_knots(_cuts(basis, k)) for basis, k in zip(self.bases, cuts, strict=True)])

    def with_degree(self, *degrees: int) -> "Patch":
        """The same geometry with elevated degrees and unchanged continuity.

        Args:
            degrees: degree, one for all directions or one per direction, none below the present one.

        Returns:
            The patch.

        Raises:
            ValueError: not as many degrees as directions, or one below the present one.
        """
        wanted = degrees * self.dim if len(degrees) == 1 else degrees
        if len(wanted) != self.dim:
            raise ValueError(f"degrees = {degrees}: one, or one for each of the {self.dim} directions is required")
        return self.on([basis.elevated(p) for basis, p in zip(self.bases, wanted, strict=True)])

    def reversed(self, direction: int) -> "Patch":
        """The same geometry with one parameter running backwards; named sides stay where they are.

        Args:
            direction: which one.

        Returns:
            The patch.

        Raises:
            ValueError: no such direction.
        """
        checks.choice("direction", direction, tuple(range(self.dim)))
        basis = self.bases[direction]
        m, low, high = basis.multiplicities[0], basis.knots[0], basis.knots[-1]
        knots = low + high - basis.knots[::-1]
        knots[:m], knots[-m:] = low, high
        # a function on knots i to i + p + 1 becomes the one on the mirrored knots
        last = len(basis.knots) - 2 - basis.degree
        order = np.take(self._grid, (last - np.arange(basis.n)) % basis.n, axis=direction).ravel(order="F")
        names = {name: (d, 1 - end if d == direction else end) for name, (d, end) in self.side_names.items()}
        bases = list(self.bases)
        bases[direction] = replace(basis, knots=knots)
        return replace(self, bases=tuple(bases), control=self.control[order], side_names=names)

    def swapped(self, first: int = 0, second: int = 1) -> "Patch":
        """The same geometry with two parameters exchanged; named sides stay where they are.

        Args:
            first: one direction.
            second: the other direction.

        Returns:
            The patch.

        Raises:
            ValueError: no such direction.
        """
        for name, direction in (("first", first), ("second", second)):
            checks.choice(name, direction, tuple(range(self.dim)))
        place = list(range(self.dim))
        place[first], place[second] = second, first
        names = {name: (place[d], end) for name, (d, end) in self.side_names.items()}
        order = np.transpose(self._grid, place).ravel(order="F")
        return replace(self, bases=tuple(self.bases[d] for d in place), control=self.control[order], side_names=names)


def _cuts(basis: BSplineBasis, parts: int) -> FloatArray:
    """Parameters that cut every Bezier element in equal parts."""
    x = basis.breakpoints
    return (x[:-1, None] + np.diff(x)[:, None] * (np.arange(1, parts) / parts)).ravel()
