"""Speed index of a machine: CPU seconds of three fixed jobs, to compare figures of different days and machines."""

import json
import time
from collections.abc import Callable

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as sla

# CPU seconds of the same jobs on the day when the figures of the published code in legacy.csv were measured.
LEGACY_DAY = {"lu_200x200": 0.216, "spmv_1e6_x20": 0.160, "python_2e6": 0.054}


def cpu_seconds(job: Callable[[], object], repeats: int = 3) -> float:
    """Smallest CPU time of a few runs of a job."""
    best = np.inf
    for _ in range(repeats):
        start = time.process_time()
        job()
        best = min(best, time.process_time() - start)
    return round(float(best), 4)


def laplacian(n: int) -> sp.csc_matrix:
    """Five-point Laplacian on an n x n grid."""
    d, eye = sp.diags([-1, 2, -1], [-1, 0, 1], shape=(n, n)), sp.identity(n)
    return (sp.kron(d, eye) + sp.kron(eye, d)).tocsc()


def count() -> float:
    """Two million steps of interpreted arithmetic."""
    s = 0.0
    for k in range(2_000_000):
        s += k * 1e-9
    return s


def calibrate() -> dict[str, float]:
    """CPU seconds of the three jobs here and now."""
    A, B = laplacian(200), laplacian(1000).tocsr()
    b, x = np.ones(A.shape[0]), np.ones(B.shape[0])
    return {
        "lu_200x200": cpu_seconds(lambda: sla.splu(A).solve(b)),
        "spmv_1e6_x20": cpu_seconds(lambda: [B @ x for _ in range(20)]),
        "python_2e6": cpu_seconds(count),
    }


def legacy_speed(here: dict[str, float]) -> float:
    """How many times faster this machine is than the one of legacy.csv: geometric mean over the jobs."""
    ratios = [LEGACY_DAY[job] / seconds for job, seconds in here.items()]
    return float(np.exp(np.mean(np.log(ratios))))


if __name__ == "__main__":
    print(json.dumps(calibrate()))
