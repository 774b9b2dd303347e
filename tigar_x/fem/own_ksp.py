"""A KSP that a user has made, in the place of one that options describe."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from mpi4py import MPI
from petsc4py import PETSc

from tigar_x.fem.recipes import LinearSolver


def check_ranks(recipe: LinearSolver, A: PETSc.Mat) -> None:
    """Refuse a KSP of other ranks, which would never come back."""
    ksp: Any = recipe.ksp
    same = MPI.Comm.Compare(ksp.comm.tompi4py(), A.comm.tompi4py()) in (MPI.IDENT, MPI.CONGRUENT)
    if not same:
        raise ValueError(
            f"solver: the KSP of {recipe.name!r} lives on {ksp.comm.size} ranks, one on the communicator of the"
            f" matrix, of {A.comm.size}, is required"
        )


def hand_over(ksp: PETSc.KSP, A: PETSc.Mat) -> None:
    """Give a user's KSP the matrix; one that has served another matrix forgets it."""
    known = ksp.getOperators()[0]
    if known.handle != A.handle:
        if min(known.getSize()) >= 0:
            ksp.reset()
        ksp.setOperators(A)


@contextmanager
def tolerances_kept(ksp: PETSc.KSP) -> Iterator[None]:
    """Leave a KSP's tolerances as they were; a user's may serve elsewhere as well."""
    rtol, atol, *_ = ksp.getTolerances()
    try:
        yield
    finally:
        ksp.setTolerances(rtol=rtol, atol=atol)
