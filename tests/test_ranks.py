"""Ranks whose copies of the shell differ by rounding, or by a failure, take the same decisions."""

import time

import numpy as np
import pytest
from mpi4py import MPI
from scenes import sheet_in_flow
from test_coupled_contact import approaching

from coudalfish import CouplingOptions, StepError
from coudalfish.step.report import RejectedStepError
from tigar_x import ranks
from tigar_x.fem.linear import SolveError
from tigar_x.ranks import PATIENCE

COMM = MPI.COMM_WORLD
TIGHT = CouplingOptions(block_rtol=1e-11, block_atol=1e-13)  # residuals are decided on where rounding is in them
SCENES = {
    "sheet": (lambda: sheet_in_flow((0.0, 0.0), sheet_velocity=(0.5, 0.1), options=TIGHT), 6),
    "contact": (lambda: approaching(dt=0.02, options=TIGHT), 3),
}
needs_ranks = pytest.mark.skipif(COMM.size == 1, reason="one rank cannot differ from itself")


def drifting(scene, size):
    """All ranks but the first get a shell that is off by rounding after every solve, and residuals that are too."""
    if COMM.rank == 0:
        return scene
    rng, solve, residual = np.random.default_rng(COMM.rank), scene.shell.solve, scene.shell.assemble_residual

    def off_solve():
        solve()
        scene.y.x.array[:] += size * rng.standard_normal(len(scene.y.x.array))

    def off_residual(forces):
        return residual(forces) * (1.0 + size * rng.standard_normal())

    scene.shell.solve, scene.shell.assemble_residual = off_solve, off_residual
    return scene


def same_everywhere(value):
    return all(np.array_equal(other, value) for other in COMM.allgather(value))


@pytest.mark.mpi
@needs_ranks
@pytest.mark.parametrize("size", [2e-16, 1e-13])
@pytest.mark.parametrize("name", SCENES)
def test_ranks_that_differ_by_rounding_go_on_together(name, size):
    make, steps = SCENES[name]
    plain, scene = make(), drifting(make(), size)
    for _ in range(steps):
        plain.fsi.takeStep()
        report = scene.fsi.takeStep()
        assert all(other == report for other in COMM.allgather(report))
        assert same_everywhere(scene.fsi.lam)
        assert same_everywhere(scene.y.x.array)
    scale = np.abs(plain.y.x.array).max()
    np.testing.assert_allclose(scene.y.x.array, plain.y.x.array, rtol=0.0, atol=1e-7 * scale)


@pytest.mark.mpi
@needs_ranks
@pytest.mark.parametrize("rank", [0, 1])
@pytest.mark.parametrize("where", ["_share_of_extracted", "_share", "solve"])
def test_a_shell_that_fails_on_one_rank_fails_on_all(rank, where):
    scene = sheet_in_flow((0.0, 0.0), sheet_velocity=(0.5, 0.1))
    scene.fsi.takeStep()
    system = scene.shell.system
    owner = scene.shell if where == "solve" else system._part
    before, works = scene.y.x.array.copy(), getattr(owner, where)

    def fails(*_, **__):
        raise SolveError("on one rank")

    if COMM.rank == rank:
        setattr(owner, where, fails)
    with pytest.raises(StepError, match="failed in the shell block: on one rank"):
        scene.fsi.takeStep()
    np.testing.assert_array_equal(scene.y.x.array, before)
    setattr(owner, where, works)
    assert scene.fsi.takeStep().t == pytest.approx(0.2)


@pytest.mark.mpi
def test_a_failure_waits_for_slow_ranks():
    """Longer than other errors of one rank do before they end the run."""

    def compute():
        if COMM.rank == 0:
            raise SolveError("no")
        time.sleep(1.5 * PATIENCE)

    with pytest.raises(SolveError, match="no"):
        ranks.agreed(COMM, compute)


@pytest.mark.mpi
def test_what_is_agreed_is_that_of_the_first_rank():
    assert ranks.first(COMM, COMM.rank) == 0
    assert ranks.agreed(COMM, lambda: (COMM.rank, "found")) == (0, "found")
    here = np.full(3, float(COMM.rank))
    ranks.share(COMM, here)
    assert not here.any()


@pytest.mark.mpi
@pytest.mark.parametrize("error", [SolveError("no"), RejectedStepError("shell", "no"), MemoryError("no")])
def test_a_failure_of_the_last_rank_is_that_of_all(error):
    def compute():
        if COMM.rank == COMM.size - 1:
            raise error

    with pytest.raises(type(error), match="no"):
        ranks.agreed(COMM, compute)
    if isinstance(error, RejectedStepError):
        with pytest.raises(RejectedStepError) as caught:
            ranks.agreed(COMM, compute)
        assert caught.value.block == "shell"


@pytest.mark.mpi
@pytest.mark.parametrize("count", [1, 4, 7])
def test_the_median_of_all_ranks_is_that_of_their_values_together(count):
    rng = np.random.default_rng(COMM.rank)
    for values in (
        rng.random(count + COMM.rank),
        np.round(3.0 * rng.random(count)),
        rng.random(count if COMM.rank else 0),
    ):
        every = np.concatenate(COMM.allgather(values))
        if len(every):
            assert ranks.median(COMM, values) == np.median(every)


@pytest.mark.mpi
@needs_ranks
def test_a_sum_of_which_one_rank_fails_to_find_its_share_fails_on_all():
    assert (ranks.summed(COMM, 2, lambda: np.array([1.0, COMM.rank])) == [COMM.size, sum(range(COMM.size))]).all()

    def share():
        if COMM.rank == 1:
            raise SolveError("no")
        return np.ones(2)

    with pytest.raises(SolveError, match="no"):
        ranks.summed(COMM, 2, share)
