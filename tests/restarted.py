"""A sheet that a flow slows down, with a checkpoint after every step, for runs that are killed and go on.

``restarted.py FOLDER STEPS [RESTART]`` prints the number of every step that is done.
"""

import sys
from pathlib import Path

import numpy as np
from mpi4py import MPI
from scenes import sheet_in_flow

from coudalfish import CouplingOptions
from coudalfish.restart import CoupledState
from tigar_x.run import script
from tigar_x.run.output import CSVSeries
from tigar_x.run.restart import Restart

TIGHT = CouplingOptions(block_rtol=1e-11, block_atol=1e-13)


def scene(**changes):
    """The coupled problem before its first step."""
    return sheet_in_flow((0.0, 0.0), **{"sheet_velocity": (0.5, 0.2), "dt": 0.05, "n": 4, "options": TIGHT} | changes)


def norms(fsi):
    """Norms of fields and rates that do not depend on the number of ranks, the multiplier's mean and maximum."""
    flow, shell = fsi.timeInt_f, fsi.timeInt_sh
    owned = flow.x.function_space.dofmap.index_map.size_local * flow.x.function_space.dofmap.index_map_bs
    fluid = [np.sum(f.x.array[:owned] ** 2) for f in (flow.x, flow.xdot_old)]
    fluid = np.sqrt(MPI.COMM_WORLD.allreduce(np.array(fluid), op=MPI.SUM))
    shells = [np.linalg.norm(f.x.array) for f in (shell.x, shell.xdot_old, shell.xddot_old)]
    return [*fluid, *shells, fsi.lam.mean(), np.abs(fsi.lam).max()]


def main(folder, steps, which=""):
    """Run to a step, from the start or from a checkpoint."""
    fsi = scene().fsi
    run = Restart(folder / "checkpoints", CoupledState(fsi), every=1)
    if which:
        run.read(which)
    columns = ("u", "u_dot", "y", "y_dot", "y_ddot", "lam_mean", "lam_max")
    with CSVSeries(folder / "history.csv", columns, after=run.after) as history:
        for step in run.steps(range(run.step + 1, steps + 1)):
            report = fsi.takeStep()
            history.write(report.t, *norms(fsi))
            if MPI.COMM_WORLD.rank == 0:
                print(step, flush=True)


if __name__ == "__main__":
    script.set_up_logging()
    main(Path(sys.argv[1]), int(sys.argv[2]), *sys.argv[3:])
