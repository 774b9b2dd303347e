"""Rates fitted to errors, and the table and summary of a refinement study."""

from types import SimpleNamespace

import pytest

from tigar_x.run.convergence import Level, Study, doubled, halved, observed_rates, refine


def level(n, **errors):
    return Level(n, n**2, errors, 0.1 * n, 0.2 * n, 100.0)


def powers(elements=(4, 8, 16), **rates):
    return Study(tuple(level(n, **{name: 3.0 * n**-r for name, r in rates.items()}) for n in elements), rates)


def test_rates_of_powers_are_their_exponents():
    assert powers(L2_u=3.0, H1_u=1.5).rates == pytest.approx({"L2_u": 3.0, "H1_u": 1.5}, abs=1e-12)
    assert powers((3, 5, 6), L2_u=0.7).rates == pytest.approx({"L2_u": 0.7}, abs=1e-12)


def test_rates_are_those_of_the_finest_levels():
    levels = (level(1, L2_u=1e-9), level(2, L2_u=1.0), *powers(L2_u=2.0).levels)
    assert Study(levels, {}).rates == pytest.approx({"L2_u": 2.0}, abs=1e-12)
    assert Study(levels, {}, last=4).rates["L2_u"] != pytest.approx(2.0, abs=0.1)


def test_table_and_results():
    study = powers(L2_u=2.0, other=1.0)
    lines = Study(study.levels, {"L2_u": 2.0}).table().splitlines()
    assert [line.split() for line in lines[-2:]] == [["rate", "2.00", "1.00"], ["theory", "2", "-"]]
    assert len(lines) == 1 + 3 + 2
    results = study.results()
    assert results["errors"] == study.levels[-1].errors
    assert results["cpu_s"] == pytest.approx(0.1 * 28)
    assert results["wall_s"] == pytest.approx(0.2 * 28)
    assert results["unknowns"] == 256


def test_refine_calls_every_mesh_once():
    seen = []

    def solve(n):
        seen.append(n)
        return SimpleNamespace(unknowns=n + 1)

    study, finest = refine(solve, lambda s: {"e": 1.0 / s.unknowns}, doubled(3, 3), {"e": 1.0})
    assert seen == [3, 6, 12]
    assert finest.unknowns == 13
    assert [v.unknowns for v in study.levels] == [4, 7, 13]
    assert all(v.cpu_s >= 0.0 and v.peak_rss_mib > 1.0 for v in study.levels)


def test_bad_input_is_named():
    for arguments, name in (((0, 2), "elements = 0"), ((2, 1), "levels = 1"), ((2.5, 2), "elements = 2.5")):
        with pytest.raises(ValueError, match=name):
            doubled(*arguments)
    with pytest.raises(ValueError, match=r"errors\['e'\] = nan"):
        level(2, e=float("nan"))
    with pytest.raises(ValueError, match=r"errors\['e'\] = 0.0"):
        level(2, e=0.0)
    with pytest.raises(ValueError, match="levels has 1 entries"):
        powers((4,), e=1.0)
    with pytest.raises(ValueError, match="last = 1"):
        Study(powers(e=1.0).levels, {}, last=1)
    with pytest.raises(ValueError, match="against = 'unknown'"):
        powers(e=1.0).draw(None, unit="-", against="unknown")


def test_meshes_that_end_with_a_given_one():
    assert halved(12, 3) == (3, 6, 12)
    assert halved(5, 1) == (5,)
    for arguments, named in (((12, 4), "elements = 12"), ((6, 2, 2, 2), "a multiple of 4"), ((1, 1), "elements = 1")):
        with pytest.raises(ValueError, match=named):
            halved(*arguments[:2], **dict(zip(("least", "multiple"), arguments[2:], strict=False)))


def test_rates_of_differences():
    values = [{"a": 1.0 + 2.0 * n**-2.0, "b": n**-1.0} for n in (4, 8, 16)]
    assert observed_rates(values) == pytest.approx({"a": 2.0, "b": 1.0}, abs=1e-10)
    assert observed_rates(values[:2]) is None


def test_a_report_is_no_solution():
    """Then what was prepared is it."""
    prepared = SimpleNamespace(unknowns=7)
    study, found = refine(lambda problem: "a report", lambda s: {"e": 1.0}, (1, 2), {}, lambda n: prepared)
    assert found is prepared
    assert study.levels[0].unknowns == 7
