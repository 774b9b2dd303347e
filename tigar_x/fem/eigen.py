"""Symmetric eigenproblems ``K x = lambda M x``: vibration, and stability about a state.

Lanczos' method with shift and inversion, by SLEPc (Hernandez, Roman and Vidal, doi:10.1145/1089014.1089019) where it
can be imported, else by ARPACK on one rank. From one start vector it may miss copies of a multiple eigenvalue, such as
the paired modes of a square or round plate. Therefore what was found is deflated and the rest searched until nothing
nearer turns up. SLEPc takes options from PETSc's table by its own names, ``-eps_...`` and ``-st_...``.
"""

import importlib
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
import scipy.sparse as sp
import ufl
from dolfinx import fem
from numpy.typing import ArrayLike
from petsc4py import PETSc
from scipy.sparse.linalg import ArpackError, LinearOperator, eigsh, splu

from tigar_x import checks, compat
from tigar_x.compat import FloatArray
from tigar_x.fem.extracted import Extracted, extracted_matrix
from tigar_x.fem.linear import SolveError

_EPS = float(np.finfo(np.float64).eps)
_SAME = 1e-8  # relative difference of distances to the shift that may be rounding
_MARGIN = 1e4  # accepted residual over what the rounding of entries amounts to
_HINT = "K - shift M must be regular: a free body needs a negative shift"


@dataclass(frozen=True)
class Eigenpairs:
    """Solutions of ``K x = lambda M x``, by increasing eigenvalue.

    Attributes:
        values: eigenvalues, shape (count,); unit: that of K over that of M.
        vectors: this rank's share of the eigenvectors, shape (count, local size), with ``x . M x = 1``.
        residuals: ``|K x - lambda M x| / |M x|``, shape (count,); unit of the eigenvalues.
        functions: the eigenvectors as homogeneous fields of a spline; empty for plain matrices.
    """

    values: FloatArray
    vectors: FloatArray
    residuals: FloatArray
    functions: tuple[fem.Function, ...] = ()

    def __post_init__(self) -> None:
        checks.freeze(self)

    def __repr__(self) -> str:
        shown = ", ".join(f"{value:.6g}" for value in self.values[:6]) + (", ..." if len(self.values) > 6 else "")
        return f"Eigenpairs({len(self.values)} values: {shown})"


def eigenpairs(K: PETSc.Mat, M: PETSc.Mat, count: int, *, shift: float = 0.0, backend: str | None = None) -> Eigenpairs:
    """The eigenpairs nearest to a shift; with a shift below the spectrum, the smallest.

    Args:
        K: symmetric matrix; it may be singular or indefinite.
        M: symmetric positive definite matrix of the same layout.
        count: number of eigenpairs, less than the number of unknowns.
        shift: a number that is no eigenvalue. The matrix of a free body is singular and needs a negative one, about
            as large as its first eigenvalues that are not zero.
        backend: "slepc" or "scipy" (one rank); None: SLEPc when slepc4py can be imported.

    Returns:
        The eigenpairs.

    Raises:
        ValueError: an argument is out of range.
        SolveError: the iteration failed or gave residuals beyond rounding, ``K - shift M`` is singular, or several
            ranks would need SciPy.
    """
    n = K.getSize()[0]
    if checks.whole("count", count, 1) >= n:
        raise ValueError(f"count = {count}: a number below that of the unknowns, {n}, is required")
    checks.finite("shift", shift)
    with _backend(backend)(K, M, shift) as nearest:
        values, vectors = nearest(count, np.empty((0, K.getLocalSize()[0])))
        while True:
            value, vector = nearest(1, vectors)
            farthest = int(np.argmax(np.abs(values - shift)))
            nearer = np.abs(value[0] - shift) < (1.0 - _SAME) * np.abs(values[farthest] - shift)
            if not nearer:
                break
            values[farthest], vectors[farthest] = value[0], vector[0]
    order = np.argsort(values)
    return _verified(K, M, values[order], vectors[order])


def eigenmodes(
    space: Extracted,
    stiffness: ufl.Form,
    mass: ufl.Form,
    count: int,
    *,
    shift: float = 0.0,
    zero_dofs: ArrayLike | None = None,
    backend: str | None = None,
) -> Eigenpairs:
    """Eigenpairs of two forms on a spline, such as the modes and squared circular frequencies of a structure.

    Args:
        space: the extracted spline, for its ``V``, or another space on it.
        stiffness: symmetric bilinear form in ``space.V``, such as the derivative of a residual at its solution.
        mass: symmetric positive definite bilinear form.
        count: number of eigenpairs.
        shift: see :func:`eigenpairs`.
        zero_dofs: spline coefficients that vanish, which leave the problem; None: those of the space.
        backend: see :func:`eigenpairs`.

    Returns:
        The eigenpairs; vectors hold this rank's coefficients, zero dofs included: those of the columns of ``space.M``.

    Raises:
        ValueError: an argument is out of range.
        SolveError: see :func:`eigenpairs`.
    """
    checks.having("space", space, "V M zero_dofs", "an ExtractedSpline, or a space on one,")
    given = space.zero_dofs if zero_dofs is None else zero_dofs
    zero = checks.indices("zero_dofs", given, space.M.size[1]).ravel()
    first, last = space.M.getOwnershipRangeColumn()
    free = np.setdiff1d(np.arange(first, last, dtype=PETSc.IntType), zero)
    K, M = (extracted_matrix(space, form, free) for form in compat.compile_forms(stiffness, mass))
    try:
        pairs = eigenpairs(K, M, count, shift=shift, backend=backend)
    finally:
        _destroy(K, M)
    vectors = np.zeros((count, last - first))
    vectors[:, free - first] = pairs.vectors
    return replace(pairs, vectors=vectors, functions=_functions(space, vectors))


def _functions(space: Extracted, coefficients: FloatArray) -> tuple[fem.Function, ...]:
    """Fields with the given coefficients of this rank, one in every row."""
    modes = tuple(fem.Function(space.V, name=f"mode_{i}") for i in range(len(coefficients)))
    with _on_rows(space.M, coefficients) as rows:
        for u, row in zip(modes, rows, strict=True):
            space.M.mult(row, compat.petsc_vector(u))
            u.x.scatter_forward()
    return modes


def _destroy(*objects: Any) -> None:
    """Free what petsc4py may keep until the end."""
    for thing in objects:
        thing.destroy()


@contextmanager
def _on_rows(A: PETSc.Mat, array: FloatArray) -> Iterator[list[PETSc.Vec]]:
    """Vectors for A to act on, which share the memory of an array's rows."""
    size = (array.shape[1], PETSc.DECIDE)
    vectors = [PETSc.Vec().createWithArray(row, size=size, comm=A.comm) for row in array]
    try:
        yield vectors
    finally:
        _destroy(*vectors)


def _verified(K: PETSc.Mat, M: PETSc.Mat, values: FloatArray, vectors: FloatArray) -> Eigenpairs:
    """Eigenpairs, normalised, if their residuals are those of rounding."""
    residuals = np.empty_like(values)
    stiffness, mass = (A.norm(PETSc.NormType.NORM_INFINITY) for A in (K, M))
    with _on_rows(K, vectors) as rows, _on_rows(K, np.empty((2, vectors.shape[1]))) as (Kx, Mx):
        for i, (value, x) in enumerate(zip(values, rows, strict=True)):
            M.mult(x, Mx)
            square = x.dot(Mx)
            if not square > 0.0:
                raise SolveError(f"x . M x = {square:.3e}: a positive definite M is required")
            x.scale(1.0 / np.sqrt(square))
            M.mult(x, Mx)
            K.mult(x, Kx)
            Kx.axpy(-value, Mx)
            rounding = _EPS * (stiffness + abs(value) * mass) * x.norm()
            if not Kx.norm() <= _MARGIN * rounding:
                raise SolveError(f"eigenvalue {value:.6e}: residual {Kx.norm():.1e}, rounding {rounding:.1e}; {_HINT}")
            residuals[i] = Kx.norm() / Mx.norm()
    return Eigenpairs(values, vectors, residuals)


# -- Lanczos' method, by two libraries --------------------------------------------------------------------------------


class _Nearest(Protocol):
    """Eigenvalues nearest to the shift, and vectors in rows, M-orthogonal to the known ones."""

    def __call__(self, count: int, known: FloatArray) -> tuple[FloatArray, FloatArray]: ...


_Backend = Callable[[PETSc.Mat, PETSc.Mat, float], AbstractContextManager[_Nearest]]


def _backend(name: str | None) -> _Backend:
    checks.choice("backend", name, (None, "slepc", "scipy"))
    if name == "scipy":
        return _arpack
    try:
        importlib.import_module("slepc4py.SLEPc")
    except ImportError:
        if name == "slepc":
            raise
        return _arpack
    return _slepc


@contextmanager
def _slepc(K: PETSc.Mat, M: PETSc.Mat, shift: float) -> Iterator[_Nearest]:
    from slepc4py import SLEPc

    eps = SLEPc.EPS().create(K.comm)
    eps.setOperators(K, M)
    eps.setProblemType(SLEPc.EPS.ProblemType.GHEP)
    eps.setWhichEigenpairs(SLEPc.EPS.Which.TARGET_MAGNITUDE)
    eps.setTarget(shift)
    eps.setTolerances(tol=_EPS)
    transform = eps.getST()
    transform.setType(SLEPc.ST.Type.SINVERT)
    solver = transform.getKSP()
    solver.setType("preonly")
    solver.getPC().setType("lu")
    solver.getPC().setFactorSolverType("mumps")
    eps.setFromOptions()

    def nearest(count: int, known: FloatArray) -> tuple[FloatArray, FloatArray]:
        eps.setDimensions(count)
        vectors = np.empty((count, known.shape[1]))
        with _on_rows(K, known) as deflated, _on_rows(K, vectors) as rows:
            eps.setDeflationSpace(deflated)
            try:
                eps.solve()
            except (PETSc.Error, SystemError) as error:  # newer slepc4py wraps the former in the latter
                raise SolveError(f"SLEPc failed; {_HINT}: {error}") from error
            if eps.getConverged() < count:
                raise SolveError(f"SLEPc found {eps.getConverged()} of {count} eigenpairs ({eps.getConvergedReason()})")
            return np.array([eps.getEigenpair(i, row).real for i, row in enumerate(rows)]), vectors

    try:
        yield nearest
    finally:
        with suppress(PETSc.Error):  # after an error inside SLEPc, which is what has to be seen
            eps.destroy()


@contextmanager
def _arpack(K: PETSc.Mat, M: PETSc.Mat, shift: float) -> Iterator[_Nearest]:
    if K.comm.size > 1:
        raise SolveError(f"eigenproblems on {K.comm.size} ranks need slepc4py: SciPy works on one")
    stiffness, mass = (sp.csr_matrix(A.getValuesCSR()[::-1], shape=A.getSize()).tocsc() for A in (K, M))
    try:
        factors = splu(stiffness - shift * mass)
    except RuntimeError as error:
        raise SolveError(f"{error}; {_HINT}") from error

    def nearest(count: int, known: FloatArray) -> tuple[FloatArray, FloatArray]:
        dual = mass @ known.T

        def invert(b: FloatArray) -> FloatArray:
            x = factors.solve(b)
            return x - known.T @ (dual.T @ x)

        start = invert(np.random.default_rng(0).standard_normal(len(dual)))
        inverse = LinearOperator(stiffness.shape, matvec=invert, dtype=np.float64)
        try:
            values, vectors = eigsh(stiffness, count, mass, shift, OPinv=inverse, v0=start)
        except ArpackError as error:
            raise SolveError(f"ARPACK failed: {error}") from error
        return values, np.ascontiguousarray(vectors.T)

    yield nearest
