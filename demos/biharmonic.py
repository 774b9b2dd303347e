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

from math import pi
from typing import Any, Literal

import numpy as np
import ufl
from dolfinx import fem

from tigar_x import ExtractedSpline, Patch, Results, Solution, SplineSystem, checks, script, solve_linear, with_results
from tigar_x.geometry import shapes, surfaces

Geometry = Literal["bspline", "nurbs"]
TOY = {"degree": 2, "elements": 3, "levels": 3}


def coarse_patch(geometry: Geometry) -> Patch:
    """The plate as one element of the lowest degree that makes it."""
    if geometry == "nurbs":
        return surfaces.annulus(inner=0.5, outer=1.0, angle=pi / 4, center=(0, 0), elements=(1, 1), degrees=(1, 2))
    return Patch.from_points([shapes.uniform(1, 1)] * 2, [(0.0, 0.0), (1.1, 0.0), (0.0, 1.1), (1.3, 1.3)])


def expected_rates(p: int) -> dict[str, int]:
    """Rates of theory by norm."""
    return {"L2_u": min(p + 1, 2 * p - 2), "H1_u": p, "H2_u": p - 1}


def solve(patch: Patch, h: float, load: float = 1.0) -> Solution:
    """Solve on a refined patch of element size h; ``load`` multiplies the load of the exact solution."""
    plate = ExtractedSpline(patch)
    k, size, factor = (fem.Constant(plate.mesh, value) for value in (np.array((3.0, 2.0)), float(h), float(load)))
    u_exact = ufl.sin(1 + ufl.dot(k, plate.F))
    next_to_sides = np.unique(np.concatenate([patch.side(name, layers=2) for name in patch.open_sides]))
    space, u = plate.space(1, zero_dofs=next_to_sides), plate.project_boundary(u_exact, slope_length=size)
    deflection, virtual = plate.rationalize(u), plate.rationalize(ufl.TestFunction(space.V))
    bending, virtual_bending = (plate.div(plate.grad(w)) for w in (deflection, virtual))
    R = bending * virtual_bending * plate.dx - factor * ufl.dot(k, k) ** 2 * u_exact * virtual * plate.dx
    solve_linear(SplineSystem(space, R, ufl.derivative(R, u), unknown=u))
    return Solution(plate, u, u_exact, patch.n - len(next_to_sides))


def errors(solution: Solution) -> dict[str, float]:
    """Norms of the error, its gradient and its second derivatives."""
    return solution.errors(derivatives=2)


@with_results(elements=4, levels=4)
def main(results: Results, geometry: Geometry = "nurbs", degree: int = 3) -> dict[str, Any]:
    """Solve the plate's problem on finer and finer splines and compare the rates with theory.

    Args:
        geometry: bspline: a quadrilateral with straight edges; nurbs: an eighth of a ring.
        degree: of the splines, 2 or more.
    """
    plate = coarse_patch(geometry).with_degree(checks.whole("degree", degree, 2))
    study, finest = results.refine(lambda n: solve(plate.refined(n), 1.0 / n), errors, expected_rates(degree))
    if results.viz:
        finest.show(results.out / "biharmonic", study, "deflection")
    return results.convergence(study, f"clamped plate, {geometry}, degree {degree}")


if __name__ == "__main__":
    script.command_line(main)
