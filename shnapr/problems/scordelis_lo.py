"""The Scordelis-Lo roof: part of a cylinder under its own weight, on diaphragms at its curved ends.

Source: J. Kiendl, "Isogeometric analysis and shape optimal design of shell structures", PhD thesis, TU Muenchen, 2011,
section 6.2.1.
"""

from dataclasses import dataclass
from math import pi
from typing import Any, Literal

import numpy as np
import ufl

from shnapr.conditions import DeadLoad
from shnapr.shell.shell import Shell
from shnapr.stress import resultants
from shnapr.supports import pinned
from shnapr.svk import StVenantKirchhoff
from tigar_x import checks
from tigar_x.geometry import surfaces
from tigar_x.geometry.functions import Cells
from tigar_x.run.progress import Stopwatch
from tigar_x.splines.spline import ExtractedSpline

PUBLISHED = 0.3006
"""How far the midpoint of a straight edge sinks by the linear theory of Kirchhoff and Love."""
STAGES = ("geometry and extraction", "forms", "M^T A M", "solve")


@dataclass(frozen=True)
class RoofData:
    """The problem's data; consistent units."""

    radius: float = 25.0
    length: float = 50.0
    half_angle: float = 40.0 * pi / 180.0
    thickness: float = 0.25
    youngs_modulus: float = 4.32e8
    poisson_ratio: float = 0.0
    load: float = 90.0


@dataclass(frozen=True)
class Mesh:
    """The roof's discretisation.

    Attributes:
        degree: of the splines, 2 or more.
        elements: per side of the whole roof.
        cells: quadrilaterals, or triangles (of twice the degree) as finite elements under the splines.
        quadrature: degree of all integrals; default: twice that of the splines.
    """

    degree: int = 3
    elements: int = 16
    cells: Literal["quad", "tri"] = "quad"
    quadrature: int | None = None

    def spline(self, data: RoofData) -> ExtractedSpline:
        """The midsurface, u along the axis and v around, on its diaphragms and held against sliding by one function."""
        p, n = checks.whole("degree", self.degree, 2), checks.whole("elements", self.elements, 1)
        size = {"radius": data.radius, "length": data.length, "angle": 2 * data.half_angle}
        patch = surfaces.cylinder_panel(**size, elements=(n, n), degrees=(p, p))
        diaphragms, corner = (
            pinned(patch, "end_0", "end_1", components=(1, 2)),
            patch.dofs(patch.side("end_0")[:1], (0,)),
        )
        cells: Cells = "tensor" if self.cells == "quad" else "simplex"
        zero_dofs = np.concatenate([diaphragms, corner])
        return ExtractedSpline(patch, cells=cells, quadrature_degree=self.quadrature, zero_dofs=zero_dofs)


class Roof:
    """The loaded roof as a shell, with the CPU time of every stage."""

    def __init__(self, mesh: Mesh, data: RoofData = RoofData()) -> None:
        self.costs = {stage: Stopwatch() for stage in STAGES}
        with self.costs["geometry and extraction"]:
            spline = mesh.spline(data)
        with self.costs["forms"]:
            material = StVenantKirchhoff(data.youngs_modulus, data.poisson_ratio, data.thickness)
            self.shell = Shell(spline, material, loads=[DeadLoad((0.0, 0.0, -data.load))])
            self.system = self.shell.system

    def solve(self) -> None:
        """Carry the load in one increment from rest."""
        with self.costs["forms"]:
            self.system.assemble_residual()
            self.system.integrate_tangent()
        with self.costs["M^T A M"]:
            self.system.extract_tangent()
        with self.costs["solve"]:
            self.system.subtract(self.system.solve())

    @property
    def sinking(self) -> float:
        """How far the midpoint of a straight edge moves down."""
        return float(-self.shell.at("v1").displacement[2])

    def resultants(self) -> tuple[Any, Any]:
        """Membrane forces and bending moments of the linear theory as UFL expressions, shape (2, 2) each."""
        rest = self.shell.spline.function(name="rest")
        at_rest = resultants(self.shell.spline, self.shell.material, rest)
        n, m = (ufl.derivative(force, rest, self.shell.y) for force in (at_rest.n, at_rest.m))
        return n, m
