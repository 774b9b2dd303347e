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

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import cos, pi, sin
from pathlib import Path
from typing import Any, Literal

import numpy as np
import ufl
from mpi4py import MPI
from dolfinx import fem
from scipy.optimize import brentq

from shnapr import mixed
from shnapr.loads import edge_moment, edge_traction
from shnapr.supports import pinned
from shnapr.svk import StVenantKirchhoff
from shnapr.work import internal_tangent, internal_work
from tigar_x import checks
from tigar_x.compat import FloatArray
from tigar_x.fem.linear import SolveError
from tigar_x.fem.load_stepping import LoadReport, StepControl, follow_load
from tigar_x.fem.time_integration import LoadStepper
from tigar_x.geometry import shapes
from tigar_x.ranks import root_only
from tigar_x.run import script
from tigar_x.run.progress import Stopwatch
from tigar_x.run.summary import Quantity, table, write_summary
from tigar_x.run.writing import claim
from tigar_x.splines.constraints import no_rotation
from tigar_x.splines.spline import ExtractedSpline
from tigar_x.splines.spline_system import SplineSystem
from tigar_x.splines.vtu import VTUSeries

DOI = "10.1016/j.finel.2003.11.001"
PUBLISHED = {0.25: (-0.563, 3.015), 0.5: (-1.604, 4.933), 1.0: (-3.286, 6.698)}  # U, W by P/P_max
LOADS = tuple(PUBLISHED)
TOY = {"degree": 3, "elements": 4}
THINNESS = (1e-1, 1e-2, 1e-3, 1e-4)
Formulation = Literal["displacement", "mixed"]


@dataclass(frozen=True)
class Data:
    """The problem's data; consistent units."""

    length: float = 10.0
    width: float = 1.0
    thickness: float = 0.1
    youngs_modulus: float = 1.2e6

    @property
    def bending_stiffness(self) -> float:
        """E I per width."""
        return self.youngs_modulus * self.thickness**3 / 12

    def full_load(self, load: str) -> float:
        """The largest force or moment per width."""
        return self.bending_stiffness * (4 / self.length**2 if load == "shear" else 2 * pi / self.length)


def circle(t: float, data: Data) -> tuple[float, float]:
    """U and W under M = t E I/L of a strip that keeps its length."""
    return data.length * (sin(t) / t - 1), data.length * (1 - cos(t)) / t


def rolled_shell(t: float, data: Data) -> tuple[float, float]:
    """U and W under M = t E I/L of a Kirchhoff-Love shell of St. Venant-Kirchhoff material."""
    c = (data.thickness * t / data.length) ** 2 / 6
    s = brentq(lambda s: s**2 * (s - 1) + c, 2 / 3, 1.0, xtol=1e-15)
    angle, length = t / s, data.length * s**0.5
    return length * sin(angle) / angle - data.length, length * (1 - cos(angle)) / angle


class Strip:
    """The clamped strip with its equilibrium at a multiple of the full load.

    Args:
        data: the problem's data.
        load: "shear" or "moment".
        dim: 2 for a curve in the plane, 3 for a surface in space.
        degree: of the splines, 2 or more.
        elements: along the strip.
        formulation: displacements alone, or with membrane forces.

    Attributes:
        spline: the midsurface.
        space: of the unknown.
        time: the multiple of the load.
        system: equilibrium.
        y: displacement, as of the last :meth:`update`.
    """

    def __init__(
        self, data: Data, load: str, dim: int, degree: int, elements: int, formulation: Formulation = "displacement"
    ) -> None:
        self.data, self.load, self.dim = data, checks.choice("load", load, ("shear", "moment")), dim
        self._mixed = checks.choice("formulation", formulation, ("displacement", "mixed")) == "mixed"
        p, n = checks.whole("degree", degree, 2), checks.whole("elements", elements, 1)
        if checks.choice("dim", dim, (2, 3)) == 2:
            patch = shapes.line((0.0, 0.0), (data.length, 0.0), elements=n, degree=p)
        else:
            patch = shapes.strip(length=data.length, width=data.width, elements=(n, 1), degrees=(p, p))
        held = {"zero_dofs": pinned(patch, "u0"), "constraints": [no_rotation(patch, "u0")]}
        spline = self.spline = ExtractedSpline(patch, **held)
        # positive moments turn the end towards a_3, which points down in the plane and up in space
        full = {load: data.full_load(load) * (-1.0 if (load, dim) == ("moment", 2) else 1.0)}
        values = (data.youngs_modulus, data.thickness, full.get("shear", 0.0), full.get("moment", 0.0))
        E, h, force, moment = (fem.Constant(spline.mesh, value) for value in values)
        material = StVenantKirchhoff(E, 0.0, h)
        self.y = spline.function(name="y")
        if self._mixed:
            space = self.space = mixed.mixed_space(spline)
            w, test = fem.Function(space.V), ufl.TestFunction(space.V)
            y, z = (mixed.displacement_part(spline, field) for field in (w, test))
            residual, tangent = (form(spline, material, w, test) for form in (mixed.mixed_work, mixed.mixed_tangent))
        else:
            self.space = spline.vector
            y = w = self.y
            z = ufl.TestFunction(spline.V)
            residual, tangent = internal_work(spline, material, y, z), internal_tangent(spline, material, y, z, y)

        self.time, end = LoadStepper(w, 1.0), spline.ds("u1")
        rolling = edge_moment(spline, self.time.t * moment, y, z, end)
        residual += rolling + edge_traction(spline, self.time.t * force * ufl.as_vector(np.eye(dim)[-1]), z, end)
        self.system = SplineSystem(self.space, residual, tangent + ufl.derivative(rolling, w), unknown=w)

    def update(self) -> None:
        """Bring the displacement to the present state."""
        if self._mixed:
            self.y.x.array[:] = mixed.displacement(self.spline, self.space, self.time.x).x.array

    def middle_line(self, samples: int = 201) -> FloatArray:
        """Present positions along and across the strip on its middle line, shape (samples, 2)."""
        xi = np.full((samples, self.spline.dim), 0.5)
        xi[:, 0] = np.linspace(0.0, 1.0, samples)
        x = self.spline.geometry.evaluate(xi) + self.spline.evaluate(self.y, xi)
        return np.asarray(x[:, [0, -1]])


@dataclass(frozen=True)
class LoadPath:
    """A strip that has been loaded.

    Attributes:
        strip: in its final state.
        loads: multiples of the full load, from 0.
        lines: middle lines in these states.
        newton: how the load was reached, up to every one of ``LOADS``.
        costs: of the solution without compilation and output.
    """

    strip: Strip
    loads: list[float]
    lines: list[FloatArray]
    newton: list[LoadReport]
    costs: Stopwatch

    @property
    def tips(self) -> FloatArray:
        """U and W in all states, shape (states, 2)."""
        return np.array([line[-1] for line in self.lines]) - self.lines[0][-1]

    def tip(self, load: float) -> tuple[float, float]:
        """U and W at a multiple of the full load."""
        U, W = self.tips[self.loads.index(load)]
        return float(U), float(W)

    @property
    def iterations(self) -> int:
        """Newton iterations of all converged steps."""
        return sum(sum(report.iterations) for report in self.newton)


def follow(strip: Strip, each: Callable[[float], None] | None = None) -> LoadPath:
    """Raise the load to its full value by way of every one of ``LOADS``."""
    watch, extra = Stopwatch(), Stopwatch()
    path = LoadPath(strip, [0.0], [strip.middle_line()], [], watch)

    def record(t: float) -> None:
        with extra:
            strip.update()
            path.loads.append(t)
            path.lines.append(strip.middle_line())
            if each is not None:
                each(t)

    # Membrane forces, whose rounding is that of E h, stand against a load of E I/L^2.
    rounding = 40 * np.finfo(float).eps * 12 * (strip.data.length / strip.data.thickness) ** 2
    with watch:
        full = strip.system.assemble_residual()
        strip.time.step_size = 0.1
        for load in LOADS:
            path.newton.append(
                follow_load(
                    strip.system,
                    strip.time,
                    until=load,
                    control=StepControl(smallest=1e-4, largest=0.1),
                    each=record,
                    reference=full,
                    rtol=max(1e-8, rounding),
                    max_iterations=40,
                )
            )
    watch.wall_s -= extra.wall_s
    watch.cpu_s -= extra.cpu_s
    return path


def main(
    load: Literal["shear", "moment"] = "shear",
    dim: Literal[2, 3] = 2,
    degree: int = 3,
    elements: int = 16,
    thickness: float = 0.1,
    formulation: Formulation = "displacement",
    study: bool = False,
    out: Path = Path("results/cantilever"),
    overwrite: bool = False,
    viz: bool = True,
) -> dict[str, Any]:
    """Bend a cantilever by a force or a moment at its end and compare its tip with published or exact positions.

    Args:
        load: dead force across the strip, or moment.
        dim: 2: a curve in the plane; 3: a surface in space.
        degree: of the splines, 2 or more.
        elements: along the strip.
        thickness: up to a tenth of the length, which is 10; published positions are for 0.1.
        formulation: displacements alone, or with membrane forces as unknowns, which does not lock.
        study: whether to compare degrees, formulations and thicknesses of 1e-1 to 1e-4 of the length as well.
        out: folder of the results.
        overwrite: whether to delete the results of an earlier run in this folder.
        viz: whether to write ParaView files and pictures.

    Returns:
        The summary.
    """
    data = Data()
    if checks.positive("thickness", thickness) > data.length / 10:
        raise ValueError(f"thickness = {thickness}: at most {data.length / 10:g}, a tenth of the length, is allowed")
    data = replace(data, thickness=thickness)
    claim(out, overwrite=overwrite)
    strip = Strip(data, load, dim, degree, elements, formulation)
    pictures = VTUSeries(out / "cantilever", strip.spline, y=strip.y) if viz else None
    path = follow(strip, pictures.write if pictures else None)
    table = thickness_study(load, dim, elements) if study else None
    if pictures:
        pictures.close()
        draw(out, path, table)

    qoi = {f"{name}({t:g})": value for t in LOADS for name, value in zip("UW", quantities(path, t), strict=True)}
    inputs = {"load": load, "dim": dim, "degree": degree, "elements": elements, "formulation": formulation}
    summary = write_summary(
        out,
        "cantilever",
        inputs | {"data": data},
        errors=errors(path),
        qoi=qoi,
        study=table,
        steps=len(path.loads) - 1,
        newton_iterations=path.iterations,
        cuts=sum(sum(report.cuts) for report in path.newton),
        unknowns=strip.system.b.getSize() - len(strip.space.zero_dofs),
        wall_s=path.costs.wall_s,
        cpu_s=path.costs.cpu_s,
    )
    if MPI.COMM_WORLD.rank == 0:
        report(summary, path)
    return summary


def quantities(path: LoadPath, t: float) -> tuple[Quantity, Quantity]:
    """U and W at a multiple of the full load, beside what is published (shear) or exact (moment)."""
    U, W = path.tip(t)
    strip = path.strip
    known, doi = (PUBLISHED[t], DOI) if strip.load == "shear" else (circle(2 * pi * t, strip.data), None)
    return Quantity(U, known[0], doi), Quantity(W, known[1], doi)


def errors(path: LoadPath) -> dict[str, float]:
    """Shear: largest relative deviation of U and of W from the published ones. Moment: distances of the tip by L.

    ``closing`` is the gap that is left in the circle; ``tip`` and ``tip_shell`` are the largest distances on the way
    from the circle and from the exact solution of this shell.
    """
    strip, data = path.strip, path.strip.data
    if strip.load == "shear":
        computed, known = (np.array([f(t) for t in LOADS]) for f in (path.tip, PUBLISHED.__getitem__))
        return dict(zip("UW", np.abs(computed / known - 1).max(axis=0).tolist(), strict=True))
    angles = 2 * pi * np.array(path.loads[1:])
    apart = {"closing": float(np.hypot(*(path.tips[-1] - circle(2 * pi, data))) / data.length)}
    for name, exact in (("tip", circle), ("tip_shell", rolled_shell)):
        distances = path.tips[1:] - [exact(t, data) for t in angles]
        apart[name] = float(np.linalg.norm(distances, axis=1).max() / data.length)
    return apart


def report(summary: dict[str, Any], path: LoadPath) -> None:
    """Print the tip's positions, the errors and the study."""
    strip = path.strip
    print(f"{strip.load}, {summary['unknowns']} unknowns, {summary['steps']} load steps, {path.iterations} iterations")
    known = f"published (doi:{DOI})" if strip.load == "shear" else "exact circle"
    rows = [(name, q["value"], q["published"]) for name, q in summary["qoi"].items()]
    print(table(("tip, by load", "computed", known), rows))
    print(table(("error", "value"), summary["errors"].items()))
    if "study" in summary:
        print(table(summary["study"][0], [row.values() for row in summary["study"]]))


def thickness_study(load: str, dim: int, elements: int) -> list[dict[str, Any]]:
    """Errors and Newton iterations by formulation, degree and h/L; a run that failed has no entries."""
    rows: list[dict[str, Any]] = []
    for formulation in ("displacement", "mixed"):
        for degree in (2, 3, 4):
            for thinness in THINNESS:
                data = replace(Data(), thickness=thinness * Data().length)
                row: dict[str, Any] = {"formulation": formulation, "degree": degree, "h/L": thinness}
                try:
                    path = follow(Strip(data, load, dim, degree, elements, formulation))
                    row |= errors(path) | {"iterations": path.iterations}
                except SolveError:
                    row |= dict.fromkeys(("U", "W") if load == "shear" else ("closing", "tip", "tip_shell"), "failed")
                    row["iterations"] = "-"
                rows.append(row)
    return rows


@root_only
def draw(out: Path, path: LoadPath, table: list[dict[str, Any]] | None) -> None:
    """Deformed shapes and the way of the tip with the known positions, and the errors of the study."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    strip, L = path.strip, path.strip.data.length
    shear = strip.load == "shear"
    P, start, columns = "P" if shear else "M", np.array([1.0, 0.0]), 3 if table else 2
    t = np.array(LOADS) if shear else np.linspace(0.01, 1.0, 200)
    known = np.array([PUBLISHED[s] if shear else circle(2 * pi * s, strip.data) for s in t]) / L
    label = "published" if shear else "exact circle"
    style: dict[str, Any] = {"marker": "o", "linestyle": "", "fillstyle": "none"} if shear else {"linestyle": "--"}
    style |= {"color": "k", "markersize": 9}

    figure, axes = plt.subplots(1, columns, figsize=(5.5 * columns, 4.8), layout="constrained")
    left, middle = axes[:2]
    for load, line in zip(path.loads, path.lines, strict=True):
        left.plot(*(line / L).T, color=plt.cm.viridis(load), linewidth=1.6)
    left.plot(*(start + path.tips / L).T, "C3.", label="tip, computed")
    left.plot(*(start + known).T, label=f"tip, {label}", **style)
    left.set(aspect="equal", xlabel="$x/L$", ylabel="$z/L$", title=f"shapes up to ${P}_{{max}}$")
    left.legend()
    for i, (name, sign) in enumerate((("-U", -1), ("W", 1))):
        middle.plot(path.loads, sign * path.tips[:, i] / L, f"C{i}.-", label=f"${name}/L$, computed")
        middle.plot(t, sign * known[:, i], label=label if i else None, **style)
    middle.set(xlabel=f"${P}/{P}_{{max}}$", ylabel="displacement of the tip / L", title="way of the tip")
    middle.grid(True, linewidth=0.4)
    middle.legend()
    if table:
        draw_study(axes[2], table, "W" if shear else "tip_shell")
    figure.savefig(out / "cantilever.png", dpi=130)
    plt.close(figure)


def draw_study(axes: Any, table: list[dict[str, Any]], norm: str) -> None:
    """One error against thinness, a line for every degree and formulation."""
    for degree, colour in ((2, "C0"), (3, "C1"), (4, "C2")):
        for formulation, style in (("displacement", "o--"), ("mixed", "s-")):
            rows = [row for row in table if (row["degree"], row["formulation"]) == (degree, formulation)]
            points = [(row["h/L"], row[norm]) for row in rows if row[norm] != "failed"]
            axes.loglog(*np.array(points).T, style, color=colour, label=f"p = {degree}, {formulation}")
    axes.set(xlabel="h / L", ylabel=f"error: {norm}", title="what thinness costs")
    axes.grid(True, linewidth=0.4)
    axes.legend(fontsize=8)


if __name__ == "__main__":
    script.command_line(main)
