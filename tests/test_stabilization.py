"""Element metric and stabilisation parameters of the VMS residual."""

import numpy as np
import pytest
import ufl
from mpi4py import MPI
from dolfinx import fem
from flows import H, grid

from tigar_x import compat
from varmint.forms.vms import element_metric, stabilization_parameters


def _metric(domain):
    d = domain.geometry.dim
    G = fem.Function(compat.lagrange_space(domain, 0, d * d))
    compat.interpolate(G, ufl.as_vector([element_metric(domain)[i, j] for i in range(d) for j in range(d)]))
    return G.x.array.reshape(-1, d, d)


@pytest.mark.parametrize("cell", ["triangle", "tetrahedron", "quadrilateral", "hexahedron"])
def test_metric_of_one_cell(cell):
    """4/h^2 I on a cube and on a right simplex with vertex 0 at the right angle."""
    d = 2 if cell in ("triangle", "quadrilateral") else 3
    corners = np.array([[(i >> k) & 1 for k in range(d)] for i in range(2**d)], dtype=float)
    x = H * (corners[corners.sum(axis=1) < 2] if cell in ("triangle", "tetrahedron") else corners)
    (G,) = _metric(compat.create_mesh(MPI.COMM_SELF, cell, [np.arange(len(x))], x))
    np.testing.assert_allclose(G, 4 / H**2 * np.eye(d), atol=1e-12 / H**2)


@pytest.mark.mpi
@pytest.mark.parametrize("cell", ["triangle", "tetrahedron", "quadrilateral", "hexahedron"])
def test_vertex_0_has_the_smallest_coordinates(cell):
    x = compat.cell_vertices(grid(cell))
    assert len(x)
    assert (x[:, :1] <= x + 1e-12).all()


@pytest.mark.mpi
def test_metric_of_a_rectangle_mesh():
    """The two triangles of a square, cut by its (0,0)-(1,1) diagonal, and their scale normal to the four sides."""
    domain = grid("triangle")
    G = _metric(domain) * H**2 / 4
    lower, upper = np.array([[1, -1], [-1, 2]]), np.array([[2, -1], [-1, 1]])
    matches = [np.abs(G - kind).max(axis=(1, 2)) < 1e-12 for kind in (lower, upper)]
    assert (matches[0] ^ matches[1]).all()
    n = ufl.FacetNormal(domain)
    scale, ds = ufl.sqrt(ufl.dot(n, element_metric(domain) * n)), ufl.ds(domain=domain)
    sides = [ufl.max_value(sign * n[i], 0.0) for i in (0, 1) for sign in (-1, 1)]
    means = [compat.assemble_scalar(f) / (3 * H) for f in compat.compile_forms(*(side * scale * ds for side in sides))]
    np.testing.assert_allclose(means, np.array([2 * 2**0.5, 2, 2 * 2**0.5, 2]) / H, rtol=1e-12)


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("dt", [None, 0.2])
def test_stabilization_parameters(d, dt):
    """By numbers, and each scale acts on its own parameter only."""
    rng = np.random.default_rng(d)
    v, J, nu, C_I, C_t = rng.normal(size=d), rng.normal(size=(d, d)), 0.3, 5.0, 7.0
    G = J @ J.T
    m = v @ G @ v + C_I * nu**2 * np.sum(G * G) + (0 if dt is None else C_t / dt**2)
    expected = np.array([1 / np.sqrt(m), np.sqrt(m) / np.trace(G)])
    for scale_m, scale_c in ((None, None), (1e-3, None), (None, 0.1), (0.2, 0.3)):
        tau = stabilization_parameters(
            ufl.as_vector(v.tolist()), ufl.as_matrix(G.tolist()), nu=nu, dt=dt, C_I=C_I, C_t=C_t,
            scale_m=scale_m, scale_c=scale_c,
        )  # fmt: skip
        factors = [scale_m or 1, 1 / (scale_c or 1)]
        np.testing.assert_allclose([t(()) for t in tau], expected * factors, rtol=1e-12)
