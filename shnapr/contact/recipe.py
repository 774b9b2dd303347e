"""Contact as a recipe: what is known of it before there are points."""

from dataclasses import dataclass, replace
from typing import get_args

import numpy as np

from shnapr.contact.kernels import LinearKernel, SmoothedKernel
from shnapr.contact.self_contact import Neighbours, SelfContact
from tigar_x import checks
from tigar_x.splines.quadrature import NodalQuadrature

SPACING = 0.75
"""Largest mean distance of the points relative to the range of contact, beyond which surfaces may pass between them."""


@dataclass(frozen=True)
class ContactRecipe:
    """Contact of a shell with itself, whose range suits the points that it comes to act between.

    Points that are too far apart for the range let surfaces pass between them. Then the range grows, and r_self with
    it. The pressure between two surfaces goes with the third power of the range (in the plane, of two curves, with the
    second), so the stiffness falls with that power, and surfaces stay as stiff.

    Attributes:
        kernel: the potential.
        r_self: see :class:`shnapr.SelfContact`; unit: length.
        neighbours: see there.
        spacing: largest mean distance of the points relative to the range; None: the range stays as it is.

    Raises:
        ValueError: a number is out of range.
    """

    kernel: LinearKernel | SmoothedKernel
    r_self: float
    neighbours: Neighbours = "surface"
    spacing: float | None = SPACING

    def __post_init__(self) -> None:
        checks.kind("kernel", self.kernel, LinearKernel | SmoothedKernel, "a LinearKernel or a SmoothedKernel")
        if not self.kernel.r_max < checks.positive("r_self", self.r_self):
            raise ValueError(f"r_self = {self.r_self}: a number > kernel.r_max = {self.kernel.r_max} is required")
        checks.choice("neighbours", self.neighbours, get_args(Neighbours))
        if self.spacing is not None:
            checks.positive("spacing", self.spacing)

    def of(self, quadrature: NodalQuadrature) -> SelfContact:
        """The contact between points.

        Args:
            quadrature: reference positions and weights of the points.
        """
        growth = self.growth(quadrature)
        kernel = replace(
            self.kernel,
            r_max=growth * self.kernel.r_max,
            stiffness=self.kernel.stiffness / growth ** quadrature.points.shape[1],
        )
        return SelfContact(quadrature, kernel, growth * self.r_self, neighbours=self.neighbours)

    def growth(self, quadrature: NodalQuadrature) -> float:
        """Factor >= 1 of the range that suits points."""
        if self.spacing is None:
            return 1.0
        area = float(quadrature.weights.mean())
        distance = float(np.sqrt(area)) if quadrature.points.shape[1] == 3 else area
        return max(1.0, distance / (self.spacing * self.kernel.r_max))
