"""Inflation of a clamped square plate: large strains of incompressible hyperelastic shells.

The plate [-1, 1]^2 of thickness h lies in the plane x_3 = 0 and is clamped at all edges. A pressure P follows its
normal. So it works on the volume V that the plate encloses with its reference plane, and in equilibrium the elastic
energy is W = int_0^V P dV along the whole path: the check of this demo. Besides, the solution has all symmetries of
the square, and a quarter of it with conditions of symmetry gives the same. Under small pressures it is that of plate
theory, 0.0012653 P 2^4/D high with D = mu h^3/3. Under the full one the plate bends at its edges with radii as small
as h, which takes fine meshes to resolve: with 16, 32, 64 and 128 biquadratic elements a side it is 0.865, 0.890, 0.901
and 0.911 high.

By default the material is neo-Hookean with mu = 1e4, h = 0.03 and P = 5e2, and the plate has 16 x 16 biquadratic
elements with four points through the thickness, as in the demonstration of hyperelastic shells that accompanies
D. Kamensky, doi:10.1016/j.camwa.2020.01.023; `--ramp 1 --step 0.01 --growth 1` takes its 100 equal load steps. Thinning
lets the pressure pass a maximum of about 560, beyond which there is no equilibrium nearby: `SolveError`.
The other material is bovine pericardium of Lee and Sacks under the pressure that closes a heart valve, in centimetres,
grams and seconds. Shells: Kiendl et al., doi:10.1016/j.cma.2015.03.010.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import ufl
from mpi4py import MPI
from dolfinx import fem
from scipy.interpolate import CubicSpline

from shnapr.hyperelastic import Hyperelastic, lee_sacks, neo_hookean
from shnapr.kinematics import area_vector, midsurface
from shnapr.loads import follower_pressure
from shnapr.supports import clamped
from shnapr.work import internal_tangent, internal_work, strain_energy
from tigar_x import checks, compat
from tigar_x.compat import FloatArray
from tigar_x.fem.line_search import LineSearch
from tigar_x.fem.load_stepping import LoadReport, StepControl, follow_load
from tigar_x.fem.time_integration import LoadStepper
from tigar_x.geometry import shapes
from tigar_x.ranks import root_only
from tigar_x.run import script
from tigar_x.run.output import CSVSeries
from tigar_x.run.progress import Stopwatch
from tigar_x.run.summary import Quantity, table, write_summary
from tigar_x.run.writing import claim
from tigar_x.splines.constraints import symmetry
from tigar_x.splines.spline import ExtractedSpline
from tigar_x.splines.spline_system import SplineSystem
from tigar_x.splines.vtu import VTUSeries

TOY = {"elements": 4, "points": 2, "step": 0.25}
HALF = 1.0  # half the side of the plate
COLUMNS = ("pressure", "height", "volume", "energy")


@dataclass(frozen=True)
class Case:
    """A material with its thickness and the pressure to reach; consistent units."""

    material: Literal["neo-hookean", "lee-sacks"]
    moduli: dict[str, float]
    thickness: float
    pressure: float


CASES = {
    case.material: case
    for case in (
        Case("neo-hookean", {"mu": 1e4}, thickness=0.03, pressure=5e2),
        Case("lee-sacks", {"c0": 676080.0, "c1": 132848.0, "c2": 38.1878}, thickness=0.0386, pressure=1e5),
    )
}


class Plate:
    """The plate, or a quarter of it, with its equilibrium at the pressure P t^ramp.

    Attributes:
        spline: midsurface.
        y: displacement.
        time: pseudo-time t of the load.
        system: equilibrium.
    """

    def __init__(self, case: Case, degree: int, elements: int, points: int, *, ramp: float, quarter: bool) -> None:
        self.case, self.elements, self.ramp, self.quarter = case, elements, ramp, quarter
        if quarter:
            patch = shapes.plate(lengths=(HALF, HALF), center=(HALF / 2, HALF / 2, 0.0), **_mesh(elements // 2, degree))
            zero_dofs, constraints = clamped(patch, "u1", "v1"), (symmetry(patch, "u0", 0), symmetry(patch, "v0", 1))
        else:
            patch = shapes.plate(lengths=(2 * HALF, 2 * HALF), **_mesh(elements, degree))
            zero_dofs, constraints = clamped(patch, *patch.open_sides), ()
        # with 3 p - 1 the pressure and the volume are integrated exactly
        conditions: dict[str, Any] = {"zero_dofs": zero_dofs, "constraints": constraints}
        spline = self.spline = ExtractedSpline(patch, MPI.COMM_SELF, quadrature_degree=3 * degree - 1, **conditions)
        y = self.y = spline.function(name="y")
        self.time = LoadStepper(y, 1.0)

        c = {name: fem.Constant(spline.mesh, value) for name, value in case.moduli.items()}
        psi = neo_hookean(**c) if case.material == "neo-hookean" else lee_sacks(**c)
        material = Hyperelastic(psi, fem.Constant(spline.mesh, case.thickness), points)
        pressure = fem.Constant(spline.mesh, case.pressure) * self.time.t ** fem.Constant(spline.mesh, ramp)
        z = ufl.TestFunction(spline.V)
        load = follower_pressure(spline, pressure, y, z)
        residual = internal_work(spline, material, y, z) + load
        tangent = internal_tangent(spline, material, y, z, y) + ufl.derivative(load, y)
        self.system = SplineSystem(spline, residual, tangent, unknown=y)

        x, a = spline.F + y, spline.parametric_grad(spline.F + y)
        volume = x[2] * area_vector(a)[2] * spline.dx.measure
        self._integrals = compat.compile_forms(volume, strain_energy(spline, material, y))

    def state(self) -> tuple[float, float, float, float]:
        """Pressure, height, enclosed volume and elastic energy of the whole plate."""
        parts = 4 if self.quarter else 1
        volume, energy = (parts * compat.assemble_scalar(form) for form in self._integrals)
        height = self.position(np.zeros((1, 2)))[0, 2]
        return self.case.pressure * float(self.time.t.value) ** self.ramp, float(height), volume, energy

    def position(self, X: FloatArray) -> FloatArray:
        """Where points of the plate are now; X has the shape (m, 2), the result (m, 3)."""
        if self.quarter:
            xi, signs = np.abs(X) / HALF, np.sign(X)
        else:
            xi, signs = (X + HALF) / (2 * HALF), np.ones_like(X)
        y = self.spline.evaluate(self.y, xi)
        y[:, :2] *= signs
        return np.column_stack([X, np.zeros(len(X))]) + y

    def stretches(self) -> tuple[Any, Any]:
        """Largest principal stretch of the midsurface, and thickness by its reference value, as UFL expressions."""
        reference, current = midsurface(self.spline), midsurface(self.spline, self.y)
        C = ufl.inv(reference.metric) * current.metric
        half, det = ufl.tr(C) / 2, ufl.det(C)
        return ufl.sqrt(half + ufl.sqrt(ufl.max_value(half**2 - det, 0.0))), 1 / ufl.sqrt(det)


def _mesh(elements: int, degree: int) -> dict[str, Any]:
    return {"elements": (elements, elements), "degrees": (degree, degree)}


@dataclass(frozen=True)
class Inflation:
    """A plate that has been inflated.

    Attributes:
        plate: in its final state.
        path: pressure, height, volume and energy of all states from the flat one, shape (steps + 1, 4).
        sections: position along the middle line x_2 = 0 in these states, shape (points, 3) each.
        load: how the load was reached.
        costs: of the solution without compilation and output.
    """

    plate: Plate
    path: FloatArray
    sections: list[FloatArray]
    load: LoadReport
    wall_s: float
    cpu_s: float

    @property
    def imbalance(self) -> float:
        """Error of W = int P dV by W, from the cubic spline P(V) through the path."""
        pressure, _, volume, energy = self.path.T
        work = CubicSpline(volume, pressure).integrate(0.0, volume[-1])
        return float(abs(work / energy[-1] - 1.0))

    @property
    def asymmetry(self) -> float:
        """Largest distance between the plate and its mirror images, by its height."""
        line = np.linspace(-HALF, HALF, 17)
        x = self.plate.position(np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)).reshape(17, 17, 3)
        images = (x[:, ::-1] * (-1, 1, 1), x[::-1] * (1, -1, 1), x.swapaxes(0, 1)[..., (1, 0, 2)])
        return float(max(np.abs(x - image).max() for image in images) / self.path[-1, 1])


MIDDLE = np.linspace(-HALF, HALF, 81)[:, None] * (1.0, 0.0)


def inflate(
    plate: Plate, *, step: float, growth: float, tolerance: float, each: Callable[[float], None] | None = None
) -> Inflation:
    """Raise the pressure, in steps of pseudo-time that begin with ``step``."""
    watch, extra = Stopwatch(), Stopwatch()
    path, sections = [(0.0, 0.0, 0.0, 0.0)], [plate.position(MIDDLE)]

    def record(t: float) -> None:
        with extra:
            path.append(plate.state())
            sections.append(plate.position(MIDDLE))
            if each is not None:
                each(t)

    with watch:
        full_load = plate.system.assemble_residual()  # the flat plate has no other forces
        plate.time.step_size = step
        load = follow_load(
            plate.system,
            plate.time,
            control=StepControl(smallest=1e-5, largest=2.0 * step, growth=growth),
            each=record,
            comm=MPI.COMM_WORLD,
            extrapolate=True,
            reference=full_load,
            rtol=tolerance,
            max_iterations=30,
            line_search=LineSearch(),
        )
    return Inflation(plate, np.array(path), sections, load, watch.wall_s - extra.wall_s, watch.cpu_s - extra.cpu_s)


def observed_rates(runs: list[Inflation]) -> dict[str, float] | None:
    """Rates at which the differences between successive plates fall, from the three finest."""
    if len(runs) < 3:
        return None
    steps = np.abs(np.diff([run.path[-1, 1:] for run in runs[-3:]], axis=0))
    return dict(zip(COLUMNS[1:], np.log2(steps[0] / steps[1]).tolist(), strict=True))


def main(
    material: Literal["neo-hookean", "lee-sacks"] = "neo-hookean",
    degree: int = 2,
    elements: int = 16,
    levels: int = 1,
    points: int = 4,
    pressure: float | None = None,
    step: float = 0.05,
    growth: float = 1.5,
    ramp: float = 2.0,
    tolerance: float = 1e-7,
    quarter: bool = False,
    out: Path = Path("results/inflation"),
    overwrite: bool = False,
    viz: bool = True,
) -> dict[str, Any]:
    """Inflate a clamped plate, and compare its energy with the work of the pressure.

    Args:
        material: neo-Hookean, or the exponential one of Lee and Sacks.
        degree: of the splines, 2 or more.
        elements: per side of the plate.
        levels: number of plates, each of half as many elements as the next, to observe convergence.
        points: Gauss points through the thickness.
        pressure: to reach; default: 5e2 for neo-hookean, 1e5 for lee-sacks.
        step: first step of the pseudo-time, which ends at 1.
        growth: factor by which an easy step grows, up to twice the first; 1: equal steps.
        ramp: exponent r of the load, pressure t^r; more than 1 makes the first, hardest steps smaller.
        tolerance: of Newton's method, by the norm of the full load.
        quarter: whether to compute a quarter of the plate with conditions of symmetry.
        out: folder of the results.
        overwrite: whether to delete the results of an earlier run in this folder.
        viz: whether to write ParaView files, a history and a picture.

    Returns:
        The summary.
    """
    case = CASES[checks.choice("material", material, tuple(CASES))]
    if pressure is not None:
        case = replace(case, pressure=checks.positive("pressure", pressure))
    p, coarsest = checks.whole("degree", degree, 2), 2 ** (checks.whole("levels", levels, 1) - 1)
    checks.whole("elements", elements, 2 * coarsest)
    if elements % (2 * coarsest):
        raise ValueError(f"elements = {elements}: a multiple of {2 * coarsest} is required for levels = {levels}")
    ramp, step = checks.positive("ramp", ramp), checks.positive("step", step)
    claim(out, overwrite=overwrite)

    runs: list[Inflation] = []
    for n in (elements // coarsest * 2**k for k in range(levels)):
        plate = Plate(case, p, n, points, ramp=ramp, quarter=quarter)
        pictures = Pictures(out, plate) if viz and n == elements else None
        each = pictures.write if pictures else None
        runs.append(inflate(plate, step=step, growth=growth, tolerance=tolerance, each=each))
    if pictures:
        pictures.close(runs)

    run = runs[-1]
    _, height, volume, energy = run.path[-1].tolist()
    stretch, thinning = at_nodes(run.plate).T
    inputs = {
        "case": case,
        "degree": p,
        "elements": elements,
        "levels": levels,
        "points": points,
        "step": step,
        "growth": growth,
        "ramp": ramp,
        "tolerance": tolerance,
        "quarter": quarter,
    }
    summary = write_summary(
        out,
        "inflation",
        inputs,
        errors={"energy_balance": run.imbalance},
        qoi={
            "height": Quantity(height),
            "volume": Quantity(volume),
            "energy": Quantity(energy),
            "largest_stretch": Quantity(stretch.max()),
            "smallest_thickness_ratio": Quantity(thinning.min()),
        },
        levels=[dict(zip(COLUMNS, run.path[-1].tolist(), strict=True)) for run in runs],
        rates=observed_rates(runs),
        monitors={"asymmetry": run.asymmetry},
        steps=len(run.load.loads),
        newton_iterations=sum(run.load.iterations),
        cuts=sum(run.load.cuts),
        dofs_shell=run.plate.spline.geometry.n * 3,
        wall_s=run.wall_s,
        cpu_s=run.cpu_s,
    )
    if MPI.COMM_WORLD.rank == 0:
        print(f"{material}, pressure {case.pressure:g}, {summary['steps']} load steps, {run.cpu_s:.3g} CPU s")
        names = ("elements", *COLUMNS[1:], "energy balance", "Newton iterations", "CPU s")
        rows = [
            (r.plate.elements, *r.path[-1, 1:].tolist(), r.imbalance, sum(r.load.iterations), r.cpu_s) for r in runs
        ]
        print(table(names, rows))
        print(f"largest stretch {stretch.max():.4g}, thinnest {thinning.min():.4g} h")
    return summary


def at_nodes(plate: Plate) -> FloatArray:
    """Largest stretch and thickness ratio at the nodes, shape (nodes, 2)."""
    fields = fem.Function(plate.spline.free(2).V)
    compat.interpolate(fields, ufl.as_vector(plate.stretches()))
    return np.asarray(fields.x.array.reshape(-1, 2))


class Pictures:
    """ParaView files and history of a run, and a picture at its end."""

    def __init__(self, out: Path, plate: Plate) -> None:
        self._out, self._plate = out, plate
        self._shell = VTUSeries(out / "plate", plate.spline, y=plate.y)
        self._history = CSVSeries(out / "history.csv", COLUMNS)

    def write(self, t: float) -> None:
        """Append the present state."""
        self._shell.write(t)
        self._history.write(t, *self._plate.state())

    def close(self, runs: list[Inflation]) -> None:
        """Finish the files and draw."""
        self._shell.close()
        self._history.close()
        draw(self._out / "inflation.png", runs)


@root_only
def draw(path: Path, runs: list[Inflation]) -> None:
    """The inflated plate with its thickness, sections along the path, and pressure against volume."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    run = runs[-1]
    plate, spline = run.plate, run.plate.spline
    ratio = fem.Function(spline.free(1).V)
    ratio.x.array[:] = at_nodes(plate)[:, 1]
    line = np.linspace(-HALF, HALF, 65)
    X = np.stack(np.meshgrid(line, line), axis=-1)
    x = plate.position(X.reshape(-1, 2)).reshape(*X.shape[:2], 3)
    centre = (X[1:, 1:] + X[:-1, :-1]).reshape(-1, 2) / 2
    xi = np.abs(centre) / HALF if plate.quarter else (centre + HALF) / (2 * HALF)
    colours = ScalarMappable(Normalize(ratio.x.array.min(), 1.0), "viridis")

    figure = plt.figure(figsize=(15, 4.6), layout="constrained")
    space, middle, right = (
        figure.add_subplot(1, 3, i + 1, **({"projection": "3d"} if i == 0 else {})) for i in range(3)
    )
    faces = colours.to_rgba(spline.evaluate(ratio, xi).reshape(64, 64))
    space.plot_surface(*np.moveaxis(x, -1, 0), facecolors=faces, rstride=1, cstride=1, shade=False)
    space.set_box_aspect(np.ptp(x.reshape(-1, 3), axis=0))
    figure.colorbar(colours, ax=space, label="thickness / initial thickness", shrink=0.6)
    space.set(xticks=(-1, 0, 1), yticks=(-1, 0, 1), zticks=())
    space.set_title(f"{plate.case.material}, P = {plate.case.pressure:g}")
    for state, section in zip(run.path, run.sections, strict=True):
        middle.plot(section[:, 0], section[:, 2], color=plt.cm.viridis(state[0] / run.path[-1, 0]), linewidth=1.2)
    middle.set(aspect="equal", xlabel="$x_1$", ylabel="$x_3$", title="middle section, all load steps")
    for one in runs:
        V, P = one.path[:, 2], one.path[:, 0]
        fine = np.linspace(0.0, V[-1], 200)
        curve = right.plot(fine, CubicSpline(V, P)(fine), linewidth=1.2)[0]
        right.plot(V, P, ".", color=curve.get_color(), label=f"{one.plate.elements} x {one.plate.elements} elements")
    right.set(xlabel="enclosed volume", ylabel="pressure", title="pressure and its work")
    right.grid(True, linewidth=0.4)
    right.legend()
    figure.savefig(path, dpi=130)
    plt.close(figure)


if __name__ == "__main__":
    script.command_line(main)
