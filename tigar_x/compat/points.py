"""Fields that live at the points of a quadrature, cell by cell, and expressions there."""

from typing import Any

import basix
import numpy as np
import ufl
from dolfinx import fem, mesh

from tigar_x.compat.forms import JIT, compiling
from tigar_x.compat.jit import safe_cache
from tigar_x.compat.meshes import cell_name
from tigar_x.compat.release import VERSION, FloatArray, IntArray
from tigar_x.compat.spaces import cell_dofs
from tigar_x.moved import guide

__getattr__ = guide(__name__)

if VERSION < (0, 9):

    def _space(domain: mesh.Mesh, degree: int, size: int) -> fem.FunctionSpace:
        cell = domain.ufl_cell()
        element = ufl.VectorElement("Quadrature", cell, degree, quad_scheme="default", dim=size)
        return fem.FunctionSpace(domain, element, **JIT)

else:
    import basix.ufl

    def _space(domain: mesh.Mesh, degree: int, size: int) -> fem.FunctionSpace:
        element = basix.ufl.quadrature_element(cell_name(domain), value_shape=(size,), degree=degree)
        return fem.functionspace(domain, element)  # type: ignore[attr-defined]


class PointField:
    """A vector field known at the points of a quadrature alone, as a coefficient of forms.

    Args:
        domain: mesh.
        degree: of the quadrature, which the measures of the forms must have as well.
        size: number of components.

    Attributes:
        function: the coefficient; it is zero at first.
        points: reference coordinates of the points, shape (points per cell, dimension of the cell).
    """

    def __init__(self, domain: mesh.Mesh, degree: int, size: int) -> None:
        self.points: FloatArray = basix.make_quadrature(getattr(basix.CellType, cell_name(domain)), degree)[0]
        with compiling(), safe_cache(f"values at the points of a quadrature of degree {degree}"):
            space = _space(domain, degree, size)
        self.function = fem.Function(space)
        self._size, self._dofs = size, cell_dofs(space)

    def assign(self, values: FloatArray) -> None:
        """Set the values.

        Args:
            values: of all local cells, shape (cells, points per cell times components).
        """
        self.function.x.array.reshape(-1, self._size)[self._dofs] = values.reshape(*self._dofs.shape, self._size)


class VectorAtPoints:
    """A UFL vector at the points of cells, compiled once and evaluated as often as what is in it has changed.

    Args:
        expression: the vector.
        points: reference coordinates, shape (points per cell, dimension of the cell).
        domain: mesh.
    """

    def __init__(self, expression: Any, points: FloatArray, domain: mesh.Mesh) -> None:
        self._domain, self._width = domain, len(points) * int(expression.ufl_shape[0])
        with compiling(), safe_cache("a vector at the points of a quadrature"):
            self._compiled = fem.Expression(expression, points, **JIT)

    def __call__(self, cells: IntArray) -> FloatArray:
        """The values.

        Args:
            cells: local numbers.

        Returns:
            Shape (cells, points per cell times components).
        """
        where = (cells,) if VERSION < (0, 9) else (self._domain, cells)
        values = self._compiled.eval(*where) if len(cells) else np.empty(0)
        return np.asarray(values).reshape(len(cells), self._width)
