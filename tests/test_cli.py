"""The command line: examples are found and run, and the self-test says in words what is wrong when something is."""

import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from mpi4py import MPI
from mpi_runs import outside
from on_disk import DEMOS, ROOT
from petsc4py import PETSc

from coudalfish.cli import check, demos, environment, problems
from coudalfish.cli.main import main
from coudalfish.cli.verdict import Check, FaultError, Finding, RemarkError, examined, judged
from coudalfish.surface.trace import TraceMatrix
from shnapr import loads
from tigar_x import compat
from tigar_x.compat import forms
from tigar_x.fem import linear, recipes
from tigar_x.splines import space
from varmint.quantities import BoundaryForce

CHECKS = {one.name: one for one in check.checks()}


def told(capsys, *arguments):
    """Exit status of a command, and its words in one line."""
    status = main(arguments)
    return status, " ".join(capsys.readouterr().out.split())


# -- examples ---------------------------------------------------------------------------------------------------------


def test_every_demo_is_listed_with_what_it_is_about(capsys):
    status, text = told(capsys, "list")
    assert status == 0
    assert list(demos.demos()) == DEMOS
    for path in demos.demos().values():
        assert f"{path.stem} {' '.join(demos.headline(path).split())}" in text
        assert 20 < len(demos.headline(path)) < 130
    assert str(ROOT / "demos") in text


@pytest.fixture
def echo(tmp_path, monkeypatch):
    """A folder with one example, which writes down how it was called."""
    said = tmp_path / "said"
    call = f"open({str(said)!r}, 'w').write(str(sys.argv))"
    code = f'"""Say it.\n\nMore."""\nimport sys\n\nif __name__ == "__main__":\n    {call}\n'
    (tmp_path / "echo_it.py").write_text(code)
    monkeypatch.setattr(demos, "folder", lambda: tmp_path)
    return said


@pytest.mark.parametrize("name", ["echo_it", "echo-it", "echo_it.py"])
def test_an_example_runs_as_a_script_with_its_own_options(name, echo):
    before = sys.argv
    assert main(["run", name, "--level", "3", "-fluid_ksp_rtol", "1e-9", "--help"]) == 0
    assert echo.read_text() == str(
        [str(echo.parent / "echo_it.py"), "--level", "3", "-fluid_ksp_rtol", "1e-9", "--help"]
    )
    assert sys.argv is before


@pytest.mark.usefixtures("echo")
def test_an_example_that_is_not_there(capsys):
    status, text = told(capsys, "run", "echo_him")
    assert status == 2
    assert "There is no example 'echo_him'; did you mean echo_it?" in text
    assert told(capsys, "run", "xyz")[1].startswith("There is no example 'xyz' \"coudalfish list\" shows")


def test_examples_of_an_installed_wheel(tmp_path, monkeypatch):
    """They are where the record of the installation says, not beside the packages."""
    share = tmp_path / "share" / "coudalfish" / "demos"
    share.mkdir(parents=True)
    (share / "one.py").touch()
    (tmp_path / "lib").mkdir()
    monkeypatch.setattr(demos, "__file__", str(tmp_path / "lib" / "coudalfish" / "cli" / "demos.py"))

    def listed(name):
        path = Path("../share/coudalfish/demos") / "one.py"
        file = SimpleNamespace(parent=path.parent, locate=lambda: tmp_path / "lib" / path)
        return [SimpleNamespace(parent=Path("coudalfish"), locate=lambda: tmp_path / "lib/coudalfish/x.py"), file]

    monkeypatch.setattr(demos.importlib.metadata, "files", listed)
    assert demos.demos() == {"one": share / "one.py"}
    monkeypatch.setattr(demos.importlib.metadata, "files", lambda name: None)
    assert demos.folder() is None
    assert main(["run", "one"]) == 2


def test_help_says_how_to_begin(capsys):
    _, text = told(capsys)
    assert "coudalfish check" in text
    assert "mpirun -n 4 coudalfish run" in text
    with pytest.raises(SystemExit) as caught:
        main(["chekc"])
    assert caught.value.code == 2
    assert "invalid choice: 'chekc'" in capsys.readouterr().err


def test_info_says_what_there_is(capsys):
    status, text = told(capsys, "info")
    assert status == 0
    for part in (
        "dolfinx 0.",
        "petsc 3.",
        "mumps",
        str(compat.cache_folder()),
        "GB of memory",
        "-march=native",
        "ranks 1,",
    ):
        assert part in text


# -- verdicts ---------------------------------------------------------------------------------------------------------


def failing(error):
    def work():
        raise error

    return work


@pytest.mark.parametrize(
    ("work", "status", "text"),
    [
        (lambda: "3 of them", "ok", "3 of them"),
        (failing(RemarkError("none there")), "note", "none there"),
        (failing(FaultError("broken", "mend it")), "WRONG", "broken"),
        (failing(ZeroDivisionError("by zero")), "WRONG", "ZeroDivisionError: by zero"),
    ],
)
def test_what_comes_of_a_check(work, status, text):
    outcome = examined(Check("it", work))
    assert (outcome.status, outcome.text) == (status, text)
    assert bool(outcome.advice) == (status == "WRONG")
    later = examined(Check("more", lambda: "done", ("it",)), [outcome])
    assert later.status == ("-" if status == "WRONG" else "ok")
    assert examined(Check("most", lambda: "done", ("more",)), [later]).status == later.status


def test_the_verdict_in_words_and_as_a_status(capsys):
    good, bad = Check("good", lambda: "fine"), Check("bad", failing(FaultError("worn\nout", "get another")))
    assert judged([good, Check("odd", failing(RemarkError("none there")))]) == 0
    assert "All is well: 2 checks" in capsys.readouterr().out
    assert judged([good, bad, Check("late", lambda: "fine", ("bad",))]) == 1
    text = capsys.readouterr().out
    assert "bad ... WRONG  worn\n                 out\n                 what to do: get another\n" in text
    assert "late .. -      not tried, it needs: bad" in text
    assert "Something is wrong: bad (1 of 3 checks, and 1 could not be tried;" in text


@pytest.mark.mpi
def test_a_check_is_as_good_as_on_the_worst_rank():
    rank, last = MPI.COMM_WORLD.rank, MPI.COMM_WORLD.size - 1
    assert examined(Check("one", lambda: f"found on {rank}")) == Finding("one", "ok", "found on 0")
    worst = examined(Check("two", failing(FaultError("broken", "")) if rank == last else lambda: "fine"))
    assert worst == Finding("two", "WRONG", "broken")


# -- the self-test ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", [name for name in CHECKS if name != "more packages"])
def test_all_is_well_here(name):
    outcome = examined(CHECKS[name])
    assert outcome.status == "ok", outcome
    assert outcome.text


@pytest.mark.mpi
def test_the_flap_on_the_ranks_of_this_run():
    found = problems.flap()
    assert found["tip"] == MPI.COMM_WORLD.bcast(found["tip"])
    assert problems.coupled().startswith("a flap bends with the flow by")


def broken_mpirun(patch, folder, script):
    """Another mpirun; a Python beside which there is none."""
    (folder / "mpirun").write_text(f"#!/bin/sh\n{script}\n")
    (folder / "mpirun").chmod(0o755)
    patch.setenv("PATH", f"{folder}:/usr/bin:/bin")
    patch.setattr(problems.sys, "executable", str(folder / "python"))
    (folder / "python").symlink_to(sys.executable)


def no_package(patch, _):
    patch.setitem(sys.modules, "splipy", None)


def old_dolfinx(patch, _):
    patch.setattr(environment, "import_module", failing_for("tigar_x.compat", ImportError("dolfinx 0.8 was found")))


def failing_for(name, error):
    def work(asked):
        if asked == name:
            raise error
        return sys.modules.get(asked)

    return work


def split_mpi(patch, _):
    patch.setenv("OMPI_COMM_WORLD_SIZE", "4")


def complex_numbers(patch, _):
    patch.setattr(PETSc, "ScalarType", complex)


def no_mumps(patch, _):
    patch.setattr(linear, "direct", lambda package="none": recipes.direct(package))


def no_compiler(patch, _):
    patch.setenv("CC", "/bin/false")


def unwritable(patch, folder):
    (folder / "file").touch()
    patch.setitem(next(iter(forms.JIT.values())), "cache_dir", str(folder / "file" / "fenics"))


def two_hdf5(patch, folder):
    (folder / "h5py.py").write_text("raise RuntimeError('Headers are 1.14.0, library is 1.10.8')\n")
    patch.setenv("PYTHONPATH", f"{folder}:{os.environ.get('PYTHONPATH', ROOT)}")


def perturbed_extraction(patch, _):
    made = space.petsc_matrix
    patch.setattr(space, "petsc_matrix", lambda rows, comm: made(1.001 * rows, comm))


def wrong_sign(patch, _):
    right = loads.dead_load
    patch.setattr(loads, "dead_load", lambda *arguments: -right(*arguments))


def half_a_force(patch, _):
    whole = BoundaryForce.__call__
    patch.setattr(BoundaryForce, "__call__", lambda self: 0.5 * whole(self))


def lossy_trace(patch, _):
    whole = TraceMatrix.transposed.func
    patch.setattr(TraceMatrix, "transposed", property(lambda self: 0.99 * whole(self)))


def failing_ranks(patch, folder):
    broken_mpirun(patch, folder, "echo 'There are not enough slots available' >&2; exit 1")


def lonely_ranks(patch, folder):
    broken_mpirun(patch, folder, """echo '{"ranks": 1, "force": [0.0]}'""")


def other_ranks(patch, folder):
    broken_mpirun(patch, folder, """echo '{"ranks": 2, "force": [1.0, 0.0, 0.0, 0.0, 0.0, 0.0]}'""")


@pytest.mark.parametrize(
    ("name", "harm", "text", "advice"),
    [
        ("packages", no_package, "missing: splipy (ModuleNotFoundError", "make setup"),
        ("packages", old_dolfinx, "dolfinx 0.8 was found", "README.md says what runs on what"),
        ("MPI", split_mpi, "4 processes were started that do not see each other", "mpirun of that library"),
        ("PETSc", complex_numbers, "built for complex numbers", "real ones"),
        ("PETSc", no_mumps, "direct(none) does not solve a small system", "a PETSc with MUMPS"),
        ("compiler", no_compiler, "/bin/false", "install gcc"),
        ("cache", unwritable, "file/fenics: Not a directory", "XDG_CACHE_HOME"),
        ("files", two_hdf5, "Headers are 1.14.0, library is 1.10.8", "one HDF5 library"),
        ("splines", perturbed_extraction, "the functions of a spline do not add up to one: 1.001", "make test"),
        ("shell", wrong_sign, "moves by 0.0001365, not by -0.0001365", "make test"),
        ("flow", half_a_force, "on a plate is -0.1, not -0.2", "make test"),
        ("coupled step", lossy_trace, "on the fluid differ by", "make test"),
        ("two ranks", failing_ranks, "two ranks fail: There are not enough slots available", "mpirun -n 2"),
        ("two ranks", lonely_ranks, "mpirun starts 1 rank twice", "MPI library of mpi4py"),
        ("two ranks", other_ranks, "between one rank and two", "make test"),
    ],
    ids=lambda value: getattr(value, "__name__", None),
)
def test_what_is_wrong_is_said_with_advice(name, harm, text, advice, monkeypatch, tmp_path):
    harm(monkeypatch, tmp_path)
    outcome = examined(CHECKS[name])
    assert outcome.status == "WRONG"
    assert text in outcome.text
    assert advice in outcome.advice


def test_what_not_everybody_needs_is_a_note(monkeypatch):
    monkeypatch.setitem(sys.modules, "gmsh", None)
    outcome = examined(CHECKS["more packages"])
    assert outcome.status == "note"
    assert "gmsh is not there: meshes from geometry" in outcome.text
    monkeypatch.setattr(problems.shutil, "which", lambda *_, **__: None)
    assert examined(CHECKS["two ranks"]).text == "mpirun is not there: runs use one processor"


def test_with_a_package_missing_the_check_ends_soon_and_with_an_error(monkeypatch, capsys):
    """And every check is there in the order in which one needs another."""
    no_package(monkeypatch, None)
    status, text = told(capsys, "check")
    assert status == 1
    assert text.count("not tried, it needs: packages") == len(CHECKS) - 3
    assert "Something is wrong: packages (1 of 12 checks, and 9 could not be tried" in text
    names = list(CHECKS)
    for i, one in enumerate(CHECKS.values()):
        assert set(one.needs) <= set(names[:i])


@pytest.mark.slow
def test_the_whole_check_with_an_empty_cache(tmp_path):
    environ = outside() | {"XDG_CACHE_HOME": str(tmp_path), "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-m", "coudalfish", "check"]
    done = subprocess.run(command, capture_output=True, text=True, env=environ, cwd=tmp_path)
    assert done.returncode == 0, done.stdout
    assert f"All is well: {len(CHECKS)} checks" in done.stdout
    assert not done.stderr
    assert len(list((tmp_path / "fenics").glob("*.cached"))) > 10
