"""Eigenproblems on splines against closed forms, dense algebra and each other's libraries."""

import sys
from contextlib import contextmanager

import numpy as np
import pytest
import scipy.linalg
import scipy.sparse as sp
import ufl
from mpi4py import MPI
from dolfinx import fem
from petsc4py import PETSc
from splines import integral, quarter

from shnapr.loads import inertia
from shnapr.svk import StVenantKirchhoff
from shnapr.work import strain_energy, virtual_work
from tigar_x.fem import eigen
from tigar_x.fem.eigen import eigenmodes, eigenpairs
from tigar_x.fem.linear import SolveError
from tigar_x.geometry import shapes
from tigar_x.splines.spline import ExtractedSpline
from tigar_x.splines.spline_system import SplineSystem


def slepc():
    """Whether slepc4py is there."""
    try:
        import slepc4py.SLEPc  # noqa: F401
    except ImportError:
        return False
    return True


BACKENDS = ["scipy", pytest.param("slepc", marks=pytest.mark.skipif(not slepc(), reason="no slepc4py"))]
L = 1.5  # length of the string
ENDS = ((1.0, -2.0), (1.0 + 0.8 * L, -2.0 + 0.6 * L))


def fixed_string(degree, elements, *, comm=MPI.COMM_SELF, size=1):
    """Displacement of a string of unit tension and density between fixed ends: forms and their space."""
    patch = shapes.line(*ENDS, elements=elements, degree=degree)
    spline = ExtractedSpline(patch, comm)
    ends = np.concatenate([patch.side("u0"), patch.side("u1")])
    space = spline.space(size, zero_dofs=(size * ends[:, None] + np.arange(size)).ravel())
    u, v = ufl.TrialFunction(space.V), ufl.TestFunction(space.V)
    return spline, space, ufl.inner(spline.grad(u), spline.grad(v)) * spline.dx, ufl.inner(u, v) * spline.dx


def exact_string(count):
    return (np.arange(1, count + 1) * np.pi / L) ** 2


def petsc(A):
    A = sp.csr_matrix(A)
    return PETSc.Mat().createAIJ(A.shape, csr=(A.indptr, A.indices, A.data), comm=PETSc.COMM_SELF)


def chain(n, copies=1):
    """Masses between springs, each coordinate in several copies."""
    K = sp.diags([-1.0, 2.0, -1.0], [-1, 0, 1], shape=(n, n))
    M = sp.diags([1.0, 4.0, 1.0], [-1, 0, 1], shape=(n, n)) / 6.0
    return (sp.kron(A, sp.identity(copies), format="csr") for A in (K, M))


# -- closed forms -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_eigenvalues_of_a_string_converge_with_twice_the_degree(degree):
    mode, errors, sibling = 3, [], []
    for elements in (8, 16, 32):
        values = eigenmodes(*fixed_string(degree, elements)[1:], 4).values
        assert (values > exact_string(4) * (1 - 1e-11)).all()  # those of Galerkin's method are too large
        errors.append(values[mode - 1] / exact_string(4)[mode - 1] - 1)
        sibling.append(values[mode - 1] / ((mode - 0.5) * np.pi / L) ** 2 - 1)  # a string with one free end
    assert np.log2(errors[-2] / errors[-1]) == pytest.approx(2 * degree, abs=0.2)
    assert errors[-1] < {1: 8e-3, 2: 1.2e-5, 3: 3e-8}[degree]
    assert np.log2(sibling[-2] / sibling[-1]) < 0.1


@pytest.mark.mpi
def test_a_distributed_string():
    if MPI.COMM_WORLD.size > 1 and not slepc():
        pytest.skip("no slepc4py")
    spline, space, k, m = fixed_string(3, 24, comm=MPI.COMM_WORLD, size=2)
    pairs = eigenmodes(space, k, m, 5, shift=-1.0)
    np.testing.assert_allclose(pairs.values, np.repeat(exact_string(3), 2)[:5], rtol=1e-6)
    first, last = space.M.getOwnershipRangeColumn()
    assert pairs.vectors.shape == (5, last - first)
    zero = [i - first for i in space.zero_dofs if first <= i < last]
    assert not pairs.vectors[:, zero].any()
    for value, u in zip(pairs.values, pairs.functions, strict=True):
        assert integral(ufl.inner(u, u) * spline.dx) == pytest.approx(1.0, rel=1e-10)
        assert integral(ufl.inner(spline.grad(u), spline.grad(u)) * spline.dx) == pytest.approx(value, rel=1e-8)


def test_modes_of_a_string_are_sines():
    spline, space, k, m = fixed_string(3, 16)
    modes = eigenmodes(space, k, m, 3).functions
    s = np.linalg.norm(spline.node_positions - ENDS[0], axis=1)
    for j, u in enumerate(modes, start=1):
        sine = np.sqrt(2 / L) * np.sin(j * np.pi * s / L)
        np.testing.assert_allclose(u.x.array * np.sign(u.x.array @ sine), sine, atol=4e-4)


def test_modes_of_a_rational_arc():
    """A string along a quarter of the unit circle, with homogeneous fields."""
    patch = quarter()
    spline = ExtractedSpline(patch, MPI.COMM_SELF)
    space = spline.space(1, zero_dofs=[0, patch.basis.n - 1])
    u, v = (spline.rationalize(f(space.V)) for f in (ufl.TrialFunction, ufl.TestFunction))
    k, m = ufl.inner(spline.grad(u), spline.grad(v)) * spline.dx, ufl.inner(u, v) * spline.dx
    np.testing.assert_allclose(eigenmodes(space, k, m, 1).values, 4.0, rtol=5e-3)


def test_a_column_buckles():
    """The fourth and the second derivative: (j pi)^4 - P (j pi)^2 between simple supports, negative beyond P = pi^2."""
    patch = shapes.line((0, 0), (0, 1), elements=16, degree=3)
    spline = ExtractedSpline(patch, MPI.COMM_SELF)
    space = spline.space(1, zero_dofs=[0, patch.basis.n - 1])
    w, v, P = ufl.TrialFunction(space.V), ufl.TestFunction(space.V), fem.Constant(spline.mesh, 0.0)
    grad = spline.grad
    k = (ufl.inner(grad(grad(w)), grad(grad(v))) - P * ufl.inner(grad(w), grad(v))) * spline.dx
    j = np.pi * np.arange(1, 4)
    for load in (0.0, 0.9, 1.1, 2.0):
        P.value = load * np.pi**2
        values = eigenmodes(space, k, w * v * spline.dx, 3, shift=-2 * np.pi**4).values
        np.testing.assert_allclose(values, j**4 - P.value * j**2, rtol=5e-4)
        assert (values[0] < 0) == (load > 1)


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_free_beam(backend):
    """A plane Kirchhoff-Love beam in the air: three rigid motions, then lambda ~ b^4 with cosh(b) cos(b) = 1."""
    h, E, rho = 1e-2, 3.0e4, 2.0
    spline = ExtractedSpline(shapes.line((0, 0), (0.6, 0.8), elements=12, degree=3), MPI.COMM_SELF)
    y, z, u = spline.function(), ufl.TestFunction(spline.V), ufl.TrialFunction(spline.V)
    material = StVenantKirchhoff(E, 0.3, h)
    k = ufl.derivative(virtual_work(spline, lambda f: strain_energy(spline, material, f), y, z), y, u)
    m = inertia(spline, u, z, density=rho, thickness=h)
    unit = E / (1 - 0.3**2) * h**3 / 12 / (rho * h)
    values = eigenmodes(spline, k, m, 5, shift=-100 * unit, backend=backend).values / unit
    np.testing.assert_allclose(values[:3], 0.0, atol=1e-5)
    np.testing.assert_allclose(values[3:] ** 0.25, (4.7300407, 7.8532046), rtol=1e-4)


# -- algebra ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("shift", [-1.0, 0.0, 70.0])
def test_pairs_nearest_to_the_shift_are_those_of_dense_algebra(backend, shift):
    """On the free block of what a SplineSystem extracts, which puts unit eigenvalues at the zero dofs."""
    spline, space, k, m = fixed_string(2, 9, size=2)
    dense = []
    for form in (k, m):
        system = SplineSystem(space, ufl.inner(spline.F, ufl.TestFunction(space.V)) * spline.dx, form)
        system.assemble_tangent()
        n = range(system.A.getSize()[0])
        free = np.setdiff1d(n, space.zero_dofs)
        dense.append(system.A.getValues(n, n)[np.ix_(free, free)])
    K, M = dense
    every = scipy.linalg.eigh(K, M, eigvals_only=True)
    pairs = eigenmodes(space, k, m, 6, shift=shift, backend=backend)
    np.testing.assert_allclose(pairs.values, np.sort(every[np.argsort(abs(every - shift))[:6]]), rtol=1e-10)
    x = pairs.vectors[:, free]
    np.testing.assert_allclose(x @ M @ x.T, np.identity(6), atol=1e-10)
    rest = K @ x.T - M @ x.T * pairs.values
    assert np.linalg.norm(rest, axis=0).max() < 1e-10 * np.linalg.norm(K)
    assert (pairs.residuals < 1e-8 * every[-1]).all()


@pytest.mark.parametrize("backend", BACKENDS)
def test_residuals_are_in_the_unit_of_the_values(backend):
    """Whatever the unit of mass; those of a vector of another length would not be."""
    K, M = chain(12)
    for unit in (1e-24, 1e24):
        pairs = eigenpairs(petsc(K), petsc(unit * M), 3, shift=-0.1 / unit, backend=backend)
        assert 0.0 < pairs.residuals.max() * unit < 1e-10


def test_zero_dofs_given_in_place_of_those_of_the_space():
    """One free end: quarter waves."""
    spline, space, k, m = fixed_string(3, 12)
    pairs = eigenmodes(space, k, m, 2, zero_dofs=[0])
    np.testing.assert_allclose(pairs.values, ((np.arange(2) + 0.5) * np.pi / L) ** 2, rtol=1e-6)
    assert pairs.vectors[0, 0] == 0.0
    assert abs(pairs.functions[0].x.array[np.argmax(spline.node_positions[:, 0])]) == pytest.approx(
        np.sqrt(2 / L), 1e-4
    )


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("copies", [2, 3, 5])
def test_multiple_eigenvalues_are_found_in_all_copies(backend, copies):
    K, M = chain(40, copies)
    exact = scipy.linalg.eigh(K.toarray(), M.toarray(), eigvals_only=True)
    for count in (1, 4, 8, 11):
        pairs = eigenpairs(petsc(K), petsc(M), count, backend=backend)
        np.testing.assert_allclose(pairs.values, exact[:count], rtol=1e-10)
        np.testing.assert_allclose(pairs.vectors @ M @ pairs.vectors.T, np.identity(count), atol=1e-9)
        assert pairs.functions == ()


def test_what_lanczos_misses_is_found_by_deflation(monkeypatch):
    """A first pass that overlooks two eigenvalues."""
    K, M = chain(30)
    complete = eigenpairs(petsc(K), petsc(M), 4, backend="scipy")
    honest, passes = eigen._arpack, []

    @contextmanager
    def careless(*matrices):
        with honest(*matrices) as nearest:

            def overlooking(count, known):
                passes.append(count)
                if len(passes) > 1:
                    return nearest(count, known)
                values, vectors = nearest(count + 2, known)
                kept = np.argsort(values)[[0, 2, 4, 5]]
                return values[kept], vectors[kept]

            yield overlooking

    monkeypatch.setattr(eigen, "_arpack", careless)
    found = eigenpairs(petsc(K), petsc(M), 4, backend="scipy")
    assert passes == [4, 1, 1, 1]
    np.testing.assert_allclose(found.values, complete.values, rtol=1e-12)


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_singular_matrix_needs_a_shift(backend):
    K, M = petsc(sp.diags(np.maximum(np.arange(10.0) - 1, 0))), petsc(sp.identity(10))
    np.testing.assert_allclose(eigenpairs(K, M, 4, shift=-0.5, backend=backend).values, (0, 0, 1, 2), atol=1e-12)
    with pytest.raises(SolveError, match="a free body needs a negative shift"):
        eigenpairs(K, M, 4, backend=backend)


# -- libraries, and what cannot be done -------------------------------------------------------------------------------


def test_without_slepc_scipy_is_taken(monkeypatch):
    K, M = (petsc(A) for A in chain(10))
    expected = eigenpairs(K, M, 2).values
    for name in ("slepc4py", "slepc4py.SLEPc"):
        monkeypatch.setitem(sys.modules, name, None)
    np.testing.assert_allclose(eigenpairs(K, M, 2).values, expected, rtol=1e-12)
    with pytest.raises(ImportError):
        eigenpairs(K, M, 2, backend="slepc")


@pytest.mark.mpi
def test_scipy_works_on_one_rank():
    _, space, k, m = fixed_string(2, 12, comm=MPI.COMM_WORLD)
    if MPI.COMM_WORLD.size == 1:
        assert eigenmodes(space, k, m, 1, backend="scipy").values[0] == pytest.approx(exact_string(1)[0], rel=1e-5)
    else:
        with pytest.raises(SolveError, match=r"on \d+ ranks need slepc4py"):
            eigenmodes(space, k, m, 1, backend="scipy")


def test_results_beyond_rounding_are_refused(monkeypatch):
    K, M = (petsc(A) for A in chain(10))
    monkeypatch.setattr(eigen, "_MARGIN", 1e-3)
    with pytest.raises(SolveError, match=r"eigenvalue \d\.\d+e-0\d: residual .*, rounding"):
        eigenpairs(K, M, 2, backend="scipy")


def test_a_mass_that_is_not_positive_is_refused():
    K, M = chain(10)
    M = M - 3 * sp.diags(np.arange(10) % 2)
    with pytest.raises(SolveError, match="a positive definite M is required"):
        eigenpairs(petsc(K), petsc(M), 3, shift=-1.0, backend="scipy")


def test_what_is_out_of_range_is_said():
    K, M = (petsc(A) for A in chain(10))
    for count in (0, 10, 2.5):
        with pytest.raises(ValueError, match=f"count = {count}: a"):
            eigenpairs(K, M, count)
    with pytest.raises(ValueError, match="shift = nan: a finite number"):
        eigenpairs(K, M, 2, shift=np.nan)
    with pytest.raises(ValueError, match="backend = 'lapack': one of"):
        eigenpairs(K, M, 2, backend="lapack")
