"""What the compatibility layer adds to dolfinx: interpolation, basis functions, nodes, points and facets."""

import numpy as np
import pytest
import ufl
from mpi4py import MPI
from dolfinx import fem, mesh
from flows import grid

from tigar_x import compat
from tigar_x.compat import forms, spaces

COMM = MPI.COMM_WORLD
CELLS = ["triangle", "quadrilateral", "tetrahedron", "hexahedron"]


def coordinates(V):
    return V.tabulate_dof_coordinates()[:, : V.mesh.geometry.dim]


# -- interpolation ----------------------------------------------------------------------------------------------------


@pytest.mark.mpi
@pytest.mark.parametrize(
    ("expression", "value"),
    [(ufl.as_vector([1.5, -2.0]), (1.5, -2.0)), (ufl.as_vector([ufl.sqrt(4.0), 0.0 * ufl.as_ufl(3)]), (2.0, 0.0))],
)
def test_interpolation_of_numbers(expression, value):
    """There is nothing to compile in them."""
    V = compat.lagrange_space(grid("triangle"), 2, 2)
    f = fem.Function(V)
    before = compat.compile_seconds()
    compat.interpolate(f, expression)
    assert compat.compile_seconds() == before
    np.testing.assert_array_equal(f.x.array.reshape(-1, 2), np.broadcast_to(value, (len(f.x.array) // 2, 2)))


@pytest.mark.mpi
def test_interpolation_of_a_number_into_a_scalar_space():
    f = fem.Function(compat.lagrange_space(grid("triangle"), 1))
    compat.interpolate(f, ufl.as_ufl(2.5))
    np.testing.assert_array_equal(f.x.array, 2.5)


@pytest.mark.mpi
@pytest.mark.parametrize("cell", CELLS)
def test_interpolation_of_what_a_space_contains(cell):
    domain = grid(cell, 2)
    V = compat.lagrange_space(domain, 2, 2)
    x, f = ufl.SpatialCoordinate(domain), fem.Function(V)
    compat.interpolate(f, ufl.as_vector([x[0] ** 2 - x[1], x[0] * x[1]]))
    X = coordinates(V)
    expected = np.column_stack([X[:, 0] ** 2 - X[:, 1], X[:, 0] * X[:, 1]])
    np.testing.assert_allclose(f.x.array.reshape(-1, 2), expected, atol=1e-15)


@pytest.mark.mpi
def test_interpolation_is_repeated_with_what_is_then_in_it():
    domain = grid("triangle")
    V = compat.lagrange_space(domain, 1)
    f, g, c = fem.Function(V), fem.Function(V), fem.Constant(domain, 2.0)
    again = compat.Interpolation(f, c * g + ufl.SpatialCoordinate(domain)[0])
    for factor, value in ((2.0, 1.0), (3.0, -1.0)):
        c.value = factor
        g.x.array[:] = value
        before = compat.compile_seconds()
        again()
        assert compat.compile_seconds() == before
        np.testing.assert_allclose(f.x.array, factor * value + coordinates(V)[:, 0], atol=1e-15)


@pytest.mark.mpi
def test_interpolation_in_some_cells():
    """The nodes of the others stay what they were."""
    domain = grid("triangle", 4)
    V = compat.lagrange_space(domain, 1)
    f, x = fem.Function(V), ufl.SpatialCoordinate(domain)
    cells = mesh.locate_entities(domain, 2, lambda x: x[0] < 0.501)
    f.x.array[:] = 7.0
    compat.Interpolation(f, x[1] + 1, cells)()
    X = coordinates(V)
    low = X[:, 0] < 0.501
    np.testing.assert_allclose(f.x.array[low], X[low, 1] + 1, atol=1e-15)
    np.testing.assert_array_equal(f.x.array[~low], 7.0)


@pytest.mark.mpi
def test_interpolation_of_numbers_in_some_cells():
    domain = grid("triangle", 4)
    V = compat.lagrange_space(domain, 1)
    f = fem.Function(V)
    cells = mesh.locate_entities(domain, 2, lambda x: x[0] < 0.501)
    compat.Interpolation(f, ufl.as_ufl(3.0), cells)()
    low = coordinates(V)[:, 0] < 0.501
    np.testing.assert_array_equal(f.x.array[low], 3.0)
    np.testing.assert_array_equal(f.x.array[~low], 0.0)


@pytest.mark.parametrize("expression", [ufl.as_vector([1.0, 2.0, 3.0]), ufl.as_ufl(1.0)])
def test_numbers_of_a_wrong_shape(expression):
    """As an expression of coordinates they are refused."""
    f = fem.Function(compat.lagrange_space(grid("triangle", 2), 1, 2))
    with pytest.raises((ValueError, RuntimeError)):
        compat.interpolate(f, expression)


# -- basis functions --------------------------------------------------------------------------------------------------


def inside(cell, n=5):
    """Random reference points."""
    d = 3 if cell in ("tetrahedron", "hexahedron") else 2
    points = np.random.default_rng(1).uniform(0.05, 0.9, (n, d))
    return points / (1 + points.sum(axis=1, keepdims=True)) if cell in ("triangle", "tetrahedron") else points


@pytest.mark.parametrize("degree", [1, 2, 3])
@pytest.mark.parametrize("cell", CELLS)
def test_gradients_of_basis_functions(cell, degree):
    """Central differences of the functions; they add up to nothing; a blocked space has those of its components."""
    domain, points = grid(cell, 1), inside(cell)
    V = compat.lagrange_space(domain, degree)
    d = points.shape[1]
    gradients = compat.tabulate_gradients(V, points)
    assert gradients.shape == (len(points), compat.cell_dofs(V).shape[1], d)
    h = 1e-5
    for i, step in enumerate(h * np.eye(d)):
        slope = (compat.tabulate(V, points + step) - compat.tabulate(V, points - step)) / (2 * h)
        np.testing.assert_allclose(gradients[:, :, i], slope, atol=1e-8)
    np.testing.assert_allclose(gradients.sum(axis=1), 0.0, atol=1e-12)
    nodes = compat.node_points(V)
    np.testing.assert_allclose(
        np.einsum("pnj,ni->pij", gradients, nodes), np.broadcast_to(np.eye(d), (5, d, d)), atol=1e-12
    )
    blocked = compat.lagrange_space(domain, degree, 3)
    np.testing.assert_array_equal(compat.tabulate_gradients(blocked, points), gradients)
    assert compat.lagrange_degree(V) == compat.lagrange_degree(blocked) == degree


@pytest.mark.parametrize("cell", CELLS)
def test_basis_functions_are_one_at_their_node(cell):
    V = compat.lagrange_space(grid(cell, 1), 2)
    np.testing.assert_allclose(
        compat.tabulate(V, compat.node_points(V)), np.eye(len(compat.node_points(V))), atol=1e-13
    )


# -- points -----------------------------------------------------------------------------------------------------------


@pytest.mark.mpi
@pytest.mark.parametrize("cell", CELLS)
def test_cells_of_points(cell):
    """Every point of the mesh has a cell on some rank, and it contains the point; others have none anywhere."""
    domain = grid(cell, 4)
    d = domain.geometry.dim
    rng = np.random.default_rng(2)
    points = np.vstack([rng.uniform(0, 1, (20, d)), np.zeros(d), np.ones(d), np.full(d, 0.5)])
    cells = compat.cells_of_points(domain, points)
    assert cells.dtype == np.int32
    assert (np.max(COMM.allgather(cells), axis=0) >= 0).all()
    mine = cells >= 0
    assert (cells < compat.owned_cells(domain)).all()
    corners = compat.cell_vertices(domain)[cells[mine]]
    assert (points[mine] >= corners.min(axis=1) - 1e-12).all()
    assert (points[mine] <= corners.max(axis=1) + 1e-12).all()
    outside = np.vstack([np.full(d, 1.01), np.full(d, -1e-3), np.full(d, 50.0), [0.5] * (d - 1) + [1.1]])
    np.testing.assert_array_equal(compat.cells_of_points(domain, outside), -1)
    assert compat.cells_of_points(domain, np.zeros((0, d))).shape == (0,)


# -- facets and nodes -------------------------------------------------------------------------------------------------


@pytest.mark.mpi
@pytest.mark.parametrize("cell", CELLS)
def test_facets_of_the_boundary(cell):
    """Those of this rank and those it knows of others, all of whose vertices lie on one side."""
    domain = grid(cell, 2)
    d, facets = domain.geometry.dim, compat.exterior_facets(domain)
    x = domain.geometry.x[compat.facet_nodes(domain)][..., :d]
    on_side = (np.isclose(x, 0.0) | np.isclose(x, 0.5)).all(axis=1) & (np.ptp(x, axis=1) < 1e-12)
    np.testing.assert_array_equal(facets, np.flatnonzero(on_side.any(axis=1)))
    owned = facets[facets < domain.topology.index_map(d - 1).size_local]
    count = {"triangle": 8, "quadrilateral": 8, "tetrahedron": 48, "hexahedron": 24}[cell]
    assert COMM.allreduce(len(owned), op=MPI.SUM) == count


@pytest.mark.mpi
@pytest.mark.parametrize("degree", [1, 2])
def test_nodes_on_facets(degree):
    """On every rank that has them, whether it has the facet or not."""
    domain = grid("triangle", 4)
    V = compat.lagrange_space(domain, degree, 2)
    facets = mesh.locate_entities_boundary(domain, 1, lambda x: np.isclose(x[0], 0.0))
    found = compat.nodes_on_facets(V, facets)
    np.testing.assert_array_equal(found, np.flatnonzero(np.isclose(coordinates(V)[:, 0], 0.0)))


@pytest.mark.mpi
def test_strong_conditions_on_components():
    """Prescribed on facets, held at nodes, and fixed at dofs."""
    domain = grid("triangle", 2)
    V = compat.lagrange_space(domain, 1, 3)
    x = coordinates(V)
    left = np.isclose(x[:, 0], 0.0)
    facets = mesh.locate_entities_boundary(domain, 1, lambda x: np.isclose(x[0], 0.0))
    values, prescribed = compat.prescribed_component(V, 1, facets)
    assert not values.x.array.any()
    compat.interpolate(values, ufl.SpatialCoordinate(domain)[1] + 3)
    held = compat.fixed_nodes(V, np.flatnonzero(left).astype(np.int32))
    fixed = compat.fixed_component(V, 2, 3 * np.flatnonzero(left) + 2)
    expected = {
        (prescribed,): [(1, x[left, 1] + 3)],
        (held,): [(0, 0.0), (1, 0.0), (2, 0.0)],
        (fixed,): [(2, 0.0)],
        (held, prescribed): [(0, 0.0), (1, x[left, 1] + 3), (2, 0.0)],
    }
    for bcs, components in expected.items():
        f = fem.Function(V)
        f.x.array[:] = 9.0
        compat.apply_values(f, bcs)
        u = np.full_like(x, 9.0, shape=(len(x), 3))
        for i, value in components:
            u[left, i] = value
        np.testing.assert_allclose(f.x.array.reshape(-1, 3), u, atol=1e-15)
        dofs = np.flatnonzero((u != 9.0).ravel())
        np.testing.assert_array_equal(compat.constrained_dofs(bcs), dofs)


@pytest.mark.mpi
def test_ghosts_are_added_to_their_owners():
    """Every rank counts its own cells at every node: in all, the number of cells around it."""
    domain = grid("quadrilateral", 3)
    V = compat.lagrange_space(domain, 1)
    f = fem.Function(V)
    np.add.at(f.x.array, compat.cell_dofs(V)[: compat.owned_cells(domain)], 1.0)
    compat.accumulate(f)
    x = coordinates(V)
    edges = np.isclose(x, 0.0) | np.isclose(x, 0.75)
    np.testing.assert_array_equal(f.x.array, 4.0 / 2 ** edges.sum(axis=1))


# -- compiled forms ---------------------------------------------------------------------------------------------------


def test_forms_that_were_compiled():
    domain = grid("triangle", 1)
    V = compat.lagrange_space(domain, 1)
    u, v = fem.Function(V, name="u"), ufl.TestFunction(V)
    before = len(compat.compiled_forms())
    k = fem.Constant(domain, 2.0)
    compat.compile_forms(k * u * v * ufl.dx + v * ufl.ds, u * ufl.dx)
    residual, functional = compat.compiled_forms()[before:]
    assert (residual.arguments, residual.cell, residual.dimension) == (1, "triangle", 2)
    assert (residual.integrals, residual.coefficients, residual.constants) == (("cell", "exterior_facet"), ("u",), 1)
    assert (functional.arguments, functional.integrals, functional.constants) == (0, ("cell",), 0)
    assert residual.seconds > 0.0


@pytest.mark.mpi
@pytest.mark.parametrize("name", ["blocked", "mixed"])
def test_components_where_a_rank_has_no_cell(name, monkeypatch):
    """Numbered by hand there: the same nodes as dolfinx has."""
    domain = grid("triangle")
    V = (
        compat.lagrange_space(domain, 2, 3)
        if name == "blocked"
        else compat.mixed_lagrange_space(domain, (2, 2), (1, 1))
    )
    for component in range(3):
        expected, parent = compat.component_space(V, component)
        with monkeypatch.context() as patch:
            patch.setattr(spaces, "_some_rank_is_empty", lambda _: True)
            found, rows = compat.component_space(V, component)
        place = dict(zip(parent.tolist(), expected.tabulate_dof_coordinates().tolist(), strict=True))
        assert sorted(rows) == sorted(parent)
        np.testing.assert_allclose(found.tabulate_dof_coordinates(), [place[row] for row in rows.tolist()], atol=1e-14)


def pressed(space):
    """Residual of a flow-like system, with divisions and roots."""
    x, test = fem.Function(space), ufl.TestFunction(space)
    x.interpolate(lambda X: np.stack([np.sin((k + 1.0) * X[0] + X[1]) for k in range(space.dofmap.index_map_bs)]))
    u, v = x[0] * ufl.grad(x[1]), ufl.grad(test[0])
    return x, (ufl.dot(u, v) / ufl.sqrt(1.0 + ufl.dot(u, u)) + x[2] * x[1] * test[1] + x[3] * v[0]) * ufl.dx


@pytest.mark.mpi
def test_flags_of_forms_in_tetrahedra_change_rounding_alone(monkeypatch):
    given = []
    compile_one = fem.form

    def noted(form, **options):
        given.append(next(iter(options.values()))["cffi_extra_compile_args"])
        return compile_one(form, **options)

    for cell, more in (("tetrahedron", forms.UNFUSED), ("triangle", [])):
        space = compat.lagrange_space(grid(cell), 1, 4)
        x, residual = pressed(space)
        monkeypatch.setattr(forms.fem, "form", noted)
        (made,) = compat.compile_forms(residual)
        monkeypatch.undo()
        assert given.pop() == [*compat.C_FLAGS, *more]
        plain, unfused = np.zeros((2, len(x.x.array)))
        compat.add_vector(unfused, made)
        compat.add_vector(plain, compile_one(residual, **forms.JIT))
        np.testing.assert_allclose(unfused, plain, rtol=0.0, atol=1e-14 * np.abs(plain).max())
