"""What a script needs around a run: its command line, its log, a progress bar, costs and a summary."""

import argparse
import functools
import inspect
import json
import logging
import platform
import resource
import signal
import sys
import threading
import time
import types
import typing
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass, is_dataclass
from pathlib import Path
from typing import Any

import dolfinx
import numpy as np
import scipy
import ufl
from mpi4py import MPI
from dolfinx import mesh
from petsc4py import PETSc

from tigar_x import compat
from tigar_x.writing import all_come, on_root, replace_text, together

log = logging.getLogger(__name__)


def command_line(main: Callable[..., Any], arguments: list[str] | None = None) -> Any:
    """Run ``main`` with the options of the command line; its signature says which there are.

    What ``main`` raises on one of several ranks ends them all, see :func:`abort_on_error`; so does ``sys.exit`` with an
    error that not all ranks come to.

    Parameters become ``--options`` with their default and annotation (int, float, str, bool, Path, Literal, optional
    ones of these); help is taken from the ``Args`` section of its docstring. A boolean gets a ``--no-`` form.

    Args:
        main: the script's function, every parameter annotated and with a default.
        arguments: command line; None: that of the process.

    Returns:
        What ``main`` returns.
    """
    doc = inspect.getdoc(main) or ""
    parser = argparse.ArgumentParser(description=doc.split("\n\n")[0])
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
    given = parser.parse_args(arguments)
    try:
        return main(**vars(given))
    except SystemExit as end:  # no excepthook sees it
        if end.code and MPI.COMM_WORLD.size > 1 and not all_come(MPI.COMM_WORLD):
            told = f"{end.code}\n"
            _abort(lambda *_: sys.stderr.write(told), SystemExit, end, None)
        raise


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


class Termination:
    """Lets a run that is told to end finish its step first: SIGTERM, SIGUSR1 and Ctrl-C no longer end the process.

    ``with Termination() as asked:`` gives a function that tells on all ranks alike whether any of them was told to end
    (collective). A second Ctrl-C interrupts as usual. Batch systems and mpirun may send SIGUSR1 ahead of time.
    """

    def __init__(self) -> None:
        self._told = 0
        self._handlers: dict[int, Any] = {}

    def __enter__(self) -> Callable[[], bool]:
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGTERM, signal.SIGUSR1, signal.SIGINT):
                self._handlers[number] = signal.signal(number, self._note)
        return lambda: bool(MPI.COMM_WORLD.allreduce(self._told, op=MPI.MAX))

    def _note(self, number: int, _: Any) -> None:
        self._told = 1
        log.warning("%s: ending after the step in progress", signal.Signals(number).name)
        if number == signal.SIGINT:
            signal.signal(number, self._handlers.pop(number))

    def __exit__(self, *_: object) -> None:
        for number, handler in self._handlers.items():
            signal.signal(number, handler)


class Progress:
    """Steps with a bar in a terminal and plain log lines elsewhere, on rank 0; iterating gives numbers from 1.

    Args:
        n_steps: number of steps, which are 1 to ``n_steps``.
        lines: number of log lines in the whole run where there is no terminal.
        done: number of steps that an earlier run has done.
    """

    def __init__(self, n_steps: int, lines: int = 10, *, done: int = 0) -> None:
        self._n = n_steps
        self._every = max(1, n_steps // lines)
        self._done = done
        self._rank = MPI.COMM_WORLD.rank
        self._bar = sys.stderr.isatty()

    def __iter__(self) -> Iterator[int]:
        """Iterate over the numbers of the steps to do, from 1 or from the one after those done."""
        for n in range(self._done + 1, self._n + 1):
            self._done = n
            yield n
        if self._bar and self._rank == 0:
            sys.stderr.write("\n")

    def show(self, report: Any) -> None:
        """Show where the run is.

        Args:
            report: the step's report with ``t``, ``passes`` and ``residuals``, or a text.
        """
        if self._rank:
            return
        if not self._bar and self._done % self._every and self._done < self._n:
            return
        text = f"step {self._done}/{self._n}  "
        if isinstance(report, str):
            text += report
        else:
            residuals = ", ".join(f"{r:.1e}" for r in report.residuals[-1])
            text += f"t = {report.t:.4g}  passes {report.passes}  residuals {residuals}"
        if not self._bar:
            log.info(text)
            return
        filled = 24 * self._done // self._n
        sys.stderr.write(f"\r[{'#' * filled}{'.' * (24 - filled)}] {text}\x1b[K")
        sys.stderr.flush()


def peak_rss_mib() -> float:
    """Largest resident memory of this process so far [MiB]; getrusage would count the parent's before exec as well."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(float(line.split()[1]) for line in lines if line.startswith("VmHWM")) / 1024.0


def rss_mib() -> float:
    """Present resident memory of this process [MiB]."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 2**20


class Stopwatch:
    """Wall and CPU seconds inside ``with`` blocks, added up; form compilation is not counted.

    Attributes:
        wall_s: wall seconds.
        cpu_s: CPU seconds of this process.
    """

    def __init__(self) -> None:
        self.wall_s = 0.0
        self.cpu_s = 0.0

    def __enter__(self) -> "Stopwatch":
        self._start = self._now()
        return self

    def __exit__(self, *_: object) -> None:
        wall, cpu = self._now()
        self.wall_s += wall - self._start[0]
        self.cpu_s += cpu - self._start[1]

    @staticmethod
    def _now() -> tuple[float, float]:
        return time.perf_counter() - compat.compile_seconds(), time.process_time() - compat.compile_cpu_seconds()


@dataclass(frozen=True)
class Quantity:
    """A quantity of interest.

    Attributes:
        value: computed.
        published: value in the literature; None: none.
        doi: where it was published; None: nowhere.
    """

    value: float
    published: float | None = None
    doi: str | None = None


def versions() -> dict[str, str]:
    """Versions of the libraries underneath, for reports."""
    return {
        "dolfinx": dolfinx.__version__,
        "ufl": ufl.__version__,
        "petsc": ".".join(str(part) for part in PETSc.Sys.getVersion()),
        "numpy": np.__version__,
        "scipy": scipy.__version__,
        "python": platform.python_version(),
    }


def plain(value: Any) -> Any:
    """Containers of dataclasses, NumPy's arrays and paths as JSON has them; None in a dataclass is left out."""
    if is_dataclass(value) and not isinstance(value, type):
        return plain({k: v for k, v in asdict(value).items() if v is not None})
    if isinstance(value, dict):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    return str(value) if isinstance(value, Path) else value


def write_summary(out: Path, demo: str, inputs: dict[str, Any], **results: Any) -> dict[str, Any]:
    """Write ``summary.json`` of a demo; costs of the process and versions are added (collective; rank 0 writes).

    Args:
        out: folder of the results; made if missing.
        demo: name of the demo.
        inputs: its parameters.
        results: errors, quantities and costs; those that are None are left out.

    Returns:
        The summary.

    Raises:
        ValueError: on all ranks: a result is not finite.
        OSError: on all ranks: the file cannot be written.
    """
    known = {key: value for key, value in results.items() if value is not None}
    summary = plain(
        {
            "demo": demo,
            "inputs": inputs,
            **known,
            "compile_s": compat.compile_seconds(),
            "peak_rss_mib": MPI.COMM_WORLD.allreduce(peak_rss_mib(), op=MPI.MAX),
            "versions": versions(),
        }
    )
    text = together(MPI.COMM_WORLD, lambda: json.dumps(summary, indent=2, allow_nan=False) + "\n")
    on_root(MPI.COMM_WORLD, lambda: replace_text(out / "summary.json", text))
    return dict(summary)


def table(header: Iterable[str], rows: Iterable[Iterable[Any]]) -> str:
    """Plain text table.

    Args:
        header: column names.
        rows: rows of the same length; floats are shown with four digits.

    Returns:
        Lines with aligned columns.
    """
    cells = [[f"{c:.4g}" if isinstance(c, float) else str(c) for c in row] for row in [list(header), *map(list, rows)]]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    return "\n".join("  ".join(c.rjust(w) for c, w in zip(row, widths, strict=True)) for row in cells)
