"""Small problems on more ranks than cells; prints their results as JSON.

The folder for files is the first argument, names of problems may follow.
"""

import json
import sys
from pathlib import Path

import numpy as np
from mpi4py import MPI
from scenes import sheet_in_flow

from coudalfish.restart import CoupledState
from tigar_x import compat
from tigar_x.fem.schemes import generalized_alpha
from tigar_x.geometry import shapes
from tigar_x.run.output import XDMFSeries
from tigar_x.run.plane_field import PlaneField
from tigar_x.run.restart import Restart
from tigar_x.splines.saved import load_extraction, save_extraction
from tigar_x.splines.spline import ExtractedSpline
from tigar_x.splines.vtu import VTUSeries
from varmint.conditions import Slip, Traction, Velocity, WeakVelocity
from varmint.flow import Flow
from varmint.forms.motion import PrescribedMotion
from varmint.mesh import box
from varmint.mesh.arrays import checked
from varmint.quantities import BoundaryForce, Measured, PointValues, flow_rate, volume, vorticity, wall_shear_stress

COMM = MPI.COMM_WORLD
SCHEME = generalized_alpha(0.5)


def splines(folder):
    """Fields, nodal values and files of a curve and a surface of one element."""
    found = []
    for name, patch in (
        ("line", shapes.line((0, 0), (2, 1), elements=1, degree=2)),
        ("sheet", shapes.parallelogram((0, 0, 0), (1, 0, 0), (0, 1, 0), elements=(1, 1), degrees=(2, 2))),
    ):
        s = ExtractedSpline(patch)
        y = s.project(s.F)
        values = s.nodal(y)[: s.V.dofmap.index_map.size_local]
        found += [COMM.allreduce((values**2).sum()), compat.assemble_scalar(*compat.compile_forms(s.F[0] * s.dx))]
        found += [*s.evaluate(y, [[0.3] * s.dim])[0]]
        found += [*s.evaluate_at(y, [np.full(s.nsd, 0.1)], distance=1.0)[0]]
        with VTUSeries(folder / name, s, y=y) as movie:
            movie.write(0.0)
        save_extraction(folder / f"{name}.npz", s)
        COMM.barrier()
        again = load_extraction(folder / f"{name}.npz")
        found += [*again.vector.coefficients(again.project(again.F)).ravel()]
    return found


def coupled(folder):
    """A sheet in two triangles, its checkpoint, and its next step once more from there."""
    fsi = sheet_in_flow((0.0, 0.0), n=1, sheet_velocity=(0.5, 0.2), dt=0.05).fsi
    run = Restart(folder / "checkpoints", CoupledState(fsi), every=1)
    found = []
    with XDMFSeries(folder / "flow.xdmf", fsi.mesh_f, w=(fsi.timeInt_f.x, (0, 1))) as movie:
        for _ in run.steps(range(2)):
            report = fsi.takeStep()
            movie.write(report.t)
            found += [
                *report.monitors.force,
                report.monitors.normal_slip_rms,
                report.slip_ratio,
                report.inactive_points,
            ]
    run.read()
    return [*found, *fsi.lam]


def flow(folder):
    """A channel of two triangles, on a mesh that moves: values, forces, fields at nodes, pictures and checkpoints."""
    mesh = box(COMM, (0, 0), (1, 1), (1, 1))
    checked(mesh.domain)
    moving = PrescribedMotion(mesh, lambda x, t: 0.1 * t * x, 0.1, SCHEME)
    conditions = [Velocity("bottom"), WeakVelocity("left", (1.0, 0.0)), Slip("top"), Traction("right")]
    f = Flow(mesh, conditions, rho=1.3, mu=0.7, dt=0.1, scheme=SCHEME, moving=moving)
    force, points = BoundaryForce(f, "bottom"), PointValues(f, [[0.3, 0.4], [1.0, 1.0]])
    fields = vorticity(f), wall_shear_stress(f, "bottom", "top")
    report = f.take_step(force)
    found = [*report.measured, *np.ravel(points()), *Measured(V=volume(f), Q=flow_rate(f, "right"))().values()]
    for field in fields:
        found += [*COMM.bcast(PlaneField(field(), moving.time.x).values).ravel()]
    return found


def main(folder, *names):
    """Numbers by problem."""
    chosen = [globals()[name] for name in names] or [splines, coupled, flow]
    return {problem.__name__: [float(value) for value in problem(folder / problem.__name__)] for problem in chosen}


if __name__ == "__main__":
    results = main(Path(sys.argv[1]), *sys.argv[2:])
    if COMM.rank == 0:
        print(json.dumps(results))
