"""Time steps that follow how many cells flow and shell pass in one.

```python
steps = CourantSteps(fsi, largest=2e-4)
while fsi.timeInt_f.time < until:
    reports = advance(fsi, steps.size())
```
"""

import math
from typing import Any

import numpy as np
from mpi4py import MPI

from coudalfish.sides.fluid import FluidSubproblem
from coudalfish.step.watch import CLOSING_LIMIT
from tigar_x import checks, compat

AGAIN = 0.8
"""Part of a limit that twice the present step may reach, so that sizes do not go to and fro."""
SAME_TIME = 1e-6
"""Part of a step by which the time may be beside a multiple of it."""


class CourantSteps:
    """Sizes of time steps by Courant numbers: the largest one halved so often that no number exceeds its limit.

    A size divides the time at which its step begins, so that the end of every largest step is reached. It falls at once
    by as much as it has to, and doubles when numbers are well below their limits. Points that may touch approach each
    other by no more than what the run warns of.

    Args:
        fsi: what is coupled, see :class:`coudalfish.coupler.CouDALFISh`; on a fixed mesh.
        largest: step size; unit: time.
        flow: limit of the Courant number ``|u| dt/h`` of any cell, of its largest nodal speed and its shortest edge.
        shell: limit of ``|y'| dt/h``, of the largest speed of the shell and the size of the fluid's cells there.
        halvings: how often the largest step is halved at most.

    Raises:
        ValueError: a number is out of range, or the mesh of the fluid moves.
    """

    def __init__(self, fsi: Any, largest: float, *, flow: float = 2.0, shell: float = 1.0, halvings: int = 2) -> None:
        checks.having("fsi", fsi, "fluid shell timeInt_f", "CouDALFISh(fluid, shell)")
        if fsi.fluid.moving is not None:
            raise ValueError(f"fsi = {fsi!r}: a flow on a fixed mesh is required")
        self._fsi, self._largest = fsi, checks.positive("largest", largest)
        self._flow, self._shell = checks.positive("flow", flow), checks.positive("shell", shell)
        self._halvings, self._last = checks.whole("halvings", halvings, 0), math.inf
        self._cells: tuple[FluidSubproblem, Any, Any] | None = None

    def numbers(self, dt: float) -> dict[str, float]:
        """Numbers of a step from the present state, relative to their limits, between two steps (collective).

        Args:
            dt: its size; unit: time.

        Returns:
            Those of ``flow``, ``shell`` and ``contact``; 0 where there is none.
        """
        shell, size = self._fsi.shell, self._fsi.fluid.mesh_size
        found = {"flow": self._flow_rate() * dt / self._flow}
        found["shell"] = float(np.linalg.norm(shell.velocity(), axis=1).max(initial=0.0)) * dt / (size * self._shell)
        found["contact"] = shell.closing_ratio() / shell.timeInt.step_size * dt / CLOSING_LIMIT
        return found

    def _flow_rate(self) -> float:
        fluid = self._fsi.fluid
        if self._cells is None or self._cells[0] is not fluid:
            corners = compat.cell_dofs(fluid.velocity_space)
            self._cells = fluid, corners, compat.shortest_edges(fluid.mesh)[: len(corners)]
        _, corners, lengths = self._cells
        speed = np.linalg.norm(fluid.timeInt.x.x.array[fluid.velocity_dofs], axis=1)
        rates = speed[corners].max(axis=1) / lengths
        return float(fluid.comm.allreduce(rates.max(initial=0.0), op=MPI.MAX))

    def size(self) -> float:
        """Size of the next step (collective); unit: time."""
        t, most = self._fsi.timeInt_f.time, max(self.numbers(1.0).values())
        for halvings in range(self._halvings + 1):
            size = self._largest / 2**halvings
            limit = 1.0 if size <= self._last else AGAIN
            divides = abs(t / size - round(t / size)) <= SAME_TIME
            if size <= 2.001 * self._last and divides and most * size <= limit:
                break
        self._last = size
        return size
