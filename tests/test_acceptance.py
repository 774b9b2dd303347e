"""When a step of the coupling has converged: what its residuals are referred to, and what is said where it has not."""

import pytest

from coudalfish import CouplingOptions
from coudalfish.step.acceptance import GROWTH_LIMIT, RISE_LIMIT, STALL, Acceptance
from coudalfish.step.report import RejectedStepError

RTOL = 0.1
COUPLING = (1e9, 1e9)


def acceptance(**options):
    return Acceptance(CouplingOptions(**(dict(block_rtol=RTOL, block_atol=0.0) | options)))


def no_floors():
    return 0.0, 0.0


def unwanted():
    return pytest.fail("floors are asked for although the relative limits hold")


def limits(judge, *tests, coupling=COUPLING, floors=no_floors):
    """What would have been accepted at every one of the tests."""
    found = []
    for norms in tests:
        judge.test(norms, coupling, floors)
        found.append(judge.limits)
    return found


def test_residuals_are_referred_to_the_largest_of_the_first_pass():
    """Those before it, what the fluid's solution makes of the shell's in it, and those after it."""
    judge = acceptance()
    assert limits(judge, (4.0, 0.0)) == [(0.4, 0.0)]
    judge.note(0.0, 30.0)
    assert limits(judge, (2.0, 20.0), (100.0, 100.0)) == [pytest.approx((0.4, 3.0))] * 2
    later = acceptance()
    assert limits(later, (4.0, 1.0), (5.0, 2.0), (9.0, 9.0)) == [(0.4, 0.1), (0.5, 0.2), (0.5, 0.2)]


def test_the_published_reference_is_the_first_residual_alone():
    judge = acceptance(stopping="published")
    assert limits(judge, (4.0, 1.0), (5.0, 2.0), coupling=(1e-3, 1e-3)) == [(0.4, 0.1)] * 2


@pytest.mark.parametrize("stopping", ["published", "before_solve"])
def test_a_residual_that_starts_below_its_floor_is_referred_to_what_the_first_pass_makes_of_it(stopping):
    judge = acceptance(stopping=stopping)
    found = limits(judge, (1e-9, 1.0), (5.0, 0.5), (9.0, 9.0), floors=lambda: (1e-8, 1e-8))
    assert found == [(1e-8, 0.1), (0.5, 0.1), (0.5, 0.1)]


def test_a_small_coupling_force_is_the_reference_and_none_is_not():
    assert limits(acceptance(), (4.0, 1.0), coupling=(2.0, 1e9)) == [(0.2, 0.1)]
    assert limits(acceptance(), (4.0, 1.0), coupling=(0.0, 0.5)) == [(0.4, 0.05)]


def test_both_residuals_have_to_be_small():
    for norms, small in (((0.4, 0.1), True), ((0.41, 0.1), False), ((0.4, 0.11), False)):
        judge = acceptance()
        judge.test((4.0, 1.0), COUPLING, no_floors)
        assert judge.test(norms, COUPLING, no_floors) is small


def test_floors_raise_limits_and_are_asked_for_where_these_are_exceeded_only():
    judge = acceptance(block_atol=1e-8)
    assert limits(judge, (4.0, 1.0), floors=lambda: (2.0, 0.01)) == [(2.0, 0.1)]
    assert judge.test((1.9, 0.1), COUPLING, lambda: (2.0, 0.01))
    assert judge.test((0.3, 0.1), COUPLING, unwanted)


@pytest.mark.parametrize(
    ("norms", "block"), [((4.4 * GROWTH_LIMIT, 1.0), "fluid"), ((4.0, 1.1 * GROWTH_LIMIT), "shell")]
)
def test_a_residual_that_grows_without_bound_rejects_the_step_and_names_its_block(norms, block):
    judge = acceptance()
    judge.test((4.0, 1.0), COUPLING, no_floors)
    judge.test((4.0, 1.0), COUPLING, no_floors)
    judge.test((3.9 * GROWTH_LIMIT, 0.9 * GROWTH_LIMIT), COUPLING, no_floors)
    with pytest.raises(RejectedStepError, match=r"grew 1.\de\+03 times in 3 passes") as caught:
        judge.test(norms, COUPLING, no_floors)
    assert caught.value.block == block


@pytest.mark.parametrize(("factors", "block"), [((1.1, 0.9), "fluid"), ((0.9, 1.1), "shell")])
def test_newtons_method_is_given_up_where_a_residual_rises_again(factors, block):
    """Above the least one after the first pass; what the first pass does to a residual is no rise."""
    judge = acceptance(multiplier="converged", block_rtol=1e-6)
    for norms in ((0.01, 0.01), (4.0, 2.0), (40.0, 20.0), (4.4, 2.2)):
        judge.test(norms, COUPLING, no_floors)
    above = 4.0 * factors[0] * RISE_LIMIT, 2.0 * factors[1] * RISE_LIMIT
    with pytest.raises(RejectedStepError, match=r"pass 4 is 22 times one before") as caught:
        judge.test(above, COUPLING, no_floors)
    assert caught.value.block == block


def test_residuals_that_rise_below_their_limits_or_of_solves_in_turn_are_none_of_an_iteration_that_wanders():
    rises = (4.0, 1.0), (1e-5, 1e-5), (0.02, 0.02), (30.0, 0.5)
    assert limits(acceptance(multiplier="lagged"), *rises)[-1] == (0.4, 0.1)
    small = acceptance(multiplier="converged", block_rtol=0.1)
    assert small.test((4.0, 1.0), COUPLING, no_floors) is False
    assert [small.test(norms, COUPLING, no_floors) for norms in rises[1:3]] == [True, True]
    beside = acceptance(multiplier="converged", block_rtol=0.1)  # the other one is above its limit
    assert limits(beside, (4.0, 1.0), (1e-5, 0.5), (0.02, 0.5))[-1] == (0.4, 0.1)


def test_a_pass_that_reduces_one_residual_too_little_stalls():
    judge = acceptance()
    assert not judge.stalled
    for norms, stalled in (((4.0, 1.0), False), ((4.0 * STALL, STALL), False), ((0.1, 1.01 * STALL**2), True)):
        judge.test(norms, COUPLING, no_floors)
        assert judge.stalled is stalled


def test_the_block_further_from_convergence_is_named():
    judge = acceptance()
    limits(judge, (4.0, 1.0), (2.0, 0.9))
    failed = judge.failure()
    assert failed.block == "shell"
    assert "fluid 5, shell 9" in str(failed)


@pytest.mark.parametrize(
    ("norms", "expected"),
    [
        ([(1.0, 1.0)], False),
        ([(1.0, 1.0), (0.3, 0.3)], True),
        ([(1.0, 1.0), (0.3, 0.4)], False),
        ([(1.0, 1.0), (0.05, 0.3)], True),
        ([(1.0, 1.0), (0.3, 0.3), (0.28, 0.1)], False),
    ],
)
def test_accepted_residuals_are_within_reach_where_one_more_pass_like_the_last_one_leaves_them(norms, expected):
    """Of a tenth of the first ones."""
    judge = acceptance()
    for pair in norms:
        judge.test(pair, COUPLING, no_floors)
    assert judge.within_reach == expected
