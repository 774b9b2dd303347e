"""Linear solvers: named recipes, and a recipe bound to a matrix."""

import itertools
import logging
import math
import weakref
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

from petsc4py import PETSc

from tigar_x import checks, compat

log = logging.getLogger(__name__)
_prefixes = itertools.count()

SMALL = 1000
"""Unknowns below which a direct solver costs next to nothing, whatever the matrix."""
MEDIUM = 30_000
"""Unknowns of a stabilised flow in the plane from which on MUMPS takes less time than GMRES with ILU(1)."""
LARGE = {2: 1_000_000, 3: 1_500_000}
"""Unknowns of a stabilised flow from which on multigrid takes no more time, and half the memory, by dimension."""


class SolveError(RuntimeError):
    """A linear or nonlinear solve that gave no usable answer."""


@dataclass(frozen=True)
class LinearSolver:
    """A named recipe for ``A x = b``.

    Attributes:
        name: what messages and reports call it.
        options: PETSc options of the KSP, without prefix.
        matrix: PETSc matrix type that the recipe wants for node-blocked systems, "aij" or "baij".
        rebuild_growth: keep a preconditioner while iterations stay below this factor times those after it was built;
            None: rebuild it whenever the matrix changed.
        fallback: recipe to use when this one fails; None: fail.
    """

    name: str
    options: Mapping[str, str | int | float] = field(hash=False)
    matrix: str = "aij"
    rebuild_growth: float | None = None
    fallback: "LinearSolver | None" = None

    @property
    def is_direct(self) -> bool:
        """Whether it is a factorisation, without a tolerance."""
        return "ksp_rtol" not in self.options


def direct(package: str = "mumps") -> LinearSolver:
    """Sparse LU factorisation.

    Args:
        package: PETSc factorisation package, "mumps" (any number of ranks) or "petsc" (one rank, small systems).

    Returns:
        The recipe.
    """
    options: dict[str, str | int | float] = {"ksp_type": "preonly", "pc_type": "lu"}
    options["pc_factor_mat_solver_type"] = package
    return LinearSolver(f"direct({package})", options)


def gmres_ilu(
    levels: int = 1,
    *,
    rtol: float = 1e-8,
    max_iterations: int = 200,
    overlap: int = 2,
    rebuild_growth: float | None = None,
    fallback: LinearSolver | None = None,
) -> LinearSolver:
    """Right-preconditioned GMRES with node-blocked incomplete LU in reverse Cuthill-McKee order.

    On several ranks the factorisation is the subdomain solver of an overlapping additive Schwarz method.

    Args:
        levels: levels of fill.
        rtol: reduction of the true residual's norm.
        max_iterations: iterations after which the solve has failed; GMRES is not restarted before.
        overlap: overlap of the Schwarz subdomains; 2 halves the iterations of 1 in the plane, and is no worse in space.
        rebuild_growth: see :class:`LinearSolver`.
        fallback: recipe to use when GMRES fails; None: :func:`gmres_sor`, and MUMPS after that.

    Returns:
        The recipe.

    Raises:
        ValueError: a number is out of range.
    """
    ilu: dict[str, str | int] = {
        "pc_type": "ilu",
        "pc_factor_levels": checks.whole("levels", levels, 0),
        "pc_factor_mat_ordering_type": "rcm",
    }
    options = _gmres(rtol, max_iterations)
    options |= {"pc_type": "asm", "pc_asm_overlap": checks.whole("overlap", overlap, 0)}
    options |= {f"sub_{key}": value for key, value in ilu.items()}
    next_one = gmres_sor(rtol=rtol) if fallback is None else fallback
    return LinearSolver(f"gmres_ilu({levels})", options, "baij", rebuild_growth, next_one)


def _gmres(rtol: float, max_iterations: int) -> dict[str, str | int | float]:
    return {
        "ksp_type": "gmres",
        "ksp_pc_side": "right",
        "ksp_norm_type": "unpreconditioned",
        "ksp_rtol": checks.positive("rtol", rtol),
        "ksp_max_it": checks.whole("max_iterations", max_iterations, 1),
        "ksp_gmres_restart": max_iterations,
        # the classical method, PETSc's default, loses orthogonality after about a hundred iterations
        "ksp_gmres_modifiedgramschmidt": 1,
    }


def gmres_sor(*, rtol: float = 1e-8, max_iterations: int = 100, fallback: LinearSolver | None = None) -> LinearSolver:
    """Right-preconditioned GMRES with node-blocked symmetric successive over-relaxation: no set-up, little memory.

    Args:
        rtol: reduction of the true residual's norm.
        max_iterations: iterations after which the solve has failed.
        fallback: recipe to use when GMRES fails; None: MUMPS.

    Returns:
        The recipe.

    Raises:
        ValueError: a number is out of range.
    """
    options = _gmres(rtol, max_iterations) | {"pc_type": "sor"}
    return LinearSolver("gmres_sor", options, "baij", None, direct() if fallback is None else fallback)


def multigrid(*, rtol: float = 1e-8, max_iterations: int = 200, fallback: LinearSolver | None = None) -> LinearSolver:
    """Flexible GMRES with algebraic multigrid of smoothed aggregation on whole nodes (PETSc's GAMG).

    Two steps of GMRES with incomplete LU smooth the levels, one block a rank; MUMPS solves the coarsest. Iterations
    grow slowly with the number of unknowns, and so does memory; the set-up costs as much as ten iterations of others.

    Args:
        rtol: reduction of the true residual's norm.
        max_iterations: iterations after which the solve has failed; GMRES is not restarted before.
        fallback: recipe to use when it fails; None: MUMPS.

    Returns:
        The recipe.

    Raises:
        ValueError: a number is out of range.
    """
    options = _gmres(rtol, max_iterations) | {
        "ksp_type": "fgmres",
        "pc_type": "gamg",
        "pc_gamg_agg_nsmooths": 1,
        "pc_gamg_threshold": 0.0,
        "pc_gamg_aggressive_coarsening": 1,
        "pc_gamg_coarse_eq_limit": 20_000,
        "mg_levels_ksp_type": "gmres",
        "mg_levels_ksp_max_it": 2,
        "mg_levels_pc_type": "bjacobi",
        "mg_levels_sub_pc_type": "ilu",
        "mg_levels_sub_pc_factor_levels": 1,
        "mg_levels_sub_pc_factor_mat_ordering_type": "rcm",
        "mg_coarse_pc_type": "lu",
        "mg_coarse_pc_factor_mat_solver_type": "mumps",
    }
    return LinearSolver("multigrid", options, "aij", None, direct() if fallback is None else fallback)


def automatic(
    unknowns: int, *, blocked: bool, dimension: int | None = None, kept: bool = False, rtol: float = 1e-8
) -> LinearSolver:
    """Recipe by size and layout: MUMPS for small or mixed systems, GMRES with block ILU(1) for others.

    In the plane MUMPS is faster than GMRES with ILU from ``MEDIUM`` unknowns on, or from the start where factors are
    kept from step to step; beyond ``LARGE`` multigrid takes less time or memory. An immersed surface makes the system
    of a flow another one: its dimension is then not given.

    Args:
        unknowns: global number of unknowns.
        blocked: whether all components live at the same nodes, as in a stabilised equal-order flow; a mixed system may
            have zeros on its diagonal, which incomplete factors do not bear.
        dimension: of space, for a flow without an immersed surface; None: another system.
        kept: whether the matrix and its factors serve several steps.
        rtol: of iterative solvers.

    Returns:
        The recipe.
    """
    size = checks.whole("unknowns", unknowns, 1)
    if not blocked or size < SMALL:
        return direct()
    if dimension is not None and size >= LARGE[dimension]:
        return multigrid(rtol=rtol)
    if dimension == 2 and (kept or size >= MEDIUM):
        return direct()
    return gmres_ilu(1, rtol=rtol, fallback=multigrid(rtol=rtol) if dimension == 3 else None)


def _delete_options(names: list[str]) -> None:
    options = PETSc.Options()
    for name in names:
        options.delValue(name)


class PreparedSolver:
    """A recipe bound to one matrix, with its factors or preconditioner kept as long as they serve.

    Args:
        recipe: what to do.
        A: the matrix; its values may change between solves, its pattern may not.
    """

    def __init__(self, recipe: LinearSolver, A: PETSc.Mat) -> None:
        self.recipe = recipe
        self._A = A
        self._pending_options: list[str] = []
        self._direct = recipe.is_direct
        self._kept_iterations: int | None = None
        self._fallback: PreparedSolver | None = None
        self._residual: PETSc.Vec | None = None
        self._copy: PETSc.Vec | None = None

    @cached_property
    def _ksp(self) -> PETSc.KSP:
        """Made for the first solve, because PETSc's table of options is finite and is cleared after it."""
        recipe, A = self.recipe, self._A
        ksp = PETSc.KSP().create(A.comm)
        ksp.setOperators(A)
        prefix = f"tigar_x_{next(_prefixes)}_"
        ksp.setOptionsPrefix(prefix)
        options = PETSc.Options()
        chosen = dict(recipe.options)
        if A.comm.size == 1 and chosen.get("pc_type") == "asm":
            chosen["pc_type"] = "ilu"
            chosen.update({key.removeprefix("sub_"): value for key, value in chosen.items() if key.startswith("sub_")})
            chosen = {k: v for k, v in chosen.items() if not k.startswith(("sub_", "pc_asm"))}
        for key, value in chosen.items():
            options[prefix + key] = value
        ksp.setFromOptions()
        self._pending_options = [prefix + key for key in chosen]
        if chosen.get("pc_type") == "gamg":  # reads them again whenever the matrix has changed
            weakref.finalize(self, _delete_options, self._pending_options).atexit = False
            self._pending_options = []
        compat.freed_with(self, ksp)
        return ksp

    def _clear_options(self) -> None:
        """PETSc's table of options is finite, and subdomain solvers read theirs in the first solve."""
        _delete_options(self._pending_options)
        self._pending_options = []

    def _attempt(self, b: PETSc.Vec, x: PETSc.Vec) -> bool:
        # a solve that PETSc breaks off leaves its right-hand side locked, so it gets a copy
        if self._copy is None:
            self._copy = b.duplicate()
            compat.freed_with(self, self._copy)
        b.copy(self._copy)
        try:
            self._ksp.solve(self._copy, x)
        except PETSc.Error as error:
            log.warning("%s failed: %s", self.recipe.name, error)
            self._copy = None
            return False
        finally:
            self._clear_options()
        if self._ksp.getConvergedReason() <= 0 or not math.isfinite(x.norm()):
            return False
        return not self._direct or self._solves(b, x)

    def _discard(self) -> None:
        """A factorisation that has failed once is not made again by PETSc, whatever becomes of the matrix."""
        self._ksp.destroy()
        del self._ksp

    def _solves(self, b: PETSc.Vec, x: PETSc.Vec) -> bool:
        """Whether a factorisation has reduced the residual at all; that of a singular matrix may not."""
        if self._residual is None:
            self._residual = b.duplicate()
        self._A.mult(x, self._residual)
        self._residual.axpy(-1.0, b)
        return bool(self._residual.norm() <= 0.1 * b.norm())

    def destroy(self) -> None:
        """Free the factors, which petsc4py would keep (collective); the object is of no use afterwards."""
        if "_ksp" in vars(self):
            self._ksp.destroy()
        if self._fallback is not None:
            self._fallback.destroy()
        for vector in (self._residual, self._copy):
            if vector is not None:
                vector.destroy()

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
        if not self._direct:
            rtol = float(self.recipe.options["ksp_rtol"])
            self._ksp.setTolerances(
                rtol=rtol if reference is None else 0.0, atol=1e-300 if reference is None else rtol * reference
            )
        pc = self._ksp.getPC()
        keep = self.recipe.rebuild_growth is not None and self._kept_iterations is not None
        pc.setReusePreconditioner(keep)
        solved = self._attempt(b, x)
        iterations = int(self._ksp.getIterationNumber())
        growth = self.recipe.rebuild_growth
        if keep and growth is not None and (not solved or iterations > growth * (self._kept_iterations or 0) + 2):
            self._kept_iterations = None
            if not solved:
                return self.solve(b, x, reference)
        elif not keep:
            self._kept_iterations = iterations
        if solved:
            return max(iterations, 1)
        reason, self._kept_iterations = self._ksp.getConvergedReason(), None
        self._discard()
        if self.recipe.fallback is None:
            what = "the matrix is singular or not finite" if self._direct else f"PETSc reason {reason}"
            raise SolveError(f"{self.recipe.name} failed after {iterations} iterations ({what})")
        log.warning("%s failed (PETSc reason %d); using %s", self.recipe.name, reason, self.recipe.fallback.name)
        if self._fallback is None:
            self._fallback = PreparedSolver(self.recipe.fallback, self._A)
        return iterations + self._fallback.solve(b, x, reference)
