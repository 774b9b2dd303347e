"""Several patches in one numbering: disjoint, or glued at coincident control points."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from typing import Any

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from tigar_x import checks
from tigar_x.compat import FloatArray, IntArray
from tigar_x.geometry import gluing
from tigar_x.geometry.functions import SplineFunctions
from tigar_x.geometry.patch import ControlNet, Patch

TOLERANCE = 1e-8
"""Control points closer than this, relative to the model's size, are one."""
ALL = slice(None)


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
        """Sides by name, see :meth:`tigar_x.geometry.patch.ControlNet.locate_sides`."""
        chosen = range(len(self.patches)) if patch is None else [self.checked(patch)]
        return [(k, *self.patches[k].locate_side(name)) for k in chosen for name in names or self.patches[k].open_sides]

    def side_places(self) -> list[dict[str, tuple[int, int]]]:
        """Sides by name, see :meth:`tigar_x.geometry.patch.ControlNet.side_places`."""
        return [places for patch in self.patches for places in patch.side_places()]

    def side_functions(self, patch: int, direction: int, end: int, layers: int = 1) -> IntArray:
        """Functions next to a side, see :meth:`tigar_x.geometry.patch.ControlNet.side_functions`."""
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


def glued(
    *patches: Patch, tolerance: float = TOLERANCE, within: bool = False, keep_open: Sequence[tuple[int, str]] = ()
) -> MultiPatch:
    """Patches whose coincident corners, edges and faces become one (C0), whatever their order and orientation.

    Functions are numbered by the position of their control points' first appearance, so the order of the patches
    permutes numbers and nothing else. The log tells what is joined, and warns of sides that come near each other but
    not near enough.

    Args:
        patches: the patches.
        tolerance: distance of control points that counts as none, relative to the size of the model.
        within: whether coincident boundary points of one patch are glued as well: a degenerate edge, such as a pole,
            becomes one function, and a patch that closes on itself becomes a ring.
        keep_open: sides that stay a boundary although another side lies in the same place, such as one bank of a slit
            (of all patches along it, the same bank): patch and name of each. Their ends are joined where further
            joints lead there, as at the tip of a slit.

    Returns:
        The geometry.

    Raises:
        ValueError: no patch, patches of different dimensions, sides that touch but do not have the same functions:
            other control points, ratios of weights, degrees or knots, or one longer than the other; or a side of
            ``keep_open`` that would not be glued.
    """
    checks.positive("tolerance", tolerance)
    checks.flag("within", within)
    apart = MultiPatch(patches)
    labels = _coincidence(apart, tolerance)
    kept = _kept_open(apart, labels, within, keep_open)
    bank = np.zeros(apart.n, dtype=bool)
    groups: dict[bytes, list[tuple[int, IntArray]]] = {}
    for k, patch in enumerate(patches):
        for sides, part in _boundary_parts(patch):
            raw = apart.functions.offsets[k] + part
            if any((k, *side) in kept for side in sides):
                bank[raw] = True
            else:
                groups.setdefault(np.unique(labels[raw]).tobytes(), []).append((k, raw))
    pairs = [np.empty((2, 0), dtype=np.int32)]
    for members in groups.values():
        if within or len({k for k, _ in members}) > 1:
            pairs += _joined([raw for _, raw in members], labels, bank)
    geometry = MultiPatch(patches, _components(np.concatenate(pairs, axis=1), apart.n))
    gluing.check_sides(geometry, tolerance, within, kept)
    gluing.report(geometry, tolerance, within, kept)
    return geometry


def _kept_open(
    apart: MultiPatch, labels: IntArray, within: bool, keep_open: Sequence[tuple[int, str]]
) -> set[tuple[int, int, int]]:
    """Patch, direction and end of sides that are not to be glued; each coincides with another one that might be."""
    kept: set[tuple[int, int, int]] = set()
    for i, (k, name) in enumerate(keep_open):
        (place,) = apart.locate_sides([name], k)
        own = np.unique(labels[apart.side_functions(*place)])
        others = [side for side in apart.open_sides if side != place and (within or side[0] != k)]
        if not any(np.array_equal(own, np.unique(labels[apart.side_functions(*side)])) for side in others):
            raise ValueError(f"keep_open[{i}] = {(k, name)}: no other side is in that place, it would not be glued")
        kept.add(place)
    return kept


def _joined(members: list[IntArray], labels: IntArray, bank: NDArray[np.bool_]) -> list[IntArray]:
    """Pairs of functions of coincident corners, edges or faces that become one, each of shape (2, pairs).

    Where an open bank ends at an edge that closes on itself, two functions of one member have one label: they stay
    apart, each with those of the same bank of the other members, unless the member has collapsed or another one is
    closed there.
    """
    raw = np.concatenate(members)
    owner = np.repeat(np.arange(len(members)), [len(member) for member in members])
    point = [np.ptp(labels[member]) == 0 for member in members]
    key = 2 * labels[raw].astype(np.int64)
    for label in np.unique(labels[raw[bank[raw]]]):
        here = labels[raw] == label
        on, off = (np.unique(owner[here & side]) for side in (bank[raw], ~bank[raw]))
        if len(off) and np.isin(off, on).all() and not any(point[i] for i in on):
            key[here & bank[raw]] += 1
    order = np.argsort(key, kind="stable")
    raw, same = raw[order], np.diff(key[order]) == 0
    return [np.stack([raw[:-1][same], raw[1:][same]])]


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


def _boundary_parts(patch: Patch) -> list[tuple[list[tuple[int, int]], IntArray]]:
    """Corners, edges and faces of a patch: the sides (direction and end) that each lies on, and its functions."""
    grid = np.arange(patch.n, dtype=np.int32).reshape([basis.n for basis in patch.bases], order="F")
    ends: list[tuple[Any, ...]] = [(ALL,) if basis.periodic else (ALL, 0, -1) for basis in patch.bases]
    found = []
    for place in product(*ends):
        sides = [(d, 0 if end == 0 else 1) for d, end in enumerate(place) if end is not ALL]
        if sides:
            found.append((sides, grid[place].ravel()))
    return found


def as_multipatch(geometry: Patch | MultiPatch) -> MultiPatch:
    """A patch as the only one of a geometry; a geometry of several as it is."""
    return MultiPatch((geometry,)) if isinstance(geometry, Patch) else geometry


def outside(geometry: ControlNet, names: Sequence[str], patch: int | None) -> list[tuple[int, int, int]]:
    """Sides by name on which a condition may be set: of all patches, those that are not glued to another side.

    Args:
        geometry: one patch or several.
        names: see :meth:`tigar_x.geometry.patch.ControlNet.locate_sides`; one or more.
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
