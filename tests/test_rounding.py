"""Rounding in Newton's method: what ends a search that cannot succeed, and what is said of it."""

import re
import sys

import numpy as np
import pytest
from mpi4py import MPI
from petsc4py import PETSc
from test_newton import nonlinear_poisson
from test_solids import GRAVITY, SOFT, beam_flow, static_deflection, tip

from tigar_x.fem import rounding
from tigar_x.fem.linear import SolveError
from tigar_x.fem.schemes import backward_euler
from tigar_x.fem.solve import newton
from varmint.forms.solids import NeoHookeanSolid


@pytest.mark.mpi
def test_newton_says_that_rounding_keeps_it_from_the_tolerance():
    system, _ = nonlinear_poisson()
    with pytest.raises(SolveError, match=r"^Newton stagnates at a residual of .*Rounding is most of that") as caught:
        newton(system, rtol=1e-30, max_iterations=40)
    iterations = int(re.search(r"the last \d+ of (\d+) iterations", str(caught.value)).group(1))
    needed = len(newton(nonlinear_poisson()[0], rtol=1e-12).linear_iterations)
    assert needed < iterations <= needed + 3 + rounding.IDLE
    assert system.assemble_residual() < 1e-12 * nonlinear_poisson()[0].assemble_residual()


@pytest.mark.mpi
def test_what_stagnates_may_be_accepted():
    system, _ = nonlinear_poisson()
    limit = newton(nonlinear_poisson()[0], rtol=1e-12).norms[-1]
    report = newton(system, rtol=0.0, atol=1e-3 * limit, max_iterations=40, stalled=1e6)
    assert report.norms[-1] <= 1e3 * limit


def test_rounding_is_that_of_what_a_state_and_what_it_refers_to_meet_in_the_free_rows():
    """Rows of held unknowns are those of a unit matrix, in other units than the forces of the rest."""
    A = PETSc.Mat().createAIJ((2, 2), csr=([0, 1, 2], [0, 1], [1.0, 1e-6]), comm=MPI.COMM_SELF)
    x = PETSc.Vec().createWithArray(np.array([1e3, -2.0]), comm=MPI.COMM_SELF)
    held = np.array([0], dtype=np.int32)
    assert rounding.of_tangent(A, x, None, held) == pytest.approx(2e-6)
    assert rounding.of_tangent(A, x, np.array([7.0, 3.0]), held) == pytest.approx(5e-6)
    assert rounding.of_tangent(A, x, None, held[:0]) == pytest.approx(1e3)


FALLING = [10.0**-k for k in range(6)]


@pytest.mark.parametrize(
    ("norms", "lengths", "expected"),
    [
        ([*FALLING, *[2e-5] * 5], [*FALLING, *[1e-7] * 5], True),
        ([*FALLING, *[2e-5] * 4], [*FALLING, *[1e-7] * 4], False),  # not yet
        ([*FALLING, *[2e-5] * 5], [*FALLING, *[1e-3] * 5], False),  # goes round in circles
        ([*FALLING, 1e-3, 1e-2, 1e-1, 1.0, 1.0], [*FALLING, *[1e-2] * 5], False),  # a passing rise
        ([*FALLING, *[0.9e-5 * 0.8**k for k in range(5)]], [*FALLING, *[1e-7] * 5], False),  # slowly down
        ([1.0], [], False),
    ],
)
def test_what_counts_as_stagnation(norms, lengths, expected):
    assert rounding.stagnates(norms, lengths) == expected


@pytest.mark.mpi
@pytest.mark.parametrize("gravity", [1e-3, 1.5e-3, 1.9e-3])
@pytest.mark.parametrize("material", [SOFT, NeoHookeanSolid(100.0, 0.3, 1.0)], ids=["svk", "neo-hookean"])
def test_a_solid_comes_to_rest_under_any_load(material, gravity, monkeypatch):
    """Strains are rounded relative to one, so its stiffness limits the residual, however small load and motion are."""
    static = static_deflection(material)
    monkeypatch.setattr(sys.modules["test_solids"], "GRAVITY", gravity)
    flow = beam_flow(20.0, backward_euler(), material=material)
    for _ in range(8):
        flow.take_step()
    assert tip(flow.moving) == pytest.approx(gravity / GRAVITY * static, rel=1e-3)
