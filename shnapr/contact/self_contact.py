"""Contact of thin shells with themselves and each other by a potential between their points.

Source: Kamensky et al., "A contact formulation based on a volumetric potential", doi:10.1016/j.cma.2017.11.007. All
pairs of nodes whose reference distance exceeds r_self interact through ``E_c = sum_pairs W_A W_B phi(r_AB)``, with the
nodal quadrature weights W and a potential phi that vanishes from r_max on. Surfaces cannot pass between their points
as long as the spacing of the nodes is well below r_max.

The published rule exempts neighbours by their distance in space, and with them whatever starts close together: a valve
that is drawn closed, or stacked sheets. Here a pair is exempt when there is a short way along the surface besides.
"""

import logging
from copy import copy
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, get_args

import numpy as np
import scipy.sparse as sp
from mpi4py import MPI
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from shnapr.contact.kernels import Kernel, LinearKernel, SmoothedKernel
from shnapr.contact.neighbours import WAY, IndexArray, way_apart
from shnapr.contact.pairs import ContactForces, assembled, by_column, ends, gaps, stiffness
from shnapr.contact.shared import largest, of_all_ranks, own_pairs
from tigar_x import checks
from tigar_x.compat import FloatArray
from tigar_x.fem.linear import SolveError
from tigar_x.splines.quadrature import NodalQuadrature

__all__ = ["ContactForces", "Kernel", "LinearKernel", "Neighbours", "SelfContact", "SmoothedKernel"]

log = logging.getLogger(__name__)

Neighbours = Literal["surface", "space"]
"""What exempts points within r_self: a short way along the surface, or their distance in space alone."""

SKIN = 0.2
"""How much further than needed pairs are searched, relative to r_max: they serve until a node has moved by half of
that."""
MOST_APPROACH = 3.0
"""Largest way in a step, relative to r_max, within which approaching points are looked for."""
COINCIDENT = 1e-12
"""Distance relative to r_max below which two points have no direction of their own."""


@dataclass(frozen=True, eq=False)
class _Found:
    """Admissible pairs of points that were closer than a reach where they were, in ascending order."""

    x: FloatArray
    reach: float
    pairs: IndexArray

    def serves(self, x: FloatArray, reach: float) -> bool:
        """Whether all pairs are among them that are closer than another reach where the points are now."""
        moved = x - self.x
        return reach + 2.0 * float(np.sqrt(np.einsum("ni,ni->n", moved, moved).max(initial=0.0))) <= self.reach


class SelfContact:
    """Contact of a shell, or of several in one spline, with itself.

    Pairs are searched with a k-d tree, somewhat farther than needed, and only again once a node has moved so far that
    another pair might count. What comes out depends on the given positions alone.

    Points in the same place (closer than 1e-12 r_max) repel each other along the line between their reference
    positions, which r_self keeps apart; their tangent has no part across that line.

    Args:
        quadrature: reference positions (in d = 2 or 3 dimensions) and weights of the points; those of weight zero take
            no part.
        kernel: the potential; its r_max is below r_self.
        r_self: neighbours with at most this distance in the reference configuration never interact; unit: length.
        neighbours: "surface": those with a way of at most 2 r_self from one to the other along the surface, over
            patches that are glued or touch. Surfaces that start nearer than r_max then push each other from the start.
            "space": all pairs, as published. A quadrature without cells knows of no surface and takes "space".

    Attributes:
        quadrature: as given.
        kernel: as given.
        r_self: as given.
        apart: pairs within r_self in the reference configuration without such a way, ascending, shape (pairs, 2).

    Raises:
        ValueError: an argument is out of range or has a wrong shape.
    """

    def __init__(
        self, quadrature: NodalQuadrature, kernel: Kernel, r_self: float, *, neighbours: Neighbours = "surface"
    ) -> None:
        checks.kind("quadrature", quadrature, NodalQuadrature, "NodalQuadrature.of(spline)")
        checks.having("kernel", kernel, "r_max", "a kernel, such as LinearKernel(r_max, stiffness),")
        points = checks.array("quadrature.points", quadrature.points, (None, None))
        n, d = points.shape
        if d not in (2, 3):
            raise ValueError(f"quadrature.points has shape {points.shape}: shape (any, 2) or (any, 3) is required")
        for name in ("weights", "rational"):
            values = checks.array(f"quadrature.{name}", getattr(quadrature, name), (n,))
            lowest = values.min(initial=np.inf)
            if lowest < 0.0 or (name == "rational" and lowest == 0.0):
                allowed = ">= 0" if name == "weights" else "> 0"
                raise ValueError(f"quadrature.{name}[{values.argmin()}] = {lowest}: numbers {allowed} are required")
        r_max = checks.positive("kernel.r_max", kernel.r_max)
        if not r_max < checks.positive("r_self", r_self):
            raise ValueError(f"kernel.r_max = {r_max} with r_self = {r_self}: kernel.r_max < r_self is required")
        self.quadrature = quadrature
        self.kernel = kernel
        self.r_self = float(r_self)
        checks.choice("neighbours", neighbours, get_args(Neighbours))
        self.apart = way_apart(quadrature, self.r_self)
        self._used = np.flatnonzero(quadrature.weights)
        self._interacting: _Found | None = None
        self._approaching: _Found | None = None
        self._warned = False
        self._allowed = self._keys(self.apart) if neighbours == "surface" else np.empty(0, dtype=np.intp)
        self._comm: MPI.Comm | None = None
        self._report(neighbours)

    def shared(self, comm: MPI.Comm) -> "SelfContact":
        """The same contact, of which each rank evaluates a part of the pairs: all that is asked of it is collective.

        Args:
            comm: the ranks, which have the same positions.
        """
        other = copy(self)
        other._comm, other._interacting, other._approaching = comm, None, None
        return other

    def __repr__(self) -> str:
        return f"SelfContact({len(self._used)} points, {self.kernel!r}, r_self = {self.r_self:g})"

    def _report(self, neighbours: Neighbours) -> None:
        """Say how many pairs start within range without being neighbours."""
        if not len(self.apart):
            return
        closer = int(np.count_nonzero(gaps(self.quadrature.points, self.apart)[1] < self.kernel.r_max))
        found = (
            f"contact: {len(self.apart)} pairs of points start nearer than r_self = {self.r_self:g}, {closer} of them "
            f"nearer than r_max = {self.kernel.r_max:g}, without a way of {WAY:g} r_self between them along the surface"
        )
        if neighbours == "space":
            log.info("%s; with neighbours = 'space' they never touch", found)
        elif closer:
            log.warning("%s; those within r_max push each other from the start: reduce r_max if they should not", found)
        else:
            log.info("%s; they may touch", found)

    @cached_property
    def spacing_ratio(self) -> float:
        """Largest local spacing of the points over r_max; beyond about 0.75 surfaces may pass between points.

        The spacing at a point is the square root (in the plane: the value) of the mean weight of the points within
        r_self of it in the reference configuration.
        """
        X, W = self.quadrature.points[self._used], self.quadrature.weights[self._used]
        n, dim = len(X), X.shape[1] - 1
        i, j = cKDTree(X).query_pairs(self.r_self, output_type="ndarray").T
        number = 1 + np.bincount(i, minlength=n) + np.bincount(j, minlength=n)
        area = W + np.bincount(i, W[j], minlength=n) + np.bincount(j, W[i], minlength=n)
        return float((area / number).max(initial=0.0) ** (1 / dim) / self.kernel.r_max)

    def evaluate(
        self, x: ArrayLike, *, tangent: bool = True, positive: bool = False, alpha: float = 1.0
    ) -> ContactForces:
        """Energy, forces and tangent in a configuration (collective where it is shared).

        Args:
            x: current positions of the points, shape (nodes, d); unit: length.
            tangent: whether to assemble the tangent.
            positive: leave out what makes the tangent of a pair indefinite, ``phi'/r (I - r r)`` of repelling points
                and a negative phi''.
            alpha: factor of the tangent > 0, the derivative of x by the positions solved for (alpha_f of a time step).

        Returns:
            The contact; where it is shared, with the tangent of this rank's pairs.

        Raises:
            ValueError: x has a wrong shape, or alpha is out of range.
            SolveError: x is not finite, as after a failed solve.
        """
        given = self._checked(x), tangent, positive, checks.positive("alpha", alpha)
        if self._comm is None:
            return self._evaluated(*given)
        return of_all_ranks(self._comm, lambda: self._evaluated(*given))

    def _evaluated(self, x: FloatArray, tangent: bool, positive: bool, alpha: float) -> ContactForces:
        """That of all pairs, or of this rank's."""
        self._interacting = self._serving(self._interacting, x, self.kernel.r_max)
        pairs, gap, r = _closer(self._interacting, x, self.kernel.r_max)
        if not len(pairs):
            return _no_contact(x, tangent)
        apart = r >= COINCIDENT * self.kernel.r_max
        inverse = np.divide(1.0, r, out=np.zeros_like(r), where=apart)
        direction = inverse[:, None] * gap
        if not apart.all():
            direction[~apart] = self._reference_directions(pairs[~apart])
        weight = self.quadrature.weights[pairs].prod(axis=1)
        slope = weight * self.kernel.slope(r)
        w = self.quadrature.rational
        forces = ends(pairs, len(w), -1.0) @ (slope[:, None] * direction) / w[:, None]
        matrix = None
        if tangent:
            along, across = alpha * weight * self.kernel.curvature(r), alpha * slope * inverse
            if positive:
                along, across = np.maximum(along, 0.0), np.maximum(across, 0.0)
            matrix = assembled(pairs, stiffness(direction, along, across), w)
        return ContactForces(
            energy=float(weight @ self.kernel.energy(r)),
            forces=forces,
            tangent=matrix,
            pairs=len(pairs),
            load=float(np.abs(slope).sum()),
            distance=float(r.min(initial=np.inf)),
            coincident=int(np.count_nonzero(~apart)),
        )

    def closing_speed(self, x: ArrayLike, velocity: FloatArray, dt: float) -> float:
        """Largest speed at which two points approach each other that might interact within a time step (collective).

        Args:
            x: present positions of the points, shape (nodes, d); unit: length.
            velocity: their velocities, shape (nodes, d).
            dt: the step; unit: time.

        Returns:
            Rate of decrease of the distance of the fastest such pair, 0 where none approaches; unit: length/time.

        Raises:
            ValueError: x has a wrong shape.
            SolveError: x is not finite.
        """
        positions = self._checked(x)
        if self._comm is None:
            return self._closing(positions, velocity, dt)
        return largest(self._comm, lambda: self._closing(positions, velocity, dt))

    def _closing(self, x: FloatArray, velocity: FloatArray, dt: float) -> float:
        """That of all pairs, or of this rank's."""
        fastest = 2.0 * float(np.sqrt(np.einsum("ni,ni->n", velocity, velocity)).max(initial=0.0))
        reach = self.kernel.r_max + min(fastest * dt, MOST_APPROACH * self.kernel.r_max)
        self._approaching = self._serving(self._approaching, x, reach)
        pairs, gap, r = _closer(self._approaching, x, reach)
        rate = np.einsum("pi,pi->p", gap, gaps(velocity, pairs)[0])
        return float(-np.divide(rate, r, out=np.zeros_like(r), where=r > 0.0).min(initial=0.0))

    def _checked(self, x: ArrayLike) -> FloatArray:
        positions = np.asarray(x, dtype=np.float64)
        if positions.shape != self.quadrature.points.shape:
            raise ValueError(f"x has shape {positions.shape}: shape {self.quadrature.points.shape} is required")
        if not np.isfinite(positions).all():
            raise SolveError("x, the positions at which contact is evaluated, is not finite")
        return positions

    def _serving(self, found: _Found | None, x: FloatArray, reach: float) -> _Found:
        """What was found where it serves, or what is found now."""
        if found is not None and found.serves(x, reach):
            return found
        farther = reach + SKIN * self.kernel.r_max
        return _Found(x.copy(), farther, self._search(x, farther))

    def _search(self, x: FloatArray, reach: float) -> IndexArray:
        """Admissible pairs closer than ``reach``, all or this rank's, in ascending order, shape (pairs, 2)."""
        x_used = x[self._used]
        if self._comm is None:
            tree = cKDTree(x_used, balanced_tree=False, compact_nodes=False)
            found = tree.query_pairs(reach, output_type="ndarray")
        else:
            found = own_pairs(self._comm, x_used, reach)
        pairs = self._used[found]
        far = gaps(self.quadrature.points, pairs)[1] > self.r_self
        if len(self._allowed):
            far |= np.isin(self._keys(pairs), self._allowed, assume_unique=True)
        pairs = pairs[far]
        return pairs[by_column(pairs[:, 1], pairs[:, 0], np.arange(len(pairs)), len(x)).data]

    def _keys(self, pairs: IndexArray) -> IndexArray:
        """One number for every pair, in whatever order its points are given."""
        return pairs.min(axis=1) * len(self.quadrature.points) + pairs.max(axis=1)

    def _reference_directions(self, pairs: IndexArray) -> FloatArray:
        """Unit vectors between the reference positions of pairs that are in the same place."""
        if not self._warned:
            self._warned = True
            log.warning("contact: %d pairs of points are in the same place; they are pushed back apart", len(pairs))
        gap, r = gaps(self.quadrature.points, pairs)
        return gap / r[:, None]


def _closer(found: _Found, x: FloatArray, reach: float) -> tuple[IndexArray, FloatArray, FloatArray]:
    """Those pairs that are closer than a reach now, the vectors between them and their distances."""
    gap, r = gaps(x, found.pairs)
    close = r < reach
    return found.pairs[close], gap[close], r[close]


def _no_contact(x: FloatArray, tangent: bool) -> ContactForces:
    """That of points of which no two interact."""
    matrix = sp.bsr_matrix((x.size, x.size), blocksize=(x.shape[1], x.shape[1])) if tangent else None
    return ContactForces(0.0, np.zeros(x.shape), matrix, pairs=0, load=0.0, distance=np.inf, coincident=0)
