"""Variational multiscale formulation of incompressible Navier-Stokes flow, as pure UFL forms.

Sources: Bazilevs et al., doi:10.1007/s00466-008-0315-x; Bazilevs and Hughes, doi:10.1016/j.compfluid.2005.07.012;
Esmaily-Moghadam et al., doi:10.1007/s00466-011-0599-0.
"""

import mpi4py.MPI  # noqa: F401  (dolfinx's wheel finds its MPI library only after this)
