"""Rates of convergence of splines for problems of second and fourth order and for eigenvalues."""

import numpy as np
import pytest
from load import load_demo

from tigar_x.geometry.patch import Patch
from tigar_x.run.convergence import refine
from tigar_x.splines.exact import Solution

POISSON, BIHARMONIC, BEAM = (load_demo(name) for name in ("poisson", "biharmonic", "beam_modes"))
TOLERANCE = 0.15

pytestmark = pytest.mark.mpi
slow = pytest.mark.slow


def require_rates(study):
    """Fitted rates are those of theory."""
    for name, rate in study.rates.items():
        assert rate == pytest.approx(study.expected[name], abs=TOLERANCE), f"{name}\n{study.table()}"


def require_bounds(study, bounds):
    """Errors on the finest mesh are below bounds: those measured, and a tenth more."""
    for (name, error), bound in zip(study.levels[-1].errors.items(), bounds, strict=True):
        assert error < bound, f"{name}\n{study.table()}"


def require_no_rates(study):
    """No error falls as theory says: what has to become of a mistake."""
    for name, rate in study.rates.items():
        assert rate < study.expected[name] - 1.0, f"{name}\n{study.table()}"


# -- second order -----------------------------------------------------------------------------------------------------


def shape(dim, geometry, degree):
    """The demo's shapes, and "weighted": straight edges with rational functions, already of degree 1."""
    patch = POISSON.coarse_patch(dim, "bspline" if geometry == "weighted" else geometry)
    points = patch.points / 2.0 if dim == 3 and geometry != "nurbs" else patch.points
    weights = 1.0 + patch.points.sum(axis=1) / 2.0 if geometry == "weighted" else patch.weights
    return Patch.from_points(patch.bases, points, weights).with_degree(degree)


def poisson(dim, geometry, degree, elements, cells="tensor", f=None):
    patch, expected = shape(dim, geometry, degree), {"L2_u": degree + 1, "H1_u": degree}
    return refine(lambda n: POISSON.solve(patch.refined(n), cells, f), Solution.errors, elements, expected)[0]


@pytest.mark.parametrize(
    ("dim", "geometry", "degree", "elements", "bounds"),
    [
        (1, "bspline", 1, (16, 32, 64), (3.3e-4, 5.1e-2)),
        (1, "bspline", 2, (16, 32, 64), (1.1e-6, 3.4e-4)),
        (1, "bspline", 3, (16, 32, 64), (1.2e-8, 3.8e-6)),
        (1, "bspline", 4, (8, 16, 32), (3.2e-9, 4.9e-7)),
        (1, "weighted", 1, (16, 32, 64), (5.2e-4, 6.0e-2)),
        (1, "nurbs", 2, (16, 32, 64), (1.2e-6, 3.2e-4)),
        (1, "nurbs", 3, (16, 32, 64), (2.2e-8, 5.7e-6)),
        (1, "nurbs", 4, (16, 32, 64), (3.5e-10, 8.9e-8)),
        (2, "bspline", 1, (8, 16, 32), (1.1e-3, 1.2e-1)),
        (2, "bspline", 2, (8, 16, 32), (1.1e-5, 1.8e-3)),
        (2, "bspline", 3, (8, 16, 32), (1.9e-7, 3.1e-5)),
        (2, "bspline", 4, (8, 16, 32), (3.9e-9, 6.2e-7)),
        (2, "weighted", 1, (8, 16, 32), (1.3e-3, 1.2e-1)),
        (2, "nurbs", 2, (8, 16, 32), (4.7e-7, 1.9e-4)),
        (2, "nurbs", 3, (8, 16, 32), (4.6e-9, 1.6e-6)),
        (2, "nurbs", 4, (8, 16, 32), (7.9e-11, 2.5e-8)),
        (3, "bspline", 1, (4, 6, 8), (1.2e-3, 7.3e-2)),
        (3, "bspline", 2, (4, 6, 8), (3.4e-5, 2.9e-3)),
        (3, "weighted", 1, (4, 6, 8), (1.7e-3, 8.0e-2)),
        (3, "nurbs", 2, (4, 6, 8), (2.1e-5, 2.0e-3)),
        pytest.param(3, "bspline", 3, (4, 6, 8), (8.2e-7, 6.9e-5), marks=slow),
        pytest.param(3, "bspline", 4, (4, 6, 8), (4.8e-8, 3.8e-6), marks=slow),
        pytest.param(3, "nurbs", 3, (4, 6, 8), (9.1e-7, 7.8e-5), marks=slow),
        pytest.param(3, "nurbs", 4, (4, 6, 8), (5.8e-8, 4.2e-6), marks=slow),
    ],
)
def test_poisson(dim, geometry, degree, elements, bounds):
    study = poisson(dim, geometry, degree, elements)
    require_rates(study)
    require_bounds(study, bounds)


@pytest.mark.parametrize(
    ("dim", "geometry", "degree", "elements"),
    [
        (2, "weighted", 1, (8, 16, 32)),
        (2, "nurbs", 2, (8, 16, 32)),
        (3, "weighted", 1, (4, 6, 8)),
        pytest.param(3, "nurbs", 2, (4, 6, 8), marks=slow),
    ],
)
def test_cells_only_carry_the_quadrature(dim, geometry, degree, elements):
    """The spline space is the same on quadrilaterals and triangles, on hexahedra and tetrahedra."""
    study = poisson(dim, geometry, degree, elements, "simplex")
    require_rates(study)
    finest = poisson(dim, geometry, degree, elements[-2:]).levels[-1]
    assert study.levels[-1].errors == pytest.approx(finest.errors, rel=0.01)


@pytest.mark.parametrize("dim", [1, 2])
def test_a_weight_forgotten_in_the_load_is_seen(dim):
    def f(spline, k):
        return spline.weight * POISSON.source(spline.F, k, circle=dim == 1)

    require_no_rates(poisson(dim, "nurbs", 2, (8, 16, 32), f=f))


def test_a_load_that_is_one_percent_off_is_seen():
    require_no_rates(poisson(2, "bspline", 2, (8, 16, 32), f=lambda s, k: 1.01 * POISSON.source(s.F, k, circle=False)))


# -- fourth order -----------------------------------------------------------------------------------------------------


def biharmonic(geometry, degree, elements=(8, 16, 32), load=1.0):
    patch, expected = BIHARMONIC.coarse_patch(geometry).with_degree(degree), BIHARMONIC.expected_rates(degree)
    return refine(lambda n: BIHARMONIC.solve(patch.refined(n), 1 / n, load), BIHARMONIC.errors, elements, expected)[0]


@pytest.mark.parametrize(
    ("geometry", "degree", "bounds"),
    [
        ("bspline", 2, (4.4e-4, 2.6e-3, 3.7e-1)),
        ("bspline", 3, (2.6e-7, 3.1e-5, 5.3e-3)),
        ("bspline", 4, (4.0e-9, 6.4e-7, 1.1e-4)),
        ("nurbs", 2, (7.9e-6, 2.2e-4, 9.0e-2)),
        ("nurbs", 3, (6.4e-9, 1.7e-6, 6.1e-4)),
        ("nurbs", 4, (8.0e-11, 2.5e-8, 8.1e-6)),
    ],
)
def test_biharmonic(geometry, degree, bounds):
    study = biharmonic(geometry, degree)
    require_rates(study)
    require_bounds(study, bounds)


def test_a_load_on_the_plate_that_is_one_percent_off_is_seen():
    require_no_rates(biharmonic("bspline", 3, load=1.01))


# -- eigenvalues ------------------------------------------------------------------------------------------------------


def beam(support, geometry, degree, elements, mode=2, factor=1.0):
    """Relative error of one eigenvalue; that of the first mode of degree 4 soon meets rounding."""

    def errors(solution):
        return {"omega^2": abs(factor * solution.modes.values[mode - 1] / solution.exact[mode - 1] - 1.0)}

    expected = {"omega^2": 2 * degree - 2}
    return refine(BEAM.Beam(support, geometry, degree, mode).solve, errors, elements, expected)[0]


@pytest.mark.parametrize(
    ("support", "geometry", "degree", "elements", "bound"),
    [
        ("clamped-free", "bspline", 2, (16, 32, 64), 7.3e-4),
        ("clamped-free", "bspline", 3, (16, 24, 32), 7.2e-7),
        ("clamped-free", "bspline", 4, (8, 12, 16), 3.3e-8),
        ("simply-supported", "bspline", 3, (16, 24, 32), 2.3e-6),
        ("simply-supported", "nurbs", 2, (16, 32, 64), 1.1e-3),
        ("simply-supported", "nurbs", 3, (16, 24, 32), 3.2e-6),
    ],
)
def test_eigenvalues_of_a_beam(support, geometry, degree, elements, bound):
    study = beam(support, geometry, degree, elements)
    require_rates(study)
    require_bounds(study, [bound])


def test_a_frequency_that_is_a_little_off_is_seen():
    require_no_rates(beam("clamped-free", "bspline", 3, (16, 24, 32), factor=1.001))


# -- the demos --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("demo", "options", "message"),
    [
        (POISSON, {"geometry": "nurbs", "degree": 1}, "degree = 1: an integer >= 2"),
        (POISSON, {"elements": 0}, "elements = 0"),
        (BIHARMONIC, {"degree": 1}, "degree = 1: an integer >= 2"),
        (BIHARMONIC, {"levels": 1}, "levels = 1"),
        (BEAM, {"degree": 1}, "degree = 1: an integer >= 2"),
        (BEAM, {"modes": 9}, "modes = 9"),
    ],
)
def test_bad_input_is_named_before_computing(demo, options, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        demo.main(out=tmp_path, **options)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("support", "modes"), [("clamped-free", 5), ("simply-supported", 3)])
def test_wave_numbers_solve_their_equation(support, modes):
    beta = BEAM.wave_numbers(support, modes)
    zero = np.sin(beta) if support == "simply-supported" else np.cos(beta) + 1.0 / np.cosh(beta)
    np.testing.assert_allclose(zero, 0.0, atol=1e-12)
    np.testing.assert_allclose(
        beta, (np.arange(modes) + (1 if support == "simply-supported" else 0.5)) * np.pi, atol=0.31
    )
