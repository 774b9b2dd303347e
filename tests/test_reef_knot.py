"""The reef knot: is it one, is nothing in touch at first, and does everything balance when it is?"""

from functools import cache

import numpy as np
import pytest
from load import load_demo
from scipy.spatial import cKDTree

from shnapr.problems.knots import Crossings, joined
from shnapr.problems.reef_knot import CENTRE, CONTACT, SQUARE_KNOT, Knot
from shnapr.shell import ShellError, dynamics
from tigar_x.fem.linear import SolveError

demo = load_demo("reef_knot")
DT = 1e-3


@cache
def knot():
    return Knot(3, DT)


@pytest.fixture
def scene():
    """The scene before its first step; forms and factors are shared."""
    scene = knot()
    time = scene.time
    for f in (scene.shell.y, time.x_old, time.xdot_old, time.xddot_old):
        f.x.array[:] = 0.0
    time._t_n, time.step_size = 0.0, DT
    scene.begin()
    return scene


def word(crossings, polygon_points):
    """The polygon's passages from its start to a vertex: U for under, O for over."""
    passages = [(p, "U") for p in crossings.under] + [(p, "O") for p in crossings.over]
    return "".join(letter for place, letter in sorted(passages) if place < polygon_points)


def test_it_is_a_reef_knot_and_no_other(scene):
    first, second = scene.centre_lines()
    crossings = scene.crossings()
    # over the bight, under a strand, over both strands, under, over: both ends on one side of the other's bight
    assert word(crossings, len(first)) == "OUOOUO"
    assert (len(crossings.under), crossings.writhe, crossings.determinant) == (6, 0, SQUARE_KNOT)
    # its lower half turned over makes a granny knot, and one ribbon on top of the other no knot
    half = (1.0, 1.0, -1.0)
    granny = Crossings.of(joined(*(np.where(x[:, 1:2] < 0, x * half, x) for x in (first, second))))
    assert (abs(granny.writhe), granny.determinant) == (6, SQUARE_KNOT)
    loose = Crossings.of(joined(first + np.array([0, 0, 5]), second))
    assert (len(loose.under), loose.determinant) == (6, 1)


def test_the_ribbons_are_images_of_each_other(scene):
    first, second = (patch.points - (CENTRE, 0.0, 0.0) for patch in scene.shell.spline.geometry.patches)
    n = scene.shell.spline.geometry.patches[0].bases[0].n

    def rows(points):
        return points.reshape(-1, n, 3)

    np.testing.assert_allclose(rows(second * (-1.0, 1.0, -1.0))[::-1], rows(first), atol=1e-12)
    # each is its own mirror image
    np.testing.assert_allclose(rows(first * (1.0, -1.0, 1.0))[:, ::-1], rows(first), atol=1e-9)


def test_nothing_touches_at_first(scene):
    X = scene.shell.positions
    between = cKDTree(X[scene.first]).query(X[~scene.first])[0].min()
    assert between > CONTACT.r_self  # so that all pairs of points of different ribbons take part
    upper, lower = (X[scene.first & (side * X[:, 1] > 0.3)] for side in (1, -1))
    assert cKDTree(upper).query(lower)[0].min() > CONTACT.r_self
    assert scene.shell.contact.evaluate(X, tangent=False).pairs == 0
    assert scene.piercings() == 0
    assert scene.spacing_ratio < 0.75
    assert scene.quadrature.weights.sum() == pytest.approx(2 * 0.5 * 27.5, rel=0.05)


def test_supports_and_load(scene):
    points, zero = scene.shell.spline.geometry.points, set(scene.shell.spline.zero_dofs)
    held, pulled = points[:, 0] < -6.0, points[:, 0] > 10.0
    assert held.any()
    assert pulled.any()
    expected = {3 * i + c for i in np.flatnonzero(held) for c in (0, 1, 2)}
    assert zero == expected | {3 * i + c for i in np.flatnonzero(pulled) for c in (1, 2)}
    X = scene.quadrature.points
    area = scene.quadrature.weights[X[:, 0] > 10.0].sum()
    np.testing.assert_allclose(scene.force, [1e3 * 0.004 * area, 0, 0], rtol=0.1, atol=1e-12)
    assert np.abs(scene._load[X[:, 0] < 9.0]).max() == 0.0


def pushed_together(scene, speed=15.0):
    """The second ribbon nearly touches the first and moves towards it."""
    functions = scene.shell.spline.geometry.patches[0].n
    shift = np.zeros((2 * functions, 3))
    shift[functions:, 0] = 1.0
    first, second = scene.shell.positions[scene.first], scene.shell.positions[~scene.first]
    steps = np.linspace(0.0, 2.0, 401)
    gaps = np.array([cKDTree(first).query(second + np.array([s, 0, 0]))[0].min() for s in steps])
    nearest = steps[np.argmax(gaps < 1.03 * CONTACT.kernel.r_max)]
    for f, factor in ((scene.shell.y, nearest), (scene.time.x_old, nearest), (scene.time.xdot_old, speed)):
        f.x.array[:] = (scene.shell.spline.vector.nodes @ (factor * shift)).ravel()
    return nearest


def test_everything_balances_in_contact(scene):
    assert pushed_together(scene) < 2.0
    scene.begin()
    start, before = scene.energies(), scene.momentum()
    scene.time.step_size = 0.5 * DT
    scene.run(steps=8, show=False).through()
    ledger = scene.ledger
    assert scene.time.time == pytest.approx(4 * DT)
    assert ledger.substeps >= 8
    assert ledger.pairs > 2
    assert scene.row["contact"] > 0.0
    # contact neither pushes nor turns the whole, and momentum changes by forces alone
    assert ledger.contact_force < 1e-12
    assert ledger.contact_torque < 1e-10
    assert ledger.force_imbalance < 1e-5
    # it is the contact that sets the held ribbon in motion
    velocity = scene.shell.spline.nodal(scene.time.xdot_old)
    momentum = 0.004 * scene.quadrature.weights[scene.first] @ velocity[scene.first]
    assert momentum[0] > 1e-4
    assert scene.momentum()[0] < before[0] + scene.force[0] * scene.time.time
    # energy: what there was and what the load did, less damping and what backward Euler took
    end = scene.energies().sum()
    np.testing.assert_allclose(end, start.sum() + ledger.work - ledger.damping + ledger.gained, rtol=1e-10)
    assert ledger.gained < 0.0
    assert ledger.largest_gain < 0.0
    # no way through
    assert 0.5 * CONTACT.kernel.r_max < ledger.distance < CONTACT.kernel.r_max
    assert 2 * ledger.motion < 1.0
    assert scene.piercings() == 0
    assert scene.crossings().determinant == SQUARE_KNOT


def test_ribbons_that_went_through_each_other_are_found(scene):
    nearest = pushed_together(scene)
    assert scene.piercings() == 0
    move = (scene.shell.y.x.array / nearest).copy()
    scene.shell.y.x.array[:] = (nearest + 0.4) * move
    assert scene.piercings() > 0
    scene.shell.y.x.array[:] = 8.0 * move
    assert scene.crossings().determinant == 1


def failing(monkeypatch, times):
    """Newton's method fails so many times."""
    attempts = []
    real = dynamics.newton

    def newton(*arguments, **options):
        attempts.append(knot().time.step_size)
        if len(attempts) <= times:
            knot().shell.y.x.array[:] += 1.0
            raise SolveError("on purpose")
        return real(*arguments, **options)

    monkeypatch.setattr(dynamics, "newton", newton)
    return attempts


def test_steps_that_fail_are_cut(scene, monkeypatch):
    attempts = failing(monkeypatch, 2)
    scene.run(steps=1, show=False).through()
    np.testing.assert_allclose(attempts, np.array([1, 1 / 2, 1 / 4, 1 / 4, 1 / 4, 1 / 4]) * DT)
    assert scene.time.time == pytest.approx(DT)
    assert (scene.ledger.failures, scene.ledger.substeps) == (2, 4)
    assert scene.ledger.force_imbalance < 1e-5


def test_a_step_that_always_fails_is_an_error(scene, monkeypatch):
    attempts = failing(monkeypatch, 100)
    with pytest.raises(ShellError, match="on purpose"):
        scene.run(steps=1, show=False).through()
    assert len(attempts) == 8
    assert not scene.shell.y.x.array.any()
    assert scene.time.time == 0.0


@pytest.mark.parametrize(
    ("option", "value"), [("dt_factor", 0.0), ("steps", 0), ("resolution", 0), ("pictures", 0), ("steps", 1.5)]
)
def test_bad_input_is_named_before_computing(option, value, tmp_path):
    with pytest.raises(ValueError, match=f"{option} = {value}"):
        demo.main(**({"steps": 1} | {option: value}), out=tmp_path)
    assert not list(tmp_path.iterdir())
