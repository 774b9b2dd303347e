"""What files and pictures show of fields that differ on both sides of an immersed curve, and values at points."""

import numpy as np
import pytest
from mpi4py import MPI
from dolfinx import fem
from on_disk import read_vtkhdf_meshes
from test_sided import membrane

from tigar_x import compat
from tigar_x.run.figure import draw
from tigar_x.run.plane_field import PlaneField
from varmint import movie

pytestmark = pytest.mark.mpi
WORLD = MPI.COMM_WORLD


@pytest.fixture(scope="module")
def swept():
    """The membrane after two steps, between pressures near 0 on its left and -1 on its right."""
    flow, fsi = membrane("jump and kink", level=1)
    for _ in range(2):
        fsi.takeStep()
    return flow, fsi


@pytest.fixture
def path(tmp_path):
    """One path for all ranks."""
    return WORLD.bcast(tmp_path, root=0) / "flow.vtkhdf"


def areas(x, triangles):
    corners = x[triangles][:, :, :2]
    return 0.5 * np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1]))


def assert_sharp(x, triangles, pressure):
    """Every triangle has the pressure of one side, and both pressures are found on the line between them."""
    assert areas(x, triangles).sum() == pytest.approx(1.0, rel=1e-6)
    p = pressure[triangles]
    assert (np.ptp(p, axis=1) < 0.12).all()
    is_left = p.mean(axis=1) > -0.5
    np.testing.assert_allclose(p, np.where(is_left, 0.0, -1.0)[:, None] + 0.0 * p, atol=0.12)
    places = [
        set(map(tuple, np.round(x[triangles[side]].reshape(-1, x.shape[1])[:, :2], 9))) for side in (is_left, ~is_left)
    ]
    shared = np.array(sorted(places[0] & places[1]))
    assert len(shared) > 6
    assert np.ptp(shared[:, 1]) == pytest.approx(1.0, rel=1e-6)  # from wall to wall


def test_files_have_pieces_of_cells_with_the_pressure_of_their_side(swept, path):
    flow, _ = swept
    smooth = fem.Function(compat.lagrange_space(flow.mesh.domain, 1), name="smooth")
    smooth.interpolate(lambda x: x[0] - 2.0 * x[1])
    with movie(flow, path, smooth=(smooth, (0,)))() as series:
        series.write(0.25)
        WORLD.barrier()
        ((t, x, triangles, fields),) = read_vtkhdf_meshes(path)  # while the series is open
        WORLD.barrier()
    assert t == 0.25
    assert_sharp(x, triangles, fields["pressure"])
    np.testing.assert_allclose(fields["smooth"], x[:, 0] - 2.0 * x[:, 1], atol=1e-12)
    exact = x[:, 1] * (1.0 - x[:, 1])
    left = np.unique(triangles[fields["pressure"][triangles].mean(axis=1) > -0.5])
    np.testing.assert_allclose(fields["velocity"][left, 0], exact[left], atol=0.03)
    assert (fields["velocity"][:, 2] == 0.0).all()


def test_files_with_a_mesh_for_every_time_open_in_vtk(path):
    vtk = pytest.importorskip("vtk", reason="the library of ParaView")
    from vtk.util.numpy_support import vtk_to_numpy

    flow, fsi = membrane("jump and kink", level=1)
    with movie(flow, path)() as series:
        for t in range(3):
            fsi.takeStep()
            series.write(float(t))
    WORLD.barrier()
    reader = vtk.vtkHDFReader()
    reader.SetFileName(str(path))
    reader.UpdateInformation()
    for t in range(3):
        reader.UpdateTimeStep(float(t))
        grid = reader.GetOutputDataObject(0)
        triangles = vtk_to_numpy(grid.GetCells().GetConnectivityArray()).reshape(-1, 3)
        x, p = vtk_to_numpy(grid.GetPoints().GetData()), vtk_to_numpy(grid.GetPointData().GetArray("pressure"))
        assert_sharp(x, triangles, p)


def test_every_time_has_the_pieces_of_its_own_cells(path):
    flow, fsi = membrane("jump and kink", level=1)
    with movie(flow, path)() as series:
        for t in range(2):
            series.write(float(t))
            fsi.takeStep()
        series.write(2.0)
    with movie(flow, path)(after=1.0) as series:
        WORLD.barrier()
        assert [step[0] for step in read_vtkhdf_meshes(path)] == [0.0, 1.0]
        WORLD.barrier()
        fsi.takeStep()
        series.write(3.0)
    WORLD.barrier()
    steps = read_vtkhdf_meshes(path)
    assert [step[0] for step in steps] == [0.0, 1.0, 3.0]
    assert len(steps[0][2]) == 72  # nothing is divided before the first step
    for _, x, triangles, fields in steps[1:]:
        assert len(triangles) > 72
        assert_sharp(x, triangles, fields["pressure"])
    WORLD.barrier()


def test_series_of_one_mesh_and_of_many_are_not_continued_as_the_other(swept, path):
    flow, _ = swept
    plain, _ = membrane("plain", level=1, multiplier_direction="normal", trace="nodes")
    with movie(flow, path)() as series:
        series.write(0.0)
    with pytest.raises(ValueError, match="with a mesh for every time was found"):
        movie(plain, path)(after=0.0)
    with movie(plain, path)() as series:
        series.write(0.0)
    with pytest.raises(ValueError, match="with one mesh for all times was found"):
        movie(flow, path)(after=0.0)


def test_pictures_end_triangles_where_the_pressure_jumps(swept):
    flow, _ = swept
    field, smeared = PlaneField(flow.w, sides=flow.sides), PlaneField(flow.w)
    if WORLD.rank == 0:
        assert_sharp(field.x, field.triangles, field.values[:, 2])
        assert np.ptp(smeared.values[smeared.triangles, 2], axis=1).max() > 0.9
    other = fem.Function(flow.V, name="other")
    with pytest.raises(ValueError, match="those of other are required, they are those of w"):
        PlaneField(other, sides=flow.sides)


def test_streamlines_cross_the_line_where_the_velocity_bends(swept, path):
    flow, _ = swept
    draw(
        path.with_suffix(".png"), PlaneField(flow.w, sides=flow.sides).signed("pressure", "-", length="-", density=1.0)
    )
    assert path.with_suffix(".png").stat().st_size > 20_000
