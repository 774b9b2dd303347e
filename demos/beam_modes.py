"""Vibration of a thin beam: eigenvalues of a plane Kirchhoff-Love shell against those of Euler and Bernoulli.

The beam is straight, of length L, and bends in the plane by strips of unit depth. Its circular frequencies are

    omega_n^2 = (beta_n / L)^4 E' h^2 / (12 rho),    E' = E/(1 - nu^2),

with cos(beta) cosh(beta) = -1 for a beam that is clamped at one end and free at the other, and beta_n = n pi for one
that is simply supported at both. The stiffness is the tangent of the shell's virtual work at rest, the mass that of its
inertia, so this is a check of both; stretching is part of the model, but far stiffer than bending.

Eigenvalues of splines of degree p >= 2 are too large by a part that falls with h^(2p-2). Source: J. A. Cottrell et
al., "Isogeometric analysis of structural vibrations", doi:10.1016/j.cma.2005.09.027.
"""

from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import numpy as np
from mpi4py import MPI
from scipy.optimize import brentq

from shnapr import Shell, StVenantKirchhoff
from tigar_x import Eigenpairs, Patch, Results, checks, draw, script, shapes, with_results
from tigar_x.splines.modes import mode_curves, write_modes

TOY = {"degree": 2, "elements": 8, "levels": 3, "modes": 3}
LENGTH, THICKNESS, YOUNGS_MODULUS, POISSON_RATIO, DENSITY = 1.0, 0.01, 1.0, 0.3, 1.0


def by_mode(values: Any) -> dict[str, Any]:
    """Values by the names of the eigenvalues."""
    return {f"omega_{i}^2": value for i, value in enumerate(values, 1)}


def wave_numbers(support: str, modes: int) -> np.ndarray:
    """The first roots beta_n."""
    n = np.arange(1, modes + 1)
    found = [brentq(lambda b: np.cos(b) + 1.0 / np.cosh(b), (i - 1) * np.pi, i * np.pi, xtol=1e-14) for i in n]
    return n * np.pi if support == "simply-supported" else np.array(found)


@dataclass(frozen=True)
class Vibration:
    """The first modes of a beam, and their exact eigenvalues omega^2."""

    shell: Shell
    modes: Eigenpairs
    exact: np.ndarray
    unknowns: int

    def errors(self) -> dict[str, float]:
        """Relative errors of the eigenvalues."""
        return by_mode(np.abs(self.modes.values / self.exact - 1.0))


@dataclass(frozen=True)
class Beam:
    """The beam and its spline.

    Attributes:
        support: of the two ends.
        geometry: bspline: the beam at constant speed; nurbs: with rational functions, at a speed that varies.
        degree: of the splines, 2 or more.
        modes: number of modes, 1 to 5; far above, vibrations along the beam come in between.
    """

    support: Literal["clamped-free", "simply-supported"] = "clamped-free"
    geometry: Literal["bspline", "nurbs"] = "bspline"
    degree: int = 3
    modes: int = 4

    def solve(self, elements: int) -> Vibration:
        """Eigenvalues and modes; on the rational beam equal parameters are unequal lengths."""
        line, p = shapes.line((0.0, 0.0), (LENGTH, 0.0), elements=1), checks.whole("degree", self.degree, 2)
        if self.geometry == "nurbs":
            line = Patch.from_points([shapes.uniform(2, 1)], [(0, 0), (LENGTH / 2, 0), (LENGTH, 0)], [1.0, 0.9, 1.2])
        held = {"clamped": ("u0",)} if self.support == "clamped-free" else {"pinned": ("u0", "u1")}
        material = StVenantKirchhoff(YOUNGS_MODULUS, POISSON_RATIO, THICKNESS)
        shell = Shell(line.with_degree(p).refined(elements), material, density=DENSITY, **held, comm=MPI.COMM_WORLD)
        ratio = YOUNGS_MODULUS / (1.0 - POISSON_RATIO**2) * THICKNESS**2 / (12.0 * DENSITY)
        beta = wave_numbers(self.support, self.modes)
        return Vibration(shell, shell.modes(self.modes), (beta / LENGTH) ** 4 * ratio, shell.unknowns)


@with_results(elements=4, levels=4)
def main(results: Results, beam: Beam) -> dict[str, Any]:
    """Compute the modes of a thin beam on finer and finer splines and compare the eigenvalues with the exact ones."""
    count, p = checks.choice("modes", beam.modes, (1, 2, 3, 4, 5)), checks.whole("degree", beam.degree, 2)
    study, found = results.refine(beam.solve, Vibration.errors, by_mode([2 * p - 2] * count))
    if results.viz:
        write_modes(results.out / "beam_modes", found.shell.spline, found.modes)
        modes = mode_curves(found.shell.spline, found.modes, length="length")
        draw(results.out / "beam_modes.png", modes, partial(study.draw, against="elements"))
    qoi = by_mode({"value": v, "exact": e} for v, e in zip(found.modes.values, found.exact, strict=True))
    return results.convergence(study, f"{beam}; relative errors of omega^2", qoi=qoi, steps=count)


if __name__ == "__main__":
    script.command_line(main)
