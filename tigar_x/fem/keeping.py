"""How long a preconditioner that ages serves, by counts alone: all ranks and equal runs decide alike."""

import math
from collections.abc import Hashable

LONGEST = 16
"""Preconditioners in a row that serve one solve only, at most, after some that were kept in vain."""


class Keeping:
    """What is known of the preconditioners of one system, whose matrix changes from solve to solve.

    A new one costs as much as some iterations. One that is kept costs those which it takes more than when it was new.
    Where ageing goes on, the cost of all is least if one is kept until its last solve takes more beyond those of a new
    one than set-up and ageing have cost in the mean of its solves. Where those of one life were more than the set-ups
    that it saved, the next one serves one solve only, and after the next such life the next two, four and so on.

    Args:
        growth: keep each while iterations stay below this factor times those after it was made; infinite: as above.
        set_up: iterations that cost as much as a new one.
    """

    def __init__(self, growth: float, set_up: float) -> None:
        self._growth, self._set_up = growth, set_up
        self._new, self._more, self._solves = 0.0, 0.0, 0
        self._pause, self._left = 0, 0
        self._made: Hashable = None
        self._last: Hashable = None

    def made(self, iterations: float, matrix: Hashable = None) -> bool:
        """Take note of the first solve with a new one: whether that is to be kept.

        Args:
            iterations: of the solve.
            matrix: names what was solved with and its values; None: they are others than in the solve before.
        """
        if matrix is not None and matrix == self._made:  # it is not a new one
            return False
        self._made = self._last = matrix
        self._new, self._more, self._solves = iterations, 0.0, 1
        if self._left > 0:
            self._left -= 1
            return False
        return True

    def served(self, iterations: float, matrix: Hashable = None) -> bool:
        """Take note of a later solve: whether the preconditioner is to be kept on.

        Args:
            iterations: infinitely many if it failed.
            matrix: as above; where values are the same as in the solve before, no set-up was saved.
        """
        same, self._last = matrix is not None and matrix == self._last, matrix
        if not math.isinf(self._growth):
            return iterations <= self._growth * self._new + 2
        if same:
            return not math.isinf(iterations)
        more = max(iterations - self._new, 0.0)
        self._more, self._solves = self._more + more, self._solves + 1
        serves = not math.isinf(more) and self._solves * more <= self._set_up + self._more
        if not serves:
            in_vain = self._more > self._set_up * (self._solves - 1)
            self._left = self._pause = min(max(2 * self._pause, 1), LONGEST) if in_vain else 0
        return serves


def part_of(rtol: float, reference: float) -> float:
    """What iterations are multiplied by to be those of a reduction by ``rtol``.

    Args:
        rtol: reduction of the residual relative to a reference.
        reference: the latter, relative to the norm of the right-hand side.
    """
    reduction = rtol * reference
    return math.log(rtol) / math.log(min(reduction, 0.5)) if 0.0 < rtol < 1.0 and reduction > 0.0 else 1.0
