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

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import permutations
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal

import numpy as np
import ufl
from mpi4py import MPI
from dolfinx import fem

from coudalfish import CouDALFISh, CouplingOptions, FluidSubproblem, ShellSubproblem, StepReport, SurfaceBand
from shnapr.loads import inertia
from shnapr.supports import clamped
from shnapr.svk import StVenantKirchhoff
from shnapr.work import internal_tangent, internal_work, strain_energy
from tigar_x import checks, script, shapes
from tigar_x.compat import FloatArray
from tigar_x.linear import LinearSolver, direct
from tigar_x.multipatch import disjoint
from tigar_x.output import CSVSeries, VTUSeries, XDMFSeries
from tigar_x.spline import ExtractedSpline
from tigar_x.time_integration import TimeIntegrator, generalized_alpha
from varmint.conditions import Condition, Slip, Traction, WeakVelocity
from varmint.flow import Flow, FlowOptions
from varmint.mesh import NamedMesh, box, named
from varmint.mesh_arrays import from_arrays
from varmint.pictures import PlaneField
from varmint.quantities import Measured, NodalField, kinetic_energy, vorticity

DOI = "10.1016/j.cma.2014.10.040"
TOY = {"elements": 6, "leaflet_elements": 6, "until": 0.15, "dt_factor": 1.5}
BOTTOM, TOP = 0, 1

# Time and displacement along the channel of the top tip, read off the published curve (+-0.04 and +-0.005); the times
# of the troughs were not read off.
PEAKS = ((0.25, 0.579), (1.21, 0.585), (2.27, 0.583))
TROUGHS = (0.324, 0.324, 0.325)
COLUMNS = (
    *("passes", "bottom_x", "bottom_y", "top_x", "top_y", "inflow", "leak", "normal_slip_rms"),
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


def mirrored(data: Data, elements: Sequence[int]) -> NamedMesh:
    """The channel of simplices of which those above its axis mirror those below.

    Args:
        data: of the problem.
        elements: along the axes; an even number along the second.

    Raises:
        ValueError: an odd number across the channel.
    """
    d, lengths = len(elements), (data.length, data.height, data.depth)
    if elements[1] % 2:
        raise ValueError(f"elements = {elements[1]}: an even number is required for a mirrored mesh")
    boxes = np.indices(elements).reshape(d, -1).T
    steps = [np.eye(d, dtype=int)[list(order)].cumsum(axis=0) for order in permutations(range(d))]
    paths = np.pad(steps, ((0, 0), (1, 0), (0, 0)))  # every simplex goes from the lowest corner to the highest one
    vertices = boxes[:, None, None] + paths
    above = boxes[:, 1] >= elements[1] // 2
    vertices[above, ..., 1] = boxes[above, None, None, 1] + 1 - paths[..., 1]
    cells = np.ravel_multi_index(tuple(np.moveaxis(vertices, -1, 0)), np.array(elements) + 1).reshape(-1, d + 1)
    lines = [np.linspace(0.0, length, n + 1) for length, n in zip(lengths, elements, strict=False)]
    x = np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1).reshape(-1, d)
    domain = from_arrays(MPI.COMM_WORLD, "triangle" if d == 2 else "tetrahedron", cells, x).domain
    names = ("left", "right", "bottom", "top", "back", "front")[: 2 * d]
    places = [(i, end) for i in range(d) for end in (0.0, lengths[i])]
    sides: dict[str, Any] = {
        name: lambda x, i=i, end=end: np.isclose(x[i], end, atol=1e-9)
        for name, (i, end) in zip(names, places, strict=True)
    }
    return named(domain, **sides)


def make_flow(mesh: NamedMesh, data: Data, dt: float, band: SurfaceBand, options: FlowOptions) -> Flow:
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
        scale_m=band.scale_m,
        scale_c=band.scale_c,
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
    fixed = [clamped(leaflets, "u0", patch=BOTTOM), clamped(leaflets, "u1", patch=TOP)]
    if d == 3:
        fixed.append(np.arange(2, 3 * leaflets.n, 3, dtype=np.int32))
    spline = ExtractedSpline(leaflets, MPI.COMM_SELF, quadrature_degree=4, zero_dofs=np.unique(np.concatenate(fixed)))
    c = SimpleNamespace(**{name: fem.Constant(spline.mesh, float(value)) for name, value in vars(data).items()})
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
    is_mirrored: bool = False,
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
        is_mirrored: whether the cells above the channel's axis mirror those below.
        invariant_metric: whether the element metric does not depend on the numbering of vertices.
        solver: of the flow; None: by size.
        data: of the problem; None: as published.
    """
    data = Data() if data is None else data
    n = checks.whole("elements", elements, 1)
    dt = data.T / (32 * n) if dt is None else dt
    counts, upper = (5 * n, n, 1)[:d], (data.length, data.height, data.depth)[:d]
    mesh = mirrored(data, counts) if is_mirrored else box(MPI.COMM_WORLD, (0.0,) * d, upper, counts)
    shell, material = make_leaflets(data, d, leaflet_elements, degree, dt)
    band = SurfaceBand(mesh.domain)
    flow = make_flow(mesh, data, dt, band, FlowOptions(invariant_metric=invariant_metric))
    fluid = FluidSubproblem(
        mesh.domain,
        flow.residual,
        flow.time,
        bcs=flow.bcs,
        band=band,
        updates=flow.updates,
        solver=solver,
        density=data.rho,
        viscosity=data.mu,
        mesh_size=data.height / n,
    )
    return Valve(data, flow, CouDALFISh(fluid, shell, options), material, 2.0 * dt)


def extremum(t: FloatArray, x: FloatArray, sign: float, low: float, high: float) -> tuple[float, float] | None:
    """Time and value of the largest ``sign * x`` between two times, by a parabola through the three nearest samples.

    Returns:
        None where the samples do not reach ``high``, or where it is at the end of the interval.
    """
    inside = np.flatnonzero((t >= low - 1e-9) & (t <= high + 1e-9))
    if len(inside) < 3 or t[-1] < high - 1e-9:
        return None
    i = int(inside[np.argmax(sign * x[inside])])
    if i in (inside[0], inside[-1]):
        return None
    before, here, after = x[i - 1 : i + 2]
    shift = 0.5 * (before - after) / (before - 2.0 * here + after)
    return float(t[i] + shift * (t[i] - t[i - 1])), float(here - 0.25 * (before - after) * shift)


def extrema(t: FloatArray, x: FloatArray) -> dict[str, tuple[float, float]]:
    """Peaks and troughs of a tip's history that have been reached: time and value by name."""
    found = {}
    for n in range(len(PEAKS)):
        found[f"peak_{n + 1}"] = extremum(t, x, 1.0, n, n + 0.6)
        found[f"trough_{n + 1}"] = extremum(t, x, -1.0, n + 0.6, n + 1.0)
    return {name: value for name, value in found.items() if value is not None}


def compare(history: FloatArray) -> tuple[dict[str, float], dict[str, script.Quantity]]:
    """Deviations from the published peaks and troughs, and all quantities.

    Args:
        history: rows of time and the displacements of bottom and top tip along the channel.
    """
    t, bottom, top = history.T
    known = {f"peak_{n}": peak for n, peak in enumerate(PEAKS, 1)}
    known |= {f"trough_{n}": (None, trough) for n, trough in enumerate(TROUGHS, 1)}
    errors, qoi = {}, {}
    for name, (time, value) in extrema(t, top).items():
        known_time, known_value = known[name]
        qoi[f"top_{name}"] = script.Quantity(value, known_value, DOI)
        qoi[f"top_{name}_time"] = script.Quantity(time, known_time, None if known_time is None else DOI)
        errors[name] = abs(value - known_value)
        if known_time is not None:
            errors[f"{name}_time"] = abs(time - known_time)
    qoi |= {f"bottom_{name}": script.Quantity(value) for name, (_, value) in extrema(t, bottom).items()}
    qoi |= {"top_end": script.Quantity(float(top[-1])), "bottom_end": script.Quantity(float(bottom[-1]))}
    return errors, qoi


def main(
    dim: Literal[2, 3] = 2,
    elements: int = 16,
    leaflet_elements: int = 16,
    degree: int = 2,
    preset: Literal["reference", "default"] = "default",
    steps_per_element: int = 32,
    dt_factor: float = 1.0,
    until: float = 3.0,
    mirrored: bool = False,
    invariant_metric: bool = False,
    out: Path = Path("results/valve_2d"),
    viz: bool = True,
) -> dict[str, Any]:
    """Let the pulsating flow move two leaflets, and compare the top one's tip with the published curve.

    Args:
        dim: dimension of space, 2 or 3 (one layer).
        elements: fluid cells across the channel, five times as many along it.
        leaflet_elements: Bezier elements of each leaflet.
        degree: of the leaflets, at least 2.
        preset: the published algorithm, or this library's defaults.
        steps_per_element: the published time step is 3 over this times the elements.
        dt_factor: time step relative to the published one.
        until: end.
        mirrored: whether the cells above the channel's axis mirror those below, for an even number of elements.
        invariant_metric: whether the stabilisation's element metric does not depend on the numbering of vertices.
        out: folder of the results.
        viz: whether to write ParaView files, the history and a picture.

    Returns:
        The summary.
    """
    data, factor, until = Data(), checks.positive("dt_factor", dt_factor), checks.positive("until", until)
    published = checks.whole("steps_per_element", steps_per_element, 1) * checks.whole("elements", elements, 1)
    checks.whole("leaflet_elements", leaflet_elements, 2), checks.whole("degree", degree, 2)
    dt = factor * data.T / published
    steps = max(1, round(until / dt))
    options = CouplingOptions()
    if preset == "reference":
        options = replace(CouplingOptions.reference(), block_rtol=1e-2)
    valve = build(
        dim,
        elements,
        dt,
        options,
        leaflet_elements=leaflet_elements,
        degree=degree,
        is_mirrored=mirrored,
        invariant_metric=invariant_metric,
        data=data,
    )
    watch, progress = script.Stopwatch(), script.Progress(steps)
    reports, rows, memory = [], [], []
    pictures = Pictures(out, valve, steps) if viz else None
    for n in progress:
        with watch:
            report = valve.fsi.takeStep()
        reports.append(report)
        tips = valve.tips()
        rows.append((report.t, *tips[:, 0]))
        memory.append(script.rss_mib())
        progress.show(report)
        if pictures:
            pictures.write(n, report, tips)
    history = np.array(rows)
    if pictures:
        pictures.close(history)

    passes = [report.passes for report in reports]
    leak = np.array([report.monitors.leak for report in reports if report.monitors])
    entered = data.inflow(history[:, 0], valve.ramp).sum()
    depth = data.depth if dim == 3 else 1.0
    errors, qoi = compare(history)
    inputs = {
        "dim": dim,
        "elements": elements,
        "leaflet_elements": leaflet_elements,
        "degree": degree,
        "preset": preset,
        "steps_per_element": steps_per_element,
        "dt_factor": factor,
        "until": until,
        "mirrored": mirrored,
        "invariant_metric": invariant_metric,
        "options": options,
    }
    summary = script.write_summary(
        out,
        "valve_2d",
        inputs,
        errors=errors or None,
        qoi=qoi,
        steps=steps,
        block_iterations_mean=float(np.mean(passes)),
        block_iterations_max=max(passes),
        linear_iterations_mean=float(np.mean([report.linear_iterations for report in reports])),
        dofs_fluid=valve.flow.unknowns,
        dofs_shell=valve.fsi.spline_sh.geometry.n * dim,
        wall_s=watch.wall_s,
        cpu_s=watch.cpu_s,
        rss_mib_step_10=memory[min(9, len(memory) - 1)],
        rss_mib_end=memory[-1],
        monitors={
            "leak_max": float(np.abs(leak).max()) / depth,
            "leaked_share": float(np.abs(leak).sum() / depth / entered),
            "asymmetry_max": float(np.abs(history[:, 2] - history[:, 1]).max()),
            "normal_slip_max": max(report.monitors.normal_slip_max for report in reports if report.monitors),
            "slip_ratio_max": max(report.slip_ratio for report in reports),
            "force_imbalance_max": max(report.monitors.force_imbalance for report in reports if report.monitors),
        },
    )
    if MPI.COMM_WORLD.rank == 0:
        head = f"{valve.flow.unknowns} fluid unknowns, preset {preset}, {steps} steps to t = {history[-1, 0]:g}"
        print(f"{head}, {watch.cpu_s:.4g} CPU s, {np.mean(passes):.2f} passes each")
        shown = [(name, q.value, "-" if q.published is None else q.published) for name, q in qoi.items()]
        print(script.table(["quantity", "value", f"published (doi:{DOI})"], shown))
    return summary


class Pictures:
    """ParaView files and histories of the run, and a picture at its end."""

    def __init__(self, out: Path, valve: Valve, steps: int, frames: int = 60) -> None:
        self._out, self._valve, self._every = out, valve, max(1, steps // frames)
        w, time, d = valve.flow.w, valve.fsi.timeInt_sh, valve.fsi.mesh_f.geometry.dim
        self._vorticity: NodalField = vorticity(valve.flow)
        self._energies = valve.energies()
        curl = self._vorticity.field, tuple(range(1 if d == 2 else 3))
        fields = {"velocity": (w, tuple(range(d))), "pressure": (w, (d,)), "vorticity": curl}
        self._fluid = XDMFSeries(out / "fluid.xdmf", valve.fsi.mesh_f, **fields)
        self._shell = VTUSeries(
            out / "shell", valve.fsi.spline_sh, y=time.x, velocity=time.xdot_old, multiplier=lambda: valve.fsi.lam
        )
        self._history = CSVSeries(out / "history.csv", COLUMNS)

    def write(self, n: int, report: StepReport, tips: FloatArray) -> None:
        """Append the present state."""
        m, inflow = report.monitors, self._valve.data.inflow(np.array(report.t), self._valve.ramp)
        energies = [value for measured in self._energies for value in measured().values()]
        if m is not None:
            places = tips[:, :2].ravel()
            self._history.write(report.t, report.passes, *places, inflow, m.leak, m.normal_slip_rms, *energies)
        if n % self._every == 0:
            self._vorticity()
            self._fluid.write(report.t)
            self._shell.write(report.t)

    def close(self, history: FloatArray) -> None:
        """Finish the files and draw the last state."""
        for series in (self._fluid, self._shell, self._history):
            series.close()
        fields = PlaneField(self._valve.flow.w), PlaneField(self._vorticity())
        if fields[0].is_here:
            draw(self._out / "valve_2d.png", self._valve, *fields, history)


def draw(path: Path, valve: Valve, flow: PlaneField, curl: PlaneField, history: FloatArray) -> None:
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
    flow.shade(axes[0], np.linalg.norm(flow.values[:, :2], axis=1), "speed", cmap="viridis")
    limit = 0.2 * np.abs(curl.values[:, -1]).max()
    curl.shade(axes[1], curl.values[:, -1], "vorticity", cmap="RdBu_r", vmin=-limit, vmax=limit)
    for axis in axes[:2]:
        for nodes in leaflets:
            nodes = nodes[np.argsort(X[nodes, 1])]
            axis.plot(*(X + y)[nodes, :2].T, "k-", linewidth=2.0)
    axes[0].set_title(f"t = {history[-1, 0]:.3g}")
    axes[2].plot(history[:, 0], history[:, 2], "C3", label="top leaflet")
    axes[2].plot(history[:, 0], history[:, 1], "C0--", label="bottom leaflet, mirrored")
    axes[2].errorbar(*zip(*PEAKS, strict=True), xerr=0.04, yerr=0.005, fmt="k.", label="published peaks")
    for n, trough in enumerate(TROUGHS):
        label = None if n else "published troughs"
        axes[2].hlines(trough, n + 0.6, n + 1.0, colors="k", linestyles=":", label=label)
    axes[2].set(xlabel="$t$", ylabel="displacement of the tip along the channel", xlim=(0.0, history[-1, 0]))
    axes[2].legend()
    figure.savefig(path, dpi=130)
    plt.close(figure)


if __name__ == "__main__":
    script.command_line(main)
