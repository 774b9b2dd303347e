"""Poisson's problem on splines: -lap u = f in a curve, a surface or a volume, with u given on the whole boundary.

The exact solution is the plane wave u = sin(1 + k . x). On flat shapes -lap u = |k|^2 u; on the unit circle, where the
position x has the second derivative -x by arc length and the tangent is t = (-x_2, x_1),

    -lap u = (k . t)^2 sin(1 + k . x) + (k . x) cos(1 + k . x)        (the Laplace-Beltrami operator).

With splines of degree p, both for u and for its L2 projection on the boundary, the errors in the norms of L2 and H1
fall with h^(p+1) and h^p. Source: Y. Bazilevs et al., "Isogeometric analysis: approximation, stability and error
estimates for h-refined meshes", doi:10.1142/S0218202506001455.
"""

from collections.abc import Callable
from dataclasses import dataclass
from math import pi
from pathlib import Path
from typing import Any, Literal

import numpy as np
import ufl
from mpi4py import MPI
from dolfinx import fem

from tigar_x import checks, compat
from tigar_x.compat import FloatArray
from tigar_x.geometry import shapes, surfaces
from tigar_x.geometry.bspline import TensorBasis
from tigar_x.geometry.functions import Cells
from tigar_x.geometry.patch import Patch
from tigar_x.ranks import root_only
from tigar_x.run import script
from tigar_x.run.convergence import Study, doubled, refine
from tigar_x.run.summary import write_summary
from tigar_x.run.writing import claim
from tigar_x.splines.spline import ExtractedSpline
from tigar_x.splines.spline_system import SplineSystem, solve_linear
from tigar_x.splines.vtu import VTUSeries

TOY = {"degree": 2, "elements": 2, "levels": 3}
WAVE = (3.0, 2.0, 1.0)


def coarse_patch(dim: int, geometry: str) -> Patch:
    """The shape as one element of the lowest degree that makes it."""
    if geometry == "bspline":
        bases = (shapes.uniform(1, 1),) * dim
        corners = TensorBasis(bases).greville
        return Patch.from_points(bases, corners * (1.0 + 0.3 * corners.mean(axis=1, keepdims=True)))
    if dim == 1:
        return Patch.from_points([shapes.uniform(2, 1)], [(1.0, 0.0), (1.0, 1.0), (0.0, 1.0)], [1.0, 0.5**0.5, 1.0])
    sector = surfaces.annulus(inner=0.5, outer=1.0, angle=pi / 4, center=(0.0, 0.0), elements=(1, 1), degrees=(1, 2))
    return sector if dim == 2 else shapes.extruded(sector, (0.0, 0.0, 0.5))


def wave(x: Any, k: Any) -> Any:
    """Exact solution at a position."""
    return ufl.sin(1 + ufl.dot(k, x))


def source(x: Any, k: Any, *, circle: bool) -> Any:
    """f = -lap u at a position on a flat shape, or on the unit circle."""
    if not circle:
        return ufl.dot(k, k) * wave(x, k)
    t = ufl.as_vector([-x[1], x[0]])
    return ufl.dot(k, t) ** 2 * wave(x, k) + ufl.dot(k, x) * ufl.cos(1 + ufl.dot(k, x))


def poisson(spline: ExtractedSpline, u: Any, v: Any, f: Any) -> ufl.Form:
    """Residual of -lap u = f."""
    w = spline.rationalize
    return ufl.inner(spline.grad(w(u)), spline.grad(w(v))) * spline.dx - f * w(v) * spline.dx


@dataclass(frozen=True)
class Solution:
    """A solution (homogeneous) on its spline, and the exact one."""

    spline: ExtractedSpline
    u: fem.Function
    exact: Any
    unknowns: int


def solve(patch: Patch, cells: Cells = "tensor", f: Callable[[ExtractedSpline, Any], Any] | None = None) -> Solution:
    """Solve on a refined patch; another source than the exact one may be given as a function of spline and k."""
    p = max(patch.functions.degrees)
    # exact for products of two derivatives on parallelograms; Bezier triangles and tetrahedra have the degree dim p
    quadrature = 2 * p if cells == "tensor" else (patch.dim + 1) * p
    spline = ExtractedSpline(patch, cells=cells, quadrature_degree=quadrature)
    k = fem.Constant(spline.mesh, np.array(WAVE[: patch.nsd]))
    exact = wave(spline.F, k)
    f_h = source(spline.F, k, circle=patch.nsd > patch.dim) if f is None else f(spline, k)
    boundary = np.unique(np.concatenate([patch.side(name) for name in patch.open_sides]))
    space = spline.space(1, zero_dofs=boundary)
    u = spline.project_boundary(exact)
    R = poisson(spline, u, ufl.TestFunction(space.V), f_h)
    solve_linear(SplineSystem(space, R, ufl.derivative(R, u), unknown=u))
    return Solution(spline, u, exact, patch.n - len(boundary))


def errors(solution: Solution) -> dict[str, float]:
    """Norms of the error and of its gradient, with two more degrees of quadrature than the solution."""
    spline = solution.spline
    e = spline.rationalize(solution.u) - solution.exact
    dx = spline.dx.of_degree(spline.quadrature_degree + 2)
    forms = compat.compile_forms(e**2 * dx, ufl.inner(spline.grad(e), spline.grad(e)) * dx)
    return dict(zip(("L2_u", "H1_u"), (compat.assemble_scalar(form) ** 0.5 for form in forms), strict=True))


def main(
    dim: Literal[1, 2, 3] = 2,
    geometry: Literal["bspline", "nurbs"] = "nurbs",
    degree: int = 3,
    cells: Literal["tensor", "simplex"] = "tensor",
    elements: int = 4,
    levels: int = 4,
    out: Path = Path("results/poisson"),
    overwrite: bool = False,
    viz: bool = True,
) -> dict[str, Any]:
    """Solve Poisson's problem on finer and finer splines and compare the rates with theory.

    Args:
        dim: parametric dimension.
        geometry: bspline: a segment, quadrilateral or hexahedron with straight edges; nurbs: a quarter of a circle, an
            eighth of a ring or of a thick pipe.
        degree: of the splines, 2 or more on a nurbs.
        cells: quadrilaterals and hexahedra, or triangles and tetrahedra (of degree dim times the spline's).
        elements: per direction on the coarsest level; doubled from level to level.
        levels: number of levels, 2 or more.
        out: folder of the results.
        overwrite: whether to delete the results of an earlier run in this folder.
        viz: whether to write a ParaView file and a picture of the finest level.

    Returns:
        The summary.
    """
    coarse = coarse_patch(dim, geometry)
    patch = coarse.with_degree(checks.whole("degree", degree, max(coarse.functions.degrees)))
    expected = {"L2_u": degree + 1, "H1_u": degree}
    claim(out, overwrite=overwrite)
    study, solution = refine(lambda n: solve(patch.refined(n), cells), errors, doubled(elements, levels), expected)
    if viz:
        with VTUSeries(out / "poisson", solution.spline, u=solution.u) as series:
            series.write(0.0)
        draw(out / "poisson.png", solution, study)

    inputs = {
        "dim": dim,
        "geometry": geometry,
        "degree": degree,
        "cells": cells,
        "elements": elements,
        "levels": levels,
    }
    summary = write_summary(out, "poisson", inputs, **study.results())
    if MPI.COMM_WORLD.rank == 0:
        print(f"{dim}D, {geometry}, degree {degree}, {cells} cells")
        print(study.table())
    return summary


def draw(path: Path, solution: Solution, study: Study) -> None:
    """The solution, in space on the section in the middle of the third direction, and the errors against run time."""
    spline = solution.spline
    dim, samples = spline.dim, 61
    axes = np.meshgrid(*[np.linspace(0.0, 1.0, samples)] * min(dim, 2), *[0.5] * (dim - 2), indexing="ij")
    xi = np.column_stack([axis.ravel() for axis in axes])
    values = spline.evaluate(solution.u, xi).reshape(axes[0].shape)
    picture(path, dim, values, spline.geometry.evaluate(xi), xi[:, 0], study)


@root_only
def picture(path: Path, dim: int, values: FloatArray, points: FloatArray, xi: FloatArray, study: Study) -> None:
    """What :func:`draw` shows, from values at points with first parameters xi."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4.6), layout="constrained")
    if dim == 1:
        left.plot(xi, values, "C0-")
        left.set(xlabel="parameter", ylabel="$u$")
    else:
        x, y = (points[:, i].reshape(values.shape[:2]) for i in (0, 1))
        values = values.reshape(x.shape)
        shade = left.pcolormesh(x, y, values, shading="gouraud", cmap="viridis")
        figure.colorbar(shade, ax=left, label="$u$")
        left.set(aspect="equal", xlabel="$x_1$", ylabel="$x_2$")
    left.set_title("solution" if dim < 3 else "solution in the middle of the third direction")
    study.draw(right)
    figure.savefig(path, dpi=130)
    plt.close(figure)


if __name__ == "__main__":
    script.command_line(main)
