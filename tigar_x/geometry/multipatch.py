"""Several patches in one numbering: disjoint, or glued at coincident control points."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from tigar_x import checks
from tigar_x.compat import FloatArray, IntArray
from tigar_x.geometry.functions import SplineFunctions
from tigar_x.geometry.net import ControlNet
from tigar_x.geometry.patch import Patch

TOLERANCE = 1e-8
"""Control points closer than this, relative to the model's size, are one."""


@dataclass(frozen=True, eq=False, repr=False)
class MultiPatch(ControlNet):
    """Several patches as one geometry; made by :func:`disjoint`, or by gluing.

    Attributes:
        patches: the patches, of one parametric dimension in one space.
        numbering: function of every raw function (those of all patches one after the other); None: none are glued.

    Raises:
        ValueError: no patch, patches that do not belong together, or a numbering that is not one.
    """

    patches: tuple[Patch, ...]
    numbering: IntArray | None = None

    def __post_init__(self) -> None:
        if not self.patches:
            raise ValueError("patches is empty: one patch or more is required")
        for i, patch in enumerate(self.patches):
            checks.kind(f"patches[{i}]", patch, Patch, "a Patch")
        for name in ("dim", "nsd"):
            found = sorted({getattr(patch, name) for patch in self.patches})
            if len(found) > 1:
                raise ValueError(f"patches have {name} = {found}: one and the same is required")
        self._check_control()
        checks.freeze(self)

    @cached_property
    def functions(self) -> SplineFunctions:  # type: ignore[override]
        """The functions of all patches in one numbering."""
        functions = SplineFunctions(tuple(patch.basis for patch in self.patches), self.numbering)
        if self.numbering is None:
            return functions
        raw = np.concatenate([patch.weights for patch in self.patches])
        factors = raw / raw[functions.first][self.numbering]
        return functions if (factors == 1.0).all() else replace(functions, factors=factors)

    @cached_property
    def control(self) -> FloatArray:  # type: ignore[override]
        """Homogeneous control points, one per function, shape (n, nsd + 1); unit: length."""
        return checks.read_only(np.concatenate([patch.control for patch in self.patches])[self.functions.first])

    @cached_property
    def size(self) -> float:
        """Diagonal of the box around the control points; unit: length."""
        return float(np.linalg.norm(np.ptp(self.points, axis=0)))

    @cached_property
    def relative_points(self) -> FloatArray:
        """Control points about their middle, in units of the size, shape (n, nsd)."""
        return (self.points - self.points.mean(axis=0)) / max(self.size, np.finfo(float).tiny)

    @cached_property
    def open_sides(self) -> list[tuple[int, int, int]]:
        """Patch, direction and end of all sides."""
        return [(k, *patch.locate_side(name)) for k, patch in enumerate(self.patches) for name in patch.open_sides]

    @cached_property
    def outer_sides(self) -> list[tuple[int, int, int]]:
        """Patch, direction and end of the sides that make the boundary: neither glued to a side nor collapsed."""
        keys = [self.side_functions(*side).tobytes() for side in self.open_sides]
        own = [side for side, key in zip(self.open_sides, keys, strict=True) if keys.count(key) == 1]
        return [side for side in own if not self.collapsed(*side)]

    def collapsed(self, patch: int, direction: int, end: int) -> bool:
        """Whether a side has no length or area, such as a pole."""
        own = self.patches[patch]
        shape = [basis.n for d, basis in enumerate(own.bases) if d != direction]
        net = own.points[own.side_functions(0, direction, end)].reshape(*shape, -1, order="F")
        return any(np.ptp(net, axis=axis).max() <= TOLERANCE * self.size for axis in range(len(shape)))

    def locate_sides(self, names: Sequence[str], patch: int | None = None) -> list[tuple[int, int, int]]:
        """Sides by name, see :meth:`tigar_x.geometry.net.ControlNet.locate_sides`."""
        chosen = range(len(self.patches)) if patch is None else [self.checked(patch)]
        return [(k, *self.patches[k].locate_side(name)) for k in chosen for name in names or self.patches[k].open_sides]

    def side_places(self) -> list[dict[str, tuple[int, int]]]:
        """Sides by name, see :meth:`tigar_x.geometry.net.ControlNet.side_places`."""
        return [places for patch in self.patches for places in patch.side_places()]

    def side_functions(self, patch: int, direction: int, end: int, layers: int = 1) -> IntArray:
        """Functions next to a side, see :meth:`tigar_x.geometry.net.ControlNet.side_functions`."""
        own = self.patches[patch].side_functions(0, direction, end, layers)
        return np.unique(self.functions.global_numbers(patch, own))

    def side(self, name: str, layers: int = 1, *, patch: int | None = None) -> IntArray:
        """Functions next to a side.

        Args:
            name: see :meth:`tigar_x.geometry.patch.Patch.side`.
            layers: rows of functions.
            patch: which patch; None: the sides of that name of all patches.

        Returns:
            Function numbers, sorted.

        Raises:
            ValueError: there is no such patch or side or not that many layers.
        """
        return np.unique(np.concatenate([self.side_functions(*p, layers) for p in self.locate_sides([name], patch)]))

    def side_dofs(
        self, name: str, layers: int = 1, components: Sequence[int] | None = None, *, patch: int | None = None
    ) -> IntArray:
        """Degrees of freedom of a vector field next to a side.

        Args:
            name: see :meth:`side`.
            layers: rows of functions.
            components: components of the field; None: all ``nsd``.
            patch: which patch; None: the sides of that name of all patches.

        Returns:
            Numbers function * nsd + component, sorted.

        Raises:
            ValueError: no such patch, side, layer or component.
        """
        return self.dofs(self.side(name, layers, patch=patch), components)

    def checked(self, patch: int) -> int:
        """The number of a patch, else ValueError."""
        return int(checks.choice("patch", patch, tuple(range(len(self.patches)))))


def disjoint(*patches: Patch) -> MultiPatch:
    """Patches in one space without any connection.

    Args:
        patches: the patches.

    Returns:
        The geometry.

    Raises:
        ValueError: no patch, or patches of different dimensions.
    """
    return MultiPatch(patches)


def as_multipatch(geometry: Patch | MultiPatch) -> MultiPatch:
    """A patch as the only one of a geometry; a geometry of several as it is."""
    return MultiPatch((geometry,)) if isinstance(geometry, Patch) else geometry


def outside(geometry: ControlNet, names: Sequence[str], patch: int | None) -> list[tuple[int, int, int]]:
    """Sides by name on which a condition may be set: of all patches, those that are not glued to another side.

    Args:
        geometry: one patch or several.
        names: see :meth:`tigar_x.geometry.net.ControlNet.locate_sides`; one or more.
        patch: which patch, whose sides are taken glued or not; None: every patch.

    Returns:
        Patch, direction and end of every side.

    Raises:
        ValueError: there is no such side or patch, or all sides of a name are glued.
    """
    if patch is not None or not isinstance(geometry, MultiPatch):
        return geometry.locate_sides(names, patch)
    found = []
    for name in names:
        places = geometry.locate_sides([name])
        free = [place for place in places if geometry.collapsed(*place) or place in geometry.outer_sides]
        if not free:
            raise ValueError(f"side {name!r} is glued to another side wherever there is one: name its patch to hold it")
        found += free
    return found
