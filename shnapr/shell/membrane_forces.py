"""Equations of a static shell with membrane forces as unknowns of their own, see :mod:`shnapr.mixed`."""

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import ufl
from dolfinx import fem

from shnapr import mixed
from shnapr.conditions import Load, ShellFields
from shnapr.shell.equations import acting, with_derivatives
from shnapr.svk import StVenantKirchhoff
from tigar_x import checks
from tigar_x.fem.time_integration import LoadStepper
from tigar_x.splines.spline import ExtractedSpline


class MembraneForces:
    """Equations whose unknown is the displacement with the membrane forces.

    Args:
        spline: the midsurface.
        material: the material.
        density: rho_s, for loads; None: none.
        loads: what acts on the shell.
        y: gets the displacement.

    Attributes:
        clock: load factor, with the unknown.
        space: of the unknown.

    Raises:
        ValueError: the material is another one than St. Venant and Kirchhoff's.
    """

    def __init__(
        self,
        spline: ExtractedSpline,
        material: Any,
        density: fem.Constant | None,
        loads: Sequence[Load],
        y: fem.Function,
    ) -> None:
        checks.kind("material", material, StVenantKirchhoff, "for formulation = 'mixed' a StVenantKirchhoff")
        self.space = mixed.mixed_space(spline)
        self._spline, self._material, self._y = spline, material, y
        self._w, self._test = fem.Function(self.space.V, name="w"), ufl.TestFunction(self.space.V)
        self.clock = LoadStepper(self._w, 1.0)
        u, z = (mixed.displacement_part(spline, field) for field in (self._w, self._test))
        self._terms = acting(loads, ShellFields(spline, u, None, z, self.clock.t, True, density, material.thickness))

    @cached_property
    def residual(self) -> ufl.Form:
        """Residual."""
        return sum(self._terms, mixed.mixed_work(self._spline, self._material, self._w, self._test))

    @cached_property
    def tangent(self) -> ufl.Form:
        """Its derivative by the unknown."""
        own = mixed.mixed_tangent(self._spline, self._material, self._w, self._test)
        return with_derivatives(own, self._terms, self._w)

    def tell(self) -> None:
        """Bring the displacement to the present state (collective)."""
        self._y.x.array[:] = mixed.displacement(self._spline, self.space, self._w).x.array

    def reset(self) -> None:
        """Make it undeformed."""
        self._w.x.array[:] = 0.0
        self._y.x.array[:] = 0.0
