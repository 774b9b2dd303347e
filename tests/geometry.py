"""Patches measured by Gauss quadrature of their own basis, without finite elements."""

import numpy as np


def grid(patch, n):
    """Tensor grid of n parameters per direction, ends included, shape (n^dim, dim)."""
    ticks = [np.linspace(basis.knots[0], basis.knots[-1], n) for basis in patch.bases]
    return np.stack([axis.ravel() for axis in np.meshgrid(*ticks, indexing="ij")], axis=1)


def tangents(patch, xi):
    """Derivatives of the position, shape (m, nsd, dim)."""
    X = patch.basis.evaluate(xi) @ patch.control
    weight = X[:, -1:]
    derivatives = (patch.basis.evaluate(xi, d) @ patch.control for d in range(patch.dim))
    return np.stack([(D[:, :-1] - X[:, :-1] / weight * D[:, -1:]) / weight for D in derivatives], axis=-1)


def jacobian(patch, xi):
    """Physical length, area or volume per parametric one, shape (m,)."""
    J = tangents(patch, xi)
    return np.sqrt(np.linalg.det(np.swapaxes(J, 1, 2) @ J))


def normals(patch, xi):
    """Unit normals of a surface in space, shape (m, 3)."""
    n = np.cross(*np.moveaxis(tangents(patch, xi), -1, 0))
    return n / np.linalg.norm(n, axis=1, keepdims=True)


def measure(patch, f=lambda x: 1.0, points=10):
    """Integral over the patch of a function of position, arrays of shape (nsd, m)."""
    g, w = np.polynomial.legendre.leggauss(points)
    nodes, weights = [], []
    for basis in patch.bases:
        x, half = basis.breakpoints, np.diff(basis.breakpoints) / 2.0
        nodes.append((x[:-1, None] + half[:, None] * (1.0 + g)).ravel())
        weights.append((half[:, None] * w).ravel())
    xi = np.stack([axis.ravel() for axis in np.meshgrid(*nodes, indexing="ij")], axis=1)
    W = np.prod(np.stack([axis.ravel() for axis in np.meshgrid(*weights, indexing="ij")]), axis=0)
    return float(np.sum(W * jacobian(patch, xi) * f(patch.evaluate(xi).T)))
