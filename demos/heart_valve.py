"""A heart valve of three leaflets that a pressure difference opens and, reversed, closes.

The aorta is a cylinder of radius 1.1 with three spherical sinuses, meshed by gmsh. The leaflets are bicubic surfaces,
patches of one spline, clamped along their posts and their attached edge; full Kirchhoff-Love shells of a St.
Venant-Kirchhoff or Lee-Sacks material, with nonlocal contact. At the inlet acts a traction of 2e4 dyn/cm^2, from
t = 0.1 on one of -1e5: the valve opens, a jet forms, the flow is decelerated and reversed, the valve closes abruptly,
and the flow rings around a small leak.

What is measured: opening and closure, places where a leaflet passes through another (of which it warns), the load of
contact, how alike the leaflets remain under a third of a turn, and the mean leak against the largest systolic flow.

Source: D. Kamensky, "Open-source immersogeometric analysis of fluid-structure interaction using FEniCS and tIGAr",
section 6, doi:10.1016/j.camwa.2020.01.023. The leaflets there come from a file; here they are those of
`tigar_x.geometry.surfaces.leaflet`. Centimetres, grams, seconds.
"""

import logging
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import numpy as np
import ufl
from mpi4py import MPI
from dolfinx import fem
from scipy.integrate import trapezoid

from coudalfish import CouDALFISh, CouplingOptions, FluidSubproblem, ShellSubproblem, StepReport, SurfaceBand, advance
from coudalfish.restart import CoupledState
from shnapr.contact import LinearKernel, SelfContact
from shnapr.contact.piercings import piercings
from shnapr.hyperelastic import Hyperelastic, lee_sacks
from shnapr.loads import inertia
from shnapr.stress import resultants
from shnapr.supports import clamped
from shnapr.svk import StVenantKirchhoff
from shnapr.work import Material, internal_tangent, internal_work
from tigar_x import checks, compat
from tigar_x.compat import FloatArray
from tigar_x.fem.linear import direct, gmres_ilu
from tigar_x.fem.schemes import generalized_alpha
from tigar_x.fem.time_integration import TimeIntegrator
from tigar_x.geometry import surfaces
from tigar_x.geometry.multipatch import disjoint
from tigar_x.ranks import on_root, root_only
from tigar_x.run import script
from tigar_x.run.output import CSVSeries
from tigar_x.run.progress import Progress, Stopwatch, rss_mib
from tigar_x.run.restart import Restart
from tigar_x.run.summary import Quantity, table, write_summary
from tigar_x.run.vtkhdf import VTKHDFSeries
from tigar_x.run.writing import claim
from tigar_x.splines.projection import LumpedProjector
from tigar_x.splines.quadrature import NodalQuadrature
from tigar_x.splines.spline import ExtractedSpline
from tigar_x.splines.vtu import VTUSeries
from varmint.conditions import Resistance, Traction, Velocity
from varmint.flow import Flow
from varmint.mesh.aorta import aortic_root
from varmint.quantities import Measured, PointValues, flow_rate

log = logging.getLogger(__name__)

TOY = {"resolution": 6, "until": 2e-4, "frames": 4}
BEFORE, BEHIND = (0.0, 0.0, -0.3), (0.0, 0.0, 1.7)
TENSION = 1.5e5
"""Membrane force at the end of the pictures' scale of colours."""
SPACING = 0.75
"""Largest mean distance of the shell's points relative to the range of contact."""


@dataclass(frozen=True)
class Data:
    """The problem's data; centimetres, grams, seconds."""

    rho: float = 1.0
    mu: float = 0.03
    radius: float = 1.1
    systolic: float = 2e4
    diastolic: float = -1e5
    reversal: float = 0.1
    youngs_modulus: float = 1e7
    poisson_ratio: float = 0.4
    thickness: float = 0.04
    rho_s: float = 1.0
    contact_range: float = 0.035
    contact_self: float = 0.045
    contact_stiffness: float = 1e11
    rho_infinity: float = 0.0


def pressure(waveform: str, t: Any, c: Data) -> Any:
    """Traction at the inlet: a step, or a pulse of the same levels with smooth flanks of a fifth of the systole."""
    if waveform == "step":
        return ufl.conditional(ufl.lt(t, c.reversal - 1e-9), c.systolic, c.diastolic)
    width = c.reversal / 5

    def rise(s: Any) -> Any:
        s = ufl.max_value(0.0, ufl.min_value(1.0, s))
        return (1 - ufl.cos(ufl.pi * s)) / 2

    up, down = rise(t / width), rise((t - c.reversal) / width + 0.5)
    return c.systolic * up + (c.diastolic - c.systolic) * down


def material(name: str, c: Any) -> Material:
    """Material of the leaflets; the Lee-Sacks constants are those of bovine pericardium."""
    if name == "svk":
        return StVenantKirchhoff(c.youngs_modulus, c.poisson_ratio, c.thickness)
    return Hyperelastic(lee_sacks(676080.0, 132848.0, 38.1878), c.thickness)


class Leaflets:
    """The three leaflets as one shell.

    Attributes:
        spline: midsurface, three patches, each from post to post (u) and from the free to the attached edge (v).
        time: integrator of the displacement.
        material: elastic material.
        contact: nonlocal contact, whose range is at least that of the data and suits the spacing of the points.
        shell: structural side of the coupling.
    """

    def __init__(self, data: Data, elements: tuple[int, int], degree: int, dt: float, name: str) -> None:
        geometry = disjoint(*surfaces.trileaflet(radius=data.radius, elements=elements, degrees=(degree, degree)))
        zero_dofs = clamped(geometry, "post_0", "post_1", "attachment")
        spline = self.spline = ExtractedSpline(geometry, MPI.COMM_SELF, quadrature_degree=4, zero_dofs=zero_dofs)
        y, z = spline.function(name="y"), ufl.TestFunction(spline.V)
        scheme = generalized_alpha(data.rho_infinity, 2, first_order_alpha_m=True)
        time = self.time = TimeIntegrator(y, dt, scheme)
        c = script.constants(spline.mesh, data)
        matter = self.material = material(name, c)
        residual = internal_work(spline, matter, time.x_alpha, z)
        tangent = internal_tangent(spline, matter, time.x_alpha, z, y)
        mass = inertia(spline, time.xddot_alpha, z, density=c.rho_s, thickness=c.thickness)
        self.contact = self._contact(data)
        self.shell = ShellSubproblem(
            spline,
            residual + mass,
            time,
            tangent=tangent + ufl.derivative(mass, y),
            solver=direct(),
            contact=self.contact,
        )

    def _contact(self, data: Data) -> SelfContact:
        quadrature = NodalQuadrature.of(self.spline)
        spacing = float(np.sqrt(quadrature.weights.mean()))
        growth = max(1.0, spacing / (SPACING * data.contact_range))
        # pressure between two sheets goes with the third power of the range: the surface keeps its stiffness
        kernel = LinearKernel(growth * data.contact_range, data.contact_stiffness / growth**3)
        # as published: at the posts leaflets start nearer than r_max, and there they touch freely
        return SelfContact(quadrature, kernel, growth * data.contact_self, neighbours="space")

    @property
    def positions(self) -> FloatArray:
        """Nodes at the last accepted state, shape (nodes, 3)."""
        return self.spline.node_positions + self.spline.nodal(self.time.x_old)

    def _along(self, xi: FloatArray) -> list[Any]:
        functions = self.spline.geometry.functions
        return [functions.evaluate(functions.to_plane(k, xi)) for k in range(surfaces.LEAFLETS)]

    @cached_property
    def _places(self) -> list[Any]:
        """Matrices from control points to the middle of the free edge and the belly of each leaflet."""
        return self._along(np.array([[0.5, 0.0], [0.5, 0.5]]))

    @cached_property
    def _edges(self) -> list[Any]:
        return self._along(np.linspace(0.0, 1.0, 41)[:, None] * (1.0, 0.0))

    @cached_property
    def _net(self) -> list[Any]:
        line = np.linspace(0.0, 1.0, 33)
        return self._along(np.stack(np.meshgrid(line, line, indexing="ij"), axis=-1).reshape(-1, 2))

    def _control(self) -> FloatArray:
        return self.spline.geometry.points + self.spline.vector.coefficients(self.time.x_old)

    def marks(self) -> FloatArray:
        """Middle of the free edge and belly of each leaflet, shape (3, 2, 3)."""
        points = self._control()
        return np.array([N @ points for N in self._places])

    def opening(self) -> float:
        """Area within the free edges, seen along the axis."""
        points = self._control()
        x, y, _ = np.concatenate([N @ points for N in self._edges]).T
        return float(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)) / 2)

    def surfaces(self) -> FloatArray:
        """Points of the leaflets on a net, shape (3, 33, 33, 3)."""
        points = self._control()
        return np.array([(N @ points).reshape(33, 33, 3) for N in self._net])

    def on_net(self, field: fem.Function) -> FloatArray:
        """Values of a scalar field on that net, shape (3, 33, 33)."""
        values = self.spline.free(1).coefficients(field)
        return np.array([(N @ values).reshape(33, 33) for N in self._net])

    def asymmetry(self) -> float:
        """Root mean square distance between leaflets that are turned by a third of a circle onto each other."""
        x = self.surfaces()
        turned = [x[k] @ turn(-2.0 * np.pi / surfaces.LEAFLETS * k).T for k in range(surfaces.LEAFLETS)]
        return float(np.sqrt(np.mean(np.sum((turned - np.mean(turned, axis=0)) ** 2, axis=-1))))

    def piercings(self) -> int:
        """Number of places where leaflets go through each other or themselves."""
        quads = compat.subcells(self.spline.V)[1]
        return piercings(self.positions, quads, self.spline.node_positions, self.contact.r_self)


def turn(angle: float) -> FloatArray:
    """Rotation about the third axis."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


@dataclass(frozen=True)
class Valve:
    """The coupled scene.

    Attributes:
        flow: blood.
        leaflets: the structure.
        fsi: both, coupled.
    """

    flow: Flow
    leaflets: Leaflets
    fsi: CouDALFISh


def options_of(preset: str) -> CouplingOptions:
    """The published algorithm with its penalty, or this library's defaults with what a long steady load needs."""
    if preset == "reference":
        published = CouplingOptions.reference()
        return CouplingOptions(**(vars(published) | {"penalty": 500.0, "relaxation": 1e-5, "block_rtol": 1e-2}))
    return CouplingOptions(relaxation=0.2, relaxation_mode="smoothed")


def leaflet_elements(size: float) -> tuple[int, int]:
    """Bicubic elements of a leaflet whose nodes are at most 0.75 times the size of the fluid's cells apart."""
    along = max(4, round(1.8 / size))
    return along, max(3, round(0.8 * along))


def build(
    data: Data,
    resolution: int,
    *,
    grading: float = 1.0,
    elements: tuple[int, int] | None = None,
    degree: int = 3,
    matter: str = "svk",
    waveform: str = "step",
    resistance: float = 0.0,
    dt: float = 5e-5,
    options: CouplingOptions | None = None,
    comm: MPI.Comm = MPI.COMM_WORLD,
) -> Valve:
    """The valve at rest."""
    size = 2.0 * data.radius / resolution
    mesh = aortic_root(comm, size=grading * size, swept_size=size, radius=data.radius)

    def inflow(_: Any, t: Any) -> Any:
        return ufl.as_vector([0.0, 0.0, pressure(waveform, t, data)])

    flow = Flow(
        mesh,
        [
            Traction("inlet", inflow),
            Resistance("outlet", resistance) if resistance else Traction("outlet"),
            Velocity("walls"),
        ],
        rho=data.rho,
        mu=data.mu,
        dt=dt,
        scheme=generalized_alpha(data.rho_infinity),
        immersed=True,
    )
    fluid = FluidSubproblem(
        mesh.domain,
        flow.residual,
        flow.time,
        bcs=flow.bcs,
        band=SurfaceBand(mesh.domain, flow.scales),
        solver=gmres_ilu(2, rtol=1e-5, rebuild_growth=1.5, fallback=direct()),
        updates=flow.updates,
        before=flow.before,
        rank_one=flow.rank_one,
        density=data.rho,
        viscosity=data.mu,
    )
    leaflets = Leaflets(data, leaflet_elements(size) if elements is None else elements, degree, dt, matter)
    return Valve(flow, leaflets, CouDALFISh(fluid, leaflets.shell, options))


COLUMNS = (
    "t_alpha",  # to which pressures, leak and contact belong
    "flow_rate",
    "opening_area",
    "pressure_before",
    "pressure_behind",
    "leak",
    "contact_pairs",
    "contact_load",
    "smallest_distance",
    "asymmetry",
    "passes",
    *(f"{place}_{axis}_{k}" for k in range(surfaces.LEAFLETS) for place in ("tip", "belly") for axis in ("r", "z")),
)


class Observer:
    """What a run records after every step, in the order of ``COLUMNS``."""

    def __init__(self, valve: Valve) -> None:
        self._valve = valve
        self._flow_rate = Measured(outwards=flow_rate(valve.flow, "inlet"))
        self._pressures = PointValues(valve.flow, [BEFORE, BEHIND])

    def __call__(self, report: StepReport) -> tuple[float, ...]:
        leaflets = self._valve.leaflets
        before, behind = self._pressures()[:, 3]
        contact, monitors = report.contact, report.monitors
        x, y, z = np.moveaxis(leaflets.marks(), -1, 0)
        marks = np.stack([np.hypot(x, y), z], axis=-1).ravel()
        # points that do not touch are at least the range of contact apart
        distance = min(contact.distance, leaflets.contact.kernel.r_max)
        return (
            report.t_alpha,
            -self._flow_rate()["outwards"],
            leaflets.opening(),
            before,
            behind,
            monitors.leak,
            contact.pairs,
            contact.load,
            distance,
            leaflets.asymmetry(),
            report.passes,
            *marks,
        )


@dataclass(frozen=True)
class History:
    """A finished history; ``rows`` has the time in its first column, then ``COLUMNS``."""

    rows: FloatArray
    reversal: float

    @classmethod
    def read(cls, path: Path, reversal: float) -> "History":
        """Read the file of a finished run (collective)."""
        rows = on_root(MPI.COMM_WORLD, lambda: np.loadtxt(path, delimiter=",", skiprows=1, ndmin=2))
        return cls(MPI.COMM_WORLD.bcast(rows), reversal)

    def __getitem__(self, name: str) -> FloatArray:
        return self.rows[:, 1 + COLUMNS.index(name)]

    @property
    def t(self) -> FloatArray:
        """Times."""
        return self.rows[:, 0]

    @cached_property
    def closure(self) -> float | None:
        """Time at which the flow is back at zero after it was reversed, when the valve has just closed."""
        q = self["flow_rate"]
        back = np.flatnonzero((self.t > self.reversal) & (q < 0.0))
        if not len(back):
            return None
        lowest = back[0] + int(np.argmin(q[back[0] :]))
        zero = np.flatnonzero(q[lowest:] >= 0.0)
        return float(self.t[lowest + zero[0]]) if len(zero) else None

    def quantities(self) -> dict[str, Quantity]:
        """What the run amounts to."""
        q, t = self["flow_rate"], self.t
        forward = q[t <= self.reversal]
        found = {
            "peak_flow_rate": float(forward.max()),
            "stroke_volume": float(trapezoid(forward, t[t <= self.reversal])) if len(forward) > 1 else 0.0,
            "largest_opening_area": float(self["opening_area"].max()),
            "final_opening_area": float(self["opening_area"][-1]),
            "largest_contact_load": float(self["contact_load"].max()),
        }
        if (t > self.reversal).any():
            found["largest_backflow"] = float(-q.min())
        if self.closure is not None:
            closed = t >= self.closure
            found["closure_time"] = self.closure
            if closed.sum() > 2:
                found |= self._leak(closed)
        return {name: Quantity(value) for name, value in found.items()}

    def _leak(self, closed: Any) -> dict[str, float]:
        """Mean backflow of the closed valve in its last whole oscillation, or in all the time if there is none."""
        q, t = self["flow_rate"][closed], self.t[closed]
        peak = float(self["flow_rate"][self.t <= self.reversal].max())
        middle = q[len(q) // 2 :].mean()
        up = np.flatnonzero((q[:-1] < middle) & (q[1:] >= middle)) + 1
        parts = [slice(a, b + 1) for a, b in pairwise(up)] or [slice(None)]
        last, sizes = parts[-1], [float(np.ptp(q[part])) for part in parts]
        mean = -float(trapezoid(q[last], t[last])) / float(t[last][-1] - t[last][0])
        found = {"mean_leak": mean, "mean_leak_relative": mean / peak, "oscillations": float(len(up[1:]))}
        if len(parts) > 1:
            found["oscillation_period"] = float(t[up[-1]] - t[up[0]]) / len(parts)
            found["oscillation_decay"] = (sizes[-1] / sizes[0]) ** (1.0 / (len(parts) - 1))
        return found


def main(
    resolution: int = 16,
    grading: float = 1.0,
    leaflet_elements: int = 0,
    degree: int = 3,
    material: Literal["svk", "lee-sacks"] = "svk",
    waveform: Literal["step", "pulse"] = "step",
    outlet_resistance: float = 0.0,
    dt: float = 5e-5,
    until: float = 0.2,
    preset: Literal["reference", "default"] = "default",
    frames: int = 80,
    checkpoint_every: int = 500,
    restart: str = "",
    out: Path = Path("results/heart_valve"),
    overwrite: bool = False,
    viz: bool = True,
) -> dict[str, Any]:
    """Open and close a heart valve of three leaflets.

    Args:
        resolution: cells of the fluid across the aorta where the leaflets move.
        grading: size of the cells elsewhere, relative to theirs.
        leaflet_elements: Bezier elements of a leaflet from post to post, 0.8 times as many across; 0: as many as suit
            the fluid's cells.
        degree: of the leaflets' splines, 2 or more.
        material: of the leaflets, St. Venant-Kirchhoff or isotropic Lee-Sacks.
        waveform: of the traction at the inlet, the published step or a smooth pulse.
        outlet_resistance: pressure by flow rate at the outlet [dyn s/cm^5].
        dt: time step [s].
        until: end [s].
        preset: the published algorithm, or this library's defaults.
        frames: number of pictures and ParaView files of the whole run.
        checkpoint_every: number of steps between checkpoints; 0: none, but where the run is told to end.
        restart: "latest", a step or a file to go on from; empty: begin anew.
        out: folder of the results.
        overwrite: whether to delete the results of an earlier run in this folder.
        viz: whether to write ParaView files and pictures.

    Returns:
        The summary.
    """
    data = Data()
    steps = max(1, round(checks.positive("until", until) / checks.positive("dt", dt)))
    checks.whole("resolution", resolution, 4)
    across = checks.whole("leaflet_elements", leaflet_elements, 0)
    inputs = {
        "data": data,
        "resolution": resolution,
        "grading": checks.within("grading", grading, 1.0, 10.0),
        "leaflet_elements": leaflet_elements,
        "degree": checks.whole("degree", degree, 2),
        "material": material,
        "waveform": waveform,
        "outlet_resistance": checks.not_negative("outlet_resistance", outlet_resistance),
        "dt": dt,
        "preset": preset,
    }
    claim(out, overwrite=overwrite, restart=restart)
    valve = build(
        data,
        resolution,
        grading=grading,
        elements=(across, max(1, round(0.8 * across))) if across else None,
        degree=degree,
        matter=material,
        waveform=waveform,
        resistance=outlet_resistance,
        dt=dt,
        options=options_of(preset),
    )
    fsi, leaflets = valve.fsi, valve.leaflets
    run = Restart(out / "checkpoints", CoupledState(fsi), every=checkpoint_every, inputs=inputs)
    if restart:
        run.read(restart)
    tally = run.extra
    for name in ("cuts", "passes", "most_passes", "linear_iterations", "piercings", "closing_ratio", "wall_s", "cpu_s"):
        tally.setdefault(name, 0)
    spent = tally["wall_s"], tally["cpu_s"]
    every = max(1, steps // frames) if checks.whole("frames", frames, 0) else 0
    observe, watch, memory = Observer(valve), Stopwatch(), []
    progress = Progress(steps, done=run.step)
    pictures = Pictures(out, valve, run) if viz else None
    with CSVSeries(out / "history.csv", COLUMNS, after=run.after) as history:
        for n in run.steps(progress):
            with watch:
                reports = advance(fsi, dt)
            report = reports[-1]
            history.write(report.t, *observe(report))
            tally["cuts"] += len(reports) - 1
            tally["passes"] += sum(r.passes for r in reports)
            tally["most_passes"] = max(tally["most_passes"], *(r.passes for r in reports))
            tally["linear_iterations"] += sum(r.linear_iterations for r in reports)
            tally["closing_ratio"] = max(tally["closing_ratio"], *(r.contact.closing_ratio for r in reports))
            tally["wall_s"], tally["cpu_s"] = spent[0] + watch.wall_s, spent[1] + watch.cpu_s
            memory.append(rss_mib())
            progress.show(report)
            if every and (n % every == 0 or n == steps):
                tally["piercings"] = max(tally["piercings"], leaflets.piercings())
                if pictures:
                    pictures.write(report.t, -(-n // every))
    if pictures:
        pictures.close()
    if run.step < steps:
        return {}
    past = History.read(out / "history.csv", data.reversal)
    if viz:
        draw_histories(out / "histories.png", past)
        animate(out)
    domain = valve.flow.mesh.domain
    summary = write_summary(
        out,
        "heart_valve",
        inputs,
        qoi=past.quantities(),
        steps=steps,
        block_iterations_mean=tally["passes"] / steps,
        block_iterations_max=tally["most_passes"],
        linear_iterations_mean=tally["linear_iterations"] / steps,
        cells=domain.topology.index_map(3).size_global,
        nodes_shell=len(leaflets.positions),
        dofs_fluid=valve.flow.unknowns,
        dofs_shell=3 * leaflets.spline.geometry.n,
        wall_s=tally["wall_s"],
        cpu_s=tally["cpu_s"],
        rss_mib_step_10=memory[min(9, len(memory) - 1)] if memory else None,
        rss_mib_end=memory[-1] if memory else None,
        monitors={
            "cut_steps": tally["cuts"],
            "piercings": tally["piercings"],
            "closing_ratio_max": tally["closing_ratio"],
            "range_of_contact": leaflets.contact.kernel.r_max,
            "points_to_range_of_contact": leaflets.contact.spacing_ratio,
            "asymmetry_max": float(past["asymmetry"].max()),
            "cell_size": fsi.fluid.mesh_size,
        },
    )
    if MPI.COMM_WORLD.rank == 0:
        print(
            f"{summary['cells']} cells, {summary['nodes_shell']} points, {steps} steps, {tally['cpu_s']:.4g} CPU s, "
            f"{summary['block_iterations_mean']:.2f} passes each"
        )
        print(table(("quantity", "value"), [(name, q.value) for name, q in past.quantities().items()]))
        if tally["piercings"]:
            log.warning("leaflets went through each other in %d places: reduce dt or refine them", tally["piercings"])
        print(f"piercings {tally['piercings']}, largest asymmetry {past['asymmetry'].max():.3g} cm")
    return summary


class Pictures:
    """ParaView files and pictures of a run."""

    def __init__(self, out: Path, valve: Valve, run: Restart) -> None:
        self._out, self._leaflets = out, valve.leaflets
        spline, w, fsi = valve.leaflets.spline, valve.flow.w, valve.fsi
        y = self._leaflets.time.x_old
        n = resultants(spline, self._leaflets.material, y).n
        largest = ufl.tr(n) / 2 + ufl.sqrt((n[0, 0] - n[1, 1]) ** 2 / 4 + n[0, 1] ** 2)
        projector = LumpedProjector(spline, 1)
        form = projector.compile(largest)
        self._tension = fem.Function(spline.free(1).V)

        def tension() -> FloatArray:
            self._tension.x.array[:] = projector(form).ravel()
            return self._tension.x.array.copy()

        self._fluid = VTKHDFSeries(
            out / "fluid.vtkhdf",
            valve.flow.mesh.domain,
            after=run.after,
            velocity=(w, (0, 1, 2)),
            pressure=(w, (3,)),
        )
        self._shell = VTUSeries(
            out / "leaflets",
            spline,
            y=y,
            after=run.after,
            velocity=self._leaflets.time.xdot_old,
            tension=tension,
            multiplier=lambda: fsi.lam,
        )

    def write(self, t: float, number: int) -> None:
        """Write the present state."""
        self._fluid.write(t)
        self._shell.write(t)
        draw_leaflets(self._out / "frames" / f"leaflets_{number:04d}.png", self._leaflets, self._tension, t)

    def close(self) -> None:
        """Finish the files."""
        self._fluid.close()
        self._shell.close()


@root_only
def draw_leaflets(path: Path, leaflets: Leaflets, tension: fem.Function, t: float) -> None:
    """The leaflets from the side and from downstream, coloured by their tension."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    path.parent.mkdir(parents=True, exist_ok=True)
    x, values = leaflets.surfaces(), leaflets.on_net(tension)
    centres = (values[:, 1:, 1:] + values[:, :-1, 1:] + values[:, 1:, :-1] + values[:, :-1, :-1]) / 4
    colours = ScalarMappable(Normalize(0.0, TENSION), "viridis")
    figure = plt.figure(figsize=(9.6, 4.8))
    for i, (elevation, azimuth) in enumerate(((12.0, 20.0), (90.0, -90.0))):
        axes = figure.add_axes((0.46 * i, 0.0, 0.46, 1.0), projection="3d", computed_zorder=True)
        for k in range(surfaces.LEAFLETS):
            axes.plot_surface(*np.moveaxis(x[k], -1, 0), facecolors=colours.to_rgba(centres[k]), shade=True, rstride=1,
                              cstride=1, linewidth=0, antialiased=False)  # fmt: skip
        axes.set(xlim=(-0.9, 0.9), ylim=(-0.9, 0.9), zlim=(-0.3, 1.5))
        axes.set_box_aspect((1, 1, 1), zoom=1.25)
        axes.set_axis_off()
        axes.view_init(elevation, azimuth)
    bar = figure.add_axes((0.925, 0.2, 0.015, 0.6))
    figure.colorbar(colours, cax=bar, label="largest membrane force [dyn/cm]", extend="max")
    figure.text(0.02, 0.93, f"t = {t:.4f} s")
    figure.savefig(path, dpi=100)
    plt.close(figure)


@root_only
def animate(out: Path) -> None:
    """Animation of the pictures of the leaflets, and six of them on one sheet."""
    from PIL import Image

    pictures = [Image.open(path).convert("RGB") for path in sorted((out / "frames").glob("leaflets_*.png"))]
    if not pictures:
        return
    first, *others = [picture.quantize() for picture in pictures]
    first.save(out / "leaflets.gif", save_all=True, append_images=others, duration=100, loop=0)
    chosen = [pictures[round(i)] for i in np.linspace(0, len(pictures) - 1, min(6, len(pictures)))]
    width, height = chosen[0].size
    sheet = Image.new("RGB", (2 * width, height * -(-len(chosen) // 2)), "white")
    for i, picture in enumerate(chosen):
        sheet.paste(picture, (width * (i % 2), height * (i // 2)))
    sheet.save(out / "leaflets.png")


@root_only
def draw_histories(path: Path, past: History) -> None:
    """Flow rate, opening area, pressures, contact and positions over time."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(3, 2, figsize=(11, 8.5), sharex=True, layout="constrained")
    axes = axes.ravel()
    axes[0].plot(past.t, past["flow_rate"], linewidth=1.0)
    axes[0].set(ylabel="flow rate [cm$^3$/s]")
    axes[1].plot(past.t, past["opening_area"], linewidth=1.0)
    axes[1].set(ylabel="area within the free edges [cm$^2$]")
    for name in ("before", "behind"):
        axes[2].plot(past["t_alpha"], past[f"pressure_{name}"], linewidth=0.8, label=f"{name} the valve")
    axes[2].set(ylabel="pressure [dyn/cm$^2$]")
    axes[3].plot(past["t_alpha"], past["contact_load"], linewidth=1.0)
    axes[3].set(ylabel="contact load [dyn]")
    for k in range(surfaces.LEAFLETS):
        axes[4].plot(past.t, past[f"tip_r_{k}"], f"C{k}", linewidth=1.0, label=f"leaflet {k}, free edge")
        axes[4].plot(past.t, past[f"belly_r_{k}"], f"C{k}--", linewidth=1.0, label=f"leaflet {k}, belly")
    axes[4].set(ylabel="distance from the axis [cm]", xlabel="t [s]")
    axes[5].plot(past["t_alpha"], past["leak"], linewidth=0.8)
    axes[5].set(ylabel="flow through the leaflets [cm$^3$/s]", xlabel="t [s]")
    for i in (2, 4):
        axes[i].legend(fontsize=7)
    for ax in axes:
        ax.grid(linewidth=0.4)
    figure.savefig(path, dpi=120)
    plt.close(figure)


if __name__ == "__main__":
    script.command_line(main)
