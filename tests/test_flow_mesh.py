"""Named parts of a boundary."""

import numpy as np
import pytest
import ufl
from mpi4py import MPI
from dolfinx import mesh

from tigar_x import compat
from varmint.mesh import boundary_measures


def left(x):
    return np.isclose(x[0], 0.0)


def right(x):
    return np.isclose(x[0], 2.0)


def ends(x):
    return left(x) | right(x)


@pytest.mark.mpi
@pytest.mark.parametrize("cell", ["triangle", "quadrilateral"])
def test_parts_have_their_length_and_may_stand_in_one_form(cell):
    corners = [np.zeros(2), np.array([2.0, 1.0])]
    domain = mesh.create_rectangle(MPI.COMM_WORLD, corners, [6, 4], getattr(mesh.CellType, cell))
    walls = [lambda x: np.isclose(x[1], 0.0), lambda x: np.isclose(x[1], 1.0)]
    ds = boundary_measures(domain, quadrature_degree=2, inlet=left, outlet=right, walls=walls)
    assert list(ds) == ["inlet", "outlet", "walls"]
    x = ufl.SpatialCoordinate(domain)
    (form,) = compat.compile_forms(x[1] * ds["inlet"] + 10 * x[0] * ds["outlet"] + 100 * ds["walls"])
    assert compat.assemble_scalar(form) == pytest.approx(0.5 + 20.0 + 400.0, rel=1e-12)


@pytest.mark.mpi
def test_a_corner_cell_does_not_lend_its_other_facets():
    """In one layer of cells every vertex lies on the top or the bottom: sides are chosen by one plane at a time."""
    domain = mesh.create_unit_cube(MPI.COMM_WORLD, 2, 2, 1)
    planes = [lambda x, i=i, s=s: np.isclose(x[i], s) for i in (0, 1) for s in (0.0, 1.0)]
    (form,) = compat.compile_forms(1.0 * boundary_measures(domain, quadrature_degree=1, sides=planes)["sides"])
    assert compat.assemble_scalar(form) == pytest.approx(4.0, rel=1e-12)


@pytest.mark.mpi
@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({}, "parts is empty"),
        ({"inlet": left, "nowhere": lambda x: x[0] > 5.0}, "part 'nowhere' has no boundary facet"),
        ({"inlet": left, "ends": ends}, "'inlet', 'ends' overlap"),
    ],
)
def test_bad_parts_are_named(parts, message):
    domain = mesh.create_rectangle(MPI.COMM_WORLD, [np.zeros(2), np.array([2.0, 1.0])], [4, 2])
    with pytest.raises(ValueError, match=message):
        boundary_measures(domain, quadrature_degree=1, **parts)
