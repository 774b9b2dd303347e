"""Two ribbons tied in a reef knot and pulled tight: contact of thin shells that bend, slide and press on each other.

Each ribbon enters and leaves on its own side, and its bight lies around both strands of the other one. The first is
held where X_1 < -6; the second is pulled along x_1 by a body force where X_1 > 10 and cannot move across there:

    rho h (y'' + c y') - div n(y) = rho h g e_1 [X_1 > 10] + contact,      y(0) = y'(0) = 0.

The shell is one of St. Venant and Kirchhoff. Contact is a potential between all pairs of points that are further apart
than R_self in the reference configuration. Sources: D. Kamensky, F. Xu, C.-H. Lee, J. Yan, Y. Bazilevs, M.-C. Hsu, "A
contact formulation based on a volumetric potential", doi:10.1016/j.cma.2017.11.007; D. Kamensky, Y. Bazilevs, "tIGAr:
Automating isogeometric analysis with FEniCS", doi:10.1016/j.cma.2018.10.002. The data are theirs but for the shape of
the knot: here its centre lines run smoothly through a few points, far enough apart that all pairs of points of
different ribbons take part in contact.

What must hold is measured in every step: contact makes neither force nor torque, momentum changes by the load, the
supports and damping alone, backward Euler makes no energy, and no point moves so far that it could pass another one.
What must not change is the type of the knot, which is checked on the way by an invariant of its centre lines.
"""

import logging
from functools import partial
from typing import Any

from shnapr.problems.reef_knot import CONTACT, SQUARE_KNOT, STEPS, TIME_STEP, Knot
from tigar_x import Results, VTUSeries, against, checks, draw, over_time, sampling, scene, script, with_results
from tigar_x.splines.pictures import View, surfaces

log = logging.getLogger(__name__)

TOY = {"steps": 6, "dt_factor": 4.0}


@with_results
def main(
    results: Results, steps: int | None = None, dt_factor: float = 1.0, resolution: int = 3, pictures: int = 150
) -> dict[str, Any]:
    """Tie a reef knot and pull it tight.

    Args:
        steps: number of time steps; default: as many as the published end time takes.
        dt_factor: time step relative to the published one.
        resolution: elements across a ribbon; those along it are 1.2 times as long in the knot.
        pictures: number of states written as ParaView files, at most one a step; as often the knot is checked.
    """
    dt, frames = checks.positive("dt_factor", dt_factor) * TIME_STEP, checks.whole("pictures", pictures, 1)
    count = max(1, round(STEPS / dt_factor)) if steps is None else checks.whole("steps", steps, 1)
    results.claim()
    knot = Knot(resolution, dt)
    spline, y, v = knot.shell.spline, knot.shell.y, knot.time.xdot_old
    net, files = sampling.net(spline, (161, 7)), partial(VTUSeries, results.out / "ribbons", spline, y=y, velocity=v)
    run = results.run(knot, steps=count, frames=frames, series=[files], history={"row": lambda: knot.row})
    knots, pierced, shown, hardest = [knot.crossings()], [knot.piercings()], [surfaces(net, y)] * 3, 0.0
    for _ in run:
        if run.writes:
            knots.append(knot.crossings())
            pierced.append(knot.piercings())
            shown[2] = surfaces(net, y)
            if knot.row["held_1"] < hardest:
                hardest, shown[1] = knot.row["held_1"], shown[2]
    past, ledger, (first, second) = run.history, knot.ledger, knot.centre_lines()
    if results.viz:
        titles = ("at the start", "under the largest pull", "at the end")
        above, beside = (
            [scene(x, length="length", view=view, title=title) for x, title in zip(shown, titles, strict=True)]
            for view in (View(90.0, -90.0), View(25.0, -90.0))
        )
        stored = {name: name for name in ("work", "kinetic", "elastic", "contact", "damping", "gained")}
        energies = over_time(past, stored, y=("energy", "force length"), time="time")
        load, limit = {"load": -knot.force[0]}, {"$r_{max}$": CONTACT.kernel.r_max}
        pull = over_time(past, {"held ends": "held_1"}, y=("force along $x_1$", "force"), time="time", levels=load)
        gap = over_time(past, "distance", y=("smallest distance", "length"), time="time", levels=limit)
        draw(results.out / "reef_knot.png", above, beside, [energies, pull, gap], size=(4.7, 3.2))
    determinants = sorted({knot.determinant for knot in knots})
    if determinants != [SQUARE_KNOT] or any(pierced):
        log.warning("the ribbons went through each other: determinants %s, %d piercings", determinants, max(pierced))
    found = {
        "force_in_held_ends": -knot.row["held_1"],
        "force_of_load": knot.force[0],
        "smallest_distance": ledger.distance,
        "contact_pairs": knot.row["pairs"],
        "length_of_knot": first[:, 0].max() - second[:, 0].min(),
    }
    told = {"piercings": max(pierced), "determinants": determinants, "writhe_initial": knots[0].writhe}
    monitors = {**vars(ledger), "spacing_ratio": knot.spacing_ratio, **told}
    return results.of_run(
        run, inputs={"steps": count}, qoi=against(found, {}), monitors=monitors, time=knot.shell.time.time
    )


if __name__ == "__main__":
    script.command_line(main)
