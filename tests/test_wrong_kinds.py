"""Arguments of a wrong kind: every one is refused in words where it is given, by its name, and not somewhere later."""

from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
import ufl
from mpi4py import MPI
from dolfinx import fem, mesh

from coudalfish import CouplingOptions
from coudalfish.step.options import PenaltyRule
from shnapr import contact, hyperelastic, loads, planes, stress, svk
from tigar_x import compat
from tigar_x.fem import line_search, linear, load_stepping
from tigar_x.fem.eigen import eigenmodes
from tigar_x.fem.schemes import backward_euler, generalized_alpha
from tigar_x.fem.solve import FiniteElementSystem
from tigar_x.fem.time_integration import LoadStepper, TimeIntegrator
from tigar_x.geometry import bspline, gluing, shapes, surfaces
from tigar_x.geometry.patch import Patch
from tigar_x.run.convergence import doubled
from tigar_x.splines import constraints
from tigar_x.splines.projection import fit
from tigar_x.splines.quadrature import NodalQuadrature
from tigar_x.splines.spline import ExtractedSpline
from tigar_x.splines.spline_system import SplineSystem
from varmint import conditions
from varmint.flow import Flow, FlowOptions
from varmint.forms import ale, boundary, motion, solids
from varmint.forms.vms import interior_residual
from varmint.mesh import box

WRONG = {
    "number": ("0.1", "many", None, (0.1, 0.2), np.array([0.1]), {}, True, 1j, float("nan")),
    "scalar": ("0.1", None, (0.1, 0.2), {}, True, ufl.as_vector([1.0, 2.0]), float("nan")),
    "vector": ("abc", None, 0.1, {}, ((0.0, 1.0), (2.0, 3.0)), (None, None), ("0", "1"), (0.0, float("nan"))),
    "array": ("abc", None, 0.1, {}, ((0.0, 1.0), (2.0, 3.0)), (0.0, float("nan"))),
    "whole": ("3", None, (3,), {}, True, 2.5, float("nan")),
    "wholes": ("33", None, 3, {}, (2.5, 2), (None, None), ("2", "2"), (True, True)),
    "choice": (3, None, {}, ("uniform",), True),
    "flag": ("no", None, 0.5, ()),
    "function": (3.0, None, "f"),
    "names": ({"u0": (0, 0)}, {"end": 3}, {"end": (1, 0)}),
    "dofs": (np.zeros(40, dtype=bool), [0.5], [-1], [10**6], ["0"]),
}


@cache
def scene():
    """A curve in the plane and a mesh, with what forms on them need."""
    spline = ExtractedSpline(shapes.line((0, 0), (1, 0), elements=2, degree=2), MPI.COMM_SELF)
    square = box(MPI.COMM_SELF, (0.0, 0.0), (1.0, 1.0), (2, 2))
    domain = square.domain
    V, Q = compat.lagrange_space(domain, 1, 2), compat.lagrange_space(domain, 1)
    return SimpleNamespace(
        spline=spline, y=spline.function(), z=ufl.TestFunction(spline.V), mesh=square, domain=domain,
        v=fem.Function(V), w=ufl.TestFunction(V), p=fem.Function(Q), q=ufl.TestFunction(Q),
        ds=square.ds("left", degree=2),
    )  # fmt: skip


def on_fluid(form, **given):
    s = scene()
    known = dict(v=s.v, p=s.p, w=s.w, q=s.q, domain=s.domain, ds=s.ds)
    return form(**{name: known[name] for name in form.__annotations__ if name in known} | given)


def system(**given):
    s = scene()
    mass = ufl.inner(s.y, s.z) * s.spline.dx
    return SplineSystem(s.spline, mass, ufl.derivative(mass, s.y), **given)


def flow(**given):
    sides = ("left", "right", "bottom", "top")
    return Flow(scene().mesh, [conditions.Velocity(sides)], **dict(rho=1.0, mu=0.1, dt=0.1) | given)


def bending(**given):
    parameters = dict(youngs_modulus=1.0, poisson_ratio=0.3, thickness=0.1)
    return svk.StVenantKirchhoff(**parameters | given)


def eigen(**given):
    s = scene()
    u = ufl.TrialFunction(s.spline.V)
    form = ufl.inner(u, s.z) * s.spline.dx
    return eigenmodes(s.spline, form, form, 1, **given)


def fitted(**given):
    s = scene()
    u = ufl.TrialFunction(s.spline.V)
    return fit(s.spline.vector, ufl.inner(u, s.z) * s.spline.dx, s.z[0] * s.spline.dx, **given)


def resisted(**given):
    return conditions.Resistance("left", **given)


PATCH = dict(elements=("wholes", (2, 2)), degrees=("wholes", (2, 2)))
MASS = dict(density=("scalar", 1.0), thickness=("scalar", 0.1))
FLUID = dict(rho=("scalar", 1.0), mu=("scalar", 0.1))
LINE = shapes.line((0, 0), (1, 0), elements=2, degree=2)
PLATE = shapes.plate(lengths=(1, 1), elements=(2, 2), degrees=(2, 2))

CASES = {
    "uniform": (shapes.uniform, dict(degree=("whole", 2), elements=("whole", 2))),
    "line": (
        shapes.line,
        dict(start=("array", (0, 0)), end=("array", (1, 0)), elements=("whole", 2), degree=("whole", 2)),
    ),
    "parallelogram": (
        shapes.parallelogram,
        dict(origin=("array", (0, 0)), edge_0=("array", (1, 0)), edge_1=("array", (0, 1)), **PATCH),
    ),
    "plate": (shapes.plate, dict(lengths=("array", (1, 1)), center=("array", (0, 0)), **PATCH)),
    "strip": (shapes.strip, dict(length=("number", 1), width=("number", 1), start=("array", (0, 0, 0)), **PATCH)),
    "box": (
        shapes.box,
        dict(lengths=("array", (1, 1, 1)), elements=("wholes", (1, 1, 1)), degrees=("wholes", (1, 1, 1))),
    ),
    "extruded": (
        lambda **g: shapes.extruded(LINE, **g),
        dict(vector=("array", (0, 0, 1)), elements=("whole", 1), degree=("whole", 1)),
    ),
    "ruled": (
        lambda **g: shapes.ruled(LINE, shapes.line((0, 1), (1, 1), elements=1), **g),
        dict(elements=("whole", 1), degree=("whole", 1)),
    ),
    "disc": (surfaces.disc, dict(radius=("number", 1), kind=("choice", "polar"), center=("array", (0, 0)), **PATCH)),
    "annulus": (
        surfaces.annulus,
        dict(inner=("number", 1), outer=("number", 2), angle=("number", 1), center=("array", (0, 0)), **PATCH),
    ),
    "cylinder panel": (
        surfaces.cylinder_panel,
        dict(radius=("number", 1), length=("number", 2), angle=("number", 1), **PATCH),
    ),
    "sphere cap": (surfaces.sphere_cap, dict(radius=("number", 1), angle=("number", 1), **PATCH)),
    "leaflet": (
        surfaces.leaflet,
        dict(
            index=("choice", 0),
            radius=("number", 1.1),
            overlap=("number", 0.03),
            gap=("number", 0.028),
            sag=("number", 0.08),
            z_top=("number", 0.94),
            opening=("number", 0.15),
            belly=("number", 0.12),
            **PATCH,
        ),
    ),
    "open knots": (bspline.open_knots, dict(degree=("whole", 2), breakpoints=("array", (0.0, 1.0)))),
    "basis": (
        bspline.BSplineBasis,
        dict(degree=("whole", 1), knots=("array", (0.0, 0.0, 1.0, 1.0)), periodic=("flag", False)),
    ),
    "patch": (
        lambda **g: Patch.from_points((shapes.uniform(1, 1),), ((0, 0), (1, 0)), **g),
        dict(side_names=("names", {"end": (0, 1)})),
    ),
    "refined": (lambda parts: PLATE.refined(parts), dict(parts=("whole", 2))),
    "with degree": (lambda degrees: PLATE.with_degree(degrees), dict(degrees=("whole", 3))),
    "dofs": (lambda functions: PLATE.dofs(functions), dict(functions=("dofs", [0, 1]))),
    "glued": (lambda **g: gluing.glued(PLATE, **g), dict(tolerance=("number", 1e-8), within=("flag", False))),
    "tied": (lambda **g: constraints.tied(n=9, **g), dict(dofs=("dofs", [0]), to=("dofs", [1]))),
    "extracted spline": (
        lambda **g: ExtractedSpline(LINE, MPI.COMM_SELF, **g),
        dict(zero_dofs=("dofs", [0, 1]), cells=("choice", "tensor")),
    ),
    "spline space": (lambda zero_dofs: scene().spline.space(1, zero_dofs=zero_dofs), dict(zero_dofs=("dofs", [0]))),
    "spline system": (system, dict(zero_dofs=("dofs", [0.0, 1.0]))),
    "eigenmodes": (eigen, dict(zero_dofs=("dofs", [0, 1]), shift=("number", -1.0))),
    "fit": (fitted, dict(dofs=("dofs", [0, 1]))),
    "doubled": (doubled, dict(elements=("whole", 2), levels=("whole", 2))),
    "generalized-alpha": (
        generalized_alpha,
        dict(rho_infinity=("number", 0.5), order=("choice", 2), first_order_alpha_m=("flag", True)),
    ),
    "backward Euler": (backward_euler, dict(order=("choice", 1))),
    "integrator": (
        lambda **g: TimeIntegrator(scene().v, scheme=backward_euler(), **g),
        dict(dt=("number", 0.1), t=("number", 0.0)),
    ),
    "load stepper": (lambda **g: LoadStepper(scene().v, **g), dict(dt=("number", 0.1), t=("number", 0.0))),
    "GMRES with ILU": (
        linear.gmres_ilu,
        dict(levels=("whole", 1), rtol=("number", 1e-8), max_iterations=("whole", 9), overlap=("whole", 1)),
    ),
    "GMRES with SOR": (linear.gmres_sor, dict(rtol=("number", 1e-8), max_iterations=("whole", 9))),
    "multigrid": (linear.multigrid, dict(rtol=("number", 1e-8), max_iterations=("whole", 9))),
    "line search": (line_search.LineSearch, dict(reduction=("number", 0.5), evaluations=("whole", 3))),
    "step control": (
        load_stepping.StepControl,
        dict(growth=("number", 1.5)),
    ),
    "St. Venant-Kirchhoff": (
        bending,
        dict(
            youngs_modulus=("scalar", 1.0),
            poisson_ratio=("scalar", 0.3),
            thickness=("scalar", 0.1),
            bending=("flag", True),
        ),
    ),
    "hyperelastic": (
        hyperelastic.Hyperelastic,
        dict(psi=("function", hyperelastic.neo_hookean(1.0)), thickness=("scalar", 0.1), points=("whole", 3)),
    ),
    "neo-Hookean": (hyperelastic.neo_hookean, dict(mu=("scalar", 1.0))),
    "Lee-Sacks": (hyperelastic.lee_sacks, dict(c0=("scalar", 1.0), c1=("scalar", 1.0), c2=("scalar", 1.0))),
    "inertia": (lambda **g: loads.inertia(scene().spline, scene().y, scene().z, **g), MASS),
    "damping": (
        lambda **g: loads.mass_damping(scene().spline, scene().y, scene().z, **g),
        dict(coefficient=("scalar", 1.0), **MASS),
    ),
    "gravity": (
        lambda **g: loads.gravity(scene().spline, z=scene().z, **g),
        dict(acceleration=("vector", (0.0, 1.0)), **MASS),
    ),
    "dead load": (lambda **g: loads.dead_load(scene().spline, z=scene().z, **g), dict(force=("vector", (0.0, 1.0)))),
    "pressure": (
        lambda **g: loads.follower_pressure(scene().spline, y=scene().y, z=scene().z, **g),
        dict(pressure=("scalar", 1.0)),
    ),
    "edge traction": (
        lambda **g: loads.edge_traction(scene().spline, z=scene().z, ds=scene().spline.ds("u1"), **g),
        dict(traction=("vector", (0.0, 1.0))),
    ),
    "edge moment": (
        lambda **g: loads.edge_moment(scene().spline, y=scene().y, z=scene().z, ds=scene().spline.ds("u1"), **g),
        dict(moment=("scalar", 1.0)),
    ),
    "rigid plane": (
        planes.RigidPlane,
        dict(
            point=("vector", (0.0, 0.0)),
            normal=("array", (0.0, 1.0)),
            stiffness=("scalar", 1.0),
            smoothing=("scalar", 0.1),
        ),
    ),
    "von Mises": (
        lambda level: stress.von_mises(scene().spline, bending(), scene().y, level),
        dict(level=("scalar", 0.5)),
    ),
    "linear kernel": (contact.LinearKernel, dict(r_max=("number", 0.1), stiffness=("number", 1.0))),
    "smoothed kernel": (
        contact.SmoothedKernel,
        dict(r_max=("number", 0.1), stiffness=("number", 1.0), smoothing=("number", 0.5)),
    ),
    "contact": (
        lambda r_self: contact.SelfContact(NodalQuadrature.of(scene().spline), contact.LinearKernel(0.1, 1.0), r_self),
        dict(r_self=("number", 0.3)),
    ),
    "weak Dirichlet": (
        lambda **g: on_fluid(boundary.weak_dirichlet, **dict(g=(0.0, 0.0)) | g),
        dict(g=("vector", (0.0, 1.0)), symmetric=("flag", True), **FLUID),
    ),
    "weak slip": (lambda **g: on_fluid(boundary.weak_slip, **g), dict(penalty=("scalar", 1.0), **FLUID)),
    "stable Neumann": (
        lambda **g: on_fluid(boundary.stable_neumann, **g),
        dict(rho=("scalar", 1.0), gamma=("scalar", 1.0)),
    ),
    "VMS": (lambda **g: on_fluid(interior_residual, **g), dict(degree=("whole", 1), C_t=("scalar", 4.0), **FLUID)),
    "solid": (
        solids.StVenantKirchhoffSolid,
        dict(youngs_modulus=("scalar", 1.0), poisson_ratio=("scalar", 0.3), density=("scalar", 1.0)),
    ),
    "flow": (flow, dict(degree=("whole", 1), **FLUID)),
    "flow options": (
        FlowOptions,
        dict(
            C_t=("number", 4.0),
            pressure=("choice", "pin"),
            max_iterations=("whole", 9),
            invariant_metric=("flag", True),
            frozen_tangent=("flag", True),
        ),
    ),
    "resistance": (resisted, dict(resistance=("number", 1.0), pressure=("number", 1.0))),
    "elastic motion": (
        lambda **g: motion.ElasticMotion(scene().mesh, {"left": None}, scheme=backward_euler(), **dict(dt=0.1) | g),
        dict(
            dt=("number", 0.1),
            degree=("whole", 1),
            stiffening=("number", 3.0),
            size_stiffening=("number", 1.0),
            rtol=("number", 1e-6),
        ),
    ),
    "moved mesh": (
        lambda **g: ale.Motion(scene().domain, **g),
        dict(displacement=("vector", (0.1, 0.0)), velocity=("vector", (0.0, 1.0)), degree=("whole", 1)),
    ),
    "mesh of a box": (
        lambda **g: box(MPI.COMM_SELF, **g),
        dict(lower=("array", (0.0, 0.0)), upper=("array", (1.0, 1.0)), elements=("wholes", (2, 2))),
    ),
    "penalty rule": (PenaltyRule, dict(C_1=("number", 1.0), C_2=("number", 1.0))),
    "coupling": (
        CouplingOptions,
        dict(
            penalty=("number", 1.0),
            relaxation=("number", 0.0),
            relaxation_mode=("choice", "uniform"),
            scale_m=("number", 1.0),
            scale_c=("number", 1.0),
            fluid_tangent=("choice", "lumped"),
            normal=("choice", "predictor"),
            stopping=("choice", "published"),
            tangent_update=("choice", "pass"),
            block_rtol=("number", 0.1),
            block_atol=("number", 0.1),
            max_passes=("whole", 3),
            acceleration=("whole", 3),
            accelerate_after=("whole", 3),
            second_attempt=("flag", False),
        ),
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_every_argument_of_a_wrong_kind_is_named(name):
    make, parameters = CASES[name]
    good = {argument: value for argument, (_, value) in parameters.items()}
    make(**good)
    for argument, (kind, _) in parameters.items():
        for wrong in WRONG[kind]:
            with pytest.raises(ValueError, match=argument.removesuffix("s")) as caught:
                make(**good | {argument: wrong})
            assert caught.type is ValueError


# -- measures ---------------------------------------------------------------------------------------------------------


def test_loads_on_edges_take_measures_of_the_splines_own_sides_alone():
    """UFL's own ds counts parameters: a total of -4 for -10. The side's measure of another degree is one still."""
    s = scene()
    line = ExtractedSpline(LINE, MPI.COMM_SELF)
    own = s.spline.ds("u1")
    traction, moment = (
        lambda ds: loads.edge_traction(s.spline, (0.0, 1.0), s.z, ds),
        lambda ds: loads.edge_moment(s.spline, 1.0, s.y, s.z, ds),
    )
    for load in (traction, moment):
        assert load(own).integrals()
        assert load(own.of_degree(3)).integrals()[0].metadata()["quadrature_degree"] == 3
        for wrong in (ufl.ds, ufl.ds(domain=s.spline.mesh), s.spline.dx, s.spline.ds, line.ds("u1"), None, "u1"):
            with pytest.raises(ValueError, match=r"^ds .*required"):
                load(wrong)


def test_terms_of_a_flow_take_measures_of_their_mesh_alone():
    s = scene()
    other = mesh.create_unit_square(MPI.COMM_SELF, 1, 1)
    forms = (
        lambda ds: on_fluid(boundary.weak_dirichlet, g=(0.0, 0.0), rho=1.0, mu=1.0, ds=ds),
        lambda ds: on_fluid(boundary.weak_slip, rho=1.0, mu=1.0, ds=ds),
        lambda ds: on_fluid(boundary.stable_neumann, rho=1.0, ds=ds),
    )
    for form in forms:
        for right in (s.ds, ufl.ds(domain=s.domain), ufl.ds):
            assert form(right).integrals()
        for wrong in (ufl.dx, ufl.dS, ufl.ds(domain=other), s.spline.ds("u1"), s.mesh.ds, None):
            with pytest.raises(ValueError, match=r"^ds .*required"):
                form(wrong)
    material = solids.NeoHookeanSolid(1.0, 0.3, 1.0)
    for form in (
        lambda dx: on_fluid(interior_residual, rho=1.0, mu=1.0, dx=dx),
        lambda dx: solids.solid_residual(material, s.v, s.v, s.w, dx),
        lambda dx: solids.mesh_residual(s.v, s.w, s.domain, dx),
    ):
        assert form(ufl.dx).integrals()
        assert form(ufl.dx(domain=s.domain)).integrals()
        for wrong in (ufl.ds, s.spline.dx, "fluid"):
            with pytest.raises(ValueError, match=r"^dx .*required"):
                form(wrong)


# -- order ------------------------------------------------------------------------------------------------------------


def test_systems_and_pins_say_when_their_arguments_come_in_another_order():
    s = scene()
    form = ufl.inner(s.v, s.w) * ufl.dx
    mass = ufl.inner(s.y, s.z) * s.spline.dx
    with pytest.raises(ValueError, match=r"^residual = .*: a form, and then the unknown is required"):
        FiniteElementSystem(s.v, form)
    with pytest.raises(ValueError, match=r"^x = .*: the unknown function, after the residual is required"):
        FiniteElementSystem(form, s.w)
    with pytest.raises(ValueError, match=r"^residual = .*: a form, after the space is required"):
        SplineSystem(s.spline, s.y, mass)
    with pytest.raises(ValueError, match=r"^where = 0: a predicate is required, after the space and the component"):
        compat.pin_component(s.v.function_space, lambda x: x[0] == 0.0, 0)
