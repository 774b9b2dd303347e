"""Plane Kirchhoff-Love beams and strings, per unit depth, against closed-form solutions."""

from types import SimpleNamespace

import numpy as np
import pytest
import ufl
from mpi4py import MPI
from dolfinx import fem
from scipy.optimize import brentq
from scipy.special import ellipe, ellipeinc, ellipk, ellipkinc

from shnapr.loads import dead_load
from shnapr.svk import StVenantKirchhoff
from shnapr.work import strain_energy, virtual_work
from tigar_x.fem.solve import newton
from tigar_x.fem.time_integration import LoadStepper
from tigar_x.geometry import shapes
from tigar_x.splines.spline import ExtractedSpline
from tigar_x.splines.spline_system import SplineSystem

E, NU = 3.0e4, 0.3


def cantilever(degree, elements, *, L, h, load, layers=2, direction=(1.0, 0.0)):
    """Beam from the origin along ``direction``, clamped at its start, with a dead force across it at its end.

    ``load`` is the final force; the pseudo-time of ``time`` scales it.
    """
    t = np.array(direction) / np.linalg.norm(direction)
    across = np.array([-t[1], t[0]])
    patch = shapes.line((0, 0), L * t, elements=elements, degree=degree)
    spline = ExtractedSpline(patch, MPI.COMM_SELF, zero_dofs=patch.side_dofs("u0", layers))
    y, z = spline.function(), ufl.TestFunction(spline.V)
    time = LoadStepper(y, 1.0)
    material = StVenantKirchhoff(E, NU, fem.Constant(spline.mesh, h))
    # the parameter is 0 at the clamped end and 1 at the loaded one
    at_end = ufl.SpatialCoordinate(spline.mesh)[0]
    force = time.t * fem.Constant(spline.mesh, load * across)
    residual = virtual_work(spline, lambda u: strain_energy(spline, material, u), y, z)
    residual -= at_end * ufl.dot(force, z) * ufl.ds(domain=spline.mesh)
    system = SplineSystem(spline, residual, ufl.derivative(residual, y), unknown=y)
    tip = int(np.argmax(spline.node_positions @ t))
    return SimpleNamespace(
        spline=spline, system=system, y=y, time=time, tip=lambda: spline.nodal(y)[tip] @ np.column_stack([t, across])
    )


def linear_deflection(degree, elements, **options):
    """Deflection of the tip along the force after one linear solve."""
    beam = cantilever(degree, elements, L=2.0, h=0.1, load=0.4, **options)
    beam.system.assemble_residual()
    beam.system.assemble_tangent()
    beam.system.subtract(beam.system.solve())
    axial, across = beam.tip()
    assert abs(axial) < 1e-12 * abs(across)
    return across


def exact_deflection(modulus):
    """P L^3/(3 E' I) of that beam."""
    return 0.4 * 2.0**3 / (3 * modulus * 0.1**3 / 12)


PLANE_STRAIN = E / (1 - NU**2)  # zero strain along the generator


@pytest.mark.parametrize("direction", [(1, 0), (0, 1), (-3, 2)])
@pytest.mark.parametrize("elements", [1, 2, 5])
def test_cubic_beam_is_exact(elements, direction):
    w = linear_deflection(3, elements, direction=direction)
    assert w == pytest.approx(exact_deflection(PLANE_STRAIN), rel=1e-8)


def test_quadratic_beam_converges():
    """The tip's error under a tip force is the energy error: rate 2 (p - 1). The wrong modulus E does not converge."""
    w = np.array([linear_deflection(2, n) for n in (2, 4, 8, 16)])
    errors = np.abs(w / exact_deflection(PLANE_STRAIN) - 1)
    assert np.log2(errors[-2] / errors[-1]) == pytest.approx(2, abs=0.05)
    assert errors[-1] < 1.5e-3
    sibling = np.abs(w / exact_deflection(E) - 1)
    assert np.log2(sibling[-2] / sibling[-1]) < 0.2
    assert sibling[-1] > 0.05


def elastica(load):
    """Deflection and shortening of the tip over L, for P L^2/(E' I) = load, by elliptic integrals.

    With k^2 = (1 + sin theta)/2, theta the slope of the tip, and sin phi = 1/(k sqrt 2): sqrt(load) = K(k) - F(phi, k),
    deflection 1 - 2 (E(k) - E(phi, k))/sqrt(load), remaining length sqrt(2 sin theta/load).
    """
    a = np.sqrt(load)

    def angles(theta):
        m = (1 + np.sin(theta)) / 2
        return m, np.arcsin(1 / np.sqrt(2 * m))

    def mismatch(theta):
        m, phi = angles(theta)
        return ellipk(m) - ellipkinc(phi, m) - a

    theta = brentq(mismatch, 1e-6, np.pi / 2 - 1e-9, xtol=1e-14)
    m, phi = angles(theta)
    return 1 - 2 * (ellipe(m) - ellipeinc(phi, m)) / a, 1 - np.sqrt(2 * np.sin(theta)) / a


def test_elastica_formula():
    """Small loads: P L^3/(3 E I); load 4: the published tip of Sze, Liu and Lo, doi:10.1016/j.finel.2003.11.001."""
    assert elastica(1e-3)[0] == pytest.approx(1e-3 / 3, rel=1e-5)
    np.testing.assert_allclose(elastica(4.0), (0.6698, 0.3286), atol=6e-4)  # h/L = 0.01, with shear


@pytest.mark.parametrize(
    ("degree", "elements", "h", "tolerance"),
    [
        (3, 16, 1e-2, 2e-4),
        (3, 16, 1e-3, 2e-3),  # membrane locking of the thinner beam ...
        (3, 32, 1e-3, 2e-4),  # ... that refinement and degree cure
        (4, 16, 1e-3, 2e-4),
    ],
)
def test_elastica(degree, elements, h, tolerance):
    """A thin cantilever of unit length under a dead tip force with P L^2/(E' I) = 4, in load steps."""
    steps, load = 10, 4 * PLANE_STRAIN * h**3 / 12
    beam = cantilever(degree, elements, L=1.0, h=h, load=load / steps, direction=(1, -2))
    for step in range(steps):
        if step:
            beam.time.advance()
        newton(beam.system, rtol=1e-6, reference=load, max_iterations=30)
    axial, across = beam.tip()
    np.testing.assert_allclose((across, -axial), elastica(4.0), atol=tolerance)


@pytest.mark.parametrize(("N_0", "elements"), [(2.0, 2), (50.0, 3)])
def test_string(N_0, elements):
    """A string under a uniform load f sags by f L^2/(8 N_0): prestress enters with factor 1."""
    L, f = 1.5, 0.3
    patch = shapes.line((0, 0), (L, 0), elements=elements, degree=2)
    spline = ExtractedSpline(
        patch, MPI.COMM_SELF, zero_dofs=np.concatenate([patch.side_dofs("u0"), patch.side_dofs("u1")])
    )
    material = StVenantKirchhoff(10.0, 0.3, 0.1, prestress=(N_0,), bending=False)
    y, z = spline.function(), ufl.TestFunction(spline.V)
    residual = virtual_work(spline, lambda u: strain_energy(spline, material, u), y, z)
    tangent = ufl.derivative(residual, y)
    system = SplineSystem(spline, residual + dead_load(spline, ufl.as_vector([0.0, -f]), z), tangent, unknown=y)
    system.assemble_residual()
    system.assemble_tangent()
    system.subtract(system.solve())
    s = spline.node_positions[:, 0]
    np.testing.assert_allclose(spline.nodal(y), np.column_stack([0 * s, -f * s * (L - s) / (2 * N_0)]), atol=1e-13)


def bent_tip(degree, elements, h, steps=8):
    """Tip of a cantilever of length 1 under P L^2/(E' I) = 4, over which membrane stiffness towers as it gets thin."""
    force = 4.0 * PLANE_STRAIN * h**3 / 12
    beam = cantilever(degree, elements, L=1.0, h=h, load=force)
    for k in range(1, steps + 1):
        beam.time.t.value = k / steps
        newton(beam.system, rtol=0.0, atol=3e-5 * force, max_iterations=60)
    return np.array(beam.tip())


def locking(degree, h):
    """Error of the tip with 16 elements, against 32 elements of degree 5."""
    return np.abs(bent_tip(degree, 16, h) - bent_tip(5, 32, h)).max()


def test_quartic_beams_do_not_lock_and_quadratic_ones_do():
    thickness = (1e-1, 1e-2, 1e-3, 1e-4)
    quartic = [locking(4, h) for h in thickness]
    assert max(quartic) <= 2 * quartic[0]
    assert quartic[0] < 1e-4
    assert locking(3, 1e-3) < 2e-3
    assert locking(2, 1e-3) > 0.1
