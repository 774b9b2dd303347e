"""What pictures of a plane flow need: nodal values on triangles, gathered on rank 0, and streamlines.

matplotlib is loaded by the functions that draw.
"""

from collections.abc import Iterable
from functools import cached_property
from typing import Any

import numpy as np
from dolfinx import fem

from tigar_x import compat
from tigar_x.compat import FloatArray
from tigar_x.fem.simplices import Sided
from tigar_x.ranks import gathered
from tigar_x.run.figure import Panel, axis_label
from tigar_x.run.pictures import Colours


class PlaneField:
    """Nodal values of a field on triangles in the plane (collective to make; whole on rank 0, empty elsewhere).

    Args:
        function: in a scalar or blocked Lagrange space; in space the nodes with the smallest third coordinate count.
        displacement: of the mesh; None: none.
        sides: what makes the function differ on both sides of a line through cells, such as ``flow.sides``; None:
            nothing. Further nodes are then on both sides of that line, and triangles end there; in the plane only.

    Attributes:
        x: positions, shape (nodes, 2).
        values: shape (nodes, components).
        triangles: nodes of each, shape (triangles, 3).

    Raises:
        ValueError: the sides are those of another function.
    """

    def __init__(
        self, function: fem.Function, displacement: fem.Function | None = None, sides: Sided | None = None
    ) -> None:
        V, found = function.function_space, nodal_values(function, displacement)
        self.x, self.values = np.zeros((0, 2)), np.zeros((0, V.dofmap.index_map_bs))
        self.triangles = np.zeros((0, 3), dtype=int)
        pieces = None if sides is None or V.mesh.geometry.dim == 3 else _pieces(function, sides)
        if found is None:
            return
        nodes, self.values, cells = found
        self.x = nodes[:, :2]
        if V.mesh.geometry.dim == 2:
            self.triangles = cells if cells.shape[1] == 3 else np.concatenate([cells[:, :3], cells[:, [0, 2, 3]]])
            self._whole = len(self.x), self.triangles
            if pieces is not None:
                self._divide(*pieces)
            return
        from scipy.spatial import Delaunay

        plane = np.isclose(nodes[:, 2], nodes[:, 2].min())
        self.x, self.values = self.x[plane], self.values[plane]
        self.triangles = Delaunay(self.x).simplices
        self._whole = len(self.x), self.triangles

    def _divide(self, x: FloatArray, values: FloatArray, divided: Any) -> None:
        """Put pieces in the place of triangles, arguments as :func:`_pieces` gives them."""
        more = len(self.x) + np.arange(len(x)).reshape(-1, 3)
        self.x, self.values = np.concatenate([self.x, x]), np.concatenate([self.values, values])
        self.triangles = np.concatenate([self.triangles[~divided], more])

    def shade(self, axes: Any, values: FloatArray, colours: Colours, *, length: str, **style: Any) -> None:
        """Draw nodal values as colours with a bar.

        Args:
            axes: of matplotlib.
            values: shape (nodes,).
            colours: what they show, and how.
            length: unit of the positions.
            style: passed on to ``tripcolor``.
        """
        low, high = colours.ends(values)
        limits = {"vmin": low, "vmax": high, "cmap": colours.palette}
        look = {"rasterized": True, "shading": "gouraud"} | limits | style
        shade = axes.tripcolor(self._triangulation, values, **look)
        colours.bar(axes, values, mappable=shade)
        (left, bottom), (right, top) = self.x.min(axis=0), self.x.max(axis=0)
        axes.set(aspect="equal", xlim=(left, right), ylim=(bottom, top))
        axes.set(xlabel=axis_label("$x_1$", length), ylabel=axis_label("$x_2$", length))

    def streamlines(self, axes: Any, samples: int = 80, **style: Any) -> None:
        """Draw streamlines of the first two components.

        Args:
            axes: of matplotlib.
            samples: along the longer side.
            style: passed on to ``streamplot``.
        """
        from matplotlib.tri import LinearTriInterpolator, Triangulation

        low, high = self.x.min(axis=0), self.x.max(axis=0)
        counts = np.maximum((samples * (high - low) / (high - low).max()).astype(int), 2)
        lines = [np.linspace(a, b, count) for a, b, count in zip(low, high, counts, strict=True)]
        grid = np.meshgrid(*lines)
        nodes, triangles = self._whole
        whole = Triangulation(*self.x[:nodes].T, triangles)
        u, v = (LinearTriInterpolator(whole, self.values[:nodes, i])(*grid) for i in (0, 1))
        axes.streamplot(*lines, u, v, **({"color": "0.25", "linewidth": 0.6, "arrowsize": 0.7} | style))

    @cached_property
    def _triangulation(self) -> Any:
        from matplotlib.tri import Triangulation

        return Triangulation(*self.x.T, self.triangles)

    def panel(
        self,
        values: FloatArray,
        colours: Colours,
        *,
        length: str,
        title: str = "",
        density: float = 0.0,
        immersed: Iterable[FloatArray] = (),
        **style: Any,
    ) -> Panel:
        """Panel of nodal values as colours, with streamlines of the first two components and immersed curves.

        Args:
            values: shape (nodes,).
            colours: what they show, and how.
            length: unit of the positions.
            title: above.
            density: of the streamlines; 0: none.
            immersed: points of curves that are drawn above all, such as shells, shape (m, 2) each; of more coordinates
                the first two count.
            style: passed on to ``tripcolor``.
        """
        curves = [np.asarray(curve)[:, :2] for curve in immersed]

        def panel(axes: Any) -> None:
            self.shade(axes, values, colours, length=length, **style)
            if density:
                self.streamlines(axes, density=density)
            for curve in curves:
                axes.plot(*curve.T, "k-", linewidth=2.0)
            axes.set_title(title)

        return panel

    def speed(self, unit: str, *, length: str, **more: Any) -> Panel:
        """Panel of the length of the first two components, in a unit, see :meth:`panel`."""
        return self.panel((self.values[:, :2] ** 2).sum(axis=1) ** 0.5, Colours("speed", unit), length=length, **more)

    def signed(self, what: str, unit: str, *, length: str, share: float = 1.0, **more: Any) -> Panel:
        """Panel of the last component in colours that tell its sign, see :meth:`panel`.

        Args:
            what: what it is, such as the pressure of a flow, or a vorticity.
            unit: in which unit.
            length: unit of the positions.
            share: of the largest magnitude, at which the colours end.
            more: see :meth:`panel`.
        """
        values = self.values[:, -1]
        end = share * float(np.abs(values).max(initial=0.0)) or 1.0
        return self.panel(values, Colours(what, unit, -end, end, "RdBu_r"), length=length, **more)


def _pieces(function: fem.Function, sides: Sided) -> tuple[FloatArray, FloatArray, Any] | None:
    """On rank 0 vertices of pieces of triangles, values there, and which triangles they replace (collective)."""
    if sides.function is not function:
        raise ValueError(f"sides: those of {function.name} are required, they are those of {sides.function.name}")
    V, pieces = function.function_space, sides.pieces()
    x = V.tabulate_dof_coordinates()[compat.cell_dofs(V)[pieces.cells]][:, :, :2]
    divided = np.zeros(compat.owned_cells(V.mesh), dtype=bool)
    divided[pieces.cells] = True
    parts = (pieces.barycentric @ x).reshape(-1, 2), sides.of_pieces(pieces), divided
    points, values, where = (gathered(V.mesh.comm, part) for part in parts)
    return None if points is None else (points, values.reshape(len(points), -1), where)


def nodal_values(
    function: fem.Function, displacement: fem.Function | None = None
) -> tuple[FloatArray, FloatArray, Any] | None:
    """Nodal values of a field on linear cells (collective).

    Args:
        function: in a scalar or blocked Lagrange space.
        displacement: of the mesh; None: none.

    Returns:
        On rank 0 present positions, shape (nodes, 3), values, shape (nodes, components), and the nodes of the cells,
        see :func:`tigar_x.compat.subcells`; None elsewhere.
    """
    V = function.function_space
    comm = V.mesh.comm
    x = V.tabulate_dof_coordinates()
    values = function.x.array.reshape(-1, V.dofmap.index_map_bs)
    if displacement is not None:
        d = V.mesh.geometry.dim
        at_nodes = fem.Function(compat.lagrange_space(V.mesh, compat.lagrange_degree(V), d))
        at_nodes.interpolate(displacement)
        at_nodes.x.scatter_forward()
        moved = np.zeros_like(x)
        moved[compat.cell_dofs(V), :d] = at_nodes.x.array.reshape(-1, d)[compat.cell_dofs(at_nodes.function_space)]
        x = x + moved
    _, cells = compat.subcells(V)
    counts = comm.allgather(len(x))
    parts = comm.gather((x, values, cells + sum(counts[: comm.rank])))
    if parts is None:
        return None
    nodes, values, cells = (np.concatenate([part[i] for part in parts]) for i in range(3))
    # nodes of several ranks are one
    _, first, number = np.unique(np.round(nodes / np.ptp(nodes), 9), axis=0, return_index=True, return_inverse=True)
    return nodes[first], values[first], number.reshape(-1)[cells]
