"""Pictures of shells: curves in the plane, surfaces in space, with a scale of length and of colours.

Surfaces are seen from far away, so that lengths across the line of sight are true and one bar of length serves the
whole picture. All faces are sorted by their distance from the eye together, so that of several surfaces the nearer one
hides the farther one. Where faces are long and meet at sharp angles, take a finer net.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI
from dolfinx import fem
from numpy.typing import ArrayLike

from tigar_x import checks
from tigar_x.compat import FloatArray
from tigar_x.run.figure import SCALE, Panel, axis_label, draw
from tigar_x.run.pictures import Colours
from tigar_x.splines.sampling import Sampling

LIGHT = np.array([-0.35, 0.45, 0.82])
"""Where the light comes from: to the right, upwards and to the eye."""
PLAIN = ((0.16, 0.42, 0.72), (0.85, 0.30, 0.20), (0.25, 0.60, 0.35), (0.60, 0.40, 0.70))
"""Colours of surfaces that show no field, one after the other."""


@dataclass(frozen=True)
class View:
    """From where a scene is seen, as matplotlib counts it.

    Attributes:
        elevation: angle of the eye above the plane of the first two axes; unit: degrees.
        azimuth: angle of the eye about the third axis, from the first; unit: degrees.
    """

    elevation: float = 25.0
    azimuth: float = -60.0

    def __post_init__(self) -> None:
        checks.within("elevation", self.elevation, -90.0, 90.0)
        checks.finite("azimuth", self.azimuth)

    @cached_property
    def axes(self) -> FloatArray:
        """Directions to the right, upwards and to the eye, shape (3, 3)."""
        e, a = np.radians([self.elevation, self.azimuth])
        eye = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
        right = np.array([-np.sin(a), np.cos(a), 0.0])
        return np.array([right, np.cross(eye, right), eye])

    def seen(self, x: ArrayLike) -> FloatArray:
        """Coordinates to the right, upwards and to the eye, of the same shape (..., 3) as the positions."""
        return np.asarray(x, dtype=float) @ self.axes.T


@dataclass(frozen=True, eq=False)
class Surface:
    """A surface that is to be drawn.

    Attributes:
        corners: of quadrilaterals, shape (faces, 4, 3); unit: length.
        values: of a field on the faces, shape (faces,); None: one colour.
        colour: of matplotlib, where there are no values.
        opacity: 0 (not seen) to 1.
    """

    corners: FloatArray
    values: FloatArray | None = None
    colour: Any = PLAIN[0]
    opacity: float = 1.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "corners", checks.array("corners", self.corners, (None, 4, 3)))
        if self.values is not None:
            object.__setattr__(self, "values", checks.array("values", self.values, (len(self.corners),)))
        checks.within("opacity", self.opacity, 0.0, 1.0)

    @classmethod
    def of_net(cls, x: ArrayLike, values: ArrayLike | None = None, **style: Any) -> "Surface":
        """A surface from points on a net, with the means of four values on its faces.

        Args:
            x: positions, shape (m, n, 3); unit: length.
            values: of a field, shape (m, n); None: one colour.
            style: ``colour`` and ``opacity``.
        """
        net = checks.array("x", x, (None, None, 3))
        if values is None:
            return cls(_corners(net), **style)
        field = checks.array("values", values, net.shape[:2])
        return cls(_corners(net), _corners(field).mean(axis=1), **style)


def _corners(net: FloatArray) -> FloatArray:
    """What a net has at the corners of its faces, shape (faces, 4, ...)."""
    around = (net[:-1, :-1], net[1:, :-1], net[1:, 1:], net[:-1, 1:])
    return np.stack(around, axis=2).reshape(-1, 4, *net.shape[2:])


def surfaces(net: Sampling, y: fem.Function | None = None, field: Any = None) -> list[Surface]:
    """The patches of a shell, each in a colour of its own where there is no field (collective).

    Args:
        net: points on nets, see :func:`tigar_x.splines.sampling.net`.
        y: homogeneous displacement; None: none.
        field: scalar, as :meth:`tigar_x.splines.sampling.Sampling.values` takes it; None: none.

    Raises:
        ValueError: the points are on no nets in space, or the field has several components.
    """
    if len(net.shape) not in (2, 3) or net.spline.nsd != 3:
        raise ValueError(f"net has the shape {net.shape}, in {net.spline.nsd} dimensions: nets in space are required")
    patches = net.positions(y).reshape(-1, *net.shape[-2:], 3)
    if field is None:
        return [Surface.of_net(x, colour=PLAIN[k % len(PLAIN)]) for k, x in enumerate(patches)]
    values = net.values(field)
    if values.shape != net.shape:
        raise ValueError(f"field has {values.shape[-1]} components: a scalar is required")
    return [Surface.of_net(x, v) for x, v in zip(patches, values.reshape(patches.shape[:3]), strict=True)]


def scene(
    shown: Sequence[Surface],
    *,
    length: str,
    view: View = View(),
    colours: Colours | None = None,
    lines: Sequence[ArrayLike] = (),
    box: ArrayLike | None = None,
    bar: bool = True,
    title: str = "",
) -> Panel:
    """Panel of surfaces and lines as they are seen from far away, with a bar of length and the directions of the axes.

    Args:
        shown: the surfaces.
        length: unit of length.
        view: from where.
        colours: of the fields; None: no surface has values.
        lines: points of lines in space, shape (m, 3) each; unit: length.
        box: lowest and highest corner of what the picture has room for besides all that is drawn, shape (2, 3), so
            that those of a movie agree; None: nothing.
        bar: whether to draw the bar of colours, where there are values.
        title: above.

    Raises:
        ValueError: no surface and no line, values without colours, or no unit.
    """
    axis_label("length", length)
    fields = [surface.values for surface in shown if surface.values is not None]
    if fields and colours is None:
        raise ValueError("colours = None: surfaces with values are shown by a scale of colours")
    segments = [np.stack([x[:-1], x[1:]], axis=1) for x in map(np.asarray, lines)]
    if not shown and not segments:
        raise ValueError("shown is empty: one surface or line is required")
    values = np.concatenate([np.zeros(0), *fields])

    def panel(axes: Any) -> None:
        scale = colours.mappable(values) if colours is not None and fields else None
        corners = np.concatenate(_draw_polygons(axes, shown, segments, view, scale))
        room = corners if box is None else np.concatenate([corners, view.seen(_box_corners(box))[:, :2]])
        framed(axes, room.min(axis=0), room.max(axis=0), view, length)
        if bar and colours is not None and fields:
            colours.bar(axes, values)
        axes.set_title(title)

    return panel


def _draw_polygons(
    axes: Any, shown: Sequence[Surface], segments: Sequence[FloatArray], view: View, scale: Any
) -> list[FloatArray]:
    """Draw all faces and segments, the nearest last; their corners in the picture."""
    from matplotlib.collections import PolyCollection

    polygons: list[FloatArray] = []
    paints, edges, depths = [], [], []
    for surface in shown:
        corners = view.seen(surface.corners)
        polygons.extend(corners[:, :, :2])
        paints.append(_paint(surface, corners, scale))
        edges.append(paints[-1] * (1.0, 1.0, 1.0, float(surface.opacity == 1.0)))
        depths.append(corners[:, :, 2].mean(axis=1))
    size = float(np.ptp(np.concatenate([*depths, *(view.seen(x)[..., 2].ravel() for x in segments)])))
    for ends in map(view.seen, segments):
        polygons.extend(ends[:, :, :2])
        paints.append(np.zeros((len(ends), 4)))
        edges.append(np.tile((0.15, 0.15, 0.15, 1.0), (len(ends), 1)))
        depths.append(ends[:, :, 2].mean(axis=1) + 0.01 * size)  # a line on a surface is before it
    order = np.argsort(np.concatenate(depths))
    widths = np.repeat([0.5, 0.9], [sum(map(len, paints[: len(shown)])), sum(map(len, segments))])
    axes.add_collection(
        PolyCollection(
            [polygons[i] for i in order],
            facecolors=np.concatenate(paints)[order],
            edgecolors=np.concatenate(edges)[order],
            linewidths=widths[order],
            closed=True,
        )
    )
    return polygons


def _paint(surface: Surface, corners: FloatArray, scale: Any) -> FloatArray:
    """Shaded colours of the faces, shape (faces, 4)."""
    from matplotlib.colors import to_rgb

    normals = np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
    sizes = np.maximum(np.linalg.norm(normals, axis=1), np.finfo(float).tiny)
    bright = np.abs(normals @ LIGHT) / (sizes * np.linalg.norm(LIGHT))
    if surface.values is None:
        colours, light = np.tile(to_rgb(surface.colour), (len(corners), 1)), 0.5 + 0.5 * bright
    else:  # whose colours are to be found on their bar
        colours, light = np.asarray(scale.to_rgba(surface.values)), 0.75 + 0.25 * bright
    return np.asarray(np.column_stack([colours[:, :3] * light[:, None], np.full(len(corners), surface.opacity)]))


def _box_corners(box: ArrayLike) -> FloatArray:
    ends = checks.array("box", box, (2, 3))
    return np.stack(np.meshgrid(*ends.T, indexing="ij"), axis=-1).reshape(-1, 3)


def framed(axes: Any, low: FloatArray, high: FloatArray, view: View, length: str) -> None:
    """Make room for a picture, a bar of length below it on the right, and the directions of the axes on the left.

    Args:
        axes: of matplotlib.
        low: lower left corner of what is seen, shape (2,); unit: length.
        high: upper right corner.
        view: from where it is seen.
        length: unit of length.
    """
    width, height = np.maximum(high - low, 1e-3 * float((high - low).max() or 1.0))
    extent = max(width, height)
    margin, below = 0.03 * extent, 0.16 * extent
    axes.set(xlim=(low[0] - margin, high[0] + margin), ylim=(low[1] - below - margin, high[1] + margin))
    axes.set(aspect="equal", xticks=(), yticks=())
    axes.set_axis_off()
    bar = nice_length(0.3 * width)
    right, y = high[0], low[1] - 0.55 * below
    axes.plot((right - bar, right), (y, y), "k-", linewidth=2.0, solid_capstyle="butt")
    text = axes.text(right - bar / 2, y - 0.08 * below, f"{bar:g} {length}", ha="center", va="top", fontsize="small")
    text.set_gid(SCALE)
    start, reach = np.array([low[0] + 0.5 * below, low[1] - 0.6 * below]), 0.4 * below
    directions = view.axes[:2].T
    for i, direction in enumerate(directions):
        seen = float(np.linalg.norm(direction))
        if seen < 0.25:
            continue  # along the line of sight
        tip = start + reach * direction
        axes.annotate("", tip, start, arrowprops={"arrowstyle": "->", "linewidth": 0.8, "shrinkA": 0, "shrinkB": 0})
        beside = np.array([-direction[1], direction[0]])
        beside *= -np.sign(beside @ (directions.sum(axis=0) - direction)) or 1.0
        place = tip + 0.45 * reach * (direction if seen > 0.6 else beside) / seen  # a short one may lie along another
        axes.text(*place, f"$x_{i + 1}$", ha="center", va="center", fontsize="x-small")


def nice_length(most: float) -> float:
    """The largest of 1, 2 and 5 times a power of ten that is not longer."""
    power = 10.0 ** np.floor(np.log10(checks.positive("most", most)))
    return float(power * max(n for n in (1.0, 2.0, 5.0) if n * power <= most * (1.0 + 1e-12)))


def draw_shell(
    path: Path,
    shown: Sequence[Surface],
    *,
    length: str,
    colours: Colours | None = None,
    views: Sequence[View] = (View(),),
    lines: Sequence[ArrayLike] = (),
    box: ArrayLike | None = None,
    title: str = "",
    size: float = 4.6,
    dpi: int = 100,
    comm: MPI.Comm = MPI.COMM_WORLD,
) -> None:
    """A picture of surfaces from one or more sides, with one bar of colours (collective).

    Args:
        path: of the picture.
        shown: the surfaces, see :func:`surfaces`.
        length: unit of length.
        colours: of the fields; None: there are none.
        views: from where, one picture each.
        lines: points of lines in space, shape (m, 3) each; unit: length.
        box: see :func:`scene`.
        title: above all.
        size: width and height of each picture in inches.
        dpi: pixels per inch.
        comm: communicator.
    """
    if not views:
        raise ValueError("views is empty: one or more is required")
    look: dict[str, Any] = {"length": length, "colours": colours, "lines": lines, "box": box}
    panels = [scene(shown, view=view, bar=view is views[-1], **look) for view in views]
    draw(path, *panels, columns=len(panels), size=(size, size), title=title, dpi=dpi, comm=comm)


def family(
    curves: Sequence[ArrayLike],
    *,
    length: str,
    colours: Colours | None = None,
    values: ArrayLike | None = None,
    coordinates: tuple[int, int] = (0, 1),
    title: str = "",
    **style: Any,
) -> Panel:
    """Panel of curves in a plane at one scale, such as a beam or a section under growing load.

    Args:
        curves: points of each, shape (m, d); unit: length.
        length: unit of length.
        colours: of the values, with a bar; None: one after the other.
        values: of every curve, such as its load, shape (curves,).
        coordinates: which coordinates are drawn to the right and upwards.
        title: above.
        style: passed on to ``plot``.

    Raises:
        ValueError: colours without values or values without colours, or no unit.
    """
    if (colours is None) != (values is None):
        raise ValueError("colours and values belong together: both or neither is required")
    numbers = np.zeros(0) if values is None else checks.array("values", values, (len(curves),))
    right, up = (axis_label(f"$x_{i + 1}$", length) for i in coordinates)

    def panel(axes: Any) -> None:
        paints = None if colours is None else colours.mappable(numbers).to_rgba(numbers)
        for i, curve in enumerate(curves):
            own = {} if paints is None else {"color": paints[i]}
            axes.plot(*np.asarray(curve)[:, coordinates].T, **({"linewidth": 1.3} | own | style))
        axes.set(aspect="equal", xlabel=right, ylabel=up, title=title)
        axes.grid(True, linewidth=0.4)
        if colours is not None:
            colours.bar(axes, numbers)

    return panel
