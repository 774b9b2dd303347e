"""Plane scenes with known answers that judge what happens at an immersed surface.

Each scene is a frozen dataclass of its data, and ``run(setting)`` computes it with any setting of the coupling and of
the flow's fields; it gives figures by name, the steps' reports and what they cost. Lengths, densities and jumps of
pressure are of the order of one, and h is the size of the fluid's cells.

- :class:`HeldSheet`: an arc or a straight sheet across a duct under a jump of pressure; nothing should flow.
- :class:`String`: a stretched string across a duct swings in its first mode.
- :class:`Ring`: a closed elastic ring that starts as an ellipse; its area should stay.
- :class:`Plate`: a plate swings in its own plane, in Stokes layers.
- :class:`Slit`: two plates on one line leave a gap, through which a jump of pressure drives the fluid.
- :class:`Flag`: a flag that is held at one end flaps in a stream.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import ufl
from mpi4py import MPI

from coudalfish import CouDALFISh, CouplingOptions, StepReport
from shnapr import DeadLoad, Shell, StVenantKirchhoff
from shnapr.supports import fixed, pinned
from tigar_x import compat, generalized_alpha
from tigar_x.compat import FloatArray
from tigar_x.fem.linear import direct
from tigar_x.geometry import multipatch, shapes
from tigar_x.geometry.gluing import glued
from tigar_x.geometry.patch import Patch
from tigar_x.run.course import Course
from tigar_x.run.progress import Stopwatch
from varmint import Flow, FlowOptions, Slip, Traction, Velocity, box, flow_rate
from varmint.mesh.named import grid

COMM = MPI.COMM_WORLD


@dataclass(frozen=True)
class Setting:
    """How a scene is computed at its surface.

    Attributes:
        options: of the coupling.
        immersed: what the flow's fields know of the surface, see :class:`varmint.Flow`.
        flow: options of the flow.
    """

    options: CouplingOptions = field(default_factory=CouplingOptions)
    immersed: Any = "plain"
    flow: FlowOptions = field(default_factory=lambda: FlowOptions(solver=direct()))


@dataclass(frozen=True, eq=False)
class Found:
    """What a run found.

    Attributes:
        figures: by name.
        reports: of the steps.
        watch: seconds of the steps.
        unknowns: of the flow.
    """

    figures: dict[str, float]
    reports: Sequence[StepReport]
    watch: Stopwatch
    unknowns: int

    @property
    def passes(self) -> FloatArray:
        """Block passes of every step."""
        return np.array([report.passes for report in self.reports])

    @property
    def imbalance(self) -> float:
        """Largest difference between action and reaction, relative to the forces."""
        return max(report.monitors.force_imbalance for report in self.reports if report.monitors)


class Coupled:
    """A flow and a shell that are coupled, and the steps that they have taken.

    Args:
        flow: the flow.
        shell: the shell.
        setting: of the coupling.
        multiplier: at the start.
    """

    def __init__(self, flow: Flow, shell: Shell, setting: Setting, multiplier: float = 0.0) -> None:
        self.flow, self.shell = flow, shell
        self.fsi = CouDALFISh(flow, shell, setting.options, multiplier=multiplier)
        self.reports: list[StepReport] = []
        self.watch = Stopwatch()

    def step(self, measure: Callable[[], Any] | None = None) -> StepReport:
        """Take a step."""
        with self.watch:
            self.reports.append(self.fsi.takeStep(measure))
        return self.reports[-1]

    def found(self, **figures: float) -> Found:
        """What has been found so far."""
        return Found(figures, tuple(self.reports), self.watch, self.flow.unknowns)


def rigid(geometry: Any) -> Shell:
    """A shell that does not move."""
    return Shell(geometry, StVenantKirchhoff(1.0, 0.3, 0.05, bending=False), density=1.0, zero_dofs=fixed(geometry))


def immersed_flow(mesh: Any, conditions: Sequence[Any], setting: Setting, *, pin_at: Any = None, **data: Any) -> Flow:
    """The flow of a scene with the options and fields of a setting."""
    options = setting.flow if pin_at is None else replace(setting.flow, pin_at=pin_at)
    return Flow(mesh, conditions, immersed=setting.immersed, options=options, **data)


# -- at rest ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class HeldSheet:
    """Duct (0, 2) x (0, 1) with slip walls and a sheet across it that is held, under a jump of pressure.

    The exact velocity is zero. With plain fields the largest velocity over the jump is 3.0e-3, 1.5e-3, 7.8e-4
    for n = 16, 32, 64; long runs of shorter steps show whether a pattern of the multiplier grows.

    Attributes:
        n: fluid cells across.
        dt: time step.
        steps: after the load.
        ramp: steps in which the load is raised.
        rho: density.
        mu: viscosity.
        jump: of the pressure.
        place: of the sheet's ends beside the line of the mesh in the middle, in cells of the fluid.
        bow: height of its arc; 0: straight.
        per_cell: elements of the sheet per cell of the fluid.
    """

    n: int = 16
    dt: float = 1.0
    steps: int = 20
    ramp: int = 10
    rho: float = 1.0
    mu: float = 0.1
    jump: float = 1.0
    place: float = 0.37
    bow: float = 0.1
    per_cell: float = 2.0

    def build(self, setting: Setting) -> Coupled:
        """The scene at rest, without its load."""
        mesh, end = box(COMM, (0.0, 0.0), (2.0, 1.0), (2 * self.n, self.n)), self.ramp * self.dt

        def load(x: Any, t: Any) -> Any:
            return ufl.as_vector([self.jump * 0.5 * (1.0 - ufl.cos(math.pi * ufl.min_value(t / end, 1.0))), 0.0])

        ends = [Traction("left", load), Traction("right"), Slip(("bottom", "top"))]
        flow = immersed_flow(mesh, ends, setting, rho=self.rho, mu=self.mu, dt=self.dt, scheme=generalized_alpha(0.0))
        x = 1.0 + self.place / self.n
        line = shapes.line((x, 0.0), (x, 1.0), elements=round(self.per_cell * self.n))
        s = line.points[:, 1]
        arc = Patch.from_points(line.bases, line.points + np.outer(4.0 * self.bow * s * (1.0 - s), (1.0, 0.0)))
        return Coupled(flow, rigid(arc), setting)

    def run(self, setting: Setting = Setting()) -> Found:
        """Load it, and let it rest.

        Figures: "velocity", the largest at a node, and "leak" through the sheet's length, over the jump; "grown", the
        velocity relative to that after half of the steps; "pattern" and "growth" of the multiplier, the largest
        difference from its mean, and its change in the second half of the steps per 1000 of them, over the jump; and
        how far its mean is off, "load".
        """
        scene = self.build(setting)
        fsi, half = scene.fsi, self.ramp + self.steps // 2
        W = fsi.shell.quadrature.weights
        for _ in range(half):
            scene.step()
        before, speed = self._along(fsi), fsi.fluid.speed()
        for _ in range(self.ramp + self.steps - half):
            report = scene.step()
        after, mean = self._along(fsi), float(np.average(self._along(fsi), weights=W))
        pattern = after - mean
        change = pattern - (before - np.average(before, weights=W))
        leak = report.monitors.leak / W.sum() if report.monitors else math.nan
        return scene.found(
            velocity=fsi.fluid.speed() / self.jump,
            leak=leak / self.jump,
            grown=fsi.fluid.speed() / speed if speed else 1.0,
            pattern=float(np.abs(pattern).max()) / self.jump,
            growth=float(np.abs(change).max()) / self.jump * 1000.0 / max(1, self.steps - self.steps // 2),
            load=mean / self.jump - 1.0,
        )

    @staticmethod
    def _along(fsi: CouDALFISh) -> FloatArray:
        """The multiplier along the normals."""
        return fsi.lam if fsi.lam.ndim == 1 else np.einsum("qi,qi->q", fsi.lam, fsi.shell.normals())

    def shifted(self, setting: Setting = Setting(), places: int = 20) -> list[Found]:
        """The sheet at places that are equally spaced within a cell of the fluid."""
        return [replace(self, place=self.place + k / places).run(setting) for k in range(places)]


LOADED_ARC = HeldSheet(n=12, dt=0.01, steps=2000, ramp=60, mu=0.01, place=0.0)
"""What ``benchmarks/relaxation.py`` runs as well: without relaxation of the multiplier a pattern of it grows."""


# -- swinging ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class String:
    """A string across the duct (-1, 1) x (0, 1), closed and with slip walls, whose ends slide along these.

    It is stretched so that it would swing at the circular frequency 2 pi in an inviscid fluid, moves along the duct
    alone, and starts displaced by its first mode that keeps the volumes on both sides, a cosine. The fluid sticks to
    it. Exact is the linear theory of a viscous fluid, see :meth:`exact`.

    Attributes:
        n: fluid cells across.
        steps_per_period: of the inviscid motion.
        periods: that are computed.
        mass_ratio: mass of the string relative to rho times its length.
        rho: density of the fluid.
        mu: viscosity; the layer at the string has the thickness sqrt(mu/(pi rho)).
        amplitude: at the start.
        place: of the string along the duct, in cells of the fluid.
    """

    n: int = 16
    steps_per_period: int = 50
    periods: int = 3
    mass_ratio: float = 1.0
    rho: float = 1.0
    mu: float = 0.01
    amplitude: float = 0.005
    place: float = 0.37

    def build(self, setting: Setting) -> Coupled:
        """The scene at its start."""
        mesh = box(COMM, (-1.0, 0.0), (1.0, 1.0), (2 * self.n, self.n))
        size = {"dt": 1.0 / self.steps_per_period, "scheme": generalized_alpha(0.5)}
        walls = [Slip(("left", "right", "bottom", "top"))]
        flow = immersed_flow(mesh, walls, setting, pin_at=(-1.0, 0.0), rho=self.rho, mu=self.mu, **size)
        line = shapes.line((self.place / self.n, 0.0), (self.place / self.n, 1.0), elements=2 * self.n)
        tension, thickness = self.tension, 0.01
        material = StVenantKirchhoff(1e-3 * tension / thickness, 0.3, thickness, prestress=(tension,), bending=False)
        along = 2 * np.arange(line.basis.n) + 1
        shell = Shell(line, material, density=self.mass / thickness, zero_dofs=along, quadrature_degree=4)
        shell.start(np.outer(self.amplitude * np.cos(math.pi * line.points[:, 1]), (1.0, 0.0)))
        return Coupled(flow, shell, setting)

    @property
    def mass(self) -> float:
        """Of the string per length."""
        return self.mass_ratio * self.rho

    @property
    def tension(self) -> float:
        """Force in the string."""
        k, both = math.pi, sum(1.0 / math.tanh(math.pi * a) for a in self._sides)
        return (2.0 * math.pi) ** 2 * (self.mass + self.rho * both / k) / k**2

    @property
    def _sides(self) -> tuple[float, float]:
        return 1.0 + self.place / self.n, 1.0 - self.place / self.n

    def exact(self) -> complex:
        """Complex circular frequency w of the motion exp(i w t).

        With k = pi and l^2 = k^2 + i w rho/mu the fluid on a side of length a resists the velocity of the string by
        the pressure i w rho/k / (tanh k a - k/l tanh l a), as follows from its potential and its shear part.
        """
        w, k = complex(2.0 * math.pi), math.pi
        for _ in range(200):
            lam = np.sqrt(k**2 + 1j * w * self.rho / self.mu)
            added = sum(self.rho / k / (np.tanh(k * a) - k / lam * np.tanh(lam * a)) for a in self._sides)
            w = complex(0.5 * (w + np.sqrt(self.tension * k**2 / (self.mass + added))))
        return w

    def run(self, setting: Setting = Setting()) -> Found:
        """Let it swing.

        Figures: "frequency" and "damping" relative to the exact circular frequency, less one, and "error" of the
        complex one; "leak", the largest change of the volume on a side over that which the mode displaces to and fro.
        """
        scene = self.build(setting)
        shape = np.cos(math.pi * scene.shell.spline.node_positions[:, 1])
        weights = scene.fsi.shell.quadrature.weights * shape
        course, leak = [], 0.0
        for _ in range(self.periods * self.steps_per_period):
            report = scene.step()
            course.append(float(weights @ scene.shell.spline.nodal(scene.shell.y)[:, 0] / (weights @ shape)))
            leak += report.monitors.leak / self.steps_per_period if report.monitors else 0.0
        first = self.steps_per_period // 2
        w, exact = damped_frequency(np.array(course[first:]), 1.0 / self.steps_per_period), self.exact()
        return scene.found(
            frequency=w.real / exact.real - 1.0,
            damping=w.imag / exact.imag - 1.0,
            error=abs(w / exact - 1.0),
            leak=abs(leak) * math.pi / (2.0 * self.amplitude),
        )


def damped_frequency(course: FloatArray, dt: float) -> complex:
    """Complex circular frequency w, of about 2 pi, of ``Re(c exp(i w t))``, by linear prediction in the least squares.

    Args:
        course: samples.
        dt: between them.
    """
    stride = max(1, round(0.125 / dt))
    ahead, here, back = course[2 * stride :], course[stride:-stride], course[: -2 * stride]
    twice, product = np.linalg.lstsq(np.column_stack([here, -back]), ahead, rcond=None)[0]
    z = complex(twice / 2.0, math.sqrt(max(0.0, product - twice**2 / 4.0)))
    return complex(-1j * np.log(z) / (stride * dt))


@dataclass(frozen=True)
class Ring:
    """A closed elastic ring in the unit box, which its tension draws from an ellipse to a circle.

    Attributes:
        n: fluid cells along a side.
        dt: time step.
        steps: number of them.
        mu: viscosity; the density is one.
        axes: of the ellipse.
        tension: at the start.
        stiffness: E times the thickness.
        mass: of the ring per length.
        per_cell: elements per cell of the fluid, about.
    """

    n: int = 32
    dt: float = 0.02
    steps: int = 50
    mu: float = 0.1
    axes: tuple[float, float] = (0.3, 0.2)
    tension: float = 1.0
    stiffness: float = 1.0
    mass: float = 0.1
    per_cell: float = 2.0

    def build(self, setting: Setting) -> Coupled:
        """The scene at its start."""
        mesh = box(COMM, (0.0, 0.0), (1.0, 1.0), (self.n, self.n))
        walls = [Velocity(("left", "right", "bottom", "top"))]
        known = {"rho": 1.0, "mu": self.mu, "dt": self.dt, "scheme": generalized_alpha(0.5)}
        flow = immersed_flow(mesh, walls, setting, pin_at=(0.0, 0.0), **known)
        (a, b), number = self.axes, round(self.per_cell * self.n * math.pi * sum(self.axes))
        angles = 2.0 * math.pi * np.linspace(0.0, 1.0, number + 1)
        points = np.column_stack([0.5 + a * np.cos(angles), 0.5 + b * np.sin(angles)])
        points[-1] = points[0]
        ring = glued(Patch.from_points(shapes.uniform_bases([1], [number], 1), points), within=True)
        material = StVenantKirchhoff(self.stiffness / 0.01, 0.3, 0.01, prestress=(self.tension,), bending=False)
        return Coupled(flow, Shell(ring, material, density=self.mass / 0.01), setting)

    def run(self, setting: Setting = Setting()) -> Found:
        """Let it go.

        Figures: "area", its change relative to the start, "lost", the largest on the way; "velocity" at the end over
        tension/mu; "roundness", smallest over largest distance from the centre.
        """
        scene = self.build(setting)
        areas = [self._area(scene)]
        for _ in range(self.steps):
            scene.step()
            areas.append(self._area(scene))
        change = np.array(areas) / areas[0] - 1.0
        away = np.linalg.norm(scene.shell.positions - scene.shell.positions.mean(axis=0), axis=1)
        return scene.found(
            area=float(change[-1]),
            lost=float(np.abs(change).max()),
            velocity=scene.fsi.fluid.speed() * self.mu / self.tension,
            roundness=float(away.min() / away.max()),
        )

    @staticmethod
    def _area(scene: Coupled) -> float:
        x, edges = scene.shell.positions, scene.fsi.shell.sheets.cells
        start, end = x[edges[:, 0]], x[edges[:, 1]]
        return abs(float(0.5 * np.sum(start[:, 0] * end[:, 1] - start[:, 1] * end[:, 0])))


@dataclass(frozen=True)
class Plate:
    """A rigid plate that swings in its own plane, between slip walls; both sides of it have a Stokes layer.

    The plate is heavy and pushed to and fro by a force of circular frequency 2 pi. What the fluid exerts, over the
    plate's velocity, is compared as complex numbers with the exact ``-mu k (tanh k a + tanh k b)``, k = (1 + i)/delta,
    a and b the distances of the walls: for walls that are far away, the layers e^(-k y).

    Attributes:
        delta: thickness of the layers sqrt(2 mu/(2 pi rho)) in cells of the fluid.
        n: fluid cells between the walls.
        steps_per_period: time steps.
        periods: that are computed; the last one counts.
        place: of the plate above the line of the mesh in the middle, in cells of the fluid.
    """

    delta: float = 1.0
    n: int = 32
    steps_per_period: int = 100
    periods: int = 3
    place: float = 0.25

    @property
    def mu(self) -> float:
        """Viscosity; the density is one."""
        return math.pi * (self.delta / self.n) ** 2

    def exact(self) -> complex:
        """Force per length over the plate's velocity."""
        k, middle = (1.0 + 1.0j) * self.n / self.delta, 0.5 + self.place / self.n
        return complex(-self.mu * k * (np.tanh(k * middle) + np.tanh(k * (1.0 - middle))))

    def build(self, setting: Setting) -> Coupled:
        """The scene at rest."""
        h, slack = 1.0 / self.n, 1e-6
        mesh = box(COMM, (-slack, 0.0), (8.0 * h + slack, 1.0), (8, self.n))
        walls = [Slip(("bottom", "top")), Velocity(("left", "right"), (0.0, 0.0), components=(1,))]
        known = {"rho": 1.0, "mu": self.mu, "dt": 1.0 / self.steps_per_period, "scheme": generalized_alpha(0.5)}
        flow = immersed_flow(mesh, walls, setting, **known)
        y, mass, omega = 0.5 + self.place * h, 100.0 * self.delta * h, 2.0 * math.pi
        line = shapes.line((0.0, y), (8.0 * h, y), elements=16)
        size = 0.1 * slack * omega**2 * mass
        push = DeadLoad(lambda X, t: ufl.as_vector([size * ufl.cos(omega * t), 0.0]))
        material = StVenantKirchhoff(100.0, 0.3, 0.01, bending=False)
        across = 2 * np.arange(line.basis.n) + 1
        return Coupled(flow, Shell(line, material, density=mass / 0.01, loads=[push], zero_dofs=across), setting)

    def run(self, setting: Setting = Setting()) -> Found:
        """Push it.

        Figures: "error" of the complex force relative to the exact one, "drag" and "inertia", its parts in phase with
        the velocity and with the acceleration, relative to the exact ones.
        """
        scene, N = self.build(setting), self.steps_per_period
        phase = force = velocity = 0.0j
        for step in range(self.periods * N):
            report = scene.step(lambda: float(np.mean(scene.fsi.shell.velocity()[:, 0])))
            if step >= (self.periods - 1) * N and report.monitors:
                phase = np.exp(-2j * math.pi * report.t_alpha)
                force, velocity = force + phase * report.monitors.force[0], velocity + phase * report.measured
        ratio = force / velocity * self.n / 8.0
        exact = self.exact()
        return scene.found(
            error=abs(ratio / exact - 1.0), drag=ratio.real / exact.real, inertia=ratio.imag / exact.imag
        )


# -- a gap ------------------------------------------------------------------------------------------------------------

DISCHARGE = {10.0: 0.60, 27.0: 0.67, 55.0: 0.67}
"""Flow over ``gap sqrt(2 jump/rho)`` of a slit at some Reynolds numbers, from meshes that fit the plates."""


def slit_flow(gap: float, reynolds: float) -> float:
    """Flow rate through a slit in a wall for a jump and a density of one.

    Args:
        gap: its width.
        reynolds: see :class:`Slit`.
    """
    if reynolds > 1.0:
        return DISCHARGE[reynolds] * gap * math.sqrt(2.0)
    return gap * math.sqrt(math.pi * reynolds / 32.0)


@dataclass(frozen=True)
class Slit:
    """Two rigid plates on one line across the duct (-1, 1) x (0, 1) with slip walls; between them is a gap.

    A jump of pressure of one drives the fluid. It starts at rest, with the jump in its pressure and on the plates. Slow
    flow through a slit in a wall has the rate ``pi gap^2 jump/(32 mu)``, faster flow that which is in ``DISCHARGE``;
    the viscosity follows from the Reynolds number, the flow rate over the kinematic viscosity. With plain fields
    0.07, 0.12, 0.50 of it pass gaps of 1, 2, 4 cells at a CFL number of 1.

    Attributes:
        gap: in cells of the fluid.
        reynolds: up to 1, where the flow counts as slow, or one of ``DISCHARGE``.
        cfl: time step times mean velocity in the gap over the size of a cell.
        n: fluid cells across.
        place: of the plates' line beside the line of the mesh in the middle, in cells of the fluid.
        middle: of the gap above the axis, likewise.
        per_cell: elements of the plates per cell of the fluid, about.
        steady: largest change of the flow relative to the reference that counts as none, while the fluid passes a
            cell in the gap.
        most: number of steps after which a steady flow is not waited for any longer.
    """

    gap: float = 1.0
    reynolds: float = 0.5
    cfl: float = 0.2
    n: int = 32
    place: float = 0.37
    middle: float = 0.5
    per_cell: float = 2.0
    steady: float = 1e-3
    most: int = 300

    @property
    def reference(self) -> float:
        """Flow rate for a jump and a density of one."""
        return slit_flow(self.gap / self.n, self.reynolds)

    @property
    def mu(self) -> float:
        """Viscosity."""
        return self.reference / self.reynolds

    def build(self, setting: Setting) -> Coupled:
        """The scene at rest."""
        h = 1.0 / self.n
        mesh = box(COMM, (-1.0, 0.0), (1.0, 1.0), (2 * self.n, self.n))
        ends = [Traction("left", (1.0, 0.0)), Traction("right"), Slip(("bottom", "top"))]
        dt = self.cfl * h * self.gap * h / self.reference
        flow = immersed_flow(mesh, ends, setting, rho=1.0, mu=self.mu, dt=dt, scheme=generalized_alpha(0.0))
        x, low = self.place * h, 0.5 + (self.middle - 0.5 * self.gap) * h
        spans = (0.0, low), (low + self.gap * h, 1.0)
        lines = [
            shapes.line((x, a), (x, b), elements=max(1, round(self.per_cell * self.n * (b - a)))) for a, b in spans
        ]
        flow.start(pressure=lambda X, t: ufl.conditional(ufl.lt(X[0], x), 1.0, 0.0))
        return Coupled(flow, rigid(multipatch.disjoint(*lines)), setting, multiplier=1.0)

    def run(self, setting: Setting = Setting()) -> Found:
        """Let it flow until it is steady.

        Figures: "flow" over the reference, "leak", what passes the plates according to the points on them, likewise,
        and "change", that of the flow at the end while the fluid passes a cell.
        """
        scene = self.build(setting)
        (rate,), old, calm = compat.compile_forms(flow_rate(scene.flow, "right")), 0.0, 0.0
        while calm < 3.0 and len(scene.reports) < self.most:
            report = scene.step()
            new = compat.assemble_scalar(rate) / self.reference
            old, change = new, abs(new - old) / self.cfl
            calm = calm + self.cfl if change <= self.steady else 0.0
        leak = report.monitors.leak / self.reference if report.monitors else math.nan
        return scene.found(flow=new, leak=leak, change=change)


# -- a free end -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Flag:
    """A flag of length one in a stream of speed and density one; its front end is held, it hangs along the stream.

    The data are those of a filament of Huang, Shin and Sung, doi:10.1016/j.jcp.2007.07.002: it starts straight and at
    rest, at an angle to the stream, and flaps for ever. It can stretch here, by about a thousandth. Near it the mesh is
    uniform, elsewhere its cells grow.

    Attributes:
        n: fluid cells in the length.
        dt: time step.
        until: end of the run; the last half of it counts.
        reynolds: Reynolds number of the length.
        mass: per area, over that of the fluid in a cube of its length.
        bending: stiffness over the mass.
        weight: per mass, along the stream.
        stretching: stiffness.
        angle: at the start.
        ahead: of the mesh, before the flag.
        behind: likewise.
        beside: likewise.
    """

    n: int = 16
    dt: float = 0.01
    until: float = 30.0
    reynolds: float = 200.0
    mass: float = 1.5
    bending: float = 1.5e-3
    weight: float = 0.5
    stretching: float = 1e3
    angle: float = 0.1 * math.pi
    ahead: float = 2.0
    behind: float = 5.0
    beside: float = 4.0

    def build(self, setting: Setting) -> Coupled:
        """The flag at rest in the stream."""
        x = _graded(-self.ahead, 1.0 + self.behind, (-0.25, 1.5), 1.0 / self.n)
        y = _graded(-self.beside, self.beside, (-0.625, 0.625), 1.0 / self.n)
        sides = [Velocity("left", (1.0, 0.0)), Slip(("bottom", "top")), Traction("right")]
        known = {"rho": 1.0, "mu": 1.0 / self.reynolds, "dt": self.dt, "scheme": generalized_alpha(0.5)}
        flow = immersed_flow(grid(COMM, (x, y)), sides, setting, **known)
        flow.start((1.0, 0.0))
        line = shapes.line((0.0, 0.0), (math.cos(self.angle), math.sin(self.angle)), elements=self.n, degree=2)
        thickness = math.sqrt(12.0 * self.bending * self.mass / self.stretching)
        material = StVenantKirchhoff(self.stretching / thickness, 0.0, thickness)
        load = DeadLoad((self.mass * self.weight, 0.0))
        known = {"density": self.mass / thickness, "zero_dofs": pinned(line, "u0"), "loads": [load]}
        return Coupled(flow, Shell(line, material, **known), setting)

    def run(self, setting: Setting = Setting()) -> Found:
        """Let it flap.

        Figures: "amplitude" of its end across the stream, half of what it passes, "period" and "drag", means over the
        last half of the run, and "leak", the largest flow through it over that of the stream through its length.
        """
        scene = self.build(setting)
        end = math.sin(self.angle)
        for _ in range(round(self.until / self.dt)):
            scene.step(lambda: end + scene.shell.at("u1").displacement[1])
        late = scene.reports[len(scene.reports) // 2 :]
        course = Course([report.t for report in late], [report.measured for report in late])
        rises = course.rises(0.0)
        monitors = [report.monitors for report in scene.reports if report.monitors]
        return scene.found(
            amplitude=0.5 * float(np.ptp(course.y)),
            period=float(np.diff(rises).mean()) if len(rises) > 1 else math.nan,
            drag=float(np.mean([each.force[0] for each in monitors[len(scene.reports) // 2 :]])),
            leak=max(abs(each.leak) for each in monitors),
        )


def _graded(low: float, high: float, uniform: tuple[float, float], h: float, growth: float = 1.15) -> FloatArray:
    """Lines of a mesh that are h apart in a part of it; outside cells grow by a factor, about."""
    a, b = uniform
    sides = []
    for length in (a - low, high - b):
        count = math.ceil(math.log1p(length * (growth - 1.0) / (growth * h)) / math.log(growth))
        steps = growth ** np.arange(1, count + 1)
        sides.append(length * np.cumsum(steps) / steps.sum())
    return np.concatenate([a - sides[0][::-1], np.linspace(a, b, round((b - a) / h) + 1), b + sides[1]])
