"""Meshes that are bisected in places: they fit together, keep their groups, and are the same on all ranks."""

import numpy as np
import pytest
from mpi4py import MPI

from tigar_x import compat
from tigar_x.ranks import gathered
from varmint.forms.space import equal_order_space
from varmint.mesh.arrays import mirrored_box
from varmint.mesh.named import SIDES, box, named
from varmint.mesh.refined import Refinement


def near(place, size, reach):
    """Sizes near a place, and of nothing else."""

    def sizes(corners):
        distance = np.linalg.norm(corners - place, axis=2).min(axis=1)
        return np.where(distance < reach, size, np.inf)

    return sizes


def volumes(mesh):
    """Volumes of the owned cells, and their qualities: 1 for an equilateral simplex."""
    x = compat.cell_vertices(mesh.domain)[: compat.owned_cells(mesh.domain)]
    d = x.shape[2]
    volume = abs(np.linalg.det(x[:, 1:] - x[:, :1])) / (2 if d == 2 else 6)
    i, j = np.triu_indices(d + 1, 1)
    mean = (np.linalg.norm(x[:, i] - x[:, j], axis=2) ** 2).mean(axis=1)
    return volume, volume * (4 / 3**0.5 if d == 2 else 6 * 2**0.5) / mean ** (d / 2)


def total(mesh, *names):
    """Area of groups of facets."""
    form = compat.Constant(mesh.domain, 1.0) * mesh.ds(*names, degree=0)
    return compat.assemble_scalar(compat.compile_forms(form)[0])


def base(d):
    """A square or cube with a group of cells and all its sides."""
    mesh = box(MPI.COMM_WORLD, [0.0] * d, [1.0] * d, [4] * d)
    sides = {
        name: lambda x, i=k // 2, end=float(k % 2): abs(x[i] - end) < 1e-9 for k, name in enumerate(np.ravel(SIDES[:d]))
    }
    return named(mesh.domain, cells={"lower": lambda x: x[d - 1] < 0.5 + 1e-9}, **sides)


@pytest.mark.mpi
def test_ranks_get_the_cells_that_they_are_to_have():
    """By places, such as those around which cells become small."""

    def halves(x, ranks):
        return np.where(x[:, 0] < 0.5, 0, ranks - 1)

    fine = Refinement(base(2), halves).mesh(near(np.full(2, 0.25), 0.1, 0.2))
    x = compat.cell_vertices(fine.domain)[: compat.owned_cells(fine.domain)].mean(axis=1)
    assert (halves(x, fine.domain.comm.size) == fine.domain.comm.rank).all()


@pytest.mark.mpi
@pytest.mark.parametrize("d", [2, 3])
def test_a_refined_mesh_fits_together_and_keeps_its_groups(d):
    mesh = base(d)
    fine = Refinement(mesh).mesh(near(np.full(d, 0.4), 0.1, 0.2))
    assert fine.size > 2 * mesh.size
    assert fine.facet_names == mesh.facet_names
    assert fine.cell_names == mesh.cell_names
    comm = mesh.domain.comm
    assert comm.allreduce(volumes(fine)[0].sum()) == pytest.approx(1.0, rel=1e-12)
    # a facet inside that only one cell has would be on the boundary
    assert total(fine) == pytest.approx(2.0 * d, rel=1e-12)
    for name in fine.facet_names:
        assert total(fine, name) == pytest.approx(1.0, rel=1e-12)
    lower = fine.dx("lower", degree=0)
    half = compat.assemble_scalar(compat.compile_forms(compat.Constant(fine.domain, 1.0) * lower)[0])
    assert half == pytest.approx(0.5, rel=1e-12)
    x = compat.cell_vertices(fine.domain)
    i, j = np.triu_indices(d + 1, 1)
    longest = np.linalg.norm(x[:, i] - x[:, j], axis=2).max(axis=1)
    assert (longest <= near(np.full(d, 0.4), 0.1, 0.2)(x) * (1 + 1e-6)).all()
    worst = comm.allreduce(volumes(fine)[1].min(initial=np.inf), op=MPI.MIN)
    assert worst >= {2: 0.86, 3: 0.4}[d] * comm.allreduce(volumes(mesh)[1].min(initial=np.inf), op=MPI.MIN)


@pytest.mark.mpi
def test_every_number_of_ranks_gives_the_same_mesh():
    found = []
    for comm in (MPI.COMM_WORLD, MPI.COMM_SELF):
        mesh = Refinement(box(comm, [0.0] * 3, [1.0] * 3, [3] * 3)).mesh(near([0.2, 0.3, 0.4], 0.2, 0.2))
        x = compat.cell_vertices(mesh.domain)[: compat.owned_cells(mesh.domain)].mean(axis=1)
        middles = MPI.COMM_WORLD.bcast(gathered(comm, x))
        found.append(middles[np.lexsort(np.round(middles, 9).T)])
    assert found[0].shape == found[1].shape
    assert np.allclose(*found, rtol=0.0, atol=1e-14)


def test_a_mesh_is_halved_as_often_as_sizes_ask_for_and_no_more():
    square = mirrored_box(MPI.COMM_SELF, [0.0, 0.0], [1.0, 1.0], [2, 2])
    refinement = Refinement(square)
    assert refinement.mesh(lambda x: np.full(len(x), np.inf)).size == square.size
    assert refinement.mesh(lambda x: np.full(len(x), 0.5 * 2**0.5)).size == square.size
    assert refinement.mesh(lambda x: np.full(len(x), 0.25 * 2**0.5)).size == 4 * square.size
    assert refinement.mesh(lambda x: np.full(len(x), 0.125 * 2**0.5)).size == 16 * square.size


def test_cells_do_not_degenerate_however_often_they_are_halved():
    cube = box(MPI.COMM_SELF, [0.0] * 3, [1.0] * 3, [2] * 3)
    worst = [volumes(Refinement(cube).mesh(near([0.3, 0.3, 0.3], size, size)))[1].min() for size in (0.2, 0.05, 0.02)]
    assert min(worst) > 0.4 * volumes(cube)[1].min()


def test_what_cannot_be_refined_is_refused():
    with pytest.raises(ValueError, match="triangles or tetrahedra are required"):
        Refinement(box(MPI.COMM_SELF, [0.0, 0.0], [1.0, 1.0], [2, 2], "quadrilateral"))
    with pytest.raises(ValueError, match="a NamedMesh"):
        Refinement(box(MPI.COMM_SELF, [0.0, 0.0], [1.0, 1.0], [2, 2]).domain)
    refinement = Refinement(box(MPI.COMM_SELF, [0.0, 0.0], [1.0, 1.0], [2, 2]))
    with pytest.raises(ValueError, match="> 0 are required"):
        refinement.mesh(lambda x: np.zeros(len(x)))
    with pytest.raises(ValueError, match="larger sizes are required"):
        refinement.mesh(near(np.zeros(2), 1e-30, 1e-20))


@pytest.mark.mpi
def test_spaces_of_refined_meshes_are_continuous():
    """A hanging vertex would make the gradient of an interpolated linear function wrong."""
    mesh = Refinement(base(3)).mesh(near([0.5, 0.5, 0.5], 0.15, 0.2))
    V = equal_order_space(mesh.domain, 1)
    cells = compat.cell_dofs(V)
    owned = V.dofmap.index_map.size_global
    x = compat.cell_vertices(mesh.domain)
    corners = gathered(mesh.domain.comm, np.round(x.reshape(-1, 3), 12))
    if corners is not None:
        assert len(np.unique(corners, axis=0)) == owned
    assert len(cells) == len(x)
