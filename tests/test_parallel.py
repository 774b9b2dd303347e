"""The tests marked mpi pass on two ranks."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from mpi4py import MPI
from on_disk import ROOT

# An MPI that came with the environment's mpi4py goes before the system's.
MPIRUN = shutil.which("mpirun", path=str(Path(sys.executable).parent)) or shutil.which("mpirun")


@pytest.mark.skipif(MPI.COMM_WORLD.size > 1, reason="already parallel")
@pytest.mark.skipif(MPIRUN is None, reason="no mpirun")
def test_two_ranks():
    env = {key: value for key, value in os.environ.items() if not key.startswith(("OMPI_", "PMIX_", "PMI_", "OPAL_"))}
    env |= {"OMPI_ALLOW_RUN_AS_ROOT": "1", "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM": "1", "OMP_NUM_THREADS": "1"}
    oversubscribe = ["--oversubscribe"] if "Open MPI" in MPI.Get_library_version() else []
    command = [MPIRUN, "-n", "2", *oversubscribe, sys.executable, "-m", "pytest", "-q", "-m", "mpi"]
    command += ["-p", "no:cacheprovider", "--color=no", str(ROOT / "tests")]
    done = subprocess.run(command, capture_output=True, text=True, env=env, cwd=ROOT, timeout=1500)
    assert done.returncode == 0, done.stdout[-4000:] + done.stderr[-2000:]
    assert done.stdout.count(" passed") == 2
