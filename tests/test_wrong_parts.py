"""Parts of a wrong kind: meshes without names, classes for objects, patches for splines. Each is refused in words."""

import pytest
import ufl
from mpi4py import MPI
from test_wrong_kinds import LINE, PLATE, bending, scene

import shnapr
import tigar_x
import varmint
from coudalfish import CoupledState, FluidSubproblem, ShellSubproblem, SurfaceBand, advance
from shnapr.contact import LinearKernel, SelfContact
from tigar_x.fem.load_stepping import follow_load
from tigar_x.fem.schemes import backward_euler, generalized_alpha
from tigar_x.fem.time_integration import LoadStepper, TimeIntegrator
from tigar_x.geometry.files import write_patch
from tigar_x.splines.quadrature import NodalQuadrature
from varmint import Flow, FlowOptions, Velocity, quantities
from varmint.forms.motion import ElasticMotion, PrescribedMotion
from varmint.forms.solids import NeoHookeanSolid, Solid

SIDES = ("left", "right", "bottom", "top")


def flow(mesh=None, conditions=None, **given):
    sides = [Velocity(SIDES)] if conditions is None else conditions
    return Flow(scene().mesh if mesh is None else mesh, sides, **dict(rho=1.0, mu=0.1, dt=0.1) | given)


def fluid(**given):
    made = flow()
    parts = dict(mesh_f=scene().domain, residual_f=made.residual, timeInt_f=made.time)
    return FluidSubproblem(**parts | given)


def side_of_a_shell(**given):
    s = scene()
    time = TimeIntegrator(s.y, 0.1, generalized_alpha(0.5, 2))
    residual = shnapr.inertia(s.spline, time.xddot_alpha, s.z, density=1.0, thickness=0.1)
    return ShellSubproblem(**dict(spline_sh=s.spline, residual_sh=residual, timeInt_sh=time) | given)


def moved(kind, **given):
    data = {"displacements": {"left": None}} if kind is ElasticMotion else {"displacement": lambda x, t: 0 * x}
    return kind(**dict(mesh=scene().mesh, dt=0.1, scheme=backward_euler(), **data) | given)


def steady():
    return flow(dt=None)


S = scene()
SYSTEM = ufl.inner(S.y, S.z) * S.spline.dx
QUADRATURE = NodalQuadrature.of(S.spline)
SHELL_OF = dict(y=S.y, z=S.z)

PARTS = {
    "Flow": (flow, {
        "mesh": (S.domain, "left", NodalQuadrature),
        "conditions": ({"left": (0, 0)}, "left", ["left"], [Velocity], [None]),
        "scheme": (0.5, generalized_alpha, "backward Euler"),
        "moving": ("yes", lambda x, t: x, S.mesh),
        "solid": (NeoHookeanSolid(1.0, 0.3, 1.0), "solid"),
        "options": ({}, FlowOptions),
    }),
    "a wall": (lambda on: flow(conditions=[Velocity(on)]), {"on": (3, None, {"left"})}),
    "Solid": (Solid, {"material": (bending(), 1.0, NeoHookeanSolid)}),
    "a prescribed motion": (lambda **g: moved(PrescribedMotion, **g), {"mesh": (S.domain,), "scheme": (0.5,)}),
    "an elastic motion": (
        lambda **g: moved(ElasticMotion, **g),
        {"mesh": (S.domain,), "scheme": (0.5,), "displacements": ("left", ["left"]), "cells": ("fluid",)},
    ),
    "named": (varmint.named, {"domain": (S.mesh, None)}),
    "grid": (lambda **g: varmint.grid(**dict(comm=MPI.COMM_SELF, lines=([0, 1], [0, 1])) | g), {
        "comm": (None, 1), "lines": (3, "01"),
    }),
    "a flow rate": (lambda flow: quantities.flow_rate(flow, "left"), {"flow": (S.mesh, S.domain, Flow)}),
    "an energy": (quantities.kinetic_energy, {"flow": (S.mesh,)}),
    "a volume": (quantities.volume, {"flow": (S.mesh,)}),
    "an area": (lambda flow: quantities.area(flow, "left"), {"flow": (S.mesh,)}),
    "an outlet": (lambda flow: quantities.outlet(flow, "left"), {"flow": (S.mesh,)}),
    "a force": (lambda flow: quantities.BoundaryForce(flow, "left"), {"flow": (S.mesh,)}),
    "values at points": (lambda flow: quantities.PointValues(flow, [(0.5, 0.5)]), {"flow": (S.mesh,)}),
    "a vorticity": (quantities.vorticity, {"flow": (S.mesh,)}),
    "FluidSubproblem": (fluid, {
        "mesh_f": (S.mesh, flow),
        "residual_f": (None, flow),
        "timeInt_f": (None, steady().time, steady().w),
        "bcs": (3, "left"),
        "updates": (print,),
        "before": (print,),
        "rank_one": (1.0,),
        "band": (True, S.mesh),
        "moving": ("yes", S.mesh),
    }),
    "ShellSubproblem": (side_of_a_shell, {
        "spline_sh": (LINE, None),
        "residual_sh": (None, "residual"),
        "timeInt_sh": (None, LoadStepper(S.y, 1.0)),
        "updates": (print,),
        "contact": (LinearKernel(0.1, 1.0), SelfContact),
    }),
    "SurfaceBand": (SurfaceBand, {"mesh_f": (S.mesh, None)}),
    "advance": (lambda fsi: advance(fsi, 0.1), {"fsi": (3, S.mesh)}),
    "CoupledState": (CoupledState, {"fsi": (3, S.mesh)}),
    "ExtractedSpline": (
        lambda **g: tigar_x.ExtractedSpline(**dict(geometry=LINE, comm=MPI.COMM_SELF) | g),
        {"geometry": ([LINE], None, S.spline), "comm": (None, 1)},
    ),
    "NodalQuadrature": (NodalQuadrature.of, {"spline": (LINE, None)}),
    "TimeIntegrator": (
        lambda **g: TimeIntegrator(**dict(x=S.y, dt=0.1, scheme=backward_euler()) | g),
        {"x": (2 * S.y, None), "scheme": (backward_euler, "backward Euler", None)},
    ),
    "LoadStepper": (lambda x: LoadStepper(x, 1.0), {"x": (3, None)}),
    "follow_load": (lambda **g: follow_load(**dict(system=None, stepper=None) | g), {"system": (3, SYSTEM)}),
    "disjoint": (lambda patches: tigar_x.disjoint(patches), {"patches": ([LINE], None, S.spline)}),
    "glued": (lambda patches: tigar_x.glued(patches), {"patches": ([LINE], None)}),
    "write_patch": (lambda patch: write_patch("nowhere", patch), {"patch": ([LINE], S.spline)}),
    "VTUSeries": (lambda spline: tigar_x.VTUSeries("nowhere", spline), {"spline": (LINE, S.y)}),
    "XDMFSeries": (lambda domain: tigar_x.XDMFSeries("nowhere.xdmf", domain), {"domain": (S.mesh,)}),
    "VTKHDFSeries": (lambda domain: tigar_x.VTKHDFSeries("nowhere.vtkhdf", domain), {"domain": (S.mesh,)}),
    "CSVSeries": (lambda columns: tigar_x.CSVSeries("nowhere", columns), {"columns": (3, "force")}),
    "Restart": (lambda state: tigar_x.Restart("nowhere", state), {"state": (S.mesh, S.y)}),
    "Study": (lambda levels: tigar_x.Study(levels, {}), {"levels": (3, None)}),
    "SplineSystem": (lambda space: tigar_x.SplineSystem(space, SYSTEM, SYSTEM), {"space": (LINE, S.y)}),
    "eigenmodes": (lambda space: tigar_x.eigenmodes(space, SYSTEM, SYSTEM, 1), {"space": (LINE, S.y)}),
    "FiniteElementSystem": (
        lambda bcs: tigar_x.FiniteElementSystem(ufl.inner(S.v, S.w) * ufl.dx, S.v, bcs), {"bcs": (3, "left")},
    ),
    "SelfContact": (
        lambda **g: SelfContact(**dict(quadrature=QUADRATURE, kernel=LinearKernel(0.1, 1.0), r_self=0.3) | g),
        {"quadrature": (S.spline, LINE), "kernel": (0.1, LinearKernel)},
    ),
    "Shell": (lambda **g: shnapr.Shell(LINE, bending(), **g), {
        "options": (FlowOptions(), {}), "updates": (print,), "scheme": ("backward Euler", 0.5),
    }),
    "clamped": (lambda geometry: shnapr.clamped(geometry, "u0"), {"geometry": (S.spline, [PLATE])}),
    "inertia": (
        lambda spline: shnapr.inertia(spline, S.y, S.z, density=1.0, thickness=0.1), {"spline": (LINE, S.spline.mesh)},
    ),
    "gravity": (
        lambda spline: shnapr.gravity(spline, (0.0, 1.0), S.z, density=1.0, thickness=0.1), {"spline": (LINE,)},
    ),
    "pressure": (lambda spline: shnapr.follower_pressure(spline, 1.0, **SHELL_OF), {"spline": (LINE,)}),
    "dead load": (lambda spline: shnapr.dead_load(spline, (0.0, 1.0), S.z), {"spline": (LINE,)}),
    "edge force": (
        lambda spline: shnapr.edge_traction(spline, (0.0, 1.0), S.z, S.spline.ds("u1")), {"spline": (LINE,)},
    ),
    "edge moment": (
        lambda spline: shnapr.edge_moment(spline, 1.0, S.y, S.z, S.spline.ds("u1")), {"spline": (LINE,)},
    ),
    "internal work": (
        lambda **g: shnapr.internal_work(**dict(spline=S.spline, material=bending(), **SHELL_OF) | g),
        {"spline": (LINE, None), "material": (1.0, NeoHookeanSolid(1.0, 0.3, 1.0), shnapr.StVenantKirchhoff)},
    ),
    "energy": (
        lambda **g: shnapr.strain_energy(**dict(spline=S.spline, material=bending(), y=S.y) | g),
        {"spline": (LINE,), "material": (1.0,)},
    ),
    "tangent": (
        lambda **g: shnapr.internal_tangent(**dict(spline=S.spline, material=bending(), unknown=S.y, **SHELL_OF) | g),
        {"spline": (LINE,), "material": (1.0,)},
    ),
    "resultants": (
        lambda **g: shnapr.resultants(**dict(spline=S.spline, material=bending(), y=S.y) | g),
        {"spline": (LINE,), "material": (1.0,)},
    ),
    "von Mises": (
        lambda **g: shnapr.von_mises(**dict(spline=S.spline, material=bending(), y=S.y, level=0.0) | g),
        {"spline": (LINE,), "material": (1.0,)},
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", PARTS)
def test_every_part_of_a_wrong_kind_is_named(name):
    make, parts = PARTS[name]
    for argument, wrong in parts.items():
        for given in wrong:
            with pytest.raises(ValueError, match=rf"^{argument}(\[\d\])? = .* is required"):
                make(**{argument: given})


def test_a_mesh_of_dolfinx_hears_how_it_gets_names():
    with pytest.raises(ValueError, match=r"a NamedMesh, such as varmint\.named\(mesh, left=.*\), is required"):
        flow(mesh=S.domain)


def test_a_condition_alone_is_all_conditions():
    alone, listed = flow(conditions=Velocity(SIDES)), flow()
    assert alone.conditions == listed.conditions
    assert len(alone.bcs) == len(listed.bcs)


def test_components_of_a_condition_are_several_numbers():
    with pytest.raises(ValueError, match=r"^Velocity\('left'\)\.components = 0: a list or a tuple is required"):
        Velocity("left", components=0)
