"""Norms, floors and figures of a coupled step by numbers: what is accepted and what is warned of rests on them."""

import logging

import numpy as np
import pytest
import scipy.sparse as sp
import ufl
from mpi4py import MPI
from scenes import sheet_in_flow

from coudalfish import CouplingOptions
from coudalfish.restart import CoupledState
from coudalfish.sides.scales import directions, median_size
from coudalfish.step.floors import ROUNDED
from coudalfish.surface.slip import SHARE_OF_LOAD
from tigar_x.fem.linear import gmres_ilu
from tigar_x.fem.schemes import generalized_alpha
from varmint.forms.motion import ElasticMotion
from varmint.mesh import box, grid

COMM = MPI.COMM_SELF


def test_norms_of_a_rational_shell_are_those_of_its_residual():
    """Of forces at its points, of a motion of them, and of the motion in a step, which the tangent resists."""
    s = sheet_in_flow(weights=lambda n: 1.0 + 0.6 * np.sin(np.arange(n)), solver=None)
    shell, rng = s.shell, np.random.default_rng(3)
    time, w, n = shell.timeInt, shell.quadrature.rational, len(shell.quadrature.points)
    zero, W = np.zeros((n, 2)), shell.quadrature.weights
    time.x_old.x.array[:] = shell.spline.function(0.1 * rng.normal(size=(shell.spline.geometry.n, 2))).x.array
    time.predict()
    time.x.x.array[:] = time.x_old.x.array

    def residual(forces):
        shell.assemble_residual(forces)
        return shell.system.b.array_r.copy()

    forces = rng.normal(size=(n, 2))
    by_forces = residual(zero) - residual(forces)
    assert shell.coupling_norm(forces) == pytest.approx(np.linalg.norm(by_forces), rel=1e-10)
    shell.assemble_tangent(0.0 * W, 0.0)
    assert shell.momentum_scale() == 0.0
    shift = np.abs(rng.normal(size=(n, 2)))
    signs, start, eps = (-1.0) ** np.arange(n), time.x.x.array.copy(), 1e-5
    sides = []
    for side in (eps, -eps):
        time.x.x.array[:] = start + side * (signs[:, None] * w[:, None] * shift).ravel()
        sides.append(residual(zero))
    slope = np.linalg.norm(sides[0] - sides[1]) / (2 * eps)
    assert shell.force_of(shift) == pytest.approx(slope, rel=1e-6)
    assert shell.momentum_scale() == pytest.approx(eps * slope, rel=1e-6)


def test_norms_of_the_fluid_are_those_of_its_momentum_rows_and_of_the_first_solve():
    """What balances in the flow is the tangent times the state; a later solve is as accurate as the first at least."""
    s = sheet_in_flow((0.3, 0.2), sheet_velocity=(0.5, -0.4), solver=gmres_ilu(1, rtol=1e-4))
    fluid, b = s.fluid, s.fluid.system.b
    assert fluid.momentum_scale() == 0.0
    s.fsi.takeStep()
    w = s.w.x.array
    w[:] = np.sin(np.arange(len(w)))
    rows = sp.csr_matrix(fluid.system.A.getValuesCSR()[::-1], shape=fluid.system.A.getSize()) @ w
    assert fluid.momentum_scale() == pytest.approx(np.linalg.norm(rows.reshape(-1, 3)[:, :2]), rel=1e-10)
    for size, first, reference in ((2.0, True, 2.0), (0.5, False, 2.0), (3.0, False, 3.0), (0.5, True, 0.5)):
        b.array = size * rows / np.linalg.norm(rows)
        fluid.solve(first=first)
        assert fluid.linear_accuracy == pytest.approx(1e-4 * reference, rel=1e-10)


@pytest.mark.parametrize("atol", [1.0, 1e-300])
def test_floors_are_a_share_of_the_coupling_forces_and_what_rounding_of_positions_makes_of_them(atol):
    """Before the first tangent there is nothing else; the penalty holds against the velocity of such an error."""
    s = sheet_in_flow((0.3, 0.2), sheet_velocity=(0.5, -0.4), options=CouplingOptions(block_atol=atol))
    s.fsi.lam[:] = np.linspace(-2.0, 1.0, len(s.fsi.lam))
    step, shell = s.fsi.step(), s.shell
    step._predict()
    step._place()
    step._evaluate()
    floor, of_shell = step._floors()
    W, beta, large = shell.quadrature.weights[:, None], s.fsi.penalty, 1e12
    terms = np.abs(s.fsi.lam)[:, None] * np.abs(step.n)
    terms += beta * (np.abs(s.fluid.velocity_at(step.trace)) + np.abs(shell.velocity()))
    assert of_shell == pytest.approx(max(atol, ROUNDED) * shell.coupling_norm(W * terms), rel=1e-10, abs=0.0)
    before = shell.velocity()
    shell.timeInt.x.x.array[:] += large * shell.rounding().ravel()
    of_rounding = beta * (shell.velocity() - before) / large
    nodal = [np.linalg.norm(step.trace.B.T @ (W * part)) for part in (terms, of_rounding)]
    assert nodal[1] > 1e-3 * ROUNDED * nodal[0]
    assert floor == pytest.approx(max(atol, ROUNDED) * nodal[0] + nodal[1], rel=1e-5, abs=0.0)


def test_the_largest_distance_of_neighbours_is_the_spacing():
    s = sheet_in_flow(solver=None)
    x = s.shell.quadrature.points.copy()
    order = np.argsort(x[:, 1])
    x[order[5], 0] += 0.3
    neighbours = np.linalg.norm(np.diff(x[order], axis=0), axis=1)
    assert s.shell.spacing(x) == pytest.approx(neighbours.max(), rel=1e-14)


def test_figures_that_warnings_rest_on_by_numbers(caplog):
    rho, mu, dt, h, speed = 2.0, 0.1, 0.05, 1.0 / 6.0, 1.5
    fsi = sheet_in_flow((0.0, 0.0), rho=rho, mu=mu, dt=dt, options=CouplingOptions(penalty=7.0)).fsi
    fsi.lam[:] = np.linspace(-3.0, 1.0, len(fsi.lam))
    step = fsi.step()
    step.spacing, step.inactive = 0.05, 4
    figures = {
        name.partition(" (")[0].split("/")[0]: figure.value for name, figure in fsi.watch._figures(step, speed).items()
    }
    assert figures == pytest.approx(
        {
            "slip ratio lam dt": 3.0 * dt / (7.0 * h),
            "Courant number |u - u_mesh| dt": speed * dt / h,
            "point spacing": 0.05 / h,
            "fraction of points outside the fluid mesh": 4 / 17,
            "penalty": 7.0 / (mu / h + rho * h / dt),
        }
    )
    assert fsi.watch._rest(2.0, dt) == pytest.approx(SHARE_OF_LOAD * 2.0 / (rho * h / dt + mu / h))
    step.dt = 1e-5
    with caplog.at_level(logging.WARNING, logger="coudalfish"):
        fsi.watch._warn_of_small_step(step, speed)
    assert f"dt (|u|/h + nu/h^2) = {1e-5 * (speed / h + mu / rho / h**2):.3g}" in caplog.text


@pytest.mark.parametrize(("speed", "moved", "lam"), [(5.0, 0.5, 1.0), (0.2, 3.0, 1.0), (0.2, 0.5, 100.0)])
def test_slip_is_seen_beside_the_speed_of_the_flow_of_the_shell_or_that_a_load_would_make(
    speed, moved, lam, monkeypatch
):
    fsi = sheet_in_flow((0.0, 0.0), dt=0.05).fsi
    step, found = fsi.step(), []
    step._predict()
    step._place()
    step.lam = np.full_like(fsi.lam, lam)
    step.u, step.y_dot = np.zeros_like(step.n), np.tile([0.0, moved], (len(step.n), 1))
    monkeypatch.setattr(fsi.watch._slip, "add", lambda slip, n, W, scale: found.append(scale))
    fsi.watch._warn_of_slip(step, speed)
    assert found == [pytest.approx(max(speed, moved, fsi.watch._rest(lam, 0.05)))]


def test_the_slip_ratio_of_a_report_is_that_of_the_largest_multiplier():
    s = sheet_in_flow((0.0, 0.0), sheet_velocity=(0.5, 0.2))
    report = s.fsi.takeStep()
    assert np.ptp(np.abs(s.fsi.lam)) > 0.0
    largest = np.abs(s.fsi.lam).max()
    assert report.slip_ratio == pytest.approx(largest * 0.1 / (s.fsi.penalty / 6.0), rel=1e-13)


def test_the_size_of_a_graded_mesh_is_the_median_of_its_cells():
    """Seven thin columns of cells and two thick ones."""
    ticks = np.append(np.linspace(0.0, 0.07, 8), [0.5, 1.0])
    assert median_size(grid(COMM, [ticks, np.linspace(0.0, 1.0, 5)]).domain) == pytest.approx(0.01)


def test_the_spacing_along_directions_in_which_nothing_flows_does_not_count():
    s = sheet_in_flow((0.0, 0.0), solver=None)
    across = s.fluid.velocity_dofs[:, 1]
    np.testing.assert_array_equal(directions(across, s.fluid.velocity_dofs, COMM), [1.0, 0.0])
    np.testing.assert_array_equal(directions(across[1:], s.fluid.velocity_dofs, COMM), [1.0, 1.0])
    s.fsi.watch._directions = np.array([1.0, 0.0])
    s.fsi.takeStep()
    step, x = s.fsi.step(), s.shell.quadrature.points
    step._predict()
    step._place()
    assert step.spacing == pytest.approx(np.diff(np.sort(x[:, 0])).max(), rel=1e-3)


def test_a_cautious_attempt_takes_half_of_the_increments_of_the_shell():
    moved = []
    for cautious in (False, True):
        s = sheet_in_flow((0.0, 0.0), sheet_velocity=(0.5, -0.4), traction=0.5)
        step = s.fsi.step(cautious=cautious)
        step._predict()
        step._place()
        step._evaluate()
        step.shell_residual()
        before = s.y.x.array.copy()
        step.solve_shell(True)
        moved.append(s.y.x.array - before)
    assert np.abs(moved[0]).max() > 1e-3
    np.testing.assert_allclose(moved[1], 0.5 * moved[0], rtol=1e-9, atol=1e-14)


def test_a_small_shell_is_told_from_another_as_a_large_one_is():
    """By a millionth of its size or of its place, whatever the unit of length."""
    for length in (1e-4, 1e4):
        one, same, longer, elsewhere = (
            CoupledState(sheet_in_flow((0.0, 0.0), length=length, ends=((0.35, 0.25 + a), (0.45, 0.75 + b))).fsi)
            for a, b in ((0.0, 0.0), (0.0, 1e-11), (0.0, 1e-6), (1e-6, 1e-6))
        )
        record = one.record()
        same.check(record)
        for other in (longer, elsewhere):
            with pytest.raises(ValueError, match="another shape"):
                other.check(record)


def test_what_is_negligible_for_the_nodes_of_a_mesh_goes_with_its_unit_of_length():
    """As their forces do, which are stresses times lengths in the plane."""
    found = []
    for size in (1.0, 1e3):
        mesh = box(COMM, (0.0, 0.0), (size, size), (3, 3))
        sides = dict.fromkeys(("left", "right", "bottom", "top"), lambda x, t: 0.5 * t * ufl.as_vector([x[0] * 1, 0]))
        moving = ElasticMotion(mesh, sides, 0.1, generalized_alpha(0.5))
        moving.time.predict()
        moving.move()
        found.append(moving._atol())
    assert found[1] / found[0] == pytest.approx(1e3, rel=1e-6)
