"""Dense parts of low rank in the tangents of sparse systems."""

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
import ufl
from dolfinx import fem
from petsc4py import PETSc

from tigar_x import compat
from tigar_x.compat import IntArray
from tigar_x.linear import PreparedSolver


class RankOne(Protocol):
    """A load ``s(x) a`` with one scalar s of the whole unknown, such as a pressure that follows an outlet's flow rate.

    The residual contains s as of its assembly (see ``before`` of :class:`FiniteElementSystem`). Its tangent ``a s'^T``
    is dense, and is therefore not assembled but added to the solution of systems without it.
    """

    @property
    def load(self) -> ufl.Form:
        """Linear form of a."""

    @property
    def slope(self) -> ufl.Form:
        """Linear form of s', the derivative of s by the unknown."""


class LowRank:
    """The dense part ``sum_i a_i s_i'^T`` of a tangent, by Woodbury's formula.

    Args:
        parts: the loads.
        V: space of the unknown.
        constrained: constrained local dofs, where all vectors are zero.
    """

    def __init__(self, parts: Sequence[RankOne], V: fem.FunctionSpace, constrained: IntArray) -> None:
        forms = compat.compile_forms(*(part.load for part in parts), *(part.slope for part in parts))
        vectors = [compat.create_vector(V) for _ in forms]
        self._forms = list(zip(vectors, forms, strict=True))
        n = len(parts)
        self._loads, self._slopes = vectors[:n], vectors[n:]
        self._solved = [vector.duplicate() for vector in self._loads]
        compat.freed_with(self, *vectors, *self._solved)
        self._constrained = constrained[constrained < vectors[0].getLocalSize()]
        self._inverse: Any = None

    def forget(self) -> None:
        """The rest of the tangent has changed."""
        self._inverse = None

    def _prepare(self, solver: PreparedSolver) -> int:
        for vector, form in self._forms:
            compat.assemble_vector(vector, form)
            vector.ghostUpdate(PETSc.InsertMode.ADD, PETSc.ScatterMode.REVERSE)
            vector.array_w[self._constrained] = 0.0
        iterations = sum(solver.solve(load, x) for load, x in zip(self._loads, self._solved, strict=True))
        products = np.array([[slope.dot(x) for x in self._solved] for slope in self._slopes])
        self._inverse = np.linalg.inv(np.eye(len(self._slopes)) + products)
        return iterations

    def correct(self, x: PETSc.Vec, solver: PreparedSolver) -> int:
        """Make a solution without the dense part one with it.

        Args:
            x: solution of the system without it, overwritten.
            solver: of that system.

        Returns:
            Linear iterations.
        """
        iterations = self._prepare(solver) if self._inverse is None else 0
        for factor, solved in zip(self._inverse @ [slope.dot(x) for slope in self._slopes], self._solved, strict=True):
            x.axpy(-factor, solved)
        return iterations
