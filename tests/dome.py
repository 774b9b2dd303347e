"""A curved sheet across a box of tetrahedra, pushed by a pressure from above."""

from types import SimpleNamespace

import ufl
from mpi4py import MPI

from coudalfish import CouDALFISh, CouplingOptions
from shnapr import Shell, StVenantKirchhoff
from tigar_x.fem.linear import direct
from tigar_x.fem.schemes import generalized_alpha
from tigar_x.geometry import shapes
from tigar_x.geometry.patch import Patch
from varmint.conditions import Slip, Traction
from varmint.flow import Flow, FlowOptions
from varmint.mesh import box

AROUND = ("left", "right", "bottom", "top")
TIGHT = CouplingOptions.sharp(block_rtol=1e-10, block_atol=1e-14)


def sheet(elements, tilted=0.0):
    """A paraboloid that goes beyond the box, whose axis is not that of the box."""
    flat = shapes.parallelogram(
        (-0.1, -0.1, 0.43), (1.2, 0, 0), (0, 1.2, 0), elements=(elements, elements), degrees=(2, 2)
    )
    points = flat.points.copy()
    a, b = points[:, 0] - 0.5, points[:, 1] - 0.45
    points[:, 2] += 0.2 * (a**2 + 0.6 * b**2) + tilted * a
    return Patch.from_points(flat.bases, points)


def dome(
    immersed="jump and kink", options=TIGHT, *, n=3, elements=None, pressure=0.3, solver=None, walls=None, dt=0.05
):
    """Elastic, and clamped along all its edges.

    The pressure is a number, or a function of time, UFL.
    """
    mesh = box(MPI.COMM_WORLD, (0.0,) * 3, (1.0,) * 3, (n,) * 3)
    conditions = [Slip(AROUND)] if walls is None else list(walls)
    load = (lambda x, t: ufl.as_vector([0.0, 0.0, -pressure(t)])) if callable(pressure) else (0.0, 0.0, -pressure)
    conditions += [Traction("back"), Traction("front", load)]
    known = {"rho": 1.0, "mu": 0.1, "dt": dt, "scheme": generalized_alpha(0.5), "immersed": immersed}
    flow = Flow(mesh, conditions, **known, options=FlowOptions(solver=solver or direct()))
    shell = Shell(
        sheet(elements or n), StVenantKirchhoff(40.0, 0.3, 0.05), density=20.0, clamped=("u0", "u1", "v0", "v1")
    )
    return SimpleNamespace(flow=flow, shell=shell, fsi=CouDALFISh(flow, shell, options))
