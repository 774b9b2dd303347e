"""Products of a converged multiplier's system in which each rank takes the points that its cells see."""

import numpy as np
import pytest
from mpi4py import MPI
from test_converged import in_flow

from coudalfish import CouplingOptions
from coudalfish.step.linearised import WEAK
from coudalfish.step.nodal import TraceNodes
from coudalfish.step.preconditioner import Preconditioner
from coudalfish.step.seen import Seen

COMM = MPI.COMM_WORLD
pytestmark = pytest.mark.mpi


def total(values):
    return COMM.allreduce(values)


@pytest.mark.parametrize("options", [{}, {"multiplier_direction": "vector"}, {"trace": "exact"}])
def test_products_are_those_of_all_points(options):
    """With the formula of the whole, for velocities and coefficients at random."""
    scene = in_flow(CouplingOptions.converged(**options))
    scene.fsi.takeStep()
    system = scene.fsi.attempts[0].method.system
    at, rng = system.at, np.random.default_rng(3)
    seen, b, d = Seen.of(at), rng.standard_normal(at.G.shape[1]), at.dofs.shape[1]
    a = at.free * np.cos(np.arange(at.dofs.size).reshape(at.dofs.shape) + at.fluid.names(at.trace.nodes)[:, None])
    nodal, slip = seen.product(a, b.copy())
    v = total((at.fluid.timeInt.x_factor * (at.trace.B @ a)).ravel())
    pushed, G = total(at.G @ b), total(at.G.toarray())
    w = at.a_s * (at.P @ at.solve_shell(at.P.T @ (at.W * at.beta * v + pushed)))

    def on_nodes(forces):
        """Of the penalty, and of the multiplier."""
        acting = at.trace.transposed @ forces.reshape(-1, d) + (at.F @ b).reshape(-1, d)
        return at.free * acting

    near(nodal, on_nodes(at.W * at.beta * (v - w)) - at.free * (at.part @ a))
    rows = total(at.beta * at.fluid.timeInt.x_factor * (at.F.T @ a.ravel()))
    rows -= at.beta * (G.T @ w) + WEAK * (at.H.T @ pushed)
    np.testing.assert_allclose(slip, rows, rtol=0.0, atol=1e-11 * np.abs(rows).max())
    bent = system.preconditioner.bent
    near(seen.to_nodes(seen.drag(bent[seen.columns] @ b), b), on_nodes(at.beta * at.a_s * at.W * (at.P @ (bent @ b))))


def near(found, expected):
    largest = max(COMM.allgather(np.abs(expected).max(initial=0.0)))
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-11 * largest)


@pytest.mark.parametrize("options", [{}, {"multiplier_direction": "vector"}, {"trace": "exact"}])
def test_the_multipliers_own_matrix_is_that_of_one_rank(options):
    """With the whole trace, by its definition."""
    scene = in_flow(CouplingOptions.converged(**options))
    scene.fsi.takeStep()
    system = scene.fsi.attempts[0].method.system
    at, seen = system.at, system.seen
    made = Preconditioner(seen)
    n = at.fluid.velocity_space.dofmap.index_map.size_global
    d, m = at.dofs.shape[1], at.F.shape[1]
    F, T, inverse = np.zeros((n, d, m)), np.zeros((len(at.W) // d, n)), np.zeros((n, d))
    names = at.fluid.names(at.trace.nodes)
    F[names], T[:, names] = at.F.toarray().reshape(-1, d, m), at.trace.B.toarray()
    inverse[names] = at.free / np.where(at.free > 0.0, at.fluid.diagonal()[at.dofs], 1.0)
    F, T, inverse, G = total(F), total(T), np.max(COMM.allgather(inverse), axis=0), total(at.G.toarray())
    bent = at.solve_shell(at.P.T @ G)
    drag = ((at.beta * at.a_s * at.W * (at.P @ bent).T).T).reshape(-1, d, m)
    C = (F - np.einsum("qn,qim->nim", T, drag)).reshape(n * d, m)
    S = at.a_s * (at.P.T @ G).T @ bent + WEAK / at.beta * (at.H.T @ G).T
    S += at.fluid.timeInt.x_factor * C.T @ (inverse.ravel()[:, None] * C)
    S[at.idle, at.idle] = S.diagonal().max()
    r = np.random.default_rng(5).standard_normal(m)
    np.testing.assert_allclose(S @ made.multiplier(r, at.beta) * -at.beta, r, rtol=0.0, atol=1e-6)


def test_values_at_the_traces_nodes_are_those_of_the_whole_vector():
    """Whichever rank they belong to; what ranks add there is summed."""
    scene = in_flow(CouplingOptions.converged())
    scene.fsi.takeStep()
    at = scene.fsi.attempts[0].method.system.at
    system, nodes = at.fluid.system, TraceNodes(at)
    flow, expected = system.b.duplicate(), system.b.duplicate()
    first, _ = flow.getOwnershipRange()
    flow.array_w[:] = np.cos(first + np.arange(flow.getLocalSize()))
    np.testing.assert_array_equal(nodes.of(flow), at.free * system.to_local(flow)[at.dofs])
    nodal = at.free * (1.0 + COMM.rank + np.sin(at.fluid.names(at.trace.nodes))[:, None])
    local = np.zeros(system.local_size)
    local[at.dofs] = nodal
    system.from_local(local, expected)
    expected.axpy(1.0, flow)
    nodes.add(nodal, flow)
    np.testing.assert_allclose(flow.array_r, expected.array_r, rtol=0.0, atol=1e-14)
    for vector in (flow, expected):
        vector.destroy()
