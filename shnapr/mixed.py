"""Membrane forces as unknowns of their own: thin shells of low degree without membrane locking.

A thin shell that bends keeps its lengths almost exactly. Splines of degree p cannot do so in every point, and when
virtual work integrates the membrane strain at more points than there is freedom for, they do not bend either: they
lock, the more the thinner they are. Here the membrane forces n are splines of one degree less, and the strain counts
only as far as these see it (Hellinger and Reissner):

    int n : eps(y) - n : (h D)^-1 : n / 2 + (energy of bending)    is stationary in y and n.

Of the contravariant components n^11 is of degree p - 1 in the first direction and p in the second one, n^22 the other
way round, and n^12 of degree p - 1 in both. Compare Echter, Oesterle and Bischoff, doi:10.1016/j.cma.2012.10.018, and
Bouclier, Elguedj and Combescure, doi:10.1016/j.cma.2012.06.008.

An edge is clamped by its position and its slope (:func:`tigar_x.splines.constraints.no_rotation`). Two rows of control
points
that are held in full would exclude strain at the edge whatever n may be: more than there is freedom for.

The unknown w has the nsd components of the displacement y and then those of n in the order 11, 22, 12, each as physical
component by E h: n^{alpha beta} = E h w_{alpha beta}/(|A_alpha| |A_beta|). Its tangent is symmetric and indefinite, so
it takes a direct solver. Newton's method takes fewer steps than with displacements alone, where forces of an iterate
are those of its strains.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp
import ufl
from dolfinx import fem

from shnapr.kinematics import Midsurface, frame, membrane_strain, midsurface
from shnapr.svk import StVenantKirchhoff
from shnapr.work import internal_tangent, internal_work
from tigar_x.geometry.bspline import BSplineBasis, TensorBasis
from tigar_x.geometry.functions import SplineFunctions
from tigar_x.splines.space import SplineSpace
from tigar_x.splines.spline import ExtractedSpline

COMPONENTS = {1: ((0, 0),), 2: ((0, 0), (1, 1), (0, 1))}
"""Directions of the contravariant membrane forces by parametric dimension, in the order of the unknown."""


def mixed_space(spline: ExtractedSpline) -> SplineSpace:
    """Space of displacements, with the zero dofs and constraints of ``spline.V``, and membrane forces.

    Args:
        spline: the midsurface, of degree 2 or more.

    Returns:
        The space of w.

    Raises:
        ValueError: the degree is too low.
    """
    functions, vector = spline.geometry.functions, spline.vector
    forces = [SplineFunctions(tuple(_lower(b, pair) for b in functions.bases)) for pair in COMPONENTS[spline.dim]]
    n = vector.n + sum(part.n for part in forces)
    G = vector.constraints
    constraints = [sp.csr_matrix((G.data, G.indices, G.indptr), shape=(G.shape[0], n))] if G.shape[0] else []
    parts = [(functions, spline.nsd), *((part, 1) for part in forces)]
    return spline.space(*parts, zero_dofs=vector.fixed, constraints=constraints)


def mixed_work(spline: ExtractedSpline, material: StVenantKirchhoff, w: fem.Function, test: Any) -> ufl.Form:
    """Virtual work of the elastic forces, and the strains that belong to the membrane forces.

    Args:
        spline: the midsurface.
        material: the material.
        w: displacement and forces, in the space of :func:`mixed_space`.
        test: test function of that space; its first nsd components are the virtual displacement.

    Returns:
        Residual form.
    """
    reference = midsurface(spline)
    (y, n), (z, dn) = (_parts(spline, material, reference, field) for field in (w, test))
    current = midsurface(spline, spline.rationalize(y))
    strain = membrane_strain(reference, current)
    own = _cartesian(reference, n)
    if material.prestress is not None:
        own -= ufl.as_vector([*material.prestress])
    compatibility = ufl.inner(dn, strain) - _complementary(material, _cartesian(reference, dn), own)
    return internal_work(spline, _Law(material, n), y, z) + compatibility * spline.dx


def mixed_tangent(spline: ExtractedSpline, material: StVenantKirchhoff, w: fem.Function, test: Any) -> ufl.Form:
    """Derivative of :func:`mixed_work`.

    Args:
        spline: the midsurface.
        material: the material.
        w: displacement and forces, in the space of :func:`mixed_space`.
        test: test function of that space.

    Returns:
        Symmetric bilinear form in ``test`` and a trial function of the same space.
    """
    trial = ufl.TrialFunction(w.function_space)
    reference = midsurface(spline)
    (y, n), (z, dn), (u, du) = (_parts(spline, material, reference, field) for field in (w, test, trial))
    current = midsurface(spline, spline.rationalize(y))

    def work(forces: Any, v: Any) -> Any:
        return ufl.inner(forces, current.tangents.T * spline.parametric_grad(spline.rationalize(v)))

    coupling = work(dn, u) + work(du, z)
    coupling -= _complementary(material, _cartesian(reference, dn), _cartesian(reference, du))
    return internal_tangent(spline, _Law(material, n), y, z, w) + coupling * spline.dx


def displacement_part(spline: ExtractedSpline, field: Any) -> Any:
    """Displacement within an unknown, a test or a trial function.

    Args:
        spline: the midsurface.
        field: in the space of :func:`mixed_space`.

    Returns:
        Homogeneous displacement as UFL vector, shape (nsd,).
    """
    return ufl.as_vector([field[i] for i in range(spline.nsd)])


def displacement(spline: ExtractedSpline, space: SplineSpace, w: fem.Function, name: str = "y") -> fem.Function:
    """The displacement alone, for output and evaluation (collective).

    Args:
        spline: the midsurface.
        space: the space of w.
        w: displacement and forces.
        name: name for output.

    Returns:
        Homogeneous displacement in ``spline.V``.
    """
    size = spline.geometry.n * spline.nsd
    return spline.function(space.coefficients(w)[:size].reshape(-1, spline.nsd), name)


@dataclass(frozen=True)
class _Law:
    """Energy with the membrane forces given: n : eps + (bending)."""

    material: StVenantKirchhoff
    forces: Any

    def energy_density(self, reference: Midsurface, current: Midsurface) -> Any:
        unstretched = Midsurface(None, None, None, reference.metric, current.curvature)
        bending = self.material.energy_density(reference, unstretched)
        return ufl.inner(self.forces, membrane_strain(reference, current)) + bending


def _parts(spline: ExtractedSpline, material: StVenantKirchhoff, reference: Midsurface, field: Any) -> tuple[Any, Any]:
    """Displacement and contravariant forces of an unknown, a test or a trial function."""
    m = spline.dim
    length = [ufl.sqrt(reference.metric[al, al]) for al in range(m)]
    stiffness = material.youngs_modulus * material.thickness
    entries: dict[tuple[int, int], Any] = {}
    for i, (al, be) in enumerate(COMPONENTS[m]):
        entries[al, be] = entries[be, al] = stiffness * field[spline.nsd + i] / (length[al] * length[be])
    forces = ufl.as_matrix([[entries[al, be] for be in range(m)] for al in range(m)])
    return displacement_part(spline, field), forces


def _cartesian(reference: Midsurface, forces: Any) -> Any:
    """Contravariant forces in the local Cartesian frame, in Voigt notation."""
    R = frame(reference.metric)
    T = R * forces * R.T
    return ufl.as_vector([T[0, 0]] if forces.ufl_shape == (1, 1) else [T[0, 0], T[1, 1], T[0, 1]])


def _complementary(material: StVenantKirchhoff, first: Any, second: Any) -> Any:
    """Bilinear form of the complementary energy, ``first . (h D)^-1 second``."""
    stiffness = material.thickness * material.plane_stress(len(first))
    return ufl.dot(first, ufl.inv(stiffness) * second)


def _lower(basis: TensorBasis, pair: tuple[int, int]) -> TensorBasis:
    """Basis of one degree less along the directions of the pair, on the same elements and at most as smooth."""
    directions = []
    for d, full in enumerate(basis.directions):
        degree = full.degree - (d in pair)
        times = np.minimum(full.multiplicities, degree)
        if not full.periodic:
            times[[0, -1]] = degree + 1
        directions.append(BSplineBasis(degree, np.repeat(full.breakpoints, times), full.periodic))
    return TensorBasis(tuple(directions))
