"""What a script needs around a run: its command line, its log, a progress bar, costs and a summary."""

import argparse
import functools
import inspect
import logging
import sys
import time
import types
import typing
from collections.abc import Callable, Sequence
from typing import Any

from mpi4py import MPI
from dolfinx import mesh

from tigar_x import compat
from tigar_x.fem import petsc_options
from tigar_x.fem.petsc_options import PREFIXES
from tigar_x.ranks import all_come

log = logging.getLogger(__name__)


def command_line(
    main: Callable[..., Any], arguments: Sequence[str] | None = None, prefixes: Sequence[str] = tuple(PREFIXES)
) -> Any:
    """Run ``main`` with the options of the command line; its signature says which there are.

    What ``main`` raises on one of several ranks ends them all, see :func:`abort_on_error`; so does ``sys.exit`` with an
    error that not all ranks come to.

    Parameters become ``--options`` with their default and annotation (int, float, str, bool, Path, Literal, optional
    ones of these); help is taken from the ``Args`` section of its docstring. A boolean gets a ``--no-`` form.

    Options with one dash, as ``-fluid_ksp_rtol 1e-10``, are PETSc's and go before those of the solvers' recipes, see
    :mod:`tigar_x.fem.petsc_options`. Those that no solver has asked for are listed by PETSc at the end.

    Args:
        main: the script's function, every parameter annotated and with a default.
        arguments: command line; None: that of the process.
        prefixes: of PETSc's options that the script takes.

    Returns:
        What ``main`` returns.
    """
    doc = inspect.getdoc(main) or ""
    parser = argparse.ArgumentParser(description=doc.split("\n\n")[0], epilog=_petsc_help(prefixes))
    hints = typing.get_type_hints(main)
    for name, parameter in inspect.signature(main).parameters.items():
        hint = hints[name]
        if typing.get_origin(hint) in (types.UnionType, typing.Union):
            hint = next(part for part in typing.get_args(hint) if part is not type(None))
        options: dict[str, Any] = {"default": parameter.default, "help": _help(doc, name)}
        if hint is bool:
            options["action"] = argparse.BooleanOptionalAction
        elif typing.get_origin(hint) is typing.Literal:
            options["choices"] = typing.get_args(hint)
            options["type"] = type(options["choices"][0])
        else:
            options["type"] = hint
        parser.add_argument("--" + name.replace("_", "-"), **options)
    set_up_logging()
    abort_on_error()
    try:
        rest, petsc = petsc_options.taken(sys.argv[1:] if arguments is None else arguments, prefixes)
    except ValueError as error:
        parser.error(str(error))
    given = parser.parse_args(rest)
    petsc_options.put(petsc)
    try:
        return main(**vars(given))
    except SystemExit as end:  # no excepthook sees it
        if end.code and MPI.COMM_WORLD.size > 1 and not all_come(MPI.COMM_WORLD):
            told = f"{end.code}\n"
            _abort(lambda *_: sys.stderr.write(told), SystemExit, end, None)
        raise


def _petsc_help(prefixes: Sequence[str]) -> str:
    meanings = [f"-{prefix}ksp_rtol: {PREFIXES.get(prefix, 'of this script')}" for prefix in prefixes]
    return (
        "Options with one dash are PETSc's, and go before what this script chooses for its linear solvers:"
        f" -ksp_type, -pc_type and all others, after the prefix of a solver ({', '.join(meanings)})."
    )


def abort_on_error() -> None:
    """Let an exception that nobody catches end all ranks, after its traceback; the others would wait for ever.

    A run on one rank ends as always.
    """
    if MPI.COMM_WORLD.size > 1:
        sys.excepthook = functools.partial(_abort, sys.excepthook)


def _abort(show: Callable[..., Any], kind: type[BaseException], error: BaseException, trace: Any) -> None:
    try:
        show(kind, error, trace)
        log.error("rank %d of %d ends the run: %s", MPI.COMM_WORLD.rank, MPI.COMM_WORLD.size, kind.__name__)
        sys.stdout.flush()
        sys.stderr.flush()
        time.sleep(0.5)  # others may have something to say as well
    finally:
        MPI.COMM_WORLD.Abort(1)


def _help(doc: str, name: str) -> str:
    lines = iter(doc.splitlines())
    for line in lines:
        head, _, text = line.strip().partition(": ")
        if head == name:
            more = [text]
            for following in lines:
                if not following.startswith("        "):
                    break
                more.append(following.strip())
            return " ".join(more).replace("%", "%%")
    return ""


class _PackagesOnly(logging.Filter):
    """Keeps the chatter of compilers and third parties out of a run's log."""

    def filter(self, record: logging.LogRecord) -> bool:
        ours = record.name.split(".")[0] in ("tigar_x", "shnapr", "varmint", "coudalfish", "__main__")
        return ours or record.levelno >= logging.WARNING


def set_up_logging(level: int = logging.INFO) -> None:
    """Log to standard error: everything on rank 0, errors on the others.

    Args:
        level: lowest level of rank 0.
    """
    handler = logging.StreamHandler()
    handler.setFormatter(logging.Formatter("%(levelname)s %(name)s: %(message)s"))
    handler.addFilter(_PackagesOnly())
    root = logging.getLogger()
    root.handlers[:] = [handler]
    root.setLevel(level if MPI.COMM_WORLD.rank == 0 else logging.ERROR)


def constants(domain: mesh.Mesh, data: Any) -> types.SimpleNamespace:
    """A script's data as Constants, so that other numbers compile nothing again.

    Args:
        domain: mesh whose forms they enter.
        data: dataclass of numbers.

    Returns:
        Constants under the names of the numbers.
    """
    return types.SimpleNamespace(**{name: compat.Constant(domain, float(value)) for name, value in vars(data).items()})
