"""Patches that become one geometry where their corners, edges and faces coincide."""

from collections.abc import Sequence
from itertools import product
from typing import Any

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from tigar_x import checks
from tigar_x.compat import IntArray
from tigar_x.geometry import joints
from tigar_x.geometry.multipatch import TOLERANCE, MultiPatch
from tigar_x.geometry.patch import Patch

ALL = slice(None)


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
    joints.check_sides(geometry, tolerance, within, kept)
    joints.report(geometry, tolerance, within, kept)
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
