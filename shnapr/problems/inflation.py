"""A clamped square plate under a pressure that follows it: large strains of incompressible shells.

The plate [-1, 1]^2 lies in the plane x_3 = 0 and is clamped at all edges. The pressure works on the volume V that the
plate encloses with its reference plane, so in equilibrium its elastic energy is int P dV along the whole path.

By default the material is neo-Hookean, with the data of the demonstration that accompanies D. Kamensky,
doi:10.1016/j.camwa.2020.01.023; the other one is bovine pericardium of Lee and Sacks under the pressure that closes a
heart valve, in centimetres, grams and seconds.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import ufl
from mpi4py import MPI
from dolfinx import fem

from shnapr.conditions import Pressure
from shnapr.hyperelastic import Hyperelastic, lee_sacks, neo_hookean
from shnapr.kinematics import area_vector, midsurface
from shnapr.shell.options import ShellOptions
from shnapr.shell.shell import Shell
from shnapr.supports import clamped
from tigar_x import checks, compat
from tigar_x.compat import FloatArray
from tigar_x.fem.line_search import LineSearch
from tigar_x.fem.load_stepping import StepControl
from tigar_x.geometry import shapes
from tigar_x.run.history import Columns
from tigar_x.run.loading import LoadPath, follow
from tigar_x.splines.constraints import symmetry
from tigar_x.splines.spline import ExtractedSpline

HALF = 1.0
"""Half the side of the plate."""
MIDDLE = np.linspace(-HALF, HALF, 81)[:, None] * (1.0, 0.0)
"""Points on the line x_2 = 0."""


@dataclass(frozen=True)
class Case:
    """A material with its thickness and the pressure to reach; consistent units."""

    psi: Callable[..., Any]
    moduli: dict[str, float]
    thickness: float
    pressure: float


CASES = {
    "neo-hookean": Case(neo_hookean, {"mu": 1e4}, thickness=0.03, pressure=5e2),
    "lee-sacks": Case(lee_sacks, {"c0": 676080.0, "c1": 132848.0, "c2": 38.1878}, thickness=0.0386, pressure=1e5),
}


@dataclass(frozen=True)
class Plate:
    """The plate and how it is discretised and loaded.

    Attributes:
        material: neo-Hookean, or the exponential one of Lee and Sacks.
        degree: of the splines, 2 or more.
        elements: per side of the plate.
        points: Gauss points through the thickness.
        pressure: to reach; default: 5e2 for neo-hookean, 1e5 for lee-sacks.
        ramp: exponent r of the load, pressure t^r; more than 1 makes the first, hardest steps smaller.
        tolerance: of Newton's method, by the norm of the full load.
        quarter: whether to compute a quarter of the plate with conditions of symmetry.
    """

    material: Literal["neo-hookean", "lee-sacks"] = "neo-hookean"
    degree: int = 2
    elements: int = 16
    points: int = 4
    pressure: float | None = None
    ramp: float = 2.0
    tolerance: float = 1e-7
    quarter: bool = False

    def __post_init__(self) -> None:
        checks.choice("material", self.material, tuple(CASES))
        checks.whole("degree", self.degree, 2)
        checks.whole("elements", self.elements, 2)
        checks.positive("ramp", self.ramp)
        if self.pressure is not None:
            checks.positive("pressure", self.pressure)


class Inflated:
    """A plate, flat at first.

    Args:
        plate: its data.

    Attributes:
        plate: as given.
        shell: the plate, or a quarter of it.
    """

    def __init__(self, plate: Plate) -> None:
        self.plate, case, p = plate, CASES[plate.material], plate.degree
        side, n = (HALF, plate.elements // 2) if plate.quarter else (2 * HALF, plate.elements)
        centre = (HALF / 2, HALF / 2, 0.0) if plate.quarter else (0.0, 0.0, 0.0)
        patch = shapes.plate(lengths=(side, side), center=centre, elements=(n, n), degrees=(p, p))
        held: dict[str, Any] = {"zero_dofs": clamped(patch, *(("u1", "v1") if plate.quarter else patch.open_sides))}
        if plate.quarter:
            held["constraints"] = (symmetry(patch, "u0", 0), symmetry(patch, "v0", 1))
        # with 3 p - 1 the pressure and the volume are integrated exactly
        spline = ExtractedSpline(patch, MPI.COMM_SELF, quadrature_degree=3 * p - 1, **held)
        self._full = case.pressure if plate.pressure is None else plate.pressure
        P, r, h = (compat.Constant(spline.mesh, float(value)) for value in (self._full, plate.ramp, case.thickness))
        psi = case.psi(**{name: compat.Constant(spline.mesh, value) for name, value in case.moduli.items()})
        self.shell = Shell(
            spline,
            Hyperelastic(psi, h, plate.points),
            loads=[Pressure(lambda x, t: P * t**r)],
            options=ShellOptions(plate.tolerance, 0.0, 30, LineSearch()),
        )
        x = spline.F + self.shell.y
        (self._volume,) = compat.compile_forms(x[2] * area_vector(spline.parametric_grad(x))[2] * spline.dx.measure)

    def inflate(self, *, step: float = 0.05, growth: float = 1.5, **more: Any) -> LoadPath:
        """Raise the pressure; its history has ``pressure``, ``height``, ``volume`` and ``energy``.

        Args:
            step: first step of the pseudo-time, which ends at 1.
            growth: factor by which an easy step grows, up to twice the first; 1: equal steps.
            more: see :func:`tigar_x.run.loading.follow`.
        """
        parts = 4 if self.plate.quarter else 1
        columns: Columns = {
            "pressure": lambda report: self._full * report.t**self.plate.ramp,
            "height": lambda: float(self.position(np.zeros((1, 2)))[0, 2]),
            "volume": lambda: parts * compat.assemble_scalar(self._volume),
            "energy": lambda: parts * self.shell.energies().elastic,
        }
        control = StepControl(smallest=1e-5, largest=2.0 * checks.positive("step", step), growth=growth)
        return follow(self.shell.solve, columns, step=step, control=control, extrapolate=True, **more)

    def position(self, X: FloatArray) -> FloatArray:
        """Where points of the plate are now; X has the shape (m, 2), the result (m, 3)."""
        quarter = self.plate.quarter
        xi, signs = (np.abs(X) / HALF, np.sign(X)) if quarter else ((X + HALF) / (2 * HALF), np.ones_like(X))
        y = self.shell.spline.evaluate(self.shell.y, xi)
        y[:, :2] *= signs
        return np.column_stack([X, np.zeros(len(X))]) + y

    def sections_into(self, sections: list[FloatArray]) -> Callable[[float], None]:
        """What appends the positions on the line x_2 = 0, shape (81, 3), to a list, for every state."""
        return lambda t: sections.append(self.position(MIDDLE))

    def asymmetry(self) -> float:
        """Largest distance between the plate and its mirror images, by its height."""
        line = np.linspace(-HALF, HALF, 17)
        x = self.position(np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)).reshape(17, 17, 3)
        images = (x[:, ::-1] * (-1, 1, 1), x[::-1] * (1, -1, 1), x.swapaxes(0, 1)[..., (1, 0, 2)])
        return float(max(np.abs(x - image).max() for image in images) / x[8, 8, 2])

    def stretches(self) -> tuple[Any, Any]:
        """Largest principal stretch of the midsurface, and thickness by its reference value, as UFL expressions."""
        spline = self.shell.spline
        C = ufl.inv(midsurface(spline).metric) * midsurface(spline, self.shell.y).metric
        half, det = ufl.tr(C) / 2, ufl.det(C)
        return ufl.sqrt(half + ufl.sqrt(ufl.max_value(half**2 - det, 0.0))), 1 / ufl.sqrt(det)

    def at_nodes(self) -> FloatArray:
        """Largest stretch and thickness ratio at the nodes, shape (nodes, 2)."""
        fields = fem.Function(self.shell.spline.free(2).V)
        compat.interpolate(fields, ufl.as_vector(self.stretches()))
        return np.asarray(fields.x.array.reshape(-1, 2))


def imbalance(path: LoadPath) -> float:
    """Error of W = int P dV by W, from the cubic spline P(V) through the path."""
    from scipy.interpolate import CubicSpline

    pressure, volume, energy = (path.history[name] for name in ("pressure", "volume", "energy"))
    return float(abs(CubicSpline(volume, pressure).integrate(0.0, volume[-1]) / energy[-1] - 1.0))
