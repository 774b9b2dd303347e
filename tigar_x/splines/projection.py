"""Projection onto spline spaces: least squares fits, and the cheap lumped one."""

from typing import Any, Protocol

import numpy as np
import ufl
from dolfinx import fem
from numpy.typing import ArrayLike
from petsc4py import PETSc

from tigar_x import checks, compat
from tigar_x.compat import FloatArray
from tigar_x.fem.extracted import extracted_matrix
from tigar_x.fem.linear import PreparedSolver, direct
from tigar_x.geometry.net import ControlNet
from tigar_x.splines.measures import SplineMeasure
from tigar_x.splines.space import SplineSpace


def fit(space: SplineSpace, mass: ufl.Form, load: ufl.Form, dofs: ArrayLike | None = None) -> fem.Function:
    """Solve a linear problem for some coefficients; all others are zero.

    The matrix is that of these coefficients alone, so the forms need not reach the others, as those of a boundary.

    Args:
        space: the space.
        mass: symmetric positive definite bilinear form.
        load: linear form.
        dofs: numbers of the coefficients; None: all but the zero dofs.

    Returns:
        The field.

    Raises:
        ValueError: a number is out of range, or a mask is given.
        SolveError: the linear solver failed.
    """
    first, last = space.M.getOwnershipRangeColumn()
    wanted = np.setdiff1d(np.arange(space.M.size[1]), space.zero_dofs) if dofs is None else dofs
    wanted = checks.indices("dofs", wanted, space.M.size[1]).ravel()
    here = np.sort(wanted[(wanted >= first) & (wanted < last)])
    mass_form, load_form = compat.compile_forms(mass, load)
    b, right = compat.create_vector(space.V), space.M.createVecRight()
    compat.assemble_vector(b, load_form)
    b.ghostUpdate(PETSc.InsertMode.ADD, PETSc.ScatterMode.REVERSE)
    space.M.multTranspose(b, right)
    A = extracted_matrix(space, mass_form, here)
    known, fitted = A.createVecs()
    known.array_w[:] = right.array_r[here - first]
    solver = PreparedSolver(direct(), A)
    solver.solve(known, fitted)
    right.set(0.0)
    right.array_w[here - first] = fitted.array_r
    result = fem.Function(space.V)
    space.M.mult(right, compat.petsc_vector(result))
    result.x.scatter_forward()
    for finished in (solver, A, b, right, known, fitted):
        finished.destroy()
    return result


def scalar_or_vector(f: Any) -> tuple[Any, int]:
    """A scalar or a vector of two or more components, and their number; ValueError if it is neither."""
    shape = ufl.as_ufl(f).ufl_shape
    if len(shape) > 1:
        raise ValueError(f"f has shape {shape}: a scalar or a vector is required")
    return (f[0], 1) if shape == (1,) else (f, int(shape[0]) if shape else 1)


class Projectable(Protocol):
    """What a projection needs of a spline, such as :class:`tigar_x.splines.spline.ExtractedSpline`."""

    @property
    def geometry(self) -> ControlNet:
        """Its control points and weights."""

    @property
    def dx(self) -> SplineMeasure:
        """Measure of the physical reference configuration."""

    def free(self, size: int) -> SplineSpace:
        """Isoparametric space of a number of components without any condition."""

    def rationalize(self, u: Any) -> Any:
        """Physical field of a homogeneous one."""

    def nodal(self, u: fem.Function) -> FloatArray:
        """Physical values of a homogeneous field at the nodes, shape (nodes, components)."""


class LumpedProjector:
    """Lumped projection of physical fields onto the spline space.

    ``U_j = w_j [M^T int f phi/w]_j / [M^T int phi/w]_j``; the factor w_j makes constants exact on rational splines.

    Args:
        spline: the spline.
        size: number of components of the fields; 1: scalars.
    """

    def __init__(self, spline: Projectable, size: int) -> None:
        self.spline = spline
        self.space = spline.free(size)
        self._b = compat.create_vector(self.space.V)
        self._load = self.space.M.createVecRight()
        self._result = fem.Function(self.space.V)
        self._integrate(self.compile(ufl.as_vector([1.0] * size) if size > 1 else ufl.as_ufl(1.0)))
        self._scale = self._load.duplicate()
        first, last = self._scale.getOwnershipRange()
        self._scale.array_w[:] = spline.geometry.weights[np.arange(first, last) // size] / self._load.array_r

    def compile(self, f: Any) -> Any:
        """Compiled form of a field, to be given to :meth:`__call__` as often as its coefficients change.

        Args:
            f: UFL expression, scalar or of shape (size,).
        """
        v = ufl.TestFunction(self.space.V)
        return compat.compile_forms(ufl.inner(f, self.spline.rationalize(v)) * self.spline.dx)[0]

    def _integrate(self, form: Any) -> None:
        compat.assemble_vector(self._b, form)
        self._b.ghostUpdate(PETSc.InsertMode.ADD, PETSc.ScatterMode.REVERSE)
        self.space.M.multTranspose(self._b, self._load)

    def __call__(self, form: Any) -> FloatArray:
        """Nodal values of the projection of a field.

        Args:
            form: from :meth:`compile`.

        Returns:
            Physical values at this rank's nodes, shape (nodes, size).
        """
        self._integrate(form)
        self._load.pointwiseMult(self._load, self._scale)
        self.space.M.mult(self._load, compat.petsc_vector(self._result))
        self._result.x.scatter_forward()
        return self.spline.nodal(self._result)


class Projected:
    """A physical field as nodal values, projected anew at each call; it may be a field of a series.

    Args:
        spline: the spline.
        field: UFL expression, scalar or of shape (size,).
    """

    def __init__(self, spline: Projectable, field: Any) -> None:
        shape = ufl.as_ufl(field).ufl_shape
        self._projector = LumpedProjector(spline, *(shape or (1,)))
        self._form = self._projector.compile(field)

    def __call__(self) -> FloatArray:
        """Values at this rank's nodes, shape (nodes, size); of a scalar (nodes,)."""
        values = self._projector(self._form)
        return values[:, 0] if values.shape[1] == 1 else values
