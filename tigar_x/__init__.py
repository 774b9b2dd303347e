"""Spline extraction for dolfinx: isogeometric analysis with forms written in UFL.

A sparse matrix M writes B-spline or NURBS functions in a Lagrange finite element basis, so that what dolfinx
assembles becomes isogeometric: ``A = M^T A_FE M``, ``b = M^T b_FE``. Source: Kamensky and
Bazilevs, doi:10.1016/j.cma.2018.10.002.

:mod:`~tigar_x.geometry` has spline geometry: shapes, files, and patches alone or joined. :mod:`~tigar_x.splines` makes
spaces, fields, forms and systems of it, under constraints.

Shells, flow and coupling stand on two more: :mod:`~tigar_x.fem` has linear solvers, Newton's method, load steps, modes
and integration in time; :mod:`~tigar_x.run` what a script needs around a run, from its command line to its output.

Importing any of its modules changes one thing in UFL, for all forms of the process: sums and products sort Constants by
their number, not by its digits (99 comes before 100). Otherwise the name of a compiled form would depend on how many
Constants were made before it. What forms mean stays, but a form of your own may be compiled a second time, and its
rounding errors may differ, when it has several Constants and was compiled without this library.
"""

import mpi4py.MPI  # noqa: F401  (dolfinx's wheel finds its MPI library only after this)

from tigar_x import moved
from tigar_x.front import __version__ as __version__
from tigar_x.front import front

moved.install()
__getattr__, __dir__, __all__ = front(__name__)
