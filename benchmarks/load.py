"""What several benchmarks need: demos as modules, runs on several ranks, figures of the published code."""

import csv
import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

from mpi4py import MPI

ROOT = Path(__file__).resolve().parent.parent


def load_demo(name: str) -> ModuleType:
    """Module of a demo, by its name."""
    path = ROOT / "demos" / f"{name}.py"
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise ImportError(f"{path} is not a module")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def on_ranks(ranks: int, *arguments: Any, preload: Path | None = None) -> Any:
    """Run this interpreter with arguments on a number of ranks; what it prints last, as JSON.

    Args:
        ranks: how many.
        arguments: a program and its arguments.
        preload: a library that is loaded before all others.

    Raises:
        RuntimeError: the run failed.
    """
    env = {key: value for key, value in os.environ.items() if not key.startswith(("OMPI_", "PMIX_", "PMI_", "OPAL_"))}
    env |= {"OMPI_ALLOW_RUN_AS_ROOT": "1", "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM": "1", "OMP_NUM_THREADS": "1"}
    before = [] if preload is None else ["env", f"LD_PRELOAD={preload}"]
    command = ["mpirun", "-n", str(ranks), "--oversubscribe", *before, sys.executable, *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, env=env)
    if done.returncode:
        raise RuntimeError(f"{' '.join(command)} failed:\n{done.stderr[-2000:]}")
    return json.loads(done.stdout.splitlines()[-1])


def legacy_valve(problem: str) -> dict[str, float]:
    """Figures of a valve with the published code, by the name of its demo."""
    with open(Path(__file__).parent / "legacy_valves.csv", newline="") as file:
        rows = csv.DictReader(line for line in file if not line.startswith("#"))
        row = next(row for row in rows if row["problem"] == problem)
    return {name: float(value) for name, value in row.items() if name != "problem" and value}


def tell(result: Any) -> None:
    """Print what :func:`on_ranks` is waiting for, on rank 0."""
    if MPI.COMM_WORLD.rank == 0:
        print(json.dumps(result))
