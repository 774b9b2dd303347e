"""Time steps by Courant numbers."""

from types import SimpleNamespace

import numpy as np
import pytest
from test_following_band import DATA, membrane, membrane_flow, square

from coudalfish.courant import AGAIN, CourantSteps
from coudalfish.step.watch import CLOSING_LIMIT
from tigar_x import compat


@pytest.mark.mpi
def test_numbers_are_those_of_the_fastest_cell_and_point():
    """The flow's by hand from its vertices; relative to the limits, and the same on all ranks."""
    fsi = membrane("plain")
    fsi.takeStep()
    flow, mesh = fsi.fluid, fsi.fluid.mesh
    corners = compat.cell_dofs(flow.velocity_space)
    speed = np.linalg.norm(flow.timeInt.x.x.array[flow.velocity_dofs], axis=1)
    rates = speed[corners].max(axis=1) / compat.shortest_edges(mesh)[: len(corners)]
    fastest = max(mesh.comm.allgather(float(rates.max())))
    found = CourantSteps(fsi, DATA.T, flow=4.0, shell=2.0).numbers(0.1)
    assert found["flow"] == pytest.approx(0.1 * fastest / 4.0)
    point = np.linalg.norm(fsi.shell.velocity(), axis=1).max()
    assert found["shell"] == pytest.approx(0.1 * point / (2.0 * flow.mesh_size))
    assert found["contact"] == 0.0


@pytest.mark.mpi
def test_the_flow_on_another_mesh_counts():
    fsi = membrane("plain")
    steps = CourantSteps(fsi, DATA.T)
    before = steps.numbers(1.0)["flow"]
    fsi.move_to(membrane_flow("plain", square(3), start=False))
    assert steps.numbers(1.0)["flow"] > 1.5 * before


class Clockwork:
    """A coupled problem whose speeds are given."""

    def __init__(self, closing=0.0):
        self.speed, self.closing = 1.0, closing
        self.timeInt_f = SimpleNamespace(time=0.0)
        self.fluid = SimpleNamespace(moving=None, mesh_size=1.0)
        self.shell = SimpleNamespace(
            velocity=lambda: np.array([[0.0, self.speed]]),
            closing_ratio=lambda: self.closing,
            timeInt=SimpleNamespace(step_size=1.0),
        )


@pytest.fixture
def clockwork(monkeypatch):
    monkeypatch.setattr(CourantSteps, "_flow_rate", lambda self: 0.0)
    return Clockwork()


def taken(fsi, steps, speeds):
    """Sizes of steps at these speeds one after the other."""
    sizes = []
    for fsi.speed in speeds:
        sizes.append(steps.size())
        fsi.timeInt_f.time += sizes[-1]
    return sizes


def test_steps_fall_at_once_and_grow_again_when_they_end_where_larger_ones_do(clockwork):
    steps = CourantSteps(clockwork, 1.0, halvings=2)
    assert taken(clockwork, steps, [0.9, 3.9, 3.9, 0.5, 0.5, 0.5, 0.5]) == [1.0, 0.25, 0.25, 0.5, 1.0, 1.0, 1.0]
    assert clockwork.timeInt_f.time == 5.0


def test_a_step_is_not_doubled_when_that_nearly_reaches_a_limit(clockwork):
    steps = CourantSteps(clockwork, 1.0)
    nearly = 0.5 * (1.0 + AGAIN)
    assert taken(clockwork, steps, [2.0, 2.0, nearly, nearly, 0.9 * AGAIN]) == [0.5, 0.5, 0.5, 0.5, 1.0]


def test_no_step_is_smaller_than_the_last_halving(clockwork):
    assert taken(clockwork, CourantSteps(clockwork, 1.0, halvings=1), [100.0] * 3) == [0.5] * 3


def test_points_that_may_touch_count(clockwork):
    clockwork.closing = 3.0 * CLOSING_LIMIT
    assert taken(clockwork, CourantSteps(clockwork, 1.0), [0.0]) == [0.25]


@pytest.mark.parametrize("wrong", [{"largest": 0.0}, {"flow": -1.0}, {"shell": 0.0}, {"halvings": -1}])
def test_numbers_out_of_range(wrong, clockwork):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        CourantSteps(clockwork, **{"largest": 1.0, **wrong})


def test_a_mesh_that_moves_is_refused(clockwork):
    clockwork.fluid.moving = object()
    with pytest.raises(ValueError, match="fixed mesh"):
        CourantSteps(clockwork, 1.0)
