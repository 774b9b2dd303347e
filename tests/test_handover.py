"""What belongs to a flow comes along when its residual is handed to the coupling by hand, or the run is refused."""

import gc
import weakref
from types import SimpleNamespace

import pytest
import ufl
from mpi4py import MPI
from scenes import free_sheet
from test_solids import beam_flow

from coudalfish import FluidSubproblem, ShellSubproblem, SurfaceBand
from coudalfish.sides.handover import check_band
from coudalfish.sides.sided_fluid import SidedFluid
from tigar_x.fem.linear import direct, gmres_ilu
from tigar_x.fem.schemes import generalized_alpha
from tigar_x.fem.time_integration import TimeIntegrator
from varmint.conditions import Resistance, Traction, Velocity, WeakVelocity
from varmint.flow import Flow, FlowOptions
from varmint.forms.motion import PrescribedMotion
from varmint.mesh import box

pytestmark = pytest.mark.mpi
SIDES = ("left", "right", "bottom", "top")


class NoCompilationError(Exception):
    """Raised where a subproblem would begin to compile, which is after all checks."""


@pytest.fixture(autouse=True)
def without_compilation(monkeypatch):
    def refuse(*_, **__):
        raise NoCompilationError

    monkeypatch.setattr("coudalfish.sides.fluid.FiniteElementSystem", refuse)
    monkeypatch.setattr("coudalfish.sides.shell.SplineSystem", refuse)


def square():
    return box(MPI.COMM_WORLD, (0.0, 0.0), (1.0, 1.0), (2, 2), "triangle")


def rising(x, t):
    return ufl.as_vector([t * x[1] * (1.0 - x[1]), 0.0 * x[0]])


def open_flow(*conditions, mesh=None, **options):
    """A channel, whose conditions at the sides are given or else an inlet that changes in time and an open outlet."""
    ends = conditions or (Velocity("left", rising), Traction("right"))
    walls = Velocity(("bottom", "top"))
    return Flow(mesh or square(), [walls, *ends], rho=1.0, mu=0.1, dt=0.1, **options)


def enclosed_flow(**options):
    walls = WeakVelocity(SIDES, (0.0, 0.0))
    return Flow(square(), [walls], rho=1.0, mu=0.1, dt=0.1, options=FlowOptions(**options))


def handed_over(flow, **other):
    """Everything that a subproblem can be given of a flow, but for what is other; up to the compilation."""
    given = dict(
        bcs=flow.bcs, updates=flow.updates, before=flow.before, rank_one=flow.rank_one, moving=flow.moving,
        solver=flow.options.solver,
    )  # fmt: skip
    with pytest.raises(NoCompilationError):
        FluidSubproblem(flow.mesh.domain, flow.residual, flow.time, **(given | other))


def test_nothing_is_asked_beyond_what_the_flow_has():
    for flow in (open_flow(), open_flow(Traction("left"), Traction("right")), enclosed_flow(pressure="pin")):
        handed_over(flow)
    handed_over(open_flow(Traction("left"), Traction("right")), updates=())


def test_more_than_the_flow_needs_may_be_given():
    flow = open_flow(options=FlowOptions(solver=gmres_ilu(1)))
    handed_over(flow, updates=[lambda t: None, *flow.updates], before=[lambda: None], solver=direct())


def test_forgotten_updates_are_asked_for():
    with pytest.raises(ValueError, match=r"^updates leaves out those of the flow: updates=flow.updates is required"):
        handed_over(open_flow(), updates=())


def test_updates_of_another_flow_do_not_count():
    with pytest.raises(ValueError, match=r"^updates leaves out those of the flow"):
        handed_over(open_flow(), updates=open_flow().updates)


@pytest.mark.parametrize("name", ["before", "rank_one"])
def test_a_forgotten_outlet_with_a_resistance_is_asked_for(name):
    flow = open_flow(Traction("left"), Resistance("right", 10.0))
    handed_over(flow)
    with pytest.raises(ValueError, match=rf"^{name} leaves out those of the flow: {name}=flow.{name} is required"):
        handed_over(flow, **{name: ()})


def test_a_forgotten_solid_is_asked_for():
    flow = beam_flow(0.5, generalized_alpha(0.5), rho=1.0, mu=0.5, rtol=1e-9, pressure="pin")
    handed_over(flow)
    with pytest.raises(ValueError, match=r"^before leaves out .* nodes of a solid"):
        handed_over(flow, before=())


def test_a_forgotten_band_is_asked_for():
    flow = open_flow(immersed="plain")
    handed_over(flow, band=SurfaceBand(flow.mesh.domain, flow.scales))
    with pytest.raises(ValueError, match=r"^band is not that of the flow: band=SurfaceBand\(mesh, flow.scales\) is re"):
        handed_over(flow, band=None)
    with pytest.raises(ValueError, match=r"^band is given, and the residual has neither of its scales"):
        handed_over(flow, band=SurfaceBand(flow.mesh.domain))


def test_a_forgotten_band_of_a_residual_by_hand_is_asked_for():
    """Its scales are fields that know that a band brings them up to date."""
    flow = open_flow()
    band, other = SurfaceBand(flow.mesh.domain), SurfaceBand(flow.mesh.domain)
    scaled = flow.residual + band.scale_m * flow.fields.q * flow.mesh.dx(degree=2)
    for wrong, said in ((None, "None"), (other, "another one")):
        with pytest.raises(ValueError, match=f"^band is {said}: the band whose scales the residual contains is requi"):
            check_band(scaled, wrong)
    check_band(scaled, band)


def test_a_band_whose_scales_were_not_given_to_the_flow():
    flow = open_flow()
    with pytest.raises(ValueError, match=r"^band is given, and the residual has neither of its scales"):
        handed_over(flow, band=SurfaceBand(flow.mesh.domain))


def test_forgotten_sides_are_asked_for():
    """Without them a flow whose fields differ on both sides of a surface would know nothing of it."""
    with pytest.raises(ValueError, match=r"^sides are not those of the flow.*CouDALFISh\(flow, shell\)$"):
        handed_over(open_flow(immersed="jump and kink"))
    mesh = square()
    first, other = (open_flow(mesh=mesh, immersed="jump and kink") for _ in "ab")
    with pytest.raises(ValueError, match=r"^sides are not those of the flow"):
        SidedFluid(mesh.domain, first.residual, first.time, bcs=first.bcs, updates=first.updates, sides=other.sides)


def test_a_forgotten_motion_is_asked_for():
    def shake(x, t):
        return ufl.as_vector([0.1 * t * x[0], 0.0 * x[1]])

    mesh, scheme = square(), generalized_alpha(0.5)
    moving, other = (PrescribedMotion(mesh, shake, 0.1, scheme) for _ in "ab")
    flow = open_flow(mesh=mesh, scheme=scheme, moving=moving)
    handed_over(flow)
    for wrong, said in ((None, "None"), (other, "another one than the flow's")):
        with pytest.raises(ValueError, match=f"^moving is {said}: moving=flow.moving is required"):
            handed_over(flow, moving=wrong)


def test_the_solver_of_the_options_is_asked_for():
    flow = open_flow(options=FlowOptions(solver=gmres_ilu(1)))
    with pytest.raises(ValueError, match=r"^solver = None: the flow's options chose '.*', solver=flow.options.solver"):
        handed_over(flow, solver=None)


@pytest.mark.parametrize("options", [dict(pressure="null space", solver=gmres_ilu(1)), dict(pressure="pin")])
def test_the_pressure_of_an_enclosed_flow_must_be_pinned(options):
    """By the pin of the flow, or of the user; the null space is not handed over."""
    flow = enclosed_flow(**options)
    bcs = () if options["pressure"] == "pin" else flow.bcs
    with pytest.raises(ValueError, match=r'^bcs: the flow is enclosed.*pin is required.*FlowOptions\(pressure="pin"\)'):
        handed_over(flow, bcs=bcs)


@pytest.mark.parametrize(("name", "known"), [("density", 1.0), ("viscosity", 0.1)])
def test_density_and_viscosity_are_those_of_the_flow(name, known):
    flow = open_flow()
    for value in (None, known, known * (1.0 + 1e-14)):
        handed_over(flow, **{name: value})
    with pytest.raises(ValueError, match=rf"^{name} = 0.5: that of the flow, {known}, is required"):
        handed_over(flow, **{name: 0.5})
    (flow.rho if name == "density" else flow.mu).value = 0.5
    handed_over(flow, **{name: 0.5})


def test_forgotten_boundary_conditions_are_asked_for():
    with pytest.raises(ValueError, match=r"^bcs leaves out strong conditions of the flow: bcs=flow.bcs is required"):
        handed_over(open_flow(), bcs=open_flow().bcs[:1])


def test_a_residual_needs_the_integrator_that_it_is_built_of():
    flow, other = open_flow(), open_flow()
    own = TimeIntegrator(flow.w, 0.1, generalized_alpha(0.5), algebraic=(2,))
    for time in (own, other.time):
        with pytest.raises(
            ValueError, match=r"^the residual does not contain 'w(_old)?' of its integrator|another mesh"
        ):
            FluidSubproblem(flow.mesh.domain, flow.residual, time)


def test_a_shell_needs_the_integrator_that_its_residual_is_built_of():
    spline = free_sheet_parts()
    own = TimeIntegrator(spline.y, 0.1, generalized_alpha(0.5, 2, first_order_alpha_m=True))
    with pytest.raises(ValueError, match=r"^the residual does not contain 'y_old' of its integrator"):
        ShellSubproblem(spline.spline, spline.residual, own)


def free_sheet_parts():
    """What a shell is made of, before it is made."""
    found = SimpleNamespace()

    def keep(spline, residual, time, **_):
        found.spline, found.residual, found.y = spline, residual, time.x
        return found

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("scenes.ShellSubproblem", keep)
        free_sheet()
    return found


def test_what_an_integrator_knows_does_not_keep_its_flow_alive():
    """Flows own matrices, which are freed when the flow goes."""
    gc.collect()
    gc.disable()
    try:
        flow = open_flow()
        time, gone = flow.time, weakref.ref(flow)
        del flow
        assert gone() is None
        assert time.needs.updates
    finally:
        gc.enable()
