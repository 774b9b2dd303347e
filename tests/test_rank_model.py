"""Counts of a step on several ranks, and the model of a step that is made of them."""

import csv
import shutil
from dataclasses import replace

import numpy as np
import pytest
import rank_counts
import rank_model
from mpi4py import MPI

WITHIN = 1.4
"""Factor between what the model says and what is counted."""


def rows(preset):
    return [row for row in rank_counts.read(rank_model.COUNTED) if row["preset"] == preset]


def predicted(model, row):
    return model.predicted(row["cells"], int(row["ranks"]), row["solves"], row["iterations"])


@pytest.mark.parametrize("preset", rank_counts.PRESETS)
def test_counts_on_two_and_four_ranks_tell_those_on_eight_and_sixteen(preset):
    few, many = ([r for r in rows(preset) if (r["ranks"] > 4) == more] for more in (False, True))
    model = rank_model.Counts.of(few)
    assert {row["ranks"] for row in many} == {8, 16}
    for row in many:
        guess, counted = predicted(model, row), rank_model.measured(row)
        for name in ("messages", "collectives", "collectives_bytes", "neighbours", "memory_mib"):
            assert 1.0 / WITHIN < guess[name] / counted[name] < WITHIN, (name, row["cells"], row["ranks"])
        for name in ("messages_bytes", "points_imbalance"):
            assert 0.5 < guess[name] / counted[name] < 2.0, (name, row["cells"], row["ranks"])


def test_a_model_of_made_up_counts_is_exact():
    made = rank_model.Counts((2.0, 20.0), (400.0, 3000.0), (3.0, 2.0, 100.0), 3000.0, (200.0, 1e-3, 0.1))
    kinds = {f"{kind}{what}": 0.0 for kind in rank_counts.KINDS for what in ("", "_bytes")}
    table = []
    for cells, ranks, iterations in ((1e4, 1, 20.0), (1e4, 2, 22.0), (4e4, 4, 30.0), (4e4, 8, 18.0), (9e4, 16, 25.0)):
        guess = made.predicted(cells, ranks, 3.0, iterations)
        faces, to = rank_model.interface(cells, ranks), rank_model.neighbours(ranks)
        row = kinds | {name: guess[name] for name in ("messages", "messages_bytes", "memory_mib")}
        row |= {"allreduces": guess["collectives"], "allreduces_bytes": guess["collectives_bytes"], "preset": "plain"}
        row |= {"solve_collectives": max(0.0, guess["collectives"] - 100.0), "solves": 3.0, "iterations": iterations}
        row |= {"solve_messages": 2.0 * iterations * to, "solve_message_bytes": 400.0 * iterations * faces}
        table.append(row | {"cells": cells, "ranks": ranks})
    found = rank_model.Counts.of(table)
    for name, value in vars(made).items():
        np.testing.assert_allclose(getattr(found, name), value, rtol=1e-6)


def test_one_rank_sends_nothing_and_many_have_little_of_each():
    model = rank_model.Counts.of(rows("plain"))
    alone = model.predicted(1e6, 1, 3.0, 30.0)
    assert alone["messages"] == alone["messages_bytes"] == alone["collectives"] == alone["collectives_bytes"] == 0.0
    times, network = rank_model.Times(1e-5, 1e-5, 1e-5, 1e-5), rank_model.Network()
    few, many = (rank_model.step(model, times, network, 1e6, ranks, 3.0, 30.0) for ranks in (64, 1024))
    for part in ("own cells", "shell"):
        assert many[part] == pytest.approx(few[part] / 16)
    assert many["every rank"] == few["every rank"]
    assert few["points"] / 16 < many["points"] < few["points"]
    assert many["collectives"] > few["collectives"]


@pytest.mark.parametrize(
    ("wrong", "text"),
    [
        ({"ranks": 0}, "ranks = 0"),
        ({"cells": 0.0}, "cells = 0"),
        ({"solves": -1.0}, "solves = -1"),
        ({"iterations": np.nan}, "iterations = nan"),
    ],
)
def test_wrong_numbers_are_refused(wrong, text):
    right = {"cells": 1e5, "ranks": 4, "solves": 2.0, "iterations": 20.0}
    with pytest.raises(ValueError, match=text):
        rank_model.Counts.of(rows("plain")).predicted(**right | wrong)


def test_wrong_networks_and_tables_are_refused(tmp_path):
    with pytest.raises(ValueError, match="latency = -1"):
        replace(rank_model.Network(), latency=-1.0)
    with pytest.raises(ValueError, match="three or more of one preset"):
        rank_model.Counts.of(rows("plain") + rows("jump"))
    with pytest.raises(ValueError, match="three or more of one preset"):
        rank_model.Counts.of(rows("plain")[:2])
    other = tmp_path / "other.csv"
    with other.open("w", newline="") as file:
        csv.writer(file).writerows([["preset", "ranks"], ["plain", 1]])
    with pytest.raises(ValueError, match=r"other\.csv: a table of rank_counts\.py is required"):
        rank_counts.read(other)
    with pytest.raises(ValueError, match="presets = 'none'"):
        rank_counts.main(presets="none", out=tmp_path)
    with pytest.raises(ValueError, match="steps = 0"):
        rank_counts.main(steps=0, out=tmp_path)


def test_without_its_library_nothing_is_counted():
    with pytest.raises(RuntimeError, match=r"messages\.c is not loaded"):
        rank_counts.Counts()


@pytest.mark.slow
@pytest.mark.skipif(MPI.COMM_WORLD.size > 1 or shutil.which("mpicc") is None, reason="starts ranks itself, by mpicc")
@pytest.mark.parametrize("ranks", [2, 3])
def test_a_step_is_counted_and_as_the_model_says(ranks):
    row = rank_counts.run(ranks, "plain", 8, steps=1, before=1)
    guess, counted = predicted(rank_model.Counts.of(rows("plain")), row), rank_model.measured(row)
    assert row["cells_imbalance"] < 1.1
    for name in ("messages", "messages_bytes", "collectives", "collectives_bytes", "memory_mib"):
        assert 0.5 < guess[name] / counted[name] < 2.0, name
