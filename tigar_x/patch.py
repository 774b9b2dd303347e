"""A spline geometry as data: degrees, knots and homogeneous control points."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from tigar_x import checks
from tigar_x.bspline import BSplineBasis, TensorBasis
from tigar_x.compat import FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class Patch:
    """One B-spline or NURBS patch: a curve (parametric dimension 1) or a surface (2).

    Attributes:
        bases: univariate bases, one per parametric direction.
        control: homogeneous control points (w x, w), first direction fastest, shape (n, nsd + 1); unit: length.

    Raises:
        ValueError: wrong shape, non-finite control points or weights that are not positive.
    """

    bases: tuple[BSplineBasis, ...]
    control: FloatArray

    def __post_init__(self) -> None:
        if len(self.bases) not in (1, 2):
            raise ValueError(f"bases has {len(self.bases)} directions: 1 or 2 are supported")
        control = checks.array("control", self.control, (self.basis.n, None)).copy()
        if not self.dim < control.shape[1] <= 4:
            allowed = f"{self.dim + 1} to 4 columns (w x, w)"
            raise ValueError(f"control has {control.shape[1]} columns: a patch of dimension {self.dim} takes {allowed}")
        if (control[:, -1] <= 0.0).any():
            i = int(np.argmax(control[:, -1] <= 0.0))
            raise ValueError(f"weight of control point {i} = {control[i, -1]}: weights > 0 are required")
        control.flags.writeable = False
        object.__setattr__(self, "control", control)

    @classmethod
    def from_points(cls, bases: Sequence[BSplineBasis], points: ArrayLike, weights: ArrayLike | None = None) -> "Patch":
        """Patch from physical control points.

        Args:
            bases: univariate bases.
            points: control points, first direction fastest, shape (n, nsd); unit: length.
            weights: NURBS weights, shape (n,); None: a B-spline.

        Returns:
            The patch.
        """
        x = checks.array("points", points, (None, None))
        w = np.ones(len(x)) if weights is None else checks.array("weights", weights, (len(x),))
        return cls(tuple(bases), np.column_stack([x * w[:, None], w]))

    @cached_property
    def basis(self) -> TensorBasis:
        """Tensor-product basis."""
        return TensorBasis(self.bases)

    @property
    def dim(self) -> int:
        """Parametric dimension."""
        return len(self.bases)

    @property
    def nsd(self) -> int:
        """Dimension of physical space."""
        return self.control.shape[1] - 1

    @property
    def weights(self) -> FloatArray:
        """Weights of the control points, shape (n,)."""
        return self.control[:, -1]

    @property
    def points(self) -> FloatArray:
        """Physical control points, shape (n, nsd)."""
        return self.control[:, :-1] / self.weights[:, None]

    @property
    def rational(self) -> bool:
        """Whether the weights differ from one."""
        return bool((self.weights != 1.0).any())

    def evaluate(self, xi: ArrayLike) -> FloatArray:
        """Physical points of parameters.

        Args:
            xi: shape (m, parametric dimension).

        Returns:
            Points, shape (m, nsd).
        """
        homogeneous = self.basis.evaluate(xi) @ self.control
        return homogeneous[:, :-1] / homogeneous[:, -1:]

    def side(self, direction: int, end: int, layers: int = 1) -> IntArray:
        """Functions next to a side.

        Args:
            direction: parametric direction that is normal to the side.
            end: 0 for the start, 1 for the end of that direction.
            layers: rows of functions: 1 fixes the position of the side, 2 its tangent as well.

        Returns:
            Function indices, sorted.

        Raises:
            ValueError: there is no such side or not that many layers.
        """
        checks.choice("direction", direction, tuple(range(self.dim)))
        checks.choice("end", end, (0, 1))
        n = self.bases[direction].n
        if checks.whole("layers", layers, 1) > n:
            raise ValueError(f"layers = {layers}: direction {direction} has only {n} functions")
        index = np.arange(self.basis.n).reshape([basis.n for basis in self.bases], order="F")
        rows = np.arange(layers) if end == 0 else np.arange(n - layers, n)
        return np.sort(np.take(index, rows, axis=direction).ravel()).astype(np.int32)

    def side_dofs(self, direction: int, end: int, layers: int = 1, components: Sequence[int] | None = None) -> IntArray:
        """Degrees of freedom of a vector field next to a side.

        Args:
            direction: parametric direction that is normal to the side.
            end: 0 for the start, 1 for the end of that direction.
            layers: rows of functions, see :meth:`side`.
            components: components of the field; None: all ``nsd``.

        Returns:
            Indices function * nsd + component, sorted.

        Raises:
            ValueError: no such side, layer or component.
        """
        chosen = range(self.nsd) if components is None else components
        parts = [checks.choice("components", c, tuple(range(self.nsd))) for c in chosen]
        functions = self.side(direction, end, layers)
        return np.sort((functions[:, None] * self.nsd + np.array(parts, dtype=np.int32)[None, :]).ravel())
