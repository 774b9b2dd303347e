"""Time integration of what has algebraic components, such as a pressure, and consistent starts."""

import numpy as np
import pytest
import ufl
from mpi4py import MPI
from dolfinx import fem, mesh

from tigar_x import compat
from tigar_x.fem.schemes import backward_euler, generalized_alpha
from tigar_x.fem.solve import FiniteElementSystem, newton
from tigar_x.fem.time_integration import TimeIntegrator

CELL = mesh.create_interval(MPI.COMM_SELF, 1, [0.0, 1.0])
NUMBER, TRIPLE = (compat.lagrange_space(CELL, 0, size) for size in (1, 3))


def spaces():
    domain = mesh.create_unit_square(MPI.COMM_WORLD, 3, 3)
    return [compat.lagrange_space(domain, 1, 3), compat.mixed_lagrange_space(domain, (2, 2), (1, 1))]


def random_function(space, seed):
    f = fem.Function(space)
    f.x.array[:] = np.random.default_rng(seed).uniform(size=len(f.x.array))
    return f


@pytest.mark.mpi
@pytest.mark.parametrize("space", spaces(), ids=["blocked", "Taylor-Hood"])
@pytest.mark.parametrize("algebraic", [(), (2,), (0, 2)])
def test_algebraic_components_are_not_averaged(space, algebraic):
    x, scheme = random_function(space, 0), generalized_alpha(0.5)
    time = TimeIntegrator(x, 0.1, scheme, algebraic=algebraic)
    time.x_old.x.array[:] = random_function(space, 1).x.array
    expected = fem.Function(space)
    for component in range(3):
        dofs = compat.component_space(space, component)[1]
        a = 1.0 if component in algebraic else 2 / 3
        expected.x.array[dofs] = a * x.x.array[dofs] + (1 - a) * time.x_old.x.array[dofs]
    v = ufl.TestFunction(space)
    b, c = compat.create_vector(space), compat.create_vector(space)
    for vector, form in zip(
        (b, c), compat.compile_forms(*(ufl.inner(f, v) * ufl.dx for f in (time.x_alpha, expected))), strict=True
    ):
        compat.assemble_vector(vector, form)
    np.testing.assert_allclose(b.array_r, c.array_r, rtol=0, atol=1e-14)


def saddle(rho, h, t=0.0, *, compliance=0.0):
    """u' + A u + g p = f(t), g . u - compliance p = s(t) with a known solution; returns what steps it."""
    A, g = np.array([[2.0, 1.0], [-1.0, 0.5]]), np.array([1.0, 2.0])
    u, du = lambda t: np.array([np.cos(t), np.sin(2 * t)]), lambda t: np.array([-np.sin(t), 2 * np.cos(2 * t)])
    p = lambda t: 1.0 + np.sin(3 * t)  # noqa: E731
    data = fem.Constant(CELL, np.zeros(3))
    x, rate = fem.Function(TRIPLE), fem.Function(TRIPLE)
    x.x.array[:], rate.x.array[:] = [*u(t), p(t)], [*du(t), 0.0]
    time = TimeIntegrator(x, h, generalized_alpha(rho), t=t, xdot=rate, algebraic=(2,))
    z, v, eps = time.x_alpha, ufl.TestFunction(TRIPLE), fem.Constant(CELL, compliance)
    momentum = [time.xdot_alpha[i] + sum(A[i, j] * z[j] for j in (0, 1)) + g[i] * z[2] - data[i] for i in (0, 1)]
    constraint = g[0] * z[0] + g[1] * z[1] - eps * z[2] - data[2]
    form = ufl.dot(ufl.as_vector([*momentum, constraint]), v) * ufl.dx

    def set_data(s):
        data.value[:] = [*(du(s) + A @ u(s) + g * p(s)), g @ u(s) - compliance * p(s)]

    return time, form, set_data, (u, du, p)


def test_algebraic_component_belongs_to_the_intermediate_level():
    """p is second-order accurate at t_alpha and only first-order at t_{n+1}."""
    levels, errors = (20, 40, 80, 160), []
    for n in levels:
        time, form, set_data, (u, _, p) = saddle(0.5, 1 / n)
        system = FiniteElementSystem(form, time.x)
        for _ in range(n):
            time.predict()
            t_alpha = float(time.t_alpha.value)
            set_data(t_alpha)
            newton(system, rtol=1e-10)
            time.advance()
        *velocity, pressure = time.x_old.x.array
        errors.append([abs(velocity - u(1.0)).max(), abs(pressure - p(t_alpha)), abs(pressure - p(1.0))])
    rates = -np.polyfit(np.log(levels[-3:]), np.log(errors[-3:]), 1)[0]
    np.testing.assert_allclose(rates, [2.0, 2.0, 1.0], atol=0.15)
    assert max(errors[-1][:2]) < 1e-3 < errors[-1][2]


# -- the start --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("scheme", [generalized_alpha(0.5, 1), generalized_alpha(0.0, 2), backward_euler(2)])
def test_consistent_start(scheme):
    """The nonlinear equation x'' + 2 x' + x^2 = t (or 2 x' + x^2 = t) at t = 0.3 gives the highest rate."""
    x, xdot = fem.Function(NUMBER), fem.Function(NUMBER)
    x.x.array[:], xdot.x.array[:] = 1.5, -0.7
    time = TimeIntegrator(x, 0.1, scheme, t=0.3, xdot=xdot)
    rate = 2 * time.xdot_alpha + (time.xddot_alpha if scheme.order == 2 else 0)
    residual = (rate + time.x_alpha**2 - time.t_alpha) * ufl.TestFunction(NUMBER) * ufl.dx
    form, unknown = time.initial_form(residual)
    newton(FiniteElementSystem(form, unknown), rtol=1e-12)
    time.start(unknown)
    if scheme.order == 1:
        assert time.xdot_old.x.array[0] == pytest.approx(0.5 * (0.3 - 1.5**2), rel=1e-12)
    else:
        assert time.xddot_old.x.array[0] == pytest.approx(0.3 - 1.5**2 + 2 * 0.7, rel=1e-12)
        assert time.xdot_old.x.array[0] == -0.7
    assert time.x_old.x.array[0] == time.x.x.array[0] == 1.5
    assert (time.time, float(time.t.value)) == (0.3, pytest.approx(0.4))


def test_consistent_start_with_an_algebraic_component():
    time, form, set_data, (u, du, p) = saddle(0.5, 0.1, t=0.3, compliance=0.2)
    set_data(0.3)
    time.x.x.array[2] = time.x_old.x.array[2] = 99.0
    time.xdot_old.x.array[:] = 99.0
    initial, unknown = time.initial_form(form)
    newton(FiniteElementSystem(initial, unknown), rtol=1e-12)
    time.start(unknown)
    np.testing.assert_allclose(time.xdot_old.x.array, [*du(0.3), 0.0], rtol=0, atol=1e-12)
    np.testing.assert_allclose(time.x_old.x.array, [*u(0.3), p(0.3)], rtol=0, atol=1e-12)
    np.testing.assert_array_equal(time.x.x.array, time.x_old.x.array)
