"""What ``coudalfish`` offers at its front; the modules have more."""

from coudalfish.coupler import CouDALFISh as CouDALFISh
from coudalfish.intervals import advance as advance
from coudalfish.restart import CoupledState as CoupledState
from coudalfish.sides.fluid import FluidSubproblem as FluidSubproblem
from coudalfish.sides.objects import fluid_side as fluid_side
from coudalfish.sides.shell import ShellSubproblem as ShellSubproblem
from coudalfish.step.options import CouplingOptions as CouplingOptions
from coudalfish.step.options import PenaltyRule as PenaltyRule
from coudalfish.step.report import ContactReport as ContactReport
from coudalfish.step.report import StepError as StepError
from coudalfish.step.report import StepReport as StepReport
from coudalfish.surface.band import SurfaceBand as SurfaceBand
from coudalfish.surface.monitors import Monitors as Monitors

__version__: str
