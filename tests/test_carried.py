"""Preconditioners that are kept while other nodes get second blocks."""

from dataclasses import replace

import numpy as np
import pytest
from mpi4py import MPI
from divided import FLAP, INSIDE, channel
from petsc4py import PETSc

from tigar_x.fem.carried import Carried, Rows
from tigar_x.fem.linear import PreparedSolver, gmres_ilu
from varmint.mesh import box

pytestmark = pytest.mark.mpi
WORLD = MPI.COMM_WORLD
SIZE, PRESSURE = 3, 2


def matrix(block):
    """One dense block a rank on the diagonal."""
    A = PETSc.Mat().createAIJ(((len(block), None), (len(block), None)), nnz=len(block), comm=WORLD)
    first = A.getOwnershipRange()[0]
    at = np.arange(first, first + len(block), dtype=PETSc.IntType)
    A.setValues(at, at, block)
    A.assemble()
    return A


def preconditioner(A, context=None):
    pc = PETSc.PC().create(WORLD)
    pc.setOperators(A)
    pc.setType("bjacobi" if context is None else "python")  # its ILU is exact in a dense block
    if context is not None:
        pc.setPythonContext(context)
    pc.setUp()
    return pc


def test_the_inverse_of_a_matrix_is_that_of_the_same_equations_in_other_unknowns():
    """Nodes of both sides change sides, second blocks go and come, of which those that come are uncoupled.

    What the jump of node 2 acts on has become a thousandth.
    """
    rng = np.random.default_rng(WORLD.rank)
    was = Rows(SIZE, np.array([1, 2, 3, 4]), np.array([1.0, -1.0, 1.0, 1.0, -1.0, 1.0]), PRESSURE)
    now = Rows(SIZE, np.array([0, 1, 2, 3]), np.array([1.0, 1.0, 1.0, -1.0, -1.0, 1.0]), PRESSURE)
    n = SIZE * len(was.side)
    A = rng.random((n + 12, n + 12)) + 9.0 * np.eye(n + 12)
    gone = np.arange(n + 9, n + 12)  # node 4
    A[gone, :], A[:, gone] = 0.0, 0.0
    A[gone, gone] = 1.0
    was = replace(was, diagonal=A.diagonal()[n:])
    # former unknowns by present ones, whose rows are those of nodes 0, 1, 2, 3
    former = np.zeros((n + 12, n + 12))
    former[:n, :n] = np.eye(n)
    former[np.arange(n, n + 9), np.arange(n + 3, n + 12)] = 1.0
    for node, second, side in ((1, n + 3, 1.0), (3, n + 9, -1.0)):  # x' - side' e' is the value on the other side
        former[SIZE * node + PRESSURE, second + PRESSURE] = -side
    part = np.ones(n + 12)
    part[n + 6 + PRESSURE] = 0.03
    B = part[:, None] * (former.T @ A @ former) * part
    new = np.arange(n, n + 3)
    B[new, new] = [2.0, 3.0, 4.0]
    old, present = matrix(A), matrix(B)
    pc = preconditioner(present, Carried(preconditioner(old), None, was, now))
    x, b = present.createVecs()
    exact = rng.random(n + 12)
    b.array_w[:] = B @ exact
    pc.apply(b, x)
    np.testing.assert_allclose(x.array_r, exact, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("kind", ["jump", "jump and kink"])
def test_steps_with_a_preconditioner_that_is_carried_are_those_with_new_ones(kind, monkeypatch):
    monkeypatch.setattr("tigar_x.fem.carried.MOST", 1.0)  # a coarse mesh, in which many nodes change
    mesh = box(WORLD, (0.0, 0.0), (1.0, 1.0), (12, 12))  # another one might be cut elsewhere
    runs, layouts, carried = [], 0, 0
    for growth in (None, 20.0):
        solver = gmres_ilu(1, rtol=1e-10, rebuild_growth=growth)
        s = channel(FLAP, INSIDE, immersed=kind, mesh=mesh, solver=solver, stiffness=4.0, inflow=(2.0, 0.0))
        for _ in range(6):
            s.fsi.takeStep()
            carried += s.fsi.fluid.system._solver._former is not None
        runs.append((s.flow.time.x.x.array.copy(), s.fsi.lam.copy()))
        layouts = s.fsi.fluid.system.layout
    assert layouts > 3
    assert carried > 1
    for one, other in zip(*runs, strict=True):
        np.testing.assert_allclose(other, one, rtol=0.0, atol=1e-6 * np.abs(one).max(initial=0.0))


def test_a_carried_preconditioner_that_has_become_poor_is_made_anew(monkeypatch):
    monkeypatch.setattr("tigar_x.fem.carried.MOST", 1.0)
    s = channel(FLAP, n=12, solver=gmres_ilu(1, rebuild_growth=20.0), stiffness=4.0, inflow=(2.0, 0.0))
    system = s.fsi.fluid.system
    for _ in range(6):
        s.fsi.takeStep()
        if system._solver._former is not None:
            break
    first = system._solver._former[0]
    assert first.keeps
    system.served(1000)
    assert not first.keeps
    assert system._solver._former is None
    system.preconditioner()
    assert system._carrying._made[0] is system._solver
    s.fsi.takeStep()


@pytest.mark.parametrize("share", [1.0, -1.0])
def test_what_is_no_longer_carried_is_freed_before_the_next_one_is_made(share, monkeypatch):
    monkeypatch.setattr("tigar_x.fem.carried.MOST", share)
    s = channel(FLAP, n=12, solver=gmres_ilu(1, rebuild_growth=20.0), stiffness=4.0, inflow=(2.0, 0.0))
    system, alive, made = s.fsi.fluid.system, [], []

    def counted(self):
        made.append(self)
        assert all(other.handle == 0 for other in alive)  # factors of former matrices
        alive.append(built(self))
        return alive[-1]

    built = PreparedSolver.preconditioner

    def of_new(self):
        return built(self) if self.keeps or "_ksp" in vars(self) else counted(self)

    monkeypatch.setattr(PreparedSolver, "preconditioner", of_new)
    for _ in range(6):
        s.fsi.takeStep()
        if share > 0.0 and system._solver._former is not None:
            system.served(1000)
    assert len(made) > 1


def test_many_other_nodes_get_a_new_preconditioner():
    was = Rows(SIZE, np.arange(20), np.ones(40), PRESSURE)
    side = np.ones(40)
    side[:3] = -1.0
    assert Rows(SIZE, np.arange(1, 21), np.ones(40), PRESSURE).resemble(was, WORLD)
    assert not Rows(SIZE, np.arange(3, 23), np.ones(40), PRESSURE).resemble(was, WORLD)
    assert not Rows(SIZE, np.arange(20), side, PRESSURE).resemble(was, WORLD)
