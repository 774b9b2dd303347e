"""Quantities derived from a flow: exact for polynomials, exact forces, and values at points and nodes."""

import numpy as np
import pytest
import ufl
from mpi4py import MPI
from dolfinx import fem

from tigar_x import compat
from tigar_x.fem.schemes import backward_euler, generalized_alpha
from varmint.conditions import Slip, Traction, Velocity, WeakVelocity
from varmint.flow import Flow, FlowOptions
from varmint.forms.motion import ElasticMotion, PrescribedMotion
from varmint.forms.solids import Solid, StVenantKirchhoffSolid
from varmint.mesh import box, grid, named
from varmint.mesh.arrays import from_arrays
from varmint.quantities import (
    BoundaryForce,
    Measured,
    NodalField,
    NodeValues,
    PointValues,
    area,
    dissipation,
    flow_rate,
    kinetic_energy,
    squared_divergence,
    volume,
    vorticity,
    wall_shear_stress,
)

COMM = MPI.COMM_WORLD
SIDES = ("left", "right", "bottom", "top")
FACES = (*SIDES, "back", "front")
RHO, MU = 1.3, 0.7
GRAVITY = np.array([0.4, -2.0])


def brick(cell="triangle", n=3):
    d = 3 if cell in ("tetrahedron", "hexahedron") else 2
    return box(COMM, (0.0,) * d, (1.0,) * d, (n,) * d, cell)


def still(mesh, degree=1, **options):
    """A flow whose state is set by hand."""
    return Flow(mesh, [Velocity(mesh.facet_names)], rho=RHO, mu=MU, degree=degree, **options)


# -- functionals ------------------------------------------------------------------------------------------------------


def functionals(flow):
    rates = {name: flow_rate(flow, name) for name in flow.mesh.facet_names}
    return Measured(
        **rates,
        everywhere=flow_rate(flow, *flow.mesh.facet_names),
        area=area(flow, "left", "top"),
        volume=volume(flow),
        kinetic_energy=kinetic_energy(flow),
        dissipation=dissipation(flow),
        squared_divergence=squared_divergence(flow),
    )


def quadratic(x, t=None):
    return ufl.as_vector([x[0] ** 2, x[0] * x[1], *[0 * x[0]] * (len(x) - 2)])


@pytest.mark.mpi
@pytest.mark.parametrize("cell", ["triangle", "quadrilateral", "tetrahedron"])
def test_functionals_of_a_quadratic_flow(cell):
    """v = (x^2, x y) in the unit square or cube."""
    flow = still(brick(cell, 2), degree=2)
    flow.start(quadratic)
    found = functionals(flow)()
    expected = {
        **dict.fromkeys(FACES[: 2 * flow.mesh.domain.geometry.dim], 0.0),
        "right": 1.0,
        "top": 1 / 2,
        "everywhere": 3 / 2,
        "area": 2.0,
        "volume": 1.0,
        "kinetic_energy": RHO / 2 * (1 / 5 + 1 / 9),
        "dissipation": 2 * MU * (5 / 3 + 1 / 6),
        "squared_divergence": 3.0,
    }
    assert found == pytest.approx(expected, rel=1e-12, abs=1e-14)


@pytest.mark.mpi
@pytest.mark.parametrize("degree", [1, 2])
def test_functionals_on_a_moved_mesh(degree):
    """Those of the state at the end of the step, on the mesh where it lies then."""
    A, b = np.array([[1.2, 0.3], [-0.1, 0.8]]), np.array([0.2, -0.4])
    displacement = A - np.eye(2)

    def move(x, t):
        return ufl.dot(ufl.as_matrix(displacement.tolist()), x) + t * ufl.as_vector(b.tolist())

    mesh, there = brick(), brick()
    moving = PrescribedMotion(mesh, move, 0.5, generalized_alpha(0.5), degree)
    moving.move()
    flow = still(mesh, degree=2, dt=0.5, moving=moving)
    x = there.domain.geometry.x
    x[:, :2] = x[:, :2] @ A.T + 0.5 * b
    fixed = still(there, degree=2)
    fixed.start(quadratic)
    flow.w.x.array[:] = fixed.w.x.array
    found, expected = functionals(flow)(), functionals(fixed)()
    assert found == pytest.approx(expected, rel=1e-12, abs=1e-14)
    assert found["volume"] == pytest.approx(np.linalg.det(A), rel=1e-13)
    unmoved = still(brick(), degree=2)
    unmoved.w.x.array[:] = fixed.w.x.array
    assert all(value != pytest.approx(expected[name], rel=1e-3) for name, value in functionals(unmoved)().items())


@pytest.mark.mpi
def test_functionals_are_those_of_the_fluid():
    """The cells of a solid do not count."""
    flow, _ = beam()
    flow.w.x.array.reshape(-1, 3)[:, 0] = 1.0
    found = Measured(V=volume(flow), K=kinetic_energy(flow))()
    assert found == pytest.approx({"V": 1.5 - 0.2, "K": RHO / 2 * 1.3}, rel=1e-12)


@pytest.mark.parametrize("make", [flow_rate, area, wall_shear_stress])
def test_groups_have_to_exist(make):
    flow = still(brick())
    with pytest.raises(ValueError, match=r"^facet group 'lid' does not exist: one of 'left', 'right'"):
        make(flow, "lid")


# -- forces -----------------------------------------------------------------------------------------------------------


@pytest.mark.mpi
@pytest.mark.parametrize("options", [dict(), dict(dt=0.1)], ids=["steady", "step"])
def test_walls_carry_the_weight_of_a_fluid_at_rest(options):
    flow = Flow(brick(), [Velocity(SIDES)], rho=RHO, mu=MU, f=GRAVITY, **options)
    force = BoundaryForce(flow, *SIDES)
    found = flow.take_step(force).measured if flow.time else (flow.solve(), force())[1]
    np.testing.assert_allclose(found, RHO * GRAVITY, rtol=1e-10)


@pytest.mark.mpi
def test_walls_of_a_box_in_space_carry_the_weight():
    flow = Flow(brick("tetrahedron", 2), [Velocity(FACES)], rho=RHO, mu=MU, f=(1.0, -2.0, 3.0))
    flow.solve()
    np.testing.assert_allclose(BoundaryForce(flow, *FACES)(), RHO * np.array([1.0, -2.0, 3.0]), rtol=1e-10)


def frame():
    """A square of side 3 with a square hole of side 1."""
    line = np.linspace(0.0, 3.0, 7)
    full = grid(MPI.COMM_SELF, [line, line])
    x, cells = full.domain.geometry.x[:, :2], compat.cell_nodes(full.domain)
    kept = cells[(np.abs(x[cells].mean(axis=1) - 1.5) > 0.5).any(axis=1)]
    domain = from_arrays(COMM, "triangle", kept, x).domain
    sides = [lambda p, i=i, e=e: np.isclose(p[i], e) for i in (0, 1) for e in (0.0, 3.0)]
    return named(domain, hole=lambda p: (np.abs(p[:2] - 1.5) < 0.501).all(axis=0), outer=sides)


@pytest.mark.mpi
@pytest.mark.parametrize("wall", [Velocity, WeakVelocity, Slip])
def test_buoyancy(wall):
    """The force on an obstacle in a fluid at rest is the weight of what it displaces, upwards."""
    flow = Flow(frame(), [wall("hole"), Velocity("outer")], rho=RHO, mu=MU, f=GRAVITY)
    flow.solve()
    hole, outer = BoundaryForce(flow, "hole")(), BoundaryForce(flow, "outer")()
    np.testing.assert_allclose(hole, -RHO * GRAVITY * 1.0, rtol=1e-9)
    np.testing.assert_allclose(outer, RHO * GRAVITY * 9.0, rtol=1e-9)


@pytest.mark.mpi
def test_forces_balance_the_body_force():
    """Of a cavity with convection as well: what sub-scales transport is balanced by the discrete continuity."""
    lid = Velocity("top", lambda x, t: ufl.as_vector([16 * (x[0] * (1 - x[0])) ** 2, 0 * x[0]]))

    def stir(x, t):
        return ufl.as_vector([4 * x[1] ** 2, 1 - x[0]])

    flow = Flow(brick(n=4), [Velocity(SIDES[:3]), lid], rho=RHO, mu=0.02, f=stir)
    flow.solve()
    force = BoundaryForce(flow, *SIDES)
    np.testing.assert_allclose(force(), RHO * np.array([4 / 3, 1 / 2]), rtol=1e-8)
    assert kinetic(flow) > 1e-3
    flow.w.x.array[:] *= 1.01  # another state is not in balance
    assert np.abs(force() - RHO * np.array([4 / 3, 1 / 2])).max() > 1e-3


def kinetic(flow):
    return Measured(K=kinetic_energy(flow))()["K"]


def shear(x, t=None):
    return ufl.as_vector([x[1], 0 * x[0]])


def parabola(x, t=None):
    return ufl.as_vector([x[1] * (1 - x[1]), 0 * x[0]])


def couette(top, bottom, mesh=None, **options):
    """Both ends have the traction of the flow; what enters has its velocity."""
    ends = [
        Traction("left", lambda x, t: ufl.as_vector([0 * x[0], -MU + 0 * x[0]]), inflow=shear),
        Traction("right", lambda x, t: ufl.as_vector([0 * x[0], MU + 0 * x[0]])),
    ]
    return Flow(mesh or brick(), [top, bottom, *ends], rho=RHO, mu=MU, **options)


@pytest.mark.mpi
@pytest.mark.parametrize("wall", [Velocity, WeakVelocity])
def test_couette_flow_pulls_at_its_walls(wall):
    """mu per length, against the wall that moves and along with the one that does not; strong or weak is the same."""
    flow = couette(wall("top", (1.0, 0.0)), wall("bottom"))
    flow.solve()
    np.testing.assert_allclose(BoundaryForce(flow, "top")(), [-MU, 0.0], atol=1e-10)
    np.testing.assert_allclose(BoundaryForce(flow, "bottom")(), [MU, 0.0], atol=1e-10)
    np.testing.assert_allclose(BoundaryForce(flow, "bottom", "top")(), [0.0, 0.0], atol=1e-10)


@pytest.mark.mpi
@pytest.mark.parametrize("wall", [Velocity, WeakVelocity])
def test_poiseuille_flow_pulls_at_its_walls(wall):
    """The parabola y (1 - y) and the pressure 2 mu (1 - x)."""
    ends = [
        Traction("left", lambda x, t: ufl.as_vector([2 * MU + 0 * x[0], -MU * (1 - 2 * x[1])]), inflow=parabola),
        Traction("right", lambda x, t: ufl.as_vector([0 * x[0], MU * (1 - 2 * x[1])])),
    ]
    flow = Flow(brick(), [wall("bottom"), wall("top"), *ends], rho=RHO, mu=MU, degree=2)
    flow.solve()
    np.testing.assert_allclose(BoundaryForce(flow, "bottom")(), [MU, -MU], atol=1e-8)
    np.testing.assert_allclose(BoundaryForce(flow, "top")(), [MU, MU], atol=1e-8)
    np.testing.assert_allclose(
        BoundaryForce(flow, "bottom")() + BoundaryForce(flow, "top")(),
        BoundaryForce(flow, "bottom", "top")(),
        atol=1e-12,
    )


@pytest.mark.mpi
def test_force_on_a_moving_mesh():
    """Couette flow stays what it is on a mesh whose nodes move, and so does its force."""
    mesh, euler = brick(), backward_euler()

    def swirl(x, t):
        bump = 0.1 * ufl.sin(3 * t) * ufl.sin(ufl.pi * x[0]) * ufl.sin(ufl.pi * x[1])
        return ufl.as_vector([bump, -0.7 * bump])

    moving = PrescribedMotion(mesh, swirl, 0.1, euler)
    flow = couette(
        Velocity("top", (1.0, 0.0)), Velocity("bottom"), mesh, dt=0.1, scheme=euler, moving=moving,
        options=FlowOptions(rtol=1e-11),
    )  # fmt: skip
    flow.start(shear)
    force = BoundaryForce(flow, "top")
    for _ in range(3):
        np.testing.assert_allclose(flow.take_step(force).measured, [-MU, 0.0], atol=1e-10)


@pytest.mark.mpi
def test_a_force_between_steps_is_refused_and_what_a_step_measures_is_that_of_its_equations():
    """A lid that starts to move: the force before the clocks move, which it could not be recovered from after them."""
    flow = Flow(brick(), [Velocity(SIDES[:3]), Velocity("top", (1.0, 0.0))], rho=RHO, mu=MU, dt=0.1)
    force = BoundaryForce(flow, "top")
    between = r"^the force is asked for between steps, at t = .*give it to the step as measure="
    with pytest.raises(RuntimeError, match=between + ".*report.measured"):
        force()
    flow.take_step()
    with pytest.raises(RuntimeError, match=between):
        force()
    report = flow.take_step(force)
    assert report.measured[0] < -0.1
    with pytest.raises(RuntimeError, match=between):
        force()

    def fail():
        raise KeyError("measure")

    with pytest.raises(KeyError, match="measure"):
        flow.take_step(fail)
    with pytest.raises(RuntimeError, match=between):
        force()


@pytest.mark.mpi
def test_a_step_tells_both_of_its_times_and_forces_belong_to_that_of_the_equations():
    """A weight that grows with time, in a box at rest."""
    flow = Flow(brick(), [Velocity(SIDES)], rho=RHO, mu=MU, dt=0.3, f=lambda x, t: ufl.as_vector([0 * x[0], -t]))
    force = BoundaryForce(flow, *SIDES)
    for n in range(2):
        report = flow.take_step(force)
        assert (report.t, report.t_alpha) == pytest.approx((0.3 * n + 0.3, 0.3 * n + 0.2), rel=1e-14)
        np.testing.assert_allclose(report.measured, [0.0, -RHO * report.t_alpha], rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("names", [("bottom",), ("top", "left")])
def test_a_weak_condition_on_more_than_the_groups(names):
    flow = Flow(brick(), [WeakVelocity(("bottom", "top")), Velocity("left"), Traction("right")], rho=RHO, mu=MU)
    with pytest.raises(ValueError, match=r"one shares a condition with \('bottom', 'top'\); conditions of their own"):
        BoundaryForce(flow, *names)
    BoundaryForce(flow, "bottom", "top")
    BoundaryForce(flow, "left")


def test_a_strong_condition_may_be_shared():
    flow = Flow(brick(), [Velocity(("bottom", "top", "left")), Traction("right")], rho=RHO, mu=MU)
    BoundaryForce(flow, "bottom")
    with pytest.raises(ValueError, match=r"^facet group 'lid' does not exist"):
        BoundaryForce(flow, "lid")


# -- a solid in the flow ----------------------------------------------------------------------------------------------

LENGTH, HALF = 1.0, 0.1


def beam():
    """A horizontal beam at the left wall of a box, whose right side has the pressure of the depth."""
    full = box(MPI.COMM_SELF, (0.0, 0.0), (1.5, 1.0), (12, 10))
    x, cells = full.domain.geometry.x[:, :2], compat.cell_nodes(full.domain)
    middles = x[cells].mean(axis=1)
    solid = (middles[:, 0] < LENGTH) & (np.abs(middles[:, 1] - 0.5) < HALF)
    edges = [
        {tuple(sorted(c[[i, j]])) for c in cells[part] for i, j in ((0, 1), (1, 2), (2, 0))} for part in (solid, ~solid)
    ]
    single = {}
    for c in cells:
        for i, j in ((0, 1), (1, 2), (2, 0)):
            edge = tuple(sorted(c[[i, j]]))
            single[edge] = single.get(edge, 0) + 1
    outer = np.array([edge for edge, count in single.items() if count == 1])
    at_right = np.isclose(x[outer, 0], 1.5).all(axis=1)
    mesh = from_arrays(
        COMM, "triangle", cells, x,
        facets={"interface": sorted(edges[0] & edges[1]), "right": outer[at_right], "walls": outer[~at_right]},
        cell_groups={"fluid": np.flatnonzero(~solid), "solid": np.flatnonzero(solid)},
    )  # fmt: skip
    euler = backward_euler()
    moving = ElasticMotion(mesh, {"walls": None, "right": None}, 20.0, euler, cells=("fluid",))
    depth = Traction("right", lambda x, t: ufl.as_vector([RHO * 2e-3 * (x[1] - 0.5), 0 * x[0]]))
    flow = Flow(
        mesh, [Velocity("walls", (0.0, 0.0)), depth], rho=RHO, mu=MU, dt=20.0, scheme=euler, f=(0.0, -2e-3),
        moving=moving, solid=Solid(StVenantKirchhoffSolid(1e3, 0.3, 1.0)), options=FlowOptions(rtol=1e-8),
    )  # fmt: skip
    return flow, mesh


@pytest.mark.mpi
def test_buoyancy_of_a_solid_in_the_flow():
    """The force of the fluid on the interface, at rest; the beam's root is at the wall, and has no part in it."""
    flow, _ = beam()
    force = BoundaryForce(flow, "interface")
    for _ in range(8):
        found = flow.take_step(force).measured
    assert found[1] == pytest.approx(RHO * 2e-3 * LENGTH * 2 * HALF, rel=1e-3)


# -- points -----------------------------------------------------------------------------------------------------------


@pytest.mark.mpi
@pytest.mark.parametrize("cell", ["triangle", "quadrilateral", "tetrahedron"])
def test_values_at_points(cell):
    """Inside cells, on their facets and vertices, at the mesh's corners; the same on every rank."""
    flow = still(brick(cell, 2), degree=2)
    d = flow.mesh.domain.geometry.dim
    flow.start(quadratic, lambda x, t: x[1] ** 2 - x[0])
    rng = np.random.default_rng(4)
    points = np.vstack(
        [rng.uniform(0, 1, (12, d)), np.zeros(d), np.ones(d), np.full(d, 0.5), rng.uniform(0, 1, (6, d))]
    )
    points[-6:, 0] = 0.5  # between cells, and perhaps between ranks
    x, y = points[:, 0], points[:, 1]
    values = PointValues(flow, points)
    expected = np.column_stack([x**2, x * y, *[0 * x] * (d - 2), y**2 - x])
    np.testing.assert_allclose(values(), expected, atol=1e-13)
    flow.w.x.array[:] *= 2.0
    np.testing.assert_allclose(values(), 2 * expected, atol=1e-13)
    np.testing.assert_array_equal(values.points, points)


@pytest.mark.mpi
@pytest.mark.parametrize(
    ("points", "message"),
    [
        ([[0.5, 0.5], [1.5, 0.5]], r"^points\[1\] = \[1.5, 0.5\]: a point of the mesh is required"),
        ([[0.5, -1e-3]], r"^points\[0\] = \[0.5, -0.001\]: a point of the mesh"),
        ([[0.5, 0.5, 0.5]], r"^points has shape \(1, 3\): shape \(any, 2\)"),
        ([0.5, 0.5], r"^points has shape \(2,\)"),
        ([[0.5, np.nan]], r"^points\[0, 1\] = nan: finite numbers"),
    ],
)
def test_points_that_are_not_of_the_mesh(points, message):
    flow = still(brick())
    with pytest.raises(ValueError, match=message):
        PointValues(flow, points)


# -- fields at nodes --------------------------------------------------------------------------------------------------


def own(function, size):
    """Values at this rank's own nodes, and where they lie."""
    V = function.function_space
    n = V.dofmap.index_map.size_local
    return V.tabulate_dof_coordinates()[:n], function.x.array[: n * size].reshape(n, size)


@pytest.mark.mpi
@pytest.mark.parametrize("degree", [1, 2])
def test_vorticity_of_a_rigid_rotation(degree):
    flow = still(brick(), degree=degree)
    flow.start(lambda x, t: ufl.as_vector([-1.5 * x[1], 1.5 * x[0]]))
    field = vorticity(flow)
    assert field() is field.field
    np.testing.assert_allclose(own(field.field, 1)[1], 3.0, rtol=1e-12)
    flow.start(shear)
    np.testing.assert_allclose(own(field(), 1)[1], -1.0, rtol=1e-12)
    assert field.field.name == "vorticity"


@pytest.mark.mpi
def test_vorticity_in_space():
    flow = still(brick("tetrahedron", 2))
    omega = ufl.as_vector([0.3, -0.5, 0.7])
    flow.start(lambda x, t: ufl.cross(omega, x))
    expected = np.broadcast_to([0.6, -1.0, 1.4], own(vorticity(flow)(), 3)[1].shape)
    np.testing.assert_allclose(own(vorticity(flow)(), 3)[1], expected, rtol=1e-12)


@pytest.mark.mpi
def test_vorticity_on_a_moved_mesh():
    mesh = brick()
    bend = PrescribedMotion(mesh, lambda x, t: ufl.as_vector([0.3 * x[1] + t, 0.2 * x[0] ** 2]), 0.1, backward_euler())
    flow = still(mesh, dt=0.1, scheme=backward_euler(), moving=bend)
    flow.start(lambda x, t: ufl.as_vector([-1.5 * x[1], 1.5 * x[0]]))
    np.testing.assert_allclose(own(vorticity(flow)(), 1)[1], 3.0, rtol=1e-12)


def moved_and_still(displacement, degree=1):
    """A flow on a mesh that has moved, and one on a mesh that lies there, with the same velocity."""
    mesh = brick(n=4)
    moving = PrescribedMotion(mesh, lambda x, t: ufl.as_vector(displacement(x, t)), 0.1, backward_euler())
    moved = still(mesh, degree=degree, dt=0.1, scheme=backward_euler(), moving=moving)
    there = brick(n=4)
    x = there.domain.geometry.x
    shift = np.array([[float(u) for u in displacement(list(point), 0.0)] for point in x])
    x[:, :2] += shift
    both = moved, still(there, degree=degree)
    for flow in both:
        flow.start(lambda x, t: ufl.as_vector([x[0] * x[1] ** 2, x[0] ** 3 - x[1] * x[0]]))
    return both


@pytest.mark.parametrize(
    "field", [vorticity, lambda flow: wall_shear_stress(flow, "left", "top")], ids=["curl", "wall"]
)
def test_fields_of_a_moved_mesh_are_those_of_the_mesh_that_lies_there(field):
    """Cells and facets are stretched by different factors, and the fields differ from cell to cell."""
    both = moved_and_still(lambda x, t: [0.8 * x[0] * x[0], 0.3 * x[1] * x[0] - 0.4 * x[1] * x[1]])
    (_, moved), (_, there) = (own(field(flow)(), 1 if field is vorticity else 2) for flow in both)
    assert np.ptp(there) > 0.1
    np.testing.assert_allclose(moved, there, rtol=1e-11, atol=1e-12)


def test_a_rigid_rotation_has_no_wall_shear_stress():
    flow = still(brick())
    flow.start(lambda x, t: ufl.as_vector([-1.5 * x[1], 1.5 * x[0]]))
    np.testing.assert_allclose(own(wall_shear_stress(flow, *SIDES)(), 2)[1], 0.0, atol=1e-12)


@pytest.mark.parametrize("degree", [1, 2])
def test_forms_on_a_curved_mesh_are_integrated_exactly(degree):
    """J of a displacement of degree m has degree 2 (m - 1) in the plane, on top of the 2 k of the flow."""

    def energy(**options):
        mesh = brick()
        bend = PrescribedMotion(
            mesh, lambda x, t: ufl.as_vector([0.2 * x[1] ** 2, 0.3 * x[0] * x[1] + t]), 0.1, backward_euler(), degree=2
        )
        flow = still(mesh, degree=degree, dt=0.1, scheme=backward_euler(), moving=bend, **options)
        flow.start(lambda x, t: ufl.as_vector([x[0] ** degree, x[1] ** degree - x[0]]))
        return Measured(e=kinetic_energy(flow))()["e"], flow.fields.degree

    (found, used), (exact, _) = energy(), energy(options=FlowOptions(quadrature_degree=10))
    less, _ = energy(options=FlowOptions(quadrature_degree=used - 2))
    assert found == pytest.approx(exact, rel=1e-12)
    assert abs(less - exact) > 1e-9


@pytest.mark.mpi
def test_ghosts_of_a_nodal_field_are_those_of_their_owners():
    flow = still(brick(), degree=2)
    flow.start(quadratic)
    field = vorticity(flow)()
    before = field.x.array.copy()
    field.x.scatter_forward()
    np.testing.assert_array_equal(field.x.array, before)


@pytest.mark.mpi
def test_wall_shear_stress_of_poiseuille_flow():
    """mu u' along the flow on both walls, and zero away from them; the pressure has no part in it."""
    flow = still(brick(), degree=2)
    flow.start(parabola, lambda x, t: 7 - x[0])
    x, tau = own(wall_shear_stress(flow, "bottom", "top")(), 2)
    walls = np.isclose(x[:, 1] * (1 - x[:, 1]), 0.0)
    np.testing.assert_allclose(tau[walls], np.broadcast_to([MU, 0.0], tau[walls].shape), atol=1e-12)
    np.testing.assert_array_equal(tau[~walls], 0.0)


@pytest.mark.mpi
def test_wall_shear_stress_has_no_normal_part():
    """Of a flow that is stretched across a wall: its normal stress is not shear."""
    flow = still(brick(), degree=1)
    flow.start(lambda x, t: ufl.as_vector([-x[0] + x[1], x[1]]))
    x, tau = own(wall_shear_stress(flow, "bottom")(), 2)
    bottom = np.isclose(x[:, 1], 0.0)
    np.testing.assert_allclose(tau[bottom], np.broadcast_to([MU, 0.0], tau[bottom].shape), atol=1e-12)


@pytest.mark.mpi
def test_wall_shear_stress_on_a_moved_mesh():
    """The wall turns and the flow with it."""
    mesh, angle = brick(), 0.6
    c, s = np.cos(angle), np.sin(angle)

    def turn(x, t):
        return ufl.as_vector([(c - 1) * x[0] - s * x[1], s * x[0] + (c - 1) * x[1] + 0.0 * t])

    moving = PrescribedMotion(mesh, turn, 0.1, backward_euler())
    flow = still(mesh, degree=1, dt=0.1, scheme=backward_euler(), moving=moving)
    flow.start(lambda x, t: (-s * x[0] + c * x[1]) * ufl.as_vector([c, s]))
    x, tau = own(wall_shear_stress(flow, "bottom")(), 2)
    bottom = np.isclose(x[:, 1], 0.0)
    np.testing.assert_allclose(tau[bottom], np.broadcast_to([MU * c, MU * s], tau[bottom].shape), atol=1e-12)


@pytest.mark.mpi
def test_nodal_fields_of_any_expression():
    """A linear scalar is averaged around nodes: exact where they lie in the middle of their cells."""
    flow = still(brick(n=4))
    x = ufl.SpatialCoordinate(flow.mesh.domain)
    for value in (x[0], ufl.as_vector([x[0], 2 * x[0]])):
        field = NodalField(flow, "any", value, flow.mesh.dx(degree=3))()
        size = value.ufl_shape[0] if value.ufl_shape else 1
        at, found = own(field, size)
        inner = ((at[:, :2] > 0.1) & (at[:, :2] < 0.9)).all(axis=1)
        np.testing.assert_allclose(found[inner], np.outer(at[inner, 0], np.arange(1, size + 1)), rtol=1e-12)
    constant = NodalField(flow, "one", fem.Constant(flow.mesh.domain, 2.0), flow.mesh.dx(degree=3))()
    np.testing.assert_allclose(own(constant, 1)[1], 2.0, rtol=1e-13)


@pytest.mark.mpi
@pytest.mark.parametrize("degree", [1, 2])
def test_values_at_the_nodes_nearest_to_points(degree):
    """Of nodes that are equally near the one with the largest coordinates, on any ranks."""
    flow = still(brick(n=4), degree=degree)
    flow.start(lambda x, t: ufl.as_vector([x[0], x[1]]), lambda x, t: x[0] - 2 * x[1])
    found = NodeValues(flow.w, [(0.26, 0.49), (1.0, 0.125 if degree == 1 else 0.0625)])()
    expected = np.array([(0.25, 0.5), (1.0, 0.25 if degree == 1 else 0.125)])
    np.testing.assert_allclose(found[:, :2], expected, atol=1e-13)
    np.testing.assert_allclose(found[:, 2], expected @ [1.0, -2.0], atol=1e-13)
    flow.w.x.array[:] = 0.0
    assert not NodeValues(flow.w, [(0.5, 0.5)])().any()
