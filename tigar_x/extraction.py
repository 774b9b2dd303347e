"""From a patch to finite elements: parametric mesh, Lagrange space and the extraction matrix M.

A spline restricted to one Bezier element is a polynomial that the Lagrange space contains, so evaluating it at the
nodes writes it exactly in the nodal basis: ``M[A, j] = N_j(xi_A)`` (Schillinger et al., doi:10.1002/nme.5216). The
nodes' coordinates are asked from dolfinx, which absorbs its reordering and any warping of the nodes. No other module
knows about the order of degrees of freedom.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp
from mpi4py import MPI
from dolfinx import fem, mesh
from petsc4py import PETSc

from tigar_x import compat
from tigar_x.patch import Patch


@dataclass(frozen=True)
class Extraction:
    """Where the spline lives in the finite element world.

    Attributes:
        mesh: parametric mesh of the Bezier elements (intervals or quadrilaterals).
        space: scalar Lagrange space of the patch's largest degree.
        M: scalar extraction matrix over this rank's nodes (owned, then ghosts), shape (nodes, functions).
    """

    mesh: mesh.Mesh
    space: fem.FunctionSpace
    M: sp.csr_matrix

    def vector_matrix(self, size: int, columns: PETSc.Vec | None = None) -> PETSc.Mat:
        """Extraction of a vector field that uses the same functions for every component, ``M x I``.

        Args:
            size: number of components.
            columns: vector whose layout the columns take; None: PETSc splits the functions over the ranks.

        Returns:
            Matrix from spline coefficients (function * size + component) to nodal values (node * size + component).
        """
        owned = self.space.dofmap.index_map.size_local
        comm = self.mesh.comm
        n = self.M.shape[1]
        local = columns.getLocalSize() if columns is not None else size * (n // comm.size + (comm.rank < n % comm.size))
        block = sp.kron(self.M[:owned], sp.identity(size), format="csr")
        block.sort_indices()
        M = PETSc.Mat().createAIJ(
            ((size * owned, PETSc.DETERMINE), (local, size * n)),
            bsize=1,
            csr=(block.indptr.astype(PETSc.IntType), block.indices.astype(PETSc.IntType), block.data),
            comm=comm,
        )
        M.assemble()
        return M


def parametric_mesh(patch: Patch, comm: MPI.Comm) -> mesh.Mesh:
    """Mesh of the patch's parametric domain, one cell per Bezier element.

    Args:
        patch: curve or surface.
        comm: communicator.

    Returns:
        Intervals or quadrilaterals with the breakpoints as vertices.
    """
    ticks = [basis.breakpoints for basis in patch.bases]
    grid = np.meshgrid(*ticks, indexing="ij")
    x = np.column_stack([g.ravel(order="F") for g in grid])
    number = np.arange(len(x)).reshape(grid[0].shape, order="F")
    if patch.dim == 1:
        cell, corners = "interval", [number[:-1], number[1:]]
    else:
        cell = "quadrilateral"
        corners = [number[:-1, :-1], number[1:, :-1], number[:-1, 1:], number[1:, 1:]]
    cells = np.column_stack([c.ravel(order="F") for c in corners])
    if comm.rank:
        cells, x = cells[:0], x[:0]
    return compat.create_mesh(comm, cell, cells, x)


def extract(patch: Patch, comm: MPI.Comm) -> Extraction:
    """Mesh, space and extraction matrix of a patch.

    Args:
        patch: curve or surface.
        comm: communicator; ``MPI.COMM_SELF`` gives every rank the whole spline.

    Returns:
        The extraction.
    """
    domain = parametric_mesh(patch, comm)
    space = compat.lagrange_space(domain, max(basis.degree for basis in patch.bases))
    nodes = space.tabulate_dof_coordinates()[:, : patch.dim]
    return Extraction(domain, space, patch.basis.evaluate(nodes))


def subcells(extraction: Extraction) -> compat.IntArray:
    """Linear cells between neighbouring nodes, ``degree`` of them per direction in every Bezier element.

    Args:
        extraction: where the spline lives.

    Returns:
        Node numbers around each subcell (2 ends of a segment, 4 corners of a quadrilateral in cyclic order), shape
        (subcells, 2 or 4).
    """
    reference = compat.node_points(extraction.space)
    dim = reference.shape[1]
    n = round(len(reference) ** (1.0 / dim))
    grid = np.lexsort(np.round(reference, 9).T).reshape((n,) * dim)
    if dim == 1:
        local = np.stack([grid[:-1], grid[1:]], axis=-1)
    else:
        local = np.stack([grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]], axis=-1)
    owned = compat.owned_cells(extraction.mesh)
    dofs = compat.cell_dofs(extraction.space)[:owned]
    return dofs[:, local.reshape(-1, 2**dim)].reshape(-1, 2**dim)


def set_nodal(function: fem.Function, values: Any) -> None:
    """Write nodal values (owned and ghosts) into a function.

    Args:
        function: in a blocked Lagrange space of ``size`` components.
        values: shape (nodes, size).
    """
    function.x.array[:] = np.asarray(values, dtype=np.float64).ravel()
