"""The README's coupled run without the objects that know what it says here: every part handed on by the script."""

import numpy as np
import ufl
from mpi4py import MPI

from coudalfish import CouDALFISh, FluidSubproblem, ShellSubproblem, SurfaceBand
from shnapr.loads import inertia
from shnapr.supports import clamped
from shnapr.svk import StVenantKirchhoff
from shnapr.work import internal_work
from tigar_x import compat
from tigar_x.fem.schemes import generalized_alpha
from tigar_x.fem.time_integration import TimeIntegrator
from tigar_x.geometry import shapes
from tigar_x.splines.spline import ExtractedSpline
from varmint.forms.boundary import weak_dirichlet
from varmint.forms.space import equal_order_space, split
from varmint.forms.vms import interior_residual
from varmint.mesh import box
