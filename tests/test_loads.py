"""Loads of shells: resultants, powers, tangents, and a beam that a moment rolls up."""

from functools import cache

import numpy as np
import pytest
import ufl
from mpi4py import MPI
from dolfinx import fem
from splines import PATCHES, coefficients

from shnapr.kinematics import area_vector
from shnapr.loads import dead_load, edge_moment, edge_traction, follower_pressure, gravity, inertia, mass_damping
from shnapr.svk import StVenantKirchhoff
from shnapr.work import internal_tangent, internal_work
from tigar_x import compat
from tigar_x.fem.solve import newton
from tigar_x.fem.time_integration import LoadStepper
from tigar_x.geometry import shapes
from tigar_x.geometry.bspline import BSplineBasis
from tigar_x.geometry.patch import Patch
from tigar_x.splines.spline import ExtractedSpline
from tigar_x.splines.spline_system import SplineSystem

A, B = np.array([2.0, 0.0, 0.0]), np.array([1.0, 3.0, 4.0])  # sides of the parallelogram
SIZES = {"line": 5.0, "arc": np.pi / 2, "parallelogram": np.linalg.norm(np.cross(A, B)), "cylinder": np.pi}
P, M = 1.7, 0.9


def closed(dim):
    """A closed curve and a torus, of random shape; all integrands are polynomials that the quadrature integrates."""
    around = BSplineBasis(2, np.linspace(0, 1, 7), periodic=True)
    n, rng = around.n, np.random.default_rng(4)
    phi = 2 * np.pi * np.arange(n) / n
    circle = np.column_stack([np.cos(phi), np.sin(phi)])
    if dim == 1:
        return Patch.from_points([around], circle + rng.uniform(-0.1, 0.1, circle.shape))
    points = np.array([[*((2 + s[0]) * c), s[1]] for s in circle for c in circle])
    return Patch.from_points([around] * 2, points + rng.uniform(-0.1, 0.1, points.shape))


@cache
def shell(name):
    patch = closed(int(name[-1])) if name.startswith("closed") else PATCHES[name]()
    return ExtractedSpline(patch, MPI.COMM_SELF, quadrature_degree=14 if patch.rational else 9)


def vector(s, form):
    """Extracted vector of a compiled form, one row per control point."""
    b, result = compat.create_vector(s.V), s.M.createVecRight()
    compat.assemble_vector(b, form)
    s.M.multTranspose(b, result)
    return result.array.reshape(-1, s.nsd)


def vectors(s, *forms):
    return [vector(s, form) for form in compat.compile_forms(*forms)]


class Load:
    """A load and its tangent as functions of the coefficients of the displacement."""

    def __init__(self, s, make):
        self.s, self.y = s, s.function()
        form = make(self.y, ufl.TestFunction(s.V))
        self._forms = compat.compile_forms(form, ufl.derivative(form, self.y))

    def __call__(self, U):
        self.y.x.array[:] = self.s.function(U).x.array
        return vector(self.s, self._forms[0])

    def tangent(self, U):
        self.y.x.array[:] = self.s.function(U).x.array
        K = compat.create_matrix(self._forms[1], "aij")
        compat.assemble_matrix(K, self._forms[1])
        K.assemble()
        return K.PtAP(self.s.M)[:, :]

    def total(self, U):
        """Force on the shell, from constant test functions."""
        return -self.s.geometry.weights @ self(U)


def constant(s, value):
    return fem.Constant(s.mesh, np.asarray(value, dtype=float))


@cache
def pressure(name):
    s = shell(name)
    return Load(s, lambda y, z: follower_pressure(s, constant(s, P), y, z))


@cache
def moment(name, side):
    s = shell(name)
    return Load(s, lambda y, z: edge_moment(s, constant(s, M), y, z, s.ds(side)))


def slope(f, U, d, eps=1e-4):
    return (f(U + eps * d) - f(U - eps * d)) / (2 * eps)


def assert_tangent(load, U, d):
    exact = load.tangent(U) @ d.ravel()
    scale = np.abs(exact).max()
    assert scale > 1e-2
    np.testing.assert_allclose(slope(load, U, d).ravel(), exact, rtol=0, atol=1e-6 * scale)


def inner(patch):
    """Mask of the control points that lie on no side, shape (n, 1)."""
    mask = np.ones((patch.n, 1), dtype=bool)
    for name in patch.open_sides:
        mask[patch.side(name)] = False
    return mask


# -- what does not depend on the displacement -------------------------------------------------------------------------


@pytest.mark.parametrize("name", list(SIZES))
def test_totals_over_the_reference_area(name):
    """Force, weight, and the forces of inertia and damping when all points move alike."""
    s, f = shell(name), np.array([0.3, -2.0, 0.7])[: shell(name).nsd]
    rate, z = s.function(s.geometry.weights[:, None] * f), ufl.TestFunction(s.V)
    mass, g = dict(density=constant(s, 7.0), thickness=0.2), constant(s, f)
    damping = mass_damping(s, rate, z, coefficient=constant(s, 3.0), **mass)
    loads = vectors(s, dead_load(s, g, z), gravity(s, g, z, **mass), inertia(s, rate, z, **mass), damping)
    expected = SIZES[name] * np.outer([-1, -1.4, 1.4, 4.2], f)
    np.testing.assert_allclose([s.geometry.weights @ load for load in loads], expected, rtol=1e-7)


def test_density_may_vary_in_space():
    s = shell("line")
    u, z = ufl.SpatialCoordinate(s.mesh)[0], ufl.TestFunction(s.V)
    (load,) = vectors(s, gravity(s, (0.0, -2.0), z, density=3 * u**2, thickness=0.5))
    np.testing.assert_allclose(load.sum(axis=0), [0, 5.0], rtol=1e-13, atol=1e-14)


@pytest.mark.parametrize(
    ("name", "side", "length"),
    [
        ("line", "u0", 1.0),
        ("parallelogram", "v0", np.linalg.norm(A)),
        ("parallelogram", "u1", np.linalg.norm(B)),
        ("cylinder", "v1", np.pi / 2),
        ("cylinder", "u0", 2.0),
    ],
)
def test_total_edge_traction(name, side, length):
    s, f = shell(name), np.array([0.3, -2.0, 0.7])[: shell(name).nsd]
    (load,) = vectors(s, edge_traction(s, constant(s, f), ufl.TestFunction(s.V), s.ds(side)))
    np.testing.assert_allclose(s.geometry.weights @ load, -length * f, rtol=1e-9)
    away = np.setdiff1d(np.arange(s.geometry.n), s.geometry.side(side))
    assert not load[away].any()


# -- follower pressure ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["arc", "parallelogram", "cylinder"])
def test_tangent_of_pressure(name):
    patch = shell(name).geometry
    assert_tangent(pressure(name), 0.1 * coefficients(patch), coefficients(patch, seed=1))


@pytest.mark.parametrize("name", ["line", "arc"])
def test_pressure_on_a_curve_depends_on_its_ends_alone(name):
    """P times the chord, turned by a right angle towards a_3 = a_1 x e_3."""
    patch, U = shell(name).geometry, 0.3 * coefficients(shell(name).geometry)
    chord = np.diff((patch.points + U / patch.weights[:, None])[[0, -1]], axis=0)[0]
    np.testing.assert_allclose(pressure(name).total(U), P * chord[[1, 0]] * [1, -1], rtol=1e-8)


def test_pressure_on_a_surface_depends_on_its_boundary_alone():
    """P times the area that a flat boundary encloses, however the inside is bent."""
    patch = shell("parallelogram").geometry
    U = 0.4 * coefficients(patch)
    enclosed = P * np.cross(A, B)
    np.testing.assert_allclose(pressure("parallelogram").total(inner(patch) * U), enclosed, rtol=1e-12, atol=1e-12)
    assert np.linalg.norm(pressure("parallelogram").total(U) - enclosed) > 0.1


@pytest.mark.parametrize("name", ["closed 1", "closed 2"])
def test_pressure_on_a_closed_shell(name):
    """Neither force nor moment; the virtual work is -P times the rate of the volume inside."""
    s, load = shell(name), pressure(name)
    U, d = 0.1 * coefficients(s.geometry), coefficients(s.geometry, seed=1)
    R = load(U)
    lever = (s.geometry.points + U).T @ R
    assert np.abs(R.sum(axis=0)).max() < 1e-13 * np.abs(R).sum()
    assert np.abs(lever - lever.T).max() < 1e-13 * np.abs(R).sum()

    y = s.function()
    x = s.F + y
    density = ufl.dot(x, area_vector(s.parametric_grad(x))) / s.nsd / s.dx.jacobian
    form = compat.compile_forms(density * s.dx)[0]

    def volume(U):
        y.x.array[:] = s.function(U).x.array
        return compat.assemble_scalar(form)

    rate = slope(volume, U, d)
    assert abs(rate) > 0.05
    assert np.sum(R * d) == pytest.approx(-P * rate, rel=1e-6)


# -- edge moments -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("side", ["u0", "u1"])
@pytest.mark.parametrize("name", ["line", "arc"])
def test_moment_works_on_the_rotation_of_the_end(name, side):
    """Towards +a_3 is clockwise where the curve ends and counterclockwise where it begins."""
    patch, load = shell(name).geometry, moment(name, side)
    U, d = 0.1 * coefficients(patch), coefficients(patch, seed=1)

    def angle(U):
        x = patch.points + U / patch.weights[:, None]
        tangent = x[-1] - x[-2] if side == "u1" else x[1] - x[0]
        return np.arctan2(tangent[1], tangent[0])

    turned = slope(angle, U, d) * (-1 if side == "u1" else 1)
    assert abs(turned) > 0.1
    assert np.sum(load(U) * d) == pytest.approx(-M * turned, rel=1e-5)
    assert_tangent(load, U, d)


@pytest.mark.parametrize("side", ["u0", "u1", "v0", "v1"])
def test_moment_in_a_rigid_rotation(side):
    """Power per reference length M omega . (nu x a_3) on the straight edges of a homogeneously deformed sheet."""
    patch, load = shell("parallelogram").geometry, moment("parallelogram", side)
    F, omega = np.array([[1.1, 0.3, 0.0], [-0.2, 0.9, 0.1], [0.4, 0.0, 1.2]]), np.array([0.3, -1.0, 0.6])
    x = patch.points @ F.T
    edge, other, length = (F @ B, F @ A, np.linalg.norm(B)) if side[0] == "u" else (F @ A, F @ B, np.linalg.norm(A))
    normal = np.cross(F @ A, F @ B)
    axis = edge / np.linalg.norm(edge)  # nu x a_3 up to its sign
    conormal = np.cross(normal, axis)
    outward = np.sign(conormal @ other) * (1 if side[1] == "1" else -1)
    axis = np.cross(outward * conormal, normal)
    power = M * length * omega @ axis / np.linalg.norm(axis)
    R = load(x - patch.points)
    assert np.sum(R * np.cross(omega, x)) == pytest.approx(-power, rel=1e-12)
    assert np.abs(R.sum(axis=0)).max() < 1e-13


def test_tangent_of_a_moment_on_a_surface():
    patch = shell("cylinder").geometry
    assert_tangent(moment("cylinder", "u1"), 0.1 * coefficients(patch), coefficients(patch, seed=1))


def test_moment_on_a_strip_is_that_on_a_curve():
    """Of a cylinder that deforms without strain along its generator, per unit depth."""
    arc, cylinder = shell("arc").geometry, shell("cylinder").geometry
    U = 0.1 * coefficients(arc)
    layers = cylinder.n // arc.n
    V = np.column_stack([np.tile(U, (layers, 1)), np.zeros(cylinder.n)])
    forces = moment("cylinder", "u1")(V).reshape(layers, -1, 3).sum(axis=0) / 2.0
    assert np.abs(forces[:, 2]).max() < 1e-12
    np.testing.assert_allclose(forces[:, :2], moment("arc", "u1")(U), rtol=0, atol=1e-12)


def test_moment_rolls_a_beam_into_a_circle():
    """M = 2 pi E' I/L; half of it makes half a circle, of radius L/pi, towards a_3 = -e_y."""
    E, h = 1.0e4, 0.01
    patch = shapes.line((0, 0), (1, 0), elements=16, degree=4)
    s = ExtractedSpline(patch, MPI.COMM_SELF, zero_dofs=patch.side_dofs("u0", 2))
    y, z = s.function(), ufl.TestFunction(s.V)
    time = LoadStepper(y, 1.0)
    material = StVenantKirchhoff(E, 0.0, h)
    load = edge_moment(s, 2 * np.pi * E * h**3 / 12 * time.t, y, z, s.ds("u1"))
    tangent = internal_tangent(s, material, y, z, y) + ufl.derivative(load, y)
    system = SplineSystem(s, internal_work(s, material, y, z) + load, tangent, unknown=y)
    tips = {}
    for step in range(1, 13):
        time.t.value = step / 12
        newton(system, rtol=0.0, atol=1e-9 * E * h, max_iterations=40)
        tips[step] = s.evaluate(y, [[1.0]])[0] + [1, 0]
    np.testing.assert_allclose(tips[6], [0, -2 / np.pi], rtol=0, atol=1e-3)
    np.testing.assert_allclose(tips[12], [0, 0], rtol=0, atol=1e-3)


# -- bad input --------------------------------------------------------------------------------------------------------


def test_bad_input():
    s = shell("line")
    y, z, ds = s.function(), ufl.TestFunction(s.V), s.ds("u1")
    mass = dict(density=1.0, thickness=0.1)
    cases = {
        r"force has shape \(3,\): shape \(2,\)": lambda: dead_load(s, (0.0, 0.0, 1.0), z),
        r"acceleration has shape \(1,\)": lambda: gravity(s, (1.0,), z, **mass),
        r"traction has shape \(\)": lambda: edge_traction(s, constant(s, 1.0), z, ds),
        r"traction\[1\] = nan": lambda: edge_traction(s, (1.0, np.nan), z, ds),
        r"pressure = inf": lambda: follower_pressure(s, np.inf, y, z),
        r"moment = nan": lambda: edge_moment(s, constant(s, np.nan), y, z, ds),
        r"coefficient = -1\.0": lambda: mass_damping(s, y, z, coefficient=-1.0, **mass),
    }
    for message, call in cases.items():
        with pytest.raises(ValueError, match=message):
            call()
