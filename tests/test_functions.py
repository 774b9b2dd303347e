"""Functions of several patches: where they lie in the parametric plane, their values there, and their numbering."""

import math

import numpy as np
import pytest

from tigar_x.geometry.bspline import BSplineBasis, TensorBasis, open_knots, periodic_knots
from tigar_x.geometry.functions import SplineFunctions


def basis(degree, ticks, periodic=False):
    make = periodic_knots if periodic else open_knots
    return BSplineBasis(degree, make(degree, ticks), periodic)


CURVES = (
    TensorBasis((basis(2, [0.0, 1.0, 3.0]),)),
    TensorBasis((basis(3, [-2.0, -1.5]),)),
    TensorBasis((basis(1, [5.0, 6.0, 7.0, 9.0], periodic=True),)),
)
SURFACES = (
    TensorBasis((basis(2, [-1.0, 0.0, 3.0]), basis(1, [0.0, 0.1]))),
    TensorBasis((basis(1, [2.0, 4.0]), basis(3, [10.0, 11.0, 12.0, 13.0]))),
    TensorBasis((basis(2, [0.0, 1.0, 2.0, 3.0], periodic=True), basis(2, [0.0, 1.0]))),
)
VOLUMES = (
    TensorBasis((basis(1, [0.0, 2.0]), basis(2, [0.0, 1.0]), basis(1, [0.0, 1.0, 5.0]))),
    TensorBasis((basis(2, [1.0, 2.0, 4.0]), basis(1, [0.0, 1.0]), basis(1, [-1.0, 1.0]))),
)
FAMILIES = {1: CURVES, 2: SURFACES, 3: VOLUMES}


def samples(tensor, n=12, seed=0):
    low, high = tensor.box
    inside = np.random.default_rng(seed).uniform(low, high, (n, tensor.dim))
    return np.concatenate([inside, tensor.box])


# -- the parametric plane ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dim", FAMILIES)
def test_a_single_patch_keeps_its_parameters(dim):
    tensor = FAMILIES[dim][0]
    functions = SplineFunctions((tensor,))
    xi = samples(tensor)
    np.testing.assert_array_equal(functions.to_plane(0, xi), xi)
    np.testing.assert_array_equal(functions.from_plane(0, xi), xi)
    np.testing.assert_array_equal(functions.boxes, [tensor.box])
    for found, direction in zip(functions.breakpoints(0), tensor.directions, strict=True):
        np.testing.assert_array_equal(found, direction.breakpoints)
    np.testing.assert_array_equal(functions.patch_of(xi), 0)
    np.testing.assert_array_equal(functions.evaluate(xi).toarray(), tensor.evaluate(xi).toarray())
    assert (functions.n, functions.dim, functions.degrees) == (tensor.n, dim, tensor.degrees)


@pytest.mark.parametrize("dim", FAMILIES)
def test_several_patches_are_unit_boxes_with_gaps_of_one(dim):
    bases = FAMILIES[dim]
    functions = SplineFunctions(bases)
    for k, tensor in enumerate(bases):
        low = np.eye(dim)[0] * 2.0 * k
        np.testing.assert_allclose(functions.boxes[k], [low, low + 1.0], rtol=0, atol=1e-15)
        for axis, (found, direction) in enumerate(zip(functions.breakpoints(k), tensor.directions, strict=True)):
            own = direction.breakpoints
            scaled = np.diff(own) / np.ptp(own)
            np.testing.assert_allclose(np.diff(found), scaled, rtol=1e-13)
            assert found[0] == low[axis]
        xi = samples(tensor)
        there = functions.to_plane(k, xi)
        assert ((there >= low - 1e-15) & (there <= low + 1.0 + 1e-15)).all()
        np.testing.assert_allclose(functions.from_plane(k, there), xi, rtol=0, atol=1e-13)
        np.testing.assert_array_equal(functions.patch_of(there), k)


# -- values -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dim", FAMILIES)
def test_values_are_those_of_the_patch_whatever_the_order_of_points(dim):
    bases = FAMILIES[dim]
    functions = SplineFunctions(bases)
    points, expected = [], []
    for k, tensor in enumerate(bases):
        xi = samples(tensor, seed=k)
        points.append(functions.to_plane(k, xi))
        block = np.zeros((len(xi), functions.n))
        block[:, functions.offsets[k] : functions.offsets[k + 1]] = tensor.evaluate(xi).toarray()
        expected.append(block)
    shuffled = np.random.default_rng(3).permutation(sum(map(len, points)))
    N = functions.evaluate(np.concatenate(points)[shuffled])
    assert N.shape == (len(shuffled), sum(tensor.n for tensor in bases))
    np.testing.assert_allclose(N.toarray(), np.concatenate(expected)[shuffled], rtol=0, atol=1e-12)
    np.testing.assert_allclose(N.sum(axis=1), 1.0, rtol=0, atol=1e-13)


def test_points_of_some_patches_only():
    functions = SplineFunctions(SURFACES)
    assert functions.evaluate(np.zeros((0, 2))).shape == (0, functions.n)
    N = functions.evaluate([[4.5, 0.5], [4.0, 0.0]])
    assert N.indices.min() >= functions.offsets[2]
    np.testing.assert_allclose(N.sum(axis=1), 1.0, rtol=0, atol=1e-14)


@pytest.mark.parametrize("point", [[-0.6, 0.5], [-2.0, 0.5], [1.3, 0.5], [1.7, 0.5], [5.2, 0.5], [99, 0.5], [0.5, 1.1]])
def test_points_in_no_patch(point):
    with pytest.raises(ValueError, match=r"xi ranges over \[.*\]: values in \[.*\] are required"):
        SplineFunctions(SURFACES).evaluate([point])


def test_bad_points():
    with pytest.raises(ValueError, match=r"points has shape \(1, 3\): shape \(any, 2\)"):
        SplineFunctions(SURFACES).evaluate([[0, 0, 0]])
    with pytest.raises(ValueError, match=r"points\[0, 1\] = nan"):
        SplineFunctions(SURFACES).evaluate([[0, np.nan]])


# -- numbering --------------------------------------------------------------------------------------------------------


def test_functions_are_counted_patch_by_patch():
    functions = SplineFunctions(SURFACES)
    np.testing.assert_array_equal(functions.offsets, np.cumsum([0, 8, 12, 9]))
    assert functions.n == 29
    assert functions.degrees == (2, 3)
    np.testing.assert_array_equal(functions.global_numbers(1, np.array([0, 5, 2])), [8, 13, 10])


def test_glued_functions_add_up():
    """The last function of one curve and the first of another become one: a hat with a foot in both patches."""
    lines = (TensorBasis((basis(1, [0.0, 1.0, 2.0]),)), TensorBasis((basis(1, [0.0, 4.0]),)))
    apart = SplineFunctions(lines)
    glued = SplineFunctions(lines, np.array([0, 1, 2, 2, 3]))
    assert (apart.n, glued.n) == (5, 4)
    points = [[0.75], [1.0], [2.0], [2.25], [3.0]]
    N = glued.evaluate(points).toarray()
    np.testing.assert_allclose(N[:, 2], [0.5, 1.0, 1.0, 0.75, 0.0], rtol=0, atol=1e-15)
    raw = apart.evaluate(points).toarray()
    np.testing.assert_allclose(N, np.column_stack([raw[:, :2], raw[:, 2] + raw[:, 3], raw[:, 4]]), rtol=0, atol=1e-15)
    np.testing.assert_allclose(N.sum(axis=1), 1.0, rtol=0, atol=1e-15)
    np.testing.assert_array_equal(glued.global_numbers(1, np.array([1, 0])), [3, 2])


def test_a_single_patch_may_be_glued_to_itself():
    ring = SplineFunctions((TensorBasis((basis(1, [0.0, 1.0, 2.0, 3.0]),)),), [0, 1, 2, 0])
    assert ring.n == 3
    N = ring.evaluate([[0.0], [0.5], [2.5], [3.0]]).toarray()
    np.testing.assert_allclose(N, [[1, 0, 0], [0.5, 0.5, 0], [0.5, 0, 0.5], [1, 0, 0]], rtol=0, atol=1e-15)
    folded = SplineFunctions((TensorBasis((basis(1, [0.0, 1.0]),)),), [0, 0]).evaluate([[0.3]])
    assert (folded.nnz, folded[0, 0]) == (1, pytest.approx(1.0))  # two functions of one point are one entry


@pytest.mark.parametrize(
    ("bases", "numbering", "message"),
    [
        ((), None, r"bases is empty: one patch or more"),
        ((CURVES[0], SURFACES[0]), None, r"bases have parametric dimensions \[1, 2\]: one and the same"),
        (CURVES[:1], [0, 1, 2], r"numbering has shape \(3,\): 4 numbers from 0 without gaps"),
        (CURVES[:1], [[0, 1], [2, 3]], r"numbering has shape \(2, 2\)"),
        (CURVES[:1], [0, 1, 2, 4], r"numbering has shape \(4,\): 4 numbers from 0 without gaps"),
        (CURVES[:1], [1, 2, 3, 4], r"numbering"),
        (CURVES[:1], [-1, 0, 1, 2], r"numbering"),
    ],
)
def test_bad_functions(bases, numbering, message):
    with pytest.raises(ValueError, match=message):
        SplineFunctions(bases, numbering)


# -- cells ------------------------------------------------------------------------------------------------------------


def volumes(cells):
    """Signed volumes of the cells from their first corner and its neighbours."""
    dim = cells.x.shape[1]
    corners = cells.x[cells.cells]
    simplex = cells.cell in ("triangle", "tetrahedron")
    neighbours = range(1, dim + 1) if simplex else [2**d for d in range(dim)]
    edges = corners[:, list(neighbours)] - corners[:, :1]
    return np.linalg.det(edges) / (math.factorial(dim) if simplex else 1)


@pytest.mark.parametrize("kind", ["tensor", "simplex"])
@pytest.mark.parametrize("dim", FAMILIES)
def test_cells_fill_the_patches(dim, kind):
    functions = SplineFunctions(FAMILIES[dim])
    cells = functions.cells(kind)
    elements = sum(
        math.prod(len(direction.breakpoints) - 1 for direction in tensor.directions) for tensor in FAMILIES[dim]
    )
    assert len(cells.cells) == elements * (math.factorial(dim) if kind == "simplex" else 1)
    assert cells.cells.shape[1] == (dim + 1 if kind == "simplex" else 2**dim)
    np.testing.assert_array_equal(np.unique(cells.cells), np.arange(len(cells.x)))  # every vertex has its cell
    owner = functions.patch_of(cells.x)[cells.cells]
    assert (owner == owner[:, :1]).all()  # patches share no vertices
    sizes = np.abs(volumes(cells))
    assert sizes.min() > 1e-3
    for k in range(len(FAMILIES[dim])):
        assert sizes[owner[:, 0] == k].sum() == pytest.approx(1.0, rel=1e-13)


def test_tensor_cells_count_their_corners_first_direction_fastest():
    cells = SplineFunctions(VOLUMES[:1]).cells("tensor")
    corners = cells.x[cells.cells[0]]
    low, high = corners[0], corners[-1]
    expected = [[(low, high)[(c >> d) & 1][d] for d in range(3)] for c in range(8)]
    np.testing.assert_array_equal(corners, expected)
    assert (high > low).all()


@pytest.mark.parametrize("dim", [2, 3])
def test_simplices_fit_together(dim):
    """Inside a patch every facet belongs to two simplices, on its boundary to one."""
    cells = SplineFunctions(FAMILIES[dim][:1]).cells("simplex")
    facets = np.concatenate([np.delete(np.sort(cells.cells, axis=1), i, axis=1) for i in range(dim + 1)])
    unique, counts = np.unique(facets, axis=0, return_counts=True)
    x = cells.x[unique]
    low, high = cells.x.min(axis=0), cells.x.max(axis=0)
    outside = ((x == low).all(axis=1) | (x == high).all(axis=1)).any(axis=1)
    np.testing.assert_array_equal(counts, np.where(outside, 1, 2))


def test_unknown_cells():
    with pytest.raises(ValueError, match=r"cells = 'quad': one of 'tensor', 'simplex' is required"):
        SplineFunctions(CURVES).cells("quad")


# -- elements of the geometry -----------------------------------------------------------------------------------------


def test_other_functions_have_to_be_smooth_on_the_elements():
    plate = SplineFunctions((TensorBasis((basis(2, [0.0, 1.0, 2.0]), basis(2, [0.0, 0.5, 1.0]))),))
    other = TensorBasis((basis(1, [0.0, 2.0]), basis(3, [0.0, 0.5, 1.0])))
    plate.require_elements("pressure", SplineFunctions((other,)))
    finer = TensorBasis((basis(1, [0.0, 0.5, 2.0]), basis(1, [0.0, 1.0])))
    with pytest.raises(ValueError, match=r"pressure: patch 0 has breakpoints \[0.  0.5 2. \] in direction 0: only"):
        plate.require_elements("pressure", SplineFunctions((finer,)))
    longer = TensorBasis((basis(1, [0.0, 2.0]), basis(1, [0.5, 1.0])))
    with pytest.raises(ValueError, match=r"pressure: patch 0 has breakpoints \[0.5 1. \] in direction 1"):
        plate.require_elements("pressure", SplineFunctions((longer,)))
    with pytest.raises(ValueError, match=r"pressure has 2 patches of dimension 2: 1 of dimension 2 are required"):
        plate.require_elements("pressure", SplineFunctions((other, other)))
    with pytest.raises(ValueError, match=r"pressure has 1 patches of dimension 1"):
        plate.require_elements("pressure", SplineFunctions(CURVES[:1]))
