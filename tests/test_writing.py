"""Writing by one rank: files that are replaced at once, and errors that reach all ranks."""

import os
import resource
import signal
from contextlib import contextmanager

import pytest
from dolfinx import mesh
from mpi_runs import MPIRUN, mpirun
from splines import WORLD, spline

from tigar_x.geometry import files, shapes
from tigar_x.ranks import on_root, root_only, together
from tigar_x.run.output import CSVSeries, XDMFSeries
from tigar_x.run.summary import write_summary
from tigar_x.run.writing import claim, replace_text
from tigar_x.splines import saved
from tigar_x.splines.vtu import VTUSeries


@pytest.fixture
def folder(tmp_path):
    """One folder for all ranks."""
    return WORLD.bcast(tmp_path, root=0)


# -- errors of some ranks ---------------------------------------------------------------------------------------------


@pytest.mark.mpi
def test_what_fails_on_rank_0_fails_on_all():
    class OddError(Exception):
        """Cannot be sent to another rank."""

    def fail(error):
        raise error

    assert on_root(WORLD, lambda: WORLD.rank) == (0 if WORLD.rank == 0 else None)
    with pytest.raises(KeyError, match="missing"):
        on_root(WORLD, lambda: fail(KeyError("missing")))
    with pytest.raises(OddError if WORLD.rank == 0 else RuntimeError, match="strange"):
        on_root(WORLD, lambda: fail(OddError("strange")))


@pytest.mark.mpi
def test_a_function_for_rank_0_is_called_there_alone():
    calls = []

    @root_only
    def draw(number, *, failing=False):
        calls.append(number)
        if failing:
            raise OSError("no space left")
        return 2 * number

    assert draw(3) == (6 if WORLD.rank == 0 else None)
    with pytest.raises(OSError, match="no space left"):
        draw(4, failing=True)
    assert calls == ([3, 4] if WORLD.rank == 0 else [])


@pytest.mark.mpi
def test_what_fails_on_one_rank_fails_on_all():
    last = WORLD.size - 1

    def work(bad):
        if WORLD.rank == bad:
            raise KeyError(f"rank {WORLD.rank}")
        return WORLD.rank

    assert together(WORLD, lambda: work(None)) == WORLD.rank
    with pytest.raises(KeyError, match=f"rank {last}"):
        together(WORLD, lambda: work(last))


# -- files that cannot be written -------------------------------------------------------------------------------------


@contextmanager
def full_disk(size):
    """Files of rank 0 cannot grow beyond a number of bytes."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    if WORLD.rank == 0:
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, handler)


def history(folder):
    """Rows of a history, written in a loop."""
    with CSVSeries(folder / "history.csv", ["F"]) as series:
        for n in range(200):
            series.write(0.1 * n, n)


def pictures(folder):
    """Pictures of a spline, written in a loop."""
    with VTUSeries(folder / "sheet", spline("parallelogram", alone=True)) as series:
        for n in range(20):
            series.write(0.1 * n)


def flow(folder):
    """A mesh for fields."""
    XDMFSeries(folder / "flow.xdmf", mesh.create_unit_square(WORLD, 2, 2)).close()


def summary(folder):
    """A summary of more than a kilobyte."""
    write_summary(folder, "demo", {}, numbers=list(range(1000)))


def patch(folder):
    """A patch in a file."""
    files.write_patch(folder / "patch.txt", shapes.line((0.0, 0.0), (1.0, 1.0), elements=100, degree=2))


def extraction(folder):
    """A saved extraction."""
    saved.save_extraction(folder / "sheet.npz", spline("parallelogram", alone=True))


WRITERS = (history, pictures, flow, summary, patch, extraction)


@pytest.mark.mpi
@pytest.mark.parametrize("write", WRITERS, ids=lambda w: w.__name__)
def test_a_folder_that_is_a_file_is_an_error_on_all_ranks(write, folder):
    on_root(WORLD, lambda: (folder / "results").write_text("a file"))
    with pytest.raises(OSError, match=r"results"):
        write(folder / "results")
    assert WORLD.bcast((folder / "results").read_text()) == "a file"


@pytest.mark.mpi
@pytest.mark.parametrize("write", [w for w in WRITERS if w is not flow], ids=lambda w: w.__name__)
def test_a_full_disk_is_an_error_on_all_ranks(write, folder):
    """Also in a loop, after the first steps have been written."""
    with full_disk(1000), pytest.raises(OSError, match="too large"):
        write(folder)


# -- an error on one rank that nobody catches -------------------------------------------------------------------------

LONELY = """
import resource, signal, sys
from pathlib import Path
from mpi4py import MPI
from dolfinx import fem, mesh
from tigar_x import compat
from tigar_x.run import script
from tigar_x.run.output import CSVSeries, XDMFSeries

RANK = MPI.COMM_WORLD.rank

def main(out: Path = Path("."), rank: int = 0, limit: int = -1):
    domain = mesh.create_unit_square(MPI.COMM_WORLD, 2, 2)
    w = fem.Function(compat.lagrange_space(domain, 1, 2))
    if RANK == rank and limit > 0:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
    with XDMFSeries(out / "flow.xdmf", domain, w=(w, (0,))) as series, CSVSeries(out / "a.csv", ["F"]) as history:
        if RANK == rank:
            raise RuntimeError("something only here")
        history.write(0.0, 1.0)
        series.write(0.0)

script.command_line(main)
"""


@pytest.mark.skipif(WORLD.size > 1 or MPIRUN is None, reason="starts ranks of its own")
@pytest.mark.parametrize(
    ("rank", "limit", "message"), [(1, -1, "RuntimeError: something only here"), (0, 1000, "Error")]
)
def test_a_script_that_fails_on_one_rank_ends_on_all(rank, limit, message, tmp_path):
    """It waits for no other rank to close its files, nor do these wait for it for ever, such as inside HDF5."""
    (tmp_path / "lonely.py").write_text(LONELY)
    done = mpirun(2, tmp_path / "lonely.py", "--out", tmp_path, "--rank", rank, "--limit", limit, timeout=120)
    assert done.returncode != 0
    assert "Traceback" in done.stderr
    assert message in done.stderr
    assert f"rank {rank} of 2 ends the run" in done.stderr


LEAVING = """
import sys
from mpi4py import MPI
from tigar_x.run import script

def main(rank: int = 0, code: str = ""):
    if rank in (MPI.COMM_WORLD.rank, -1):
        sys.exit(int(code) if code.isdigit() else code)
    MPI.COMM_WORLD.Barrier()

script.command_line(main)
"""


@pytest.mark.skipif(WORLD.size > 1 or MPIRUN is None, reason="starts ranks of its own")
def test_a_script_that_leaves_on_one_rank_ends_on_all(tmp_path):
    (tmp_path / "leaving.py").write_text(LEAVING)
    done = mpirun(2, tmp_path / "leaving.py", "--rank", 1, "--code", "something only here", timeout=60)
    assert done.returncode != 0
    assert "something only here\n" in done.stderr
    assert "rank 1 of 2 ends the run: SystemExit" in done.stderr
    done = mpirun(2, tmp_path / "leaving.py", "--rank", -1, "--code", "3", timeout=60)
    assert done.returncode == 3
    assert "ends the run" not in done.stderr


# -- files that are replaced ------------------------------------------------------------------------------------------


def test_text_is_replaced_as_a_whole(tmp_path, monkeypatch):
    path = tmp_path / "summary.json"
    replace_text(path, "old\n")
    assert path.read_text() == "old\n"
    with pytest.raises(UnicodeEncodeError):  # fails while it writes
        replace_text(path, "new" * 10**5 + "\udc80")
    assert path.read_text() == "old\n"

    def interrupted(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", interrupted)
        with pytest.raises(KeyboardInterrupt):
            replace_text(path, "new\n")
    assert path.read_text() == "old\n"
    replace_text(path, "new\n")
    assert path.read_text() == "new\n"
    assert [p.name for p in tmp_path.iterdir()] == ["summary.json"]


# -- folders of earlier runs ------------------------------------------------------------------------------------------

EARLIER = ("summary.json", "history.csv", "sheet.pvd", "sheet_000001.vtu", "flow.xdmf", "flow.h5", "flow.vtkhdf")
DEEPER = ("checkpoints/checkpoint_00000007.npz", "frames/leaflets_0001.png", "flow.steps/000000.h5")


def earlier_run(folder, *names):
    """Files with their names in them."""
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(name)


@pytest.mark.mpi
@pytest.mark.parametrize("name", EARLIER + DEEPER)
def test_a_folder_with_results_is_refused_and_stays(name, folder):
    on_root(WORLD, lambda: earlier_run(folder, name))
    with pytest.raises(FileExistsError, match=rf"out = {folder} has the results of an earlier run \({name}\)") as error:
        claim(folder)
    assert ("--restart latest" in str(error.value)) == name.endswith(".npz")
    claim(folder, restart="latest")
    assert WORLD.bcast((folder / name).read_text()) == name


@pytest.mark.mpi
def test_a_run_may_overwrite_another_and_nothing_else(folder):
    others = ("notes.txt", "valve.msh", "checkpoints/notes.txt", "older/summary.json", "parameters.json")
    claim(folder / "new")  # there is none yet
    on_root(WORLD, lambda: earlier_run(folder, *EARLIER, *DEEPER, *others))
    with pytest.raises(ValueError, match="restart = 'latest' goes on with what overwrite = True deletes"):
        claim(folder, overwrite=True, restart="latest")
    claim(folder, overwrite=True)
    claim(folder)
    left = WORLD.bcast(sorted(str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file()))
    assert left == sorted(others)
