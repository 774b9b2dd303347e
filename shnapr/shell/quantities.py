"""What is measured of a shell: places, energies, resultants."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import ufl
from mpi4py import MPI
from dolfinx import fem
from petsc4py import PETSc

from tigar_x import checks, compat
from tigar_x.compat import FloatArray
from tigar_x.splines.spline import ExtractedSpline


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
        reference: positions before deformation, shape (points, nsd); unit: length.
        displacement: shape (points, nsd); unit: length.
    """

    reference: FloatArray
    displacement: FloatArray

    def __post_init__(self) -> None:
        checks.freeze(self)

    @property
    def position(self) -> FloatArray:
        """Present positions, shape (points, nsd)."""
        return self.reference + self.displacement

    @classmethod
    def of(cls, spline: ExtractedSpline, y: fem.Function, xi: FloatArray, patch: int) -> "Places":
        """Places at parameters of a patch (collective).

        Args:
            spline: the midsurface.
            y: homogeneous displacement.
            xi: shape (points, parametric dimension).
            patch: which patch.

        Raises:
            ValueError: there is no such patch, or a parameter lies outside of it.
        """
        displacement = spline.evaluate(y, xi, patch)
        functions = spline.geometry.functions
        homogeneous = np.asarray(functions.evaluate(functions.to_plane(patch, xi)) @ spline.geometry.control)
        return cls(homogeneous[:, :-1] / homogeneous[:, -1:], displacement)


def on_side(spline: ExtractedSpline, name: str, along: float, patch: int) -> FloatArray:
    """Parameters of a point of a patch's side.

    Args:
        spline: the midsurface.
        name: of the side.
        along: how far along the side, from 0 to 1.
        patch: which patch.

    Returns:
        Shape (1, parametric dimension).

    Raises:
        ValueError: there is no such side or patch, or ``along`` is out of range.
    """
    ((_, direction, end),) = spline.geometry.locate_sides([name], patch)
    functions = spline.geometry.functions
    origin = functions.to_plane(patch, np.zeros((1, spline.dim)))[0]
    low, high = np.asarray(functions.boxes[patch]) - origin
    xi = low + checks.within("along", along, 0.0, 1.0) * (high - low)
    xi[direction] = (low, high)[end][direction]
    return np.asarray(xi)[None]


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


def derivative_of(terms: list[ufl.Form], y: fem.Function, start: Any) -> Any:
    """Sum of derivatives of those terms that depend on y, added to a form."""
    depend = [term for term in terms if any(c is y for c in term.coefficients())]
    return sum((ufl.derivative(term, y) for term in depend), start)
