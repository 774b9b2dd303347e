"""Sheets in a channel whose fields differ on both sides of them, which several tests share."""

from types import SimpleNamespace

import numpy as np
from mpi4py import MPI

from coudalfish import CouDALFISh, CouplingOptions
from shnapr import Shell, StVenantKirchhoff
from shnapr.supports import fixed
from tigar_x import generalized_alpha
from tigar_x.fem.linear import direct
from tigar_x.geometry import multipatch, shapes
from varmint import Flow, FlowOptions, Slip, Traction, Velocity, box

VECTOR = {"trace": "exact", "multiplier_direction": "vector", "fluid_tangent": "consistent"}
CONVERGED = CouplingOptions.converged(**VECTOR)
LAGGED = CouplingOptions(trace="exact", relaxation=0.2, relaxation_mode="smoothed")
TIGHT = {"block_rtol": 1e-9, "block_atol": 1e-13}
FLAP = ((0.43, 0.0), (0.47, 0.6))
"""From the lower wall into the channel."""
INSIDE = ((0.35, 0.27), (0.53, 0.71))
"""With two free ends."""


def line(ends, elements=12, **options):
    """A straight line with sides "start" and "end"."""
    return shapes.line(*ends, elements=elements, degree=2, side_names={"start": (0, 0), "end": (0, 1)}, **options)


def channel(
    *lines,
    immersed="jump and kink",
    n=8,
    dt=0.05,
    inflow=(1.0, 0.0),
    inlet=None,
    walls=None,
    options=CONVERGED,
    clamped=("start",),
    held=False,
    units=(1.0, 1.0, 1.0),
    solver=None,
    geometry=None,
    stiffness=40.0,
    mesh=None,
    **flow_options,
):
    """Unit square with a uniform flow from the left to the right, between slip walls or others, and sheets in it.

    Args:
        lines: ends of straight sheets; or ``geometry``.
        inlet: condition on the left; None: the velocity ``inflow``.
        walls: conditions below and above; None: slip.
        clamped: sides of the sheets.
        held: whether the sheets do not move at all.
        units: of length, time and mass, in which everything is given.
        mesh: None: n by n squares of two triangles.
    """
    L, T, M = units
    mesh = box(MPI.COMM_WORLD, (0.0, 0.0), (L, L), (n, n)) if mesh is None else mesh
    geometry = multipatch.disjoint(*(line(L * np.array(ends)) for ends in lines)) if geometry is None else geometry
    inlet = Velocity("left", tuple(L / T * np.array(inflow))) if inlet is None else inlet
    conditions = [inlet, Traction("right")]
    conditions += [Slip(("bottom", "top"))] if walls is None else list(walls)
    flow = Flow(
        mesh, conditions, rho=M / L**3, mu=0.05 * M / (L * T), dt=dt * T, scheme=generalized_alpha(0.5),
        immersed=immersed, options=FlowOptions(solver=solver or direct(), **flow_options),
    )  # fmt: skip
    material = StVenantKirchhoff(stiffness * M / (L * T**2), 0.3, 0.05 * L)
    supports = {"zero_dofs": fixed(geometry)} if held else {"clamped": list(clamped)} if clamped else {}
    shell = Shell(geometry, material, density=20.0 * M / L**3, **supports)
    return SimpleNamespace(flow=flow, shell=shell, fsi=CouDALFISh(flow, shell, options))


def everything(fsi):
    """What a step leaves behind: fields, rates, multiplier, clocks, and what is divided."""
    arrays = [
        fsi.lam.copy(),
        np.array(fsi.floors or ()),
        np.array([] if fsi.locator.cells is None else fsi.locator.cells),
    ]
    arrays += [np.array([float(time.t.value), float(time.t_alpha.value)]) for time in fsi.integrators]
    arrays += [f.x.array.copy() for time in fsi.integrators for f in (*time.unknowns, *time.state.values())]
    sides, doubled = fsi.fluid.sides, fsi.fluid.sides.doubled
    arrays += [f.x.array.copy() for f in (sides.phi, sides.size, sides.negative, sides.wall)]
    arrays += [doubled.cells.copy(), doubled.second.copy(), doubled.side.copy(), fsi.fluid.free.copy()]
    return [*arrays, fsi.timeInt_f.is_second.copy()]
