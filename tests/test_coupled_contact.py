"""Contact between shells in a coupled step."""

import logging
import math
from contextlib import suppress

import numpy as np
import pytest
import scipy.sparse as sp
from scenes import sheet_in_flow

from coudalfish import CouplingOptions, StepError
from shnapr.contact import LinearKernel, SelfContact

R_MAX, STIFFNESS = 0.06, 1e7
TWO = (((0.4, 0.2), (0.4, 0.8)), ((0.6, 0.2), (0.6, 0.8)))
APPROACHING = ((1.0, 0.0), (-1.0, 0.0))


def contact(stiffness=STIFFNESS, r_max=R_MAX):
    return lambda quadrature: SelfContact(quadrature, LinearKernel(r_max, stiffness), 1.2 * r_max)


DEFAULT = contact()


def approaching(*, dt=0.005, contact=DEFAULT, speed=1.0, **settings):
    """Two heavy parallel sheets in a fluid at rest that run into each other."""
    settings = {"n": 8, "rho_s": 1000.0, "mu": 0.01, "density_of_points": 24, "rho_infinity": 0.5} | settings
    velocity = speed * np.array(APPROACHING)
    return sheet_in_flow((0.0, 0.0), ends=TWO, sheet_velocity=velocity, dt=dt, contact=contact, **settings)


def gap(scene):
    """Smallest distance of the two sheets at the last accepted state."""
    x = scene.fsi.shell.quadrature.points + scene.fsi.spline_sh.nodal(scene.fsi.timeInt_sh.x_old)
    first = scene.fsi.shell.quadrature.points[:, 0] < 0.5
    return x[~first, 0].min() - x[first, 0].max()


def run(scene, steps):
    reports, gaps = [], []
    for _ in range(steps):
        reports.append(scene.fsi.takeStep())
        gaps.append(gap(scene))
    return reports, np.array(gaps)


def test_contact_keeps_sheets_apart_that_would_cross_without_it():
    with_contact, without = approaching(), approaching(contact=None)
    reports, gaps = run(with_contact, 40)
    assert gaps.min() > 0.2 * R_MAX
    assert gaps[-1] > gaps.min()  # they part again
    touching = [report.contact for report in reports if report.contact.pairs]
    assert touching
    assert all(c.load > 0.0 and c.energy > 0.0 and 0.0 < c.distance < R_MAX for c in touching)
    _, free = run(without, 40)
    assert free.min() < 0.0


def test_a_shell_without_contact_has_no_object_for_it():
    scene = approaching(contact=None)
    assert scene.fsi.contactContext_sh is None
    assert scene.fsi.takeStep().contact is None


def test_contact_is_the_coupler_s_contact_context():
    scene = approaching()
    assert scene.fsi.contactContext_sh is scene.fsi.shell.contact
    report = scene.fsi.takeStep()
    assert report.contact.pairs == 0
    assert report.contact.load == 0.0
    assert report.contact.distance == math.inf


def test_mirrored_sheets_stay_mirrored():
    scene = approaching(options=CouplingOptions(block_rtol=1e-8))
    run(scene, 24)
    y = scene.fsi.spline_sh.nodal(scene.fsi.timeInt_sh.x_old)
    X = scene.fsi.shell.quadrature.points
    # the fluid's mesh has diagonals of one direction alone: rotation by half a turn maps it to itself
    rotated = np.lexsort((np.round(1.0 - X[:, 1], 9), np.round(1.0 - X[:, 0], 9)))
    order = np.lexsort((np.round(X[:, 1], 9), np.round(X[:, 0], 9)))
    np.testing.assert_allclose(y[rotated], -y[order], atol=2e-3 * np.abs(y).max())


def test_contact_is_taken_at_the_level_of_the_equations():
    """The tangent of contact in the coupled step is the slope of its forces with alpha_f = 2/3 in it."""
    scene = approaching()
    while not (found := scene.fsi.takeStep().contact).pairs:
        pass
    shell, time = scene.fsi.shell, scene.fsi.timeInt_sh
    of_last_residual = shell.touching
    assert (found.load, found.energy, found.distance) == (
        of_last_residual.load,
        of_last_residual.energy,
        of_last_residual.distance,
    )
    time.predict()
    zero, W = np.zeros_like(shell.quadrature.points), np.zeros(len(shell.quadrature.points))
    shell.assemble_residual(zero)
    assert shell.touching is not None
    shell.assemble_tangent(W, 1.0)
    A = sp.csr_matrix(shell.system.A.getValuesCSR()[::-1], shape=shell.system.A.size)
    direction = np.random.default_rng(7).normal(size=A.shape[0])
    step = 1e-7 * R_MAX
    U = scene.fsi.spline_sh.vector.coefficients(time.x)
    values = []
    for sign in (1.0, -1.0):
        moved = scene.fsi.spline_sh.function(U + sign * step * direction.reshape(-1, 2))
        time.x.x.array[:] = moved.x.array
        shell.assemble_residual(zero)
        values.append(shell.system.b.array_r.copy())
    slope = (values[0] - values[1]) / (2.0 * step)
    np.testing.assert_allclose(A @ direction, slope, rtol=1e-5, atol=1e-6 * np.abs(slope).max())


def test_contact_of_a_rational_shell_is_between_its_points():
    scene = approaching(weights=lambda n: 1.0 + 0.6 * np.sin(np.arange(n)))
    shell = scene.fsi.shell
    shell.timeInt.predict()
    assert np.ptp(shell.quadrature.rational) > 0.3
    moved = shell.system.positions() - shell.quadrature.points
    level = 2 / 3 * 0.005 * np.where(shell.quadrature.points[:, :1] < 0.5, 1.0, -1.0) * [1.0, 0.0]
    np.testing.assert_allclose(moved, level, atol=1e-15)


def test_fast_approach_is_warned_of(caplog):
    scene = approaching(dt=0.02)
    with caplog.at_level(logging.WARNING):
        report = scene.fsi.takeStep()
        assert "of the range of contact in a step" not in caplog.text  # they are still too far apart
        while report.contact.closing_ratio < 0.1:
            report = scene.fsi.takeStep()
    assert report.contact.closing_ratio == pytest.approx(2.0 * 0.02 / R_MAX, rel=0.3)
    assert "of the range of contact in a step" in caplog.text
    assert "reduce dt" in caplog.text


def test_slow_approach_is_not_warned_of(caplog):
    scene = approaching(dt=0.005)
    with caplog.at_level(logging.WARNING):
        run(scene, 20)
    assert "of the range of contact in a step" not in caplog.text


def test_points_that_are_too_far_apart_for_contact_are_warned_of(caplog):
    scene = approaching(density_of_points=8, n=4)
    with caplog.at_level(logging.WARNING):
        scene.fsi.takeStep()
    assert "times the range of contact apart" in caplog.text
    assert "raise r_max" in caplog.text


def test_a_failed_step_in_contact_leaves_the_last_good_state():
    scene = approaching(options=CouplingOptions(max_passes=1, block_rtol=1e-14, block_atol=0.0, second_attempt=False))
    fsi = scene.fsi
    fsi.options = CouplingOptions()
    while not fsi.takeStep().contact.pairs:
        pass
    fsi.options = CouplingOptions(max_passes=1, block_rtol=1e-14, block_atol=0.0, second_attempt=False)
    before = [f.x.array.copy() for f in (fsi.timeInt_f.x, fsi.timeInt_sh.x)], fsi.lam.copy(), fsi.timeInt_sh.time
    with pytest.raises(StepError) as caught:
        fsi.takeStep()
    assert ("pairs touch" in caught.value.suspect) == (caught.value.block == "shell")
    for f, value in zip((fsi.timeInt_f.x, fsi.timeInt_sh.x), before[0], strict=True):
        np.testing.assert_array_equal(f.x.array, value)
    np.testing.assert_array_equal(fsi.lam, before[1])
    assert fsi.timeInt_sh.time == before[2]
    fsi.options = CouplingOptions()
    fsi.takeStep()


def test_a_shell_that_fails_in_contact_says_so(monkeypatch):
    scene = approaching()
    fsi = scene.fsi
    while not fsi.takeStep().contact.pairs:
        pass
    monkeypatch.setattr(fsi.shell, "solve", lambda: None)  # the shell's residual never falls
    fsi.options = CouplingOptions(max_passes=3, second_attempt=False)
    with pytest.raises(StepError) as caught:
        fsi.takeStep()
    assert caught.value.block == "shell"
    assert "pairs touch: reduce dt or smooth the kernel of contact" in caught.value.suspect


@pytest.mark.parametrize("stiffness", [1e2, 1e5, 1e9, 1e12])
def test_any_stiffness_of_contact_is_finite(stiffness):
    """Each step converges, or stops with a diagnosis; what is accepted is finite."""
    scene = approaching(contact=contact(stiffness))
    with suppress(StepError):
        run(scene, 30)
    assert np.isfinite(scene.fsi.timeInt_sh.x_old.x.array).all()
    assert np.isfinite(scene.fsi.timeInt_f.x_old.x.array).all()
    assert np.isfinite(scene.fsi.lam).all()
