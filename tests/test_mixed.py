"""Membrane forces as unknowns: consistency, exact cases, agreement with displacements alone, and no locking."""

from types import SimpleNamespace

import numpy as np
import pytest
import ufl
from mpi4py import MPI
from dolfinx import fem

from shnapr import mixed
from shnapr.loads import dead_load, edge_traction
from shnapr.supports import clamped, pinned
from shnapr.svk import StVenantKirchhoff
from shnapr.work import internal_tangent, internal_work
from tigar_x.fem.solve import newton
from tigar_x.geometry import shapes, surfaces
from tigar_x.splines.constraints import no_rotation
from tigar_x.splines.spline import ExtractedSpline
from tigar_x.splines.spline_system import SplineSystem, solve_linear

E, NU, H = 3.0e3, 0.3, 0.1
HOW = ("displacement", "mixed")


def curve(degree=3, elements=5):
    return shapes.interpolated(lambda u: (2 * u + 0.3 * u**2, 0.4 * u**2), [shapes.uniform(degree, elements)])


def panel(degree=2, elements=3):
    return surfaces.cylinder_panel(
        radius=2.0, length=1.5, angle=1.2, elements=(elements, elements), degrees=(degree, degree)
    )


def shell(geometry, loads=(), *, fixed=(), constraints=(), material=None, comm=MPI.COMM_WORLD):
    """A loaded shell whose unknown is (y, n); every load is a function of spline and z."""
    spline = ExtractedSpline(geometry, comm, zero_dofs=fixed, constraints=constraints)
    space = mixed.mixed_space(spline)
    w, test = fem.Function(space.V), ufl.TestFunction(space.V)
    material = material(spline) if callable(material) else material
    if material is None:
        material = StVenantKirchhoff(E, NU, H)
    residual, tangent = (form(spline, material, w, test) for form in (mixed.mixed_work, mixed.mixed_tangent))
    z = mixed.displacement_part(spline, test)
    for load in loads:
        residual += load(spline, z)
    system = SplineSystem(space, residual, tangent, unknown=w)
    return SimpleNamespace(spline=spline, space=space, w=w, system=system, material=material)


def displaced(s, field):
    """Write the interpolation of a displacement field of the control points, and coefficients of the forces."""
    U = np.zeros(s.space.n)
    size = s.spline.geometry.n * s.spline.nsd
    U[:size] = (field * s.spline.geometry.weights[:, None]).ravel()
    s.w.x.array[:] = s.space.function(U).x.array
    return U


def dense(A):
    B = A.convert("dense") if A.type.endswith("dense") else A.copy()
    return np.array(B[:, :])


@pytest.mark.parametrize(
    ("geometry", "prestress", "bending"),
    [
        (curve(), None, True),
        (curve(), (0.7,), True),
        (panel(), (1.0, 2.0, 0.5), True),
        (panel(), (1.0, 2.0, 0.5), False),
    ],
)
def test_tangent_is_the_derivative_of_the_residual(geometry, prestress, bending):
    material = StVenantKirchhoff(E, NU, H, prestress=prestress, bending=bending)
    s = shell(geometry, material=material, comm=MPI.COMM_SELF)
    rng = np.random.default_rng(2)
    U, V = 0.02 * rng.standard_normal(s.space.n), rng.standard_normal(s.space.n)
    size = geometry.n * geometry.nsd
    U[size:] *= 0.1

    def residual(U):
        s.w.x.array[:] = s.space.function(U).x.array
        s.system.assemble_residual()
        return s.system.b.array_r.copy()

    h = 1e-6
    slope = (residual(U + h * V) - residual(U - h * V)) / (2 * h)
    residual(U)
    s.system.assemble_tangent()
    K = dense(s.system.A)
    np.testing.assert_allclose(K @ V, slope, rtol=0, atol=3e-7 * np.abs(slope).max())
    np.testing.assert_allclose(K, K.T, rtol=0, atol=1e-11 * np.abs(K).max())
    assert np.abs(K[:size, size:] @ V[size:]).max() > 1e-3 * np.abs(slope).max()


@pytest.mark.parametrize("geometry", [curve(), panel()])
def test_rigid_motion_strains_nothing(geometry):
    s = shell(geometry, comm=MPI.COMM_SELF)
    nsd = geometry.nsd
    c, d = np.cos(0.8), np.sin(0.8)
    turn = np.eye(nsd)
    turn[:2, :2] = [[c, -d], [d, c]]
    displaced(s, geometry.points @ (turn - np.eye(nsd)).T + 0.3)
    stiff = E * H
    assert s.system.assemble_residual() < 1e-11 * stiff
    displaced(s, 0.01 * geometry.points)
    assert s.system.assemble_residual() > 1e-3 * stiff


@pytest.mark.mpi
def test_stretched_strip():
    """The force that is applied is the one that is found, and Poisson's contraction belongs to it."""
    pull, material = 4.0, StVenantKirchhoff(E, NU, H)
    strip = shapes.strip(length=2.0, width=1.0, elements=(4, 3), degrees=(2, 2))
    middle = pinned(strip, "u0", components=(0, 2))
    fixed = np.union1d(middle, np.union1d(strip.dofs(np.arange(strip.n), (2,)), strip.dofs(strip.side("u0")[:1], (1,))))

    def load(spline, z):
        return edge_traction(spline, (pull, 0.0, 0.0), z, spline.ds("u1"))

    s = shell(strip, [load], fixed=fixed, material=material)
    newton(s.system, rtol=1e-12)
    forces = s.space.coefficients(s.w)[strip.n * 3 :] * E * H
    n_11 = np.unique(np.round(forces[forces > 0.1 * pull], 9))
    assert len(n_11) == 1
    eps = n_11[0] / (E * H)
    stretch = (
        1 + 2 * eps
    ) ** 0.5  # n^11 is of second Piola-Kirchhoff type: the force per reference width is n^11 stretch
    assert n_11[0] * stretch == pytest.approx(pull, rel=1e-9)
    assert np.abs(forces[forces < 0.1 * pull]).max() < 1e-9 * pull
    y = s.spline.evaluate(mixed.displacement(s.spline, s.space, s.w), [[1.0, 0.0], [1.0, 1.0]])
    np.testing.assert_allclose(y[:, 0], 2.0 * (stretch - 1), rtol=1e-9)
    assert y[1, 1] - y[0, 1] == pytest.approx((1 - 2 * NU * eps) ** 0.5 - 1, rel=1e-9)


def test_prestressed_string():
    """A string under a uniform load f sags by f L^2/(8 N_0): prestress enters with factor 1."""
    L, f, N_0 = 1.5, 1e-6, 2.0
    line = shapes.line((0, 0), (L, 0), elements=4, degree=2)
    material = StVenantKirchhoff(E, NU, H, prestress=(N_0,), bending=False)
    fixed = np.concatenate([line.side_dofs("u0"), line.side_dofs("u1")])
    s = shell(line, [lambda spline, z: dead_load(spline, (0.0, -f), z)], fixed=fixed, material=material)
    s.w.x.array[:] = s.space.function(np.append(np.zeros(line.n * 2), np.full(s.space.n - line.n * 2, 1.0))).x.array
    s.w.x.array[:] *= N_0 / (E * H)
    newton(s.system, rtol=1e-7)
    y = s.spline.evaluate(mixed.displacement(s.spline, s.space, s.w), [[0.5]])
    np.testing.assert_allclose(y, [[0.0, -f * L**2 / (8 * N_0)]], atol=1e-6 * f)


def bent_panel(formulation, degree, elements, h):
    """Deflection of the far end of a panel that is clamped at one, in its middle, under its weight; linear."""
    geometry = panel(degree, elements)
    conditions = {"fixed": pinned(geometry, "end_0"), "constraints": [no_rotation(geometry, "end_0")]}
    if formulation == "two rows":
        conditions = {"fixed": clamped(geometry, "end_0")}

    def weight(spline, z):
        return dead_load(spline, (0.0, 0.0, -fem.Constant(spline.mesh, h**3)), z)

    def law(spline):
        return StVenantKirchhoff(*(fem.Constant(spline.mesh, value) for value in (E, NU, h)))

    if formulation == "mixed":
        s = shell(geometry, [weight], **conditions, material=law)
        solve_linear(s.system)
        y = mixed.displacement(s.spline, s.space, s.w)
        return float(s.spline.evaluate(y, [[1.0, 0.5]])[0, 2])
    spline = ExtractedSpline(geometry, zero_dofs=conditions.pop("fixed"), **conditions)
    y, z = spline.function(), ufl.TestFunction(spline.V)
    residual, tangent = internal_work(spline, law(spline), y, z), internal_tangent(spline, law(spline), y, z, y)
    solve_linear(SplineSystem(spline, residual + weight(spline, z), tangent, unknown=y))
    return float(spline.evaluate(y, [[1.0, 0.5]])[0, 2])


@pytest.mark.mpi
def test_both_formulations_converge_to_the_same():
    fine = bent_panel("mixed", 3, 16, 0.05)
    alone, both = (np.array([abs(bent_panel(how, 2, n, 0.05) / fine - 1) for n in (4, 8, 16)]) for how in HOW)
    assert (np.diff(alone) < 0).all()
    assert (np.diff(both) < 0).all()
    assert alone[-1] < 0.01
    assert (both < 0.7 * alone + 2e-3).all()


def test_a_thin_panel_locks_with_displacements_alone():
    fine = bent_panel("mixed", 3, 16, 0.005)
    alone, both = (abs(bent_panel(how, 3, 8, 0.005) / fine - 1) for how in HOW)
    assert alone > 0.5
    assert both < 0.01


def test_two_rows_hold_more_than_position_and_slope():
    fine = bent_panel("mixed", 3, 16, 0.05)
    errors = [abs(bent_panel(how, 3, 8, 0.05) / fine - 1) for how in ("two rows", "displacement")]
    assert errors[0] > 0.05
    assert errors[1] < 2e-3


def test_linear_splines_are_refused():
    spline = ExtractedSpline(shapes.line((0, 0), (1, 0), elements=2), MPI.COMM_SELF)
    with pytest.raises(ValueError, match="degree = 0"):
        mixed.mixed_space(spline)
