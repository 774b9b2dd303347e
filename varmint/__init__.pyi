"""What ``varmint`` offers at its front; the modules have more."""

from varmint.conditions import Resistance as Resistance
from varmint.conditions import Slip as Slip
from varmint.conditions import Traction as Traction
from varmint.conditions import Velocity as Velocity
from varmint.conditions import WeakVelocity as WeakVelocity
from varmint.flow.flow import Flow as Flow
from varmint.flow.options import FlowError as FlowError
from varmint.flow.options import FlowOptions as FlowOptions
from varmint.flow.options import FlowReport as FlowReport
from varmint.forms.motion import ElasticMotion as ElasticMotion
from varmint.forms.motion import MeshInversionError as MeshInversionError
from varmint.forms.motion import PrescribedMotion as PrescribedMotion
from varmint.mesh.aorta import aortic_root as aortic_root
from varmint.mesh.models import channel_with_cylinder as channel_with_cylinder
from varmint.mesh.models import from_gmsh as from_gmsh
from varmint.mesh.named import NamedMesh as NamedMesh
from varmint.mesh.named import box as box
from varmint.mesh.named import grid as grid
from varmint.mesh.named import named as named
from varmint.quantities import BoundaryForce as BoundaryForce
from varmint.quantities import NodalField as NodalField
from varmint.quantities import PointValues as PointValues

__version__: str
