"""A membrane swept along by a flow: the manufactured fluid-structure benchmark.

The square (0, L)^2 is cut by a membrane that starts as the line x_1 = L/2 and moves with y = V t Y(X_2) e_1,
Y(s) = L s - s^2. Left of it the flow is u = V Y(x_2) e_1, p = 0. Right of it

    u = V Y(x_2) e_1 + S (V t Y'(x_2) e_1 + e_2),   S = V (x_1 - L/2 - V t Y(x_2))/L,   p = -DP,

so that u is continuous and solenoidal, equals the membrane's velocity on it, and pressure and velocity gradient jump.
Body forces on both sides and a load on the membrane make this an exact solution of the coupled problem.

Source: D. Kamensky, "Open-source immersogeometric analysis of fluid-structure interaction using FEniCS and tIGAr",
section 5.3.1, doi:10.1016/j.camwa.2020.01.023.

In three dimensions the square is extruded by H with one layer of cells and slip on its top and bottom, as in the
source. All norms are per unit depth.
"""

from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal

import numpy as np
import ufl
from mpi4py import MPI
from dolfinx import fem, mesh

from coudalfish import CouDALFISh, CouplingOptions, FluidSubproblem, ShellSubproblem, StepReport, SurfaceBand
from coudalfish.restart import CoupledState
from shnapr.loads import dead_load, inertia
from shnapr.svk import StVenantKirchhoff
from shnapr.work import strain_energy, virtual_work
from tigar_x import checks, compat
from tigar_x.fem.linear import LinearSolver, direct
from tigar_x.fem.schemes import generalized_alpha
from tigar_x.fem.solve import FiniteElementSystem
from tigar_x.fem.time_integration import TimeIntegrator
from tigar_x.geometry import shapes
from tigar_x.ranks import root_only
from tigar_x.run import script
from tigar_x.run.output import CSVSeries
from tigar_x.run.plane_field import PlaneField
from tigar_x.run.progress import Progress, Stopwatch, rss_mib
from tigar_x.run.restart import Restart
from tigar_x.run.summary import table, write_summary
from tigar_x.run.vtkhdf import VTKHDFSeries
from tigar_x.run.writing import claim
from tigar_x.splines.spline import ExtractedSpline
from tigar_x.splines.vtu import VTUSeries
from varmint.forms.boundary import weak_dirichlet
from varmint.forms.space import equal_order_space, split
from varmint.forms.vms import interior_residual
from varmint.mesh import named

DOI = "10.1016/j.camwa.2020.01.023"
TOY = {"level": 1, "dt_factor": 1.0}

# Errors of the published code per unit depth, measured with degree-2 quadrature on a one-layer extrusion.
PUBLISHED_CODE = {
    1: {"L2_u": 7.250e-2, "H1_u": 8.918e-1, "L2_p": 3.656, "L2_y": 1.400e-3, "H1_y": 3.665e-2},
    2: {"L2_u": 5.011e-2, "H1_u": 7.499e-1, "L2_p": 8.388e-1, "L2_y": 1.370e-3, "H1_y": 1.907e-2},
    3: {"L2_u": 1.831e-2, "H1_u": 4.068e-1, "L2_p": 1.434e-1, "L2_y": 7.694e-4, "H1_y": 9.562e-3},
    4: {"L2_u": 6.542e-3, "H1_u": 2.428e-1, "L2_p": 8.882e-2, "L2_y": 3.852e-4, "H1_y": 4.776e-3},
}


@dataclass(frozen=True)
class Data:
    """The problem's data; consistent units."""

    L: float = 1.0
    H: float = 0.25
    V: float = 1.0
    DP: float = 1.0
    T: float = 1.0
    mu: float = 0.1
    rho: float = 1.0
    youngs_modulus: float = 1.0
    poisson_ratio: float = 0.3
    thickness: float = 0.3
    rho_s: float = 1.0
    prestress: float = 10.0
    rho_infinity: float = 0.0


def unit(i: int, d: int) -> Any:
    """Unit vector e_(i+1) in d dimensions."""
    return ufl.as_vector([float(i == j) for j in range(d)])


def exact_flow(x: Any, t: Any, c: Any) -> SimpleNamespace:
    """Velocity u, pressure p and body force per mass f, each chosen by side, and grad(u) taken side by side."""
    Y, dY = c.L * x[1] - x[1] ** 2, c.L - 2 * x[1]
    e_1, e_2 = unit(0, len(x)), unit(1, len(x))
    S = c.V * (x[0] - c.L / 2 - c.V * t * Y) / c.L
    u_left = c.V * Y * e_1
    u_right = u_left + S * (c.V * t * dY * e_1 + e_2)
    rate_right = c.V**2 * (((x[0] - c.L / 2) * dY - 2 * c.V * t * Y * dY) * e_1 - Y * e_2) / c.L
    left = ufl.lt(x[0], c.L / 2 + c.V * t * Y)

    def force(u: Any, rate: Any) -> Any:
        return rate + ufl.grad(u) * u - ufl.div(2 * c.mu / c.rho * ufl.sym(ufl.grad(u)))

    f_left, f_right = force(u_left, ufl.zero(len(x))), force(u_right, rate_right)
    return SimpleNamespace(
        u=ufl.conditional(left, u_left, u_right),
        p=ufl.conditional(left, 0.0, -c.DP),
        grad_u=ufl.conditional(left, ufl.grad(u_left), ufl.grad(u_right)),
        f=ufl.conditional(left, f_left, f_right),
    )


def exact_displacement(X: Any, t: Any, c: Any) -> Any:
    """Displacement of the membrane."""
    return c.V * t * (c.L * X[1] - X[1] ** 2) * unit(0, len(X))


def membrane_load(X: Any, t: Any, c: Any) -> Any:
    """Force per reference area that closes the membrane's balance: inertia is zero, stresses and traction are not."""
    dY, ddY, a = c.L - 2 * X[1], -2.0, c.V * t
    g = 1 + (a * dY) ** 2
    K = c.youngs_modulus * c.thickness / (1 - c.poisson_ratio**2)
    shear = c.mu * g * c.V / c.L
    e_1, e_2 = unit(0, len(X)), unit(1, len(X))
    traction = c.DP * (e_1 - a * dY * e_2) + shear * (a * dY * e_1 + e_2)
    elastic = (1.5 * K * a**3 * dY**2 + c.prestress * a) * ddY * e_1 + K * a**2 * dY * ddY * e_2
    return -elastic - traction


def project(function: fem.Function, expression: Any) -> None:
    """L2 projection onto a finite element space."""
    dx = ufl.dx(metadata={"quadrature_degree": 4})
    residual = ufl.inner(function - expression, ufl.TestFunction(function.function_space)) * dx
    system = FiniteElementSystem(residual, function)
    system.assemble_residual()
    system.assemble_tangent()
    system.subtract(system.solve())


def make_fluid(domain: mesh.Mesh, data: Data, dt: float, solver: LinearSolver | None) -> FluidSubproblem:
    """The flow: VMS interior, weak Dirichlet conditions on four sides, slip on an extrusion's ends, pressure pinned."""
    c, d = script.constants(domain, data), domain.geometry.dim
    V = equal_order_space(domain)
    w = fem.Function(V, name="w")
    time = TimeIntegrator(w, dt, generalized_alpha(data.rho_infinity), algebraic=(d,))
    x = ufl.SpatialCoordinate(domain)
    start = exact_flow(x, 0.0, c)
    project(w, ufl.as_vector([*start.u, start.p]))
    time.x_old.x.array[:] = w.x.array

    band = SurfaceBand(domain)
    (v, p), (v_t, _), (z, q) = split(time.x_alpha), split(time.xdot_alpha), split(ufl.TestFunction(V))
    exact = exact_flow(x, time.t_alpha, c)
    residual = interior_residual(
        v,
        p,
        z,
        q,
        domain,
        rho=c.rho,
        mu=c.mu,
        v_t=v_t,
        f=exact.f,
        dt=time.dt,
        scale_m=band.scale_m,
        scale_c=band.scale_c,
    )
    ds = named(domain, sides=on_sides(data)).ds("sides", degree=2)
    residual += weak_dirichlet(v, p, z, q, exact.u, domain, ds, rho=c.rho, mu=c.mu)
    bcs = [compat.pin_component(V, d, lambda x: np.abs(x).max(axis=0) < 1e-6 * data.L)]
    if d == 3:
        bcs.append(compat.pin_component(V, 2, lambda x: on_extrusion_ends(x, data)))
    return FluidSubproblem(
        domain, residual, time, bcs=bcs, band=band, solver=solver, density=data.rho, viscosity=data.mu
    )


def on_extrusion_ends(x: Any, data: Data) -> Any:
    """Mask of the points on x_3 = 0 and x_3 = H."""
    return np.isclose(x[2], 0.0, atol=1e-6 * data.L) | np.isclose(x[2], data.H, atol=1e-6 * data.L)


def on_sides(data: Data) -> list[Any]:
    """Masks of the points on the four sides x_1, x_2 = 0, L, one function for each."""
    places = [(i, value) for i in (0, 1) for value in (0.0, data.L)]
    return [lambda x, i=i, value=value: np.isclose(x[i], value, atol=1e-6 * data.L) for i, value in places]


def make_membrane(data: Data, d: int, elements: int, dt: float, projected: bool) -> ShellSubproblem:
    """The membrane: linear B-splines, fixed ends, no bending; nothing moves along the direction of an extrusion."""
    corner = (data.L / 2, 0.0, 0.0)
    if d == 2:
        patch = shapes.line(corner[:2], (data.L / 2, data.L), elements=elements)
    else:
        sides = ((0.0, data.L, 0.0), (0.0, 0.0, data.H))
        patch = shapes.parallelogram(corner, *sides, elements=(elements, 1), degrees=(1, 1))
    fixed = [patch.side_dofs("u0"), patch.side_dofs("u1"), np.arange(2, d * patch.basis.n, 3) if d == 3 else []]
    zero_dofs = np.concatenate(fixed).astype(int)
    spline = ExtractedSpline(patch, MPI.COMM_SELF, quadrature_degree=4, zero_dofs=zero_dofs)
    c = script.constants(spline.mesh, data)
    speed = exact_displacement(spline.F, 1.0, c)
    if projected:
        velocity = spline.project(speed)
    else:
        s = patch.points[:, 1]
        velocity = spline.function(np.outer(data.V * (data.L * s - s**2), np.eye(d)[0]))

    y, z = spline.function(name="y"), ufl.TestFunction(spline.V)
    scheme = generalized_alpha(data.rho_infinity, 2, first_order_alpha_m=True)
    time = TimeIntegrator(y, dt, scheme, xdot=velocity)
    prestress = (c.prestress,) if d == 2 else (c.prestress, 0.0, 0.0)
    material = StVenantKirchhoff(c.youngs_modulus, c.poisson_ratio, c.thickness, prestress=prestress, bending=False)
    residual = virtual_work(spline, lambda y: strain_energy(spline, material, y), time.x_alpha, z)
    residual += inertia(spline, time.xddot_alpha, z, density=c.rho_s, thickness=c.thickness)
    residual += dead_load(spline, membrane_load(spline.F, time.t_alpha, c), z)
    return ShellSubproblem(spline, residual, time, solver=direct("petsc"))


def build(
    d: int,
    level: int,
    steps: int,
    options: CouplingOptions,
    solver: LinearSolver | None = None,
    *,
    projected: bool,
    data: Data,
) -> CouDALFISh:
    """The scene at a refinement level, before its first step."""
    N, dt = cells_per_side(level), data.T / steps
    slack = 3e-8 * data.L  # the membrane's ends lie on the boundary: keep them inside whatever the rounding
    corners = np.array([[-slack] * 3, [data.L + slack, data.L + slack, data.H + slack]])[:, :d]
    if d == 2:
        domain = mesh.create_rectangle(MPI.COMM_WORLD, corners, [N, N], mesh.CellType.triangle)
    else:
        domain = mesh.create_box(MPI.COMM_WORLD, corners, [N, N, 1], mesh.CellType.tetrahedron)
    fluid = make_fluid(domain, data, dt, solver)
    membrane = make_membrane(data, d, 2 ** (level + 3), dt, projected)
    return CouDALFISh(fluid, membrane, options, multiplier=data.DP)


def cells_per_side(level: int) -> int:
    """Fluid cells along a side of the square."""
    return 3 * 2 ** checks.whole("level", level, 0)


def errors(fsi: CouDALFISh, data: Data, t: float, degree: int) -> dict[str, float]:
    """Norms of the errors at time t per unit depth; the gradient is compared side by side."""
    domain, spline = fsi.mesh_f, fsi.spline_sh
    (v, p), y = split(fsi.timeInt_f.x), fsi.timeInt_sh.x
    exact = exact_flow(ufl.SpatialCoordinate(domain), t, script.constants(domain, data))
    dx = ufl.dx(domain=domain, metadata={"quadrature_degree": degree})
    e_y = y - exact_displacement(spline.F, t, script.constants(spline.mesh, data))
    forms = compat.compile_forms(
        ufl.inner(v - exact.u, v - exact.u) * dx,
        ufl.inner(ufl.grad(v) - exact.grad_u, ufl.grad(v) - exact.grad_u) * dx,
        (p - exact.p) ** 2 * dx,
        ufl.inner(e_y, e_y) * spline.dx,
        ufl.inner(spline.grad(e_y), spline.grad(e_y)) * spline.dx,
    )
    names = ("L2_u", "H1_u", "L2_p", "L2_y", "H1_y")
    depth = 1.0 if domain.geometry.dim == 2 else data.H
    return {name: (compat.assemble_scalar(form) / depth) ** 0.5 for name, form in zip(names, forms, strict=True)}


def main(
    dim: Literal[2, 3] = 2,
    level: int = 2,
    preset: Literal["reference", "default"] = "default",
    dt_factor: float = 1.0,
    initial_velocity: Literal["projected", "interpolated"] | None = None,
    out: Path = Path("results/manufactured"),
    overwrite: bool = False,
    viz: bool = True,
    checkpoint_every: int = 0,
    restart: str = "",
) -> dict[str, Any]:
    """Run the manufactured fluid-membrane benchmark and check it against its exact solution.

    Args:
        dim: dimension of space, 2 or 3 (one layer).
        level: refinement level: 3 * 2^level fluid cells per side, 2^(level + 3) membrane elements.
        preset: the published algorithm, or this library's defaults.
        dt_factor: time step relative to the published one, T/(2 N).
        initial_velocity: membrane velocity at t = 0, projected as in the published code or interpolated;
            default: projected for the reference preset, else interpolated.
        out: folder of the results.
        overwrite: whether to delete the results of an earlier run in this folder.
        viz: whether to write ParaView files and a picture.
        checkpoint_every: steps between checkpoints; 0: none, but where the run is told to end.
        restart: checkpoint to go on from: "latest", the number of its step, or its file.

    Returns:
        The summary; nothing where the run was told to end.
    """
    data, reference = Data(), preset == "reference"
    factor = checks.positive("dt_factor", dt_factor)
    start = initial_velocity or ("projected" if reference else "interpolated")
    steps = max(1, round(2 * cells_per_side(level) / factor))
    options = CouplingOptions.reference() if reference else CouplingOptions()
    claim(out, overwrite=overwrite, restart=restart)
    fsi = build(dim, level, steps, options, projected=start == "projected", data=data)

    inputs = {
        "dim": dim,
        "level": level,
        "preset": preset,
        "dt_factor": factor,
        "initial_velocity": start,
        "options": options,
    }
    run = Restart(out / "checkpoints", CoupledState(fsi), every=checkpoint_every, inputs=inputs)
    if restart:
        run.read(restart)

    watch, progress = Stopwatch(), Progress(steps, done=run.step)
    numbers, memory = run.extra.setdefault("steps", []), []
    pictures = Pictures(out, fsi, run) if viz else None
    for _ in run.steps(progress):
        with watch:
            report = fsi.takeStep()
        numbers.append(in_numbers(report))
        memory.append(rss_mib())
        progress.show(report)
        if pictures:
            pictures.write(report)
    if pictures:
        pictures.close(data, fsi)
    if run.step < steps:
        return {}

    passes = [step["passes"] for step in numbers]
    measured = errors(fsi, data, data.T, 2)
    summary = write_summary(
        out,
        "manufactured",
        inputs,
        errors=measured,
        errors_true=errors(fsi, data, data.T, 8),
        steps=steps,
        block_iterations_mean=float(np.mean(passes)),
        block_iterations_max=max(passes),
        linear_iterations_mean=float(np.mean([step["linear_iterations"] for step in numbers])),
        dofs_fluid=fsi.timeInt_f.x.function_space.dofmap.index_map.size_global * (dim + 1),
        dofs_shell=fsi.spline_sh.geometry.basis.n * dim,
        wall_s=watch.wall_s,
        cpu_s=watch.cpu_s,
        rss_mib_step_10=memory[min(9, len(memory) - 1)] if memory else None,
        rss_mib_end=memory[-1] if memory else None,
        monitors={
            f"{name}_max": max(step[name] for step in numbers)
            for name in ("normal_slip", "leak", "force_imbalance", "slip_ratio")
        },
    )
    if MPI.COMM_WORLD.rank == 0:
        published = PUBLISHED_CODE.get(level, {})
        rows = [
            (name, value, summary["errors_true"][name], published.get(name, "-")) for name, value in measured.items()
        ]
        print(
            f"level {level}, preset {preset}, {steps} steps, {watch.cpu_s:.3g} CPU s, {np.mean(passes):.2f} passes each"
        )
        print(table(["norm", "error (degree 2)", "error (degree 8)", f"published code (doi:{DOI})"], rows))
    return summary


def in_numbers(report: StepReport) -> dict[str, float]:
    """What the summary needs of a step."""
    return {
        "passes": report.passes,
        "linear_iterations": report.linear_iterations,
        "normal_slip": report.monitors.normal_slip_max,
        "leak": abs(report.monitors.leak),
        "force_imbalance": report.monitors.force_imbalance,
        "slip_ratio": report.slip_ratio,
    }


class Pictures:
    """ParaView files and histories of the run, and a picture at its end."""

    def __init__(self, out: Path, fsi: CouDALFISh, run: Restart) -> None:
        w, time, d = fsi.timeInt_f.x, fsi.timeInt_sh, fsi.mesh_f.geometry.dim
        self._out = out
        fields = {"velocity": (w, tuple(range(d))), "pressure": (w, (d,))}
        self._fluid = VTKHDFSeries(out / "fluid.vtkhdf", fsi.mesh_f, after=run.after, **fields)
        self._shell = VTUSeries(
            out / "shell",
            fsi.spline_sh,
            y=time.x,
            after=run.after,
            velocity=time.xdot_old,
            multiplier=lambda: fsi.lam,
            normal=fsi.shell.normals,
        )
        forces = tuple(f"force_{i + 1}" for i in range(d))
        columns = ("t_alpha", "passes", "normal_slip_rms", "leak", *forces)
        self._history = CSVSeries(out / "history.csv", columns, after=run.after)

    def write(self, report: Any) -> None:
        """Append the present state."""
        m = report.monitors
        self._fluid.write(report.t)
        self._shell.write(report.t)
        self._history.write(report.t, report.t_alpha, report.passes, m.normal_slip_rms, m.leak, *m.force)

    def close(self, data: Data, fsi: CouDALFISh) -> None:
        """Finish the files and draw the final state."""
        for series in (self._fluid, self._shell, self._history):
            series.close()
        draw(self._out / "manufactured.png", PlaneField(fsi.timeInt_f.x), data, fsi)


@root_only
def draw(path: Path, field: PlaneField, data: Data, fsi: CouDALFISh) -> None:
    """Final pressure with streamlines, and the membrane's displacement against the exact one."""
    d = fsi.mesh_f.geometry.dim
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4.6), layout="constrained")
    limits = {"vmin": -1.5 * data.DP, "vmax": 0.5 * data.DP}
    field.shade(left, field.values[:, d], "pressure", cmap="RdBu_r", **limits)
    field.streamlines(left, samples=60, density=1.1)
    X = fsi.spline_sh.node_positions
    order = np.argsort(X[:, 1])
    order = order[X[order, -1] == 0.0] if d == 3 else order
    X = X[order]
    y = fsi.spline_sh.nodal(fsi.timeInt_sh.x)[order]
    left.plot(X[:, 0] + y[:, 0], X[:, 1] + y[:, 1], "k-", linewidth=2.0, label="membrane")
    left.set_title(f"t = {fsi.timeInt_f.time:.3g}: pressure, streamlines, membrane")
    exact = data.V * fsi.timeInt_f.time * (data.L * X[:, 1] - X[:, 1] ** 2)
    right.plot(X[:, 1], exact, "k-", linewidth=1.0, label="exact")
    right.plot(X[:, 1], y[:, 0], "C3--", linewidth=1.5, label="computed")
    right.set(xlabel="$X_2$", ylabel="$y_1$", title="displacement of the membrane")
    right.legend()
    figure.savefig(path, dpi=130)
    plt.close(figure)


if __name__ == "__main__":
    script.command_line(main)
