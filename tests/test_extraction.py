"""Extraction: what the spline knows exactly, the finite elements know as well."""

import numpy as np
import pytest
from mpi4py import MPI
from dolfinx import fem
from splines import PATCHES, RATIONAL, WORLD, coefficients, integral, spline

from tigar_x import compat
from tigar_x.geometry.bspline import BSplineBasis, open_knots
from tigar_x.geometry.patch import Patch
from tigar_x.splines.spline import ExtractedSpline

pytestmark = pytest.mark.mpi


# -- the matrix -------------------------------------------------------------------------------------------------------


def wiggly(*degrees):
    """Patch on uneven knots, some of them repeated."""
    bases = []
    for p in degrees:
        inside = np.concatenate([[0.2], np.full(max(1, p - 1), 0.5), [0.9]])
        bases.append(BSplineBasis(p, np.concatenate([np.zeros(p + 1), inside, np.ones(p + 1)])))
    n = int(np.prod([basis.n for basis in bases]))
    return Patch.from_points(bases, np.random.default_rng(0).uniform(size=(n, 3)))


@pytest.mark.parametrize("degrees", [(1,), (2,), (3,), (4,), (1, 1), (2, 1), (2, 3), (1, 4)])
def test_finite_elements_reproduce_every_function(degrees):
    patch = wiggly(*degrees)
    s = ExtractedSpline(patch)
    M = s.scalar.nodes
    np.testing.assert_allclose(M.sum(axis=1), 1.0, rtol=0, atol=1e-13)
    assert np.diff(M.indptr).max() <= np.prod([p + 1 for p in degrees])

    vertices = compat.cell_vertices(s.mesh)[: compat.owned_cells(s.mesh)]
    low, high = vertices.min(axis=1), vertices.max(axis=1)
    theta = np.random.default_rng(1).uniform(0.01, 0.99, (5, *low.shape))
    xi = (low + theta * (high - low)).reshape(-1, patch.dim)
    cells = np.tile(np.arange(len(low), dtype=np.int32), len(theta))
    N = patch.basis.evaluate(xi)
    u = fem.Function(s.scalar.V)
    for column in coefficients(patch, 3).T:
        u.x.array[:] = M @ column
        found = u.eval(np.pad(xi, ((0, 0), (0, 3 - patch.dim))), cells).reshape(-1)
        np.testing.assert_allclose(found, N @ column, rtol=0, atol=2e-13)
    assert WORLD.allreduce(len(xi), op=MPI.SUM) == 5 * np.prod([len(b.breakpoints) - 1 for b in patch.bases])


@pytest.mark.parametrize("size", [1, 2, 4])
def test_components_are_treated_alike(size):
    space = ExtractedSpline(wiggly(2, 3)).space(size)
    n = space.nodes.shape[1]
    U = np.random.default_rng(2).uniform(size=(n, size))
    x, y = space.M.createVecs()
    x.array_w[:] = U.ravel()[slice(*x.getOwnershipRange())]
    space.M.mult(x, y)
    owned = space.V.dofmap.index_map.size_local
    np.testing.assert_allclose(y.array_r.reshape(-1, size), (space.nodes @ U)[:owned], rtol=0, atol=1e-14)
    assert space.M.size[1] == size * n


# -- geometry ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "measure", "moment"),
    [
        ("line", 5.0, [12.5, 0.0]),
        # |(2, 0, 0) x (1, 3, 4)| = 10, centre (2.5, 1.5, 4)
        ("parallelogram", 10.0, [25.0, 15.0, 40.0]),
        ("arc", np.pi / 2, [1.0, 1.0]),
        ("annulus", 0.75 * np.pi, [7 / 3, 7 / 3]),
        ("cylinder", np.pi, [2.0, 2.0, np.pi]),
    ],
)
def test_lengths_and_areas(name, measure, moment):
    degree = 16 if name in RATIONAL else None
    s = spline(name, quadrature_degree=degree)
    assert integral(1.0 * s.dx) == pytest.approx(measure, rel=1e-12)
    found = [integral(s.F[i] * s.dx) for i in range(s.nsd)]
    np.testing.assert_allclose(found, moment, rtol=0, atol=1e-11)
    if name in RATIONAL:  # a rule of low degree does not integrate the rational speed exactly
        assert abs(integral(1.0 * spline(name, quadrature_degree=2).dx) / measure - 1.0) > 1e-8


@pytest.mark.parametrize("name", PATCHES)
def test_position_at_nodes(name):
    s = spline(name)
    nodes = s.scalar.V.tabulate_dof_coordinates()[:, : s.geometry.dim]
    np.testing.assert_allclose(s.node_positions, s.geometry.evaluate(nodes), rtol=0, atol=1e-14)
    position = fem.Function(s.V)
    compat.interpolate(position, s.F)
    np.testing.assert_allclose(position.x.array.reshape(-1, s.nsd), s.node_positions, rtol=0, atol=1e-13)
    assert (s.weight is None) == (name not in RATIONAL)
    if name in ("arc", "cylinder"):
        np.testing.assert_allclose(np.hypot(*s.node_positions[:, :2].T), 1.0, rtol=1e-14)


@pytest.mark.parametrize("scale", [1.0, 1e-3])
@pytest.mark.parametrize("weight", [1.0, 0.7])
@pytest.mark.parametrize("doubled", [[2.0, 0.0], [0.7, 0.3]])
def test_an_element_without_length_is_refused(doubled, weight, scale):
    basis = BSplineBasis(2, open_knots(2, np.arange(5)))
    points = scale * np.array([[0, 0], [0.5, 0], doubled, doubled, doubled, [3, 0]])
    with pytest.raises(ValueError, match="zero length or area"):
        ExtractedSpline(Patch.from_points([basis], points, [weight] * 6))


def test_an_element_without_area_is_refused_and_a_thin_one_is_not():
    def sheet(width):
        bases = [BSplineBasis(1, open_knots(1, np.arange(3)))] * 2
        x, y = (a.ravel() for a in np.meshgrid([0.0, 0.3, 0.7], [0.0, 0.1, 0.1 + width]))
        return ExtractedSpline(Patch.from_points(bases, np.column_stack([x, y, 0.3 * x])))

    with pytest.raises(ValueError, match="zero length or area"):
        sheet(0.0)
    assert integral(1.0 * sheet(1e-9).dx) == pytest.approx(0.07 * np.sqrt(1.09), rel=1e-7)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"zero_dofs": [0, 14]}, r"zero_dofs contains 14: integers from 0 to 13 are required"),
        ({"zero_dofs": [-1]}, r"zero_dofs contains -1: integers"),
        ({"quadrature_degree": -1}, r"quadrature_degree = -1: an integer >= 0"),
        ({"quadrature_degree": 2.5}, r"quadrature_degree = 2.5"),
    ],
)
def test_bad_arguments(change, message):
    with pytest.raises(ValueError, match=message):
        ExtractedSpline(PATCHES["line"](), **change)


def test_bad_coefficients():
    with pytest.raises(ValueError, match=r"coefficients has shape \(3, 2\): shape \(7, 2\)"):
        spline("line").function(np.zeros((3, 2)))
