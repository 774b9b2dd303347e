"""What ``varmint`` offers at its front; the modules have more."""

from varmint.conditions import Resistance as Resistance
from varmint.conditions import Slip as Slip
from varmint.conditions import Traction as Traction
from varmint.conditions import Velocity as Velocity
from varmint.conditions import WeakVelocity as WeakVelocity
from varmint.errors import velocity_errors as velocity_errors
from varmint.flow.flow import Flow as Flow
from varmint.flow.movie import movie as movie
from varmint.flow.options import FlowError as FlowError
from varmint.flow.options import FlowOptions as FlowOptions
from varmint.flow.options import FlowReport as FlowReport
from varmint.forms.motion import ElasticMotion as ElasticMotion
from varmint.forms.motion import MeshInversionError as MeshInversionError
from varmint.forms.motion import PrescribedMotion as PrescribedMotion
from varmint.forms.solids import NeoHookeanSolid as NeoHookeanSolid
from varmint.forms.solids import Solid as Solid
from varmint.forms.solids import StVenantKirchhoffSolid as StVenantKirchhoffSolid
from varmint.mesh.aorta import aortic_root as aortic_root
from varmint.mesh.files import read_mesh as read_mesh
from varmint.mesh.models import channel_with_cylinder as channel_with_cylinder
from varmint.mesh.models import from_gmsh as from_gmsh
from varmint.mesh.named import NamedMesh as NamedMesh
from varmint.mesh.named import box as box
from varmint.mesh.named import grid as grid
from varmint.mesh.named import named as named
from varmint.profiles import parabola as parabola
from varmint.quantities import BoundaryForce as BoundaryForce
from varmint.quantities import Measured as Measured
from varmint.quantities import NodalField as NodalField
from varmint.quantities import NodeValues as NodeValues
from varmint.quantities import PointValues as PointValues
from varmint.quantities import flow_rate as flow_rate
from varmint.quantities import kinetic_energy as kinetic_energy
from varmint.quantities import squared_divergence as squared_divergence
from varmint.quantities import volume as volume
from varmint.quantities import vorticity as vorticity
from varmint.quantities import wall_shear_stress as wall_shear_stress

__version__: str
