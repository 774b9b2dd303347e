"""Running a program on several ranks from a test that has one."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

from mpi4py import MPI
from on_disk import ROOT

# Two runs that do the same: on several ranks they differ by rounding, since MUMPS adds up what arrives first, and
# where a residual is at the tolerance one may do a pass or an iteration more.
SAME_RUN = 0.0 if MPI.COMM_WORLD.size == 1 else 1e-8

# An MPI that came with the environment's mpi4py goes before the system's.
MPIRUN = shutil.which("mpirun", path=str(Path(sys.executable).parent)) or shutil.which("mpirun")


def outside():
    """The environment of a process that belongs to no MPI run and finds the modules that tests find."""
    mine = ("OMPI_", "PMIX_", "PMI_", "OPAL_")
    kept = {key: value for key, value in os.environ.items() if not key.startswith(mine)}
    found = [str(ROOT), str(ROOT / "tests"), str(ROOT / "benchmarks"), *filter(None, [kept.get("PYTHONPATH")])]
    return kept | {"OMP_NUM_THREADS": "1", "PYTHONPATH": os.pathsep.join(found)}


def mpirun(ranks, *arguments, timeout=2400):
    """Run this interpreter with arguments on a number of ranks; the finished process with its output."""
    env = outside() | {"OMPI_ALLOW_RUN_AS_ROOT": "1", "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM": "1"}
    oversubscribe = ["--oversubscribe"] if "Open MPI" in MPI.Get_library_version() else []
    command = [MPIRUN, "-n", str(ranks), *oversubscribe, sys.executable, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, env=env, cwd=ROOT, timeout=timeout)
