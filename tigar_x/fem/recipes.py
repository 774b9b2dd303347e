"""Named recipes for linear systems; :mod:`tigar_x.fem.linear` binds one to a matrix."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

from petsc4py import PETSc

from tigar_x import checks
from tigar_x.fem.keeping import Keeping

DEFAULT_RTOL = 1e-5
"""PETSc's tolerance where a recipe has none."""
SMALL = 1000
"""Unknowns below which a direct solver costs next to nothing, whatever the matrix."""
MEDIUM = 30_000
"""Unknowns of a stabilised flow in the plane from which on MUMPS takes less time than GMRES with ILU(1)."""
LARGE = {2: 1_000_000, 3: 1_500_000}
"""Unknowns of a stabilised flow from which on multigrid takes no more time, and half the memory, by dimension."""
IMMERSED = {2: 100_000, 3: 20_000}
"""Unknowns of a stabilised flow around an immersed surface from which on ILU(1) takes less time after a coarse level,
by dimension."""
REPAIR = 3.0
"""Factor of weak couplings of pressures in the matrix that the smoother is made for; with 10, which needs as many
iterations, a residual of the same size leaves ten times the error of these pressures."""

SET_UP = {0: 9.0, 1: 14.0, 2: 28.0}
"""Iterations that cost as much as new incomplete factors with or without a coarse level, by levels of fill."""


class SolveError(RuntimeError):
    """A linear or nonlinear solve that gave no usable answer."""


@dataclass(frozen=True)
class LinearSolver:
    """A named recipe for ``A x = b``.

    Attributes:
        name: what messages and reports call it.
        options: PETSc options of the KSP, without prefix. What is not given is PETSc's default. The norm that is tested
            is the method's own; the recipes below test that of the true residual.
        matrix: PETSc matrix type that the recipe wants for node-blocked systems, "aij" or "baij".
        rebuild_growth: keep a preconditioner while iterations stay below this factor times those after it was built;
            ``math.inf``: as long as that pays, see :mod:`tigar_x.fem.keeping`; None: rebuild it whenever the matrix
            changed.
        fallback: recipe to use when this one fails; None: fail.
        aggregates: nodes of an aggregate of the coarse level that goes before the preconditioner which the options
            describe, see :mod:`tigar_x.fem.two_level`; 0: by number of nodes; None: there is no coarse level.
        prefix: of the PETSc options that go before ``options``, with its underscore, as "valve_"; None: that of the
            system which it solves, see :mod:`tigar_x.fem.petsc_options`.
        configure: called with the KSP once ``options`` are set, for what no option can say. A tolerance that it sets
            is kept. What is a factorisation has to be one by ``options``.
        ksp: a KSP of one's own, as it is: no options are set, those of the command line neither. ``options`` says what
            it was when the recipe was made. It gets the matrix, and for the time of a solve the tolerance that belongs
            to it; it is never destroyed here.
        overrides: what :func:`tigar_x.fem.petsc_options.chosen` has found under the prefix, already in ``options``.
    """

    name: str
    options: Mapping[str, str | int | float] = field(hash=False)
    matrix: str = "aij"
    rebuild_growth: float | None = None
    fallback: "LinearSolver | None" = None
    aggregates: int | None = None
    prefix: str | None = None
    configure: Callable[[PETSc.KSP], None] | None = None
    ksp: PETSc.KSP | None = field(default=None, hash=False)
    overrides: Mapping[str, str] = field(default_factory=dict, hash=False, repr=False)

    def __post_init__(self) -> None:
        if self.ksp is None:
            return
        if self.configure is not None:
            raise ValueError(f"{self.name}: ksp and configure are given, one of them is required: configure the KSP")
        rtol, atol, *_ = self.ksp.getTolerances()
        found = {"ksp_type": self.ksp.getType(), "pc_type": self.ksp.getPC().getType()}
        known = {key: value for key, value in found.items() if value is not None}
        object.__setattr__(self, "options", {"ksp_rtol": rtol, "ksp_atol": atol, **known, **self.options})

    @property
    def is_direct(self) -> bool:
        """Whether it is a factorisation that is applied once, without a tolerance."""
        return self.options.get("ksp_type") == "preonly" and self.options.get("pc_type") in ("lu", "cholesky")

    @property
    def needs_nodes(self) -> bool:
        """Whether it, or a fallback, has to know the nodes of the system."""
        return self.aggregates is not None or (self.fallback is not None and self.fallback.needs_nodes)

    @property
    def repair(self) -> float:
        """Factor of weak couplings of pressures in the matrix that the smoother of two levels is made for.

        Two levels of fill need none, and leave a tenth of the error of these pressures at the same residual then.
        """
        return REPAIR if self._fill < 2 else 1.0

    @property
    def _fill(self) -> int:
        """Levels of fill of incomplete factors."""
        return int(self.options.get("pc_factor_levels", self.options.get("sub_pc_factor_levels", 0)))

    def keeping(self) -> Keeping | None:
        """Whether and how long preconditioners are kept; None: they are made anew whenever the matrix changed."""
        if self.rebuild_growth is None:
            return None
        return Keeping(self.rebuild_growth, SET_UP[min(self._fill, max(SET_UP))])

    @property
    def rtol(self) -> float:
        """Reduction of the residual's norm at which it stops; 0 for a factorisation."""
        return 0.0 if self.is_direct else float(self.options.get("ksp_rtol", DEFAULT_RTOL))


def direct(package: str = "mumps") -> LinearSolver:
    """Sparse LU factorisation.

    Args:
        package: PETSc factorisation package: "mumps" (any number of ranks; on several it adds up what arrives first, so
            that two runs differ in the last digits), "superlu_dist" (the same digits in every run) or "petsc" (one
            rank, small systems).

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


def two_level(
    levels: int = 1,
    *,
    rtol: float = 1e-8,
    max_iterations: int = 200,
    overlap: int = 2,
    aggregates: int = 0,
    rebuild_growth: float | None = None,
    fallback: LinearSolver | None = None,
) -> LinearSolver:
    """Flexible GMRES with a coarse level and :func:`gmres_ilu`'s preconditioner after it.

    Its iterations hardly grow with the number of ranks or of unknowns, see :mod:`tigar_x.fem.two_level`. The flexible
    method keeps what the preconditioner gave, and saves its last application.

    Args:
        levels: levels of fill.
        rtol: reduction of the true residual's norm.
        max_iterations: iterations after which the solve has failed; GMRES is not restarted before.
        overlap: overlap of the Schwarz subdomains.
        aggregates: nodes of an aggregate; 0: by number of nodes.
        rebuild_growth: see :class:`LinearSolver`.
        fallback: recipe to use when GMRES fails; None: MUMPS.

    Returns:
        The recipe.

    Raises:
        ValueError: a number is out of range.
    """
    one = gmres_ilu(levels, rtol=rtol, max_iterations=max_iterations, overlap=overlap, rebuild_growth=rebuild_growth)
    size, last = checks.whole("aggregates", aggregates, 0), direct() if fallback is None else fallback
    options = {**one.options, "ksp_type": "fgmres"}
    return replace(one, name=f"two_level({levels})", options=options, aggregates=size, fallback=last)


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


def multigrid(
    *, rtol: float = 1e-8, max_iterations: int = 200, aggressive: int = 1, fallback: LinearSolver | None = None
) -> LinearSolver:
    """Flexible GMRES with algebraic multigrid of smoothed aggregation on whole nodes (PETSc's GAMG).

    Two steps of GMRES with incomplete LU smooth the levels, one overlapping block a rank; MUMPS solves the coarsest,
    whose null space it detects: that of the pressure in an enclosed flow is in all levels, and its last pivot is
    rounding.
    Iterations grow slowly with the number of unknowns, and so does memory; the set-up costs as much as ten iterations
    of others.

    Args:
        rtol: reduction of the true residual's norm.
        max_iterations: iterations after which the solve has failed; GMRES is not restarted before.
        aggressive: levels whose aggregates reach two nodes far. Without any, iterations in the plane do not depend on
            how the mesh is cut into the parts of ranks; each costs more.
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
        "pc_gamg_aggressive_coarsening": checks.whole("aggressive", aggressive, 0),
        "pc_gamg_coarse_eq_limit": 20_000,
        "mg_levels_ksp_type": "gmres",
        "mg_levels_ksp_max_it": 2,
        "mg_levels_pc_type": "asm",
        "mg_levels_pc_asm_overlap": 2,
        "mg_levels_sub_pc_type": "ilu",
        "mg_levels_sub_pc_factor_levels": 1,
        "mg_levels_sub_pc_factor_mat_ordering_type": "rcm",
        "mg_coarse_pc_type": "lu",
        "mg_coarse_pc_factor_mat_solver_type": "mumps",
        "mg_coarse_mat_mumps_icntl_24": 1,
        "mg_coarse_mat_mumps_cntl_3": 1e-9,
    }
    return LinearSolver("multigrid", options, "aij", None, direct() if fallback is None else fallback)


def automatic(
    unknowns: int,
    *,
    blocked: bool,
    dimension: int | None = None,
    immersed: int | None = None,
    kept: bool = False,
    rtol: float = 1e-8,
    ranks: int = 1,
) -> LinearSolver:
    """Recipe by size, layout and ranks: MUMPS for small or mixed systems, GMRES with block ILU(1) for others.

    In the plane MUMPS is faster than GMRES with ILU from ``MEDIUM`` unknowns on, or from the start where factors are
    kept from step to step; beyond ``LARGE`` multigrid takes less time or memory. An immersed surface makes the system
    of a flow another one: from ``IMMERSED`` unknowns on a coarse level goes before ILU(1).

    Args:
        unknowns: global number of unknowns.
        blocked: whether all components live at the same nodes, as in a stabilised equal-order flow; a mixed system may
            have zeros on its diagonal, which incomplete factors do not bear.
        dimension: of space, for a flow without an immersed surface; None: another system.
        immersed: dimension of space, for a flow around an immersed surface; None: another system.
        kept: whether the matrix and its factors serve several steps.
        rtol: of iterative solvers.
        ranks: of the system; in the plane multigrid has no aggressive coarsening on several.

    Returns:
        The recipe.
    """
    size = checks.whole("unknowns", unknowns, 1)
    if not blocked or size < SMALL:
        return direct()
    if dimension is not None and size >= LARGE[dimension]:
        return multigrid(rtol=rtol, aggressive=int(dimension == 3 or ranks == 1))
    if dimension == 2 and (kept or size >= MEDIUM):
        return direct()
    if immersed is not None and size >= IMMERSED[immersed]:
        return two_level(1, rtol=rtol)
    return gmres_ilu(1, rtol=rtol, fallback=multigrid(rtol=rtol) if dimension == 3 else None)
