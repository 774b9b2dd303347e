"""What a shell refuses, in words."""

import math

import numpy as np
import pytest
import ufl
from mpi4py import MPI

from shnapr.conditions import Damping, DeadLoad, EdgeForce, EdgeMoment, Gravity, Pressure
from shnapr.contact import ContactRecipe, LinearKernel, SelfContact, SmoothedKernel
from shnapr.hyperelastic import Hyperelastic, neo_hookean
from shnapr.planes import RigidPlane
from shnapr.shell import Shell, ShellOptions
from shnapr.svk import StVenantKirchhoff
from tigar_x.fem.schemes import backward_euler, generalized_alpha
from tigar_x.geometry import shapes
from tigar_x.splines.quadrature import NodalQuadrature
from tigar_x.splines.spline import ExtractedSpline

PATCH = shapes.line((0.0, 0.0), (1.0, 0.0), elements=2, degree=2)
MATERIAL = StVenantKirchhoff(1e3, 0.3, 0.1)
RECIPE = ContactRecipe(LinearKernel(0.1, 1.0), 0.2)
MOVING = {"density": 1.0, "dt": 0.1}


def shell(**options):
    """A clamped curve in the plane."""
    return Shell(**({"geometry": PATCH, "material": MATERIAL, "clamped": ["u0"]} | options))


def spline():
    return ExtractedSpline(PATCH, MPI.COMM_SELF)


REFUSED = {
    "no density in time": ({"dt": 0.1}, "density = None: one is required of a shell that moves in time"),
    "negative density": ({"density": -1.0}, r"density = -1\.0: a number >= 0 is required"),
    "no step": (MOVING | {"dt": 0.0}, r"dt = 0\.0: a number > 0 is required"),
    "scheme without a step": ({"scheme": backward_euler(2)}, "dt = None with a scheme"),
    "first-order scheme": (MOVING | {"scheme": backward_euler()}, r"order of scheme = 1: one of 2 is required"),
    "unknown side": ({"clamped": ["end"]}, "end"),
    "one text for sides": ({"clamped": "u0"}, r"clamped = 'u0': a list or a tuple is required, such as \['u0'\]"),
    "no patch": (
        {"geometry": None},
        r"geometry = None: a Patch, a MultiPatch such as disjoint\(first, second\), or an Ex",
    ),
    "no material": (
        {"material": 1e3},
        r"material = 1000\.0: a material, such as shnapr's StVenantKirchhoff or Hyperelastic, is",
    ),
    "class of a load": ({"loads": [Pressure]}, r"loads\[0\] = <class .*Pressure'>: a load, such as .* is required"),
    "one load": ({"loads": Pressure(1.0)}, r"loads = Pressure\(value=1\.0\): a list or a tuple is required"),
    "load of another shape": (
        {"loads": [DeadLoad((1.0, 0.0, 0.0))]},
        r"DeadLoad\.force has shape \(3,\): shape \(2,\)",
    ),
    "vector as pressure": (
        {"loads": [Pressure((1.0, 0.0))]},
        r"value has shape \(2,\): a scalar is required",
    ),
    "infinite load": ({"loads": [Pressure(math.inf)]}, r"Pressure\.value = inf: a finite number is required"),
    "unknown edge": ({"loads": [EdgeForce("end", (1.0, 0.0))]}, "end"),
    "no edge": ({"loads": [EdgeMoment((), 1.0)]}, "on is empty: the name of an edge is required"),
    "numbers of time": (
        {"loads": [Pressure(lambda x, t: math.sin(t))]},
        r"Pressure\.value: .*ufl\.sin\(t\)",
    ),
    "weight without density": ({"loads": [Gravity((0.0, -1.0))]}, "density = None: one is required, for Gravity"),
    "damping without density": ({"loads": [Damping(1.0)]}, "density = None: one is required, for Damping"),
    "plane in space": ({"loads": [RigidPlane((0, 0, 0), (0, 0, 1), 1.0)]}, r"plane\.normal has shape \(3,\)"),
    "contact without a recipe": ({"contact": LinearKernel(0.1, 1.0)}, "contact = LinearKernel.*: a recipe, such as"),
    "mixed in time": (MOVING | {"formulation": "mixed"}, "formulation = 'mixed': a clock requires"),
    "mixed with contact": ({"contact": RECIPE, "formulation": "mixed"}, "formulation = 'mixed' with contact"),
    "mixed rubber": (
        {"material": Hyperelastic(neo_hookean(1.0), 0.1), "formulation": "mixed"},
        "for formulation = 'mixed' a StVenantKirchhoff is required",
    ),
    "formulation": ({"formulation": "hybrid"}, "formulation = 'hybrid': one of 'displacement', 'mixed' is required"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_refused_when_it_is_made(name):
    options, told = REFUSED[name]
    with pytest.raises(ValueError, match=told):
        shell(**options)


def test_asked_at_the_wrong_time():
    static, moving = shell(), shell(**MOVING)
    for call, told in (
        (static.take_step, r"dt = None: a shell without a clock takes no steps; solve\(\) finds its equilibrium"),
        (lambda: static.run(steps=1), "dt = None: a shell without a clock takes no steps"),
        (lambda: static.modes(1), "density = None: one is required, for modes"),
        (lambda: static.bind(0.1, generalized_alpha(0.5)), "density = None: one is required"),
        (lambda: static.solve(math.nan), "until = nan: a finite number is required"),
        (moving.solve, r"dt = 0\.1: solve\(\) is for shells without a clock; take_step\(\)"),
        (moving.solve_linear, r"dt = 0\.1: solve_linear\(\) is for shells without a clock"),
        (moving.support_force, r"support_force\(\) between steps: ask for it in take_step\(measure=...\)"),
        (lambda: shell(formulation="mixed").energies(), r"formulation = 'mixed': energies\(\) requires"),
        (lambda: shell(formulation="mixed").start(np.zeros((4, 2))), "formulation = 'mixed': it starts undeformed"),
    ):
        with pytest.raises(ValueError, match=told):
            call()


def test_states_and_places_that_are_not_there():
    one = shell()
    for call, told in (
        (lambda: one.start(np.zeros((2, 2))), r"displacement has shape \(2, 2\): shape \(4, 2\) is required"),
        (lambda: one.start(velocity=ufl.as_vector([0.0] * 3)), r"velocity has shape \(3,\): shape \(2,\) is required"),
        (lambda: one.at("end"), "end"),
        (lambda: one.at("u1", patch=1), "patch = 1"),
        (lambda: one.at([2.0]), r"xi\[0\] = \[2\.\]"),
    ):
        with pytest.raises(ValueError, match=told):
            call()


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"rtol": -1.0}, r"rtol = -1\.0"),
        ({"atol": math.nan}, "atol = nan"),
        ({"max_iterations": 0}, "max_iterations = 0: an integer >= 1"),
        ({"keep": 2.0}, r"keep = 2\.0: a number from 0 to 1"),
    ],
)
def test_options(options, told):
    with pytest.raises(ValueError, match=told):
        ShellOptions(**options)


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"r_self": 0.1}, r"r_self = 0\.1: a number > kernel\.r_max = 0\.1 is required"),
        ({"kernel": 0.1}, r"kernel = 0\.1: a LinearKernel or a SmoothedKernel is required"),
        ({"neighbours": "all"}, "neighbours = 'all'"),
        ({"spacing": 0.0}, r"spacing = 0\.0: a number > 0"),
    ],
)
def test_recipes_of_contact(options, told):
    with pytest.raises(ValueError, match=told):
        ContactRecipe(**({"kernel": SmoothedKernel(0.1, 1.0, 0.5), "r_self": 0.2} | options))


def test_a_spline_has_its_supports():
    with pytest.raises(ValueError, match="geometry is a spline, which has its supports and its quadrature"):
        shell(geometry=spline())


def test_contact_between_points_is_no_recipe():
    touching = SelfContact(NodalQuadrature.of(spline()), LinearKernel(0.1, 1.0), 0.2)
    with pytest.raises(ValueError, match=r"contact = .*: a recipe, such as shnapr's ContactRecipe"):
        shell(contact=touching)


@pytest.mark.mpi
def test_a_distributed_shell_has_no_contact_with_itself():
    if MPI.COMM_WORLD.size == 1:
        assert shell(contact=RECIPE, comm=MPI.COMM_WORLD).contact is not None
        return
    with pytest.raises(ValueError, match=r"spline lives on 2 ranks: nodal quadrature needs MPI\.COMM_SELF"):
        shell(contact=RECIPE, comm=MPI.COMM_WORLD)


def test_it_tells_what_it_is():
    assert repr(shell(loads=[Pressure(1.0)], contact=RECIPE)) == (
        "Shell(a curve of 4 functions, StVenantKirchhoff, Pressure, contact, statics)"
    )
    assert repr(shell(**MOVING)).endswith("t = 0, dt = 0.1)")
