"""Patches with known geometry, and the splines on them, for the tests of several modules."""

from functools import cache

import numpy as np
from mpi4py import MPI

from tigar_x import compat, shapes
from tigar_x.bspline import BSplineBasis, open_knots
from tigar_x.patch import Patch
from tigar_x.spline import ExtractedSpline

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


def integral(form):
    return compat.assemble_scalar(compat.compile_forms(form)[0])


def coefficients(patch, size=None, seed=0):
    return np.random.default_rng(seed).uniform(-1, 1, (patch.basis.n, patch.nsd if size is None else size))
