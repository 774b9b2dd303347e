"""Nodal quadrature: the Lagrange nodes of a spline as points of a rule."""

import numpy as np
import pytest
from mpi4py import MPI

from tigar_x import compat
from tigar_x.geometry import shapes, surfaces
from tigar_x.geometry.bspline import BSplineBasis, open_knots
from tigar_x.geometry.patch import Patch
from tigar_x.splines.quadrature import NodalQuadrature
from tigar_x.splines.spline import ExtractedSpline

ELEMENTS = 3


def rule(patch, **options):
    return NodalQuadrature.of(ExtractedSpline(patch, MPI.COMM_SELF, **options))


def monomial_error(quadrature, power):
    """Error of the integral of x^power over [0, 1]."""
    return abs(quadrature.weights @ quadrature.points[:, 0] ** power - 1 / (power + 1))


@pytest.mark.parametrize("degree", [1, 2, 3, 4])
def test_lobatto_rule_on_a_line(degree):
    """``degree + 1`` Lobatto points integrate polynomials to degree ``2 degree - 1`` and no further."""
    q = rule(shapes.line((0, 0.5), (1, 0.5), elements=ELEMENTS, degree=degree))
    assert q.points.shape == (ELEMENTS * degree + 1, 2)
    assert q.weights.min() > 0.0
    for power in range(2 * degree):
        assert monomial_error(q, power) < 1e-14
    assert monomial_error(q, 2 * degree) > 1e-9
    np.testing.assert_allclose(q.points[:, 1], 0.5, rtol=1e-14)
    ends = [np.isclose(q.points[:, 0], x).nonzero()[0] for x in (0.0, 1.0)]
    assert [len(e) for e in ends] == [1, 1]
    np.testing.assert_allclose(q.weights[np.concatenate(ends)], 1 / ELEMENTS / (degree * (degree + 1)), rtol=1e-12)


@pytest.mark.parametrize("degrees", [(1, 1), (2, 3), (4, 2)])
def test_weights_of_a_parallelogram(degrees):
    patch = shapes.parallelogram((1, 0, 2), (2, 0, 0), (1, 3, 4), elements=(2, 3), degrees=degrees)
    q = rule(patch)
    p = max(degrees)
    assert q.points.shape == ((2 * p + 1) * (3 * p + 1), 3)
    assert q.weights.min() > 0.0
    assert q.weights.sum() == pytest.approx(10.0, rel=1e-13)
    # linear functions are integrated exactly by every one of these rules
    np.testing.assert_allclose(q.weights @ q.points, [25.0, 15.0, 40.0], rtol=1e-13)
    np.testing.assert_allclose(q.rational, 1.0, rtol=1e-14)


@pytest.mark.parametrize("factor", [1.0, 3.0])
def test_rational_weights(factor):
    """On a quarter circle the weights belong to the arc length, whatever the common factor of the NURBS weights."""
    basis = BSplineBasis(2, open_knots(2, [0, 1]))
    weights = factor * np.array([1.0, np.sqrt(0.5), 1.0])
    q = rule(Patch.from_points([basis], [[1, 0], [1, 1], [0, 1]], weights), quadrature_degree=16)
    assert q.weights.sum() == pytest.approx(np.pi / 2, rel=1e-12)
    assert q.weights.min() > 0.0
    np.testing.assert_allclose(np.hypot(*q.points.T), 1.0, rtol=1e-14)
    middle = np.argmin(abs(q.points[:, 0] - q.points[:, 1]))
    np.testing.assert_allclose(q.rational[middle], factor * (0.5 + 0.5 * np.sqrt(0.5)), rtol=1e-14)
    np.testing.assert_allclose(np.delete(q.rational, middle), factor, rtol=1e-14)


def test_what_a_pole_takes_comes_from_the_nodes_of_its_cells_alone():
    spline = ExtractedSpline(surfaces.sphere_cap(radius=1.0, angle=1.2, elements=(3, 4), degrees=(2, 2)), MPI.COMM_SELF)
    q, before = NodalQuadrature.of(spline), spline.node_areas
    cells = compat.cell_dofs(spline.scalar.V)
    near = np.unique(cells[(before[cells] < 0.0).any(axis=1)])
    far = np.setdiff1d(np.arange(len(before)), near)
    assert len(near) > 0
    assert len(far) > len(near)
    np.testing.assert_array_equal(q.weights[far], before[far])
    givers = near[before[near] > 1e-13]
    assert (q.weights[givers] < before[givers]).all()
    assert q.weights.min() >= 0.0
    assert q.weights.sum() == pytest.approx(before.sum(), rel=1e-13)


@pytest.mark.mpi
@pytest.mark.skipif(MPI.COMM_WORLD.size == 1, reason="needs more than one rank")
def test_distributed_splines_are_refused():
    spline = ExtractedSpline(shapes.line((0, 0), (1, 0), elements=4))
    with pytest.raises(ValueError, match=rf"spline lives on {MPI.COMM_WORLD.size} ranks: .*COMM_SELF"):
        NodalQuadrature.of(spline)


@pytest.mark.mpi
def test_every_rank_has_the_whole_rule():
    q = rule(shapes.line((0, 0), (1, 0), elements=4, degree=2))
    everyone = MPI.COMM_WORLD.allgather((q.points, q.weights))
    for points, weights in everyone:
        np.testing.assert_array_equal(points, everyone[0][0])
        np.testing.assert_array_equal(weights, everyone[0][1])
    assert len(q.weights) == 9
