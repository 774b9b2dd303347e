"""Whether a spline is smooth enough for a shell that bends.

The curvature of a Kirchhoff-Love shell takes second derivatives. Functions of degree 1 have none, and where functions
are only C0 no moment passes from one side to the other.
"""

import logging
from typing import Any
from weakref import WeakSet

import ufl
from ufl.algorithms import extract_coefficients

from shnapr.kinematics import Midsurface, midsurface
from tigar_x import checks
from tigar_x.geometry.lines import folds
from tigar_x.geometry.multipatch import MultiPatch, as_multipatch
from tigar_x.geometry.patch import Patch
from tigar_x.splines.spline import ExtractedSpline, require_spline

log = logging.getLogger(__name__)

NAMED = 4
"""How many lines a message names."""
_seen: WeakSet[ExtractedSpline] = WeakSet()


def require_kinds(spline: Any, material: Any) -> None:
    """Refuse what is no spline, and what is no material of shells.

    Args:
        spline: the midsurface.
        material: its material.

    Raises:
        ValueError: one is something else.
    """
    require_spline(spline)
    checks.having("material", material, "energy_density", "a material of shells, such as shnapr's StVenantKirchhoff,")


def require_bending(spline: ExtractedSpline, material: Any) -> None:
    """Refuse functions that cannot bend, and warn of lines where they fold; once for a spline.

    Lines that constraints make smooth, or supports hold, are none. A membrane may be as it likes, and nothing is known
    of a geometry that was read from a file.

    Args:
        spline: the midsurface.
        material: its material, see :class:`shnapr.work.Material`.

    Raises:
        ValueError: the degree is 1 in all directions, while curvature enters the energy and something is free to move.
    """
    require_kinds(spline, material)
    if spline in _seen or not isinstance(spline.geometry, Patch | MultiPatch) or not _bends(spline, material):
        return
    geometry, free = as_multipatch(spline.geometry), spline.vector.admissible
    if not free.shape[1]:
        return
    for k, patch in enumerate(geometry.patches):
        if max(patch.basis.degrees) == 1:
            raise ValueError(
                f"spline has degree 1 in patch {k}, where a shell has no curvature: degree 2 or more is required "
                "(with_degree), or a material without bending"
            )
    _seen.add(spline)
    lines = [line.name for line in folds(geometry, free)]
    if lines:
        names = ", ".join(lines[:NAMED]) + (f" and {len(lines) - NAMED} more" if len(lines) > NAMED else "")
        log.warning(
            "shell: functions are only C0 at %s: it turns there as on a hinge. If none is meant, take constraints = "
            "[smooth_joints(geometry)] of tigar_x.splines.constraints for glued sides and [smooth_lines(geometry)] for "
            "knots "
            "inside a patch that are repeated as often as the degree, or a degree above 1",
            names,
        )


def _bends(spline: ExtractedSpline, material: Any) -> bool:
    """Whether the current curvature is in the energy of a material."""
    m, mark = spline.dim, ufl.Coefficient(spline.V)
    reference = midsurface(spline)
    curvature = ufl.as_matrix([[mark[0]] * m] * m)
    current = Midsurface(None, None, None, reference.metric, curvature)
    return mark in extract_coefficients(material.energy_density(reference, current))
