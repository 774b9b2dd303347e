"""Velocities at an inlet."""

import numpy as np
import pytest
import ufl
from mpi4py import MPI
from dolfinx import fem, mesh

from varmint.profiles import parabola


def values(profile, y, time):
    domain = mesh.create_unit_interval(MPI.COMM_SELF, 1)
    x, t = fem.Constant(domain, (0.0, y)), fem.Constant(domain, time)
    velocity = profile(x, t)
    return [float(ufl.as_ufl(part)((), mapping={x: (0.0, y), t: time})) for part in velocity]


def test_mean_and_walls():
    profile = parabola(0.4, 2.0)
    y = np.linspace(0.0, 0.4, 201)
    u = np.array([values(profile, float(each), 0.0)[0] for each in y])
    assert u[0] == u[-1] == 0.0
    assert u.max() == pytest.approx(3.0)
    assert (u[1:] + u[:-1]).mean() / 2.0 == pytest.approx(2.0, rel=1e-4)  # trapezoids


def test_it_comes_up_within_the_ramp():
    profile = parabola(1.0, 2.0, ramp=0.5, dim=3)
    found = [values(profile, 0.5, t) for t in (0.0, 0.125, 0.25, 0.5, 7.0)]
    smooth = 1.5 * (1.0 - np.cos(np.pi / 4.0))
    np.testing.assert_allclose([u[0] for u in found], [0.0, smooth, 1.5, 3.0, 3.0], atol=1e-14)
    assert all(u[1:] == [0.0, 0.0] for u in found)


@pytest.mark.parametrize(
    ("arguments", "name"), [((0.0, 1.0), "height"), ((1.0, 1.0, -1.0), "ramp"), ((1.0, 1.0, 0.0, 4), "dim")]
)
def test_bad_input_is_named(arguments, name):
    with pytest.raises(ValueError, match=name):
        parabola(*arguments)
