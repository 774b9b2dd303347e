"""The equations of a shell at a level of time or load: residual, tangent, and what its energy and modes consist of."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property

import ufl
from dolfinx import fem

from shnapr.conditions import Load, ShellFields
from shnapr.loads import inertia
from shnapr.work import Material, internal_tangent, internal_work, strain_energy
from tigar_x.fem.time_integration import LoadStepper, TimeIntegrator
from tigar_x.splines.spline import ExtractedSpline


class Displacements:
    """Equations whose unknown is the displacement.

    Args:
        spline: the midsurface.
        material: the material.
        density: rho_s; None: none.
        loads: what acts on the shell.
        clock: integrator of the displacement, or in statics its load factor.

    Attributes:
        clock: as given.
        space: of the displacement, which is the spline itself: it knows positions, of which residuals round off.
        fields: what the loads see.
    """

    def __init__(
        self,
        spline: ExtractedSpline,
        material: Material,
        density: fem.Constant | None,
        loads: Sequence[Load],
        clock: TimeIntegrator | LoadStepper,
    ) -> None:
        self.clock, self.space = clock, spline
        self._spline, self._material, self._loads, self._y = spline, material, loads, clock.x
        thickness = getattr(material, "thickness", None)
        y, v, t = clock.x, None, clock.t
        if isinstance(clock, TimeIntegrator):
            y, v, t = clock.x_alpha, clock.xdot_alpha, clock.t_alpha
        is_static = isinstance(clock, LoadStepper)
        self.fields = ShellFields(spline, y, v, ufl.TestFunction(spline.V), t, is_static, density, thickness)
        self._terms = acting(loads, self.fields)
        if isinstance(clock, TimeIntegrator):
            mass = self.fields.mass("a shell that moves in time")
            self._terms.insert(0, inertia(spline, clock.xddot_alpha, self.fields.z, **mass))

    @cached_property
    def residual(self) -> ufl.Form:
        """Residual without contact."""
        return sum(self._terms, internal_work(self._spline, self._material, self.fields.y, self.fields.z))

    @cached_property
    def tangent(self) -> ufl.Form:
        """Its derivative by the displacement."""
        own = internal_tangent(self._spline, self._material, self.fields.y, self.fields.z, self._y)
        return with_derivatives(own, self._terms, self._y)

    def energies(self) -> list[ufl.Form]:
        """Elastic energy of the present state, and in time the kinetic one of the last accepted state."""
        elastic = strain_energy(self._spline, self._material, self._y)
        if not isinstance(self.clock, TimeIntegrator):
            return [elastic]
        v, mass = self._spline.rationalize(self.clock.xdot_old), self.fields.mass("kinetic energy")
        return [elastic, mass["density"] * mass["thickness"] / 2 * ufl.inner(v, v) * self._spline.dx]

    def vibration(self) -> tuple[ufl.Form, ufl.Form]:
        """Stiffness and mass about the present state, bilinear forms.

        Raises:
            ValueError: there is no density.
        """
        present = replace(self.fields, y=self._y, v=None, t=self.clock.t)
        mass = inertia(self._spline, ufl.TrialFunction(self._spline.V), present.z, **present.mass("modes"))
        own = internal_tangent(self._spline, self._material, self._y, present.z, self._y)
        return with_derivatives(own, acting(self._loads, present), self._y), mass


def acting(loads: Sequence[Load], fields: ShellFields) -> list[ufl.Form]:
    """Terms of loads; those that do nothing have none."""
    return [term for term in (load.term(fields) for load in loads) if term is not None]


def with_derivatives(own: ufl.Form, terms: Sequence[ufl.Form], unknown: fem.Function) -> ufl.Form:
    """A tangent together with the derivatives of those terms that depend on the unknown."""
    depend = [term for term in terms if any(c is unknown for c in term.coefficients())]
    return sum((ufl.derivative(term, unknown) for term in depend), own)
