"""Velocities at the trace's nodes out of a vector of the flow, and forces there into one."""

from typing import Any

import numpy as np
from petsc4py import PETSc

from coudalfish.step.linearised import Linearised
from tigar_x import compat
from tigar_x.compat import FloatArray


class TraceNodes:
    """Values at the trace's nodes, of which some belong to other ranks: these are exchanged at once, and no others.

    Args:
        at: the state whose trace it is (collective).
    """

    def __init__(self, at: Linearised) -> None:
        self._at, self._scatter, comm = at, None, at.fluid.comm
        if comm.size == 1:
            return
        compat.free_dropped(comm)  # those of the steps before
        flow = at.fluid.system.b
        rows = at.fluid.system.A.getLGMap()[0].apply(at.dofs.ravel().astype(PETSc.IntType))
        known = np.flatnonzero(rows >= 0).astype(PETSc.IntType)
        self._there = PETSc.Vec().createSeq(len(rows), comm=PETSc.COMM_SELF)
        source = PETSc.IS().createGeneral(rows[known], comm=flow.comm)
        target = PETSc.IS().createGeneral(known, comm=PETSc.COMM_SELF)
        self._scatter = PETSc.Scatter().create(flow, source, self._there, target)
        source.destroy()
        target.destroy()
        compat.freed_with(self, self._scatter)
        compat.freed_with(self, self._there)

    def of(self, flow: PETSc.Vec) -> FloatArray:
        """Free velocities there, zero where they are held, shape (nodes, d) (collective)."""
        at = self._at
        if self._scatter is None:
            return np.asarray(at.free * flow.array_r[at.entries])
        self._exchange(flow, self._there, PETSc.InsertMode.INSERT, PETSc.ScatterMode.FORWARD)
        return np.asarray(at.free * self._there.array_r.reshape(at.free.shape))

    def add(self, nodal: FloatArray, flow: PETSc.Vec) -> None:
        """Add the ranks' shares of what acts there, shape (nodes, d) each, to a vector of the flow (collective)."""
        if self._scatter is None:
            flow.array_w[self._at.entries[self._at.known]] += nodal[self._at.known]
            return
        self._there.array_w[:] = nodal.ravel()
        self._exchange(self._there, flow, PETSc.InsertMode.ADD_VALUES, PETSc.ScatterMode.REVERSE)

    def _exchange(self, *what: Any) -> None:
        self._scatter.scatter(*what)  # type: ignore[union-attr]  # who is alone exchanges nothing
