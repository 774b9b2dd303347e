"""Anderson acceleration, alone and where the block iteration needs it."""

import logging
from dataclasses import replace

import numpy as np
import pytest
from scenes import sheet_in_flow

from coudalfish import CouplingOptions, PenaltyRule, StepError, advance
from coudalfish.step.acceleration import Anderson

STIFF = CouplingOptions(penalty=PenaltyRule(300.0, 0.0), block_rtol=1e-5, second_attempt=False, max_passes=40)


def moving_sheet(options):
    return sheet_in_flow((0.0, 0.0), sheet_velocity=(0.5, 0.0), options=options, rho_infinity=0.0)


def iterations(depth, spectral_radius=0.98, n=4):
    """Steps to solve a linear fixed-point problem to 1e-10."""
    rng = np.random.default_rng(3)
    A = rng.normal(size=(n, n))
    A *= spectral_radius / np.abs(np.linalg.eigvals(A)).max()
    solution = rng.normal(size=n)
    b = solution - A @ solution
    x, mix = np.zeros(n), Anderson(depth) if depth else None
    for k in range(2000):
        if np.abs(x - solution).max() < 1e-10:
            return k
        image = A @ x + b
        x = mix.next(x, image) if mix else image
    return 2000


def test_a_linear_problem_is_solved_in_as_many_steps_as_it_has_unknowns():
    assert iterations(4) <= 4 + 2
    assert iterations(0) > 100


def test_first_step_is_the_plain_one():
    image = np.array([1.0, -2.0])
    np.testing.assert_array_equal(Anderson(3).next(np.zeros(2), image), image)


def test_repeated_iterates_do_no_harm():
    mix = Anderson(3)
    for _ in range(4):
        np.testing.assert_allclose(mix.next(np.ones(2), np.ones(2)), 1.0)


@pytest.mark.mpi
def test_large_penalties_converge_with_acceleration_only():
    with pytest.raises(StepError, match="no convergence in 40 passes"):
        moving_sheet(replace(STIFF, acceleration=0)).fsi.takeStep()
    report = moving_sheet(STIFF).fsi.takeStep()
    assert report.attempts == 1
    assert STIFF.accelerate_after < report.passes <= 40


@pytest.mark.mpi
def test_second_attempt_rescues_a_step_and_says_so(caplog):
    patient = replace(STIFF, accelerate_after=10**6, max_passes=80)
    with pytest.raises(StepError):
        moving_sheet(patient).fsi.takeStep()
    scene, direct = moving_sheet(replace(patient, second_attempt=True)), moving_sheet(STIFF)
    with caplog.at_level(logging.WARNING, logger="coudalfish"):
        report = scene.fsi.takeStep()
    assert report.attempts == 2
    direct.fsi.takeStep()
    np.testing.assert_allclose(scene.y.x.array, direct.y.x.array, atol=1e-7)
    if scene.domain.comm.rank == 0:
        assert any("attempting it again" in record.getMessage() for record in caplog.records)


def test_a_hopeless_penalty_is_named():
    options = CouplingOptions(penalty=PenaltyRule(1e7, 0.0), max_passes=10, block_rtol=1e-8)
    scene = moving_sheet(options)
    before = scene.y.x.array.copy()
    with pytest.raises(StepError, match=r"suspect: penalty/impedance of the flow.*lower the penalty beta"):
        scene.fsi.takeStep()
    np.testing.assert_array_equal(scene.y.x.array, before)


# -- smaller steps ----------------------------------------------------------------------------------------------------

IMPATIENT = CouplingOptions(
    penalty=PenaltyRule(30.0, 0.0), block_rtol=1e-4, acceleration=0, second_attempt=False, max_passes=8
)


@pytest.mark.mpi
def test_advance_cuts_the_step_where_it_fails():
    scene = moving_sheet(IMPATIENT)
    with pytest.raises(StepError):
        scene.fsi.takeStep()
    reports = advance(scene.fsi, 0.1)
    assert len(reports) > 1
    assert scene.fsi.timeInt_f.time == pytest.approx(0.1, rel=1e-12)
    assert scene.fsi.timeInt_sh.time == pytest.approx(0.1, rel=1e-12)
    assert scene.fsi.step_size == 0.1


def test_advance_takes_one_step_where_one_is_enough():
    whole, plain = moving_sheet(CouplingOptions()), moving_sheet(CouplingOptions())
    (report,) = advance(whole.fsi, 0.1)
    assert report == plain.fsi.takeStep()


def test_advance_gives_up_after_the_allowed_halvings():
    scene = moving_sheet(IMPATIENT)
    with pytest.raises(StepError):
        advance(scene.fsi, 0.1, halvings=0)
    assert scene.fsi.timeInt_f.time == 0.0
    assert scene.fsi.step_size == 0.1
    with pytest.raises(ValueError, match=r"interval = 0"):
        advance(scene.fsi, 0.0)
