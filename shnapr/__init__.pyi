"""What ``shnapr`` offers at its front; the modules have more."""

from shnapr.conditions import Damping as Damping
from shnapr.conditions import DeadLoad as DeadLoad
from shnapr.conditions import EdgeForce as EdgeForce
from shnapr.conditions import EdgeMoment as EdgeMoment
from shnapr.conditions import Gravity as Gravity
from shnapr.conditions import Pressure as Pressure
from shnapr.contact.kernels import LinearKernel as LinearKernel
from shnapr.contact.kernels import SmoothedKernel as SmoothedKernel
from shnapr.contact.recipe import ContactRecipe as ContactRecipe
from shnapr.contact.self_contact import SelfContact as SelfContact
from shnapr.contact.system import ContactSystem as ContactSystem
from shnapr.hyperelastic import Hyperelastic as Hyperelastic
from shnapr.hyperelastic import lee_sacks as lee_sacks
from shnapr.hyperelastic import neo_hookean as neo_hookean
from shnapr.loads import dead_load as dead_load
from shnapr.loads import edge_moment as edge_moment
from shnapr.loads import edge_traction as edge_traction
from shnapr.loads import follower_pressure as follower_pressure
from shnapr.loads import gravity as gravity
from shnapr.loads import inertia as inertia
from shnapr.loads import mass_damping as mass_damping
from shnapr.planes import RigidPlane as RigidPlane
from shnapr.planes import plane_contact as plane_contact
from shnapr.shell.options import ShellError as ShellError
from shnapr.shell.options import ShellOptions as ShellOptions
from shnapr.shell.options import ShellReport as ShellReport
from shnapr.shell.shell import Shell as Shell
from shnapr.stress import resultants as resultants
from shnapr.stress import von_mises as von_mises
from shnapr.supports import clamped as clamped
from shnapr.supports import fixed as fixed
from shnapr.supports import pinned as pinned
from shnapr.svk import StVenantKirchhoff as StVenantKirchhoff
from shnapr.work import internal_tangent as internal_tangent
from shnapr.work import internal_work as internal_work
from shnapr.work import strain_energy as strain_energy

__version__: str
