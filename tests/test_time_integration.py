"""Time integration: orders, damping, what is averaged and what is not, and the clock."""

import numpy as np
import pytest
import ufl
from mpi4py import MPI
from dolfinx import fem, mesh

from tigar_x import compat
from tigar_x.fem.schemes import backward_euler, companion, generalized_alpha
from tigar_x.fem.time_integration import LoadStepper, TimeIntegrator

CELL = mesh.create_interval(MPI.COMM_SELF, 1, [0.0, 1.0])
NUMBER, TRIPLE = (compat.lagrange_space(CELL, 0, size) for size in (1, 3))
SCHEMES = [
    pytest.param(generalized_alpha(rho, order, first_order_alpha_m=first), id=f"{name}{order}-{rho}")
    for rho in (0.0, 0.5, 1.0)
    for order, first, name in ((1, False, "order"), (2, False, "order"), (2, True, "mixed"))
] + [pytest.param(backward_euler(order), id=f"euler{order}") for order in (1, 2)]


def integrator(scheme, dt, *state, t=0.0):
    """One number in time; ``state`` is x and its known rates, the others are zero."""
    functions = [fem.Function(NUMBER) for _ in state]
    for f, value in zip(functions, state, strict=True):
        f.x.array[:] = value
    rates = dict(zip(("xdot", "xddot"), functions[1:], strict=False))
    return TimeIntegrator(functions[0], dt, scheme, t=t, **rates)


def alpha_rates(time):
    """Rates at the intermediate level, from the definition."""
    s, now = time.scheme, time.rates()
    if s.order == 1:
        return (s.alpha_m * now[0][0] + (1 - s.alpha_m) * time.xdot_old.x.array[0],)
    old = time.xdot_old.x.array[0], time.xddot_old.x.array[0]
    return tuple(a * v[0] + (1 - a) * o for a, v, o in zip((s.alpha_f, s.alpha_m), now, old, strict=True))


def solve_step(time, stiffness, damping, load):
    """Solve the linear equation of one step: x' + k x = f, or x'' + c x' + k x = f; two evaluations give its slope."""

    def residual(x):
        time.x.x.array[:] = x
        *lower, highest = alpha_rates(time)
        return highest + damping * sum(lower) + stiffness * time.x_alpha_array()[0] - load(float(time.t_alpha.value))

    zero = residual(0.0)
    time.x.x.array[:] = -zero / (residual(1.0) - zero)


# -- formulas ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("scheme", SCHEMES)
def test_coefficients_are_those_of_newmark(scheme):
    """Rates at the end satisfy the update formulas that define gamma and beta."""
    h, (x, x_n, v_n, a_n) = 0.3, (1.1, 0.4, -0.7, 2.3)
    time = integrator(scheme, h, x_n, *(v_n, a_n)[: scheme.order])
    time.x.x.array[:] = x
    v, *a = (rate[0] for rate in time.rates())
    if scheme == backward_euler(scheme.order):
        assert v == pytest.approx((x - x_n) / h)
        assert a == [pytest.approx((v - v_n) / h)] * (scheme.order - 1)
        return
    gamma = 0.5 + scheme.alpha_m - scheme.alpha_f
    beta = 0.25 * (1 + scheme.alpha_m - scheme.alpha_f) ** 2
    if scheme.order == 1:
        assert x == pytest.approx(x_n + h * ((1 - gamma) * v_n + gamma * v))
    else:
        assert v == pytest.approx(v_n + h * ((1 - gamma) * a_n + gamma * a[0]))
        assert x == pytest.approx(x_n + h * v_n + h**2 * ((0.5 - beta) * a_n + beta * a[0]))


@pytest.mark.parametrize("rho", [0.0, 0.25, 1.0])
def test_intermediate_levels(rho):
    first, second = generalized_alpha(rho, 1), generalized_alpha(rho, 2)
    mixed = generalized_alpha(rho, 2, first_order_alpha_m=True)
    assert first.alpha_f == second.alpha_f == mixed.alpha_f == 1 / (1 + rho)
    assert first.alpha_m == mixed.alpha_m == pytest.approx((3 - rho) / (2 + 2 * rho))
    assert second.alpha_m == pytest.approx((2 - rho) / (1 + rho))


@pytest.mark.parametrize("scheme", SCHEMES)
def test_forms_arrays_and_factors_agree(scheme):
    time = integrator(scheme, 0.2, 0.4, *(-0.7, 2.3)[: scheme.order])
    v = ufl.TestFunction(NUMBER)
    expressions = [time.x_alpha, time.xdot_alpha] + ([time.xddot_alpha] if scheme.order == 2 else [])
    forms = compat.compile_forms(*(e * v * ufl.dx for e in expressions))
    b = compat.create_vector(NUMBER)
    seen = []
    for x in (1.1, 2.1):
        time.x.x.array[:] = x
        found = []
        for form in forms:
            compat.assemble_vector(b, form)
            found.append(b.array_r[0])
        assert found[1:] == pytest.approx(list(alpha_rates(time)))
        assert found[:2] == pytest.approx([time.x_alpha_array()[0], time.xdot_alpha_array()[0]])
        seen.append(found)
    assert seen[1][0] - seen[0][0] == pytest.approx(time.x_factor)
    assert seen[1][1] - seen[0][1] == pytest.approx(time.xdot_factor)


@pytest.mark.parametrize("scheme", SCHEMES)
def test_predictor_keeps_the_rate(scheme):
    time = integrator(scheme, 0.3, 0.4, *(-0.7, 2.3)[: scheme.order])
    time.x.x.array[:] = 99.0
    time.predict()
    if scheme.order == 1:
        assert time.x.x.array[0] == 0.4
    else:
        assert time.rates()[0][0] == pytest.approx(-0.7, rel=1e-13)
        assert time.x.x.array[0] != 0.4


@pytest.mark.parametrize("scheme", SCHEMES)
def test_the_unknown_of_a_rate(scheme):
    """The inverse of the rates, as array and as expression."""
    time = integrator(scheme, 0.3, 0.4, *(-0.7, 2.3)[: scheme.order])
    time.x.x.array[:] = 1.1
    rate = time.rates()[0]
    dofs = np.zeros((1, 1), dtype=np.int32)
    found = time.x_from_rate_array(rate[dofs], dofs)
    assert found.shape == (1, 1)
    assert found[0, 0] == pytest.approx(1.1, rel=1e-14)
    given = fem.Constant(CELL, float(rate[0]))
    (form,) = compat.compile_forms(time.x_from_rate(given) * ufl.dx(domain=CELL))
    assert compat.assemble_scalar(form) == pytest.approx(1.1, rel=1e-14)
    # the derivative by the rate is what a solid in a flow has in its tangent
    other = time.x_from_rate_array(rate[dofs] + 1.0, dofs)
    assert other[0, 0] - 1.1 == pytest.approx(0.3 / scheme.a0, rel=1e-13)


@pytest.mark.parametrize("scheme", [backward_euler(), *(generalized_alpha(rho) for rho in (0.0, 0.3, 1.0))])
def test_companions(scheme):
    """The same levels, and between the two highest rates the relation that the first-order scheme has."""
    second = companion(scheme)
    assert second.order == 2
    assert (second.alpha_f, second.alpha_m) == pytest.approx((scheme.alpha_f, scheme.alpha_m), rel=1e-15)
    assert (second.b0, second.b1) == pytest.approx((scheme.a0, scheme.a1), rel=1e-14)
    assert (second == backward_euler(2)) is (scheme == backward_euler())
    with pytest.raises(ValueError, match=r"^order of scheme = 2: one of 1 is required"):
        companion(second)


@pytest.mark.parametrize("scheme", [backward_euler(), generalized_alpha(0.0), generalized_alpha(0.5)])
def test_what_moves_along_has_the_velocity_of_a_companion(scheme):
    """A displacement whose velocity is integrated at first order: both have one acceleration."""
    first, second = integrator(scheme, 0.3, -0.7, 2.3), integrator(companion(scheme), 0.3, 0.4, -0.7, 2.3)
    for velocity in (0.2, -0.5):
        first.x.x.array[:] = velocity
        dofs = np.zeros(1, dtype=np.int32)
        second.x.x.array[:] = second.x_from_rate_array(np.full(1, velocity), dofs)
        assert second.rates()[0] == pytest.approx(velocity, rel=1e-13)
        assert second.rates()[1] == pytest.approx(first.rates()[0], rel=1e-12)
        assert alpha_rates(second)[1] == pytest.approx(alpha_rates(first)[0], rel=1e-12)
        assert alpha_rates(second)[0] == pytest.approx(first.x_alpha_array()[0], rel=1e-12)
        first.advance()
        second.advance()


def test_a_step_is_taken_back():
    time = integrator(generalized_alpha(0.5), 0.3, 1.0, 2.0)
    time.x.x.array[:] = 7.0
    time.restore()
    assert time.x.x.array[0] == time.x_old.x.array[0] == 1.0
    assert time.xdot_old.x.array[0] == 2.0
    assert time.time == 0.0


@pytest.mark.parametrize("scheme", [generalized_alpha(0.5), generalized_alpha(0.2, 2), backward_euler(2)])
def test_the_state_and_the_clock_are_all_that_steps_follow_from(scheme):
    def step(time):
        time.predict()
        solve_step(time, 3.0, 0.2, np.cos)
        time.advance()

    whole = integrator(scheme, 0.3, 1.0, 2.0, t=0.7)
    for _ in range(3):
        step(whole)
    assert list(whole.state) == ["x", "xdot", "xddot"][: scheme.order + 1]
    other = integrator(scheme, 0.9, 5.0)
    for name, f in other.state.items():
        f.x.array[:] = whole.state[name].x.array
    other.resume(whole.time, whole.step_size)
    assert other.x.x.array[0] == whole.x.x.array[0]
    assert [float(c.value) for c in (other.t, other.t_alpha, other.dt)] == [
        float(c.value) for c in (whole.t, whole.t_alpha, whole.dt)
    ]
    for time in (whole, other):
        step(time)
    assert [f.x.array[0] for f in other.state.values()] == [f.x.array[0] for f in whole.state.values()]
    for t, dt in ((float("nan"), 0.1), (0.0, 0.0)):
        with pytest.raises(ValueError, match="is required"):
            other.resume(t, dt)
    assert (other.time, other.step_size) == (whole.time, whole.step_size)


# -- orders -----------------------------------------------------------------------------------------------------------


def error(scheme, n, *, start):
    """Error at t = 1 of x and x' for x(t) = cos 2t + sin t with n steps."""
    x = [
        lambda t: np.cos(2 * t) + np.sin(t),
        lambda t: -2 * np.sin(2 * t) + np.cos(t),
        lambda t: -4 * np.cos(2 * t) - np.sin(t),
    ]
    k, c = (1.0, 0.0) if scheme.order == 1 else (5.0, 0.4)
    loads = {1: lambda t: x[1](t) + k * x[0](t), 2: lambda t: x[2](t) + c * x[1](t) + k * x[0](t)}
    known = scheme.order + (start == "consistent")
    time = integrator(scheme, 1 / n, *(f(0.0) for f in x[:known]))
    for _ in range(n):
        time.predict()
        solve_step(time, k, c, loads[scheme.order])
        time.advance()
    assert time.time == pytest.approx(1.0)
    errors = [abs(time.x_old.x.array[0] - x[0](1.0)), abs(time.xdot_old.x.array[0] - x[1](1.0))]
    return errors[: scheme.order]


def orders(scheme, start, levels=(40, 80, 160, 320)):
    errors = np.array([error(scheme, n, start=start) for n in levels])
    return -np.polyfit(np.log(levels[-3:]), np.log(errors[-3:]), 1)[0], errors[-1]


@pytest.mark.parametrize("scheme", SCHEMES)
def test_order_with_a_consistent_start(scheme):
    rates, finest = orders(scheme, "consistent")
    euler = scheme == backward_euler(scheme.order)
    np.testing.assert_allclose(rates, 1.0 if euler else 2.0, atol=0.1)
    assert finest.max() < (2e-2 if euler else 1e-4)


@pytest.mark.parametrize("scheme", [s for s in SCHEMES if "euler" not in s.id])
def test_order_is_lost_with_an_inconsistent_start_unless_nothing_is_damped(scheme):
    rates, finest = orders(scheme, "zero")
    consistent = orders(scheme, "consistent")[1]
    if scheme.alpha_f == 0.5:  # rho_infinity = 1
        np.testing.assert_allclose(rates, 2.0, atol=0.1)
        np.testing.assert_allclose(finest, consistent, rtol=1e-6)
    else:
        np.testing.assert_allclose(rates, 1.0, atol=0.15)
        assert finest.max() < 1e-2
        assert finest.max() > 30 * consistent.max()


# -- damping ----------------------------------------------------------------------------------------------------------


def spectral_radius(scheme, frequency):
    """Largest eigenvalue of the map (x, h x', h^2 x'') -> next for h^2 k = frequency^2 (h k in first order)."""
    h, size = 0.1, scheme.order + 1
    k = (frequency / h) ** scheme.order
    scale = h ** np.arange(size)
    columns = []
    for unit in np.eye(size):
        time = integrator(scheme, h, *(unit / scale))
        solve_step(time, k, 0.0, lambda t: 0.0)
        time.advance()
        state = [time.x_old, time.xdot_old, *([time.xddot_old] if size == 3 else [])]
        columns.append([f.x.array[0] for f in state] * scale)
    return np.abs(np.linalg.eigvals(np.transpose(columns))).max()


@pytest.mark.parametrize(
    ("order", "first_order_alpha_m", "rho", "expected"),
    [(order, False, rho, rho) for order in (1, 2) for rho in (0.0, 0.5, 0.8, 1.0)]
    + [(2, True, 0.0, 1 / 3), (2, True, 0.5, 5 / 7), (2, True, 1.0, 1.0)],
)
def test_damping_of_high_frequencies(order, first_order_alpha_m, rho, expected):
    scheme = generalized_alpha(rho, order, first_order_alpha_m=first_order_alpha_m)
    assert spectral_radius(scheme, 1e5) == pytest.approx(expected, abs=5e-3)
    # stable at every frequency, and without damping at low ones if the system has none itself
    assert max(spectral_radius(scheme, w) for w in np.logspace(-1, 5, 25)) <= 1.0 + 1e-6
    if order == 2:
        assert spectral_radius(scheme, 1e-2) == pytest.approx(1.0, abs=1e-5)


@pytest.mark.parametrize("order", [1, 2])
def test_backward_euler_annihilates_high_frequencies(order):
    assert spectral_radius(backward_euler(order), 1e5) < 1e-2


# -- the clock --------------------------------------------------------------------------------------------------------


def test_clock_and_step_size():
    time = integrator(generalized_alpha(0.5), 0.3, 1.0, t=2.0)

    def clock():
        return [time.time, float(time.t.value), float(time.t_alpha.value), time.step_size]

    assert clock() == pytest.approx([2.0, 2.3, 2.2, 0.3])
    time.advance()
    assert clock() == pytest.approx([2.3, 2.6, 2.5, 0.3])
    time.step_size = 0.6
    assert clock() == pytest.approx([2.3, 2.9, 2.7, 0.6])
    time.x.x.array[:] = 2.5  # from x_n = 1 at rest, with gamma = 2/3
    assert time.rates()[0][0] == pytest.approx(1.5 / (2 / 3 * 0.6))
    for bad in (0.0, -0.1, float("nan"), float("inf")):
        with pytest.raises(ValueError, match=f"dt = {bad}: a"):
            time.step_size = bad
    assert clock() == pytest.approx([2.3, 2.9, 2.7, 0.6])


def test_load_stepper():
    x = fem.Function(NUMBER)
    load = LoadStepper(x, 0.25, t=1.0)
    assert float(load.t.value) == 1.25
    load.advance()
    assert float(load.t.value) == 1.5
    for bad in (0.0, -1.0, float("nan")):
        with pytest.raises(ValueError, match=f"dt = {bad}: a"):
            LoadStepper(x, bad)
    with pytest.raises(ValueError, match="t = inf"):
        LoadStepper(x, 0.1, t=float("inf"))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: generalized_alpha(-0.1), "rho_infinity = -0.1: a number from 0 to 1"),
        (lambda: generalized_alpha(1.1), "rho_infinity = 1.1"),
        (lambda: generalized_alpha(float("nan")), "rho_infinity = nan"),
        (lambda: generalized_alpha(0.5, 3), "order = 3: one of 1, 2 is required"),
        (lambda: backward_euler(0), "order = 0: one of 1, 2"),
        (lambda: integrator(backward_euler(), 0.0, 1.0), "dt = 0.0: a number > 0"),
        (lambda: integrator(backward_euler(), -0.1, 1.0), "dt = -0.1"),
        (lambda: integrator(backward_euler(), float("nan"), 1.0), "dt = nan"),
        (lambda: integrator(backward_euler(), 0.1, 1.0, t=float("inf")), "t = inf"),
        (
            lambda: TimeIntegrator(fem.Function(TRIPLE), 0.1, backward_euler(), algebraic=(0, 3)),
            "algebraic = 3: one of",
        ),
    ],
)
def test_bad_arguments(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_a_first_order_system_has_no_second_rate():
    time = integrator(backward_euler(), 0.1, 1.0)
    with pytest.raises(AttributeError, match="no second rate"):
        _ = time.xddot_alpha
