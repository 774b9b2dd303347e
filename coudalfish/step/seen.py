"""The points that a rank's cells see, and the products with the system's matrix made of these.

Of the sums over points each rank finds its share: those over the fluid's nodes are its own anyway, and so are the
forces of the multiplier that act there. What ranks have in common is the shell's solution, and velocities at the points
that more than one of them sees.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse as sp
from mpi4py import MPI

from coudalfish.step.linearised import WEAK, Linearised
from tigar_x import ranks
from tigar_x.compat import FloatArray


@dataclass(frozen=True, eq=False)
class Seen:
    """Parts of the system at the points that this rank sees.

    Attributes:
        at: the whole.
        common: of the rows of these points, those of points that other ranks see as well.
        places: their numbers among all points that several ranks see.
        shared: number of these.
        B: trace, shape (n / d, nodes).
        columns: which of the shell's coefficients move these points.
        P: their displacement by these, shape (n, columns).
        G: forces of the multiplier's functions on the shell, this rank's share, shape (n, functions).
        H: functions, shape (n, functions).
        W: areas, shape (n,).
    """

    at: Linearised
    common: Any
    places: Any
    shared: int
    B: sp.csr_matrix
    columns: Any
    P: sp.csr_matrix
    G: sp.csr_matrix
    H: sp.csr_matrix
    W: FloatArray

    @classmethod
    def of(cls, at: Linearised) -> "Seen":
        """Those of the system at a state (collective)."""
        d, B, comm = at.dofs.shape[1], at.trace.B, at.fluid.comm
        if comm.size == 1:
            none = np.empty(0, dtype=np.int64)
            return cls(at, none, none, 0, B, slice(None), at.P, at.G, at.H, at.W)
        count = at.trace.seen_by(comm)
        points = np.flatnonzero(at.trace.seen | (np.diff(at.G.indptr).reshape(-1, d).any(axis=1)))
        several = np.flatnonzero(count > 1)
        rows = (d * points[:, None] + np.arange(d)).ravel()
        place = np.full((len(count), d), -1)
        place[several] = np.arange(d * len(several)).reshape(-1, d)
        places = place.ravel()[rows]
        common = np.flatnonzero(places >= 0)
        P = at.P[rows]
        moves = np.zeros(P.shape[1], dtype=bool)
        moves[P.indices] = True
        columns = np.flatnonzero(moves)
        of_points = P[:, columns], at.G[rows], at.H[rows], at.W[rows]
        return cls(at, common, places[common], d * len(several), B[points], columns, *of_points)

    @cached_property
    def transposed(self) -> tuple[Any, Any, Any, Any]:
        """Of B, P, G and H, which are asked for in every product."""
        return self.B.T.tocsr(), self.P.T, self.G.T, self.H.T

    def product(self, a: FloatArray, b: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The product's part of coupling, see :mod:`coudalfish.step.condensed` (collective).

        Args:
            a: velocities at the trace's nodes, shape (nodes, d).
            b: coefficients of the multiplier, the same on every rank, shape (functions,).

        Returns:
            Forces on the trace's nodes, this rank's share, shape (nodes, d), and beta times the rows of the multiplier.
        """
        at, comm, a_f = self.at, self.at.fluid.comm, self.at.fluid.timeInt.x_factor
        _, P_t, G_t, H_t = self.transposed
        v, pushed = (a_f * (self.B @ a)).ravel(), self.G @ b
        sums = np.zeros(self.shared + at.P.shape[1])
        sums[self.places], load = v[self.common], sums[self.shared :]
        load[self.columns] = P_t @ (self.W * at.beta * v + pushed)
        if comm.size > 1:
            comm.Allreduce(MPI.IN_PLACE, sums, op=MPI.SUM)
        w = at.a_s * (self.P @ at.solve_shell(load)[self.columns])
        slip = at.beta * (a_f * (at.F_t @ a.ravel()) - G_t @ w) - WEAK * (H_t @ pushed)
        v[self.common] = sums[self.places]
        nodal = self.to_nodes(self.W * at.beta * (v - w), b) - at.free * (at.part @ a)
        return nodal, ranks.total(comm, slip)

    def moved(self, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The same of an increment of the shell (collective).

        Args:
            y: coefficients, shape (coefficients,).

        Returns:
            See :meth:`product`.
        """
        at = self.at
        w = at.a_s * (self.P @ y[self.columns])
        return self.to_nodes(at.beta * self.W * w), ranks.total(at.fluid.comm, at.beta * (self.G.T @ w))

    def drag(self, y: FloatArray) -> FloatArray:
        """Forces of the penalty at the points where these coefficients move the shell, or columns of them do."""
        at = self.at
        return np.asarray((at.beta * at.a_s * (self.W * (self.P @ y).T)).T)

    def to_nodes(self, forces: FloatArray, b: FloatArray | None = None) -> FloatArray:
        """This rank's share of forces on the trace's nodes, shape (nodes, d).

        Args:
            forces: at the points, those of the multiplier's functions apart, shape (n,).
            b: coefficients of these, shape (functions,); None: zero.
        """
        nodal = self.transposed[0] @ forces.reshape(-1, self.at.dofs.shape[1])
        if b is not None:
            nodal += (self.at.F @ b).reshape(nodal.shape)
        return np.asarray(self.at.free * nodal)
