"""Poisson's problem on splines: -lap u = f in a curve, a surface or a volume, with u given on the whole boundary.

The exact solution is the plane wave u = sin(1 + k . x). On flat shapes -lap u = |k|^2 u; on the unit circle, where the
position x has the second derivative -x by arc length and the tangent is t = (-x_2, x_1),

    -lap u = (k . t)^2 sin(1 + k . x) + (k . x) cos(1 + k . x)        (the Laplace-Beltrami operator).

With splines of degree p, both for u and for its L2 projection on the boundary, the errors in the norms of L2 and H1
fall with h^(p+1) and h^p. Source: Y. Bazilevs et al., "Isogeometric analysis: approximation, stability and error
estimates for h-refined meshes", doi:10.1142/S0218202506001455.
"""

from collections.abc import Callable
from math import pi
from typing import Any, Literal

import numpy as np
import ufl
from dolfinx import fem

from tigar_x import ExtractedSpline, Patch, Results, Solution, SplineSystem, checks, script, solve_linear, with_results
from tigar_x.geometry import shapes, surfaces
from tigar_x.geometry.bspline import TensorBasis
from tigar_x.geometry.functions import Cells

TOY = {"degree": 2, "elements": 2, "levels": 3}


def coarse_patch(dim: int, geometry: str) -> Patch:
    """The shape as one element of the lowest degree that makes it."""
    if geometry == "bspline":
        bases = (shapes.uniform(1, 1),) * dim
        corners = TensorBasis(bases).greville
        return Patch.from_points(bases, corners * (1.0 + 0.3 * corners.mean(axis=1, keepdims=True)))
    if dim == 1:
        return Patch.from_points([shapes.uniform(2, 1)], [(1.0, 0.0), (1.0, 1.0), (0.0, 1.0)], [1.0, 0.5**0.5, 1.0])
    sector = surfaces.annulus(inner=0.5, outer=1.0, angle=pi / 4, center=(0, 0), elements=(1, 1), degrees=(1, 2))
    return sector if dim == 2 else shapes.extruded(sector, (0.0, 0.0, 0.5))


def source(x: Any, k: Any, *, circle: bool) -> Any:
    """f = -lap u at a position on a flat shape, or on the unit circle."""
    phase = 1 + ufl.dot(k, x)
    if not circle:
        return ufl.dot(k, k) * ufl.sin(phase)
    return ufl.dot(k, ufl.as_vector([-x[1], x[0]])) ** 2 * ufl.sin(phase) + ufl.dot(k, x) * ufl.cos(phase)


def solve(patch: Patch, cells: Cells = "tensor", f: Callable[[ExtractedSpline, Any], Any] | None = None) -> Solution:
    """Solve on a refined patch; another source than the exact one may be given as a function of spline and k."""
    p = max(patch.functions.degrees)
    # exact for products of two derivatives on parallelograms; Bezier triangles and tetrahedra have the degree dim p
    s = ExtractedSpline(patch, cells=cells, quadrature_degree=2 * p if cells == "tensor" else (patch.dim + 1) * p)
    boundary = np.unique(np.concatenate([patch.side(name) for name in patch.open_sides]))
    space, k = s.space(1, zero_dofs=boundary), fem.Constant(s.mesh, (3.0, 2.0, 1.0)[: patch.nsd])
    exact = ufl.sin(1 + ufl.dot(k, s.F))
    load = source(s.F, k, circle=patch.nsd > patch.dim) if f is None else f(s, k)
    u, v = s.project_boundary(exact), s.rationalize(ufl.TestFunction(space.V))
    residual = (ufl.inner(s.grad(s.rationalize(u)), s.grad(v)) - load * v) * s.dx
    solve_linear(SplineSystem(space, residual, ufl.derivative(residual, u), unknown=u))
    return Solution(s, u, exact, patch.n - len(boundary))


@with_results(elements=4, levels=4)
def main(
    results: Results,
    dim: Literal[1, 2, 3] = 2,
    geometry: Literal["bspline", "nurbs"] = "nurbs",
    degree: int = 3,
    cells: Literal["tensor", "simplex"] = "tensor",
) -> dict[str, Any]:
    """Solve Poisson's problem on finer and finer splines and compare the rates with theory.

    Args:
        dim: parametric dimension.
        geometry: bspline: straight edges; nurbs: a quarter of a circle, an eighth of a ring or of a thick pipe.
        degree: of the splines, 2 or more on a nurbs.
        cells: quadrilaterals and hexahedra, or triangles and tetrahedra (of degree dim times the spline's).
    """
    coarse = coarse_patch(dim, geometry)
    patch = coarse.with_degree(checks.whole("degree", degree, max(coarse.functions.degrees)))
    rates = {"L2_u": degree + 1, "H1_u": degree}
    study, solution = results.refine(lambda n: solve(patch.refined(n), cells), Solution.errors, rates)
    if results.viz:
        solution.show(results.out / "poisson", study)
    return results.convergence(study, f"{dim}D, {geometry}, degree {degree}, {cells} cells")


if __name__ == "__main__":
    script.command_line(main)
