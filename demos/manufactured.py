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

from pathlib import Path
from typing import Any, Literal

import numpy as np
import ufl
from mpi4py import MPI
from dolfinx import fem, mesh

from coudalfish import CouDALFISh, CouplingOptions, FluidSubproblem, StepReport, SurfaceBand
from coudalfish.problems.manufactured import (
    DOI,
    PUBLISHED_CODE,
    cells_per_side,
    errors,
    exact_flow,
    membrane,
    on_extrusion_ends,
    on_sides,
    square,
)
from coudalfish.problems.manufactured import (
    ProblemData as Data,
)
from coudalfish.restart import CoupledState
from tigar_x import checks, compat
from tigar_x.fem.linear import LinearSolver
from tigar_x.fem.schemes import generalized_alpha
from tigar_x.fem.solve import FiniteElementSystem
from tigar_x.fem.time_integration import TimeIntegrator
from tigar_x.ranks import root_only
from tigar_x.run import script
from tigar_x.run.output import CSVSeries
from tigar_x.run.pictures import Colours
from tigar_x.run.plane_field import PlaneField
from tigar_x.run.progress import Progress, Stopwatch, rss_mib
from tigar_x.run.restart import Restart
from tigar_x.run.summary import table, write_summary
from tigar_x.run.vtkhdf import VTKHDFSeries
from tigar_x.run.writing import claim
from tigar_x.splines.vtu import VTUSeries
from varmint.forms.boundary import weak_dirichlet
from varmint.forms.space import equal_order_space, split
from varmint.forms.vms import interior_residual
from varmint.mesh import named

TOY = {"level": 1, "dt_factor": 1.0}


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
    dt = data.T / steps
    domain = square(MPI.COMM_WORLD, data, d, level)
    fluid = make_fluid(domain, data, dt, solver)
    shell = membrane(data, d, 2 ** (level + 3), dt, projected)
    return CouDALFISh(fluid, shell, options, multiplier=data.DP)


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
    colours = Colours("pressure", "force/area", -1.5 * data.DP, 0.5 * data.DP, "RdBu_r")
    field.shade(left, field.values[:, d], colours, length="length")
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
