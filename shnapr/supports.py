"""Supports of a shell's edges, by name, and of whole shells: degrees of freedom of the displacement that do not move.

Symmetry, which ties degrees of freedom to each other, is in :func:`tigar_x.splines.constraints.symmetry`.
"""

from collections.abc import Sequence

import numpy as np

from tigar_x import checks
from tigar_x.compat import IntArray
from tigar_x.geometry.multipatch import MultiPatch, as_multipatch, outside
from tigar_x.geometry.patch import Patch


def clamped(geometry: Patch | MultiPatch, *sides: str, patch: int | None = None) -> IntArray:
    """Edges whose position and tangent plane are held: the two outer rows of control points.

    This is how the published analyses clamp. Held in all components, the second row keeps the edge's elements from
    stretching across the edge as well, an error of first order in their size; :func:`pinned` with
    :func:`tigar_x.splines.constraints.no_rotation` holds the tangent plane alone.

    Args:
        geometry: the shell, with open knot vectors across these edges.
        sides: names of the edges, such as "u0".
        patch: whose edges; None: those of that name of all patches but the ones that are glued to another edge.

    Returns:
        Zero dofs (function * nsd + component), sorted.

    Raises:
        ValueError: no side is named, there is no such side or patch, or all of that name are glued.
    """
    return _layers(geometry, sides, patch, 2, None)


def pinned(
    geometry: Patch | MultiPatch, *sides: str, components: Sequence[int] | None = None, patch: int | None = None
) -> IntArray:
    """Edges whose position is held, in all or some directions of space, and that may turn.

    Args:
        geometry: the shell.
        sides: names of the edges.
        components: axes along which they are held; None: all.
        patch: whose edges; None: those of that name of all patches but the ones that are glued to another edge.

    Returns:
        Zero dofs (function * nsd + component), sorted.

    Raises:
        ValueError: no side is named, there is no such side, patch or axis, or all of that name are glued.
    """
    return _layers(geometry, sides, patch, 1, components)


def fixed(geometry: Patch | MultiPatch, *, patch: int | None = None) -> IntArray:
    """Whole shells that do not move at all, such as rigid bodies and walls that are immersed in a flow.

    They go to the spline as ``zero_dofs``.

    Args:
        geometry: the shell.
        patch: which patch; None: all.

    Returns:
        Zero dofs (function * nsd + component), sorted.

    Raises:
        ValueError: there is no such patch.
    """
    whole = as_multipatch(geometry)
    if patch is None:
        return geometry.dofs(np.arange(geometry.n))
    own = np.arange(whole.patches[whole.checked(patch)].n, dtype=np.int32)
    return geometry.dofs(np.unique(whole.functions.global_numbers(patch, own)))


def _layers(
    geometry: Patch | MultiPatch, sides: Sequence[str], patch: int | None, layers: int, axes: Sequence[int] | None
) -> IntArray:
    checks.kind("geometry", geometry, Patch | MultiPatch, "a Patch or a MultiPatch")
    if not sides:
        raise ValueError("sides is empty: name at least one edge")
    places = outside(geometry, sides, patch)
    functions = np.unique(np.concatenate([geometry.side_functions(*place, layers) for place in places]))
    return geometry.dofs(functions, axes)
