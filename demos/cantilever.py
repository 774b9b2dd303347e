"""A cantilever under an end shear or an end moment: large rotations of a thin strip, and what thinness costs.

A strip of length L = 10, width b = 1 and thickness h = 0.1, of E = 1.2e6 and nu = 0, is clamped at one end. At the
other end acts either a dead force across it, up to P L^2/(E I) = 4 (which is P = 4), or a moment, up to M = 2 pi E I/L,
which rolls it into a full circle. With U along and W across the strip, the tip under M = t E I/L is at

    U = L (sin(t)/t - 1),   W = L (1 - cos(t))/t,

if the strip keeps its length. A Kirchhoff-Love shell of St. Venant-Kirchhoff material does not quite: its energy
E h eps^2/2 + E I kappa^2/2 in terms of Green's strain and of kappa = s^(1/2) theta' has its minimum at

    s - 1 = -(h theta')^2/6,   theta' = M/(E I s),   s the squared stretch,

so when it is rolled up it is shorter by 0.03 % at h/L = 0.01, and by 4 % at h/L = 0.1, where its angle is 8 % more than
2 pi. The tip is compared with both solutions: the first tells how good the theory is, the second how good the splines.

In the plane the strip is a curve, per unit of depth; in space it is a surface of one element across. With displacements
alone splines of low degree lock as the strip becomes thinner; with membrane forces as unknowns (`shnapr.mixed`) they do
not. `--study` compares the two for h/L = 1e-1 ... 1e-4 under loads that bend all these strips alike.

Source: K. Y. Sze, X. H. Liu, S. H. Lo, "Popular benchmark problems for geometric nonlinear analysis of shells",
sections 3.1 and 3.2, doi:10.1016/j.finel.2003.11.001.
"""

from functools import partial
from math import pi
from pathlib import Path
from typing import Any

from shnapr.problems.cantilever import DOI, PUBLISHED, Strip, circle, thickness_study
from tigar_x import Quantity, Results, VTUSeries, script, with_results
from tigar_x.run.figure import draw, lines
from tigar_x.run.loading import LoadPath
from tigar_x.run.pictures import Colours
from tigar_x.run.summary import table
from tigar_x.splines import sampling
from tigar_x.splines.pictures import family

TOY = {"degree": 3, "elements": 4}


@with_results
def main(results: Results, strip: Strip, study: bool = False) -> dict[str, Any]:
    """Bend a cantilever by a force or a moment at its end and compare its tip with published or exact positions.

    Args:
        study: whether to compare degrees, formulations and thicknesses of 1e-1 to 1e-4 of the length as well.
    """
    shell, shown = strip.shell(), []
    results.claim()
    series, middle = (
        [partial(VTUSeries, results.out / "cantilever", shell.spline, y=shell.y)],
        sampling.line(shell.spline, 0, 201),
    )
    path = strip.bend(shell, results=results, series=series, each=lambda t: shown.append(middle.positions(shell.y)[0]))
    rows = thickness_study(strip) if study else None
    known, doi = (PUBLISHED, DOI) if strip.load == "shear" else ({t: circle(2 * pi * t) for t in PUBLISHED}, None)
    qoi = {}
    for i, t in enumerate(path.loads):
        if t in PUBLISHED:
            qoi |= {f"{x}({t:g})": Quantity(path.history[x][i], known[t][k], doi) for k, x in enumerate("UW")}
    if results.viz:
        draw_path(results.out / "cantilever.png", path, shown, known, rows, strip)
    if rows:
        results.say(table(rows[0], [row.values() for row in rows]))
    return results.of_path(path, doi=doi, errors=strip.errors(path), qoi=qoi, study=rows, unknowns=shell.unknowns)


def draw_path(path: Path, way: LoadPath, shown: list[Any], known: dict[float, Any], rows: Any, strip: Strip) -> None:
    """Deformed shapes, the way of the tip with the known positions, and the errors of the study."""
    tip = {name: (way.loads, way.history[name]) for name in "UW"}
    points = {f"{name}, known": (list(known), [value[k] for value in known.values()]) for k, name in enumerate("UW")}
    styles = {name: {"fmt": "ko", "fillstyle": "none"} for name in points}
    panels = [
        family(
            shown,
            length="length",
            colours=Colours("load factor", "-"),
            values=way.loads,
            coordinates=(0, strip.dim - 1),
        ),
        lines(tip | points, x=("load factor", "-"), y=("displacement of the tip", "length"), styles=styles),
    ]
    if rows:
        name, runs = list(rows[0])[-2], {}
        for row in (row for row in rows if row[name] != "failed"):
            x, y = runs.setdefault(f"p = {row['degree']}, {row['formulation']}", ([], []))
            x.append(row["h/L"])
            y.append(row[name])
        panels.append(lines(runs, x=("h/L", "-"), y=(f"error {name}", "-"), xscale="log", yscale="log"))
    draw(path, *panels, columns=3)


if __name__ == "__main__":
    script.command_line(main)
