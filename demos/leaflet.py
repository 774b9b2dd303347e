"""A leaflet of a heart valve that closes against two rigid planes.

Diastolic pressure acts from downstream on one of three equal leaflets, pinned along its posts and its attached edge,
and pushes it upstream and to the axis. By symmetry its neighbours are replaced by two planes through the axis, at 60
degrees to both sides of its middle; their pressure is k times the depth of the midsurface in the plane.

What is checked: supports, planes and pressure are in balance; the resultant of the pressure, which follows the normal,
is P/2 times the integral of x cross dx along the boundary; the solution is symmetric about the leaflet's middle; the
mean depth in the planes is of the order of P/k; and the free edge converges under refinement. The planes leave the
leaflet a wedge, whose tip it fills up to a bending radius of (E h^3/(12 (1 - nu^2) P))^(1/3): that is what refinement
resolves. Strains are large: with h = 0.01 or ten times the pressure some load steps fail, and not all such loads are
reached.

The load and all moduli are those of the demonstration of contact with planes that accompanies D. Kamensky,
doi:10.1016/j.camwa.2020.01.023; the leaflet is that of `tigar_x.geometry.surfaces.leaflet`. Centimetres, grams,
seconds.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import ufl
from mpi4py import MPI
from dolfinx import fem

from shnapr.kinematics import midsurface
from shnapr.loads import follower_pressure
from shnapr.planes import RigidPlane, plane_contact
from shnapr.stress import resultants
from shnapr.supports import pinned
from shnapr.svk import StVenantKirchhoff
from shnapr.work import internal_tangent, internal_work, strain_energy
from tigar_x import checks, compat
from tigar_x.compat import FloatArray
from tigar_x.fem.line_search import LineSearch
from tigar_x.fem.load_stepping import LoadReport, StepControl, follow_load
from tigar_x.fem.time_integration import LoadStepper
from tigar_x.geometry import surfaces
from tigar_x.ranks import root_only
from tigar_x.run import script
from tigar_x.run.output import CSVSeries
from tigar_x.run.progress import Stopwatch
from tigar_x.run.summary import Quantity, table, write_summary
from tigar_x.run.writing import claim
from tigar_x.splines.measures import SplineMeasure
from tigar_x.splines.projection import LumpedProjector
from tigar_x.splines.spline import ExtractedSpline
from tigar_x.splines.spline_system import SplineSystem
from tigar_x.splines.vtu import VTUSeries

TOY = {"degree": 2, "elements": 5, "step": 0.25}
INDEX = 1  # the leaflet with its middle at the azimuth of 180 degrees
NORMALS = ((-(3**0.5) / 2, -0.5, 0.0), (-(3**0.5) / 2, 0.5, 0.0))
COLUMNS = ("pressure", "energy", "centre_radius", "centre_z", "distance_1", "distance_2", "contact_force", "touching")


@dataclass(frozen=True)
class Data:
    """The problem's data; centimetres, grams, seconds."""

    youngs_modulus: float = 1e7
    poisson_ratio: float = 0.45
    thickness: float = 0.03
    pressure: float = 1e5
    stiffness: float = 1e9
    smoothing: float = 0.0


class Leaflet:
    """The leaflet between its planes, in equilibrium at the pressure P t.

    Attributes:
        spline: midsurface, from post to post and from the free to the attached edge.
        y: displacement.
        time: pseudo-time t of the load.
        system: equilibrium.
    """

    def __init__(self, data: Data, degree: int, elements: int) -> None:
        self.data, self.elements = data, elements
        along = max(2, round(0.8 * elements))
        patch = surfaces.leaflet(INDEX, elements=(elements, along), degrees=(degree, degree))
        zero_dofs = pinned(patch, "post_0", "post_1", "attachment")
        spline = self.spline = ExtractedSpline(patch, MPI.COMM_SELF, zero_dofs=zero_dofs)
        y = self.y = spline.function(name="y")
        self.time = LoadStepper(y, 1.0)

        c = {name: fem.Constant(spline.mesh, value) for name, value in vars(data).items()}
        smoothing = c["smoothing"] if data.smoothing else 0.0
        planes = [RigidPlane((0.0, 0.0, 0.0), normal, c["stiffness"], smoothing) for normal in NORMALS]
        self.material = StVenantKirchhoff(c["youngs_modulus"], c["poisson_ratio"], c["thickness"])
        z = ufl.TestFunction(spline.V)
        pressure = c["pressure"] * self.time.t
        load = follower_pressure(spline, pressure, y, z)
        contact = plane_contact(spline, planes[0], y, z) + plane_contact(spline, planes[1], y, z)
        residual = internal_work(spline, self.material, y, z) + load + contact
        tangent = internal_tangent(spline, self.material, y, z, y) + ufl.derivative(load + contact, y)
        self.system = SplineSystem(spline, residual, tangent, unknown=y)

        ds, x = spline.ds(), spline.F + y
        along_edge = spline.parametric_grad(x) * ufl.as_vector([-ds.normal[1], ds.normal[0]])  # counter-clockwise
        boundary = pressure / 2 * ufl.dot(ufl.cross(x, along_edge), z) * ds.measure
        self._vectors = compat.compile_forms(residual, load, contact, boundary)
        depths = [-ufl.dot(x, ufl.as_vector(plane.normal)) for plane in planes]
        current = midsurface(spline, y)
        area = SplineMeasure(ufl.sqrt(ufl.det(current.metric)), spline.dx.measure)
        force = sum(plane.traction(depth) for plane, depth in zip(planes, depths, strict=True)) * area
        moment = sum(plane.traction(depth) * depth for plane, depth in zip(planes, depths, strict=True)) * area
        self._scalars = compat.compile_forms(strain_energy(spline, self.material, y), force, moment)

    def _extracted(self, form: Any) -> FloatArray:
        """Nodal values of a form that is linear in its test function, extracted, shape (functions, 3)."""
        nodal, result = compat.create_vector(self.spline.V), self.spline.M.createVecRight()
        compat.assemble_vector(nodal, form)
        self.spline.M.multTranspose(nodal, result)
        return np.array(result.array_r).reshape(-1, 3)

    def forces(self) -> "Forces":
        """Resultants of all that acts on the leaflet."""
        residual, pressure, contact, boundary = (self._extracted(form) for form in self._vectors)
        held = np.zeros(residual.size, dtype=bool)
        held[self.spline.zero_dofs] = True
        reaction = np.where(held.reshape(-1, 3), residual, 0.0).sum(axis=0)
        return Forces(reaction, -pressure.sum(axis=0), -contact.sum(axis=0), boundary.sum(axis=0))

    def distances(self, x: FloatArray) -> FloatArray:
        """Distances of points from the two planes, shape (points, 2)."""
        return x @ np.transpose(NORMALS)

    def nodes(self) -> FloatArray:
        """Present positions of the nodes, shape (nodes, 3)."""
        return self.spline.node_positions + self.spline.nodal(self.y)

    def position(self, xi: FloatArray) -> FloatArray:
        """Present positions at parameters, shape (points, 3)."""
        return self.spline.geometry.evaluate(xi) + self.spline.evaluate(self.y, xi)

    def state(self) -> tuple[float, ...]:
        """Values of ``COLUMNS``."""
        energy, force, _ = (compat.assemble_scalar(form) for form in self._scalars)
        edge = self.position(np.linspace(0.0, 1.0, 401)[:, None] * (1.0, 0.0))
        x, y, z = edge[200]
        nearest = self.distances(edge).min(axis=1)
        touching = float(np.mean(nearest < 0.1 * self.data.thickness))
        low = self.distances(self.nodes()).min(axis=0)
        return (
            self.data.pressure * float(self.time.t.value),
            energy,
            float(np.hypot(x, y)),
            float(z),
            *low,
            force,
            touching,
        )

    def mean_depth(self) -> float:
        """Mean of the depth in the planes, weighted by their pressure; 0 without contact."""
        _, force, moment = (compat.assemble_scalar(form) for form in self._scalars)
        return moment / force if force else 0.0

    def asymmetry(self) -> float:
        """Largest distance between the leaflet and its mirror image; unit: length."""
        line = np.linspace(0.0, 1.0, 17)
        x = self.position(np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)).reshape(17, 17, 3)
        return float(np.abs(x - x[:, ::-1] * (1, -1, 1)).max())


@dataclass(frozen=True)
class Forces:
    """Resultants of the forces on the leaflet; ``boundary`` is that of the pressure from the boundary alone."""

    reaction: FloatArray
    pressure: FloatArray
    contact: FloatArray
    boundary: FloatArray

    @property
    def imbalance(self) -> float:
        """Norm of the sum, by that of the pressure."""
        return float(np.linalg.norm(self.reaction + self.pressure + self.contact) / np.linalg.norm(self.pressure))

    @property
    def boundary_error(self) -> float:
        """Difference of the two resultants of the pressure, by its norm."""
        return float(np.linalg.norm(self.boundary - self.pressure) / np.linalg.norm(self.pressure))


@dataclass(frozen=True)
class Closure:
    """A leaflet that has been closed, its history (rows of ``COLUMNS``), and how its load was reached at what cost."""

    leaflet: Leaflet
    history: FloatArray
    load: LoadReport
    wall_s: float
    cpu_s: float

    def final(self, name: str) -> float:
        """Last value of a column."""
        return float(self.history[-1, COLUMNS.index(name)])


def close(leaflet: Leaflet, *, step: float, tolerance: float, each: Callable[[float], None] | None = None) -> Closure:
    """Raise the pressure in steps of pseudo-time, which are cut where Newton's method fails."""
    watch, extra, history = Stopwatch(), Stopwatch(), []

    def record(t: float) -> None:
        with extra:
            history.append(leaflet.state())
            if each is not None:
                each(t)

    with watch:
        full_load = leaflet.system.assemble_residual()  # the open leaflet has no other forces
        leaflet.time.step_size = step
        load = follow_load(
            leaflet.system,
            leaflet.time,
            control=StepControl(smallest=1e-4 * step, largest=step),
            each=record,
            comm=MPI.COMM_WORLD,
            reference=full_load,
            rtol=tolerance,
            max_iterations=40,
            line_search=LineSearch(),
        )
    return Closure(leaflet, np.array(history), load, watch.wall_s - extra.wall_s, watch.cpu_s - extra.cpu_s)


def observed_rates(runs: list[Closure]) -> dict[str, float] | None:
    """Rates at which the differences between successive meshes fall, from the three finest."""
    if len(runs) < 3:
        return None
    names = ("energy", "centre_radius", "centre_z")
    values = np.array([[run.final(name) for name in names] for run in runs[-3:]])
    steps = np.abs(np.diff(values, axis=0))
    return dict(zip(names, np.log2(steps[0] / steps[1]).tolist(), strict=True))


def main(
    degree: int = 3,
    elements: int = 20,
    levels: int = 1,
    pressure: float = 1e5,
    thickness: float = 0.03,
    stiffness: float = 1e9,
    smoothing: float = 0.0,
    step: float = 0.1,
    tolerance: float = 1e-9,
    out: Path = Path("results/leaflet"),
    overwrite: bool = False,
    viz: bool = True,
) -> dict[str, Any]:
    """Close a leaflet of a heart valve against two planes, and check the balance of forces.

    Args:
        degree: of the splines, 2 or more.
        elements: from post to post; 0.8 times as many from edge to edge.
        levels: number of meshes, each of half as many elements as the next, to observe convergence.
        pressure: difference of pressure across the leaflet [dyn/cm^2].
        thickness: of the leaflet [cm].
        stiffness: pressure of the planes by depth [dyn/cm^3].
        smoothing: distance over which the planes' pressure sets in [cm]; 0: abruptly.
        step: load step, by the whole load.
        tolerance: of Newton's method, by the norm of the full load.
        out: folder of the results.
        overwrite: whether to delete the results of an earlier run in this folder.
        viz: whether to write ParaView files, a history and a picture.

    Returns:
        The summary.
    """
    data = Data(
        pressure=checks.positive("pressure", pressure),
        thickness=checks.positive("thickness", thickness),
        stiffness=checks.positive("stiffness", stiffness),
        smoothing=checks.not_negative("smoothing", smoothing),
    )
    step = checks.positive("step", step)
    p, coarsest = checks.whole("degree", degree, 2), 2 ** (checks.whole("levels", levels, 1) - 1)
    if checks.whole("elements", elements, 2 * coarsest) % coarsest:
        raise ValueError(f"elements = {elements}: a multiple of {coarsest} is required for levels = {levels}")
    claim(out, overwrite=overwrite)

    runs: list[Closure] = []
    for n in (elements // coarsest * 2**k for k in range(levels)):
        leaflet = Leaflet(data, p, n)
        pictures = Pictures(out, leaflet) if viz and n == elements else None
        each = pictures.write if pictures else None
        runs.append(close(leaflet, step=step, tolerance=tolerance, each=each))
    run, forces = runs[-1], leaflet.forces()
    if pictures:
        pictures.close(runs)

    inputs = {
        "data": data,
        "degree": p,
        "elements": elements,
        "levels": levels,
        "step": step,
        "tolerance": tolerance,
    }
    quantities = ("energy", "centre_radius", "centre_z", "contact_force", "touching")
    summary = write_summary(
        out,
        "leaflet",
        inputs,
        errors={"force_balance": forces.imbalance, "pressure_resultant": forces.boundary_error},
        qoi={name: Quantity(run.final(name)) for name in quantities},
        levels=[dict(zip(COLUMNS, run.history[-1].tolist(), strict=True)) for run in runs],
        rates=observed_rates(runs),
        monitors={
            "asymmetry": leaflet.asymmetry(),
            "deepest": -min(run.final("distance_1"), run.final("distance_2")),
            "mean_depth": leaflet.mean_depth(),
            "pressure_over_stiffness": data.pressure / data.stiffness,
            "reaction": forces.reaction.tolist(),
            "contact": forces.contact.tolist(),
            "pressure": forces.pressure.tolist(),
        },
        steps=len(run.load.loads),
        newton_iterations=run.load.iterations,
        cuts=sum(run.load.cuts),
        dofs_shell=leaflet.spline.geometry.n * 3,
        wall_s=run.wall_s,
        cpu_s=run.cpu_s,
    )
    if MPI.COMM_WORLD.rank == 0:
        print(f"pressure {data.pressure:g}, {summary['steps']} load steps, {run.cpu_s:.3g} CPU s")
        rows = [
            (r.leaflet.elements, *(r.final(name) for name in quantities), sum(r.load.iterations), r.cpu_s) for r in runs
        ]
        print(table(("elements", *quantities, "Newton iterations", "CPU s"), rows))
        print(
            f"force balance {forces.imbalance:.1e}, resultant of the pressure {forces.boundary_error:.1e}, mean depth "
            f"{summary['monitors']['mean_depth']:.3g} (pressure/stiffness {data.pressure / data.stiffness:.3g})"
        )
    return summary


class Pictures:
    """ParaView files and history of a run, and a picture at its end."""

    def __init__(self, out: Path, leaflet: Leaflet) -> None:
        self._out, self._leaflet = out, leaflet
        spline, y = leaflet.spline, leaflet.y
        n = resultants(spline, leaflet.material, y).n
        # not a stress: strains at the upper corners are beyond those for which this material has a thickness
        largest = ufl.tr(n) / 2 + ufl.sqrt((n[0, 0] - n[1, 1]) ** 2 / 4 + n[0, 1] ** 2)
        projector = LumpedProjector(spline, 1)
        form = projector.compile(largest)
        self.tension = lambda: projector(form)
        self._shell = VTUSeries(
            out / "leaflet",
            spline,
            y=y,
            tension=self.tension,
            distance=lambda: leaflet.distances(leaflet.nodes()).min(axis=1),
        )
        self._history = CSVSeries(out / "history.csv", COLUMNS)

    def write(self, t: float) -> None:
        """Append the present state."""
        self._shell.write(t)
        self._history.write(t, *self._leaflet.state())

    def close(self, runs: list[Closure]) -> None:
        """Finish the files and draw."""
        self._shell.close()
        self._history.close()
        draw(self._out / "leaflet.png", runs, self.tension())


@root_only
def draw(path: Path, runs: list[Closure], tension: FloatArray) -> None:
    """The closed leaflet with its tension and the planes, and how its free edge came there."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    leaflet, spline = runs[-1].leaflet, runs[-1].leaflet.spline
    field = fem.Function(spline.free(1).V)
    field.x.array[:] = tension.ravel()
    line = np.linspace(0.0, 1.0, 81)
    middles = (line[1:] + line[:-1]) / 2
    grid, centres = (np.stack(np.meshgrid(s, s), axis=-1) for s in (line, middles))
    x = leaflet.position(grid.reshape(-1, 2)).reshape(81, 81, 3)
    values = spline.evaluate(field, centres.reshape(-1, 2)).reshape(80, 80)
    colours = ScalarMappable(Normalize(0.0, np.quantile(values, 0.98)), "viridis")

    figure = plt.figure(figsize=(15, 5.2), layout="constrained")
    space = figure.add_subplot(1, 3, 1, projection="3d")
    middle, right = figure.add_subplot(1, 3, 2), figure.add_subplot(1, 3, 3)
    space.plot_surface(*np.moveaxis(x, -1, 0), facecolors=colours.to_rgba(values), rstride=1, cstride=1, shade=False)
    for normal in NORMALS:
        outwards = np.array([normal[1], -normal[0]]) * -np.sign(normal[1])
        r, z = np.meshgrid([0.0, 1.15], [-0.2, 1.0])
        space.plot_surface(r * outwards[0], r * outwards[1], z, color="0.6", alpha=0.25)
    space.set(xticks=(), yticks=(), zticks=())
    space.set_aspect("equal")
    space.view_init(30, 205)
    figure.colorbar(colours, ax=space, label="largest membrane force [dyn/cm]", shrink=0.6)
    space.set_title(f"closed by {leaflet.data.pressure:g} dyn/cm$^2$")

    edge = np.linspace(0.0, 1.0, 401)[:, None] * (1.0, 0.0)
    for name, position in (("open", spline.geometry.evaluate(edge)), ("closed", leaflet.position(edge))):
        middle.plot(position[:, 0], position[:, 1], linewidth=1.5, label=f"free edge, {name}")
    for normal in NORMALS:
        outwards = np.array([normal[1], -normal[0]]) * -np.sign(normal[1])
        middle.plot([0.0, 1.2 * outwards[0]], [0.0, 1.2 * outwards[1]], "k--", linewidth=0.8)
    middle.set(
        aspect="equal", xlim=(-1.1, 0.1), xlabel="$x_1$", ylabel="$x_2$", title="seen along the axis, with the planes"
    )
    middle.legend(loc="center left")
    for run in runs:
        history = dict(zip(COLUMNS, run.history.T, strict=True))
        right.plot(history["pressure"], history["centre_radius"], ".-", label=f"{run.leaflet.elements} elements")
    right.set(xlabel="pressure [dyn/cm$^2$]", ylabel="distance from the axis [cm]", title="middle of the free edge")
    right.set(yscale="log")
    right.grid(True, which="both", linewidth=0.4)
    right.legend()
    figure.savefig(path, dpi=130)
    plt.close(figure)


if __name__ == "__main__":
    script.command_line(main)
