"""Variational multiscale formulation of incompressible Navier-Stokes flow, as pure UFL forms.

Sources: Bazilevs et al., doi:10.1007/s00466-008-0315-x; Bazilevs and Hughes, doi:10.1016/j.compfluid.2005.07.012;
Esmaily-Moghadam et al., doi:10.1007/s00466-011-0599-0.
"""

from tigar_x.front import __version__ as __version__
from tigar_x.front import front

__getattr__, __dir__, __all__ = front(__name__)
