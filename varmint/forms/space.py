"""The equal-order space of velocity and pressure."""

from typing import Any

import ufl
from dolfinx import fem, mesh

from tigar_x import checks, compat


def equal_order_space(domain: mesh.Mesh, degree: int = 1) -> fem.FunctionSpace:
    """One vector element of value size d + 1: d velocity components, then the pressure, at every node.

    The node-blocked layout assembles into PETSc's BAIJ matrices, whose block factorisations suit the system.

    Args:
        domain: mesh of dimension d = 2 or 3.
        degree: polynomial degree k of velocity and pressure.

    Returns:
        The space.

    Raises:
        ValueError: degree < 1 or another dimension.
    """
    d = checks.choice("dimension of domain", domain.geometry.dim, (2, 3))
    return compat.lagrange_space(domain, checks.whole("degree", degree, 1), d + 1)


def split(u: Any) -> tuple[Any, Any]:
    """Velocity and pressure of a field with d + 1 components.

    Args:
        u: function, test function or expression of shape (d + 1,), in a blocked or a mixed space.

    Returns:
        Velocity of shape (d,) and pressure.
    """
    d = u.ufl_shape[0] - 1
    return ufl.as_vector([u[i] for i in range(d)]), u[d]
