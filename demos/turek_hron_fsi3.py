"""An elastic beam behind a cylinder in a channel, FSI3: a thick solid in the mesh of the flow, which moves along.

The beam (length 0.35, thickness 0.02) is attached to a cylinder of diameter 0.1 in the channel (0, 2.5) x (0, 0.41). It
is a St. Venant-Kirchhoff solid that shares nodes with the fluid; the mesh of the fluid follows it as a fictitious
elastic solid, stiffer where cells are compressed or small. The fluid enters with a parabola of mean speed 2, which
comes up within two seconds, and leaves freely. After some seconds the beam flaps with a period of about 0.19 s.

What is compared are mean and amplitude, half the sum and half the difference of the last maximum and minimum, of the
displacement of the beam's end (0.6, 0.2) and of drag and lift on cylinder and beam together, and their frequencies.

Source: Turek and Hron, doi:10.1007/3-540-34596-5_15.
"""

from pathlib import Path
from typing import Any, Literal

import numpy as np
import ufl
from mpi4py import MPI

from tigar_x import checks
from tigar_x.compat import FloatArray
from tigar_x.fem.linear import direct
from tigar_x.fem.schemes import backward_euler, generalized_alpha
from tigar_x.ranks import root_only
from tigar_x.run import script
from tigar_x.run.output import CSVSeries
from tigar_x.run.pictures import Colours
from tigar_x.run.plane_field import PlaneField
from tigar_x.run.progress import Progress, Stopwatch, rss_mib
from tigar_x.run.summary import Quantity, table, write_summary
from tigar_x.run.vtkhdf import VTKHDFSeries
from tigar_x.run.writing import claim
from varmint.conditions import Traction, Velocity
from varmint.flow import Flow, FlowOptions
from varmint.forms.motion import ElasticMotion
from varmint.forms.solids import Solid, StVenantKirchhoffSolid
from varmint.mesh.models import channel_with_cylinder
from varmint.quantities import BoundaryForce, NodalField, vorticity

DOI = "10.1007/3-540-34596-5_15"
TOY = {"size": 0.12, "beam_size": 0.03, "degree": 1, "dt": 0.01, "until": 0.1}
HEIGHT, SPEED, RAMP, TIP = 0.41, 2.0, 2.0, (0.6, 0.2)
RHO, NU, SHEAR_MODULUS, POISSON_RATIO = 1e3, 1e-3, 2e6, 0.4
HELD = ("inlet", "outlet", "walls", "cylinder", "beam_root")

# mean, amplitude and frequency
PUBLISHED = {
    "u_x": (-2.69e-3, 2.53e-3, 10.9),
    "u_y": (1.48e-3, 34.38e-3, 5.3),
    "drag": (457.3, 22.66, 10.9),
    "lift": (2.22, 149.78, 5.3),
}
COLUMNS = ("t", "t_alpha", *PUBLISHED, "smallest_volume_ratio")


def inflow(x: Any, t: Any) -> Any:
    """Parabola of mean speed U, which comes up within the ramp."""
    rise = ufl.conditional(ufl.lt(t, RAMP), (1 - ufl.cos(ufl.pi * t / RAMP)) / 2, 1.0)
    return ufl.as_vector([6.0 * SPEED * x[1] * (HEIGHT - x[1]) / HEIGHT**2 * rise, 0.0])


def build(
    size: float = 0.03,
    beam_size: float = 0.008,
    degree: int = 2,
    dt: float = 2e-3,
    scheme: str = "generalized alpha",
    comm: MPI.Comm = MPI.COMM_WORLD,
    **options: Any,
) -> Flow:
    """Fluid and beam at rest."""
    mesh = channel_with_cylinder(comm, length=2.5, beam=(0.35, 0.02), size=size, cylinder_size=beam_size)
    integration = backward_euler() if scheme == "backward euler" else generalized_alpha(0.5)
    moving = ElasticMotion(mesh, dict.fromkeys(HELD), dt, integration, degree, cells=("fluid",))
    youngs_modulus = 2.0 * SHEAR_MODULUS * (1.0 + POISSON_RATIO)
    return Flow(
        mesh,
        [
            Velocity(("walls", "cylinder")),
            Velocity("beam_root", (0.0, 0.0)),
            Velocity("inlet", inflow),
            Traction("outlet"),
        ],
        rho=RHO,
        mu=RHO * NU,
        degree=degree,
        dt=dt,
        scheme=integration,
        moving=moving,
        solid=Solid(StVenantKirchhoffSolid(youngs_modulus, POISSON_RATIO, RHO)),
        options=FlowOptions(**({"rtol": 1e-5, "solver": direct()} | options)),
    )


class Tip:
    """Displacement of the node at the middle of the beam's end (collective)."""

    def __init__(self, flow: Flow) -> None:
        self._u = flow.moving.time.x
        self._comm = flow.mesh.domain.comm
        V = self._u.function_space
        owned = V.dofmap.index_map.size_local
        distance = np.linalg.norm(V.tabulate_dof_coordinates()[:owned, :2] - TIP, axis=1)
        nearest = self._comm.allgather(distance.min(initial=np.inf))
        self._rank = int(np.argmin(nearest))
        self._node = int(distance.argmin()) if self._comm.rank == self._rank else 0

    def __call__(self) -> FloatArray:
        return self._comm.bcast(self._u.x.array[2 * self._node : 2 * self._node + 2].copy(), root=self._rank)


def course(history: FloatArray, name: str) -> tuple[FloatArray, FloatArray]:
    """Times of a quantity, for forces those of the equations, and its values, from rows of ``COLUMNS``."""
    return history[:, COLUMNS.index("t_alpha" if name in ("drag", "lift") else "t")], history[:, COLUMNS.index(name)]


def last_oscillation(t: FloatArray, y: FloatArray) -> tuple[float, float, float]:
    """Mean and amplitude of the last full oscillation, and the frequency of all of the last second's."""
    late = t >= t[-1] - 1.0
    t, y = t[late], y[late]
    inner = np.arange(1, len(y) - 1)
    high = inner[(y[1:-1] > y[:-2]) & (y[1:-1] >= y[2:])]
    low = inner[(y[1:-1] < y[:-2]) & (y[1:-1] <= y[2:])]
    middle = (y.max() + y.min()) / 2.0
    high, low = high[y[high] > middle], low[y[low] < middle]
    if len(high) < 3 or len(low) < 1:
        return float(middle), float(np.ptp(y) / 2.0), float("nan")
    top, bottom = y[high[-1]], y[low[-1]]
    frequency = (len(high) - 1) / (t[high[-1]] - t[high[0]])
    return float((top + bottom) / 2.0), float((top - bottom) / 2.0), float(frequency)


def main(
    size: float = 0.03,
    beam_size: float = 0.008,
    degree: int = 2,
    dt: float = 2e-3,
    until: float = 7.0,
    scheme: Literal["backward euler", "generalized alpha"] = "generalized alpha",
    out: Path = Path("results/turek_hron_fsi3"),
    overwrite: bool = False,
    viz: bool = True,
) -> dict[str, Any]:
    """Follow the beam from rest until it flaps, and compare its oscillations with the published ones.

    Args:
        size: of the cells away from cylinder and beam.
        beam_size: of the cells at cylinder and beam, at most the beam's thickness.
        degree: of velocity, pressure and the mesh's displacement.
        dt: time step.
        until: end; the beam flaps regularly from about t = 5 on.
        scheme: of time integration; generalized alpha has rho_infinity = 1/2, backward Euler damps the beam.
        out: folder of the results.
        overwrite: whether to delete the results of an earlier run in this folder.
        viz: whether to write ParaView files, the history and a picture.

    Returns:
        The summary.
    """
    steps = max(1, round(checks.positive("until", until) / checks.positive("dt", dt)))
    claim(out, overwrite=overwrite)
    flow = build(size, beam_size, degree, dt, scheme)
    flow.compile()
    force, tip = BoundaryForce(flow, "cylinder", "interface"), Tip(flow)
    watch, progress, memory = Stopwatch(), Progress(steps), []
    pictures = Pictures(out, flow, steps) if viz else None
    rows, counts = [], np.zeros(3, dtype=int)
    for n in progress:
        with watch:
            report = flow.take_step(force)
        counts += report.iterations, report.linear_iterations, report.tangents
        rows.append((report.t, report.t_alpha, *tip(), *report.measured, flow.moving.smallest_volume_ratio()))
        memory.append(rss_mib())
        progress.show(f"t = {report.t:.4g}  iterations {report.iterations}  u_y {rows[-1][3]:.4g}")
        if pictures:
            pictures.write(n, rows[-1])
    history = np.array(rows)
    if pictures:
        pictures.close(flow, history)

    qoi = {}
    for name, published in PUBLISHED.items():
        found = last_oscillation(*course(history, name))
        for kind, value, known in zip(("mean", "amplitude", "frequency"), found, published, strict=True):
            if np.isfinite(value):
                qoi[f"{name}_{kind}"] = Quantity(value, known, DOI)
    inputs = {"size": size, "beam_size": beam_size, "degree": degree, "dt": dt, "until": until, "scheme": scheme}
    summary = write_summary(
        out,
        "turek_hron_fsi3",
        inputs,
        qoi=qoi,
        steps=steps,
        newton_iterations_mean=counts[0] / steps,
        tangents_mean=counts[2] / steps,
        linear_iterations_mean=counts[1] / steps,
        dofs_fluid=flow.unknowns,
        monitors={"smallest_volume_ratio": history[:, -1].min()},
        rss_mib_step_10=memory[min(9, len(memory) - 1)],
        rss_mib_end=memory[-1],
        wall_s=watch.wall_s,
        cpu_s=watch.cpu_s,
    )
    if MPI.COMM_WORLD.rank == 0:
        print(f"{flow.unknowns} unknowns, {steps} steps to t = {history[-1, 0]:g}, {watch.cpu_s:.4g} CPU s")
        print(table(("quantity", "value", "published"), [(k, q.value, q.published) for k, q in qoi.items()]))
    return summary


class Pictures:
    """ParaView files of the moving mesh, the history, and a picture at the end."""

    def __init__(self, out: Path, flow: Flow, steps: int, frames: int = 60) -> None:
        self._out, self._every = out, max(1, steps // frames)
        self._vorticity: NodalField = vorticity(flow)
        fields = {"velocity": (flow.w, (0, 1)), "pressure": (flow.w, (2,))}
        fields |= {"mesh_displacement": (flow.moving.time.x, (0, 1)), "vorticity": (self._vorticity.field, (0,))}
        self._movie = VTKHDFSeries(out / "flow.vtkhdf", flow.mesh.domain, **fields)
        self._history = CSVSeries(out / "history.csv", COLUMNS[1:])

    def write(self, n: int, row: tuple[Any, ...]) -> None:
        """Append the present state."""
        self._history.write(*row)
        if n % self._every == 0:
            self._vorticity()
            self._movie.write(row[0])

    def close(self, flow: Flow, history: FloatArray) -> None:
        """Finish the files and draw the last state."""
        self._movie.close()
        self._history.close()
        displacement = flow.moving.time.x
        fields = PlaneField(flow.w, displacement), PlaneField(self._vorticity(), displacement)
        draw(self._out / "turek_hron_fsi3.png", *fields, history)


@root_only
def draw(path: Path, flow: PlaneField, curl: PlaneField, history: FloatArray) -> None:
    """Speed and vorticity on the moved mesh, and the histories of the last second."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure = plt.figure(figsize=(11, 9), layout="constrained")
    grid = figure.add_gridspec(4, 2, height_ratios=(1.1, 1.1, 1, 1))
    axes = figure.add_subplot(grid[0, :]), figure.add_subplot(grid[1, :])
    flow.shade(axes[0], np.linalg.norm(flow.values[:, :2], axis=1), Colours("speed", "m/s"), length="m")
    limit = 0.1 * np.abs(curl.values).max()
    curl.shade(axes[1], curl.values[:, 0], Colours("vorticity", "1/s", -limit, limit, "RdBu_r"), length="m")
    late = history[:, 0] >= history[-1, 0] - 1.0
    for i, (name, (mean, amplitude, _)) in enumerate(PUBLISHED.items()):
        plot = figure.add_subplot(grid[2 + i // 2, i % 2])
        plot.plot(*(values[late] for values in course(history, name)))
        plot.axhspan(mean - amplitude, mean + amplitude, color="0.9", label="published range")
        plot.set(ylabel=name, xlabel="$t$")
        plot.legend(loc="upper left", fontsize="small")
    figure.savefig(path, dpi=130)
    plt.close(figure)


if __name__ == "__main__":
    script.command_line(main)
