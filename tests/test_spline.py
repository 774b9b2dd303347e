"""Calculus, mass matrices and projections on splines."""

import numpy as np
import pytest
import ufl
from mpi4py import MPI
from dolfinx import fem
from splines import PATCHES, RATIONAL, WORLD, coefficients, integral, spline

from tigar_x.splines.spline import ExtractedSpline
from tigar_x.splines.spline_system import SplineSystem

pytestmark = pytest.mark.mpi


def dense(A):
    """The whole matrix on every rank."""
    first, last = A.getOwnershipRange()
    return np.concatenate(WORLD.allgather(A.getValues(range(first, last), range(A.size[1]))))


# -- calculus ---------------------------------------------------------------------------------------------------------


def projector(s):
    """Tangential projector of the known surfaces in terms of the position."""
    I = ufl.Identity(s.nsd)
    if s.nsd == s.geometry.dim:
        return I
    radial = ufl.as_vector([s.F[0], s.F[1], *([0.0] * (s.nsd - 2))]) / ufl.sqrt(s.F[0] ** 2 + s.F[1] ** 2)
    return I - ufl.outer(radial, radial)


@pytest.mark.parametrize("name", RATIONAL)
def test_gradient_and_divergence_are_those_of_the_surface(name):
    s = spline(name)
    x, z = s.F, s.F[s.nsd - 1]
    P = projector(s)
    # f = x0^2 z + x1 and v = (z x0, x0 x1, ...) with their gradients in space
    f = x[0] ** 2 * z + x[1]
    e = [ufl.as_vector([float(i == j) for j in range(s.nsd)]) for i in range(s.nsd)]
    df = 2 * x[0] * z * e[0] + e[1] + x[0] ** 2 * e[-1]
    v = z * x[0] * e[0] + x[0] * x[1] * e[1]
    dv = ufl.outer(e[0], z * e[0] + x[0] * e[-1]) + ufl.outer(e[1], x[1] * e[0] + x[0] * e[1])
    T = ufl.outer(v, x)
    zero = [
        s.grad(f) - P * df,
        s.grad(v) - dv * P,
        s.div(v) - ufl.inner(dv, P),
        s.div(x) - s.geometry.dim,
        s.div(T) - (dv * P * x + s.geometry.dim * v),
    ]
    assert s.grad(v).ufl_shape == (s.nsd, s.nsd)
    assert s.div(T).ufl_shape == (s.nsd,)
    assert integral(sum(ufl.inner(r, r) for r in zero) * s.dx) < 1e-24
    if s.nsd > s.geometry.dim:  # the gradient in space itself is another one
        assert integral(ufl.inner(s.grad(f) - df, s.grad(f) - df) * s.dx) > 0.1


# -- systems ----------------------------------------------------------------------------------------------------------


def mass(s, factor=1.0, f=None, **options):
    u, v = ufl.TrialFunction(s.V), ufl.TestFunction(s.V)
    load = ufl.as_vector([1.0] * s.nsd) if f is None else f
    form = factor * ufl.inner(s.rationalize(u), s.rationalize(v)) * s.dx
    return SplineSystem(s, ufl.inner(load, s.rationalize(v)) * s.dx, form, **options)


@pytest.mark.parametrize("name", ["parallelogram", "arc"])
def test_mass_matrix_and_its_symbolic_reuse(name):
    s = spline(name)
    factor = fem.Constant(s.mesh, 1.0)
    zero = s.geometry.side_dofs("u1", 2)
    free, held = mass(s, factor), mass(s, factor, zero_dofs=zero)
    for system in (free, held):
        system.assemble_tangent()
    A, H = dense(free.A), dense(held.A)
    np.testing.assert_allclose(A, A.T, rtol=0, atol=1e-14)
    assert np.linalg.eigvalsh(A).min() > 1e-5
    # sum of the components of a rigid translation
    one = (s.geometry.weights[:, None] * np.eye(s.nsd)[0]).ravel()
    assert one @ A @ one == pytest.approx(integral(1.0 * s.dx), rel=1e-12)

    expected = A.copy()
    expected[zero], expected[:, zero] = 0.0, 0.0
    expected[zero, zero] = 1.0
    np.testing.assert_allclose(H, expected, rtol=0, atol=1e-15)

    factor.value = 3.0
    for system in (free, held):
        system.assemble_tangent()
    np.testing.assert_allclose(dense(free.A), 3.0 * A, rtol=0, atol=1e-14)
    expected[np.ix_(*[np.setdiff1d(np.arange(len(A)), zero)] * 2)] *= 3.0
    np.testing.assert_allclose(dense(held.A), expected, rtol=0, atol=1e-14)

    held.assemble_residual()
    first, last = held.b.getOwnershipRange()
    mine = zero[(zero >= first) & (zero < last)] - first
    assert not held.b.array_r[mine].any()
    assert np.delete(held.b.array_r, mine).all()


def nodal_constant(s, value):
    return np.tile(np.asarray(value, dtype=float), (len(s.node_weights), 1))


@pytest.mark.parametrize("name", PATCHES)
def test_projections(name):
    s = spline(name)
    constant = np.array([1.5, -2.0, 0.25])[: s.nsd]
    np.testing.assert_allclose(
        s.nodal(s.project(ufl.as_vector(list(constant)))), nodal_constant(s, constant), rtol=0, atol=1e-12
    )
    lump = s.lumped_projector
    np.testing.assert_allclose(
        lump(lump.compile(ufl.as_vector(list(constant)))), nodal_constant(s, constant), rtol=0, atol=1e-13
    )
    # the consistent projection leaves the spline space alone, the lumped one smooths it
    u = s.function(coefficients(s.geometry))
    projected = s.project(s.rationalize(u))
    np.testing.assert_allclose(projected.x.array, u.x.array, rtol=0, atol=1e-11)
    smoothed = lump(lump.compile(s.rationalize(u)))
    assert WORLD.allreduce(np.abs(smoothed - s.nodal(u)).max(), op=MPI.MAX) > 0.05


def test_constrained_projection_keeps_the_zero_dofs():
    patch = PATCHES["parallelogram"]()
    s = ExtractedSpline(patch, zero_dofs=patch.side_dofs("u0"))
    u = s.project(ufl.as_vector([1.0, 2.0, 3.0]), constrained=True)
    at_start = np.isclose(s.scalar.V.tabulate_dof_coordinates()[:, 0], 0.0)
    assert not s.nodal(u)[at_start].any()
    free = s.project(ufl.as_vector([1.0, 2.0, 3.0]))
    np.testing.assert_allclose(s.nodal(free), nodal_constant(s, [1, 2, 3]), rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", ["parallelogram", "annulus"])
def test_one_rank_and_all_ranks_agree(name):
    def measures(s):
        x = s.F
        u = s.rationalize(s.project(ufl.as_vector([ufl.sin(3 * x[0] + i) * x[1] for i in range(s.nsd)])))
        gradient = s.grad(u)
        return [integral(g * s.dx) for g in (ufl.inner(u, u), ufl.inner(gradient, gradient), s.div(u))]

    np.testing.assert_allclose(measures(spline(name, alone=True)), measures(spline(name)), rtol=1e-11)
