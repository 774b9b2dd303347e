"""A residual that is assembled already is not assembled again, and nothing changes."""

import numpy as np
import pytest
from mpi4py import MPI
from mpi_runs import SAME_RUN
from scenes import sheet_in_flow

from coudalfish import CouplingOptions
from coudalfish.step import attempt
from coudalfish.step.known import Known

COMM = MPI.COMM_WORLD
OPTIONS = CouplingOptions.converged(block_rtol=1e-9, block_atol=1e-13)


class Anew(Known):
    """Computes whatever it is asked for."""

    def __call__(self, compute, *arrays):
        self._arrays = None
        return super().__call__(compute, *arrays)


@pytest.mark.mpi
def test_a_number_is_computed_again_only_where_an_array_has_changed():
    calls, x, y, known = [], np.zeros(3), np.ones(2), Known(COMM)

    def compute():
        calls.append(1)
        return float(len(calls))

    assert [known(compute, x, y), known(compute, x, y.copy())] == [1.0, 1.0]
    y[1] = 3.0  # the array itself, of which it has to keep a copy
    assert known(compute, x, y) == 2.0
    if COMM.rank:
        x[0] = 1.0  # on other ranks than the first one, which decides
    assert known(compute, x, y) == 2.0


@pytest.mark.mpi
def test_what_could_not_be_computed_is_not_known():
    known = Known(COMM)

    def fail():
        raise ValueError("no")

    assert known(lambda: 2.0, np.zeros(1)) == 2.0
    with pytest.raises(ValueError, match="no"):
        known(fail, np.ones(1))
    assert known(lambda: 3.0, np.zeros(1)) == 3.0


def steps(monkeypatch, kind, count=4):
    """Fields after some steps, and how often the shell's residual was assembled."""
    monkeypatch.setattr(attempt, "Known", kind)
    fsi = sheet_in_flow((0.0, 0.0), sheet_velocity=(0.5, 0.2), dt=0.05, n=8, options=OPTIONS).fsi
    assemblies, assemble = [], fsi.shell.assemble_residual
    monkeypatch.setattr(fsi.shell, "assemble_residual", lambda forces: assemblies.append(1) or assemble(forces))
    passes = sum(fsi.takeStep().passes for _ in range(count))
    return (
        fsi.shell.timeInt.x.x.array.copy(),
        fsi.fluid.timeInt.x.x.array.copy(),
        fsi.lam.copy(),
        passes,
        sum(assemblies),
    )


@pytest.mark.mpi
def test_the_shells_residual_is_assembled_once_a_state_and_nothing_else_changes(monkeypatch):
    *kept, passes, few = steps(monkeypatch, Known)
    *anew, same, many = steps(monkeypatch, Anew)
    assert passes == same
    for a, b in zip(kept, anew, strict=True):
        np.testing.assert_allclose(a, b, rtol=0.0, atol=SAME_RUN * np.abs(b).max())
    assert many - few == 2 * passes  # the one before a pass, and the one after it
