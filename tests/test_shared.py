"""Systems on splines that several ranks hold whole, and of which each integrates and extracts a part."""

from types import SimpleNamespace

import numpy as np
import pytest
import scipy.sparse as sp
from mpi4py import MPI
from scenes import sheet_in_flow
from test_contact_system import GAP, beams

COMM = MPI.COMM_WORLD
pytestmark = pytest.mark.mpi
several = pytest.mark.skipif(COMM.size == 1, reason="one rank has nothing to share")


def states():
    """Two beams in contact, one system whole and one shared, and displacements that push one against the other."""
    whole, shared = beams(1e-3), beams(1e-3)
    shared[2].share(COMM)
    rng = np.random.default_rng(0)
    n = whole[0].geometry.n
    for push in (0.0, 0.5, 0.7):
        U = 1e-3 * rng.standard_normal((n, 2))
        U[n // 2 :, 1] -= push * GAP
        for spline, y, _, stepper in (whole, shared):
            y.x.array[:] = spline.function(U).x.array
            stepper.t.value = 0.3
        yield whole[2], shared[2], rng.standard_normal((len(whole[0].node_weights), 2))


def csr(A):
    return sp.csr_matrix(A.getValuesCSR()[::-1], shape=A.size)


def near(value, expected, tolerance=1e-12):
    np.testing.assert_allclose(value, expected, rtol=0.0, atol=tolerance * np.abs(expected).max(initial=1e-300))


def contact(found):
    return [found.energy, found.pairs, found.load, found.coincident, min(found.distance, 9.0)]


def test_parts_sum_to_the_system_with_contact():
    touched = 0
    for whole, shared, values in states():
        for system in (whole, shared):
            system.assemble_residual(values)
            system.assemble_tangent(np.abs(values))
        near(shared.b.array_r, whole.b.array_r)
        assert abs(csr(shared.A) - csr(whole.A)).max() < 1e-12 * abs(csr(whole.A)).max()
        near(contact(shared.forces), contact(whole.forces))
        near(shared.forces.forces, whole.forces.forces)
        assert shared.product_norm(values) == pytest.approx(whole.product_norm(values), rel=1e-12)
        near(shared.solve().array_r, whole.solve().array_r, 1e-9)
        touched += whole.forces.pairs
        for system in (whole, shared):
            system.renew_contact()
        assert abs(csr(shared.A) - csr(whole.A)).max() < 1e-12 * abs(csr(whole.A)).max()
        x, speeds = whole.positions(), values - values.mean(axis=0)
        assert shared.contact.closing_speed(x, speeds, 0.01) == whole.contact.closing_speed(x, speeds, 0.01)
    assert touched > 10


@several
def test_ranks_get_the_same_to_the_last_digit_and_integrate_less():
    for whole, shared, values in states():
        whole.assemble_residual(values)
        shared.assemble_residual(values)
        shared.assemble_tangent(np.abs(values))
        found = shared.b.array_r.copy(), csr(shared.A).data, shared.solve().array_r.copy()
        for arrays in COMM.allgather(found):
            assert all(np.array_equal(one, other) for one, other in zip(arrays, found, strict=True))
        pairs, every = len(shared.contact._interacting.pairs), len(whole.contact._interacting.pairs)
        assert COMM.allreduce(pairs) == every
        assert pairs < max(1, every)


@several
def test_residuals_are_extracted_by_parts():
    """No rank extracts all of them, nor those of other elements' points."""
    whole, shared, values = next(states())
    shared.space = SimpleNamespace(V=shared.space.V, rows=shared.space.rows)
    for system in (whole, shared):
        system.assemble_residual(values)
    near(shared.b.array_r, whole.b.array_r)
    part, rows = shared._part, whole.space.rows
    assert max(COMM.allgather(part._M.size[0])) < 0.8 * rows.shape[0]
    assert COMM.allreduce(len(part._mine)) == rows.shape[0]  # points on the border of parts are loaded once


def test_a_coupled_shell_is_shared_by_the_ranks_of_the_flow():
    fsi = sheet_in_flow().fsi
    assert fsi.shell.system.is_shared == (COMM.size > 1)


def test_what_is_shared_is_solved_by_its_factors_on_any_number_of_ranks():
    for whole, shared, values in states():
        for system in (whole, shared):
            system.assemble_residual(values)
            system.assemble_tangent(np.abs(values))
            system.solve()
        assert whole._factors is None
        assert shared._factors is not None


@several
def test_what_others_ask_of_the_contact_is_theirs_alone():
    """Rank 0 may look at the energy of a shell that is coupled, and the others need not."""
    system = beams(1e-3)[2]
    contact = system.contact
    system.share(COMM)
    assert contact is not system.contact
    if COMM.rank == 0:
        contact.evaluate(system.positions(), tangent=False)
