"""Surfaces that meet the fluid on the polygons on which the signed distance from them is zero in its cells.

The fluid's velocity is averaged there over the hat functions phi_q of the surface's points at the nearest places,
``u_q = (1/W_q) int phi_q u dA`` with ``W_q = int phi_q dA``, areas at rest. What forces at the points do they do on the
polygons; a multiplier may act along the normals of the polygons instead, and a pressure that jumps is then in
equilibrium with it to rounding.
"""

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from mpi4py import MPI

from coudalfish.surface.averaged import TOUCHING, Averaged
from coudalfish.surface.exchange import by_components
from coudalfish.surface.meeting import Meeting, NormalForces
from coudalfish.surface.net import Net
from coudalfish.surface.polygons import ZeroPoints
from coudalfish.surface.trace import Location
from tigar_x.compat import FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class OnPolygons(Averaged):
    """A surface in a step that meets the fluid on polygons, see :class:`coudalfish.surface.meeting.Meeting`.

    Attributes:
        normals: of the polygons at this rank's points on them, shape (polygon points, d).
        hats: hat functions there, shape (polygon points, points).
        net: how the surface's points hang together.
        plain: the surface where it is.
        comm: of the fluid.
    """

    normals: FloatArray
    hats: sp.csr_matrix
    net: Net
    plain: Meeting
    comm: MPI.Comm

    @classmethod
    def of(
        cls,
        points: ZeroPoints,
        hats: sp.csr_matrix,
        net: Net,
        areas: FloatArray,
        nodes: IntArray,
        whole: FloatArray,
        plain: Meeting,
        comm: MPI.Comm,
    ) -> "OnPolygons":
        """By points on the polygons of this rank's cells (collective).

        Args:
            points: the points.
            hats: hat functions of the surface's points there.
            net: how these hang together.
            areas: of the surface at rest that they stand for, shape (polygon points,).
            nodes: those of all cells, shape (cells, d + 1).
            whole: areas at rest of the surface's points, shape (points,).
            plain: the surface where it is.
            comm: of the fluid.
        """
        W = np.asarray(hats.T @ areas, dtype=np.float64)
        comm.Allreduce(MPI.IN_PLACE, W, op=MPI.SUM)
        W[TOUCHING * whole > W] = 0.0
        of_points = nodes[points.cells]
        is_seen = np.zeros(int(of_points.max(initial=-1)) + 1, dtype=bool)
        is_seen[of_points] = True
        seen = np.flatnonzero(is_seen)
        column, starts = (np.cumsum(is_seen) - 1)[of_points], np.arange(0, of_points.size + 1, nodes.shape[1])
        E = sp.csr_matrix((points.barycentric.ravel(), column.ravel(), starts), shape=(len(areas), len(seen)))
        location = Location(points.cells, points.barycentric, np.ones(len(areas), dtype=bool))
        inverse, means = np.divide(1.0, W, out=np.zeros_like(W), where=W > 0.0), hats.T.tocsr()
        means.data *= np.repeat(inverse, np.diff(means.indptr)) * areas[means.indices]
        return cls(W, location, (E, areas), seen, means, points.normals, hats, net, plain, comm)

    def vertex_functions(self) -> sp.csr_matrix:
        """See there (collective)."""
        return self.plain.vertex_functions()

    def normal_forces(
        self, functions: sp.csr_matrix, n: FloatArray, trace: sp.csr_matrix | None = None
    ) -> NormalForces:
        """Forces along the normals of the polygons (collective): what acts on both sides sums to the same.

        Args:
            functions: of a multiplier, force per area at the surface's points, shape (points, functions).
            n: the surface's normals, which agree across joints, shape (points, d).
            trace: see :class:`coudalfish.surface.meeting.Meeting`.
        """
        E, forces = self.penalty[0] if trace is None else trace, self.penalty[1][:, None] * self.normals
        acting = (self._sided(n) @ functions).tocsr()
        d, rows = self.normals.shape[1], np.repeat(np.arange(acting.shape[0]), np.diff(acting.indptr))
        blocks = (acting.data[:, None] * forces[rows])[:, :, None], acting.indices, acting.indptr
        each = sp.bsr_matrix(blocks, shape=(d * acting.shape[0], acting.shape[1]))
        return NormalForces(by_components(self.hats.T, each, d), by_components(E.T, each, d))

    def _sided(self, n: FloatArray) -> sp.csr_matrix:
        """Hat functions with the side of the surface on which the polygons' normals are, 1 or -1 (collective).

        A sheet has one side wherever polygons are nearest to it: where sheets touch or fold, single polygons are turned
        by more than a right angle against the nearest place, and would push the wrong way. Only a sheet that is
        one-sided has the side of each polygon.
        """
        sheet, one_sided = self.net.sheet_of_points, self.net.one_sided
        along = np.einsum("qi,qi->q", n, self.hats.T @ (self.penalty[1][:, None] * self.normals))
        votes = np.bincount(sheet + 1, along, len(one_sided) + 1)
        self.comm.Allreduce(MPI.IN_PLACE, votes, op=MPI.SUM)
        sided = self.hats @ sp.diags(np.where(votes < 0.0, -1.0, 1.0)[sheet + 1])
        if not one_sided.any():
            return sided
        each = np.where(np.einsum("gi,gi->g", self.hats @ n, self.normals) < 0.0, -1.0, 1.0)
        single = np.append(False, one_sided)[sheet + 1]
        return sided @ sp.diags(1.0 * ~single) + sp.diags(each) @ self.hats @ sp.diags(1.0 * single)
