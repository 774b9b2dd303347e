"""A membrane, a plane valve and a dome in flows that differ on both sides of them: prints what steps give.

Without tolerances of the solvers, so that nothing but rounding may depend on the number of ranks.
"""

import json

import numpy as np
from mpi4py import MPI
from dome import dome
from load import load_demo

from coudalfish import CouplingOptions
from coudalfish.problems import manufactured as problem
from tigar_x.fem.linear import direct

TIGHT = CouplingOptions.sharp(block_rtol=1e-10, block_atol=1e-14)


def membrane(steps=3):
    """The manufactured membrane on 12 by 12 squares."""
    options = {"projected": False, "data": problem.ProblemData(), "immersed": "jump and kink"}
    flow, shell, fsi = load_demo("manufactured").build(2, 2, 24, TIGHT, direct(), **options)
    return flow, shell, fsi, [fsi.takeStep().passes for _ in range(steps)]


def valve(steps=4, elements=8):
    """The plane valve, while it opens."""
    scene = load_demo("valve_2d").Valve(elements=elements, leaflet_elements=elements, preset="sharp")
    flow, shell, fsi = scene.build(TIGHT, direct())
    return flow, shell, fsi, [fsi.takeStep().passes for _ in range(steps)]


def sheet(steps=3):
    """A dome in space that gives way to a pressure."""
    s = dome(options=TIGHT)
    return s.flow, s.shell, s.fsi, [s.fsi.takeStep().passes for _ in range(steps)]


def figures(flow, shell, fsi, passes):
    """Lists of numbers by name that do not depend on how the mesh is numbered."""
    time, V = flow.time, flow.V
    d, owned = V.mesh.geometry.dim, V.dofmap.index_map.size_local
    result = {"y": shell.y.x.array.tolist(), "multiplier": fsi.lam.ravel().tolist(), "passes": passes}
    patches = len(shell.spline.geometry.functions.bases)
    if patches > 1:
        result["tips"] = [shell.at("tip", patch=k).displacement[:d].tolist() for k in range(patches)]
    for name, f in (("x", time.x), ("second", time.second)):
        squares = (f.x.array.reshape(-1, d + 1)[:owned] ** 2).sum(axis=0)
        result[name] = np.sqrt(V.mesh.comm.allreduce(squares, op=MPI.SUM)).tolist()
    return result


def main():
    """All scenes; prints on the first rank."""
    results = {scene.__name__: figures(*scene()) for scene in (membrane, valve, sheet)}
    if MPI.COMM_WORLD.rank == 0:
        print(json.dumps(results))
    return results


if __name__ == "__main__":
    main()
