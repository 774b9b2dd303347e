"""Problems on splines without any fluid, solved on the ranks of this run; prints their results as JSON."""

import json

import numpy as np
import ufl
from mpi4py import MPI

from shnapr.loads import dead_load
from shnapr.supports import clamped, pinned
from shnapr.svk import StVenantKirchhoff
from shnapr.work import strain_energy, virtual_work
from tigar_x.fem.eigen import eigenmodes
from tigar_x.fem.solve import newton
from tigar_x.geometry import shapes, surfaces
from tigar_x.geometry.gluing import glued
from tigar_x.splines.spline import ExtractedSpline
from tigar_x.splines.spline_system import SplineSystem, solve_linear


def roof():
    """Displacements of a loaded cylindrical roof."""
    patch = surfaces.cylinder_panel(radius=25.0, length=50.0, angle=np.deg2rad(80.0), elements=(6, 6), degrees=(3, 3))
    s = ExtractedSpline(patch, zero_dofs=pinned(patch, "u0", "u1"))
    y, z = s.function(), ufl.TestFunction(s.V)
    R = virtual_work(s, lambda u: strain_energy(s, StVenantKirchhoff(4.32e8, 0.0, 0.25), u), y, z)
    R += dead_load(s, ufl.as_vector([0.0, 0.0, -90.0]), z)
    newton(SplineSystem(s, R, ufl.derivative(R, y), unknown=y), rtol=1e-8)
    return s.evaluate(y, [[0.3, 0.6], [0.5, 0.5]])


def solid():
    """Poisson's equation with prescribed values in a solid of two glued NURBS patches, on tetrahedra."""
    sector = surfaces.annulus(inner=1.0, outer=2.0, angle=np.pi / 2, elements=(2, 2), degrees=(2, 2))
    left = shapes.extruded(sector, (0.0, 0.0, 1.0), elements=2, degree=2)
    right = shapes.extruded(sector, (0.0, 0.0, -0.5), elements=2, degree=2)
    s = ExtractedSpline(glued(left, right), cells="simplex")
    space = s.space(1, zero_dofs=s.geometry.side("w1"))
    w, v = s.rationalize, ufl.TestFunction(space.V)
    u = s.project_boundary(s.F[0] * s.F[1], "w1")
    R = (ufl.inner(s.grad(w(u)), s.grad(w(v))) - w(v)) * s.dx
    solve_linear(SplineSystem(space, R, ufl.derivative(R, u), unknown=u))
    return s.evaluate(u, [[0.2, 0.4, 0.1], [0.7, 0.5, 0.6]], patch=1)


def modes():
    """Frequencies of a clamped plate."""
    patch = shapes.parallelogram((0, 0, 0), (1, 0, 0), (0, 0.7, 0), elements=(5, 4), degrees=(3, 3))
    s = ExtractedSpline(patch, zero_dofs=clamped(patch, "u0", "v0"))
    y, z, u = s.function(), ufl.TestFunction(s.V), ufl.TrialFunction(s.V)
    R = virtual_work(s, lambda u: strain_energy(s, StVenantKirchhoff(1e4, 0.3, 0.05), u), y, z)
    mass = ufl.inner(u, z) * s.dx
    return eigenmodes(s, ufl.derivative(R, y), mass, 4).values


def saved_fields():
    """Projections and coefficients."""
    patch = surfaces.annulus(inner=1.0, outer=2.0, center=(0.0, 0.0), elements=(4, 4), degrees=(2, 2))
    s = ExtractedSpline(patch)
    f = s.project(ufl.exp(s.F[0]) * s.F[1])
    lumped = s.lumped_projector
    values = lumped(lumped.compile(ufl.as_vector([s.F[1], s.F[0] ** 2])))
    owned = s.V.dofmap.index_map.size_local
    total = MPI.COMM_WORLD.allreduce(np.sum(values[:owned] ** 2))
    return np.append(s.scalar.coefficients(f)[::7], total)


if __name__ == "__main__":
    found = {problem.__name__: np.ravel(problem()).tolist() for problem in (roof, solid, modes, saved_fields)}
    if MPI.COMM_WORLD.rank == 0:
        print(json.dumps(found))
