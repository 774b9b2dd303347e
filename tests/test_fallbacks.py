"""Every fallback of every recipe, each after the failure of what comes before it; what failures leave behind."""

from dataclasses import replace

import numpy as np
import pytest
from mpi4py import MPI
from petsc4py import PETSc
from scenes import sheet_in_flow

from coudalfish import StepError
from tigar_x import compat
from tigar_x.fem.linear import (
    LinearSolver,
    PreparedSolver,
    SolveError,
    automatic,
    direct,
    gmres_ilu,
    gmres_sor,
    multigrid,
)
from varmint.conditions import Traction, Velocity
from varmint.flow import Flow, FlowError, FlowOptions
from varmint.mesh import box

WORLD = MPI.COMM_WORLD
RECIPES = {
    "gmres_ilu": gmres_ilu(),
    "gmres_sor": gmres_sor(),
    "multigrid": multigrid(),
    "plane": automatic(5000, blocked=True, dimension=2),
    "space": automatic(5000, blocked=True, dimension=3),
    "surface": automatic(5000, blocked=True),
    "large": automatic(10**9, blocked=True, dimension=2),
}


def chain(recipe):
    """The recipe and all that may take its place."""
    return [recipe] if recipe.fallback is None else [recipe, *chain(recipe.fallback)]


NEVER = {"ksp_max_it": 1, "ksp_rtol": 1e-30}


LEVELS = {"pc_gamg_coarse_eq_limit": 50}
"""Multigrid has several levels of small matrices too."""


def failing(recipe, kept):
    """The same chain, whose members fail up to one."""
    options = {**recipe.options, **(LEVELS if recipe.name == "multigrid" else {})}
    if recipe is kept:
        return replace(recipe, options=options)
    return replace(recipe, options={**options, **NEVER}, fallback=failing(recipe.fallback, kept))


def hopeless():
    """GMRES, then multigrid, and both fail."""
    last = replace(multigrid(), options={**multigrid().options, **LEVELS, **NEVER}, fallback=None)
    return gmres_ilu(max_iterations=1, rtol=1e-30, fallback=last)


PLACES = [
    pytest.param(recipe, i, id=f"{name}-{last.name}")
    for name, recipe in RECIPES.items()
    for i, last in enumerate(chain(recipe))
]


def blocked_matrix(kind="baij", n=12, size=4):
    """Convection and diffusion of coupled components on n x n points of a square, distributed by rows of points."""
    A = PETSc.Mat().create(WORLD)
    A.setSizes((size * n * n, size * n * n))
    A.setType(kind)
    A.setBlockSize(size)
    A.setPreallocationNNZ((5, 4) if kind == "baij" else (5 * size, 4 * size))
    fill(A, 0.0, n, size)
    return A


def fill(A, shift, n=12, size=4):
    A.zeroEntries()
    coupling = np.eye(size) + 0.3 * np.triu(np.ones((size, size)), 1)
    first, last = (row // size for row in A.getOwnershipRange())
    for point in range(first, last):
        i, j = divmod(point, n)
        A.setValuesBlocked([point], [point], (4.0 + shift) * coupling)
        for k, at, factor in ((i - 1, j, 1.3), (i + 1, j, 0.7), (i, j - 1, 1.2), (i, j + 1, 0.8)):
            if min(k, at) >= 0 and max(k, at) < n:
                A.setValuesBlocked([point], [k * n + at], -factor * np.eye(size))
    A.assemble()


def loads(A):
    x, b = A.createVecs()
    b.array_w[:] = np.sin(np.arange(*A.getOwnershipRange()))
    return b, x


def relative_residual(A, b, x):
    r = b.duplicate()
    A.mult(x, r)
    return (r - b).norm() / b.norm()


def options_in_table():
    return {key for key in PETSc.Options().getAll() if key.startswith("tigar_x")}


@pytest.mark.mpi
@pytest.mark.parametrize(("recipe", "place"), PLACES)
def test_every_fallback_solves_after_the_failure_of_its_predecessors(recipe, place, caplog):
    A = blocked_matrix(recipe.matrix)
    b, x = loads(A)
    members = chain(recipe)
    solver = PreparedSolver(failing(recipe, members[place]), A)
    for shift in (0.0, 0.5, 0.5):
        fill(A, shift)
        caplog.clear()
        solver.solve(b, x)
        assert relative_residual(A, b, x) < 1e-7
        used = [record.getMessage().split("using ")[-1] for record in caplog.records]
        assert used == [member.name for member in members[1 : place + 1]]
    assert not options_in_table()


@pytest.mark.mpi
def test_failures_leave_no_options_behind():
    """PETSc's table has some hundred places, and multigrid takes twenty."""
    A = blocked_matrix()
    b, x = loads(A)
    solver = PreparedSolver(hopeless(), A)
    for _ in range(40):
        with pytest.raises(SolveError, match=r"^multigrid failed after 1 iterations \(PETSc reason -3\)"):
            solver.solve(b, x)
        assert not options_in_table()
    kept = [PreparedSolver(multigrid(), A) for _ in range(3)]
    for one in kept:
        one.solve(b, x)
    assert not options_in_table()


@pytest.mark.mpi
def test_a_preconditioner_that_someone_keeps_goes_with_its_solver():
    """With its factors; PETSc would keep them until the end of the run."""
    A = blocked_matrix()
    fill(A, 3.0)
    solver = PreparedSolver(direct(), A)
    kept = solver.preconditioner()
    assert kept.handle
    assert solver.preconditioner() is kept
    del solver
    compat.free_dropped(A.comm.tompi4py())  # several ranks free together what one frees at once
    assert not kept.handle


def test_an_unknown_option_fails_in_words_and_falls_back():
    A = blocked_matrix("aij")
    b, x = loads(A)
    broken = LinearSolver("odd", {"ksp_type": "no such method", "pc_type": "jacobi"})
    with pytest.raises(SolveError, match=r"^odd failed after 0 iterations \(PETSc: error code"):
        PreparedSolver(broken, A).solve(b, x)
    PreparedSolver(replace(broken, fallback=direct()), A).solve(b, x)
    assert relative_residual(A, b, x) < 1e-12
    assert not options_in_table()


# -- recipes of one's own ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "is_direct", "rtol"),
    [
        ({"ksp_type": "cg", "pc_type": "jacobi"}, False, 1e-5),
        ({"ksp_type": "cg", "pc_type": "jacobi", "ksp_rtol": 1e-3}, False, 1e-3),
        ({}, False, 1e-5),
        ({"ksp_type": "preonly", "pc_type": "lu"}, True, 0.0),
        ({"ksp_type": "preonly", "pc_type": "cholesky", "ksp_rtol": 1e-3}, True, 0.0),
        ({"ksp_type": "preonly", "pc_type": "jacobi"}, False, 1e-5),
        ({"ksp_type": "gmres", "pc_type": "lu"}, False, 1e-5),
    ],
)
def test_direct_is_what_applies_a_factorisation_once(options, is_direct, rtol):
    recipe = LinearSolver("own", options)
    assert recipe.is_direct == is_direct
    assert recipe.rtol == rtol


@pytest.mark.mpi
def test_a_recipe_without_a_tolerance_has_that_of_petsc_and_heeds_a_reference():
    A = blocked_matrix("aij")
    b, x = loads(A)
    options = {"ksp_type": "gmres", "pc_type": "jacobi", "ksp_pc_side": "right", "ksp_gmres_restart": 100}
    solver = PreparedSolver(LinearSolver("own", options), A)
    few = solver.solve(b, x, 1e3 * b.norm())
    assert 1e-4 < relative_residual(A, b, x) <= 1e-2
    many = solver.solve(b, x)
    assert 1e-8 < relative_residual(A, b, x) <= 1e-5
    assert few < many
    solver = PreparedSolver(LinearSolver("own", {**options, "ksp_atol": 0.1 * b.norm()}), A)
    solver.solve(b, x)
    assert 1e-3 < relative_residual(A, b, x) <= 0.1


@pytest.mark.mpi
def test_one_application_of_a_preconditioner_is_no_solution():
    """It has tested no residual, so that is done for it."""
    A = blocked_matrix("aij")
    b, x = loads(A)
    once = LinearSolver("once", {"ksp_type": "preonly", "pc_type": "jacobi"})
    with pytest.raises(SolveError, match="its residual is too large"):
        PreparedSolver(once, A).solve(b, x)
    PreparedSolver(once, A).solve(b, x, 1e6 * b.norm())


# -- in steps ---------------------------------------------------------------------------------------------------------


def duct(**options):
    mesh = box(WORLD, (0.0, 0.0), (2.0, 1.0), (6, 4))
    inlet = Velocity("left", lambda x, t: (t * x[1] * (1 - x[1]), 0.0))
    conditions = [Velocity(("bottom", "top")), inlet, Traction("right")]
    return Flow(mesh, conditions, rho=1.0, mu=0.1, dt=0.1, options=FlowOptions(**options))


@pytest.mark.mpi
def test_steps_of_a_flow_whose_solvers_fail_but_the_last():
    """More steps than PETSc's table would have room for."""
    flow = duct(solver=failing(RECIPES["space"], chain(RECIPES["space"])[-1]), rtol=1e-9)
    other = duct(solver=direct(), rtol=1e-9, pressure="pin")
    for _ in range(12):
        flow.take_step()
        other.take_step()
    np.testing.assert_allclose(flow.w.x.array, other.w.x.array, atol=1e-7)
    assert np.abs(other.w.x.array).max() > 0.05


@pytest.mark.mpi
def test_errors_of_all_solvers_arrive_as_those_of_the_step():
    flow = duct(solver=hopeless())
    for _ in range(12):
        with pytest.raises(FlowError, match="multigrid failed after 1 iterations"):
            flow.take_step()
    sheet = sheet_in_flow(solver=hopeless(), traction=1.0)
    for _ in range(12):
        with pytest.raises(StepError, match="multigrid failed after 1 iterations"):
            sheet.fsi.takeStep()
