"""The preconditioner of two levels: its parts against dense matrices, its iterations on any ranks, and its options."""

from dataclasses import replace

import numpy as np
import pytest
from mpi4py import MPI
from load import load_demo
from mpi_runs import mpirun
from petsc4py import PETSc
from scenes import sheet_in_flow
from test_fallbacks import blocked_matrix, fill, loads, relative_residual
from test_petsc_options import table  # noqa: F401

from coudalfish import CouplingOptions
from coudalfish.problems import manufactured as problem
from tigar_x import compat
from tigar_x.fem.linear import PreparedSolver, SolveError, direct, two_level
from tigar_x.fem.nodes import RowNodes, aggregates
from tigar_x.fem.petsc_options import chosen
from tigar_x.fem.two_level import MOST, TwoLevel, _linear, aggregate_size
from tigar_x.run.progress import rss_mib

WORLD = MPI.COMM_WORLD
CAVITY = load_demo("lid_driven_cavity")
SIDE, SIZE = 12, 4


def nodes_of(A, **more):
    """Points of a square, of which those on its left hold two unknowns, as by strong conditions."""
    first, last = (row // SIZE for row in A.getOwnershipRange())
    i, j = np.divmod(np.arange(first, last), SIDE)
    held = np.zeros((len(i), SIZE), dtype=bool)
    held[j == 0, :2] = True
    return RowNodes(np.column_stack([j, i, 0 * i]) / SIDE, held, **more)


def held_matrix(nodes):
    A = blocked_matrix()
    rows = A.getOwnershipRange()[0] + np.flatnonzero(nodes.held)
    A.zeroRowsColumns(rows.astype(PETSc.IntType), diag=2.0)
    return A


def dense(A):
    """The whole matrix on every rank."""
    indptr, indices, data = A.getValuesCSR()
    mine = np.zeros((len(indptr) - 1, A.getSize()[1]))
    mine[np.repeat(np.arange(len(mine)), np.diff(indptr)), indices] = data
    return np.vstack(WORLD.allgather(mine))


def prepared(A, nodes, **options):
    """The preconditioner of a matrix, by itself."""
    pc = PETSc.PC().create(WORLD)
    pc.setOperators(A)
    pc.setType("python")
    context = TwoLevel(nodes, "two_level_test_", **options)
    pc.setPythonContext(context)
    PETSc.Options()["two_level_test_pc_type"] = "jacobi"
    pc.setUp()
    PETSc.Options().delValue("two_level_test_pc_type")
    return pc, context


@pytest.mark.mpi
def test_blocks_are_those_of_the_matrix():
    A = blocked_matrix()
    at, values = compat.block_pattern(A), np.concatenate(compat.block_values(A))
    first = A.getOwnershipRange()[0] // SIZE
    columns = np.append(first + np.arange(at.own), at.others)[at.columns]
    found = np.zeros((at.own, SIZE, A.getSize()[1] // SIZE, SIZE))
    found[at.rows, :, columns] = values.transpose(0, 2, 1)
    mine = slice(*A.getOwnershipRange())
    assert np.array_equal(found.reshape(SIZE * at.own, -1), dense(A)[mine])
    assert np.array_equal(at.columns[at.diagonal], np.arange(at.own))
    with pytest.raises(ValueError, match="baij, is required"):
        compat.block_pattern(blocked_matrix("aij"))


def test_aggregates_are_small_and_of_one_group():
    x = np.random.default_rng(0).random((1000, 3)) * [4.0, 1.0, 1.0]
    group = (np.arange(1000) % 3 == 0).astype(int)
    number = aggregates(x, 20, group)
    counts = np.bincount(number)
    assert counts.max() <= 20
    assert counts.min() >= 10
    for k in range(len(counts)):
        assert len(set(group[number == k])) == 1
        assert np.ptp(x[number == k], axis=0).max() < 1.5
    assert len(aggregates(x[:0], 20)) == 0


def test_aggregates_grow_with_the_number_of_nodes_later_where_some_nodes_are_double():
    nodes = 7_000, 28_000, 120_000
    assert [aggregate_size(n, several=False) for n in nodes] == [128, 256, 256]
    assert [aggregate_size(n, several=True) for n in nodes] == [128, 128, 256]
    assert aggregate_size(10_000_000, several=True) == -(-10_000_000 // MOST)


@pytest.mark.mpi
@pytest.mark.parametrize("shared", [8_000, 0])
@pytest.mark.parametrize("floating", [False, True])
def test_coarse_level_is_exact_for_constants_and_linear_pressures_of_aggregates(monkeypatch, floating, shared):
    """r = A P c gives P c whatever the smoother is, and whether the ranks share the factors."""
    monkeypatch.setattr("tigar_x.fem.coarse_solver.SHARED", shared)
    plain = nodes_of(blocked_matrix())
    A = held_matrix(plain)
    nodes = replace(plain, floating=floating)
    pc, _ = prepared(A, nodes, size=9)
    number = aggregates(nodes.x, 9)
    rng = np.random.default_rng(WORLD.rank)
    constants = rng.random((number.max() + 1, SIZE))
    if floating and WORLD.rank == 0:
        constants[0, -1] = 0.0
    x, r = A.createVecs()
    values = constants[number]
    if not floating:  # one of the pressures would have another value where it is pinned
        slopes = rng.random((number.max() + 1, 3))
        values[:, -1] += np.einsum("ij,ij->i", slopes[number], nodes.x)
    x.array_w[:] = (values * ~nodes.held).ravel()
    A.mult(x, r)
    y = x.duplicate()
    pc.apply(r, y)
    assert (y - x).norm() < 1e-12 * x.norm()
    pc.destroy()


def test_linear_functions_are_independent_or_zero():
    """Of points in space, in a plane, on a line and alone, of which some pressures are held."""
    rng = np.random.default_rng(0)
    scale = np.repeat([[1.0, 2.0, 3.0], [1.0, 1.0, 1e-9], [0.0, 1.0, 0.0], [0.0, 0.0, 0.0]], 9, axis=0)
    x, number, free = rng.random((36, 3)) * scale + 5.0, np.repeat(np.arange(4), 9), np.ones(36)
    free[[0, 9, 18]] = 0.0
    found = _linear(x, number, 4, free, 3)
    assert not found[free == 0.0].any()
    for k, rank in enumerate((3, 2, 1, 0)):
        here = (number == k) & (free > 0.0)
        functions = np.column_stack([np.ones(here.sum()), found[here]])
        gram = functions.T @ functions / here.sum()
        some = gram.diagonal() > 0.0
        assert some.sum() == 1 + rank
        assert np.allclose(gram[np.ix_(some, some)], np.eye(1 + rank), atol=1e-9)


@pytest.mark.mpi
@pytest.mark.parametrize(("dense", "shared"), [(600, 8_000), (0, 8_000), (0, 0)])
@pytest.mark.parametrize("size", [9, 1000])
def test_a_coarse_level_that_is_singular_makes_no_large_correction(monkeypatch, dense, shared, size):
    """Where an aggregate has all nodes, its diagonal is what rounding leaves."""
    monkeypatch.setattr("tigar_x.fem.coarse_solver.DENSE", dense)
    monkeypatch.setattr("tigar_x.fem.coarse_solver.SHARED", shared)
    A = blocked_matrix()
    at = compat.block_pattern(A)
    couplings = np.random.default_rng(0).random(len(at.rows))
    couplings[at.diagonal] = 0.0
    couplings[at.diagonal] = -np.bincount(at.rows, couplings)
    start = 0
    for blocks in compat.block_values(A):
        blocks[:] = -np.eye(SIZE) * couplings[start : start + len(blocks), None, None]
        start += len(blocks)
    A.stateIncrease()  # constants are in its null space
    nodes = nodes_of(A)
    pc, _ = prepared(A, replace(nodes, held=np.zeros_like(nodes.held)), size=size)
    b, x = loads(A)
    pc.apply(b, x)
    assert x.norm() < 1e7 * b.norm()
    pc.destroy()


@pytest.mark.mpi
def test_repaired_matrix_has_larger_couplings_of_weak_pressures_and_the_same_sums():
    A = blocked_matrix()
    weak = nodes_of(A).x[:, 0] > 0.4
    nodes = nodes_of(A, weak=lambda: weak)
    pc, context = prepared(A, nodes, repair=7.0)
    exact, repaired = dense(A), dense(context.smoother.getOperators()[1])
    p = slice(SIZE - 1, None, SIZE)
    both = np.concatenate(WORLD.allgather(weak))
    edges = both[:, None] & both[None, :] & ~np.eye(len(both), dtype=bool)
    expected = exact.copy()
    expected[p, p] *= np.where(edges, 7.0, 1.0)
    expected[p, p] -= np.diag((expected[p, p] - exact[p, p]).sum(axis=1))
    assert np.allclose(repaired, expected, rtol=0, atol=1e-12)
    fill(A, 0.5)
    pc.setUp()
    again = dense(context.smoother.getOperators()[1])
    assert np.allclose(again - repaired, dense(A) - exact, rtol=0, atol=1e-12)
    pc.destroy()


@pytest.mark.mpi
def test_solves_matrices_that_change_and_keeps_what_serves():
    A = blocked_matrix()
    nodes = nodes_of(A)
    b, x = loads(A)
    for growth in (None, 1.5):
        solver = PreparedSolver(two_level(rtol=1e-9, aggregates=16, rebuild_growth=growth), A, nodes)
        for shift in (0.0, 0.01, 3.0, 0.0):
            fill(A, shift)
            solver.solve(b, x)
            assert relative_residual(A, b, x) < 2e-9
        solver.destroy()


@pytest.mark.mpi
@pytest.mark.parametrize("weak", [False, True])
def test_what_is_kept_is_not_made_again_when_the_matrix_has_changed(weak):
    A = blocked_matrix()
    plain = nodes_of(A)
    pc, _ = prepared(A, replace(plain, weak=lambda: plain.x[:, 0] > 0.4) if weak else plain)
    b, x = loads(A)
    pc.apply(b, x)
    fill(A, 3.0)
    pc.setReusePreconditioner(True)
    pc.setUp()
    y = x.duplicate()
    pc.apply(b, y)
    assert (y - x).norm() < 1e-12 * x.norm()
    pc.setReusePreconditioner(False)
    A.stateIncrease()
    pc.setUp()
    pc.apply(b, y)
    assert (y - x).norm() > 1e-3 * x.norm()
    pc.destroy()


@pytest.mark.parametrize("shared", [8_000, 0])
def test_memory_of_matrices_that_are_gone_comes_back(monkeypatch, shared):
    """A matrix of a sixth of a MiB is made anew where other cells are divided; whoever made it frees it first."""
    monkeypatch.setattr("tigar_x.fem.coarse_solver.SHARED", shared)

    def one() -> None:
        A = blocked_matrix()
        b, x = loads(A)
        solver = PreparedSolver(two_level(aggregates=16), A, nodes_of(A))
        solver.solve(b, x)
        for thing in (A, b, x):
            thing.destroy()
        del solver  # the last one to know the matrix

    for lap in range(80):
        one()
        if lap == 20:
            start = rss_mib()
    assert rss_mib() - start < 2.0


@pytest.mark.mpi
def test_falls_back_to_mumps_by_name(caplog):
    A = blocked_matrix()
    b, x = loads(A)
    recipe = two_level(rtol=1e-12, max_iterations=1)
    PreparedSolver(recipe, A, nodes_of(A)).solve(b, x)
    assert "using direct(mumps)" in caplog.text
    assert relative_residual(A, b, x) < 1e-12
    A.scale(np.nan)
    with pytest.raises(SolveError):
        PreparedSolver(two_level(), A, nodes_of(A)).solve(b, x)


def test_needs_nodes_and_blocks():
    for A, nodes in ((blocked_matrix(), None), (blocked_matrix("aij"), nodes_of(blocked_matrix()))):
        with pytest.raises(ValueError, match=r"two_level\(1\).*baij"):
            PreparedSolver(two_level(), A, nodes)
    with pytest.raises(ValueError, match="aggregates = -1"):
        two_level(aggregates=-1)
    with pytest.raises(ValueError, match=r"two_level\(1\).*same nodes"):
        sheet_in_flow(solver=two_level(), taylor_hood=True)


@pytest.mark.mpi
def test_options_of_petsc_change_the_smoother_or_take_its_place(table):  # noqa: F811
    table(fluid_sub_pc_factor_levels=0, fluid_pc_factor_levels=0)
    changed = chosen(two_level(), direct(), "fluid_")
    assert changed.aggregates == 0
    A = blocked_matrix()
    b, x = loads(A)
    solver = PreparedSolver(changed, A, nodes_of(A))
    solver.solve(b, x)
    assert relative_residual(A, b, x) < 1e-7
    inner = solver.preconditioner().getPythonContext().smoother
    if WORLD.size == 1:
        assert inner.getType() == "ilu"
    assert solver.preconditioner().getType() == "python"
    table(fluid_pc_type="sor")
    other = chosen(two_level(), direct(), "fluid_")
    assert other.aggregates is None
    again = PreparedSolver(other, A)
    again.solve(b, x)
    assert again.preconditioner().getType() == "sor"


@pytest.mark.mpi
def test_an_enclosed_flow_is_that_of_a_direct_solver():
    """Its pressure is known up to a constant, on the coarse level as well."""
    flows = [CAVITY.build(16, 2, solver=solver) for solver in (two_level(rtol=1e-6, aggregates=16), direct())]
    for flow in flows:
        flow.solve()
    found, expected = map(CAVITY.errors, flows)
    for name in found:
        assert found[name] == pytest.approx(expected[name], rel=1e-5)


def by_place(w):
    """Values at the nodes of all ranks, which two meshes share out in two ways."""
    V = w.function_space
    own, size = V.dofmap.index_map.size_local, V.dofmap.index_map_bs
    mine = np.hstack([V.tabulate_dof_coordinates()[:own].round(9), w.x.array.reshape(-1, size)[:own]])
    every = np.vstack(WORLD.allgather(mine))
    return every[np.lexsort(every[:, 2::-1].T)][:, 3:]


@pytest.mark.mpi
def test_a_coupled_step_is_that_of_a_direct_solver(caplog):
    """With a band; the couplings of its pressures are repaired."""
    scenes = [sheet_in_flow(n=12, moving=False, traction=1.0, solver=s) for s in (two_level(rtol=1e-8), direct())]
    for scene in scenes:
        for _ in range(2):
            scene.fsi.takeStep()
    assert scenes[0].fluid.system.recipe.name == "two_level(1)"
    assert "using" not in caplog.text
    found, expected = (by_place(scene.w) for scene in scenes)
    assert np.abs(found - expected).max() < 1e-4 * np.abs(expected).max()  # a step leaves this much


def test_weak_couplings_are_repaired_where_there_is_less_fill():
    assert two_level(0).repair == two_level(1).repair > 1.0 == two_level(2).repair


@pytest.mark.mpi
def test_weak_nodes_are_those_whose_cells_are_all_in_the_band():
    scene = sheet_in_flow(n=12, moving=False)
    scene.fsi.takeStep()
    band, V = scene.fluid.band, scene.w.function_space
    weak = band.surrounded(V)
    x = V.tabulate_dof_coordinates()
    own = V.dofmap.index_map.size_local
    cells = compat.cell_dofs(V)[: compat.owned_cells(V.mesh)]
    inside = band.scale_m.x.array[compat.cell_dofs(band.scale_m.function_space)[: len(cells), 0]] < 1.0
    outside = np.vstack(WORLD.allgather(x[np.unique(cells[~inside])]))
    assert WORLD.allreduce(int(weak[:own].sum())) > 10
    for point, is_weak in zip(x, weak, strict=True):
        assert is_weak == (np.abs(outside - point).max(axis=1).min() > 1e-9)


ITERATIONS = """
import json
from mpi4py import MPI
from load import load_demo
from test_two_level import first_iterations
counts = first_iterations()
if MPI.COMM_WORLD.rank == 0:
    print(json.dumps(counts))
"""


def first_iterations():
    """Iterations of a solve of a small heart valve."""
    valve = load_demo("heart_valve")
    _, _, fsi = valve.Valve(resolution=8, preset="plain").build(valve.Data())
    system = fsi.fluid.system
    fsi.takeStep()
    recipe, x = two_level(rtol=1e-6), system.b.duplicate()
    return PreparedSolver(recipe, system.A, system.nodes_of_rows()).solve(system.b, x)


@pytest.mark.slow
def test_iterations_do_not_grow_with_ranks():
    counts = {}
    for ranks in (1, 4):
        done = mpirun(ranks, "-c", ITERATIONS)
        assert done.returncode == 0, done.stderr[-2000:]
        counts[ranks] = eval(done.stdout.splitlines()[-1])
    assert counts[4] <= 1.3 * counts[1] + 1, counts


DIVIDED = ITERATIONS.replace("first_iterations", "iterations_of_steps")


def iterations_of_steps():
    """Iterations of steps of a small heart valve whose pressure jumps."""
    valve = load_demo("heart_valve")
    _, _, fsi = valve.Valve(resolution=8).build(valve.Data())
    assert fsi.fluid.system.recipe.name == "two_level(1)"
    return [fsi.takeStep().linear_iterations for _ in range(4)]


@pytest.mark.slow
def test_iterations_with_jumps_do_not_grow_with_ranks():
    counts = {}
    for ranks in (1, 2, 4):
        done = mpirun(ranks, "-c", DIVIDED)
        assert done.returncode == 0, done.stderr[-2000:]
        counts[ranks] = max(eval(done.stdout.splitlines()[-1]))
    assert max(counts.values()) <= 1.3 * counts[1] + 1, counts


def test_jumps_in_space_are_solved_with_two_levels_unless_options_say_otherwise(table):  # noqa: F811
    build, d = load_demo("manufactured").build, problem.data_of(3, curved=True)
    more = {"data": d, "immersed": "jump", "projected": False}
    _, _, fsi = build(3, 1, 4, CouplingOptions.converged(), None, **more)
    assert fsi.fluid.system.recipe.name == "two_level(0)"
    fsi.takeStep()
    pc = fsi.fluid.system.preconditioner()
    assert isinstance(pc.getPythonContext(), TwoLevel)
    table(fluid_pc_type="jacobi")
    _, _, fsi = build(3, 1, 4, CouplingOptions.converged(), None, **more)
    assert fsi.fluid.system.recipe.aggregates is None
    assert fsi.fluid.system.recipe.options["pc_type"] == "jacobi"
