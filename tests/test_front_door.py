"""A flow and a shell are coupled as they are: same numbers as by hand, and what is forgotten or mixed up is refused."""

import logging

import numpy as np
import pytest
import ufl
from mpi4py import MPI
from dolfinx import mesh
from scenes import free_sheet, sheet_in_flow
from test_solids import HELD, SOFT, beam_mesh

from coudalfish import CouDALFISh, CouplingOptions, FluidSubproblem, ShellSubproblem, SurfaceBand, fluid_side
from shnapr.conditions import DeadLoad
from shnapr.shell import Shell
from shnapr.svk import StVenantKirchhoff
from tigar_x.fem.linear import direct
from tigar_x.fem.schemes import backward_euler, companion, generalized_alpha
from tigar_x.geometry import shapes
from varmint.conditions import Resistance, Traction, Velocity, WeakVelocity
from varmint.flow import Flow, FlowOptions
from varmint.forms.motion import ElasticMotion, PrescribedMotion
from varmint.forms.solids import Solid
from varmint.mesh import box

WORLD = MPI.COMM_WORLD
DT = 0.05


def square():
    return box(WORLD, (0.0, 0.0), (1.0, 1.0), (4, 4), "triangle")


def stream(x, t):
    return ufl.as_vector([ufl.min_value(t, 1.0) * x[1] * (1.0 - x[1]), 0.0 * x[0]])


def a_flow(*, enclosed=False, immersed="plain", dt=DT, **options):
    sides = [Velocity("left", stream), Velocity(("bottom", "top")), Resistance("right", 3.0)]
    if enclosed:
        sides = [WeakVelocity(("left", "right", "bottom", "top"), stream)]
    return Flow(square(), sides, rho=1.0, mu=0.1, dt=dt, immersed=immersed, **options)


def a_shell(ends=((0.5, 0.01), (0.5, 0.6)), **options):
    line = shapes.line(*ends, elements=8, degree=2)
    return Shell(line, StVenantKirchhoff(1e3, 0.3, 0.02), **({"density": 1.0, "clamped": ["u0"]} | options))


@pytest.fixture
def without_compilation(monkeypatch):
    """What is refused has to be so before anything is compiled."""

    def fail(*_, **__):
        raise AssertionError("something is compiled")

    monkeypatch.setattr("coudalfish.sides.fluid.FiniteElementSystem", fail)
    monkeypatch.setattr("coudalfish.sides.shell.SplineSystem", fail)


@pytest.mark.mpi
def test_a_flow_and_a_shell_give_what_their_parts_give_by_hand():
    """All that belongs to the flow comes along: conditions in time, an outlet with a resistance, scales, the solver."""
    flow, shell = a_flow(options=FlowOptions(solver=direct())), a_shell()
    fsi = CouDALFISh(flow, shell)
    other = a_flow(options=FlowOptions(solver=direct()))
    alike = a_shell(dt=DT, scheme=companion(other.time.scheme))
    fluid = FluidSubproblem(
        other.mesh.domain, other.residual, other.time, bcs=other.bcs, band=SurfaceBand(other.mesh.domain, other.scales),
        solver=direct(), updates=other.updates, before=other.before, rank_one=other.rank_one, density=1.0,
        viscosity=0.1,
    )  # fmt: skip
    by_hand = CouDALFISh(fluid, ShellSubproblem(alike.spline, alike.residual, alike.time, tangent=alike.tangent))
    for _ in range(2):
        report, expected = fsi.take_step(), by_hand.takeStep()
    np.testing.assert_allclose(report.monitors.force, expected.monitors.force, rtol=1e-10)
    np.testing.assert_allclose(flow.w.x.array, other.w.x.array, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(shell.y.x.array, alike.y.x.array, rtol=1e-10, atol=1e-14)
    assert np.abs(shell.y.x.array).max() > 1e-8
    assert set(flow.scales[0].x.array) == {1.0, 1e-3}
    assert shell.time.scheme == companion(flow.time.scheme)
    assert shell.time.step_size == DT


def test_a_shell_that_was_stepped_before_goes_on_in_a_flow_at_the_same_time():
    flow, shell = a_flow(), a_shell(dt=DT)
    shell.take_step()
    with pytest.raises(ValueError, match=r"^t = 0\.05: the shell has a clock of its own"):
        CouDALFISh(flow, shell)


def test_a_shell_joins_a_flow_at_its_time_and_its_updates_come_along():
    flow, called = a_flow(), []
    shell = a_shell(updates=[called.append])
    flow.take_step()
    report = CouDALFISh(flow, shell).take_step()
    assert (report.t, shell.time.time) == pytest.approx((2 * DT, 2 * DT))
    assert called == pytest.approx([report.t_alpha])


def test_the_size_of_cells_may_be_given_with_a_flow():
    assert fluid_side(a_flow(), mesh_size=0.3).mesh_size == 0.3


FORGOTTEN = {
    "a flow that no surface is immersed in": (
        lambda: CouDALFISh(a_flow(immersed=False), a_shell()),
        r"fluid was made without a surface in its equations: Flow\(..., immersed=True\) is required",
    ),
    "the time step of the flow": (
        lambda: CouDALFISh(a_flow(dt=None), a_shell()),
        r"fluid is a steady flow \(dt = None\): one that advances in time is required",
    ),
    "the density of the shell": (lambda: CouDALFISh(a_flow(), a_shell(density=None)), "density = None: one is require"),
    "the shell": (lambda: CouDALFISh(a_flow(), None), "shell = None: a shell, .* is required"),
    "a pin of the pressure": (
        lambda: CouDALFISh(a_flow(enclosed=True, options=FlowOptions(pressure="null space")), a_shell()),
        "pressure = 'null space': 'pin' is required of a flow in which a surface is immersed",
    ),
}

MIXED_UP = {
    "the arguments": (
        lambda: CouDALFISh(a_shell(), a_flow()),
        r"fluid = Shell.*: a flow, .* is required; CouDALFISh\(fluid, shell\) is the order of its arguments",
    ),
    "a mesh for a flow": (
        lambda: CouDALFISh(mesh.create_unit_square(WORLD, 2, 2), a_shell()),
        r"fluid = .*: a flow, such as varmint's Flow\(..., immersed=True\), or FluidSubproblem is required",
    ),
    "a residual for a flow": (lambda: CouDALFISh(a_flow().residual, a_shell()), "fluid = .*: a flow, .* is required"),
    "a spline for a shell": (lambda: CouDALFISh(a_flow(), a_shell().spline), "shell = .*: a shell, .* is required"),
    "the shell's time step": (
        lambda: CouDALFISh(a_flow(), a_shell(dt=0.1)),
        r"dt = 0\.1: the shell has a clock of its own, and 0\.05 is required",
    ),
    "the shell's scheme": (
        lambda: CouDALFISh(a_flow(), a_shell(dt=DT, scheme=backward_euler(2))),
        "scheme = Scheme.*: the shell has a clock of its own",
    ),
    "the published scheme of structures": (
        lambda: CouDALFISh(a_flow(), a_shell(dt=DT, scheme=generalized_alpha(0.5, 2))),
        "scheme = Scheme.*: the shell has a clock of its own",
    ),
    "dimensions": (
        lambda: CouDALFISh(a_flow(), a_shell(((0.5, 0.0, 0.0), (0.5, 0.6, 0.0)))),
        "the shell lives in 3 dimensions, the fluid in 2: they must be equal",
    ),
    "options of the flow": (
        lambda: CouDALFISh(a_flow(), a_shell(), FlowOptions()),
        r"options = FlowOptions.*: CouplingOptions is required",
    ),
    "points and multiplier": (
        lambda: CouDALFISh(sheet_in_flow().fluid, free_sheet().shell, multiplier=np.zeros(3)),
        r"multiplier has shape \(3,\)",
    ),
}


@pytest.mark.parametrize("what", FORGOTTEN)
def test_what_is_forgotten_is_asked_for(what, without_compilation):
    script, message = FORGOTTEN[what]
    with pytest.raises(ValueError, match=f"^{message}"):
        script()


@pytest.mark.parametrize("what", [name for name in MIXED_UP if name != "points and multiplier"])
def test_what_is_mixed_up_is_refused(what, without_compilation):
    script, message = MIXED_UP[what]
    with pytest.raises(ValueError, match=f"^{message}"):
        script()


def test_a_multiplier_of_other_points_is_refused():
    script, message = MIXED_UP["points and multiplier"]
    with pytest.raises(ValueError, match=f"^{message}"):
        script()


@pytest.mark.skipif(WORLD.size == 1, reason="one rank has all of a spline")
@pytest.mark.mpi
def test_a_distributed_shell_is_refused(without_compilation):
    with pytest.raises(ValueError, match="the shell's spline is distributed"):
        CouDALFISh(a_flow(), a_shell(comm=WORLD))


def test_a_side_of_a_coupled_run_does_not_step_alone():
    """Nothing would act on it."""
    flow, shell = a_flow(), a_shell()
    CouDALFISh(flow, shell, CouplingOptions(penalty=10.0))
    for side, name in ((flow, "flow"), (shell, "shell")):
        for step in (side.take_step, lambda side=side: side.run(steps=1)):
            with pytest.raises(ValueError, match=f"^the {name} is coupled with a"):
                step()


def test_two_couplers_do_not_share_a_side():
    """Each would move its clock."""
    flow, shell = a_flow(), a_shell()
    with pytest.raises(ValueError, match=r"^multiplier has shape \(3,\)"):
        CouDALFISh(flow, shell, multiplier=np.zeros(3))
    first = CouDALFISh(flow, shell)  # nothing was coupled before
    with pytest.raises(ValueError, match=r"^fluid is coupled with another shell: .* are patches of one geometry"):
        CouDALFISh(flow, a_shell())
    with pytest.raises(ValueError, match=r"^shell is coupled with another flow: make it anew"):
        CouDALFISh(a_flow(), shell)
    again = CouDALFISh(flow, shell, CouplingOptions(penalty=10.0))  # the same two with other options
    assert again.integrators == first.integrators


def test_the_tangent_that_a_flow_was_told_to_take_comes_along(monkeypatch):
    taken = []

    def record(*_, tangent=None, **__):
        taken.append(tangent)
        raise InterruptedError

    monkeypatch.setattr("coudalfish.sides.fluid.FiniteElementSystem", record)
    for frozen in (True, False):
        with pytest.raises(InterruptedError):
            CouDALFISh(a_flow(options=FlowOptions(frozen_tangent=frozen)), a_shell())
    assert [tangent is not None for tangent in taken] == [True, False]


def test_a_coupling_that_is_refused_leaves_the_shell_without_a_clock():
    """It is solved in statics and coupled with a flow of another time step then, as if nothing had been tried."""
    shell = a_shell(loads=[DeadLoad((0.1, 0.0))])
    residual = shell.residual
    with pytest.raises(ValueError, match="multiplier has shape"):
        CouDALFISh(a_flow(), shell, multiplier=np.zeros(3))
    assert shell.time is None
    assert shell.residual is residual
    shell.solve()
    bent = shell.y.x.array.copy()
    fsi = CouDALFISh(a_flow(dt=0.1), shell)
    assert fsi.timeInt_sh.step_size == 0.1
    np.testing.assert_array_equal(shell.time.x_old.x.array, bent)
    with pytest.raises(ValueError, match="multiplier has shape"):  # what is coupled already stays so
        CouDALFISh(fsi.fluid, shell, multiplier=np.zeros(3))
    assert shell.time is fsi.timeInt_sh


def test_a_shell_without_a_clock_has_none_to_give_back():
    for shell in (a_shell(), a_shell(dt=DT)):
        with pytest.raises(ValueError, match=r"^Shell.* has no clock that bind\(\) brought"):
            shell.release()


def test_a_step_size_of_one_side_alone_is_refused():
    flow, shell = a_flow(), a_shell()
    fsi = CouDALFISh(flow, shell)
    flow.time.step_size = 0.1
    with pytest.raises(
        ValueError, match=r"^clocks \(t, dt\): fluid \(0\.0, 0\.1\), shell \(0\.0, 0\.05\): .* sets all"
    ):
        fsi.take_step()
    fsi.step_size = 0.1
    assert fsi.take_step().t == 0.1


@pytest.mark.parametrize(
    ("make", "name", "message"),
    [
        (a_flow, "mu", r"^Flow\.mu = 0\.5: the equations have its Constant; mu\.value is what can be set"),
        (a_flow, "dt", r"^Flow\.dt = 0\.5: time\.step_size is what can be set"),
        (a_flow, "conditions", r"^Flow\.conditions = 0\.5: it belongs to what is made already; another Flow is requi"),
        (a_shell, "density", r"^Shell\.density = 0\.5: the equations have its Constant; density\.value"),
        (a_shell, "loads", r"^Shell\.loads = 0\.5: it belongs to what is made already; another Shell is required"),
        (a_shell, "thickness", r"^Shell\.thickness = 0\.5: material\.thickness\.value is what can be set"),
        (lambda: CouDALFISh(a_flow(), a_shell()), "dt", r"^CouDALFISh\.dt = 0\.5: step_size is what can be set"),
        (lambda: CouDALFISh(a_flow(), a_shell()), "shell", r"^CouDALFISh\.shell = 0\.5: .* another CouDALFISh is req"),
    ],
)
def test_what_is_set_too_late_to_have_an_effect_is_refused(make, name, message):
    thing = make()
    with pytest.raises(AttributeError, match=message):
        setattr(thing, name, 0.5)


def test_what_is_read_when_it_is_needed_can_be_set():
    flow, shell = a_flow(), a_shell()
    fsi = CouDALFISh(flow, shell)
    flow.mu.value = shell.density.value = 0.5
    fsi.options, fsi.step_size = CouplingOptions.converged(), 0.1
    assert fsi.options.multiplier == "converged"


# -- what a flow knows of a surface, and how it is coupled, where nobody says -----------------------------------------


def open_flow(immersed=True, cell="triangle", **options):
    known = {"rho": 1.0, "mu": 0.1, "dt": DT} | options
    return Flow(box(WORLD, (0.0, 0.0), (1.0, 1.0), (4, 4), cell), OPEN, immersed=immersed, **known)


OPEN = [Velocity("left", stream), Velocity(("bottom", "top")), Traction("right")]


def test_a_flow_has_the_best_fields_that_it_can_have():
    best, plain = open_flow(), open_flow("plain")
    assert best.sides.is_kinked
    assert best.scales is None
    assert plain.sides is None
    assert plain.scales is not None


def test_in_space_the_pressure_jumps_by_default_on_tetrahedra_alone():
    for cell, immersed in (("tetrahedron", "jump"), ("hexahedron", None)):
        mesh = box(WORLD, (0.0,) * 3, (1.0,) * 3, (2,) * 3, cell)
        sides = [Velocity(("left", "bottom", "top", "front", "back")), Traction("right")]
        flow = Flow(mesh, sides, rho=1.0, mu=0.1, dt=DT, immersed=True)
        assert (flow.sides is not None) == (immersed == "jump")
        assert flow.sides is None or not flow.sides.is_kinked


def with_a_solid():
    """A beam, with which the fluid's mesh moves."""
    given = {"mesh": beam_mesh(), "scheme": backward_euler()}
    moving = ElasticMotion(given["mesh"], dict.fromkeys(HELD), DT, given["scheme"], cells=("fluid",))
    options = {"rho": 1.0, "mu": 1.0, "dt": DT, "scheme": given["scheme"], "moving": moving}
    return Flow(given["mesh"], [Velocity(HELD)], **options, solid=Solid(SOFT), immersed=True)


def on_a_mesh_that_moves():
    mesh, scheme = box(WORLD, (0.0, 0.0), (1.0, 1.0), (4, 4)), backward_euler()
    moving = PrescribedMotion(mesh, lambda x, t: 0.1 * t * x, DT, scheme)
    return Flow(mesh, OPEN, rho=1.0, mu=0.1, dt=DT, scheme=scheme, moving=moving, immersed=True)


@pytest.mark.parametrize(
    ("make", "wanted"),
    [
        (lambda: open_flow(degree=2), "degree = 2: degree 1"),
        (lambda: open_flow(cell="quadrilateral"), "mesh: triangles or tetrahedra"),
        (lambda: open_flow(dt=None), "dt = None: a flow that advances in time"),
        (lambda: a_flow(immersed=True), "conditions: no Resistance"),
        (on_a_mesh_that_moves, "moving: a mesh that is fixed"),
        (with_a_solid, "moving: a mesh that is fixed"),
    ],
    ids=["degree 2", "quadrilaterals", "steady", "resistance", "moving", "solid"],
)
def test_where_fields_cannot_differ_on_both_sides_they_are_plain_and_the_log_says_why(make, wanted, caplog):
    with caplog.at_level(logging.INFO, logger="varmint"):
        flow = make()
    assert flow.sides is None
    assert flow.is_immersed
    (said,) = [record for record in caplog.records if record.name == "varmint.flow.checks"]
    assert said.levelno == logging.INFO
    assert said.getMessage() == f"fields at an immersed surface are 'plain': for others, {wanted} is required"


def test_who_names_no_options_gets_those_that_suit_the_fields():
    assert CouDALFISh(open_flow(), a_shell()).options == CouplingOptions.sharp()
    jump = CouplingOptions.converged(fluid_tangent="consistent", trace="exact")
    assert CouDALFISh(open_flow("jump"), a_shell()).options == jump
    assert CouDALFISh(open_flow("plain"), a_shell()).options == CouplingOptions()


@pytest.mark.parametrize(
    ("immersed", "options", "said"),
    [
        ("jump", CouplingOptions(trace="exact"), ["multiplier = 'lagged'"]),
        ("jump and kink", CouplingOptions(), ["multiplier = 'lagged'", "trace = 'nodes'"]),
        ("jump", CouplingOptions.converged(), ["trace = 'nodes'"]),
        ("jump", CouplingOptions.sharp(), ["multiplier_direction = 'vector'"]),
        ("plain", CouplingOptions.sharp(), ["multiplier_direction = 'vector'"]),
        ("plain", CouplingOptions.converged(), []),
        ("jump", CouplingOptions.converged(trace="exact"), []),
        ("jump and kink", CouplingOptions.converged(trace="exact"), []),
    ],
)
def test_options_that_do_not_suit_the_fields_are_taken_and_named(immersed, options, said, caplog):
    fsi = CouDALFISh(open_flow(immersed), a_shell(), options)
    assert fsi.options == options
    warned = [record.getMessage() for record in caplog.records if record.levelno == logging.WARNING]
    assert [message.split(" = ")[0] for message in warned] == [name.split(" = ")[0] for name in said]
    for message, start in zip(warned, said, strict=True):
        assert message.startswith(start)
        assert "is advised" in message


def test_scales_that_no_field_has_are_named(caplog):
    """Those of the published algorithm as well, also where it is chosen later; it runs."""
    CouDALFISh(open_flow("plain"), a_shell(), CouplingOptions.reference())
    fsi = CouDALFISh(open_flow(), a_shell())
    assert not caplog.records
    fsi.options = CouplingOptions.reference()
    assert fsi.takeStep().passes > 1
    assert fsi.takeStep().attempts == 1
    said = [record.getMessage() for record in caplog.records if "has no effect" in record.getMessage()]
    assert len(said) == 1
    assert said[0].startswith("scale_c = 0.001 has no effect: only plain fields")
