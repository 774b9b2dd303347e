"""Shells with contact: the reduced system, statically and in time."""

import numpy as np
import pytest
import scipy.sparse as sp
import ufl
from mpi4py import MPI
from dolfinx import fem

from shnapr.contact import LinearKernel, SelfContact, SmoothedKernel
from shnapr.contact.system import ContactSystem
from shnapr.loads import dead_load, inertia
from shnapr.svk import StVenantKirchhoff
from shnapr.work import strain_energy, virtual_work
from tigar_x.fem.load_stepping import follow_load
from tigar_x.fem.schemes import generalized_alpha
from tigar_x.fem.solve import newton
from tigar_x.fem.time_integration import LoadStepper, TimeIntegrator
from tigar_x.geometry import shapes
from tigar_x.geometry.multipatch import disjoint
from tigar_x.splines.quadrature import NodalQuadrature
from tigar_x.splines.spline import ExtractedSpline

GAP, R_MAX = 0.1, 0.08


def beams(time_step=None, load=0.0, kernel=None, r_self=0.09):
    """Two parallel beams in the plane, each held at one end by its first two control points, with contact."""
    lower = shapes.line((0, 0), (1, 0), elements=16, degree=2)
    upper = shapes.line((0, GAP), (1, GAP), elements=16, degree=2)
    geometry = disjoint(lower, upper)
    spline = ExtractedSpline(geometry, MPI.COMM_SELF, zero_dofs=geometry.side_dofs("u0", 2))
    y, z = spline.function(), ufl.TestFunction(spline.V)
    material = StVenantKirchhoff(1e4, 0.3, 0.02)
    force = fem.Constant(spline.mesh, (0.0, -load))
    # the upper beam alone is loaded: its parameters begin at 2
    on_upper = ufl.conditional(ufl.gt(ufl.SpatialCoordinate(spline.mesh)[0], 1.5), 1.0, 0.0)
    time, level = None, y
    residual = 0
    if time_step is not None:
        time = TimeIntegrator(y, time_step, generalized_alpha(0.5, 2))
        level = time.x_alpha
        residual = inertia(spline, time.xddot_alpha, z, density=1.0, thickness=0.02)
    residual += virtual_work(spline, lambda u: strain_energy(spline, material, u), level, z)
    stepper = LoadStepper(y, 0.05)
    residual += dead_load(spline, stepper.t * on_upper * force, z)
    contact = SelfContact(NodalQuadrature.of(spline), kernel or SmoothedKernel(R_MAX, 1e5, 1.0), r_self)
    system = ContactSystem(spline, residual, ufl.derivative(residual, y), contact, unknown=y, time=time)
    return spline, y, system, stepper


def dense(A):
    return sp.csr_matrix(A.getValuesCSR()[::-1], shape=A.size).toarray()


@pytest.mark.parametrize("time_step", [None, 1e-3])
def test_tangent_is_the_slope_of_the_residual(time_step):
    spline, y, system, _ = beams(time_step)
    n = spline.geometry.n
    U = np.zeros((n, 2))
    U[n // 2 :, 1] = -0.5 * GAP  # the upper beam pushed towards the lower one
    rng = np.random.default_rng(0)
    U += 1e-3 * rng.standard_normal(U.shape)
    V = rng.standard_normal(U.shape)
    V.ravel()[spline.zero_dofs] = 0.0

    def residual(U):
        y.x.array[:] = (spline.vector.nodes @ U).ravel()
        system.assemble_residual()
        return system.b.array_r.copy()

    h = 1e-7
    slope = (residual(U + h * V) - residual(U - h * V)) / (2 * h)
    residual(U)
    assert system.forces.pairs > 10
    system.assemble_tangent()
    K = dense(system.A)
    np.testing.assert_allclose(K @ V.ravel(), slope, rtol=0, atol=2e-6 * np.abs(slope).max())
    np.testing.assert_allclose(K, K.T, rtol=0, atol=1e-10 * np.abs(K).max())
    # without contact the tangent is another one
    system._bind(system._own)
    other = dense(system.A) @ V.ravel()
    assert np.abs(other - slope).max() > 0.02 * np.abs(slope).max()


@pytest.mark.parametrize("time_step", [None, 1e-3])
def test_a_positive_tangent_has_a_semidefinite_part_of_contact_and_the_same_residual(time_step):
    spline, y, system, _ = beams(time_step)
    n = spline.geometry.n
    U = 1e-3 * np.random.default_rng(0).standard_normal((n, 2))
    U[n // 2 :, 1] -= 0.5 * GAP
    y.x.array[:] = (spline.vector.nodes @ U).ravel()
    parts, residuals, free = {}, {}, np.setdiff1d(np.arange(2 * n), spline.zero_dofs)
    for positive in (False, True):
        system.positive = positive
        system.assemble_residual()
        residuals[positive] = system.b.array_r.copy()
        system.assemble_tangent()
        whole = dense(system.A)
        system.renew_contact()  # leaves out the same
        np.testing.assert_allclose(dense(system.A), whole, rtol=0.0, atol=1e-12 * np.abs(whole).max())
        system._bind(system._own)
        parts[positive] = (whole - dense(system.A))[np.ix_(free, free)]
    assert system.forces.pairs > 10
    np.testing.assert_array_equal(residuals[True], residuals[False])
    lowest = {positive: np.linalg.eigvalsh(part).min() for positive, part in parts.items()}
    scale = np.abs(parts[True]).max()
    assert lowest[True] > -1e-9 * scale
    assert lowest[False] < -1e-2 * scale


def test_contact_is_renewed_where_something_has_changed_and_factors_are_kept_where_not():
    spline, y, system, _ = beams()
    n = spline.geometry.n
    U = np.zeros((n, 2))
    U[n // 2 :, 1] = -0.5 * GAP
    y.x.array[:] = (spline.vector.nodes @ U).ravel()
    system.assemble_tangent()
    load = np.where(np.isin(np.arange(2 * n), spline.zero_dofs), 0.0, 1.0)
    before, factors = system.inverse(load), system._factors
    system.renew_contact()
    assert system._factors is factors
    y.x.array[:] *= 1.1
    system.renew_contact()
    assert system._factors is None
    moved = system.inverse(load)
    assert np.abs(moved - before).max() > 1e-3 * np.abs(before).max()
    system.positive = True
    system.renew_contact()
    assert system._factors is None
    positive = system.inverse(load)
    assert np.abs(positive - moved).max() > 1e-3 * np.abs(moved).max()
    whole = dense(system.A)
    system.assemble_tangent()
    np.testing.assert_allclose(np.linalg.solve(whole, load), positive, rtol=0.0, atol=1e-9 * np.abs(positive).max())


@pytest.mark.parametrize("r_self", [0.09, 0.12])
def test_a_loaded_beam_rests_on_the_other_one_however_near_it_starts(r_self):
    spline, y, system, stepper = beams(load=0.02, r_self=r_self)
    follow_load(system, stepper, atol=1e-10, rtol=0.0)
    x = spline.node_positions + spline.nodal(y)
    upper = spline.node_positions[:, 1] > GAP / 2
    assert 0.0 < system.forces.distance < R_MAX
    # the lower beam is bent by nothing but contact
    tip = np.argmax(spline.node_positions[:, 0] + 10 * upper), np.argmax(spline.node_positions[:, 0] - 10 * upper)
    gap = x[tip[0], 1] - x[tip[1], 1]
    assert 0.0 < gap < GAP
    assert spline.nodal(y)[tip[1], 1] < -0.005
    # and they would have crossed without it
    free_spline, free_y, free, stepper = beams(load=0.02, kernel=SmoothedKernel(R_MAX, 1e-12, 1.0))
    follow_load(free, stepper, atol=1e-10, rtol=0.0)
    assert GAP + free_spline.nodal(free_y)[tip[0], 1] < 0.0


def test_momentum_of_colliding_bodies_is_kept():
    """Two free beams, one thrown at the other: contact moves momentum from one to the other and makes none."""
    spline, y, _, _ = beams()
    material = StVenantKirchhoff(1e4, 0.3, 0.02)
    free = ExtractedSpline(spline.geometry, MPI.COMM_SELF)
    y, z = free.function(), ufl.TestFunction(free.V)
    velocity = np.zeros((free.geometry.n, 2))
    velocity[free.geometry.n // 2 :, 1] = -1.0
    time = TimeIntegrator(y, 5e-4, generalized_alpha(0.5, 2), xdot=free.function(velocity))
    residual = inertia(free, time.xddot_alpha, z, density=1.0, thickness=0.02)
    residual += virtual_work(free, lambda u: strain_energy(free, material, u), time.x_alpha, z)
    contact = SelfContact(NodalQuadrature.of(free), LinearKernel(R_MAX, 1e5), r_self=0.09)
    system = ContactSystem(free, residual, ufl.derivative(residual, y), contact, unknown=y, time=time)
    upper = free.node_positions[:, 1] > GAP / 2
    W = free.node_areas

    def momentum():
        v = free.nodal(time.xdot_old)
        return np.array([W[part] @ v[part] for part in (upper, ~upper)])

    start, touched = momentum(), 0
    for _ in range(160):
        time.predict()
        newton(system, rtol=1e-10, atol=1e-12)
        time.advance()
        touched += system.forces.pairs > 0
    end = momentum()
    assert touched > 3
    np.testing.assert_allclose(end.sum(axis=0), start.sum(axis=0), rtol=0, atol=1e-10)
    assert end[1, 1] < -0.5  # the beam at rest has been pushed away
    assert start[1, 1] == 0.0
