"""Rigid planes: pressure over depth, and the virtual work of a flat shell pressed into one."""

from itertools import pairwise

import numpy as np
import pytest
import ufl
from mpi4py import MPI
from dolfinx import fem
from scipy.interpolate import BSpline

from shnapr.planes import RigidPlane, plane_contact
from tigar_x import compat
from tigar_x.geometry import shapes
from tigar_x.geometry.patch import Patch
from tigar_x.splines.spline import ExtractedSpline

# -- pressure ----------------------------------------------------------------------------------------------------------


def plane(**other):
    return RigidPlane(**(dict(point=(0.0, 0.0, 0.5), normal=(0, 0, 1), stiffness=3.0, smoothing=0.2) | other))


def test_pressure_by_its_pieces():
    k, s = 3.0, 0.2
    near, inside = np.linspace(-s, 0, 9), np.linspace(0, 1, 9)
    traction = plane().traction
    np.testing.assert_array_equal(traction(np.array([-5, -s])), 0)
    np.testing.assert_allclose(traction(near), k * (near + s) ** 2 / (2 * s), rtol=1e-13, atol=1e-16)
    np.testing.assert_allclose(traction(inside), k * (s / 2 + inside), rtol=1e-14)
    hard = plane(smoothing=0).traction
    np.testing.assert_allclose(hard(np.array([-1, 0, 0.3])), [0, 0, 0.9], rtol=1e-15)


@pytest.mark.parametrize("at", [-0.2, 0.0])
def test_pressure_is_smooth(at):
    """Value and slope have no jump at -s and 0; without smoothing the slope jumps at 0."""

    def jumps(traction, h=1e-7):
        below, here, above = traction(np.array([at - h, at, at + h]))
        return abs(above - below), abs(above - 2 * here + below) / h

    value, slope = jumps(plane().traction)
    assert value < 1e-6
    assert slope < 1e-5
    if at == 0.0:
        assert jumps(plane(smoothing=0.0).traction)[1] > 1


def test_a_thin_onset_loses_no_digits():
    depth = np.array([1e-3, 1.0, 1e3])
    np.testing.assert_allclose(plane(smoothing=1e-12).traction(depth), 3.0 * (depth + 5e-13), rtol=1e-15)


@pytest.mark.parametrize("size", [1.0, 1e-200, 1e200])
def test_the_normal_becomes_a_unit_vector(size):
    np.testing.assert_allclose(plane(normal=(3 * size, 0, -4 * size)).normal, (0.6, 0, -0.8), rtol=1e-15)


# -- virtual work ------------------------------------------------------------------------------------------------------


class Scene:
    """A flat patch, stretched and tilted into a plane whose parameters are Constants."""

    def __init__(self, dim, smoothing):
        if dim == 1:
            self.patch = shapes.line((0, 0), (2, 0.5), elements=3, degree=2)
        else:
            flat = shapes.parallelogram((0, 0, 0), (2, 0, 0.5), (0.3, 1, 0), elements=(2, 3), degrees=(2, 1))
            # equal weights other than 1 make the fields homogeneous without making the patch rational in shape
            self.patch = Patch.from_points(flat.bases, flat.points, np.full(len(flat.points), 1.7))
        d = self.d = self.patch.nsd
        self.spline = ExtractedSpline(self.patch, MPI.COMM_SELF, quadrature_degree=6)
        self.c = {
            "point": fem.Constant(self.spline.mesh, np.array([0.2, 0.0, 0.1])[:d]),
            "stiffness": fem.Constant(self.spline.mesh, 3.0),
        }
        if smoothing:
            self.c["smoothing"] = fem.Constant(self.spline.mesh, smoothing)
        self.plane = RigidPlane(normal=(1.0, -2.0, 2.0)[:d], **self.c)
        self.y, z = self.spline.function(), ufl.TestFunction(self.spline.V)
        R = plane_contact(self.spline, self.plane, self.y, z)
        self._R, self._K = compat.compile_forms(R, ufl.derivative(R, self.y))
        F = np.array([[1.2, 0.1, 0.3], [-0.2, 0.9, 0.1], [0.1, 0.2, 1.1]])[:d, :d]
        self.deformed = self.patch.points @ F.T

    def at_depth(self, depth):
        """Coefficients of a displacement that tilts the patch and puts its shallowest point at a depth."""
        m = np.array(self.plane.normal)
        x = self.deformed - np.outer(((self.deformed - self.c["point"].value) @ m).max() + depth, m)
        return x, self.patch.weights[:, None] * (x - self.patch.points)

    def residual(self, U):
        self.y.x.array[:] = self.spline.function(U).x.array
        b, result = compat.create_vector(self.spline.V), self.spline.M.createVecRight()
        compat.assemble_vector(b, self._R)
        self.spline.M.multTranspose(b, result)
        return result.array.reshape(U.shape)

    def tangent(self, U):
        self.y.x.array[:] = self.spline.function(U).x.array
        A = compat.create_matrix(self._K, "aij")
        compat.assemble_matrix(A, self._K)
        A.assemble()
        return A.PtAP(self.spline.M)[:, :]

    def by_hand(self, x):
        """Residual by Gauss points in every element, from control points in the current configuration."""
        tables = [table(basis) for basis in self.patch.bases]
        N, dN, weight = tables[0]
        if self.d == 2:
            bases, tangents = N, [dN]
        else:
            M, dM, more = tables[1]
            bases, weight = np.einsum("qj,pi->qpji", M, N).reshape(-1, len(x)), np.outer(more, weight).ravel()
            pairs = (M, dN), (dM, N)
            tangents = [np.einsum("qj,pi->qpji", b, a).reshape(-1, len(x)) for b, a in pairs]
        a = np.stack([T @ x for T in tangents], axis=-1)
        area = weight * np.sqrt(np.linalg.det(np.einsum("qik,qil->qkl", a, a)))
        m = np.array(self.plane.normal)
        pressure = self.plane.traction((self.c["point"].value - bases @ x) @ m)
        return -np.outer(bases.T @ (pressure * area), m) / self.patch.weights[:, None]


def table(basis):
    """Functions and their derivatives at Gauss points of every element, and the points' weights."""
    ends, (s, w) = np.unique(basis.knots), np.polynomial.legendre.leggauss(6)
    points = np.concatenate([(a + b) / 2 + (b - a) / 2 * s for a, b in pairwise(ends)])
    weights = np.concatenate([(b - a) / 2 * w for a, b in pairwise(ends)])
    functions = BSpline(basis.knots, np.eye(len(basis.knots) - basis.degree - 1), basis.degree)
    return functions(points), functions.derivative()(points), weights


@pytest.fixture(scope="module", params=[(1, 0.0), (1, 5.0), (2, 0.0), (2, 5.0)], ids=lambda p: f"dim{p[0]}-s{p[1]:g}")
def scene(request):
    return Scene(*request.param)


def test_pressed_into_the_plane(scene):
    """Wholly inside, where pressure is linear: as quadrature by hand, and the resultant as in closed form."""
    x, U = scene.at_depth(0.3)
    R, expected = scene.residual(U), scene.by_hand(x)
    np.testing.assert_allclose(R, expected, atol=1e-13 * np.abs(expected).max())
    m = np.array(scene.plane.normal)
    corners = x[[0, -1]] if scene.d == 2 else x.reshape(-1, scene.patch.bases[0].n, 3)[[0, 0, -1], [0, -1, 0]]
    edges = corners[1:] - corners[0]
    area = np.sqrt(np.linalg.det(edges @ edges.T))
    depth = (scene.c["point"].value - x.mean(axis=0)) @ m
    centre = (scene.c["point"].value - (corners[0] + edges.sum(axis=0) / 2)) @ m
    assert depth == pytest.approx(centre, rel=1e-12)
    pressure = 3.0 * (centre + (2.5 if "smoothing" in scene.c else 0.0))
    np.testing.assert_allclose(
        (scene.patch.weights[:, None] * R).sum(axis=0), -pressure * area * m, atol=1e-12 * pressure * area
    )


def test_the_onset(scene):
    """Everywhere between -s and 0: quadratic pressure, or none without smoothing."""
    x, U = scene.at_depth(-4.0)
    if "smoothing" in scene.c:
        expected = scene.by_hand(x)
        np.testing.assert_allclose(scene.residual(U), expected, atol=1e-13 * np.abs(expected).max())
        assert np.abs(expected).max() > 0.01
    else:
        np.testing.assert_array_equal(scene.residual(U), 0)
    np.testing.assert_array_equal(scene.residual(scene.at_depth(-20.0)[1]), 0)


@pytest.mark.parametrize("depth", [0.3, -0.5])
def test_tangent(scene, depth):
    """The tangent is the slope of the residual, also where a part of the shell is outside the plane."""
    U, h = scene.at_depth(depth)[1] + 0.02 * np.random.default_rng(0).uniform(-1, 1, scene.patch.points.shape), 1e-6
    d = np.random.default_rng(1).uniform(-1, 1, U.shape)
    slope = (scene.residual(U + h * d) - scene.residual(U - h * d)).ravel() / (2 * h)
    K = scene.tangent(U)
    assert np.abs(slope).max() > 1e-2
    np.testing.assert_allclose(K @ d.ravel(), slope, atol=1e-6 * np.abs(slope).max())


def test_every_parameter_counts(scene):
    """Constants may change after compilation, and each of them changes residual and tangent."""
    U = scene.at_depth(0.3)[1]
    R, K = scene.residual(U), scene.tangent(U)
    for c in scene.c.values():
        before = c.value.copy()
        c.value = 1.1 * before
        assert np.abs(scene.residual(U) - R).max() > 1e-3 * np.abs(R).max()
        assert np.abs(scene.tangent(U) - K).max() > 1e-4 * np.abs(K).max()
        c.value = before
    np.testing.assert_allclose(scene.residual(U), R, rtol=1e-12)


# -- bad input ---------------------------------------------------------------------------------------------------------

BAD = {
    r"normal = \(0, 0, 0\): a vector other than zero": dict(normal=(0, 0, 0)),
    r"normal\[1\] = nan": dict(normal=(0, np.nan, 1)),
    r"normal has shape \(4,\)": dict(normal=(1, 0, 0, 0)),
    r"point\[2\] = inf": dict(point=(0, 0, np.inf)),
    r"point has shape \(2,\): shape \(3,\)": dict(point=(0, 0)),
    "stiffness = 0.0": dict(stiffness=0.0),
    "stiffness = -1": dict(stiffness=-1),
    "stiffness = nan": dict(stiffness=np.nan),
    "smoothing = -0.1": dict(smoothing=-0.1),
    "smoothing = inf": dict(smoothing=np.inf),
}


@pytest.mark.parametrize("message", BAD)
def test_bad_planes(message):
    with pytest.raises(ValueError, match=f"^{message}.* required"):
        plane(**BAD[message])


def test_bad_constants(scene):
    mesh = scene.spline.mesh
    for name, value in (("stiffness", -1.0), ("smoothing", 0.0), ("point", np.array([0, np.nan, 0]))):
        with pytest.raises(ValueError, match=f"^{name}.* required"):
            plane(**{name: fem.Constant(mesh, value)})


def test_a_plane_of_another_dimension(scene):
    other = RigidPlane((0.0,) * (5 - scene.d), (1.0,) * (5 - scene.d), 1.0)
    with pytest.raises(ValueError, match=rf"^plane\.normal has shape .*: shape \({scene.d},\) is required"):
        plane_contact(scene.spline, other, scene.y, ufl.TestFunction(scene.spline.V))
