"""How long preconditioners that age are kept."""

import math

import pytest

from tigar_x.fem.keeping import LONGEST, Keeping, part_of

NEW, SET_UP = 13, 14.0


def cost(ages, keeping=None, solves=200):
    """Iterations of many solves, set-ups as well; a solve with what is of age k takes ``NEW + ages(k)`` of them."""
    total, kept, age = 0.0, False, 0
    for _ in range(solves):
        age = age + 1 if kept else 0
        iterations = NEW + ages(age)
        total += iterations + (0.0 if kept else SET_UP)
        if keeping is not None:
            kept = keeping.served(iterations) if kept else keeping.made(iterations)
    return total


def of_lives(ages, lives, solves=200):
    """The same, where all serve equally often; the least of them."""
    every = [[(SET_UP if k % life == 0 else 0.0) + NEW + ages(k % life) for k in range(solves)] for life in lives]
    return min(map(sum, every))


@pytest.mark.parametrize("rate", [0.0, 0.2, 1.0, 3.0, 6.0])
def test_it_costs_little_more_than_the_best_of_equal_lives(rate):
    assert cost(lambda k: rate * k, Keeping(math.inf, SET_UP)) < 1.03 * of_lives(lambda k: rate * k, range(1, 200))


@pytest.mark.parametrize("first", [10.0, 15.0, 30.0, 100.0])
def test_one_that_ages_at_once_is_hardly_ever_kept(first):
    """Each try costs what it takes more; they become rare."""
    more = cost(lambda k: first * k, Keeping(math.inf, SET_UP)) / cost(lambda k: first * k)
    assert more < 1.0 + 0.003 * first


def test_growth_is_that_of_the_first_solve():
    keeping = Keeping(1.5, SET_UP)
    assert keeping.made(10)
    assert keeping.served(17)
    assert not keeping.served(18)
    assert keeping.made(10)


def test_pauses_double_and_end_with_a_life_that_paid():
    keeping, pauses = Keeping(math.inf, SET_UP), []
    for _ in range(7):
        count = 0
        while not keeping.made(NEW):
            count += 1
        pauses.append(count)
        assert not keeping.served(4 * NEW)
    assert pauses == [0, 1, 2, 4, 8, LONGEST, LONGEST]
    while not keeping.made(NEW):
        pass
    more = 0
    while keeping.served(NEW + more):
        more += 1
    assert keeping.made(NEW)
    assert not keeping.served(4 * NEW)
    assert not keeping.made(NEW)
    assert keeping.made(NEW)


def test_a_solve_that_failed_ends_a_life():
    for growth, next_one_is_kept in ((1.5, True), (math.inf, False)):
        keeping = Keeping(growth, SET_UP)
        assert keeping.made(NEW)
        assert not keeping.served(math.inf)
        assert keeping.made(NEW) is next_one_is_kept


def test_a_matrix_that_is_solved_with_again_saves_no_set_up():
    """Of two solves a step with the same matrix only the first one counts, for lives and pauses."""
    keeping, lives, kept = Keeping(math.inf, SET_UP), [], False
    for step in range(40):
        new, iterations = not kept, NEW if not kept else NEW + 20
        for taken in (iterations, 0.6 * iterations):
            kept = keeping.served(taken, step) if kept else keeping.made(taken, step)
        lives.append(new)
    assert lives.count(False) == 6  # of 40; between them 1, 2, 4, 8 and 16 are made that serve one step


def test_iterations_of_a_small_reduction_count_as_those_of_a_whole_one():
    assert part_of(1e-5, 1.0) == pytest.approx(1.0)
    assert part_of(1e-5, 100.0) == pytest.approx(5 / 3)
    assert part_of(1e-5, 1e9) == pytest.approx(math.log(1e5) / math.log(2.0))
    assert part_of(0.0, 1.0) == part_of(1e-5, 0.0) == part_of(1e-300, 1e-300) == 1.0
