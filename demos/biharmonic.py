"""A clamped plate on splines: lap lap u = f with u and its normal derivative given on the whole boundary.

u is the deflection of a Kirchhoff plate of bending stiffness D under the load D f; Poisson's ratio does not enter when
the whole boundary is clamped. The weak form

    int lap u lap v = int f v    for all v that vanish on the boundary with their normal derivative

asks for functions of continuity C1, which splines of degree p >= 2 have and usual finite elements do not. The exact
solution is the plane wave u = sin(1 + k . x) with f = |k|^4 u. The two rows of coefficients next to every side carry
the data of the boundary: they minimise

    int (u_h - u)^2 + h^2 (u_h,n - u,n)^2    over the boundary,    h the size of an element.

Errors in the norms of H2, H1 and L2 fall with h^(p-1), h^p and h^min(p+1, 2p-2), as for any conforming elements of a
problem of fourth order. Source: G. Strang, G. J. Fix, "An analysis of the finite element method", 1973, chapter 3.
"""

from dataclasses import dataclass
from math import pi
from pathlib import Path
from typing import Any, Literal

import numpy as np
import ufl
from mpi4py import MPI
from dolfinx import fem

from tigar_x import checks, compat
from tigar_x.compat import FloatArray, IntArray
from tigar_x.geometry import shapes, surfaces
from tigar_x.geometry.patch import Patch
from tigar_x.ranks import root_only
from tigar_x.run import script
from tigar_x.run.convergence import Study, doubled, refine
from tigar_x.run.summary import write_summary
from tigar_x.run.writing import claim
from tigar_x.splines.spline import ExtractedSpline
from tigar_x.splines.spline_system import SplineSystem, solve_linear
from tigar_x.splines.vtu import VTUSeries

TOY = {"degree": 2, "elements": 3, "levels": 3}
WAVE = (3.0, 2.0)


def coarse_patch(geometry: str) -> Patch:
    """The plate as one element of the lowest degree that makes it."""
    if geometry == "bspline":
        corners = [(0.0, 0.0), (1.1, 0.0), (0.0, 1.1), (1.3, 1.3)]
        return Patch.from_points([shapes.uniform(1, 1)] * 2, corners)
    return surfaces.annulus(inner=0.5, outer=1.0, angle=pi / 4, center=(0.0, 0.0), elements=(1, 1), degrees=(1, 2))


def expected_rates(p: int) -> dict[str, int]:
    """Rates of theory by norm."""
    return {"L2_u": min(p + 1, 2 * p - 2), "H1_u": p, "H2_u": p - 1}


def wave(x: Any, k: Any) -> Any:
    """Exact solution at a position."""
    return ufl.sin(1 + ufl.dot(k, x))


def laplacian(spline: ExtractedSpline, f: Any) -> Any:
    """Laplacian of a physical field."""
    return spline.div(spline.grad(f))


def plate(spline: ExtractedSpline, u: Any, v: Any, f: Any) -> ufl.Form:
    """Residual of lap lap u = f."""
    w = spline.rationalize
    return laplacian(spline, w(u)) * laplacian(spline, w(v)) * spline.dx - f * w(v) * spline.dx


def boundary_rows(patch: Patch) -> IntArray:
    """Functions of the two rows next to every side."""
    return np.unique(np.concatenate([patch.side(name, layers=2) for name in patch.open_sides]))


@dataclass(frozen=True)
class Solution:
    """A solution (homogeneous) on its spline, and the exact one."""

    spline: ExtractedSpline
    u: fem.Function
    exact: Any
    unknowns: int


def solve(patch: Patch, h: float, load: float = 1.0) -> Solution:
    """Solve on a refined patch of element size h; ``load`` multiplies the load of the exact solution."""
    spline = ExtractedSpline(patch)
    k, size, factor = (fem.Constant(spline.mesh, value) for value in (np.array(WAVE), float(h), float(load)))
    exact = wave(spline.F, k)
    rows = boundary_rows(patch)
    space = spline.space(1, zero_dofs=rows)
    u = spline.project_boundary(exact, slope_length=size)
    R = plate(spline, u, ufl.TestFunction(space.V), factor * ufl.dot(k, k) ** 2 * exact)
    solve_linear(SplineSystem(space, R, ufl.derivative(R, u), unknown=u))
    return Solution(spline, u, exact, patch.n - len(rows))


def errors(solution: Solution) -> dict[str, float]:
    """Norms of the error, its gradient and its second derivatives, with two more degrees of quadrature."""
    spline = solution.spline
    e = spline.rationalize(solution.u) - solution.exact
    dx = spline.dx.of_degree(spline.quadrature_degree + 2)
    derivatives = (e, spline.grad(e), spline.grad(spline.grad(e)))
    forms = compat.compile_forms(*(ufl.inner(D, D) * dx for D in derivatives))
    return dict(zip(("L2_u", "H1_u", "H2_u"), (compat.assemble_scalar(form) ** 0.5 for form in forms), strict=True))


def main(
    geometry: Literal["bspline", "nurbs"] = "nurbs",
    degree: int = 3,
    elements: int = 4,
    levels: int = 4,
    out: Path = Path("results/biharmonic"),
    overwrite: bool = False,
    viz: bool = True,
) -> dict[str, Any]:
    """Solve the plate's problem on finer and finer splines and compare the rates with theory.

    Args:
        geometry: bspline: a quadrilateral with straight edges; nurbs: an eighth of a ring.
        degree: of the splines, 2 or more.
        elements: per direction on the coarsest level; doubled from level to level.
        levels: number of levels, 2 or more.
        out: folder of the results.
        overwrite: whether to delete the results of an earlier run in this folder.
        viz: whether to write a ParaView file and a picture of the finest level.

    Returns:
        The summary.
    """
    patch = coarse_patch(geometry).with_degree(checks.whole("degree", degree, 2))
    claim(out, overwrite=overwrite)
    study, solution = refine(
        lambda n: solve(patch.refined(n), 1.0 / n), errors, doubled(elements, levels), expected_rates(degree)
    )
    if viz:
        with VTUSeries(out / "biharmonic", solution.spline, u=solution.u) as series:
            series.write(0.0)
        draw(out / "biharmonic.png", solution, study)

    inputs = {"geometry": geometry, "degree": degree, "elements": elements, "levels": levels}
    summary = write_summary(out, "biharmonic", inputs, **study.results())
    if MPI.COMM_WORLD.rank == 0:
        print(f"clamped plate, {geometry}, degree {degree}")
        print(study.table())
    return summary


def draw(path: Path, solution: Solution, study: Study) -> None:
    """The deflection, and the errors against run time."""
    spline, samples = solution.spline, 61
    axes = np.meshgrid(*[np.linspace(0.0, 1.0, samples)] * 2, indexing="ij")
    xi = np.column_stack([axis.ravel() for axis in axes])
    values = spline.evaluate(solution.u, xi).reshape(samples, samples)
    picture(path, spline.geometry.evaluate(xi), values, study)


@root_only
def picture(path: Path, points: FloatArray, values: FloatArray, study: Study) -> None:
    """What :func:`draw` shows, from values at points."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4.6), layout="constrained")
    x, y = (points[:, i].reshape(values.shape) for i in (0, 1))
    shade = left.pcolormesh(x, y, values, shading="gouraud", cmap="viridis")
    figure.colorbar(shade, ax=left, label="$u$")
    left.set(aspect="equal", xlabel="$x_1$", ylabel="$x_2$", title="deflection")
    study.draw(right)
    figure.savefig(path, dpi=130)
    plt.close(figure)


if __name__ == "__main__":
    script.command_line(main)
