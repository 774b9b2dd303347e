"""Values at nodes and meshes, told apart without regard to how they are distributed over ranks.

A field is known by the places of its nodes: gathered on one rank it belongs to no partition, and finds its nodes on any
other by a k-d tree. A mesh is known by counts, its box, and sums over its cells of waves about as long as a cell: what
moves a vertex or turns a diagonal changes them, another order of the cells does not.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from mpi4py import MPI
from dolfinx import fem, mesh
from scipy.spatial import cKDTree

from tigar_x import compat
from tigar_x.compat import FloatArray, IntArray
from tigar_x.ranks import gathered

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
    """The nodes of a scalar Lagrange space on rank 0 of its communicator, and values on their way there and back.

    Args:
        space: scalar space of two or more nodes, none in the same place.
        name: what it is, for errors.

    Attributes:
        comm: communicator of the mesh.
        count: number of nodes on all ranks.
        x: coordinates of all nodes on rank 0, shape (nodes, geometric dimension); None on the others.

    Raises:
        ValueError: two nodes are in the same place, as in discontinuous spaces.
    """

    def __init__(self, space: fem.FunctionSpace, name: str) -> None:
        self.comm: MPI.Comm = space.mesh.comm
        index_map = space.dofmap.index_map
        self.count = int(index_map.size_global)
        self._owned = int(index_map.size_local)
        self._counts = self.comm.allgather(self._owned)
        self.x = self.gather(space.tabulate_dof_coordinates()[: self._owned, : space.mesh.geometry.dim])
        apart = True
        if self.x is not None:
            self._tree = cKDTree(self.x)
            self._close = CLOSE * float(np.linalg.norm(np.ptp(self.x, axis=0)))
            apart = bool(self._tree.query(self.x, k=2)[0][:, 1].min() > 2.0 * self._close)
        if not self.comm.bcast(apart):
            raise ValueError(f"{name}: nodes in the same place, which cannot be told apart in a checkpoint")

    def gather(self, values: FloatArray) -> FloatArray | None:
        """Values of all nodes on rank 0, None elsewhere (collective).

        Args:
            values: at the nodes that this rank owns, shape (owned, ...).
        """
        rows: FloatArray | None = gathered(self.comm, values)
        return rows

    def scatter(self, values: FloatArray | None) -> FloatArray:
        """Values at the nodes that this rank owns (collective), shape (owned, ...).

        Args:
            values: of all nodes on rank 0, None elsewhere.
        """
        if values is not None and self.comm.size == 1:
            return values
        parts: Any = None if values is None else np.split(values, np.cumsum(self._counts)[:-1])
        return np.asarray(self.comm.scatter(parts))

    def match(self, x: FloatArray) -> IntArray:
        """Where the nodes of this space are among others, on rank 0 only.

        Args:
            x: coordinates of the others in any order, shape (nodes, geometric dimension).

        Returns:
            The number among the others of every node.

        Raises:
            ValueError: their number or their places differ.
        """
        if len(x) != self.count:
            raise ValueError(f"{len(x)} nodes were found, {self.count} are required")
        distance, here = self._tree.query(x)
        if not distance.max() <= self._close or len(np.unique(here)) < self.count:
            raise ValueError(f"nodes were found that are up to {distance.max():.3g} away from those required")
        return np.argsort(here).astype(np.int32)


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

    def gather(self, function: fem.Function) -> list[FloatArray | None]:
        """Values of every part on rank 0, shape (nodes, components) each (collective)."""
        return [nodes.gather(function.x.array[dofs]) for nodes, dofs in self.parts]

    def scatter(self, function: fem.Function, values: Sequence[FloatArray | None]) -> None:
        """Give a function the values of every part on rank 0, None elsewhere (collective)."""
        for (nodes, dofs), part in zip(self.parts, values, strict=True):
            function.x.array[dofs] = nodes.scatter(part)
        function.x.scatter_forward()
