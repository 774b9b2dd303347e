"""``ExtractedSpline``: fields, geometry and calculus of a spline in UFL.

Fields are stored in homogeneous form: the coefficient function u^h lies in the spline space and the physical field is
u = u^h / w. For a B-spline w = 1 and the division does not enter the forms. Source: Kamensky and Bazilevs,
doi:10.1016/j.cma.2018.10.002.
"""

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np
import ufl
from mpi4py import MPI
from dolfinx import fem
from numpy.typing import ArrayLike
from petsc4py import PETSc

from tigar_x import checks, compat
from tigar_x.compat import FloatArray, IntArray
from tigar_x.extraction import extract, set_nodal
from tigar_x.patch import Patch


class SurfaceMeasure:
    """Integration over the physical reference configuration: ``integrand * measure`` gives a form.

    Args:
        jacobian: physical length or area per parametric one.
        measure: UFL measure of the parametric mesh with its quadrature degree.
    """

    def __init__(self, jacobian: Any, measure: ufl.Measure) -> None:
        self.jacobian = jacobian
        self.measure = measure

    def __rmul__(self, integrand: Any) -> ufl.Form:
        """Form of ``integrand`` over the surface."""
        return integrand * self.jacobian * self.measure


class ExtractedSpline:
    """A spline patch as a dolfinx function space with an extraction matrix.

    Args:
        patch: the geometry.
        comm: communicator; coupled runs put a whole copy on every rank with ``MPI.COMM_SELF``.
        quadrature_degree: degree of every integral over the spline; None: twice the largest degree.
        zero_dofs: spline coefficients (function * nsd + component) whose increments vanish, see
            :meth:`tigar_x.patch.Patch.side_dofs`.

    Attributes:
        V: vector Lagrange space with nsd components, for homogeneous displacement-like fields.
        M: extraction matrix of ``V`` (PETSc), from spline coefficients to nodal values.
        F: physical position as UFL expression over the parametric mesh, shape (nsd,); unit: length.
        weight: weight field w, or None for a B-spline.
        dx: measure of the physical reference configuration.
        node_positions: reference positions of this rank's nodes, shape (nodes, nsd); unit: length.
        node_weights: w at the nodes, shape (nodes,).
        node_areas: integrals of the nodal functions over the reference surface, shape (nodes,).

    Raises:
        ValueError: quadrature degree or zero dofs out of range.
    """

    def __init__(
        self,
        patch: Patch,
        comm: MPI.Comm = MPI.COMM_WORLD,
        *,
        quadrature_degree: int | None = None,
        zero_dofs: ArrayLike | Sequence[int] = (),
    ) -> None:
        self.patch = patch
        self.nsd = patch.nsd
        degree = max(basis.degree for basis in patch.bases)
        chosen = 2 * degree if quadrature_degree is None else quadrature_degree
        self.quadrature_degree = checks.whole("quadrature_degree", chosen, 0)
        self.zero_dofs: IntArray = np.unique(np.asarray(zero_dofs, dtype=np.int32))
        n = patch.basis.n * self.nsd
        if len(self.zero_dofs) and not 0 <= self.zero_dofs[0] <= self.zero_dofs[-1] < n:
            raise ValueError(f"zero_dofs ranges over [{self.zero_dofs[0]}, {self.zero_dofs[-1]}]: 0 to {n - 1} allowed")

        self.extraction = extract(patch, comm)
        self.mesh = self.extraction.mesh
        self.V_scalar = self.extraction.space
        self.V = compat.lagrange_space(self.mesh, degree, self.nsd)
        self.M = self.extraction.vector_matrix(self.nsd)

        homogeneous = self.extraction.M @ patch.control
        if patch.rational:
            control = fem.Function(compat.lagrange_space(self.mesh, degree, self.nsd + 1), name="control")
            set_nodal(control, homogeneous)
            self.weight = control[self.nsd]
            self.F = ufl.as_vector([control[i] / control[self.nsd] for i in range(self.nsd)])
        else:
            control = fem.Function(self.V, name="control")
            set_nodal(control, homogeneous[:, :-1])
            self.weight = None
            self.F = ufl.as_vector([control[i] for i in range(self.nsd)])
        self.DF = ufl.grad(self.F)
        self.metric = self.DF.T * self.DF
        jacobian = ufl.sqrt(ufl.det(self.metric) if patch.dim > 1 else self.metric[0, 0])
        self._measure = ufl.dx(domain=self.mesh, metadata={"quadrature_degree": self.quadrature_degree})
        self.dx = SurfaceMeasure(jacobian, self._measure)

        self.node_weights: FloatArray = homogeneous[:, -1]
        self.node_positions: FloatArray = homogeneous[:, :-1] / homogeneous[:, -1:]
        self.node_areas = self._measure_nodes()

    def _measure_nodes(self) -> FloatArray:
        """Integrals of the nodal functions over the reference surface; an element without area is refused."""
        cells = compat.lagrange_space(self.mesh, 0)
        node_form, cell_form = compat.compile_forms(
            ufl.TestFunction(self.V_scalar) * self.dx, ufl.TestFunction(cells) * self.dx
        )
        areas, cell_areas = compat.create_vector(self.V_scalar), compat.create_vector(cells)
        compat.assemble_vector(cell_areas, cell_form)
        worst = np.nan_to_num(cell_areas.array_r, nan=0.0).min(initial=np.inf)
        rounding = 1e-14 * np.abs(self.patch.points).max() ** self.patch.dim
        if not self.mesh.comm.allreduce(worst, op=MPI.MIN) > rounding:
            raise ValueError("patch has an element of zero length or area: distinct control points are required")
        compat.assemble_vector(areas, node_form)
        areas.ghostUpdate(PETSc.InsertMode.ADD, PETSc.ScatterMode.REVERSE)
        areas.ghostUpdate(PETSc.InsertMode.INSERT, PETSc.ScatterMode.FORWARD)
        with areas.localForm() as local:
            return local.array.copy()

    # -- fields -------------------------------------------------------------------------------------------------------

    def rationalize(self, u: Any) -> Any:
        """Physical field u^h / w of a homogeneous one (the field itself on a B-spline)."""
        return u if self.weight is None else u / self.weight

    def function(self, coefficients: ArrayLike | None = None, name: str = "f") -> fem.Function:
        """Field in ``V``.

        Args:
            coefficients: homogeneous spline coefficients, shape (functions, nsd); None: zero.
            name: name for output.

        Returns:
            The homogeneous field with nodal values M U.
        """
        u = fem.Function(self.V, name=name)
        if coefficients is not None:
            U = checks.array("coefficients", coefficients, (self.patch.basis.n, self.nsd))
            set_nodal(u, self.extraction.M @ U)
        return u

    def nodal(self, u: fem.Function) -> FloatArray:
        """Physical values of a homogeneous field in ``V`` at the nodes, shape (nodes, nsd)."""
        return u.x.array.reshape(-1, self.nsd) / self.node_weights[:, None]

    # -- calculus -----------------------------------------------------------------------------------------------------

    def parametric_grad(self, f: Any) -> Any:
        """Derivatives with respect to the parameters; appends an axis of the parametric dimension."""
        return ufl.grad(f)

    @cached_property
    def _pseudo_inverse(self) -> Any:
        if self.patch.dim == 1:
            return self.DF.T / self.metric[0, 0]
        return ufl.inv(self.metric) * self.DF.T

    def grad(self, f: Any) -> Any:
        """Cartesian (surface) gradient ``f,xi (DF^T DF)^-1 DF^T``; appends an axis of length nsd."""
        return ufl.dot(self.parametric_grad(f), self._pseudo_inverse)

    def div(self, f: Any) -> Any:
        """Surface divergence: trace of the last two axes of :meth:`grad`."""
        gradient = self.grad(f)
        i = ufl.indices(len(gradient.ufl_shape) - 1)
        return ufl.as_tensor(gradient[(*i, i[-1])], i[:-1]) if len(i) > 1 else gradient[i[0], i[0]]

    # -- projection ---------------------------------------------------------------------------------------------------

    def project(self, f: Any, *, constrained: bool = False) -> fem.Function:
        """L2 projection of a physical vector field onto the spline space (consistent mass matrix).

        Args:
            f: UFL expression over the parametric mesh, shape (nsd,).
            constrained: whether the zero dofs stay zero.

        Returns:
            Homogeneous field u^h with ``int (u^h/w) . (v^h/w) = int f . (v^h/w)`` for all v^h.
        """
        from tigar_x.linear import direct
        from tigar_x.solve import SplineSystem

        u, v = ufl.TrialFunction(self.V), ufl.TestFunction(self.V)
        mass = ufl.inner(self.rationalize(u), self.rationalize(v)) * self.dx
        load = ufl.inner(f, self.rationalize(v)) * self.dx
        result = fem.Function(self.V)
        system = SplineSystem(self, load, mass, direct(), zero_dofs=self.zero_dofs if constrained else ())
        system.assemble_residual()
        system.assemble_tangent()
        system.add(result, system.solve())
        return result

    @cached_property
    def lumped_projector(self) -> "LumpedProjector":
        """The cheap projection with a diagonal mass matrix."""
        return LumpedProjector(self)


class LumpedProjector:
    """Lumped projection of physical vector fields onto the spline space.

    ``U_j = w_j [M^T int f phi/w]_j / [M^T int phi/w]_j``; the factor w_j makes constants exact on rational splines.

    Args:
        spline: the spline.
    """

    def __init__(self, spline: ExtractedSpline) -> None:
        self.spline = spline
        self._b = compat.create_vector(spline.V)
        self._load = spline.M.createVecRight()
        self._result = fem.Function(spline.V)
        self._integrate(self.compile(ufl.as_vector([1.0] * spline.nsd)))
        self._scale = self._load.duplicate()
        first, last = self._scale.getOwnershipRange()
        self._scale.array_w[:] = spline.patch.weights[np.arange(first, last) // spline.nsd] / self._load.array_r

    def compile(self, f: Any) -> Any:
        """Compiled form of a field, to be given to :meth:`__call__` as often as its coefficients change.

        Args:
            f: UFL expression, shape (nsd,).
        """
        v = ufl.TestFunction(self.spline.V)
        return compat.compile_forms(ufl.inner(f, self.spline.rationalize(v)) * self.spline.dx)[0]

    def _integrate(self, form: Any) -> None:
        compat.assemble_vector(self._b, form)
        self._b.ghostUpdate(PETSc.InsertMode.ADD, PETSc.ScatterMode.REVERSE)
        self.spline.M.multTranspose(self._b, self._load)

    def __call__(self, form: Any) -> FloatArray:
        """Nodal values of the projection of a field.

        Args:
            form: from :meth:`compile`.

        Returns:
            Physical values at this rank's nodes, shape (nodes, nsd).
        """
        self._integrate(form)
        self._load.pointwiseMult(self._load, self._scale)
        self.spline.M.mult(self._load, compat.petsc_vector(self._result))
        self._result.x.scatter_forward()
        return self.spline.nodal(self._result)
