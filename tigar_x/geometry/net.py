"""What spline geometries share: functions, control points and sides by name."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tigar_x import checks
from tigar_x.compat import FloatArray, IntArray
from tigar_x.geometry.functions import SplineFunctions


class ControlNet(ABC):
    """What all spline geometries share: functions, and a homogeneous control point for each of them.

    Attributes:
        functions: the functions.
        control: homogeneous control points (w x, w), shape (n, nsd + 1); unit: length.
    """

    functions: SplineFunctions
    control: FloatArray

    def _check_control(self) -> FloatArray:
        dim = self.functions.dim
        control = checks.array("control", self.control, (self.functions.n, None)).copy()
        if not dim < control.shape[1] <= 4:
            allowed = f"{dim + 1} to 4 columns (w x, w)"
            raise ValueError(f"control has {control.shape[1]} columns: a patch of dimension {dim} takes {allowed}")
        if (control[:, -1] <= 0.0).any():
            i = int(np.argmax(control[:, -1] <= 0.0))
            raise ValueError(f"weight of control point {i} = {control[i, -1]}: weights > 0 are required")
        control.flags.writeable = False
        return control

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.outline})"

    @property
    def outline(self) -> str:
        """What it is, in a few words."""
        kind, patches = ("curve", "surface", "volume")[self.dim - 1], len(self.functions.boxes)
        degree = " x ".join(map(str, self.functions.degrees))
        parts = [
            f"{kind} in {self.nsd}D",
            f"{self.n} {'rational ' if self.rational else ''}functions of degree {degree}",
        ]
        return ", ".join([*parts, f"{patches} patches"] if patches > 1 else parts)

    @property
    def n(self) -> int:
        """Number of functions."""
        return self.functions.n

    @property
    def dim(self) -> int:
        """Parametric dimension."""
        return self.functions.dim

    @property
    def nsd(self) -> int:
        """Dimension of physical space."""
        return int(self.control.shape[1]) - 1

    @property
    def weights(self) -> FloatArray:
        """Weights of the control points, shape (n,)."""
        return self.control[:, -1]

    @property
    def points(self) -> FloatArray:
        """Physical control points, shape (n, nsd)."""
        return checks.read_only(self.control[:, :-1] / self.weights[:, None])

    @property
    def rational(self) -> bool:
        """Whether the weights differ from one."""
        return bool((self.weights != 1.0).any())

    @abstractmethod
    def locate_sides(self, names: Sequence[str], patch: int | None = None) -> list[tuple[int, int, int]]:
        """Sides by name.

        Args:
            names: see :meth:`tigar_x.geometry.patch.Patch.locate_side`; none: all there are.
            patch: which patch; None: every patch.

        Returns:
            Patch, direction and end of every side.

        Raises:
            ValueError: there is no such side or patch.
        """

    @abstractmethod
    def side_places(self) -> list[dict[str, tuple[int, int]]]:
        """For every patch its sides by name, each with its direction and end."""

    @abstractmethod
    def side_functions(self, patch: int, direction: int, end: int, layers: int = 1) -> IntArray:
        """Functions next to a side, sorted.

        Args:
            patch: which patch.
            direction: direction normal to the side.
            end: its start (0) or end (1).
            layers: rows of functions.
        """

    def where(self, predicate: Callable[[FloatArray], NDArray[np.bool_]]) -> IntArray:
        """Functions whose control points lie in a region.

        Args:
            predicate: maps physical control points of shape (nsd, n) to a mask of shape (n,).

        Returns:
            Function numbers, sorted.

        Raises:
            ValueError: the predicate selects nothing or does not return a mask.
        """
        mask = np.asarray(predicate(self.points.T))
        if mask.shape != (self.n,) or mask.dtype != bool:
            raise ValueError(
                f"predicate returned {mask.dtype} of shape {mask.shape}: bool of shape ({self.n},) required"
            )
        if not mask.any():
            raise ValueError(f"predicate = {predicate!r} selects no control point: at least one is required")
        return np.flatnonzero(mask).astype(np.int32)

    def dofs(self, functions: ArrayLike, components: Sequence[int] | None = None) -> IntArray:
        """Degrees of freedom of a vector field with nsd components.

        Args:
            functions: function numbers.
            components: components of the field; None: all ``nsd``.

        Returns:
            Numbers function * nsd + component, sorted.

        Raises:
            ValueError: no such function or component, or a mask instead of numbers.
        """
        chosen = range(self.nsd) if components is None else components
        parts = [checks.choice("components", c, tuple(range(self.nsd))) for c in chosen]
        rows = checks.indices("functions", functions, self.n).ravel()
        return np.unique(rows[:, None] * self.nsd + np.array(parts, dtype=np.int32)[None, :]).astype(np.int32)
