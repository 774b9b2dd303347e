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

from dataclasses import dataclass
from math import pi
from pathlib import Path
from typing import Any, Literal

import numpy as np
import ufl
from mpi4py import MPI
from dolfinx import fem

from shnapr.loads import dead_load
from shnapr.stress import resultants
from shnapr.supports import pinned
from shnapr.svk import StVenantKirchhoff
from shnapr.work import internal_tangent, internal_work
from tigar_x import checks
from tigar_x.compat import FloatArray
from tigar_x.geometry import surfaces
from tigar_x.geometry.functions import Cells
from tigar_x.ranks import root_only
from tigar_x.run import script
from tigar_x.run.progress import Stopwatch, peak_rss_mib
from tigar_x.run.summary import Quantity, table, write_summary
from tigar_x.run.writing import claim
from tigar_x.splines.spline import ExtractedSpline
from tigar_x.splines.spline_system import SplineSystem
from tigar_x.splines.vtu import VTUSeries

PUBLISHED = 0.3006
TOY = {"degree": 3, "elements": 4}
CELLS: dict[str, Cells] = {"quad": "tensor", "tri": "simplex"}
STAGES = ("geometry and extraction", "forms", "M^T A M", "solve")


@dataclass(frozen=True)
class Data:
    """The problem's data; consistent units."""

    radius: float = 25.0
    length: float = 50.0
    half_angle: float = 40.0 * pi / 180.0
    thickness: float = 0.25
    youngs_modulus: float = 4.32e8
    poisson_ratio: float = 0.0
    load: float = 90.0


class Roof:
    """The loaded roof.

    Args:
        data: the problem's data.
        degree: of the splines, 2 or more.
        elements: per side.
        cells: "quad" or "tri".
        quadrature: degree of all integrals; None: twice the splines'.

    Attributes:
        spline: the midsurface, u along the axis and v around.
        y: displacement.
        costs: stopwatch of every stage.
    """

    def __init__(
        self, data: Data, degree: int, elements: int, cells: str = "quad", quadrature: int | None = None
    ) -> None:
        self.data = data
        self.costs = {stage: Stopwatch() for stage in STAGES}
        p, n = checks.whole("degree", degree, 2), checks.whole("elements", elements, 1)
        kind = CELLS[checks.choice("cells", cells, tuple(CELLS))]
        with self.costs["geometry and extraction"]:
            patch = surfaces.cylinder_panel(
                radius=data.radius, length=data.length, angle=2 * data.half_angle, elements=(n, n), degrees=(p, p)
            )
            diaphragms = pinned(patch, "end_0", "end_1", components=(1, 2))
            against_sliding = patch.dofs(patch.side("end_0")[:1], (0,))
            fixed = np.concatenate([diaphragms, against_sliding])
            spline = self.spline = ExtractedSpline(patch, cells=kind, quadrature_degree=quadrature, zero_dofs=fixed)
        with self.costs["forms"]:
            self.y = spline.function(name="y")
            self._rest = spline.function(name="rest")
            self.system = SplineSystem(spline, *self._forms(), unknown=self.y)

    def _forms(self) -> tuple[ufl.Form, ufl.Form]:
        """Residual and tangent at rest."""
        spline, data, rest, z = self.spline, self.data, self._rest, ufl.TestFunction(self.spline.V)
        E, nu, h, f = (
            fem.Constant(spline.mesh, value)
            for value in (data.youngs_modulus, data.poisson_ratio, data.thickness, data.load)
        )
        self.material = StVenantKirchhoff(E, nu, h)
        weight = dead_load(spline, f * ufl.as_vector([0.0, 0.0, -1.0]), z)
        residual = internal_work(spline, self.material, rest, z) + weight
        return residual, internal_tangent(spline, self.material, rest, z, rest)

    def solve(self) -> None:
        """Carry the load."""
        with self.costs["forms"]:
            self.system.assemble_residual()
            self.system.integrate_tangent()
        with self.costs["M^T A M"]:
            self.system.extract_tangent()
        with self.costs["solve"]:
            self.system.subtract(self.system.solve())

    @property
    def unknowns(self) -> int:
        """Number of spline coefficients that move."""
        return self.spline.geometry.n * 3 - len(self.spline.zero_dofs)

    def sinking(self) -> float:
        """How far the midpoint of a straight edge moves down."""
        return float(-self.spline.evaluate(self.y, [[0.5, 1.0]])[0, 2])

    def resultants(self) -> tuple[Any, Any]:
        """Membrane forces and bending moments of the linear theory as UFL expressions, shape (2, 2) each."""
        at_rest = resultants(self.spline, self.material, self._rest)
        n, m = (ufl.derivative(force, self._rest, self.y) for force in (at_rest.n, at_rest.m))
        return n, m


def main(
    degree: int = 3,
    elements: int = 16,
    cells: Literal["quad", "tri"] = "quad",
    quadrature: int | None = None,
    out: Path = Path("results/scordelis_lo"),
    overwrite: bool = False,
    viz: bool = True,
) -> dict[str, Any]:
    """Load the Scordelis-Lo roof and compare its deflection with the published one.

    Args:
        degree: of the splines, 2 or more.
        elements: per side of the whole roof.
        cells: quadrilaterals, or triangles (of twice the degree) as finite elements under the splines.
        quadrature: degree of all integrals; default: twice that of the splines.
        out: folder of the results.
        overwrite: whether to delete the results of an earlier run in this folder.
        viz: whether to write a ParaView file with forces and moments and a picture.

    Returns:
        The summary.
    """
    claim(out, overwrite=overwrite)
    roof = Roof(Data(), degree, elements, cells, quadrature)
    roof.solve()
    memory, w = peak_rss_mib(), roof.sinking()
    if viz:
        write_resultants(out / "scordelis_lo", roof)
        draw(out / "scordelis_lo.png", roof)

    costs = {stage: watch.cpu_s for stage, watch in roof.costs.items()}
    inputs = {"degree": degree, "elements": elements, "cells": cells, "data": roof.data}
    inputs["quadrature"] = roof.spline.quadrature_degree
    summary = write_summary(
        out,
        "scordelis_lo",
        inputs,
        errors={"sinking": abs(w / PUBLISHED - 1.0)},
        qoi={"sinking": Quantity(w, PUBLISHED)},
        unknowns=roof.unknowns,
        nonzeros=int(roof.system.A.getInfo()["nz_used"]),
        stages_cpu_s=costs,
        solver_peak_rss_mib=MPI.COMM_WORLD.allreduce(memory, op=MPI.MAX),
        steps=1,
        wall_s=sum(watch.wall_s for watch in roof.costs.values()),
        cpu_s=sum(costs.values()),
    )
    if MPI.COMM_WORLD.rank == 0:
        print(f"degree {degree}, {elements} x {elements} elements ({cells}), {roof.unknowns} unknowns")
        print(f"the midpoint of a straight edge sinks by {w:.6f}; published: {PUBLISHED} (Kiendl 2011)")
        print(table(("stage", "CPU s"), costs.items()))
        print(f"peak memory {summary['solver_peak_rss_mib']:.0f} MiB")
    return summary


def write_resultants(path: Path, roof: Roof) -> None:
    """The deformed roof with forces (N_11, N_22, N_12) and moments, 1 along the axis and 2 around."""
    spline = roof.spline
    fields = {}
    for name, T in zip(("membrane_forces", "moments"), roof.resultants(), strict=True):
        fields[name] = spline.project(ufl.as_vector([T[0, 0], T[1, 1], T[0, 1]]))
    with VTUSeries(path, spline, y=roof.y, **fields) as series:
        series.write(0.0)


def draw(path: Path, roof: Roof, scale: float = 10.0) -> None:
    """The deformed roof in space with its vertical displacement, and the latter across the middle and along an edge."""
    spline, samples = roof.spline, 81
    s = np.linspace(0.0, 1.0, samples)
    xi = np.stack(np.meshgrid(s, s, indexing="ij"), axis=-1)
    middles = (xi[1:, 1:] + xi[:-1, :-1]) / 2
    y, faces = (spline.evaluate(roof.y, points.reshape(-1, 2)) for points in (xi, middles))
    picture(path, roof, spline.geometry.evaluate(xi.reshape(-1, 2)).reshape((*xi.shape[:2], 3)), y, faces, scale)


@root_only
def picture(path: Path, roof: Roof, X: FloatArray, y: FloatArray, faces: FloatArray, scale: float) -> None:
    """What :func:`draw` shows, from displacements on a grid of points X and in the middle of its faces."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import LightSource, Normalize

    samples, y = len(X), y.reshape(X.shape)
    x = X + scale * y
    colours = ScalarMappable(Normalize(y[..., 2].min(), y[..., 2].max()), "viridis")
    light = LightSource(azdeg=180.0, altdeg=35.0).shade_normals(normals(x))[..., None]
    paint = (0.55 + 0.45 * light) * colours.to_rgba(faces[:, 2].reshape(samples - 1, samples - 1))[..., :3]

    figure = plt.figure(figsize=(13, 5))
    space = figure.add_axes((0.02, 0.02, 0.46, 0.94), projection="3d", computed_zorder=False)
    bar, plane = figure.add_axes((0.54, 0.2, 0.012, 0.6)), figure.add_axes((0.67, 0.12, 0.31, 0.78))
    free = {"rstride": 1, "cstride": 1, "shade": False, "antialiased": False, "clip_on": False}
    space.plot_surface(*np.moveaxis(x, -1, 0), facecolors=paint, **free)
    for line in (X[0], X[-1], X[:, 0], X[:, -1]):
        space.plot(*line.T, color="0.3", linewidth=0.8, linestyle="--", zorder=5, clip_on=False)
    space.set_box_aspect(np.ptp(X.reshape(-1, 3), axis=0), zoom=1.45)
    space.view_init(elev=28.0, azim=-52.0)
    space.set_axis_off()
    space.set_title(f"deformed roof, displacements x {scale:g}", y=0.94)
    figure.colorbar(colours, cax=bar, label="vertical displacement")

    angle = np.degrees(roof.data.half_angle)
    plane.plot(np.linspace(-angle, angle, samples), y[samples // 2, :, 2], "C0-", label="computed")
    plane.plot((-angle, angle), (-PUBLISHED, -PUBLISHED), "ko", label=f"published: {-PUBLISHED}")
    plane.set(xlabel="angle from the crown [degrees]", ylabel="vertical displacement", title="middle section")
    plane.grid(True, linewidth=0.4)
    plane.legend()
    figure.savefig(path, dpi=130)
    plt.close(figure)


def normals(x: FloatArray) -> FloatArray:
    """Unit normals of the faces of a grid of points, shape (rows - 1, columns - 1, 3)."""
    n = np.cross(x[1:, 1:] - x[:-1, :-1], x[:-1, 1:] - x[1:, :-1])
    return np.asarray(n / np.linalg.norm(n, axis=-1, keepdims=True))


if __name__ == "__main__":
    script.command_line(main)
