"""What a coupled run warns of, what it does not warn of, and whom it suspects when a step fails."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.sparse as sp
import ufl
from mpi4py import MPI
from dolfinx import fem
from scenes import sheet_in_flow
from test_moving_coupler import prescribed
from test_moving_coupler import scene as moving_scene

from coudalfish import (
    CouDALFISh,
    CouplingOptions,
    PenaltyRule,
    ShellSubproblem,
    StepError,
)
from coudalfish.step.report import RejectedStepError
from coudalfish.surface.exchange import VertexMeans
from coudalfish.surface.slip import WINDOW, RelativeSlip, SlipWindow
from shnapr.loads import inertia
from tigar_x.fem.linear import direct
from tigar_x.fem.schemes import generalized_alpha
from tigar_x.fem.time_integration import TimeIntegrator
from tigar_x.geometry import shapes
from tigar_x.splines.spline import ExtractedSpline
from varmint import conditions
from varmint.flow import Flow, FlowOptions
from varmint.mesh import box


def said(texts, *parts):
    """Whether exactly one warning has these parts, where warnings are given."""
    found = sum(all(part in text for part in parts) for text in texts)
    return found == (1 if MPI.COMM_WORLD.rank == 0 else 0)


# -- points outside the fluid -----------------------------------------------------------------------------------------


@pytest.mark.mpi
def test_a_shell_in_millimetres_beside_a_mesh_in_metres(warned):
    scene = sheet_in_flow((0.0, 0.0), ends=((350.0, 250.0), (450.0, 750.0)))
    for _ in range(2):
        scene.fsi.takeStep()
    texts = warned()
    assert said(texts, "no point of the shell is in the fluid", "spans 100 x 500, the fluid 1 x 1", "units of length")


@pytest.mark.mpi
def test_a_shell_in_metres_beside_a_mesh_in_millimetres(warned):
    scene = sheet_in_flow((0.0, 0.0), ends=((0.35, 0.25), (0.35, 0.35)))
    scene.fsi.takeStep()
    texts = warned()
    assert said(
        texts, "smaller than a cell of the fluid", "spans 0 x 0.1, the fluid 1 x 1", "size 0.167", "units of len"
    )


@pytest.mark.mpi
def test_points_that_leave_the_fluid_are_warned_of_when_they_do(warned):
    scene = sheet_in_flow((0.0, 0.0), sheet_velocity=(0.5, 0.0), ends=((0.55, 0.5), (0.93, 0.5)), rho_s=100.0)
    scene.fsi.takeStep()
    assert not warned()
    for _ in range(2):
        scene.fsi.takeStep()
    assert said(warned(), "of 17 points of the shell are outside the fluid", "the shell spans 0.38 x ")
    assert "units" not in "".join(warned())


# -- slip -------------------------------------------------------------------------------------------------------------


def piston(steps_per_period, n=16, mass_ratio=1.0, **options):
    """A rigid sheet on a spring across a duct with open ends, which starts with the fluid; lengths of a duct of 1.

    Returns the run with the frequency, relative to the exact one, from the first time that the sheet comes back.
    """
    omega, dt, height = 2.0 * math.pi, 1.0 / steps_per_period, 0.25
    mesh = box(MPI.COMM_WORLD, (0.0, 0.0), (1.0, height), (n, n // 4), "triangle")
    scheme, solved = generalized_alpha(0.5), FlowOptions(solver=direct())
    walls = conditions.Slip(("bottom", "top"))
    ends = [conditions.Traction(side) for side in ("left", "right")]
    flow = Flow(mesh, [walls, *ends], rho=1.0, mu=1e-3, dt=dt, scheme=scheme, immersed="plain", options=solved)
    flow.start((0.01 * omega, 0.0))
    line = shapes.line((0.52, 0.0), (0.52, height), elements=n // 2, degree=1)
    spline = ExtractedSpline(line, MPI.COMM_SELF, quadrature_degree=4, zero_dofs=np.arange(line.basis.n) * 2 + 1)
    start = spline.function(np.tile([0.01 * omega, 0.0], (line.basis.n, 1)))
    time = TimeIntegrator(
        spline.function(name="y"), dt, generalized_alpha(0.5, 2, first_order_alpha_m=True), xdot=start
    )
    z, k = ufl.TestFunction(spline.V), (1.0 + mass_ratio) * omega**2
    spring, rigidity, rho_s, h = (fem.Constant(spline.mesh, float(c)) for c in (k, 1e4 * k, mass_ratio, 1.0))
    residual = inertia(spline, time.xddot_alpha, z, density=rho_s, thickness=h)
    residual += spring * ufl.inner(time.x_alpha, z) * spline.dx
    residual += rigidity * ufl.inner(ufl.grad(time.x_alpha), ufl.grad(z)) * ufl.dx(domain=spline.mesh)
    shell = ShellSubproblem(spline, residual, time)
    fsi = CouDALFISh(flow, shell, CouplingOptions(**options))
    path = [(0.0, 0.0)]
    while len(path) < 3 or path[-1][1] > 0.0:
        t = fsi.takeStep().t
        path.append((t, float(spline.nodal(time.x)[0, 0])))
        assert t < 1.0
    (t, y), (after, beyond) = path[-2:]
    return SimpleNamespace(fsi=fsi, frequency=0.5 / (t + (after - t) * y / (y - beyond)))


@pytest.mark.mpi
def test_a_piston_that_comes_back_late_is_warned_of_although_it_moves_a_small_part_of_a_cell(warned):
    """The amplitude is a sixth of a cell, and the slip per load change stays within its limit."""
    late = piston(50, mass_ratio=0.01)
    assert late.frequency < 0.85
    texts = warned()
    assert said(texts, "the fluid passed the shell with", "of the speed", "reduce dt or raise the penalty")
    assert not any("slip ratio" in text for text in texts)


@pytest.mark.parametrize("way", [dict(steps_per_period=200), dict(steps_per_period=50, penalty=PenaltyRule(2.0, 8.0))])
def test_a_smaller_time_step_or_a_larger_penalty_mends_the_piston_as_the_warning_says(warned, way):
    assert piston(**way).frequency == pytest.approx(1.0, abs=0.03)
    assert not any("passed the shell" in text for text in warned())


def across(points=32, dt=0.01, **options):
    """A heavy sheet across a flow, coupled by a converged multiplier, after as many steps as slip is averaged over."""
    scene = sheet_in_flow(
        (1.0, 0.0), sheet_velocity=(0.0, 0.0), ends=((0.52, 0.25), (0.52, 0.75)), rho_s=1e6, dt=dt, mu=1e-3,
        density_of_points=points, options=CouplingOptions.converged(**options),
    )  # fmt: skip
    for _ in range(WINDOW):
        scene.fsi.takeStep()


@pytest.mark.mpi
def test_a_converged_multiplier_lets_fluid_pass_between_its_functions_and_does_not_lag(warned):
    across(points=4)
    texts = warned()
    assert said(texts, "passed the shell with", "between the functions of the multiplier; reduce multiplier_size")
    assert not any("lags" in text or "raise the penalty" in text or "slip ratio" in text for text in texts)


@pytest.mark.parametrize("way", [dict(points=4, multiplier_size=1.5), dict(points=32)])
def test_smaller_functions_or_a_finer_shell_let_less_pass_as_the_warning_says(warned, way):
    across(**way)
    assert not any("passed the shell" in text for text in warned())


def test_a_smaller_time_step_does_not_help_a_converged_multiplier_as_the_warning_says(warned):
    across(points=4, dt=0.001)
    assert said(warned(), "passed the shell with", "a smaller dt does not help")


@pytest.mark.mpi
def test_a_pattern_of_the_multiplier_within_cells_is_no_slip(warned):
    """It exceeds the limit by far; the load of the same size that has one sign is warned of."""
    for pattern in (True, False):
        scene = sheet_in_flow((0.0, 0.0), density_of_points=32, options=CouplingOptions(penalty=1.0))
        scene.fsi.lam[:] = 2.0 * (1.0 - 2.0 * (np.arange(33) % 2)) if pattern else 2.0
        assert scene.fsi.takeStep().slip_ratio > 0.5
        if pattern:
            assert not any("slip ratio" in text for text in warned())
    assert said(warned(), "slip ratio lam dt/(beta h)", "passes the shell with", "reduce dt or raise the penalty")


@pytest.mark.mpi
def test_slip_along_the_shell_is_warned_of_with_another_advice(warned):
    """A heavy sheet along a flow; its multiplier has nothing to do."""
    scene = sheet_in_flow(
        (1.0, 0.0), sheet_velocity=(0.0, 0.0), ends=((0.25, 0.52), (0.75, 0.52)), rho_s=1e6, dt=0.01, mu=1e-3,
        options=CouplingOptions(penalty=1e-3),
    )  # fmt: skip
    for _ in range(WINDOW - 1):
        scene.fsi.takeStep()
    assert not warned()
    scene.fsi.takeStep()
    texts = warned()
    assert said(texts, "the fluid slid along the shell with", "refine its mesh there")
    assert not any("passed the shell" in text or "raise the penalty" in text for text in texts)


def test_slip_is_averaged_over_the_surface_and_the_steps():
    """Areas weigh, normals need not be unit vectors, and the speed of all steps counts."""
    window = SlipWindow()
    slip, n, W = np.array([[3.0, 4.0], [0.0, 0.0]]), np.array([[2.0, 0.0], [0.0, 5.0]]), np.array([1.0, 3.0])
    for k in range(WINDOW):
        assert window.slip is None
        now = window.add(slip, n, W, 10.0 if k % 2 else 0.0)
        assert now == (RelativeSlip(0.15, 0.2) if k % 2 else None)
    speed = 10.0 / math.sqrt(2.0)
    assert window.slip.normal == pytest.approx(1.5 / speed)
    assert window.slip.tangential == pytest.approx(2.0 / speed)


def test_means_over_vertices_keep_constants_and_sums():
    rng = np.random.default_rng(3)
    N = np.zeros((5, 4))
    N[:4, :3] = rng.dirichlet((1.0, 1.0, 1.0), 4)
    W, x = np.array([1.0, 2.0, 0.5, 1.5, 0.0]), rng.uniform(-1.0, 1.0, (5, 2))
    means = VertexMeans(sp.csr_matrix(N), W)
    found = means @ x
    np.testing.assert_allclose(W @ found, W @ x, rtol=1e-13)
    np.testing.assert_allclose((means @ np.ones((5, 1)))[:4], 1.0, rtol=1e-13)
    assert not found[4].any()
    np.testing.assert_array_equal(means @ x[:, 0], found[:, 0])


# -- suspects ---------------------------------------------------------------------------------------------------------


@pytest.mark.mpi
def test_the_number_that_left_its_limit_first_is_suspect_and_not_what_a_diverging_step_shows():
    scene = sheet_in_flow((0.0, 0.0), options=CouplingOptions(penalty=1e-2))
    scene.fsi.lam[:] = 1.0
    for _ in range(2):
        scene.fsi.takeStep()
    scene.fluid.updates = (lambda t: scene.w.x.array.fill(np.nan),)
    with pytest.raises(StepError) as caught:
        scene.fsi.takeStep()
    first = "slip ratio lam dt/(beta h) (raise the penalty beta or reduce dt) = "
    assert caught.value.suspect.startswith(first)
    symptom = "Courant number |u - u_mesh| dt/h (reduce dt) is not finite"
    assert caught.value.suspect.endswith(f", advised at most 0.3, since t = 0; then {symptom}")


@pytest.mark.parametrize("multiplier", ["lagged", "converged"])
def test_a_large_penalty_is_suspect_where_fluid_and_shell_are_solved_in_turn_alone(multiplier):
    """Steps that solve for all at once take a pass with it, however large it is."""
    scene = sheet_in_flow((0.3, 0.2), options=CouplingOptions(multiplier=multiplier, penalty=PenaltyRule(1e6, 0.0)))
    report = scene.fsi.takeStep()
    assert report.attempts == 1
    assert report.passes <= 2 or multiplier == "lagged"
    scene.g.value[0] = np.nan
    step = scene.fsi.step()
    with pytest.raises(RejectedStepError) as caught:
        step.run()
    suspect = step.failure(caught.value).suspect
    assert suspect.startswith("penalty/impedance of the flow") == (multiplier == "lagged")
    assert ("within limits" in suspect) == (multiplier == "converged")


def test_a_number_that_came_back_within_its_limit_is_no_suspect():
    scene = sheet_in_flow((0.0, 0.0), options=CouplingOptions(penalty=1e-2))
    scene.fsi.lam[:] = 1.0
    scene.fsi.takeStep()
    scene.fsi.lam[:] = 0.0
    scene.fsi.options = CouplingOptions(penalty=100.0)
    scene.fsi.takeStep()
    scene.g.value[0] = np.nan
    with pytest.raises(StepError, match="suspect: ") as caught:
        scene.fsi.takeStep()
    assert "slip ratio" not in caught.value.suspect


@pytest.mark.mpi
def test_the_courant_number_is_that_of_the_flow_past_the_mesh():
    """A mesh that moves along with a fast flow, by two cells a step."""

    def along(x, t):
        return ufl.as_vector([4.0 * t + 0.0 * x[0], 0.0 * t])

    impossible = CouplingOptions(block_rtol=1e-15, block_atol=0.0, max_passes=1, second_attempt=False)
    found = []
    for motion in (None, prescribed(along)):
        fsi = moving_scene(motion, velocity=(4.0, 0.0), sheet_velocity=(4.0, 0.01), options=impossible)
        with pytest.raises(StepError) as caught:
            fsi.takeStep()
        found.append(caught.value.suspect)
        assert fsi.fluid.speed() == pytest.approx(4.0 if motion is None else 0.0, abs=1e-9)
    assert found[0].startswith("Courant number |u - u_mesh| dt/h (reduce dt) = ")
    assert "within limits" in found[1]
