"""Flows in space with the shells in them, which matplotlib cannot show: streamlines and surfaces of one speed.

Needs pyvista, which is no dependency of this package: ``pip install pyvista``. It draws without a window, and nothing
but geometry: bars and directions are those of other pictures.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from dolfinx import fem

from tigar_x import checks, compat
from tigar_x.compat import FloatArray
from tigar_x.ranks import on_root
from tigar_x.run.figure import Panel, axis_label
from tigar_x.run.pictures import Colours
from tigar_x.run.plane_field import nodal_values
from tigar_x.splines.pictures import Surface, View, framed

CELLS = {"tetra": 10, "hexahedron": 12}
"""VTK's numbers of cells."""
LOOK = {"show_scalar_bar": False, "smooth_shading": False}


def flow_scene(
    w: fem.Function,
    shown: Sequence[Surface] = (),
    *,
    colours: Colours,
    length: str,
    view: View | None = None,
    displacement: fem.Function | None = None,
    level: float | None = None,
    streamlines: int = 200,
    title: str = "",
    pixels: int = 900,
) -> Panel:
    """Panel of a flow in space: streamlines coloured by the speed, a surface of one speed, and shells (collective).

    Args:
        w: velocity in its first three components, in a blocked Lagrange space in three dimensions.
        shown: shells, each in its colour and opacity; values on them are not drawn.
        colours: of the speed.
        length: unit of length.
        view: from where; None: as others are seen.
        displacement: of the mesh; None: none.
        level: speed of a translucent surface; None: there is none.
        streamlines: number of points that they start from, within a ball about the middle; 0: none.
        title: above.
        pixels: of the longer side.

    Returns:
        A panel for :func:`tigar_x.run.figure.draw`.

    Raises:
        ImportError: on all ranks: pyvista is not installed.
        ValueError: the flow is not in space, or there is no unit.
    """
    V, eye = w.function_space, View() if view is None else view
    axis_label("length", length)
    if V.mesh.geometry.dim != 3 or V.dofmap.index_map_bs < 3:
        raise ValueError(f"w lies in {V.mesh.geometry.dim} dimensions: a velocity in space is required")
    checks.whole("streamlines", streamlines, 0)
    checks.whole("pixels", pixels, 2)
    field, kind = nodal_values(w, displacement), CELLS[compat.subcells(V)[0]]
    options = shown, colours, eye, level, streamlines, pixels
    rendered = on_root(V.mesh.comm, lambda: _render(field, kind, *options))

    def panel(axes: Any) -> None:
        picture, speed, low, high = rendered  # type: ignore[misc]  # rank 0 draws
        axes.imshow(picture, extent=(low[0], high[0], low[1], high[1]), interpolation="antialiased")
        framed(axes, low, high, eye, length)
        colours.bar(axes, speed)
        axes.set_title(title)

    return panel


def _render(
    field: Any,
    kind: int,
    shown: Sequence[Surface],
    colours: Colours,
    eye: View,
    level: float | None,
    streamlines: int,
    pixels: int,
) -> tuple[Any, FloatArray, FloatArray, FloatArray]:
    """The picture, the speeds, and the corners of the picture as they are seen."""
    from matplotlib.colors import to_rgb

    pyvista = _pyvista()
    seen = eye.seen(field[0])[:, :2]
    low, high = seen.min(axis=0), seen.max(axis=0)
    margin = 0.01 * (high - low).max()
    low, high = low - margin, high + margin
    window = [int(n) for n in np.ceil(pixels * (high - low) / (high - low).max())]
    plotter = pyvista.Plotter(off_screen=True, window_size=window)
    plotter.set_background("white")
    grid = _grid(pyvista, field, kind)
    _add_flow(plotter, grid, colours, level, streamlines)
    for surface in shown:
        plotter.add_mesh(_quads(pyvista, surface), color=list(to_rgb(surface.colour)), opacity=surface.opacity, **LOOK)
    middle = np.array([*(low + high) / 2.0, eye.seen(grid.center)[2]]) @ eye.axes
    plotter.camera_position = [middle + 3.0 * grid.length * eye.axes[2], middle, eye.axes[1]]
    plotter.enable_parallel_projection()
    plotter.camera.parallel_scale = (high - low)[1] / 2.0
    plotter.camera.clipping_range = (grid.length, 5.0 * grid.length)
    picture = np.array(plotter.screenshot(return_img=True))
    plotter.close()
    return picture, np.asarray(grid["speed"]), low, high


def _pyvista() -> Any:
    try:
        import pyvista
    except ImportError as error:
        raise ImportError("flow_scene needs pyvista, which is not installed: pip install pyvista") from error
    return pyvista


def _grid(pyvista: Any, field: Any, kind: int) -> Any:
    """Velocity and speed on cells."""
    x, values, cells = field
    numbered = np.column_stack([np.full(len(cells), cells.shape[1]), cells])
    grid = pyvista.UnstructuredGrid(numbered.ravel(), np.full(len(cells), kind, dtype=np.uint8), x)
    grid["velocity"] = values[:, :3]
    grid["speed"] = np.linalg.norm(values[:, :3], axis=1)
    return grid


def _quads(pyvista: Any, surface: Surface) -> Any:
    """A shell as quadrilaterals."""
    n = len(surface.corners)
    numbered = np.column_stack([np.full(n, 4), np.arange(4 * n).reshape(-1, 4)])
    return pyvista.PolyData(surface.corners.reshape(-1, 3), numbered.ravel())


def _add_flow(plotter: Any, grid: Any, colours: Colours, level: float | None, streamlines: int) -> None:
    """Add the walls, streamlines and a surface of one speed."""
    plotter.add_mesh(grid, color="lightgray", opacity=0.15, **LOOK)
    parts = []
    if streamlines:
        parts.append((grid.streamlines("velocity", n_points=streamlines, source_radius=0.4 * grid.length), 1.0))
    if level is not None:
        parts.append((grid.contour([level], scalars="speed"), 0.4))
    for part, opacity in parts:
        if part.n_points:
            look = {"scalars": "speed", "clim": colours.ends(grid["speed"]), "cmap": colours.palette}
            plotter.add_mesh(part, opacity=opacity, line_width=1.5, **look, **LOOK)
