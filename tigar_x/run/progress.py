"""How far a run is and what it costs: a bar or log lines, seconds, memory; how it is told to end."""

import logging
import resource
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from mpi4py import MPI

from tigar_x import compat

log = logging.getLogger(__name__)


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
        self.end()

    def end(self) -> None:
        """End the line of the bar."""
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
