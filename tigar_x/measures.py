"""Measures of a spline's physical reference configuration."""

from typing import Any

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

    def of_degree(self, quadrature_degree: int) -> "SplineMeasure":
        """The same measure with another quadrature degree.

        Args:
            quadrature_degree: 0 or more.

        Raises:
            ValueError: another number.
        """
        degree = checks.whole("quadrature_degree", quadrature_degree, 0)
        return SplineMeasure(self.jacobian, self.measure(metadata={"quadrature_degree": degree}))


class SideMeasure(SplineMeasure):
    """Integration over sides of the patches in the reference configuration.

    Attributes:
        normal: outward unit normal of the parametric domain, shape (parametric dimension,).
    """

    def __init__(self, jacobian: Any, measure: ufl.Measure, normal: Any) -> None:
        super().__init__(jacobian, measure)
        self.normal = normal
