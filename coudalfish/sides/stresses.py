"""Pressure and viscous traction of the fluid on either side of an immersed shell, at its points.

They are those of the flow's fields, which know both sides. What the coupling exerts are the multiplier and the penalty;
both agree in the mean, and the better the finer the mesh. Within a cell of a free edge fields hardly
differ on both sides, so that less is found there than is exerted.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from mpi4py import MPI

from coudalfish.surface.exchange import tractions
from tigar_x import checks
from tigar_x.compat import FloatArray, IntArray

NEAR = 2.0
"""Distance, in sizes of a divided cell, up to which it tells what is on the side that the cell of a point lacks."""


@dataclass(frozen=True, eq=False)
class SideStresses:
    """Stresses at the points of a shell, first in front of it, where its normals point, then behind it.

    Attributes:
        x: positions of the points, shape (points, d); unit: length.
        normal: unit normals, shape (points, d).
        pressure: shape (points, 2), not a number at points outside the fluid; unit: force/area.
        viscous: ``2 mu sym(grad u) n``, with the same n on both sides, shape (points, 2, d); unit: force/area.
    """

    x: FloatArray
    normal: FloatArray
    pressure: FloatArray
    viscous: FloatArray

    def __post_init__(self) -> None:
        checks.freeze(self)

    @property
    def shear(self) -> FloatArray:
        """Tangential part of the viscous traction, shape (points, 2, d)."""
        along = np.einsum("qsi,qi->qs", self.viscous, self.normal)
        return np.asarray(self.viscous - along[:, :, None] * self.normal[:, None])

    @property
    def traction(self) -> FloatArray:
        """Force of both sides on the shell per present area, shape (points, d)."""
        front, behind = np.swapaxes(self.viscous, 0, 1)
        return front - behind + tractions(self.pressure[:, 1] - self.pressure[:, 0], self.normal)


def side_stresses(fsi: Any) -> SideStresses:
    """Stresses on both sides at the end of the last step (collective).

    Args:
        fsi: a flow whose fields differ on both sides of the surface, coupled, after its first step.

    Raises:
        ValueError: nothing differs in the flow.
    """
    checks.having("fsi", fsi, "fluid shell locator spline_sh", "CouDALFISh(fluid, shell)")
    sides, shell = fsi.fluid.sides, fsi.shell
    if sides is None:
        raise ValueError(
            "fsi: a flow whose fields differ on both sides is required, Flow(..., immersed='jump and kink')"
        )
    x, n, d = shell.positions(), shell.normals(), fsi.spline_sh.nsd
    n = n / np.linalg.norm(n, axis=1, keepdims=True)  # at nodes they are means
    at, values = fsi.locator.locate(x), np.zeros((len(x), 2, 1 + d))
    mine = np.flatnonzero(at.owned)
    for i, s in enumerate((-1.0, 1.0)):  # the surface's sides are positive behind the shell
        where = _cells_of_side(fsi, at.cells[mine], at.barycentric[mine], x[mine], s)
        grad = sides.mean_gradient_at(*where, s)
        strain = fsi.fluid.viscosity * (grad + np.swapaxes(grad, 1, 2))
        values[mine, i, 0] = sides.at(*where, np.full(len(mine), s))[:, -1]
        values[mine, i, 1:] = np.einsum("qij,qj->qi", strain, n[mine])
    values[~at.active] = np.nan
    total = np.asarray(fsi.fluid.comm.allreduce(values, op=MPI.SUM))
    return SideStresses(x, n, total[:, :, 0], total[:, :, 1:])


def _cells_of_side(
    fsi: Any, cells: IntArray, barycentric: FloatArray, x: FloatArray, s: float
) -> tuple[IntArray, FloatArray]:
    """Cells that know a side of the surface at points, which lie in them or, next to a divided one, nearby."""
    sides = fsi.fluid.sides
    near = sides.nearest_divided(x, NEAR)
    other = ~sides.is_divided(cells) & (sides.side(cells, barycentric) != s) & (near >= 0)
    cells, barycentric = np.where(other, near, cells), barycentric.copy()
    barycentric[other] = sides.barycentric(cells[other], x[other])
    return cells, barycentric
