"""Solutions on splines whose exact ones are known: norms of their errors, files and pictures."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import ufl
from dolfinx import fem

from tigar_x import compat
from tigar_x.run.convergence import Study
from tigar_x.run.figure import axis_label, draw
from tigar_x.run.pictures import Colours
from tigar_x.splines import sampling
from tigar_x.splines.spline import ExtractedSpline
from tigar_x.splines.vtu import VTUSeries


@dataclass(frozen=True)
class Solution:
    """A solution beside the exact one.

    Attributes:
        spline: on which it is.
        u: homogeneous coefficients of the solution.
        exact: UFL, in terms of the position ``spline.F``.
        unknowns: number of free coefficients.
    """

    spline: ExtractedSpline
    u: fem.Function
    exact: Any
    unknowns: int

    def errors(self, derivatives: int = 1) -> dict[str, float]:
        """Norms of the error in L2 and of its derivatives, with two more degrees of quadrature than the solution.

        Args:
            derivatives: number of derivatives: 1 for the seminorm of H1, 2 for that of H2 as well.

        Returns:
            Norms by the names ``L2_u``, ``H1_u``, ``H2_u``.
        """
        parts = [self.spline.rationalize(self.u) - self.exact]
        for _ in range(derivatives):
            parts.append(self.spline.grad(parts[-1]))
        dx = self.spline.dx.of_degree(self.spline.quadrature_degree + 2)
        forms = compat.compile_forms(*(ufl.inner(part, part) * dx for part in parts))
        names = ("L2_u", *(f"H{i}_u" for i in range(1, len(parts))))
        return {name: compat.assemble_scalar(form) ** 0.5 for name, form in zip(names, forms, strict=True)}

    def show(self, path: Path, study: Study, what: str = "$u$", samples: int = 61) -> None:
        """Write the solution as a ParaView file, and draw it beside the errors of a study (collective).

        Of a volume the section in the middle of the third direction is drawn.

        Args:
            path: without ending.
            study: errors from level to level.
            what: name of the solution; the problem has no dimensions.
            samples: number of points in a direction.
        """
        VTUSeries(path, self.spline, u=self.u).once()
        dim = self.spline.dim
        points = sampling.net(self.spline, (samples,) * min(dim, 2) + (3,) * (dim - 2), patch=0)
        x, u = points.positions(), points.values(self.u)
        if dim == 3:
            x, u = x[:, :, 1], u[:, :, 1]

        def solution(axes: Any) -> None:
            if dim == 1:
                axes.plot([i / (samples - 1) for i in range(samples)], u)
                axes.set(xlabel=axis_label("parameter, by its range", "-"), ylabel=axis_label(what, "-"))
            else:
                shade = axes.pcolormesh(x[..., 0], x[..., 1], u, shading="gouraud")
                Colours(what, "-").bar(axes, u, mappable=shade)
                axes.set(aspect="equal", xlabel=axis_label("$x_1$", "-"), ylabel=axis_label("$x_2$", "-"))
            axes.set_title("solution" if dim < 3 else "solution in the middle of the third direction")

        draw(path.with_suffix(".png"), solution, study.draw)
