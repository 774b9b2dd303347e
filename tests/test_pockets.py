"""Pieces of fluid at walls that surfaces cut off: which of them are pockets, and which are fluid as any other."""

import numpy as np
import pytest
from mpi4py import MPI
from dolfinx import mesh

from coudalfish.surface.enriched import Enriching
from tigar_x import compat

pytestmark = pytest.mark.mpi
COMM = MPI.COMM_WORLD
N = 6
OFF = 1e-9


def cube():
    return Enriching(compat.lagrange_space(mesh.create_unit_cube(COMM, N, N, N), 1), kinked=False)


def layer(axis=1):
    """One layer of cells between two walls that are a third of a cell apart."""
    ends, cells = np.ones(3), np.full(3, N)
    ends[axis], cells[axis] = 1.0 / (3.0 * N), 1
    domain = mesh.create_box(COMM, [np.zeros(3), ends], cells.tolist())
    return Enriching(compat.lagrange_space(domain, 1), kinked=False)


def at(e, places):
    """Mask of the nodes at places, in cells."""
    apart = N * e.x[:, None] - np.reshape(np.asarray(places, dtype=float), (-1, 3))
    nearest = np.abs(apart).max(axis=2).min(axis=1, initial=np.inf)
    return nearest < 1e-6


def is_joined(e, places, depth=0.05, side=-1.0, unknown=()):
    """Whether nodes at places, on one side of a surface near all the others, are counted to the other side."""
    there = at(e, places)
    phi = np.where(there, side * depth, -side)
    phi[at(e, unknown)] = np.nan
    before, after = phi.copy(), e._pockets.joined(phi, OFF)
    np.testing.assert_array_equal(phi, before)
    np.testing.assert_array_equal(after[~there], before[~there])
    joined = (after[there] < 0.0) == (side > 0.0)
    every = COMM.allreduce(int(joined.sum()), op=MPI.SUM)
    assert every in (0, COMM.allreduce(int(there.sum()), op=MPI.SUM))  # all of them or none
    assert not joined.any() or np.abs(after[there]).max() <= OFF
    return every > 0


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_nodes_of_a_wall_that_are_cut_off_together_are_joined_wherever_ranks_meet(side):
    e = cube()
    for i in range(1, N - 1):
        for j in range(1, N):
            assert is_joined(e, [(i, j, 0), (i + 1, j, 0)], side=side)
    for k in (1, 2, 3):
        assert is_joined(e, [(0, j, k) for j in (2, 3, 4)], side=side)
        assert is_joined(e, [(N, 2, k), (N, 3, k), (N, 2, k + 1), (N, 3, k + 1)], side=side)
    assert is_joined(e, [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)], side=side)


def test_what_hangs_together_with_the_fluid_is_not_joined():
    e = cube()
    for places in ([(3, 3, 0), (3, 3, 1)], [(2, 3, 0), (3, 3, 0), (3, 3, 1)]):
        assert not is_joined(e, places)
    pair = [(2, 3, 0), (3, 3, 0)]
    assert is_joined(e, pair)
    assert not is_joined(e, pair, unknown=[(2, 3, 1)])  # too far from the surface to know


def test_a_film_along_a_wall_is_not_joined_and_one_node_is_whatever_it_holds():
    """Its nodes are all on the wall, as those of a pocket."""
    e = cube()
    assert not is_joined(e, [(i, 3, 0) for i in range(1, N)], depth=0.01)
    assert not is_joined(e, [(i, j, 0) for i in (1, 2, 3, 4) for j in (1, 2, 3, 4)], depth=0.01)
    assert not is_joined(e, [(2, 3, 0), (3, 3, 0)], depth=2.0)  # it holds more than a cell
    assert is_joined(e, [(3, 3, 0)], depth=2.0)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_in_one_layer_of_cells_its_two_walls_are_none(axis):
    """As in the plane, where a node inside is fluid as any other; at the sides there are pockets."""
    e, thick = layer(axis), 1.0 / 3.0

    def both(*places):
        return [np.insert(np.array(place, dtype=float), axis, y) for place in places for y in (0.0, thick)]

    inside, side = both((3, 3)), both((0, 3))
    assert not is_joined(e, inside)
    assert not is_joined(e, inside[:1])
    assert is_joined(e, side)
    assert is_joined(e, side[1:])
    assert is_joined(e, both((0, 3), (0, 4)))
    assert not is_joined(e, both((0, 3), (1, 3)))
