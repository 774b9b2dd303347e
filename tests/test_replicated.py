"""Ranks that each solve the same problem, with other rounding or a failure of their own, go the way of rank 0."""

import numpy as np
import pytest
from mpi4py import MPI
from test_load_stepping import pointwise

from shnapr.problems.inflation import Inflated, Plate
from shnapr.problems.leaflet import Closing, Leaflet
from shnapr.problems.reef_knot import Knot
from tigar_x.fem.linear import SolveError
from tigar_x.fem.load_stepping import StepControl, follow_load
from tigar_x.fem.solve import newton
from tigar_x.ranks import first
from tigar_x.splines.spline_system import SplineSystem

COMM = MPI.COMM_WORLD
pytestmark = [pytest.mark.mpi, pytest.mark.skipif(COMM.size == 1, reason="one rank cannot differ from itself")]


def cube(**options):
    """u + u^3 = 3 t on every rank, whose last residual of the first step is what is accepted there."""
    problem = pointwise(lambda u, t: u + u**3 - 3.0 * t, step=0.25, comm=MPI.COMM_SELF)
    norms = newton(problem.system, rtol=1e-6).norms
    problem.u.x.array[:] = 0.0
    residual = problem.system.assemble_residual
    problem.system.assemble_residual = lambda: residual() * (1.0 + 1e-13 * COMM.rank)
    control = StepControl(easy=len(norms) - 1, growth=2.0)
    accepted = first(COMM, norms[-1])
    report = follow_load(problem.system, problem.time, control=control, rtol=0.0, atol=accepted, **options)
    return report, problem.u.x.array.copy()


def test_ranks_that_differ_by_rounding_take_the_load_steps_of_the_first():
    alone = COMM.allgather(cube()[0])
    assert alone[0] != alone[-1]  # or nothing is tested
    report, u = cube(comm=COMM)
    assert report == alone[0]
    assert all(np.array_equal(other, u) for other in COMM.allgather(u))


@pytest.mark.parametrize("rank", [0, 1])
def test_a_step_that_fails_on_one_rank_is_cut_on_all(rank):
    problem = pointwise(lambda u, t: u - t, step=0.5, comm=MPI.COMM_SELF)
    solve, failed = problem.system.solve, []

    def fails():
        if COMM.rank == rank and not failed:
            failed.append(True)
            raise SolveError("on one rank")
        return solve()

    problem.system.solve = fails
    report = follow_load(problem.system, problem.time, comm=COMM)
    assert report.loads[0] == 0.25
    assert report.cuts == (1,) + (0,) * (len(report.cuts) - 1)
    assert all(other == report for other in COMM.allgather(report))


def leaflet():
    closing = Closing(Leaflet(2, 5, pressure=1e3))
    return closing.shell.y, closing.close(step=0.5).report


def inflation():
    plate = Inflated(Plate(elements=4, points=2, quarter=True))
    return plate.shell.y, plate.inflate(step=0.25).report


def reef_knot():
    knot = Knot(1)
    knot.run(steps=2, show=False).through()
    return knot.shell.y, (knot.ledger.newton_iterations, knot.ledger.substeps)


@pytest.mark.parametrize("demo", [leaflet, inflation, reef_knot])
def test_demos_whose_ranks_differ_by_rounding_keep_one_shell(demo, monkeypatch):
    plain, rng = SplineSystem.assemble_residual, np.random.default_rng(COMM.rank)

    def off(self, *args):
        plain(self, *args)
        self.b.array_w[:] *= 1.0 + (1e-13 if COMM.rank else 0.0) * rng.standard_normal(self.b.getLocalSize())
        return float(self.b.norm())

    monkeypatch.setattr(SplineSystem, "assemble_residual", off)
    y, steps = demo()
    assert np.abs(y.x.array).max() > 0.0
    assert all(np.array_equal(other, y.x.array) for other in COMM.allgather(y.x.array))
    assert all(other == steps for other in COMM.allgather(steps))
