"""The state of a flow on another mesh: interpolated at its nodes, wherever the ranks have them.

Nodes of one mesh are sent to those ranks whose cells of the other may contain them, and values come back, so that no
rank holds more than its share. Between meshes that are bisected from one base mesh the interpolation of linear
functions is exact where cells become smaller.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from dolfinx import fem, mesh

from coudalfish.surface.trace import INSIDE, PointLocator
from tigar_x import compat
from tigar_x.compat import FloatArray, IntArray
from tigar_x.fem.time_integration import TimeIntegrator

AT_NODE = 1e-9
"""By how much a barycentric coordinate may be below one where a point is a vertex."""


class PointsElsewhere:
    """Points of every rank in a mesh whose cells may be those of other ranks (collective).

    Args:
        source: mesh of triangles or tetrahedra.
        points: of this rank, shape (n, d); unit: length.

    Raises:
        ValueError: on all ranks: a point lies in no cell.
    """

    def __init__(self, source: mesh.Mesh, points: FloatArray) -> None:
        self._source, self._comm, self._count = source, source.comm, len(points)
        locator = PointLocator(source)
        corners = locator.corners.reshape(-1, points.shape[1])
        slack = INSIDE * float(np.abs(points).max(initial=1e-300))
        box = corners.min(axis=0, initial=np.inf) - slack, corners.max(axis=0, initial=-np.inf) + slack
        asked = [
            np.flatnonzero(((points >= low) & (points <= high)).all(axis=1)) for low, high in self._comm.allgather(box)
        ]
        of_others = self._comm.alltoall([points[chosen] for chosen in asked])
        cells = [locator.search(x) for x in of_others]
        answers = self._comm.alltoall([found >= 0 for found in cells])
        owner = np.full(len(points), self._comm.size)
        for rank in reversed(range(self._comm.size)):  # of several ranks that have found a point the lowest counts
            owner[asked[rank][answers[rank]]] = rank
        self._check(points, owner)
        self._asked = [chosen[owner[chosen] == rank] for rank, chosen in enumerate(asked)]
        taken = self._comm.alltoall([owner[chosen] == rank for rank, chosen in enumerate(asked)])
        self._cells = np.concatenate([found[mask] for found, mask in zip(cells, taken, strict=True)])
        x = np.concatenate([x[mask] for x, mask in zip(of_others, taken, strict=True)])
        self._ends = np.cumsum([int(mask.sum()) for mask in taken])[:-1]
        self._barycentric = locator.barycentric(self._cells, x)

    def _check(self, points: FloatArray, owner: IntArray) -> None:
        lost = points[owner == self._comm.size]
        found = [x for x in self._comm.allgather(lost[0].tolist() if len(lost) else None) if x]
        if found:
            raise ValueError(
                f"a node of the new mesh at {found[0]} is outside the old one: the same region is required"
            )

    def values(self, function: Callable[[IntArray, FloatArray], FloatArray]) -> FloatArray:
        """Values at this rank's points (collective), shape (n, any).

        Args:
            function: of cells and barycentric coordinates there, shapes (k,) and (k, d + 1), to values, (k, any).
        """
        of_others = self._comm.alltoall(np.split(function(self._cells, self._barycentric), self._ends))
        result = np.zeros((self._count, of_others[0].shape[1]))
        for chosen, values in zip(self._asked, of_others, strict=True):
            result[chosen] = values
        return result


def transfer(old: Any, new: Any) -> None:
    """Give a flow the last accepted state of another one, its clock and its step size (collective).

    Velocity, pressure and rate are interpolated; at nodes in divided cells they are those of the side on which a node
    lies, the rate as the mean of that side's nodes. Second blocks are continued as means of those around, so that
    nodes that become divided need not begin from zero. Dynamic sub-scales begin anew.

    Args:
        old: side of the fluid, see :class:`coudalfish.sides.fluid.FluidSubproblem`, between two steps.
        new: another one, of the same kind.

    Raises:
        ValueError: a node of the new mesh lies outside the old one.
    """
    time, V = new.timeInt, new.timeInt.x.function_space
    owned, m = V.dofmap.index_map.size_local, V.dofmap.index_map_bs
    x = V.tabulate_dof_coordinates()[:owned, : V.mesh.geometry.dim]
    values = PointsElsewhere(old.timeInt.x.function_space.mesh, x).values(_State(old, new.mesh_size))
    for function, columns in zip(_functions(time), np.split(values, values.shape[1] // m, axis=1), strict=True):
        function.x.array[: owned * m] = columns.ravel()
        function.x.scatter_forward()
    time.resume(old.timeInt.time, old.timeInt.step_size)


def _functions(time: TimeIntegrator) -> list[fem.Function]:
    """What is transferred of a flow's state."""
    state = time.state
    return [state[name] for name in ("x", "xdot", "second", "second_rate") if name in state]


class _State:
    """Values of a flow's state, one function after the other, as a function of places.

    Args:
        fluid: its side.
        length: in which kinks are to be measured; unit: length.
    """

    def __init__(self, fluid: Any, length: float) -> None:
        self._sides, self._time = fluid.sides, fluid.timeInt
        self._V = self._time.x.function_space
        self._nodes, self._scalar = compat.cell_dofs(self._V), fluid.velocity_space
        m = self._V.dofmap.index_map_bs
        self._fields = [function.x.array.reshape(-1, m) for function in _functions(self._time)]
        if self._sides is not None:
            self._is_second = self._time.is_second.reshape(-1, m)
            self._scale = np.ones(m)
            self._scale[:-1] = length / float(self._sides.length.value)

    def __call__(self, cells: IntArray, barycentric: FloatArray) -> FloatArray:
        """Values, shape (n, functions * components)."""
        nodes = self._nodes[cells]
        weights = compat.tabulate(self._scalar, barycentric[:, 1:])
        if self._sides is None:
            return np.hstack([np.einsum("nk,nkm->nm", weights, field[nodes]) for field in self._fields])
        first, rate, *second = self._fields
        x, x_dot = (np.einsum("nk,nkm->nm", weights, field[nodes]) for field in (first, rate))
        # a node on the surface has its own value, on whichever side rounding sees it
        there = np.flatnonzero(self._sides.is_divided(cells) & (barycentric.max(axis=1) < 1.0 - AT_NODE))
        if len(there):
            here, at = cells[there], barycentric[there]
            s = self._sides.side(here, at)
            x[there] = self._sides.at(here, at, s)
            same = at * (self._sides.doubled.side[nodes[there]] == s[:, None])
            x_dot[there] = _mean(same[:, :, None], rate[nodes[there]])
        of_second = weights[:, :, None] * self._is_second[nodes]
        return np.hstack([x, x_dot, *(self._scale * _mean(of_second, field[nodes]) for field in second)])


def _mean(weights: FloatArray, values: FloatArray) -> FloatArray:
    """Means with weights, zero where these vanish; shapes (n, nodes, components or 1) and (n, nodes, components)."""
    total = weights.sum(axis=1)
    means = (weights * values).sum(axis=1) / np.where(total > INSIDE, total, 1.0)
    return np.asarray(np.where(total > INSIDE, means, 0.0))
