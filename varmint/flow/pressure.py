"""The constant of the pressure in a flow that nothing leaves: left to a null space, or pinned at a vertex."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from mpi4py import MPI
from dolfinx import fem

from tigar_x import checks, compat
from tigar_x.compat import FloatArray
from tigar_x.fem.linear import LinearSolver
from varmint.mesh.named import NamedMesh

NEAR = 1e-9
"""Relative to the size of the mesh, by how much a vertex may be farther than the nearest and count as nearest."""


def by_null_space(chosen: str, recipe: LinearSolver, *, immersed: bool = False) -> bool:
    """Whether an iterative solver leaves the constant alone, instead of a pin that fixes it.

    Args:
        chosen: see :class:`varmint.flow.options.FlowOptions`.
        recipe: linear solver.
        immersed: whether a surface is immersed, along which the pressure jumps; then it is pinned.

    Raises:
        ValueError: the null space is asked of a direct solver, or with an immersed surface.
    """
    if immersed:
        if chosen == "null space":
            raise ValueError("pressure = 'null space': 'pin' is required of a flow in which a surface is immersed")
        return False
    if chosen == "null space" and recipe.is_direct:
        raise ValueError(f"pressure = 'null space': an iterative solver is required, {recipe.name} is given")
    return chosen == "null space" or (chosen == "automatic" and not recipe.is_direct)


def pressure_pin(V: fem.FunctionSpace, mesh: NamedMesh, groups: Sequence[str], at: Sequence[float] | None) -> Any:
    """Strong condition p = 0 at a vertex of the fluid (collective).

    It depends on the mesh alone, not on its partition: of several vertices that are as near it is the one with the
    smallest coordinates, the first one first. A vertex that alone is nearest to the centroid turns with the mesh. Of
    several, as in a box with odd numbers of cells, no rule can choose one that does: the box is the same after a turn
    that exchanges them.

    Args:
        V: space of velocity and pressure.
        mesh: mesh.
        groups: cell groups of the fluid; none: all cells.
        at: point, the vertex next to it is taken, shape (d,); None: the centroid of the fluid. Unit: length.

    Returns:
        A dolfinx boundary condition.
    """
    domain = mesh.domain
    d, comm, owned = domain.geometry.dim, domain.comm, compat.owned_cells(domain)
    cells = mesh.cells(*groups) if groups else np.arange(owned)
    corners = compat.cell_vertices(domain)[cells[cells < owned]]
    target = _centroid(comm, corners) if at is None else checks.array("pin_at", at, (d,))
    vertices = corners.reshape(-1, d)
    ends = np.array(comm.allgather((vertices.min(axis=0, initial=np.inf), vertices.max(axis=0, initial=-np.inf))))
    near = NEAR * float((ends[:, 1].max(axis=0) - ends[:, 0].min(axis=0)).max())
    distance = np.linalg.norm(vertices - target, axis=1)
    least = comm.allreduce(float(distance.min(initial=np.inf)), op=MPI.MIN)
    found = comm.allgather(min(map(tuple, vertices[distance <= least + near].tolist()), default=None))
    place = np.array(min(vertex for vertex in found if vertex is not None))
    return compat.pin_component(V, d, lambda x: np.linalg.norm(x[:d].T - place, axis=1) < near)


def _centroid(comm: MPI.Comm, corners: FloatArray) -> FloatArray:
    """Centroid of cells with vertices of shape (cells, vertices, d), by their midpoints and sizes there (collective).

    Neither depends on the numbering of vertices.
    """
    count, d = corners.shape[1:]
    if count == d + 1:
        jacobians = corners[:, 1:] - corners[:, :1]
    else:
        signs = (np.arange(count)[:, None] >> np.arange(d) & 1) - 0.5
        jacobians = np.einsum("vj,cvi->cji", signs, corners)
    sizes = np.abs(np.linalg.det(jacobians))
    moments = np.append(sizes @ corners.mean(axis=1), sizes.sum())
    total = np.sum(comm.allgather(moments), axis=0)
    return np.asarray(total[:-1] / total[-1])
