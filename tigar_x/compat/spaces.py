"""Elements, function spaces, where their dofs lie, and interpolation."""

from typing import Any

import numpy as np
import ufl
import ufl.corealg.traversal
from mpi4py import MPI
from dolfinx import fem, mesh
from ufl.algorithms.apply_algebra_lowering import apply_algebra_lowering
from ufl.algorithms.apply_derivatives import apply_derivatives

from tigar_x.compat.forms import JIT, compiling
from tigar_x.compat.jit import safe_cache
from tigar_x.compat.meshes import cell_name, cell_nodes, is_simplex, owned_cells
from tigar_x.compat.release import VERSION, FloatArray, IntArray, as_table
from tigar_x.moved import guide

__getattr__ = guide(__name__)

# Nodes lie at Gauss-Lobatto-Legendre points, which is the default of all releases.
if VERSION < (0, 9):
    from basix.ufl_wrapper import convert_ufl_element

    def _lagrange(cell: str, degree: int, size: int, discontinuous: bool) -> Any:
        element = ufl.FiniteElement("DG" if discontinuous or degree == 0 else "Lagrange", cell, degree)
        return ufl.VectorElement(element, dim=size) if size > 1 else element

    def _mixed(elements: list[Any]) -> Any:
        return ufl.MixedElement(elements)

    def _function_space(domain: mesh.Mesh, element: Any) -> fem.FunctionSpace:
        with compiling(), safe_cache(f"the element {element}"):
            return fem.FunctionSpace(domain, element, **JIT)

    def _scalar_element(space: fem.FunctionSpace) -> Any:
        element = space.ufl_element()
        while element.num_sub_elements():
            element = element.sub_elements()[0]
        return convert_ufl_element(element)

else:
    import basix.ufl

    def _lagrange(cell: str, degree: int, size: int, discontinuous: bool) -> Any:
        shape = (size,) if size > 1 else None
        return basix.ufl.element("DG" if discontinuous or degree == 0 else "Lagrange", cell, degree, shape=shape)

    def _mixed(elements: list[Any]) -> Any:
        return basix.ufl.mixed_element(elements)

    def _function_space(domain: mesh.Mesh, element: Any) -> fem.FunctionSpace:
        return fem.functionspace(domain, element)  # type: ignore[attr-defined]

    def _scalar_element(space: fem.FunctionSpace) -> Any:
        return space.ufl_element().basix_element


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
    return _function_space(domain, _lagrange(cell_name(domain), degree, size, discontinuous))


def mixed_lagrange_space(domain: mesh.Mesh, *parts: tuple[int, int]) -> fem.FunctionSpace:
    """Mixed Lagrange space.

    Args:
        domain: mesh.
        parts: (degree, number of components) of every part.

    Returns:
        The function space; component ``i`` of its functions counts through the parts in order.
    """
    elements = [_lagrange(cell_name(domain), degree, size, False) for degree, size in parts]
    return _function_space(domain, _mixed(elements))


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
    view = component_view(space, component)
    if _some_rank_is_empty(space.mesh):  # where collapse() crashes
        scalar = lagrange_space(space.mesh, lagrange_degree(view))
        map = scalar.dofmap.index_map
        parent = np.zeros(map.size_local + map.num_ghosts, dtype=np.int32)
        parent[cell_dofs(scalar)] = cell_dofs(view)
        return scalar, parent
    collapsed, parent = view.collapse()
    return collapsed, np.asarray(parent if VERSION < (0, 11) else parent[0], dtype=np.int32)


def _some_rank_is_empty(domain: mesh.Mesh) -> bool:
    """Whether there is a rank without a cell (collective)."""
    return domain.comm.size > 1 and bool(domain.comm.allreduce(len(cell_nodes(domain)) == 0, op=MPI.LOR))


def component_view(space: fem.FunctionSpace, component: int) -> fem.FunctionSpace:
    """Sub space of one component, as strong conditions want it; arguments as in :func:`component_space`."""
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
    rows = space.dofmap.list
    if VERSION < (0, 9) and rows.num_nodes == 0:
        return np.zeros((0, space.dofmap.dof_layout.num_dofs), dtype=np.int32)
    return as_table(rows)


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
    return _scalar_element(space).tabulate(0, points)[0].reshape(len(points), -1)


def tabulate_gradients(space: fem.FunctionSpace, points: FloatArray) -> FloatArray:
    """Derivatives of the scalar basis functions of a Lagrange space by the reference coordinates.

    Args:
        space: scalar or blocked Lagrange space on a simplex or tensor cell.
        points: reference coordinates, shape (n, topological dimension).

    Returns:
        Values, shape (n, dofs per cell, topological dimension).
    """
    derivatives = np.asarray(_scalar_element(space).tabulate(1, points))[1:]
    return np.moveaxis(derivatives.reshape(points.shape[1], len(points), -1), 0, -1)


def node_points(space: fem.FunctionSpace) -> FloatArray:
    """Reference coordinates of the nodes of a Lagrange space, shape (dofs per cell, topological dimension)."""
    points = space.element.interpolation_points
    return np.asarray(points() if VERSION < (0, 11) else points)


def lagrange_degree(space: fem.FunctionSpace) -> int:
    """Polynomial degree of a scalar or blocked Lagrange space."""
    degree = _scalar_element(space).degree
    return int(degree() if VERSION < (0, 9) else degree)


def unknowns(space: fem.FunctionSpace) -> int:
    """Number of degrees of freedom on all ranks (not collective)."""
    return int(space.dofmap.index_map.size_global * space.dofmap.index_map_bs)


def subcells(space: fem.FunctionSpace) -> tuple[str, IntArray]:
    """Linear cells between neighbouring nodes, ``degree`` of them per direction in every element.

    Args:
        space: Lagrange space.

    Returns:
        meshio's name of the cells ("line", "quad", "hexahedron", "triangle" or "tetra"), and node numbers around each
        of those that this rank owns, quadrilaterals and hexahedra in cyclic order, shape (subcells, corners).
    """
    reference = node_points(space)
    dim = reference.shape[1]
    if is_simplex(space.mesh):
        from scipy.spatial import Delaunay

        kind, local = ("triangle", "tetra")[dim - 2], Delaunay(reference).simplices
    else:
        n = round(len(reference) ** (1.0 / dim))
        grid = np.lexsort(np.round(reference, 9).T).reshape((n,) * dim)  # the last coordinate varies slowest
        low, high = slice(None, -1), slice(1, None)
        square: list[Any] = [(low, low), (low, high), (high, high), (high, low)]
        corners = [[(low,), (high,)], square, [(end, *corner) for end in (low, high) for corner in square]]
        kind = ("line", "quad", "hexahedron")[dim - 1]
        local = np.stack([grid[corner] for corner in corners[dim - 1]], axis=-1).reshape(-1, 2**dim)
    dofs = cell_dofs(space)[: owned_cells(space.mesh)]
    return kind, dofs[:, local].reshape(-1, local.shape[1])


class Interpolation:
    """Interpolation of a UFL expression, compiled once and repeated as often as what is in it has changed.

    Args:
        function: target, in a Lagrange space.
        expression: UFL expression of the same value shape.
        cells: local cells to whose nodes it is restricted; None: all.

    Raises:
        ValueError: the shapes differ.
    """

    def __init__(self, function: fem.Function, expression: Any, cells: IntArray | None = None) -> None:
        if expression.ufl_shape != function.ufl_shape:
            raise ValueError(f"expression has shape {expression.ufl_shape}: shape {function.ufl_shape} is required")
        self._function = function
        self._cells = cells
        self._numbers: FloatArray | None = None
        expression = apply_derivatives(apply_algebra_lowering(expression))  # which may leave numbers alone
        if _contains(expression, ufl.Coefficient, ufl.Constant, ufl.classes.GeometricQuantity):
            space = function.function_space
            if not _contains(expression, ufl.Coefficient, ufl.classes.GeometricQuantity):
                # Constants alone do not tell every release where they are
                here = fem.Constant(space.mesh, 0.0) * ufl.SpatialCoordinate(space.mesh)[0]
                shape = expression.ufl_shape
                expression = expression + (ufl.as_vector([here] * shape[0]) if shape else here)
            with compiling(), safe_cache(f"an expression at the nodes of {function.name}"):
                self._compiled = fem.Expression(expression, node_points(space), **JIT)
        else:
            shape = expression.ufl_shape
            self._numbers = np.array([float(expression[i]) for i in range(shape[0])] if shape else float(expression))

    def __call__(self) -> None:
        """Interpolate (collective)."""
        if self._numbers is not None:
            nodes = (
                slice(None) if self._cells is None else cell_dofs(self._function.function_space)[self._cells].ravel()
            )
            self._function.x.array.reshape(-1, self._numbers.size)[nodes] = self._numbers
            self._function.x.scatter_forward()
            return
        arguments = () if self._cells is None else (self._cells,)
        self._function.interpolate(self._compiled, *arguments)
        self._function.x.scatter_forward()


def _contains(expression: Any, *kinds: type) -> bool:
    """Whether there are terminals of some kinds in an expression."""
    return any(isinstance(leaf, kinds) for leaf in ufl.corealg.traversal.traverse_unique_terminals(expression))


def interpolate(function: fem.Function, expression: Any) -> None:
    """Interpolate a UFL expression into ``function`` (collective on its mesh).

    Args:
        function: target, in a Lagrange space.
        expression: UFL expression of the same value shape.
    """
    Interpolation(function, expression)()
