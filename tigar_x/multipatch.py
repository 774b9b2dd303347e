"""Several patches in one numbering: disjoint, or glued at coincident control points."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from tigar_x import checks
from tigar_x.compat import FloatArray, IntArray
from tigar_x.functions import SplineFunctions
from tigar_x.patch import ControlNet, Patch

TOLERANCE = 1e-8
"""Control points closer than this, relative to the model's size, are one."""


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

    @cached_property
    def functions(self) -> SplineFunctions:  # type: ignore[override]
        """The functions of all patches in one numbering."""
        return SplineFunctions(tuple(patch.basis for patch in self.patches), self.numbering)

    @cached_property
    def control(self) -> FloatArray:  # type: ignore[override]
        """Homogeneous control points, one per function, shape (n, nsd + 1); unit: length."""
        raw = np.concatenate([patch.control for patch in self.patches])
        if self.numbering is None:
            return raw
        return raw[np.unique(self.numbering, return_index=True)[1]]

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
    """Patches whose coincident boundary control points become one (C0), whatever their order and orientation.

    Functions are numbered by the position of their control points' first appearance, so the order of the patches
    permutes numbers and nothing else. Sides that share control points must agree in degree and knots.

    Args:
        patches: the patches.
        tolerance: distance of homogeneous control points that counts as none, relative to the size of the model.
        within: whether coincident boundary points of one patch are glued as well: a degenerate edge, such as a pole,
            becomes one function, and a patch that closes on itself becomes a ring.

    Returns:
        The geometry.

    Raises:
        ValueError: no patch, patches of different dimensions, sides that share control points but not their knots, or
            sides of which only a part is shared.
    """
    checks.positive("tolerance", tolerance)
    apart = MultiPatch(patches)
    boundary = [np.unique(np.concatenate([patch.side(name) for name in patch.open_sides])) for patch in patches]
    owner = np.repeat(np.arange(len(patches)), [len(functions) for functions in boundary])
    raw = np.concatenate([apart.functions.offsets[k] + functions for k, functions in enumerate(boundary)])
    x = apart.control[raw]
    size = np.linalg.norm(np.ptp(apart.points, axis=0))
    pairs = cKDTree(x).query_pairs(tolerance * size, output_type="ndarray")
    if not within:
        pairs = pairs[owner[pairs[:, 0]] != owner[pairs[:, 1]]]
    a, b = raw[pairs].T
    graph = sp.coo_matrix((np.ones(len(a)), (a, b)), shape=(apart.n, apart.n))
    labels = connected_components(graph, directed=False)[1]
    numbering = np.unique(labels, return_index=True)[1].argsort().argsort()[labels].astype(np.int32)
    _check_edges(patches, apart.functions.offsets, numbering)
    return MultiPatch(patches, numbering)


def _check_edges(patches: tuple[Patch, ...], offsets: IntArray, numbering: IntArray) -> None:
    """Refuse sides that are shared in part, or whose functions are not the same."""
    if patches[0].dim == 1:
        return
    sides = [
        (k, name, numbering[offsets[k] + patch.side(name)])
        for k, patch in enumerate(patches)
        for name in patch.open_sides
    ]
    for i, (k, name, functions) in enumerate(sides):
        for other, other_name, other_functions in sides[:i]:
            if other == k:
                continue
            shared = len(np.intersect1d(functions, other_functions))
            # opposite corners may be shared by sides that only meet there
            if shared <= 2 ** (patches[0].dim - 1):
                continue
            pair = f"side {other_name!r} of patch {other} and side {name!r} of patch {k}"
            if shared < min(len(np.unique(functions)), len(np.unique(other_functions))):
                raise ValueError(f"{pair} share {shared} control points of {len(functions)}: all are required")
            if not _same_knots(_edge(patches[other], other_name), _edge(patches[k], name)):
                raise ValueError(f"{pair} share their control points: the same degrees and knots are required as well")


def _edge(patch: Patch, name: str) -> list[tuple[int, FloatArray]]:
    """Degree and normalised knots of the directions along a side."""
    along = [basis for d, basis in enumerate(patch.bases) if d != patch.locate_side(name)[0]]
    return [(b.degree, (b.knots - b.knots[0]) / (b.knots[-1] - b.knots[0])) for b in along]


def _same_knots(first: list[tuple[int, FloatArray]], second: list[tuple[int, FloatArray]]) -> bool:
    """Whether two sides have the same functions, up to the order and the sense of their parameters."""

    def alike(a: tuple[int, FloatArray], b: tuple[int, FloatArray]) -> bool:
        if a[0] != b[0] or len(a[1]) != len(b[1]):
            return False
        return any(np.allclose(a[1], knots, rtol=0.0, atol=1e-12) for knots in (b[1], 1.0 - b[1][::-1]))

    orders = [second, second[::-1]]
    return any(all(alike(a, b) for a, b in zip(first, order, strict=True)) for order in orders)


def as_multipatch(geometry: Patch | MultiPatch) -> MultiPatch:
    """A patch as the only one of a geometry; a geometry of several as it is."""
    return MultiPatch((geometry,)) if isinstance(geometry, Patch) else geometry
