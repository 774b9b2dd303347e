"""Data that treat UFL expressions as numbers are refused in words, wherever a function is asked for UFL."""

import math
import signal

import numpy as np
import pytest
import ufl
from mpi4py import MPI
from dolfinx import fem
from ufl.core.expr import Expr

from shnapr.hyperelastic import Hyperelastic
from tigar_x import compat
from tigar_x.time_integration import backward_euler
from varmint.conditions import Traction, Velocity, WeakVelocity
from varmint.flow import Flow
from varmint.mesh import box
from varmint.motion import ElasticMotion, PrescribedMotion

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
