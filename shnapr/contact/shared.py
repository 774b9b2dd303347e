"""Contact whose pairs of points are shared between ranks that have the same positions."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from mpi4py import MPI
from scipy.spatial import cKDTree

from shnapr.contact.neighbours import IndexArray
from shnapr.contact.pairs import ContactForces
from tigar_x import ranks
from tigar_x.compat import FloatArray

ROUNDED = 1e-9
"""Part of a distance that rounding may lack."""


def own_pairs(comm: MPI.Comm, x: FloatArray, reach: float) -> IndexArray:
    """Those pairs of close points that are this rank's, by their numbers, whatever other pairs there are.

    Args:
        comm: the ranks, which have as many points each, one after the other along the longest direction.
        x: points, shape (n, d); unit: length.
        reach: distance up to which they are close.

    Returns:
        Pairs (i, j) with i < j, in no order, shape (pairs, 2).
    """
    along = x[:, np.ptp(x, axis=0).argmax()]
    order = np.argsort(along, kind="stable")
    first, last = (len(x) * (comm.rank + k) // comm.size for k in (0, 1))
    if first == last:
        return np.empty((0, 2), dtype=np.intp)
    end = np.searchsorted(along[order], along[order[last - 1]] + (1.0 + ROUNDED) * reach, "right")
    near = order[first:end]
    found = cKDTree(x[near], balanced_tree=False, compact_nodes=False).query_pairs(reach, output_type="ndarray")
    return np.sort(near[found[found[:, 0] < last - first]], axis=1)  # a pair is of the rank that has the first of both


def of_all_ranks(comm: MPI.Comm, evaluate: Callable[[], ContactForces]) -> ContactForces:
    """Contact of the pairs of all ranks, with the tangent of this rank's (collective).

    Args:
        comm: the ranks.
        evaluate: contact of this rank's pairs.
    """
    own: list[ContactForces] = []

    def numbers() -> FloatArray:
        own.append(found := evaluate())
        return np.concatenate([[found.energy, found.load, found.pairs, found.coincident], _at(comm, found.distance)])

    energy, load, pairs, coincident, *distances = ranks.summed(comm, 4 + comm.size, numbers)
    (found,) = own
    forces = found.forces
    if pairs:
        forces = ranks.summed(comm, forces.size, forces.ravel).reshape(forces.shape)
    sums = {"energy": float(energy), "load": float(load), "distance": float(min(distances))}
    counts = {"pairs": int(pairs), "coincident": int(coincident)}
    return replace(found, forces=forces, **sums, **counts)  # type: ignore[arg-type]  # it takes them by name


def largest(comm: MPI.Comm, find: Callable[[], float]) -> float:
    """The largest of the numbers that the ranks find (collective)."""
    return float(ranks.summed(comm, comm.size, lambda: _at(comm, find())).max())


def _at(comm: MPI.Comm, value: float) -> FloatArray:
    """A number at the place of this rank, shape (ranks,)."""
    result = np.zeros(comm.size)
    result[comm.rank] = value
    return result
