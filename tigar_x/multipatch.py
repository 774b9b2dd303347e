"""Several patches in one numbering: disjoint, or glued at coincident control points."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from typing import Any

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from tigar_x import checks
from tigar_x.compat import FloatArray, IntArray
from tigar_x.functions import SplineFunctions
from tigar_x.locate import closest_points
from tigar_x.patch import ControlNet, Patch

TOLERANCE = 1e-8
"""Control points closer than this, relative to the model's size, are one."""
SAME_FUNCTION = 1e-6
"""Functions that differ by less along a joint are the same."""
ALL = slice(None)
INSIDE = np.array([0.13, 0.42, 0.77])
"""Where a Bezier element of a side is compared with other sides; not at points that are likely to be special."""


@dataclass(frozen=True, eq=False)
class MultiPatch(ControlNet):
    """Several patches as one geometry; made by :func:`disjoint` or :func:`glued`.

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
        """Sides by name, see :meth:`tigar_x.patch.ControlNet.locate_sides`."""
        chosen = range(len(self.patches)) if patch is None else [self.checked(patch)]
        return [(k, *self.patches[k].locate_side(name)) for k in chosen for name in names or self.patches[k].open_sides]

    def side_places(self) -> list[dict[str, tuple[int, int]]]:
        """Sides by name, see :meth:`tigar_x.patch.ControlNet.side_places`."""
        return [places for patch in self.patches for places in patch.side_places()]

    def side_functions(self, patch: int, direction: int, end: int, layers: int = 1) -> IntArray:
        """Functions next to a side, see :meth:`tigar_x.patch.ControlNet.side_functions`."""
        own = self.patches[patch].side_functions(0, direction, end, layers)
        return np.unique(self.functions.global_numbers(patch, own))

    def side(self, name: str, layers: int = 1, *, patch: int | None = None) -> IntArray:
        """Functions next to a side.

        Args:
            name: see :meth:`tigar_x.patch.Patch.side`.
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


def glued(*patches: Patch, tolerance: float = TOLERANCE, within: bool = False) -> MultiPatch:
    """Patches whose coincident corners, edges and faces become one (C0), whatever their order and orientation.

    Functions are numbered by the position of their control points' first appearance, so the order of the patches
    permutes numbers and nothing else.

    Args:
        patches: the patches.
        tolerance: distance of control points that counts as none, relative to the size of the model.
        within: whether coincident boundary points of one patch are glued as well: a degenerate edge, such as a pole,
            becomes one function, and a patch that closes on itself becomes a ring.

    Returns:
        The geometry.

    Raises:
        ValueError: no patch, patches of different dimensions, or sides that touch but do not have the same functions:
            other control points, ratios of weights, degrees or knots, or one longer than the other.
    """
    checks.positive("tolerance", tolerance)
    checks.flag("within", within)
    apart = MultiPatch(patches)
    groups: dict[bytes, list[tuple[int, IntArray]]] = {}
    labels = _coincidence(apart, tolerance)
    for k, patch in enumerate(patches):
        for part in _boundary_parts(patch):
            raw = apart.functions.offsets[k] + part
            groups.setdefault(np.unique(labels[raw]).tobytes(), []).append((k, raw))
    pairs = [np.empty((2, 0), dtype=np.int32)]
    for members in groups.values():
        if within or len({k for k, _ in members}) > 1:
            raw = np.concatenate([functions for _, functions in members])
            raw = raw[np.argsort(labels[raw], kind="stable")]
            same = np.diff(labels[raw]) == 0
            pairs.append(np.stack([raw[:-1][same], raw[1:][same]]))
    geometry = MultiPatch(patches, _components(np.concatenate(pairs, axis=1), apart.n))
    _check_sides(geometry, tolerance, within)
    return geometry


def _coincidence(apart: MultiPatch, tolerance: float) -> IntArray:
    """A label for every raw function, the same where boundary control points coincide."""
    if not apart.open_sides:
        return np.arange(apart.n, dtype=np.int32)
    raw = np.unique(np.concatenate([apart.side_functions(*side) for side in apart.open_sides]))
    return _components(
        raw[cKDTree(apart.relative_points[raw]).query_pairs(tolerance, output_type="ndarray")].T, apart.n
    )


def _components(pairs: IntArray, n: int) -> IntArray:
    """Numbers from 0 without gaps, in the order of first appearance, equal for what pairs connect, shape (n,)."""
    graph = sp.coo_matrix((np.ones(pairs.shape[1]), tuple(pairs)), shape=(n, n))
    labels = connected_components(graph, directed=False)[1]
    return np.asarray(np.unique(labels, return_index=True)[1].argsort().argsort()[labels], dtype=np.int32)


def _boundary_parts(patch: Patch) -> list[IntArray]:
    """Functions of the corners, edges and faces of a patch."""
    grid = np.arange(patch.n, dtype=np.int32).reshape([basis.n for basis in patch.bases], order="F")
    ends: list[tuple[Any, ...]] = [(ALL,) if basis.periodic else (ALL, 0, -1) for basis in patch.bases]
    return [grid[place].ravel() for place in product(*ends) if any(end is not ALL for end in place)]


def _check_sides(geometry: MultiPatch, tolerance: float, within: bool) -> None:
    """Refuse sides that touch along a part but do not have the same functions there."""
    if geometry.dim == 1:
        return
    sides = [_Side.of(geometry, *place) for place in geometry.open_sides]
    slack = tolerance * geometry.size
    for i, side in enumerate(sides):
        for other in sides[:i]:
            if other.patch == side.patch and not within:
                continue
            if _differ(side, other, slack, geometry) or _differ(other, side, slack, geometry):
                raise ValueError(
                    f"{other.name} and {side.name} touch but do not have the same functions: the same control points, "
                    "weights, degrees and knots are required"
                )


@dataclass(frozen=True, eq=False)
class _Side:
    """A side of a patch as a geometry of its own.

    Attributes:
        patch: which patch it belongs to.
        name: what messages call it.
        shape: the side.
        numbers: its functions among those of the whole geometry.
        xi: samples inside its Bezier elements.
        x: their positions.
    """

    patch: int
    name: str
    shape: Patch
    numbers: IntArray
    xi: FloatArray
    x: FloatArray

    @classmethod
    def of(cls, geometry: MultiPatch, k: int, direction: int, end: int) -> "_Side":
        """Side of a patch by its direction and end."""
        patch = geometry.patches[k]
        own = patch.side_functions(0, direction, end)
        numbers = geometry.functions.global_numbers(k, own)
        bases = tuple(basis for d, basis in enumerate(patch.bases) if d != direction)
        shape = Patch.from_points(bases, geometry.points[numbers], patch.weights[own])
        ticks = [(b.breakpoints[:-1, None] + np.diff(b.breakpoints)[:, None] * INSIDE).ravel() for b in bases]
        xi = np.stack(np.meshgrid(*ticks, indexing="ij"), axis=-1).reshape(-1, len(bases))
        return cls(k, side_name(k, direction, end), shape, numbers, xi, shape.evaluate(xi))

    def functions(self, xi: FloatArray, geometry: MultiPatch) -> sp.csr_matrix:
        """Rational functions of the geometry at parameters of the side, shape (m, n)."""
        N = self.shape.basis.evaluate(xi)
        N = sp.diags(1.0 / (N @ self.shape.weights)) @ N @ sp.diags(self.shape.weights)
        place = (np.arange(len(self.numbers)), self.numbers)
        return N @ sp.csr_matrix((np.ones(len(self.numbers)), place), shape=(len(self.numbers), geometry.n))


def _differ(one: _Side, other: _Side, slack: float, geometry: MultiPatch) -> bool:
    """Whether samples of one side lie on the other one where that has other functions."""
    low, high = other.shape.points.min(axis=0) - slack, other.shape.points.max(axis=0) + slack
    near = ((one.x >= low) & (one.x <= high)).all(axis=1)
    if not near.any() or np.ptp(one.x, axis=0).max() <= slack:
        return False
    xi, x = one.xi[near], one.x[near]
    closest = closest_points(other.shape, x)
    touching = closest.distance <= slack
    if not touching.any():
        return False
    gap = one.functions(xi[touching], geometry) - other.functions(closest.xi[touching], geometry)
    return bool(np.abs(gap).max() > SAME_FUNCTION)


def side_name(patch: int, direction: int, end: int) -> str:
    """What messages call a side."""
    return f"side {'uvw'[direction]}{end} of patch {patch}"


def as_multipatch(geometry: Patch | MultiPatch) -> MultiPatch:
    """A patch as the only one of a geometry; a geometry of several as it is."""
    return MultiPatch((geometry,)) if isinstance(geometry, Patch) else geometry
