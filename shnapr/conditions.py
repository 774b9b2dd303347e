"""Loads of a shell as values: what acts on it, and on which edges.

Data are numbers, UFL or dolfinx Constants, or a callable of position and time that returns UFL. The position is that of
the reference where the load is dead, the present one where it follows the shell.

In statics the time is the load factor, which goes from 0 to 1 as the shell is loaded. Numbers, UFL and Constants grow
with it in proportion. A callable says itself how it depends on it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import ufl

from shnapr import loads
from tigar_x import checks, compat
from tigar_x.compat import Data
from tigar_x.splines.measures import SideMeasure
from tigar_x.splines.spline import ExtractedSpline

__all__ = ["Damping", "DeadLoad", "EdgeForce", "EdgeMoment", "Gravity", "Load", "Pressure", "ShellFields"]


@dataclass(frozen=True)
class ShellFields:
    """What loads see of a shell.

    Attributes:
        spline: the midsurface.
        y: homogeneous displacement at the level of the equations, shape (nsd,).
        v: its rate; None: statics.
        z: test function.
        t: time of the equations, in statics the load factor.
        is_static: whether numbers are to grow with the load factor.
        density: rho_s; None: not known.
        thickness: h; None: not known.
    """

    spline: ExtractedSpline
    y: Any
    v: Any
    z: Any
    t: Any
    is_static: bool
    density: Any = None
    thickness: Any = None

    def scalar(self, name: str, data: Data, *, follows: bool = False) -> Any:
        """UFL scalar of data.

        Args:
            name: what messages call it.
            data: see the module.
            follows: whether a callable gets the present position.

        Raises:
            ValueError: it is no finite scalar.
        """
        value = self._given(name, data, follows)
        checks.parameter(name, value, checks.finite)
        return self._scaled(data, value)

    def vector(self, name: str, data: Data) -> Any:
        """UFL vector of data at the reference position.

        Args:
            name: what messages call it.
            data: see the module.

        Raises:
            ValueError: it is not a finite vector of shape (nsd,).
        """
        return self._scaled(data, checks.vector(name, self._given(name, data, False), self.spline.nsd))

    def mass(self, name: str) -> dict[str, Any]:
        """Density and thickness.

        Args:
            name: of what needs them.

        Raises:
            ValueError: one is not known.
        """
        for what, value in (("density", self.density), ("material.thickness", self.thickness)):
            if value is None:
                raise ValueError(f"{what} = None: one is required, for {name}")
        return {"density": self.density, "thickness": self.thickness}

    def ds(self, on: str | Sequence[str], patch: int | None) -> SideMeasure:
        """Measure of edges by name.

        Raises:
            ValueError: none is named, or there is no such edge or patch.
        """
        sides = (on,) if isinstance(on, str) else tuple(on)
        if not sides:
            raise ValueError("on is empty: the name of an edge is required")
        return self.spline.ds(*sides, patch=patch)

    def _given(self, name: str, data: Data, follows: bool) -> Any:
        here = self.spline.F + self.spline.rationalize(self.y) if follows else self.spline.F
        return compat.given(name, data, here, self.t)

    def _scaled(self, data: Data, value: Any) -> Any:
        return self.t * value if self.is_static and not compat.is_function(data) else value


class Load(Protocol):
    """What a shell asks of a load; those of users need no more."""

    def term(self, fields: ShellFields) -> ufl.Form | None:
        """Residual form; None: there is none in statics."""


@dataclass(frozen=True)
class DeadLoad:
    """Force per reference area (in the plane: per reference length and depth) that keeps its direction.

    Attributes:
        force: shape (nsd,).
    """

    force: Data

    def term(self, fields: ShellFields) -> ufl.Form:
        """See :class:`Load`."""
        return loads.dead_load(fields.spline, fields.vector("DeadLoad.force", self.force), fields.z)


@dataclass(frozen=True)
class Gravity:
    """Weight; the shell needs a density.

    Attributes:
        acceleration: shape (nsd,); unit: length/time^2.
    """

    acceleration: Data

    def term(self, fields: ShellFields) -> ufl.Form:
        """See :class:`Load`."""
        g = fields.vector("Gravity.acceleration", self.acceleration)
        return loads.gravity(fields.spline, g, fields.z, **fields.mass("Gravity"))


@dataclass(frozen=True)
class Pressure:
    """Pressure along the present normal on the present area.

    Attributes:
        value: positive along a_3; unit: force/length^2.
    """

    value: Data

    def term(self, fields: ShellFields) -> ufl.Form:
        """See :class:`Load`."""
        pressure = fields.scalar("Pressure.value", self.value, follows=True)
        return loads.follower_pressure(fields.spline, pressure, fields.y, fields.z)


@dataclass(frozen=True)
class EdgeForce:
    """Force on edges that keeps its direction.

    Attributes:
        on: name of an edge, or several.
        force: per reference length of the edge (in the plane: at the point, per depth), shape (nsd,).
        patch: whose edges; None: those of all patches.
    """

    on: str | Sequence[str]
    force: Data
    patch: int | None = None

    def term(self, fields: ShellFields) -> ufl.Form:
        """See :class:`Load`."""
        force = fields.vector(f"EdgeForce({self.on!r}).force", self.force)
        return loads.edge_traction(fields.spline, force, fields.z, fields.ds(self.on, self.patch))


@dataclass(frozen=True)
class EdgeMoment:
    """Moment about the present tangent of edges, see :func:`shnapr.loads.edge_moment`.

    Attributes:
        on: name of an edge, or several.
        moment: turns the outward conormal towards +a_3; per reference length of the edge (in the plane: at the point,
            per depth).
        patch: whose edges; None: those of all patches.
    """

    on: str | Sequence[str]
    moment: Data
    patch: int | None = None

    def term(self, fields: ShellFields) -> ufl.Form:
        """See :class:`Load`."""
        moment = fields.scalar(f"EdgeMoment({self.on!r}).moment", self.moment, follows=True)
        return loads.edge_moment(fields.spline, moment, fields.y, fields.z, fields.ds(self.on, self.patch))


@dataclass(frozen=True)
class Damping:
    """Damping in proportion to mass; it does nothing in statics. The shell needs a density.

    Attributes:
        coefficient: c >= 0, a number, Constant or UFL scalar; unit: 1/time.
    """

    coefficient: Any

    def term(self, fields: ShellFields) -> ufl.Form | None:
        """See :class:`Load`."""
        mass = fields.mass("Damping")
        if fields.v is None:
            return None
        return loads.mass_damping(fields.spline, fields.v, fields.z, coefficient=self.coefficient, **mass)
