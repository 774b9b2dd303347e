"""Two ribbons tied in a reef knot and pulled tight: contact of thin shells that bend, slide and press on each other.

Each ribbon enters and leaves on its own side, and its bight lies around both strands of the other one. The first is
held where X_1 < -6; the second is pulled along x_1 by a body force where X_1 > 10 and cannot move across there:

    rho h (y'' + c y') - div n(y) = rho h g e_1 [X_1 > 10] + contact,      y(0) = y'(0) = 0.

The shell is one of St. Venant and Kirchhoff. Contact is a potential between all pairs of points that are further apart
than R_self in the reference configuration. Sources: D. Kamensky, F. Xu, C.-H. Lee, J. Yan, Y. Bazilevs, M.-C. Hsu, "A
contact formulation based on a volumetric potential", doi:10.1016/j.cma.2017.11.007; D. Kamensky, Y. Bazilevs, "tIGAr:
Automating isogeometric analysis with FEniCS", doi:10.1016/j.cma.2018.10.002. The data are theirs but for the shape of
the knot: here its centre lines run smoothly through a few points, far enough apart that all pairs of points of
different ribbons take part in contact.

What must hold is measured in every step: contact makes neither force nor torque, momentum changes by the load, the
supports and damping alone, backward Euler makes no energy, and no point moves so far that it could pass another one.
What must not change is the type of the knot, which is checked on the way by an invariant of its centre lines.
"""

import logging
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import ufl
from mpi4py import MPI

from shnapr.contact import LinearKernel, SelfContact
from shnapr.contact.piercings import piercings
from shnapr.contact.system import ContactSystem
from shnapr.loads import dead_load, inertia, mass_damping
from shnapr.svk import StVenantKirchhoff
from shnapr.work import internal_tangent, internal_work, strain_energy
from tigar_x import checks, compat
from tigar_x.compat import FloatArray, IntArray
from tigar_x.fem.linear import SolveError
from tigar_x.fem.schemes import backward_euler
from tigar_x.fem.solve import NewtonReport, newton
from tigar_x.fem.time_integration import TimeIntegrator
from tigar_x.geometry import shapes
from tigar_x.geometry.bspline import BSplineBasis, open_knots
from tigar_x.geometry.multipatch import MultiPatch, disjoint
from tigar_x.geometry.ribbon import CentreLine, Crossings, ribbon
from tigar_x.ranks import agreed, root_only
from tigar_x.run import script
from tigar_x.run.output import CSVSeries
from tigar_x.run.progress import Progress, Stopwatch, rss_mib
from tigar_x.run.summary import Quantity, table, write_summary
from tigar_x.run.writing import claim
from tigar_x.splines.quadrature import NodalQuadrature
from tigar_x.splines.spline import ExtractedSpline
from tigar_x.splines.vtu import VTUSeries

log = logging.getLogger(__name__)

TOY = {"steps": 6, "dt_factor": 4.0}
SQUARE_KNOT = 9
"""Determinant of the reef knot with its ends joined: the product of those of two trefoils."""
SMALLEST_STEP = 2.0**-7
"""Part of a time step below which none is cut."""
HISTORY = (
    *("kinetic", "elastic", "contact", "work", "damping", "gained", "held_1", "held_2", "held_3", "force_imbalance"),
    *("pairs", "distance", "newton_iterations", "substeps", "failures"),
)


@dataclass(frozen=True)
class Data:
    """The problem's data; consistent units."""

    youngs_modulus: float = 1e7
    poisson_ratio: float = 0.3
    thickness: float = 0.004
    density: float = 1.0
    damping: float = 1.0
    body_force: float = 1e3
    held: float = -6.0
    pulled: float = 10.0
    r_max: float = 0.15
    stiffness: float = 1e8
    r_self: float = 0.4
    time_step: float = 2.5e-4
    steps: int = 6000


CENTRE, WIDTH = 2.0, 0.5
STRAND = (
    *((-9.0, 0.58, 0.0), (-8.0, 0.58, 0.0), (-7.0, 0.58, 0.0), (-5.5, 0.58, 0.0), (-4.2, 0.58, 0.0)),
    *((-1.53, 0.58, 0.45), (0.0, 1.41, -0.55), (1.11, 1.86, -0.27), (1.72, 1.12, 0.5), (1.53, 0.0, 0.73)),
)
"""Points on one strand of the first ribbon, from its end to the middle of its bight, seen from the knot's centre: over
the bight of the second ribbon, down through it and under its strand, and up over both its strands."""
FINE = 7.0
"""Distance along the ribbon from the middle of the bight within which elements are fine."""


def breakpoints(length: float, element: float) -> FloatArray:
    """Ends of the elements along a ribbon, the same from both ends; those beyond FINE are 2.5 times as long."""
    half = length / 2
    coarse = np.linspace(0.0, half - FINE, 1 + round((half - FINE) / (2.5 * element)))
    fine = np.linspace(half - FINE, half, 1 + round(FINE / element))
    start = np.concatenate([coarse[:-1], fine])
    return np.concatenate([start, length - start[-2::-1]])


def knot(elements_across: int, degree: int = 2) -> MultiPatch:
    """The two ribbons; the second is the first one turned by 180 degrees about the x_2 axis through the centre."""
    there = np.array(STRAND)
    back = there[-2::-1] * (1.0, -1.0, 1.0)
    points = np.concatenate([there, back])
    ribbons = []
    for turned in ((1.0, 1.0, 1.0), (-1.0, 1.0, -1.0)):
        line = CentreLine.through((CENTRE, 0.0, 0.0) + points * turned)
        along = BSplineBasis(degree, open_knots(degree, breakpoints(line.length, 1.2 * WIDTH / elements_across)))
        across = shapes.uniform(degree, elements_across)
        ribbons.append(ribbon(line, WIDTH, (0.0, 0.0, 1.0), along, across))
    return disjoint(*ribbons)


def joined(first: FloatArray, second: FloatArray) -> FloatArray:
    """Closed polygon of two centre lines, each from its end at x_2 > 0; the ends are joined around the outside."""
    aside = np.array([0.0, 2.0 * max(np.abs(first[:, 1]).max(), np.abs(second[:, 1]).max()), 0.0])
    far = [first[-1] - aside, second[-1] - aside, second[0] + aside, first[0] + aside]
    return np.concatenate([first, far[:2], second[::-1], far[2:]])


class Scene:
    """Ribbons, load, contact and time, before the first step."""

    def __init__(self, data: Data, elements_across: int, time_step: float) -> None:
        self.data = data
        geometry = knot(elements_across)
        held = geometry.dofs(geometry.where(lambda x: x[0] < data.held))
        guided = geometry.dofs(geometry.where(lambda x: x[0] > data.pulled), (1, 2))
        zero_dofs = np.concatenate([held, guided])
        self.spline = spline = ExtractedSpline(geometry, MPI.COMM_SELF, zero_dofs=zero_dofs)
        self.quadrature = NodalQuadrature.of(spline)
        contact = SelfContact(self.quadrature, LinearKernel(data.r_max, data.stiffness), data.r_self)

        self.y, z = spline.function(name="y"), ufl.TestFunction(spline.V)
        self.time = TimeIntegrator(self.y, time_step, backward_euler(2))
        material = StVenantKirchhoff(data.youngs_modulus, data.poisson_ratio, data.thickness)
        mass = {"density": data.density, "thickness": data.thickness}
        moving = inertia(spline, self.time.xddot_alpha, z, **mass)
        moving += mass_damping(spline, self.time.xdot_alpha, z, coefficient=data.damping, **mass)
        pull = ufl.conditional(ufl.gt(spline.F[0], data.pulled), data.density * data.thickness * data.body_force, 0.0)
        load = dead_load(spline, ufl.as_vector([pull, 0.0, 0.0]), z)
        residual = moving + internal_work(spline, material, self.time.x_alpha, z) + load
        tangent = ufl.derivative(moving, self.y)
        tangent += internal_tangent(spline, material, self.time.x_alpha, z, self.y)
        self.system = ContactSystem(spline, residual, tangent, contact, unknown=self.y, time=self.time)

        v = self.time.xdot_old
        kinetic = 0.5 * data.density * data.thickness * ufl.inner(v, v) * spline.dx
        forms = compat.compile_forms(residual, load, kinetic, strain_energy(spline, material, self.y))
        self._residual, load_vector, self._kinetic, self._elastic = forms
        self._nodal = compat.create_vector(spline.V)
        self._reactions = spline.M.createVecRight()
        compat.assemble_vector(self._nodal, load_vector)
        self.load: FloatArray = -self._nodal.array_r.reshape(-1, 3)
        self.force: FloatArray = self.load.sum(axis=0)
        spline.M.multTranspose(self._nodal, self._reactions)
        self.load_norm = float(self._reactions.norm())

    @property
    def positions(self) -> FloatArray:
        """Present positions of the nodes, shape (nodes, 3)."""
        return self.spline.node_positions + self.y.x.array.reshape(-1, 3)

    def momentum(self) -> FloatArray:
        """Momentum of the last accepted state; the nodal rule is exact for it."""
        v = self.time.xdot_old.x.array.reshape(-1, 3)
        return self.data.density * self.data.thickness * self.quadrature.weights @ v

    def energies(self) -> FloatArray:
        """Kinetic, elastic and contact energy of the last accepted state."""
        contact = self.system.forces.energy if self.system.forces else 0.0
        return np.array([compat.assemble_scalar(self._kinetic), compat.assemble_scalar(self._elastic), contact])

    def reactions(self) -> FloatArray:
        """Forces of the supports on the control points in the step that was just solved, shape (functions, 3)."""
        compat.assemble_vector(self._nodal, self._residual)
        self._nodal.array_w += self.system.forces.forces.ravel()
        self.spline.M.multTranspose(self._nodal, self._reactions)
        forces = np.zeros(self.spline.geometry.n * 3)
        forces[self.spline.zero_dofs] = self._reactions.array_r[self.spline.zero_dofs]
        return forces.reshape(-1, 3)

    @cached_property
    def _along(self) -> tuple[Any, Any]:
        """Matrices from control points to points on the two centre lines."""
        functions = self.spline.geometry.functions
        lines = []
        for k, patch in enumerate(self.spline.geometry.patches):
            s = patch.bases[0].breakpoints
            s = np.linspace(s[0], s[-1], 4 * len(s))
            middle = np.full(len(s), patch.bases[1].breakpoints[[0, -1]].mean())
            lines.append(functions.evaluate(functions.to_plane(k, np.column_stack([s, middle]))))
        return lines[0], lines[1]

    def centre_lines(self) -> tuple[FloatArray, FloatArray]:
        """Present centre lines of the two ribbons as polygons."""
        points = self.spline.geometry.points + self.spline.vector.coefficients(self.y)
        return self._along[0] @ points, self._along[1] @ points

    def crossings(self) -> Crossings:
        """Crossings of the knot with its ends joined."""
        return Crossings.of(joined(*self.centre_lines()))

    @cached_property
    def quads(self) -> IntArray:
        """Quadrilaterals between neighbouring nodes, shape (quadrilaterals, 4)."""
        return compat.subcells(self.spline.V)[1]

    @cached_property
    def first(self) -> Any:
        """Mask of the nodes of the first ribbon."""
        functions = self.spline.geometry.functions
        return functions.patch_of(self.spline.V.tabulate_dof_coordinates()[:, : functions.dim]) == 0

    def piercings(self) -> int:
        """Number of places where the net of nodes goes through itself."""
        return piercings(self.positions, self.quads, self.spline.node_positions, self.data.r_self)

    @property
    def spacing_ratio(self) -> float:
        """Spacing of the points over r_max within the knot, where it matters."""
        q, kernel = self.quadrature, self.system.contact.kernel
        near = np.abs(q.points[:, 0] - CENTRE) < 2.4
        part = NodalQuadrature(q.points[near], q.weights[near], q.rational[near])
        return SelfContact(part, kernel, self.data.r_self).spacing_ratio


@dataclass
class Ledger:
    """Balances of a run so far.

    Attributes:
        work: of the load.
        damping: energy that damping took.
        gained: energy that came from nowhere; negative: what backward Euler dissipated.
        largest_gain: of a single step, relative to the work until then or to the energy, whichever is larger.
        force_imbalance: largest change of momentum that no force explains, relative to the load.
        contact_force: largest sum of the contact forces, relative to the sum of their magnitudes.
        contact_torque: largest sum of their torques, likewise.
        distance: smallest distance of points that may touch; unit: length.
        motion: largest displacement of a point in a step, relative to the smallest distance then.
        pairs: largest number of interacting pairs.
        newton_iterations: those of accepted steps.
        substeps: accepted steps.
        failures: attempts that Newton did not solve.
    """

    work: float = 0.0
    damping: float = 0.0
    gained: float = 0.0
    largest_gain: float = -np.inf
    force_imbalance: float = 0.0
    contact_force: float = 0.0
    contact_torque: float = 0.0
    distance: float = np.inf
    motion: float = 0.0
    pairs: int = 0
    newton_iterations: int = 0
    substeps: int = 0
    failures: int = 0


class Run:
    """Advances a scene and keeps its ledger.

    Attributes:
        ledger: the balances.
        row: the last step in the columns of HISTORY.
    """

    def __init__(self, scene: Scene, rtol: float = 1e-6) -> None:
        self.scene = scene
        self.ledger = Ledger()
        self.row: dict[str, float] = {}
        self._size = scene.time.step_size
        self._atol = rtol * scene.load_norm
        self._momentum = scene.momentum()
        scene.system.assemble_residual()
        self._energies = scene.energies()

    def advance(self, interval: float) -> None:
        """Steps that add up to an interval: as large as it where Newton converges, halved where it does not.

        Raises:
            SolveError: a step failed that would be too small if cut; the state is that of the last step.
        """
        time, ledger = self.scene.time, self.ledger
        end = time.time + interval
        while end - time.time > 1e-9 * interval:
            time.step_size = min(self._size, end - time.time)
            time.predict()
            try:
                report = agreed(MPI.COMM_WORLD, self._solve, self.scene.y.x.array)
            except SolveError as error:
                self.scene.y.x.array[:] = time.x_old.x.array
                ledger.failures += 1
                log.info("t = %g: a step of %g failed: %s", time.time, time.step_size, error)
                self._size = 0.5 * time.step_size
                if self._size < SMALLEST_STEP * interval:
                    raise
                continue
            ledger.newton_iterations += len(report.step_lengths)
            self._accept()
            self._size = min(2.0 * self._size, interval)

    def _solve(self) -> NewtonReport:
        return newton(self.scene.system, rtol=0.0, atol=self._atol, max_iterations=12)

    def _accept(self) -> None:
        """Make a solved step the old state and enter it into the ledger."""
        scene, ledger, time = self.scene, self.ledger, self.scene.time
        moved = (scene.y.x.array - time.x_old.x.array).reshape(-1, 3)
        held = scene.reactions().sum(axis=0)
        time.advance()

        momentum, energies = scene.momentum(), scene.energies()
        rate = (momentum - self._momentum) / time.step_size + scene.data.damping * momentum
        imbalance = float(np.abs(rate - scene.force - held).max() / scene.force[0])
        work = float((scene.load * moved).sum())
        damping = 2.0 * scene.data.damping * time.step_size * energies[0]
        gained = float((energies - self._energies).sum()) - work + damping
        self._momentum, self._energies = momentum, energies

        ledger.substeps += 1
        ledger.work += work
        ledger.damping += damping
        ledger.gained += gained
        ledger.largest_gain = max(ledger.largest_gain, gained / max(abs(ledger.work), energies.sum()))
        ledger.force_imbalance = max(ledger.force_imbalance, imbalance)
        distance = self._enter_contact(float(np.linalg.norm(moved, axis=1).max()))
        last = (*energies, ledger.work, ledger.damping, ledger.gained, *held, imbalance)
        counts = (ledger.newton_iterations, ledger.substeps, ledger.failures)
        self.row = dict(zip(HISTORY, (*last, scene.system.forces.pairs, distance, *counts), strict=True))

    def _enter_contact(self, moved: float) -> float:
        """Enter the contact of the step, and return the smallest distance, r_max where nothing touches."""
        ledger, contact = self.ledger, self.scene.system.forces
        distance = min(contact.distance, self.scene.data.r_max)
        ledger.distance = min(ledger.distance, distance)
        ledger.motion = max(ledger.motion, moved / distance)
        ledger.pairs = max(ledger.pairs, contact.pairs)
        if contact.pairs:
            ledger.contact_force = max(ledger.contact_force, _surplus(contact.forces))
            torques = np.cross(self.scene.positions, contact.forces)
            ledger.contact_torque = max(ledger.contact_torque, _surplus(torques))
        return distance


def _surplus(vectors: FloatArray) -> float:
    """Magnitude of a sum relative to the sum of the magnitudes."""
    return float(np.linalg.norm(vectors.sum(axis=0)) / np.linalg.norm(vectors, axis=1).sum())


def main(
    steps: int | None = None,
    dt_factor: float = 1.0,
    resolution: int = 3,
    pictures: int = 150,
    out: Path = Path("results/reef_knot"),
    overwrite: bool = False,
    viz: bool = True,
) -> dict[str, Any]:
    """Tie a reef knot and pull it tight.

    Args:
        steps: number of time steps; default: as many as the published end time takes.
        dt_factor: time step relative to the published one.
        resolution: elements across a ribbon; those along it are 1.2 times as long in the knot.
        pictures: number of states written as ParaView files, at most one a step; as often the knot is checked.
        out: folder of the results.
        overwrite: whether to delete the results of an earlier run in this folder.
        viz: whether to write ParaView files, a history and a picture.

    Returns:
        The summary.
    """
    data = Data()
    dt = checks.positive("dt_factor", dt_factor) * data.time_step
    steps = max(1, round(data.steps / dt_factor)) if steps is None else checks.whole("steps", steps, 1)
    every = max(1, steps // checks.whole("pictures", pictures, 1))
    claim(out, overwrite=overwrite)
    scene = Scene(data, checks.whole("resolution", resolution, 1), dt)
    run, watch, progress = Run(scene), Stopwatch(), Progress(steps)

    memory, states, knots, pierced = [], [(0.0, scene.positions)], [scene.crossings()], [scene.piercings()]
    files = Files(out, scene) if viz else None
    for n in progress:
        before = run.ledger.newton_iterations
        with watch:
            run.advance(dt)
        memory.append(rss_mib())
        if n % every == 0 or n == steps:
            states.append((scene.time.time, scene.positions))
            knots.append(scene.crossings())
            pierced.append(scene.piercings())
        if files:
            files.write(scene.time.time, run.row, picture=n % every == 0)
        passes, residuals = run.ledger.newton_iterations - before, [(run.row["force_imbalance"],)]
        progress.show(SimpleNamespace(t=scene.time.time, passes=passes, residuals=residuals))
    if files:
        files.close()
        draw(out / "reef_knot.png", scene, states, files.rows)

    ledger, first, second = run.ledger, *scene.centre_lines()
    determinants = sorted({knot.determinant for knot in knots})
    if determinants != [SQUARE_KNOT] or any(pierced):
        log.warning("the ribbons went through each other: determinants %s, %d piercings", determinants, max(pierced))
    inputs = {"steps": steps, "dt_factor": dt_factor, "resolution": resolution, "pictures": pictures}
    summary = write_summary(
        out,
        "reef_knot",
        inputs,
        qoi={
            "force_in_held_ends": Quantity(-run.row["held_1"]),
            "force_of_load": Quantity(float(scene.force[0])),
            "smallest_distance": Quantity(ledger.distance),
            "contact_pairs": Quantity(float(run.row["pairs"])),
            "length_of_knot": Quantity(float(first[:, 0].max() - second[:, 0].min())),
        },
        steps=steps,
        time=scene.time.time,
        dofs_shell=3 * scene.spline.geometry.n,
        wall_s=watch.wall_s,
        cpu_s=watch.cpu_s,
        rss_mib_step_10=memory[min(9, len(memory) - 1)],
        rss_mib_end=memory[-1],
        monitors=vars(ledger)
        | {
            "spacing_ratio": scene.spacing_ratio,
            "piercings": max(pierced),
            "determinants": determinants,
            "writhe_initial": knots[0].writhe,
        },
    )
    if MPI.COMM_WORLD.rank == 0:
        print(f"{steps} steps to t = {scene.time.time:.4g}, {watch.cpu_s:.3g} CPU s, {ledger.failures} cut")
        print(table(["quantity", "value"], [(name, q["value"]) for name, q in summary["qoi"].items()]))
        print(table(["monitor", "value"], summary["monitors"].items()))
    return summary


class Files:
    """ParaView files and a history of the run."""

    def __init__(self, out: Path, scene: Scene) -> None:
        self._ribbons = VTUSeries(out / "ribbons", scene.spline, y=scene.y, velocity=scene.time.xdot_old)
        self._history = CSVSeries(out / "history.csv", HISTORY)
        self.rows: list[tuple[float, ...]] = []

    def write(self, t: float, row: dict[str, float], *, picture: bool) -> None:
        """Append a step to the history, and its state to the ParaView files if it is to be a picture."""
        self.rows.append((t, *row.values()))
        self._history.write(t, *row.values())
        if picture:
            self._ribbons.write(t)

    def close(self) -> None:
        """Finish the files."""
        self._ribbons.close()
        self._history.close()


@root_only
def draw(path: Path, scene: Scene, states: list[tuple[float, FloatArray]], rows: list[tuple[float, ...]]) -> None:
    """The knot from above and from the side at the start, at the largest pull and at the end, and histories."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(3, 3, figsize=(14, 9.5), layout="constrained", height_ratios=(1.0, 0.75, 0.8))
    hardest = rows[int(np.argmin([row[1 + HISTORY.index("held_1")] for row in rows]))][0]
    middle = min(states, key=lambda state: abs(state[0] - hardest))
    for column, (t, x) in zip(axes.T, (states[0], middle, states[-1]), strict=True):
        centre = 0.5 * (x[scene.first, 0].max() + x[~scene.first, 0].min())
        for ax, angle, across in zip(column, (0.0, np.radians(65.0)), (2.3, 1.6), strict=False):
            draw_ribbons(ax, scene, x, angle)
            ax.set(aspect="equal", xlim=(centre - 3.5, centre + 3.5), ylim=(-across, across))
            ax.set_axis_off()
        column[0].set_title(f"t = {t:.3g}")
    t, *columns = np.array(rows).T
    history = dict(zip(HISTORY, columns, strict=True))
    for name in ("work", "kinetic", "elastic", "contact", "damping"):
        axes[2, 0].plot(t, history[name], label=name)
    axes[2, 0].plot(t, -history["gained"], "k:", label="backward Euler's dissipation")
    axes[2, 0].set(xlabel="$t$", title="energies")
    axes[2, 1].plot(t, -history["held_1"], label="held ends")
    axes[2, 1].axhline(scene.force[0], color="0.5", linestyle="--", label="load")
    axes[2, 1].set(xlabel="$t$", title="force along $x_1$")
    axes[2, 2].plot(t, history["distance"], label="smallest distance")
    axes[2, 2].axhline(scene.data.r_max, color="0.5", linestyle="--", label="$r_{max}$")
    axes[2, 2].set(xlabel="$t$", ylim=(0.0, 1.2 * scene.data.r_max), title="distance of points that may touch")
    for ax, place in zip(axes[2], ("center right", "upper right", "lower right"), strict=True):
        ax.legend(fontsize=8, loc=place)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def draw_ribbons(ax: Any, scene: Scene, x: FloatArray, angle: float) -> None:
    """Shaded ribbons, the nearest last, seen along x_3 after a rotation about the x_1 axis."""
    from matplotlib.collections import PolyCollection

    c, s = np.cos(angle), np.sin(angle)
    quads = scene.quads
    corners = (x @ np.array([[1.0, 0.0, 0.0], [0.0, c, s], [0.0, -s, c]]))[quads]
    normals = np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
    light = np.abs(normals @ (0.35, 0.25, 0.9)) / np.linalg.norm(normals, axis=1)
    colours = np.where(scene.first[quads[:, :1]], (0.16, 0.42, 0.72), (0.85, 0.3, 0.2)) * (0.4 + 0.6 * light[:, None])
    order = np.argsort(corners[:, :, 2].mean(axis=1))
    faces = np.clip(colours, 0.0, 1.0)[order]
    ax.add_collection(PolyCollection(corners[order, :, :2], facecolors=faces, edgecolors=faces, linewidths=0.3))


if __name__ == "__main__":
    script.command_line(main)
