"""Scenes in space with known answers that judge what happens at an immersed surface, see ``scene.py``.

Lengths, densities and jumps of pressure are of the order of one but for those of a heart valve, and h is the size of
the fluid's cells, which are tetrahedra, six to a cube.

- :class:`HeldSurface`: a dome or a plate across a cube under a jump of pressure; nothing should flow.
- :class:`Fence`: an elastic plate with three free edges in a stream.
- In ``space_gaps.py`` a slit and a hole, in ``space_contact.py`` two plates within one cell, in ``space_bodies.py``
  spheres.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import ufl
from scene import COMM, Coupled, Found, Setting, immersed_flow, rigid

from coudalfish.surface import exchange
from shnapr import Shell, StVenantKirchhoff
from tigar_x import compat, generalized_alpha
from tigar_x.compat import FloatArray
from tigar_x.fem.linear import gmres_ilu
from tigar_x.geometry import shapes
from tigar_x.geometry.patch import Patch
from varmint import Flow, FlowOptions, Slip, Traction, Velocity, WeakVelocity, box

IN_SPACE = Setting(flow=FlowOptions())
"""Linear solver by size: factors of flows in space are dear."""
ITERATIVE = gmres_ilu(1)
AROUND = ("left", "right", "bottom", "top")
OVER = 0.1
"""By how much surfaces reach beyond walls which they cross."""


def from_above(jump: Any) -> list[Any]:
    """Pressures at the ends of the third axis: a jump at the upper one, none at the lower one."""
    return [Traction("front", lambda x, t: ufl.as_vector([0.0, 0.0, -(jump(t) if callable(jump) else jump)])),
            Traction("back")]  # fmt: skip


def ramped(jump: float, end: float) -> Any:
    """A jump that rises smoothly until a time, or is there at once."""
    return lambda t: jump * 0.5 * (1.0 - ufl.cos(math.pi * ufl.min_value(t / end, 1.0))) if end else jump


def rectangle(
    corner: Sequence[float], one: Sequence[float], other: Sequence[float], h: float, degree: int = 2
) -> Patch:
    """Flat patch with elements of about a size."""
    elements = [max(1, math.ceil(float(np.linalg.norm(edge)) / h - 1e-9)) for edge in (one, other)]
    return shapes.parallelogram(corner, one, other, elements=elements, degrees=(degree, degree))


def pressure_error(flow: Flow, exact: Any, near: Any, fine: int = 8) -> float:
    """Norm in L2 of the error of the pressure, relative to that of one (collective).

    Args:
        flow: the flow.
        exact: function of points, shape (n, 3).
        near: function of points, how far they are from a jump of it, above which few points of a cell are enough.
        fine: points along an edge where the jump is near.
    """
    domain, V = flow.mesh.domain, flow.V
    corners = V.tabulate_dof_coordinates()[:, :3][compat.cell_dofs(V)[: compat.owned_cells(domain)]]
    volumes = np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1])) / 6.0
    close = near(corners.mean(axis=1)) < np.ptp(corners, axis=1).max()
    square = 0.0
    for cells, points in ((np.flatnonzero(close), fine), (np.flatnonzero(~close), 3)):
        barycentric = _lattice(points)
        for b in barycentric:
            at = np.broadcast_to(b, (len(cells), 4))
            error = _pressure(flow, cells, at) - exact(np.einsum("k,nki->ni", b, corners[cells]))
            square += float(volumes[cells] @ error**2) / len(barycentric)
    total, volume = domain.comm.allreduce(np.array([square, volumes.sum()]))
    return math.sqrt(total / volume)


def _lattice(points: int) -> FloatArray:
    """Barycentric coordinates of points that are spread evenly inside a tetrahedron."""
    every = np.array([k for k in np.ndindex(*(points,) * 3) if sum(k) < points])
    own = (every + 0.25) / points
    return np.column_stack([1.0 - own.sum(axis=1), own])


def _pressure(flow: Flow, cells: Any, barycentric: FloatArray) -> FloatArray:
    if flow.sides is not None:
        return np.asarray(flow.sides.at(cells, barycentric, None)[:, -1])
    values = flow.w.x.array.reshape(-1, 4)[compat.cell_dofs(flow.V)[cells], 3]
    return np.asarray(np.einsum("nk,nk->n", barycentric, values))


def along_normals(scene: Coupled) -> FloatArray:
    """The multiplier along the normals at the points."""
    return exchange.along_normals(scene.fsi.lam, scene.fsi.shell.normals())


def iterations(scene: Coupled) -> float:
    """Of the linear solver, per pass."""
    return sum(r.linear_iterations for r in scene.reports) / sum(r.passes for r in scene.reports)


# -- at rest ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class HeldSurface:
    """Unit cube with slip walls and a surface across it that is held, under a jump of pressure from above.

    The exact velocity is zero. A heart valve's numbers, started at once, are those of :data:`VALVE_NUMBERS`.

    Attributes:
        n: fluid cells along a side.
        dt: time step.
        steps: after the load.
        ramp: steps in which the load is raised; 0: it is there at once.
        rho: density.
        mu: viscosity.
        jump: of the pressure.
        height: of the surface above the lower side in the middle.
        curved: factor of the squares of the distances from the axis; 0: flat.
        slope: along the first two axes.
        weak: whether the fluid sticks to the walls, weakly.
        per_cell: elements of the surface per cell of the fluid.
        iterative: whether linear systems are solved by iterations however small, for their number.
    """

    n: int = 8
    dt: float = 1.0
    steps: int = 10
    ramp: int = 10
    rho: float = 1.0
    mu: float = 0.1
    jump: float = 1.0
    height: float = 0.43
    curved: float = 0.2
    slope: tuple[float, float] = (0.0, 0.0)
    weak: bool = False
    per_cell: float = 1.5
    iterative: bool = False

    def above(self, x: FloatArray) -> FloatArray:
        """How far points are above the surface along the third axis."""
        a, b = x[:, 0] - 0.5, x[:, 1] - 0.45
        bowl = self.curved * (a**2 + 0.6 * b**2) + self.slope[0] * a + self.slope[1] * b
        return np.asarray(x[:, 2] - self.height - bowl)

    def build(self, setting: Setting) -> Coupled:
        """The scene at rest, without its load."""
        mesh = box(COMM, (0.0,) * 3, (1.0,) * 3, (self.n,) * 3)
        walls = WeakVelocity(AROUND) if self.weak else Slip(AROUND)
        known = {"rho": self.rho, "mu": self.mu, "dt": self.dt, "scheme": generalized_alpha(0.5)}
        if self.iterative and setting.flow.solver is None:
            setting = replace(setting, flow=replace(setting.flow, solver=ITERATIVE))
        flow = immersed_flow(mesh, [walls, *from_above(ramped(self.jump, self.ramp * self.dt))], setting, **known)
        size = 1.0 + 2.0 * OVER
        flat = rectangle((-OVER, -OVER, 0.0), (size, 0.0, 0.0), (0.0, size, 0.0), 1.0 / (self.per_cell * self.n))
        points = flat.points - np.outer(self.above(flat.points), (0.0, 0.0, 1.0))
        return Coupled(flow, rigid(Patch.from_points(flat.bases, points)), setting)

    def run(self, setting: Setting = IN_SPACE) -> Found:
        """Load it, and let it rest.

        Figures: "velocity", the largest at a node, and "leak" through the surface, over the jump; "highest", the
        largest velocity on the way; "pressure", the error of the pressure in L2, "load", how far the mean of the
        multiplier is off where a cell or more from the walls, and "pattern", its largest difference from that, over the
        jump; "iterations" of the linear solver per pass.
        """
        scene = self.build(setting)
        speeds = []
        for _ in range(self.ramp + self.steps):
            report = scene.step()
            speeds.append(scene.fsi.fluid.speed())
        leak = report.monitors.leak if report.monitors else math.nan
        lam, W = along_normals(scene), scene.fsi.shell.quadrature.weights
        here = np.abs(scene.shell.positions[:, :2] - 0.5).max(axis=1) < 0.5 - 1.0 / self.n
        mean = float(np.average(lam[here], weights=W[here]))
        error = pressure_error(
            scene.flow, lambda x: np.where(self.above(x) > 0.0, self.jump, 0.0), lambda x: np.abs(self.above(x))
        )
        return scene.found(
            velocity=speeds[-1] / self.jump,
            highest=max(speeds) / self.jump,
            leak=leak / self.jump,
            pressure=error / self.jump,
            load=abs(mean) / self.jump - 1.0,
            pattern=float(np.abs(lam[here] - mean).max()) / self.jump,
            iterations=iterations(scene),
        )


VALVE_NUMBERS = HeldSurface(n=8, dt=1e-4, steps=200, ramp=0, mu=0.04, jump=1e5, iterative=True)
"""Centimetres, grams and seconds of a heart valve that closes at once."""


# -- a plate with free edges ------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Fence:
    """An elastic plate that stands on the lower wall of the channel (0, 2) x (0, 1) x (0, 1), three edges of it free.

    The stream comes in with speed and density one, which it reaches smoothly, and sticks to the lower wall alone.

    Attributes:
        n: fluid cells across.
        dt: time step.
        steps: number of them.
        mu: viscosity.
        place: of the plate along the channel.
        height: of the plate.
        width: of the plate.
        thickness: likewise.
        youngs_modulus: likewise.
        density: likewise.
        ramp: time within which the stream comes up.
        per_cell: elements of the plate per cell of the fluid, about.
    """

    n: int = 8
    dt: float = 0.02
    steps: int = 60
    mu: float = 0.02
    place: float = 0.713
    height: float = 0.55
    width: float = 0.55
    thickness: float = 0.05
    youngs_modulus: float = 3.2e4
    density: float = 10.0
    ramp: float = 0.3
    per_cell: float = 1.0

    def build(self, setting: Setting) -> Coupled:
        """The scene at rest."""
        mesh = box(COMM, (0.0,) * 3, (2.0, 1.0, 1.0), (2 * self.n, self.n, self.n))

        def stream(x: Any, t: Any) -> Any:
            return ufl.as_vector([0.5 * (1.0 - ufl.cos(math.pi * ufl.min_value(t / self.ramp, 1.0))), 0.0, 0.0])

        sides = [Slip(("top", "back", "front")), Velocity("bottom"), Velocity("left", stream), Traction("right")]
        known = {"rho": 1.0, "mu": self.mu, "dt": self.dt, "scheme": generalized_alpha(0.5)}
        flow = immersed_flow(mesh, sides, setting, **known)
        plate = rectangle(
            (self.place, 0.0, 0.5 * (1.0 - self.width)), (0.0, self.height, 0.0), (0.0, 0.0, self.width),
            1.0 / (self.per_cell * self.n),
        )  # fmt: skip
        material = StVenantKirchhoff(self.youngs_modulus, 0.3, self.thickness)
        return Coupled(flow, Shell(plate, material, density=self.density, clamped=("u0",)), setting)

    def run(self, setting: Setting = IN_SPACE) -> Found:
        """Let it bend.

        Figures: "tip", how far the middle of its upper edge has been moved along the channel at the end; "drag", the
        force on it then; "leak", the largest flow through it over that of the stream through its area; "wobble", the
        largest second difference of the tip's course in the second half of the steps over the tip.
        """
        scene = self.build(setting)
        for _ in range(self.steps):
            scene.step(lambda: float(scene.shell.at((1.0, 0.5)).displacement[0]))
        tip = np.array([report.measured for report in scene.reports])
        monitors = [report.monitors for report in scene.reports if report.monitors]
        late = np.diff(tip, 2)[len(tip) // 2 :]
        return scene.found(
            tip=tip[-1],
            drag=monitors[-1].force[0],
            leak=max(abs(each.leak) for each in monitors) / (self.width * self.height),
            wobble=float(np.abs(late).max(initial=0.0)) / abs(tip[-1]),
        )
