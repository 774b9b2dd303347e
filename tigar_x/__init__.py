"""Spline extraction for dolfinx: isogeometric analysis with forms written in UFL.

A sparse matrix M writes B-spline or NURBS functions in a Lagrange finite element basis, so that what dolfinx
assembles becomes isogeometric: ``A = M^T A_FE M``, ``b = M^T b_FE``. Source: Kamensky and
Bazilevs, doi:10.1016/j.cma.2018.10.002.

Geometry comes from :mod:`~tigar_x.shapes`, :mod:`~tigar_x.surfaces`, :mod:`~tigar_x.ribbon` or
:mod:`~tigar_x.files` as a :mod:`~tigar_x.patch`, or as several of them (:mod:`~tigar_x.multipatch`).
:mod:`~tigar_x.spline` makes spaces, forms and fields of it, under :mod:`~tigar_x.constraints`, and
:mod:`~tigar_x.spline_system` the reduced equations. :mod:`~tigar_x.solve`, :mod:`~tigar_x.load_stepping` and
:mod:`~tigar_x.eigen` solve them.

The package also holds the ground that shells, flow and coupling stand on: linear solvers, one Newton loop, time
integrators, output, and what a script needs around a run.

Importing any of its modules changes one thing in UFL, for all forms of the process: sums and products sort Constants by
their number, not by its digits (99 comes before 100). Otherwise the name of a compiled form would depend on how many
Constants were made before it. What forms mean stays, but a form of your own may be compiled a second time, and its
rounding errors may differ, when it has several Constants and was compiled without this library.
"""

import mpi4py.MPI  # noqa: F401  (dolfinx's wheel finds its MPI library only after this)

__version__ = "0.1.0"
