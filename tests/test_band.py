"""The band of scaled stabilisation around the surface."""

import numpy as np
import pytest
from mpi4py import MPI
from dolfinx import mesh

from coudalfish import SurfaceBand
from coudalfish.surface.trace import PointLocator
from tigar_x import compat


def scaled_cells(domain, x):
    """Midpoints of all cells in the band, sorted, gathered from all ranks."""
    band = SurfaceBand(domain)
    band.update(PointLocator(domain).locate(x), scale_m=0.25, scale_c=0.5)
    owned = compat.owned_cells(domain)
    inside = band.scale_m.x.array[:owned] == 0.25
    np.testing.assert_array_equal(inside, band.scale_c.x.array[:owned] == 0.5)
    assert set(np.unique(band.scale_m.x.array)) <= {0.25, 1.0}
    middle = compat.cell_vertices(domain)[:owned].mean(axis=1)[inside]
    return {tuple(m) for m in np.concatenate(domain.comm.allgather(middle.round(9)))}


def neighbours(domain, vertices):
    """Midpoints of the cells that touch any of the given vertices, gathered from all ranks."""
    x = compat.cell_vertices(domain)[: compat.owned_cells(domain)]
    touches = (np.abs(x[:, :, None, :] - np.asarray(vertices)).max(axis=-1) < 1e-9).any(axis=(1, 2))
    return {tuple(m) for m in np.concatenate(domain.comm.allgather(x.mean(axis=1)[touches].round(9)))}


@pytest.mark.mpi
def test_band_is_the_cut_cell_and_its_ring():
    domain = mesh.create_unit_square(MPI.COMM_WORLD, 4, 4)
    cell = [(0.25, 0.25), (0.5, 0.25), (0.5, 0.5)]
    assert scaled_cells(domain, np.array([[0.42, 0.3]])) == neighbours(domain, cell)


@pytest.mark.mpi
def test_point_on_a_vertex_or_edge_marks_the_same_cells_whoever_owns_it():
    domain = mesh.create_unit_square(MPI.COMM_WORLD, 4, 4)
    assert scaled_cells(domain, np.array([[0.5, 0.5]])) == neighbours(domain, [(0.5, 0.5)])
    assert scaled_cells(domain, np.array([[0.5, 0.6]])) == neighbours(domain, [(0.5, 0.5), (0.5, 0.75)])


@pytest.mark.mpi
def test_no_active_point_no_band():
    domain = mesh.create_unit_square(MPI.COMM_WORLD, 4, 4)
    assert not scaled_cells(domain, np.array([[2.0, 2.0]]))


@pytest.mark.parametrize(
    ("name", "value"), [("scale_m", 0.0), ("scale_m", 1.5), ("scale_c", -1.0), ("scale_c", np.nan)]
)
def test_bad_scales(name, value):
    domain = mesh.create_unit_square(MPI.COMM_WORLD, 2, 2)
    location = PointLocator(domain).locate(np.array([[0.5, 0.5]]))
    with pytest.raises(ValueError, match=f"{name} = {value}"):
        SurfaceBand(domain).update(location, **{"scale_m": 1.0, "scale_c": 1.0, name: value})
