"""Spline extraction for dolfinx: isogeometric analysis with forms written in UFL.

A sparse matrix M writes B-spline or NURBS functions in a Lagrange finite element basis, so that what dolfinx
assembles becomes isogeometric: ``A = M^T A_FE M``, ``b = M^T b_FE``. Source: Kamensky and
Bazilevs, doi:10.1016/j.cma.2018.10.002.

The package also holds the ground that shells, flow and coupling stand on: linear solvers, one Newton loop, time
integrators, output, and what a script needs around a run.
"""

import mpi4py.MPI  # noqa: F401  (dolfinx's wheel finds its MPI library only after this)

__version__ = "0.1.0"
