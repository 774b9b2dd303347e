"""What a quantity does over time: extremes, passages of a level, oscillations and their decay."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np

from tigar_x import checks
from tigar_x.compat import FloatArray, IntArray

FEW = 3
"""Number of maxima or passages from which on there is a frequency."""


@dataclass(frozen=True)
class Extreme:
    """A maximum or minimum between samples.

    Attributes:
        t: its time.
        value: there.
    """

    t: float
    value: float


@dataclass(frozen=True)
class Oscillation:
    """An oscillation by its last maximum and minimum, as benchmarks of flapping and shedding give it.

    Attributes:
        mean: half the sum of the last maximum and minimum.
        amplitude: half their difference.
        frequency: number of maxima by the time between the first and the last one; NaN where there are less than
            three. Unit: 1/time.
    """

    mean: float
    amplitude: float
    frequency: float


@dataclass(frozen=True)
class Ringing:
    """An oscillation that decays, by its whole cycles.

    Attributes:
        mean: over the last cycle, or over all samples where there is none.
        cycles: their number.
        period: mean duration of a cycle; NaN without one. Unit: time.
        decay: range of a cycle by that of the one before, on average; NaN with less than two.
    """

    mean: float
    cycles: int
    period: float
    decay: float

    @property
    def log_decrement(self) -> float:
        """Logarithmic decrement, ``-ln(decay)``."""
        return -float(np.log(self.decay))


@dataclass(frozen=True, eq=False)
class Course:
    """A quantity over time.

    Between samples it is taken as linear, but at extremes as a parabola.

    Args:
        t: times, increasing; shape (samples,).
        y: values, shape (samples,).

    Raises:
        ValueError: times and values are not of one number, or times do not increase.
    """

    t: FloatArray
    y: FloatArray

    def __post_init__(self) -> None:
        t, y = np.asarray(self.t, dtype=float), np.asarray(self.y, dtype=float)
        if t.ndim != 1 or t.shape != y.shape:
            raise ValueError(f"t and y have shapes {t.shape} and {y.shape}: (samples,) is required of both")
        if (np.diff(t) <= 0.0).any():
            raise ValueError("t does not increase from sample to sample")
        object.__setattr__(self, "t", t)
        object.__setattr__(self, "y", y)

    def __len__(self) -> int:
        return len(self.t)

    def __getitem__(self, chosen: Any) -> "Course":
        """The part of a slice, of numbers, or of a mask such as ``course.t > 1``."""
        return Course(self.t[chosen], self.y[chosen])

    def __repr__(self) -> str:
        span = f"t = {self.t[0]:g} to {self.t[-1]:g}" if len(self) else "empty"
        return f"Course({len(self)} samples, {span})"

    # -- parts --------------------------------------------------------------------------------------------------------

    def between(self, low: float = -np.inf, high: float = np.inf) -> "Course":
        """The samples from one time to another, both included but for rounding."""
        slack = 1e-9 * max(abs(self.t[-1]), 1e-300) if len(self) else 0.0
        return self[(self.t >= low - slack) & (self.t <= high + slack)]

    def last(self, duration: float | None = None, *, share: float | None = None) -> "Course":
        """The last part, of a duration or of a share of the time at the end.

        Args:
            duration: in units of time.
            share: in (0, 1], of the time t at the last sample.

        Raises:
            ValueError: not one of them is given, or it is out of range.
        """
        if (duration is None) == (share is None):
            raise ValueError(f"duration = {duration!r}, share = {share!r}: one of them is required")
        if not len(self):
            return self
        if share is not None:
            return self[self.t >= self.t[-1] * (1.0 - checks.within("share", share, 0.0, 1.0))]
        return self[self.t >= self.t[-1] - checks.positive("duration", duration)]

    # -- numbers ------------------------------------------------------------------------------------------------------

    @cached_property
    def integral(self) -> float:
        """Integral over time, by trapezoids; unit: that of y times time."""
        from scipy.integrate import trapezoid

        return float(trapezoid(self.y, self.t))

    @cached_property
    def mean(self) -> float:
        """Mean over time, by trapezoids; of one sample its value."""
        return self.integral / float(self.t[-1] - self.t[0]) if len(self) > 1 else float(self.y.mean())

    @property
    def middle(self) -> float:
        """Half the sum of largest and smallest sample."""
        return float((self.y.max() + self.y.min()) / 2.0)

    # -- extremes -----------------------------------------------------------------------------------------------------

    @property
    def peaks(self) -> "Course":
        """Samples that are local maxima above the middle of the range."""
        y = self.y
        inner = np.arange(1, len(y) - 1)
        high = inner[(y[1:-1] > y[:-2]) & (y[1:-1] >= y[2:])]
        return self[high[y[high] > self.middle]] if len(high) else self[:0]

    @property
    def troughs(self) -> "Course":
        """Samples that are local minima below the middle of the range."""
        peaks = Course(self.t, -self.y).peaks
        return Course(peaks.t, -peaks.y)

    def highest(self, low: float, high: float, *, accuracy: float = 0.0) -> Extreme | None:
        """The largest value between two times.

        The value is that of a parabola through the three nearest samples.

        Args:
            low: time.
            high: time.
            accuracy: of a reading. Tops are flat: with it the time is the middle of the interval in which y is that
                near to the largest sample. Zero: the time is that of the parabola's top. Unit: that of y.

        Returns:
            None where the samples end more than a step before ``high``, or where the largest is at an end.
        """
        t, y, accuracy = self.t, self.y, checks.not_negative("accuracy", accuracy)
        inside = np.flatnonzero((t >= low - 1e-9) & (t <= high + 1e-9))
        if len(inside) < 3 or t[-1] < high - (t[1] - t[0]):
            return None
        i = int(inside[np.argmax(y[inside])])
        if i in (inside[0], inside[-1]):
            return None
        left, here, right = y[i - 1 : i + 2]
        bend = left - 2.0 * here + right
        shift = 0.5 * (left - right) / bend if bend else 0.0
        value = float(here - 0.25 * (left - right) * shift)
        if not accuracy:
            return Extreme(float(t[i] + shift * (t[i + 1] - t[i - 1]) / 2.0), value)
        level = here - accuracy
        lower = np.flatnonzero(y - level < 0.0)
        before, after = lower[lower < i], lower[lower > i]
        if not (len(before) and len(after)):
            return None
        ends = [t[j] + (level - y[j]) / (y[j + 1] - y[j]) * (t[j + 1] - t[j]) for j in (before[-1], after[0] - 1)]
        return Extreme(float(np.mean(ends)), value)

    def lowest(self, low: float, high: float, *, accuracy: float = 0.0) -> Extreme | None:
        """The smallest value between two times, see :meth:`highest`."""
        found = Course(self.t, -self.y).highest(low, high, accuracy=accuracy)
        return None if found is None else Extreme(found.t, -found.value)

    def extremes(self, period: float, split: float = 0.5, *, accuracy: float = 0.0) -> dict[str, Extreme]:
        """Peaks and troughs of what is driven with a period, from t = 0 on.

        Args:
            period: of the drive; unit: time.
            split: share of each period in which the peak is; the trough is in the rest. In [0, 1].
            accuracy: see :meth:`highest`.

        Returns:
            ``peak_1``, ``trough_1``, ``peak_2``, ...: largest and smallest value of the parts of each period, without
            those that the samples do not reach, and those at an end of their part.

        Raises:
            ValueError: a number is out of range.
        """
        checks.positive("period", period)
        checks.within("split", split, 0.0, 1.0)
        found: dict[str, Extreme | None] = {}
        for n in range(int(np.ceil(self.t[-1] / period)) if len(self) else 0):
            start, middle, end = n * period, (n + split) * period, (n + 1) * period
            found[f"peak_{n + 1}"] = self.highest(start, middle, accuracy=accuracy)
            found[f"trough_{n + 1}"] = self.lowest(middle, end, accuracy=accuracy)
        return {name: extreme for name, extreme in found.items() if extreme is not None}

    # -- passages -----------------------------------------------------------------------------------------------------

    def _steps_up(self, level: float) -> IntArray:
        """Numbers of the samples after which y rises through a level."""
        return np.flatnonzero((self.y[:-1] < level) & (self.y[1:] >= level))

    def rises(self, level: float | None = None) -> FloatArray:
        """Times at which y rises through a level.

        Args:
            level: value; None: the mean of the samples.
        """
        y = self.y - (self.y.mean() if level is None else level)
        i = Course(self.t, y)._steps_up(0.0)
        return self.t[i] - y[i] * (self.t[i + 1] - self.t[i]) / (y[i + 1] - y[i])

    def falls(self, level: float | None = None) -> FloatArray:
        """Times at which y falls through a level, see :meth:`rises`."""
        return Course(self.t, -self.y).rises(None if level is None else -level)

    def first(self, holds: Callable[[FloatArray], Any]) -> float | None:
        """Time of the first sample of which a condition holds, such as ``lambda y: y >= 0``; None: of none."""
        found = np.flatnonzero(holds(self.y))
        return float(self.t[found[0]]) if len(found) else None

    def cycles(self, level: float | None = None) -> list["Course"]:
        """Whole cycles, each from the sample at which y has risen through a level to the next such one.

        Args:
            level: value; None: the mean of the later half of the samples.
        """
        middle = float(self.y[len(self) // 2 :].mean()) if level is None and len(self) else level
        return [] if middle is None else [self[a : b + 1] for a, b in pairwise(self._steps_up(middle) + 1)]

    def last_cycles(self, count: int = 1, level: float | None = None) -> "Course":
        """The last whole cycles in one, such as for a mean over them; all samples where there are not as many.

        Args:
            count: number of cycles.
            level: see :meth:`cycles`.
        """
        cycles = self.cycles(level)[-checks.whole("count", count, 1) :]
        if len(cycles) < count:
            return self
        return self[(self.t >= cycles[0].t[0]) & (self.t <= cycles[-1].t[-1])]

    # -- oscillations -------------------------------------------------------------------------------------------------

    def frequency(self) -> float:
        """Frequency by the passages upwards through the mean; NaN where there are less than three. Unit: 1/time."""
        passages = self.rises() if len(self) else np.zeros(0)
        return float((len(passages) - 1) / (passages[-1] - passages[0])) if len(passages) >= FEW else float("nan")

    def oscillation(self) -> Oscillation:
        """The oscillation by its last maximum and minimum, or by the range where there are none.

        Raises:
            ValueError: there is no sample.
        """
        if not len(self):
            raise ValueError("the course has no samples: at least one is required")
        high, low = self.peaks, self.troughs
        if len(high) < FEW or not len(low):
            return Oscillation(self.middle, float(np.ptp(self.y) / 2.0), float("nan"))
        top, bottom = high.y[-1], low.y[-1]
        frequency = (len(high) - 1) / (high.t[-1] - high.t[0])
        return Oscillation(float((top + bottom) / 2.0), float((top - bottom) / 2.0), float(frequency))

    def ringing(self, level: float | None = None) -> Ringing:
        """The oscillation by its whole cycles.

        Args:
            level: see :meth:`cycles`.

        Raises:
            ValueError: there is no sample.
        """
        if not len(self):
            raise ValueError("the course has no samples: at least one is required")
        cycles = self.cycles(level)
        if not cycles:
            return Ringing(self.mean, 0, float("nan"), float("nan"))
        n, (first, last) = len(cycles), (float(np.ptp(cycles[i].y)) for i in (0, -1))
        decay = (last / first) ** (1.0 / (n - 1)) if n > 1 else float("nan")
        return Ringing(cycles[-1].mean, n, float(cycles[-1].t[-1] - cycles[0].t[0]) / n, decay)
