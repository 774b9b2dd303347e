"""Flow around a cylinder and a beam behind it, against the published values."""

import pytest

pytest.importorskip("gmsh")
from load import load_demo

from varmint.problems.cylinder import PUBLISHED, Channel, Coefficients

CYLINDER, BEAM = load_demo("cylinder"), load_demo("turek_hron_fsi3")


def test_steady_drag_and_lift():
    """Re = 20: drag within 0.3 %, lift within 2 %, the difference of pressures within 0.5 %."""
    flow = Channel(20.0, steady=True).build()
    flow.solve()
    drag, lift, dp = Coefficients(flow)()
    published = PUBLISHED[20.0, True][1]
    assert drag == pytest.approx(published["drag"], rel=3e-3)
    assert lift == pytest.approx(published["lift"], rel=2e-2)
    assert dp == pytest.approx(published["dp"], rel=5e-3)


@pytest.mark.slow
@pytest.mark.parametrize(("cell", "times"), [("triangle", 3.0), ("quadrilateral", 4.0)])
def test_a_polygon_of_equal_area_cuts_the_error_of_the_drag(cell, times):
    """Re = 20, degree 2: from .13 to .035 % of triangles, from .14 to .028 % of quadrilaterals."""
    errors = []
    for equal_area in (False, True):
        flow = Channel(20.0, steady=True).build(cell=cell, equal_area=equal_area)
        flow.solve()
        drag, published = Coefficients(flow)()[0], PUBLISHED[20.0, True][1]["drag"]
        errors.append(abs(drag / published - 1.0))
    assert errors[0] > times * errors[1]
    assert errors[1] < 5e-4


@pytest.mark.slow
def test_vortices(tmp_path):
    """Re = 100: within the intervals of the benchmark, widened by a half."""
    found = CYLINDER.main(reynolds=100.0, until=6.0, out=tmp_path, viz=False)["qoi"]
    assert found["drag_max"]["value"] == pytest.approx(3.23, abs=0.015)
    assert found["lift_max"]["value"] == pytest.approx(1.0, abs=0.015)
    assert found["strouhal"]["value"] == pytest.approx(0.3, abs=0.0075)


@pytest.mark.slow
def test_beam(tmp_path):
    """FSI3 on a coarse mesh: amplitudes and mean drag within a tenth, frequencies within a twentieth."""
    found = BEAM.main(out=tmp_path, viz=False)["qoi"]
    for name in ("u_x_amplitude", "u_y_amplitude", "drag_mean", "drag_amplitude", "lift_amplitude", "u_x_mean"):
        assert found[name]["value"] == pytest.approx(found[name]["published"], rel=0.1), name
    for name in ("u_x_frequency", "u_y_frequency", "lift_frequency"):
        assert found[name]["value"] == pytest.approx(found[name]["published"], rel=0.05), name
