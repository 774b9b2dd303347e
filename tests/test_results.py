"""Options that scripts share, and the folder of their results."""

import inspect
import json
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal

import pytest

from tigar_x.run import script
from tigar_x.run.convergence import Level, Study
from tigar_x.run.figure import draw, lines
from tigar_x.run.results import Results, with_results
from tigar_x.run.summary import Quantity, against, quantity_table
from tigar_x.run.tally import Tally


@with_results
def plain(results: Results, degree: int = 3, shape: Literal["square", "disc"] | None = None) -> dict[str, Any]:
    """Solve a problem.

    Args:
        degree: of the splines.
        shape: of the domain.

    Returns:
        What is left.
    """
    results.claim()
    return results.summary({"twice": 2 * degree}, errors={"L2_u": 0.5})


@with_results(checkpoint_every=7)
def long(results: Results) -> Results:
    """Step for ever."""
    return results


@with_results(elements=2, levels=3)
def study(results: Results, factor: float = 1.0) -> Any:
    """Solve on finer and finer meshes."""
    solved = type("Solved", (), {"unknowns": 1})
    found, _ = results.refine(
        lambda n: setattr(solved, "n", n) or solved, lambda s: {"e": factor / s.n**2}, {"e": 2.0}, lambda n: n
    )
    return results.convergence(found, "a study", more=1)


@dataclass(frozen=True)
class Problem:
    """A problem with its mesh.

    Attributes:
        degree: of the splines,
            two or more.
        kind: of cells.
    """

    degree: int = 3
    kind: Literal["triangle", "quadrilateral"] = "triangle"


@with_results
def of_a_dataclass(results: Results, problem: Problem, factor: float = 1.0) -> Any:
    """Solve a problem.

    Args:
        factor: of the load.
    """
    return problem, factor, results.inputs


def test_fields_of_a_dataclass_are_options(tmp_path, capsys):
    assert list(inspect.signature(of_a_dataclass).parameters)[:3] == ["degree", "kind", "factor"]
    found = of_a_dataclass(degree=2, factor=0.5, out=tmp_path)
    assert found == (Problem(2), 0.5, {"degree": 2, "kind": "triangle", "factor": 0.5})
    with pytest.raises(ValueError, match="kind = 'hexagon'"):
        of_a_dataclass(kind="hexagon", out=tmp_path)
    with pytest.raises(SystemExit):
        script.command_line(of_a_dataclass, ["--help"])
    said = " ".join(capsys.readouterr().out.split())
    assert "of the splines, two or more." in said
    assert "of the load." in said


def test_the_script_is_called_by_its_file_and_records_its_options(tmp_path):
    summary = plain(degree=4, out=tmp_path)
    assert summary["demo"] == "test_results"
    assert summary["inputs"] == {"degree": 4, "shape": None, "twice": 8}
    assert json.loads((tmp_path / "summary.json").read_text()) == summary
    with pytest.raises(FileExistsError, match="earlier run"):
        plain(out=tmp_path)
    assert plain(out=tmp_path, overwrite=True)["inputs"]["degree"] == 3


def test_options_are_those_of_the_script_and_the_shared_ones():
    names = {f: list(inspect.signature(f).parameters) for f in (plain, long, study)}
    assert names[plain] == ["degree", "shape", "out", "overwrite", "viz"]
    assert names[long] == ["out", "overwrite", "viz", "checkpoint_every", "restart"]
    assert names[study] == ["factor", "elements", "levels", "out", "overwrite", "viz"]
    made = long(out="somewhere", restart="latest")
    assert (made.out, made.checkpoint_every, made.restart, made.viz) == (Path("somewhere"), 7, "latest", True)
    assert long().out == Path("results/test_results")


def test_the_command_line_has_them_with_their_help(tmp_path, capsys):
    summary = script.command_line(plain, ["--degree", "2", "--shape", "disc", "--no-viz", "--out", str(tmp_path)])
    assert summary["inputs"] == {"degree": 2, "shape": "disc", "twice": 4}
    with pytest.raises(SystemExit):
        script.command_line(plain, ["--help"])
    said = capsys.readouterr().out
    assert "of the splines." in said
    assert "folder of the results." in said
    assert "What is left" not in said


@pytest.mark.parametrize(
    ("options", "message"), [({"shape": "cube"}, "shape = 'cube'"), ({"degre": 2}, "degre"), ({"levels": 2}, "levels")]
)
def test_other_options_and_values_are_refused(options, message, tmp_path):
    with pytest.raises((ValueError, TypeError), match=message):
        plain(out=tmp_path, **options)
    assert not list(tmp_path.iterdir())


def test_a_run_may_be_longer_than_the_one_that_it_goes_on_from(tmp_path):
    """Lengths are no inputs that have to agree."""
    stepped = SimpleNamespace(run=lambda **options: options)
    made = Results("valve", {"level": 2, "until": 1.0, "steps": 3, "frames": 4}, tmp_path, viz=False, restart="latest")
    given = made.run(stepped, series=["movie"], until=1.0)
    assert (given["inputs"], given["restart"], given["series"]) == ({"level": 2}, "latest", ())


def test_a_study_takes_its_meshes_from_the_options(tmp_path):
    summary = study(out=tmp_path, elements=3, levels=2)
    assert [level["elements"] for level in summary["levels"]] == [3, 6]
    assert summary["rates"]["e"] == pytest.approx(2.0)
    assert summary["inputs"] == {"factor": 1.0, "elements": 3, "levels": 2}
    assert summary["more"] == 1
    with pytest.raises(ValueError, match="levels = 1"):
        study(out=tmp_path / "other", levels=1)
    assert not (tmp_path / "other").exists()


def test_panels_are_drawn_in_one_picture(tmp_path):
    levels = [Level(n, n, {"e": 1.0 / n}, 0.1 * n, 0.1, 1.0) for n in (2, 4)]
    seen = []

    def in_space(axes):
        seen.append(axes.name)
        axes.set(xlabel="x [m]", ylabel="y [m]", zlabel="z [m]")

    in_space.projection = "3d"
    panels = Study(tuple(levels), {}).draw, lines({"u": ([0, 1], [0, 1])}, x=("t", "s"), y=("u", "m")), in_space
    draw(tmp_path / "pictures" / "all.png", *panels)
    assert (tmp_path / "pictures" / "all.png").stat().st_size > 1000
    assert seen == ["3d"]
    with pytest.raises(ZeroDivisionError):
        draw(tmp_path / "wrong.png", lambda axes: 1 / 0)


def test_quantities_beside_what_is_published():
    found = against({"drag": 5.5, "lift": 0.1}, {"drag": 5.58}, "10.1/x")
    assert found == {"drag": Quantity(5.5, 5.58, "10.1/x"), "lift": Quantity(0.1)}
    summary = {"qoi": {"drag": {"value": 5.5, "published": 5.58}, "lift": {"value": 0.1}}}
    assert "published (doi:10.1/x)" in quantity_table(summary, "10.1/x").splitlines()[0]
    assert quantity_table(summary).splitlines()[-1].split() == ["lift", "0.1", "-"]
    assert "published" not in quantity_table({"qoi": {"drag": {"value": 5.5}}})
    head, row = quantity_table({"qoi": {"frequency": {"value": 0.9, "exact": 1.0}}}).splitlines()
    assert (head.split(), row.split()) == (["quantity", "value", "exact"], ["frequency", "0.9", "1"])


def test_what_one_solve_takes_has_the_names_of_runs():
    costs = Tally({}).once(lambda: SimpleNamespace(iterations=3, linear_iterations=12)).results()
    assert (costs["newton_iterations_mean"], costs["linear_iterations_mean"]) == (3, 12)
    assert costs["wall_s"] >= 0.0
