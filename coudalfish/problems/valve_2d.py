"""What is known of the plane valve: readings of the published tip, and a solution on a mesh that fits the leaflets.

The readings are peaks and troughs of the top tip's displacement along the channel, taken from the figure of Kamensky et
al., section 4.7, doi:10.1016/j.cma.2014.10.040. Their troughs are 0.02 above those of the solution.

The solution is that of an independent program without an immersed surface: its mesh has the leaflets' outline as a
boundary and moves with it. Leaflets have their real thickness there; what leaflets without thickness would do, as those
of a shell in the flow, is extrapolated from several thicknesses. Its error is about 0.001 either way, and it ends at
t = 1, a period of the inflow.
"""

import csv
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from tigar_x.compat import FloatArray
from tigar_x.run.course import Course

DOI, READING = "10.1016/j.cma.2014.10.040", 0.005  # accuracy with which its curve was read off; of times 0.04
TIMES, PEAKS, TROUGHS = (0.25, 1.21, 2.27), (0.579, 0.585, 0.583), (0.324, 0.324, 0.325)  # times are of the peaks
BY_NAME = {"top_peak_{}_time": TIMES, "top_peak_{}": PEAKS, "top_trough_{}": TROUGHS}
PUBLISHED = {name.format(n): x for name, values in BY_NAME.items() for n, x in enumerate(values, 1)}
"""The readings by what they are of."""
START = 0.15
"""From here on curves are compared: before, they hang on how the inflow sets in, which goes by time steps."""


@cache
def body_fitted() -> dict[str, FloatArray]:
    """Times "t", and displacements "thick_x", "thick_y", "thin_x", "thin_y" of the tip; shape (200,) each.

    "thick" is of the real thickness, "thin" of none; x is along the channel, y across it.
    """
    with open(Path(__file__).with_suffix(".csv"), newline="") as file:
        names, *rows = csv.reader(file)
    return dict(zip(names, np.array(rows, dtype=float).T, strict=True))


def off_body_fitted(t: FloatArray, x: FloatArray) -> dict[str, float]:
    """Root mean squares, over START <= t <= 1, of how far a tip's displacement along the channel is from the solution.

    Args:
        t: times, increasing; shape (samples,).
        x: displacement of the top tip then, shape (samples,).

    Returns:
        "top_rms_thick" and "top_rms_thin", as far as the samples go; nothing where they end before START.
    """
    known = body_fitted()
    within = Course(t, x).between(START, known["t"][-1])
    if not len(within):
        return {}
    exact = {of: np.interp(within.t, known["t"], known[f"{of}_x"]) for of in ("thick", "thin")}
    return {f"top_rms_{of}": Course(within.t, (within.y - there) ** 2).mean ** 0.5 for of, there in exact.items()}


def swings(tip: Course) -> dict[str, float]:
    """Peaks and troughs of a tip's displacement along the channel, a period apart, with their times, and its end.

    Args:
        tip: its course.

    Returns:
        By name, such as "peak_1", "peak_1_time", "trough_1" and "end".
    """
    found = {"end": float(tip.y[-1])}
    for name, extreme in tip.extremes(1.0, 0.6, accuracy=READING).items():
        found |= {name: extreme.value, f"{name}_time": extreme.t}
    return found


def known_points() -> dict[str, tuple[Any, Any]]:
    """Times and displacements of the top tip along the channel, for pictures, by what they are."""
    t, x = (body_fitted()[name][7::8] for name in ("t", "thin_x"))
    return {"published peaks": (TIMES, PEAKS), "body-fitted": (t, x)}
