"""Relaxation of the multiplier in longer runs; benchmarks/relaxation.py tabulates more of them."""

import pytest
import relaxation


@pytest.fixture(scope="module")
def figures():
    """Of a run without relaxation, with the uniform and with the smoothed one."""
    choices = {"none": 0.0, "uniform": 1e-2, "smoothed": 1.0}
    return {name: relaxation.run("arc, points h/4 apart", name, r, None, n=4, steps=400) for name, r in choices.items()}


def test_smoothed_relaxation_stops_patterns_and_does_not_leak(figures):
    none, smoothed = figures["none"], figures["smoothed"]
    assert none["growth"] > 0.3
    assert smoothed["growth"] < 2e-3
    assert smoothed["pattern"] < 0.25 * none["pattern"]
    assert abs(smoothed["leak"]) < 1e-9
    assert smoothed["passes"] < none["passes"]
    assert smoothed["outflow"] == pytest.approx(none["outflow"], rel=0.05)


def test_uniform_relaxation_leaks_by_its_law(figures):
    """And patterns decay later."""
    uniform = figures["uniform"]
    assert uniform["leak"] == pytest.approx(uniform["law"], rel=0.02)
    assert figures["smoothed"]["growth"] < 0.2 * uniform["growth"]
    assert uniform["growth"] < 0.02
    assert uniform["outflow"] > 2.0 * figures["smoothed"]["outflow"]


def test_the_table_has_a_row_for_every_choice(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(relaxation, "run", lambda *a, **k: dict.fromkeys(relaxation.HEADER[3:], 1.0))
    lines = relaxation.main(tmp_path, only="arc")
    assert len(lines) == 2 + 2 * len(relaxation.CHOICES)
    assert (tmp_path / "relaxation.md").read_text().splitlines() == lines
    assert lines[-1] in capsys.readouterr().out
