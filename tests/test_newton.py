"""The two kinds of systems, and the Newton loop on them."""

from itertools import pairwise

import numpy as np
import pytest
import scipy.sparse as sp
import ufl
from mpi4py import MPI
from dolfinx import fem, mesh
from petsc4py import PETSc

from shnapr import loads
from shnapr.supports import clamped
from shnapr.svk import StVenantKirchhoff
from shnapr.work import internal_work
from tigar_x import compat
from tigar_x.fem.line_search import LineSearch, search
from tigar_x.fem.linear import SolveError
from tigar_x.fem.schemes import backward_euler
from tigar_x.fem.solve import FiniteElementSystem, newton
from tigar_x.fem.time_integration import TimeIntegrator
from tigar_x.geometry import shapes
from tigar_x.splines.spline import ExtractedSpline
from tigar_x.splines.spline_system import SplineSystem


def nonlinear_poisson(*, exact_tangent=True, start=0.0):
    """-div((1 + u^2) grad u) = -10 u_e with solution u_e = 1 + x + 2 y, which linear elements contain."""
    domain = mesh.create_unit_square(MPI.COMM_WORLD, 4, 4)
    V = compat.lagrange_space(domain, 1)
    u, v, X = fem.Function(V), ufl.TestFunction(V), ufl.SpatialCoordinate(domain)
    exact = fem.Function(V)
    exact.interpolate(lambda x: 1.0 + x[0] + 2.0 * x[1])
    form = (1 + u**2) * ufl.dot(ufl.grad(u), ufl.grad(v)) * ufl.dx
    form += 10.0 * (1 + X[0] + 2 * X[1]) * v * ufl.dx
    picard = None if exact_tangent else (1 + u**2) * ufl.dot(ufl.grad(ufl.TrialFunction(V)), ufl.grad(v)) * ufl.dx
    domain.topology.create_connectivity(1, 2)
    facets = mesh.exterior_facet_indices(domain.topology)
    bc = fem.dirichletbc(exact, fem.locate_dofs_topological(V, 1, facets))
    system = FiniteElementSystem(form, u, [bc], tangent=picard)
    u.x.array[:] = start
    system.apply_boundary_values()
    return system, exact


def order(norms, last=3):
    """Exponent q of |r_k+1| = C |r_k|^q, fitted to the last norms above rounding."""
    r = np.log([n for n in norms if n > 1e-12 * norms[0]])[-last - 1 :]
    return np.polyfit(r[:-1], r[1:], 1)[0]


@pytest.mark.mpi
def test_newton_converges_quadratically_to_the_manufactured_solution():
    system, exact = nonlinear_poisson()
    report = newton(system, rtol=1e-11, max_iterations=12)
    assert order(report.norms) == pytest.approx(2.0, abs=0.3)
    assert report.norms[-1] <= 1e-11 * report.norms[0]
    assert len(report.linear_iterations) == len(report.norms) - 1 < 10
    np.testing.assert_allclose(system.x.x.array, exact.x.array, rtol=0, atol=1e-10)


@pytest.mark.mpi
def test_an_inexact_tangent_converges_linearly():
    system, exact = nonlinear_poisson(exact_tangent=False)
    report = newton(system, rtol=1e-9, max_iterations=60)
    assert order(report.norms, last=8) == pytest.approx(1.0, abs=0.1)
    np.testing.assert_allclose(system.x.x.array, exact.x.array, rtol=0, atol=1e-7)


def test_newton_reports_its_history_when_it_fails():
    system, _ = nonlinear_poisson()
    reference = newton(nonlinear_poisson()[0], rtol=1e-11, max_iterations=12)
    with pytest.raises(SolveError, match=r"did not converge in 2 iterations: residuals \[") as caught:
        newton(system, rtol=1e-11, max_iterations=2)
    history = [float(part) for part in str(caught.value).split("[")[1].rstrip("]").split(",")]
    np.testing.assert_allclose(history, reference.norms[:3], rtol=1e-8)
    assert system.assemble_residual() == pytest.approx(history[-1])  # the state is the last iterate


def test_newton_tests_before_it_solves():
    system, _ = nonlinear_poisson()
    start = system.x.x.array.copy()
    norm = system.assemble_residual()
    for options in ({"reference": 1e6 * norm, "rtol": 1e-5}, {"rtol": 0.0, "atol": 1.001 * norm}):
        report = newton(system, max_iterations=0, **options)
        assert report.norms == (norm,)
        assert report.linear_iterations == ()
    np.testing.assert_array_equal(system.x.x.array, start)
    with pytest.raises(SolveError, match="did not converge in 0 iterations"):
        newton(system, reference=1e4 * norm, rtol=1e-5, max_iterations=0)


def test_a_residual_that_is_not_finite_is_refused():
    system, _ = nonlinear_poisson()
    system.x.x.array[0] = np.nan
    with pytest.raises(SolveError, match="iteration 0: the residual is not finite"):
        newton(system)
    overflowing, _ = nonlinear_poisson(start=1e155)
    with pytest.raises(SolveError, match="iteration 0: the residual is not finite"):
        newton(overflowing)


def test_what_is_out_of_range_is_said():
    system, _ = nonlinear_poisson()
    for options in ({"rtol": -1e-5}, {"atol": np.nan}, {"reference": -1.0}, {"max_iterations": 2.5}):
        name, value = next(iter(options.items()))
        with pytest.raises(ValueError, match=f"{name} = {value}: a"):
            newton(system, **options)
    for options in ({"reduction": 1.5}, {"reduction": np.nan}, {"evaluations": 0}):
        name, value = next(iter(options.items()))
        with pytest.raises(ValueError, match=f"{name} = {value}: a"):
            LineSearch(**options)


# -- line search ------------------------------------------------------------------------------------------------------


class Pointwise:
    """f(u) = 0 in every point, from a constant start: the iterates are those of one equation. Counts residuals."""

    def __init__(self, f, start, *, slope=1.0):
        domain = mesh.create_unit_interval(MPI.COMM_WORLD, 4)
        V = compat.lagrange_space(domain, 1)
        self.u, v = fem.Function(V), ufl.TestFunction(V)
        form = f(self.u) * v * ufl.dx
        self.system = FiniteElementSystem(form, self.u, tangent=slope * ufl.derivative(form, self.u))
        self.u.x.array[:] = start
        self.assembled = 0
        for name in ("assemble_tangent", "solve", "subtract"):
            setattr(self, name, getattr(self.system, name))

    @property
    def b(self):
        return self.system.b

    def assemble_residual(self):
        self.assembled += 1
        return self.system.assemble_residual()


def growing(u):
    """Odd, with f = u + 10 u^3: the gradient of a convex energy."""
    return u + 10 * u**3


@pytest.mark.mpi
def test_a_line_search_does_nothing_where_full_steps_serve():
    plain, searched = (Pointwise(growing, 1.0) for _ in range(2))
    without, report = newton(plain, rtol=1e-11), newton(searched, rtol=1e-11, line_search=LineSearch())
    np.testing.assert_allclose(report.norms, without.norms, rtol=1e-6, atol=1e-14)
    assert report.step_lengths == without.step_lengths == (1.0,) * len(report.linear_iterations)
    assert searched.assembled == plain.assembled == len(report.norms)


@pytest.mark.mpi
def test_a_line_search_converges_where_full_steps_diverge():
    """Newton's method for atan(u) = 0 diverges from |u| > 1.3917452."""
    for start, converges in ((1.39, True), (1.40, False)):
        if converges:
            newton(Pointwise(ufl.atan, start), rtol=1e-9)
        else:
            with pytest.raises(SolveError):
                newton(Pointwise(ufl.atan, start), rtol=1e-9)
        for times in (1, -10):
            problem = Pointwise(ufl.atan, times * start)
            report = newton(problem, rtol=1e-9, line_search=LineSearch())
            np.testing.assert_allclose(problem.u.x.array, 0.0, atol=1e-8)
            assert report.step_lengths[-1] == 1.0
            assert len(report.step_lengths) == len(report.linear_iterations) == len(report.norms) - 1
            assert (min(report.step_lengths) < 1.0) is (problem.assembled > len(report.norms))
    assert min(report.step_lengths) < 0.2


@pytest.mark.mpi
def test_a_step_that_leaves_the_numbers_is_halved():
    """From 5, the full step for log(u) = 0 ends at 5 (1 - log 5) < 0, half of it at 0.98."""
    problem = Pointwise(ufl.ln, 5.0)
    report = newton(problem, rtol=1e-10, line_search=LineSearch())
    assert report.step_lengths[:2] == (0.5, 1.0)
    np.testing.assert_allclose(problem.u.x.array, 1.0, atol=1e-9)
    with pytest.raises(SolveError, match="iteration 1: the residual is not finite"):
        newton(Pointwise(ufl.ln, 5.0), rtol=1e-10)
    overflowing = Pointwise(lambda u: ufl.exp(u) - 1, -8.0)
    report = newton(overflowing, rtol=1e-10, line_search=LineSearch())
    np.testing.assert_allclose(overflowing.u.x.array, 0.0, atol=1e-9)
    assert report.step_lengths[0] < 1e-2


class Quadratic:
    """R = D x, the gradient of an energy, with a line search along any increment."""

    def __init__(self, stiffness, x):
        self.D, self.x = np.array(stiffness), np.array(x)
        self.b = PETSc.Vec().createSeq(len(x), comm=PETSc.COMM_SELF)
        self.assembled = -1
        self.norm = self.assemble_residual()

    def assemble_residual(self):
        self.assembled += 1
        self.b.array_w[:] = self.D * self.x
        return self.b.norm()

    def subtract(self, increment):
        self.x -= increment.array_r


@pytest.mark.parametrize(("excess", "evaluations"), [(1, 1), (2, 2), (8, 3)])
def test_steps_go_to_the_minimum_of_the_energy(excess, evaluations):
    """There the residual may be larger. The secant's root is exact once it lies in the inner part of the interval."""
    problem = Quadratic([1.0, 100.0], [1.0, 5e-4])
    increment = problem.b.copy()
    optimum = increment.dot(increment) / increment.array_r.dot(problem.D * increment.array_r)
    increment.scale(excess * optimum)
    s, norm = search(problem, increment, problem.norm, LineSearch(reduction=1e-12))
    assert s == pytest.approx(1 / excess, rel=1e-12)
    assert problem.assembled == evaluations
    assert norm == pytest.approx(problem.b.norm())
    assert norm > 3 * problem.norm


@pytest.mark.mpi
def test_a_failed_line_search_says_so_and_takes_its_steps_back():
    """Along the wrong direction no step helps."""
    problem = Pointwise(growing, 0.4, slope=-1.0)
    with pytest.raises(SolveError, match=r"no step length from 1 to 7\.8e-03 reduces the residual"):
        newton(problem, line_search=LineSearch(evaluations=8))
    assert problem.assembled == 1 + 8
    np.testing.assert_allclose(problem.u.x.array, 0.4, rtol=1e-14)


# -- kept tangents ----------------------------------------------------------------------------------------------------


@pytest.mark.mpi
@pytest.mark.parametrize("keep", [0.2, 0.5])
def test_a_tangent_is_kept_while_it_serves(keep):
    """As long as every step reduces the residual by the factor; the solution is the same, with fewer tangents."""
    system, exact = nonlinear_poisson()
    report = newton(system, rtol=1e-10, keep=keep, max_iterations=60)
    every = newton(nonlinear_poisson()[0], rtol=1e-10)
    np.testing.assert_allclose(system.x.x.array, exact.x.array, rtol=0, atol=1e-8)
    assert every.tangents == len(every.linear_iterations) == len(every.norms) - 1
    assert report.tangents < every.tangents
    assert len(report.norms) > len(every.norms)
    falls = [b / a for a, b in pairwise(report.norms)]
    assert report.tangents == 1 + sum(fall >= keep for fall in falls[:-1])
    assert report.step_lengths == (1.0,) * len(falls)


@pytest.mark.mpi
def test_a_tangent_is_kept_from_the_last_call():
    system, exact = nonlinear_poisson()
    assert newton(system, rtol=1e-10, keep=0.2).tangents > 0
    for keep, tangents in ((0.2, 0), (None, 1)):
        system.x.x.array[:] += 1e-4 * np.sin(np.arange(len(system.x.x.array)))
        system.x.x.scatter_forward()
        system.apply_boundary_values()
        assert newton(system, rtol=1e-3, keep=keep).tangents == tangents
    np.testing.assert_allclose(system.x.x.array, exact.x.array, rtol=0, atol=1e-6)


@pytest.mark.mpi
def test_a_step_with_a_kept_tangent_that_makes_things_worse_is_taken_back():
    """From u = 3 with the slope of u = 0, which is 271 times too small; then there is a new one."""
    system = Pointwise(growing, 0.0).system
    system.assemble_residual()
    system.assemble_tangent()
    system.x.x.array[:] = 3.0
    report = newton(system, rtol=1e-10, keep=0.2)
    fresh = newton(Pointwise(growing, 3.0), rtol=1e-10)
    assert report.step_lengths[0] == 0.0
    assert report.norms[1] == pytest.approx(report.norms[0], rel=1e-12)
    np.testing.assert_allclose(report.norms[1:5], fresh.norms[:4], rtol=1e-8)
    assert 0 < report.tangents < len(report.linear_iterations)
    np.testing.assert_allclose(system.x.x.array, 0.0, atol=1e-7)


@pytest.mark.mpi
def test_a_kept_tangent_that_leaves_the_numbers_is_given_up():
    """The step for log(u) = 0 from 5 with the slope of u = 8 would end below zero."""
    system = Pointwise(ufl.ln, 8.0).system
    system.assemble_residual()
    system.assemble_tangent()
    system.x.x.array[:] = 2.0
    report = newton(system, rtol=1e-10, keep=0.2)
    assert report.step_lengths[0] == 0.0
    np.testing.assert_allclose(system.x.x.array, 1.0, atol=1e-9)


@pytest.mark.mpi
def test_a_kept_tangent_that_is_singular_is_given_up():
    system = Pointwise(lambda u: u**2 - 1, 0.0).system
    system.assemble_residual()
    system.assemble_tangent()
    system.x.x.array[:] = 2.0
    report = newton(system, rtol=1e-10, keep=0.2)
    assert report.tangents > 0
    np.testing.assert_allclose(system.x.x.array, 1.0, atol=1e-9)
    system.x.x.array[:] = 0.0
    with pytest.raises(SolveError, match="singular"):
        newton(system, rtol=1e-10)


@pytest.mark.mpi
def test_a_line_search_that_fails_along_a_kept_tangent_is_tried_with_a_new_one():
    """From u = 3 with the slope of u = -1, which is negative."""
    system = Pointwise(lambda u: u**2 + 2 * u - 3, -3.0).system
    system.assemble_residual()
    system.assemble_tangent()
    system.x.x.array[:] = 3.0
    report = newton(system, rtol=1e-10, keep=0.2, line_search=LineSearch(evaluations=6))
    assert report.tangents > 0
    np.testing.assert_allclose(system.x.x.array, 1.0, atol=1e-9)


@pytest.mark.parametrize("keep", [-0.1, 1.1, np.nan])
def test_what_is_kept_is_in_range(keep):
    with pytest.raises(ValueError, match=f"^keep = {keep}: a"):
        newton(nonlinear_poisson()[0], keep=keep)


# -- where rounding ends it -------------------------------------------------------------------------------------------


@pytest.mark.mpi
def test_a_line_search_that_stalls_near_the_accepted_residual():
    """Along the wrong direction nothing is better: that is accepted within the multiple, and an error beyond it."""
    problem = Pointwise(growing, 0.4, slope=-1.0)
    norm = problem.assemble_residual()
    options = dict(rtol=0.0, atol=norm / 100, line_search=LineSearch(evaluations=4))
    report = newton(problem, stalled=1000.0, **options)
    assert report.step_lengths == (0.0,)
    assert report.norms == (norm, norm)
    np.testing.assert_allclose(problem.u.x.array, 0.4, rtol=1e-12)
    with pytest.raises(SolveError, match="no step length"):
        newton(problem, stalled=10.0, **options)


@pytest.mark.mpi
def test_an_accepted_residual_that_a_tangent_tells():
    """It is asked for before the first tangent and after every one; what it accepts is not solved for."""
    system, _ = nonlinear_poisson()
    norm = system.assemble_residual()
    for factor, solves in ((2.0, 0), (0.5, 4)):
        system, _ = nonlinear_poisson()
        report = newton(system, rtol=0.0, atol=lambda s=system, f=factor: f * norm if s.has_tangent else 0.0)
        assert report.tangents == max(solves, 1)
        assert len(report.linear_iterations) == solves
        assert report.norms[-1] < factor * norm
    with pytest.raises(ValueError, match=r"^atol = -1.0: a number >= 0"):
        newton(system, atol=lambda: -1.0)


@pytest.mark.mpi
def test_rounding_is_what_solutions_are_left_with():
    """Unknown before the first tangent; afterwards a bound on the residual of the solution, and not far above it."""
    system, _ = nonlinear_poisson()
    assert system.rounding() == 0.0
    report = newton(system, rtol=1e-11)
    once_more = newton(system, rtol=0.0, atol=system.rounding)
    assert once_more.norms[-1] <= system.rounding()
    assert system.rounding() < 1e-9 * report.norms[0]


def shell_strip():
    """A clamped curve in the plane with inertia, damping and a load at its end, and its system."""
    line = shapes.line((0, 0), (1, 0), elements=4, degree=2)
    spline = ExtractedSpline(line, MPI.COMM_SELF, zero_dofs=clamped(line, "u0"))
    y, z = spline.function(name="y"), ufl.TestFunction(spline.V)
    time = TimeIntegrator(y, 20.0, backward_euler(2))
    load = fem.Constant(spline.mesh, (0.0, 0.0))
    material = StVenantKirchhoff(1e3, 0.0, 0.1)
    body = dict(density=1.0, thickness=0.1)
    residual = internal_work(spline, material, y, z) + loads.inertia(spline, time.xddot_alpha, z, **body)
    residual += loads.mass_damping(spline, time.xdot_alpha, z, coefficient=5.0, **body)
    residual += loads.edge_traction(spline, load, z, spline.ds("u1"))
    return SplineSystem(spline, residual, ufl.derivative(residual, y), unknown=y), time, load


def test_a_shell_that_comes_to_rest_goes_on():
    """Rounding ends its steps; in the end they start at their solution. A load that is small counts none the less."""
    system, time, load = shell_strip()
    time.x_old.x.array[1::2] = 1e-3 * np.sin(system.space.node_positions[:, 0]) ** 2
    for _ in range(40):
        time.predict()
        report = newton(system, rtol=1e-6)
        time.advance()
    assert 0.0 < report.norms[-1] <= system.rounding() < 1e-12
    assert len(report.linear_iterations) <= 3
    assert np.abs(time.xdot_old.x.array).max() < 1e-15
    for force in (1e-3, 1e-7):
        load.value[:] = 0.0, force
        time.predict()
        report = newton(system, rtol=1e-3)
        assert report.norms[-1] < 1e-3 * report.norms[0]


@pytest.mark.mpi
def test_newton_at_a_solution_is_done():
    """With and without a line search and kept tangents; one that is no solution up to rounding still fails."""
    for options in ({}, {"keep": 0.2}, {"line_search": LineSearch()}):
        system, _ = nonlinear_poisson()
        newton(system, rtol=0.0, atol=1e-13 * newton(system, rtol=1e-11).norms[0])
        report = newton(system, **options, rtol=1e-5)
        assert len(report.linear_iterations) <= 2
        assert report.norms[0] <= system.rounding()
    with pytest.raises(SolveError):
        newton(nonlinear_poisson()[0], rtol=1e-20, max_iterations=30)


# -- additions from outside, and splines ------------------------------------------------------------------------------


def test_loads_and_tangents_of_others_enter_a_finite_element_system():
    system, _ = nonlinear_poisson()
    system.assemble_residual()
    own = system.b.array_r.copy()

    def load(local):
        local += 2.0

    system.assemble_residual(load)
    free = np.setdiff1d(np.arange(len(own)), system.constrained)
    np.testing.assert_allclose(system.b.array_r[free], own[free] + 2.0, rtol=1e-14)
    assert not system.b.array_r[system.constrained].any()

    system.assemble_tangent()
    before = system.A.getDiagonal().array_r.copy()
    node = int(free[0])
    system.assemble_tangent(lambda A: A.setValuesLocal([node], [node], [5.0], PETSc.InsertMode.ADD_VALUES))
    change = system.A.getDiagonal().array_r - before
    np.testing.assert_allclose(change, 5.0 * (np.arange(len(own)) == node), rtol=0, atol=1e-13)
    np.testing.assert_array_equal(before[system.constrained], 1.0)


class TestSplineSystem:
    """Nodal loads and stiffnesses are extracted like everything else."""

    def make(self, **options):
        patch = shapes.line((0, 0), (2, 1), elements=4, degree=2)
        spline = ExtractedSpline(patch, MPI.COMM_SELF, zero_dofs=patch.side_dofs("u0"))
        u, du, v = fem.Function(spline.V), ufl.TrialFunction(spline.V), ufl.TestFunction(spline.V)
        form = ufl.inner(u - 2 * spline.F, v) * spline.dx
        return spline, SplineSystem(spline, form, ufl.inner(du, v) * spline.dx, unknown=u, **options)

    def test_newton_finds_the_linear_solution(self):
        spline, system = self.make(zero_dofs=())
        report = newton(system, rtol=1e-12)
        assert len(report.norms) == 2
        np.testing.assert_allclose(spline.nodal(system.unknown), 2 * spline.node_positions, rtol=0, atol=1e-12)

    def test_zero_dofs_are_those_of_the_spline(self):
        spline, system = self.make()
        system.unknown.x.array[:] = 0.125
        newton(system, rtol=1e-12)
        start = np.isclose(spline.node_positions[:, 0], 0.0)
        np.testing.assert_allclose(spline.nodal(system.unknown)[start], 0.125, rtol=0, atol=1e-15)

    def test_nodal_loads_and_stiffness(self):
        spline, system = self.make()
        M = sp.kron(spline.vector.nodes, sp.identity(2)).toarray()
        free = np.setdiff1d(np.arange(M.shape[1]), spline.zero_dofs)
        nodal = np.random.default_rng(3).uniform(0.5, 1.0, (len(spline.node_areas), 2))
        system.assemble_residual()
        b = system.b.array_r.copy()
        norm = system.assemble_residual(nodal)
        expected = b[free] + M.T[free] @ nodal.ravel()
        np.testing.assert_allclose(system.b.array_r[free], expected, rtol=0, atol=1e-14)
        assert norm == pytest.approx(np.linalg.norm(expected))
        np.testing.assert_allclose(system.extract(nodal)[free], M.T[free] @ nodal.ravel(), rtol=0, atol=1e-14)
        assert not system.extract(nodal)[spline.zero_dofs].any()

        assert system.product_norm(nodal) == 0.0
        system.assemble_tangent()
        system.assemble_residual()
        before = system.b.array_r.copy()
        system.unknown.x.array[:] += nodal.ravel()
        system.assemble_residual()
        assert system.product_norm(nodal) == pytest.approx(np.linalg.norm(system.b.array_r - before), rel=1e-12)
        n = range(M.shape[1])
        A = system.A.getValues(n, n)
        system.assemble_tangent(nodal)
        added = (system.A.getValues(n, n) - A)[np.ix_(free, free)]
        np.testing.assert_allclose(added, (M.T @ (nodal.ravel()[:, None] * M))[np.ix_(free, free)], rtol=0, atol=1e-13)

    def test_what_is_missing_is_said(self):
        _, system = self.make()
        for use in (lambda: system.A, system.solve):
            with pytest.raises(SolveError, match="no tangent has been assembled"):
                use()
        system.unknown = None
        with pytest.raises(SolveError, match="without its unknown"):
            system.subtract(system.b)
