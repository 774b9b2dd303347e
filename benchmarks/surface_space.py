"""What settings of the coupling and of the flow's fields do at an immersed surface in space: error, time and memory.

The scenes are those of ``space.py`` and the modules that it names; settings and tables are those of ``surface.py``.
"""

from dataclasses import replace
from pathlib import Path

from space import IN_SPACE, VALVE_NUMBERS, Fence, HeldSurface
from space_bodies import Obstacle, Sphere
from space_contact import Pair
from space_gaps import Hole, Slit
from space_membrane import Membrane
from surface import Study, jobs, tabulate

from tigar_x.run import script

JUMPS = (1.0, 1e2, 1e3, 1e5)
AT_REST = ("velocity", "highest", "leak", "pressure", "load", "pattern", "iterations")
TILTED = HeldSurface(curved=0.0, slope=(0.31, 0.17))
GAPS = (0.25, 0.5, 1.0, 2.0, 4.0)
IN_GAPS = ("flow", "leak", "change")
ERRORS = ("L2_u", "H1_u", "L2_p", "L2_y", "H1_y")
STUDIES: dict[str, Study] = {
    "membrane, one layer": (ERRORS, {f"level {n}": Membrane(n) for n in (2, 3)}),
    "membrane, curved": (ERRORS, {f"level {n}": Membrane(n, curved=True) for n in (1, 2, 3)}),
    "dome": (AT_REST, {f"n {n}": HeldSurface(n) for n in (8, 16, 24)}),
    "dome, jump": (AT_REST, {f"{jump:g}": HeldSurface(jump=jump, dt=jump**-0.5) for jump in JUMPS}),
    "dome, weak walls": (AT_REST, {f"n {n}": HeldSurface(n, weak=True) for n in (8, 16)}),
    "tilted plate": (AT_REST, {f"n {n}": replace(TILTED, n=n) for n in (8, 16, 24)}),
    "tilted plate, jump": (
        AT_REST,
        {f"{jump:g}": replace(TILTED, jump=jump, dt=jump**-0.5) for jump in JUMPS},
    ),
    "valve numbers": (AT_REST, {"n 8": VALVE_NUMBERS, "n 8, weak walls": replace(VALVE_NUMBERS, weak=True)}),
    "sphere": (
        ("velocity", "volume", "inside", "pressure", "load", "pattern", "roundness"),
        {f"n {n}": Sphere(n) for n in (8, 16, 24)} | {"jump 1e5": Sphere(jump=1e5, dt=0.05 * 1e5**-0.5)},
    ),
    "fence": (("tip", "drag", "leak", "wobble"), {f"n {n}": Fence(n) for n in (8, 12, 16)}),
    "slit, one layer": (IN_GAPS, {f"gap {gap:g} h": Slit(gap) for gap in GAPS}),
    "slit, one layer, Re 10": (IN_GAPS, {f"gap {gap:g} h": Slit(gap, reynolds=10.0) for gap in GAPS[2:]}),
    "slit, four layers": (IN_GAPS, {f"gap {gap:g} h": Slit(gap, layers=4) for gap in GAPS}),
    "hole": (("flow", "discharge", "leak", "change"), {f"gap {gap:g} h": Hole(gap) for gap in GAPS}),
    "hole, Re 20": (
        ("flow", "discharge", "leak", "change"),
        {f"gap {gap:g} h": Hole(gap, reynolds=20.0) for gap in GAPS[2:]},
    ),
    "pair": (
        ("velocity", "highest", "leak", "force", "distance", "contact", "iterations"),
        {f"{apart:g} h, held": Pair(apart) for apart in (0.2, 0.5)}
        | {f"{apart:g} h, touching": Pair(apart, touching=True) for apart in (0.2, 0.5)},
    ),
    "obstacle": (
        ("drag", "change", "slip"),
        {f"n {n}": Obstacle(n) for n in (8, 12, 16)}
        | {f"n {n}, dt / 10": Obstacle(n, 0.01, before=0.1) for n in (8, 12, 16)},
    ),
}


def main(
    settings: str = "plain; converged; jump; sharp", only: str = "", out: Path = Path("results/surface_space")
) -> None:
    """Run the scenes with the settings; print a table for each study as Markdown, and write them all as CSV.

    Args:
        settings: separated by semicolons, see ``surface.py``.
        only: run the cases whose study and name, "hole: gap 2 h", contain this.
        out: folder of the results.
    """
    tabulate(jobs(only, STUDIES), settings, out / "surface_space.csv", IN_SPACE)


if __name__ == "__main__":
    script.command_line(main)
