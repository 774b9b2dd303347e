"""When the block iteration of a step has converged, stalls or diverges."""

import math
from collections.abc import Callable

from coudalfish.step.options import CouplingOptions
from coudalfish.step.report import RejectedStepError

GROWTH_LIMIT = 1e3
"""Growth of a residual within a step at which the step is given up."""
RISE_LIMIT = 20.0
"""Growth above the least residual after the first pass at which a step of a converged multiplier is given up: such an
iteration wanders, rounding decides whether and where it ends. Steps that are accepted have known at most 3.01."""
STALL = 0.5
"""Tangents that are kept during a step are assembled anew when a pass reduces a residual by less than this."""
BLOCKS = ("fluid", "shell")

Pair = tuple[float, float]


class Acceptance:
    """Judges the residuals (fluid, shell) of one step.

    A residual is small when it is below ``block_rtol`` times a reference or below a floor. The reference is the first
    residual or, unless the stopping is "published", the present coupling forces where these are smaller: the first
    residual alone may be dominated by data that change in time, such as walls with a strong penalty. A residual that
    starts from nothing, as at rest or in a uniform flow, is referred to what the other block makes of it in the first
    pass.

    Args:
        options: tolerances and stopping rule.

    Attributes:
        history: residuals of every test; unit: force.
        limits: residuals that the last test would have accepted; unit: force.
    """

    def __init__(self, options: CouplingOptions) -> None:
        self._options = options
        self._published = options.stopping == "published"
        self._first = [0.0, 0.0]
        self._floors: Pair = (0.0, 0.0)
        self.history: list[Pair] = []
        self.limits: Pair = (0.0, 0.0)

    def note(self, norm_f: float, norm_s: float) -> None:
        """Take residuals into account as first ones, while the first pass lasts or those before were nothing."""
        tests = len(self.history)
        for i, norm in enumerate((norm_f, norm_s)):
            if tests <= (0 if self._published else 1) or (tests == 1 and self._first[i] <= self._floors[i]):
                self._first[i] = max(self._first[i], norm)

    def test(self, norms: Pair, coupling: Pair, floors: Callable[[], Pair]) -> bool:
        """Whether both residuals are small.

        Args:
            norms: residuals, finite; unit: force.
            coupling: coupling forces in both blocks; unit: force.
            floors: gives absolute limits, asked for only where the relative ones are exceeded; unit: force.

        Returns:
            True when the step may be accepted.

        Raises:
            RejectedStepError: a residual grows without bound.
        """
        self.note(*norms)
        self.history.append(norms)
        self.limits = self._limit(0, coupling[0]), self._limit(1, coupling[1])
        if self._small(norms):
            return True
        self._floors = floors()
        self.limits = max(self.limits[0], self._floors[0]), max(self.limits[1], self._floors[1])
        for i, block in enumerate(BLOCKS):
            if norms[i] > self.limits[i] and self._ratio(i) > GROWTH_LIMIT:
                raise RejectedStepError(
                    block, f"the residual grew {self._ratio(i):.3g} times in {len(self.history) - 1} passes"
                )
            if norms[i] > self.limits[i] and self._rise(i) > RISE_LIMIT:
                raise RejectedStepError(
                    block, f"the residual of pass {len(self.history) - 1} is {self._rise(i):.3g} times one before"
                )
        return self._small(norms)

    def _small(self, norms: Pair) -> bool:
        return all(norm <= limit for norm, limit in zip(norms, self.limits, strict=True))

    def _limit(self, i: int, force: float) -> float:
        reference = self._first[i]
        if force and not self._published:
            reference = min(reference, force)
        return self._options.block_rtol * reference

    def _ratio(self, i: int) -> float:
        return self.history[-1][i] / self._first[i] if self._first[i] else 0.0

    def _rise(self, i: int) -> float:
        """The last residual by the least one between it and the first, of an iteration of Newton's; otherwise 0."""
        least = min((norms[i] for norms in self.history[1:-1]), default=0.0)
        return self.history[-1][i] / least if least and self._options.multiplier == "converged" else 0.0

    @property
    def stalled(self) -> bool:
        """Whether the last pass reduced one of the residuals too little."""
        if len(self.history) < 2:
            return False
        old, new = self.history[-2:]
        return any(b > STALL * a for a, b in zip(old, new, strict=True))

    @property
    def within_reach(self) -> bool:
        """Whether one more pass leaves accepted residuals, if it reduces them as the last one has done."""
        if len(self.history) < 2:
            return False
        found = zip(*self.history[-2:], self.limits, strict=True)
        return all(new <= limit or new**2 <= limit * old for old, new, limit in found)

    def failure(self) -> RejectedStepError:
        """The error that the limit of passes has been reached, naming the block that is further from convergence."""
        pairs = zip(self.history[-1], self.limits, strict=True)
        ratios = [norm / limit if limit else (math.inf if norm else 0.0) for norm, limit in pairs]
        return RejectedStepError(
            BLOCKS[ratios.index(max(ratios))],
            f"no convergence in {self._options.max_passes} passes (residuals relative to the accepted ones: "
            f"fluid {ratios[0]:.3g}, shell {ratios[1]:.3g})",
        )
