"""PETSc's options before those of recipes, solvers configured by a callable, and KSPs of users' own."""

import json
import logging
import subprocess
import sys
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
import ufl
from mpi4py import MPI
from dolfinx import fem
from mpi_runs import outside
from petsc4py import PETSc
from scenes import sheet_in_flow
from test_fallbacks import blocked_matrix, loads, relative_residual
from test_motion import ALPHA, DT, FACES, brick

from shnapr.shell import Shell
from shnapr.svk import StVenantKirchhoff
from tigar_x import compat
from tigar_x.fem.eigen import eigenpairs
from tigar_x.fem.linear import LinearSolver, PreparedSolver, SolveError, chosen, direct, gmres_ilu, gmres_sor
from tigar_x.fem.petsc_options import RTOL, taken
from tigar_x.fem.solve import FiniteElementSystem
from tigar_x.geometry import shapes
from tigar_x.run import script
from tigar_x.run.summary import plain
from varmint.conditions import Traction, Velocity
from varmint.flow import Flow, FlowOptions
from varmint.forms.motion import ElasticMotion
from varmint.mesh import box

WORLD = MPI.COMM_WORLD
CG, PACKAGE, BLOCKS = {"ksp_type": "cg", "pc_type": "jacobi"}, "pc_factor_mat_solver_type", "baij"


@pytest.fixture
def table(monkeypatch):
    """Writes into PETSc's table, which is left as it was."""
    options = PETSc.Options()
    before = options.getAll()

    def write(**given):
        for key, value in given.items():
            options.setValue(key, value)

    yield write
    for key in options.getAll():
        if key not in before:
            options.delValue(key)


def prefixed(recipe=None, prefix="fluid_"):
    return chosen(recipe, direct(), prefix)


# -- options before a recipe's ----------------------------------------------------------------------------------------


def test_what_is_not_given_changes_nothing(table):
    table(shell_ksp_type="cg", fluid_snes_rtol=1, ksp_type="cg", valve_pc_type="none")
    recipe = gmres_ilu()
    assert prefixed(recipe) is recipe
    assert prefixed() == direct()


@pytest.mark.parametrize(
    ("recipe", "given", "found", "matrix"),
    [
        (
            gmres_ilu(rtol=1e-3),
            {"ksp_rtol": "1e-9"},
            {"ksp_type": "gmres", "pc_type": "asm", "ksp_rtol": "1e-9"},
            BLOCKS,
        ),
        (gmres_ilu(), {"pc_type": "hypre"}, {"pc_type": "hypre", "ksp_rtol": 1e-8, "ksp_type": "gmres"}, "aij"),
        (gmres_ilu(), {"pc_type": "sor", "mat_type": "aij"}, {"pc_type": "sor"}, "aij"),
        (gmres_ilu(), {"pc_type": "jacobi"}, {"pc_type": "jacobi"}, BLOCKS),
        (direct(), CG, {"ksp_rtol": RTOL, "ksp_norm_type": "unpreconditioned"}, "aij"),
        (direct(), {**CG, "ksp_rtol": "0.1"}, {"ksp_rtol": "0.1"}, "aij"),
        (direct(), {PACKAGE: "petsc"}, {PACKAGE: "petsc", "pc_type": "lu"}, "aij"),
    ],
)
def test_options_go_before_those_of_the_recipe(recipe, given, found, matrix, table):
    table(**{f"fluid_{key}": value for key, value in given.items()})
    changed = prefixed(recipe)
    assert {key: changed.options.get(key) for key in found} == found
    assert changed.matrix == matrix
    assert changed.fallback is recipe.fallback
    assert changed.name.startswith(f"{recipe.name} with -fluid_")
    assert prefixed(changed) is changed
    assert not any(key.startswith(("sub_", "pc_asm")) for key in changed.options) or "pc_type" not in given
    assert changed.is_direct == (recipe.is_direct and "pc_type" not in given)


def test_methods_keep_to_the_true_residual_where_they_know_it(table):
    table(fluid_ksp_type="cg", shell_ksp_type="minres")
    assert prefixed(gmres_ilu()).options["ksp_norm_type"] == "unpreconditioned"
    assert "ksp_pc_side" not in prefixed(gmres_ilu()).options
    assert "ksp_norm_type" not in prefixed(gmres_ilu(), "shell_").options


def test_a_recipe_has_a_prefix_of_its_own(table):
    table(fluid_ksp_rtol="1e-3", valve_ksp_rtol="1e-4")
    assert prefixed(replace(gmres_ilu(), prefix="valve_")).rtol == 1e-4


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("fluid_ksp_rtol", "small", "-fluid_ksp_rtol = 'small': a finite number"),
        ("fluid_ksp_atol", "-1", "-fluid_ksp_atol = -1.0: a number >= 0"),
        ("fluid_mat_type", "dense", "-fluid_mat_type = 'dense': one of 'aij', 'baij'"),
    ],
)
def test_values_that_cannot_be(key, value, message, table):
    table(**{key: value})
    with pytest.raises(ValueError, match=message):
        prefixed()


@pytest.mark.mpi
def test_they_solve_and_stay_in_the_table_alone(table):
    """Those of the recipe are there in a solve only, and the user's are left."""
    A = blocked_matrix()
    b, x = loads(A)
    table(fluid_ksp_rtol="1e-12", fluid_ksp_max_it="300", mg_levels_pc_type="none")
    before = PETSc.Options().getAll()
    for recipe in (gmres_ilu(rtol=1e-2), gmres_sor(rtol=1e-2)):
        PreparedSolver(recipe, A).solve(b, x)
        assert relative_residual(A, b, x) > 1e-9
        solver = PreparedSolver(prefixed(recipe), A)
        solver.solve(b, x)
        assert relative_residual(A, b, x) <= 1e-12
        assert solver._ksp.getOptionsPrefix() == "fluid_"
        assert PETSc.Options().getAll() == before


@pytest.mark.mpi
def test_what_fails_with_them_falls_back_to_recipes_without_them(table, caplog):
    A = blocked_matrix()
    b, x = loads(A)
    table(fluid_ksp_max_it="1", fluid_ksp_rtol="1e-30")
    PreparedSolver(prefixed(gmres_ilu()), A).solve(b, x)
    assert relative_residual(A, b, x) <= 1e-8
    said = [record.getMessage() for record in caplog.records if record.levelno >= logging.WARNING]
    assert len(said) == 1
    assert said[0].startswith("gmres_ilu(1) with -fluid_ksp_max_it 1 -fluid_ksp_rtol 1e-30 failed")
    assert said[0].endswith("using gmres_sor")


def test_on_one_rank_both_names_of_the_subdomain_s_options_are_heard(table):
    A = blocked_matrix()
    b, x = loads(A)
    counts = []
    for given in (
        {},
        {"fluid_sub_pc_factor_levels": "6"},
        {"fluid_pc_factor_levels": "6"},
        {"fluid_pc_asm_blocks": "6"},
    ):
        for key in PETSc.Options().getAll():
            PETSc.Options().delValue(key)
        table(**given)
        solver = PreparedSolver(prefixed(gmres_ilu(0)), A)
        counts.append(solver.solve(b, x))
        assert solver._ksp.getPC().getType() == ("asm" if "fluid_pc_asm_blocks" in given else "ilu")
    assert counts[1] == counts[2] < counts[0]


def duct(**options):
    mesh = box(WORLD, (0.0, 0.0), (2.0, 1.0), (6, 4))
    inlet = Velocity("left", lambda x, t: (t * x[1] * (1 - x[1]), 0.0))
    conditions = [Velocity(("bottom", "top")), inlet, Traction("right")]
    return Flow(mesh, conditions, rho=1.0, mu=0.1, dt=0.1, options=FlowOptions(**options))


def used(system):
    return system._solver._ksp.getType()


@pytest.mark.mpi
def test_every_system_has_its_prefix(table):
    table(fluid_ksp_type="gcr", fluid_pc_type="jacobi", fluid_ksp_rtol="1e-10", fluid_ksp_gcr_restart="300")
    table(shell_ksp_type="fgmres")
    flow = duct()
    flow.take_step()
    assert used(flow.system) == "gcr"
    assert flow.recipe.rtol == flow.system.linear_rtol == 1e-10
    sheet = sheet_in_flow(traction=1.0)
    sheet.fsi.takeStep()
    assert used(sheet.fluid.system) == "gcr"
    assert used(sheet.shell.system) == "fgmres"
    assert sheet.fluid.linear_accuracy > 0.0
    strip = Shell(shapes.line((0, 0), (1, 0), elements=4, degree=2), StVenantKirchhoff(1e3, 0.3, 0.1), clamped=("u0",))
    assert strip.solver.options["ksp_type"] == strip.system._recipe.options["ksp_type"] == "fgmres"


@pytest.mark.mpi
def test_options_without_a_prefix_are_for_systems_made_by_hand(table):
    table(ksp_type="cg", pc_type="jacobi")
    sheet = sheet_in_flow()
    for recipe in (duct().system.recipe, sheet.fluid.system.recipe, sheet.shell.system._recipe):
        assert recipe.is_direct
    V = compat.lagrange_space(sheet.domain, 1, 3)
    u = fem.Function(V)
    system = FiniteElementSystem(ufl.inner(u, ufl.TestFunction(V)) * ufl.dx, u)
    assert system.recipe.options["ksp_type"] == "cg"


@pytest.mark.mpi
def test_meshes_and_projections_have_theirs(table, monkeypatch):
    """And projections none of systems made by hand."""
    made = []
    monkeypatch.setattr(PreparedSolver, "__init__", recorded(made, PreparedSolver.__init__))
    table(mesh_ksp_type="cg", mesh_pc_type="jacobi", projection_ksp_type="gmres", ksp_type="bicg")
    mesh = brick("triangle")
    ElasticMotion(mesh, dict.fromkeys(FACES[:4]), DT, ALPHA)
    flow = duct()
    flow.start((0.1, 0.0), projected=True)
    flow.consistent_start()
    assert [recipe.options["ksp_type"] for recipe in made] == ["cg", "gmres", "preonly"]


def recorded(made, init):
    def of(self, recipe, *more):
        made.append(recipe)
        init(self, recipe, *more)

    return of


def test_slepc_has_its_own(table):
    pytest.importorskip("slepc4py")
    K = PETSc.Mat().createAIJ((40, 40), nnz=3, comm=MPI.COMM_SELF)
    M = PETSc.Mat().createAIJ((40, 40), nnz=1, comm=MPI.COMM_SELF)
    for i in range(40):
        K[i, max(i - 1, 0) : min(i + 2, 40)] = [-1.0] * (i > 0) + [2.0] + [-1.0] * (i < 39)
        M[i, i] = 1.0
    K.assemble()
    M.assemble()
    assert eigenpairs(K, M, 2, backend="slepc").values[0] == pytest.approx(2 - 2 * np.cos(np.pi / 41))
    table(st_pc_type="none")
    with pytest.raises(SolveError, match=r"residual|SLEPc"):
        eigenpairs(K, M, 2, backend="slepc")


# -- solvers that users bring -----------------------------------------------------------------------------------------


def configured(**more):
    def configure(ksp):
        ksp.setType("bcgs")
        ksp.setNormType(PETSc.KSP.NormType.UNPRECONDITIONED)
        ksp.setTolerances(rtol=1e-11, max_it=400)
        ksp.getPC().setType("jacobi")

    return LinearSolver("mine", {}, configure=configure, **more)


@pytest.mark.mpi
def test_a_callable_configures_the_ksp_and_the_table_goes_first(table):
    A = blocked_matrix("aij")
    b, x = loads(A)
    solver = PreparedSolver(configured(), A)
    solver.solve(b, x)
    assert relative_residual(A, b, x) <= 1e-11
    assert solver.rtol == 1e-11
    solver.solve(b, x, 1e6 * b.norm())
    assert 1e-8 < relative_residual(A, b, x) <= 1e-5
    table(fluid_ksp_rtol="1e-4", fluid_ksp_type="gmres")
    solver = PreparedSolver(prefixed(configured()), A)
    solver.solve(b, x)
    assert (solver._ksp.getType(), solver._ksp.getPC().getType(), solver.rtol) == ("gmres", "jacobi", 1e-4)
    assert 1e-11 < relative_residual(A, b, x) <= 1e-4


@pytest.mark.mpi
def test_a_configured_solver_that_fails_falls_back_and_is_configured_again():
    A = blocked_matrix("aij")
    b, x = loads(A)
    calls = []

    def configure(ksp):
        calls.append(ksp)
        ksp.setTolerances(rtol=1e-30, max_it=1)

    solver = PreparedSolver(LinearSolver("mine", {}, configure=configure, fallback=direct()), A)
    for _ in range(2):
        solver.solve(b, x)
        assert relative_residual(A, b, x) <= 1e-12
    assert len(calls) == 2


def own(comm=WORLD, **tolerances):
    ksp = PETSc.KSP().create(comm)
    ksp.setOptionsPrefix("own_")
    ksp.setType("gmres")
    ksp.getPC().setType("jacobi")
    ksp.setPCSide(PETSc.PC.Side.RIGHT)
    ksp.setTolerances(**({"rtol": 1e-10, "max_it": 400} | tolerances))
    return ksp


@pytest.mark.mpi
def test_a_ksp_of_one_s_own_serves_and_stays_as_it_was(table):
    """For two matrices of different sizes in turn, and after the solvers are gone; the table does not change it."""
    table(fluid_ksp_rtol="1e-1", fluid_ksp_type="cg")
    ksp = own()
    recipe = prefixed(ksp)
    assert (recipe.name, recipe.rtol, recipe.is_direct, recipe.ksp) == ("own", 1e-10, False, ksp)
    matrices = [blocked_matrix("aij", n) for n in (12, 8)]
    solvers = [PreparedSolver(recipe, A) for A in matrices]
    for A, solver in zip(2 * matrices, 2 * solvers, strict=True):
        b, x = loads(A)
        solver.solve(b, x)
        assert relative_residual(A, b, x) <= 1e-10
        solver.solve(b, x, 1e6 * b.norm())
        assert relative_residual(A, b, x) > 1e-9
        assert ksp.getTolerances()[:2] == (1e-10, recipe.options["ksp_atol"])
    for solver in solvers:
        solver.destroy()
    assert ksp.getType() == "gmres"
    PreparedSolver(prefixed(ksp), matrices[0]).solve(*loads(matrices[0]))


@pytest.mark.mpi
def test_a_ksp_that_fails_may_have_a_fallback_and_may_be_a_factorisation():
    A = blocked_matrix("aij")
    b, x = loads(A)
    with pytest.raises(SolveError, match="own failed after 1 iterations"):
        PreparedSolver(prefixed(own(max_it=1)), A).solve(b, x)
    PreparedSolver(LinearSolver("short", {}, ksp=own(max_it=1), fallback=direct()), A).solve(b, x)
    assert relative_residual(A, b, x) <= 1e-12
    ksp = own()
    ksp.setType("preonly")
    ksp.getPC().setType("lu")
    ksp.getPC().setFactorSolverType("mumps")
    assert prefixed(ksp).is_direct
    A.zeroEntries()
    A.assemble()
    solver = PreparedSolver(prefixed(ksp), A)
    with pytest.raises(SolveError, match="own failed"):
        solver.solve(b, x)
    A = blocked_matrix("aij")
    A.copy(solver._A)
    solver.solve(b, x)
    assert relative_residual(A, b, x) <= 1e-12


@pytest.mark.mpi
def test_flows_and_shells_take_them():
    """The same steps as with recipes, to the tolerance."""
    flows = [duct(rtol=1e-9, pressure="pin", solver=solver) for solver in (direct(), own(), configured())]
    for flow in flows:
        flow.take_step()
        np.testing.assert_allclose(flow.w.x.array, flows[0].w.x.array, atol=1e-7)
    assert (used(flows[1].system), used(flows[2].system)) == ("gmres", "bcgs")
    sheet = sheet_in_flow(solver=own(rtol=1e-12, max_it=1000))
    sheet.fsi.takeStep()
    assert used(sheet.fluid.system) == "gmres"


def test_what_is_no_solver_is_refused():
    with pytest.raises(ValueError, match=r"solver = 'mumps': a recipe such as direct\(\).*PETSc.KSP is required"):
        FlowOptions(solver="mumps")
    with pytest.raises(ValueError, match="mine: ksp and configure are given"):
        LinearSolver("mine", {}, ksp=own(), configure=print)


@pytest.mark.mpi
@pytest.mark.skipif(WORLD.size == 1, reason="all communicators of one rank are alike")
def test_a_ksp_of_other_ranks_is_refused():
    with pytest.raises(ValueError, match="lives on 1 ranks, one on the communicator of the matrix, of 2"):
        PreparedSolver(prefixed(own(MPI.COMM_SELF)), blocked_matrix("aij"))


def test_summaries_name_them():
    @dataclass
    class Inputs:
        solver: Any

    text = json.dumps(plain(Inputs(configured(ksp=None))))
    assert "configure" in text
    assert json.loads(json.dumps(plain(Inputs(prefixed(own())))))["solver"]["name"] == "own"


# -- the command line -------------------------------------------------------------------------------------------------


def main(level: int = 1, name: str = ""):
    """Solve nothing."""
    return level, name, PETSc.Options().getAll()


@pytest.mark.usefixtures("table")
@pytest.mark.parametrize(
    ("line", "level", "options"),
    [
        ("-fluid_ksp_rtol 1e-10 --level 3", 3, {"fluid_ksp_rtol": "1e-10"}),
        ("--level 3 -shell_ksp_monitor -ksp_atol -1", 3, {"shell_ksp_monitor": None, "ksp_atol": "-1"}),
        ("-mesh_sub_pc_type none -eps_tol 1e-9 --level -2", -2, {"mesh_sub_pc_type": "none", "eps_tol": "1e-9"}),
    ],
)
def test_options_with_one_dash_go_into_petsc_s_table(line, level, options):
    found = script.command_line(main, line.split())
    assert found[0] == level
    assert found[2].items() >= options.items()
    assert "options_left" in found[2]  # so that PETSc names at the end what nobody has asked for


def test_prefixes_are_those_of_the_script():
    assert taken(["-valve_ksp_type", "cg"], ("valve_",)) == ([], {"valve_ksp_type": "cg"})
    with pytest.raises(ValueError, match=r"-fluid_ksp_type: options of a script begin .*-valve_ksp_type"):
        taken(["-fluid_ksp_type", "cg"], ("valve_",))


@pytest.mark.parametrize(
    "line", ["-level 3", "-flud_ksp_rtol 1", "-fluid_kps_rtol 1", "-log_view", "-fluid_ksp_rtol=1"]
)
def test_what_is_no_option_of_a_solver_is_refused_in_words(line, capsys):
    before = PETSc.Options().getAll()
    with pytest.raises(SystemExit) as caught:
        script.command_line(main, line.split())
    assert caught.value.code == 2
    said = capsys.readouterr().err
    assert f"{line.split()[0]}: options of a script begin with two dashes" in said
    assert "-fluid_ksp_type" in said
    assert PETSc.Options().getAll() == before


def test_help_tells_of_them(capsys):
    with pytest.raises(SystemExit):
        script.command_line(main, ["-h"])
    words = " ".join(capsys.readouterr().out.split())
    assert "Options with one dash are PETSc's" in words
    assert "-shell_ksp_rtol: shells" in words


def test_at_the_end_petsc_names_what_no_solver_has_asked_for():
    """On one rank the options of the only subdomain are asked for by another name, and count."""
    code = (
        "from test_fallbacks import blocked_matrix, loads\n"
        "from tigar_x.fem.linear import PreparedSolver, chosen, gmres_ilu\n"
        "from tigar_x.run import script\n"
        "def main(n: int = 3):\n"
        "    A = blocked_matrix(n=n)\n"
        "    PreparedSolver(chosen(gmres_ilu(), gmres_ilu(), 'fluid_'), A).solve(*loads(A))\n"
        "script.command_line(main)\n"
    )
    names = ("fluid_ksp_rtoll", "fluid_ksp_rtol", "fluid_sub_pc_factor_levels", "shell_pc_type")
    given = [word for name, value in zip(names, ("1", "1e-9", "2", "lu"), strict=True) for word in (f"-{name}", value)]
    done = subprocess.run(
        [sys.executable, "-c", code, *given], capture_output=True, text=True, env=outside(), check=True
    )
    left = {word.removeprefix("name:-") for word in done.stdout.split() if word.startswith("name:-")}
    assert left == {"fluid_ksp_rtoll", "shell_pc_type"}
