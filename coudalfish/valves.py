"""What is measured of a heart valve: how far it is open, where its leaflets are, and what flows through it.

Every leaflet is a patch that goes from post to post (u) and from its free edge to the attached one (v), as those of
:func:`tigar_x.geometry.surfaces.trileaflet` do; patch by patch they follow each other around the third axis.
"""

from typing import Any, Protocol

import numpy as np
from dolfinx import fem

from tigar_x import checks
from tigar_x.compat import FloatArray
from tigar_x.run.course import Course
from tigar_x.run.history import History
from tigar_x.run.summary import Quantity
from tigar_x.splines import sampling
from tigar_x.splines.spline import ExtractedSpline

EDGE, NET = 41, 33
"""Points along a free edge, and along both sides of a net on a leaflet."""
PLACES = ("tip", "belly")
"""The marks of a leaflet."""


class ShellOfLeaflets(Protocol):
    """A shell of leaflets, such as :class:`shnapr.shell.Shell`."""

    @property
    def spline(self) -> ExtractedSpline:
        """The midsurface."""

    @property
    def y(self) -> fem.Function:
        """Homogeneous displacement."""

    @property
    def contact(self) -> Any:
        """Contact of the leaflets; None: none."""


class Leaflets:
    """Where the leaflets of a valve are.

    Args:
        shell: a surface of one patch a leaflet.

    Attributes:
        y: homogeneous displacement.
        net: points of the leaflets on a net, see :mod:`tigar_x.splines.sampling`.

    Raises:
        ValueError: the shell is no surface in space.
    """

    def __init__(self, shell: ShellOfLeaflets) -> None:
        spline = shell.spline
        if (spline.dim, spline.nsd) != (2, 3):
            raise ValueError(f"shell: dimension {spline.dim} in {spline.nsd}: a surface in space is required")
        self.y, self._contact = shell.y, shell.contact
        self._marks = sampling.marks(spline, [[0.5, 0.0], [0.5, 0.5]])
        self._edges, self.net = sampling.line(spline, 0, EDGE, at=0.0), sampling.net(spline, NET)

    def marks(self) -> FloatArray:
        """Middle of the free edge and belly of each leaflet, shape (leaflets, 2, 3); unit: length."""
        return self._marks.positions(self.y)

    def heights(self) -> FloatArray:
        """Distances of the marks from the third axis, and their third coordinates, shape (leaflets, 2, 2)."""
        x, y, z = np.moveaxis(self.marks(), -1, 0)
        return np.stack([np.hypot(x, y), z], axis=-1)

    def opening(self) -> float:
        """Area within the free edges, seen along the third axis; unit: length^2."""
        return sampling.enclosed_area(self._edges.positions(self.y))

    def asymmetry(self) -> float:
        """Root mean square distance of the leaflets, turned about the third axis onto each other; unit: length."""
        x = self.net.positions(self.y)
        turned = [leaflet @ turn(-2.0 * np.pi * k / len(x)).T for k, leaflet in enumerate(x)]
        return float(np.sqrt(np.mean(np.sum((turned - np.mean(turned, axis=0)) ** 2, axis=-1))))

    def columns(self) -> dict[Any, Any]:
        """Columns of a coupled run's history, see :mod:`tigar_x.run.history`.

        Those of contact are there where the leaflets have it; ``leak`` and they belong to the time ``t_alpha``.
        """
        names = tuple(f"{place}_{axis}_{k}" for k in range(len(self.marks())) for place in PLACES for axis in "rz")
        moved = {"opening_area": self.opening, "asymmetry": self.asymmetry, names: self.heights}
        every = {"t_alpha": "t_alpha", "leak": "monitors.leak", "passes": "passes", **moved}
        if self._contact is None:
            return every
        least = self._contact.kernel.r_max  # at least that far apart are points that do not touch
        nearest = {"smallest_distance": lambda report: min(report.contact.distance, least)}
        return {**every, "contact_pairs": "contact.pairs", "contact_load": "contact.load", **nearest}


def quantities(past: History, reversal: float) -> dict[str, Quantity]:
    """What a run of a valve amounts to: that of its flow rate, largest and last opening, largest load of contact.

    Args:
        past: history with the columns of :meth:`Leaflets.columns` of leaflets that have contact, and ``flow_rate``.
        reversal: time at which the pressure is reversed.
    """
    opening = past["opening_area"]
    found = {"largest_opening_area": opening.max(), "final_opening_area": opening[-1]}
    found |= {"largest_contact_load": past["contact_load"].max(), **flow_through(past.course("flow_rate"), reversal)}
    return {name: Quantity(float(value)) for name, value in found.items()}


def turn(angle: float) -> FloatArray:
    """Rotation about the third axis, shape (3, 3).

    Args:
        angle: unit: radians.
    """
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def flow_through(q: Course, reversal: float) -> dict[str, float]:
    """What a flow rate through a valve amounts to that opens, and closes after the pressure has been reversed.

    Args:
        q: flow rate, positive through the open valve; unit: volume/time.
        reversal: time at which the pressure is reversed.

    Returns:
        ``peak_flow_rate``, ``stroke_volume``; after the reversal ``largest_backflow``; after the closure, when the flow
        is back at zero after it was reversed, ``closure_time``, and of the ringing that follows ``mean_leak`` in its
        last whole cycle (in all the time where there is none), the same ``mean_leak_relative`` to the peak,
        ``oscillations`` and, with two cycles or more, ``oscillation_period`` and ``oscillation_decay``.

    Raises:
        ValueError: there is no sample up to the reversal.
    """
    forward, back = q[q.t <= reversal], q[q.t > reversal]
    if not len(forward):
        raise ValueError(f"reversal = {checks.finite('reversal', reversal)}: a time after the first sample is required")
    peak = float(forward.y.max())
    found = {"peak_flow_rate": peak, "stroke_volume": forward.integral if len(forward) > 1 else 0.0}
    if not len(back):
        return found
    found["largest_backflow"] = -float(q.y.min())
    reversed_ = np.flatnonzero(back.y < 0.0)
    first = back[reversed_[0] :] if len(reversed_) else back[:0]
    closure = first[int(first.y.argmin()) :].first(_forward_again) if len(first) else None
    if closure is None:
        return found
    found["closure_time"] = closure
    closed = q[q.t >= closure]
    if len(closed) > 2:
        ringing = closed.ringing()
        found |= {"mean_leak": -ringing.mean, "mean_leak_relative": -ringing.mean / peak}
        found["oscillations"] = float(ringing.cycles)
        if ringing.cycles > 1:
            found |= {"oscillation_period": ringing.period, "oscillation_decay": ringing.decay}
    return found


def _forward_again(q: FloatArray) -> Any:
    return q >= 0.0
