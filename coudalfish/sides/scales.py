"""Sizes and speeds of a fluid that rules and warnings refer to."""

import numpy as np
from mpi4py import MPI
from dolfinx import fem, mesh

from coudalfish.sides.mesh_motion import MovingMesh
from tigar_x import compat, ranks
from tigar_x.compat import FloatArray, IntArray
from tigar_x.fem.time_integration import TimeIntegrator


def median_size(domain: mesh.Mesh) -> float:
    """Median over the cells of a mesh of their shortest edges, at rest (collective); unit: length.

    Args:
        domain: mesh of simplices.
    """
    lengths = compat.shortest_edges(domain)[: compat.owned_cells(domain)]
    return ranks.median(domain.comm, lengths)


def extent(domain: mesh.Mesh) -> FloatArray:
    """Lengths of the box around a mesh, shape (d,); unit: length (collective).

    Args:
        domain: mesh.
    """
    d = domain.geometry.dim
    x = domain.geometry.x[:, :d]
    low, high = x.min(axis=0, initial=np.inf), x.max(axis=0, initial=-np.inf)
    domain.comm.Allreduce(MPI.IN_PLACE, low, op=MPI.MIN)
    domain.comm.Allreduce(MPI.IN_PLACE, high, op=MPI.MAX)
    return np.asarray(high - low)


def largest_speed(
    time: TimeIntegrator, moving: MovingMesh | None, velocity_space: fem.FunctionSpace, velocity_dofs: IntArray
) -> float:
    """Largest nodal speed of a fluid relative to its mesh, at the vertices where that moves (collective).

    Args:
        time: integrator of the fluid.
        moving: motion of the mesh; None: it is fixed.
        velocity_space: scalar space of one velocity component.
        velocity_dofs: dofs of the components in the unknown, shape (nodes, d).

    Returns:
        Unit: length/time.
    """
    v = time.x.x.array[velocity_dofs]
    if moving is not None:
        V = moving.time.x.function_space
        own = compat.cell_dofs(V)
        corners = compat.cell_dofs(velocity_space)[:, : own.shape[1]]  # the vertices come first
        rate = moving.time.rates()[0] if moving.time.in_step else moving.time.xdot_old.x.array
        v = v[corners] - rate.reshape(-1, v.shape[1])[own]
    return float(time.x.function_space.mesh.comm.allreduce(np.linalg.norm(v, axis=-1).max(initial=0.0), op=MPI.MAX))


def directions(constrained: IntArray, velocity_dofs: IntArray, comm: MPI.Comm) -> FloatArray:
    """Which components of the velocity are free at some node, 1 or 0, shape (d,) (collective).

    In a layer of cells between walls that hold the velocity across it, nothing flows across.

    Args:
        constrained: local dofs with strong conditions.
        velocity_dofs: local dofs of the components, shape (nodes, d).
        comm: of the fluid.
    """
    free = (~np.isin(velocity_dofs, constrained)).any(axis=0).astype(np.float64)
    comm.Allreduce(MPI.IN_PLACE, free, op=MPI.MAX)
    return free
