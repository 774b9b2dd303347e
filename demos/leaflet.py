"""A leaflet of a heart valve that closes against two rigid planes.

Diastolic pressure acts from downstream on one of three equal leaflets, pinned along its posts and its attached edge,
and pushes it upstream and to the axis. By symmetry its neighbours are replaced by two planes through the axis, at 60
degrees to both sides of its middle; their pressure is k times the depth of the midsurface in the plane.

What is checked: supports, planes and pressure are in balance; the resultant of the pressure, which follows the normal,
is P/2 times the integral of x cross dx along the boundary; the solution is symmetric about the leaflet's middle; the
mean depth in the planes is of the order of P/k; and the free edge converges under refinement. The planes leave the
leaflet a wedge, whose tip it fills up to a bending radius of (E h^3/(12 (1 - nu^2) P))^(1/3): that is what refinement
resolves. Strains are large: with h = 0.01 or ten times the pressure some load steps fail, and not all such loads are
reached.

The load and all moduli are those of the demonstration of contact with planes that accompanies D. Kamensky,
doi:10.1016/j.camwa.2020.01.023; the leaflet is that of `tigar_x.geometry.surfaces.leaflet`. Centimetres, grams,
seconds.
"""

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from shnapr.problems.leaflet import NORMALS, Closing, Leaflet
from tigar_x import Colours, Results, VTUSeries, against, draw, lines, sampling, scene, script
from tigar_x.run.convergence import halved, observed_rates
from tigar_x.run.results import with_results
from tigar_x.splines.pictures import Surface, View, surfaces
from tigar_x.splines.projection import Projected

TOY = {"degree": 2, "elements": 5, "step": 0.25}
MEASURED = ("energy", "centre_radius", "centre_z", "contact_force", "touching")


@with_results
def main(results: Results, leaflet: Leaflet, levels: int = 1, step: float = 0.1) -> dict[str, Any]:
    """Close a leaflet of a heart valve against two planes, and check the balance of forces.

    Args:
        levels: number of meshes, each of half as many elements as the next, to observe convergence.
        step: load step, by the whole load.
    """
    paths = dict.fromkeys(halved(leaflet.elements, levels))
    results.claim()
    for n in paths:
        closing, more = Closing(replace(leaflet, elements=n)), {}
        spline, y = closing.shell.spline, closing.shell.y
        tension = Projected(spline, closing.tension())
        if n == leaflet.elements:
            fields = {"tension": tension, "distance": closing.nearest}
            more = {"results": results, "series": [partial(VTUSeries, results.out / "leaflet", spline, y=y, **fields)]}
        path = paths[n] = closing.close(step=step, **more)
    forces = closing.forces()
    if results.viz:
        picture(results, closing, paths, tension())
    deepest = -min(path.final("distance_1"), path.final("distance_2"))
    return results.of_path(
        path,
        errors={"force_balance": forces.imbalance, "pressure_resultant": forces.boundary_error},
        qoi=against({name: path.final(name) for name in MEASURED}, {}),
        levels=[{name: p.final(name) for name in p.history.names} for p in paths.values()],
        rates=observed_rates([{name: p.final(name) for name in MEASURED[:3]} for p in paths.values()]),
        monitors={
            "asymmetry": closing.asymmetry(),
            "deepest": deepest,
            "mean_depth": closing.mean_depth(),
            "pressure_over_stiffness": leaflet.pressure / leaflet.stiffness,
            **{name: getattr(forces, name).tolist() for name in ("reaction", "contact", "pressure")},
        },
        newton_iterations=path.report.iterations,
        dofs_shell=spline.geometry.n * 3,
    )


def picture(results: Results, closing: Closing, paths: dict[int, Any], tension: Any) -> None:
    """The closed leaflet with its tension and the planes, and how its free edge came there."""
    net, edge = sampling.net(closing.shell.spline, 81, patch=0), sampling.side(closing.shell.spline, "v0", 401, patch=0)
    outwards = [np.array([m[1], -m[0], 0.0]) * -np.sign(m[1]) for m in NORMALS]
    r, z = np.meshgrid([0.0, 1.15], [-0.2, 1.0])
    planes = [
        Surface.of_net(r[..., None] * e + z[..., None] * (0.0, 0.0, 1.0), colour="0.6", opacity=0.25) for e in outwards
    ]
    force = Colours("largest membrane force", "dyn/cm", 0.0, float(np.quantile(tension, 0.98)))
    space = scene(
        [*surfaces(net, closing.shell.y, tension), *planes], length="cm", colours=force, view=View(30.0, 205.0)
    )
    seen = {name: x[:, :2].T for name, x in (("open", edge.reference), ("closed", edge.positions(closing.shell.y)))}
    seen |= {f"_{i}": np.outer(e[:2], [0.0, 1.2]) for i, e in enumerate(outwards)}
    styles = {f"_{i}": {"fmt": "k--"} for i in range(len(outwards))}
    axial = lines(seen, x=("$x_1$", "cm"), y=("$x_2$", "cm"), aspect="equal", title="along the axis", styles=styles)
    way = {f"{n} elements": (p.history["pressure"][1:], p.history["centre_radius"][1:]) for n, p in paths.items()}
    radius = lines(way, x=("pressure", "dyn/cm$^2$"), y=("middle of the free edge to axis", "cm"), yscale="log")
    draw(results.out / "leaflet.png", space, axial, radius, columns=3)


if __name__ == "__main__":
    script.command_line(main)
