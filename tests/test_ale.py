"""Forms on a moved mesh: those that are pulled back are those of the mesh that lies there."""

from itertools import permutations

import numpy as np
import pytest
import ufl
from mpi4py import MPI
from dolfinx import fem
from flows import DT, MU, RHO, Flow, assembled, moved_to, randomise, slope_error

from tigar_x import compat
from varmint.forms import ale
from varmint.forms.ale import Motion
from varmint.forms.boundary import stable_neumann, weak_dirichlet, weak_slip
from varmint.forms.vms import element_metric, interior_residual, momentum_residual

KINDS = [("triangle", 1), ("triangle", 2), ("quadrilateral", 1), ("tetrahedron", 1)]


class Moving(Flow):
    """A random flow on a mesh with a random displacement and velocity."""

    def __init__(self, cell="triangle", degree=1, n=2):
        super().__init__(cell, degree, n)
        vertices = compat.lagrange_space(self.mesh, 1, self.d)
        self.displacement, self.velocity = fem.Function(vertices), fem.Function(vertices)
        randomise(self.displacement, 5)
        self.displacement.x.array[:] *= 0.05
        randomise(self.velocity, 6)
        self.motion = Motion(self.mesh, self.displacement, self.velocity)
        self.held = Motion(self.mesh, fem.Function(vertices), self.velocity)  # no displacement, the same velocity

    def measures(self, degree=4):
        metadata = {"quadrature_degree": degree}
        return ufl.dx(domain=self.mesh, metadata=metadata), ufl.ds(domain=self.mesh, metadata=metadata)

    def assemble_moved(self, form):
        """The same vector on the mesh that lies where the motion brings it."""
        (compiled,) = compat.compile_forms(form)
        with moved_to(self.mesh, self.displacement):
            return assembled(compiled, self.V)


def terms(m, motion, invariant):
    """Every residual with a motion, by name."""
    _, ds = m.measures()
    g = m.constant(np.arange(1.0, m.d + 1))
    common = dict(motion=motion, rho=RHO)
    unsteady = dict(v_t=m.v_t, dt=DT, f=ufl.sin(m.d * ale.position(m.mesh, motion)[0]) * g)
    edge = (m.v, m.p, m.w, m.q)
    return {
        "interior": m.residual(motion=motion, invariant=invariant, **unsteady),
        "weak_dirichlet": weak_dirichlet(*edge, g, m.mesh, ds, mu=MU, invariant=invariant, **common),
        "weak_slip": weak_slip(*edge, m.mesh, ds, mu=MU, invariant=invariant, **common),
        "stable_neumann": stable_neumann(m.v, m.w, m.mesh, ds, traction=g, g=2 * g, **common),
    }


@pytest.mark.mpi
@pytest.mark.parametrize("invariant", [False, True])
@pytest.mark.parametrize(("cell", "degree"), KINDS)
def test_residuals_are_those_of_the_mesh_where_it_lies(cell, degree, invariant):
    """Second derivatives, metrics, areas, normals and the inflow's direction with them; unmoved, they are others."""
    m = Moving(cell, degree)
    pulled_back, there = terms(m, m.motion, invariant), terms(m, m.held, invariant)
    for name, form in pulled_back.items():
        found, expected, unmoved = m.assemble(form), m.assemble_moved(there[name]), m.assemble(there[name])
        assert (found - expected).norm() < 1e-11 * expected.norm(), name
        assert (unmoved - expected).norm() > 1e-2 * expected.norm(), name


@pytest.mark.mpi
def test_the_residual_of_a_moved_mesh_of_degree_two():
    """A linear displacement in the quadratic space; what vanishes on linear simplices is in the form, and vanishes."""
    m = Moving()
    quadratic = fem.Function(compat.lagrange_space(m.mesh, 2, 2))
    quadratic.interpolate(m.displacement)
    quadratic.x.scatter_forward()
    options = dict(v_t=m.v_t, dt=DT, quadrature_degree=4)
    found = m.assemble(m.residual(motion=Motion(m.mesh, quadratic, m.velocity, 2), **options))
    expected = m.assemble(m.residual(motion=m.motion, **options))
    assert (found - expected).norm() < 1e-12 * expected.norm()


def curved(x):
    """A smooth displacement that no mesh of straight edges has."""
    return ufl.as_vector([0.2 * x[1] ** 2 + 0.1 * x[0] * x[1], 0.3 * ufl.sin(x[0]) - 0.1 * x[1]])


def integral(form):
    return compat.assemble_scalar(compat.compile_forms(form)[0])


@pytest.mark.mpi
def test_derivatives_by_the_present_coordinates():
    """The chain rule, twice: fields of the present coordinates, on a curved mesh, have their own derivatives."""
    flow = Flow("triangle", n=2)
    motion = Motion(flow.mesh, curved(flow.x), flow.constant([0.0, 0.0]), 2)
    X = ale.position(flow.mesh, motion)
    v = ufl.as_vector([X[0] ** 2 * X[1], ufl.cos(X[1]) - X[0]])
    grad = ufl.as_matrix([[2 * X[0] * X[1], X[0] ** 2], [-1.0, -ufl.sin(X[1])]])
    twice = ufl.as_vector([4 * X[1], -ufl.cos(X[1]) * 2 + 2 * X[0]])  # div (grad v + grad v^T)
    errors = [
        ale.gradient(v, motion) - grad,
        ale.divergence(v, motion) - ufl.tr(grad),
        ale.divergence(2 * ufl.sym(ale.gradient(v, motion)), motion) - twice,
        ale.gradient(v, None) - grad,
    ]
    found = [integral(ufl.inner(error, error) * ufl.dx(domain=flow.mesh, degree=6)) for error in errors]
    assert max(found[:3]) < 1e-24
    assert found[3] > 1e-3


@pytest.mark.mpi
@pytest.mark.parametrize("simple", [False, True])
def test_an_exact_solution_leaves_no_strong_residual_on_a_curved_mesh(simple):
    """The viscous part may be left out on straight linear simplices alone."""
    flow = Flow("triangle", n=2)
    motion = Motion(flow.mesh, curved(flow.x), flow.constant([0.4, -0.3]), 2)
    X, V = ale.position(flow.mesh, motion), flow.constant([0.4, -0.3])
    v, p = ufl.as_vector([X[1] ** 2, X[0] * X[0] + X[0]]), X[0] * X[1]
    grad = ufl.as_matrix([[0.0, 2 * X[1]], [2 * X[0] + 1, 0.0]])
    f = grad * (v - V) + (ufl.as_vector([X[1], X[0]]) - MU * ufl.as_vector([2.0, 2.0])) / RHO
    r = momentum_residual(v, p, rho=RHO, mu=MU, linear_simplex=simple, f=f, motion=motion)
    found = integral(ufl.inner(r, r) * ufl.dx(domain=flow.mesh, degree=6))
    assert (found < 1e-24) is not simple


@pytest.mark.mpi
@pytest.mark.parametrize("degree", [1, 2])
def test_an_exact_solution_on_a_curved_mesh_leaves_no_residual(degree):
    """In the interior and at the boundary, to the quadrature; if the displacement counts as linear, it does."""
    flow = Flow("triangle", n=2)
    V = flow.constant([0.4, -0.3])
    motion = Motion(flow.mesh, curved(flow.x), V, degree)
    X = ale.position(flow.mesh, motion)
    v, p = ufl.as_vector([X[1] ** 2, X[0] * X[0]]), X[0] * X[1]
    grad = ufl.as_matrix([[0.0, 2 * X[1]], [2 * X[0], 0.0]])
    f = grad * (v - V) + (ufl.as_vector([X[1], X[0]]) - MU * ufl.as_vector([2.0, 2.0])) / RHO
    ds = ufl.ds(domain=flow.mesh, metadata={"quadrature_degree": 14})
    common = dict(rho=RHO, mu=MU, motion=motion)
    residual = interior_residual(v, p, flow.w, flow.q, flow.mesh, f=f, quadrature_degree=14, **common)
    residual += weak_dirichlet(v, p, flow.w, flow.q, v, flow.mesh, ds, **common)
    assert (flow.assemble(residual).norm() < 1e-11) is (degree == 2)


@pytest.mark.mpi
@pytest.mark.parametrize(("cell", "degree"), KINDS)
def test_volumes_areas_and_normals(cell, degree):
    """Present volume, centroid, boundary and its normals, against those of the mesh that lies there."""
    m = Moving(cell, degree)
    dx, ds = m.measures(6)

    def functionals(motion):
        x, n = ale.position(m.mesh, motion), ale.normal(m.mesh, motion)
        inside = [m.constant(1.0), x[0], ufl.inner(ale.gradient(m.v, motion), ale.gradient(m.v, motion))]
        edge = [m.constant(1.0), ufl.dot(x, n), n[0] ** 2, m.v[0] * n[1]]
        forms = [ale.per_volume(f, motion) * dx for f in inside] + [ale.per_area(f, m.mesh, motion) * ds for f in edge]
        return compat.compile_forms(*forms)

    pulled_back = [compat.assemble_scalar(form) for form in functionals(m.motion)]
    fixed = functionals(None)
    unmoved = [compat.assemble_scalar(form) for form in fixed]
    with moved_to(m.mesh, m.displacement):
        expected = [compat.assemble_scalar(form) for form in fixed]
    np.testing.assert_allclose(pulled_back, expected, rtol=1e-12, atol=1e-13)
    assert (np.abs(np.subtract(unmoved, expected)) > 1e-5 * np.abs(expected)).all()
    assert expected[4] == pytest.approx(m.d * expected[0], rel=1e-12)  # div x = d


@pytest.mark.mpi
@pytest.mark.parametrize("invariant", [False, True])
@pytest.mark.parametrize("cell", ["triangle", "quadrilateral", "tetrahedron"])
def test_the_metric_is_that_of_the_moved_cells(cell, invariant):
    m = Moving(cell)
    a, b = m.constant(np.arange(1.0, m.d + 1)), m.constant([0.3] * m.d)
    dx, _ = m.measures()
    moved, fixed = compat.compile_forms(
        *(
            ale.per_volume(ufl.dot(a, element_metric(m.mesh, motion, invariant=invariant) * b), motion) * dx
            for motion in (m.motion, None)
        )
    )
    found, unmoved = compat.assemble_scalar(moved), compat.assemble_scalar(fixed)
    with moved_to(m.mesh, m.displacement):
        expected = compat.assemble_scalar(fixed)
    assert found == pytest.approx(expected, rel=1e-12)
    assert found != pytest.approx(unmoved, rel=1e-5)


@pytest.mark.mpi
@pytest.mark.parametrize("name", ["interior", "weak_dirichlet", "weak_slip", "stable_neumann"])
def test_a_moving_frame(name):
    """One velocity added to fluid, mesh and data changes nothing; added to the mesh alone it does."""
    m = Moving(n=2)
    c, alone = m.constant([0.0, 0.0]), m.constant([0.0, 0.0])
    _, ds = m.measures()
    v, g = m.v + c, ufl.as_vector([1.0, 2.0]) + c
    common = dict(motion=Motion(m.mesh, m.displacement, m.velocity + c + alone), rho=RHO)
    edge = (v, m.p, m.w, m.q)
    form = {
        "interior": lambda: interior_residual(*edge, m.mesh, mu=MU, v_t=m.v_t, dt=DT, **common),
        "weak_dirichlet": lambda: weak_dirichlet(*edge, g, m.mesh, ds, mu=MU, penalty=1.0, **common),
        "weak_slip": lambda: weak_slip(*edge, m.mesh, ds, mu=MU, penalty=1.0, **common),
        "stable_neumann": lambda: stable_neumann(v, m.w, m.mesh, ds, g=g, **common),
    }[name]()
    (form,) = compat.compile_forms(form)
    rest = assembled(form, m.V)
    c.value = [1.3, -0.7]
    together = assembled(form, m.V)
    alone.value = [0.5, 0.5]
    apart = assembled(form, m.V)
    assert (together - rest).norm() < 1e-12 * rest.norm()
    assert (apart - rest).norm() > 1e-3 * rest.norm()


@pytest.mark.mpi
def test_a_mesh_without_displacement_gives_what_a_fixed_one_does():
    m = Moving()
    still = Motion(m.mesh, fem.Function(m.displacement.function_space), m.constant([0.0, 0.0]))
    for name, form in terms(m, still, False).items():
        found, expected = m.assemble(form), m.assemble(terms(m, None, False)[name])
        assert (found - expected).norm() < 1e-13 * expected.norm(), name


@pytest.mark.mpi
@pytest.mark.parametrize("cell", ["triangle", "quadrilateral", "tetrahedron"])
def test_the_rate_of_the_volume_is_the_flux_of_the_meshs_velocity(cell):
    """int div_x(v_mesh) J = oint v_mesh . n, and both are the derivative of the volume along v_mesh."""
    m = Moving(cell)
    dx, ds = m.measures(5)
    n = ale.normal(m.mesh, m.motion)
    inside = integral(ale.per_volume(ale.divergence(m.velocity, m.motion), m.motion) * dx)
    across = integral(ale.per_area(ufl.dot(m.velocity, n), m.mesh, m.motion) * ds)
    (volume,) = compat.compile_forms(ale.per_volume(m.constant(1.0), m.motion) * dx)
    start, sides = m.displacement.x.array.copy(), []
    for eps in (1e-4, -1e-4):
        m.displacement.x.array[:] = start + eps * m.velocity.x.array
        sides.append(compat.assemble_scalar(volume))
    assert abs(inside) > 1e-3
    assert inside == pytest.approx(across, rel=1e-11)
    assert (sides[0] - sides[1]) / 2e-4 == pytest.approx(inside, rel=1e-6)


@pytest.mark.parametrize("name", ["interior", "weak_dirichlet", "weak_slip", "stable_neumann"])
def test_without_motion_no_displacement_is_in_the_form(name):
    m = Moving()
    fixed, moving = (set(terms(m, motion, False)[name].coefficients()) for motion in (None, m.motion))
    assert not fixed & {m.displacement, m.velocity}
    assert moving == fixed | {m.displacement, m.velocity}


@pytest.mark.mpi
@pytest.mark.parametrize("degree", [1, 2])
def test_tangent(degree):
    m = Moving(degree=degree)
    for name, form in terms(m, m.motion, False).items():
        assert slope_error(form, m.u) < 1e-6, name


@pytest.mark.parametrize("k", [1, 2])
@pytest.mark.parametrize("m", [None, 1, 2, 3])
def test_the_quadrature_of_a_curved_mesh_is_that_of_its_volume_as_well(k, m):
    """2 k, and 2 (m - 1) more for J of a displacement of degree m."""
    flow = Flow("triangle", k, n=1)
    still = flow.constant([0.0, 0.0])
    motion = None if m is None else Motion(flow.mesh, curved(flow.x), still, m)
    (integral,) = flow.residual(motion=motion).integrals()
    assert integral.metadata()["quadrature_degree"] == 2 * k + 2 * ((m or 1) - 1)


# -- the invariant metric ---------------------------------------------------------------------------------------------

CORNERS = {
    "triangle": [[0.0, 0.0], [1.0, 0.1], [0.3, 0.8]],
    "tetrahedron": [[0.0, 0.0, 0.0], [1.0, 0.1, 0.2], [0.3, 0.8, -0.1], [0.1, 0.2, 0.9]],
}


def metrics(cell, orders, *, invariant):
    """G of copies of one cell, whose vertices have the given orders."""
    x, d = np.array(CORNERS[cell]), len(CORNERS[cell]) - 1
    cells = np.arange(len(orders) * (d + 1)).reshape(-1, d + 1)
    domain = compat.create_mesh(MPI.COMM_SELF, cell, cells, np.concatenate([x[list(order)] for order in orders]))
    V = compat.lagrange_space(domain, 0, d * d)
    G, z, size = element_metric(domain, invariant=invariant), ufl.TestFunction(V), ufl.CellVolume(domain)
    entries = sum(G[i, j] / size * z[d * i + j] for i in range(d) for j in range(d))
    (form,) = compat.compile_forms(entries * ufl.dx(domain=domain))
    found = np.empty((len(orders), d, d))
    found[compat.input_numbers(domain)[0]] = assembled(form, V).array_r.reshape(-1, d, d)
    return found


@pytest.mark.parametrize("cell", CORNERS)
def test_the_invariant_metric_does_not_see_how_vertices_are_numbered(cell):
    """The published one depends on which vertex is numbered 0, and on nothing else."""
    orders = list(permutations(range(len(CORNERS[cell]))))  # those with one first vertex follow each other
    invariant, published = (metrics(cell, orders, invariant=choice) for choice in (True, False))
    np.testing.assert_allclose(invariant - invariant[0], 0.0, atol=1e-12 * invariant.max())
    published = published.reshape(len(CORNERS[cell]), -1, *published.shape[1:])
    np.testing.assert_allclose(published - published[:, :1], 0.0, atol=1e-12 * published.max())
    first = published[:, 0]
    assert min(np.abs(a - b).max() for i, a in enumerate(first) for b in first[:i]) > 0.1


@pytest.mark.parametrize("cell", CORNERS)
def test_the_invariant_metric_of_a_regular_cell_of_edge_two_is_one(cell):
    """Its edges are as long as those of the bi-unit cube, whose metric is 1 as well."""
    x = np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [1.0, 3**0.5, 0.0], [1.0, 3**-0.5, (8 / 3) ** 0.5]])
    d = len(CORNERS[cell]) - 1
    domain = compat.create_mesh(MPI.COMM_SELF, cell, [list(range(d + 1))], x[: d + 1, :d])
    G, dx = element_metric(domain, invariant=True), ufl.dx(domain=domain)
    error = G - ufl.Identity(d)
    assert integral(ufl.inner(error, error) * dx) < 1e-24


def squared_difference(m, motion):
    """Of the invariant metric and the published one."""
    error = element_metric(m.mesh, motion) - element_metric(m.mesh, motion, invariant=True)
    return integral(ufl.inner(error, error) * m.measures(2)[0])


@pytest.mark.mpi
@pytest.mark.parametrize("cell", ["quadrilateral", "hexahedron"])
def test_on_tensor_cells_there_is_one_metric(cell):
    m = Moving(cell, n=1)
    assert max(squared_difference(m, motion) for motion in (None, m.motion)) < 1e-20
    assert squared_difference(Moving("triangle", n=1), None) > 1.0


# -- bad input --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["displacement", "velocity"])
@pytest.mark.parametrize("value", [ufl.as_vector([1.0, 2.0, 3.0]), ufl.as_ufl(1.0), ufl.Identity(2)])
def test_shapes_of_a_motion(name, value):
    m = Moving(n=1)
    given = dict(displacement=m.displacement, velocity=m.velocity) | {name: value}
    with pytest.raises(ValueError, match=rf"^{name} has shape .*: shape \(2,\) is required"):
        Motion(m.mesh, **given)


@pytest.mark.parametrize("degree", [0, -1, 1.5])
def test_degree_of_a_motion(degree):
    m = Moving(n=1)
    with pytest.raises(ValueError, match=f"^degree = {degree}: an integer >= 1"):
        Motion(m.mesh, m.displacement, m.velocity, degree)
