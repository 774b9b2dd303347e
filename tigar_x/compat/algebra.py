"""Vectors, matrices, assembly and strong boundary conditions."""

import weakref
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import scipy.sparse as sp
from mpi4py import MPI
from dolfinx import fem, la
from dolfinx.fem import petsc
from numpy.typing import NDArray
from petsc4py import PETSc

from tigar_x.compat.blocks import block_pattern, block_values
from tigar_x.compat.release import VERSION, FloatArray, IntArray
from tigar_x.compat.spaces import component_space, component_view

_ADD = la.ScatterMode.add if VERSION < (0, 9) else la.InsertMode.add  # type: ignore[attr-defined]


_shared: dict[tuple[int, ...], list[tuple[weakref.ref[Any], tuple[Any, ...]]]] = {}
"""Owners and PETSc objects of several ranks, by these ranks, in the order in which all of them made them."""


def freed_with(owner: Any, *objects: Any) -> None:
    """Destroy PETSc objects some time after their owner is gone.

    petsc4py keeps what is merely dropped, and with it memory and communicators, of which some MPI libraries have few.
    On one rank the objects go with their owner; on several with :func:`free_dropped`.

    Args:
        owner: nothing that it made may be used after it.
        objects: PETSc objects of one communicator; all ranks make them in the same order.
    """
    comm = objects[0].comm.tompi4py()
    if comm.size > 1:
        _shared.setdefault(_members(comm), []).append((weakref.ref(owner), objects))
        return
    for thing in objects:
        weakref.finalize(owner, thing.destroy).atexit = False


def free_dropped(comm: MPI.Comm) -> None:
    """Destroy the PETSc objects whose owners are gone on all ranks (collective).

    Args:
        comm: communicator of the ranks that made them.
    """
    if comm.size == 1:
        return
    members = _members(comm)
    entries = _shared.get(members, [])
    counts = comm.allgather(len(entries))
    if min(counts) < max(counts):  # a rank has failed where others have not: better to keep all than to wait for it
        return
    gone = np.array([owner() is None for owner, _ in entries], dtype=np.int32)
    comm.Allreduce(MPI.IN_PLACE, gone, op=MPI.MIN)
    for (_, objects), dead in zip(entries, gone, strict=True):
        if dead:
            for thing in objects:
                thing.destroy()
    _shared[members] = [entry for entry, dead in zip(entries, gone, strict=True) if not dead]


def _members(comm: MPI.Comm) -> tuple[int, ...]:
    """World ranks of a communicator."""
    group, world = comm.Get_group(), MPI.COMM_WORLD.Get_group()
    ranks = MPI.Group.Translate_ranks(group, list(range(comm.size)), world)
    group.Free()
    world.Free()
    return tuple(int(rank) for rank in ranks)


def petsc_vector(function: fem.Function) -> PETSc.Vec:
    """PETSc vector that shares memory with a function."""
    return function.vector if VERSION < (0, 9) else function.x.petsc_vec


def add_ghosts(function: fem.Function) -> None:
    """Add the values of ghosts to those of their owners (collective); ghosts keep what they have."""
    function.x.scatter_reverse(_ADD)


def accumulate(function: fem.Function) -> None:
    """Add the values of ghosts to those of their owners, and update the ghosts (collective)."""
    add_ghosts(function)
    function.x.scatter_forward()


def matrix_of(A: sp.csr_matrix, size: int = 1, comm: MPI.Comm = MPI.COMM_SELF) -> PETSc.Mat:
    """A matrix as PETSc's, on one rank.

    Args:
        A: the matrix, whose indices get sorted.
        size: of the blocks of its rows.
        comm: communicator of the rank.
    """
    A.sort_indices()
    csr = A.indptr.astype(PETSc.IntType), A.indices.astype(PETSc.IntType), A.data
    made = PETSc.Mat().createAIJ(A.shape, bsize=size, csr=csr, comm=comm)
    made.assemble()
    return made


def maximise(space: fem.FunctionSpace, values: FloatArray) -> FloatArray:
    """The largest values that any rank has at the nodes of a scalar space (collective).

    Args:
        space: the space.
        values: at this rank's nodes, ghosts as well, shape (nodes,).
    """
    vector = create_vector(space)
    with vector.localForm() as local:
        local.array[:] = values
    vector.ghostUpdate(PETSc.InsertMode.MAX, PETSc.ScatterMode.REVERSE)
    vector.ghostUpdate(PETSc.InsertMode.INSERT, PETSc.ScatterMode.FORWARD)
    with vector.localForm() as local:
        result = np.array(local.array, dtype=np.float64)
    vector.destroy()
    return result


def create_vector(space: fem.FunctionSpace) -> PETSc.Vec:
    """Zero vector with ghosts, in the layout of a space."""
    index_map, size = space.dofmap.index_map, space.dofmap.index_map_bs
    return PETSc.Vec().createGhost(
        index_map.ghosts.astype(PETSc.IntType),
        size=(size * index_map.size_local, size * index_map.size_global),
        bsize=size,
        comm=space.mesh.comm,
    )


def create_matrix(form: Any, kind: str) -> PETSc.Mat:
    """Empty matrix with the sparsity of a compiled bilinear form.

    Args:
        form: compiled form.
        kind: PETSc type, "aij" or "baij".
    """
    return petsc.create_matrix(form, kind)


def assemble_vector(b: PETSc.Vec, form: Any) -> None:
    """Overwrite the local part of ``b``, ghosts included, by the assembled form; ghosts are not yet summed."""
    with b.localForm() as local:
        local.set(0.0)
    petsc.assemble_vector(b, form)


def assemble_matrix(A: PETSc.Mat, form: Any, bcs: Sequence[Any] = ()) -> None:
    """Overwrite ``A`` by the assembled form with unit rows at the dofs of ``bcs``; assembly is not finished."""
    A.zeroEntries()
    add_matrix(A, form, bcs)


def add_vector(b: FloatArray, form: Any) -> None:
    """Add an assembled form to an array of local dofs, ghosts included, which are not summed."""
    fem.assemble_vector(b, form)


def add_matrix(A: PETSc.Mat, form: Any, bcs: Sequence[Any] = ()) -> None:
    """Add an assembled form to ``A`` but for rows and columns of ``bcs``, which get ones; assembly is not finished."""
    if isinstance(form, SplitForm):
        form.add_to(A, list(bcs))
    else:
        _assemble(A, form, list(bcs), 1.0)


def _assemble(A: PETSc.Mat, form: Any, bcs: list[Any], diagonal: float) -> None:
    petsc.assemble_matrix(A, form, bcs, diagonal)  # type: ignore[arg-type]


class SplitForm:
    """A bilinear form on several ranks, in cells whose nodes are all this rank's and in those at the border of others.

    PETSc looks up every block that goes into a matrix of several ranks, and sends those of rows of other ranks one by
    one. So what is inside goes into the rows and columns of this rank, and what is at the border is summed before.

    Args:
        inside: compiled form in the former.
        border: the same in the latter.
        nodes: local nodes of these, shape (cells, nodes of a cell).
    """

    def __init__(self, inside: Any, border: Any, nodes: IntArray) -> None:
        self.inside, self.border = inside, border
        self._nodes, compact = np.unique(nodes, return_inverse=True)
        self._cells = compact.reshape(nodes.shape)
        self._sums: PETSc.Mat | None = None

    def add_to(self, A: PETSc.Mat, bcs: list[Any]) -> None:
        """See :func:`add_matrix`."""
        if A.comm.size == 1:
            for form in (self.inside, self.border):
                _assemble(A, form, bcs, 1.0)
            return
        _assemble(_own_block(A), self.inside, bcs, 1.0)
        if not len(self._nodes):
            return
        if self._sums is None:
            self._sums = self._matrix(A.getLGMap()[0])
        self._sums.zeroEntries()
        _assemble(self._sums, self.border, bcs, 0.0)  # the ones are there
        self._sums.assemble()
        pattern, (values,) = block_pattern(self._sums), block_values(self._sums)
        starts = np.searchsorted(pattern.rows, np.arange(len(self._nodes) + 1)).astype(PETSc.IntType)
        columns, rows = (self._nodes[i].astype(PETSc.IntType) for i in (pattern.columns, np.arange(len(self._nodes))))
        blocks = np.ascontiguousarray(values.transpose(0, 2, 1))
        A.setValuesBlockedLocalIJV(starts, columns, blocks, PETSc.InsertMode.ADD_VALUES, rowmap=rows)

    def _matrix(self, numbers: PETSc.LGMap) -> PETSc.Mat:
        """An empty one of the nodes at the border, which takes local numbers of the dofs."""
        size, n, cells = numbers.getBlockSize(), len(self._nodes), self._cells
        starts = np.arange(0, cells.size + 1, cells.shape[1])
        of_cells = sp.csr_matrix((np.ones(cells.size, dtype=np.int32), cells.ravel(), starts), (len(cells), n))
        A = PETSc.Mat().create(comm=MPI.COMM_SELF)
        A.setSizes((n * size, n * size))
        A.setType("baij")
        A.setBlockSize(size)
        A.setPreallocationNNZ(np.diff((of_cells.T @ of_cells).tocsr().indptr).astype(PETSc.IntType))
        names = np.full(numbers.getSize() // size, -1, dtype=PETSc.IntType)
        names[self._nodes] = np.arange(n)
        _number(A, names, size)
        freed_with(self, A)
        return A


def _own_block(A: PETSc.Mat) -> PETSc.Mat:
    """Rows and columns of this rank, which take the same local numbers as the matrix does."""
    block, numbers = A.getDiagonalBlock(), A.getLGMap()[0]
    names, size = numbers.getBlockIndices(), numbers.getBlockSize()
    first, end = (bound // size for bound in A.getOwnershipRange())
    _number(block, np.where((names >= first) & (names < end), names - first, -1), size)
    return block


def _number(A: PETSc.Mat, names: IntArray, size: int) -> None:
    """Give local numbers to a matrix of one rank: blocks of rows and columns, -1: none."""
    numbers = PETSc.LGMap().create(names, size, MPI.COMM_SELF)
    A.setLGMap(numbers, numbers)
    numbers.destroy()


def assemble_scalar(form: Any) -> float:
    """Value of a compiled functional, summed over all ranks."""
    return float(form.mesh.comm.allreduce(fem.assemble_scalar(form), op=MPI.SUM))


def constrained_dofs(bcs: Sequence[Any]) -> IntArray:
    """Local dofs (owned and ghosts) that strong boundary conditions prescribe, unblocked, sorted."""
    parts = [bc.dof_indices()[0] for bc in bcs]
    return np.unique(np.concatenate(parts)).astype(np.int32) if parts else np.empty(0, dtype=np.int32)


def apply_values(function: fem.Function, bcs: Sequence[Any]) -> None:
    """Write the prescribed values of ``bcs`` into ``function``, ghosts included."""
    if bcs:
        petsc.set_bc(petsc_vector(function), list(bcs))
        function.x.scatter_forward()


def nodes_on_facets(space: fem.FunctionSpace, facets: IntArray) -> IntArray:
    """Nodes (block dofs) of a scalar or blocked Lagrange space on facets (collective), sorted.

    Args:
        space: the space.
        facets: local facets of this rank.
    """
    domain = space.mesh
    dim = domain.topology.dim - 1
    domain.topology.create_connectivity(dim, dim + 1)
    return np.sort(fem.locate_dofs_topological(space, dim, facets)).astype(np.int32)


def prescribed_component(space: fem.FunctionSpace, component: int, facets: IntArray) -> tuple[fem.Function, Any]:
    """Strong condition on one component of a blocked or mixed space on facets (collective).

    Args:
        space: the space.
        component: index of the component.
        facets: local facets of this rank.

    Returns:
        The function whose values are prescribed, zero at first, and a dolfinx boundary condition.
    """
    domain = space.mesh
    dim = domain.topology.dim - 1
    domain.topology.create_connectivity(dim, dim + 1)
    view = component_view(space, component)
    values = fem.Function(component_space(space, component)[0])
    dofs = fem.locate_dofs_topological((view, values.function_space), dim, facets)
    return values, fem.dirichletbc(values, dofs, view)


def fixed_component(space: fem.FunctionSpace, component: int, dofs: IntArray) -> Any:
    """Strong condition that makes one component zero at given dofs.

    Args:
        space: blocked or mixed space.
        component: index of the component.
        dofs: local indices in the array of a function of the space.

    Returns:
        A dolfinx boundary condition.
    """
    return fem.dirichletbc(PETSc.ScalarType(0.0), np.sort(dofs).astype(np.int32), component_view(space, component))


def fixed_nodes(space: fem.FunctionSpace, nodes: IntArray) -> Any:
    """Strong condition that holds all components of a scalar or blocked space at given nodes.

    Args:
        space: the space.
        nodes: local block dofs.

    Returns:
        A dolfinx boundary condition.
    """
    return fem.dirichletbc(fem.Function(space), nodes)


def pin_component(
    space: fem.FunctionSpace, component: int, where: Callable[[FloatArray], NDArray[np.bool_]], value: float = 0.0
) -> Any:
    """Strong condition on one component at the nodes that a predicate selects.

    Args:
        space: blocked or mixed space.
        component: index of the component.
        where: maps coordinates of shape (3, n) to a mask of shape (n,).
        value: prescribed value, in the unit of the component.

    Returns:
        A dolfinx boundary condition.

    Raises:
        ValueError: no node on any rank satisfies ``where``, or the arguments come in another order.
    """
    if not callable(where):
        raise ValueError(f"where = {where!r}: a predicate is required, after the space and the component")
    collapsed, parent = component_space(space, component)
    nodes = np.flatnonzero(where(collapsed.tabulate_dof_coordinates().T))
    if space.mesh.comm.allreduce(len(nodes), op=MPI.SUM) == 0:
        raise ValueError(f"where = {where!r} selects no node of component {component}; at least one is needed")
    dofs = np.sort(parent[nodes]).astype(np.int32)
    return fem.dirichletbc(PETSc.ScalarType(value), dofs, component_view(space, component))
