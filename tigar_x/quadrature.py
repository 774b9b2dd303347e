"""Nodal quadrature on a spline: the immersed points of the coupling, and the point masses of contact."""

from dataclasses import dataclass

import numpy as np

from tigar_x.compat import FloatArray
from tigar_x.spline import ExtractedSpline


@dataclass(frozen=True, eq=False)
class NodalQuadrature:
    """Quadrature points at the Lagrange nodes of a spline that lives whole on this rank.

    Attributes:
        points: reference positions X_A, shape (nodes, nsd); unit: length.
        weights: reference areas W_A = int phi_A, summing to the whole area, zero at the nodes of a pole, shape
            (nodes,); unit: length or area.
        rational: weights w_A of the spline at the nodes, shape (nodes,); a physical value is u^h_A / w_A, and a point
            force f enters row A of the homogeneous residual as f / w_A.
    """

    points: FloatArray
    weights: FloatArray
    rational: FloatArray

    @classmethod
    def of(cls, spline: ExtractedSpline) -> "NodalQuadrature":
        """Nodal quadrature of a spline.

        Args:
            spline: lives on one rank (``MPI.COMM_SELF``).

        Returns:
            The quadrature.

        Raises:
            ValueError: the spline is distributed, or a weight is negative, as on triangles.
        """
        if spline.mesh.comm.size > 1:
            raise ValueError(f"spline lives on {spline.mesh.comm.size} ranks: nodal quadrature needs MPI.COMM_SELF")
        weights = spline.node_areas
        rounding = 1e-13 * np.abs(weights).max()
        if not (weights > -rounding).all():
            i = int(np.argmin(weights))
            raise ValueError(f"weights[{i}] = {weights[i]}: nodal weights >= 0 are required, which tensor cells give")
        weights = np.where(weights > rounding, weights, 0.0)
        return cls(spline.node_positions, weights, spline.node_weights)
