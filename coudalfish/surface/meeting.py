"""How the points of a surface meet the fluid in a step: what they see of its velocity, and the areas they stand for."""

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import scipy.sparse as sp
from dolfinx import fem

from coudalfish.surface.sheets import Sheets
from coudalfish.surface.trace import Location, PointLocator, TraceMatrix, trace_matrix
from tigar_x.compat import FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class NormalForces:
    """Forces of a multiplier's functions along normals that the meeting has of its own.

    Attributes:
        at_points: on the surface, shape (points d, functions); this rank's share.
        at_nodes: on the nodes of the trace, shape (nodes d, functions); likewise.
    """

    at_points: sp.csr_matrix
    at_nodes: sp.csr_matrix


class Meeting(Protocol):
    """Where a surface is in the fluid in one step.

    Velocities of the fluid at the points are ``u_q = B u`` and forces at the points act on the fluid by ``B^T``, so
    that both have the same power.
    """

    @property
    def trace(self) -> TraceMatrix:
        """From nodal velocities to the points."""

    @property
    def W(self) -> FloatArray:
        """Reference areas of the points, zero where there is no fluid, shape (points,)."""

    @property
    def active(self) -> Any:
        """Mask of the points that meet the fluid, shape (points,)."""

    @property
    def location(self) -> Location:
        """All places at which the fluid is evaluated."""

    @property
    def penalty(self) -> tuple[sp.csr_matrix, FloatArray]:
        """Matrix E and areas w of a penalty's tangent ``E^T diag(beta w) E``, of the columns of the trace."""

    @property
    def seen(self) -> IntArray:
        """Local nodes of the velocity space that the columns of E, and of the trace, stand for."""

    @property
    def means(self) -> sp.csr_matrix | None:
        """From values at the rows of E to those of the trace; None: they are the same."""

    def vertex_functions(self) -> sp.csr_matrix:
        """Linear functions of the fluid mesh's vertices as the points see them (collective)."""

    def normal_forces(
        self, functions: sp.csr_matrix, n: FloatArray, trace: sp.csr_matrix | None = None
    ) -> NormalForces | None:
        """Forces of scalar functions along the meeting's own normals (collective); None: the surface's are as good.

        Args:
            functions: of a multiplier, force per area at the points, shape (points, functions).
            n: the surface's normals, which agree across joints, shape (points, d).
            trace: from more nodes to the rows of E, where the velocity has more; None: it is E.
        """


class Meets(Protocol):
    """A way in which surfaces meet the fluid."""

    def __call__(self, x: FloatArray, locator: PointLocator) -> Meeting:
        """Place the surface (collective).

        Args:
            x: positions of its points, the same on every rank, shape (points, d); unit: length.
            locator: of the fluid's mesh.
        """


@dataclass(frozen=True, eq=False)
class AtPoints:
    """A surface whose points see the fluid where they are.

    Attributes:
        trace: see :class:`Meeting`.
        W: see there.
        location: see there.
        locator: of the fluid's mesh.
    """

    trace: TraceMatrix
    W: FloatArray
    location: Location
    locator: PointLocator

    @property
    def active(self) -> Any:
        """Mask of the points that lie in the fluid, shape (points,)."""
        return self.location.active

    @property
    def penalty(self) -> tuple[sp.csr_matrix, FloatArray]:
        """See :class:`Meeting`."""
        return self.trace.B, self.W

    @property
    def seen(self) -> IntArray:
        """See there."""
        return self.trace.nodes

    @property
    def means(self) -> None:
        """See there."""

    def vertex_functions(self) -> sp.csr_matrix:
        """See :class:`Meeting`."""
        return self.locator.vertex_functions(self.location)

    def normal_forces(self, functions: sp.csr_matrix, n: FloatArray, trace: sp.csr_matrix | None = None) -> None:
        """See there."""


@dataclass(frozen=True, eq=False)
class MeetsAtPoints:
    """The published way.

    Attributes:
        space: scalar space of one component of the fluid's velocity.
        weights: reference areas of the points, shape (points,).
    """

    space: fem.FunctionSpace
    weights: FloatArray

    def __call__(self, x: FloatArray, locator: PointLocator) -> AtPoints:
        """See :class:`Meets`."""
        location = locator.locate(x)
        W = np.where(location.active, self.weights, 0.0)
        return AtPoints(trace_matrix(self.space, location), W, location, locator)


def meets(kind: str, space: fem.FunctionSpace, sheets: Sheets, weights: FloatArray) -> Meets:
    """The way that an option asks for.

    Args:
        kind: "nodes" or "exact", see :class:`coudalfish.step.options.CouplingOptions`.
        space: scalar space of one component of the fluid's velocity.
        sheets: how the points of the surface hang together.
        weights: their reference areas, shape (points,).

    Raises:
        ValueError: the kind does not suit the surface.
    """
    if kind == "nodes":
        return MeetsAtPoints(space, weights)
    from coudalfish.surface.averages import MeetsByAverages  # a scene that has points alone needs none of it

    return MeetsByAverages.of(space, sheets, weights)
