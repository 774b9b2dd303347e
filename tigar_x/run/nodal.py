"""Values at nodes and meshes, told apart without regard to how they are distributed over ranks.

A field is known by the places of its nodes, by which it finds them on any other partition with a k-d tree. A mesh is
known by counts, its box, and sums over its cells of waves about as long as a cell: what moves a vertex or turns a
diagonal changes them, another order of the cells does not.
"""

from functools import cached_property
from typing import Any

import numpy as np
from mpi4py import MPI
from dolfinx import fem, mesh
from scipy.spatial import cKDTree

from tigar_x import compat
from tigar_x.compat import FloatArray, IntArray

CLOSE = 1e-10
"""Distance within which two nodes are the same one, relative to the size of the mesh."""
SAME = 1e-9
"""Difference of box and waves, relative to the size and per cell, within which two meshes are the same one."""
WAVES = np.sqrt([[2.0, 3.0, 5.0, 7.0], [11.0, 13.0, 17.0, 19.0], [23.0, 29.0, 31.0, 37.0], [41.0, 43.0, 47.0, 53.0]])
"""Phases of the waves per cell, one row each, for three coordinates and the size of the cell."""


def wave_sums(z: FloatArray, count: int, comm: MPI.Comm = MPI.COMM_SELF) -> list[float]:
    """Means of waves at points, which depend on where all of them are but not on their order (collective).

    Args:
        z: this rank's points relative to the box of all, shape (points, at most 4).
        count: number of points on all ranks.
        comm: communicator.

    Returns:
        One number in [-1, 1] for each row of :data:`WAVES`.
    """
    phases = count ** (1.0 / max(z.shape[1], 1)) * z @ WAVES[:, : z.shape[1]].T
    return [float(x) / count for x in comm.allreduce(np.sin(phases).sum(axis=0), op=MPI.SUM)]


def fingerprint(domain: mesh.Mesh) -> dict[str, Any]:
    """What tells a mesh from others on any number of ranks (collective).

    Args:
        domain: mesh.

    Returns:
        Cell, dimension, numbers of cells and vertices, lower corner and size of its box, wave sums of its cells.
    """
    comm, topology = domain.comm, domain.topology
    x = compat.cell_vertices(domain)[: compat.owned_cells(domain)]
    ends = np.concatenate([x.min(axis=(0, 1), initial=np.inf), -x.max(axis=(0, 1), initial=-np.inf)])
    comm.Allreduce(MPI.IN_PLACE, ends, op=MPI.MIN)
    low, high = np.split(ends, 2)
    size, cells = float(np.linalg.norm(-high - low)), int(topology.index_map(topology.dim).size_global)
    middle = x.mean(axis=1)
    spread = np.sqrt(((x - middle[:, None]) ** 2).sum(axis=2).mean(axis=1))
    return {
        "cell": compat.cell_name(domain),
        "dimension": int(domain.geometry.dim),
        "cells": cells,
        "vertices": int(topology.index_map(0).size_global),
        "corner": low.tolist(),
        "size": size,
        "waves": wave_sums(np.column_stack([middle - low, spread]) / size, cells, comm),
    }


def difference(found: dict[str, Any], required: dict[str, Any]) -> str | None:
    """What makes one mesh another one.

    Args:
        found: fingerprint.
        required: fingerprint.

    Returns:
        The first difference in words; None: they are the same mesh.
    """
    for key in ("cell", "dimension", "cells", "vertices"):
        if found[key] != required[key]:
            what = key if key in ("cell", "dimension") else f"number of {key}"
            return f"{what} {found[key]} was found, {required[key]} is required"
    size = required["size"]
    box = np.subtract([*found["corner"], found["size"]], [*required["corner"], size])
    if not np.abs(box).max() <= SAME * size:
        place = f"a box at {found['corner']} of size {found['size']:.10g} was found"
        return f"{place}, one at {required['corner']} of size {size:.10g} is required"
    if not np.abs(np.subtract(found["waves"], required["waves"])).max() <= SAME:
        return "as many cells were found as are required, but they lie or are divided otherwise"
    return None


class Nodes:
    """The nodes of a scalar Lagrange space that this rank owns.

    Args:
        space: scalar space of two or more nodes, none in the same place.
        name: what it is, for errors.

    Attributes:
        comm: communicator of the mesh.
        count: number of nodes on all ranks.
        x: coordinates of this rank's nodes, shape (owned nodes, geometric dimension).

    Raises:
        ValueError: two nodes are in the same place, as in discontinuous spaces.
    """

    def __init__(self, space: fem.FunctionSpace, name: str) -> None:
        self.comm: MPI.Comm = space.mesh.comm
        index_map = space.dofmap.index_map
        self.count, d = int(index_map.size_global), space.mesh.geometry.dim
        local = space.tabulate_dof_coordinates()[:, :d]
        self.x: FloatArray = local[: index_map.size_local]
        ends = np.concatenate([local.min(axis=0, initial=np.inf), -local.max(axis=0, initial=-np.inf)])
        self.comm.Allreduce(MPI.IN_PLACE, ends, op=MPI.MIN)
        self.close = CLOSE * float(np.linalg.norm(ends[:d] + ends[d:]))
        apart = len(local) < 2 or bool(cKDTree(local).query(local, k=2)[0][:, 1].min() > 2.0 * self.close)
        if not self.comm.allreduce(apart, op=MPI.LAND):
            raise ValueError(f"{name}: nodes in the same place, which cannot be told apart in a checkpoint")

    def find(self, x: FloatArray) -> tuple[IntArray, IntArray]:
        """Which of these nodes are among others.

        Args:
            x: coordinates of the others, shape (nodes, geometric dimension).

        Returns:
            Numbers of nodes that this rank owns, and of the others in the same places.
        """
        none = np.empty(0, dtype=np.int32)
        if not len(self.x) or not len(x) or x.shape[1] != self.x.shape[1]:
            return none, none
        low, high = self.x.min(axis=0) - self.close, self.x.max(axis=0) + self.close
        others = np.flatnonzero(((x >= low) & (x <= high)).all(axis=1))
        distance, here = self._tree.query(x[others], distance_upper_bound=2.0 * self.close)
        found = distance <= self.close
        return here[found].astype(np.int32), others[found].astype(np.int32)

    @cached_property
    def _tree(self) -> cKDTree:
        return cKDTree(self.x)


def matching(x: FloatArray, others: FloatArray, close: float) -> IntArray:
    """Where each of some points is among the nodes of a mesh.

    Args:
        x: the nodes, shape (nodes, d); unit: length.
        others: the points in any order, shape (nodes, d).
        close: distance within which two are the same.

    Returns:
        The number among the nodes of every point.

    Raises:
        ValueError: their number or their places differ.
    """
    if len(others) != len(x):
        raise ValueError(f"{len(others)} nodes were found, {len(x)} are required")
    distance, here = cKDTree(x).query(others)
    if not distance.max() <= close or len(np.unique(here)) < len(x):
        raise ValueError(f"nodes were found that are up to {distance.max():.3g} away from those required")
    return np.asarray(here, dtype=np.int32)


class Layout:
    """How the components of a function lie at nodes.

    Args:
        function: in a Lagrange space of scalars or vectors, or a mixed one of such.
        name: what it is, for errors.

    Attributes:
        space: its space.
        parts: nodes, and this rank's dofs of the components that live there, shape (owned nodes, components).

    Raises:
        ValueError: two nodes are in the same place.
    """

    def __init__(self, function: fem.Function, name: str) -> None:
        self.space = function.function_space
        places: list[tuple[fem.FunctionSpace, FloatArray, list[IntArray]]] = []
        comm = self.space.mesh.comm
        for component in range(int(np.prod(function.ufl_shape, dtype=int))):
            space, dofs = compat.component_space(self.space, component)
            owned = space.dofmap.index_map.size_local
            x = space.tabulate_dof_coordinates()[:owned]
            same = [comm.allreduce(np.array_equal(x, other), op=MPI.LAND) for _, other, _ in places]
            if not any(same):
                places.append((space, x, []))
            places[same.index(True) if any(same) else -1][2].append(dofs[:owned])
        self.parts = [(Nodes(space, name), np.column_stack(dofs)) for space, _, dofs in places]
