"""The VMS residual in the interior (Bazilevs et al., doi:10.1007/s00466-008-0315-x)."""

from functools import cache

import numpy as np
import pytest
import ufl
from dolfinx import fem
from flows import DT, MU, RHO, Flow, assembled, randomise, slope_error
from ufl.algorithms import expand_derivatives

from tigar_x import compat
from tigar_x.fem.solve import FiniteElementSystem
from varmint.forms.boundary import stable_neumann, weak_dirichlet
from varmint.forms.space import split
from varmint.forms.vms import frozen_tangent

CASES = [("triangle", 1), ("triangle", 2), ("quadrilateral", 1), ("tetrahedron", 1)]


@pytest.mark.mpi
@pytest.mark.parametrize("unsteady", [False, True])
@pytest.mark.parametrize(
    ("cell", "degree", "order"),
    [(*case, order) for case in CASES for order in ("uniform", "linear")] + [("triangle", 2, "quadratic")],
)
def test_consistency(cell, degree, order, unsteady):
    """An exact solution that the space contains leaves no residual; with a force off by one it does."""
    flow = Flow(cell, degree, n=2)
    d, x = flow.d, flow.x
    A = np.array([[0.5, -1.0, 0.3], [0.8, -0.2, 0.6], [-0.4, 0.1, -0.3]])[:d, :d]
    slope = flow.constant(order != "uniform")
    v = flow.constant([0.7, -0.4, 0.3][:d]) + slope * ufl.as_matrix((A - np.trace(A) / d * np.eye(d)).tolist()) * x
    p = 2.0 + slope * (x[0] - 3.0 * x[1])
    if order == "quadratic":
        v = v + ufl.as_vector([x[1] ** 2 + x[0] * x[1], -0.5 * x[1] ** 2 - x[0] ** 2])
    compat.interpolate(flow.u, ufl.as_vector([*v, p]))
    wrong, f = flow.constant(0.0), ufl.grad(v) * v + (ufl.grad(p) - MU * ufl.div(2 * ufl.sym(ufl.grad(v)))) / RHO
    options = {}
    if unsteady:
        v_t = ufl.as_vector([1.0, 0.5 * x[0], x[1]][:d])
        options, f = dict(v_t=v_t, dt=flow.constant(DT)), f + v_t
    residual = flow.residual(f=f + wrong * ufl.as_vector([1.0] * d), **options)
    ds = ufl.ds(domain=flow.mesh, metadata={"quadrature_degree": 2 * degree})
    residual += weak_dirichlet(flow.v, flow.p, flow.w, flow.q, v, flow.mesh, ds, rho=RHO, mu=MU)
    form = compat.compile_forms(residual)[0]
    exact = assembled(form, flow.V).norm()
    wrong.value = 1.0
    scale = assembled(form, flow.V).norm()
    assert scale > 1e-2
    assert exact < 1e-11 * scale


@pytest.mark.mpi
@pytest.mark.parametrize("unsteady", [False, True])
@pytest.mark.parametrize("banded", [False, True])
def test_tangent(unsteady, banded):
    flow = Flow("triangle")
    options = dict(v_t=flow.v / DT - flow.v_t, dt=flow.constant(DT)) if unsteady else {}
    if banded:
        for seed, name in enumerate(("scale_m", "scale_c")):
            options[name] = scale = fem.Function(compat.lagrange_space(flow.mesh, 0))
            randomise(scale, seed)
            scale.x.array[:] = 10.0 ** (1.5 * scale.x.array - 1.5)
    residual = flow.residual(f=flow.x, **options)
    g = ufl.as_vector([0.1, 0.2])
    residual += weak_dirichlet(flow.v, flow.p, flow.w, flow.q, g, flow.mesh, ufl.ds(flow.mesh), rho=RHO, mu=MU)
    residual += stable_neumann(flow.v, flow.w, flow.mesh, ufl.ds(flow.mesh), rho=RHO)
    system = FiniteElementSystem(residual, flow.u)
    state, direction = flow.u.x.array.copy(), flow.rate.copy()
    randomise(direction, 3)

    def at(eps):
        flow.u.x.array[:] = state + eps * direction.x.array
        system.assemble_residual()
        return system.b.copy()

    at(0.0)
    system.assemble_tangent()
    slope = system.b.duplicate()
    system.A.mult(compat.petsc_vector(direction), slope)
    difference = (at(1e-6) - at(-1e-6)) / 2e-6
    assert (difference - slope).norm() < 1e-6 * slope.norm()


def test_a_frozen_tangent_is_the_slope_at_the_parameters_of_the_present_state():
    flow = Flow("triangle", n=2)
    held = flow.u.copy()
    residual = flow.residual(v_tau=split(held)[0], v_t=flow.v / DT - flow.v_t, dt=DT)
    assert slope_error(residual, flow.u, frozen_tangent(residual, flow.u, held)) < 1e-6
    held.x.array[:] *= 3.0
    assert slope_error(residual, flow.u, frozen_tangent(residual, flow.u, held)) > 1e-3


@pytest.mark.parametrize("unsteady", [False, True])
@pytest.mark.parametrize(("cell", "degree"), [("triangle", 1), ("triangle", 2), ("quadrilateral", 1)])
def test_every_term(cell, degree, unsteady):
    """The powers of the band's scales tell the terms apart; each is assembled here in index notation."""
    flow = Flow(cell, degree, n=2)
    v, p, w, q, d = flow.v, flow.p, flow.w, flow.q, flow.d
    f = ufl.as_vector([ufl.sin(flow.x[1]), flow.x[0] ** 2])
    s_m, s_c = flow.constant(1.0), flow.constant(1.0)
    time = dict(v_t=flow.v_t, dt=DT) if unsteady else {}
    total = flow.residual(f=f, scale_m=s_m, scale_c=s_c, **time)

    i, j, k = ufl.indices(3)
    C_I = 3 if degree == 1 else 6 * degree**4
    K = ufl.inv(ufl.Jacobian(flow.mesh))
    G = ufl.as_tensor(4 * K[k, i] * K[k, j], (i, j))
    m = v[i] * G[i, j] * v[j] + C_I * (MU / RHO) ** 2 * G[i, j] * G[i, j] + (4 / DT**2 if unsteady else 0)
    tau_M, tau_C = 1 / ufl.sqrt(m), ufl.sqrt(m) / G[i, i]
    sigma = ufl.as_tensor(MU * (v[i].dx(j) + v[j].dx(i)) - p * ufl.Identity(d)[i, j], (i, j))
    D = ufl.as_vector(v[i].dx(j) * v[j] - f[i] + (flow.v_t[i] if unsteady else 0 * v[i]), i)
    r = ufl.as_vector(RHO * D[i] - sigma[i, j].dx(j), i)
    terms = {
        "Galerkin": RHO * D[i] * w[i] + sigma[i, j] * w[i].dx(j) + q * v[i].dx(i),
        "SUPG": tau_M * r[i] * w[i].dx(j) * v[j],
        "PSPG": tau_M / RHO * r[i] * q.dx(i),
        "cross stress": -tau_M * w[i] * v[i].dx(j) * r[j],
        "Reynolds stress": -(tau_M**2) / RHO * w[i].dx(j) * r[i] * r[j],
        "grad-div": tau_C * RHO * v[i].dx(i) * w[j].dx(j),
    }
    dx = ufl.dx(domain=flow.mesh, metadata={"quadrature_degree": 2 * degree})
    form, *forms = compat.compile_forms(total, *(term * dx for term in terms.values()))

    def at(m_value, c_value):
        s_m.value, s_c.value = m_value, c_value
        return assembled(form, flow.V).array.reshape(-1, d + 1)

    expected = {name: assembled(f, flow.V).array.reshape(-1, d + 1) for name, f in zip(terms, forms, strict=True)}
    galerkin, half, one = at(0.0, 1e300), at(0.5, 1e300), at(1.0, 1e300)
    quadratic = 2 * (one - 2 * half + galerkin)
    linear = one - galerkin - quadratic
    measured = {
        "Galerkin": galerkin,
        "grad-div": at(0.0, 0.5) / 2 - galerkin / 2,
        "Reynolds stress": quadratic,
        "PSPG": linear * [0, 0, 1],
        "SUPG": linear * [1, 1, 0] - expected["cross stress"],
        "cross stress": linear * [1, 1, 0] - expected["SUPG"],
    }
    for name, value in measured.items():
        scale = np.abs(expected[name]).max()
        assert scale > 1e-4, name
        np.testing.assert_allclose(value, expected[name], atol=1e-10 * scale, err_msg=name)
    # a constant test function sees neither SUPG nor Reynolds stress
    np.testing.assert_allclose(linear[:, :d].sum(axis=0), expected["cross stress"][:, :d].sum(axis=0), rtol=1e-9)


@cache
def _order(expression):
    """Order of the highest derivative in an expanded expression."""
    here = isinstance(expression, ufl.classes.Grad)
    return here + max((_order(operand) for operand in expression.ufl_operands), default=0)


@pytest.mark.parametrize(("cell", "degree"), CASES)
def test_what_a_form_contains(cell, degree):
    """No time step in steady flow, no second derivatives on linear simplices, no coefficient without a band."""
    flow = Flow(cell, degree)
    dt, scale = flow.constant(DT), fem.Function(compat.lagrange_space(flow.mesh, 0))
    steady, unsteady = flow.residual(), flow.residual(v_t=flow.v_t, dt=dt)
    simple = degree == 1 and cell in ("triangle", "tetrahedron")
    for form in (steady, unsteady):
        orders = [_order(integral.integrand()) for integral in expand_derivatives(form).integrals()]
        assert orders == [1 if simple else 2]
    assert (steady.constants(), list(unsteady.constants())) == ([], [dt])
    assert steady.coefficients() == (flow.u,)
    assert set(flow.residual(scale_m=scale).coefficients()) == {flow.u, scale}


def test_moving_frame():
    """v + c with v_t - (grad v) c leaves the Galerkin terms of momentum as they are (sub-scales off)."""
    flow = Flow("triangle")
    c, frame = flow.constant([0.0, 0.0]), flow.constant(1.0)
    v_t = flow.v_t - frame * ufl.grad(flow.v) * c
    form = compat.compile_forms(flow.residual(v=flow.v + c, v_t=v_t, dt=DT, scale_m=0.0 * frame, scale_c=1e300))[0]
    rest = assembled(form, flow.V)
    c.value = [1.3, -0.7]
    moved = assembled(form, flow.V)
    frame.value = 0.0
    wrong = assembled(form, flow.V)
    assert (moved - rest).norm() < 1e-13 * rest.norm()
    assert (wrong - rest).norm() > 0.1 * rest.norm()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (dict(rho=0.0), r"^rho = 0.0: a number > 0"),
        (dict(rho=-1.0), r"^rho = -1.0: a number > 0"),
        (dict(rho=np.nan), r"^rho = nan"),
        (dict(mu=-0.1), r"^mu = -0.1: a number >= 0"),
        (dict(mu=np.inf), r"^mu = inf"),
        (dict(degree=0), r"^degree = 0: an integer >= 1"),
        (dict(dt=0.1), "v_t and dt belong together"),
        (dict(v_t=ufl.as_vector([1.0, 2.0])), "v_t and dt belong together"),
        (dict(v_t=ufl.as_vector([1.0, 2.0]), dt=0.0), r"^dt = 0.0: a number > 0"),
        (dict(v=ufl.as_vector([1.0, 2.0, 3.0])), r"^v has shape \(3,\): a mesh of dimension 2 requires \(2,\)"),
    ],
)
def test_bad_input(options, message):
    with pytest.raises(ValueError, match=message):
        Flow("triangle").residual(**options)


@pytest.mark.parametrize(("name", "value"), [("rho", 0.0), ("rho", -2.0), ("mu", -0.1), ("dt", -1.0)])
def test_bad_constants(name, value):
    flow = Flow("triangle")
    with pytest.raises(ValueError, match=rf"^{name} = .*{value:g}.*required"):
        flow.residual(**(dict(v_t=flow.v_t, dt=DT) | {name: flow.constant(value)}))
