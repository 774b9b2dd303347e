"""The one place that knows which dolfinx it runs on.

Everything in the four packages that differs between dolfinx releases is spelled here, once; no other module asks for a
version. A release is supported when the test suite has run on it: at present 0.5 (Debian 12).

The module also owns form compilation: the C flags, the cache key and the time it takes.
"""

import hashlib
import logging
import platform
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import dolfinx
import numpy as np
import ufl
import ufl.sorting
from basix.ufl_wrapper import convert_ufl_element
from dolfinx import fem, geometry, mesh
from mpi4py import MPI
from numpy.typing import ArrayLike, NDArray
from petsc4py import PETSc

log = logging.getLogger(__name__)

VERSION = tuple(int(part) for part in dolfinx.__version__.split(".")[:2])
if VERSION != (0, 5):
    raise ImportError(f"dolfinx {dolfinx.__version__} was found; this release runs on dolfinx 0.5 (Debian 12)")

# UFL 2022.2 orders Constants by their printed count, so that 100 comes before 99 and the cache key of a form depends on
# how many Constants a process made before it; by number the order is stable.
ufl.sorting._terminal_cmps[ufl.Constant._ufl_typecode_] = ufl.sorting._cmp_coefficient

IntArray = NDArray[np.int32]
FloatArray = NDArray[np.float64]


# -- form compilation -------------------------------------------------------------------------------------------------


def _processor() -> str:
    """What ``-march=native`` depends on, so that a cache shared between machines never mixes them."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    keys = ("model name", "flags", "Features", "CPU part")
    known = sorted({line for line in lines if line.startswith(keys)})
    return hashlib.sha1("".join([platform.machine(), *known]).encode()).hexdigest()[:12]


# The members of -ffast-math that change neither the meaning of NaN and Inf nor the processor's treatment of denormals:
# -ffinite-math-only would make NaN tests lie, and linking with -ffast-math sets flush-to-zero for the whole process.
C_FLAGS = [
    "-O2",
    "-g0",
    "-march=native",
    "-ftree-vectorize",
    "-fno-math-errno",
    "-fno-trapping-math",
    "-fno-signed-zeros",
    "-fassociative-math",
    "-freciprocal-math",
    f"-DTIGAR_X_PROCESSOR={int(_processor(), 16)}ULL",
]
_JIT = {"cffi_extra_compile_args": C_FLAGS, "timeout": 600}
_compile_seconds = np.zeros(2)


def compile_seconds() -> float:
    """Wall seconds that this process has spent in building or loading forms and expressions so far [s]."""
    return float(_compile_seconds[0])


def compile_cpu_seconds() -> float:
    """CPU seconds of this process in the same; a compiler that it waits for is another process [s]."""
    return float(_compile_seconds[1])


@contextmanager
def _compiling() -> Iterator[None]:
    start = np.array([time.perf_counter(), time.process_time()])
    try:
        yield
    finally:
        _compile_seconds[:] += np.array([time.perf_counter(), time.process_time()]) - start


def compile_forms(*forms: ufl.Form) -> list[Any]:
    """Compile UFL forms with the project's C flags.

    All signatures are computed before the first compilation, because dolfinx 0.5 numbers coefficients on first use
    and a form's cache key would otherwise depend on what was compiled before it.

    Args:
        forms: UFL forms on one mesh.

    Returns:
        The compiled dolfinx forms, in the same order.
    """
    with _compiling():
        for form in forms:
            form.signature()
        return [fem.form(form, jit_params=_JIT) for form in forms]


def interpolate(function: fem.Function, expression: Any) -> None:
    """Interpolate a UFL expression into ``function`` (collective on its mesh).

    Args:
        function: target, in a Lagrange space.
        expression: UFL expression of the same value shape.
    """
    points = function.function_space.element.interpolation_points()
    with _compiling():
        compiled = fem.Expression(expression, points, jit_params=_JIT)
    function.interpolate(compiled)
    function.x.scatter_forward()


# -- elements and spaces ----------------------------------------------------------------------------------------------


def _function_space(domain: mesh.Mesh, element: Any) -> fem.FunctionSpace:
    with _compiling():
        return fem.FunctionSpace(domain, element, jit_params=_JIT)


def _lagrange_element(cell: str, degree: int, discontinuous: bool) -> Any:
    """UFL element: dolfinx places its nodes at Gauss-Lobatto-Legendre points, and mixed forms know its pullback."""
    return ufl.FiniteElement("DG" if discontinuous or degree == 0 else "Lagrange", cell, degree)


def lagrange_space(domain: mesh.Mesh, degree: int, size: int = 1, *, discontinuous: bool = False) -> fem.FunctionSpace:
    """Nodal Lagrange space with Gauss-Lobatto-Legendre node placement.

    Args:
        domain: mesh.
        degree: polynomial degree; 0 gives one constant per cell.
        size: number of components; 1 gives a scalar space, more a node-blocked vector space.
        discontinuous: whether every cell owns its nodes.

    Returns:
        The function space.
    """
    element = _lagrange_element(domain.ufl_cell().cellname(), degree, discontinuous)
    if size > 1:
        element = ufl.VectorElement(element, dim=size)
    return _function_space(domain, element)


def mixed_space(domain: mesh.Mesh, *parts: tuple[int, int]) -> fem.FunctionSpace:
    """Mixed Lagrange space.

    Args:
        domain: mesh.
        parts: (degree, number of components) of every part.

    Returns:
        The function space; component ``i`` of its functions counts through the parts in order.
    """
    cell = domain.ufl_cell().cellname()
    elements = []
    for degree, size in parts:
        element = _lagrange_element(cell, degree, False)
        elements.append(ufl.VectorElement(element, dim=size) if size > 1 else element)
    return _function_space(domain, ufl.MixedElement(elements))


def component_space(space: fem.FunctionSpace, component: int) -> tuple[fem.FunctionSpace, IntArray]:
    """Scalar space of one component of a scalar, blocked or mixed space, and where its dofs lie in the parent.

    Args:
        space: any Lagrange space or mixed space of such.
        component: index of the component, counted through all parts.

    Returns:
        The collapsed scalar space, and for each of its local dofs (owned, then ghosts) the local index in the
        parent's array.

    Raises:
        IndexError: no such component.
    """
    if space.num_sub_spaces == 0:
        if component:
            raise IndexError(f"component = {component}: the space is scalar, allowed is 0")
        dofmap = space.dofmap
        return space, np.arange(dofmap.index_map.size_local + dofmap.index_map.num_ghosts, dtype=np.int32)
    collapsed, parent = _component_view(space, component).collapse()
    return collapsed, np.asarray(parent, dtype=np.int32)


def _component_view(space: fem.FunctionSpace, component: int) -> fem.FunctionSpace:
    sub, remaining = space, component
    while sub.num_sub_spaces:
        for i in range(sub.num_sub_spaces):
            width = max(sub.sub(i).num_sub_spaces, 1)
            if remaining < width:
                sub = sub.sub(i)
                break
            remaining -= width
        else:
            raise IndexError(f"component = {component}: the space has no such component")
    return sub


def cell_dofs(space: fem.FunctionSpace) -> IntArray:
    """Local (block) dof numbers of every local cell, shape (cells, dofs per cell)."""
    dofs = space.dofmap.list
    return dofs.array.reshape(dofs.num_nodes, -1)


def tabulate(space: fem.FunctionSpace, points: FloatArray) -> FloatArray:
    """Scalar basis functions of a Lagrange space at reference points.

    Args:
        space: scalar or blocked Lagrange space on a simplex or tensor cell.
        points: reference coordinates, shape (n, topological dimension).

    Returns:
        Values, shape (n, dofs per cell).
    """
    if not len(points):
        return np.empty((0, cell_dofs(space).shape[1]))
    element = space.ufl_element()
    while element.num_sub_elements():
        element = element.sub_elements()[0]
    return convert_ufl_element(element).tabulate(0, points)[0].reshape(len(points), -1)


def node_points(space: fem.FunctionSpace) -> FloatArray:
    """Reference coordinates of the nodes of a Lagrange space, shape (dofs per cell, topological dimension)."""
    return np.asarray(space.element.interpolation_points())


# -- meshes and geometry ----------------------------------------------------------------------------------------------


def create_mesh(comm: MPI.Comm, cell: str, cells: ArrayLike, x: ArrayLike) -> mesh.Mesh:
    """Mesh of affine or multilinear cells from arrays.

    Args:
        comm: communicator; rank 0 gives the whole mesh, the other ranks give empty arrays of the same width.
        cell: UFL name of the cell.
        cells: vertices of the cells, shape (cells, vertices per cell), in dolfinx's ordering.
        x: coordinates, shape (vertices, geometric dimension).

    Returns:
        The distributed mesh.
    """
    points = np.asarray(x, dtype=np.float64)
    domain = ufl.Mesh(ufl.VectorElement("Lagrange", cell, 1, dim=points.shape[1]))
    return mesh.create_mesh(comm, cells=np.asarray(cells, dtype=np.int64), x=points, domain=domain)


def cell_vertices(domain: mesh.Mesh) -> FloatArray:
    """Coordinates of the vertices of all local cells, shape (cells, vertices, geometric dimension)."""
    dofmap = domain.geometry.dofmap
    dofs = dofmap.array.reshape(dofmap.num_nodes, -1)
    return domain.geometry.x[dofs][:, :, : domain.geometry.dim]


def owned_cells(domain: mesh.Mesh) -> int:
    """Number of cells that this rank owns; they come first in the local numbering."""
    return int(domain.topology.index_map(domain.topology.dim).size_local)


def bounding_box_tree(domain: mesh.Mesh, padding: float) -> Any:
    """Bounding box tree of the cells that this rank owns."""
    cells = np.arange(owned_cells(domain), dtype=np.int32)
    return geometry.BoundingBoxTree(domain, domain.topology.dim, cells, padding=padding)


def candidate_cells(tree: Any, points: FloatArray) -> tuple[IntArray, IntArray]:
    """Cells whose boxes contain points.

    Args:
        tree: from :func:`bounding_box_tree`.
        points: shape (n, 3).

    Returns:
        The cells, and offsets of shape (n + 1,) into them.
    """
    hits = geometry.compute_collisions(tree, points)
    return hits.array, hits.offsets


# -- linear algebra ---------------------------------------------------------------------------------------------------


def petsc_vector(function: fem.Function) -> PETSc.Vec:
    """PETSc vector that shares memory with a function."""
    return function.vector


def create_vector(space: fem.FunctionSpace) -> PETSc.Vec:
    """Zero vector with ghosts, in the layout of a space."""
    return dolfinx.la.create_petsc_vector(space.dofmap.index_map, space.dofmap.index_map_bs)


def create_matrix(form: Any, kind: str) -> PETSc.Mat:
    """Empty matrix with the sparsity of a compiled bilinear form.

    Args:
        form: compiled form.
        kind: PETSc type, "aij" or "baij".
    """
    return fem.petsc.create_matrix(form, kind)


def assemble_vector(b: PETSc.Vec, form: Any) -> None:
    """Overwrite the local part of ``b``, ghosts included, by the assembled form; ghosts are not yet summed."""
    with b.localForm() as local:
        local.set(0.0)
    fem.petsc.assemble_vector(b, form)


def assemble_matrix(A: PETSc.Mat, form: Any, bcs: Sequence[Any] = ()) -> None:
    """Overwrite ``A`` by the assembled form with unit rows at the dofs of ``bcs``; assembly is not finished."""
    A.zeroEntries()
    fem.petsc.assemble_matrix(A, form, list(bcs))  # type: ignore[arg-type]


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
        fem.petsc.set_bc(petsc_vector(function), list(bcs))
        function.x.scatter_forward()


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
        ValueError: no node on any rank satisfies ``where``.
    """
    collapsed, parent = component_space(space, component)
    nodes = np.flatnonzero(where(collapsed.tabulate_dof_coordinates().T))
    if space.mesh.comm.allreduce(len(nodes), op=MPI.SUM) == 0:
        raise ValueError(f"where = {where!r} selects no node of component {component}; at least one is needed")
    dofs = np.sort(parent[nodes]).astype(np.int32)
    return fem.dirichletbc(PETSc.ScalarType(value), dofs, _component_view(space, component))
