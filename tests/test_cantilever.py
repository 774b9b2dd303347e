"""The cantilever under shear and moment: published positions, closed forms, and locking with its cure."""

from functools import cache
from math import pi
from types import SimpleNamespace

import numpy as np
import pytest
from load import load_demo

from shnapr.problems.cantilever import LENGTH, PUBLISHED, Strip, circle, rolled_shell, thickness_study

demo = load_demo("cantilever")


@cache
def bent(load, degree=3, elements=16, dim=2, formulation="displacement", thinness=0.01):
    strip = Strip(load, dim, degree, elements, thinness * LENGTH, formulation)
    return SimpleNamespace(strip=strip, path=strip.bend(strip.shell()))


def errors_of(found):
    return found.strip.errors(found.path)


@pytest.mark.mpi
@pytest.mark.parametrize("formulation", ["displacement", "mixed"])
@pytest.mark.parametrize("dim", [2, 3])
def test_shear(dim, formulation):
    found = bent("shear", dim=dim, formulation=formulation)
    path, errors = found.path, errors_of(found)
    assert errors["U"] < 0.003
    assert errors["W"] < 0.001
    assert path.loads[-1] == 1.0
    assert set(PUBLISHED) <= set(path.loads)


@pytest.mark.parametrize("formulation", ["displacement", "mixed"])
@pytest.mark.parametrize("dim", [2, 3])
def test_moment(dim, formulation):
    errors = errors_of(bent("moment", dim=dim, formulation=formulation))
    assert errors["closing"] < 1e-3
    assert errors["tip_shell"] < 2e-4
    assert errors["tip"] < 1e-3


def test_plane_and_space_agree():
    """Without Poisson's ratio every section of the strip is the curve."""
    for load in ("shear", "moment"):
        plane, space = (bent(load, dim=dim).path for dim in (2, 3))
        np.testing.assert_allclose([plane.final(x) for x in "UW"], [space.final(x) for x in "UW"], atol=1e-5)


def test_closed_forms():
    t, h = 2 * pi, 0.1
    np.testing.assert_allclose(circle(t), (-LENGTH, 0.0), atol=1e-12)
    np.testing.assert_allclose(rolled_shell(2.0, 1e-6), circle(2.0), rtol=1e-10)
    # to first order the angle grows by (h t/L)^2/6, and the tip overshoots by it times the radius L/t
    gap = np.hypot(*np.subtract(rolled_shell(t, h), circle(t)))
    assert gap == pytest.approx((h * t / LENGTH) ** 2 / 6 * LENGTH, rel=2e-3)


def test_a_thick_strip_does_not_close_but_follows_the_theory():
    errors = errors_of(bent("moment", degree=4, thinness=0.1))
    assert errors["closing"] > 0.07
    assert errors["tip_shell"] < 1e-6


@pytest.mark.parametrize("thinness", [1e-2, 1e-4])
@pytest.mark.parametrize("degree", [2, 3, 4])
def test_membrane_forces_do_not_lock(degree, thinness):
    shear, moment = (
        errors_of(bent(load, degree, formulation="mixed", thinness=thinness)) for load in ("shear", "moment")
    )
    assert max(shear.values()) < 0.01
    assert moment["closing"] < 0.005
    assert moment["tip_shell"] < {2: 5e-4, 3: 2e-4, 4: 1e-7}[degree]


@pytest.mark.parametrize(("degree", "thinness"), [(2, 1e-2), (2, 1e-3), (3, 1e-4)])
def test_displacements_alone_lock(degree, thinness):
    shear, moment = (errors_of(bent(load, degree, thinness=thinness)) for load in ("shear", "moment"))
    assert max(shear.values()) > 0.01
    assert moment["closing"] > 0.1


def test_membrane_forces_need_fewer_iterations():
    plain, both = (bent("shear", 4, formulation=how, thinness=1e-4) for how in ("displacement", "mixed"))
    assert both.path.iterations < 0.5 * plain.path.iterations


@pytest.mark.slow
@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("load", ["shear", "moment"])
def test_study(load, dim):
    """With membrane forces every degree and thickness passes, but for the theory's own gap in the thickest circle."""
    table = thickness_study(Strip(load, dim))
    assert len(table) == 24
    assert all(row["iterations"] != "-" for row in table)
    for row in table:
        if row["formulation"] == "displacement":
            continue
        if load == "shear":
            assert max(row["U"], row["W"]) < 0.01
        else:
            assert row["tip_shell"] < 1e-3
            assert (row["closing"] < 0.005) == (row["h/L"] < 0.05)


def test_study_in_the_demo(tmp_path):
    summary = demo.main(elements=8, study=True, out=tmp_path)
    assert len(summary["study"]) == 24
    assert (tmp_path / "cantilever.png").exists()


@pytest.mark.parametrize(
    ("option", "value"), [("thickness", 1.1), ("thickness", 0.0), ("degree", 1), ("elements", 0), ("load", "torsion")]
)
def test_bad_input_is_named(option, value, tmp_path):
    with pytest.raises(ValueError, match=f"{option} = '?{value}"):
        demo.main(out=tmp_path, **{option: value})
    assert not list(tmp_path.iterdir())
