"""Meshes of flow scenes: named groups of facets and cells, and the checks of what is brought from elsewhere."""

import signal

import numpy as np
import pytest
import ufl
from mpi4py import MPI
from dolfinx import fem, mesh

from tigar_x import compat
from tigar_x.ranks import on_root
from varmint.mesh import NamedMesh, box, grid, named
from varmint.mesh import elements as mesh_elements
from varmint.mesh import files as mesh_files
from varmint.mesh.arrays import checked, distributed, from_arrays
from varmint.mesh.checks import FACETS, MeshArrays, checked_arrays, extruded_arrays
from varmint.mesh.elements import Block, Elements
from varmint.mesh.files import read_mesh
from varmint.mesh.models import channel_with_cylinder, from_gmsh
from varmint.mesh.named import CELLS

COMM = MPI.COMM_WORLD
KINDS = [*CELLS[2], *CELLS[3]]
LINES = [np.array([0.0, 0.1, 0.4, 1.0, 2.0]), np.array([-1.0, -0.9, 0.0, 0.5]), np.array([0.0, 0.25, 3.0])]
SIZES = np.array([2.0, 1.5, 3.0])


def left(x):
    return np.isclose(x[0], 0.0)


def right(x):
    return np.isclose(x[0], 2.0)


def ends(x):
    return left(x) | right(x)


def value(form):
    return compat.assemble_scalar(compat.compile_forms(form)[0])


def total(number):
    return COMM.allreduce(number, op=MPI.SUM)


def content(x):
    """Length, area or volume of entities with corners x, shape (entities, corners, dimension); boxes or simplices."""
    corners, dim = x.shape[1:]
    edges = x[:, [1, 2, 4] if corners == 8 else range(1, corners)] - x[:, :1]
    if corners == 4 and dim == 3 and np.abs(np.linalg.det(edges)).max(initial=0.0) < 1e-14:
        edges = edges[:, :2]
    if corners == 4 and dim == 2:
        edges = np.stack([x[:, 3] - x[:, 0], x[:, 2] - x[:, 1]], axis=1)
    gram = np.einsum("cik,cjk->cij", edges, edges)
    factor = {2: 1.0, 3: 2.0, 8: 1.0}.get(corners, {1: 1.0, 2: 2.0 if dim == 2 else 1.0, 3: 6.0}[edges.shape[1]])
    return np.sqrt(np.maximum(np.linalg.det(gram), 0.0)).sum() / factor


def facet_contents(m):
    """Length or area of every group of facets, from the vertices of the facets that each rank owns."""
    dim = m.domain.topology.dim
    x, nodes = m.domain.geometry.x[:, :dim], compat.facet_nodes(m.domain)
    owned = m.domain.topology.index_map(dim - 1).size_local
    return {name: total(content(x[nodes[m.facets(name)[m.facets(name) < owned]]])) for name in m.facet_names}


def cell_contents(m):
    x, owned = compat.cell_vertices(m.domain), compat.owned_cells(m.domain)
    return {name: total(content(x[m.cells(name)[m.cells(name) < owned]])) for name in m.cell_names}


def cell_total(m):
    return total(content(compat.cell_vertices(m.domain)[: compat.owned_cells(m.domain)]))


def side_sizes(dim):
    """What the sides of a grid over LINES measure."""
    area = np.prod(SIZES[:dim])
    names = [("left", "right"), ("bottom", "top"), ("back", "front")][:dim]
    return {name: area / SIZES[i] for i, pair in enumerate(names) for name in pair}


def some_arrays(kind, seed=3):
    """A grid over LINES with vertices and cells in random order and unused vertices; its sides, and two halves."""
    dim = 2 if kind in CELLS[2] else 3
    source = grid(MPI.COMM_SELF, LINES[:dim], kind)
    rng = np.random.default_rng(seed)
    x = np.concatenate([source.domain.geometry.x[:, :dim], rng.random((3, dim))])
    order = rng.permutation(len(x))
    number = np.argsort(order)
    cells = number[rng.permutation(compat.cell_nodes(source.domain))]
    if kind in ("triangle", "tetrahedron"):
        cells = rng.permuted(cells, axis=1)
    nodes = compat.facet_nodes(source.domain)
    facets = {name: rng.permuted(number[nodes[source.facets(name)]], axis=1) for name in source.facet_names}
    low = x[order][cells].mean(axis=1)[:, 0] < 1.0
    inner = np.flatnonzero(np.isclose(source.domain.geometry.x[nodes][:, :, 0], 1.0).all(axis=1))
    facets["middle"] = number[nodes[inner]]
    return MeshArrays(kind, cells, x[order], facets, {"low": np.flatnonzero(low), "high": np.flatnonzero(~low)})


def built(arrays):
    """The mesh of arrays that only rank 0 has."""
    given = (arrays.cells, arrays.x) if COMM.rank == 0 else (None, None)
    groups = {"facets": arrays.facets, "cell_groups": arrays.cell_groups} if COMM.rank == 0 else {}
    return from_arrays(COMM, arrays.cell, *given, **groups)


# -- names ------------------------------------------------------------------------------------------------------------


@pytest.mark.mpi
@pytest.mark.parametrize("cell", ["triangle", "quadrilateral"])
def test_parts_have_their_length_and_may_stand_in_one_form(cell):
    corners = [np.zeros(2), np.array([2.0, 1.0])]
    domain = mesh.create_rectangle(COMM, corners, [6, 4], getattr(mesh.CellType, cell))
    walls = [lambda x: np.isclose(x[1], 0.0), lambda x: np.isclose(x[1], 1.0)]
    upstream = {"upstream": lambda x: x[0] < 1.0 + 1e-9}
    m = named(domain, cells=upstream, inlet=left, outlet=right, walls=walls)
    assert m.facet_names == ("inlet", "outlet", "walls")
    assert m.cell_names == ("upstream",)
    assert facet_contents(m) == pytest.approx({"inlet": 1.0, "outlet": 1.0, "walls": 4.0})
    assert cell_contents(m) == pytest.approx({"upstream": 1.0})
    x = ufl.SpatialCoordinate(domain)
    form = x[1] * m.ds("inlet", degree=2) + 10 * x[0] * m.ds("outlet", degree=2) + 100 * m.ds("walls", degree=2)
    form += 1e3 * m.ds("walls", "inlet", "walls", degree=1) + 1e4 * m.ds(degree=1)
    form += 1e5 * m.dx("upstream", degree=1) + 1e6 * m.dx(degree=1)
    assert value(form) == pytest.approx(0.5 + 20.0 + 400.0 + 5e3 + 6e4 + 1e5 + 2e6, rel=1e-12)


@pytest.mark.mpi
def test_a_corner_cell_does_not_lend_its_other_facets():
    """In one layer of cells every vertex lies on the top or the bottom: sides are chosen by one plane at a time."""
    domain = mesh.create_unit_cube(COMM, 2, 2, 1)
    planes = [lambda x, i=i, s=s: np.isclose(x[i], s) for i in (0, 1) for s in (0.0, 1.0)]
    m = named(domain, sides=planes)
    assert facet_contents(m) == pytest.approx({"sides": 4.0})
    assert value(1.0 * m.ds("sides", degree=1)) == pytest.approx(4.0, rel=1e-12)


@pytest.mark.mpi
@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({}, "parts is empty"),
        ({"inlet": left, "nowhere": lambda x: x[0] > 5.0}, "part 'nowhere' has no boundary facet"),
        ({"inlet": left, "inside": lambda x: np.isclose(x[0], 1.0)}, "part 'inside' has no boundary facet"),
        ({"inlet": left, "ends": ends}, "'inlet', 'ends' overlap: every boundary facet may"),
        ({"inlet": left, "cells": {"thin": right}}, "part 'thin' has no cell"),
        (
            {"cells": {"all": lambda x: x[0] < 9.0, "half": lambda x: x[0] < 1.1}},
            "'all', 'half' overlap: every cell may",
        ),
    ],
)
def test_bad_parts_are_named(parts, message):
    domain = mesh.create_rectangle(COMM, [np.zeros(2), np.array([2.0, 1.0])], [4, 2])
    with pytest.raises(ValueError, match=message):
        named(domain, **parts)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda m: m.ds("inlte", degree=1), "facet group 'inlte' does not exist: one of 'inlet', 'outlet' is required"),
        (lambda m: m.facets("inlet", "x"), "facet group 'x' does not exist: one of 'inlet', 'outlet' is required"),
        (lambda m: m.facets(), "no facet group is named: one of 'inlet', 'outlet' is required"),
        (lambda m: m.cells("fluid"), "cell group 'fluid' does not exist: one of nothing is required"),
        (lambda m: m.dx("fluid", degree=1), "cell group 'fluid' does not exist: one of nothing is required"),
        (lambda m: m.cells(), "no cell group is named: one of nothing is required"),
        (lambda m: m.ds(degree=-1), "degree = -1: an integer >= 0 is required"),
        (lambda m: m.dx(degree=1.5), "degree = 1.5: an integer >= 0 is required"),
    ],
)
def test_a_missing_name_is_told_with_those_there_are(call, message):
    domain = mesh.create_rectangle(MPI.COMM_SELF, [np.zeros(2), np.array([2.0, 1.0])], [4, 2])
    with pytest.raises(ValueError, match=message):
        call(named(domain, inlet=left, outlet=right))


def test_a_mesh_without_names_has_its_whole_measures():
    domain = mesh.create_rectangle(MPI.COMM_SELF, [np.zeros(2), np.array([2.0, 1.0])], [4, 2])
    m = NamedMesh(domain)
    assert value(1.0 * m.ds(degree=1) + 10.0 * m.dx(degree=1)) == pytest.approx(26.0, rel=1e-12)


@pytest.mark.mpi
@pytest.mark.parametrize("kind", KINDS)
def test_ranks_agree_on_the_groups_of_shared_facets(kind):
    """A field that is set on the facets of a group by every rank that knows them is the same on all ranks."""
    m = grid(COMM, LINES[: 2 if kind in CELLS[2] else 3], kind)
    every = m.facets(*m.facet_names)
    assert np.array_equal(every, compat.exterior_facets(m.domain))
    assert np.array_equal(every, np.unique(every))
    V = compat.lagrange_space(m.domain, 1)
    dim = m.domain.topology.dim
    for name in ("left", "top"):
        u = fem.Function(V)
        u.x.array[fem.locate_dofs_topological(V, dim - 1, m.facets(name), remote=False)] = 1.0
        mine = u.x.array.copy()
        u.x.scatter_forward()
        assert (mine <= u.x.array).all()
        u.x.array[:] = np.maximum(mine, u.x.array)
        assert total(u.x.array[: V.dofmap.index_map.size_local].sum()) == np.prod(
            [len(line) for i, line in enumerate(LINES[:dim]) if i != {"left": 0, "top": 1}[name]]
        )


# -- boxes ------------------------------------------------------------------------------------------------------------


@pytest.mark.mpi
@pytest.mark.parametrize("kind", KINDS)
def test_a_grid_has_its_lines_and_sides(kind):
    dim = 2 if kind in CELLS[2] else 3
    m = grid(COMM, LINES[:dim], kind)
    assert compat.cell_name(m.domain) == kind
    assert cell_total(m) == pytest.approx(np.prod(SIZES[:dim]))
    assert facet_contents(m) == pytest.approx(side_sizes(dim))
    for i, line in enumerate(LINES[:dim]):
        here = COMM.allgather(m.domain.geometry.x[:, i])
        assert np.array_equal(np.unique(np.concatenate(here)), line)
    assert checked(m.domain) is m.domain


@pytest.mark.mpi
@pytest.mark.parametrize("kind", KINDS)
def test_the_divergence_theorem_holds_over_the_sides_of_a_graded_grid(kind):
    dim = 2 if kind in CELLS[2] else 3
    m = grid(COMM, LINES[:dim], kind)
    x, n = ufl.SpatialCoordinate(m.domain), ufl.FacetNormal(m.domain)
    F = ufl.as_vector([(i + 1) * x[i] + x[0] * x[1] for i in range(dim)])
    sides = sum(
        (ufl.dot(F, n) * m.ds(name, degree=2) for name in m.facet_names[1:]), ufl.dot(F, n) * m.ds("left", degree=2)
    )
    volume = (1e3 + 1.0) * ufl.div(F) * m.dx(degree=2)
    inside = value(1e3 * ufl.div(F) * m.dx(degree=2))
    assert value(volume - sides) == pytest.approx(inside, rel=1e-12)
    assert inside > 1e3


@pytest.mark.mpi
def test_a_box_is_a_grid_of_equal_cells_with_simplices_by_default():
    plane, space = box(COMM, (0.0, -1.0), (2.0, 1.0), (4, 2)), box(COMM, (0, 0, 0), (1, 2, 3), (1, 2, 3))
    assert [compat.cell_name(m.domain) for m in (plane, space)] == ["triangle", "tetrahedron"]
    assert total(compat.owned_cells(plane.domain)) == 16
    assert total(compat.owned_cells(space.domain)) == 36
    assert cell_total(plane) == pytest.approx(4.0)
    assert facet_contents(space) == pytest.approx(dict(left=6.0, right=6.0, bottom=3.0, top=3.0, back=2.0, front=2.0))
    quads = box(COMM, (0.0, -1.0), (2.0, 1.0), (4, 2), "quadrilateral")
    x = compat.cell_vertices(quads.domain)
    assert np.allclose(np.ptp(x, axis=1), (0.5, 1.0))


@pytest.mark.mpi
def test_diagonals_to_the_left_are_mirror_images_of_those_to_the_right():
    """Cell by cell, with the numbers of their vertices, on which the stabilisation's metric depends."""

    def corners(diagonal):
        x = compat.cell_vertices(box(COMM, (0, 0), (4, 2), (4, 2), diagonal=diagonal).domain)[..., :2]
        return np.concatenate(COMM.allgather(x)).reshape(-1, 6)

    left, right = corners("left"), corners("right")
    assert {tuple(cell) for cell in left} == {tuple(cell) for cell in right * ([-1, 1] * 3) + [4, 0] * 3}
    for cells, rises in ((right, 1.0), (left, -1.0)):
        sides = cells.reshape(-1, 3, 2) - np.roll(cells.reshape(-1, 3, 2), 1, axis=1)
        assert np.all(sides[np.arange(len(sides)), np.abs(sides).sum(axis=2).argmax(axis=1)].prod(axis=1) == rises)


@pytest.mark.mpi
def test_alternating_diagonals_rise_otherwise_than_those_of_all_neighbours():
    """On squares of edge 1, two triangles of each."""
    x = compat.cell_vertices(box(COMM, (0, 0), (4, 3), (4, 3), diagonal="alternating").domain)[..., :2]
    cells = np.unique(np.concatenate(COMM.allgather(x)), axis=0)
    square = np.floor(cells.mean(axis=1)).astype(int)
    sides = cells - np.roll(cells, 1, axis=1)
    rises = sides[np.arange(len(sides)), np.abs(sides).sum(axis=2).argmax(axis=1)].prod(axis=1)
    assert np.array_equal(rises * rises[0], (-1.0) ** (square.sum(axis=1) - square[0].sum()))
    assert np.array_equal(np.unique(square, axis=0, return_counts=True)[1], np.full(12, 2))


@pytest.mark.parametrize("kind", KINDS)
def test_vertex_0_of_a_cell_of_a_grid_has_the_smallest_coordinates(kind):
    x = compat.cell_vertices(grid(MPI.COMM_SELF, LINES[: 2 if kind in CELLS[2] else 3], kind).domain)
    assert np.array_equal(x[:, 0], x.min(axis=1))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (((0.0,), (1.0,), (2,)), "dimension of lower = 1: one of 2, 3 is required"),
        (((0.0, 0.0), (1.0, 1.0, 1.0), (2, 2)), r"upper has shape \(3,\): shape \(2\) is required"),
        (((0.0, 0.0), (1.0, 0.0), (2, 2)), r"upper = \(1.0, 0.0\): coordinates > lower = \(0.0, 0.0\) are required"),
        (((0.0, 0.0), (1.0, np.inf), (2, 2)), r"upper\[1\] = inf: finite numbers are required"),
        (((0.0, 0.0), (1.0, 1.0), (2, 0)), r"elements\[1\] = 0: an integer >= 1 is required"),
        (((0.0, 0.0), (1.0, 1.0), (2, 2.5)), r"elements\[1\] = 2.5: an integer >= 1 is required"),
        (((0.0, 0.0), (1.0, 1.0), 2), "elements = 2: one number for each of the 2 axes is required"),
        (((0.0, 0.0), (1.0, 1.0), (2, 2), "hexahedron"), "cell = 'hexahedron': one of 'triangle', 'quadrilateral'"),
        (((0, 0, 0), (1, 1, 1), (2, 2, 2), "triangle"), "cell = 'triangle': one of 'tetrahedron', 'hexahedron'"),
    ],
)
def test_a_bad_box_is_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        box(MPI.COMM_SELF, *arguments)


@pytest.mark.parametrize(("kind", "diagonal"), [("triangle", "up"), ("quadrilateral", "left"), ("tetrahedron", "left")])
def test_another_diagonal_is_refused(kind, diagonal):
    with pytest.raises(ValueError, match=f"diagonal = '{diagonal}': one of 'right'"):
        grid(MPI.COMM_SELF, LINES[: 2 if kind in CELLS[2] else 3], kind, diagonal=diagonal)


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ([[0.0, 1.0]], "number of axes in lines = 1: one of 2, 3 is required"),
        ([[0.0, 1.0], [0.0]], r"lines\[1\] = \[0.0\]: two or more coordinates that increase are required"),
        ([[0.0, 1.0, 1.0], [0.0, 1.0]], r"lines\[0\] = .*: two or more coordinates that increase are required"),
        ([[0.0, 1.0], [0.0, np.nan]], r"lines\[1\]\[1\] = nan: finite numbers are required"),
        ([[0.0, 1.0], [[0.0, 1.0]]], r"lines\[1\] has shape \(1, 2\): shape \(any\) is required"),
    ],
)
def test_bad_lines_are_refused(lines, message):
    with pytest.raises(ValueError, match=message):
        grid(MPI.COMM_SELF, lines)


# -- arrays -----------------------------------------------------------------------------------------------------------


@pytest.mark.mpi
@pytest.mark.parametrize("kind", KINDS)
def test_groups_of_arrays_are_found_again_on_any_rank(kind):
    dim = 2 if kind in CELLS[2] else 3
    arrays = some_arrays(kind)
    m = built(arrays)
    area = np.prod(SIZES[:dim])
    assert facet_contents(m) == pytest.approx(side_sizes(dim) | {"middle": area / SIZES[0]})
    assert cell_contents(m) == pytest.approx({"low": area / 2.0, "high": area / 2.0})
    assert m.inner_facet_names == ("middle",)
    x = compat.cell_vertices(m.domain).mean(axis=1)[:, 0]
    assert np.array_equal(np.flatnonzero(x < 1.0), m.cells("low"))
    assert len(m.cells("low", "high")) == len(x)
    size = m.domain.topology.index_map(0).size_global
    assert size == np.prod([len(line) for line in LINES[:dim]])
    with pytest.raises(
        ValueError, match=r"facet group 'middle' has facets inside the mesh: one of 'left', .* is required"
    ):
        m.ds("middle", degree=1)
    assert checked(m.domain) is m.domain


@pytest.mark.mpi
@pytest.mark.parametrize("kind", ["triangle", "hexahedron"])
def test_measures_of_arrays_close_the_divergence_theorem_on_one_half(kind):
    """The flux through the middle, which lies inside, is the volume integral less the flux through the sides."""
    dim = 2 if kind in CELLS[2] else 3
    m = built(some_arrays(kind))
    n = ufl.FacetNormal(m.domain)
    F = ufl.SpatialCoordinate(m.domain)
    flux = value(ufl.div(F) * m.dx("low", degree=1) - ufl.dot(F, n) * m.ds("left", degree=1))
    area = np.prod(SIZES[:dim])
    assert flux == pytest.approx(dim * area / 2.0, rel=1e-12)
    marks = ufl.Measure("dS", domain=m.domain, subdomain_data=m.facet_tags, metadata={"quadrature_degree": 1})
    one = fem.Constant(m.domain, 1.0)
    assert value(ufl.avg(one) * marks(m.facet_names.index("middle") + 1)) == pytest.approx(area / SIZES[0], rel=1e-12)


@pytest.mark.mpi
def test_one_cell_is_a_mesh():
    m = built(MeshArrays("triangle", np.array([[2, 0, 1]]), np.eye(3)[:, :2], {"long": [[0, 1]]}, {"all": [0]}))
    assert facet_contents(m) == pytest.approx({"long": np.sqrt(2.0)})
    assert cell_contents(m) == pytest.approx({"all": 0.5})


SQUARE = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0], [2.0, 0.0], [0.4, 0.3]])
CUBE = np.array([[x, y, z] for z in (0.0, 1.0) for y in (0.0, 1.0) for x in (0.0, 1.0)])
VTK = [0, 1, 3, 2, 4, 5, 7, 6]
BAD = [
    (
        MeshArrays("prism", [[0]], CUBE),
        "cell = 'prism': one of 'triangle', 'quadrilateral', 'tetrahedron', 'hexahedron'",
    ),
    (MeshArrays("triangle", [], SQUARE), r"cells is empty: integers of shape \(any, 3\) are required"),
    (
        MeshArrays("triangle", [[0.0, 1.0, 2.0]], SQUARE),
        r"cells has type float64 and shape \(1, 3\): integers of shape",
    ),
    (
        MeshArrays("triangle", [[0, 1, 2, 3]], SQUARE),
        r"cells has type int64 and shape \(1, 4\): integers of shape \(any, 3\)",
    ),
    (MeshArrays("triangle", [[0, 1, 2], [0, 1]], SQUARE), r"cells = \[\[0, 1, 2\], \[0, 1\]\]: integers of shape"),
    (MeshArrays("triangle", [[0, 1, 6]], SQUARE), "cells has 6: numbers from 0 to 5 are required"),
    (MeshArrays("triangle", [[0, 1, -1]], SQUARE), "cells has -1: numbers from 0 to 5 are required"),
    (MeshArrays("triangle", [[0, 1, 2]], CUBE), r"x has shape \(8, 3\): shape \(any, 2\) is required"),
    (MeshArrays("triangle", [[0, 1, 2]], np.where(SQUARE == 2.0, np.nan, SQUARE)), r"x\[4, 0\] = nan: finite numbers"),
    (MeshArrays("triangle", [[0, 1, 2], [0, 1, 4]], SQUARE), r"cell 1 at \(1, 0\) has no volume"),
    (MeshArrays("triangle", [[0, 1, 2], [3, 1, 1]], SQUARE), r"cell 1 at \(1, 0.333333\) has no volume"),
    (MeshArrays("tetrahedron", [[0, 1, 2, 3]], CUBE), r"cell 0 at \(0.5, 0.5, 0\) has no volume"),
    (MeshArrays("quadrilateral", [[0, 0, 1, 1]], SQUARE), r"cell 0 at \(0.5, 0\) has no volume"),
    (
        MeshArrays("quadrilateral", [[0, 1, 3, 2]], SQUARE),
        r"the Jacobian of cell 0 at \(0.5, 0.5\) vanishes or changes sign",
    ),
    (MeshArrays("quadrilateral", [[0, 1, 2, 5]], SQUARE), r"the Jacobian of cell 0 at \(0.35, 0.325\) vanishes or"),
    (MeshArrays("quadrilateral", [[0, 1, 2, 2]], SQUARE), "the Jacobian of cell 0 .* vanishes or changes sign"),
    (MeshArrays("hexahedron", [VTK], CUBE), r"the Jacobian of cell 0 at \(0.5, 0.5, 0.5\) vanishes or changes sign"),
    (MeshArrays("triangle", [[0, 1, 2], [0, 1, 5]], SQUARE), r"cell 0 at \(0.3.*\) and cell 1 at \(0.4.*\) overlap"),
    (
        MeshArrays("triangle", [[0, 1, 2], [2, 1, 0]], SQUARE),
        "cell 0 .* and cell 1 .* overlap: cells that share a facet",
    ),
    (
        MeshArrays("quadrilateral", [[0, 1, 2, 3], [1, 0, 3, 2]], SQUARE),
        "cell 0 .* and cell 1 .* overlap: cells that share a facet are required to lie on different sides",
    ),
    (MeshArrays("tetrahedron", [[0, 1, 2, 4], [0, 1, 2, 7]], CUBE), "cell 0 .* and cell 1 .* overlap"),
    (
        MeshArrays("hexahedron", [range(8), [0, 1, 2, 3, 8, 9, 10, 11]], np.r_[CUBE, CUBE[4:] * [1, 1, 2]]),
        "cell 0 .* and cell 1 .* overlap",
    ),
    (MeshArrays("triangle", [[0, 1, 2], [1, 2, 3], [1, 2, 4]], SQUARE), r"a facet of cell 0 at .* has 3 cells"),
    (
        MeshArrays("triangle", [[0, 1, 2], [1, 2, 3], [6, 7, 8]], np.r_[SQUARE, SQUARE[:3] + 5.0]),
        r"the mesh has 2 parts that share no facet, the smallest with 1 of 3 cells, such as cell 2 at \(5.33333, 5.3",
    ),
    (MeshArrays("triangle", [[0, 5, 1], [1, 3, 4]], SQUARE), "the mesh has 2 parts that share no facet"),
    (
        MeshArrays("triangle", [[0, 1, 2]], SQUARE, {"a": [[0, 1], [0, 3]]}),
        r"facets\['a'\]\[1\] = \[0 3\]: a facet of the mesh",
    ),
    (MeshArrays("triangle", [[0, 1, 2]], SQUARE, {"a": []}), r"facets\['a'\] is empty: integers of shape \(any, 2\)"),
    (MeshArrays("triangle", [[0, 1, 2]], SQUARE, {"a": [[0, 9]]}), r"facets\['a'\] has 9: numbers from 0 to 5"),
    (
        MeshArrays("triangle", [[0, 1, 2]], SQUARE, {"a": [[0, 1]], "b": [[1, 2], [1, 0]]}),
        r"facets\['a'\] and facets\['b'\] overlap: groups that share nothing are required",
    ),
    (MeshArrays("triangle", [[0, 1, 2]], SQUARE, {}, {"f": [1]}), r"cell_groups\['f'\] has 1: numbers from 0 to 0"),
    (
        MeshArrays("triangle", [[0, 1, 2]], SQUARE, {}, {"f": [0], "s": [0]}),
        r"cell_groups\['f'\] and cell_groups\['s'\] ov",
    ),
]


@pytest.mark.mpi
@pytest.mark.parametrize(("arrays", "message"), BAD, ids=[str(i) for i in range(len(BAD))])
def test_arrays_that_are_no_mesh_are_refused_on_all_ranks(arrays, message):
    with pytest.raises(ValueError, match=message):
        built(arrays)


@pytest.mark.parametrize("kind", KINDS)
def test_the_first_bad_cell_is_found_in_any_mesh(kind):
    """The cell that is turned inside out, laid flat, or repeated is the one in the message."""
    arrays = some_arrays(kind)
    x, bad = arrays.x.copy(), 7
    x[arrays.cells[bad, 1]] = x[arrays.cells[bad, 0]]
    with pytest.raises(ValueError, match=r"cell .* has no volume|the Jacobian of cell .* vanishes"):
        checked_arrays(MeshArrays(kind, arrays.cells, x))
    with pytest.raises(ValueError, match=f"cell {bad} at .* and cell {len(arrays.cells)} at .* overlap|has 3 cells"):
        checked_arrays(MeshArrays(kind, np.r_[arrays.cells, arrays.cells[[bad]]], arrays.x))


@pytest.mark.parametrize("kind", KINDS)
def test_shape_and_place_of_the_mesh_do_not_matter(kind):
    """Mirrored, thin and far away, a mesh is one still, and a cell that is flat there is found."""
    arrays = some_arrays(kind)
    dim = arrays.x.shape[1]
    scales = [np.ones(dim), np.where(np.arange(dim) == 0, -1e-6, 1.0), np.full(dim, 1e-9)]
    for scale, far in [(scales[0], 0.0), (scales[0], 1e5), (scales[1], 0.0), (scales[2], 0.0)]:
        x = arrays.x * scale + far
        checked_arrays(MeshArrays(kind, arrays.cells, x, arrays.facets, arrays.cell_groups))
        x[:, 0] = far
        with pytest.raises(ValueError, match=r"cell 0 at .* has no volume"):
            checked_arrays(MeshArrays(kind, arrays.cells, x))


def test_a_facet_twice_in_a_group_counts_once():
    arrays = checked_arrays(MeshArrays("triangle", [[0, 1, 3]], SQUARE, {"a": [[3, 1], [0, 1], [1, 3]]}, {"f": [0, 0]}))
    assert arrays.facets["a"].tolist() == [[0, 1], [1, 2]]
    assert arrays.cells.tolist() == [[0, 1, 2]]
    assert np.array_equal(arrays.x, SQUARE[[0, 1, 3]])
    assert arrays.cell_groups["f"].tolist() == [0]


@pytest.mark.mpi
@pytest.mark.parametrize("kind", ["triangle", "quadrilateral"])
def test_plane_cells_are_extruded_with_their_groups(kind):
    plane = some_arrays(kind)
    m = distributed(COMM, lambda: extruded_arrays(checked_arrays(plane), 0.5, 3))
    sizes = {name: size / 2.0 for name, size in (side_sizes(2) | {"middle": SIZES[1]}).items()}
    assert facet_contents(m) == pytest.approx(sizes | {"back": 3.0, "front": 3.0})
    assert cell_contents(m) == pytest.approx({"low": 0.75, "high": 0.75})
    x = compat.cell_vertices(m.domain).mean(axis=1)[:, 0]
    assert np.array_equal(np.flatnonzero(x < 1.0), m.cells("low"))
    assert compat.cell_name(m.domain) == {"triangle": "tetrahedron", "quadrilateral": "hexahedron"}[kind]
    with pytest.raises(ValueError, match="cell of arrays = 'tetrahedron': one of 'triangle', 'quadrilateral' is req"):
        extruded_arrays(some_arrays("tetrahedron"), 1.0, 1)


@pytest.mark.mpi
@pytest.mark.parametrize("kind", KINDS)
def test_a_mesh_of_dolfinx_is_checked_as_it_stands(kind):
    m = grid(COMM, LINES[: 2 if kind in CELLS[2] else 3], kind)
    x, far = m.domain.geometry.x, 2.0
    assert checked(m.domain) is m.domain
    corner = np.isclose(x[:, 0], 0.0) & np.isclose(x[:, 1], -1.0) & np.isclose(x[:, 2], 0.0)
    x[corner, 0] += far
    with pytest.raises(ValueError, match=r"overlap|changes sign"):
        checked(m.domain)
    x[corner, 0] -= far
    assert checked(m.domain) is m.domain


@pytest.mark.mpi
def test_only_linear_meshes_that_fill_space_are_checked(monkeypatch):
    x = np.concatenate([SQUARE, SQUARE[:, :1] ** 2], axis=1) if COMM.rank == 0 else np.zeros((0, 3))
    surface = compat.create_mesh(COMM, "triangle", [[0, 1, 2], [1, 2, 3]] if COMM.rank == 0 else np.zeros((0, 3)), x)
    with pytest.raises(ValueError, match="domain has cells 'triangle' in 3 dimensions: 2 are required"):
        checked(surface)
    with pytest.raises(ValueError, match="cell of domain = 'interval': one of 'triangle', "):
        checked(mesh.create_unit_interval(COMM, 4))
    monkeypatch.setattr(compat, "cell_nodes", lambda domain: np.zeros((0, 6), dtype=np.int32))
    with pytest.raises(ValueError, match="domain has curved cells: cells of degree 1 are required"):
        checked(mesh.create_unit_square(COMM, 2, 2))


def test_facets_of_the_reference_cells_are_those_of_basix():
    import basix

    for kind, facets in FACETS.items():
        dim = 2 if kind in CELLS[2] else 3
        assert sorted(facets.tolist()) == sorted(basix.topology(getattr(basix.CellType, kind))[dim - 1])


# -- elements with numbers --------------------------------------------------------------------------------------------


def elements(kind, labels=None):
    """A grid as a mesh generator has it: sides have the numbers 1, 2, ..., the halves 1 and 2, which is negative."""
    names = {cell: (other, facet, order) for other, (cell, facet, order) in mesh_elements.CELLS.items()}
    other, facet, order = names[kind]
    arrays = some_arrays(kind)
    facets = {name: rows for name, rows in arrays.facets.items() if name != "middle"}
    rows = np.concatenate(list(facets.values()))
    if facet == "quad":
        rows = np.sort(rows, axis=1)
    side = np.repeat(np.arange(1, len(facets) + 1), [len(group) for group in facets.values()])
    half = np.ones(len(arrays.cells), dtype=int)
    half[arrays.cell_groups["high"]] = -2
    cells = Block(other, np.asarray(arrays.cells)[:, np.argsort(order)], half)
    x = np.pad(arrays.x, ((0, 0), (0, 3 - arrays.x.shape[1])), constant_values=0.7)
    return Elements("the grid", x, [Block(facet, rows, side), cells, Block("vertex", [[0]], [5])], labels or {})


@pytest.mark.mpi
@pytest.mark.parametrize("kind", KINDS)
def test_numbered_groups_have_given_names_labels_or_numbers(kind):
    dim = 2 if kind in CELLS[2] else 3
    labels = {(dim, 1): "low", (dim - 1, 1): "inlet", (dim - 1, 2): "outlet", (dim + 1, 3): "nothing"}
    m = distributed(COMM, lambda: elements(kind, labels).arrays({"floor": 3, "exit": 2}))
    area = np.prod(SIZES[:dim])
    wanted = dict(zip(("inlet", "exit", "floor", "4", "5", "6"), side_sizes(dim).values(), strict=False))
    assert facet_contents(m) == pytest.approx(wanted)
    assert cell_contents(m) == pytest.approx({"low": area / 2.0, "exit": area / 2.0})


def first(block, **changes):
    return Block(**{"kind": block.kind, "vertices": block.vertices, "numbers": block.numbers} | changes)


@pytest.mark.parametrize(
    ("change", "names", "message"),
    [
        (lambda e: (e.points, e.blocks[:1]), {}, "the grid has no cells: triangles, quadrilaterals, .* are required"),
        (lambda e: (e.points, []), {}, "the grid has no cells"),
        (
            lambda e: (e.points, [e.blocks[1], Block("quad", np.array([[0, 1, 2, 3]]), np.array([1]))]),
            {},
            "the grid has cells 'triangle' and 'quad': linear ones of one kind, of 'triangle', 'quad', 'tetra', ",
        ),
        (
            lambda e: (e.points, [Block("triangle6", np.array([[0, 1, 2, 3, 4, 5]]), np.array([1]))]),
            {},
            "the grid has cells 'triangle6': linear ones of one kind, of 'triangle', .* are required",
        ),
        (
            lambda e: (e.points, [Block("wedge", np.array([[0, 1, 2, 3, 4, 5]]), np.array([1]))]),
            {},
            "the grid has cells 'wedge': linear ones",
        ),
        (
            lambda e: (e.points, [e.blocks[1], Block("line3", np.array([[0, 1, 2]]), np.array([1]))]),
            {},
            "the grid has facets with a group 'line3': linear ones of one kind, of 'line', are required",
        ),
        (
            lambda e: (e.points + np.linspace(0.0, 0.1, len(e.points))[:, None] * [0.0, 0.0, 1.0], e.blocks),
            {},
            r"the grid has z from 0.7\d* to 0.\d*: a plane mesh at one z is required",
        ),
        (lambda e: (e.points[:, :1], e.blocks), {}, "the grid has points with 1 coordinates: 2 are required"),
        (lambda e: (e.points, e.blocks), {"inlet": 7}, r"names\['inlet'\] = 7: one of 1, 2, 3, 4 is required"),
        (
            lambda e: (e.points, e.blocks),
            {"a": 1, "b": 1},
            r"names = \{'a': 1, 'b': 1\}: a number of its own for each name",
        ),
        (lambda e: (e.points, e.blocks), {"4": 3}, "groups 3 and 4 of the grid are both '4': two names are required"),
    ],
)
def test_elements_that_are_no_plain_mesh_are_refused(change, names, message):
    with pytest.raises(ValueError, match=message):
        Elements("the grid", *change(elements("triangle"))).arrays(names)


# -- files ------------------------------------------------------------------------------------------------------------


def shared_path(tmp_path):
    """The folder of rank 0."""
    return type(tmp_path)(COMM.bcast(str(tmp_path)))


def written(path, found, **options):
    """Write elements by meshio on rank 0."""
    import meshio

    def write():
        order = sorted(found.blocks, key=lambda block: block.dimension)
        numbers = [np.abs(np.asarray(block.numbers)) for block in order]
        fields = {name: np.array([number, dim]) for (dim, number), name in found.labels.items()}
        data = {"gmsh:physical": numbers, "gmsh:geometrical": numbers}
        blocks = [(block.kind, np.asarray(block.vertices)) for block in order]
        data = {options.pop("data", "gmsh:physical"): numbers} if path.suffix == ".xdmf" else data
        meshio.Mesh(found.points, blocks, cell_data=data, field_data=fields).write(path, **options)

    on_root(COMM, write)
    return path


@pytest.mark.mpi
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("version", ["gmsh22", "gmsh"])
def test_a_msh_file_is_read_with_its_names(tmp_path, kind, version):
    pytest.importorskip("meshio")
    dim = 2 if kind in CELLS[2] else 3
    path = shared_path(tmp_path) / "mesh.msh"
    labels = {(dim, 1): "low", (dim, 2): "high", (dim - 1, 1): "in flow", (dim - 1, 2): "outlet"}
    if version == "gmsh22":
        written(path, elements(kind, labels), file_format=version, binary=dim == 3)
    else:
        on_root(COMM, lambda: path.write_text(msh41(elements(kind, labels))))
    m = read_mesh(COMM, path, names={"floor": 3})
    area = np.prod(SIZES[:dim])
    wanted = dict(zip(("in flow", "outlet", "floor", "4", "5", "6"), side_sizes(dim).values(), strict=False))
    assert facet_contents(m) == pytest.approx(wanted)
    assert cell_contents(m) == pytest.approx({"low": area / 2.0, "high": area / 2.0})


def msh41(found):
    """Version 4.1 in ASCII, one entity for each group, with numbers that have gaps and the negative ones of a file."""
    kinds = {"line": 1, "triangle": 2, "quad": 3, "tetra": 4, "hexahedron": 5}
    blocks = [block for block in found.blocks if block.kind != "vertex"]
    groups = [
        (block.dimension, number, kinds[block.kind], np.asarray(block.vertices)[block.numbers == number])
        for block in sorted(blocks, key=lambda block: block.dimension)
        for number in np.unique(block.numbers)
    ]
    counts = [sum(group[0] == dim for group in groups) for dim in range(4)]
    lines = ["$MeshFormat", "4.1 0 8", "$EndMeshFormat", "$PhysicalNames", str(len(found.labels))]
    lines += [f'{dim} {number} "{name}"' for (dim, number), name in found.labels.items()]
    lines += ["$EndPhysicalNames", "$Entities", " ".join(map(str, counts))]
    lines += [
        f"{dim} 0 0 0 1 1 1 1 {number} 0".replace(f"{dim} ", f"{abs(number)} ", 1) for dim, number, _, _ in groups
    ]
    count, tags = len(found.points), 3 * np.arange(len(found.points)) + 2
    lines += ["$EndEntities", "$Nodes", f"1 {count} 2 {tags[-1]}", f"2 1 0 {count}", *map(str, tags)]
    lines += [" ".join(f"{value:.17g}" for value in point) for point in found.points]
    lines += ["$EndNodes", "$Elements", f"{len(groups)} {sum(len(group[3]) for group in groups)} 1 999"]
    for dim, number, kind, rows in groups:
        lines.append(f"{dim} {abs(number)} {kind} {len(rows)}")
        lines += [f"{i + 1} " + " ".join(map(str, tags[row])) for i, row in enumerate(rows)]
    return "\n".join([*lines, "$EndElements", ""])


@pytest.mark.mpi
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("data", ["gmsh:physical", "name_to_read", "anything"])
def test_xdmf_files_of_cells_and_of_facets_are_joined(tmp_path, kind, data):
    pytest.importorskip("meshio")
    folder, found = shared_path(tmp_path), elements(kind)
    dim = found.blocks[1].dimension
    cells = written(folder / "cells.xdmf", Elements("", found.points[:, :dim], [found.blocks[1]]), data=data)
    turned = found.points[::-1]
    rows = len(turned) - 1 - found.blocks[0].vertices
    facets = Elements("", turned, [Block(found.blocks[0].kind, rows, found.blocks[0].numbers)])
    sides = written(folder / "facets.xdmf", facets, data=data, data_format="XML")
    m = read_mesh(COMM, cells, facets_path=str(sides), names={"inlet": 1})
    area = np.prod(SIZES[:dim])
    wanted = dict(zip(("inlet", "2", "3", "4", "5", "6"), side_sizes(dim).values(), strict=False))
    assert facet_contents(m) == pytest.approx(wanted)
    assert cell_contents(m) == pytest.approx({"inlet": area / 2.0, "2": area / 2.0})


@pytest.mark.mpi
@pytest.mark.parametrize("kind", KINDS)
def test_one_xdmf_file_has_cells_and_facets(tmp_path, kind):
    pytest.importorskip("meshio")
    found = elements(kind)
    m = read_mesh(COMM, written(shared_path(tmp_path) / "mesh.xdmf", Elements("", found.points, found.blocks[:2])))
    area = np.prod(SIZES[: found.blocks[1].dimension])
    assert list(facet_contents(m).values()) == pytest.approx(list(side_sizes(found.blocks[1].dimension).values()))
    assert cell_contents(m) == pytest.approx({"1": area / 2.0, "2": area / 2.0})


def test_an_xdmf_file_without_numbers_has_no_groups(tmp_path):
    meshio = pytest.importorskip("meshio")
    blocks = [("triangle", np.array([[0, 1, 2], [1, 2, 3]]))]
    meshio.Mesh(SQUARE, blocks, cell_data={"quality": [np.ones(2)]}).write(tmp_path / "plain.xdmf", data_format="XML")
    m = read_mesh(MPI.COMM_SELF, tmp_path / "plain.xdmf")
    assert (m.facet_names, m.cell_names, m.facet_tags, m.cell_tags) == ((), (), None, None)
    assert m.domain.topology.index_map(0).size_global == 4


@pytest.mark.mpi
@pytest.mark.parametrize(
    ("name", "text", "error", "message"),
    [
        ("none.msh", None, FileNotFoundError, "none.msh: there is no such file"),
        ("mesh.stl", "", ValueError, "suffix of '.*mesh.stl' = '.stl': one of '.msh', '.xdmf', '.geo' is required"),
        ("empty.msh", "", ValueError, "empty.msh cannot be read as .msh"),
        (
            "cut.msh",
            "$MeshFormat\n2.2 0 8\n$EndMeshFormat\n$Nodes\n7\n1 0 0 0\n",
            ValueError,
            "cut.msh cannot be read as .msh",
        ),
        ("not.xdmf", "<html>", ValueError, "not.xdmf cannot be read as .xdmf"),
        ("gone.xdmf", "<Xdmf Version='3.0'><Domain/></Xdmf>", ValueError, "gone.xdmf cannot be read as .xdmf"),
    ],
)
def test_files_that_are_no_meshes_are_refused_on_all_ranks(tmp_path, name, text, error, message):
    pytest.importorskip("meshio")
    path = shared_path(tmp_path) / name
    if text is not None:
        on_root(COMM, lambda: path.write_text(text))
    with pytest.raises(error, match=message):
        read_mesh(COMM, path)


def test_files_of_facets_that_do_not_fit_are_refused(tmp_path):
    pytest.importorskip("meshio")
    found = elements("triangle")
    cells = written(tmp_path / "cells.xdmf", Elements("", found.points, [found.blocks[1]]))
    with pytest.raises(ValueError, match=r"cells.xdmf has no elements of dimension 1: facets of the mesh are required"):
        read_mesh(MPI.COMM_SELF, cells, facets_path=cells)
    with pytest.raises(ValueError, match=r"suffix of '.*' = '.geo': one of '.msh', '.xdmf' is required"):
        read_mesh(MPI.COMM_SELF, cells, facets_path=tmp_path / "facets.geo")
    with pytest.raises(FileNotFoundError, match=r"facets.msh: there is no such file"):
        read_mesh(MPI.COMM_SELF, cells, facets_path=tmp_path / "facets.msh")
    moved = written(tmp_path / "facets.xdmf", Elements("", found.points + 1e-3, [found.blocks[0]]))
    with pytest.raises(
        ValueError, match=r"facets.xdmf has a facet with a vertex at \[.*\]: a vertex of .*cells.xdmf is req"
    ):
        read_mesh(MPI.COMM_SELF, cells, facets_path=moved)


def test_data_that_could_be_groups_must_be_one(tmp_path):
    meshio = pytest.importorskip("meshio")
    blocks = [("triangle", np.array([[0, 1, 2], [1, 2, 3]]))]
    data = {"a": [np.array([1, 2])], "b": [np.array([1, 2])]}
    meshio.Mesh(SQUARE, blocks, cell_data=data).write(tmp_path / "two.xdmf")
    with pytest.raises(
        ValueError, match=r"two.xdmf has several integer cell data, 'a', 'b': one, or one named 'gmsh:phy"
    ):
        read_mesh(MPI.COMM_SELF, tmp_path / "two.xdmf")


# -- gmsh -------------------------------------------------------------------------------------------------------------


def square(gmsh, *, recombined=False, name=True):
    """Two unit squares side by side, one of them of the group "first"."""
    geo = gmsh.model.geo
    p = [geo.addPoint(x, y, 0.3) for y in (0.0, 1.0) for x in (0.0, 1.0, 2.0)]
    pairs = [(0, 1), (1, 2), (3, 4), (4, 5), (0, 3), (1, 4), (2, 5)]
    line = [geo.addLine(p[a], p[b]) for a, b in pairs]
    loops = [[line[0], line[5], -line[2], -line[4]], [line[1], line[6], -line[3], -line[5]]]
    planes = [geo.addPlaneSurface([geo.addCurveLoop(loop)]) for loop in loops]
    if recombined:
        for curve in line:
            geo.mesh.setTransfiniteCurve(curve, 4)
        for plane in planes:
            geo.mesh.setTransfiniteSurface(plane)
            geo.mesh.setRecombine(2, plane)
    geo.synchronize()
    if name:
        model = gmsh.model
        model.setPhysicalName(1, model.addPhysicalGroup(1, [-line[4]], 3), "inlet")
        model.setPhysicalName(1, model.addPhysicalGroup(1, [line[5]], 4), "middle")
        model.addPhysicalGroup(1, [line[0], line[1]], 8)
        model.setPhysicalName(2, model.addPhysicalGroup(2, planes[:1], 1), "first")
        model.addPhysicalGroup(2, planes[1:], 7)
    gmsh.option.setNumber("Mesh.MeshSizeMax", 0.3)
    return planes


@pytest.mark.mpi
@pytest.mark.parametrize("kind", ["triangle", "quadrilateral"])
def test_a_plane_geometry_of_gmsh_keeps_its_groups(kind):
    pytest.importorskip("gmsh")
    m = from_gmsh(COMM, lambda gmsh: square(gmsh, recombined=kind == "quadrilateral") and None, 2)
    assert compat.cell_name(m.domain) == kind
    assert facet_contents(m) == pytest.approx({"inlet": 1.0, "middle": 1.0, "8": 2.0})
    assert cell_contents(m) == pytest.approx({"first": 1.0, "7": 1.0})
    assert m.inner_facet_names == ("middle",)


def cuboid(gmsh, *, hexahedra):
    geo = gmsh.model.geo
    planes = square(gmsh, recombined=hexahedra, name=False)
    swept = geo.extrude([(2, plane) for plane in planes], 0.0, 0.0, 0.5, [2] if hexahedra else [], recombine=hexahedra)
    geo.synchronize()
    volumes = [tag for dim, tag in swept if dim == 3]
    tops = [swept[i - 1][1] for i, (dim, _) in enumerate(swept) if dim == 3]
    gmsh.model.setPhysicalName(3, gmsh.model.addPhysicalGroup(3, volumes), "all")
    gmsh.model.setPhysicalName(2, gmsh.model.addPhysicalGroup(2, tops), "front")
    gmsh.model.setPhysicalName(2, gmsh.model.addPhysicalGroup(2, planes), "back")


@pytest.mark.mpi
@pytest.mark.parametrize("kind", ["tetrahedron", "hexahedron"])
def test_a_solid_geometry_of_gmsh_keeps_its_groups(kind):
    pytest.importorskip("gmsh")
    m = from_gmsh(COMM, lambda gmsh: cuboid(gmsh, hexahedra=kind == "hexahedron"), 3)
    assert compat.cell_name(m.domain) == kind
    assert facet_contents(m) == pytest.approx({"front": 2.0, "back": 2.0})
    assert cell_contents(m) == pytest.approx({"all": 1.0})


@pytest.mark.mpi
@pytest.mark.parametrize("version", [2.2, 4.1])
@pytest.mark.parametrize("kind", KINDS)
def test_files_of_gmsh_are_read_as_its_models_are(tmp_path, kind, version):
    pytest.importorskip("gmsh")
    pytest.importorskip("meshio")
    path, dim = shared_path(tmp_path) / "mesh.msh", 2 if kind in CELLS[2] else 3

    def build(gmsh):
        if dim == 2:
            square(gmsh, recombined=kind == "quadrilateral")
        else:
            cuboid(gmsh, hexahedra=kind == "hexahedron")
        gmsh.model.mesh.generate(dim)
        gmsh.option.setNumber("Mesh.MshFileVersion", version)
        gmsh.write(str(path))

    m = from_gmsh(COMM, build, dim)
    COMM.barrier()
    again = read_mesh(COMM, path)
    assert facet_contents(again) == pytest.approx(facet_contents(m))
    assert cell_contents(again) == pytest.approx(cell_contents(m))
    assert again.inner_facet_names == m.inner_facet_names
    assert total(compat.owned_cells(again.domain)) == total(compat.owned_cells(m.domain))


GEO = """
SetFactory("OpenCASCADE");
Rectangle(1) = {0, 0, 0, 2, 1};
Disk(2) = {0.6, 0.5, 0, 0.2};
BooleanDifference(3) = { Surface{1}; Delete; }{ Surface{2}; Delete; };
Physical Surface("fluid") = {3};
hole() = Curve In BoundingBox {0.3, 0.2, -1, 0.9, 0.8, 1};
Physical Curve("hole") = {hole()};
Mesh.MeshSizeMax = 0.1;
"""


@pytest.mark.mpi
def test_a_geo_file_is_meshed(tmp_path):
    pytest.importorskip("gmsh")
    path = shared_path(tmp_path) / "scene.geo"
    on_root(COMM, lambda: path.write_text(GEO))
    m = read_mesh(COMM, path)
    around = 2.0 * np.pi * 0.2
    assert facet_contents(m)["hole"] == pytest.approx(around, rel=0.03)
    assert cell_contents(m)["fluid"] == pytest.approx(2.0 - np.pi * 0.04, rel=0.01)
    assert cell_contents(m)["fluid"] == pytest.approx(cell_total(m))


@pytest.mark.mpi
@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("Point(1) = {0, 0, 0}; Line(3 = {1, 2\n", "bad.geo: gmsh makes no mesh of it: .*syntax error"),
        ("", "bad.geo has nothing of dimension 0|bad.geo has no cells"),
        ("Point(1) = {0, 0, 0}; Point(2) = {1, 0, 0}; Line(1) = {1, 2};\n", "bad.geo has no cells"),
        (GEO + "Mesh.ElementOrder = 2;\n", "bad.geo has cells 'triangle 6': linear ones of one kind"),
        (GEO + 'Physical Curve("again") = {hole(0)};\n', "bad.geo has entity .* in groups hole and again: one at most"),
    ],
)
def test_a_bad_geo_file_is_refused_on_all_ranks(tmp_path, text, message):
    pytest.importorskip("gmsh")
    path = shared_path(tmp_path) / "bad.geo"
    on_root(COMM, lambda: path.write_text(text))
    with pytest.raises(ValueError, match=message):
        read_mesh(COMM, path)


@pytest.mark.mpi
def test_gmsh_is_left_as_it_was_found_whatever_happens():
    gmsh = pytest.importorskip("gmsh")

    def broken(gmsh):
        square(gmsh)
        raise LookupError("the script has a mistake")

    def handler(*_):
        """For interrupts."""

    before = signal.signal(signal.SIGINT, handler)
    try:
        for _ in range(2):
            with pytest.raises(LookupError, match="the script has a mistake"):
                from_gmsh(COMM, broken, 2)
            assert signal.getsignal(signal.SIGINT) is handler
        m = from_gmsh(COMM, lambda gmsh: square(gmsh) and None, 2)
        assert signal.getsignal(signal.SIGINT) is handler
    finally:
        signal.signal(signal.SIGINT, before)
    assert cell_total(m) == pytest.approx(2.0)
    if hasattr(gmsh, "isInitialized"):
        assert not gmsh.isInitialized()


def test_gmsh_in_use_is_not_taken_over():
    gmsh = pytest.importorskip("gmsh")
    if not hasattr(gmsh, "isInitialized"):
        pytest.skip("this gmsh does not tell whether it is in use")
    gmsh.initialize([], False, interruptible=False)
    try:
        with pytest.raises(RuntimeError, match=r"gmsh is in use: gmsh.finalize\(\) is required before"):
            from_gmsh(MPI.COMM_SELF, lambda gmsh: square(gmsh) and None, 2)
        assert gmsh.isInitialized()
    finally:
        gmsh.finalize()


@pytest.mark.parametrize(
    ("build", "dim", "message"),
    [
        (square, 1, "dim = 1: one of 2, 3 is required"),
        (square, 3, "the model of build has nothing of dimension 3: a geometry that is synchronized is required"),
        (lambda gmsh: gmsh.model.geo.addPoint(0.0, 0.0, 0.0), 2, "has nothing of dimension 2"),
    ],
)
def test_bad_models_are_refused(build, dim, message):
    pytest.importorskip("gmsh")
    with pytest.raises(ValueError, match=message):
        from_gmsh(MPI.COMM_SELF, build, dim)


# -- the channel with a cylinder --------------------------------------------------------------------------------------


def chords(m, name, radius, angle):
    """Length of the chords that a group has for an arc, and the area between them and the arc, for equal chords."""
    n = total((m.facets(name) < m.domain.topology.index_map(m.domain.topology.dim - 1).size_local).sum())
    return 2.0 * radius * n * np.sin(angle / (2.0 * n)), radius**2 * (angle - n * np.sin(angle / n)) / 2.0


@pytest.mark.mpi
def test_the_channel_has_its_cylinder_and_small_cells_around_it():
    pytest.importorskip("gmsh")
    m = channel_with_cylinder(COMM, size=0.05)
    assert m.facet_names == ("inlet", "outlet", "walls", "cylinder")
    assert (m.cell_names, m.inner_facet_names) == ((), ())
    around, gap = chords(m, "cylinder", 0.05, 2.0 * np.pi)
    lengths = {"inlet": 0.41, "outlet": 0.41, "walls": 4.4, "cylinder": around}
    assert facet_contents(m) == pytest.approx(lengths, rel=1e-4)
    assert cell_total(m) == pytest.approx(2.2 * 0.41 - np.pi * 0.05**2 + gap, rel=1e-6)
    x = compat.cell_vertices(m.domain)
    size, r = np.linalg.norm(x[:, 1] - x[:, 0], axis=1), np.linalg.norm(x.mean(axis=1) - 0.2, axis=1)
    assert size[r < 0.06].max(initial=0.0) < 0.025
    assert size.max() < 0.1
    nodes = compat.facet_nodes(m.domain)[m.facets("cylinder")]
    assert np.linalg.norm(m.domain.geometry.x[nodes][..., :2] - 0.2, axis=-1) == pytest.approx(0.05, rel=1e-10)


@pytest.mark.mpi
def test_flux_out_of_the_channel_is_the_integral_of_the_divergence():
    pytest.importorskip("gmsh")
    m = channel_with_cylinder(COMM, size=0.05, beam=(0.35, 0.02), length=2.5)
    n, F = ufl.FacetNormal(m.domain), ufl.SpatialCoordinate(m.domain) - ufl.as_vector([0.2, 0.2])
    outside = ("inlet", "outlet", "walls", "cylinder", "beam_root")
    assert value(ufl.div(F) * m.dx("fluid", "solid", degree=1)) == pytest.approx(
        value(ufl.dot(F, n) * m.ds(*outside, degree=1)), rel=1e-12
    )


@pytest.mark.mpi
def test_a_rigid_beam_is_no_part_of_the_mesh():
    """Its surface alone is, without the root on the cylinder; the fluid's cells are as many as with an elastic one."""
    pytest.importorskip("gmsh")
    options = dict(size=0.05, beam=(0.35, 0.02), length=2.5)
    rigid, elastic = channel_with_cylinder(COMM, rigid=True, **options), channel_with_cylinder(COMM, **options)
    assert rigid.facet_names == ("inlet", "outlet", "walls", "cylinder", "beam")
    assert rigid.cell_names == rigid.inner_facet_names == ()
    sides, others = facet_contents(rigid), facet_contents(elastic)
    assert sides["beam"] == pytest.approx(others["interface"], rel=1e-12)
    assert sides["cylinder"] == pytest.approx(others["cylinder"], rel=1e-12)
    n, F = ufl.FacetNormal(rigid.domain), ufl.SpatialCoordinate(rigid.domain)
    area = value(ufl.div(F) * rigid.dx(degree=1)) / 2.0
    assert area == pytest.approx(cell_contents(elastic)["fluid"], rel=1e-9)
    assert value(ufl.dot(F, n) * rigid.ds(*rigid.facet_names, degree=1)) == pytest.approx(2.0 * area, rel=1e-12)


@pytest.mark.mpi
def test_the_beam_is_a_part_of_the_mesh_behind_the_cylinder():
    pytest.importorskip("gmsh")
    m = channel_with_cylinder(COMM, size=0.05, beam=(0.35, 0.02), length=2.5)
    assert m.facet_names == ("inlet", "outlet", "walls", "cylinder", "beam_root", "interface")
    assert m.inner_facet_names == ("interface",)
    half = np.arcsin(0.2)
    root = 0.2 + 0.05 * np.cos(half)
    angles = {"cylinder": 2.0 * (np.pi - half), "beam_root": 2.0 * half}
    arcs = {name: chords(m, name, 0.05, angle) for name, angle in angles.items()}
    lengths = {"inlet": 0.41, "outlet": 0.41, "walls": 5.0, "interface": 2.0 * (0.6 - root) + 0.02}
    assert facet_contents(m) == pytest.approx(lengths | {name: arc for name, (arc, _) in arcs.items()}, rel=1e-4)
    areas = cell_contents(m)
    segment = 0.05**2 * (half - np.sin(2.0 * half) / 2.0)
    beam = 0.02 * (0.6 - root) - segment
    assert areas["solid"] == pytest.approx(beam + arcs["beam_root"][1], rel=1e-8)
    gaps = arcs["cylinder"][1] + arcs["beam_root"][1]
    assert sum(areas.values()) == pytest.approx(2.5 * 0.41 - np.pi * 0.05**2 + gaps, rel=1e-6)
    x = compat.cell_vertices(m.domain).mean(axis=1)
    inside = (abs(x[:, 1] - 0.2) < 0.01) & (x[:, 0] > 0.2) & (x[:, 0] < 0.6)
    assert np.array_equal(np.flatnonzero(inside), m.cells("solid"))
    link = compat.connectivity(m.domain, 1, 2)
    cells = [set(link.links(facet)) for facet in m.facets("interface")]
    solid = set(m.cells("solid"))
    assert all(len(pair & solid) == 1 for pair in cells if len(pair) == 2)
    assert total(sum(len(pair) == 2 for pair in cells)) >= total(sum(len(pair) == 1 for pair in cells))
    nodes = np.unique(compat.facet_nodes(m.domain)[m.facets("interface")])
    corners = total(np.isclose(m.domain.geometry.x[nodes][:, :2], (0.6, 0.19)).all(axis=1).sum())
    assert corners >= 1


@pytest.mark.mpi
def test_the_channel_with_a_depth_is_made_of_tetrahedra():
    pytest.importorskip("gmsh")
    m = channel_with_cylinder(COMM, size=0.1, cylinder_size=0.03, beam=(0.35, 0.02), depth=0.2, length=1.0)
    plane = channel_with_cylinder(COMM, size=0.1, cylinder_size=0.03, beam=(0.35, 0.02), length=1.0)
    wanted = {name: 0.2 * length for name, length in facet_contents(plane).items()}
    assert facet_contents(m) == pytest.approx(wanted | {"back": cell_total(plane), "front": cell_total(plane)})
    assert cell_contents(m) == pytest.approx({name: 0.2 * area for name, area in cell_contents(plane).items()})
    assert m.inner_facet_names == ("interface",)


@pytest.mark.parametrize("cell", ["triangle", "quadrilateral"])
@pytest.mark.parametrize(
    "beam",
    [{}, {"beam": (0.35, 0.02), "length": 2.5}, {"beam": (0.35, 0.02), "length": 2.5, "rigid": True}],
    ids=["cylinder", "beam", "rigid"],
)
def test_a_polygon_of_equal_area_has_that_of_the_circle(cell, beam):
    """What the cylinder takes of the channel, and nothing else has moved: with a beam not its root's ends either."""
    pytest.importorskip("gmsh")
    plain, equal = (
        channel_with_cylinder(MPI.COMM_SELF, size=0.05, cell=cell, equal_area=on, **beam) for on in (False, True)
    )
    half = np.arcsin(0.2)
    beam_area = 0.02 * (0.35 + 0.05 - 0.05 * np.cos(half)) - 0.05**2 * (half - np.sin(2.0 * half) / 2.0)
    disc = np.pi * 0.05**2 + (beam_area if "rigid" in beam else 0.0)
    assert compat.cell_name(equal.domain) == cell
    assert cell_total(equal) == pytest.approx(beam.get("length", 2.2) * 0.41 - disc, rel=1e-12)
    assert cell_total(plain) - cell_total(equal) > 0.005 * np.pi * 0.05**2
    x, y = (m.domain.geometry.x for m in (plain, equal))
    moved = np.linalg.norm(y - x, axis=1) > 1e-12
    assert np.linalg.norm(x[moved, :2] - 0.2, axis=1) == pytest.approx(0.05, rel=1e-10)
    assert np.linalg.norm(y[moved, :2] - 0.2, axis=1).max(initial=0.05) < 1.02 * 0.05
    for name in {"interface", "beam"} & set(plain.facet_names):
        assert facet_contents(equal)[name] == pytest.approx(facet_contents(plain)[name], rel=1e-12)


@pytest.mark.mpi
def test_the_channel_of_quadrilaterals_has_its_groups_with_a_depth_as_well():
    pytest.importorskip("gmsh")
    given = dict(size=0.1, cylinder_size=0.03, beam=(0.35, 0.02), length=1.0, cell="quadrilateral")
    plane, m = channel_with_cylinder(COMM, **given), channel_with_cylinder(COMM, **given, depth=0.2)
    assert compat.cell_name(m.domain) == "hexahedron"
    found = facet_contents(m)
    ends = [total(len(m.facets(name))) >= total(compat.owned_cells(plane.domain)) for name in ("back", "front")]
    sides = {name: found[name] for name in plane.facet_names}
    assert all(ends)
    assert sides == pytest.approx({name: 0.2 * length for name, length in facet_contents(plane).items()})
    x, owned = compat.cell_vertices(m.domain), compat.owned_cells(m.domain)
    assert np.allclose(np.diff(x[..., 2].reshape(-1, 2, 4).mean(axis=2)), 0.1)
    for name, area in cell_contents(plane).items():
        cells = m.cells(name)[m.cells(name) < owned]
        assert total(content(x[cells, :4, :2])) == pytest.approx(2.0 * area)
    assert plane.inner_facet_names == m.inner_facet_names == ("interface",)


def test_the_wake_is_refined_on_demand():
    pytest.importorskip("gmsh")
    counts = []
    for wake in (None, 0.02):
        m = channel_with_cylinder(MPI.COMM_SELF, size=0.05, wake_size=wake)
        x = compat.cell_vertices(m.domain).mean(axis=1)
        counts.append(((x[:, 0] > 1.0) & (abs(x[:, 1] - 0.2) < 0.1)).sum())
    assert counts[1] > 4 * counts[0]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"length": 0.0}, "length = 0.0: a number > 0 is required"),
        ({"height": np.nan}, "height = nan: a finite number is required"),
        ({"radius": -1.0}, "radius = -1.0: a number > 0 is required"),
        ({"size": 0.0}, "size = 0.0: a number > 0 is required"),
        ({"cell": "hexahedron"}, "cell = 'hexahedron': one of 'triangle', 'quadrilateral' is required"),
        ({"depth": 0.0}, "depth = 0.0: a number > 0 is required"),
        ({"center": (0.2, 0.04)}, r"center = \(0.2, 0.04\): a cylinder of radius 0.05 within the channel is required"),
        ({"center": (0.2, 0.2, 0.2)}, r"center has shape \(3,\): shape \(2\) is required"),
        ({"cylinder_size": 0.1}, "cylinder_size = 0.1: a number up to size = 0.02 is required"),
        ({"wake_size": -0.1}, "wake_size = -0.1: a number > 0 is required"),
        (
            {"beam": (1.95, 0.02)},
            r"beam = \(1.95, 0.02\): a length in \(0, 1.95\) and a thickness in \(0, 0.1\) are req",
        ),
        ({"beam": (0.35, 0.1)}, r"beam = \(0.35, 0.1\): a length in \(0, 1.95\) and a thickness in \(0, 0.1\) are req"),
        ({"rigid": True}, "rigid = True with beam = None: a beam's length"),
        ({"rigid": "yes"}, "rigid = 'yes': True or False is required"),
        ({"beam": 0.35}, r"beam has shape \(\): shape \(2\) is required"),
    ],
)
def test_a_channel_that_cannot_be_is_refused_before_gmsh_is_asked(change, message):
    with pytest.raises(ValueError, match=message):
        channel_with_cylinder(MPI.COMM_SELF, **change)


def test_meshes_need_neither_gmsh_nor_meshio():
    assert not {"gmsh", "meshio"} & set(vars(mesh_files)) | {"gmsh", "meshio"} & set(vars(mesh_elements))
