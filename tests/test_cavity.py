"""Regularised lid-driven cavity at Re = 100: steady flow against an exact solution, on sequences of meshes.

The benchmark of D. Kamensky, doi:10.1016/j.camwa.2020.01.023, figure 2.
"""

from functools import cache

import numpy as np
import pytest
import ufl
from mpi4py import MPI
from load import load_demo

from varmint.conditions import WeakVelocity
from varmint.flow import Flow, FlowOptions
from varmint.mesh import box

DEMO = load_demo("lid_driven_cavity")

# Errors of the published code (legacy FEniCS 2019.2 with VarMINT of 2022) on triangles, measured with quadrature of
# degree 2k; (degree, N): (H1 seminorm, L2 norm) of the velocity.
LEGACY = {
    (1, 8): (6.64e-1, 2.33e-2),
    (1, 16): (3.21e-1, 6.20e-3),
    (1, 32): (1.59e-1, 1.56e-3),
    (1, 64): (7.92e-2, 3.91e-4),
    (2, 8): (9.52e-2, 2.15e-3),
    (2, 16): (2.19e-2, 1.98e-4),
    (2, 32): (5.11e-3, 1.91e-5),
}


def built(N, degree, cell, share, drift, comm, **options):
    """The demo's flow; or that on these ranks, with a share of the force, in a frame that drifts."""
    if (share, drift, comm) == (1.0, (0.0, 0.0), MPI.COMM_WORLD):
        return DEMO.build(N, degree, cell, **options)
    nu, moved = 0.01, ufl.as_vector(drift)
    walls = WeakVelocity(("left", "right", "bottom", "top"), lambda x, t: DEMO.exact(x)[0] + moved)
    mesh, chosen = box(comm, (0, 0), (1, 1), (N, N), cell), FlowOptions(C_I=6.0 * degree**4, pin_at=(0.0, 0.0))

    def force(x, t):
        return share * DEMO.force(x, nu, moved)

    return Flow(mesh, [walls], rho=1.0, mu=nu, degree=degree, f=force, options=chosen)


@cache
def errors(N, degree, cell="triangle", share=1.0, drift=(0.0, 0.0), alone=False, **options):
    """H1 seminorm and L2 norm of the velocity's error, with ``share`` of the body force, in a frame that drifts."""
    comm = MPI.COMM_SELF if alone else MPI.COMM_WORLD
    flow = built(N, degree, cell, share, drift, comm, **options)
    flow.solve()
    found = DEMO.errors(flow, drift=drift)
    return found["H1_u"], found["L2_u"]


def rates(sequence, *args, **options):
    """Errors on a sequence of meshes, shape (meshes, 2), and the rates of the finest pair, each halving the size."""
    table = np.array([errors(N, *args, **options) for N in sequence])
    return table, np.log2(table[-2] / table[-1])


FINEST = {1: (32, 64), 2: (16, 32), 3: (8, 16), 4: (4, 8)}


@pytest.mark.parametrize("cell", ["triangle", "quadrilateral"])
@pytest.mark.parametrize("degree", [1, 2, 3, 4])
def test_rates(degree, cell):
    """H1 of order k and L2 of order k + 1 on the finest pair; errors on triangles are the published ones."""
    table, (rate_H1, rate_L2) = rates(FINEST[degree], degree, cell)
    assert rate_H1 >= degree - 0.1
    assert rate_L2 >= degree + 0.9
    for N, row in zip(FINEST[degree], table, strict=True):
        if (degree, N) in LEGACY:
            assert (row < 1.05 * np.array(LEGACY[degree, N])).all()
            if cell == "triangle":
                np.testing.assert_allclose(row, LEGACY[degree, N], rtol=0.01)


@pytest.mark.mpi
@pytest.mark.parametrize(("degree", "N"), [(1, 8), (1, 16), (2, 8), (2, 16)])
def test_errors_of_the_published_code(degree, N):
    np.testing.assert_allclose(errors(N, degree), LEGACY[degree, N], rtol=0.01)


@pytest.mark.parametrize(("degree", "cell"), [(1, "triangle"), (2, "triangle"), (1, "quadrilateral")])
def test_a_wrong_force_does_not_converge(degree, cell):
    """With nine tenths of the force the velocity has another limit."""
    sequence = {1: (16, 32), 2: (8, 16)}[degree]
    table, (rate_H1, rate_L2) = rates(sequence, degree, cell, share=0.9)
    assert degree - 0.1 > rate_H1
    assert rate_L2 < 0.2
    assert table[-1, 1] > 5 * LEGACY[degree, sequence[-1]][1]


@pytest.mark.parametrize("degree", [1, 2])
def test_a_frame_that_moves(degree):
    """A constant velocity added to the flow and its boundary data keeps rate and size of the error."""
    table, (rate_H1, rate_L2) = rates((8, 16), degree, drift=(0.5, -0.3))
    assert degree - 0.1 <= rate_H1
    assert degree + 0.9 <= rate_L2
    np.testing.assert_allclose(table[-1, 0], LEGACY[degree, 16][0], rtol=0.02)
    assert table[-1, 1] < LEGACY[degree, 16][1]


@pytest.mark.parametrize("options", [{"invariant_metric": True}, {"frozen_tangent": True}])
def test_options_keep_the_accuracy(options):
    """Another metric is another method of the same order; another tangent leads to the same solution."""
    found, usual = np.array(errors(16, 1, **options)), np.array(errors(16, 1))
    if "frozen_tangent" in options:
        np.testing.assert_allclose(found, usual, rtol=1e-8)
    else:
        assert (found < 1.1 * usual).all()
        assert abs(found[1] / usual[1] - 1.0) > 1e-4


@pytest.mark.mpi
@pytest.mark.skipif(MPI.COMM_WORLD.size == 1, reason="compares with a run of one rank alone")
def test_any_number_of_ranks():
    """Every rank alone finds what all find together."""
    np.testing.assert_allclose(errors(8, 1), errors(8, 1, alone=True), rtol=1e-8)
