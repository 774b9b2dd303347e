"""Load stepping: what it reaches, what it restores, and how it chooses its steps."""

from types import SimpleNamespace

import numpy as np
import pytest
import ufl
from mpi4py import MPI
from dolfinx import fem, mesh
from petsc4py import PETSc
from test_beam import PLANE_STRAIN, cantilever, elastica

from tigar_x import compat
from tigar_x.fem.line_search import LineSearch
from tigar_x.fem.linear import SolveError
from tigar_x.fem.load_stepping import StepControl, follow_load
from tigar_x.fem.solve import FiniteElementSystem, newton
from tigar_x.fem.time_integration import LoadStepper


def pointwise(f, *, step=1.0, start=0.0, comm=MPI.COMM_WORLD):
    """f(u, t) = 0 in every point, from a constant state: one equation."""
    V = compat.lagrange_space(mesh.create_unit_interval(comm, 4), 1)
    u, v = fem.Function(V), ufl.TestFunction(V)
    u.x.array[:] = start
    time = LoadStepper(u, step)
    return SimpleNamespace(u=u, time=time, system=FiniteElementSystem(f(u, time.t) * v * ufl.dx, u))


def test_the_stepper_changes_the_step_in_progress():
    time = pointwise(lambda u, t: u - t, step=0.25).time
    time.advance()
    time.step_size = 0.5
    assert (time.time, float(time.t.value), time.step_size) == (0.25, 0.75, 0.5)
    time.advance()
    assert (time.time, float(time.t.value)) == (0.75, 1.25)
    for bad in (0.0, -0.1, np.nan):
        with pytest.raises(ValueError, match=f"dt = {bad}: a"):
            time.step_size = bad
    assert float(time.t.value) == 1.25


def test_elastica_under_a_load_too_large_for_one_step():
    """P L^2/(E' I) = 30 and ten iterations a step: the state does not depend on the steps that led there."""
    h, ratio = 1e-2, 30.0
    load = ratio * PLANE_STRAIN * h**3 / 12
    beam = cantilever(4, 32, L=1.0, h=h, load=load)
    accepted = dict(rtol=0.0, atol=1e-5 * load)
    with pytest.raises(SolveError, match="did not converge in 10 iterations"):
        newton(beam.system, max_iterations=10, **accepted)
    beam.y.x.array[:] = 0.0
    seen = []

    def each(t):
        assert float(beam.time.t.value) == beam.time.time == t
        assert beam.system.assemble_residual() <= accepted["atol"]
        seen.append(t)

    report = follow_load(beam.system, beam.time, each=each, max_iterations=10, **accepted)
    axial, across = beam.tip()
    np.testing.assert_allclose((across, -axial), elastica(ratio), atol=1e-3)
    assert tuple(seen) == report.loads
    assert report.loads[-1] == 1.0
    assert (np.diff((0.0, *report.loads)) > 0).all()
    assert len(report.loads) == len(report.iterations) == len(report.cuts) < 20
    assert report.cuts[0] >= 3
    assert max(report.iterations) <= 10
    at_once = cantilever(4, 32, L=1.0, h=h, load=load)
    newton(at_once.system, max_iterations=40, **accepted)
    np.testing.assert_allclose(beam.y.x.array, at_once.y.x.array, atol=1e-5)


@pytest.mark.mpi
def test_a_limit_load_is_approached_and_the_last_state_kept():
    """4 u (1 - u) = 3 t/2 has solutions up to t = 2/3."""
    problem = pointwise(lambda u, t: 4 * u * (1 - u) - 1.5 * t, step=0.4)
    states = {}

    def each(t):
        states[t] = problem.u.x.array.copy()

    with pytest.raises(SolveError, match=r"loading ended at 0\.6\d+: a step of 0\.0001\d+ failed: ") as caught:
        follow_load(problem.system, problem.time, control=StepControl(smallest=1e-4), each=each, rtol=1e-10)
    last = max(states)
    assert 2 / 3 - 2e-4 < last < 2 / 3
    assert f"ended at {last:g}:" in str(caught.value)
    assert isinstance(caught.value.__cause__, SolveError)
    np.testing.assert_array_equal(problem.u.x.array, states[last])
    assert float(problem.time.t.value) == problem.time.time == last
    np.testing.assert_allclose(problem.u.x.array, (1 - np.sqrt(1 - 1.5 * last)) / 2, rtol=1e-8)


@pytest.mark.mpi
@pytest.mark.parametrize("line_search", [None, LineSearch()])
def test_what_never_converges_leaves_the_start(line_search):
    problem = pointwise(lambda u, t: u**2 + 1 + t, step=0.5, start=0.3)
    with pytest.raises(SolveError, match=r"loading ended at 0: a step of 0\.125 failed"):
        follow_load(problem.system, problem.time, control=StepControl(smallest=0.1), line_search=line_search)
    np.testing.assert_array_equal(problem.u.x.array, 0.3)
    assert (problem.time.time, float(problem.time.t.value), problem.time.step_size) == (0.0, 0.0, 0.0625)


# -- the choice of steps ----------------------------------------------------------------------------------------------


@pytest.mark.mpi
def test_easy_steps_grow_up_to_the_largest():
    problem = pointwise(lambda u, t: u - t, step=0.1)
    report = follow_load(problem.system, problem.time, control=StepControl(largest=0.3, growth=1.5))
    np.testing.assert_allclose(report.loads, (0.1, 0.25, 0.475, 0.775, 1.0), rtol=1e-14)
    assert report.iterations == (1,) * 5
    assert report.cuts == (0,) * 5
    np.testing.assert_allclose(problem.u.x.array, 1.0, rtol=1e-12)
    report = follow_load(problem.system, problem.time, until=1.75)  # goes on with the step that it had
    np.testing.assert_allclose(report.loads, (1.3, 1.75), rtol=1e-14)
    assert follow_load(problem.system, problem.time, until=1.75).loads == ()
    hard = pointwise(lambda u, t: u - t, step=0.25)
    assert follow_load(hard.system, hard.time, control=StepControl(easy=0)).loads == (0.25, 0.5, 0.75, 1.0)


def test_no_sliver_is_left_for_the_last_step():
    problem = pointwise(lambda u, t: u - t, step=0.4999)
    assert follow_load(problem.system, problem.time, control=StepControl(growth=1.0)).loads == (0.4999, 1.0)
    problem = pointwise(lambda u, t: u - t, step=0.1)
    loads = follow_load(problem.system, problem.time, control=StepControl(growth=1.0)).loads
    assert len(loads) == 10
    assert loads[-1] == 1.0


def test_a_step_that_was_cut_is_repeated_before_it_grows():
    """Steps beyond 0.2 overflow."""
    problem = pointwise(lambda u, t: u - t)
    assemble = problem.system.assemble_residual

    def fragile():
        too_long = float(problem.time.t.value) - problem.time.time > 0.2
        return np.inf if too_long else assemble()

    problem.system.assemble_residual = fragile
    report = follow_load(problem.system, problem.time)
    steps = np.diff((0.0, *report.loads))
    np.testing.assert_allclose(steps[:4], (0.125, 0.125, 0.1875, 0.140625), rtol=1e-12)
    assert report.cuts[:4] == (3, 0, 0, 1)
    assert steps.max() <= 0.2


@pytest.mark.mpi
def test_extrapolation_is_exact_where_the_response_is_linear():
    """From the second step on the start is the solution, whatever the sizes of the steps."""
    problem = pointwise(lambda u, t: u - t, step=0.1)
    options = dict(rtol=0.0, atol=1e-14)
    report = follow_load(problem.system, problem.time, extrapolate=True, **options)
    assert report.iterations == (1, *(0,) * (len(report.loads) - 1))
    np.testing.assert_allclose(problem.u.x.array, 1.0, atol=1e-12)

    def curved(u, t):
        return u**3 + u - 2 * t

    counts = {}
    for extrapolate in (False, True):
        problem = pointwise(curved, step=0.05)
        report = follow_load(problem.system, problem.time, extrapolate=extrapolate, control=StepControl(growth=1.0))
        counts[extrapolate] = sum(report.iterations)
        np.testing.assert_allclose(problem.u.x.array, 1.0, atol=1e-5)
    assert counts[True] < counts[False]


@pytest.mark.mpi
def test_prescribed_displacements_follow_the_pseudo_time():
    """u = 0 and u = 2 t at the ends. After a failure the data belong to the last load reached."""
    domain = mesh.create_unit_interval(MPI.COMM_WORLD, 4)
    V = compat.lagrange_space(domain, 1)
    u, v, end = fem.Function(V), ufl.TestFunction(V), fem.Constant(domain, PETSc.ScalarType(0.0))
    domain.topology.create_connectivity(0, 1)
    ends = [mesh.locate_entities_boundary(domain, 0, lambda x, s=s: np.isclose(x[0], s)) for s in (0.0, 1.0)]
    dofs = [fem.locate_dofs_topological(V, 0, points) for points in ends]
    bcs = [fem.dirichletbc(PETSc.ScalarType(0.0), dofs[0], V), fem.dirichletbc(end, dofs[1], V)]
    time = LoadStepper(u, 0.25)
    stiffness = ufl.exp(ufl.ln(fem.Constant(domain, 0.6) - time.t))  # not a number beyond t = 0.6
    system = FiniteElementSystem(stiffness * ufl.dot(ufl.grad(u), ufl.grad(v)) * ufl.dx, u, bcs)

    def prescribe(t):
        end.value = 2 * t
        system.apply_boundary_values()

    options = dict(control=StepControl(smallest=1e-2, growth=1.0), updates=[prescribe], rtol=0.0, atol=1e-12)
    follow_load(system, time, until=0.5, **options)
    np.testing.assert_allclose(u.x.array, V.tabulate_dof_coordinates()[:, 0], atol=1e-12)
    with pytest.raises(SolveError, match=r"loading ended at 0\.5"):
        follow_load(system, time, **options)
    assert float(end.value) == 2 * time.time
    np.testing.assert_allclose(u.x.array, 2 * time.time * V.tabulate_dof_coordinates()[:, 0], atol=1e-12)


@pytest.mark.parametrize("left", [0.9, 1.0, 1.5, 2.0, 2.1, 4.0])
def test_the_last_steps_end_too(left):
    """Whatever is left of the path, in multiples of the smallest step, steps that fail are cut only so often."""
    problem = pointwise(lambda u, t: u**2 + 1 + t)
    with pytest.raises(SolveError, match="loading ended at 0"):
        follow_load(problem.system, problem.time, until=left * 0.01, control=StepControl(smallest=0.01))
    np.testing.assert_array_equal(problem.u.x.array, 0.0)


def test_what_is_out_of_range_is_said():
    for options in (
        {"smallest": 0.0},
        {"largest": 1e-4},
        {"largest": np.nan},
        {"easy": -1},
        {"growth": 0.9},
    ):
        name, value = next(iter(options.items()))
        with pytest.raises(ValueError, match=f"{name} = {value}: a"):
            StepControl(**options)
    problem = pointwise(lambda u, t: u - t)
    follow_load(problem.system, problem.time)
    with pytest.raises(ValueError, match=r"until = 0\.5: a number >= the present pseudo-time 1\.0"):
        follow_load(problem.system, problem.time, until=0.5)
