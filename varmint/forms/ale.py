"""Arbitrary Lagrangian-Eulerian description: fields on a moving mesh, integrated over the mesh where it was at rest.

With y the coordinates of the mesh at rest, u its displacement and ``x = y + u(y)``, all gradients in the forms are
those by x, ``grad_x f = (grad_y f) F^-1`` with ``F = grad_y x``; volumes carry ``J = det F``, areas ``J |F^-T N|``, and
the outward normal is the unit vector along ``F^-T N``. Source: Bazilevs et al., doi:10.1007/s00466-008-0315-x.

On a fixed mesh the motion is None, and none of these factors is in the form.
"""

from dataclasses import dataclass
from typing import Any

import ufl

from tigar_x import checks


@dataclass(frozen=True)
class Motion:
    """Displacement and velocity of a mesh at the level of the equations.

    Attributes:
        domain: the mesh at rest.
        displacement: u, UFL vector of shape (d,); unit: length.
        velocity: its rate at fixed y, of the same shape; unit: length/time.
        degree: polynomial degree of the displacement.

    Raises:
        ValueError: a shape does not belong to the mesh, or the degree is below 1.
    """

    domain: Any
    displacement: Any
    velocity: Any
    degree: int = 1

    def __post_init__(self) -> None:
        d = self.domain.geometry.dim
        for name in ("displacement", "velocity"):
            object.__setattr__(self, name, checks.vector(name, getattr(self, name), d))
        checks.whole("degree", self.degree, 1)

    @property
    def F(self) -> Any:
        """Deformation gradient of the mesh, shape (d, d)."""
        return ufl.Identity(self.domain.geometry.dim) + ufl.grad(self.displacement)


def position(domain: Any, motion: Motion | None) -> Any:
    """Present coordinates, shape (d,); unit: length.

    Args:
        domain: mesh.
        motion: its motion; None: it is fixed.
    """
    x = ufl.SpatialCoordinate(domain)
    return x if motion is None else x + motion.displacement


def gradient(f: Any, motion: Motion | None) -> Any:
    """Gradient by the present coordinates; the last index is that of the derivative.

    Args:
        f: field of any shape.
        motion: motion of the mesh; None: it is fixed.
    """
    return ufl.grad(f) if motion is None else ufl.dot(ufl.grad(f), ufl.inv(motion.F))


def divergence(f: Any, motion: Motion | None) -> Any:
    """Divergence by the present coordinates, over the last index.

    Args:
        f: vector or tensor field.
        motion: motion of the mesh; None: it is fixed.
    """
    if motion is None:
        return ufl.div(f)
    i = ufl.Index()
    g = gradient(f, motion)
    if len(f.ufl_shape) == 1:
        return g[i, i]
    return ufl.as_vector([g[j, i, i] for j in range(f.ufl_shape[0])])


def advection(v: Any, motion: Motion | None) -> Any:
    """Velocity of the fluid relative to the mesh, shape (d,).

    Args:
        v: velocity of the fluid.
        motion: motion of the mesh; None: it is fixed.
    """
    return v if motion is None else v - motion.velocity


def per_volume(integrand: Any, motion: Motion | None) -> Any:
    """An integrand per present volume, made one per volume of the mesh at rest.

    Args:
        integrand: UFL scalar.
        motion: motion of the mesh; None: it is fixed.
    """
    return integrand if motion is None else integrand * ufl.det(motion.F)


def per_area(integrand: Any, domain: Any, motion: Motion | None) -> Any:
    """An integrand per present area, made one per area of the mesh at rest.

    Args:
        integrand: UFL scalar.
        domain: mesh.
        motion: motion of the mesh; None: it is fixed.
    """
    if motion is None:
        return integrand
    m = _oriented(domain, motion)
    return integrand * ufl.det(motion.F) * ufl.sqrt(ufl.dot(m, m))


def normal(domain: Any, motion: Motion | None) -> Any:
    """Outward unit normal of the present boundary, shape (d,).

    Args:
        domain: mesh.
        motion: its motion; None: it is fixed.
    """
    if motion is None:
        return ufl.FacetNormal(domain)
    m = _oriented(domain, motion)
    return m / ufl.sqrt(ufl.dot(m, m))


def _oriented(domain: Any, motion: Motion) -> Any:
    """``F^-T N``, along the present normal."""
    return ufl.dot(ufl.FacetNormal(domain), ufl.inv(motion.F))
