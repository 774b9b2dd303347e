"""Sides of a spline's patches as facets of its parametric mesh."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from dolfinx import mesh

from tigar_x.compat import FloatArray
from tigar_x.geometry.multipatch import MultiPatch, as_multipatch
from tigar_x.geometry.net import ControlNet
from tigar_x.geometry.patch import Patch
from tigar_x.splines.extraction import tagged_boundary

Place = tuple[int, int, int]
"""Patch, direction normal to the side, and its start (0) or end (1)."""


def tag_of(place: Place, dim: int) -> int:
    """Number of a side's facets, from 1.

    Args:
        place: the side.
        dim: parametric dimension.
    """
    patch, direction, end = place
    return 1 + 2 * (dim * patch + direction) + end


def tagged_sides(domain: mesh.Mesh, boxes: FloatArray) -> Any:
    """Tags of the exterior facets of a parametric mesh, see :func:`tag_of`.

    Args:
        domain: parametric mesh.
        boxes: lower and upper corner of every patch in it, shape (patches, 2, parametric dimension).

    Returns:
        dolfinx mesh tags.
    """
    parts, dim = [], boxes.shape[2]
    for k, box in enumerate(boxes):
        slack = 1e-9 * (box[1] - box[0])
        for direction in range(dim):
            for end in (0, 1):
                tag = tag_of((k, direction, end), dim)
                parts.append((tag, _on_side(box, slack, direction, box[end, direction])))
    return tagged_boundary(domain, parts)


def _on_side(box: FloatArray, slack: FloatArray, direction: int, value: float) -> Any:
    """Predicate of points of the parametric plane that lie on one side of a box."""

    def on_side(x: FloatArray) -> Any:
        dim = len(slack)
        inside = (x[:dim] >= (box[0] - slack)[:, None]) & (x[:dim] <= (box[1] + slack)[:, None])
        return inside.all(axis=0) & (np.abs(x[direction] - value) <= slack[direction])

    return on_side


def named_or_outer(geometry: ControlNet, names: Sequence[str], patch: int | None) -> list[Place]:
    """Sides by name, or those that make the boundary.

    Args:
        geometry: spline geometry.
        names: of the sides; none: those that are neither glued nor collapsed, or all of a geometry from a file.
        patch: whose sides; None: those of all patches.

    Raises:
        ValueError: there is no such side or patch.
    """
    if names or not isinstance(geometry, Patch | MultiPatch):
        return geometry.locate_sides(names, patch)
    whole = as_multipatch(geometry)
    return [place for place in whole.outer_sides if patch is None or place[0] == whole.checked(patch)]
