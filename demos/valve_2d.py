"""Two leaflets that a pulsating channel flow opens and lets swing back: the plane valve.

The channel (0, 8) x (0, 1.61) has a straight leaflet of length 0.7 clamped to each wall at x_1 = 2.0; their tips leave
a gap of 0.21. The fluid enters with

    u_1 = 5 (sin 2 pi t + 1.1) x_2 (1.61 - x_2),

which comes up linearly within the first two steps, sticks to the walls and leaves freely. Both leaflets are St.
Venant-Kirchhoff shells, patches of one spline; their midsurface is the plane x_1 = 2.0. Velocities on inlet and walls
are imposed weakly, and all time integration is generalized-alpha with rho_infinity = 0.

What is compared are the peaks and troughs of the displacement of the top leaflet's tip along the channel. In three
dimensions the channel is extruded by its depth with one layer of cells and slip on its ends, as in the source.

Source: Kamensky et al., section 4.7, doi:10.1016/j.cma.2014.10.040; with the discretisation of D. Kamensky,
doi:10.1016/j.camwa.2020.01.023.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import ufl
from mpi4py import MPI
from dolfinx import fem

from coudalfish import CouDALFISh, CouplingOptions, FluidSubproblem, ShellSubproblem, StepReport, SurfaceBand
from coudalfish.restart import CoupledState
from shnapr.loads import inertia
from shnapr.supports import clamped
from shnapr.svk import StVenantKirchhoff
from shnapr.work import internal_tangent, internal_work, strain_energy
from tigar_x import checks
from tigar_x.compat import FloatArray
from tigar_x.fem.linear import LinearSolver, direct
from tigar_x.fem.schemes import generalized_alpha
from tigar_x.fem.time_integration import TimeIntegrator
from tigar_x.geometry import shapes
from tigar_x.geometry.multipatch import disjoint
from tigar_x.ranks import root_only
from tigar_x.run import script
from tigar_x.run.output import CSVSeries
from tigar_x.run.pictures import Colours
from tigar_x.run.plane_field import PlaneField
from tigar_x.run.progress import Progress, Stopwatch, rss_mib
from tigar_x.run.restart import Restart
from tigar_x.run.summary import Quantity, table, write_summary
from tigar_x.run.vtkhdf import VTKHDFSeries
from tigar_x.run.writing import claim
from tigar_x.splines.spline import ExtractedSpline
from tigar_x.splines.vtu import VTUSeries
from varmint.conditions import Condition, Slip, Traction, WeakVelocity
from varmint.flow import Flow, FlowOptions
from varmint.mesh import NamedMesh, box
from varmint.mesh.arrays import mirrored_box
from varmint.quantities import Measured, NodalField, kinetic_energy, vorticity

DOI = "10.1016/j.cma.2014.10.040"
TOY = {"elements": 6, "leaflet_elements": 6, "until": 0.15, "dt_factor": 1.5}
SIDES, FRAMES = ("bottom", "top"), 60

# Time and displacement along the channel of the top tip, read off the published curve with an accuracy of 0.04 and
# 0.005 (READING); the times of the troughs were not read off.
PEAKS = ((0.25, 0.579), (1.21, 0.585), (2.27, 0.583))
TROUGHS = (0.324, 0.324, 0.325)
READING = 0.005
COLUMNS = (  # leak and slip belong to t_alpha
    *("t_alpha", "passes", "bottom_x", "bottom_y", "top_x", "top_y", "inflow", "leak", "normal_slip"),
    *("kinetic_fluid", "kinetic_shell", "elastic"),
)


@dataclass(frozen=True)
class Data:
    """The problem's data; consistent units."""

    length: float = 8.0
    height: float = 1.61
    depth: float = 1.0
    T: float = 3.0
    mu: float = 10.0
    rho: float = 100.0
    speed: float = 5.0
    mean: float = 1.1
    leaflet_x: float = 2.0
    leaflet_length: float = 0.7
    thickness: float = 0.0212
    youngs_modulus: float = 5.6e7
    poisson_ratio: float = 0.4
    rho_s: float = 100.0
    rho_infinity: float = 0.0

    def pulse(self, t: Any, ramp: Any) -> Any:
        """Factor of the inflow's profile at a time; the ramp lasts from 0 to ``ramp``."""
        return self.speed * (ufl.sin(2 * ufl.pi * t) + self.mean) * ufl.min_value(t / ramp, 1.0)

    def inflow(self, t: Any, ramp: float) -> Any:
        """Flow rate per depth through the inlet, for an array of times."""
        pulse = self.speed * (np.sin(2 * np.pi * t) + self.mean) * np.minimum(t / ramp, 1.0)
        return pulse * self.height**3 / 6.0


@dataclass(frozen=True, eq=False)
class Valve:
    """The coupled scene before its first step.

    Attributes:
        data: of the problem.
        flow: the channel's flow.
        fsi: what is coupled.
        material: of the leaflets.
        ramp: time within which the inflow comes up.
    """

    data: Data
    flow: Flow
    fsi: CouDALFISh
    material: StVenantKirchhoff
    ramp: float

    def tips(self) -> FloatArray:
        """Displacement of the free ends of bottom and top leaflet, the mean over an extrusion's depth, shape (2, d)."""
        spline, d = self.fsi.spline_sh, self.data
        x_2, y = spline.node_positions[:, 1], spline.nodal(self.fsi.timeInt_sh.x)
        ends = (d.leaflet_length, d.height - d.leaflet_length)
        return np.array([y[np.isclose(x_2, end, rtol=0.0, atol=1e-9)].mean(axis=0) for end in ends])

    def energies(self) -> tuple[Measured, Measured]:
        """Compiled kinetic energy of the fluid, and kinetic and elastic energy of the leaflets."""
        spline, time, d = self.fsi.spline_sh, self.fsi.timeInt_sh, self.data
        v = spline.rationalize(time.xdot_old)
        kinetic = d.rho_s * d.thickness / 2 * ufl.dot(v, v) * spline.dx
        return (
            Measured(kinetic_fluid=kinetic_energy(self.flow)),
            Measured(kinetic_shell=kinetic, elastic=strain_energy(spline, self.material, time.x)),
        )


def make_flow(mesh: NamedMesh, data: Data, dt: float, options: FlowOptions) -> Flow:
    """Weak velocities on inlet and walls, a free outlet, slip on an extrusion's ends."""
    d = mesh.domain.geometry.dim
    ramp = fem.Constant(mesh.domain, 2.0 * dt)

    def profile(x: Any, t: Any) -> Any:
        return ufl.as_vector([data.pulse(t, ramp) * x[1] * (data.height - x[1]), *[0.0] * (d - 1)])

    conditions: list[Condition] = [WeakVelocity("left", profile), WeakVelocity(("bottom", "top")), Traction("right")]
    if d == 3:
        conditions.append(Slip(("back", "front")))
    return Flow(
        mesh,
        conditions,
        rho=data.rho,
        mu=data.mu,
        dt=dt,
        scheme=generalized_alpha(data.rho_infinity),
        immersed=True,
        options=options,
    )


def make_leaflets(data: Data, d: int, elements: int, degree: int, dt: float) -> tuple[ShellSubproblem, Any]:
    """Both leaflets as patches of one spline, from below upwards so that both normals point along the channel.

    They are clamped to the walls by two rows of control points; nothing moves along an extrusion.
    """
    x, L, H = data.leaflet_x, data.leaflet_length, data.height
    spans = ((0.0, L), (H - L, H))
    if d == 2:
        patches = [shapes.line((x, low), (x, high), elements=elements, degree=degree) for low, high in spans]
    else:
        across = (0.0, 0.0, data.depth)
        patches = [
            shapes.parallelogram(
                (x, low, 0.0), (0.0, high - low, 0.0), across, elements=(elements, 1), degrees=(degree, 1)
            )
            for low, high in spans
        ]
    leaflets = disjoint(*patches)
    fixed = [clamped(leaflets, "u0", patch=0), clamped(leaflets, "u1", patch=1)]
    if d == 3:
        fixed.append(np.arange(2, 3 * leaflets.n, 3, dtype=np.int32))
    spline = ExtractedSpline(leaflets, MPI.COMM_SELF, quadrature_degree=4, zero_dofs=np.unique(np.concatenate(fixed)))
    c = script.constants(spline.mesh, data)
    y, z = spline.function(name="y"), ufl.TestFunction(spline.V)
    time = TimeIntegrator(y, dt, generalized_alpha(data.rho_infinity, 2, first_order_alpha_m=True))
    material = StVenantKirchhoff(c.youngs_modulus, c.poisson_ratio, c.thickness)
    mass = inertia(spline, time.xddot_alpha, z, density=c.rho_s, thickness=c.thickness)
    residual = internal_work(spline, material, time.x_alpha, z) + mass
    tangent = internal_tangent(spline, material, time.x_alpha, z, y) + ufl.derivative(mass, y)
    return ShellSubproblem(spline, residual, time, solver=direct("petsc"), tangent=tangent), material


def build(
    d: int = 2,
    elements: int = 16,
    dt: float | None = None,
    options: CouplingOptions | None = None,
    *,
    leaflet_elements: int = 16,
    degree: int = 2,
    mirrored: bool = False,
    invariant_metric: bool = False,
    solver: LinearSolver | None = None,
    data: Data | None = None,
) -> Valve:
    """The scene before its first step.

    Args:
        d: dimension of space.
        elements: fluid cells across the channel, five times as many along it.
        dt: time step; None: the published one, 3/(32 elements).
        options: of the coupling; None: the defaults.
        leaflet_elements: Bezier elements of each leaflet.
        degree: of the leaflets.
        mirrored: whether the cells below the channel's axis mirror those above.
        invariant_metric: whether the element metric does not depend on the numbering of vertices.
        solver: of the flow; None: by size.
        data: of the problem; None: as published.
    """
    data = Data() if data is None else data
    n = checks.whole("elements", elements, 1)
    dt = data.T / (32 * n) if dt is None else dt
    lengths = (data.length, data.height, data.depth)[:d]
    corners_and_counts = (0.0,) * d, lengths, (5 * n, n, 1)[:d]
    if mirrored:
        mesh = mirrored_box(MPI.COMM_WORLD, *corners_and_counts, original="upper")
    else:
        mesh = box(MPI.COMM_WORLD, *corners_and_counts)
    shell, material = make_leaflets(data, d, leaflet_elements, degree, dt)
    flow = make_flow(mesh, data, dt, FlowOptions(invariant_metric=invariant_metric))
    fluid = FluidSubproblem(
        mesh.domain,
        flow.residual,
        flow.time,
        bcs=flow.bcs,
        band=SurfaceBand(mesh.domain, flow.scales),
        updates=flow.updates,
        solver=solver,
        density=data.rho,
        viscosity=data.mu,
        mesh_size=data.height / n,
    )
    return Valve(data, flow, CouDALFISh(fluid, shell, options), material, 2.0 * dt)


def extremum(t: FloatArray, x: FloatArray, sign: float, low: float, high: float) -> tuple[float, float] | None:
    """Time and value of the largest ``sign * x`` between two times.

    The value is that of a parabola through the three nearest samples. Tops are flat: the time is the middle of the
    interval in which x is as good as the value, to the accuracy of reading.

    Returns:
        None where the samples end more than a step before ``high``, or where there is no such interval.
    """
    inside = np.flatnonzero((t >= low - 1e-9) & (t <= high + 1e-9))
    if len(inside) < 3 or t[-1] < high - (t[1] - t[0]):
        return None
    i = int(inside[np.argmax(sign * x[inside])])
    level = x[i] - sign * READING
    lower = np.flatnonzero(sign * (x - level) < 0.0)
    before, after = lower[lower < i], lower[lower > i]
    if i in (inside[0], inside[-1]) or not (len(before) and len(after)):
        return None
    ends = [t[j] + (level - x[j]) / (x[j + 1] - x[j]) * (t[j + 1] - t[j]) for j in (before[-1], after[0] - 1)]
    left, here, right = x[i - 1 : i + 2]
    shift = 0.5 * (left - right) / (left - 2.0 * here + right)
    return float(np.mean(ends)), float(here - 0.25 * (left - right) * shift)


def extrema(t: FloatArray, x: FloatArray) -> dict[str, tuple[float, float]]:
    """Peaks and troughs of a tip's history that have been reached: time and value by name."""
    found = {}
    for n in range(len(PEAKS)):
        found[f"peak_{n + 1}"] = extremum(t, x, 1.0, n, n + 0.6)
        found[f"trough_{n + 1}"] = extremum(t, x, -1.0, n + 0.6, n + 1.0)
    return {name: value for name, value in found.items() if value is not None}


def compare(columns: dict[str, FloatArray]) -> tuple[dict[str, float], dict[str, Quantity]]:
    """Deviations from the published peaks and troughs, and all quantities, from the columns of all steps."""
    t, bottom, top = (columns[name] for name in ("t", "bottom_x", "top_x"))
    known = {f"peak_{n}": peak for n, peak in enumerate(PEAKS, 1)}
    known |= {f"trough_{n}": (None, trough) for n, trough in enumerate(TROUGHS, 1)}
    errors, qoi = {}, {}
    for name, (time, value) in extrema(t, top).items():
        known_time, known_value = known[name]
        qoi[f"top_{name}"] = Quantity(value, known_value, DOI)
        qoi[f"top_{name}_time"] = Quantity(time, known_time, None if known_time is None else DOI)
        errors[name] = abs(value - known_value)
        if known_time is not None:
            errors[f"{name}_time"] = abs(time - known_time)
    qoi |= {f"bottom_{name}": Quantity(value) for name, (_, value) in extrema(t, bottom).items()}
    qoi |= {"top_end": Quantity(float(top[-1])), "bottom_end": Quantity(float(bottom[-1]))}
    return errors, qoi


def main(
    dim: Literal[2, 3] = 2,
    elements: int = 16,
    leaflet_elements: int = 16,
    degree: int = 2,
    preset: Literal["reference", "default"] = "default",
    smoothing: float = 0.0,
    steps_per_element: int = 32,
    dt_factor: float = 1.0,
    until: float = 3.0,
    mirrored: bool | None = None,
    invariant_metric: bool = False,
    out: Path = Path("results/valve_2d"),
    overwrite: bool = False,
    viz: bool = True,
    checkpoint_every: int = 0,
    restart: str = "",
) -> dict[str, Any]:
    """Let the pulsating flow move two leaflets, and compare the top one's tip with the published curve.

    Args:
        dim: dimension of space, 2 or 3 (one layer).
        elements: fluid cells across the channel, five times as many along it.
        leaflet_elements: Bezier elements of each leaflet.
        degree: of the leaflets, at least 2.
        preset: the published algorithm, or this library's defaults.
        smoothing: relaxation of the multiplier towards its means over vertices, about 0.5; 0: none.
        steps_per_element: the published time step is 3 over this times the elements.
        dt_factor: time step relative to the published one.
        until: end.
        mirrored: whether the cells below the channel's axis mirror those above, for an even number of elements;
            default: with the default preset, where the number is even; the published mesh is not mirrored.
        invariant_metric: whether the stabilisation's element metric does not depend on the numbering of vertices.
        out: folder of the results.
        overwrite: whether to delete the results of an earlier run in this folder.
        viz: whether to write ParaView files, the history and a picture.
        checkpoint_every: steps between checkpoints; 0: none, but where the run is told to end.
        restart: checkpoint to go on from: "latest", the number of its step, or its file.

    Returns:
        The summary; nothing where the run was told to end.
    """
    data, factor, until = Data(), checks.positive("dt_factor", dt_factor), checks.positive("until", until)
    published = checks.whole("steps_per_element", steps_per_element, 1) * checks.whole("elements", elements, 1)
    dt = factor * data.T / published
    steps = max(1, round(until / dt))
    discretisation = {
        "leaflet_elements": checks.whole("leaflet_elements", leaflet_elements, 2),
        "degree": checks.whole("degree", degree, 2),
        "mirrored": preset == "default" and elements % 2 == 0 if mirrored is None else mirrored,
        "invariant_metric": invariant_metric,
    }
    options = options_of(preset)
    if checks.not_negative("smoothing", smoothing):
        options = replace(options, relaxation=smoothing, relaxation_mode="smoothed")
    claim(out, overwrite=overwrite, restart=restart)
    valve = build(dim, elements, dt, options, data=data, **discretisation)
    fsi = valve.fsi
    inputs = {"dim": dim, "elements": elements, **discretisation, "preset": preset, "options": options}
    inputs |= {"steps_per_element": steps_per_element, "dt_factor": factor}
    run = Restart(out / "checkpoints", CoupledState(fsi), every=checkpoint_every, inputs=inputs)
    if restart:
        run.read(restart)

    watch, progress = Stopwatch(), Progress(steps, done=run.step)
    numbers, memory = run.extra.setdefault("steps", []), []
    pictures = Pictures(out, valve, run, max(1, steps // FRAMES)) if viz else None
    for n in run.steps(progress):
        with watch:
            report = fsi.takeStep()
        numbers.append(in_numbers(report, valve.tips()))
        memory.append(rss_mib())
        progress.show(report)
        if pictures:
            pictures.write(n, numbers[-1])
    columns = {name: np.array([step[name] for step in numbers]) for name in numbers[0]}
    if pictures:
        pictures.close(columns)
    if run.step < steps:
        return {}

    depth = data.depth if dim == 3 else 1.0
    entered = data.inflow(columns["t"], valve.ramp).sum()
    errors, qoi = compare(columns)
    summary = write_summary(
        out,
        "valve_2d",
        {**inputs, "until": until},
        errors=errors or None,
        qoi=qoi,
        steps=steps,
        block_iterations_mean=float(columns["passes"].mean()),
        block_iterations_max=int(columns["passes"].max()),
        linear_iterations_mean=float(columns["linear_iterations"].mean()),
        dofs_fluid=valve.flow.unknowns,
        dofs_shell=fsi.spline_sh.geometry.n * dim,
        wall_s=watch.wall_s,
        cpu_s=watch.cpu_s,
        rss_mib_step_10=memory[min(9, len(memory) - 1)] if memory else None,
        rss_mib_end=memory[-1] if memory else None,
        monitors={
            "leak_max": float(np.abs(columns["leak"]).max()) / depth,
            "leaked_share": float(np.abs(columns["leak"]).sum() / depth / entered),
            "asymmetry_max": float(np.abs(columns["top_x"] - columns["bottom_x"]).max()),
            **{f"{name}_max": columns[name].max() for name in ("normal_slip", "slip_ratio", "force_imbalance")},
        },
    )
    if MPI.COMM_WORLD.rank == 0:
        head = f"{valve.flow.unknowns} fluid unknowns, preset {preset}, {steps} steps to t = {columns['t'][-1]:g}"
        print(f"{head}, {watch.cpu_s:.4g} CPU s, {summary['block_iterations_mean']:.2f} passes each")
        shown = [(name, q.value, "-" if q.published is None else q.published) for name, q in qoi.items()]
        print(table(["quantity", "value", f"published (doi:{DOI})"], shown))
    return summary


def options_of(preset: str) -> CouplingOptions:
    """Options of the coupling by the name of a preset; the reference has the tolerance of the published run."""
    return replace(CouplingOptions.reference(), block_rtol=1e-2) if preset == "reference" else CouplingOptions()


def in_numbers(report: StepReport, tips: FloatArray) -> dict[str, float]:
    """What summary and history need of a step."""
    m = report.monitors
    return {
        "t": report.t,
        "t_alpha": report.t_alpha,
        "passes": report.passes,
        "linear_iterations": report.linear_iterations,
        **{f"{side}_{x}": float(tips[i, j]) for i, side in enumerate(SIDES) for j, x in enumerate("xy")},
        "leak": m.leak,
        "normal_slip": m.normal_slip_max,
        "force_imbalance": m.force_imbalance,
        "slip_ratio": report.slip_ratio,
    }


class Pictures:
    """ParaView files and histories of the run, and a picture at its end."""

    def __init__(self, out: Path, valve: Valve, run: Restart, every: int) -> None:
        self._out, self._valve, self._every = out, valve, every
        w, time, d = valve.flow.w, valve.fsi.timeInt_sh, valve.fsi.mesh_f.geometry.dim
        self._vorticity: NodalField = vorticity(valve.flow)
        self._energies = valve.energies()
        curl = self._vorticity.field, tuple(range(1 if d == 2 else 3))
        fields = {"velocity": (w, tuple(range(d))), "pressure": (w, (d,)), "vorticity": curl}
        self._fluid = VTKHDFSeries(out / "fluid.vtkhdf", valve.fsi.mesh_f, after=run.after, **fields)
        self._shell = VTUSeries(
            out / "shell",
            valve.fsi.spline_sh,
            y=time.x,
            after=run.after,
            velocity=time.xdot_old,
            multiplier=lambda: valve.fsi.lam,
        )
        self._history = CSVSeries(out / "history.csv", COLUMNS, after=run.after)

    def write(self, n: int, step: dict[str, float]) -> None:
        """Append the present state."""
        found = step | {"inflow": float(self._valve.data.inflow(np.array(step["t"]), self._valve.ramp))}
        for measured in self._energies:
            found |= measured()
        self._history.write(step["t"], *(found[name] for name in COLUMNS))
        if n % self._every == 0:
            self._vorticity()
            self._fluid.write(step["t"])
            self._shell.write(step["t"])

    def close(self, columns: dict[str, FloatArray]) -> None:
        """Finish the files and draw the last state."""
        for series in (self._fluid, self._shell, self._history):
            series.close()
        fields = PlaneField(self._valve.flow.w), PlaneField(self._vorticity())
        draw(self._out / "valve_2d.png", self._valve, *fields, columns)


@root_only
def draw(path: Path, valve: Valve, flow: PlaneField, curl: PlaneField, columns: dict[str, FloatArray]) -> None:
    """Speed, vorticity and leaflets, and the histories of both tips with the published peaks and troughs."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    spline = valve.fsi.spline_sh
    X, y = spline.node_positions, spline.nodal(valve.fsi.timeInt_sh.x)
    plane = np.isclose(X[:, 2], 0.0) if X.shape[1] == 3 else np.full(len(X), True)
    middle = valve.data.height / 2.0
    leaflets = [np.flatnonzero(plane & side) for side in (X[:, 1] < middle, X[:, 1] > middle)]
    figure = plt.figure(figsize=(11, 8.4), layout="constrained")
    grid = figure.add_gridspec(3, 1, height_ratios=(1, 1, 1.5))
    axes = [figure.add_subplot(grid[i]) for i in range(3)]
    flow.shade(axes[0], np.linalg.norm(flow.values[:, :2], axis=1), Colours("speed", "length/time"), length="length")
    limit = 0.5 * np.abs(curl.values[:, -1]).max()
    curl.shade(axes[1], curl.values[:, -1], Colours("vorticity", "1/time", -limit, limit, "RdBu_r"), length="length")
    for axis in axes[:2]:
        for nodes in leaflets:
            nodes = nodes[np.argsort(X[nodes, 1])]
            axis.plot(*(X + y)[nodes, :2].T, "k-", linewidth=2.0)
    t = columns["t"]
    axes[0].set_title(f"t = {t[-1]:.3g}")
    axes[2].plot(t, columns["top_x"], "C3", label="top leaflet")
    axes[2].plot(t, columns["bottom_x"], "C0--", label="bottom leaflet")
    axes[2].errorbar(*zip(*PEAKS, strict=True), xerr=0.04, yerr=0.005, fmt="k.", label="published peaks")
    for n, trough in enumerate(TROUGHS):
        label = None if n else "published troughs"
        axes[2].hlines(trough, n + 0.6, n + 1.0, colors="k", linestyles=":", label=label)
    axes[2].set(xlabel="$t$", ylabel="displacement of the tip along the channel", xlim=(0.0, t[-1]))
    axes[2].legend()
    figure.savefig(path, dpi=130)
    plt.close(figure)


if __name__ == "__main__":
    script.command_line(main)
