"""Plane scenes in which something swings, see ``plane.py``.

- :class:`String`: a stretched string across a duct swings in its first mode.
- :class:`Plate`: a plate swings in its own plane, in Stokes layers.
"""

import math
from dataclasses import dataclass

import numpy as np
import ufl
from scene import COMM, IN_PLANE, Coupled, Found, Setting, immersed_flow

from shnapr import DeadLoad, Shell, StVenantKirchhoff
from tigar_x import generalized_alpha
from tigar_x.compat import FloatArray
from tigar_x.geometry import shapes
from varmint import Slip, Velocity, box


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

    def run(self, setting: Setting = IN_PLANE) -> Found:
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

    def run(self, setting: Setting = IN_PLANE) -> Found:
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
