"""Patches with known geometry, and the splines on them, for the tests of several modules."""

from functools import cache

import numpy as np
import ufl
from mpi4py import MPI
from dolfinx import fem

from tigar_x import compat
from tigar_x.geometry import shapes
from tigar_x.geometry.bspline import BSplineBasis, open_knots, periodic_knots
from tigar_x.geometry.multipatch import as_multipatch
from tigar_x.geometry.patch import Patch
from tigar_x.splines.spline import ExtractedSpline
from tigar_x.splines.spline_system import SplineSystem, solve_linear

WORLD = MPI.COMM_WORLD
SPANS = 2  # per quarter of a circle


def quarter(rows=None):
    """Quarter of the unit circle in rational quadratics; ``rows`` of (scale, height) sweep it to a surface."""
    half = np.pi / 4 / SPANS
    angle, weight = half * np.arange(2 * SPANS + 1), np.tile([1.0, np.cos(half)], SPANS + 1)[:-1]
    x = np.stack([np.cos(angle), np.sin(angle)], axis=1) / weight[:, None]
    knots = np.concatenate([[0.0], np.repeat(np.arange(SPANS + 1.0), 2), [SPANS]])
    bases = [BSplineBasis(2, knots)]
    if rows is None:
        return Patch.from_points(bases, x, weight)
    bases.append(BSplineBasis(1, open_knots(1, np.arange(len(rows)))))
    points = np.concatenate(
        [np.column_stack([scale * x, *([np.full(len(x), z)] * (z is not None))]) for scale, z in rows]
    )
    return Patch.from_points(bases, points, np.tile(weight, len(rows)))


def turned(basis, r, z=None, weights=None, *, quarters=1, closed=False):
    """Curve (r, z) turned about the third axis in rational quadratics, u along the circle; without z in the plane."""
    angle, w = np.pi / 4 * np.arange(2 * quarters + 1), np.tile([1.0, np.sqrt(0.5)], quarters + 1)[:-1]
    x = np.stack([np.cos(angle), np.sin(angle)], axis=1) / w[:, None]
    ticks = np.arange(quarters + 1.0)
    if closed:  # the first function of the periodic basis is the bubble of the first arc
        circle = BSplineBasis(2, periodic_knots(2, ticks, 0), periodic=True)
        x, w = x[1:], w[1:]
    else:
        circle = BSplineBasis(2, open_knots(2, ticks, 0))
    r, weights = np.asarray(r, dtype=float), np.ones(len(r)) if weights is None else np.asarray(weights)
    points = (r[:, None, None] * x).reshape(-1, 2)
    if z is not None:
        points = np.column_stack([points, np.repeat(z, len(x))])
    return Patch.from_points([circle, basis], points, np.outer(weights, w).ravel())


def radial(degree, elements):
    """Uniform basis over [0, 1], and its Greville points as radii of a disc."""
    basis = BSplineBasis(degree, open_knots(degree, np.linspace(0.0, 1.0, elements + 1)))
    return basis, basis.greville


def half_disc(elements=2, degree=2):
    """Half of the unit disc with a pole at its centre, v along the radius."""
    return turned(*radial(degree, elements), quarters=2)


def rectangle(x, y, elements=(2, 2), degrees=(2, 2)):
    """[x_0, x_1] x [y_0, y_1] in the plane."""
    edges = (x[1] - x[0], 0.0), (0.0, y[1] - y[0])
    return shapes.parallelogram((x[0], y[0]), *edges, elements=elements, degrees=degrees)


PATCHES = {
    "line": lambda: shapes.line((1, 2), (4, -2), elements=4, degree=3),
    "parallelogram": lambda: shapes.parallelogram((1, 0, 2), (2, 0, 0), (1, 3, 4), elements=(3, 2), degrees=(2, 3)),
    "arc": quarter,
    "annulus": lambda: quarter([(1.0, None), (1.4, None), (2.0, None)]),
    "cylinder": lambda: quarter([(1.0, 0.0), (1.0, 0.5), (1.0, 2.0)]),
}
RATIONAL = ("arc", "annulus", "cylinder")


@cache
def spline(name, alone=False, quadrature_degree=None):
    return ExtractedSpline(PATCHES[name](), MPI.COMM_SELF if alone else WORLD, quadrature_degree=quadrature_degree)


def poisson(geometry, load=lambda x: 1.0 + x[0], fixed=None, **options):
    """Solution of -div grad u = load with u = 0 on sides (all of the boundary), and its spline."""
    s = ExtractedSpline(geometry, **options)
    sides = as_multipatch(geometry).outer_sides if fixed is None else fixed
    space = s.space(1, zero_dofs=np.concatenate([geometry.side_functions(*side) for side in sides]))
    u, v = fem.Function(space.V), s.rationalize(ufl.TestFunction(space.V))
    residual = ufl.inner(s.grad(s.rationalize(u)), s.grad(v)) * s.dx - load(s.F) * v * s.dx
    solve_linear(SplineSystem(space, residual, ufl.derivative(residual, u), unknown=u))
    return u, s


def energy(u, s):
    """Dirichlet energy of a scalar field, and its mean square."""
    grad = s.grad(s.rationalize(u))
    return integral(ufl.inner(grad, grad) * s.dx), integral(s.rationalize(u) ** 2 * s.dx)


def integral(form):
    return compat.assemble_scalar(compat.compile_forms(form)[0])


def coefficients(patch, size=None, seed=0):
    return np.random.default_rng(seed).uniform(-1, 1, (patch.basis.n, patch.nsd if size is None else size))
