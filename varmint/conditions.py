"""Boundary conditions of a flow as values: what holds on which named facets.

Data are given as numbers, as UFL or dolfinx Constants, or as a callable of present coordinates and time that returns
UFL. A callable gets the time that its condition needs: the end of the step where values are imposed strongly, the
level of the equations elsewhere.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import ufl
from mpi4py import MPI

from tigar_x import checks, compat
from tigar_x.compat import Data, IntArray
from tigar_x.moved import guide
from varmint.forms import ale, boundary
from varmint.forms.ale import Motion
from varmint.mesh.named import NamedMesh

__getattr__ = guide(__name__)


@dataclass(frozen=True)
class FlowFields:
    """What conditions see of a flow.

    Attributes:
        mesh: mesh with named facets.
        v: velocity at the level of the equations.
        p: pressure.
        w: test function of v.
        q: test function of p.
        rho: density.
        mu: dynamic viscosity.
        t: end of the step.
        t_alpha: time of the equations.
        motion: motion of the mesh at the level of the equations; None: it is fixed.
        motion_end: the same at the end of the step.
        invariant: whether the invariant metric is used.
        degree: of quadrature.
    """

    mesh: NamedMesh
    v: Any
    p: Any
    w: Any
    q: Any
    rho: Any
    mu: Any
    t: Any
    t_alpha: Any
    motion: Motion | None
    motion_end: Motion | None
    invariant: bool
    degree: int

    @property
    def d(self) -> int:
        """Dimension of space."""
        return int(self.mesh.domain.geometry.dim)

    def vector(self, name: str, data: Data, *, end: bool = False) -> Any:
        """UFL vector of data.

        Args:
            name: what messages call it.
            data: see the module.
            end: whether it belongs to the end of the step.

        Raises:
            ValueError: it is not a finite vector of shape (d,).
        """
        domain, motion = self.mesh.domain, self.motion_end if end else self.motion
        values = compat.given(name, data, ale.position(domain, motion), self.t if end else self.t_alpha)
        return checks.vector(name, values, self.d)

    def mesh_velocity(self, *, end: bool = False) -> Any:
        """Velocity of the mesh; zero where it is fixed."""
        motion = self.motion_end if end else self.motion
        return ufl.as_vector([0.0] * self.d) if motion is None else motion.velocity

    def ds(self, on: tuple[str, ...]) -> ufl.Measure:
        """Measure of facet groups."""
        return self.mesh.ds(*on, degree=self.degree)


def _groups(on: str | Sequence[str]) -> tuple[str, ...]:
    names = (on,) if isinstance(on, str) else tuple(checks.listed("on", on))
    if not names:
        raise ValueError("on is empty: the name of a facet group is required")
    if not all(isinstance(name, str) for name in names):
        raise ValueError(f"on = {on!r}: the name of a facet group is required, or several")
    return names


@dataclass(frozen=True)
class Prescribed:
    """A velocity component that is prescribed at the nodes of facets.

    Attributes:
        component: its index.
        facets: local facets.
        value: UFL scalar at the end of the step.
    """

    component: int
    facets: IntArray
    value: Any


@dataclass(frozen=True)
class Condition:
    """Condition on facet groups.

    Attributes:
        on: name of a facet group, or several.
    """

    on: str | Sequence[str]

    def __post_init__(self) -> None:
        _groups(self.on)

    def __str__(self) -> str:
        return f"{type(self).__name__} on {', '.join(self.groups)}"

    @property
    def groups(self) -> tuple[str, ...]:
        """Names of the facet groups."""
        return _groups(self.on)

    def is_open(self, fields: FlowFields) -> bool:
        """Whether fluid may pass without a prescribed velocity, so that the pressure's constant is determined."""
        return False

    def term(self, fields: FlowFields) -> ufl.Form | None:
        """Residual form; None: the condition is strong alone."""

    def strong(self, fields: FlowFields) -> "list[Prescribed]":
        """Values at nodes at the end of the step; empty: the condition is weak."""
        return []

    def _name(self, attribute: str) -> str:
        return f"{type(self).__name__}({', '.join(map(repr, self.groups))}).{attribute}"


@dataclass(frozen=True)
class Velocity(Condition):
    """Velocity at the nodes of the facets. Of several conditions at a node the last one counts.

    Attributes:
        on: facet groups.
        value: velocity; None: that of the mesh, zero where it is fixed (no slip).
        components: components that are prescribed; None: all.
    """

    value: Data = None
    components: Sequence[int] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.components is not None:
            checks.listed(self._name("components"), self.components)

    def is_open(self, fields: FlowFields) -> bool:
        """See :class:`Condition`; without all components the one normal to the facets decides."""
        if self.components is None or set(self.components) == set(range(fields.d)):
            return False
        axes = _axes(fields.mesh, self.groups)
        free = axes is None or bool((~np.isin(axes, list(self.components))).any())
        return bool(fields.mesh.domain.comm.allreduce(free, op=MPI.LOR))

    def strong(self, fields: FlowFields) -> list[Prescribed]:
        """See :class:`Condition`."""
        if self.value is None:
            value = fields.mesh_velocity(end=True)
        else:
            value = fields.vector(self._name("value"), self.value, end=True)
        chosen = range(fields.d) if self.components is None else self.components
        for i in chosen:
            checks.choice(self._name("components"), i, tuple(range(fields.d)))
        facets = fields.mesh.facets(*self.groups)
        return [Prescribed(i, facets, value[i]) for i in chosen]


@dataclass(frozen=True)
class WeakVelocity(Condition):
    """Velocity imposed weakly, see :func:`varmint.forms.boundary.weak_dirichlet`.

    Attributes:
        on: facet groups.
        value: velocity; None: that of the mesh, zero where it is fixed (no slip).
        symmetric: whether the variant is the symmetric one.
        penalty: factor of the penalty; None: 1000 in the symmetric variant, else absent.
    """

    value: Data = None
    symmetric: bool = True
    penalty: Any = None

    def term(self, fields: FlowFields) -> ufl.Form:
        """See :class:`Condition`."""
        f = fields
        value = f.mesh_velocity() if self.value is None else f.vector(self._name("value"), self.value)
        return boundary.weak_dirichlet(
            f.v, f.p, f.w, f.q, value, f.mesh.domain, f.ds(self.groups), rho=f.rho, mu=f.mu,
            symmetric=self.symmetric, penalty=self.penalty, motion=f.motion, invariant=f.invariant,
        )  # fmt: skip


@dataclass(frozen=True)
class Slip(Condition):
    """Impermeable wall without friction: the normal velocity is that of the mesh.

    Where all facets are normal to axes the components are imposed at the nodes; where one is not, and on moving meshes,
    the condition is weak on all.

    Attributes:
        on: facet groups.
        strong_if_moving: on a moving mesh: the facets stay normal to their axes, and the component is imposed at the
            nodes there as well.
        penalty: factor of the penalty where the condition is weak.
    """

    strong_if_moving: bool = False
    penalty: Any = 1e3

    def _is_strong(self, fields: FlowFields) -> bool:
        if fields.motion is not None and not self.strong_if_moving:
            return False
        return _axes(fields.mesh, self.groups) is not None

    def term(self, fields: FlowFields) -> ufl.Form | None:
        """See :class:`Condition`."""
        f = fields
        if self._is_strong(f):
            return None
        return boundary.weak_slip(
            f.v, f.p, f.w, f.q, f.mesh.domain, f.ds(self.groups), rho=f.rho, mu=f.mu, penalty=self.penalty,
            motion=f.motion, invariant=f.invariant,
        )  # fmt: skip

    def strong(self, fields: FlowFields) -> list[Prescribed]:
        """See :class:`Condition`."""
        if not self._is_strong(fields):
            return []
        facets, axes = fields.mesh.facets(*self.groups), _axes(fields.mesh, self.groups)
        value = fields.mesh_velocity(end=True)
        used = [i for i in range(fields.d) if fields.mesh.domain.comm.allreduce(int(np.count_nonzero(axes == i)))]
        return [Prescribed(i, facets[axes == i], value[i]) for i in used]


def _axes(mesh: NamedMesh, groups: tuple[str, ...]) -> IntArray | None:
    """Axis to which each of this rank's facets is normal; None: on some rank one is normal to none (collective)."""
    nodes = compat.facet_nodes(mesh.domain)[mesh.facets(*groups)]
    spread = np.ptp(mesh.domain.geometry.x[nodes][..., : mesh.domain.geometry.dim], axis=1)
    flat = spread <= 1e-10 * spread.max(axis=1, keepdims=True, initial=0.0)
    if mesh.domain.comm.allreduce(int(np.count_nonzero(~flat.any(axis=1)))):
        return None
    return flat.argmax(axis=1).astype(np.int32)


@dataclass(frozen=True)
class Traction(Condition):
    """Force per area on an open boundary, with the stabilisation of what flows back in (counted once).

    Attributes:
        on: facet groups.
        value: traction; None: zero (a free outlet).
        gamma: factor of the stabilisation.
        inflow: velocity of the fluid that comes back in; None: zero.
    """

    value: Data = None
    gamma: Any = 1.0
    inflow: Data = None

    def is_open(self, fields: FlowFields) -> bool:
        """See :class:`Condition`."""
        return True

    def term(self, fields: FlowFields) -> ufl.Form:
        """See :class:`Condition`."""
        f = fields
        traction, g = (
            None if data is None else f.vector(self._name(name), data)
            for name, data in (("value", self.value), ("inflow", self.inflow))
        )
        return boundary.stable_neumann(
            f.v, f.w, f.mesh.domain, f.ds(self.groups), rho=f.rho, traction=traction, g=g, gamma=self.gamma,
            motion=f.motion,
        )  # fmt: skip


@dataclass(frozen=True)
class Resistance(Condition):
    """Outlet whose pressure follows its flow rate Q, ``p = pressure + resistance Q``, with stabilised backflow.

    Q is that of the last iterate when a residual is assembled; its dense tangent is taken into account.

    Attributes:
        on: facet groups.
        resistance: >= 0; unit: pressure/flow rate.
        pressure: behind the resistance.
        gamma: factor of the stabilisation.

    Raises:
        ValueError: the resistance is negative.
    """

    resistance: float = 0.0
    pressure: float = 0.0
    gamma: Any = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.not_negative("resistance", self.resistance)
        checks.finite("pressure", self.pressure)

    def is_open(self, fields: FlowFields) -> bool:
        """See :class:`Condition`."""
        return True

    def term_with(self, fields: FlowFields, outlet_pressure: Any) -> ufl.Form:
        """Residual form with the present pressure of the outlet, a Constant that the flow keeps."""
        f = fields
        traction = -outlet_pressure * ale.normal(f.mesh.domain, f.motion)
        return boundary.stable_neumann(
            f.v, f.w, f.mesh.domain, f.ds(self.groups), rho=f.rho, traction=traction, gamma=self.gamma, motion=f.motion
        )
