"""Midsurface geometry: surfaces in space, and curves in the plane."""

import numpy as np
import pytest
import ufl
from mpi4py import MPI
from dolfinx import fem

from shnapr.kinematics import Midsurface, curvature_change, local_voigt, membrane_strain, midsurface
from tigar_x import compat
from tigar_x.geometry import shapes
from tigar_x.geometry.bspline import BSplineBasis, open_knots
from tigar_x.geometry.patch import Patch
from tigar_x.splines.spline import ExtractedSpline

HALF_ANGLE = np.pi / 5  # of the circle arcs: one span of 72 degrees


def point_values(spline, *expressions):
    """Values of UFL expressions at the nodes of every element, one array (points, *shape) each."""
    parts = [np.ndindex(*e.ufl_shape) if e.ufl_shape else [()] for e in expressions]
    flat = [e[i] if i else e for e, part in zip(expressions, parts, strict=True) for i in part]
    u = fem.Function(compat.lagrange_space(spline.mesh, 2, len(flat), discontinuous=True))
    compat.interpolate(u, ufl.as_vector(flat))
    values, result = u.x.array.reshape(-1, len(flat)), []
    for e in expressions:
        n = int(np.prod(e.ufl_shape, dtype=int))
        result.append(values[:, :n].reshape(-1, *e.ufl_shape))
        values = values[:, n:]
    return result


def arc(R, clockwise=False):
    """Rational quadratic arc of the circle of radius R around the origin: points and weights."""
    phi = np.array([-HALF_ANGLE, 0.0, HALF_ANGLE])
    radius = R / np.array([1.0, np.cos(HALF_ANGLE), 1.0])
    points = np.column_stack([radius * np.cos(phi), radius * np.sin(phi)])
    weights = np.array([1.0, np.cos(HALF_ANGLE), 1.0])
    return (points[::-1] if clockwise else points), weights


def quadratic(elements=1):
    return BSplineBasis(2, open_knots(2, np.linspace(0.0, 1.0, elements + 1)))


def circle(R, clockwise=False):
    return ExtractedSpline(Patch.from_points([quadratic()], *arc(R, clockwise)), MPI.COMM_SELF)


def cylinder_panel(R, clockwise=False):
    """Arc in the (x, y) plane, first direction, times a generator along z."""
    points, weights = arc(R, clockwise)
    z = np.array([0.0, 0.4, 1.5])
    grid = np.array([[*x, height] for height in z for x in points])
    return ExtractedSpline(Patch.from_points([quadratic()] * 2, grid, np.tile(weights, 3)), MPI.COMM_SELF)


def wavy(dim, seed=3):
    """A patch without any symmetry: random control points and weights, 2 elements per direction."""
    rng = np.random.default_rng(seed)
    if dim == 1:
        flat = shapes.line((0.0, 0.0), (1.0, 0.3), elements=2, degree=2)
    else:
        flat = shapes.parallelogram((0, 0, 0), (1, 0, 0.2), (0.3, 1, 0), elements=(2, 2), degrees=(2, 2))
    points = flat.points + rng.uniform(-0.08, 0.08, flat.points.shape)
    patch = Patch.from_points(flat.bases, points, rng.uniform(0.8, 1.3, len(points)))
    return ExtractedSpline(patch, MPI.COMM_SELF)


@pytest.fixture(scope="module", params=[1, 2], ids=["curve", "surface"])
def deformed(request):
    """A random patch with a random displacement, and everything one may want to know of it."""
    spline = wavy(request.param)
    y = spline.function(np.random.default_rng(5).uniform(-0.1, 0.1, (spline.geometry.basis.n, spline.nsd)))
    state = midsurface(spline, spline.rationalize(y))
    by_normal = -state.tangents.T * spline.parametric_grad(state.normal)
    names = ("tangents", "normal", "metric", "curvature", "by_normal", "shift")
    shift = state.x - spline.F - spline.rationalize(y)
    values = point_values(
        spline, state.tangents, state.normal, state.metric, state.curvature, by_normal, ufl.as_vector(shift)
    )
    return dict(zip(names, values, strict=True))


def test_current_position(deformed):
    assert np.abs(deformed["shift"]).max() < 1e-14


def test_normal_is_unit_and_orthogonal(deformed):
    a, n = deformed["tangents"], deformed["normal"]
    assert np.abs(np.linalg.norm(n, axis=1) - 1).max() < 1e-13
    assert np.abs(np.einsum("qia,qi->qa", a, n)).max() < 1e-13
    if a.shape[2] == 2:
        assert (np.linalg.det(np.concatenate([a, n[:, :, None]], axis=2)) > 0).all()


def test_metric(deformed):
    a = deformed["tangents"]
    np.testing.assert_allclose(deformed["metric"], np.einsum("qia,qib->qab", a, a), rtol=1e-12)


def test_curvature_is_symmetric_and_equals_its_form_by_the_normal(deformed):
    b = deformed["curvature"]
    scale = np.abs(b).max()
    assert scale > 0.1
    np.testing.assert_allclose(b, b.transpose(0, 2, 1), atol=1e-12 * scale)
    np.testing.assert_allclose(b, deformed["by_normal"], atol=1e-11 * scale)


@pytest.mark.parametrize(
    ("start", "end", "normal"),
    [((0.5, 0), (0.5, 1), (1, 0)), ((0, 0), (2, 0), (0, -1)), ((1, 1), (0, 0), (-(0.5**0.5), 0.5**0.5))],
)
def test_normal_of_a_line(start, end, normal):
    spline = ExtractedSpline(shapes.line(start, end, elements=1, degree=2), MPI.COMM_SELF)
    (n,) = point_values(spline, midsurface(spline).normal)
    np.testing.assert_allclose(n, np.tile(normal, (len(n), 1)), atol=1e-14)


@pytest.mark.parametrize("clockwise", [False, True])
@pytest.mark.parametrize("R", [0.3, 4.0])
def test_curvature_of_a_circle(R, clockwise):
    """Counterclockwise a_3 = a_1 x e_3 points outward, so x,ss . a_3 = -1/R."""
    spline = circle(R, clockwise)
    state = midsurface(spline)
    x, n, b = point_values(spline, state.x, state.normal, local_voigt(state, state.curvature))
    sign = -1 if clockwise else 1
    np.testing.assert_allclose(np.linalg.norm(x, axis=1), R, rtol=1e-13)
    np.testing.assert_allclose(n, sign * x / R, atol=1e-13)
    np.testing.assert_allclose(b, -sign / R, rtol=1e-12)


@pytest.mark.parametrize("clockwise", [False, True])
def test_curvature_of_a_cylinder(clockwise):
    """Only the circumferential curvature is not zero; its value and sign are those of the plane curve."""
    R = 2.5
    spline = cylinder_panel(R, clockwise)
    state = midsurface(spline)
    x, n, b = point_values(spline, state.x, state.normal, local_voigt(state, state.curvature))
    sign = -1 if clockwise else 1
    np.testing.assert_allclose(n[:, :2], sign * x[:, :2] / R, atol=1e-13)
    np.testing.assert_allclose(n[:, 2], 0, atol=1e-13)
    np.testing.assert_allclose(b, np.tile([-sign / R, 0, 0], (len(b), 1)), atol=1e-12)


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("nsd", [2, 3])
def test_local_frame(nsd, seed):
    """Against e_i . a^alpha with a Gram-Schmidt frame and a dual basis made by numpy."""
    rng = np.random.default_rng(seed)
    a = rng.normal(size=(nsd, nsd - 1)) * [1.0, 30.0][: nsd - 1]
    T = rng.normal(size=(nsd - 1, nsd - 1))
    T = T + T.T
    frame = [a[:, 0] / np.linalg.norm(a[:, 0])]
    if nsd == 3:
        e_2 = a[:, 1] - (a[:, 1] @ frame[0]) * frame[0]
        frame.append(e_2 / np.linalg.norm(e_2))
    Q = np.array(frame) @ np.linalg.pinv(a).T
    expected = Q @ T @ Q.T
    if nsd == 3:
        expected = np.array([expected[0, 0], expected[1, 1], 2 * expected[0, 1]])
    state = Midsurface(None, None, None, ufl.as_matrix((a.T @ a).tolist()), None)
    result = local_voigt(state, ufl.as_matrix(T.tolist()))
    values = [result[i](()) for i in range(len(result))]
    np.testing.assert_allclose(values, expected.ravel(), rtol=1e-10, atol=1e-12 * np.abs(expected).max())


def test_strain_signs():
    """Stretching is positive strain; bending towards the normal makes b grow and kappa = B - b fall."""
    spline = ExtractedSpline(shapes.line((0, 0), (1, 0), elements=1, degree=2), MPI.COMM_SELF)
    x = spline.F
    stretch, bend = 0.1 * ufl.as_vector([x[0], 0]), -0.1 * x[0] ** 2 * ufl.as_vector([0, 1])
    reference = midsurface(spline)
    eps, kap = point_values(
        spline,
        membrane_strain(reference, midsurface(spline, stretch)),
        curvature_change(reference, midsurface(spline, bend)),
    )
    np.testing.assert_allclose(eps, 0.5 * (1.1**2 - 1), rtol=1e-12)
    assert (kap < 0).all()
    np.testing.assert_allclose(kap[:, 0, 0].min(), -0.2, rtol=1e-12)  # where the slope is zero: -2 * 0.1


@pytest.mark.parametrize("dim", [1, 2])
def test_rigid_motion_gives_no_strain(dim):
    spline = wavy(dim)
    angles = [0.7] if dim == 1 else [0.7, -1.1, 0.4]
    rotation = np.eye(spline.nsd)
    for angle, (i, j) in zip(angles, [(0, 1), (1, 2), (0, 2)], strict=False):
        plane = np.eye(spline.nsd)
        plane[[i, i, j, j], [i, j, i, j]] = np.cos(angle), -np.sin(angle), np.sin(angle), np.cos(angle)
        rotation = plane @ rotation
    points = spline.geometry.points
    moved = points @ rotation.T + np.arange(1.0, spline.nsd + 1)
    y = spline.function((moved - points) * spline.geometry.weights[:, None])
    reference, current = midsurface(spline), midsurface(spline, spline.rationalize(y))
    eps, kap, B, turned = point_values(
        spline,
        local_voigt(reference, membrane_strain(reference, current)),
        local_voigt(reference, curvature_change(reference, current)),
        local_voigt(reference, reference.curvature),
        current.normal - ufl.as_matrix(rotation.tolist()) * reference.normal,
    )
    curvature = np.abs(B).max()
    assert curvature > 0.1  # there is one that could have changed
    assert np.abs(eps).max() < 1e-12
    assert np.abs(kap).max() < 1e-12 * max(1.0, curvature)
    assert np.abs(turned).max() < 1e-12


@pytest.mark.parametrize("wrong", ["curve in space", "surface in the plane"])
def test_other_dimensions_are_refused(wrong):
    if wrong == "curve in space":
        patch = shapes.line((0, 0, 0), (1, 0, 0), elements=1)
    else:
        patch = shapes.parallelogram((0, 0), (1, 0), (0, 1), elements=(1, 1), degrees=(1, 1))
    with pytest.raises(ValueError, match=r"parametric dimension \d in \d-dimensional space: \(1, 2\) or \(2, 3\)"):
        midsurface(ExtractedSpline(patch, MPI.COMM_SELF))
