"""The parts of the linear system of fluid, shell and multiplier at one state."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse as sp

from coudalfish.sides.fluid import FluidSubproblem
from coudalfish.surface.trace import TraceMatrix
from tigar_x.compat import FloatArray

WEAK = 1e-8
"""Factor eps of the term that keeps multipliers from growing which nothing else determines."""
NOTHING = 1e-14
"""Square of a function, summed over the areas at which it acts, relative to the largest, which is rounding."""


@dataclass(frozen=True, eq=False)
class Linearised:
    """The parts of the system at one state, the same on every rank but for the fluid's.

    Attributes:
        fluid: the flow, with its tangent assembled.
        trace: of its velocity at the points, this rank's share.
        part: what its tangent has of the penalty, for one component, shape (trace nodes, trace nodes).
        W: areas, zero at inactive points, shape (points d,).
        H: functions of the multiplier, zero where it acts on nothing, shape (points d, functions).
        G: their forces on the shell, shape (points d, functions), this rank's share.
        F: their forces on the trace's nodes, shape (nodes d, functions), likewise.
        P: displacements of the points by the shell's coefficients, shape (points d, coefficients).
        solve_shell: A_s^-1 times its argument, shape (coefficients,), or each of its columns.
        beta: penalty.
        a_s: derivative of y' by y.
    """

    fluid: FluidSubproblem
    trace: TraceMatrix
    part: sp.csr_matrix
    W: FloatArray
    H: sp.csr_matrix
    G: sp.csr_matrix
    F: sp.csr_matrix
    P: sp.csr_matrix
    solve_shell: Callable[[FloatArray], FloatArray]
    beta: float
    a_s: float

    @cached_property
    def dofs(self) -> Any:
        """Dofs of the trace's nodes, shape (nodes, d)."""
        return self.fluid.trace_dofs[self.trace.nodes]

    @cached_property
    def entries(self) -> Any:
        """Where these dofs are in a vector of the flow on one rank, -1: nowhere, shape (nodes, d)."""
        return self.fluid.system.entries[self.dofs]

    @cached_property
    def known(self) -> Any:
        """Mask of those that are somewhere, shape (nodes, d)."""
        return self.entries >= 0

    @cached_property
    def free(self) -> FloatArray:
        """One where a velocity is free, zero where it is held, shape (nodes, d)."""
        return self.fluid.free[self.trace.nodes].astype(np.float64)

    @cached_property
    def F_t(self) -> Any:
        """Forces of the functions on the nodes, shape (functions, nodes d)."""
        return self.F.T

    @cached_property
    def idle(self) -> Any:
        """Mask of the functions that act on nothing.

        Those that end at a row of points have values of rounding there, which determine nothing either.
        """
        size = self.H.multiply(self.H).T @ self.W
        return size <= NOTHING * size.max(initial=0.0)
