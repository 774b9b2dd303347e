"""A cantilever under an end shear or an end moment.

A strip of length L = 10, width 1, E = 1.2e6 and nu = 0 is clamped at one end. At the other end acts either a dead force
across it, up to P L^2/(E I) = 4, or a moment, up to M = 2 pi E I/L, which rolls it into a full circle.

Source: K. Y. Sze, X. H. Liu, S. H. Lo, "Popular benchmark problems for geometric nonlinear analysis of shells",
sections 3.1 and 3.2, doi:10.1016/j.finel.2003.11.001.
"""

from dataclasses import dataclass, replace
from math import cos, pi, sin
from typing import Any, Literal

import numpy as np
from mpi4py import MPI

from shnapr.conditions import EdgeForce, EdgeMoment, Load
from shnapr.shell.options import ShellError, ShellOptions
from shnapr.shell.shell import Shell
from shnapr.svk import StVenantKirchhoff
from tigar_x import checks
from tigar_x.fem.load_stepping import StepControl
from tigar_x.geometry import shapes
from tigar_x.run.loading import LoadPath, follow
from tigar_x.splines.constraints import no_rotation

DOI = "10.1016/j.finel.2003.11.001"
PUBLISHED = {0.25: (-0.563, 3.015), 0.5: (-1.604, 4.933), 1.0: (-3.286, 6.698)}
"""U and W of the tip under shear by the load factor, for the thickness 0.1."""
LENGTH, WIDTH, YOUNGS_MODULUS = 10.0, 1.0, 1.2e6


def circle(t: float) -> tuple[float, float]:
    """U and W under M = t E I/L of a strip that keeps its length."""
    return LENGTH * (sin(t) / t - 1), LENGTH * (1 - cos(t)) / t


def rolled_shell(t: float, thickness: float) -> tuple[float, float]:
    """U and W under M = t E I/L of a Kirchhoff-Love shell of St. Venant-Kirchhoff material.

    Its energy E h eps^2/2 + E I kappa^2/2 in terms of Green's strain and of kappa = s^(1/2) theta' has its minimum at
    s - 1 = -(h theta')^2/6, theta' = M/(E I s), s the squared stretch.

    Args:
        t: angle of the circle.
        thickness: h.
    """
    from scipy.optimize import brentq

    c = (thickness * t / LENGTH) ** 2 / 6
    s = float(brentq(lambda s: s**2 * (s - 1) + c, 2 / 3, 1.0, xtol=1e-15))
    angle, length = t / s, LENGTH * s**0.5
    return length * sin(angle) / angle - LENGTH, length * (1 - cos(angle)) / angle


@dataclass(frozen=True)
class Strip:
    """The strip, its load and its mesh.

    Attributes:
        load: dead force across the strip, or moment.
        dim: 2: a curve in the plane; 3: a surface in space.
        degree: of the splines, 2 or more.
        elements: along the strip.
        thickness: up to a tenth of the length, which is 10; published positions are for 0.1.
        formulation: displacements alone, or with membrane forces as unknowns, which does not lock.
    """

    load: Literal["shear", "moment"] = "shear"
    dim: Literal[2, 3] = 2
    degree: int = 3
    elements: int = 16
    thickness: float = 0.1
    formulation: Literal["displacement", "mixed"] = "displacement"

    def __post_init__(self) -> None:
        if checks.positive("thickness", self.thickness) > LENGTH / 10:
            raise ValueError(
                f"thickness = {self.thickness}: at most {LENGTH / 10:g}, a tenth of the length, is allowed"
            )

    def shell(self) -> Shell:
        """The strip at rest under none of its load."""
        p, n = checks.whole("degree", self.degree, 2), checks.whole("elements", self.elements, 1)
        if self.dim == 2:
            patch = shapes.line((0.0, 0.0), (LENGTH, 0.0), elements=n, degree=p)
        else:
            patch = shapes.strip(length=LENGTH, width=WIDTH, elements=(n, 1), degrees=(p, p))
        stiffness = YOUNGS_MODULUS * self.thickness**3 / 12
        load: Load
        if self.load == "shear":
            load = EdgeForce("u1", np.eye(self.dim)[-1] * 4 * stiffness / LENGTH**2)
        else:  # positive moments turn the end towards a_3, which points down in the plane and up in space
            load = EdgeMoment("u1", (1.0 if self.dim == 3 else -1.0) * 2 * pi * stiffness / LENGTH)
        # membrane forces, whose rounding is that of E h, stand against a load of E I/L^2
        rounding = 40 * np.finfo(float).eps * 12 * (LENGTH / self.thickness) ** 2
        return Shell(
            patch,
            StVenantKirchhoff(YOUNGS_MODULUS, 0.0, self.thickness),
            pinned=("u0",),
            constraints=[no_rotation(patch, "u0")],
            loads=[load],
            formulation=self.formulation,
            options=ShellOptions(rtol=max(1e-8, float(rounding)), atol=0.0, max_iterations=20),
            comm=MPI.COMM_WORLD,
        )

    def bend(self, shell: Shell, **more: Any) -> LoadPath:
        """Raise the load to its full value by way of the published loads; U and W of the tip."""
        columns, control = {("U", "W"): lambda: shell.at("u1").displacement[[0, -1]]}, StepControl(1e-4, 0.1)
        return follow(shell.solve, columns, until=tuple(PUBLISHED), step=0.1, control=control, **more)

    def errors(self, path: LoadPath) -> dict[str, float]:
        """Shear: largest deviations of U and W from the published ones. Moment: distances of the tip by L.

        ``closing`` is the gap that is left in the circle; ``tip`` and ``tip_shell`` are the largest distances on the
        way from the circle and from the exact solution of this shell.

        Args:
            path: from :meth:`bend`.
        """
        tips, loads = np.column_stack([path.history["U"], path.history["W"]]), np.array(path.loads)
        if self.load == "shear":
            computed = tips[[path.loads.index(load) for load in PUBLISHED]]
            return dict(zip("UW", np.abs(computed / list(PUBLISHED.values()) - 1).max(axis=0).tolist(), strict=True))
        apart = {"closing": np.hypot(*(tips[-1] - circle(2 * pi)))}
        for name, exact in (("tip", circle), ("tip_shell", lambda t: rolled_shell(t, self.thickness))):
            apart[name] = np.linalg.norm(tips[1:] - [exact(2 * pi * t) for t in loads[1:]], axis=1).max()
        return {name: float(distance / LENGTH) for name, distance in apart.items()}


def thickness_study(strip: Strip) -> list[dict[str, Any]]:
    """Errors and Newton iterations by formulation, degree and h/L; a run that failed has no entries."""
    rows: list[dict[str, Any]] = []
    for formulation in ("displacement", "mixed"):
        for degree in (2, 3, 4):
            for thinness in (1e-1, 1e-2, 1e-3, 1e-4):
                row = {"formulation": formulation, "degree": degree, "h/L": thinness}
                case = replace(strip, formulation=formulation, degree=degree, thickness=thinness * LENGTH)
                try:
                    path = case.bend(case.shell())
                    rows.append(row | case.errors(path) | {"iterations": path.iterations})
                except ShellError:
                    names = ("U", "W") if strip.load == "shear" else ("closing", "tip", "tip_shell")
                    rows.append(row | dict.fromkeys(names, "failed") | {"iterations": "-"})
    return rows
