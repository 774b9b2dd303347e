"""Weak Dirichlet and stable Neumann conditions.

Bazilevs and Hughes, doi:10.1016/j.compfluid.2005.07.012; Esmaily-Moghadam et al., doi:10.1007/s00466-011-0599-0.
"""

import numpy as np
import pytest
import ufl
from mpi4py import MPI
from flows import MU, RHO, Flow, assembled

from tigar_x import compat
from varmint.forms.boundary import stable_neumann, weak_dirichlet
from varmint.forms.vms import stress

DS = {"quadrature_degree": 5}


class Edge(Flow):
    """A random flow with the boundary terms of a whole boundary."""

    def __init__(self, cell="triangle"):
        super().__init__(cell, n=2)
        self.ds = ufl.ds(domain=self.mesh, metadata=DS)
        self.n = ufl.FacetNormal(self.mesh)
        self.g = self.constant(np.arange(1.0, self.d + 1))

    def dirichlet(self, **options):
        given = dict(v=self.v, p=self.p, w=self.w, q=self.q, g=self.g, domain=self.mesh, ds=self.ds, rho=RHO, mu=MU)
        return weak_dirichlet(**(given | options))

    def neumann(self, **options):
        return stable_neumann(**(dict(v=self.v, w=self.w, domain=self.mesh, ds=self.ds, rho=RHO) | options))

    def set(self, v, p=0.0):
        compat.interpolate(self.u, ufl.as_vector([*v, p + 0 * self.x[0]]))

    def pair(self, *forms):
        """Residuals tested with the state itself, w = v and q = p."""
        state = compat.petsc_vector(self.u)
        return [assembled(form, self.V).dot(state) for form in compat.compile_forms(*forms)]

    def vectors(self, *forms):
        return [assembled(form, self.V) for form in compat.compile_forms(*forms)]


def same(a, b, rel=1e-12):
    return b.norm() > 1e-3 and (a - b).norm() < rel * b.norm()


@pytest.mark.mpi
@pytest.mark.parametrize("symmetric", [True, False])
def test_exact_boundary_data_leave_the_traction_only(symmetric):
    """With v = g nothing remains but -sigma n . w; with another g more does."""
    e = Edge()
    total, traction, other = e.vectors(
        e.dirichlet(g=e.v, symmetric=symmetric),
        -ufl.inner(stress(e.v, e.p, MU) * e.n, e.w) * e.ds,
        e.dirichlet(symmetric=symmetric),
    )
    assert same(total, traction)
    assert not same(other, traction, 0.1)


@pytest.mark.mpi
@pytest.mark.parametrize("cell", ["triangle", "quadrilateral", "tetrahedron"])
@pytest.mark.parametrize(
    ("symmetric", "penalty", "P"), [(True, None, 1e3), (True, 7.0, 7.0), (False, None, 0.0), (False, 7.0, 7.0)]
)
def test_terms_of_the_weak_dirichlet_condition(cell, symmetric, penalty, P):
    """Against index notation; the q-term has one sign in both variants."""
    e = Edge(cell)
    i, j, k = ufl.indices(3)
    v, w, n = e.v, e.w, e.n
    K = ufl.inv(ufl.Jacobian(e.mesh))
    Gnn = 4 * K[k, i] * n[i] * K[k, j] * n[j]
    S = 1 if symmetric else -1
    jump = v - e.g
    flux = v[i] * n[i]
    expected = -MU * (v[i].dx(j) + v[j].dx(i)) * n[j] * w[i] + e.p * n[i] * w[i]
    expected -= RHO * ufl.conditional(ufl.lt(flux, 0), flux, 0) * jump[i] * w[i]
    expected -= S * MU * (w[i].dx(j) + w[j].dx(i)) * n[j] * jump[i] + e.q * n[i] * jump[i]
    expected += P * MU * ufl.sqrt(Gnn) * jump[i] * w[i]
    assert same(*e.vectors(e.dirichlet(symmetric=symmetric, penalty=penalty), expected * e.ds))


def test_energy_of_the_non_symmetric_variant():
    """Viscous and pressure terms cancel in w = v, q = p (g = 0): what remains is the inflow's energy."""
    e = Edge()
    zero = ufl.as_vector([0.0, 0.0])
    flux = ufl.dot(e.v, e.n)
    inflow = -RHO * ufl.min_value(flux, 0) * ufl.dot(e.v, e.v) * e.ds
    free, held = e.pair(*(e.dirichlet(g=zero, symmetric=symmetric, penalty=0.0) for symmetric in (False, True)))
    expected = compat.assemble_scalar(compat.compile_forms(inflow)[0])
    assert expected > 0.1
    assert free == pytest.approx(expected, rel=1e-12)
    assert abs(held - expected) > 1e-3 * expected


@pytest.mark.mpi
@pytest.mark.parametrize("term", ["dirichlet", "neumann"])
@pytest.mark.parametrize("velocity", [(2.0, 0.0), (-2.0, 0.0), (0.0, 0.5)])
def test_inflow_term_acts_where_flow_enters(term, velocity):
    """Uniform flow without viscosity and pressure: forces on the upstream side only, rho |v.n| (v - g) in all."""
    e = Edge()
    e.set(e.constant(velocity))
    form = e.dirichlet(mu=0.0) if term == "dirichlet" else e.neumann(g=e.g)
    (b,) = e.vectors(form)
    force = b.array.reshape(-1, 3)[:, :2]
    x = e.V.tabulate_dof_coordinates()[: len(force)]
    axis = int(np.argmax(np.abs(velocity)))
    length = 2 * 0.25
    upstream = np.isclose(x[:, axis], 0.0 if velocity[axis] > 0 else length)
    jump = np.array(velocity) - [1.0, 2.0]
    total = e.mesh.comm.allreduce(force.sum(axis=0), op=MPI.SUM)
    np.testing.assert_allclose(total, RHO * abs(velocity[axis]) * length * jump, rtol=1e-12)
    assert np.abs(force[~upstream]).max(initial=0.0) < 1e-14


@pytest.mark.parametrize("gamma", [0.5, 1.0, 3.0])
def test_energy_on_an_open_boundary(gamma):
    """Convection and stable Neumann together in the stagnation flow (x, -y).

    Without viscosity, pressure and sub-scales w = v gives rho/2 int (v.n + 2 gamma |v.n|_-) |v|^2: with gamma = 1/2
    the energy of what leaves plus that of what enters. On the square of side L, flow leaves on the right and enters
    on the top, and int |v.n| |v|^2 = 4/3 L^4 on both.
    """
    e = Edge()
    e.set((e.x[0], -e.x[1]))
    off = dict(mu=0.0, scale_m=e.constant(0.0), scale_c=1e300, quadrature_degree=4)
    (power,) = e.pair(e.residual(**off) + e.neumann(gamma=gamma))
    L = 0.5
    side = RHO / 2 * 4 / 3 * L**4
    assert power == pytest.approx(side * (1 - 1 + 2 * gamma), rel=1e-12)


@pytest.mark.mpi
def test_traction():
    """-int h . w, independent of the flow's direction where it leaves."""
    e = Edge()
    e.set(e.x)  # leaves everywhere but on the two sides through the origin, where v.n = 0
    h = ufl.as_vector([0.3, -2.0])
    loaded, expected, free = e.vectors(e.neumann(traction=h), -ufl.inner(h, e.w) * e.ds, e.neumann())
    assert same(loaded, expected)
    assert free.norm() < 1e-15


def test_an_absent_traction_is_not_in_the_form():
    e = Edge()
    h = e.constant([1.0, 2.0])
    assert e.neumann().constants() == []
    assert e.neumann(traction=h).constants() == [h]


@pytest.mark.parametrize("name", ["rho", "mu"])
def test_parameters_may_be_constants(name):
    e = Edge()
    value = dict(rho=RHO, mu=MU)[name]
    assert same(*e.vectors(e.dirichlet(**{name: e.constant(value)}), e.dirichlet()))


@pytest.mark.parametrize(("term", "name"), [("dirichlet", "penalty"), ("neumann", "gamma")])
def test_factors_may_be_constants(term, name, monkeypatch):
    """A sweep over them is to compile nothing. UFL's attempt to make a number of a Constant takes for ever."""
    monkeypatch.setattr(ufl.core.expr.Expr, "__float__", lambda self: pytest.fail(f"float({self!r})"))
    e = Edge()
    make = getattr(e, term)
    assert same(*e.vectors(make(**{name: e.constant(20.0)}), make(**{name: 20.0})))
    with pytest.raises(ValueError, match=f"^{name} = .*-1.*>= 0"):
        make(**{name: e.constant(-1.0)})


@pytest.mark.parametrize(
    ("term", "options", "message"),
    [
        ("dirichlet", dict(penalty=-1.0), r"^penalty = -1.0: a number >= 0"),
        ("dirichlet", dict(penalty=np.nan), r"^penalty = nan"),
        ("dirichlet", dict(g=ufl.as_vector([1.0, 2.0, 3.0])), r"^g has shape \(3,\): shape \(2,\)"),
        ("dirichlet", dict(rho=-1.0), r"^rho = -1.0: a number > 0"),
        ("dirichlet", dict(mu=-0.1), r"^mu = -0.1: a number >= 0"),
        ("neumann", dict(gamma=-0.5), r"^gamma = -0.5: a number >= 0"),
        ("neumann", dict(gamma=np.inf), r"^gamma = inf"),
        ("neumann", dict(rho=0.0), r"^rho = 0.0: a number > 0"),
    ],
)
def test_bad_input(term, options, message):
    with pytest.raises(ValueError, match=message):
        getattr(Edge(), term)(**options)
