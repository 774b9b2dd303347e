"""Linear solver recipes: agreement, fallbacks, kept preconditioners and what they refuse."""

import logging
from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse as sp
import ufl
from mpi4py import MPI
from dolfinx import fem, mesh
from petsc4py import PETSc

from tigar_x import compat
from tigar_x.fem.linear import PreparedSolver, SolveError, direct, gmres_ilu, gmres_sor
from tigar_x.fem.projection import project
from tigar_x.fem.solve import FiniteElementSystem, newton

WORLD = MPI.COMM_WORLD


def petsc_matrix(S):
    """Matrix on this rank alone; explicit zeros stay in its pattern."""
    S = sp.csr_matrix(S)
    S.sort_indices()
    A = PETSc.Mat().createAIJ(S.shape, csr=(S.indptr, S.indices, S.data.astype(float)), comm=MPI.COMM_SELF)
    A.assemble()
    return A


def full(rows):
    """All entries of a small matrix, zeros included, as sparse matrix."""
    a = np.array(rows, dtype=float)
    n = len(a)
    return sp.csr_matrix((a.ravel(), np.tile(np.arange(n), n), n * np.arange(n + 1)), shape=(n, n))


def convection(n=14, speed=6.0):
    """Five-point stencil of a nonsymmetric problem on n x n points; ILU(0) is not exact for it."""
    D = sp.diags([-1.0, 2.0, -1.0], [-1, 0, 1], (n, n)) + speed / n * sp.diags([-1.0, 1.0], [-1, 1], (n, n))
    return sp.csr_matrix(sp.kron(D, sp.identity(n)) + sp.kron(sp.identity(n), D))


def tridiagonal(shift, n=60):
    """ILU(0) of a tridiagonal matrix is its LU, so that a fresh preconditioner needs one iteration."""
    return sp.diags([-1.0, 2.0, -1.0], [-1, 0, 1], (n, n)) + sp.diags(shift * np.linspace(0, 1, n) ** 2)


def residual(A, b, x):
    r = b.duplicate()
    A.mult(x, r)
    r.aypx(-1.0, b)
    return r.norm()


def ones(A):
    x, b = A.createVecs()
    b.set(1.0)
    return b, x


# -- linear recipes ---------------------------------------------------------------------------------------------------


def advection_diffusion(solver):
    """Three coupled components with strong conditions on a whole side and on single components elsewhere."""
    domain = mesh.create_unit_square(WORLD, 8, 8)
    V = compat.lagrange_space(domain, 1, 3)
    u, v, X = fem.Function(V), ufl.TestFunction(V), ufl.SpatialCoordinate(domain)
    coupling = ufl.as_matrix([[1.0, 2.0, 0.0], [-2.0, 1.0, 0.5], [0.0, 3.0, 0.0]])
    wind = ufl.as_vector([4.0 - X[1], 2.0 * X[0]])
    form = 0.1 * ufl.inner(ufl.grad(u), ufl.grad(v)) + ufl.dot(ufl.grad(u) * wind + coupling * u, v)
    form -= ufl.dot(ufl.as_vector([1.0, X[0], X[1]]), v)

    g = fem.Function(V)
    g.interpolate(lambda x: np.stack([x[1], 1.0 - x[1], 0.3 + 0.0 * x[1]]))
    left = fem.locate_dofs_geometrical(V, lambda x: np.isclose(x[0], 0.0))
    bcs = [
        fem.dirichletbc(g, left),
        compat.pin_component(V, 1, lambda x: np.isclose(x[0], 1.0), -0.25),
        compat.pin_component(V, 2, lambda x: np.isclose(x[0], 1.0) & np.isclose(x[1], 1.0), 7.0),
    ]
    return FiniteElementSystem(form * ufl.dx, u, bcs, solver=solver), g


def solved(solver):
    system, g = advection_diffusion(solver)
    system.apply_boundary_values()
    report = newton(system, rtol=1e-9, max_iterations=1)
    return system, g, report


def warnings(caplog):
    return [r.getMessage() for r in caplog.records if r.name.startswith("tigar_x") and r.levelno >= logging.WARNING]


@pytest.mark.mpi
@pytest.mark.parametrize("levels", [0, 1])
def test_direct_and_iterative_solutions_agree(levels, caplog):
    reference, _, _ = solved(direct())
    system, _, report = solved(gmres_ilu(levels, rtol=1e-11))
    assert reference.A.getType() in ("seqaij", "mpiaij")
    assert system.A.getType() in ("seqbaij", "mpibaij")
    assert system.A.getBlockSize() == 3
    assert 1 < report.linear_iterations[0] < 40
    assert not warnings(caplog)
    np.testing.assert_allclose(system.x.x.array, reference.x.x.array, rtol=0, atol=1e-8)
    assert np.abs(reference.x.x.array).max() > 0.3


@pytest.mark.mpi
@pytest.mark.parametrize("solver", [direct(), gmres_ilu(1, rtol=1e-11)])
def test_constraints_hold_exactly(solver):
    system, g, _ = solved(solver)
    x, u = system.x.function_space.tabulate_dof_coordinates(), system.x.x.array.reshape(-1, 3)
    left, right = np.isclose(x[:, 0], 0.0), np.isclose(x[:, 0], 1.0)
    corner = right & np.isclose(x[:, 1], 1.0)
    np.testing.assert_array_equal(u[left], g.x.array.reshape(-1, 3)[left])
    np.testing.assert_array_equal(u[right, 1], -0.25)
    np.testing.assert_array_equal(u[corner, 2], 7.0)
    rest = np.concatenate([u[~left & ~right].ravel(), u[right, 0], u[right & ~corner, 2]])
    assert not np.isin(rest, [-0.25, 7.0]).any()


@pytest.mark.mpi
@pytest.mark.parametrize(
    ("fallback", "names"),
    [
        (direct(), ["direct(mumps)"]),
        (None, ["gmres_sor"]),
        (gmres_sor(max_iterations=1), ["gmres_sor", "direct(mumps)"]),
    ],
)
def test_fallbacks_are_used_in_order_and_logged(fallback, names, caplog):
    reference, _, _ = solved(direct())
    system, _, report = solved(gmres_ilu(0, max_iterations=1, rtol=1e-11, fallback=fallback))
    np.testing.assert_allclose(system.x.x.array, reference.x.x.array, rtol=0, atol=1e-7)
    assert report.linear_iterations[0] > 1
    messages = warnings(caplog)
    assert [message.split("using ")[1] for message in messages] == names
    assert messages[0].startswith("gmres_ilu(0) failed")


@pytest.mark.parametrize("solver", [direct(), direct("petsc"), gmres_ilu(0), replace(gmres_ilu(1), fallback=None)])
@pytest.mark.parametrize(
    "rows",
    [
        [[1, 2, 0], [0, 0, 0], [0, 1, 3]],  # an empty row
        [[0, 0, 0], [0, 0, 0], [0, 0, 0]],
        [[1, -1, 0], [-1, 2, -1], [0, -1, 1]],  # nothing holds it, and the load is not in equilibrium
    ],
)
def test_singular_systems_are_refused(solver, rows):
    A = petsc_matrix(full(rows))
    with pytest.raises(SolveError, match=r"(direct|gmres_ilu)\(\w+\) failed"):
        PreparedSolver(solver, A).solve(*ones(A))


@pytest.mark.parametrize(
    "solver",
    [
        pytest.param(direct()),
        pytest.param(replace(gmres_ilu(0), fallback=None)),
        pytest.param(gmres_ilu(0)),
        direct("petsc"),
    ],
    ids=["mumps", "gmres", "fallback", "petsc"],
)
def test_after_a_singular_system_the_next_one_is_solved(solver):
    A = petsc_matrix(full([[1, 2, 0], [0, 0, 0], [0, 1, 3]]))
    b, x = ones(A)
    prepared = PreparedSolver(solver, A)
    with pytest.raises(SolveError, match="failed"):
        prepared.solve(b, x)
    petsc_matrix(full([[4, 1, 0], [1, 5, 2], [0, 1, 3]])).copy(A, PETSc.Mat.Structure.SAME_NONZERO_PATTERN)
    prepared.solve(b, x)
    assert residual(A, b, x) <= 1e-8 * b.norm()


@pytest.mark.parametrize("solver", [direct(), gmres_ilu(0)])
def test_a_load_that_is_not_finite_is_refused(solver):
    A = petsc_matrix(convection(4))
    b, x = ones(A)
    b.array_w[3] = np.nan
    with pytest.raises(SolveError, match="failed"):
        PreparedSolver(solver, A).solve(b, x)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"levels": -1}, "levels = -1: an integer >= 0"),
        ({"rtol": 0.0}, "rtol = 0.0: a number > 0"),
        ({"rtol": float("nan")}, "rtol = nan"),
        ({"max_iterations": 0}, "max_iterations = 0: an integer >= 1"),
        ({"overlap": -1}, "overlap = -1"),
    ],
)
def test_bad_recipes(change, message):
    with pytest.raises(ValueError, match=message):
        gmres_ilu(**change)


def test_more_fill_needs_fewer_iterations():
    A = petsc_matrix(convection())
    counts = [PreparedSolver(gmres_ilu(levels, rtol=1e-10), A).solve(*ones(A)) for levels in (0, 1, 3, 100)]
    assert counts[0] > counts[1] > counts[2] > counts[3]
    assert counts[3] == 1  # all fill: the factors are exact


class TestRebuild:
    """A preconditioner is kept while it serves."""

    @staticmethod
    def iterations(growth, shifts, **options):
        A = petsc_matrix(tridiagonal(0.0))
        solver = PreparedSolver(replace(gmres_ilu(0, rebuild_growth=growth, **options), fallback=None), A)
        counts = []
        for shift in shifts:
            petsc_matrix(tridiagonal(shift)).copy(A, PETSc.Mat.Structure.SAME_NONZERO_PATTERN)
            b, x = ones(A)
            counts.append(solver.solve(b, x))
            assert residual(A, b, x) <= 1e-8 * b.norm()
        return counts

    def test_without_growth_every_matrix_gets_its_own(self):
        assert self.iterations(None, [0.0, 1e-5, 1e-5, 10.0, 10.0]) == [1] * 5

    def test_kept_while_iterations_stay_low(self):
        first, *kept = self.iterations(4.0, [0.0, 1e-5, 1e-5, 1e-5])
        assert first == 1
        assert min(kept) > 1
        assert max(kept) <= 4 * 1 + 2

    @pytest.mark.parametrize("growth", [None, 4.0])
    def test_the_same_for_another_solver_that_says_how_it_served(self, growth):
        A = petsc_matrix(tridiagonal(0.0))
        solver = PreparedSolver(gmres_ilu(0, rebuild_growth=growth), A)
        (b, x), is_exact = ones(A), []
        for shift, served in ((0.0, 1), (1.0, 6), (1.0, 7), (1.0, 1), (2.0, np.inf), (2.0, 1)):
            petsc_matrix(tridiagonal(shift)).copy(A, PETSc.Mat.Structure.SAME_NONZERO_PATTERN)
            solver.preconditioner().apply(b, x)
            is_exact.append(residual(A, b, x) < 1e-10 * b.norm())
            solver.served(served)
        assert is_exact == ([True] * 6 if growth is None else [True, False, False, True, False, True])

    def test_rebuilt_after_iterations_have_grown(self):
        first, grown, rebuilt, kept = self.iterations(4.0, [0.0, 10.0, 10.0, 10.0 + 1e-5])
        assert grown > 4 * first + 2
        assert rebuilt == 1
        assert 1 < kept <= 6

    def test_rebuilt_at_once_when_the_old_one_fails(self):
        assert self.iterations(4.0, [0.0, 10.0], max_iterations=5) == [1, 1]


class TestReference:
    """The tolerance refers to the given norm, in the recipe and in its fallback."""

    A = petsc_matrix(convection())

    def test_loose_and_tight(self):
        b, x = ones(self.A)
        solver = PreparedSolver(gmres_ilu(0, rtol=1e-4), self.A)
        counts = []
        for factor in (1e5, 1.0, 1e-4):
            counts.append(solver.solve(b, x, factor * b.norm()))
            assert residual(self.A, b, x) <= 1e-4 * factor * b.norm()
        assert counts[0] == 1  # nothing to do
        assert not PreparedSolver(gmres_ilu(0, rtol=1e-4), self.A).solve(b, x) < counts[1] < counts[2]

    def test_without_reference_the_load_is_it_again(self):
        b, x = ones(self.A)
        solver = PreparedSolver(gmres_ilu(0, rtol=1e-6), self.A)
        fresh = solver.solve(b, x)
        solver.solve(b, x, 1e6 * b.norm())
        assert residual(self.A, b, x) > 0.9 * b.norm()
        assert solver.solve(b, x) == fresh
        assert residual(self.A, b, x) <= 1e-6 * b.norm()

    def test_fallback(self):
        b, x = ones(self.A)
        recipe = gmres_ilu(0, max_iterations=1, fallback=gmres_ilu(0, rtol=1e-3))
        PreparedSolver(recipe, self.A).solve(b, x, 1e-6 * b.norm())
        assert residual(self.A, b, x) <= 1e-9 * b.norm()

    def test_direct_solver_needs_none(self):
        b, x = ones(self.A)
        assert PreparedSolver(direct(), self.A).solve(b, x, 1e6 * b.norm()) == 1
        assert residual(self.A, b, x) < 1e-12 * b.norm()


@pytest.fixture
def table_of_options():
    """PETSc's table, left as it was found whatever the test does to it."""
    table = PETSc.Options()
    before = set(table.getAll())
    yield lambda: set(table.getAll()) - before
    for key in set(table.getAll()) - before:
        table.delValue(key)


@pytest.mark.parametrize("solve_at_once", [True, False])
def test_many_solvers_do_not_fill_the_table_of_options(solve_at_once, table_of_options):
    A = petsc_matrix(convection(3))
    b, x = ones(A)
    solvers = []
    for _ in range(600):
        solvers.append(PreparedSolver(gmres_ilu(0), A))
        if solve_at_once:
            solvers[-1].solve(b, x)
    if not solve_at_once:
        for solver in solvers:
            solver.solve(b, x)
    assert residual(A, b, x) <= 1e-8 * b.norm()
    assert not table_of_options()


# -- dense parts of low rank, and fields that are determined up to a constant ------------------------------------------


class Follower:
    """A load ``s a`` whose factor s follows a weighted mean of the unknown, linear or not."""

    def __init__(self, u, v, domain, a, weight, offset):
        self.s = fem.Constant(domain, 0.0)
        self._offset, self._s = offset, weight * u * ufl.dx
        self.load, self.slope = a * v * ufl.dx, weight * v * ufl.dx
        (self._compiled,) = compat.compile_forms(self._s)

    def update(self):
        self.s.value = self._offset + compat.assemble_scalar(self._compiled)


def followed(solver=None, parts=2):
    """A Laplace equation with loads whose factors follow integrals of the solution, and strong values on one side."""
    domain = mesh.create_unit_square(WORLD, 5, 5)
    V = compat.lagrange_space(domain, 1)
    u, v, x = fem.Function(V), ufl.TestFunction(V), ufl.SpatialCoordinate(domain)
    weights = [(x[0], 30 * x[1] ** 2, 0.5), (x[1] - x[0], 20 * x[0], -2.0)][:parts]
    loads = [Follower(u, v, domain, a, weight, offset) for a, weight, offset in weights]
    form = ufl.dot(ufl.grad(u), ufl.grad(v)) * ufl.dx - v * ufl.dx + sum(load.s * load.load for load in loads)
    left = fem.locate_dofs_geometrical(V, lambda x: np.isclose(x[0], 0.0))
    bc = fem.dirichletbc(PETSc.ScalarType(0.25), left, V)
    before = [load.update for load in loads]
    system = FiniteElementSystem(form, u, [bc], solver=solver, rank_one=loads, before=before)
    system.apply_boundary_values()
    return system, loads


@pytest.mark.mpi
@pytest.mark.parametrize("parts", [1, 2])
@pytest.mark.parametrize("solver", [direct(), gmres_ilu(1, rtol=1e-12)], ids=["direct", "gmres"])
def test_loads_that_follow_the_solution_are_solved_for_in_one_step(parts, solver):
    system, loads = followed(solver, parts)
    report = newton(system, rtol=1e-9, max_iterations=1)
    assert len(report.norms) == 2
    assert all(abs(float(load.s.value)) > 0.05 for load in loads)
    assert report.linear_iterations[0] >= 1 + parts  # one solve for every load


@pytest.mark.mpi
def test_without_their_tangent_they_are_not():
    system, _ = followed()
    system._low_rank = None
    with pytest.raises(SolveError, match="did not converge in 3 iterations"):
        newton(system, rtol=1e-9, max_iterations=3)


def test_low_rank_against_a_dense_matrix():
    """K + sum a s'^T, assembled in full, without rows and columns of constrained dofs."""
    system, loads = followed()
    system.assemble_residual()
    system.assemble_tangent()
    increment = system.solve().array_r.copy()
    n = len(increment)
    K = system.A.getValues(range(n), range(n))
    for load in loads:
        a, s = (compat.create_vector(system.x.function_space) for _ in range(2))
        for vector, form in zip((a, s), compat.compile_forms(load.load, load.slope), strict=True):
            compat.assemble_vector(vector, form)
            vector.array_w[system.constrained] = 0.0
        K += np.outer(a.array_r, s.array_r)
    np.testing.assert_allclose(increment, np.linalg.solve(K, system.b.array_r), atol=1e-13)
    np.testing.assert_allclose(increment[system.constrained], 0.0, atol=1e-15)
    assert np.linalg.norm(K - system.A.getValues(range(n), range(n))) > 0.1


def enclosed(solver, *, pinned=False, source=0.0):
    """Stabilised Stokes flow in a closed box, whose pressure is determined up to a constant."""
    domain = mesh.create_unit_square(WORLD, 6, 6)
    V = compat.lagrange_space(domain, 1, 3)
    u, test, x = fem.Function(V), ufl.TestFunction(V), ufl.SpatialCoordinate(domain)
    v, w = (ufl.as_vector([f[0], f[1]]) for f in (u, test))
    p, q = u[2], test[2]
    f = ufl.as_vector([x[1] + 4 * x[1] ** 2, x[0] - 4 * x[0]])
    form = ufl.inner(ufl.grad(v), ufl.grad(w)) - p * ufl.div(w) + q * ufl.div(v) - ufl.dot(f, w)
    form += 0.005 * ufl.dot(ufl.grad(p) - f, ufl.grad(q)) - source * q
    edge = lambda x: np.isclose(x[0] * (1 - x[0]) * x[1] * (1 - x[1]), 0.0)  # noqa: E731
    bcs = [compat.pin_component(V, i, edge) for i in (0, 1)]
    constant = None if pinned else compat.component_space(V, 2)[1]
    if pinned:
        bcs.append(compat.pin_component(V, 2, lambda x: np.isclose(x[0] + x[1], 0.0)))
    return FiniteElementSystem(form * ufl.dx, u, bcs, solver=solver, constant=constant)


def nodal(system):
    """This rank's own nodal values, and the mean of their last component over all ranks."""
    values = system.x.x.array[: system.b.getLocalSize()].reshape(-1, 3)
    total = WORLD.allreduce(np.array([values[:, 2].sum(), len(values)]), op=MPI.SUM)
    return values, total[0] / total[1]


@pytest.mark.mpi
@pytest.mark.parametrize("start", [0.0, 5.0])
def test_a_constant_that_the_equations_leave_open_stays_what_it_was(start):
    """The rest is what a pinned system has; the mean of the start is kept."""
    pinned, free = enclosed(direct(), pinned=True), enclosed(gmres_ilu(1, rtol=1e-11))
    free.x.x.array[2::3] = start
    for system in (pinned, free):
        newton(system, rtol=1e-9)
    (a, mean_a), (b, mean_b) = nodal(pinned), nodal(free)
    assert mean_b == pytest.approx(start, abs=1e-12)
    np.testing.assert_allclose(b[:, :2], a[:, :2], rtol=0, atol=1e-8)
    np.testing.assert_allclose(b[:, 2] - mean_b, a[:, 2] - mean_a, rtol=0, atol=1e-8)
    assert WORLD.allreduce(np.abs(a[:, :2]).max(initial=0.0), op=MPI.MAX) > 0.01


@pytest.mark.mpi
def test_what_no_state_can_balance_is_taken_out_of_the_residual():
    """A source in a closed box: with it spread over all nodes there is a solution, and it is found."""
    system = enclosed(gmres_ilu(1, rtol=1e-11), source=1.0)
    report = newton(system, rtol=1e-8)
    assert report.norms[-1] <= 1e-8 * report.norms[0]
    residual = system.b.array_r.reshape(-1, 3)[:, 2]
    assert WORLD.allreduce(residual.sum(), op=MPI.SUM) == pytest.approx(0.0, abs=1e-12)
    compat.assemble_vector(system.b, system._residual)
    assert WORLD.allreduce(system.b.array_r.reshape(-1, 3)[:, 2].sum(), op=MPI.SUM) < -0.5


# -- projection -------------------------------------------------------------------------------------------------------


@pytest.mark.mpi
@pytest.mark.parametrize("size", [1, 3])
def test_a_projection_keeps_polynomials_and_the_mean_of_what_is_none(size):
    domain = mesh.create_unit_square(WORLD, 4, 3)
    function = fem.Function(compat.lagrange_space(domain, 2, size))
    x = ufl.SpatialCoordinate(domain)
    polynomial = x[0] * x[1] - 2 * x[1] ** 2
    step = ufl.conditional(ufl.lt(x[0], 0.4), 1.0, x[1])
    for f, close in ((polynomial, True), (step, False)):
        expression = f if size == 1 else ufl.as_vector([f, 2 * f, 1.0])
        project(function, expression)
        e, one = function - expression, 1.0 if size == 1 else ufl.as_vector([1.0, 1.0, 1.0])
        dx = ufl.dx(domain=domain, metadata={"quadrature_degree": 6})
        mean, square = (
            compat.assemble_scalar(form) for form in compat.compile_forms(ufl.inner(e, one) * dx, ufl.inner(e, e) * dx)
        )
        assert abs(mean) < 1e-12
        assert (square < 1e-20) == close


def test_a_projection_refuses_another_shape():
    domain = mesh.create_unit_square(WORLD, 2, 2)
    function = fem.Function(compat.lagrange_space(domain, 1, 2))
    with pytest.raises(ValueError, match=r"expression has shape \(\): that of the function, \(2,\), is required"):
        project(function, ufl.SpatialCoordinate(domain)[0])
