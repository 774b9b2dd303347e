"""Fields that depend on fewer coefficients than they have nodal values: ``u = M U``, as splines on finite elements."""

from typing import Any, Protocol

import numpy as np
import scipy.sparse as sp
from dolfinx import fem
from numpy.typing import ArrayLike
from petsc4py import PETSc

from tigar_x import compat
from tigar_x.compat import IntArray


class Extracted(Protocol):
    """A spline as a reduced system sees it: an ``ExtractedSpline`` for its ``V``, or a ``SplineSpace``."""

    @property
    def V(self) -> fem.FunctionSpace:
        """Lagrange space."""

    @property
    def M(self) -> PETSc.Mat:
        """Extraction matrix."""

    @property
    def rows(self) -> sp.csr_matrix:
        """This rank's rows of ``M``."""

    @property
    def zero_dofs(self) -> IntArray:
        """Columns of ``M`` whose increments vanish."""


def extracted_matrix(space: Extracted, form: Any, dofs: ArrayLike) -> PETSc.Mat:
    """Rows and columns of ``M^T A M``; the caller destroys it when it is done.

    Args:
        space: the spline.
        form: compiled bilinear form.
        dofs: columns of M that this rank owns, sorted.

    Returns:
        The matrix, numbered anew.
    """
    A = compat.create_matrix(form, "aij")
    compat.assemble_matrix(A, form)
    A.assemble()
    product = A.PtAP(space.M)
    kept = PETSc.IS().createGeneral(np.asarray(dofs, dtype=PETSc.IntType), comm=A.comm)
    part = product.createSubMatrix(kept, kept)
    for finished in (A, product, kept):
        finished.destroy()
    return part
