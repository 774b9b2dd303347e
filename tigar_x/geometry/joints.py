"""What gluing has joined: sides that touch without being the same are refused, others that come near are told of."""

import logging
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from scipy.spatial import cKDTree

from tigar_x.compat import FloatArray, IntArray
from tigar_x.geometry.locate import closest_points
from tigar_x.geometry.multipatch import MultiPatch
from tigar_x.geometry.patch import Patch

log = logging.getLogger(__name__)

SAME_FUNCTION = 1e-6
"""Functions that differ by less along a joint are the same."""
INSIDE = np.array([0.13, 0.42, 0.77])
"""Where a Bezier element of a side is compared with other sides; not at points that are likely to be special."""
NEAR = 1e-2
"""Distance of sides that looks like a mistake, relative to their lengths and to the widths of their patches."""
NAMED = 8
"""How many joints a message names."""


def check_sides(geometry: MultiPatch, tolerance: float, within: bool, kept: set[tuple[int, int, int]]) -> None:
    """Refuse sides that touch along a part but do not have the same functions there.

    Args:
        geometry: glued patches.
        tolerance: distance that counts as none, relative to the size of the model.
        within: whether sides of one patch may be glued.
        kept: sides (patch, direction, end) that are open on purpose.

    Raises:
        ValueError: there are such sides.
    """
    if geometry.dim == 1:
        return
    sides = [_Side.of(geometry, *place) for place in geometry.open_sides if place not in kept]
    slack = tolerance * geometry.size
    for i, side in enumerate(sides):
        for other in sides[:i]:
            if other.place[0] == side.place[0] and not within:
                continue
            if _differ(side, other, slack, geometry) or _differ(other, side, slack, geometry):
                hint = "".join(f"; {text}" for text in _near(geometry, other.place, side.place))
                raise ValueError(
                    f"{other.name} and {side.name} touch but do not have the same functions: the same control points, "
                    f"weights, degrees and knots are required{hint}"
                )


@dataclass(frozen=True, eq=False)
class _Side:
    """A side of a patch as a geometry of its own.

    Attributes:
        place: its patch, direction and end.
        name: what messages call it.
        shape: the side.
        numbers: its functions among those of the whole geometry.
        xi: samples inside its Bezier elements.
        x: their positions.
    """

    place: tuple[int, int, int]
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
        return cls((k, direction, end), side_name(k, direction, end), shape, numbers, xi, shape.evaluate(xi))

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


def report(geometry: MultiPatch, tolerance: float, within: bool, kept: set[tuple[int, int, int]]) -> None:
    """Log what is joined, and warn of sides that come near each other without being joined.

    Args:
        geometry: glued patches.
        tolerance: distance that counted as none, relative to the size of the model.
        within: whether sides of one patch may be glued.
        kept: sides (patch, direction, end) that are open on purpose.
    """
    sides = [side for side in geometry.open_sides if not geometry.collapsed(*side)]
    keys = [geometry.side_functions(*side).tobytes() for side in sides]
    names, near = [], []
    for i, side in enumerate(sides):
        for j, other in enumerate(sides[:i]):
            if keys[i] == keys[j]:
                names.append(f"{side_name(*other)} and {side_name(*side)}")
            elif (within or side[0] != other[0]) and not {side, other} & kept:
                near += _near(geometry, other, side)
    merged = sum(patch.n for patch in geometry.patches) - geometry.n
    if names or merged:
        more = [f"{len(names) - NAMED} more"] if len(names) > NAMED else []
        joints = ": " + ", ".join(names[:NAMED] + more) if names else ""
        log.info("glued: %d joints, %d control points less%s", len(names), merged, joints)
    elif len(geometry.patches) > 1:
        log.warning(
            "glued: nothing is joined: no control points of the %d patches are within tolerance = %g of the model's "
            "size, %g",
            len(geometry.patches),
            tolerance,
            geometry.size,
        )
    for text in near:
        log.warning("glued: %s", text)


def _near(geometry: MultiPatch, one: tuple[int, int, int], other: tuple[int, int, int]) -> list[str]:
    """What to say of two sides that are not joined: nothing unless one lies along the other from end to end."""
    x, y = (geometry.points[geometry.side_functions(*side)] for side in (one, other))
    reach = NEAR * min(_width(geometry, one), _width(geometry, other))
    if (x.min(axis=0) > y.max(axis=0) + reach).any() or (y.min(axis=0) > x.max(axis=0) + reach).any():
        return []
    pair = f"{side_name(*one)} and {side_name(*other)}"
    gap = max(cKDTree(y).query(x)[0].max(), cKDTree(x).query(y)[0].max())
    if len(x) == len(y) and gap <= reach:
        spacing = min(cKDTree(z).query(z, 2)[0][:, 1].min() for z in (x, y))
        needed = 1.1 * gap / geometry.size
        text = f"{pair} come within {gap:.3g} of each other and are not joined: "
        if gap < 0.4 * spacing:
            return [text + f"tolerance = {needed:.1e} would do if they are meant to be one"]
        return [text + "their control points lie too dense for any tolerance to join the right ones"]
    for (side, z), (beside, hull) in (((one, x), (other, y)), ((other, y), (one, x))):
        if geometry.dim > 1 and (z >= hull.min(axis=0) - reach).all() and (z <= hull.max(axis=0) + reach).all():
            samples, shape = _Side.of(geometry, *side).x, _Side.of(geometry, *beside).shape
            gap = closest_points(shape, samples).distance.max()
            if gap <= reach:
                return [f"{pair} come within {gap:.3g} of each other and do not have the same functions: not joined"]
    return []


def _width(geometry: MultiPatch, side: tuple[int, int, int]) -> float:
    """The length of a side, or the distance to the side opposite if that is less."""
    k, direction, end = side
    own, opposite = (geometry.points[geometry.side_functions(k, direction, e)] for e in (end, 1 - end))
    across = float(cKDTree(own).query(opposite)[0].max())
    return across if geometry.dim == 1 else min(across, float(np.linalg.norm(np.ptp(own, axis=0))))


def side_name(patch: int, direction: int, end: int) -> str:
    """What messages call a side."""
    return f"side {'uvw'[direction]}{end} of patch {patch}"
