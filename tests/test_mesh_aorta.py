"""The mesh of a piece of aorta with the sinuses of a valve."""

import numpy as np
import pytest
from mpi4py import MPI
from scipy.integrate import trapezoid

from tigar_x import compat
from varmint.mesh.aorta import aortic_root, sectors

COMM = MPI.COMM_WORLD
VOLUME = 10.65
"""Of the geometry with the published lengths, by quadrature over sections."""


def cell_vertices(m):
    domain = m.domain
    return compat.cell_vertices(domain)[: compat.owned_cells(domain)]


def volume(m):
    x = cell_vertices(m)
    return COMM.allreduce(float(np.abs(np.linalg.det(x[:, 1:] - x[:, :1])).sum() / 6.0), op=MPI.SUM)


def exact_volume(radius=1.1, bottom=-0.5, top=2.0, sinus=0.88, offset=0.55, height=0.68):
    """Sections of the union, circles about a regular triangle's corners and one about its middle, by fine sampling."""
    z = np.linspace(bottom, top, 501)
    line = np.linspace(-2.0, 2.0, 801)
    x, y = np.meshgrid(line, line)
    inside = np.hypot(x, y) <= radius
    areas = []
    for level in z:
        r2 = sinus**2 - (level - height) ** 2
        section = inside.copy()
        for angle in np.pi / 3 + 2 * np.pi / 3 * np.arange(3):
            section |= (x - offset * np.cos(angle)) ** 2 + (y - offset * np.sin(angle)) ** 2 <= r2
        areas.append(section.mean() * 16.0)
    return float(trapezoid(areas, z))


def ends_and_walls(m):
    """Largest distance of the vertices of every group from where its facets belong."""
    found = {}
    nodes = compat.facet_nodes(m.domain)
    x = m.domain.geometry.x
    for name in ("inlet", "outlet", "walls"):
        at = x[np.unique(nodes[m.facets(name)])]
        if name == "walls":
            r = np.hypot(at[:, 0], at[:, 1])
            angles = np.pi / 3 + 2 * np.pi / 3 * np.arange(3)
            centers = np.column_stack([0.55 * np.cos(angles), 0.55 * np.sin(angles), np.full(3, 0.68)])
            spheres = np.abs(np.linalg.norm(at[:, None] - centers, axis=2) - 0.88).min(axis=1)
            off = np.minimum(np.abs(r - 1.1), spheres)
        else:
            off = np.abs(at[:, 2] - (-0.5 if name == "inlet" else 2.0))
        found[name] = COMM.allreduce(float(off.max(initial=0.0)), op=MPI.MAX)
    return found


def test_the_reference_volume_is_that_of_the_geometry():
    assert exact_volume() == pytest.approx(VOLUME, abs=0.02)


@pytest.mark.mpi
@pytest.mark.parametrize("size", [0.3, 0.2])
def test_volume_and_groups(size):
    m = aortic_root(COMM, size=size)
    assert volume(m) == pytest.approx(VOLUME, rel=0.012)
    assert set(m.facet_names) == {"inlet", "outlet", "walls"}
    assert max(ends_and_walls(m).values()) < 1e-6


@pytest.mark.mpi
def test_every_boundary_facet_has_a_group():
    m = aortic_root(COMM, size=0.3)
    on_boundary = compat.exterior_facets(m.domain)
    named = np.concatenate([m.facets(name) for name in m.facet_names])
    assert np.isin(on_boundary, named).all()
    assert len(np.unique(named)) == len(named)


def test_cells_are_smaller_where_leaflets_move():
    m = aortic_root(MPI.COMM_SELF, size=0.3, swept_size=0.15)
    x = compat.cell_vertices(m.domain)
    z, lengths = x.mean(axis=1)[:, 2], np.linalg.norm(x[:, 1] - x[:, 0], axis=1)
    fine = np.median(lengths[(z > 0.0) & (z < 0.9)])
    assert fine < 0.22
    assert fine < 0.75 * np.median(lengths[z > 1.8])
    assert np.median(lengths[(z > 0.95) & (z < 1.2)]) < 1.04 * fine  # where the free edges are when it is open


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"size": 0.0}, "size"),
        ({"size": np.nan}, "size"),
        ({"swept_size": 0.4}, "swept_size"),
        ({"swept_size": -1.0}, "swept_size"),
        ({"swept": (1.0, 0.0)}, "swept"),
        ({"top": 1.2}, "top"),
        ({"bottom": 0.0}, "bottom"),
        ({"sinus_radius": 0.5}, "sinus_radius"),
        ({"radius": -1.0}, "radius"),
    ],
)
def test_what_is_refused(change, named):
    with pytest.raises(ValueError, match=named):
        aortic_root(MPI.COMM_SELF, **({"size": 0.3} | change))


@pytest.mark.mpi
def test_ranks_have_sectors_with_as_many_cells_and_know_those_across_their_facets():
    domain = aortic_root(COMM, size=0.3).domain
    own = compat.owned_cells(domain)
    counts = COMM.allgather(own)
    assert max(counts) - min(counts) <= 1
    middles = compat.cell_vertices(domain)[:own].mean(axis=1)
    near = np.abs(middles[:, 2] - 0.55) < 0.5  # where leaflets are
    shares = COMM.allgather(int(near.sum()))
    assert max(shares) < 1.1 * sum(shares) / COMM.size
    of_cells, of_facets = compat.connectivity(domain, 3, 2), compat.connectivity(domain, 2, 3)
    facets = np.unique(of_cells.array.reshape(-1, 4)[:own])
    alone = facets[np.diff(of_facets.offsets)[facets] == 1]
    np.testing.assert_array_equal(alone, np.intersect1d(compat.exterior_facets(domain), facets))


@pytest.mark.parametrize("ranks", [1, 2, 5, 7, 12, 64])
def test_sectors_of_any_number_of_ranks(ranks):
    x = np.random.default_rng(1).uniform(-1.0, 1.0, (1000, 3))
    counts = np.bincount(sectors(x, ranks), minlength=ranks)
    assert len(counts) == ranks
    assert counts.min() >= counts.max() - 2
