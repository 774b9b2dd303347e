"""Data that treat UFL expressions as numbers are refused in words, wherever a function is asked for UFL."""

import math
import signal

import numpy as np
import pytest
import splines
import ufl
from mpi4py import MPI
from dolfinx import fem
from ufl.core.expr import Expr

from shnapr.hyperelastic import Hyperelastic
from shnapr.work import virtual_work
from tigar_x import compat
from tigar_x.fem.schemes import backward_euler
from varmint.conditions import Traction, Velocity, WeakVelocity
from varmint.flow import Flow
from varmint.forms.motion import ElasticMotion, PrescribedMotion
from varmint.mesh import box

MESH = box(MPI.COMM_SELF, (0.0, 0.0), (1.0, 1.0), (1, 1))
OWN = fem.Constant(MESH.domain, 2.0)
SIDES = ("bottom", "top", "right")
FUNCTIONS = {
    "sine": lambda x, t: (math.sin(t), 0.0),
    "sine of a product": lambda x, t: (math.sin(2 * t), 0.0),
    "rounded": lambda x, t: (round(t), 0.0),
    "complex": lambda x, t: (abs(complex(t)), 0.0),
    "interpolated": lambda x, t: (np.interp(t, [0.0, 1.0], [0.0, 1.0]), 0.0),
    "numpy": lambda x, t: (np.sin(x[0]), 0.0 * t),
    "numpy of a vector": lambda x, t: np.exp(x),
    "condition": lambda x, t: (1.0 if t < 1.0 else 0.0, 0.0),
    "largest": lambda x, t: (max(x[0], 0.5), 0.0),
    "method": lambda x, t: (x.sum(), 0.0),
    "constant of one's own": lambda x, t: (float(OWN) * x[0], 0.0),
    "array": lambda x, t: np.asarray(x[0] * t, dtype=float),
}


@pytest.fixture(autouse=True)
def no_patience():
    """Some of these took for ever. What the signal raises is no Exception, which UFL would take for an answer."""
    before = signal.signal(signal.SIGALRM, lambda *_: pytest.fail("it takes for ever"))
    signal.alarm(20)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


def flow(*, value=None, **given):
    inlet = given.pop("inlet", Velocity)("left", value)
    return Flow(MESH, [inlet, Velocity(SIDES)], rho=1.0, mu=1.0, dt=0.1, **given)


@pytest.mark.parametrize("function", FUNCTIONS.values(), ids=FUNCTIONS)
def test_numbers_are_not_made_of_time_and_place(function):
    kept = vars(Expr)["__float__"]
    with pytest.raises(
        ValueError, match=r"^Velocity\('left'\)\.value: the function .* with \w+: .*ufl\.sin\(t\) in place"
    ):
        flow(value=function)
    assert vars(Expr)["__float__"] is kept


USES = {
    r"WeakVelocity\('left'\)\.value": lambda f: flow(value=f, inlet=WeakVelocity),
    r"Traction\('left'\)\.value": lambda f: flow(value=f, inlet=Traction),
    "f": lambda f: flow(f=f),
    "velocity": lambda f: flow().start(f),
    "pressure": lambda f: flow().start(None, lambda x, t: f(x, t)[0]),
    "displacement": lambda f: PrescribedMotion(MESH, f, 0.1, backward_euler()),
    r"displacements\['left'\]": lambda f: ElasticMotion(MESH, {"left": f}, 0.1, backward_euler()),
}


@pytest.mark.parametrize(("name", "use"), USES.items(), ids=USES)
def test_wherever_a_function_of_them_is_given(name, use):
    with pytest.raises(ValueError, match=f"^{name}: the function that was given ends with TypeError"):
        use(lambda x, t: (math.cos(t), 0.0))


def test_nor_of_strains():
    material = Hyperelastic(lambda E: math.log(1.0 + E[0, 0]), thickness=0.1)
    x = ufl.SpatialCoordinate(MESH.domain)
    with pytest.raises(ValueError, match=r"^psi: the function that was given ends with TypeError"):
        material._energy(ufl.as_matrix([[x[0], 0], [0, x[1]]]))


def test_nor_of_displacements():
    spline = splines.spline("parallelogram")
    y, z = spline.function(), ufl.TestFunction(spline.V)
    with pytest.raises(ValueError, match=r"^energy: the function that was given ends with TypeError"):
        virtual_work(spline, lambda u: math.sqrt(u[0]) * spline.dx, y, z)


def own(message):
    raise ValueError(message)


def test_words_of_an_energy_are_kept():
    spline = splines.spline("parallelogram")
    with pytest.raises(ValueError, match=r"^degree = 1$"):
        virtual_work(spline, lambda u: own("degree = 1"), spline.function(), ufl.TestFunction(spline.V))


NUMBERS = {
    "sine": lambda t: math.sin(t),
    "sine of a product": lambda t: math.sin(2 * t),
    "of a quotient": lambda t: math.exp(-(t - 1.0) / t),
    "power": lambda t: math.cos(t**2),
    "float": lambda t: float(t),
    "whole": lambda t: int(t),
    "rounded": lambda t: round(t),
    "complex": lambda t: complex(t),
    "numpy": lambda t: np.sin(t),
    "interpolated": lambda t: np.interp(t, [0.0, 1.0], [0.0, 1.0]),
    "of a sine": lambda t: float(ufl.sin(t)),
}


@pytest.mark.parametrize("number", NUMBERS.values(), ids=NUMBERS)
@pytest.mark.parametrize("name", ["t", "t_alpha", "dt"])
def test_nor_of_the_clock_wherever_that_is_written(name, number, caplog):
    with pytest.raises((TypeError, ValueError)) as caught:
        number(getattr(flow().time, name))
    numpy = "ufunc" in str(caught.value) or "array element" in str(caught.value)
    assert numpy or "ufl.sin(t) in place of math.sin(t)" in str(caught.value) + caplog.text


def test_constants_of_the_library_are_those_of_dolfinx_in_forms():
    def signatures(of):
        u, c = fem.Function(V), of(MESH.domain, 2.0)
        form = c * u**2 * v * ufl.dx + of(MESH.domain, np.array([1.0, 2.0]))[1] * v * ufl.ds
        return [f.signature() for f in (form, ufl.derivative(form, u), ufl.replace(form, {u: c * u}))]

    V = compat.lagrange_space(MESH.domain, 1)
    v = ufl.TestFunction(V)
    assert signatures(compat.Constant) == signatures(fem.Constant)
    c = compat.Constant(MESH.domain, 2.0)
    assert isinstance(c, fem.Constant)
    assert (2 * c)((), {c: 3.0}) == 6.0  # where a number is given, expressions have one
    c.value = 4.0
    assert float(c.value) == 4.0


def test_what_is_meant_is_kept():
    x, t = ufl.SpatialCoordinate(MESH.domain), fem.Constant(MESH.domain, 0.5)
    wanted = ufl.conditional(ufl.lt(t, 1.0), ufl.sin(2 * t) * x[0], math.sin(2.0))
    given = compat.ask("f", lambda x, t: ufl.conditional(ufl.lt(t, 1.0), ufl.sin(2 * t) * x[0], math.sin(2.0)), x, t)
    assert given == wanted
    assert compat.ask("f", lambda t: np.float64(2.0) * t, t) == 2.0 * t
    assert compat.ask("f", lambda t: float(ufl.as_ufl(3.0)), t) == 3.0


def test_other_mistakes_stay_what_they_are():
    with pytest.raises(ZeroDivisionError):
        flow(value=lambda x, t: (1 / 0, 0.0))
