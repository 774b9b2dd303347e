"""Flow around a cylinder in a channel at any Reynolds number: steady flow, or vortices that it sheds.

The channel (0, 2.2) x (0, 0.41) holds a cylinder of diameter D = 0.1 slightly below its middle. The fluid enters with
a parabola of mean speed U = 1, does not slip on walls and cylinder, and leaves freely. With Re = U D/nu and the force F
on the cylinder per unit depth, the coefficients of drag and lift are 2 F/(rho U^2 D); dp is the difference of pressure
over rho U^2 between the foremost and the rearmost point of the cylinder, and St = f D/U the Strouhal number of the
lift's frequency f.

Sources: Schaefer and Turek, doi:10.1007/978-3-322-89849-4_39 (Re = 100: the middle of the intervals given there); John
and Matthies, doi:10.1002/fld.195 (Re = 20). Cells have straight edges, so that the cylinder is a polygon.
"""

from functools import partial
from typing import Any

import numpy as np

from tigar_x import History, PlaneField, Results, Tally, against, draw, over_time, script, with_results
from varmint.flow.movie import movie
from varmint.problems.cylinder import DIAMETER, PUBLISHED, SPEED, Channel, Coefficients
from varmint.quantities import Measured, squared_divergence, vorticity

TOY = {"reynolds": 20.0, "size": 0.15, "dt": 0.1, "until": 0.5, "steady": False}


def periodic(past: History) -> dict[str, float]:
    """Extremes over the last two fifths of a run, and the Strouhal number."""
    drag, lift = (past.course(name, "t_alpha").last(share=0.4) for name in ("drag", "lift"))
    found = {"drag_max": drag.y.max(), "drag_min": drag.y.min(), "lift_max": lift.y.max(), "lift_min": lift.y.min()}
    oscillates = np.ptp(lift.y) > 1e-3 and np.isfinite(lift.frequency())
    return found | ({"strouhal": lift.frequency() * DIAMETER / SPEED} if oscillates else {})


@with_results
def main(results: Results, channel: Channel, until: float = 8.0) -> dict[str, Any]:
    """Compute the flow around a cylinder in a channel, with the history of drag and lift.

    Args:
        until: end of the unsteady flow.
    """
    flow = channel.build()
    flow.compile()
    measure, curl, divergence = Coefficients(flow), vorticity(flow), Measured(square=squared_divergence(flow))
    files, panels = movie(flow, results.out / "flow.vtkhdf", vorticity=(curl, (0,))), []
    if channel.steady:
        results.claim()
        costs = Tally({}).once(flow.solve).results()
        summary = partial(results.summary, **costs, steps=1, dofs_fluid=flow.unknowns)
        found = dict(zip(("drag", "lift", "dp"), measure(), strict=True))
    else:
        columns = {"t_alpha": "t_alpha", ("drag", "lift", "dp"): "measured", "newton_iterations": "iterations"}
        run = results.run(flow, until=until, frames=40, series=[files], measure=measure, history=columns).through()
        summary, found, names = partial(results.of_run, run), periodic(run.history), {"drag": "drag", "lift": "lift"}
        panels.append(over_time(run.history, names, y=("coefficient", "-"), time="-", over="t_alpha"))
    if results.viz:
        if channel.steady:
            files().once()
        swirl = PlaneField(curl()).signed("vorticity", "-", share=0.15, length="-")
        flowing = PlaneField(flow.w).speed("-", length="-")
        draw(results.out / "cylinder.png", flowing, swirl, *panels, columns=1, size=(10.0, 2.6))
    doi, known = PUBLISHED.get((float(channel.reynolds), channel.steady), (None, {}))
    return summary(qoi=against(found, known, doi), monitors={"divergence": divergence()["square"] ** 0.5})


if __name__ == "__main__":
    script.command_line(main)
