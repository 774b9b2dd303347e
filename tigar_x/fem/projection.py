"""Projection onto finite element spaces."""

from typing import Any

import ufl
from dolfinx import fem

from tigar_x import checks, compat
from tigar_x.fem.newton import newton
from tigar_x.fem.solve import FiniteElementSystem


def project(function: fem.Function, expression: Any, degree: int | None = None) -> None:
    """Project in L2 onto the space of a function (collective).

    Args:
        function: target; its space may have any number of components.
        expression: UFL expression of the same shape over its mesh.
        degree: of quadrature; None: 2 k + 2 for elements of degree k.

    Raises:
        ValueError: the expression has another shape.
        SolveError: the projection failed, as that of an expression that is not finite does.
    """
    V = function.function_space
    f = ufl.as_ufl(expression)
    if f.ufl_shape != function.ufl_shape:
        raise ValueError(f"expression has shape {f.ufl_shape}: that of the function, {function.ufl_shape}, is required")
    if degree is None:
        degree = 2 * compat.lagrange_degree(V) + 2
    dx = ufl.dx(domain=V.mesh, metadata={"quadrature_degree": checks.whole("degree", degree, 0)})
    residual = ufl.inner(function - f, ufl.TestFunction(V)) * dx
    function.x.array[:] = 0.0  # else a start that is the projection already leaves nothing but rounding to reduce
    newton(FiniteElementSystem(residual, function, prefix="projection_"), rtol=1e-10)
