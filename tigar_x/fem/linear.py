"""Linear solvers: a recipe bound to a matrix. The recipes come from :mod:`tigar_x.fem.recipes`."""

import itertools
import logging
import math
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cached_property
from typing import Any

from petsc4py import PETSc

from tigar_x import compat
from tigar_x.fem.carried import Carried, Rows
from tigar_x.fem.keeping import Keeping, part_of
from tigar_x.fem.nodes import RowNodes
from tigar_x.fem.own_ksp import check_ranks, hand_over, tolerances_kept
from tigar_x.fem.petsc_options import chosen, of_one_rank
from tigar_x.fem.recipes import (
    LARGE,
    MEDIUM,
    SMALL,
    LinearSolver,
    SolveError,
    automatic,
    direct,
    gmres_ilu,
    gmres_sor,
    multigrid,
    two_level,
)
from tigar_x.fem.two_level import TwoLevel

__all__ = [
    "LARGE",
    "MEDIUM",
    "SMALL",
    "LinearSolver",
    "PreparedSolver",
    "SolveError",
    "automatic",
    "chosen",
    "direct",
    "gmres_ilu",
    "gmres_sor",
    "keep_orthogonal",
    "multigrid",
    "two_level",
]

log = logging.getLogger(__name__)
_prefixes = itertools.count()


def keep_orthogonal(ksp: PETSc.KSP) -> None:
    """Let a GMRES that nothing else configures orthogonalise by the modified method, as those of recipes do.

    The classical one, PETSc's default, loses orthogonality where the residual stays for many iterations, and then it
    stays for good.

    Args:
        ksp: the solver, whose method and preconditioner have been set.
    """
    prefix, table = f"tigar_x_{next(_prefixes)}_", PETSc.Options()
    key = prefix + "ksp_gmres_modifiedgramschmidt"
    table[key] = 1
    try:
        ksp.setOptionsPrefix(prefix)
        ksp.setFromOptions()
    finally:
        table.delValue(key)


class PreparedSolver:
    """A recipe bound to one matrix, with its factors or preconditioner kept as long as they serve.

    Args:
        recipe: what to do.
        A: the matrix; its values may change between solves, its pattern may not.
        nodes: of its rows; None: nothing is known of them.
        keeping: what is known of preconditioners of other matrices of the same system; None: nothing.

    Raises:
        ValueError: the recipe's own KSP lives on other ranks than the matrix, or a coarse level lacks nodes or blocks.
    """

    def __init__(
        self, recipe: LinearSolver, A: PETSc.Mat, nodes: RowNodes | None = None, keeping: Keeping | None = None
    ) -> None:
        self.recipe = recipe
        self._keeping = keeping or recipe.keeping()
        self._nodes = nodes
        if recipe.aggregates is not None and (nodes is None or "baij" not in A.getType()):
            raise ValueError(
                f"solver = {recipe.name}: a system whose components all live at the same nodes, with a matrix of type"
                " baij, is required for its coarse level"
            )
        self._A = A
        options = dict(recipe.options)
        # with the user's prefix PETSc finds what the user has given by itself, and knows that it was used
        self._prefix = (recipe.prefix or "") if recipe.overrides else f"tigar_x_{next(_prefixes)}_"
        if A.comm.size == 1:
            options = of_one_rank(options, recipe.overrides)
        for key in set(recipe.overrides) - {*options, "mat_type"}:  # taken by another name: PETSc would call it unused
            PETSc.Options(self._prefix).getString(key, "")
        self._options = {self._prefix + key: value for key, value in options.items() if key not in recipe.overrides}
        if recipe.ksp is not None:
            check_ranks(recipe, A)
        self._has = False  # a preconditioner that is kept
        self._former: tuple[PreparedSolver, Carried] | None = None
        self._fallback: PreparedSolver | None = None
        self._residual: PETSc.Vec | None = None
        self._copy: PETSc.Vec | None = None
        self._converted: PETSc.Mat | None = None
        self._converted_state = -1
        self._tolerances: tuple[float, float] | None = None  # of a KSP that a callable has configured

    @contextmanager
    def _table_of_options(self) -> Iterator[None]:
        """The recipe's options in PETSc's table, which is finite.

        Subdomain solvers read theirs in the first solve, multigrid whenever the matrix has changed.
        """
        table = PETSc.Options()
        try:
            for key, value in self._options.items():
                table[key] = value
            yield
        finally:
            for key in self._options:
                table.delValue(key)

    @cached_property
    def _ksp(self) -> PETSc.KSP:
        if self.recipe.ksp is not None:
            return self.recipe.ksp
        ksp = PETSc.KSP().create(self._A.comm)
        compat.freed_with(self, ksp)
        ksp.setOptionsPrefix(self._prefix)
        ksp.setOperators(self._operator())
        with self._table_of_options():
            ksp.setFromOptions()
        context: Carried | TwoLevel | None = None if self._former is None else self._former[1]
        if context is None and self.recipe.aggregates is not None and self._nodes is not None:
            context = TwoLevel(self._nodes, self._prefix, size=self.recipe.aggregates, repair=self.recipe.repair)
        if context is not None:
            pc = ksp.getPC()
            pc.setType("python")
            pc.setPythonContext(context)
        if self.recipe.configure is not None:
            self.recipe.configure(ksp)
            if self.recipe.overrides:
                ksp.setFromOptions()
            self._tolerances = ksp.getTolerances()[:2]
        return ksp

    @cached_property
    def _pc(self) -> PETSc.PC:
        """For those who keep it: it goes with this object, and its factors with it."""
        pc = self._ksp.getPC()
        compat.freed_with(self, pc)
        return pc

    @property
    def rtol(self) -> float:
        """Reduction of the residual's norm at which it stops; 0 for a factorisation."""
        return self.recipe.rtol if self._tolerances is None else self._tolerances[0]

    def _operator(self) -> PETSc.Mat:
        """The matrix, in the type that the recipe wants: a fallback may want another one than the first recipe."""
        if self.recipe.matrix != "aij" or "baij" not in self._A.getType():
            return self._A
        state = self._A.stateGet()
        if self._converted is None:
            self._converted = PETSc.Mat()
            self._A.convert("aij", self._converted)
            compat.freed_with(self, self._converted)
            null = self._A.getNullSpace()
            if null.handle:
                self._converted.setNullSpace(null)
        elif state != self._converted_state:
            self._A.convert("aij", self._converted)
        self._converted_state = state
        return self._converted

    def _attempt(self, b: PETSc.Vec, x: PETSc.Vec, reference: float | None, keep: bool) -> tuple[str, int]:
        """Why the recipe failed (empty: it did not), and its iterations."""
        # a solve that PETSc breaks off leaves its right-hand side locked, so it gets a copy
        if self._copy is None:
            self._copy = b.duplicate()
            compat.freed_with(self, self._copy)
        b.copy(self._copy)
        try:
            ksp, operator = self._ksp, self._operator()
            if self.recipe.ksp is not None:
                hand_over(ksp, operator)
            with self._table_of_options(), tolerances_kept(ksp):
                self._set_tolerances(reference)
                if self.recipe.ksp is None or self.recipe.rebuild_growth is not None:
                    ksp.getPC().setReusePreconditioner(keep and self._former is None)  # which follows the diagonal
                ksp.solve(self._copy, x)
        except PETSc.Error as error:
            self._copy = None
            return f"PETSc: {error}", 0
        iterations, reason = int(self._ksp.getIterationNumber()), int(self._ksp.getConvergedReason())
        if reason <= 0:
            singular = "the matrix is singular or not finite, " if self.recipe.is_direct else ""
            return f"{singular}PETSc reason {reason}", iterations
        if not math.isfinite(x.norm()):
            return "the solution is not finite", iterations
        if self._ksp.getNormType() == PETSc.KSP.NormType.NONE:  # it has looked at no residual
            accepted = 0.1 if self.recipe.is_direct else self.rtol
            if not self._solves(
                b, x, accepted * (b.norm() if reference is None or self.recipe.is_direct else reference)
            ):
                return "the matrix is singular" if self.recipe.is_direct else "its residual is too large", iterations
        return "", iterations

    def _set_tolerances(self, reference: float | None) -> None:
        if self.recipe.is_direct:
            return
        smallest = float(self.recipe.options.get("ksp_atol", 1e-300))
        rtol, smallest = (self.recipe.rtol, smallest) if self._tolerances is None else self._tolerances
        if reference is None:
            self._ksp.setTolerances(rtol=rtol, atol=smallest)
        else:
            self._ksp.setTolerances(rtol=0.0, atol=max(rtol * reference, smallest))

    def _discard(self) -> None:
        """A factorisation that has failed once is not made again by PETSc, whatever becomes of the matrix."""
        if self.recipe.ksp is not None:
            self.recipe.ksp.reset()
        elif "_ksp" in vars(self):
            self._ksp.destroy()
            del self._ksp
        if "_pc" in vars(self):
            self._pc.destroy()
            del self._pc

    def _solves(self, b: PETSc.Vec, x: PETSc.Vec, accepted: float) -> bool:
        """Whether the residual's norm is acceptable; with factors of a singular matrix it may not even fall."""
        if self._residual is None:
            self._residual = b.duplicate()
            compat.freed_with(self, self._residual)
        self._A.mult(x, self._residual)
        self._residual.axpy(-1.0, b)
        return bool(self._residual.norm() <= accepted)

    def destroy(self) -> None:
        """Free the factors, which petsc4py would keep (collective); the object is of no use afterwards."""
        self._has = False
        self._discard()
        if self._fallback is not None:
            self._fallback.destroy()
        for thing in (self._residual, self._copy, self._converted):
            if thing is not None:
                thing.destroy()

    def preconditioner(self) -> PETSc.PC:
        """The recipe's preconditioner, or its factors, without its fallbacks (collective).

        It is that of the matrix as it is, or a former one while the recipe's ``rebuild_growth`` lets that serve.

        Raises:
            SolveError: PETSc could not make it.
        """
        try:
            ksp, operator = self._ksp, self._operator()
            if self.recipe.ksp is not None:
                hand_over(ksp, operator)
            with self._table_of_options():
                if self.recipe.ksp is None or self.recipe.rebuild_growth is not None:
                    self._pc.setReusePreconditioner(self.keeps and self._former is None)
                self._pc.setUp()
                self._pc.setUpOnBlocks()
        except PETSc.Error as error:
            self._discard()
            self.served(math.inf)
            raise SolveError(f"{self.recipe.name}: no preconditioner (PETSc: {error})") from None
        return self._pc

    @property
    def keeps(self) -> bool:
        """Whether a preconditioner is kept that has been made for a former matrix."""
        return self._has

    @property
    def can_be_carried(self) -> bool:
        """Whether it has a preconditioner of its own that may serve another matrix, see :meth:`carry`."""
        own = self.recipe.ksp is None and self.recipe.configure is None and self._former is None
        return own and self.keeps and not self.recipe.is_direct

    def carry(self, former: "PreparedSolver", owner: Any, was: Rows, now: Rows) -> None:
        """Begin with the preconditioner of another matrix, which is kept like one's own.

        Args:
            former: whose it is, with the same recipe; its :attr:`can_be_carried` holds.
            owner: of that matrix.
            was: rows of that matrix.
            now: rows of this one.
        """
        self._former = former, Carried(former._pc, owner, was, now)
        self._has = former._has

    def again(self) -> "PreparedSolver":
        """Another one for the same matrix."""
        return PreparedSolver(self.recipe, self._A, self._nodes, self._keeping)

    def served(self, iterations: float) -> None:
        """Take note of the iterations of a solve with :meth:`preconditioner`, infinitely many if it failed."""
        if self._keeping is None:
            return
        had, failed, keeping = self._has, math.isinf(iterations), self._keeping
        matrix = self._A.handle, self._A.stateGet()
        self._has = keeping.served(iterations, matrix) if had else not failed and keeping.made(iterations, matrix)
        if had and not self._has and self._former is not None:
            former = self._former[0]
            self._discard()
            self._former = None
            former.destroy()  # before the new one needs memory

    def solve(self, b: PETSc.Vec, x: PETSc.Vec, reference: float | None = None) -> int:
        """Solve ``A x = b``.

        Args:
            b: right-hand side, finite.
            x: overwritten by the solution.
            reference: norm that the recipe's relative tolerance refers to; None: that of ``b``.

        Returns:
            Number of iterations (1 for a direct solver).

        Raises:
            SolveError: neither the recipe nor its fallbacks gave a finite solution to the tolerance.
        """
        keep = self.keeps
        cause, iterations = self._attempt(b, x, reference, keep)
        taken = iterations if reference is None else iterations * part_of(self.rtol, reference / max(b.norm(), 1e-300))
        self.served(math.inf if cause else taken)
        if keep and cause:
            return self.solve(b, x, reference)
        if not cause:
            return max(iterations, 1)
        self._discard()
        if self.recipe.fallback is None:
            raise SolveError(f"{self.recipe.name} failed after {iterations} iterations ({cause})")
        log.warning("%s failed (%s); using %s", self.recipe.name, cause, self.recipe.fallback.name)
        if self._fallback is None:
            self._fallback = PreparedSolver(self.recipe.fallback, self._A, self._nodes)
        return iterations + self._fallback.solve(b, x, reference)
