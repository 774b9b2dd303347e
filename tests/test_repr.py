"""What a notebook shows of the main objects: one line with their sizes, which asks no other rank for anything."""

from functools import cache

import numpy as np
import pytest
from mpi4py import MPI
from scenes import sheet_in_flow

from shnapr.contact import LinearKernel, SelfContact
from tigar_x import (
    Eigenpairs,
    ExtractedSpline,
    NodalQuadrature,
    TimeIntegrator,
    constraints,
    disjoint,
    generalized_alpha,
    shapes,
)
from varmint import Flow, Traction, Velocity, WeakVelocity, box

LINE = shapes.line((0, 0), (1, 0), elements=4, degree=2)


@cache
def made():
    channel = box(MPI.COMM_WORLD, (0, 0), (3, 1), (6, 2))
    sides = [WeakVelocity(("bottom", "top")), Velocity("left", (1.0, 0.0)), Traction("right")]
    flow = Flow(channel, sides, rho=1.0, mu=0.1, dt=0.1)
    held = ExtractedSpline(LINE, MPI.COMM_SELF, zero_dofs=LINE.side_dofs("u0", layers=2))
    spread = ExtractedSpline(shapes.plate(lengths=(1, 1), elements=(2, 2), degrees=(2, 2)), MPI.COMM_WORLD)
    tied = ExtractedSpline(LINE, MPI.COMM_SELF, constraints=[constraints.tied([0], [10], n=12)])
    fsi = sheet_in_flow().fsi
    contact = SelfContact(NodalQuadrature.of(held), LinearKernel(0.1, 1.0), 0.3)
    return {
        LINE: "Patch(curve in 2D, 6 functions of degree 2)",
        shapes.plate(
            lengths=(1, 1), elements=(2, 3), degrees=(2, 1)
        ): "Patch(surface in 3D, 16 functions of degree 2 x 1)",
        disjoint(LINE, LINE): "MultiPatch(curve in 2D, 12 functions of degree 2, 2 patches)",
        held: "ExtractedSpline(curve in 2D, 6 functions of degree 2, 4 interval cells, 12 coefficients, 4 held)",
        tied: "ExtractedSpline(curve in 2D, 6 functions of degree 2, 4 interval cells, 12 coefficients, 0 held, "
        "1 constraints)",
        spread: "ExtractedSpline(surface in 3D, 16 functions of degree 2 x 2, 4 quadrilateral cells, "
        "48 coefficients, 0 held)",
        channel: "NamedMesh(24 triangle cells in 2D; facets left, right, bottom, top)",
        flow: "Flow(63 unknowns of degree 1 in 2D, t = 0, dt = 0.1, "
        "WeakVelocity on bottom, top; Velocity on left; Traction on right)",
        flow.time: "TimeIntegrator(w of 63 unknowns, t = 0, dt = 0.1, order 1, alpha_f = 0.666667, alpha_m = 0.833333)",
        TimeIntegrator(held.function(name="y"), 0.5, generalized_alpha(1.0, 2), t=2.0): "TimeIntegrator(y of 18 "
        "unknowns, t = 2, dt = 0.5, order 2, alpha_f = 0.5, alpha_m = 0.5)",
        contact: "SelfContact(9 points, LinearKernel(r_max=0.1, stiffness=1.0), r_self = 0.3)",
        fsi.fluid: "FluidSubproblem(147 unknowns in 2D, band)",
        fsi.shell: "ShellSubproblem(34 coefficients, 17 points)",
        fsi: f"CouDALFISh({fsi.fluid!r}, {fsi.shell!r}, t = 0, dt = 0.1)",
    }


@pytest.mark.mpi
def test_main_objects_show_their_sizes_in_one_line_without_other_ranks():
    objects = made()
    if MPI.COMM_WORLD.rank == 0:
        for thing, line in objects.items():
            assert repr(thing) == line
            assert len(line) < 200
    MPI.COMM_WORLD.Barrier()


def test_modes_show_their_first_values():
    pairs = Eigenpairs(np.arange(8.0) / 3.0, np.zeros((8, 2)), np.zeros(8))
    assert repr(pairs) == "Eigenpairs(8 values: 0, 0.333333, 0.666667, 1, 1.33333, 1.66667, ...)"
