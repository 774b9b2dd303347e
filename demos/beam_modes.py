"""Vibration of a thin beam: eigenvalues of a plane Kirchhoff-Love shell against those of Euler and Bernoulli.

The beam is straight, of length L, and bends in the plane by strips of unit depth. Its circular frequencies are

    omega_n^2 = (beta_n / L)^4 E' h^2 / (12 rho),    E' = E/(1 - nu^2),

with cos(beta) cosh(beta) = -1 for a beam that is clamped at one end and free at the other, and beta_n = n pi for one
that is simply supported at both. The stiffness is the tangent of the shell's virtual work at rest, the mass that of its
inertia, so this is a check of both; stretching is part of the model, but far stiffer than bending.

Eigenvalues of splines of degree p >= 2 are too large by a part that falls with h^(2p-2). Source: J. A. Cottrell,
A. Reali, Y. Bazilevs, T. J. R. Hughes, "Isogeometric analysis of structural vibrations",
doi:10.1016/j.cma.2005.09.027.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import ufl
from mpi4py import MPI
from dolfinx import fem
from scipy.optimize import brentq

from shnapr.loads import inertia
from shnapr.svk import StVenantKirchhoff
from shnapr.work import internal_tangent
from tigar_x import checks
from tigar_x.compat import FloatArray
from tigar_x.fem.eigen import eigenmodes
from tigar_x.geometry import shapes
from tigar_x.geometry.patch import Patch
from tigar_x.ranks import root_only
from tigar_x.run import script
from tigar_x.run.convergence import Study, doubled, refine
from tigar_x.run.summary import write_summary
from tigar_x.run.writing import claim
from tigar_x.splines.spline import ExtractedSpline
from tigar_x.splines.vtu import VTUSeries

TOY = {"degree": 2, "elements": 8, "levels": 3, "modes": 3}
SUPPORTS = {"clamped-free": ("u0",), "simply-supported": ("u0", "u1")}


@dataclass(frozen=True)
class Data:
    """The beam's data; consistent units."""

    length: float = 1.0
    thickness: float = 0.01
    youngs_modulus: float = 1.0
    poisson_ratio: float = 0.3
    density: float = 1.0


def coarse_patch(geometry: str, length: float) -> Patch:
    """The beam as one element of the lowest degree; on the rational one equal parameters are unequal lengths."""
    if geometry == "bspline":
        return shapes.line((0.0, 0.0), (length, 0.0), elements=1)
    points = [(0.0, 0.0), (length / 2, 0.0), (length, 0.0)]
    return Patch.from_points([shapes.uniform(2, 1)], points, [1.0, 0.9, 1.2])


def wave_numbers(support: str, modes: int) -> FloatArray:
    """The first roots beta_n."""
    n = np.arange(1, modes + 1)
    if support == "simply-supported":
        return n * np.pi
    return np.array([brentq(lambda b: np.cos(b) + 1.0 / np.cosh(b), (i - 1) * np.pi, i * np.pi, xtol=1e-14) for i in n])


def exact_eigenvalues(support: str, modes: int, data: Data) -> FloatArray:
    """The first omega_n^2."""
    modulus = data.youngs_modulus / (1.0 - data.poisson_ratio**2)
    beta = wave_numbers(support, modes)
    return np.asarray((beta / data.length) ** 4 * modulus * data.thickness**2 / (12.0 * data.density))


@dataclass(frozen=True)
class Solution:
    """The first eigenvalues omega^2, the exact ones, and the modes (homogeneous) on a spline."""

    spline: ExtractedSpline
    values: FloatArray
    exact: FloatArray
    modes: tuple[fem.Function, ...]
    unknowns: int


def solve(patch: Patch, support: str, modes: int, data: Data) -> Solution:
    """Eigenvalues and modes on a refined patch."""
    layers = 2 if support == "clamped-free" else 1
    fixed = np.concatenate([patch.side_dofs(name, layers) for name in SUPPORTS[support]])
    spline = ExtractedSpline(patch, zero_dofs=fixed)
    E, nu, h, rho = (
        fem.Constant(spline.mesh, value)
        for value in (data.youngs_modulus, data.poisson_ratio, data.thickness, data.density)
    )
    y, u, v = spline.function(), ufl.TrialFunction(spline.V), ufl.TestFunction(spline.V)
    stiffness = internal_tangent(spline, StVenantKirchhoff(E, nu, h), y, v, y)
    mass = inertia(spline, u, v, density=rho, thickness=h)
    pairs = eigenmodes(spline, stiffness, mass, modes)
    exact = exact_eigenvalues(support, modes, data)
    return Solution(spline, pairs.values, exact, pairs.functions, patch.n * spline.nsd - len(fixed))


def by_mode(values: Iterable[Any]) -> dict[str, Any]:
    """Values by the names of the eigenvalues."""
    return {f"omega_{i}^2": value for i, value in enumerate(values, 1)}


def errors(solution: Solution) -> dict[str, float]:
    """Relative errors of the eigenvalues."""
    return by_mode(np.abs(solution.values / solution.exact - 1.0))


def main(
    support: Literal["clamped-free", "simply-supported"] = "clamped-free",
    geometry: Literal["bspline", "nurbs"] = "bspline",
    degree: int = 3,
    elements: int = 4,
    levels: int = 4,
    modes: int = 4,
    out: Path = Path("results/beam_modes"),
    overwrite: bool = False,
    viz: bool = True,
) -> dict[str, Any]:
    """Compute the modes of a thin beam on finer and finer splines and compare the eigenvalues with the exact ones.

    Args:
        support: of the two ends.
        geometry: bspline: the beam at constant speed; nurbs: with rational functions, at a speed that varies.
        degree: of the splines, 2 or more.
        elements: on the coarsest level; doubled from level to level.
        levels: number of levels, 2 or more.
        modes: number of modes, 1 to 5; far above, vibrations along the beam come in between.
        out: folder of the results.
        overwrite: whether to delete the results of an earlier run in this folder.
        viz: whether to write the modes for ParaView and a picture.

    Returns:
        The summary.
    """
    data = Data()
    p, count = checks.whole("degree", degree, 2), checks.choice("modes", modes, (1, 2, 3, 4, 5))
    patch = coarse_patch(geometry, data.length).with_degree(p)
    claim(out, overwrite=overwrite)
    study, solution = refine(
        lambda n: solve(patch.refined(n), support, count, data),
        errors,
        doubled(elements, levels),
        by_mode([2 * p - 2] * count),
    )
    if viz:
        write_modes(out / "beam_modes", solution)
        draw(out / "beam_modes.png", solution, study)

    inputs = {"support": support, "geometry": geometry, "degree": p, "elements": elements, "levels": levels}
    inputs |= {"modes": count, "data": data}
    pairs = zip(solution.values, solution.exact, strict=True)
    qoi = by_mode({"value": value, "exact": exact} for value, exact in pairs)
    summary = write_summary(out, "beam_modes", inputs, qoi=qoi, steps=count, **study.results())
    if MPI.COMM_WORLD.rank == 0:
        print(f"{support} beam, {geometry}, degree {p}; relative errors of omega^2")
        print(study.table())
    return summary


def unit_modes(solution: Solution) -> list[tuple[float, fem.Function]]:
    """Circular frequencies, and modes with a largest displacement of one."""
    spline = solution.spline
    scaled = []
    for value, mode in zip(solution.values, solution.modes, strict=True):
        y = spline.evaluate(mode, np.linspace(0.0, 1.0, 201)[:, None])[:, 1]
        unit = fem.Function(spline.V, name="mode")
        unit.x.array[:] = mode.x.array / y[np.argmax(np.abs(y))]
        scaled.append((float(value) ** 0.5, unit))
    return scaled


def write_modes(path: Path, solution: Solution) -> None:
    """One frame for every mode, at the time of its circular frequency."""
    y = solution.spline.function(name="mode")
    with VTUSeries(path, solution.spline, y=y) as series:
        for frequency, mode in unit_modes(solution):
            y.x.array[:] = mode.x.array
            series.write(frequency)


def draw(path: Path, solution: Solution, study: Study) -> None:
    """The modes, and the errors of their eigenvalues against the number of elements."""
    xi = np.linspace(0.0, 1.0, 201)[:, None]
    x = solution.spline.geometry.evaluate(xi)[:, 0]
    curves = [(frequency, solution.spline.evaluate(mode, xi)[:, 1]) for frequency, mode in unit_modes(solution)]
    picture(path, x, curves, study)


@root_only
def picture(path: Path, x: FloatArray, curves: list[tuple[float, FloatArray]], study: Study) -> None:
    """What :func:`draw` shows."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4.6), layout="constrained")
    for i, (frequency, y) in enumerate(curves):
        left.plot(x, y, label=rf"$\omega_{i + 1}$ = {frequency:.4g}")
    left.set(xlabel="$x_1$", ylabel="displacement", title="modes")
    left.legend()
    study.draw(right, unit="-", against="elements")
    right.set_ylabel("relative error")
    figure.savefig(path, dpi=130)
    plt.close(figure)


if __name__ == "__main__":
    script.command_line(main)
