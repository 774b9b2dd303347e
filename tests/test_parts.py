"""Forms that are confined to some of their cells without another compilation."""

import numpy as np
import pytest
import ufl
from mpi4py import MPI
from dolfinx import fem

from tigar_x import compat
from tigar_x.compat import algebra
from tigar_x.fem.linear import direct, gmres_ilu
from tigar_x.fem.solve import FiniteElementSystem
from varmint.mesh.named import box

pytestmark = pytest.mark.mpi


def scene():
    """A square with two groups of facets, a function, a Constant, and a form of cells and facets."""
    mesh = box(MPI.COMM_WORLD, (0.0, 0.0), (1.0, 1.0), (5, 5))
    domain = mesh.domain
    V = compat.lagrange_space(domain, 1, 3)
    u, c = fem.Function(V, name="u"), compat.Constant(domain, 2.0)
    u.x.array[:] = 1.0
    w = ufl.TestFunction(V)
    cells = c * ufl.inner(u, w) * mesh.dx(degree=2)
    facets = u[0] * w[0] * mesh.ds("left", degree=2) + 3 * u[1] * w[1] * mesh.ds("left", "right", "bottom", degree=2)
    return domain, mesh, u, c, cells, facets


def total(form, V):
    b = compat.create_vector(V)
    compat.assemble_vector(b, form)
    with b.localForm() as local:
        return V.mesh.comm.allreduce(float(local.array_r.sum()), op=MPI.SUM)


def middles(domain):
    return compat.cell_vertices(domain).mean(axis=1)


def test_cells_alone_are_integrated_over():
    domain, _, u, c, cells, _ = scene()
    form, V = compat.PartialForm(cells), u.function_space
    x = middles(domain)
    below = x[:, 1] < 0.4  # two of five rows
    np.testing.assert_allclose(total(form.on(below), V), 2.0 * 3 * 0.4, rtol=1e-13)
    np.testing.assert_allclose(total(form.on(~below), V), 2.0 * 3 * 0.6, rtol=1e-13)
    c.value = 5.0
    np.testing.assert_allclose(total(form.on(below), V), 5.0 * 3 * 0.4, rtol=1e-13)
    assert total(form.on(np.zeros_like(below)), V) == 0.0


def test_facets_follow_their_cells_and_keep_their_groups():
    domain, _, u, _, cells, facets = scene()
    form, V = compat.PartialForm(cells + facets), u.function_space
    u.x.array[compat.component_space(V, 2)[1]] = 0.0
    below = middles(domain)[:, 1] < 0.4
    np.testing.assert_allclose(total(form.on(below), V), 2.0 * 2 * 0.4 + 0.4 + 3 * (0.4 + 0.4 + 1.0), rtol=1e-13)
    np.testing.assert_allclose(total(form.on(~below), V), 2.0 * 2 * 0.6 + 0.6 + 3 * (0.6 + 0.6), rtol=1e-13)


def test_parts_sum_to_the_whole_and_compile_nothing():
    domain, _, u, _, cells, facets = scene()
    tangent = compat.PartialForm(ufl.derivative(cells + facets, u))
    A, B = compat.create_matrix(tangent.whole, "aij"), compat.create_matrix(tangent.whole, "aij")
    compat.assemble_matrix(A, tangent.whole)
    A.assemble()
    chosen = np.random.default_rng(1).random(len(middles(domain))) < 0.3
    before = len(compat.compiled_forms())
    for mask in (chosen, ~chosen):
        part = A.duplicate()
        compat.assemble_matrix(part, tangent.on(mask))
        part.assemble()
        B.assemble()
        B.axpy(1.0, part)
    assert len(compat.compiled_forms()) == before
    assert A.norm() > 0.1
    B.axpy(-1.0, A)
    assert B.norm() < 1e-14


@pytest.mark.parametrize("kind", ["aij", "baij"])
def test_tangents_of_several_ranks_are_those_of_all_cells(kind):
    """Cells inside of a rank go into its own block, beside what is there, and prescribed rows have ones alone."""
    domain, _, u, _, cells, facets = scene()
    V, tangent = u.function_space, compat.PartialForm(ufl.derivative(cells + facets, u))
    bcs = [compat.fixed_nodes(V, compat.nodes_on_facets(V, compat.exterior_facets(domain)))]
    whole, parts = (compat.create_matrix(tangent.whole, kind) for _ in range(2))
    split = tangent.on(np.ones(len(middles(domain)), dtype=bool))
    for _ in range(2):  # the second time with a pattern that is there
        for A, form in ((whole, tangent.whole), (parts, split)):
            compat.assemble_matrix(A, form, bcs)
            A.assemble()
        assert whole.norm() > 0.1
        difference = parts.copy()
        difference.axpy(-1.0, whole)
        assert difference.norm() < 1e-14


def test_cells_inside_of_a_rank_send_nothing(monkeypatch):
    """They are inserted into a matrix of this rank alone, and cells at the border of others are summed before."""
    domain, _, u, _, cells, _ = scene()
    V, comm = u.function_space, domain.comm
    form = compat.PartialForm(ufl.derivative(cells, u)).on(np.ones(len(middles(domain)), dtype=bool))
    A = compat.create_matrix(compat.PartialForm(ufl.derivative(cells, u)).whole, "baij")
    compat.assemble_matrix(A, form)
    A.assemble()
    if comm.size == 1:
        assert not isinstance(form, compat.SplitForm)
        return
    inside = int((compat.cell_dofs(V)[: compat.owned_cells(domain)] < V.dofmap.index_map.size_local).all(axis=1).sum())
    assert 0 < comm.allreduce(inside) < comm.allreduce(compat.owned_cells(domain))
    into, assemble = [], algebra.petsc.assemble_matrix

    def noted(matrix, part, *rest):
        into.append((matrix.comm.size, part))
        return assemble(matrix, part, *rest)

    monkeypatch.setattr(algebra.petsc, "assemble_matrix", noted)
    compat.add_matrix(A, form)
    assert into == [(1, form.inside), (1, form.border)]


@pytest.mark.parametrize("kind", ["aij", "baij"])
def test_systems_in_space_split_their_tangents_on_several_ranks(kind):
    """And have the same tangent."""
    domain = box(MPI.COMM_WORLD, (0.0, 0.0, 0.0), (1.0, 1.0, 1.0), (4, 3, 3)).domain
    V = compat.lagrange_space(domain, 1, 2)
    u, w = fem.Function(V), ufl.TestFunction(V)
    u.x.array[:] = 1.0
    residual = ((1 + u[0] ** 2) * ufl.inner(ufl.grad(u), ufl.grad(w)) + u[1] * w[0]) * ufl.dx(degree=2)
    bcs = [compat.pin_component(V, 1, lambda x: x[0] < 0.1)]
    system = FiniteElementSystem(residual, u, bcs, solver=direct() if kind == "aij" else gmres_ilu(1))
    assert isinstance(system._tangent, compat.SplitForm) is (domain.comm.size > 1)
    (form,) = compat.compile_forms(ufl.derivative(residual, u))
    A = compat.create_matrix(form, kind)
    compat.assemble_matrix(A, form, bcs)
    A.assemble()
    for _ in range(2):
        system.assemble_tangent()
        difference = system.A.copy()
        difference.axpy(-1.0, A)
        assert difference.norm() < 1e-13 * A.norm()


def test_what_cannot_be_confined_is_refused():
    mesh = box(MPI.COMM_WORLD, (0.0, 0.0), (1.0, 1.0), (3, 3))
    V = compat.lagrange_space(mesh.domain, 1)
    u, w = fem.Function(V), ufl.TestFunction(V)
    with pytest.raises(ValueError, match="interior_facet"):
        compat.PartialForm(ufl.avg(u) * ufl.avg(w) * ufl.dS(domain=mesh.domain))
    with pytest.raises(ValueError, match="tags are required"):
        compat.PartialForm(u * w * mesh.ds(degree=2))
