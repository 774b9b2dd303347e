"""Modes of vibration as files and pictures."""

from pathlib import Path

import numpy as np
from mpi4py import MPI

from tigar_x.fem.eigen import Eigenpairs
from tigar_x.run.figure import Panel, lines
from tigar_x.splines.sampling import line
from tigar_x.splines.spline import ExtractedSpline
from tigar_x.splines.vtu import VTUSeries


def write_modes(path: Path | str, spline: ExtractedSpline, pairs: Eigenpairs) -> None:
    """Write modes of vibration: a frame each, at the time of its circular frequency (collective).

    Args:
        path: see :class:`tigar_x.splines.vtu.VTUSeries`.
        spline: curve, surface or volume.
        pairs: homogeneous displacements; the largest displacement of a node is made one in each.
    """
    mode = spline.function(name="mode")
    with VTUSeries(path, spline, y=mode) as series:
        for value, function in zip(pairs.values, pairs.functions, strict=True):
            largest = float(np.linalg.norm(spline.nodal(function), axis=1).max(initial=0.0))
            mode.x.array[:] = function.x.array / spline.mesh.comm.allreduce(largest, op=MPI.MAX)
            series.write(float(value) ** 0.5)


def mode_curves(spline: ExtractedSpline, pairs: Eigenpairs, *, length: str, samples: int = 201) -> Panel:
    """Panel of the modes of a curve: their second component over the first coordinate, each by its largest value.

    Args:
        spline: the curve.
        pairs: modes, as homogeneous displacements.
        length: unit of length.
        samples: number of points.
    """
    points, courses = line(spline, 0, samples, patch=0), {}
    for value, mode in zip(pairs.values, pairs.functions, strict=True):
        w = points.values(mode)[:, 1]
        courses[rf"$\omega$ = {float(value) ** 0.5:.4g}"] = (points.reference[:, 0], w / w[np.argmax(np.abs(w))])
    return lines(courses, x=("$x_1$", length), y=("displacement, by its largest", "-"), title="modes")
