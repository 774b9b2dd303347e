"""Nodal quadrature on a spline: the immersed points of the coupling, and the point masses of contact."""

from dataclasses import dataclass

import numpy as np

from tigar_x import checks, compat
from tigar_x.compat import FloatArray, IntArray
from tigar_x.splines.spline import ExtractedSpline, require_spline

NEGATIVE = 2e-2
"""Part of the largest weight by which others may be negative: at poles they are by less, on triangles by more."""


@dataclass(frozen=True, eq=False)
class NodalQuadrature:
    """Quadrature points at the Lagrange nodes of a spline that lives whole on this rank.

    Attributes:
        points: reference positions X_A, shape (nodes, nsd); unit: length.
        weights: reference areas W_A = int phi_A, summing to the whole area, shape (nodes,); unit: length or area. A
            little less than zero, as a pole makes them, is taken from the other nodes of the same cells instead.
        rational: weights w_A of the spline at the nodes, shape (nodes,); a physical value is u^h_A / w_A, and a point
            force f enters row A of the homogeneous residual as f / w_A.
        cells: points of every cell of the surface, shape (cells, points per cell); None: no surface is known.
    """

    points: FloatArray
    weights: FloatArray
    rational: FloatArray
    cells: IntArray | None = None

    def __post_init__(self) -> None:
        checks.freeze(self)

    @classmethod
    def of(cls, spline: ExtractedSpline) -> "NodalQuadrature":
        """Nodal quadrature of a spline.

        Args:
            spline: lives on one rank (``MPI.COMM_SELF``).

        Returns:
            The quadrature.

        Raises:
            ValueError: the spline is distributed, or weights are negative by more than rounding and poles, as on
                triangles.
        """
        require_spline(spline)
        if spline.mesh.comm.size > 1:
            raise ValueError(f"spline lives on {spline.mesh.comm.size} ranks: nodal quadrature needs MPI.COMM_SELF")
        weights = spline.node_areas
        if weights.min() < -NEGATIVE * weights.max():
            i = int(np.argmin(weights))
            raise ValueError(f"weights[{i}] = {weights[i]}: nodal weights >= 0 are required, which tensor cells give")
        cells = compat.cell_dofs(spline.scalar.V)
        return cls(spline.node_positions, _spread(weights, cells), spline.node_weights, cells)


def _spread(weights: FloatArray, cells: IntArray) -> FloatArray:
    """The same weights with zero for negative ones, which the other nodes of their cells make up for."""
    result = np.where(weights > 1e-13 * weights.max(), weights, 0.0)
    share = result.copy()
    for i in np.flatnonzero(weights < 0.0):
        around = np.unique(cells[(cells == i).any(axis=1)])
        result[around] += weights[i] * share[around] / share[around].sum()
    return result
