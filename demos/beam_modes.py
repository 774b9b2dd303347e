"""Vibration of a thin beam: eigenvalues of a plane Kirchhoff-Love shell against those of Euler and Bernoulli.

A straight beam of length L that bends in the plane has, per unit depth, the circular frequencies

    omega_n^2 = (beta_n / L)^4 E' h^2 / (12 rho),    E' = E/(1 - nu^2),

with cos(beta) cosh(beta) = -1 for a beam that is clamped at one end and free at the other, and beta_n = n pi for one
that is simply supported at both. The stiffness is the tangent of the shell's virtual work at rest, the mass that of its
inertia. Eigenvalues of splines of degree p >= 2 are too large by a part that falls with h^(2p-2). Source: J. A.
Cottrell, A. Reali, Y. Bazilevs, T. J. R. Hughes, doi:10.1016/j.cma.2005.09.027.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from mpi4py import MPI
from scipy.optimize import brentq

from shnapr import Shell, StVenantKirchhoff
from tigar_x import Eigenpairs, Patch, Results, checks, draw, script, shapes, with_results
from tigar_x.compat import FloatArray
from tigar_x.splines.modes import mode_curves, write_modes

TOY = {"degree": 2, "elements": 8, "levels": 3, "modes": 3}
LENGTH, THICKNESS, YOUNGS_MODULUS, POISSON_RATIO, DENSITY = 1.0, 0.01, 1.0, 0.3, 1.0


def coarse_patch(geometry: str) -> Patch:
    """The beam as one element of the lowest degree; on the rational one equal parameters are unequal lengths."""
    if geometry == "bspline":
        return shapes.line((0.0, 0.0), (LENGTH, 0.0), elements=1)
    return Patch.from_points([shapes.uniform(2, 1)], [(0, 0), (LENGTH / 2, 0), (LENGTH, 0)], [1.0, 0.9, 1.2])


def wave_numbers(support: str, modes: int) -> FloatArray:
    """The first roots beta_n."""
    n = np.arange(1, modes + 1) * np.pi
    roots = (brentq(lambda b: np.cos(b) + 1.0 / np.cosh(b), b - np.pi, b, xtol=1e-14) for b in n)
    return n if support == "simply-supported" else np.array(list(roots))


@dataclass(frozen=True)
class Vibration:
    """The first modes of a beam, and their exact eigenvalues omega^2."""

    beam: Shell
    modes: Eigenpairs
    exact: FloatArray
    unknowns: int

    def errors(self) -> dict[str, float]:
        """Relative errors of the eigenvalues."""
        return by_mode(np.abs(self.modes.values / self.exact - 1.0))


def solve(patch: Patch, support: str, modes: int) -> Vibration:
    """Eigenvalues and modes on a refined patch."""
    ends = {"clamped": ("u0",)} if support == "clamped-free" else {"pinned": ("u0", "u1")}
    material = StVenantKirchhoff(YOUNGS_MODULUS, POISSON_RATIO, THICKNESS)
    beam = Shell(patch, material, density=DENSITY, **ends, comm=MPI.COMM_WORLD)
    ratio = YOUNGS_MODULUS / (1.0 - POISSON_RATIO**2) * THICKNESS**2 / (12.0 * DENSITY)
    return Vibration(beam, beam.modes(modes), (wave_numbers(support, modes) / LENGTH) ** 4 * ratio, beam.unknowns)


def by_mode(values: Iterable[Any]) -> dict[str, Any]:
    """Values by the names of the eigenvalues."""
    return {f"omega_{i}^2": value for i, value in enumerate(values, 1)}


@with_results(elements=4, levels=4)
def main(
    results: Results,
    support: Literal["clamped-free", "simply-supported"] = "clamped-free",
    geometry: Literal["bspline", "nurbs"] = "bspline",
    degree: int = 3,
    modes: int = 4,
) -> dict[str, Any]:
    """Compute the modes of a thin beam on finer and finer splines and compare the eigenvalues with the exact ones.

    Args:
        support: of the two ends.
        geometry: bspline: the beam at constant speed; nurbs: with rational functions, at a speed that varies.
        degree: of the splines, 2 or more.
        modes: number of modes, 1 to 5; far above, vibrations along the beam come in between.
    """
    count, p = checks.choice("modes", modes, (1, 2, 3, 4, 5)), checks.whole("degree", degree, 2)
    coarse, rates = coarse_patch(geometry).with_degree(p), by_mode([2 * p - 2] * count)
    study, found = results.refine(lambda n: solve(coarse.refined(n), support, count), Vibration.errors, rates)
    if results.viz:
        write_modes(results.out / "beam_modes", found.beam.spline, found.modes)
        modes = mode_curves(found.beam.spline, found.modes, length="length")
        draw(results.out / "beam_modes.png", modes, lambda axes: study.draw(axes, against="elements"))
    qoi = by_mode({"value": v, "exact": e} for v, e in zip(found.modes.values, found.exact, strict=True))
    return results.convergence(study, f"{support} beam, {geometry}, degree {p}", qoi=qoi, steps=count)


if __name__ == "__main__":
    script.command_line(main)
