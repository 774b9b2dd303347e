"""Conditions on named facets: what is imposed at which nodes and when, and what enters the residual."""

import numpy as np
import pytest
import ufl
from mpi4py import MPI
from dolfinx import fem
from flows import MU, RHO, assembled, randomise

from tigar_x import compat
from tigar_x.fem.schemes import backward_euler, generalized_alpha
from varmint.conditions import Resistance, Slip, Traction, Velocity, WeakVelocity
from varmint.flow import Flow, FlowOptions
from varmint.forms import ale
from varmint.forms.boundary import stable_neumann, weak_dirichlet, weak_slip
from varmint.forms.motion import PrescribedMotion
from varmint.forms.space import split
from varmint.forms.vms import element_metric, interior_residual, stress
from varmint.mesh import box, named

SIDES = ("left", "right", "bottom", "top")
FACES = (*SIDES, "back", "front")
DT = 0.5


def square(n=2, cell=None):
    return box(MPI.COMM_WORLD, (0.0, 0.0), (1.0, 1.0), (n, n), cell)


def cube(cell=None):
    return box(MPI.COMM_WORLD, (0.0, 0.0, 0.0), (1.0, 1.0, 1.0), (2, 2, 1), cell)


def flow_with(*conditions, mesh=None, moving=None, **options):
    """A flow with no stress on the sides that have no condition."""
    mesh = square() if mesh is None else mesh
    used = {name for condition in conditions for name in condition.groups}
    free = tuple(name for name in mesh.facet_names if name not in used)
    rest = [Traction(free)] if free else []
    scheme = generalized_alpha(0.5) if moving is None else moving.scheme
    given = dict(rho=RHO, mu=MU, dt=DT, scheme=scheme, moving=moving and moving.mesh_motion)
    return Flow(mesh, [*rest, *conditions], **(given | options))


class Moving:
    """A mesh that is sheared at a constant rate."""

    def __init__(self, mesh, scheme=None, rate=0.3):
        self.scheme = generalized_alpha(0.5) if scheme is None else scheme
        self.rate = rate
        d = mesh.domain.geometry.dim

        def displacement(x, t):
            return ufl.as_vector([rate * t * x[1], *[0.0] * (d - 1)])

        self.mesh_motion = PrescribedMotion(mesh, displacement, DT, self.scheme)
        self.mesh_motion.move()


def prescribed(flow):
    """Coordinates of this rank's nodes, and what is prescribed there; NaN: nothing. Shape (nodes, d + 1)."""
    for update in flow.updates:
        update(float(flow.time.t_alpha.value))
    u = fem.Function(flow.V)
    u.x.array[:] = np.nan
    compat.apply_values(u, flow.bcs)
    size = u.ufl_shape[0]
    return flow.V.tabulate_dof_coordinates()[:, : size - 1], u.x.array.reshape(-1, size)


def on(x, side):
    """Which nodes lie on a side of the unit square or cube."""
    i = FACES.index(side)
    return np.isclose(x[:, i // 2], float(i % 2))


# -- strong values ----------------------------------------------------------------------------------------------------


@pytest.mark.mpi
@pytest.mark.parametrize("degree", [1, 2])
@pytest.mark.parametrize("cell", [None, "quadrilateral"])
def test_values_at_the_nodes_of_named_facets_and_the_last_condition_at_corners(cell, degree):
    values = {"bottom": (1.0, 2.0), "left": (3.0, 4.0), "top": (5.0, 6.0)}
    for order in (("bottom", "left", "top"), ("top", "left", "bottom"), ("left", "top", "bottom")):
        conditions = [Velocity(name, values[name]) for name in order]
        x, u = prescribed(flow_with(*conditions, mesh=square(cell=cell), degree=degree))
        expected = np.full_like(u, np.nan)
        for name in order:
            expected[on(x, name), :2] = values[name]
        np.testing.assert_array_equal(u, expected)


@pytest.mark.mpi
def test_kinds_of_data():
    """Numbers, arrays, Constants, UFL, functions and callables say the same."""
    mesh = square()
    constant, x = fem.Constant(mesh.domain, (0.25, -2.0)), ufl.SpatialCoordinate(mesh.domain)
    function = fem.Function(compat.lagrange_space(mesh.domain, 1, 2))
    compat.interpolate(function, constant)
    kinds = [
        (0.25, -2.0),
        [0.25, -2.0],
        np.array([0.25, -2.0]),
        constant,
        function,
        ufl.as_vector([0.25 + 0 * x[0], -2.0]),
        lambda x, t: (0.25, -2.0),
        lambda x, t: ufl.as_vector([0.25, -2.0 + 0 * t]),
        lambda x, t: [0.25, constant[1]],
    ]
    for data in kinds:
        at, u = prescribed(flow_with(Velocity("top", data), mesh=mesh))
        expected = np.full_like(u, np.nan)
        expected[on(at, "top"), :2] = 0.25, -2.0
        np.testing.assert_allclose(u, expected, rtol=1e-15)


@pytest.mark.mpi
def test_what_varies_is_brought_along():
    """A Constant that is changed and the time; what cannot vary is interpolated once."""
    mesh = square()
    speed = fem.Constant(mesh.domain, 2.0)
    flow = flow_with(
        Velocity("left", lambda x, t: ufl.as_vector([speed * x[1], 3.0 * t])), Velocity("top", (1.0, 1.0)), mesh=mesh
    )
    assert len(flow.updates) == 2  # one a component of the first
    for factor, time in ((2.0, DT), (5.0, 2 * DT)):
        speed.value = factor
        x, u = prescribed(flow)
        left = on(x, "left") & ~on(x, "top")
        np.testing.assert_allclose(
            u[left, :2], np.column_stack([factor * x[left, 1], 0 * x[left, 1] + 3 * time]), atol=1e-15
        )
        flow.time.advance()


@pytest.mark.mpi
@pytest.mark.parametrize(("components", "free"), [((0,), [1]), ((1,), [0]), ((0, 1), []), ((), [0, 1])])
def test_single_components(components, free):
    x, u = prescribed(flow_with(Velocity("right", (1.5, 2.5), components)))
    right = on(x, "right")
    for i in range(2):
        np.testing.assert_array_equal(u[right, i], np.nan if i in free else 1.5 + i)
    assert np.isnan(u[~right]).all()
    assert np.isnan(u[:, 2]).all()


@pytest.mark.mpi
def test_a_component_leaves_the_other_to_earlier_conditions():
    x, u = prescribed(flow_with(Velocity("left", (1.0, 2.0)), Velocity("top", (7.0, 8.0), [1])))
    corner = on(x, "left") & on(x, "top")
    np.testing.assert_array_equal(u[corner, :2], np.broadcast_to((1.0, 8.0), (corner.sum(), 2)))


@pytest.mark.mpi
@pytest.mark.parametrize("scheme", [backward_euler(), generalized_alpha(0.5)], ids=["euler", "alpha"])
def test_strong_data_belong_to_the_end_of_a_step_and_weak_data_to_its_equations(scheme):
    mesh = square()
    t_alpha = scheme.alpha_f * DT

    def data(x, t):
        return ufl.as_vector([t, 2 * t * x[1]])

    strong = flow_with(Velocity("left", data), mesh=mesh, scheme=scheme)
    x, u = prescribed(strong)
    left = on(x, "left")
    np.testing.assert_allclose(u[left, :2], DT * np.column_stack([np.ones(left.sum()), 2 * x[left, 1]]), atol=1e-15)

    y = ufl.SpatialCoordinate(mesh.domain)
    for kind in (WeakVelocity, Traction, lambda name, value: Traction(name, inflow=value)):
        forms = []
        for value in (data, data(y, t_alpha), data(y, DT)):
            flow = flow_with(kind("left", value), mesh=mesh, scheme=scheme)
            randomise(flow.w, 1)
            randomise(flow.time.x_old, 2)
            for state in (flow.w, flow.time.x_old):
                state.x.array[compat.component_space(flow.V, 0)[1]] += 2.0  # so that all of the side is an inlet
            (form,) = compat.compile_forms(dict(flow.terms)["left",])
            forms.append(assembled(form, flow.V))
        timed, level, end = forms
        assert (timed - level).norm() < 1e-12 * level.norm()
        assert ((level - end).norm() < 1e-12 * end.norm()) is (scheme.alpha_f == 1.0)


@pytest.mark.mpi
def test_on_a_moving_mesh_data_belong_to_present_coordinates():
    mesh = square()
    moving = Moving(mesh)
    x, u = prescribed(flow_with(Velocity("top", lambda x, t: x), mesh=mesh, moving=moving))
    top = on(x, "top")
    np.testing.assert_allclose(u[top, :2], x[top] + [moving.rate * DT, 0.0], rtol=1e-14, atol=1e-15)


@pytest.mark.mpi
def test_no_slip_is_the_velocity_of_the_mesh():
    mesh = square()
    for moving, speed in ((None, 0.0), (Moving(mesh), 0.3)):
        x, u = prescribed(flow_with(Velocity(("top", "right")), mesh=mesh, moving=moving))
        walls = on(x, "top") | on(x, "right")
        expected = np.column_stack([speed * x[walls, 1], 0 * x[walls, 0]])
        np.testing.assert_allclose(u[walls, :2], expected, rtol=1e-12, atol=1e-15)
        assert np.isnan(u[~walls]).all()


@pytest.mark.mpi
def test_walls_of_a_mesh_that_accelerates_have_its_velocity_at_the_end_or_at_the_level_of_the_equations():
    """The former where the velocity is held, the latter in the forms; at rest at first, the mesh shears."""
    mesh, scheme = square(), generalized_alpha(0.5)
    motion = PrescribedMotion(mesh, lambda x, t: ufl.as_vector([0.3 * t**2 * (1 + x[1]), 0.0 * t]), DT, scheme)
    motion.move()
    at = motion.time.x.function_space.tabulate_dof_coordinates()
    rates = motion.time.rates()[0].reshape(-1, 2)[:, 0] / (1 + at[:, 1])
    speed = rates[0]
    np.testing.assert_allclose(rates, speed, rtol=1e-12)

    def flow(weak):
        conditions = [Slip("left", strong_if_moving=True), Velocity("top"), weak, Traction("bottom")]
        return Flow(mesh, conditions, rho=RHO, mu=MU, dt=DT, scheme=scheme, moving=motion)

    made = flow(WeakVelocity("right"))
    x, u = prescribed(made)
    left, top = on(x, "left"), on(x, "top")
    np.testing.assert_allclose(u[left | top, 0], speed * (1 + x[left | top, 1]), rtol=1e-12)
    assert np.isnan(u[left & ~top, 1]).all()
    given = flow(WeakVelocity("right", lambda x, t: ufl.as_vector([scheme.alpha_f * speed * (1 + x[1]), 0 * x[0]])))
    found, expected = (assembled(compat.compile_forms(dict(f.terms)["right",])[0], f.V) for f in (made, given))
    assert (found - expected).norm() < 1e-12 * expected.norm()


# -- slip -------------------------------------------------------------------------------------------------------------


@pytest.mark.mpi
@pytest.mark.parametrize("cell", [None, "quadrilateral"])
def test_slip_on_the_sides_of_a_rectangle_is_strong(cell):
    """Several sides of different directions in one condition; nothing is imposed along them."""
    flow = flow_with(Slip(("left", "top", "right")), mesh=square(cell=cell))
    assert [groups for groups, _ in flow.terms] == [("fluid",), ("bottom",)]
    x, u = prescribed(flow)
    expected = np.full_like(u, np.nan)
    expected[on(x, "left") | on(x, "right"), 0] = 0.0
    expected[on(x, "top"), 1] = 0.0
    np.testing.assert_array_equal(u, expected)


@pytest.mark.mpi
@pytest.mark.parametrize("cell", [None, "hexahedron"])
def test_slip_on_the_sides_of_a_box_is_strong(cell):
    x, u = prescribed(flow_with(Slip(("left", "back")), Slip("top"), mesh=cube(cell)))
    expected = np.full_like(u, np.nan)
    for side, axis in (("left", 0), ("top", 1), ("back", 2)):
        expected[on(x, side), axis] = 0.0
    np.testing.assert_array_equal(u, expected)


def sheared(slope=0.5):
    """The square with its left and right sides inclined: x = y_1 + slope y_2."""
    mesh = square(3)
    x = mesh.domain.geometry.x
    x[:, 0] += slope * x[:, 1]
    return mesh


@pytest.mark.mpi
def test_slip_on_an_inclined_wall_is_weak():
    """A condition with any such facet is weak as a whole; one without stays strong."""
    flow = flow_with(Slip(("left", "top")), Slip("bottom"), mesh=sheared())
    assert [groups for groups, _ in flow.terms] == [("fluid",), ("right",), ("left", "top")]
    x, u = prescribed(flow)
    expected = np.full_like(u, np.nan)
    expected[np.isclose(x[:, 1], 0.0), 1] = 0.0
    np.testing.assert_array_equal(u, expected)


@pytest.mark.mpi
def test_slip_on_a_curved_wall_is_weak():
    mesh = square(4)
    mesh.domain.geometry.x[:, 1] *= 1.0 + 0.2 * np.sin(np.pi * mesh.domain.geometry.x[:, 0])
    flow = flow_with(Slip("top"), Slip("bottom"), mesh=mesh)
    assert [groups for groups, _ in flow.terms] == [("fluid",), ("left", "right"), ("top",)]


@pytest.mark.mpi
@pytest.mark.parametrize("strong", [False, True])
def test_slip_on_a_moving_mesh(strong):
    """Weak, whatever the wall's direction at rest, unless the scene says that it keeps it."""
    mesh = square()
    moving = Moving(mesh)
    flow = flow_with(Slip("top", strong_if_moving=strong), mesh=mesh, moving=moving)
    assert (("top",) in dict(flow.terms)) is not strong
    x, u = prescribed(flow)
    assert np.isnan(u[:, 0]).all()
    np.testing.assert_array_equal(u[on(x, "top"), 1], 0.0 if strong else np.nan)


@pytest.mark.mpi
def test_strong_slip_on_a_moving_mesh_has_its_velocity():
    mesh = square()
    motion = PrescribedMotion(mesh, lambda x, t: ufl.as_vector([0.2 * t * x[0], 0.0 * t]), DT, backward_euler())
    motion.move()
    conditions = [Traction(("left", "bottom", "top")), Slip("right", strong_if_moving=True)]
    x, u = prescribed(Flow(mesh, conditions, rho=RHO, mu=MU, dt=DT, scheme=backward_euler(), moving=motion))
    np.testing.assert_allclose(u[on(x, "right"), 0], 0.2, rtol=1e-13)
    assert np.isnan(u[on(x, "right"), 1]).all()


class Wall:
    """A fluid with a weak slip condition on the inclined sides, and functions of its state."""

    def __init__(self):
        self.mesh = sheared()
        self.flow = flow_with(Slip(("left", "right")), mesh=self.mesh, dt=None, scheme=None)
        self.form = dict(self.flow.terms)["left", "right"]
        self.n = ufl.FacetNormal(self.mesh.domain)

    def vector(self, v, p=0.0, form=None):
        x = ufl.SpatialCoordinate(self.mesh.domain)
        compat.interpolate(self.flow.w, ufl.as_vector([*v(x), p]))
        return assembled(compat.compile_forms(self.form if form is None else form)[0], self.flow.V)


@pytest.mark.mpi
def test_flow_along_a_wall_without_traction_on_it_leaves_nothing():
    """The normal part of the traction alone counts: along the wall the flow may be sheared."""
    wall = Wall()
    along = wall.vector(lambda x: (0.5, 1.0))
    sheared_along = wall.vector(lambda x: (0.5 * (x[0] - 0.5 * x[1]), x[0] - 0.5 * x[1]))
    scale = wall.vector(lambda x: (1.0, -0.5)).norm()
    assert along.norm() < 1e-13 * scale
    assert sheared_along.norm() < 1e-13 * scale
    assert wall.vector(lambda x: (0.5, 1.0), p=1.0).norm() > 1e-3 * scale


@pytest.mark.mpi
def test_only_the_normal_traction_is_in_a_slip_condition():
    """-(n . sigma n) (w . n) is left where the flow is along the wall."""
    wall = Wall()
    f = wall.flow.fields
    expected = -ufl.dot(wall.n, stress(f.v, f.p, f.mu) * wall.n) * ufl.dot(f.w, wall.n) * f.ds(("left", "right"))

    def shear(x):
        return 0.5 * x[1] ** 2, x[1] ** 2

    found, traction = wall.vector(shear, 0.7), wall.vector(shear, 0.7, expected)
    assert (found - traction).norm() < 1e-12 * traction.norm()


@pytest.mark.mpi
def test_energy_of_weak_slip():
    """w = v, q = p: pressures cancel, the viscous parts are equal, inflow and penalty cost energy."""
    wall = Wall()
    flow, f = wall.flow, wall.flow.fields
    randomise(flow.w, 4)
    n = wall.n
    v_n, strain = ufl.dot(f.v, n), ufl.dot(n, ufl.sym(ufl.grad(f.v)) * n)
    G_nn = ufl.dot(n, element_metric(wall.mesh.domain) * n)
    ds = f.ds(("left", "right"))
    inflow = ufl.conditional(ufl.lt(v_n, 0), -v_n, 0.0)
    parts = [-4 * MU * strain * v_n * ds, RHO * inflow * v_n**2 * ds, 1e3 * MU * ufl.sqrt(G_nn) * v_n**2 * ds]
    form, *expected = compat.compile_forms(wall.form, *parts)
    power = assembled(form, flow.V).dot(compat.petsc_vector(flow.w))
    expected = [compat.assemble_scalar(part) for part in expected]
    assert min(np.abs(expected)) > 1e-4
    assert expected[1] > 0.0
    assert expected[2] > 0.0
    assert power == pytest.approx(sum(expected), rel=1e-12)


@pytest.mark.mpi
def test_weak_slip_follows_the_mesh():
    """Of a fluid that moves as the wall does the normal traction alone is left, and more of a fluid at rest."""
    mesh = square()
    moving = Moving(mesh)
    flow = flow_with(Slip(("left", "right")), mesh=mesh, moving=moving)
    f, x = flow.fields, ufl.SpatialCoordinate(mesh.domain)
    n = ale.normal(mesh.domain, f.motion)
    traction = -ufl.dot(n, stress(f.v, f.p, f.mu, f.motion) * n) * ufl.dot(f.w, n)
    traction = ale.per_area(traction, mesh.domain, f.motion) * f.ds(("left", "right"))
    forms = compat.compile_forms(dict(flow.terms)["left", "right"], traction)
    for speed in (moving.rate, 0.0):
        compat.interpolate(flow.w, ufl.as_vector([speed * x[1], 0.0, 0.7]))
        flow.time.x_old.x.array[:] = flow.w.x.array
        found, expected = (assembled(form, flow.V) for form in forms)
        assert ((found - expected).norm() < 1e-12 * expected.norm()) is (speed == moving.rate)


@pytest.mark.mpi
def test_options_of_a_flow_and_of_its_conditions_reach_the_forms():
    mesh = sheared()
    weak = WeakVelocity("top", (1.0, 2.0), symmetric=False, penalty=7.0)
    options = FlowOptions(invariant_metric=True, C_I=5.0, C_t=9.0)
    flow = flow_with(weak, Slip("left", penalty=11.0), mesh=mesh, f=(0.3, -0.2), options=options)
    randomise(flow.w, 1)
    randomise(flow.time.x_old, 2)
    f, domain = flow.fields, mesh.domain
    fields, common = (f.v, f.p, f.w, f.q), dict(rho=f.rho, mu=f.mu, invariant=True)
    unsteady = dict(v_t=split(flow.time.xdot_alpha)[0], dt=flow.time.dt, f=ufl.as_vector([0.3, -0.2]))
    expected = {
        ("fluid",): interior_residual(
            *fields, domain, C_I=5.0, C_t=9.0, dx=mesh.dx(degree=f.degree), **unsteady, **common
        ),
        ("top",): weak_dirichlet(
            *fields, ufl.as_vector([1.0, 2.0]), domain, f.ds(("top",)), symmetric=False, penalty=7.0, **common
        ),
        ("left",): weak_slip(*fields, domain, f.ds(("left",)), penalty=11.0, **common),
    }
    for groups, form in expected.items():
        found, wanted = (assembled(part, flow.V) for part in compat.compile_forms(dict(flow.terms)[groups], form))
        assert (found - wanted).norm() < 1e-12 * wanted.norm(), groups


# -- open boundaries --------------------------------------------------------------------------------------------------


@pytest.mark.mpi
@pytest.mark.parametrize("gamma", [0.5, 1.0])
@pytest.mark.parametrize("kind", ["traction", "resistance", "together"])
def test_backflow_is_counted_once(kind, gamma):
    """Uniform flow in through the left side and out through the right one: gamma rho |v.n| v on the left, in all."""
    h = (0.0, 0.0) if kind == "traction" else None
    conditions = {
        "traction": [Traction("left", h, gamma), Traction("right", gamma=gamma)],
        "resistance": [Resistance("left", 3.0, gamma=gamma), Resistance("right", 3.0, gamma=gamma)],
        "together": [Traction(("left", "right"), gamma=gamma)],
    }[kind]
    flow = flow_with(*conditions, Velocity(("bottom", "top"), (2.0, 1.0)), dt=None, scheme=None)
    compat.interpolate(flow.w, ufl.as_vector([2.0, 1.0, 0.0]))
    total = sum(form for groups, form in flow.terms if groups != ("fluid",))
    force = assembled(compat.compile_forms(total)[0], flow.V).array_r.reshape(-1, 3).sum(axis=0)
    force = MPI.COMM_WORLD.allreduce(force, op=MPI.SUM)
    np.testing.assert_allclose(force, [gamma * RHO * 2.0 * 2.0, gamma * RHO * 2.0 * 1.0, 0.0], atol=1e-13)


@pytest.mark.mpi
def test_what_comes_back_in_may_have_a_velocity():
    flow = flow_with(Traction("left", inflow=(2.0, 1.0)), Traction("right"), dt=None, scheme=None)
    compat.interpolate(flow.w, ufl.as_vector([2.0, 1.0, 0.0]))
    assert assembled(compat.compile_forms(dict(flow.terms)["left",])[0], flow.V).norm() < 1e-14
    compat.interpolate(flow.w, ufl.as_vector([2.0, 1.5, 0.0]))
    assert assembled(compat.compile_forms(dict(flow.terms)["left",])[0], flow.V).norm() > 0.1


@pytest.mark.mpi
def test_traction_and_pressure_behind_an_outlet():
    """A pressure p_0 + R Q is the traction -(p_0 + R Q) n."""
    flow = flow_with(Resistance("right", 4.0, 0.5), Velocity("left", (0.0, 0.0)), dt=None, scheme=None)
    compat.interpolate(flow.w, ufl.as_vector([ufl.SpatialCoordinate(flow.mesh.domain)[1], 0.0, 9.0]))
    flow.system.assemble_residual()  # brings the outlet's pressure along
    f = flow.fields
    n = ufl.FacetNormal(flow.mesh.domain)
    expected = stable_neumann(f.v, f.w, flow.mesh.domain, f.ds(("right",)), rho=RHO, traction=-2.5 * n)
    found, expected = (assembled(form, flow.V) for form in compat.compile_forms(dict(flow.terms)["right",], expected))
    assert (found - expected).norm() < 1e-14 * expected.norm()
    assert expected.norm() > 1.0


@pytest.mark.mpi
def test_an_outlet_on_a_moving_mesh_is_where_it_lies_at_the_level_of_the_equations():
    """The right side tilts to x = 1 + tilt y: its area times its normal is (1, -tilt)."""
    mesh = square()
    moving = Moving(mesh)
    flow = flow_with(Resistance("right", 4.0, 0.5, gamma=0.0), mesh=mesh, moving=moving)
    turned = np.array([1.0, -moving.rate * DT * moving.scheme.alpha_f])
    velocity = np.array([3.0, 1.0])
    compat.interpolate(flow.w, ufl.as_vector([*velocity, 0.0]))
    flow.time.x_old.x.array[:] = flow.w.x.array
    (outlet,) = flow.rank_one
    assert outlet.flow_rate() == pytest.approx(velocity @ turned, rel=1e-13)
    outlet.update()
    pressure = 0.5 + 4.0 * (velocity @ turned)
    assert float(outlet.pressure.value) == pytest.approx(pressure, rel=1e-13)
    forms = compat.compile_forms(outlet.load, outlet.slope, dict(flow.terms)["right",])
    for form, factor in zip(forms, (1.0, 4.0 * moving.scheme.alpha_f, pressure), strict=True):
        total = assembled(form, flow.V).array_r.reshape(-1, 3).sum(axis=0)
        total = MPI.COMM_WORLD.allreduce(total, op=MPI.SUM)
        np.testing.assert_allclose(total, [*(factor * turned), 0.0], rtol=1e-12, atol=1e-14)


@pytest.mark.mpi
@pytest.mark.parametrize(
    ("condition", "is_closed"),
    [
        (Velocity("right", (1.0, 0.0)), True),
        (Velocity("right", (1.0, 0.0), (0, 1)), True),
        (Velocity("right", (1.0, 0.0), (0,)), True),
        (Velocity("right", (1.0, 0.0), (1,)), False),
        (WeakVelocity("right"), True),
        (Slip("right"), True),
        (Traction("right"), False),
        (Resistance("right"), False),
    ],
)
def test_what_determines_the_pressure(condition, is_closed):
    walls = Velocity(("left", "bottom", "top"))
    flow = Flow(square(), [walls, condition], rho=RHO, mu=MU, dt=DT)
    assert flow.is_closed is is_closed
    assert (len(flow.bcs) == len(flow._bcs)) is not is_closed  # the pinned pressure of a small closed flow


@pytest.mark.mpi
def test_one_component_on_an_inclined_wall_leaves_its_normal_free():
    walls = Velocity(("right", "bottom", "top"))
    for components, is_closed in (((0,), False), ((1,), False), ((0, 1), True)):
        flow = Flow(sheared(), [walls, Velocity("left", (0.0, 0.0), components)], rho=RHO, mu=MU, dt=DT)
        assert flow.is_closed is is_closed


# -- bad input --------------------------------------------------------------------------------------------------------

ONE_OF = "one of 'left', 'right', 'bottom', 'top' is required"


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Velocity("outlet"), rf"^facet group 'outlet' does not exist: {ONE_OF}"),
        (lambda: Slip(("left", "lid")), rf"^facet group 'lid' does not exist: {ONE_OF}"),
        (lambda: Traction("lid"), "^facet group 'lid' does not exist"),
        (lambda: WeakVelocity("lid"), "^facet group 'lid' does not exist"),
        (lambda: Resistance("lid"), "^facet group 'lid' does not exist"),
        (lambda: Velocity((1.0, 0.0), "left"), r"^on = \(1\.0, 0\.0\): the name of a facet group is required"),
        (lambda: Velocity(()), "^on is empty: the name of a facet group is required"),
        (lambda: Velocity("left", (1.0, 2.0, 3.0)), r"^Velocity\('left'\)\.value has shape \(3,\): shape \(2,\)"),
        (lambda: Velocity("left", (1.0,)), r"^Velocity\('left'\)\.value has shape \(1,\): shape \(2,\)"),
        (lambda: Velocity("left", 1.0), r"^Velocity\('left'\)\.value = 1.0: a vector of shape \(2,\) is required"),
        (lambda: Velocity("left", ufl.Identity(2)), r"^Velocity\('left'\)\.value has shape \(2, 2\): shape \(2,\)"),
        (lambda: Velocity("left", lambda x, t: x[0]), r"^Velocity\('left'\)\.value has shape \(\): shape \(2,\)"),
        (lambda: WeakVelocity(("left", "top"), (1.0, 2.0, 3.0)), r"^WeakVelocity\('left', 'top'\)\.value has shape"),
        (lambda: Traction("left", (1.0, 2.0, 3.0)), r"^Traction\('left'\)\.value has shape \(3,\)"),
        (lambda: Traction("left", inflow=(1.0,)), r"^Traction\('left'\)\.inflow has shape \(1,\)"),
        (lambda: Velocity("left", (np.nan, 0.0)), r"^Velocity\('left'\)\.value\[0\] = nan: a finite number"),
        (lambda: Velocity("left", lambda x, t: (0.0, np.inf)), r"^Velocity\('left'\)\.value\[1\] = inf: a finite"),
        (lambda: Traction("left", (0.0, -np.inf)), r"^Traction\('left'\)\.value\[1\] = -inf: a finite number"),
        (lambda: Velocity("left", np.array([0.0, np.nan])), r"^Velocity\('left'\)\.value\[1\] = nan"),
        (lambda: Velocity("left", (0.0, 1.0), (2,)), r"^Velocity\('left'\)\.components = 2: one of 0, 1 is required"),
        (lambda: Velocity("left", components=(-1,)), r"^Velocity\('left'\)\.components = -1: one of 0, 1"),
        (lambda: WeakVelocity("left", penalty=-1.0), "^penalty = -1.0: a number >= 0"),
        (lambda: Traction("left", gamma=-0.5), "^gamma = -0.5: a number >= 0"),
        (lambda: Resistance("left", -1.0), "^resistance = -1.0: a number >= 0"),
        (lambda: Resistance("left", np.nan), "^resistance = nan"),
        (lambda: Resistance("left", 1.0, np.inf), "^pressure = inf: a finite number"),
        (lambda: Resistance("left", gamma=-1.0), "^gamma = -1.0: a number >= 0"),
    ],
)
def test_bad_conditions(make, message):
    with pytest.raises(ValueError, match=message):
        flow_with(make())


def test_a_constant_that_is_not_finite():
    mesh = square()
    bad = fem.Constant(mesh.domain, (1.0, np.nan))
    with pytest.raises(ValueError, match=r"^Velocity\('left'\)\.value\[1\] = nan: finite numbers are required"):
        flow_with(Velocity("left", bad), mesh=mesh)


def test_penalty_of_a_weak_slip():
    with pytest.raises(ValueError, match=r"^penalty = -1.0: a number >= 0"):
        flow_with(Slip("left", penalty=-1.0), mesh=sheared())


@pytest.mark.mpi
@pytest.mark.parametrize(
    ("conditions", "message"),
    [
        (
            [Velocity(("left", "top"))],
            "4 of 8 boundary facets have no condition: .* without one are 'right', 'bottom'$",
        ),
        ([Velocity(SIDES[:3])], "2 of 8 boundary facets have no condition: .* without one are 'top'$"),
        ([Velocity(SIDES), Slip("left")], "^facet group 'left' has two conditions: one is allowed"),
        ([Velocity((*SIDES, "left"))], "^facet group 'left' has two conditions"),
        ([], "^conditions is empty: every boundary facet needs one"),
    ],
)
def test_every_boundary_facet_needs_one_condition(conditions, message):
    with pytest.raises(ValueError, match=message):
        Flow(square(), conditions, rho=RHO, mu=MU, dt=DT)


@pytest.mark.mpi
def test_facets_of_no_group():
    mesh = named(square().domain, left=lambda x: np.isclose(x[0], 0.0))
    with pytest.raises(ValueError, match=r"6 of 8 .* without one are none, but some facets belong to no group"):
        Flow(mesh, [Velocity("left")], rho=RHO, mu=MU, dt=DT)
