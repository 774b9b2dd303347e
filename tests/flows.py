"""A random flow state and a residual of chosen options, which the tests of the flow forms share."""

from contextlib import contextmanager

import numpy as np
import ufl
from mpi4py import MPI
from dolfinx import fem, mesh
from petsc4py import PETSc

from tigar_x import compat
from tigar_x.fem.solve import FiniteElementSystem
from varmint.forms.space import equal_order_space, split
from varmint.forms.vms import interior_residual

RHO, MU, DT = 1.3, 0.07, 0.11
H = 0.25


def grid(cell, n=3):
    """Cells of size H in a square or cube, cut into simplices or not."""
    kind, d = getattr(mesh.CellType, cell), 3 if cell in ("tetrahedron", "hexahedron") else 2
    corners = [np.zeros(d), np.full(d, n * H)]
    create = mesh.create_rectangle if d == 2 else mesh.create_box
    return create(MPI.COMM_WORLD, corners, [n] * d, kind)


def assembled(form, space):
    """Vector of a compiled form, summed over the ranks."""
    b = compat.create_vector(space)
    compat.assemble_vector(b, form)
    b.ghostUpdate(PETSc.InsertMode.ADD, PETSc.ScatterMode.REVERSE)
    return b


def randomise(u, seed):
    """Random nodal values in (-1, 1)."""
    rng = np.random.default_rng([seed, u.function_space.mesh.comm.rank])
    u.x.array[:] = rng.uniform(-1, 1, len(u.x.array))
    u.x.scatter_forward()


@contextmanager
def moved_to(domain, displacement):
    """Inside the ``with`` statement the mesh lies where a displacement of its vertices brings it."""
    rest, d = domain.geometry.x.copy(), domain.geometry.dim
    nodes, dofs = compat.cell_nodes(domain), compat.cell_dofs(displacement.function_space)
    domain.geometry.x[nodes, :d] = rest[nodes, :d] + displacement.x.array.reshape(-1, d)[dofs]
    try:
        yield
    finally:
        domain.geometry.x[:] = rest


def slope_error(residual, u, tangent=None):
    """Relative difference of a tangent along a random direction from central differences of the residual at u."""
    system = FiniteElementSystem(residual, u, tangent=tangent)
    state, direction = u.x.array.copy(), u.copy()
    randomise(direction, 3)

    def at(eps):
        u.x.array[:] = state + eps * direction.x.array
        system.assemble_residual()
        return system.b.copy()

    difference = (at(1e-6) - at(-1e-6)) / 2e-6
    at(0.0)
    system.assemble_tangent()
    slope = system.b.duplicate()
    system.A.mult(compat.petsc_vector(direction), slope)
    return (difference - slope).norm() / slope.norm()


class Flow:
    """A random state of velocity, pressure and rate, with its test functions."""

    def __init__(self, cell, degree=1, n=3):
        self.mesh, self.degree = grid(cell, n), degree
        self.V = equal_order_space(self.mesh, degree)
        self.u, self.rate = fem.Function(self.V), fem.Function(self.V)
        randomise(self.u, 1)
        randomise(self.rate, 2)
        (self.v, self.p), (self.w, self.q) = split(self.u), split(ufl.TestFunction(self.V))
        self.v_t = split(self.rate)[0]
        self.d = self.mesh.geometry.dim
        self.x = ufl.SpatialCoordinate(self.mesh)

    def constant(self, value):
        return fem.Constant(self.mesh, np.asarray(value, dtype=float))

    def residual(self, **options):
        given = dict(v=self.v, p=self.p, w=self.w, q=self.q, domain=self.mesh, rho=RHO, mu=MU, degree=self.degree)
        return interior_residual(**(given | options))

    def assemble(self, form):
        return assembled(compat.compile_forms(form)[0], self.V)
