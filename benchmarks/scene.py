"""What coupled scenes with known answers have in common, in the plane and in space.

Each scene is a frozen dataclass of its data, and ``run(setting)`` computes it with any setting of the coupling and of
the flow's fields; it gives figures by name, the steps' reports and what they cost.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from mpi4py import MPI

from coudalfish import CouDALFISh, CouplingOptions, StepReport
from shnapr import Shell, StVenantKirchhoff
from shnapr.supports import fixed
from tigar_x import compat
from tigar_x.compat import FloatArray
from tigar_x.fem.linear import direct
from tigar_x.run.progress import Stopwatch
from varmint import Flow, FlowOptions

COMM = MPI.COMM_WORLD


@dataclass(frozen=True)
class Setting:
    """How a scene is computed at its surface.

    Attributes:
        options: of the coupling.
        immersed: what the flow's fields know of the surface, see :class:`varmint.Flow`.
        flow: options of the flow.
    """

    options: CouplingOptions = field(default_factory=CouplingOptions)
    immersed: Any = "plain"
    flow: FlowOptions = field(default_factory=lambda: FlowOptions(solver=direct()))


IN_PLANE = Setting()
"""Factors of flows in the plane are cheap."""


@dataclass(frozen=True, eq=False)
class Found:
    """What a run found.

    Attributes:
        figures: by name.
        reports: of the steps.
        watch: seconds of the steps.
        unknowns: of the flow.
    """

    figures: dict[str, float]
    reports: Sequence[StepReport]
    watch: Stopwatch
    unknowns: int

    @property
    def passes(self) -> FloatArray:
        """Block passes of every step."""
        return np.array([report.passes for report in self.reports])

    @property
    def imbalance(self) -> float:
        """Largest difference between action and reaction, relative to the forces."""
        return max(report.monitors.force_imbalance for report in self.reports if report.monitors)


class Coupled:
    """A flow and a shell that are coupled, and the steps that they have taken.

    Args:
        flow: the flow.
        shell: the shell.
        setting: of the coupling.
        multiplier: at the start.
    """

    def __init__(self, flow: Flow, shell: Shell, setting: Setting, multiplier: float = 0.0) -> None:
        self.flow, self.shell = flow, shell
        self.fsi = CouDALFISh(flow, shell, setting.options, multiplier=multiplier)
        self.reports: list[StepReport] = []
        self.watch = Stopwatch()

    def step(self, measure: Callable[[], Any] | None = None) -> StepReport:
        """Take a step."""
        with self.watch:
            self.reports.append(self.fsi.takeStep(measure))
        return self.reports[-1]

    def found(self, **figures: float) -> Found:
        """What has been found so far."""
        return Found(figures, tuple(self.reports), self.watch, self.flow.unknowns)


def rigid(geometry: Any) -> Shell:
    """A shell that does not move."""
    return Shell(geometry, StVenantKirchhoff(1.0, 0.3, 0.05, bending=False), density=1.0, zero_dofs=fixed(geometry))


def immersed_flow(mesh: Any, conditions: Sequence[Any], setting: Setting, *, pin_at: Any = None, **data: Any) -> Flow:
    """The flow of a scene with the options and fields of a setting."""
    options = setting.flow if pin_at is None else replace(setting.flow, pin_at=pin_at)
    return Flow(mesh, conditions, immersed=setting.immersed, options=options, **data)


def until_steady(scene: Coupled, through: Any, reference: float, cfl: float, steady: float, most: int) -> Any:
    """March to a flow rate that no longer changes, while the fluid passes three cells.

    Returns:
        Flow, leak and its change while the fluid passes a cell, over the reference.
    """
    (rate,), old, calm = compat.compile_forms(through), 0.0, 0.0
    while calm < 3.0 and len(scene.reports) < most:
        report = scene.step()
        new = compat.assemble_scalar(rate) / reference
        old, change = new, abs(new - old) / cfl
        calm = calm + cfl if change <= steady else 0.0
    leak = report.monitors.leak / reference if report.monitors else math.nan
    return {"flow": new, "leak": leak, "change": change}
