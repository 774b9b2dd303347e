"""The two kinds of systems, and the Newton loop on them."""

import numpy as np
import pytest
import scipy.sparse as sp
import ufl
from mpi4py import MPI
from dolfinx import fem, mesh
from petsc4py import PETSc

from tigar_x import compat, shapes
from tigar_x.linear import SolveError
from tigar_x.solve import FiniteElementSystem, SplineSystem, newton
from tigar_x.spline import ExtractedSpline


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
        M = sp.kron(spline.extraction.M, sp.identity(2)).toarray()
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

        system.assemble_tangent()
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
