"""The points that a rank's cells see, and the product with the system's matrix made of these alone.

Of the sums over points each rank finds its share: those over the fluid's nodes are its own anyway, and points that are
seen from several ranks count a part on each. What ranks have in common is the shell's solution, and velocities at the
points that more than one of them sees.
"""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import scipy.sparse as sp
from mpi4py import MPI

from coudalfish.step.linearised import WEAK, Linearised, Preconditioner
from tigar_x.compat import FloatArray


@dataclass(frozen=True, eq=False)
class Seen:
    """Parts of the system at the points that this rank sees, on several ranks.

    Attributes:
        at: the whole.
        rows: of matrices of points, of those that are seen, shape (n,).
        count: by how many ranks each of them is seen, shape (n,).
        common: mask of the rows of points that several ranks see.
        places: their numbers among those that any rank has in common with another one.
        shared: number of these.
        B: trace, shape (n / d, nodes).
        B_t: its transpose.
        P: displacement, shape (n, coefficients).
        P_t: its transpose.
        G: forces of the multiplier's functions, shape (n, functions).
        G_t: its transpose.
        H_t: functions, shape (functions, n).
        W: areas, shape (n,).
    """

    at: Linearised
    rows: Any
    count: FloatArray
    common: Any
    places: Any
    shared: int
    B: sp.csr_matrix
    B_t: sp.csr_matrix
    P: sp.csr_matrix
    P_t: sp.csr_matrix
    G: sp.csr_matrix
    G_t: sp.csr_matrix
    H_t: sp.csr_matrix
    W: FloatArray
    _known: dict[Preconditioner, Any] = field(default_factory=dict, init=False, repr=False)

    @classmethod
    def of(cls, at: Linearised) -> "Seen":
        """Those of the system at a state (collective)."""
        d, B = at.dofs.shape[1], at.trace.B
        seen = np.diff(B.indptr) > 0
        count = seen.astype(np.int32)
        at.fluid.comm.Allreduce(MPI.IN_PLACE, count, op=MPI.SUM)
        points, several = np.flatnonzero(seen), np.flatnonzero(count > 1)
        rows = (d * points[:, None] + np.arange(d)).ravel()
        place = np.full((len(count), d), -1)
        place[several] = np.arange(d * len(several)).reshape(-1, d)
        places = place.ravel()[rows]
        common = places >= 0
        own, P, G = B[points], at.P[rows], at.G[rows]
        return cls(
            at=at,
            rows=rows,
            count=np.repeat(count[points], d).astype(np.float64),
            common=common,
            places=places[common],
            shared=d * len(several),
            B=own,
            B_t=own.T.tocsr(),
            P=P,
            P_t=P.T.tocsr(),
            G=G,
            G_t=G.T.tocsr(),
            H_t=at.H[rows].T.tocsr(),
            W=at.W[rows],
        )

    def product(self, a: FloatArray, b: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The product's part of coupling, see :mod:`coudalfish.step.condensed` (collective).

        Args:
            a: velocities at the trace's nodes, shape (nodes, d).
            b: coefficients of the multiplier, shape (functions,); those of the first rank count.

        Returns:
            Forces on the trace's nodes, this rank's share, shape (nodes, d), and beta times the rows of the multiplier,
            on the first rank.
        """
        at, comm, a_f = self.at, self.at.fluid.comm, self.at.fluid.timeInt.x_factor
        comm.Bcast(b)
        v, pushed = (a_f * (self.B @ a)).ravel(), self.G @ b
        sums = np.zeros(self.shared + self.P.shape[1])
        sums[self.places] = v[self.common]
        sums[self.shared :] = self.P_t @ (self.W * at.beta * v + pushed / self.count)
        comm.Allreduce(MPI.IN_PLACE, sums, op=MPI.SUM)
        w = at.a_s * (self.P @ at.solve_shell(sums[self.shared :]))
        slip = at.beta * (self.G_t @ (v - w / self.count)) - WEAK * (self.H_t @ (pushed / self.count))
        if at.X_t is not None:
            slip[: at.X_t.shape[0]] += at.beta * a_f * (at.X_t @ a.ravel())
        v[self.common] = sums[self.places]
        nodal = self.to_nodes(self.W * at.beta * (v - w) + pushed, b) - at.free * (at.part @ a)
        total = np.empty_like(slip)
        comm.Reduce(slip, total, op=MPI.SUM)
        return nodal, total

    def nodal(self, preconditioner: Preconditioner, b: FloatArray) -> FloatArray:
        """Forces of coefficients on the trace's nodes by the preconditioner, this rank's share, shape (nodes, d).

        Args:
            preconditioner: of the system, perhaps of an earlier state.
            b: coefficients, the same on every rank, shape (functions,).
        """
        made = preconditioner.made
        G, P, bent = self._of_made(preconditioner)
        return self.to_nodes(G @ b - made.beta * made.a_s * (made.W[self.rows] * (P @ (bent @ b))), b)

    def _of_made(self, preconditioner: Preconditioner) -> tuple[sp.csr_matrix, sp.csr_matrix, FloatArray]:
        """Its forces and displacements at the points that are seen, and how coefficients that move these give way."""
        if preconditioner not in self._known:
            used = np.unique(self.P.indices)
            self._known.clear()
            self._known[preconditioner] = preconditioner.made.G[self.rows], self.P[:, used], preconditioner.bent[used]
        return self._known[preconditioner]

    def to_nodes(self, forces: FloatArray, b: FloatArray) -> FloatArray:
        """This rank's share of forces at the points that are seen, and of functions, on the nodes, shape (nodes, d)."""
        nodal = self.B_t @ forces.reshape(-1, self.at.dofs.shape[1])
        if self.at.X is not None:
            nodal = nodal + (self.at.X @ b).reshape(nodal.shape)
        return np.asarray(self.at.free * nodal)
