"""A shell as one object: the numbers of forms by hand, exact solutions, and states after a failure."""

import numpy as np
import pytest
import ufl
from mpi4py import MPI

from shnapr import loads as forms
from shnapr.conditions import Damping, DeadLoad, EdgeForce, EdgeMoment, Gravity, Pressure
from shnapr.contact import ContactRecipe, LinearKernel, SelfContact
from shnapr.contact.system import ContactSystem
from shnapr.planes import RigidPlane, plane_contact
from shnapr.shell import Shell, ShellError, ShellOptions
from shnapr.supports import clamped
from shnapr.svk import StVenantKirchhoff
from shnapr.work import internal_tangent, internal_work
from tigar_x import compat
from tigar_x.fem.linear import LinearSolver, SolveError
from tigar_x.fem.newton import newton
from tigar_x.fem.schemes import backward_euler, companion, generalized_alpha
from tigar_x.fem.time_integration import TimeIntegrator
from tigar_x.geometry import shapes
from tigar_x.geometry.multipatch import disjoint
from tigar_x.splines.constraints import no_rotation
from tigar_x.splines.quadrature import NodalQuadrature
from tigar_x.splines.sampling import line
from tigar_x.splines.spline import ExtractedSpline
from tigar_x.splines.spline_system import SplineSystem, solve_linear

E, NU, H, RHO = 1e3, 0.3, 0.1, 2.0
MATERIAL = StVenantKirchhoff(E, NU, H)
LENGTH = 2.0


def beam(elements=4, degree=2):
    return shapes.line((0.0, 0.0), (LENGTH, 0.0), elements=elements, degree=degree)


def cantilever(*loads, **options):
    """A clamped curve in the plane."""
    return Shell(beam(), MATERIAL, **({"clamped": ["u0"], "loads": loads, "density": RHO} | options))


def by_hand(patch=None, **options):
    """Spline, displacement, test function and Constants of the same."""
    patch = beam() if patch is None else patch
    spline = ExtractedSpline(patch, MPI.COMM_SELF, zero_dofs=clamped(patch, "u0"), **options)
    c = {name: compat.Constant(spline.mesh, value) for name, value in {"E": E, "nu": NU, "h": H, "rho": RHO}.items()}
    return spline, spline.function(name="y"), ufl.TestFunction(spline.V), c, StVenantKirchhoff(c["E"], c["nu"], c["h"])


# -- the numbers of forms by hand -------------------------------------------------------------------------------------


@pytest.mark.mpi
def test_statics_are_those_of_forms_by_hand():
    shell = cantilever(
        Pressure(0.02), EdgeMoment("u1", 0.01), RigidPlane((0.0, -0.1), (0.0, 1.0), 5.0), options=ShellOptions(rtol=0.0)
    )
    shell.solve()

    spline, y, z, _, material = by_hand()
    end, plane = spline.ds("u1"), RigidPlane((0.0, -0.1), (0.0, 1.0), compat.Constant(spline.mesh, 5.0))
    one, pressure, moment = (compat.Constant(spline.mesh, value) for value in (1.0, 0.02, 0.01))
    load = forms.follower_pressure(spline, one * pressure, y, z) + forms.edge_moment(spline, one * moment, y, z, end)
    load += plane_contact(spline, plane, y, z)
    tangent = internal_tangent(spline, material, y, z, y) + ufl.derivative(load, y)
    system = SplineSystem(spline, internal_work(spline, material, y, z) + load, tangent, unknown=y)
    newton(system, rtol=1e-13)
    assert np.abs(y.x.array).max() > 0.1
    np.testing.assert_allclose(shell.y.x.array, y.x.array, rtol=1e-9, atol=1e-11)
    np.testing.assert_allclose(shell.at("u1").displacement, spline.evaluate(y, [[1.0]])[0], rtol=1e-9)
    np.testing.assert_allclose(shell.at(line(shell.spline, 0, 3, patch=0)).reference[:, 0], [0.0, 1.0, 2.0])


@pytest.mark.mpi
def test_linear_theory_is_one_increment_from_rest():
    shell = cantilever(DeadLoad((0.0, 5.0)))
    shell.solve()
    shell.solve_linear()

    spline, y, z, _, material = by_hand()
    rest, force = spline.function(), compat.Constant(spline.mesh, np.array([0.0, 5.0]))
    residual = internal_work(spline, material, rest, z) + forms.dead_load(spline, force, z)
    solve_linear(SplineSystem(spline, residual, internal_tangent(spline, material, rest, z, rest), unknown=y))
    np.testing.assert_allclose(shell.y.x.array, y.x.array, rtol=1e-10, atol=1e-12)


@pytest.mark.mpi
@pytest.mark.parametrize("touching", [False, True])
def test_steps_are_those_of_forms_by_hand(touching):
    strips = disjoint(beam(8), shapes.line((0.0, 0.17), (LENGTH, 0.17), elements=8, degree=2)) if touching else beam()
    kernel, r_self = LinearKernel(0.18, 1e3), 0.185
    shell = Shell(
        strips,
        MATERIAL,
        clamped=["u0"],
        density=RHO,
        loads=[Gravity((0.0, -1.0)), Damping(0.3), DeadLoad(lambda X, t: [0.0, -20 * t * ufl.sin(X[1])])],
        contact=ContactRecipe(kernel, r_self, spacing=None) if touching else None,
        dt=0.05,
        scheme=generalized_alpha(0.5, 2),
    )
    reports = [shell.take_step() for _ in range(3)]

    spline, y, z, c, material = by_hand(strips)
    time = TimeIntegrator(y, 0.05, generalized_alpha(0.5, 2))
    mass = {"density": c["rho"], "thickness": c["h"]}
    g, damping = compat.Constant(spline.mesh, np.array([0.0, -1.0])), compat.Constant(spline.mesh, 0.3)
    rest = forms.inertia(spline, time.xddot_alpha, z, **mass) + forms.gravity(spline, g, z, **mass)
    rest += forms.mass_damping(spline, time.xdot_alpha, z, coefficient=damping, **mass)
    rest += forms.dead_load(spline, ufl.as_vector([0.0, -20 * time.t_alpha * ufl.sin(spline.F[1])]), z)
    residual = internal_work(spline, material, time.x_alpha, z) + rest
    tangent = internal_tangent(spline, material, time.x_alpha, z, y) + ufl.derivative(rest, y)
    if touching:
        contact = SelfContact(NodalQuadrature.of(spline), kernel, r_self)
        system = ContactSystem(spline, residual, tangent, contact, unknown=y, time=time)
    else:
        system = SplineSystem(spline, residual, tangent, unknown=y)
    for _ in range(3):
        time.predict()
        newton(system, rtol=1e-8, atol=system.rounding, max_iterations=30)
        time.advance()
    np.testing.assert_allclose(shell.y.x.array, y.x.array, rtol=1e-10, atol=1e-13)
    np.testing.assert_allclose(shell.time.xdot_old.x.array, time.xdot_old.x.array, rtol=1e-8, atol=1e-11)
    assert reports[-1].t == shell.time.time == time.time
    assert reports[-1].t_alpha == pytest.approx(0.1 + time.scheme.alpha_f * 0.05)
    assert (shell.energies().contact > 0.0) == touching


@pytest.mark.mpi
def test_a_distributed_shell_is_the_same():
    whole, parts = (cantilever(DeadLoad((0.0, 5.0)), comm=comm) for comm in (MPI.COMM_SELF, MPI.COMM_WORLD))
    for shell in (whole, parts):
        shell.solve()
    assert whole.unknowns == parts.unknowns == 2 * (beam().n - 2)
    np.testing.assert_allclose(parts.at("u1").position, whole.at("u1").position, rtol=1e-9)
    np.testing.assert_allclose(parts.support_force(), (0.0, -5.0 * LENGTH), atol=1e-6)
    np.testing.assert_allclose(whole.support_force(), (0.0, -5.0 * LENGTH), atol=1e-6)


# -- exact solutions --------------------------------------------------------------------------------------------------


@pytest.mark.mpi
def test_numbers_are_constants_that_may_change():
    shell = cantilever(EdgeForce("u1", (0.0, 1e-4)), density=None)
    shell.solve()
    first, residual = shell.at("u1").displacement[1], shell.residual
    shell.material.youngs_modulus.value = 2 * E
    shell.loads[0].force.value[:] = (0.0, 4e-4)
    shell.solve()
    assert shell.residual is residual
    assert shell.at("u1").displacement[1] == pytest.approx(2 * first, rel=1e-4)
    shell.solve(0.5)
    assert shell.load_factor == 0.5
    assert shell.at("u1").displacement[1] == pytest.approx(first, rel=1e-4)


@pytest.mark.mpi
def test_frequencies_rise_with_the_tension_of_the_present_state():
    patch, tension, modulus = beam(16, 3), 2.0, E / (1 - NU**2)
    held = [patch.dofs(patch.side("u0")), patch.dofs(patch.side("u1"), (1,))]
    material = StVenantKirchhoff(E, NU, 0.05)
    shell = Shell(patch, material, density=RHO, zero_dofs=np.concatenate(held), loads=[EdgeForce("u1", (tension, 0.0))])
    k = np.pi / LENGTH
    bending, mass = modulus * 0.05**3 / 12 * k**4, RHO * 0.05
    assert shell.modes(1).values[0] == pytest.approx(bending / mass, rel=1e-4)
    shell.solve()
    # stretching by 3.6 % is what the string's formula leaves out
    assert shell.modes(1).values[0] == pytest.approx((bending + tension * k**2) / mass, rel=0.05)
    assert tension * k**2 > 20 * bending


@pytest.mark.mpi
def test_a_clock_takes_over_displacement_and_velocity():
    shell = Shell(beam(), MATERIAL, density=RHO)
    shell.start(np.tile([0.5, 0.0], (beam().n, 1)), ufl.as_vector([0.25 + 0 * shell.spline.F[0], -1.0]))
    shell.bind(0.1, backward_euler(), 2.0)
    report = shell.take_step(measure=shell.support_force)
    assert report.t == pytest.approx(2.1)
    np.testing.assert_allclose(shell.at("u0").displacement, (0.525, -0.1), atol=1e-12)
    np.testing.assert_allclose(report.measured, 0.0, atol=1e-10)
    assert shell.energies().total == pytest.approx(RHO * H * LENGTH * (0.25**2 + 1.0) / 2)


@pytest.mark.mpi
def test_an_equilibrium_stays_when_a_clock_comes():
    shell = cantilever(DeadLoad((0.0, 5.0)))
    shell.solve()
    still = shell.at("u1").displacement
    shell.bind(0.1, generalized_alpha(0.5))
    for _ in range(2):
        assert shell.take_step().iterations <= 1
    assert abs(still[1]) > 0.1
    np.testing.assert_allclose(shell.at("u1").displacement, still, rtol=1e-9)
    assert shell.energies().kinetic < 1e-15
    shell.loads[0].force.value[:] = 0.0
    shell.take_step()
    assert 0.5 < shell.at("u1").displacement[1] / still[1] < 1.0  # on its way, and not at rest where it is straight
    assert shell.energies().kinetic > 0.0


@pytest.mark.mpi
def test_membrane_forces_as_unknowns_do_not_lock():
    h, force, patch = 2e-4, 2.5e-11, beam(4)
    deflection = {}
    for formulation in ("displacement", "mixed"):
        shell = Shell(
            patch,
            StVenantKirchhoff(E, 0.0, h),
            pinned=["u0"],
            constraints=[no_rotation(patch, "u0")],
            loads=[EdgeForce("u1", (0.0, force))],
            formulation=formulation,
        )
        shell.solve(step=0.5)
        deflection[formulation] = shell.at("u1").displacement[1]
    exact = force * LENGTH**3 / (3 * E * h**3 / 12)
    assert deflection["mixed"] == pytest.approx(exact, rel=0.03)
    assert deflection["displacement"] < 0.5 * exact


@pytest.mark.parametrize("d", [2, 3])
def test_a_range_that_grows_with_the_spacing_keeps_the_stiffness_of_surfaces(d):
    recipe = ContactRecipe(LinearKernel(0.1, 1e3), 0.11, neighbours="space", spacing=0.4)
    ticks = 0.04 * np.arange(-6, 7)
    flat = np.stack(np.meshgrid(*[ticks] * (d - 1)), axis=-1).reshape(-1, d - 1)
    sheets = np.concatenate([np.column_stack([flat, np.full(len(flat), height)]) for height in (0.0, 0.15)])
    pressures = []
    for coarse in (1.0, 2.5):
        areas = np.full(len(sheets), (0.04 * coarse) ** (d - 1))
        contact = recipe.of(NodalQuadrature(coarse * sheets, areas, np.ones(len(sheets))))
        assert contact.kernel.r_max == pytest.approx(0.1 * coarse)
        assert contact.r_self == pytest.approx(0.11 * coarse)
        x = coarse * sheets
        x[len(flat) :, -1] = 0.5 * contact.kernel.r_max
        forces = contact.evaluate(x, tangent=False).forces[: len(flat), -1] / areas[0]
        pressures.append(forces[len(flat) // 2])
    assert abs(pressures[0]) > 0.1
    assert pressures[0] == pytest.approx(pressures[1], rel=1e-9)
    assert recipe.growth(NodalQuadrature(sheets, areas / 1e3, np.ones(len(sheets)))) == 1.0


# -- after a failure --------------------------------------------------------------------------------------------------


@pytest.mark.mpi
def test_a_failed_step_leaves_the_state_before_it():
    loads = (DeadLoad((0.0, 50.0)),)
    clock = {"dt": 0.1, "scheme": generalized_alpha(0.5, 2)}
    shell, other = (cantilever(*loads, **clock) for _ in range(2))
    for each in (shell, other):
        each.take_step()
    before, shell.options = shell.y.x.array.copy(), ShellOptions(max_iterations=1)
    with pytest.raises(ShellError, match=r"the step to t = 0\.2 \(dt = 0\.1\) failed") as caught:
        shell.take_step()
    assert caught.value.t == pytest.approx(0.2)
    np.testing.assert_array_equal(shell.y.x.array, before)
    shell.options = ShellOptions()
    shell.take_step()
    other.take_step()
    np.testing.assert_allclose(shell.y.x.array, other.y.x.array, rtol=1e-12, atol=1e-15)


@pytest.mark.mpi
def test_an_interrupt_in_a_step_leaves_the_state_before_it():
    def interrupt():
        raise KeyboardInterrupt

    shell = cantilever(DeadLoad((0.0, 50.0)), dt=0.1)
    with pytest.raises(KeyboardInterrupt):
        shell.take_step(measure=interrupt)
    assert (shell.time.in_step, shell.time.time) == (False, 0.0)
    np.testing.assert_array_equal(shell.y.x.array, 0.0)


@pytest.mark.mpi
def test_a_linear_solve_that_fails_leaves_the_state_before_it():
    stuck = LinearSolver("stuck", {"ksp_type": "cg", "pc_type": "none", "ksp_max_it": 1, "ksp_rtol": 1e-14})
    shell, seen = cantilever(DeadLoad((0.0, 5.0)), solver=stuck), []
    shell.updates = (seen.append,)
    shell.start(np.tile([0.0, 0.1], (beam().n, 1)))
    before = shell.y.x.array.copy()
    with pytest.raises(SolveError, match="stuck failed"):
        shell.solve_linear()
    assert (shell.load_factor, seen) == (0.0, [1.0, 0.0])
    np.testing.assert_array_equal(shell.y.x.array, before)


@pytest.mark.mpi
def test_a_load_that_is_not_reached_leaves_the_last_equilibrium():
    shell = cantilever(DeadLoad(lambda X, t: [0.0, 5 * t + ufl.sqrt(0.6 - t)]))
    with pytest.raises(ShellError, match=r"no equilibrium at a load factor of 1: loading ended at 0\.6") as caught:
        shell.solve(step=0.2)
    assert 0.59 < caught.value.t == shell.load_factor <= 0.6
    force = 5 * caught.value.t + np.sqrt(0.6 - caught.value.t)
    np.testing.assert_allclose(shell.support_force(), (0.0, -force * LENGTH), atol=1e-6)
    shell.start()
    np.testing.assert_array_equal(shell.y.x.array, 0.0)
    assert shell.system.rounding() > 0.0  # of positions, where nothing is displaced
    assert shell.solve(0.1).loads == (0.1,)


@pytest.mark.mpi
def test_a_run_cuts_steps_that_fail():
    shell = cantilever(DeadLoad((0.0, 50.0)), dt=0.2, options=ShellOptions(rtol=1e-4, max_iterations=4))
    times = [(report.t, len(run.reports)) for run in [shell.run(until=0.4, show=False)] for report in run]
    assert [t for t, _ in times] == pytest.approx([0.2, 0.4])
    assert max(steps for _, steps in times) > 1
    assert shell.time.step_size == pytest.approx(0.2)


# -- a clock from outside ---------------------------------------------------------------------------------------------


@pytest.mark.mpi
def test_a_shell_gets_its_clock_once():
    shell, scheme = cantilever(), generalized_alpha(0.5)
    shell.bind(0.1, scheme, 2.0)
    assert (shell.time.step_size, shell.time.time, shell.time.scheme) == (0.1, 2.0, companion(scheme))
    shell.bind(0.1, companion(scheme), 2.0)
    for dt, other, t, told in (
        (0.2, scheme, 2.0, r"dt = 0\.1: the shell has a clock of its own, and 0\.2 is required"),
        (0.1, scheme, 0.0, r"t = 2\.0: the shell has a clock of its own, and 0\.0 is required"),
        (0.1, backward_euler(), 2.0, r"scheme = Scheme.*: the shell has a clock of its own"),
    ):
        with pytest.raises(ValueError, match=told):
            shell.bind(dt, other, t)
