"""Measures of a spline's physical reference configuration."""

from copy import copy
from typing import Any, Self

import ufl

from tigar_x import checks


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
