"""Meshes that gmsh makes on rank 0."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from mpi4py import MPI

from tigar_x import checks
from tigar_x.compat import FloatArray
from varmint.mesh.arrays import Owners, distributed
from varmint.mesh.checks import MeshArrays, extruded_arrays
from varmint.mesh.elements import Elements
from varmint.mesh.named import CELLS, NamedMesh
from varmint.mesh.session import model_elements, session

QUADRILATERALS = {
    "RecombineAll": 1,
    "RecombinationAlgorithm": 1,
    "SubdivisionAlgorithm": 1,
    "MeshSizeFactor": 2,
    "Algorithm": 6,
}
"""gmsh's options for a mesh of quadrilaterals alone: cells of twice the size, most of them recombined, are divided.

Its full-quad recombination fails in some releases where a curve has an odd number of edges, and algorithm 8 may crash.
"""
GROWTH = 0.25
"""By how much cells grow per unit of length away from the cylinder."""


class Region(NamedTuple):
    """Where cells are smaller.

    Attributes:
        kind: gmsh's name of a size field of regions, "Ball" or "Box".
        size: of the cells in it.
        shape: parameters of the field that say where it is.
    """

    kind: str
    size: float
    shape: dict[str, float]


def from_gmsh(comm: MPI.Comm, build: Callable[[Any], None], dim: int, owners: Owners | None = None) -> NamedMesh:
    """Mesh of a geometry that is built by gmsh.

    Args:
        comm: communicator; only rank 0 calls gmsh.
        build: function of the module gmsh, which has been initialized with an empty model; it makes the geometry, its
            physical groups of dimensions ``dim`` and ``dim`` - 1, and settings. It may make the mesh as well.
        dim: dimension of the cells, 2 or 3.
        owners: see :func:`varmint.mesh.arrays.distributed`.

    Returns:
        The mesh; physical groups become groups of cells and facets, by their names or else their numbers. Where some
        cells are in physical groups, the others are left out, as gmsh does in its files.

    Raises:
        ValueError: on all ranks: another dimension, nothing of this dimension, what is in two physical groups, or
            what :func:`varmint.mesh.checks.checked_arrays` raises. All ranks also raise what ``build`` and gmsh do.
        RuntimeError: gmsh is in use.
    """
    checks.choice("dim", dim, (2, 3))

    def elements() -> Elements:
        with session() as gmsh:
            build(gmsh)
            return model_elements(gmsh, dim, "the model of build")

    return distributed(comm, lambda: elements().arrays(), owners)


def channel_with_cylinder(
    comm: MPI.Comm,
    *,
    length: float = 2.2,
    height: float = 0.41,
    center: Sequence[float] = (0.2, 0.2),
    radius: float = 0.05,
    size: float = 0.02,
    cylinder_size: float | None = None,
    wake_size: float | None = None,
    beam: tuple[float, float] | None = None,
    rigid: bool = False,
    depth: float | None = None,
    cell: str = "triangle",
    equal_area: bool = False,
) -> NamedMesh:
    """Channel (0, length) x (0, height) with a cylinder across it, and a beam behind the cylinder if one is wanted.

    The default is the channel of Schaefer and Turek, doi:10.1007/978-3-322-89849-4_39; with ``length=2.5`` and
    ``beam=(0.35, 0.02)`` it is that of Turek and Hron, doi:10.1007/3-540-34596-5_15.

    Args:
        comm: communicator.
        length: of the channel; unit: length, as for all that follows.
        height: of the channel.
        center: of the cylinder, shape (2,).
        radius: of the cylinder.
        size: of the cells away from the cylinder.
        cylinder_size: of the cells at the cylinder and the beam, from where they grow; None: a quarter of ``size``,
            and at most half of the beam's thickness.
        wake_size: of the cells up to two radii from the axis between the cylinder and the outlet; None: not refined.
        beam: length, from the rearmost point of the cylinder to its tip, and thickness; its root is an arc of the
            cylinder. None: no beam.
        rigid: whether the beam does not move: then it has no cells, and its surface is the group "beam".
        depth: extent along the third axis, for tetrahedra or hexahedra over the plane cells; None: a plane mesh.
        cell: "triangle" or "quadrilateral", in the plane.
        equal_area: whether the polygon that stands for the cylinder has the area of the circle, instead of its vertices
            on it. Those that are of a beam as well stay where they are.

    Returns:
        Mesh with the groups of facets "inlet", "outlet", "walls" and "cylinder", and with a depth "back" and "front".
        With a beam "cylinder" is what the fluid touches; further groups are "beam_root" on the cylinder and "interface"
        between the groups of cells "fluid" and "solid", or "beam" alone if it is rigid.

    Raises:
        ValueError: another cell, a length that is not positive, cells that are to be larger at the cylinder or in the
            wake than away, a cylinder or a beam that is not within the channel, a beam that is not thinner than the
            cylinder, or a rigid beam that is none.
        RuntimeError: gmsh is in use.
    """
    x, y = _check_channel(length, height, center, radius, beam, depth)
    quadrilaterals = checks.choice("cell", cell, CELLS[2]) == "quadrilateral"
    checks.positive("size", size)
    if checks.flag("rigid", rigid) and beam is None:
        raise ValueError("rigid = True with beam = None: a beam's length and thickness are required")
    thin = size if beam is None else beam[1]
    fine = min(size / 4.0, thin / 2.0) if cylinder_size is None else checks.positive("cylinder_size", cylinder_size)
    wake = size if wake_size is None else checks.positive("wake_size", wake_size)
    for name, value in (("cylinder_size", fine), ("wake_size", wake)):
        if value > size:
            raise ValueError(f"{name} = {value!r}: a number up to size = {size!r} is required")
    tip = None if beam is None else (x + radius + beam[0], beam[1])
    around = Region("Ball", fine, {"Radius": radius, "XCenter": x, "YCenter": y})
    fields = [around, _zone(wake, x, length, y, 4.0 * radius)]
    if tip is not None:
        fields.append(_zone(fine, x, tip[0], y, tip[1]))

    def arrays() -> MeshArrays:
        with session() as gmsh:
            _build_channel(gmsh.model, (length, height), (x, y), radius, tip, rigid)
            set_sizes(gmsh, size, fields)
            if quadrilaterals:
                for option, value in QUADRILATERALS.items():
                    gmsh.option.setNumber(f"Mesh.{option}", value)
            plane = model_elements(gmsh, 2, "the channel").arrays()
        if equal_area:
            plane = replace(plane, x=_with_equal_area(plane, np.array([x, y]), radius))
        return plane if depth is None else extruded_arrays(plane, depth, int(np.ceil(depth / size - 1e-9)))

    return distributed(comm, arrays)


def _with_equal_area(plane: MeshArrays, center: FloatArray, radius: float) -> FloatArray:
    """Coordinates with the vertices of the cylinder moved away from its center, but those that a beam has as well.

    All chords together then have the area of their sectors. Those between two moved ends, one and none have the area
    ``a f^2 + b f + c`` in the factor ``f`` of their ends' distance from the center.
    """
    chords = np.concatenate([plane.facets[name] for name in ("cylinder", "beam_root") if name in plane.facets])
    moved = np.setdiff1d(chords, [plane.facets[name] for name in ("interface", "beam") if name in plane.facets])
    away = plane.x - center
    one, other = (away[chords[:, i]] for i in (0, 1))
    areas = np.abs(one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0]) / 2.0
    sectors = np.arctan2(2.0 * areas, (one * other).sum(axis=1)).sum() * radius**2 / 2.0
    ends = np.isin(chords, moved).sum(axis=1)
    a, b, c = (areas[ends == count].sum() for count in (2, 1, 0))
    factor = (np.sqrt(b**2 + 4.0 * a * (sectors - c)) - b) / (2.0 * a)
    x = plane.x.copy()
    x[moved] = center + factor * away[moved]
    return x


def _check_channel(
    length: float, height: float, center: Sequence[float], radius: float, beam: Any, depth: float | None
) -> tuple[float, float]:
    """Center of a cylinder that is, with its beam, within the channel."""
    lengths = {"length": length, "height": height, "radius": radius} | ({} if depth is None else {"depth": depth})
    for name, value in lengths.items():
        checks.positive(name, value)
    x, y = checks.array("center", center, (2,))
    if not min(x, length - x, y, height - y) > radius:
        raise ValueError(f"center = {center!r}: a cylinder of radius {radius:g} within the channel is required")
    if beam is not None:
        l, h = checks.array("beam", beam, (2,))
        longest, thickest = length - x - radius, 2.0 * radius
        if not (0.0 < l < longest and 0.0 < h < thickest):
            raise ValueError(
                f"beam = {beam!r}: a length in (0, {longest:g}) and a thickness in (0, {thickest:g}) are required"
            )
    return float(x), float(y)


def _zone(size: float, start: float, end: float, y: float, width: float) -> Region:
    """Rectangle of cells of a size, along the first axis."""
    return Region("Box", size, {"XMin": start, "XMax": end, "YMin": y - width / 2.0, "YMax": y + width / 2.0})


def _build_channel(
    model: Any,
    corner: tuple[float, float],
    center: tuple[float, float],
    radius: float,
    tip: tuple[float, float] | None,
    rigid: bool,
) -> None:
    """Geometry and groups; ``tip`` is where a beam ends along the first axis, and its thickness."""
    geo, (x, y) = model.geo, center
    corners = [geo.addPoint(a, b, 0.0) for a, b in ((0.0, 0.0), (corner[0], 0.0), corner, (0.0, corner[1]))]
    bottom, outlet, top, inlet = (geo.addLine(corners[i], corners[(i + 1) % 4]) for i in range(4))
    middle = geo.addPoint(x, y, 0.0)
    half = 0.0 if tip is None else np.arcsin(tip[1] / (2.0 * radius))
    angles = [half, np.pi / 2.0, np.pi, 3.0 * np.pi / 2.0, *([] if tip is None else [-half])]
    ring = [geo.addPoint(x + radius * np.cos(angle), y + radius * np.sin(angle), 0.0) for angle in angles]
    arcs = [geo.addCircleArc(a, middle, b) for a, b in zip(ring, [*ring[1:], ring[0]], strict=True)]
    facets, cells = {"inlet": [inlet], "outlet": [outlet], "walls": [bottom, top], "cylinder": arcs}, {}
    hole = arcs
    if tip is not None:
        *around, root = arcs
        path = [ring[-1], *(geo.addPoint(tip[0], y + s * tip[1] / 2.0, 0.0) for s in (-1.0, 1.0)), ring[0]]
        edges = [geo.addLine(a, b) for a, b in pairwise(path)]
        hole = [*around, *edges]
        facets["cylinder"] = around
        if rigid:
            geo.remove([(1, root)])
            facets["beam"] = edges
        else:
            facets |= {"beam_root": [root], "interface": edges}
            cells["solid"] = [geo.addPlaneSurface([geo.addCurveLoop([*edges, -root])])]
    fluid = geo.addPlaneSurface([geo.addCurveLoop([bottom, outlet, top, inlet]), geo.addCurveLoop(hole)])
    if cells:
        cells["fluid"] = [fluid]
    geo.synchronize()
    for dim, groups in ((1, facets), (2, cells)):
        for name, tags in groups.items():
            model.setPhysicalName(dim, model.addPhysicalGroup(dim, tags), name)


def set_sizes(gmsh: Any, size: float, regions: Sequence[Region]) -> None:
    """Cells of a size, which are smaller in regions and grow away from them.

    Args:
        gmsh: the module, with a model.
        size: of cells away from the regions; unit: length.
        regions: may be empty.
    """
    for option in ("MeshSizeExtendFromBoundary", "MeshSizeFromPoints", "MeshSizeFromCurvature"):
        gmsh.option.setNumber(f"Mesh.{option}", 0)
    gmsh.option.setNumber("Mesh.MeshSizeMax", size)
    if not regions:
        return
    field = gmsh.model.mesh.field
    tags = []
    for kind, small, shape in regions:
        tags.append(field.add(kind))
        for name, value in (shape | {"VIn": small, "VOut": size, "Thickness": (size - small) / GROWTH}).items():
            field.setNumber(tags[-1], name, float(value))
    smallest = field.add("Min")
    field.setNumbers(smallest, "FieldsList", tags)
    field.setAsBackgroundMesh(smallest)
