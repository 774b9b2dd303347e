"""What has to come before every test module."""

import mpi4py.MPI  # noqa: F401  (dolfinx's wheel finds its MPI library only after this)
