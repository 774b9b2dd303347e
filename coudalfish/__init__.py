"""Fluid-structure interaction of thin structures immersed in flow, by the dynamic augmented Lagrangian method.

``CouDALFISh.takeStep()`` advances a fluid and a shell by one time step. Source: Kamensky, "Open-source immersogeometric
analysis of fluid-structure interaction using FEniCS and tIGAr", doi:10.1016/j.camwa.2020.01.023.
"""

import mpi4py.MPI  # noqa: F401  (dolfinx's wheel finds its MPI library only after this)

from coudalfish.band import SurfaceBand
from coudalfish.coupler import CouDALFISh, advance
from coudalfish.monitors import Monitors
from coudalfish.options import CouplingOptions, PenaltyRule
from coudalfish.report import StepError, StepReport
from coudalfish.subproblems import FluidSubproblem, ShellSubproblem

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
