"""A leaflet of a heart valve that closes against two rigid planes.

Pressure acts from downstream on one of three equal leaflets, pinned along its posts and its attached edge. By symmetry
its neighbours are two planes through the axis, at 60 degrees to both sides of its middle. Centimetres, grams, seconds.

The load and all moduli are those of the demonstration of contact with planes that accompanies D. Kamensky,
doi:10.1016/j.camwa.2020.01.023; the leaflet is that of :func:`tigar_x.geometry.surfaces.leaflet`.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import ufl

from shnapr.conditions import Pressure
from shnapr.kinematics import midsurface
from shnapr.loads import follower_pressure
from shnapr.planes import RigidPlane, plane_contact
from shnapr.shell.options import ShellOptions
from shnapr.shell.shell import Shell
from shnapr.stress import resultants
from shnapr.svk import StVenantKirchhoff
from tigar_x import checks, compat
from tigar_x.compat import FloatArray
from tigar_x.fem.line_search import LineSearch
from tigar_x.fem.load_stepping import StepControl
from tigar_x.geometry import surfaces
from tigar_x.run.history import Columns
from tigar_x.run.loading import LoadPath, follow
from tigar_x.splines import sampling
from tigar_x.splines.measures import SplineMeasure

INDEX = 1
"""The leaflet with its middle at the azimuth of 180 degrees."""
NORMALS = ((-(3**0.5) / 2, -0.5, 0.0), (-(3**0.5) / 2, 0.5, 0.0))
"""Of the planes, to where the leaflet may be."""


@dataclass(frozen=True)
class Leaflet:
    """The leaflet, its load and its mesh.

    Attributes:
        degree: of the splines, 2 or more.
        elements: from post to post; 0.8 times as many from edge to edge.
        pressure: difference of pressure across the leaflet [dyn/cm^2].
        thickness: of the leaflet [cm].
        stiffness: pressure of the planes by depth [dyn/cm^3].
        smoothing: distance over which the planes' pressure sets in [cm]; 0: abruptly.
        tolerance: of Newton's method, by the norm of the full load.
    """

    degree: int = 3
    elements: int = 20
    pressure: float = 1e5
    thickness: float = 0.03
    stiffness: float = 1e9
    smoothing: float = 0.0
    tolerance: float = 1e-9

    def __post_init__(self) -> None:
        checks.whole("degree", self.degree, 2)
        checks.whole("elements", self.elements, 2)
        for name in ("pressure", "thickness", "stiffness"):
            checks.positive(name, getattr(self, name))
        checks.not_negative("smoothing", self.smoothing)


class Closing:
    """A leaflet between its planes, open at first.

    Args:
        leaflet: its data.

    Attributes:
        leaflet: as given.
        shell: the leaflet, u from post to post and v from the free to the attached edge.
    """

    def __init__(self, leaflet: Leaflet) -> None:
        self.leaflet, n, p = leaflet, leaflet.elements, leaflet.degree
        patch = surfaces.leaflet(INDEX, elements=(n, max(2, round(0.8 * n))), degrees=(p, p))
        origin, stiffness, smoothing = (0.0, 0.0, 0.0), leaflet.stiffness, leaflet.smoothing
        self.shell = Shell(
            patch,
            StVenantKirchhoff(1e7, 0.45, leaflet.thickness),
            pinned=("post_0", "post_1", "attachment"),
            loads=[Pressure(leaflet.pressure), *(RigidPlane(origin, m, stiffness, smoothing) for m in NORMALS)],
            options=ShellOptions(leaflet.tolerance, 0.0, 40, LineSearch()),
        )
        spline, y = self.shell.spline, self.shell.y
        self._edge, self._middle = (sampling.side(spline, "v0", n, patch=0) for n in (401, 3))
        x, current = spline.F + y, midsurface(spline, y)
        area = SplineMeasure(ufl.sqrt(ufl.det(current.metric)), spline.dx.measure)
        self._planes = [plane for plane in self.shell.loads if isinstance(plane, RigidPlane)]
        pairs = [(plane, -ufl.dot(x, ufl.as_vector(plane.normal))) for plane in self._planes]
        force = sum(plane.traction(depth) for plane, depth in pairs) * area
        moment = sum(plane.traction(depth) * depth for plane, depth in pairs) * area
        self._contact = compat.compile_forms(force, moment)

    def close(self, *, step: float = 0.1, **more: Any) -> LoadPath:
        """Raise the pressure, in steps of pseudo-time that are cut where Newton's method fails.

        Args:
            step: first step of the pseudo-time, which ends at 1.
            more: see :func:`tigar_x.run.loading.follow`.

        Returns:
            The way, with the pressure, the elastic energy, radius and height of the middle of the free edge, the
            smallest distances from both planes, the sum of their pressures and the share of the edge that touches.
        """
        checks.positive("step", step)
        columns: Columns = {
            "pressure": lambda report: self.leaflet.pressure * report.t,
            "energy": lambda: self.shell.energies().elastic,
            ("centre_radius", "centre_z"): self._centre,
            ("distance_1", "distance_2"): lambda: self.distances(self.shell.positions).min(axis=0),
            "contact_force": lambda: compat.assemble_scalar(self._contact[0]),
            "touching": self._touching,
        }
        return follow(self.shell.solve, columns, step=step, control=StepControl(1e-4 * step, step), **more)

    def _centre(self) -> tuple[float, float]:
        x, y, z = self._middle.positions(self.shell.y)[1]
        return float(np.hypot(x, y)), float(z)

    def _touching(self) -> float:
        nearest = self.distances(self._edge.positions(self.shell.y)).min(axis=1)
        return float(np.mean(nearest < 0.1 * self.leaflet.thickness))

    def distances(self, x: FloatArray) -> FloatArray:
        """Distances of points from the two planes, shape (points, 2)."""
        return np.asarray(x @ np.transpose(NORMALS))

    def nearest(self) -> FloatArray:
        """Distances of the nodes from the nearer plane, shape (nodes,)."""
        return np.asarray(self.distances(self.shell.positions).min(axis=1))

    def mean_depth(self) -> float:
        """Mean of the depth in the planes, weighted by their pressure; 0 without contact."""
        force, moment = map(compat.assemble_scalar, self._contact)
        return moment / force if force else 0.0

    def asymmetry(self) -> float:
        """Largest distance between the leaflet and its mirror image; unit: length."""
        x = sampling.net(self.shell.spline, 17, patch=0).positions(self.shell.y)
        return float(np.abs(x - x[::-1] * (1, -1, 1)).max())

    def tension(self) -> Any:
        """Largest membrane force, UFL; unit: force/length."""
        # not a stress: strains at the upper corners are beyond those for which this material has a thickness
        n = resultants(self.shell.spline, self.shell.material, self.shell.y).n
        return ufl.tr(n) / 2 + ufl.sqrt((n[0, 0] - n[1, 1]) ** 2 / 4 + n[0, 1] ** 2)

    def forces(self, factor: float | None = None) -> "Forces":
        """Resultants of all that acts on the leaflet.

        Args:
            factor: of the pressure; None: that of the present state.
        """
        spline, y, z = self.shell.spline, self.shell.y, ufl.TestFunction(self.shell.spline.V)
        P = compat.Constant(spline.mesh, self.leaflet.pressure * (self.shell.load_factor if factor is None else factor))
        ds, x = spline.ds(), spline.F + y
        along_edge = spline.parametric_grad(x) * ufl.as_vector([-ds.normal[1], ds.normal[0]])  # counter-clockwise
        boundary = P / 2 * ufl.dot(ufl.cross(x, along_edge), z) * ds.measure
        contact = sum(plane_contact(spline, plane, y, z) for plane in self._planes)
        parts = self.shell.residual, follower_pressure(spline, P, y, z), contact, boundary
        residual, on_it, from_planes, from_edge = map(self._extracted, compat.compile_forms(*parts))
        held = np.zeros(residual.size, dtype=bool)
        held[spline.zero_dofs] = True
        reaction = np.where(held.reshape(-1, 3), residual, 0.0).sum(axis=0)
        return Forces(reaction, -on_it.sum(axis=0), -from_planes.sum(axis=0), from_edge.sum(axis=0))

    def _extracted(self, form: Any) -> FloatArray:
        """Forces on the control points of a form that is linear in its test function, shape (functions, 3)."""
        nodal, result = compat.create_vector(self.shell.spline.V), self.shell.spline.M.createVecRight()
        compat.assemble_vector(nodal, form)
        self.shell.spline.M.multTranspose(nodal, result)
        return np.array(result.array_r).reshape(-1, 3)


@dataclass(frozen=True)
class Forces:
    """Resultants of the forces on the leaflet; ``boundary`` is that of the pressure from the boundary alone."""

    reaction: FloatArray
    pressure: FloatArray
    contact: FloatArray
    boundary: FloatArray

    @property
    def imbalance(self) -> float:
        """Norm of the sum, by that of the pressure."""
        return float(np.linalg.norm(self.reaction + self.pressure + self.contact) / np.linalg.norm(self.pressure))

    @property
    def boundary_error(self) -> float:
        """Difference of the two resultants of the pressure, by its norm."""
        return float(np.linalg.norm(self.boundary - self.pressure) / np.linalg.norm(self.pressure))
