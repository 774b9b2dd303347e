"""Products of a converged multiplier's system in which each rank takes the points that its cells see."""

import numpy as np
import pytest
from mpi4py import MPI
from test_converged import in_flow

from coudalfish import CouplingOptions
from coudalfish.step.linearised import WEAK
from coudalfish.step.seen import Seen

COMM = MPI.COMM_WORLD
pytestmark = [pytest.mark.mpi, pytest.mark.skipif(COMM.size == 1, reason="one rank sees all")]


def total(values):
    return COMM.allreduce(values)


@pytest.mark.parametrize("options", [{}, {"multiplier_direction": "vector"}, {"trace": "exact"}])
def test_products_are_those_of_all_points(options):
    """With the formula of the whole, for velocities and coefficients at random."""
    scene = in_flow(CouplingOptions.converged(**options))
    scene.fsi.takeStep()
    system = scene.fsi.attempts[0].method.system
    at, rng = system.at, np.random.default_rng(3)
    seen, b, a = Seen.of(at), rng.standard_normal(at.G.shape[1]), rng.standard_normal(at.dofs.shape)
    a = at.free * np.cos(np.arange(a.size).reshape(a.shape) + at.fluid.names(at.trace.nodes)[:, None])
    nodal, slip = seen.product(a, b.copy())
    v = total((at.fluid.timeInt.x_factor * (at.trace.B @ a)).ravel())
    pushed = at.G @ b
    w = at.moved(at.W * at.beta * v + pushed)
    expected = at.to_nodes(at.W * (at.beta * (v - w)) + pushed, b) - at.free * (at.part @ a)
    np.testing.assert_allclose(
        nodal, expected, rtol=0.0, atol=1e-11 * max(COMM.allgather(np.abs(expected).max(initial=0.0)))
    )
    rows = at.beta * (at.G_t @ (v - w)) - WEAK * (at.H_t @ pushed)
    if at.X_t is not None:
        rows += total(at.beta * at.fluid.timeInt.x_factor * (at.X_t @ a.ravel()))
    if COMM.rank == 0:
        np.testing.assert_allclose(slip, rows, rtol=0.0, atol=1e-11 * np.abs(rows).max())
    made = system.preconditioner
    expected = at.to_nodes(made.forces(b), b)
    found = seen.nodal(made, b)
    np.testing.assert_allclose(
        found, expected, rtol=0.0, atol=1e-11 * max(COMM.allgather(np.abs(expected).max(initial=0.0)))
    )
