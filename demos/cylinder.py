"""Flow around a cylinder in a channel at any Reynolds number: steady flow, or vortices that it sheds.

The channel (0, 2.2) x (0, 0.41) holds a cylinder of diameter D = 0.1 slightly below its middle. The fluid enters with
a parabola of mean speed U = 1, does not slip on walls and cylinder, and leaves freely. With Re = U D/nu and the force F
on the cylinder per unit depth, the coefficients of drag and lift are 2 F/(rho U^2 D); dp is the difference of pressure
over rho U^2 between the foremost and the rearmost point of the cylinder, and St = f D/U the Strouhal number of the
lift's frequency f.

Sources: Schaefer and Turek, doi:10.1007/978-3-322-89849-4_39 (Re = 100: the middle of the intervals given there); John
and Matthies, doi:10.1002/fld.195 (Re = 20). Cells have straight edges, so that the cylinder is a polygon.
"""

from pathlib import Path
from typing import Any

import numpy as np
import ufl
from mpi4py import MPI

from tigar_x import checks, compat
from tigar_x.compat import FloatArray
from tigar_x.fem.schemes import generalized_alpha
from tigar_x.ranks import root_only
from tigar_x.run import script
from tigar_x.run.output import CSVSeries
from tigar_x.run.pictures import Colours
from tigar_x.run.plane_field import PlaneField
from tigar_x.run.progress import Progress, Stopwatch
from tigar_x.run.summary import Quantity, table, write_summary
from tigar_x.run.vtkhdf import VTKHDFSeries
from tigar_x.run.writing import claim
from varmint.conditions import Traction, Velocity
from varmint.flow import Flow, FlowOptions
from varmint.mesh.models import channel_with_cylinder
from varmint.quantities import BoundaryForce, Measured, NodalField, PointValues, squared_divergence, vorticity

TOY = {"reynolds": 20.0, "size": 0.15, "dt": 0.1, "until": 0.5, "steady": False}
SPEED, DIAMETER, HEIGHT = 1.0, 0.1, 0.41
FRONT_AND_REAR = ((0.15, 0.2), (0.25, 0.2))

# by Reynolds number, whether steady, and name
PUBLISHED = {
    (20.0, True): ("10.1002/fld.195", {"drag": 5.57953523384, "lift": 0.010618948146, "dp": 0.11752016697 / 0.2**2}),
    (100.0, False): (
        "10.1007/978-3-322-89849-4_39",
        {"drag_max": 3.23, "lift_max": 1.0, "strouhal": 0.3},
    ),
}


def inflow(x: Any, t: Any, ramp: float) -> Any:
    """Parabola of mean speed U, which comes up within the time ``ramp``; zero: at once."""
    parabola = 6.0 * SPEED * x[1] * (HEIGHT - x[1]) / HEIGHT**2
    rise = ufl.conditional(ufl.lt(t, ramp), (1 - ufl.cos(ufl.pi * t / ramp)) / 2, 1.0) if ramp else 1.0
    return ufl.as_vector([parabola * rise, 0.0])


def build(
    reynolds: float = 100.0,
    degree: int = 2,
    size: float = 0.04,
    *,
    dt: float | None = None,
    rho_infinity: float = 0.5,
    ramp: float = 0.5,
    comm: MPI.Comm = MPI.COMM_WORLD,
    cell: str = "triangle",
    equal_area: bool = False,
    **options: Any,
) -> Flow:
    """The channel at rest; steady without a time step."""
    sizes = {"size": size, "cylinder_size": size / 6.0, "wake_size": size / 2.0}
    mesh = channel_with_cylinder(comm, **sizes, cell=cell, equal_area=equal_area)
    rise = 0.0 if dt is None else ramp
    return Flow(
        mesh,
        [Velocity(("walls", "cylinder")), Velocity("inlet", lambda x, t: inflow(x, t, rise)), Traction("outlet")],
        rho=1.0,
        mu=SPEED * DIAMETER / checks.positive("reynolds", reynolds),
        degree=degree,
        dt=dt,
        scheme=None if dt is None else generalized_alpha(rho_infinity),
        options=FlowOptions(**options),
    )


class Coefficients:
    """Drag, lift and pressure difference of the present state."""

    def __init__(self, flow: Flow) -> None:
        self._force = BoundaryForce(flow, "cylinder")
        self._points = PointValues(flow, surface_points(flow))

    def __call__(self) -> FloatArray:
        front, rear = self._points()[:, -1]
        return np.append(self._force() * 2.0 / (SPEED**2 * DIAMETER), front - rear)


def surface_points(flow: Flow) -> FloatArray:
    """Vertices of the cylinder next to its foremost and rearmost point."""
    domain = flow.mesh.domain
    nodes = compat.facet_nodes(domain)[flow.mesh.facets("cylinder")].ravel()
    mine = domain.geometry.x[nodes][:, :2]
    x = np.concatenate(domain.comm.allgather(mine))
    return np.array([x[np.linalg.norm(x - point, axis=1).argmin()] for point in FRONT_AND_REAR])


def periodic(t: FloatArray, drag: FloatArray, lift: FloatArray, share: float = 0.4) -> dict[str, float]:
    """Extremes over the last part of a run, and the Strouhal number from the lift's rising passages of its mean."""
    late = t >= t[-1] * (1.0 - share)
    t, drag, lift = t[late], drag[late], lift[late]
    y = lift - lift.mean()
    i = np.flatnonzero((y[:-1] < 0.0) & (y[1:] >= 0.0))
    passages = t[i] - y[i] * (t[i + 1] - t[i]) / (y[i + 1] - y[i])
    found = {"drag_max": drag.max(), "drag_min": drag.min(), "lift_max": lift.max(), "lift_min": lift.min()}
    if len(passages) > 2 and np.ptp(y) > 1e-3:
        found["strouhal"] = (len(passages) - 1) / (passages[-1] - passages[0]) * DIAMETER / SPEED
    return {name: float(value) for name, value in found.items()}


def main(
    reynolds: float = 100.0,
    steady: bool = False,
    degree: int = 2,
    size: float = 0.04,
    dt: float = 0.005,
    until: float = 8.0,
    rho_infinity: float = 0.5,
    out: Path = Path("results/cylinder"),
    overwrite: bool = False,
    viz: bool = True,
) -> dict[str, Any]:
    """Compute the flow around a cylinder in a channel, with the history of drag and lift.

    Args:
        reynolds: Reynolds number with the mean speed and the diameter.
        steady: whether to solve for the steady flow.
        degree: of velocity and pressure.
        size: of the cells far away; a sixth of it at the cylinder, half of it in the wake.
        dt: time step of the unsteady flow.
        until: end of the unsteady flow.
        rho_infinity: spectral radius of the time integration at infinite frequency.
        out: folder of the results.
        overwrite: whether to delete the results of an earlier run in this folder.
        viz: whether to write ParaView files, the history and a picture of the wake.

    Returns:
        The summary.
    """
    claim(out, overwrite=overwrite)
    flow = build(reynolds, degree, size, dt=None if steady else dt, rho_infinity=rho_infinity)
    flow.compile()
    measure, watch = Coefficients(flow), Stopwatch()
    if steady:
        with watch:
            report = flow.solve()
        found = dict(zip(("drag", "lift", "dp"), measure().tolist(), strict=True))
        history, iterations, linear = np.zeros((0, 4)), report.iterations, report.linear_iterations
        if viz:
            with _movie(out, flow) as movie:
                movie.write(0.0)
    else:
        history, iterations, linear = follow(
            flow, measure, checks.positive("until", until), watch, out if viz else None
        )
        found = periodic(*history[:, :3].T)

    doi, known = PUBLISHED.get((float(reynolds), steady), (None, {}))
    steps = max(len(history), 1)
    inputs = {"reynolds": reynolds, "steady": steady, "degree": degree, "size": size, "dt": None if steady else dt}
    inputs |= {"until": until, "rho_infinity": rho_infinity}
    summary = write_summary(
        out,
        "cylinder",
        inputs,
        qoi={k: Quantity(v, known.get(k), doi if k in known else None) for k, v in found.items()},
        monitors={"divergence": Measured(square=squared_divergence(flow))()["square"] ** 0.5},
        steps=steps,
        newton_iterations_mean=iterations / steps,
        linear_iterations_mean=linear / steps,
        dofs_fluid=flow.unknowns,
        wall_s=watch.wall_s,
        cpu_s=watch.cpu_s,
    )
    field, curl = PlaneField(flow.w), PlaneField(vorticity(flow)())
    if viz:
        draw(out / "cylinder.png", field, curl, history, f"Re = {reynolds:g}")
    if MPI.COMM_WORLD.rank == 0:
        print(f"Re = {reynolds:g}, degree {degree}, {flow.unknowns} unknowns, {steps} steps, {watch.cpu_s:.3g} CPU s")
        print(table(("quantity", "value", "published"), [(k, v, known.get(k, "-")) for k, v in found.items()]))
    return summary


def _movie(out: Path, flow: Flow, curl: NodalField | None = None) -> VTKHDFSeries:
    fields: dict[str, Any] = {"velocity": (flow.w, (0, 1)), "pressure": (flow.w, (2,))}
    if curl is not None:
        fields["vorticity"] = (curl.field, (0,))
    return VTKHDFSeries(out / "flow.vtkhdf", flow.mesh.domain, **fields)


def follow(
    flow: Flow, measure: Coefficients, until: float, watch: Stopwatch, out: Path | None, pictures: int = 40
) -> tuple[FloatArray, int, int]:
    """Steps to the end: history of (t_alpha, drag, lift, dp), Newton and linear iterations in all."""
    steps = max(1, round(until / flow.time.step_size))
    progress, rows, counts = Progress(steps), [], np.zeros(2, dtype=int)
    curl = None if out is None else vorticity(flow)
    movie = None if out is None else _movie(out, flow, curl)
    log = (
        None if out is None else CSVSeries(out / "history.csv", ("t_alpha", "drag", "lift", "dp", "newton_iterations"))
    )
    for n in progress:
        with watch:
            report = flow.take_step(measure)
        counts += report.iterations, report.linear_iterations
        # drag, lift and pressures belong to the level of the equations, within the step
        rows.append((report.t_alpha, *report.measured))
        progress.show(f"t = {report.t:.4g}  iterations {report.iterations}  drag {report.measured[0]:.4g}")
        if log is not None:
            log.write(report.t, *rows[-1], report.iterations)
        if movie is not None and curl is not None and n % max(1, steps // pictures) == 0:
            curl()
            movie.write(report.t)
    for series in (movie, log):
        if series is not None:
            series.close()
    return np.array(rows), int(counts[0]), int(counts[1])


@root_only
def draw(path: Path, field: PlaneField, curl: PlaneField, history: FloatArray, title: str) -> None:
    """Speed and vorticity in the channel, and the history of drag and lift."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    rows = 3 if len(history) else 2
    figure, axes = plt.subplots(rows, 1, figsize=(10, 2.6 * rows), layout="constrained")
    field.shade(axes[0], np.linalg.norm(field.values[:, :2], axis=1), Colours("speed", "U"), length="length")
    axes[0].set_title(title)
    limit = 0.15 * np.abs(curl.values).max()
    curl.shade(axes[1], curl.values[:, 0], Colours("vorticity", "U/length", -limit, limit, "RdBu_r"), length="length")
    if len(history):
        axes[2].plot(history[:, 0], history[:, 1], label="drag")
        axes[2].plot(history[:, 0], history[:, 2], label="lift")
        top = 1.2 * max(history[len(history) // 5 :, 1].max(), 1.0)
        axes[2].set(xlabel="$t$", ylabel="coefficient", ylim=(-1.5, top))
        axes[2].grid(True, linewidth=0.4)
        axes[2].legend()
    figure.savefig(path, dpi=130)
    plt.close(figure)


if __name__ == "__main__":
    script.command_line(main)
