"""Measures of a spline's physical reference configuration."""

from copy import copy
from typing import Any, Self

import numpy as np
import ufl
from mpi4py import MPI
from dolfinx import fem, mesh
from petsc4py import PETSc

from tigar_x import checks, compat
from tigar_x.compat import FloatArray
from tigar_x.geometry.net import ControlNet


class SplineMeasure:
    """Integration over the physical reference configuration: ``integrand * measure`` gives a form.

    Attributes:
        jacobian: physical length, area or volume per parametric one.
        measure: UFL measure of the parametric mesh with its quadrature degree.
    """

    def __init__(self, jacobian: Any, measure: ufl.Measure) -> None:
        self.jacobian = jacobian
        self.measure = measure

    def __rmul__(self, integrand: Any) -> ufl.Form:
        """Form of ``integrand``."""
        return integrand * self.jacobian * self.measure

    def of_degree(self, quadrature_degree: int) -> Self:
        """The same measure with another quadrature degree.

        Args:
            quadrature_degree: 0 or more.

        Raises:
            ValueError: another number.
        """
        degree = checks.whole("quadrature_degree", quadrature_degree, 0)
        other = copy(self)
        other.measure = self.measure(metadata={"quadrature_degree": degree})
        return other


class SideMeasure(SplineMeasure):
    """Integration over sides of the patches in the reference configuration.

    Attributes:
        normal: outward unit normal of the parametric domain, shape (parametric dimension,).
    """

    def __init__(self, jacobian: Any, measure: ufl.Measure, normal: Any) -> None:
        super().__init__(jacobian, measure)
        self.normal = normal


def nodal_integrals(V: fem.FunctionSpace, dx: SplineMeasure) -> FloatArray:
    """Integrals of the nodal functions of a scalar space (collective).

    Args:
        V: the space.
        dx: measure.

    Returns:
        One for each of this rank's nodes, ghosts included, shape (nodes,).
    """
    integrals = compat.create_vector(V)
    compat.assemble_vector(integrals, compat.compile_forms(ufl.TestFunction(V) * dx)[0])
    integrals.ghostUpdate(PETSc.InsertMode.ADD, PETSc.ScatterMode.REVERSE)
    integrals.ghostUpdate(PETSc.InsertMode.INSERT, PETSc.ScatterMode.FORWARD)
    with integrals.localForm() as local:
        return local.array.copy()


def refuse_flat_elements(domain: mesh.Mesh, dx: SplineMeasure, geometry: ControlNet) -> None:
    """Refuse a spline with an element that has no length, area or volume (collective).

    Args:
        domain: parametric mesh.
        dx: measure of the reference configuration.
        geometry: its control points.

    Raises:
        ValueError: there is one.
    """
    cells = compat.lagrange_space(domain, 0)
    sizes = compat.create_vector(cells)
    compat.assemble_vector(sizes, compat.compile_forms(ufl.TestFunction(cells) * dx)[0])
    worst = np.nan_to_num(sizes.array_r, nan=0.0).min(initial=np.inf)
    points = geometry.points
    rounding = 1e-14 * np.abs(points).max() * np.ptp(points, axis=0).max() ** (geometry.dim - 1)
    if not domain.comm.allreduce(worst, op=MPI.MIN) > rounding:
        raise ValueError("geometry has an element of zero length or area: distinct control points are required")


def require_sides(name: str, value: Any, domain: Any) -> None:
    """Refuse what is not a measure of a spline's sides, such as one of UFL's, which knows parameters only.

    Args:
        name: what messages call it.
        value: from :meth:`tigar_x.splines.spline.ExtractedSpline.ds`.
        domain: the spline's parametric mesh.

    Raises:
        ValueError: it is another measure, or none.
    """
    if not isinstance(value, SideMeasure):
        raise ValueError(f"{name} = {value!r}: a measure of the spline's sides is required, such as spline.ds('u1')")
    checks.measure(name, value.measure, domain, "exterior_facet")
