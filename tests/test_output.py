"""What the series leave on disk, read back by other libraries."""

import csv
import xml.etree.ElementTree as ET

import numpy as np
import pytest
from mpi4py import MPI
from dolfinx import fem, mesh
from splines import WORLD, spline

from tigar_x import compat
from tigar_x.geometry.bspline import BSplineBasis, open_knots
from tigar_x.geometry.patch import Patch
from tigar_x.run.output import CSVSeries, XDMFSeries
from tigar_x.splines.spline import ExtractedSpline
from tigar_x.splines.vtu import VTUSeries

MARKS = ("a & b", "a < b", "b > a", 'say "x"', "\N{GREEK SMALL LETTER OMEGA}")
"""Names that need care in XML or beyond ASCII."""


@pytest.fixture
def folder(tmp_path):
    """One folder for all ranks, below one that the series have to make."""
    return WORLD.bcast(tmp_path, root=0) / "results"


# -- XDMF -------------------------------------------------------------------------------------------------------------


def set_components(function, values):
    """Nodal values of the components of a blocked or mixed function."""
    for component, value in enumerate(values):
        space, dofs = compat.component_space(function.function_space, component)
        function.x.array[dofs] = value(space.tabulate_dof_coordinates().T)


def read_xdmf(path):
    """Coordinates, and values by (name, time)."""
    h5py = pytest.importorskip("h5py")
    WORLD.barrier()
    domain = ET.parse(path).getroot().find("Domain")
    values = {}
    with h5py.File(path.with_suffix(".h5"), "r") as file:

        def dataset(item):
            name, place = item.text.split(":")
            assert name == path.with_suffix(".h5").name
            return file[place][:]

        x = dataset(domain.find("Grid/Geometry/DataItem"))
        for series in domain.findall("Grid[@GridType='Collection']"):
            for grid in series:
                t = float(grid.find("Time").get("Value"))
                values[series.get("Name"), t] = dataset(grid.find("Attribute/DataItem"))
    return x, values


@pytest.mark.mpi
@pytest.mark.parametrize("cell", ["triangle", "quadrilateral", "tetrahedron", "hexahedron"])
@pytest.mark.parametrize("kind", ["blocked", "mixed"])
def test_xdmf_has_the_vertex_values(cell, kind, folder):
    flat = cell in ("triangle", "quadrilateral")
    if flat:
        domain = mesh.create_unit_square(WORLD, 3, 2, getattr(mesh.CellType, cell))
    else:
        domain = mesh.create_unit_cube(WORLD, 2, 2, 1, getattr(mesh.CellType, cell))
    space = (
        compat.lagrange_space(domain, 2, 3)
        if kind == "blocked"
        else compat.mixed_lagrange_space(domain, (2, 2), (1, 1))
    )
    w = fem.Function(space)
    fields = [lambda x: x[0] + 3 * x[1] ** 2 - x[2], lambda x: 10 + x[1] * x[0], lambda x: 20 - x[1] + 5 * x[2]]
    path = folder / "flow.xdmf"
    with XDMFSeries(path, domain, velocity=(w, (0, 1)), swapped=(w, (2, 0)), pressure=(w, [2])) as series:
        set_components(w, fields)
        series.write(0.0)
        set_components(w, [lambda x, f=f: -2 * f(x) for f in fields])
        series.write(0.125)

    x, values = read_xdmf(path)
    assert len(x) == (4 * 3 if flat else 3 * 3 * 2)
    exact = np.stack([f(np.pad(x, ((0, 0), (0, 3 - x.shape[1]))).T) for f in fields], axis=1)
    assert set(values) == {(name, t) for name in ("velocity", "swapped", "pressure") for t in (0.0, 0.125)}
    for t, factor in ((0.0, 1.0), (0.125, -2.0)):
        for name, components in (("velocity", [0, 1]), ("swapped", [2, 0]), ("pressure", [2])):
            found = values[name, t]
            np.testing.assert_allclose(found[:, : len(components)], factor * exact[:, components], rtol=0, atol=1e-13)
            assert not found[:, len(components) :].any()  # padding to three components


def test_xdmf_refuses_a_component_that_does_not_exist(folder):
    domain = mesh.create_unit_square(MPI.COMM_SELF, 1, 1)
    w = fem.Function(compat.lagrange_space(domain, 1, 2))
    with pytest.raises(IndexError, match="component = 2"):
        XDMFSeries(folder / "flow.xdmf", domain, velocity=(w, (0, 2)))


@pytest.mark.mpi
def test_xdmf_keeps_names_or_refuses_them(folder):
    """Marks of XML are kept; what separates or quotes in XDMF and HDF5 is refused before anything is written."""
    domain = mesh.create_unit_square(WORLD, 2, 2)
    w = fem.Function(compat.lagrange_space(domain, 1, 1))
    w.x.array[:] = 1.5
    fields = dict.fromkeys(MARKS, (w, (0,)))
    with XDMFSeries(folder / 'a & "b" <c>.xdmf', domain, **fields) as series:
        series.write(0.25)
    _, values = read_xdmf(folder / 'a & "b" <c>.xdmf')
    assert set(values) == {(name, 0.25) for name in MARKS}
    assert all(np.allclose(found[:, 0], 1.5, rtol=0, atol=1e-14) for found in values.values())
    kept = sorted(folder.iterdir())
    for name in ("a/b", "a:b", "it's", ".", "..", "", "two\nlines", "\x07"):
        with pytest.raises(ValueError, match=r"field = .*: printable characters other than / : ' are required"):
            XDMFSeries(folder / "flow.xdmf", domain, **{name: (w, (0,))})
    for name, reason in (("a:b.xdmf", "other than :"), ("flow", "ends in .xdmf"), ("flow.h5", "ends in .xdmf")):
        with pytest.raises(ValueError, match=f"path = .*{reason}"):
            XDMFSeries(folder / name, domain, w=(w, (0,)))
    assert sorted(folder.iterdir()) == kept


# -- VTU --------------------------------------------------------------------------------------------------------------


def read_index(path):
    """(time, file) of every entry of a PVD file."""
    entries = ET.parse(path).getroot().findall("Collection/DataSet")
    return [(float(e.get("timestep")), path.parent / e.get("file")) for e in entries]


def cell_sizes(x, cells):
    """Lengths of segments, areas of quadrilaterals that are given in cyclic order."""
    corners = x[cells]
    if corners.shape[1] == 2:
        return np.linalg.norm(corners[:, 1] - corners[:, 0], axis=1)
    return 0.5 * np.linalg.norm(np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1]), axis=1)


@pytest.mark.mpi
@pytest.mark.parametrize(
    ("name", "kind", "n_cells", "size"),
    [("arc", "line", 4, np.pi / 2), ("annulus", "quad", 16, 0.75 * np.pi), ("parallelogram", "quad", 54, 10.0)],
)
def test_vtu_is_the_deformed_spline(name, kind, n_cells, size, folder):
    meshio = pytest.importorskip("meshio")
    s = spline(name, alone=True)
    n, nsd = len(s.node_positions), s.nsd
    y, v = s.function(), s.function(0.25 * s.geometry.control[:, :-1])
    positions = np.pad(s.node_positions, ((0, 0), (0, 3 - nsd)))
    with VTUSeries(
        folder / "shell", s, y, velocity=v, pressure=lambda: np.arange(n) / n, **{"n": lambda: -s.nodal(v)}
    ) as movie:
        for step, factor in enumerate((0.0, 0.5)):
            y.x.array[:] = s.function(factor * s.geometry.control[:, :-1]).x.array
            movie.write(0.1 * step)
            WORLD.barrier()
            # the index is complete after every step, not only at the end
            index = read_index(folder / "shell.pvd")
            assert [t for t, _ in index] == [0.0, 0.1][: step + 1]
            WORLD.barrier()
    assert sorted(folder.iterdir()) == sorted([folder / "shell.pvd", *(file for _, file in index)])
    for (_, file), factor in zip(index, (0.0, 0.5), strict=True):
        read = meshio.read(file)
        np.testing.assert_allclose(read.points, (1 + factor) * positions, rtol=0, atol=1e-13)
        assert set(read.point_data) == {"displacement", "velocity", "pressure", "n"}
        np.testing.assert_allclose(read.point_data["displacement"], factor * positions, rtol=0, atol=1e-13)
        np.testing.assert_allclose(read.point_data["velocity"], 0.25 * positions, rtol=0, atol=1e-13)
        np.testing.assert_allclose(read.point_data["n"], -0.25 * positions, rtol=0, atol=1e-13)
        np.testing.assert_array_equal(read.point_data["pressure"], np.arange(n) / n)
        (block,) = read.cells
        assert (block.type, len(block.data)) == (kind, n_cells)
        assert set(block.data.ravel()) == set(range(n))
        sizes = cell_sizes(read.points, block.data)
        assert sizes.min() > 0.0
        exact = size * (1 + factor) ** s.geometry.dim
        assert sizes.sum() == pytest.approx(exact, rel=1e-12 if name == "parallelogram" else 0.03)
        assert sizes.sum() <= exact * (1 + 1e-12)  # chords


def test_vtu_without_displacement_is_the_reference(folder):
    meshio = pytest.importorskip("meshio")
    s = spline("cylinder", alone=True)
    with VTUSeries(folder / "still", s) as movie:
        movie.write(3.0)
    ((t, file),) = read_index(folder / "still.pvd")
    read = meshio.read(file)
    assert t == 3.0
    assert not read.point_data
    np.testing.assert_allclose(read.points, s.node_positions, rtol=0, atol=1e-14)


def test_vtu_series_whose_names_contain_dots_are_kept_apart(folder):
    pytest.importorskip("meshio")
    for name in ("nu_0.1", "nu_0.2"):
        with VTUSeries(folder / name, spline("line", alone=True)) as movie:
            movie.write(0.0)
    for name in ("nu_0.1", "nu_0.2"):
        ((_, file),) = read_index(folder / f"{name}.pvd")
        assert file == folder / f"{name}_000000.vtu"


@pytest.mark.mpi
@pytest.mark.parametrize("cells", ["tensor", "simplex"])
@pytest.mark.parametrize("dim", [1, 2, 3])
def test_vtu_of_a_distributed_spline_fills_the_whole_shape(folder, dim, cells):
    meshio = pytest.importorskip("meshio")
    bases = [BSplineBasis(p, open_knots(p, np.linspace(0, 1, 4))) for p in (2, 1, 3)[:dim]]
    grid = np.meshgrid(*[basis.greville for basis in bases], indexing="ij")
    patch = Patch.from_points(bases, np.column_stack([2.0 * g.ravel(order="F") for g in grid]))
    s = ExtractedSpline(patch, cells=cells)
    with VTUSeries(folder / "shape", s, x=lambda: s.node_positions[:, 0], u=s.project(s.F[0] ** 2)) as movie:
        movie.write(0.0)
    WORLD.barrier()
    written = meshio.read(folder / "shape_000000.vtu")
    (block,) = written.cells
    corners = written.points[block.data][:, :, :dim]
    np.testing.assert_allclose(written.point_data["x"], written.points[:, 0], rtol=0, atol=1e-14)
    if bases[0].degree > 1:
        np.testing.assert_allclose(written.point_data["u"], written.points[:, 0] ** 2, rtol=0, atol=1e-12)
    if block.type in ("triangle", "tetra"):
        edges = corners[:, 1:] - corners[:, :1]
        volume = np.abs(np.linalg.det(edges)).sum() / (1, 1, 2, 6)[dim]
    else:
        volume = np.prod(np.ptp(corners, axis=1), axis=1).sum()
    assert volume == pytest.approx(2.0**dim, rel=1e-12)


@pytest.mark.mpi
def test_a_vtu_series_goes_on(folder):
    pytest.importorskip("meshio")
    s = spline("line", alone=True)

    def write(*times, after=None):
        with VTUSeries(folder / "shell", s, after=after) as movie:
            for t in times:
                movie.write(t)
        WORLD.barrier()
        index = read_index(folder / "shell.pvd")
        files = sorted(path.name for path in folder.glob("*.vtu"))
        WORLD.barrier()
        assert files == [file.name for _, file in index] == [f"shell_{n:06d}.vtu" for n in range(len(index))]
        return [t for t, _ in index]

    assert write(0.1, after=0.0) == [0.1]  # there is none yet
    assert write(0.1, 0.2, 0.1 + 0.2, 0.4) == [0.1, 0.2, 0.1 + 0.2, 0.4]
    assert write(after=0.3) == [0.1, 0.2, 0.1 + 0.2]
    assert write(0.35, 0.5, after=0.2) == [0.1, 0.2, 0.35, 0.5]
    if WORLD.rank == 0:
        (folder / "shell.pvd").write_text("<VTKFile>")
    with pytest.raises(ValueError, match=r"shell.pvd: not the index of a series"):
        VTUSeries(folder / "shell", s, after=0.2)


@pytest.mark.mpi
def test_vtu_keeps_the_names_of_fields_and_files(folder):
    """Read by an XML parser, which meshio's writer of XML does not ask for."""
    meshio = pytest.importorskip("meshio")
    s = spline("line", alone=True)
    name = 'a & "b" <c>'
    for times, after in (((0.0, 0.5), None), ((0.75,), 0.6)):
        with VTUSeries(folder / name, s, after=after, **dict.fromkeys(MARKS, lambda: s.node_positions[:, 0])) as movie:
            for t in times:
                movie.write(t)
        WORLD.barrier()
    index = read_index(folder / f"{name}.pvd")
    assert index == [(t, folder / f"{name}_{n:06d}.vtu") for n, t in enumerate((0.0, 0.5, 0.75))]
    for _, file in index:
        read = meshio.read(file)
        assert set(read.point_data) == set(MARKS)
        assert all((values == s.node_positions[:, 0]).all() for values in read.point_data.values())


def test_vtu_refuses_names_that_hide_or_cannot_be_read(folder):
    s = spline("line", alone=True)
    values = lambda: s.node_positions[:, 0]  # noqa: E731
    with pytest.raises(ValueError, match="field = 'displacement': another name is required"):
        VTUSeries(folder / "shell", s, y=s.function(), displacement=values)
    for name in ("", "two\nlines", "\x07"):
        with pytest.raises(ValueError, match=r"field = .*: printable characters are required"):
            VTUSeries(folder / "shell", s, **{name: values})
    with pytest.raises(ValueError, match=r"path = .*: printable characters are required"):
        VTUSeries(folder / "two\nlines", s)
    assert not folder.exists()
    VTUSeries(folder / "shell", s, displacement=values).close()  # there is no other one


# -- CSV and text -----------------------------------------------------------------------------------------------------


@pytest.mark.mpi
def test_csv_history(folder):
    path = folder / "tip.csv"
    rows = [(0.1, 1 / 3, np.float64(-2e-17)), (0.2, 5, np.float64(np.pi))]
    with CSVSeries(path, ["u x", "F"]) as history:
        for n, row in enumerate(rows, start=1):
            history.write(*row)
            WORLD.barrier()
            with open(path, newline="") as file:  # each row is on disk at once
                header, *found = csv.reader(file)
            assert header == ["t", "u x", "F"]
            assert [tuple(map(float, r)) for r in found] == rows[:n]
            WORLD.barrier()
        for values in ((), (1.0,), (1.0, 2.0, 3.0)):
            with pytest.raises(ValueError, match=rf"values has {len(values)} entries: 2 are required \('u x', 'F'\)"):
                history.write(0.3, *values)
    assert len(path.read_text().splitlines()) == 3


@pytest.mark.mpi
def test_csv_keeps_the_names_of_its_columns_or_refuses_them(folder):
    columns = [*MARKS, "a, b", "it's"]
    for after in (None, 0.0):
        with CSVSeries(folder / 'a & "b".csv', columns, after=after) as history:
            history.write(0.5, *range(len(columns)))
    WORLD.barrier()
    with open(folder / 'a & "b".csv', newline="") as file:
        assert list(csv.reader(file)) == [["t", *columns], ["0.5", *map(str, range(len(columns)))]]
    for bad, reason in ((["F", "F"], "'F' is there twice"), (["t"], "'t' is there twice"), (["a\nb"], "printable")):
        with pytest.raises(ValueError, match=f"column.* = .*{reason}"):
            CSVSeries(folder / "tip.csv", bad)
    assert not (folder / "tip.csv").exists()


@pytest.mark.mpi
def test_a_csv_history_goes_on(folder):
    path = folder / "tip.csv"

    def write(*rows, after=None):
        with CSVSeries(path, ["u x", "F"], after=after) as history:
            for row in rows:
                history.write(*row)
        WORLD.barrier()
        with open(path, newline="") as file:
            header, *found = csv.reader(file)
        WORLD.barrier()
        assert header == ["t", "u x", "F"]
        return [tuple(map(float, row)) for row in found]

    a, b, c = (0.1, 1 / 3, 2.0), (0.1 + 0.2, np.pi, -0.0), (0.4, 5.0, 1e-300)
    assert write(a, after=0.0) == [a]  # there is none yet
    assert write(a, b, c) == [a, b, c]
    assert write(after=0.3) == [a, b]
    assert write(c, after=0.3) == [a, b, c]
    assert write(after=0.0) == []


@pytest.mark.parametrize("torn", ["0.1", "0.15,2", "0.2,3.", ""])
def test_a_row_that_was_not_finished_is_dropped(torn, tmp_path):
    path = tmp_path / "tip.csv"
    path.write_bytes(b"t,F\r\n0.1,1.5\r\n" + torn.encode())
    with CSVSeries(path, ["F"], after=0.3) as history:
        history.write(0.4, 2.5)
    assert path.read_text().splitlines() == ["t,F", "0.1,1.5", "0.4,2.5"]


@pytest.mark.parametrize("begun", ["", "t,"])
def test_a_history_that_was_hardly_begun_is_a_new_one(begun, tmp_path):
    (tmp_path / "tip.csv").write_text(begun)
    with CSVSeries(tmp_path / "tip.csv", ["F"], after=0.3) as history:
        history.write(0.4, 2.5)
    assert (tmp_path / "tip.csv").read_text().splitlines() == ["t,F", "0.4,2.5"]


@pytest.mark.mpi
@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("t,G\n0.1,1\n", r"columns \['t', 'G'\] were found, \['t', 'F'\] are required"),
        ("t,F,G\n0.1,1,2\n", r"columns \['t', 'F', 'G'\] were found"),
        ("t,F\nsoon,1\n", "not a history"),
        ("t,F\n\n", "not a history"),
    ],
)
def test_a_history_of_another_kind_is_refused_and_stays(text, message, folder):
    path = folder / "tip.csv"
    if WORLD.rank == 0:
        folder.mkdir()
        path.write_text(text)
    with pytest.raises(ValueError, match=rf"tip.csv: {message}"):
        CSVSeries(path, ["F"], after=0.3)
    WORLD.barrier()
    assert path.read_text() == text


def test_csv_is_closed_when_the_run_fails(tmp_path):
    def run():
        with CSVSeries(tmp_path / "tip.csv", ["F"]) as history:
            history.write(0.0, 1.0)
            raise RuntimeError("the run failed")

    with pytest.raises(RuntimeError, match="the run failed"):
        run()
    assert (tmp_path / "tip.csv").read_text().splitlines() == ["t,F", "0.0,1.0"]
