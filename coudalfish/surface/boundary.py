"""The boundary of a fluid in space, and where surfaces are attached to it.

A surface ends freely only inside the fluid. Where it ends on a wall, or beyond it, it goes on as far as sides are
concerned, and nothing flows around that edge. Edges come to walls and leave them as the surface moves.
"""

from dataclasses import replace

import numpy as np
from mpi4py import MPI
from dolfinx import mesh

from coudalfish.surface.facets import walls_of
from coudalfish.surface.interface import Sought
from coudalfish.surface.net import Net
from coudalfish.surface.sheets import Sheets
from coudalfish.surface.surfaces import Surfaces
from tigar_x import compat, ranks
from tigar_x.compat import FloatArray, IntArray


def boundary(domain: mesh.Mesh) -> Surfaces:
    """That of a mesh of tetrahedra, whole on every rank, with normals that point out of the fluid (collective).

    Args:
        domain: the mesh.
    """
    owned = compat.owned_cells(domain)
    cell, side = np.nonzero(walls_of(domain)[:owned, None] >> np.arange(4) & 1)
    vertices = np.array([np.delete(np.arange(4), opposite) for opposite in range(4)])[side]
    x = compat.cell_vertices(domain)[cell]
    a, b, c = (np.take_along_axis(x, vertices[:, k, None, None], 1)[:, 0] for k in range(3))
    inwards = x[np.arange(len(cell)), side] - a
    turned = np.einsum("fi,fi->f", np.cross(b - a, c - a), inwards) > 0.0
    vertices[turned] = vertices[turned][:, ::-1]
    number = compat.global_nodes(domain)[0][compat.cell_nodes(domain)[:, :4]][cell]
    found = np.take_along_axis(number, vertices, 1), np.take_along_axis(x, vertices[..., None], 1)
    numbers, points = (np.concatenate(part) for part in zip(*domain.comm.allgather(found), strict=True))
    _, first, cells = np.unique(numbers, return_index=True, return_inverse=True)
    return Surfaces(points.reshape(-1, 3)[first], Net(cells.reshape(-1, 3), np.arange(len(first))))


class Attaching:
    """How a shell hangs together that is attached to the boundary of a fluid where it is near that (collective).

    Args:
        domain: the fluid's mesh, which does not move.
        sheets: how the cells of the shell hang together.
        reach: distance from the boundary that counts as none; unit: length.
    """

    def __init__(self, domain: mesh.Mesh, sheets: Sheets, reach: float) -> None:
        self._domain, self._walls, self._reach = domain, boundary(domain), reach
        self._free = self._net = Net.of(sheets)

    def __call__(self, x: FloatArray) -> Net:
        """By the positions of its points, the same on every rank, shape (points, 3); unit: length (collective)."""
        surface = Surfaces(x, self._free)
        now = attached(surface, self._walls, self._reach, self._domain.comm)
        if not np.array_equal(now, np.empty((0, 2)) if self._net.attached is None else self._net.attached):
            self._net = replace(self._free, attached=now)
        return self._net


def attached(surface: Surfaces, walls: Surfaces, reach: float, comm: MPI.Comm) -> IntArray:
    """Edges at which a surface ends on the boundary of a fluid or beyond it (collective).

    An edge that leads from one wall to another through the fluid is not attached.

    Args:
        surface: the surface.
        walls: the boundary, whose normals point out of the fluid, or a part of it.
        reach: distance from it that counts as none; unit: length.
        comm: ranks that have both, each of which looks at some of the edges.

    Returns:
        Places at their ends, see :class:`coudalfish.surface.net.Net`, shape (attached, 2).
    """
    net = surface.net
    ends = net.at_ends
    size = float(np.linalg.norm(np.ptp(np.concatenate([surface.span, walls.span]), axis=0)))
    bounds = len(ends.points) * np.arange(comm.size + 1) // comm.size

    def found() -> FloatArray:
        mine = slice(*bounds[comm.rank : comm.rank + 2])
        a, b = surface.x[ends.points[mine].T]
        x = np.concatenate([a, b, 0.5 * (a + b)])
        near, result = walls.nearest(x, Sought(np.arange(len(x)), size)), np.zeros(len(ends.points))
        result[mine] = (near.signed_distance() <= reach).reshape(3, -1).all(axis=0)  # negative beyond
        return result

    there = ranks.summed(comm, len(ends.points), found) > 0.0
    return np.asarray(net.edge_places[net.edges[ends.triangle, ends.corner][there]])
