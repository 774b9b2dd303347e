"""Fields as VTKHDF: readable at any time, whatever happens to the run, and continued on any number of ranks."""

import shutil
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from mpi4py import MPI
from dolfinx import fem, mesh
from mpi_runs import mpirun, outside
from on_disk import ROOT, read_vtkhdf

from tigar_x import compat
from tigar_x.run import writing
from tigar_x.run.vtkhdf import VTKHDFSeries

pytest.importorskip("h5py")
WORLD = MPI.COMM_WORLD


@pytest.fixture
def path(tmp_path):
    """One path for all ranks, in a folder that the series has to make."""
    return WORLD.bcast(tmp_path, root=0) / "results" / "flow.vtkhdf"


def function(domain):
    """Linear function of a vector of three components, and a setter that makes it factor * (x, y + 10, x + y)."""
    w = fem.Function(compat.lagrange_space(domain, 1, 3))
    x = w.function_space.tabulate_dof_coordinates()

    def scale(factor):
        w.x.array[:] = factor * np.column_stack([x[:, 0], x[:, 1] + 10, x[:, 0] + x[:, 1]]).ravel()

    scale(1.0)
    return w, scale


def series(path, domain, w, **arguments):
    """Velocity and pressure of such a function."""
    return VTKHDFSeries(path, domain, velocity=(w, (0, 1)), pressure=(w, (2,)), **arguments)


def assert_is(fields, x, factor):
    """Fields are those of the function at points."""
    exact = factor * np.column_stack([x[:, 0], x[:, 1] + 10, x[:, 0] + x[:, 1]])
    np.testing.assert_allclose(fields["velocity"], np.pad(exact[:, :2], ((0, 0), (0, 1))), rtol=0, atol=1e-13)
    np.testing.assert_allclose(fields["pressure"], exact[:, 2], rtol=0, atol=1e-13)


def volume(kind, x):
    """Volume of a cell whose corners come in VTK's order, by simplices."""
    if kind in (5, 9):
        x, y = x[:, 0], x[:, 1]
        return 0.5 * (x @ np.roll(y, -1) - y @ np.roll(x, -1))
    parts = (
        [[0, 1, 2, 3]]
        if kind == 10
        else [[0, 1, 2, 6], [0, 2, 3, 6], [0, 3, 7, 6], [0, 7, 4, 6], [0, 4, 5, 6], [0, 5, 1, 6]]
    )
    return sum(abs(np.linalg.det(x[p[1:]] - x[p[0]])) / 6 for p in parts)


@pytest.mark.mpi
@pytest.mark.parametrize("cell", ["triangle", "quadrilateral", "tetrahedron", "hexahedron"])
def test_vtkhdf_has_the_mesh_and_the_vertex_values(cell, path):
    kind = getattr(mesh.CellType, cell)
    flat = cell in ("triangle", "quadrilateral")
    domain = mesh.create_unit_square(WORLD, 3, 2, kind) if flat else mesh.create_unit_cube(WORLD, 2, 2, 1, kind)
    w, scale = function(domain)
    with series(path, domain, w) as movie:
        for step in range(3):
            scale(step + 1.0)
            movie.write(0.5 * step)
            WORLD.barrier()
            x, cells, steps = read_vtkhdf(path)  # while the series is open
            assert [t for t, _ in steps] == [0.5 * i for i in range(step + 1)]
            for i, (_, fields) in enumerate(steps):
                assert_is(fields, x, i + 1.0)
            WORLD.barrier()
    assert len(x) == (12 if flat else 18)
    assert sum(abs(volume(k, x[corners])) for k, corners in cells) == pytest.approx(1.0, rel=1e-12)


@pytest.mark.mpi
def test_vtkhdf_computes_what_is_computed_when_it_writes(path):
    domain = mesh.create_unit_square(WORLD, 2, 2)
    (w, scale), factors = function(domain), iter([1.0, 5.0, 7.0])

    def computed():
        scale(next(factors))
        return w

    with VTKHDFSeries(path, domain, velocity=(computed, (0, 1)), pressure=(w, (2,))) as movie:
        for step in range(2):
            movie.write(float(step))
    x, _, steps = read_vtkhdf(path)
    for (_, fields), factor in zip(steps, (5.0, 7.0), strict=True):
        assert_is(fields, x, factor)


def test_vtkhdf_opens_in_vtk(path):
    vtk = pytest.importorskip("vtk", reason="the library of ParaView")
    from vtk.util.numpy_support import vtk_to_numpy

    domain = mesh.create_unit_square(MPI.COMM_SELF, 3, 2, mesh.CellType.quadrilateral)
    w, scale = function(domain)
    with series(path, domain, w) as movie:
        movie.write(0.0)
        scale(-2.0)
        movie.write(0.25)
        reader = vtk.vtkHDFReader()
        reader.SetFileName(str(path))
        assert reader.CanReadFile(str(path))
        reader.UpdateInformation()
        times = reader.GetOutputInformation(0).Get(vtk.vtkStreamingDemandDrivenPipeline.TIME_STEPS())
        assert times == (0.0, 0.25)
        for t, factor in zip(times, (1.0, -2.0), strict=True):
            reader.UpdateTimeStep(t)
            grid = reader.GetOutputDataObject(0)
            assert (grid.GetNumberOfPoints(), grid.GetNumberOfCells()) == (12, 6)
            data = {name: vtk_to_numpy(grid.GetPointData().GetArray(name)) for name in ("velocity", "pressure")}
            assert_is(data, vtk_to_numpy(grid.GetPoints().GetData()), factor)


def test_vtkhdf_stores_the_mesh_once_and_numbers_as_they_are(path):
    domain = mesh.create_unit_square(MPI.COMM_SELF, 40, 40)
    w, _ = function(domain)
    sizes = {}
    for single in (False, True):
        with series(path, domain, w, single=single) as movie:
            for step in range(4):
                movie.write(step)
        files = [file.stat().st_size for file in path.with_suffix(".steps").glob("0*.h5")]
        assert len(files) == 4
        sizes[single] = max(files)
    numbers = 4 * 41 * 41
    assert sizes[False] < 8 * numbers + 4096
    assert sizes[True] < 4 * numbers + 4096
    assert path.stat().st_size < 40_000


@pytest.mark.mpi
def test_vtkhdf_is_continued_where_the_run_goes_on(path):
    domain = mesh.create_unit_square(WORLD, 4, 3)
    w, scale = function(domain)
    with series(path, domain, w) as movie:
        for step in range(4):
            scale(step)
            movie.write(0.1 * step)
    other = mesh.create_unit_square(WORLD, 4, 3)  # whose vertices may be numbered otherwise
    w, scale = function(other)
    with series(path, other, w, after=0.1 * 2) as movie:
        WORLD.barrier()
        assert len(read_vtkhdf(path)[2]) == 3
        WORLD.barrier()
        scale(7.0)
        movie.write(0.75)
    WORLD.barrier()
    x, _, steps = read_vtkhdf(path)
    assert [t for t, _ in steps] == [0.0, 0.1, 0.2, 0.75]
    for (_, fields), factor in zip(steps, (0.0, 1.0, 2.0, 7.0), strict=True):
        assert_is(fields, x, factor)


CONTINUED = """
import sys
from mpi4py import MPI
from dolfinx import mesh
from pathlib import Path
from test_vtkhdf import function, series
domain = mesh.create_unit_square(MPI.COMM_WORLD, 4, 3)
w, scale = function(domain)
scale(float(sys.argv[2]))
with series(Path(sys.argv[1]), domain, w, after=float(sys.argv[2]) - 1) as movie:
    movie.write(float(sys.argv[2]))
"""


def test_vtkhdf_is_continued_on_other_ranks(path):
    done = mpirun(2, "-c", CONTINUED, path, 1)
    assert done.returncode == 0, done.stderr
    domain = mesh.create_unit_square(MPI.COMM_SELF, 4, 3)
    w, scale = function(domain)
    scale(2.0)
    with series(path, domain, w, after=1.0) as movie:
        movie.write(2.0)
    x, _, steps = read_vtkhdf(path)
    assert [t for t, _ in steps] == [1.0, 2.0]
    for t, fields in steps:
        assert_is(fields, x, t)


@pytest.mark.mpi
def test_vtkhdf_refuses_an_earlier_series_of_something_else(path):
    domain = mesh.create_unit_square(WORLD, 2, 2)
    w, _ = function(domain)
    with series(path, domain, w) as movie:
        movie.write(0.0)
    before = read_vtkhdf(path)[2]
    with pytest.raises(ValueError, match=r"flow.vtkhdf: fields .* are required"):
        VTKHDFSeries(path, domain, velocity=(w, (0, 1)), after=0.0)
    finer = mesh.create_unit_square(WORLD, 2, 3)
    with pytest.raises(ValueError, match=r"on 8 cells were found, .* on 12 are required"):
        series(path, finer, function(finer)[0], after=0.0)
    moved = mesh.create_rectangle(WORLD, [[0.0, 0.0], [1.0, 1.5]], [2, 2])
    with pytest.raises(ValueError, match=r"another mesh .*0.25 away"):
        series(path, moved, function(moved)[0], after=0.0)
    WORLD.barrier()
    assert str(read_vtkhdf(path)[2]) == str(before)
    WORLD.barrier()
    if WORLD.rank == 0:
        path.write_text("something else")
    WORLD.barrier()
    with pytest.raises(ValueError, match="not the index of a series"):
        series(path, domain, w, after=0.0)


@pytest.mark.mpi
def test_vtkhdf_refuses_names_that_cannot_be(path):
    domain = mesh.create_unit_square(WORLD, 1, 2)
    w, _ = function(domain)
    for name in ("a/b", ".", ""):
        with pytest.raises(ValueError, match="printable characters"):
            VTKHDFSeries(path, domain, **{name: (w, (0,))})
    with pytest.raises(ValueError, match=r"ends in \.vtkhdf"):
        VTKHDFSeries(path.with_suffix(".xdmf"), domain, u=(w, (0,)))
    with pytest.raises(IndexError, match="component = 3"):
        VTKHDFSeries(path, domain, u=(w, (3,)))
    with VTKHDFSeries(path, domain, **{'a & <b> "c"': (w, (0,))}) as movie:
        movie.write(0.0)
    WORLD.barrier()
    assert list(read_vtkhdf(path)[2][0][1]) == ['a & <b> "c"']


@pytest.mark.mpi
def test_vtkhdf_that_cannot_be_written_fails_on_all_ranks_and_stays_as_it_was(path, monkeypatch):
    domain = mesh.create_unit_square(WORLD, 2, 2)
    w, scale = function(domain)

    def full(file, content):
        raise OSError(28, "No space left on device")

    with series(path, domain, w) as movie:
        movie.write(0.0)
        for failing in ("000001.h5", "flow.vtkhdf"):
            with monkeypatch.context() as patch:
                patch.setattr(
                    "tigar_x.run.vtkhdf.replace_bytes",
                    lambda file, content, failing=failing: (full if file.name == failing else writing.replace_bytes)(
                        file, content
                    ),
                )
                with pytest.raises(OSError, match="No space left"):
                    movie.write(1.0)
            WORLD.barrier()
            assert [t for t, _ in read_vtkhdf(path)[2]] == [0.0]
            WORLD.barrier()
        scale(3.0)
        movie.write(2.0)
    WORLD.barrier()
    x, _, steps = read_vtkhdf(path)
    assert [t for t, _ in steps] == [0.0, 2.0]
    assert_is(steps[1][1], x, 3.0)
    WORLD.barrier()  # all have read it
    if WORLD.rank == 0:
        shutil.rmtree(path.parent)
        path.parent.write_text("a file where a folder should be")
    WORLD.barrier()
    with pytest.raises((FileExistsError, NotADirectoryError)):
        series(path, domain, w)


KILLED = """
import sys
from mpi4py import MPI
from dolfinx import mesh
from pathlib import Path
from test_vtkhdf import function, series
domain = mesh.create_unit_square(MPI.COMM_SELF, 30, 30)
w, scale = function(domain)
with series(Path(sys.argv[1]), domain, w) as movie:
    for step in range(100000):
        scale(step)
        movie.write(step)
        print(step, flush=True)
"""


def test_vtkhdf_of_a_killed_run_is_whole(path):
    rng = np.random.default_rng(1)
    for _ in range(2):
        run = subprocess.Popen(
            [sys.executable, "-c", KILLED, str(path)], stdout=subprocess.PIPE, text=True, cwd=ROOT, env=outside()
        )
        for line in run.stdout:
            if int(line) == 5:
                break
        time.sleep(rng.uniform(0.0, 0.05))
        run.send_signal(signal.SIGKILL)
        written = 5 + len(run.stdout.read().split())
        run.wait()
        x, _, steps = read_vtkhdf(path)
        assert len(steps) in (written + 1, written + 2)  # the last may have been written but not told of
        for step, (t, fields) in enumerate(steps):
            assert t == step
            assert_is(fields, x, step)


def test_vtkhdf_without_h5py_says_so(path, monkeypatch):
    monkeypatch.setitem(sys.modules, "h5py", None)
    domain = mesh.create_unit_square(MPI.COMM_SELF, 1, 1)
    with pytest.raises(ImportError, match="VTKHDFSeries needs h5py"):
        series(path, domain, function(domain)[0])


@pytest.mark.mpi
def test_vtkhdf_keeps_names_or_refuses_them(path):
    domain = mesh.create_unit_square(WORLD, 1, 1)
    w = fem.Function(compat.lagrange_space(domain, 1, 1))
    w.x.array[:] = 1.5
    names = ("a & b", 'say "x" <c>', "it's 1:2", "\N{GREEK SMALL LETTER OMEGA}")
    path = path.with_name("a & 'b'.vtkhdf")
    with VTKHDFSeries(path, domain, **dict.fromkeys(names, (w, (0,)))) as movie:
        movie.write(0.25)
    WORLD.barrier()
    ((t, fields),) = read_vtkhdf(path)[2]
    assert t == 0.25
    assert set(fields) == set(names)
    assert all((values == 1.5).all() for values in fields.values())
    for name in ("a/b", "50 %", ".", "", "two\nlines"):
        with pytest.raises(ValueError, match=r"field = .*: printable characters other than / % are required"):
            VTKHDFSeries(path, domain, **{name: (w, (0,))})
    with pytest.raises(ValueError, match=r"path = '50%\.vtkhdf': printable characters other than % are required"):
        VTKHDFSeries(path.with_name("50%.vtkhdf"), domain, w=(w, (0,)))
