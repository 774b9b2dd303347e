"""Pictures of a heart valve: its leaflets from the side and from downstream, and what happens over time."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from coudalfish.valves import Leaflets
from tigar_x.run.figure import Table, draw, over_time
from tigar_x.run.frames import Frames
from tigar_x.run.pictures import Colours
from tigar_x.splines.pictures import View, draw_shell, surfaces

VIEWS = View(12.0, 20.0), View(90.0, -90.0)
"""From the side, and from downstream along the third axis."""


def leaflets_movie(
    path: Path, leaflets: Leaflets, field: Any, colours: Colours, *, length: str, time: str, box: Sequence[Any]
) -> "partial[Frames]":
    """What draws the leaflets at each output of a run, and animates the pictures at its end.

    Args:
        path: of the animation, a GIF.
        leaflets: the leaflets.
        field: scalar that colours them, see :meth:`tigar_x.splines.sampling.Sampling.values`; or a function of nothing
            that gives its values at the nodes.
        colours: its scale, with both ends, so that all pictures have one.
        length: unit of length.
        time: unit of time.
        box: lowest and highest corner of what is seen, shape (2, 3); unit: length.

    Returns:
        A function of ``after``, see :class:`tigar_x.run.running.Run`.
    """
    look: dict[str, Any] = {"length": length, "colours": colours, "views": VIEWS, "box": box}

    def leaflets_at(file: Path, t: float) -> None:
        values = field() if callable(field) else field
        draw_shell(file, surfaces(leaflets.net, leaflets.y, values), title=f"t = {t:.4f} {time}", **look)

    return partial(Frames, path, leaflets_at)


def histories(path: Path, past: Table, *, length: str, time: str, force: str) -> None:
    """Flow rate, opening, pressures, contact, marks and leak over time (collective).

    Args:
        path: of the picture.
        past: history with the columns of :meth:`coudalfish.valves.Leaflets.columns` of three leaflets with contact,
            ``flow_rate``, ``pressure_before`` and ``pressure_behind``.
        length: unit of length.
        time: unit of time.
        force: unit of force.
    """
    rate, alpha = f"{length}$^3$/{time}", partial(over_time, past, time=time, over="t_alpha")
    tips = {f"leaflet {k}, free edge": f"tip_r_{k}" for k in range(3)}
    bellies = {f"leaflet {k}, belly": f"belly_r_{k}" for k in range(3)}
    pressures = {f"{place} the valve": f"pressure_{place}" for place in ("before", "behind")}
    styles = {
        name: {"color": f"C{k % 3}", "linestyle": "-" if k < 3 else "--"} for k, name in enumerate(tips | bellies)
    }
    draw(
        path,
        over_time(past, "flow_rate", y=("flow rate", rate), time=time),
        over_time(past, "opening_area", y=("area within the free edges", f"{length}$^2$"), time=time),
        alpha(pressures, y=("pressure", f"{force}/{length}$^2$")),
        alpha("contact_load", y=("load of contact", force)),
        over_time(past, tips | bellies, y=("distance from the axis", length), time=time, styles=styles),
        alpha("leak", y=("flow through the leaflets", rate)),
        size=(5.5, 2.9),
    )
