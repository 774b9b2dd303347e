"""What is measured of a shell: places, energies, resultants."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import ufl
from mpi4py import MPI
from dolfinx import fem
from numpy.typing import ArrayLike
from petsc4py import PETSc

from tigar_x import checks, compat
from tigar_x.compat import FloatArray
from tigar_x.splines.sampling import Sampling, marks
from tigar_x.splines.spline import ExtractedSpline

if TYPE_CHECKING:
    from shnapr.contact.self_contact import SelfContact


@dataclass(frozen=True)
class Energies:
    """Energies of a shell (per depth in the plane).

    Attributes:
        elastic: strain energy.
        kinetic: of the last accepted state; 0 in statics.
        contact: potential of contact.
    """

    elastic: float
    kinetic: float
    contact: float

    @property
    def total(self) -> float:
        """Their sum."""
        return self.elastic + self.kinetic + self.contact


@dataclass(frozen=True, eq=False)
class Places:
    """Where points of a shell are.

    Attributes:
        reference: positions before deformation, shape (..., nsd); unit: length.
        displacement: shape (..., nsd); unit: length.
    """

    reference: FloatArray
    displacement: FloatArray

    def __post_init__(self) -> None:
        checks.freeze(self)

    @property
    def position(self) -> FloatArray:
        """Present positions, shape (..., nsd)."""
        return self.reference + self.displacement

    @classmethod
    def of(
        cls, spline: ExtractedSpline, y: fem.Function, place: str | ArrayLike | Sampling, along: float, patch: int
    ) -> "Places":
        """See :meth:`shnapr.shell.Shell.at`."""
        if isinstance(place, str):
            place = _on_side(spline, place, along, patch)
        points = place if isinstance(place, Sampling) else marks(spline, place, patch=patch)
        return cls(points.reference, points.values(y))


def _on_side(spline: ExtractedSpline, name: str, along: float, patch: int) -> FloatArray:
    """Parameters of a point of a patch's side, shape (parametric dimension,)."""
    ((_, direction, end),) = spline.geometry.locate_sides([name], patch)
    functions = spline.geometry.functions
    origin = functions.to_plane(patch, np.zeros((1, spline.dim)))[0]
    low, high = np.asarray(functions.boxes[patch]) - origin
    xi = low + checks.within("along", along, 0.0, 1.0) * (high - low)
    xi[direction] = (low, high)[end][direction]
    return np.asarray(xi)


class EnergyForms:
    """Compiled energies of a shell.

    Args:
        spline: the midsurface.
        forms: elastic energy, and the kinetic one in time.
        contact: contact with itself; None: none.
    """

    def __init__(self, spline: ExtractedSpline, forms: Sequence[ufl.Form], contact: "SelfContact | None") -> None:
        self._forms, self._contact = compat.compile_forms(*forms), contact

    def __call__(self, positions: FloatArray) -> Energies:
        """Energies of the present state, with positions of the nodes (collective)."""
        elastic, *kinetic = (compat.assemble_scalar(form) for form in self._forms)
        touching = 0.0 if self._contact is None else self._contact.evaluate(positions, tangent=False).energy
        return Energies(elastic, kinetic[0] if kinetic else 0.0, touching)


def field_of(spline: ExtractedSpline, name: str, data: Any) -> fem.Function:
    """A homogeneous field of a spline.

    Args:
        spline: the midsurface.
        name: what messages call it.
        data: coefficients, shape (functions, nsd), or a UFL vector, which is projected; None: zero.

    Raises:
        ValueError: the shape is not allowed.
    """
    if isinstance(data, ufl.core.expr.Expr):
        return spline.project(checks.vector(name, data, spline.nsd), constrained=True)
    coefficients = None if data is None else checks.array(name, data, (spline.geometry.n, spline.nsd))
    return spline.function(coefficients, name)


def resultant(spline: ExtractedSpline, form: ufl.Form) -> FloatArray:
    """Sum of the forces of a residual form (collective).

    Args:
        spline: the midsurface.
        form: linear in a test function of ``spline.V``.

    Returns:
        What the form gives for a virtual displacement of all points by one along each axis, shape (nsd,).
    """
    nodal, (compiled,) = compat.create_vector(spline.V), compat.compile_forms(form)
    compat.assemble_vector(nodal, compiled)
    nodal.ghostUpdate(PETSc.InsertMode.ADD, PETSc.ScatterMode.REVERSE)
    forces = np.array(nodal.array_r).reshape(-1, spline.nsd)
    nodal.destroy()
    # the homogeneous field of a uniform displacement has the weights as its nodal values
    own = spline.node_weights[: len(forces)] @ forces
    return np.asarray(spline.mesh.comm.allreduce(own, op=MPI.SUM))
