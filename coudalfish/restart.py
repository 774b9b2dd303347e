"""What a coupled run goes on from, for :class:`tigar_x.run.restart.Restart`."""

from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np
from dolfinx import fem

from tigar_x import checks
from tigar_x.compat import FloatArray
from tigar_x.fem.time_integration import TimeIntegrator
from tigar_x.ranks import first
from tigar_x.run.nodal import wave_sums
from tigar_x.run.restart import Integrators
from tigar_x.splines.spline import ExtractedSpline

SAME = 1e-9
"""Difference of the immersed points' wave sums within which two shells are the same one."""
DIRECTIONS = np.array([1.0, 0.618])
"""How parameters enter the wave sums as one number, which no exchange or reversal of them leaves alone."""


class Coupled(Protocol):
    """What is known of a coupled problem by what it goes on from, see :class:`coudalfish.coupler.CouDALFISh`."""

    fluid: Any
    shell: Any
    options: Any
    spline_sh: ExtractedSpline
    timeInt_f: TimeIntegrator
    timeInt_sh: TimeIntegrator
    lam: FloatArray
    floors: tuple[float, float] | None


class CoupledState:
    """The state of a coupled run: fluid and its mesh where it moves, shell, multiplier, clocks and residual floors.

    Args:
        fsi: what is coupled.
        others: further integrators by name.

    Attributes:
        fields: functions by name; the multiplier is brought up to date by :meth:`record`.
    """

    def __init__(self, fsi: Coupled, **others: TimeIntegrator) -> None:
        checks.having("fsi", fsi, "fluid shell spline_sh timeInt_f timeInt_sh lam", "CouDALFISh(fluid, shell)")
        self._fsi = fsi
        if fsi.fluid.moving is not None:
            others["mesh"] = fsi.fluid.moving.time
        self._integrators = Integrators(fluid=fsi.timeInt_f, shell=fsi.timeInt_sh, **others)
        space = fsi.spline_sh.free(1 if fsi.lam.ndim == 1 else fsi.lam.shape[1])
        self._multiplier = fem.Function(space.V, name="multiplier")
        self.fields = {**self._integrators.fields, "multiplier": self._multiplier}

    @property
    def settings(self) -> dict[str, Any]:
        """Schemes, step sizes and options of the coupling."""
        return {**self._integrators.settings, "options": self._fsi.options}

    @property
    def time(self) -> float:
        """Time t_n of the last accepted state."""
        return self._fsi.timeInt_f.time

    def _shape(self) -> list[float]:
        x = self._fsi.shell.quadrature.points
        size = float(np.linalg.norm(np.ptp(x, axis=0)))
        return [size, *x.min(axis=0), *wave_sums((x - x.min(axis=0)) / size, len(x))]

    def _parameters(self) -> list[float]:
        """What tells in which directions the patches are parametrised, by which normals and the multiplier go."""
        x, spline = self._fsi.shell.quadrature.points, self._fsi.spline_sh
        xi = spline.scalar.V.tabulate_dof_coordinates()[:, : spline.dim]
        low, size = xi.min(axis=0), np.ptp(xi, axis=0)
        together = (
            (x - x.min(axis=0)) / np.linalg.norm(np.ptp(x, axis=0)),
            ((xi - low) / size) @ DIRECTIONS[: len(size)],
        )
        return wave_sums(np.column_stack(together), len(x))

    def record(self) -> dict[str, Any]:
        """Clocks, floors, and what tells the shell from others; the multiplier goes into its field."""
        self._multiplier.x.array[:] = self._fsi.lam.ravel()
        shell = {"shape": self._shape(), "parameters": self._parameters()}
        return {**self._integrators.record(), "floors": self._fsi.floors, **shell}

    def check(self, record: Mapping[str, Any]) -> None:
        """Check that a record is that of this shell.

        Raises:
            ValueError: it is not.
        """
        shape, parameters = first(self._fsi.fluid.comm, (self._shape(), self._parameters()))
        if not np.allclose(record["shape"], shape, rtol=SAME, atol=SAME * shape[0]):
            raise ValueError("the shell of the checkpoint has another shape than this one at the same parameters")
        if not np.allclose(record.get("parameters", parameters), parameters, rtol=0.0, atol=SAME):
            raise ValueError(
                "the shell of the checkpoint is parametrised in other directions than this one, so that its values"
                " would come to other places: the same patches are required"
            )

    def resume(self, record: Mapping[str, Any]) -> None:
        """Take over the fields, which have been read, and the record."""
        self._integrators.resume(record)
        self._fsi.lam = self._multiplier.x.array.reshape(self._fsi.lam.shape).copy()
        self._fsi.floors = None if record["floors"] is None else tuple(record["floors"])
