"""Scenes in space with known answers that judge what happens at an immersed surface, as those of ``plane.py`` do.

Lengths, densities and jumps of pressure are of the order of one but for those of a heart valve, and h is the size of
the fluid's cells, which are tetrahedra, six to a cube.

- :class:`HeldSurface`: a dome or a plate across a cube under a jump of pressure; nothing should flow.
- :class:`Sphere`: a closed membrane whose tension the pressure inside balances; nothing should move.
- :class:`Fence`: an elastic plate with three free edges in a stream.
- :class:`Slit`: two plates in one plane leave a gap, through which a jump of pressure drives the fluid.
- :class:`Hole`: a plate with a round hole, likewise.
- :class:`Pair`: two plates within one cell, which a pressure pushes against each other.
- :class:`Obstacle`: a rigid sphere in a stream; a mesh that fits it gives the drag.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import ufl
from plane import COMM, Coupled, Found, Setting, immersed_flow, rigid, slit_flow

from coudalfish.surface import exchange
from shnapr import ContactRecipe, LinearKernel, Shell, StVenantKirchhoff
from shnapr.supports import fixed
from tigar_x import compat, generalized_alpha
from tigar_x.compat import FloatArray
from tigar_x.fem.linear import gmres_ilu
from tigar_x.geometry import multipatch, shapes, surfaces
from tigar_x.geometry.gluing import glued
from tigar_x.geometry.multipatch import MultiPatch
from tigar_x.geometry.patch import Patch
from varmint import Flow, FlowOptions, PointValues, Slip, Traction, Velocity, WeakVelocity, box, flow_rate
from varmint.mesh.models import Region, from_gmsh, set_sizes
from varmint.quantities import BoundaryForce

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


def along_normals(scene: Coupled) -> FloatArray:
    """The multiplier along the normals at the points."""
    return exchange.along_normals(scene.fsi.lam, scene.fsi.shell.normals())


def iterations(scene: Coupled) -> float:
    """Of the linear solver, per pass."""
    return sum(r.linear_iterations for r in scene.reports) / sum(r.passes for r in scene.reports)


def ball(radius: float, center: Sequence[float], elements: int, *, quarter: bool = False) -> MultiPatch:
    """A sphere of six quadratic patches without poles, whose normals point outwards.

    Args:
        radius: of the sphere.
        center: likewise.
        elements: in half of a patch's side, an eighth of a circle.
        quarter: whether to leave out what is more than an element below the middle of the second and third axis.
    """
    h, patches = 1.0 / elements, []
    for axis, sign in ((0, 1), (0, -1), (1, 1), (2, 1), (1, -1), (2, -1)):
        if quarter and sign < 0 and axis:
            continue
        one, other = ((axis + k) % 3 for k in ((1, 2) if sign > 0 else (2, 1)))
        starts = [-h if quarter and k else -1.0 for k in (one, other)]

        def surface(u: FloatArray, v: FloatArray, at: Any = (axis, sign, one, other, starts)) -> FloatArray:
            k, s, i, j, low = at
            x = np.empty((3, len(u)))
            x[k] = s
            for m, parameter, start in ((i, u, low[0]), (j, v, low[1])):
                x[m] = np.tan(0.25 * math.pi * (start + (1.0 - start) * parameter))
            return np.asarray(np.asarray(center)[:, None] + radius * x / np.linalg.norm(x, axis=0))

        numbers = [round((1.0 - start) * elements) for start in starts]
        patches.append(shapes.interpolated(surface, shapes.uniform_bases([2, 2], numbers, 2)))
    return glued(*patches)


@dataclass(frozen=True)
class Sphere:
    """A closed membrane in the unit cube, full of fluid and at rest: its tension balances the pressure inside.

    The fluid starts without pressure, which is zero in a corner. The exact velocity is zero, and the pressure inside
    the jump.

    Attributes:
        n: fluid cells along a side.
        dt: time step.
        steps: number of them.
        mu: viscosity; the density is one.
        jump: of the pressure.
        radius: of the sphere.
        center: of the sphere, out of the mesh's symmetry.
        stiffness: E times the thickness over the tension.
        mass: per area.
        per_cell: elements per cell of the fluid, about.
    """

    n: int = 8
    dt: float = 0.05
    steps: int = 5
    mu: float = 0.1
    jump: float = 1.0
    radius: float = 0.3
    center: tuple[float, float, float] = (0.513, 0.507, 0.491)
    stiffness: float = 10.0
    mass: float = 0.1
    per_cell: float = 1.0

    def build(self, setting: Setting) -> Coupled:
        """The scene at its start."""
        mesh = box(COMM, (0.0,) * 3, (1.0,) * 3, (self.n,) * 3)
        known = {"rho": 1.0, "mu": self.mu, "dt": self.dt, "scheme": generalized_alpha(0.5)}
        flow = immersed_flow(mesh, [Velocity((*AROUND, "back", "front"))], setting, pin_at=(0.0,) * 3, **known)
        eighth = 0.25 * math.pi * self.radius
        membrane = ball(self.radius, self.center, max(2, round(eighth * self.per_cell * self.n)))
        tension, t = 0.5 * self.jump * self.radius, 0.01
        elastic = {"prestress": (tension, tension, 0.0), "bending": False}
        material = StVenantKirchhoff(self.stiffness * tension / t, 0.3, t, **elastic)
        return Coupled(flow, Shell(membrane, material, density=self.mass / t), setting)

    def run(self, setting: Setting = IN_SPACE) -> Found:
        """Let it go.

        Figures: "velocity", the largest at a node, times the viscosity over the tension; "volume", its change relative
        to the start; "inside", how far the pressure in the middle is off over the jump, "pressure", its error in L2
        likewise; "load" and "pattern" of the multiplier as of :class:`HeldSurface`; "roundness", smallest over largest
        distance from the centre.
        """
        scene = self.build(setting)
        start = self._volume(scene)
        for _ in range(self.steps):
            scene.step()
        lam, W = along_normals(scene), scene.fsi.shell.quadrature.weights
        mean, away = float(np.average(lam, weights=W)), np.linalg.norm(scene.shell.positions - self.center, axis=1)
        middle = PointValues(scene.flow, [self.center])()[0, 3]

        def outside(x: FloatArray) -> FloatArray:
            return np.asarray(np.linalg.norm(x - self.center, axis=1) - self.radius)

        error = pressure_error(
            scene.flow, lambda x: np.where(outside(x) < 0.0, self.jump, 0.0), lambda x: np.abs(outside(x))
        )
        return scene.found(
            velocity=scene.fsi.fluid.speed() * self.mu / (0.5 * self.jump * self.radius),
            volume=self._volume(scene) / start - 1.0,
            inside=middle / self.jump - 1.0,
            pressure=error / self.jump,
            load=abs(mean) / self.jump - 1.0,
            pattern=float(np.abs(lam - mean).max()) / self.jump,
            roundness=float(away.min() / away.max()),
        )

    def _volume(self, scene: Coupled) -> float:
        """By the triangles about the middles of its quadrilaterals."""
        x, quads = scene.shell.positions - self.center, scene.fsi.shell.sheets.cells
        corners = x[quads]
        return abs(float(sum(
            np.linalg.det(np.stack([corners[:, i], corners[:, j], corners.mean(axis=1)], axis=1)).sum()
            for i, j in ((0, 1), (1, 2), (2, 3), (3, 0))
        ))) / 6.0  # fmt: skip


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


# -- gaps -------------------------------------------------------------------------------------------------------------


def until_steady(scene: Coupled, through: Any, reference: float, cfl: float, steady: float, most: int) -> Any:
    """March to a flow rate that no longer changes, while the fluid passes three cells.

    Returns:
        Flow, leak and its change while the fluid passes a cell, over the reference.
    """
    (rate,), old, calm = compat.compile_forms(through), 0.0, 0.0
    while calm < 3.0 and len(scene.reports) < most:
        report = scene.step()
        new = compat.assemble_scalar(rate) / reference
        old, change = new, abs(new - old) / cfl
        calm = calm + cfl if change <= steady else 0.0
    leak = report.monitors.leak / reference if report.monitors else math.nan
    return {"flow": new, "leak": leak, "change": change}


@dataclass(frozen=True)
class Slit:
    """Two rigid plates in one plane across a channel (-1, 1) x (0, 1) with slip walls; between them is a gap.

    It is the slit of ``plane.py``, in space: the flow is the plane one, with the same references.

    Attributes:
        gap: see :class:`plane.Slit`, as for the others.
        reynolds: see there.
        cfl: see there.
        n: see there.
        layers: of cells along the third axis, in which the plates go from wall to wall.
        place: see there.
        middle: see there.
        per_cell: see there.
        steady: see there.
        most: see there.
    """

    gap: float = 1.0
    reynolds: float = 0.5
    cfl: float = 1.0
    n: int = 16
    layers: int = 1
    place: float = 0.37
    middle: float = 0.5
    per_cell: float = 2.0
    steady: float = 3e-3
    most: int = 150

    @property
    def reference(self) -> float:
        """Flow rate per depth for a jump and a density of one."""
        return slit_flow(self.gap / self.n, self.reynolds)

    def build(self, setting: Setting) -> Coupled:
        """The scene at rest, with the jump in its pressure and on the plates."""
        h = 1.0 / self.n
        depth = self.layers * h
        mesh = box(COMM, (-1.0, 0.0, 0.0), (1.0, 1.0, depth), (2 * self.n, self.n, self.layers))
        walls = Slip(("bottom", "top", "back", "front"))
        ends = [Traction("left", (1.0, 0.0, 0.0)), Traction("right"), walls]
        known = {"rho": 1.0, "mu": self.reference / self.reynolds, "scheme": generalized_alpha(0.0)}
        flow = immersed_flow(mesh, ends, setting, dt=self.cfl * h * self.gap * h / self.reference, **known)
        x, low, over = self.place * h, 0.5 + (self.middle - 0.5 * self.gap) * h, min(OVER, h)
        spans = (-over, low), (low + self.gap * h, 1.0 + over)
        across = (0.0, 0.0, depth + 2.0 * over)
        plates = [rectangle((x, a, -over), (0.0, b - a, 0.0), across, h / self.per_cell, degree=1) for a, b in spans]
        flow.start(pressure=lambda X, t: ufl.conditional(ufl.lt(X[0], x), 1.0, 0.0))
        return Coupled(flow, rigid(multipatch.disjoint(*plates)), setting, multiplier=1.0)

    def run(self, setting: Setting = IN_SPACE) -> Found:
        """Let it flow until it is steady.

        Figures: "flow" over the reference, "leak", what passes the plates according to the points on them, likewise,
        and "change", that of the flow at the end while the fluid passes a cell.
        """
        scene, reference = self.build(setting), self.reference * self.layers / self.n
        more = self.cfl, self.steady, self.most
        return scene.found(**until_steady(scene, flow_rate(scene.flow, "right"), reference, *more))


SLOWED = {20.0: 0.75}
"""Flow through a hole over that of slow flow, by :func:`fitted_flow` at some Reynolds numbers, within 1 %."""
ARRAY = 2.0 / (3.0 * math.pi) * 9.0336
"""By how much holes in a square array, whose walls are planes of symmetry, help each other, over (radius/side)^3.

The pressure of Sampson's flow far from its hole is at the plate ``mu Q/(pi r^3)`` on the one side and minus that on the
other, and 9.0336 is the sum of 1/r^3 over a square lattice of unit side, without its origin.
"""


@dataclass(frozen=True)
class Hole:
    """A rigid plate with a round hole across a channel (0, 1) x (0, 1) x (-1, 1) with slip walls.

    A jump of pressure of one drives the fluid, which starts at rest with the jump in its pressure and on the plate.
    Slow flow through a hole in a wall has the rate ``jump radius^3/(3 mu)`` (Sampson, doi:10.1098/rspl.1891.0009),
    which the images of the hole behind the walls raise a little, see ``ARRAY``; for faster flow see ``SLOWED``.

    Attributes:
        gap: diameter of the hole in cells of the fluid.
        reynolds: Reynolds number of the diameter and the mean velocity that slow flow would have; up to 1, where the
            flow counts as slow, or one of ``SLOWED``.
        cfl: time step times that mean velocity over the size of a cell.
        n: fluid cells across.
        length: of the channel to both sides.
        place: of the plate above the plane of the mesh in its middle, in cells of the fluid.
        middle: of the hole beside the middle of the channel, along the first two axes, likewise.
        per_cell: elements of the plate per cell of the fluid, about.
        steady: see :class:`Slit`.
        most: see there.
    """

    gap: float = 2.0
    reynolds: float = 0.5
    cfl: float = 1.0
    n: int = 16
    length: float = 0.5
    place: float = 0.37
    middle: tuple[float, float] = (0.13, 0.29)
    per_cell: float = 1.5
    steady: float = 3e-3
    most: int = 150

    @property
    def radius(self) -> float:
        """Of the hole."""
        return 0.5 * self.gap / self.n

    @property
    def mu(self) -> float:
        """Viscosity, from the mean velocity jump radius/(3 pi mu) of slow flow."""
        return self.radius * math.sqrt(2.0 / (3.0 * math.pi * self.reynolds))

    @property
    def reference(self) -> float:
        """Flow rate for a jump and a density of one."""
        return self.slow * (SLOWED[self.reynolds] if self.reynolds > 1.0 else 1.0)

    @property
    def slow(self) -> float:
        """Flow rate without inertia."""
        return self.radius**3 / (3.0 * self.mu) * (1.0 + ARRAY * self.radius**3)

    def build(self, setting: Setting) -> Coupled:
        """The scene at its start."""
        h, R, long = 1.0 / self.n, self.radius, round(self.length * self.n)
        mesh = box(COMM, (0.0, 0.0, -long * h), (1.0, 1.0, long * h), (self.n, self.n, 2 * long))
        known = {"rho": 1.0, "mu": self.mu, "scheme": generalized_alpha(0.0)}
        mean = R / (3.0 * math.pi * self.mu)
        flow = immersed_flow(mesh, [Slip(AROUND), *from_above(1.0)], setting, dt=self.cfl * h / mean, **known)
        center = (0.5 + self.middle[0] * h, 0.5 + self.middle[1] * h, self.place * h)
        outer = 0.75 + max(map(abs, self.middle)) * h * math.sqrt(2.0)
        elements = (round(self.per_cell * (outer - R) / h), max(8, round(self.per_cell * math.pi * (outer + R) / h)))
        plate = surfaces.annulus(inner=R, outer=outer, center=center, elements=elements, degrees=(2, 2))
        flow.start(pressure=lambda X, t: ufl.conditional(ufl.gt(X[2], center[2]), 1.0, 0.0))
        return Coupled(flow, rigid(glued(plate, within=True)), setting, multiplier=-1.0)  # its normals point up

    def run(self, setting: Setting = IN_SPACE) -> Found:
        """Let it flow until it is steady.

        Figures: "flow" over the reference, "discharge", the flow over ``area sqrt(2 jump/rho)``, "leak", what passes
        the plate according to the points on it over the reference, and "change", that of the flow at the end while
        the fluid passes a cell.
        """
        scene = self.build(setting)
        found = until_steady(scene, flow_rate(scene.flow, "back"), self.reference, self.cfl, self.steady, self.most)
        area = math.pi * self.radius**2
        return scene.found(discharge=found["flow"] * self.reference / (area * math.sqrt(2.0)), **found)


# -- two surfaces in one cell -----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Pair:
    """Two plates across the unit cube with slip walls, less than a cell apart; a pressure acts on the upper one.

    The lower plate is held. The upper one is held as well, or moves along the third axis alone and rests on contact,
    which balances the jump at the distance from which it starts. Then the exact velocity is zero, and the fluid
    between the plates has no pressure.

    Attributes:
        apart: distance of the plates, in cells of the fluid.
        n: fluid cells along a side.
        dt: time step.
        steps: number of them.
        rho: density.
        mu: viscosity.
        jump: of the pressure.
        touching: whether the upper plate moves and contact holds it.
        place: of the lower plate above the mesh's plane below the middle, in cells of the fluid.
        slope: of both along the first two axes.
        thickness: of the plates.
        youngs_modulus: over the jump.
        density: of the plates.
    """

    apart: float = 0.5
    n: int = 8
    dt: float = 1e-4
    steps: int = 50
    rho: float = 1.0
    mu: float = 0.04
    jump: float = 1e5
    touching: bool = False
    place: float = 0.3
    slope: tuple[float, float] = (0.0, 0.0)
    thickness: float = 0.04
    youngs_modulus: float = 1e3
    density: float = 1.0

    def build(self, setting: Setting) -> Coupled:
        """The scene at rest, without its load."""
        h = 1.0 / self.n
        gap = self.apart * h
        mesh = box(COMM, (0.0,) * 3, (1.0,) * 3, (self.n,) * 3)
        known = {"rho": self.rho, "mu": self.mu, "dt": self.dt, "scheme": generalized_alpha(0.5)}
        if setting.flow.solver is None:
            setting = replace(setting, flow=replace(setting.flow, solver=ITERATIVE))
        flow = immersed_flow(mesh, [Slip(AROUND), *from_above(self.jump)], setting, **known)
        low, (a, b) = (self.n // 2 - 1 + self.place) * h, self.slope
        # twice as many points as the range of contact needs, which is as long as the plates are apart, and a third more
        size = min(h, gap) if self.touching else h
        plates = [
            rectangle((0.0, 0.0, z - 0.5 * (a + b)), (1.0, 0.0, a), (0.0, 1.0, b), size) for z in (low, low + gap)
        ]
        geometry = multipatch.disjoint(*plates)
        material = StVenantKirchhoff(self.youngs_modulus * self.jump, 0.3, self.thickness)
        if not self.touching:
            return Coupled(flow, rigid(geometry), setting)
        reach = gap / 0.75
        # plates at a distance d press with pi k d (range - d)^2
        contact = ContactRecipe(
            LinearKernel(reach, self.jump / (math.pi * gap * (reach - gap) ** 2)), r_self=1.3 * reach, spacing=None
        )
        upper = fixed(geometry, patch=1)
        held = np.union1d(fixed(geometry, patch=0), upper[upper % 3 != 2])
        return Coupled(flow, Shell(geometry, material, density=self.density, zero_dofs=held, contact=contact), setting)

    def run(self, setting: Setting = IN_SPACE) -> Found:
        """Let the pressure act.

        Figures: "velocity", the largest at a node at the end, and "highest", the largest on the way; "leak", the sum
        of the flows through both; "force" of the fluid on both along the third axis, how far it is off, over the jump;
        "distance" of the middles over that at the start, less one; "contact", how far its load is off, likewise, or
        nan without it; "iterations" of the linear solver per pass.
        """
        scene = self.build(setting)
        speeds = []
        for _ in range(self.steps):
            report = scene.step()
            speeds.append(scene.fsi.fluid.speed())
        monitors, touch = report.monitors, report.contact
        x = scene.shell.positions.reshape(2, -1, 3)[..., 2].mean(axis=1)
        return scene.found(
            velocity=speeds[-1],
            highest=max(speeds),
            leak=monitors.leak if monitors else math.nan,
            force=abs(monitors.force[2]) / self.jump - 1.0 if monitors else math.nan,
            distance=float(abs(x[1] - x[0])) * self.n / self.apart - 1.0,
            contact=touch.load / self.jump - 1.0 if touch else math.nan,
            iterations=iterations(scene),
        )


# -- a body in a stream -----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Obstacle:
    """A rigid sphere of diameter one on the axis of the channel (-1.5, 2.5) x (-1, 1) x (-1, 1) with slip walls.

    A quarter of it is computed, with planes of symmetry through the axis. Fluid of density one comes in with speed one.

    Attributes:
        n: fluid cells in the diameter.
        dt: time step.
        until: end, at which the flow counts as steady.
        before: time step with which it is marched to its steady state before; None: that of the run.
        reynolds: Reynolds number of the diameter.
        place: of the sphere's middle along the channel, in cells of the fluid.
        per_cell: elements of the sphere per cell of the fluid, about.
    """

    n: int = 16
    dt: float = 0.1
    until: float = 6.0
    before: float | None = None
    reynolds: float = 20.0
    place: float = 0.37
    per_cell: float = 1.0

    def build(self, setting: Setting) -> Coupled:
        """The scene at its start, in a uniform stream."""
        mesh = box(COMM, (-1.5, 0.0, 0.0), (2.5, 1.0, 1.0), (4 * self.n, self.n, self.n))
        dt = self.dt if self.before is None else self.before
        known = {"rho": 1.0, "mu": 1.0 / self.reynolds, "dt": dt, "scheme": generalized_alpha(0.0)}
        sides = [Velocity("left", (1.0, 0.0, 0.0)), Slip(("bottom", "top", "back", "front")), Traction("right")]
        flow = immersed_flow(mesh, sides, setting, **known)
        flow.start((1.0, 0.0, 0.0))
        elements = max(2, round(0.125 * math.pi * self.per_cell * self.n))
        return Coupled(flow, rigid(ball(0.5, (self.place / self.n, 0.0, 0.0), elements, quarter=True)), setting)

    def run(self, setting: Setting = IN_SPACE) -> Found:
        """Let it flow.

        Figures: "drag" of the whole sphere over that of a unit square in the stream, ``2 F/(rho U^2 D^2)``; "change",
        that in the last twentieth of the run relative to it; "slip", the root mean square of what passes the sphere.
        """
        scene, until = self.build(setting), self.until
        if self.before is not None:
            for _ in range(round(until / self.before)):
                scene.step()
            scene.fsi.step_size, until = self.dt, 0.1 * until
        for _ in range(round(until / self.dt)):
            scene.step()
        end = scene.reports[-1].t
        drag = [8.0 * report.monitors.force[0] for report in scene.reports if report.monitors]
        late = [d for d, report in zip(drag, scene.reports, strict=True) if report.t >= end - 0.05 * self.until]
        monitors = scene.reports[-1].monitors
        return scene.found(
            drag=drag[-1],
            change=float(np.ptp(late)) / drag[-1],
            slip=monitors.normal_slip_rms if monitors else math.nan,
        )


# -- meshes that fit --------------------------------------------------------------------------------------------------


def fitted_drag(size: float, *, reynolds: float = 20.0, degree: int = 2, around: float = 0.25) -> dict[str, float]:
    """Drag of :class:`Obstacle` in steady flow on a mesh that fits the sphere, by gmsh.

    Args:
        size: of the cells far away.
        reynolds: see there.
        degree: of velocity and pressure.
        around: size of the cells at the sphere over that far away.
    """

    def build(gmsh: Any) -> None:
        occ = gmsh.model.occ
        channel, body = occ.addBox(-1.5, 0.0, 0.0, 4.0, 1.0, 1.0), occ.addSphere(0.0, 0.0, 0.0, 0.5)
        occ.cut([(3, channel)], [(3, body)])
        centre = {"Radius": 0.5, "XCenter": 0.0, "YCenter": 0.0, "ZCenter": 0.0}
        _meshed(gmsh, 0, size, Region("Ball", around * size, centre))

    sides = [Velocity("start", (1.0, 0.0, 0.0)), Velocity("body"), Slip("walls"), Traction("end")]
    flow = Flow(from_gmsh(COMM, build, 3), sides, rho=1.0, mu=1.0 / reynolds, degree=degree)
    flow.start((1.0, 0.0, 0.0))
    flow.solve()
    return {"drag": 8.0 * float(BoundaryForce(flow, "body")()[0]), "unknowns": flow.unknowns}


def fitted_flow(hole: Hole, *, around: float = 0.25, thickness: float = 0.05, degree: int = 2) -> dict[str, float]:
    """Flow of :class:`Hole`, over that of slow flow through a thin plate, on a mesh that fits a plate, by gmsh.

    Args:
        hole: which; in the middle of the channel.
        around: size of the cells at the hole over its radius.
        thickness: of the plate over the radius.
        degree: of velocity and pressure.
    """
    R, L = hole.radius, hole.length

    def build(gmsh: Any) -> None:
        occ, half = gmsh.model.occ, 0.5 * thickness * R
        channel = occ.addBox(0.0, 0.0, -L, 0.5, 0.5, 2.0 * L)
        plate = occ.addBox(0.0, 0.0, -half, 0.5, 0.5, 2.0 * half)
        way = occ.addCylinder(0.0, 0.0, -half, 0.0, 0.0, 2.0 * half, R)
        solid, _ = occ.cut([(3, plate)], [(3, way)])
        occ.cut([(3, channel)], solid)
        centre = {"Radius": 1.2 * R, "XCenter": 0.0, "YCenter": 0.0, "ZCenter": 0.0}
        _meshed(gmsh, 2, 0.12, Region("Ball", around * R, centre))

    ends = [Traction("end", (0.0, 0.0, -1.0)), Traction("start"), Slip("walls"), Velocity("body")]
    flow = Flow(from_gmsh(COMM, build, 3), ends, rho=1.0, mu=hole.mu, degree=degree)
    flow.solve()
    (rate,) = compat.compile_forms(flow_rate(flow, "start"))
    return {"flow": 4.0 * compat.assemble_scalar(rate) / hole.slow, "unknowns": flow.unknowns}


def _meshed(gmsh: Any, axis: int, size: float, *regions: Region) -> None:
    """Name the sides of a quarter of a channel along an axis with a body in it, and say how large cells are."""
    model = gmsh.model
    model.occ.synchronize()
    low, high = np.split(np.array(model.getBoundingBox(-1, -1)), 2)
    groups: dict[str, list[int]] = {"start": [], "end": [], "walls": [], "body": []}
    for _, tag in model.getEntities(2):
        box_of = np.split(np.array(model.getBoundingBox(2, tag)), 2)
        on_side = [np.abs(np.array(box_of) - side[k]).max(axis=0)[k] < 1e-4 for side in (low, high) for k in range(3)]
        flat = np.reshape(on_side, (2, 3))
        name = "start" if flat[0, axis] else "end" if flat[1, axis] else "walls" if flat.any() else "body"
        groups[name].append(tag)
    for name, tags in groups.items():
        model.setPhysicalName(2, model.addPhysicalGroup(2, tags), name)
    model.addPhysicalGroup(3, [tag for _, tag in model.getEntities(3)])
    set_sizes(gmsh, size, regions)
