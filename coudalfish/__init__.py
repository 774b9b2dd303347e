"""Fluid-structure interaction of thin structures immersed in flow, by the dynamic augmented Lagrangian method.

``CouDALFISh.takeStep()`` advances a fluid and a shell by one time step. Source: Kamensky, "Open-source immersogeometric
analysis of fluid-structure interaction using FEniCS and tIGAr", doi:10.1016/j.camwa.2020.01.023.
"""

import mpi4py.MPI  # noqa: F401  (dolfinx's wheel finds its MPI library only after this)

from coudalfish.coupler import CouDALFISh
from coudalfish.run import advance
from coudalfish.sides.fluid import FluidSubproblem
from coudalfish.sides.shell import ShellSubproblem
from coudalfish.step.options import CouplingOptions, PenaltyRule
from coudalfish.step.report import StepError, StepReport
from coudalfish.surface.band import SurfaceBand
from coudalfish.surface.monitors import Monitors

__all__ = [
    "CouDALFISh",
    "CouplingOptions",
    "FluidSubproblem",
    "Monitors",
    "PenaltyRule",
    "ShellSubproblem",
    "StepError",
    "StepReport",
    "SurfaceBand",
    "advance",
]
