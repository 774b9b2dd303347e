"""What the relaxation of the multiplier does in long runs: growth of its patterns, leak and slip.

A sheet stands across a duct with slip walls under a steady jump of pressure, see ``stability.duct``. On a sheet that is
curved or elastic the multiplier has patterns that the fluid's velocities cannot see; the slip that these leave behind
makes them grow, step by step. Uniform relaxation bounds them and leaks; smoothed relaxation damps what differs from the
mean over the vertices of the fluid's mesh, weighted by their linear functions. Means over the points around a vertex or
in a cell are here for comparison: too many patterns are constant in the cells.
"""

import logging
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from stability_runs import long_advance, through_duct
from stability_scenes import duct

from coudalfish import CouplingOptions
from coudalfish.surface.trace import Location, PointLocator
from tigar_x import compat
from tigar_x.compat import FloatArray
from tigar_x.run import script

BETA = 50.0
SHEETS: dict[str, dict[str, Any]] = {
    "arc, points h/2 apart": {"bow": 0.1},
    "arc, points h/4 apart": {"bow": 0.1, "refined": 2},
    "elastic, points h/2 apart": {"flexible": True, "prestress": 10.0},
}
HEADER = ("sheet", "relaxation", "r", "pattern", "growth", "leak", "law", "largest slip", "outflow", "passes")


class ByCell(PointLocator):
    """Means over the points in a cell, on one rank."""

    def vertex_functions(self, location: Location) -> sp.csr_matrix:
        """One function for every cell, one in it."""
        return one_hot(location.cells)


class ByVertex(PointLocator):
    """Means over the points that are nearest to a vertex, on one rank."""

    def vertex_functions(self, location: Location) -> sp.csr_matrix:
        """One function for every vertex, one at the points that are nearest to it."""
        functions = super().vertex_functions(location)
        return one_hot(np.asarray(functions.argmax(axis=1)).ravel())


def one_hot(patches: NDArray[np.int32]) -> sp.csr_matrix:
    """Functions that are one at the points of a patch."""
    _, patch = np.unique(patches, return_inverse=True)
    return sp.csr_matrix((np.ones(len(patch)), patch, np.arange(len(patch) + 1)))


CHOICES: tuple[tuple[str, float, Callable[[Any], PointLocator] | None], ...] = (
    ("none", 0.0, None),
    *(("uniform", r, None) for r in (1e-5, 1e-3, 1e-2)),
    *(("smoothed", r, None) for r in (0.1, 1.0)),
    *(("by vertex", r, ByVertex) for r in (0.1, 1.0)),
    *(("by cell", r, ByCell) for r in (0.1, 1.0)),
)


def _pattern(lam: FloatArray, W: FloatArray) -> FloatArray:
    return lam - np.average(lam, weights=W)


def run(
    sheet: str, relaxation: str, r: float, locator: Callable[[Any], PointLocator] | None, *, n: int, steps: int
) -> dict[str, float]:
    """Load the duct smoothly, and then hold the load.

    Args:
        sheet: name of the sheet.
        relaxation: name of the relaxation.
        r: its parameter.
        locator: makes what finds the points; None: as it is.
        n: fluid cells across.
        steps: after the load has been applied.

    Returns:
        Figures by name: "pattern", the largest difference of the multiplier from its mean at the end, and "growth", its
        largest change in the last half of the steps per 1000 steps, both relative to the jump; speeds of the "leak" and
        its "law" r jump/beta, of the "largest slip" of a point and of the "outflow"; "passes" of the last step.
    """
    shape = dict(SHEETS[sheet])
    elements = 2 * n * shape.pop("refined", 1)
    mode: Any = "uniform" if relaxation in ("none", "uniform") else "smoothed"
    options = CouplingOptions(penalty=BETA, relaxation=r, relaxation_mode=mode)
    scene = duct(options, n=n, jump=0.0, elements=elements, **shape)
    fsi, W, (outflow,) = scene.fsi, scene.fsi.shell.quadrature.weights, compat.compile_forms(scene.outflow)
    if locator is not None:
        fsi.locator = locator(fsi.mesh_f)
    through_duct(scene, 100, ramp=60)
    long_advance(fsi, steps // 2)
    half = _pattern(fsi.lam, W)
    report = long_advance(fsi, steps // 2)[-1]
    monitors, pattern = report.monitors, _pattern(fsi.lam, W)
    return {
        "pattern": float(np.abs(pattern).max()),
        "growth": float(np.abs(pattern - half).max()) * 2000.0 / steps,
        "leak": monitors.leak / scene.length if monitors else math.nan,
        "law": r / BETA if mode == "uniform" else 0.0,
        "largest slip": monitors.normal_slip_max if monitors else math.nan,
        "outflow": compat.assemble_scalar(outflow),
        "passes": report.passes,
    }


def main(out: Path = Path("results/relaxation"), n: int = 12, steps: int = 2000, only: str = "") -> list[str]:
    """Run all sheets and relaxations, print the table as Markdown and write it.

    Args:
        out: folder of the results.
        n: fluid cells across.
        steps: after the load has been applied, a multiple of 200.
        only: sheets whose name contains this.

    Returns:
        The lines of the table.
    """
    logging.getLogger("coudalfish").setLevel(logging.ERROR)  # the jump is one step's change of the load
    lines = [f"| {' | '.join(HEADER)} |", f"|{' --- |' * len(HEADER)}"]
    print("\n".join(lines), flush=True)
    start = time.perf_counter()
    for sheet in SHEETS:
        for choice in CHOICES if only in sheet else ():
            figures = run(sheet, *choice, n=n, steps=steps)
            numbers = (f"{figures[name]:.2g}" for name in HEADER[3:])
            lines.append(f"| {sheet} | {choice[0]} | {choice[1]:g} | {' | '.join(numbers)} |")
            print(lines[-1], flush=True)
    out.mkdir(parents=True, exist_ok=True)
    (out / "relaxation.md").write_text("\n".join([*lines, ""]))
    print(f"\n{time.perf_counter() - start:.0f} s; written: {out / 'relaxation.md'}")
    return lines


if __name__ == "__main__":
    script.command_line(main)
