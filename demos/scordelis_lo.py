"""The Scordelis-Lo roof: a barrel vault under its own weight, the classical test of shells in bending and stretching.

Part of a cylinder of radius R = 25, length 50 and half-angle 40 degrees, 0.25 thick, of E = 4.32e8 and nu = 0, carries
the dead load 90 per area. Its curved ends rest on diaphragms, which hold them in their planes only; the straight edges
are free. By the linear theory of Kirchhoff and Love the midpoint of a straight edge sinks by 0.3006.

The theory is linear, so virtual work and its tangent are taken at rest, and the load is carried in one solve. The
geometry is exact: a rational arc. By default integrals take the degree 2 p. With p = 2 it makes coarse meshes lock; the
degree 3, which is two Gauss points per direction of a quadrilateral, relieves them.

Source: J. Kiendl, "Isogeometric analysis and shape optimal design of shell structures", PhD thesis, TU Muenchen, 2011,
section 6.2.1.
"""

from typing import Any

import numpy as np
import ufl
from mpi4py import MPI

from shnapr.problems.scordelis_lo import PUBLISHED, Mesh, Roof
from tigar_x import Colours, Results, VTUSeries, against, draw, lines, sampling, script, table, with_results
from tigar_x.run.progress import peak_rss_mib
from tigar_x.splines.pictures import Surface, scene

TOY = {"elements": 4}


@with_results
def main(results: Results, mesh: Mesh) -> dict[str, Any]:
    """Load the Scordelis-Lo roof and compare its deflection with the published one."""
    roof = Roof(mesh)
    results.claim()
    roof.solve()
    memory, w, spline = peak_rss_mib(), roof.sinking, roof.shell.spline
    if results.viz:
        forces = zip(("membrane_forces", "moments"), roof.resultants(), strict=True)
        fields = {name: spline.project(ufl.as_vector([T[0, 0], T[1, 1], T[0, 1]])) for name, T in forces}
        VTUSeries(results.out / "scordelis_lo", spline, y=roof.shell.y, **fields).once()
        net, arc = sampling.net(spline, 81, patch=0), sampling.line(spline, 1, 81, patch=0)
        shown = Surface.of_net(net.reference + 10.0 * net.values(roof.shell.y), net.values(roof.shell.y)[..., 2])
        colours = Colours("vertical displacement, shown tenfold", "length")
        angle, sunk = np.linspace(-40.0, 40.0, 81), arc.values(roof.shell.y)[:, 2]
        middle = {"computed": (angle, sunk), "published": ((-40.0, 40.0), (-PUBLISHED, -PUBLISHED))}
        labels = {"x": ("angle from the crown", "degrees"), "y": ("vertical displacement", "length")}
        section = lines(middle, **labels, styles={"published": {"fmt": "ko"}})
        draw(results.out / "scordelis_lo.png", scene([shown], length="length", colours=colours), section)
    costs = {stage: watch.cpu_s for stage, watch in roof.costs.items()}
    results.say(table(("stage", "CPU s"), costs.items()))
    return results.summary(
        {"quadrature": spline.quadrature_degree},
        errors={"sinking": abs(w / PUBLISHED - 1.0)},
        qoi=against({"sinking": w}, {"sinking": PUBLISHED}),
        unknowns=roof.shell.unknowns,
        nonzeros=int(roof.system.A.getInfo()["nz_used"]),
        stages_cpu_s=costs,
        solver_peak_rss_mib=MPI.COMM_WORLD.allreduce(memory, op=MPI.MAX),
        steps=1,
        wall_s=sum(watch.wall_s for watch in roof.costs.values()),
        cpu_s=sum(costs.values()),
    )


if __name__ == "__main__":
    script.command_line(main)
