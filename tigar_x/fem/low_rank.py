"""Dense parts of low rank in the tangents of sparse systems."""

from collections.abc import Sequence
from typing import Protocol

import numpy as np
import ufl
from dolfinx import fem
from petsc4py import PETSc

from tigar_x import compat
from tigar_x.compat import FloatArray, IntArray
from tigar_x.fem.linear import PreparedSolver


class RankOne(Protocol):
    """A load ``s(x) a`` with one scalar s of the whole unknown, such as a pressure that follows an outlet's flow rate.

    The residual contains s as of its assembly (see ``before`` of ``FiniteElementSystem``). Its tangent ``a s'^T``
    is dense, and is therefore not assembled but added to the solution of systems without it.
    """

    @property
    def load(self) -> ufl.Form:
        """Linear form of a."""

    @property
    def slope(self) -> ufl.Form:
        """Linear form of s', the derivative of s by the unknown."""


ACCURACY = 1e-10
"""Part of a residual that what is left of the loads' systems may make up, where the solver has no tolerance."""
NOTHING = 1e-12
"""Part of a residual that counts as nothing."""


class LowRank:
    """The dense part ``sum_i a_i s_i'^T`` of a tangent, by Woodbury's formula.

    The formula holds for any size of s', such as a large resistance, if two things are seen to. A residual may consist
    of the loads a_i for the most part; these are taken out of it and met by the solutions z_i of ``K z_i = a_i`` alone.
    And what z_i leaves, ``e_i = K z_i - a_i``, enters the residual with the amount of z_i in the solution, which grows
    with s': z_i is refined until that is less than what the solver leaves of the rest.

    Args:
        parts: the loads.
        V: space of the unknown.
        constrained: constrained local dofs, where all vectors are zero.
    """

    def __init__(self, parts: Sequence[RankOne], V: fem.FunctionSpace, constrained: IntArray) -> None:
        n = len(parts)
        self._forms = compat.compile_forms(*(part.load for part in parts), *(part.slope for part in parts))
        vectors = [compat.create_vector(V) for _ in range(5 * n + 1)]
        self._loads, self._slopes, self._solved, self._errors, self._present = (
            vectors[i * n : (i + 1) * n] for i in range(5)
        )
        self._work = vectors[-1]
        compat.freed_with(self, *vectors)
        self._constrained = constrained[constrained < vectors[0].getLocalSize()]
        self._refinable: list[bool] | None = None
        self._assembled = False

    def forget(self) -> None:
        """The rest of the tangent has changed."""
        self._refinable, self._assembled = None, False

    def _assemble(self, vectors: list[PETSc.Vec]) -> None:
        for vector, form in zip(vectors, self._forms, strict=False):
            compat.assemble_vector(vector, form)
            vector.ghostUpdate(PETSc.InsertMode.ADD, PETSc.ScatterMode.REVERSE)
            vector.array_w[self._constrained] = 0.0

    def _set_error(self, i: int, A: PETSc.Mat) -> float:
        A.mult(self._solved[i], self._errors[i])
        self._errors[i].axpy(-1.0, self._loads[i])
        return float(self._errors[i].norm())

    def _prepare(self, solver: PreparedSolver, A: PETSc.Mat) -> int:
        self._assemble([*self._loads, *self._slopes])
        self._assembled = True
        iterations = sum(solver.solve(load, z) for load, z in zip(self._loads, self._solved, strict=True))
        self._refinable = [self._set_error(i, A) > 0.0 for i in range(len(self._loads))]
        return iterations

    def _refine(self, solver: PreparedSolver, A: PETSc.Mat) -> int:
        """Halve the errors at least, where rounding lets them be."""
        iterations = 0
        for i, z in enumerate(self._solved):
            if self._refinable is None or not self._refinable[i]:
                continue
            before = self._errors[i].norm()
            iterations += solver.solve(self._errors[i], self._work)
            z.axpy(-1.0, self._work)
            after = self._set_error(i, A)
            if after >= before:
                z.axpy(1.0, self._work)
                self._set_error(i, A)
            self._refinable[i] = 0.0 < after < 0.5 * before
        return iterations

    def solve(
        self, b: PETSc.Vec, x: PETSc.Vec, solver: PreparedSolver, A: PETSc.Mat, reference: float | None = None
    ) -> int:
        """Solve the system with the dense part.

        Args:
            b: right-hand side.
            x: overwritten by the solution.
            solver: of the system without the dense part.
            A: its matrix.
            reference: norm that the solver's relative tolerance refers to; None: that of b without the loads.

        Returns:
            Linear iterations.

        Raises:
            SolveError: the solver failed.
        """
        iterations = self._prepare(solver, A) if self._refinable is None else 0
        amounts = self._without(self._loads, b)
        scale = float(self._work.norm()) if reference is None else reference
        iterations += solver.solve(self._work, x, reference)
        while True:
            products = np.array([[slope.dot(z) for z in self._solved] for slope in self._slopes])
            wanted = amounts - [slope.dot(x) for slope in self._slopes]
            factors = np.linalg.solve(np.eye(len(wanted)) + products, wanted)
            self._work.set(0.0)
            self._work.maxpy(factors, self._errors)
            left = self._work.norm()
            if left <= max(solver.rtol, ACCURACY) * scale or not any(self._refinable or ()):
                break
            iterations += self._refine(solver, A)
        x.maxpy(factors, self._solved)
        return iterations

    def _without(self, loads: list[PETSc.Vec], b: PETSc.Vec) -> FloatArray:
        """Take the loads out of b, which goes into the vector of work, and return their amounts."""
        gram = np.array([[a.dot(c) for c in loads] for a in loads])
        amounts = np.linalg.lstsq(gram, np.array([a.dot(b) for a in loads]), rcond=None)[0]
        b.copy(self._work)
        self._work.maxpy(-amounts, loads)
        return np.asarray(amounts)

    def add_product(self, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Add the product of the dense part and x to y (collective)."""
        if not self._assembled:
            self._assemble([*self._loads, *self._slopes])
            self._assembled = True
        y.maxpy([slope.dot(x) for slope in self._slopes], self._loads)

    def remove(self, vector: PETSc.Vec) -> None:
        """Take the present loads out of a vector (collective)."""
        self._assemble(self._present)
        self._without(self._present, vector)
        self._work.copy(vector)

    def rest(self, b: PETSc.Vec) -> float:
        """Norm of a residual without the present loads (collective); all of it where they are all that there is."""
        self._assemble(self._present)
        self._without(self._present, b)
        rest, norm = float(self._work.norm()), float(b.norm())
        return rest if rest > NOTHING * norm else norm

    def rounding(self, x: PETSc.Vec) -> float:
        """What rounding of the unknown, relative to its values, does to the loads (collective)."""
        if self._refinable is None:
            return 0.0
        self._work.array_w[:] = np.abs(x.array_r)
        total = 0.0
        for load, slope in zip(self._loads, self._slopes, strict=True):
            size = slope.copy()
            size.abs()
            total += float(load.norm() * size.dot(self._work))
            size.destroy()
        return total
