"""From a geometry to finite elements: parametric mesh, Lagrange spaces and the extraction matrix M.

A spline restricted to one Bezier element is a polynomial that the Lagrange space contains, so evaluating it at the
nodes writes it exactly in the nodal basis: ``M[A, j] = N_j(xi_A)`` (Schillinger et al., doi:10.1002/nme.5216). The
nodes' coordinates are asked from dolfinx, which absorbs its reordering and any warping of the nodes. No other module
knows about the order of degrees of freedom.
"""

from collections.abc import Callable, Sequence
from typing import Any, Protocol

import numpy as np
import scipy.sparse as sp
from mpi4py import MPI
from dolfinx import fem, mesh
from petsc4py import PETSc

from tigar_x import compat
from tigar_x.compat import FloatArray
from tigar_x.geometry.functions import ParametricCells


class Evaluable(Protocol):
    """Functions that can be evaluated at the nodes of a parametric mesh."""

    @property
    def n(self) -> int:
        """Number of functions."""

    @property
    def degrees(self) -> tuple[int, ...]:
        """Largest polynomial degree in every direction."""

    def evaluate(self, points: FloatArray) -> sp.csr_matrix:
        """Values at points of the parametric plane, shape (points, n)."""


def parametric_mesh(cells: ParametricCells, comm: MPI.Comm) -> mesh.Mesh:
    """Distributed mesh of parametric cells.

    Args:
        cells: the same on every rank.
        comm: communicator.

    Returns:
        The mesh.
    """
    here = slice(0, 0) if comm.rank else slice(None)
    return compat.create_mesh(comm, cells.cell, cells.cells[here], cells.x[here])


def tagged_boundary(domain: mesh.Mesh, parts: Sequence[tuple[int, Callable[[FloatArray], Any]]]) -> Any:
    """Tags of the exterior facets of a mesh.

    Args:
        domain: mesh.
        parts: for every tag the predicate of its facets' vertices, which takes coordinates of shape (3, n); no facet
            belongs to two parts.

    Returns:
        dolfinx mesh tags.
    """
    dim = domain.topology.dim - 1
    found = [mesh.locate_entities_boundary(domain, dim, where) for _, where in parts]
    facets = np.concatenate(found).astype(np.int32)
    tags = np.repeat(np.array([tag for tag, _ in parts], dtype=np.int32), [len(part) for part in found])
    order = np.argsort(facets)
    return mesh.meshtags(domain, dim, facets[order], tags[order])


def element_degree(degrees: Sequence[int], simplices: bool) -> int:
    """Degree of the Lagrange space that contains a tensor-product spline on one element.

    Args:
        degrees: polynomial degrees, one per direction.
        simplices: whether the cells are simplices (or else tensor cells).

    Returns:
        Their sum on simplices, else the largest.
    """
    return sum(degrees) if simplices else max(degrees)


def node_matrix(functions: Evaluable, space: fem.FunctionSpace) -> sp.csr_matrix:
    """Values of functions at this rank's nodes (owned, then ghosts) of a scalar or blocked space, shape (nodes, n)."""
    dim = space.mesh.geometry.dim
    return functions.evaluate(space.tabulate_dof_coordinates()[:, :dim])


def petsc_matrix(rows: sp.spmatrix, comm: MPI.Comm) -> PETSc.Mat:
    """Distributed matrix from every rank's rows.

    Args:
        rows: this rank's rows, with global columns.
        comm: communicator.

    Returns:
        The matrix; its columns are split evenly over the ranks.
    """
    local = rows.tocsr()
    local.sort_indices()
    m, n = local.shape
    width = n // comm.size + (comm.rank < n % comm.size)
    csr = (local.indptr.astype(PETSc.IntType), local.indices.astype(PETSc.IntType), local.data)
    M = PETSc.Mat().createAIJ(((m, PETSc.DETERMINE), (width, n)), bsize=1, csr=csr, comm=comm)
    M.assemble()
    return M


def set_nodal(function: fem.Function, values: Any) -> None:
    """Write nodal values (owned and ghosts) into a function.

    Args:
        function: in a scalar or blocked Lagrange space of ``size`` components.
        values: shape (nodes, size).
    """
    function.x.array[:] = np.asarray(values, dtype=np.float64).ravel()
