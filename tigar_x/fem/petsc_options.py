"""Options of PETSc's table, which go before those of a recipe; solvers that users bring themselves.

Every system has a prefix, as solvers have in PETSc: ``-fluid_ksp_rtol 1e-10 -shell_pc_type cholesky``. The table gets
options from a script's command line (:func:`tigar_x.run.script.command_line`), from the environment's PETSC_OPTIONS,
from ``~/.petscrc``, and from ``PETSc.Options()["fluid_ksp_rtol"] = 1e-10`` before the system is made.

They change the recipe that would have been used, whose fallbacks stay as they are:

- With another ``pc_type``, nothing of the recipe's preconditioner is left.
- With another ``ksp_type``, the norm of the true residual is tested as before, where the method knows it.
- In place of a factorisation, an iterative solver reduces the residual by ``RTOL`` unless ``ksp_rtol`` says otherwise.
- ``mat_type`` is "aij" or "baij", the latter for systems whose components all live at the same nodes.
"""

import logging
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from petsc4py import PETSc

from tigar_x import checks
from tigar_x.fem.recipes import LinearSolver

PREFIXES = {
    "": "systems made by hand",
    "fluid_": "flows",
    "shell_": "shells",
    "mesh_": "meshes that move as elastic solids",
    "projection_": "projections onto finite element spaces",
}
"""Prefixes of the options of solvers, and which they are."""
RTOL = 1e-8
"""Reduction of the residual by an iterative solver in place of a factorisation."""

_GROUPS = ("ksp", "pc", "sub", "mg", "mat", "fieldsplit")  # of one solver
_OTHERS = ("eps", "st")  # of SLEPc, by its own names
_OF_PRECONDITIONER = ("pc_", "sub_", "mg_", "mat_", "fieldsplit_")
_ON_BLOCKS = ("ilu", "sor", "asm", "bjacobi", "jacobi", "pbjacobi", "none")
_WITHOUT_TRUE_NORM = ("minres", "symmlq", "pipelcg", "qcg", "pipecr")

log = logging.getLogger(__name__)


def chosen(solver: Any, default: LinearSolver, prefix: str) -> LinearSolver:
    """The recipe of a system: the user's, or the default, as the options of PETSc's table change it.

    Args:
        solver: a recipe, a KSP or None.
        default: recipe in place of None.
        prefix: of the system's options, unless the recipe has its own.

    Returns:
        The recipe. One that comes from here already is returned as it is.

    Raises:
        ValueError: the solver is nothing of that, or an option has a value that it cannot have.
    """
    recipe = default if solver is None else as_recipe("solver", solver)
    prefix = prefix if recipe.prefix is None else recipe.prefix
    given = {} if recipe.ksp is not None else _given(prefix)
    if recipe.overrides or not given:
        return recipe
    shown = " ".join(f"-{prefix}{key}{'' if value is None else f' {value}'}" for key, value in given.items())
    changed = replace(_changed(recipe, given, prefix), name=f"{recipe.name} with {shown}", prefix=prefix)
    log.info("%s: PETSc's options %s go first", recipe.name, shown)
    return changed


def as_recipe(name: str, solver: Any) -> LinearSolver:
    """A recipe of a recipe or a KSP.

    Args:
        name: what messages call it.
        solver: the recipe or KSP.

    Returns:
        The recipe; that of a KSP has the KSP's prefix as its name, if it has one.

    Raises:
        ValueError: it is neither.
    """
    if isinstance(solver, PETSc.KSP):
        return LinearSolver((solver.getOptionsPrefix() or "own KSP").rstrip("_"), {}, ksp=solver)
    wanted = "a recipe such as direct() of tigar_x.fem.linear, or a PETSc.KSP"
    recipe: LinearSolver = checks.kind(name, solver, LinearSolver, wanted)
    return recipe


def _given(prefix: str) -> dict[str, Any]:
    """Options of one solver in PETSc's table, without their prefix."""
    found = PETSc.Options(prefix).getAll()
    return {key: value for key, value in sorted(found.items()) if key.partition("_")[0] in _GROUPS}


def _changed(recipe: LinearSolver, given: dict[str, Any], prefix: str) -> LinearSolver:
    """The recipe with other options."""
    options, matrix, aggregates = dict(recipe.options), recipe.matrix, recipe.aggregates
    if given.get("pc_type", options.get("pc_type")) != options.get("pc_type"):
        options = {key: value for key, value in options.items() if not key.startswith(_OF_PRECONDITIONER)}
        aggregates = None
        if given["pc_type"] not in _ON_BLOCKS:
            matrix = "aij"
    method = given.get("ksp_type", options.get("ksp_type"))
    if method != options.get("ksp_type"):
        options.pop("ksp_pc_side", None)
        options["ksp_norm_type"] = "unpreconditioned"
        if method in _WITHOUT_TRUE_NORM or method == "preonly":
            del options["ksp_norm_type"]
        if recipe.is_direct:
            options["ksp_rtol"] = RTOL
    if "mat_type" in given:
        matrix = checks.choice(f"-{prefix}mat_type", given["mat_type"], ("aij", "baij"))
        PETSc.Options(prefix).getString("mat_type")  # PETSc would call it unused at the end
    for key in ("ksp_rtol", "ksp_atol"):
        if key in given:
            checks.not_negative(f"-{prefix}{key}", _number(given[key]))
    own = {key: value for key, value in given.items() if key != "mat_type"}
    return replace(recipe, options={**options, **own}, matrix=matrix, aggregates=aggregates, overrides=given)


def _number(text: Any) -> Any:
    try:
        return float(text)
    except (TypeError, ValueError):
        return text


# -- command lines ----------------------------------------------------------------------------------------------------


def taken(
    arguments: Sequence[str], prefixes: Sequence[str] = tuple(PREFIXES)
) -> tuple[list[str], dict[str, str | None]]:
    """Take PETSc's options, which begin with one dash, out of a command line.

    Args:
        arguments: the command line.
        prefixes: those that options may have.

    Returns:
        The other arguments, and the options by name without the dash, with their values; None: without one.

    Raises:
        ValueError: an argument with one dash is no option of a solver.
    """
    rest: list[str] = []
    options: dict[str, str | None] = {}
    words = "|".join((*_GROUPS, *_OTHERS))
    shape = re.compile(rf"(?:{'|'.join(map(re.escape, prefixes))})(?:{words})_\w+")
    place = iter(range(len(arguments)))
    for i in place:
        argument = arguments[i]
        if not re.match(r"-[A-Za-z]", argument) or argument == "-h":
            rest.append(argument)
            continue
        name = argument[1:]
        if not shape.fullmatch(name):
            known = ", ".join(f"-{prefix}ksp_type" for prefix in prefixes)
            raise ValueError(
                f"{argument}: options of a script begin with two dashes, those of PETSc's linear solvers as {known};"
                " other options of PETSc go into the environment's PETSC_OPTIONS"
            )
        has_value = i + 1 < len(arguments) and not re.match(r"-[A-Za-z-]", arguments[i + 1])
        options[name] = arguments[next(place)] if has_value else None
    return rest, options


def put(options: dict[str, str | None]) -> None:
    """Put options into PETSc's table, and let PETSc tell at the end which of them no solver has asked for.

    Args:
        options: by name.
    """
    table = PETSc.Options()
    for name, value in options.items():
        table.setValue(name, value)
    if options and not table.hasName("options_left"):
        table.setValue("options_left", True)


def of_one_rank(options: dict[str, Any], overrides: Mapping[str, Any]) -> dict[str, Any]:
    """Options without Schwarz methods, whose only subdomain solver takes their place, unless the user chose them.

    Args:
        options: a recipe's, without its prefix; those of multigrid's levels are looked at as well.
        overrides: what the user has given.

    Returns:
        The options.
    """
    for level in ("", "mg_levels_"):
        pc, schwarz, sub = level + "pc_type", level + "pc_asm", level + "sub_"
        if options.get(pc) == "asm" and not any(key == pc or key.startswith(schwarz) for key in overrides):
            inner = {level + key.removeprefix(sub): value for key, value in options.items() if key.startswith(sub)}
            options = {key: value for key, value in options.items() if not key.startswith((pc, schwarz, sub))} | inner
    return options
