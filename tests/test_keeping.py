"""How long preconditioners that age are kept."""

import math

import pytest

from tigar_x.fem.keeping import LONGEST, Keeping

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
