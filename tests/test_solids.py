"""Elastic materials, and solids that share a mesh with the flow around them."""

from functools import cache

import numpy as np
import pytest
import ufl
from mpi4py import MPI
from dolfinx import fem
from flows import assembled

from tigar_x import compat
from tigar_x.fem.schemes import backward_euler, generalized_alpha
from tigar_x.fem.solve import FiniteElementSystem, newton
from varmint.conditions import Traction, Velocity
from varmint.flow import Flow, FlowError, FlowOptions
from varmint.forms.motion import ElasticMotion, PrescribedMotion
from varmint.forms.solids import NeoHookeanSolid, Solid, StVenantKirchhoffSolid, mesh_residual, solid_residual
from varmint.mesh import box, named
from varmint.quantities import Measured, volume

COMM = MPI.COMM_WORLD
E_MODULUS, NU, RHO = 7.0, 0.3, 2.0
LAME = E_MODULUS * NU / ((1 + NU) * (1 - 2 * NU)), E_MODULUS / (2 * (1 + NU))
MATERIALS = [StVenantKirchhoffSolid(E_MODULUS, NU, RHO), NeoHookeanSolid(E_MODULUS, NU, RHO)]
KINDS = pytest.mark.parametrize("material", MATERIALS, ids=["svk", "neo-hookean"])
DIMENSIONS = pytest.mark.parametrize("d", [2, 3])


# -- materials --------------------------------------------------------------------------------------------------------


def energy(material, F):
    """Stored energy per reference volume."""
    lam, mu = LAME
    C = F.T * F
    d = F.ufl_shape[0]
    if isinstance(material, StVenantKirchhoffSolid):
        strain = (C - ufl.Identity(d)) / 2
        return lam / 2 * ufl.tr(strain) ** 2 + mu * ufl.inner(strain, strain)
    J = ufl.det(F)
    return mu / 2 * (ufl.tr(C) - 2 * ufl.ln(J) - d) + lam / 2 * ufl.ln(J) ** 2


@cache
def cell(d):
    """One cell of volume 1/d!, on which matrices are integrated."""
    x = np.vstack([np.zeros(d), np.eye(d)])
    return compat.create_mesh(MPI.COMM_SELF, ("triangle", "tetrahedron")[d - 2], [list(range(d + 1))], x)


@cache
def evaluators(material, d):
    """Stress of the material, and derivative of its energy, of any matrix F."""
    domain = cell(d)
    F, V = fem.Constant(domain, np.eye(d)), compat.lagrange_space(domain, 0, d * d)
    G, z = ufl.variable(F), ufl.TestFunction(V)
    dx = ufl.dx(domain=domain, degree=0)
    stresses = material.first_piola_kirchhoff(F), ufl.diff(energy(material, G), G)
    entries = [(i, j, z[d * i + j] / ufl.CellVolume(domain)) for i in range(d) for j in range(d)]
    forms = compat.compile_forms(*(sum(P[i, j] * weight for i, j, weight in entries) * dx for P in stresses))

    def stress(values, which=0):
        F.value = values
        return assembled(forms[which], V).array_r.reshape(d, d)

    return stress


def matrices(d, n=4):
    rng = np.random.default_rng(3)
    return [np.eye(d) + 0.4 * rng.uniform(-1, 1, (d, d)) for _ in range(n)]


def rotation(d):
    Q, _ = np.linalg.qr(np.random.default_rng(8).normal(size=(d, d)))
    return Q * np.sign(np.linalg.det(Q)) ** np.where(np.arange(d) == 0, 1, 0)


@KINDS
@DIMENSIONS
def test_stress_is_the_derivative_of_the_energy(material, d):
    stress = evaluators(material, d)
    for F in matrices(d):
        assert np.linalg.det(F) > 0.0
        expected = stress(F, 1)
        np.testing.assert_allclose(stress(F), expected, rtol=1e-12, atol=1e-12)
        assert np.abs(expected).max() > 0.5


@KINDS
@DIMENSIONS
def test_a_rigid_rotation_needs_no_stress(material, d):
    stress, Q = evaluators(material, d), rotation(d)
    assert np.linalg.det(Q) == pytest.approx(1.0)
    np.testing.assert_allclose(stress(Q), 0.0, atol=1e-13)
    np.testing.assert_allclose(stress(np.eye(d)), 0.0, atol=1e-15)
    for F in matrices(d):
        np.testing.assert_allclose(stress(Q @ F), Q @ stress(F), atol=1e-12)


@KINDS
@DIMENSIONS
def test_moments_are_balanced_and_no_direction_is_special(material, d):
    """P F^T is symmetric, and P(F Q) = P(F) Q."""
    stress, Q = evaluators(material, d), rotation(d)
    for F in matrices(d):
        P = stress(F)
        np.testing.assert_allclose(P @ F.T, F @ P.T, atol=1e-12)
        assert np.abs(P - P.T).max() > 1e-2
        np.testing.assert_allclose(stress(F @ Q), P @ Q, atol=1e-12)


@KINDS
@DIMENSIONS
def test_small_strains_obey_hookes_law(material, d):
    """In the plane that of plane strain: the stress of the strain without a third component."""
    stress, (lam, mu) = evaluators(material, d), LAME
    H = matrices(d)[0] - np.eye(d)
    strain = (H + H.T) / 2
    hooke = lam * np.trace(strain) * np.eye(d) + 2 * mu * strain
    errors = [np.abs(stress(np.eye(d) + eps * H) / eps - hooke).max() for eps in (1e-4, 1e-5)]
    assert errors[0] < 1e-2
    assert errors[1] == pytest.approx(errors[0] / 10, rel=0.01)
    # uniaxial stress in space: the modulus and the contraction
    e = np.diag([1.0, -NU, -NU])[:d, :d]
    if d == 3:
        np.testing.assert_allclose(stress(np.eye(3) + 1e-7 * e) / 1e-7, np.diag([E_MODULUS, 0, 0]), atol=1e-5)


@pytest.mark.parametrize("make", [StVenantKirchhoffSolid, NeoHookeanSolid])
@pytest.mark.parametrize(
    ("change", "message"),
    [
        (dict(youngs_modulus=0.0), r"^youngs_modulus = 0.0: a number > 0"),
        (dict(youngs_modulus=np.nan), r"^youngs_modulus = nan"),
        (dict(poisson_ratio=0.5), r"^poisson_ratio = 0.5: a number in \(-1, 0.5\) is required"),
        (dict(poisson_ratio=-1.0), r"^poisson_ratio = -1.0: a number in \(-1, 0.5\)"),
        (dict(density=-1.0), r"^density = -1.0: a number > 0"),
    ],
)
def test_bad_materials(make, change, message):
    with pytest.raises(ValueError, match=message):
        make(**(dict(youngs_modulus=1.0, poisson_ratio=0.3, density=1.0) | change))


@pytest.mark.mpi
@DIMENSIONS
def test_the_fictitious_solid_of_a_mesh(d):
    """At rest nothing is left; stiffness goes with the inverse power of a cell's volume; rigid motion is free."""
    mesh = box(COMM, (0.0,) * d, (1.0,) * d, (2,) * d)
    V = compat.lagrange_space(mesh.domain, 1, d)
    u, size = fem.Function(V), fem.Constant(mesh.domain, 1.0)
    x = ufl.SpatialCoordinate(mesh.domain)
    dx = mesh.dx(degree=2)

    def forces(form):
        system = FiniteElementSystem(form, u)
        system.assemble_residual()
        return system.b.copy()

    plain = mesh_residual(u, ufl.TestFunction(V), mesh.domain, dx, size=size, size_stiffening=2.0)
    assert forces(plain).norm() == 0.0
    compat.interpolate(u, ufl.dot(ufl.as_matrix((rotation(d) - np.eye(d)).tolist()), x))
    assert forces(plain).norm() < 1e-12
    compat.interpolate(u, 0.1 * x)
    first = forces(plain)
    size.value = 3.0
    second = forces(plain)
    assert first.norm() > 0.01
    assert second.norm() == pytest.approx(9.0 * first.norm(), rel=1e-12)
    powers = [mesh_residual(u, ufl.TestFunction(V), mesh.domain, dx, stiffening=a) for a in (0.0, 1.0)]
    neutral, compressed = (forces(form).norm() for form in powers)
    assert compressed == pytest.approx(neutral / 1.1**d, rel=1e-12)


# -- a solid in a flow ------------------------------------------------------------------------------------------------

LENGTH, THICKNESS, GRAVITY = 1.0, 0.2, 2e-3
SOFT = StVenantKirchhoffSolid(100.0, 0.3, 1.0)


@cache
def beam_mesh():
    """A horizontal beam that is attached to the left wall of a box."""
    domain = box(COMM, (0.0, 0.0), (1.5, 1.0), (12, 10)).domain
    low, high, eps = 0.5 - THICKNESS / 2, 0.5 + THICKNESS / 2, 1e-9

    def left(x):
        return np.isclose(x[0], 0.0)

    sides = {
        "root": lambda x: left(x) & (x[1] > low - eps) & (x[1] < high + eps),
        "left": [lambda x: left(x) & (x[1] < low + eps), lambda x: left(x) & (x[1] > high - eps)],
        "right": lambda x: np.isclose(x[0], 1.5),
        "bottom": lambda x: np.isclose(x[1], 0.0),
        "top": lambda x: np.isclose(x[1], 1.0),
    }
    beam = lambda x: (x[0] < LENGTH + eps) & (x[1] > low - eps) & (x[1] < high + eps)  # noqa: E731
    around = [lambda x: x[1] < low + eps, lambda x: x[1] > high - eps, lambda x: x[0] > LENGTH - eps]
    return named(domain, cells={"solid": beam, "fluid": around}, **sides)


HELD = ("root", "left", "right", "bottom", "top")


def beam_flow(dt, scheme, *, rho=1e-6, mu=1e-6, material=SOFT, degree=1, f=None, opened=True, **options):
    mesh = beam_mesh()
    moving = ElasticMotion(mesh, dict.fromkeys(HELD), dt, scheme, degree, cells=("fluid",))
    walls = ("left", "bottom", "top") if opened else ("left", "bottom", "top", "right")
    outlet = [Traction("right")] if opened else []
    return Flow(
        mesh,
        [Velocity(walls), Velocity("root", (0.0, 0.0)), *outlet],
        rho=rho,
        mu=mu,
        degree=degree,
        dt=dt,
        scheme=scheme,
        moving=moving,
        f=(0.0, -GRAVITY) if f is None else f,
        solid=Solid(material),
        options=FlowOptions(**options),
    )


def tip(moving):
    """Largest downward displacement of the mesh's nodes on the beam's end."""
    V = moving.time.x.function_space
    x = V.tabulate_dof_coordinates()
    end = np.isclose(x[:, 0], LENGTH) & np.isclose(x[:, 1], 0.5)
    u = -moving.time.x.x.array.reshape(-1, 2)[end, 1]
    return COMM.allreduce(float(u.max(initial=-np.inf)), op=MPI.MAX)


@cache
def static_deflection(material):
    """The same cells without a fluid."""
    mesh = box(COMM, (0.0, 0.5 - THICKNESS / 2), (LENGTH, 0.5 + THICKNESS / 2), (8, 2))
    V = compat.lagrange_space(mesh.domain, 1, 2)
    u, w = fem.Function(V), ufl.TestFunction(V)
    gravity = fem.Constant(mesh.domain, (0.0, -GRAVITY))
    form = solid_residual(material, u, 0 * gravity, w, mesh.dx(degree=2), f=gravity)
    held = compat.fixed_nodes(V, compat.nodes_on_facets(V, mesh.facets("left")))
    newton(FiniteElementSystem(form, u, [held]), rtol=1e-10)
    x = V.tabulate_dof_coordinates()
    end = np.isclose(x[:, 0], LENGTH) & np.isclose(x[:, 1], 0.5)
    return COMM.allreduce(float(-u.x.array.reshape(-1, 2)[end, 1].max(initial=-1.0)), op=MPI.MIN)


@pytest.mark.mpi
@pytest.mark.parametrize("material", [SOFT, NeoHookeanSolid(100.0, 0.3, 1.0)], ids=["svk", "neo-hookean"])
def test_a_beam_under_its_weight_comes_to_its_static_deflection(material):
    """In a fluid that weighs nothing; backward Euler with large steps damps what oscillates."""
    flow = beam_flow(20.0, backward_euler(), material=material)
    for _ in range(25):
        flow.take_step()
    expected = static_deflection(material)
    assert expected > 5e-5
    assert tip(flow.moving) == pytest.approx(expected, rel=1e-3)
    flow.take_step()
    assert tip(flow.moving) == pytest.approx(expected, rel=1e-3)


def states(flow):
    time, mesh = flow.time, flow.moving.time
    kept = [flow.w, time.x_old, time.xdot_old, mesh.x, mesh.x_old, mesh.xdot_old, mesh.xddot_old]
    return [f.x.array.copy() for f in kept]


def node_sets(flow):
    """Which nodes of the flow lie strictly inside the solid, and in it at all."""
    x = flow.V.tabulate_dof_coordinates()
    half = THICKNESS / 2
    inside = (x[:, 0] < LENGTH - 1e-9) & (np.abs(x[:, 1] - 0.5) < half - 1e-9)
    closed = (x[:, 0] < LENGTH + 1e-9) & (np.abs(x[:, 1] - 0.5) < half + 1e-9)
    return inside, closed


@pytest.mark.mpi
@pytest.mark.parametrize("degree", [1, 2])
@pytest.mark.parametrize("scheme", [backward_euler(), generalized_alpha(0.5)], ids=["euler", "alpha"])
def test_the_mesh_moves_with_the_solid(scheme, degree):
    """Velocities at the nodes of the solid are the rates of the mesh there, which the schemes relate to positions."""
    flow = beam_flow(0.5, scheme, degree=degree, rtol=1e-8)
    assert flow.fluid_cells == ("fluid",)
    x, X = flow.moving.time.x.function_space.tabulate_dof_coordinates(), flow.V.tabulate_dof_coordinates()
    order = np.empty(len(x), dtype=int)
    order[compat.cell_dofs(flow.moving.time.x.function_space)] = compat.cell_dofs(flow.V)
    np.testing.assert_allclose(X[order], x)
    for _ in range(3):
        report = flow.take_step()
        v, rate = flow.w.x.array.reshape(-1, 3)[order], flow.moving.time.xdot_old.x.array.reshape(-1, 2)
        _, closed = node_sets(flow)
        closed = closed[order]
        np.testing.assert_allclose(rate[closed], v[closed, :2], atol=1e-11)
        assert COMM.allreduce(np.abs(v[closed, :2]).max(initial=0.0), op=MPI.MAX) > 1e-5
        assert COMM.allreduce(np.abs(rate[~closed] - v[~closed, :2]).max(initial=0.0), op=MPI.MAX) > 1e-6
        assert report.residuals[-1] <= 1e-8 * report.residuals[0]
    assert flow.moving.smallest_volume_ratio() > 0.5


@pytest.mark.mpi
def test_there_is_no_pressure_strictly_inside_a_solid():
    """Elsewhere there is, on its surface as well."""
    flow = beam_flow(0.5, backward_euler(), rho=1.0, mu=0.1)
    for _ in range(2):
        flow.take_step()
    p = flow.w.x.array.reshape(-1, 3)[:, 2]
    inside, _ = node_sets(flow)
    constrained = set(compat.constrained_dofs([flow.bcs[0]]))
    assert constrained == set(3 * np.flatnonzero(inside) + 2)
    assert COMM.allreduce(int(inside.sum()), op=MPI.SUM) > 0
    np.testing.assert_array_equal(p[inside], 0.0)
    away = ~inside & ~np.isclose(flow.V.tabulate_dof_coordinates()[:, 0], 1.5)
    assert (p[away] != 0.0).all()


@pytest.mark.mpi
def test_a_solid_at_rest_stays_at_rest():
    flow = beam_flow(0.5, generalized_alpha(0.5), f=(0.0, 0.0))
    report = flow.take_step()
    assert report.iterations == 0
    assert not flow.w.x.array.any()
    assert not flow.moving.time.x.x.array.any()


def hanging():
    """As heavy as the fluid of a closed box under gravity."""
    return beam_flow(20.0, backward_euler(), rho=1.0, mu=0.5, opened=False)


@pytest.mark.mpi
def test_a_solid_as_heavy_as_the_fluid_hangs_in_it():
    """Gravity on both is balanced by the hydrostatic pressure: the solid has no weight, but is compressed a little."""
    flow = hanging()
    for _ in range(6):
        flow.take_step()
    assert abs(tip(flow.moving)) < 0.02 * static_deflection(SOFT)
    p = flow.w.x.array.reshape(-1, 3)[:, 2]
    bottom, top = (np.isclose(flow.V.tabulate_dof_coordinates()[:, 1], y) for y in (0.0, 1.0))
    lowest = COMM.allreduce(float(p[bottom].min(initial=np.inf)), op=MPI.MIN)
    highest = COMM.allreduce(float(p[top].max(initial=-np.inf)), op=MPI.MAX)
    assert lowest - highest == pytest.approx(GRAVITY, rel=0.05)


@pytest.mark.mpi
def test_a_solid_that_is_compressible_determines_the_pressure():
    """The fluid of a closed box keeps its volume, whatever a solid in it would do under another pressure."""
    flow = hanging()
    present = Measured(V=volume(flow))
    before = present()["V"]
    for _ in range(6):
        flow.take_step()
    assert present()["V"] == pytest.approx(before, rel=1e-9)
    assert not flow.is_closed


@pytest.mark.mpi
@pytest.mark.parametrize("scheme", [backward_euler(), generalized_alpha(0.5)], ids=["euler", "alpha"])
def test_a_heavy_fluid_around_a_light_solid_is_stable(scheme):
    """A hundred times as heavy: what lets schemes diverge that solve for one after the other."""
    light = StVenantKirchhoffSolid(100.0, 0.3, 0.01)

    def push(x, t):
        return ufl.as_vector([0.0 * x[0], 2e-3 * ufl.sin(40 * t) * x[0]])

    flow = beam_flow(0.05, scheme, rho=1.0, mu=1e-3, material=light, f=push)
    tips = []
    for _ in range(12):
        report = flow.take_step()
        assert report.iterations <= 12
        tips.append(tip(flow.moving))
    assert max(np.abs(tips)) < 1e-3
    assert max(np.abs(tips)) > 1e-8


@pytest.mark.mpi
def test_a_beam_that_is_let_go():
    """A load that is put on at once swings it between nothing and twice the static deflection, if nothing is damped."""
    flow = beam_flow(0.05, generalized_alpha(1.0))
    heights = []
    for _ in range(50):
        flow.take_step()
        heights.append(tip(flow.moving))
    lowest = int(np.argmax(heights))
    assert heights[lowest] == pytest.approx(2 * static_deflection(SOFT), rel=0.1)
    assert min(heights[lowest:]) < 0.1 * heights[lowest]


@pytest.mark.mpi
def test_a_step_that_fails_leaves_fluid_and_solid_as_they_were():
    flow = beam_flow(0.5, generalized_alpha(0.5), rho=1.0, mu=0.1, max_iterations=12)
    flow.take_step()
    before = states(flow)
    rho = flow.rho.value.copy()
    flow.rho.value = np.nan
    with pytest.raises(FlowError):
        flow.take_step()
    flow.rho.value = rho
    for old, new in zip(before, states(flow), strict=True):
        np.testing.assert_array_equal(old, new)
    for time in (flow.time, flow.moving.time):
        time.step_size = 0.25
    flow.take_step()


def elastic(mesh, cells=("fluid",), degree=1):
    return ElasticMotion(mesh, dict.fromkeys(HELD), 0.1, backward_euler(), degree, cells=cells)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (dict(solid=Solid(SOFT, "beam")), "^cell group 'beam' does not exist: one of 'solid', 'fluid' is required"),
        (dict(degree=2), "^degree = 2: that of the moving mesh, 1, is required"),
        (dict(cells=()), r"^moving.cells = \(\): \('fluid',\) is required, the cells of the fluid"),
        (dict(cells=("solid",)), r"^moving.cells = \('solid',\): \('fluid',\) is required"),
        (dict(cells=("solid", "fluid")), r"^moving.cells = \('solid', 'fluid'\): \('fluid',\) is required"),
        (dict(prescribed=True), "^moving = .*: a solid in the flow requires an ElasticMotion"),
    ],
)
def test_bad_solids_in_a_flow(change, message):
    mesh = beam_mesh()
    if change.pop("prescribed", False):
        moving = PrescribedMotion(mesh, lambda x, t: ufl.as_vector([0.0 * t, 0.0 * t]), 0.1, backward_euler())
    else:
        moving = elastic(mesh, change.pop("cells", ("fluid",)))
    given = dict(rho=1.0, mu=1.0, dt=0.1, scheme=backward_euler(), moving=moving, solid=Solid(SOFT)) | change
    with pytest.raises(ValueError, match=message):
        Flow(mesh, [Velocity(HELD)], **given)


def test_groups_of_a_solid():
    assert Solid(SOFT).groups == ("solid",)
    assert Solid(SOFT, "beam").groups == ("beam",)
    assert Solid(SOFT, ("beam", "flag")).groups == ("beam", "flag")
