"""A flow whose fields differ on both sides of the surface, as the coupling sees it."""

from collections.abc import Callable
from functools import partial
from typing import Any, Protocol

import numpy as np
import ufl
from dolfinx import fem

from coudalfish.sides.fluid import FluidSubproblem
from coudalfish.surface.cut_cells import CutCells
from coudalfish.surface.enriched import Enrichment
from coudalfish.surface.meeting import Meeting
from coudalfish.surface.sheets import Sheets
from coudalfish.surface.trace import TraceMatrix
from tigar_x import compat
from tigar_x.compat import FloatArray, IntArray
from tigar_x.fem.divided import Doubled
from tigar_x.fem.doubled import DoubledSystem
from tigar_x.fem.linear import LinearSolver, gmres_ilu, two_level


class FluidSides(Protocol):
    """What differs on both sides of a surface, such as varmint's ``Flow(..., immersed="jump and kink").sides``.

    Attributes:
        is_kinked: whether velocities are kinked; pressures always jump.
        phi: linear function of which the surface is the zero line.
        size: linear function with its sizes at the nodes.
        length: in which kinks measure both.
        negative: weight of the negative side in divided cells, a quadratic function in each.
        wall: the same on their facets on the boundary.
        carried: velocities of the surface at the nodes, and the same times the signs of phi there; empty without kinks.
        doubled: equations of divided cells, and what is divided.
        given: force that the surface gives to the nodes, into the rows of the unknown, this rank's share.
    """

    is_kinked: bool
    phi: fem.Function
    size: fem.Function
    length: fem.Constant
    negative: fem.Function
    wall: fem.Function
    carried: tuple[fem.Function, ...]
    doubled: Doubled
    given: FloatArray

    def is_divided(self, cells: IntArray) -> Any:
        """Mask of those of some cells that are divided."""

    def nearest_divided(self, x: FloatArray, reach: float) -> IntArray:
        """Divided cells whose middles are nearest to points, -1 where none is in reach, shape (n,)."""

    def barycentric(self, cells: IntArray, x: FloatArray) -> FloatArray:
        """Barycentric coordinates of points in cells, or of points nearby, shape (n, d + 1)."""

    def side(self, cells: IntArray, barycentric: FloatArray) -> FloatArray:
        """Sides on which they lie, shape (n,)."""

    def at(self, cells: IntArray, barycentric: FloatArray, s: FloatArray) -> FloatArray:
        """Velocity and pressure there at the end of the step, each on a side, shape (n, d + 1)."""

    def mean_gradient_at(self, cells: IntArray, barycentric: FloatArray, s: float) -> FloatArray:
        """Gradient of the velocity on a side from means around nodes (collective), component first, (n, d, d)."""

    def integral(self, f: Callable[[Any, Any, Any], Any], degree: int = 4) -> float:
        """Integral over the flow at the end of the last step (collective).

        Args:
            f: UFL scalar of the velocity, the pressure and the side, -1 or 1 or, where no surface is near, 0.
            degree: of the quadrature.
        """


class Dividing(Protocol):
    """What finds out how a surface divides a mesh."""

    def __call__(
        self, meeting: Meeting, sheets: Sheets, x: FloatArray, v: FloatArray, load: Callable[[], FloatArray]
    ) -> tuple[Enrichment, Meeting]:
        """What is divided, and how the surface meets that (collective).

        Args:
            meeting: of the surface with the fluid where it is.
            sheets: how its points hang together.
            x: their positions, shape (points, d); unit: length.
            v: their velocities, same shape; unit: length/time.
            load: gives the multiplier that the step starts from, same shape; unit: force/area.
        """

    @property
    def nothing(self) -> Enrichment:
        """What there is without a surface."""

    def suits(self, load: Callable[[], FloatArray]) -> bool:
        """Whether what was divided last would be so under a load, too (collective); shape (points, d)."""

    def weights(self, cut: CutCells) -> FloatArray:
        """Weights of the negative side at nodes of the cells that are cut, shape (cut, nodes)."""

    def on_walls(self, cut: CutCells) -> tuple[IntArray, FloatArray]:
        """Those of them that have a facet on the boundary, and weights there, shape (found, nodes)."""


def dividing(
    space: fem.FunctionSpace, weights: fem.FunctionSpace, walls: fem.FunctionSpace, size: float, *, kinked: bool
) -> Dividing:
    """By the dimension of the flow: a plane one needs nothing of what one in space does.

    Args:
        space: see :class:`coudalfish.surface.divided_mesh.DividedMesh`, as for the others.
        weights: see there.
        walls: see there.
        size: see there.
        kinked: see there.
    """
    if space.mesh.geometry.dim == 2:
        from coudalfish.surface.in_plane import DividedPlane

        return DividedPlane(space, weights, walls, size, kinked=kinked)
    from coudalfish.surface.in_space import DividedSpace

    return DividedSpace(space, weights, walls, size, kinked=kinked)


class SidedFluid(FluidSubproblem):
    """A flow whose pressure jumps, and whose velocity may be kinked, at the surface.

    Args:
        sides: what differs.
        arguments: see :class:`coudalfish.sides.fluid.FluidSubproblem`; there is no band.
    """

    system: DoubledSystem

    def __init__(self, *arguments: Any, sides: FluidSides, **named: Any) -> None:
        self.sides = sides
        super().__init__(*arguments, **named)
        self._node = self.velocity_dofs[:, 0] // (self.mesh.geometry.dim + 1)
        self.trace_dofs = np.vstack([self.velocity_dofs, self.velocity_dofs + len(self.timeInt.x.x.array)])
        self.free = np.vstack([self.free, np.zeros_like(self.free)])
        spaces = self.velocity_space, sides.negative.function_space, sides.wall.function_space
        self._dividing = dividing(*spaces, self.mesh_size, kinked=sides.is_kinked)
        self._cells, self._wall_cells = (compat.cell_dofs(space) for space in spaces[1:])
        self._linear, self._blocks = np.empty((2, len(self._node)), dtype=np.int64)
        for f, numbers in ((sides.phi, self._linear), *((f, self._blocks) for f in sides.carried[:1])):
            numbers[compat.cell_dofs(self.velocity_space)] = compat.cell_dofs(f.function_space)
        sides.length.value = self.mesh_size
        self._found = self._dividing.nothing
        self._weighted = self._cells[:0], self._wall_cells[:0]  # dofs of weights that are not zero

    def _recipe(self, unknowns: int, *, blocked: bool) -> LinearSolver:
        """Iterative however small: what changes its unknowns from step to step cannot keep the analysis of factors.

        No stabilisation is scaled down here. In space a coarse level and the least fill take fewer iterations than
        more fill does, and half its set-up, which is due whenever other nodes are divided.
        """
        return two_level(0) if self.mesh.geometry.dim == 3 else gmres_ilu(1)

    def _make_system(self, residual: ufl.Form, bcs: Any, **options: Any) -> DoubledSystem:
        return DoubledSystem(residual, self.timeInt.x, bcs, self.sides.doubled, **options)

    def place(
        self,
        meeting: Meeting,
        sheets: Sheets,
        x: FloatArray,
        v: FloatArray,
        load: Callable[[], FloatArray],
        *,
        scale_m: float,
        scale_c: float,
    ) -> Meeting:
        """See :class:`coudalfish.sides.fluid.FluidSubproblem` (collective); there are no scales."""
        found, meets = self._dividing(meeting, sheets, x, v, load)
        self._divide(found)
        return meets

    def _divide(self, found: Enrichment) -> None:
        """Take over what the surface divides (collective)."""
        self._found, sides = found, self.sides
        phi = found.known
        sides.phi.x.array[self._linear], sides.size.x.array[self._linear] = phi, np.abs(phi)
        on_walls, of_walls = self._dividing.on_walls(found.cut)
        for dofs, weight in zip(self._weighted, (sides.negative, sides.wall), strict=True):
            weight.x.array[dofs] = 0.0
        self._weighted = self._cells[found.cut.cells], self._wall_cells[on_walls]
        sides.negative.x.array[self._weighted[0]] = self._dividing.weights(found.cut)
        sides.wall.x.array[self._weighted[1]] = of_walls
        d, n = self.mesh.geometry.dim, len(self._node)
        v = np.zeros((n, d)) if found.velocity is None else found.velocity
        for f, values in zip(sides.carried, (v, np.where(phi < 0.0, -1.0, 1.0)[:, None] * v), strict=False):
            f.x.array.reshape(-1, d)[self._blocks] = values
        second = np.zeros((n, d + 1), dtype=bool)
        kinks = found.kink[:, None] & self.free[:n]
        second[self._node, :d], second[self._node, d] = kinks, found.jump
        self.free[n:] = kinks
        side = np.ones(n)
        side[self._node[phi < 0.0]] = -1.0
        divided = np.zeros(len(self._cells), dtype=bool)
        divided[found.cut.cells] = True
        self.timeInt.is_second[:] = second.ravel()  # type: ignore[attr-defined]
        layout = self.system.layout
        self.system.divide(divided, second, side)
        if self.system.layout != layout:
            self._measure()

    def suits(self, load: Callable[[], FloatArray]) -> bool:
        """See :class:`coudalfish.sides.fluid.FluidSubproblem`."""
        return self._dividing.suits(load)

    def remember(self) -> Callable[[], None]:
        """See :class:`coudalfish.sides.fluid.FluidSubproblem`."""
        return partial(self._divide, self._found)

    def assemble_residual(
        self, trace: TraceMatrix, forces: FloatArray, impedance: float, beside: FloatArray | float = 0.0
    ) -> float:
        """See :class:`coudalfish.sides.fluid.FluidSubproblem`."""
        at_nodes, given = trace.nodes < len(self._node), self.sides.given
        given[:] = 0.0
        given[self.velocity_dofs[trace.nodes[at_nodes]]] = (trace.transposed @ forces + beside)[at_nodes]
        return super().assemble_residual(trace, forces, impedance, beside)

    def _levels(self) -> tuple[FloatArray, FloatArray]:
        time: Any = self.timeInt
        present, old = (time.x, time.second), (time.x_old, time.second_old)
        first, second = (np.concatenate([f.x.array for f in pair]) for pair in (present, old))
        return first, second

    def names(self, nodes: IntArray) -> IntArray:
        """See :class:`coudalfish.sides.fluid.FluidSubproblem`; kinks come after all nodes."""
        n, size = len(self._node), self.velocity_space.dofmap.index_map.size_global
        return np.where(nodes < n, super().names(nodes % n), super().names(nodes % n) + size)
