"""The Scordelis-Lo roof against the published deflection, the legacy library's table, and the balance of forces."""

from dataclasses import replace

import numpy as np
import pytest
import ufl
from load import load_demo

from shnapr.problems.scordelis_lo import PUBLISHED, Mesh, Roof, RoofData
from shnapr.shell import Shell

demo = load_demo("scordelis_lo")
FINE = 0.3005925  # what degrees 4 and 5 agree on

# Deflections of the legacy library, to six digits, by degree and elements per side: triangles, quadrature degree 2 p.
LEGACY = {
    (2, 4): 0.069540,
    (2, 8): 0.238116,
    (2, 16): 0.295703,
    (2, 32): 0.300238,
    (3, 4): 0.279943,
    (3, 8): 0.300066,
    (3, 16): 0.300584,
    (3, 32): 0.300592,
    (4, 4): 0.300000,
    (4, 8): 0.300590,
    (4, 16): 0.300592,
}
QUICK = {(2, 4), (2, 8), (3, 4)}


def roof(degree, elements, cells="quad", quadrature=None, data=None):
    built = Roof(Mesh(degree, elements, cells, quadrature), data or RoofData())
    built.solve()
    return built


def sinking(*args, **kwargs):
    return roof(*args, **kwargs).sinking


@pytest.mark.mpi
@pytest.mark.parametrize("elements", [8, 16])
def test_cubic_roof(elements):
    w = sinking(3, elements)
    assert w == pytest.approx(LEGACY[3, elements], abs=6e-7)
    if elements == 16:
        assert w == pytest.approx(PUBLISHED, abs=1e-4)


@pytest.mark.parametrize(
    ("degree", "elements"),
    [pytest.param(*mesh, marks=[] if mesh in QUICK else pytest.mark.slow) for mesh in LEGACY],
)
def test_table_of_the_legacy_library(degree, elements):
    """Rules of degree 8 on triangles, which degree 4 uses, are others than the legacy library's."""
    same_rule = degree < 4
    w = sinking(degree, elements, "tri")
    assert w == pytest.approx(LEGACY[degree, elements], abs=6e-7 if same_rule else 2e-6)


@pytest.mark.parametrize(("degree", "elements", "apart"), [(2, 4, 6e-5), (2, 8, 2e-5), (3, 4, 2e-6)])
def test_quadrilaterals_and_triangles(degree, elements, apart):
    """Both carry the same functions: what differs is the quadrature, which 4 p leaves no room for."""
    quad, tri = (sinking(degree, elements, cells) for cells in ("quad", "tri"))
    assert 1e-7 < abs(quad - tri) < apart
    if degree == 2:
        quad, tri = (sinking(2, elements, cells, quadrature=8) for cells in ("quad", "tri"))
        assert quad == pytest.approx(tri, abs=1e-8)


@pytest.mark.parametrize(
    ("degree", "bounds"),
    [
        (2, (0.24, 0.063, 5e-3)),
        (3, (0.021, 6e-4, 1e-5)),
        (4, (6e-4, 3e-6, 2e-7)),
        pytest.param(5, (4e-4, 3e-6, 2e-7), marks=pytest.mark.slow),
    ],
)
def test_convergence(degree, bounds):
    errors = np.array([abs(sinking(degree, n) - FINE) for n in (4, 8, 16)])
    assert (errors < bounds).all()
    assert (np.diff(errors) < 0).all()


def test_quadratic_roofs_lock_and_less_quadrature_relieves_them():
    assert sinking(2, 8) < 0.8 * FINE
    assert sinking(2, 8, quadrature=3) == pytest.approx(FINE, rel=0.02)


def test_membrane_forces_as_unknowns_cure_locking():
    shell = Roof(Mesh(2, 4)).shell
    both = Shell(shell.spline, shell.material, loads=shell.loads, formulation="mixed")
    both.solve_linear()
    assert -both.at("v1").displacement[2] == pytest.approx(FINE, rel=0.06)
    assert sinking(2, 4) < 0.25 * FINE


def test_displacements_follow_load_and_stiffness():
    data = RoofData()
    w = sinking(3, 4)
    assert sinking(3, 4, data=replace(data, load=-7.0 * data.load)) == pytest.approx(-7.0 * w, rel=1e-9)
    assert sinking(3, 4, data=replace(data, youngs_modulus=data.youngs_modulus / 3)) == pytest.approx(3 * w, rel=1e-9)
    assert sinking(3, 4, data=replace(data, thickness=0.3)) < 0.8 * w


def test_symmetry():
    s = roof(3, 8)
    xi = np.array([[0.5, 0.0], [0.2, 0.3], [0.4, 0.8]])
    y = s.shell.spline.evaluate(s.shell.y, xi)
    along, across = (s.shell.spline.evaluate(s.shell.y, np.abs(xi - mirror)) for mirror in ((1.0, 0.0), (0.0, 1.0)))
    np.testing.assert_allclose(along[:, 1:], y[:, 1:], atol=1e-9)
    np.testing.assert_allclose(across, y * (1, -1, 1), atol=1e-9)
    assert np.abs(y[:, 1:]).min() > 1e-3


def test_the_middle_section_balances_the_load():
    """Stress resultants are a beam's: no force along the axis, and the moment q L^2/8 of the load q per length."""
    built = roof(3, 16)
    spline, data = built.shell.spline, RoofData()
    n, m = (spline.project(ufl.as_vector([T[0, 0], T[1, 1], T[0, 1]])) for T in built.resultants())
    xi = np.column_stack([np.full(401, 0.5), np.linspace(0.0, 1.0, 401)])
    X = spline.geometry.evaluate(xi)
    phi = np.arctan2(X[:, 1], X[:, 2])
    n_11, m_11 = spline.evaluate(n, xi)[:, 0], spline.evaluate(m, xi)[:, 0]

    def along_the_arc(f):
        return data.radius * np.sum((f[1:] + f[:-1]) / 2 * np.diff(phi))

    q = data.load * 2 * data.half_angle * data.radius
    moment = along_the_arc(n_11 * X[:, 2] + m_11 * np.cos(phi))
    assert abs(along_the_arc(n_11)) < 1e-3 * along_the_arc(np.abs(n_11))
    assert -moment == pytest.approx(q * data.length**2 / 8, rel=1e-3)
    assert n_11[[0, -1]].min() > 7e4
    assert n_11[200] < 0.0


@pytest.mark.parametrize(
    ("option", "value"), [("degree", 1), ("elements", 0), ("cells", "hexagon"), ("quadrature", -1)]
)
def test_bad_input_is_named(option, value, tmp_path):
    with pytest.raises(ValueError, match=f"{option}.* = '?{value}"):
        demo.main(out=tmp_path, **{option: value})
    assert not list(tmp_path.iterdir())
