"""Systems of which some nodes have second blocks: tangents, rows, places in the matrix, ranks."""

import numpy as np
import pytest
from mpi4py import MPI
from divided import CONVERGED, FLAP, INSIDE, channel
from petsc4py import PETSc

from tigar_x import compat
from tigar_x.fem.linear import direct, gmres_ilu
from tigar_x.fem.solve import FiniteElementSystem
from varmint import Velocity, box

pytestmark = pytest.mark.mpi
KINDS = ("jump", "jump and kink")
STICKING = (Velocity(("bottom", "top")),)
"""Walls that hold the velocity at nodes."""
ASSEMBLED = PETSc.Log.Event("MatAssemblyBegin")
SOLVERS = {"aij": direct(), "baij": gmres_ilu(1)}


def placed(*lines, **changes):
    """A channel with sheets that divide its cells, in a state that varies in all fields, and the step."""
    s = channel(*(lines or (FLAP,)), **changes)
    step = s.fsi.step()
    step._predict()
    step._place()
    time, V = s.flow.time, s.flow.V
    x = V.tabulate_dof_coordinates()[:, :2]
    time.x.x.array[:] += waves(x, 1.0).ravel() * free(s)[0]
    time.second.x.array[:] = waves(x, 2.0).ravel() * free(s)[1]
    return s, step


def waves(x, seed):
    """Values of three components that are the same on all ranks, shape (nodes, 3)."""
    k = np.arange(1.0, 4.0) + seed
    return np.sin(np.outer(x[:, 0], 3.1 * k) + np.outer(x[:, 1], 2.3 * k**1.5) + k)


def free(s):
    """Where x and the second blocks are unknowns, local dofs."""
    mask = np.ones(len(s.flow.time.x.x.array))
    mask[s.fsi.fluid.system.constrained] = 0.0
    return mask, s.fsi.fluid.system.second.ravel().astype(float)


def slope_error(s, step, seed=5.0):
    """Relative difference of the tangent along a direction in all unknowns from differences of the residual."""
    fluid, time = s.fsi.fluid, s.flow.time
    x = s.flow.V.tabulate_dof_coordinates()[:, :2]
    fields = (time.x.x.array, time.second.x.array)
    along = [waves(x, seed + i).ravel() * mask for i, mask in enumerate(free(s))]
    start = [f.copy() for f in fields]

    def at(eps):
        for f, f0, v in zip(fields, start, along, strict=True):
            f[:] = f0 + eps * v
        step.u = fluid.velocity_at(step.trace)
        fluid.assemble_residual(step.trace, step.forces, step.beta)
        return fluid.system.b.copy()

    difference = (at(1e-6) - at(-1e-6)) / 2e-6
    at(0.0)
    fluid.assemble_tangent(step.trace, step.penalty_tangent(consistent=True))
    direction, slope = fluid.system.b.duplicate(), fluid.system.b.duplicate()
    direction.array_w[:] = fluid.system.owned(np.concatenate(along))
    fluid.system.A.mult(direction, slope)
    return (difference - slope).norm() / slope.norm()


@pytest.mark.parametrize("matrix", SOLVERS)
@pytest.mark.parametrize("walls", [None, STICKING], ids=["slip", "sticking"])
@pytest.mark.parametrize("kind", KINDS)
def test_the_tangent_is_the_derivative_of_the_residual_with_its_penalty(kind, walls, matrix):
    # with the exact trace the tangent has another penalty than the residual
    s, step = placed(immersed=kind, walls=walls, solver=SOLVERS[matrix], options=CONVERGED.with_(trace="nodes"))
    step.y_dot = step.shell.velocity()
    second = s.fsi.fluid.system.second
    comm = MPI.COMM_WORLD
    assert comm.allreduce(int(second[:, 2].sum()), op=MPI.SUM) > 5
    assert (comm.allreduce(int(second[:, :2].sum()), op=MPI.SUM) > 10) is (kind == "jump and kink")
    assert slope_error(s, step) < 1e-7
    assert s.fsi.fluid.system.A.getType().endswith(matrix)


def test_where_nothing_is_divided_the_system_is_the_plain_one():
    s = channel(FLAP)
    time, system = s.flow.time, s.fsi.fluid.system
    time.x.x.array[:] = waves(s.flow.V.tabulate_dof_coordinates()[:, :2], 1.0).ravel()
    system.apply_boundary_values()
    plain = FiniteElementSystem(s.flow.residual, time.x, s.flow.bcs)
    for each in (plain, system):
        each.assemble_residual()
        each.assemble_tangent()
    assert (plain.b - system.b).norm() < 1e-13 * plain.b.norm()
    difference = plain.A.copy()
    difference.axpy(-1.0, system.A)
    assert difference.norm() < 1e-13 * plain.A.norm()
    assert plain.b.norm() > 0.1


def test_a_jump_at_one_side_of_all_nodes_is_a_jump_of_their_cells():
    """Nodal pressures of 3 on the one side and 1 on the other with a jump of 2 are one constant on either side."""
    s, _ = placed(((0.43, 0.0), (0.47, 1.0)))
    time, system = s.flow.time, s.fsi.fluid.system
    time.second.x.array[:] = 0.0
    x, e = (f.x.array.reshape(-1, 3) for f in (time.x, time.second))
    time.x_old.x.array[:], x[:, :2] = 0.0, 0.0
    e[:, 2] = 2.0 * system.second[:, 2]
    x[:, 2] = 2.0 + s.fsi.fluid.sides.doubled.side
    near = np.unique(compat.cell_dofs(s.flow.V)[s.fsi.fluid.sides.doubled.cells])
    assert system.second[near, 2].all()
    system._doubled.join()
    z = system._doubled.joined[0][2].x.array.reshape(-1, 6)[system._doubled.node_of_z[near]]
    np.testing.assert_allclose(z[:, 2], 2.0, atol=1e-14)
    np.testing.assert_allclose(z[:, 5], 2.0, atol=1e-14)


@pytest.mark.parametrize("matrix", SOLVERS)
def test_the_matrix_has_room_for_all_that_is_put_in(matrix):
    """Also for what the penalty couples that no cell does: no place is made while the tangent is assembled."""
    s = channel(FLAP, INSIDE, n=12, solver=SOLVERS[matrix])
    layouts = set()
    for _ in range(3):
        s.fsi.takeStep()
        layouts.add(s.fsi.fluid.system.layout)
        room = s.fsi.fluid.system.A.getInfo()
        assert room["mallocs"] == 0.0
        assert room["nz_allocated"] < (1.01 if MPI.COMM_WORLD.size == 1 else 1.7) * room["nz_used"]
    assert len(layouts) > 1


@pytest.mark.skipif(MPI.COMM_WORLD.size == 1, reason="compares several ranks with one")
@pytest.mark.parametrize("lines", [(FLAP,), (INSIDE, ((0.8, 0.0), (0.77, 0.5)))], ids=["flap", "two"])
def test_residual_and_tangent_are_those_of_one_rank(lines):
    found = []
    for comm in (MPI.COMM_SELF, MPI.COMM_WORLD):
        mesh = box(comm, (0.0, 0.0), (1.0, 1.0), (8, 8))
        s, step = placed(*lines, mesh=mesh)
        fluid, step.u, step.y_dot = s.fsi.fluid, s.fsi.fluid.velocity_at(step.trace), step.shell.velocity()
        fluid.assemble_residual(step.trace, step.forces, step.beta)
        fluid.assemble_tangent(step.trace, step.penalty_tangent(consistent=True))
        x = s.flow.V.tabulate_dof_coordinates()[:, :2]
        probes = [fluid.system.b.duplicate() for _ in range(2)]
        for seed, probe in zip((7.0, 9.0), probes, strict=True):
            probe.array_w[:] = fluid.system.owned(np.concatenate([waves(x, seed).ravel(), waves(x, seed + 1).ravel()]))
        product = probes[0].duplicate()
        fluid.system.A.mult(probes[0], product)
        counts = comm.allreduce(fluid.system.second[: fluid.system._owned_nodes].sum(), op=MPI.SUM)
        found.append([fluid.system.b.dot(probes[0]), fluid.system.b.norm(), product.dot(probes[1]), product.norm()])
        found[-1] += [float(counts), fluid.system.b.getSize()]
    np.testing.assert_allclose(found[1], found[0], rtol=1e-11)
    assert found[0][-2] > 20


def test_divided_cells_and_others_are_exchanged_together(monkeypatch):
    """Ranks wait for each other wherever a matrix is assembled."""
    s, step = placed()
    system, counts = s.fsi.fluid.system, []
    divided, add = system._add_divided, compat.add_matrix

    def noted():
        divided()
        counts.append(ASSEMBLED.getPerfInfo()["count"])

    def followed(A, form, bcs=()):
        if A == system.A:
            counts.append(ASSEMBLED.getPerfInfo()["count"])
        add(A, form, bcs)

    monkeypatch.setattr(system, "_add_divided", noted)
    monkeypatch.setattr(compat, "add_matrix", followed)
    PETSc.Log.begin()
    s.fsi.fluid.assemble_tangent(step.trace, step.penalty_tangent(consistent=True))
    assert len(counts) == 2
    assert 0 < counts[0] == counts[1]
