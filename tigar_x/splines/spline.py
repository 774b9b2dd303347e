"""``ExtractedSpline``: fields, geometry and calculus of a spline in UFL.

Fields are stored in homogeneous form: the coefficient function u^h lies in the spline space and the physical field is
u = u^h / w. For a B-spline w = 1 and the division does not enter the forms. Source: Kamensky and Bazilevs,
doi:10.1016/j.cma.2018.10.002.
"""

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse as sp
import ufl
from mpi4py import MPI
from dolfinx import fem
from numpy.typing import ArrayLike

from tigar_x import checks, compat
from tigar_x.compat import FloatArray
from tigar_x.geometry.functions import Cells, within_patch
from tigar_x.geometry.locate import points_on
from tigar_x.geometry.multipatch import MultiPatch
from tigar_x.geometry.net import ControlNet
from tigar_x.geometry.patch import Patch
from tigar_x.splines.extraction import Evaluable, element_degree, parametric_mesh, set_nodal
from tigar_x.splines.measures import SideMeasure, SplineMeasure, nodal_integrals, refuse_flat_elements
from tigar_x.splines.projection import LumpedProjector, fit, scalar_or_vector
from tigar_x.splines.sides import named_or_outer, tag_of, tagged_sides
from tigar_x.splines.space import SplineSpace


class ExtractedSpline:
    """A spline geometry as dolfinx function spaces with extraction matrices.

    Args:
        geometry: a patch, several in one numbering, or a geometry read from a file.
        comm: communicator; coupled runs put a whole copy on every rank with ``MPI.COMM_SELF``.
        cells: "tensor" for quadrilaterals and hexahedra, "simplex" for triangles and tetrahedra as Bezier elements.
        quadrature_degree: degree of every integral over the spline; None: twice the largest degree.
        zero_dofs: coefficients (function * nsd + component) of ``V`` whose increments vanish, see
            :meth:`tigar_x.geometry.patch.Patch.side_dofs`.
        constraints: further linear constraints in ``V``, see :mod:`tigar_x.splines.constraints`.

    Attributes:
        geometry: as given.
        cells: as given.
        dim: parametric dimension.
        nsd: dimension of physical space.
        mesh: parametric mesh.
        vector: the space of ``V`` with its conditions.
        V: vector Lagrange space with nsd components, for homogeneous displacement-like fields.
        M: extraction matrix of ``V`` (PETSc), from spline coefficients to nodal values.
        rows: this rank's rows of ``M`` (scipy).
        zero_dofs: columns of ``M`` whose increments vanish.
        F: physical position as UFL expression over the parametric mesh, shape (nsd,); unit: length.
        weight: weight field w, or None for a B-spline.
        dx: measure of the physical reference configuration.
        node_positions: reference positions of this rank's nodes, shape (nodes, nsd); unit: length.
        node_weights: w at the nodes, shape (nodes,).

    Raises:
        ValueError: quadrature degree or zero dofs out of range, or an element without length, area or volume.
    """

    def __init__(
        self,
        geometry: ControlNet,
        comm: MPI.Comm = MPI.COMM_WORLD,
        *,
        cells: Cells = "tensor",
        quadrature_degree: int | None = None,
        zero_dofs: ArrayLike | Sequence[int] = (),
        constraints: Sequence[sp.spmatrix] = (),
    ) -> None:
        self.geometry = checks.kind("geometry", geometry, ControlNet, "a Patch, a MultiPatch or a saved geometry")
        checks.kind("comm", comm, MPI.Comm, "a communicator, such as MPI.COMM_SELF,")
        self.cells = cells
        self.dim, self.nsd = geometry.dim, geometry.nsd
        chosen = 2 * max(geometry.functions.degrees) if quadrature_degree is None else quadrature_degree
        self.quadrature_degree = checks.whole("quadrature_degree", chosen, 0)
        self.mesh = parametric_mesh(geometry.functions.cells(cells), comm)
        self._spaces: dict[int, SplineSpace] = {}
        self.vector = self.space(self.nsd, zero_dofs=zero_dofs, constraints=constraints)
        self.V, self.M, self.rows = self.vector.V, self.vector.M, self.vector.rows
        self.zero_dofs = self.vector.zero_dofs

        homogeneous = self.vector.nodes @ geometry.control
        self.node_weights: FloatArray = homogeneous[:, -1]
        self.node_positions: FloatArray = homogeneous[:, :-1] / homogeneous[:, -1:]
        size = self.nsd + 1 if geometry.rational else self.nsd
        degree = element_degree(geometry.functions.degrees, cells == "simplex" and self.dim > 1)
        control = fem.Function(compat.lagrange_space(self.mesh, degree, size), name="control")
        set_nodal(control, homogeneous[:, :size])
        parts = [control[i] for i in range(size)] if size > 1 else [control]
        self.weight = parts[-1] if geometry.rational else None
        self.F = ufl.as_vector([self.rationalize(part) for part in parts[: self.nsd]])
        self.DF = ufl.grad(self.F)
        self.metric = self.DF.T * self.DF
        jacobian = ufl.sqrt(ufl.det(self.metric) if self.dim > 1 else self.metric[0, 0])
        metadata = {"quadrature_degree": self.quadrature_degree}
        self.dx = SplineMeasure(jacobian, ufl.dx(domain=self.mesh, metadata=metadata))
        refuse_flat_elements(self.mesh, self.dx, geometry)

    def __repr__(self) -> str:
        space, cells = self.vector, self.mesh.topology.index_map(self.dim).size_global
        held = f"{space.n} coefficients, {len(space.fixed)} held"
        held += f", {space.constraints.shape[0]} constraints" if space.constraints.shape[0] else ""
        return f"ExtractedSpline({self.geometry.outline}, {cells} {compat.cell_name(self.mesh)} cells, {held})"

    @cached_property
    def node_areas(self) -> FloatArray:
        """Integrals of the nodal functions over the reference configuration, shape (nodes,)."""
        return nodal_integrals(self.scalar.V, self.dx)

    # -- fields -------------------------------------------------------------------------------------------------------

    def space(
        self,
        *parts: int | tuple[Evaluable, int],
        zero_dofs: ArrayLike | Sequence[int] = (),
        constraints: Sequence[sp.spmatrix] = (),
    ) -> SplineSpace:
        """Space of fields over this spline.

        Args:
            parts: for every field the number of its components, or functions of another degree or continuity on the
                same Bezier elements and the number of components.
            zero_dofs: coefficients whose increments vanish.
            constraints: linear constraints between coefficients.

        Returns:
            The space.

        Raises:
            ValueError: functions of a part are not polynomials on every Bezier element.
        """
        pairs = [(self.geometry.functions, part) if isinstance(part, int) else part for part in parts]
        for i, (functions, _) in enumerate(pairs):
            if functions is not self.geometry.functions:
                self.geometry.functions.require_elements(f"parts[{i}]", functions)
        return SplineSpace(self.mesh, *pairs, zero_dofs=zero_dofs, constraints=constraints)

    def free(self, size: int) -> SplineSpace:
        """Isoparametric space of a number of components without any condition, made once."""
        if size not in self._spaces:
            self._spaces[size] = self.space(size)
        return self._spaces[size]

    @property
    def scalar(self) -> SplineSpace:
        """Isoparametric scalar space without any condition."""
        return self.free(1)

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
        return self.vector.function(coefficients, name)

    def nodal(self, u: fem.Function) -> FloatArray:
        """Physical values of a homogeneous isoparametric field at the nodes, shape (nodes, components)."""
        size = u.function_space.dofmap.index_map_bs
        return u.x.array.reshape(-1, size) / self.node_weights[:, None]

    def evaluate(self, u: fem.Function, xi: ArrayLike, patch: int = 0) -> FloatArray:
        """Physical values of a homogeneous isoparametric field at parameters of a patch (collective).

        Args:
            u: field of any number of components, in the spline space.
            xi: the same on every rank, shape (m, parametric dimension).
            patch: which patch.

        Returns:
            Values, shape (m, components), on every rank.

        Raises:
            ValueError: there is no such patch, or a parameter lies outside of it.
        """
        functions = self.geometry.functions
        checks.choice("patch", patch, tuple(range(len(functions.boxes))))
        N = functions.evaluate(within_patch(functions, patch, checks.array("xi", xi, (None, self.dim))))
        size = u.function_space.dofmap.index_map_bs
        return np.asarray((N @ self.free(size).coefficients(u)) / (N @ self.geometry.weights)[:, None])

    def evaluate_at(self, u: fem.Function, points: ArrayLike, *, distance: float | None = None) -> FloatArray:
        """Physical values of a homogeneous isoparametric field at points of space (collective).

        Args:
            u: field of any number of components, in the spline space.
            points: on the reference configuration, or near it: the closest points count; the same on every rank, shape
                (m, nsd); unit: length.
            distance: largest distance from the spline that is allowed; None: 1e-6 of its size.

        Returns:
            Values, shape (m, components), on every rank.

        Raises:
            ValueError: a point lies farther away, or the geometry was read from a file.
        """
        if not isinstance(self.geometry, Patch | MultiPatch):
            raise ValueError(f"geometry = {type(self.geometry).__name__}: points can be located on patches only")
        found = points_on(self.geometry, points, distance)
        values = np.empty((len(found.patch), u.function_space.dofmap.index_map_bs))
        for patch in range(len(self.geometry.functions.bases)):
            here = found.patch == patch
            values[here] = self.evaluate(u, found.xi[here], patch)
        return values

    # -- calculus -----------------------------------------------------------------------------------------------------

    def parametric_grad(self, f: Any) -> Any:
        """Derivatives with respect to the parameters; appends an axis of the parametric dimension."""
        return ufl.grad(f)

    @cached_property
    def inverse_metric(self) -> Any:
        """Contravariant metric, shape (parametric dimension, parametric dimension)."""
        return ufl.inv(self.metric) if self.dim > 1 else ufl.as_matrix([[1 / self.metric[0, 0]]])

    @cached_property
    def _pseudo_inverse(self) -> Any:
        if self.dim == 1:
            return self.DF.T / self.metric[0, 0]
        return self.inverse_metric * self.DF.T

    def grad(self, f: Any) -> Any:
        """Cartesian (surface) gradient ``f,xi (DF^T DF)^-1 DF^T``; appends an axis of length nsd."""
        return ufl.dot(self.parametric_grad(f), self._pseudo_inverse)

    def div(self, f: Any) -> Any:
        """Surface divergence: trace of the last two axes of :meth:`grad`."""
        gradient = self.grad(f)
        i = ufl.indices(len(gradient.ufl_shape) - 1)
        return ufl.as_tensor(gradient[(*i, i[-1])], i[:-1]) if len(i) > 1 else gradient[i[0], i[0]]

    # -- sides --------------------------------------------------------------------------------------------------------

    @cached_property
    def _ds(self) -> ufl.Measure:
        """Exterior facets of the parametric mesh, numbered by their sides."""
        tags = tagged_sides(self.mesh, self.geometry.functions.boxes)
        metadata = {"quadrature_degree": self.quadrature_degree}
        return ufl.ds(domain=self.mesh, subdomain_data=tags, metadata=metadata)

    def ds(self, *sides: str, patch: int | None = None) -> SideMeasure:
        """Measure of sides in the physical reference configuration: of points (1), edges or faces.

        Args:
            sides: names, such as "u0"; none: the boundary, which is all sides that are not glued to another one.
            patch: whose sides; None: those of all patches.

        Returns:
            The measure.

        Raises:
            ValueError: there is no such side or patch.
        """
        tags = tuple(tag_of(place, self.dim) for place in named_or_outer(self.geometry, sides, patch))
        N = ufl.FacetNormal(self.mesh)
        # det(g) N . g^-1 N, which a collapsed side has as well
        stretch = ufl.sqrt(abs(ufl.dot(N, ufl.cofac(self.metric) * N))) if self.dim > 1 else 1.0
        return SideMeasure(stretch, self._ds(tags), N)

    @property
    def side_normal(self) -> Any:
        """Outward unit normal of the sides within the tangent space of the reference configuration, shape (nsd,)."""
        N = ufl.FacetNormal(self.mesh)
        return self.DF * self.inverse_metric * N / ufl.sqrt(ufl.dot(N, self.inverse_metric * N))

    # -- projection ---------------------------------------------------------------------------------------------------

    def project(self, f: Any, *, constrained: bool = False) -> fem.Function:
        """L2 projection of a physical field onto the spline space (consistent mass matrix).

        Args:
            f: UFL expression over the parametric mesh, scalar or a vector.
            constrained: for a vector of nsd components, whether zero dofs and constraints of ``V`` hold.

        Returns:
            Homogeneous field u^h with ``int (u^h/w) . (v^h/w) = int f . (v^h/w)`` for all v^h.

        Raises:
            ValueError: constrained is asked of a field of another size.
        """
        f, size = scalar_or_vector(f)
        if constrained and size != self.nsd:
            raise ValueError(f"constrained = True: f has {size} components, conditions are known for {self.nsd}")
        space, w = self.vector if constrained else self.free(size), self.rationalize
        u, v = ufl.TrialFunction(space.V), ufl.TestFunction(space.V)
        return fit(space, ufl.inner(w(u), w(v)) * self.dx, ufl.inner(f, w(v)) * self.dx)

    def project_boundary(self, f: Any, *sides: str, patch: int | None = None, slope_length: Any = None) -> fem.Function:
        """Field whose trace on sides is the L2 projection of data there, with all inner coefficients zero.

        The start of a problem with non-zero Dirichlet data: the sides' coefficients are zero dofs of the increments.

        Args:
            f: UFL expression over the parametric mesh, scalar or a vector.
            sides: names; none: the boundary, see :meth:`ds`.
            patch: whose sides; None: those of all patches.
            slope_length: a length, such as the element size: two rows of coefficients are then fitted, to the values
                and to this length times the derivative of f across the sides. None: one row, values alone.

        Returns:
            Homogeneous field.
        """
        f, size = scalar_or_vector(f)
        space, ds, w = self.free(size), self.ds(*sides, patch=patch), self.rationalize
        u, v = ufl.TrialFunction(space.V), ufl.TestFunction(space.V)
        mass, load = ufl.inner(w(u), w(v)) * ds, ufl.inner(f, w(v)) * ds
        if slope_length is not None:
            slope_f, slope_u, slope_v = (ufl.dot(self.grad(g), self.side_normal) for g in (f, w(u), w(v)))
            mass += slope_length**2 * ufl.inner(slope_u, slope_v) * ds
            load += slope_length**2 * ufl.inner(slope_f, slope_v) * ds
        layers = 1 if slope_length is None else 2
        rows = [self.geometry.side_functions(*place, layers) for place in named_or_outer(self.geometry, sides, patch)]
        return fit(space, mass, load, np.unique(np.concatenate(rows))[:, None] * size + np.arange(size))

    @cached_property
    def lumped_projector(self) -> LumpedProjector:
        """The cheap projection of vector fields with a diagonal mass matrix."""
        return LumpedProjector(self, self.nsd)


def require_spline(spline: Any) -> None:
    """Refuse what is no spline that forms and systems may be built on.

    Args:
        spline: the argument of that name.

    Raises:
        ValueError: it is something else, such as its geometry.
    """
    checks.kind("spline", spline, ExtractedSpline, "ExtractedSpline(patch, comm)")
