"""After a step that fails, one that succeeds is to the last bit that which it would have been without the failure.

On several ranks as near as two runs that do the same.
"""

from contextlib import contextmanager, suppress
from dataclasses import replace

import numpy as np
import pytest
import test_moving_coupler as on_a_moving_mesh
from mpi4py import MPI
from mpi_runs import SAME_RUN
from scenes import free_sheet, sheet_in_flow
from test_coupled_contact import approaching
from test_flow import cavity
from test_solids import beam_flow

from coudalfish import CouDALFISh, CouplingOptions, FluidSubproblem, StepError
from tigar_x.fem.linear import SolveError, gmres_ilu
from tigar_x.fem.schemes import generalized_alpha
from varmint.flow import FlowError

SMOOTHED = CouplingOptions(relaxation=0.5, relaxation_mode="smoothed")
ON_LINES = ((0.5, 0.25), (0.5, 0.75))  # points on edges between cells of a mesh with 6 cells


def sheet(**settings):
    return sheet_in_flow((0.0, 0.0), sheet_velocity=(0.5, 0.1), **settings).fsi


def solid():
    """A beam in the flow moves the mesh in every pass; the sheet lies outside."""
    flow = beam_flow(0.5, generalized_alpha(0.5), rho=1.0, mu=0.5, rtol=1e-9, pressure="pin")
    hooks = {"updates": flow.updates, "before": flow.before, "moving": flow.moving}
    numbers = {"density": 1.0, "viscosity": 0.5}
    fluid = FluidSubproblem(flow.mesh.domain, flow.residual, flow.time, bcs=flow.bcs, **hooks, **numbers)
    shell = free_sheet(dt=0.5, ends=((3.0, 0.0), (3.0, 1.0))).shell
    return CouDALFISh(fluid, shell, CouplingOptions(block_rtol=1e-8))


SCENES = {
    "sheet": lambda: sheet(),
    "smoothed": lambda: sheet(options=SMOOTHED),
    "on lines": lambda: sheet_in_flow((0.0, 0.0), sheet_velocity=(0.0, 0.1), ends=ON_LINES).fsi,
    "iterative": lambda: sheet(solver=gmres_ilu(1), n=8),
    "contact": lambda: approaching(dt=0.04).fsi,
    "elastic mesh": lambda: on_a_moving_mesh.scene(on_a_moving_mesh.elastic, sheet_velocity=(0.5, 0.1)),
    "solid": solid,
}
ON_RANKS = ("sheet", "contact", "elastic mesh")
"""Scenes for several ranks, one of every kind."""


def everything(fsi):
    """What a step leaves behind: fields, rates, multiplier, clocks, floors, cells of the points and the band."""
    arrays = [fsi.lam.copy(), np.array(fsi.floors), fsi.locator.cells.copy()]
    arrays += [np.array([float(time.t.value), float(time.t_alpha.value)]) for time in fsi.integrators]
    arrays += [f.x.array.copy() for time in fsi.integrators for f in (time.x, *time.state.values())]
    band = fsi.fluid.band
    return arrays if band is None else arrays + [f.x.array.copy() for f in (band.scale_m, band.scale_c)]


def assert_same(found, expected, rtol=SAME_RUN):
    for new, old in zip(found, expected, strict=True):
        np.testing.assert_allclose(new, old, rtol=0.0, atol=rtol * np.abs(old).max(initial=0.0))


def assert_same_report(found, expected):
    assert abs(found.passes - expected.passes) <= (SAME_RUN > 0.0)
    if MPI.COMM_WORLD.size == 1:
        assert found == expected


@contextmanager
def changed(thing, **values):
    before = {name: getattr(thing, name) for name in values}
    for name, value in values.items():
        setattr(thing, name, value)
    try:
        yield
    finally:
        for name, value in before.items():
            setattr(thing, name, value)


def too_few_passes(fsi):
    """Both attempts run, move the shell and end after tangents of their own."""
    options = replace(fsi.options, block_rtol=1e-15, block_atol=0.0, max_passes=3)
    with changed(fsi, options=options), pytest.raises(StepError, match="no convergence"):
        fsi.takeStep()


def too_long(fsi):
    """The points have gone far when it fails."""
    with changed(fsi, step_size=4.0 * fsi.step_size):
        too_few_passes(fsi)


def broken_solver(fsi):
    """In the second pass, of either side in turn."""
    for side in (fsi.fluid, fsi.shell):
        solve, calls = side.solve, []

        def fail(*arguments, solve=solve, calls=calls, **options):
            calls.append(0)
            if len(calls) % 2 == 0:
                raise SolveError("as told")
            return solve(*arguments, **options)

        tight = replace(fsi.options, block_rtol=1e-12)
        with changed(side, solve=fail), changed(fsi, options=tight), pytest.raises(StepError, match="as told"):
            fsi.takeStep()


def interrupted(fsi):
    def interrupt():
        raise KeyboardInterrupt

    with changed(fsi.shell, solve=interrupt), suppress(KeyboardInterrupt):
        fsi.takeStep()


FAILURES = (too_few_passes, too_long, broken_solver, interrupted)


@pytest.mark.mpi
@pytest.mark.parametrize("name", SCENES if MPI.COMM_WORLD.size == 1 else ON_RANKS)
def test_a_step_after_failures_is_that_without_them(name):
    plain, tried = (SCENES[name]() for _ in "ab")
    for number in range(3):
        failures = FAILURES if number != 1 else FAILURES[::-1]
        before = everything(tried) if number else None
        for fail in failures:
            fail(tried)
            if before is not None:
                assert_same(everything(tried), before, 0.0)
        expected, report = plain.takeStep(), tried.takeStep()
        assert_same_report(report, expected)
        assert_same(everything(tried), everything(plain))


@pytest.mark.mpi
def test_a_flow_goes_on_from_a_failure_with_the_tangent_that_it_kept():
    plain, tried = (cavity("pin", dt=0.1) for _ in "ab")
    for _ in range(4):
        hopeless = replace(tried.options, rtol=1e-14, max_iterations=3)
        with changed(tried, options=hopeless), changed(tried.time, step_size=0.4), pytest.raises(FlowError):
            tried.take_step()
        found, expected = tried.take_step(), plain.take_step()
        assert found.tangents == expected.tangents
        assert_same([tried.w.x.array], [plain.w.x.array])


def test_before_its_first_solve_a_step_does_not_look_at_tangents_of_one_that_failed():
    def floors_of_first_test(fsi):
        found = []

        def stop(**_):
            found.append(fsi.floors)
            raise KeyboardInterrupt

        with changed(fsi.fluid, solve=stop), suppress(KeyboardInterrupt):
            fsi.takeStep()
        return found[0]

    plain, tried = sheet(), sheet()
    too_few_passes(tried)
    assert floors_of_first_test(tried) == floors_of_first_test(plain)
