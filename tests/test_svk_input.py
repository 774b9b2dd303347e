"""What a St. Venant-Kirchhoff shell refuses, and what it says."""

import numpy as np
import pytest
from mpi4py import MPI
from dolfinx import fem

from shnapr.svk import StVenantKirchhoff
from shnapr.work import strain_energy
from tigar_x.geometry import shapes
from tigar_x.splines.spline import ExtractedSpline


def flat(dim):
    if dim == 1:
        patch = shapes.line((0, 0), (1, 0), elements=1, degree=2)
    else:
        patch = shapes.parallelogram((0, 0, 0), (1, 0, 0), (0, 1, 0), elements=(1, 1), degrees=(2, 2))
    return ExtractedSpline(patch, MPI.COMM_SELF)


def values(dim):
    resultant = (2 * dim - 1) * (0.1,)
    return dict(youngs_modulus=10.0, poisson_ratio=0.3, thickness=0.3, prestress=resultant, bending_prestress=resultant)


@pytest.mark.parametrize("dim", [1, 2])
def test_good_parameters(dim):
    spline = flat(dim)
    assert strain_energy(spline, StVenantKirchhoff(**values(dim)), spline.function()).integrals()


LIMITS = {
    "youngs_modulus": (0.0, -1.0, np.nan, np.inf),
    "thickness": (0.0, -0.1, np.nan),
    "poisson_ratio": (-1.0, 0.51, np.nan),
    "prestress": (np.nan, np.inf),
    "bending_prestress": (np.nan, np.inf),
}


@pytest.mark.parametrize("constant", [False, True], ids=["number", "Constant"])
@pytest.mark.parametrize(("name", "value"), [(name, value) for name, values in LIMITS.items() for value in values])
def test_parameters_out_of_range(name, value, constant):
    given = [value] if "prestress" in name else value
    given = fem.Constant(flat(1).mesh, np.asarray(given)) if constant else given
    with pytest.raises(ValueError, match=rf"^{name}.* = .*{value:.4g}.* required"):
        StVenantKirchhoff(**(values(1) | {name: given}))


@pytest.mark.parametrize("name", ["prestress", "bending_prestress"])
@pytest.mark.parametrize(("dim", "length"), [(1, 2), (2, 1), (2, 4)])
def test_prestress_of_a_wrong_length(dim, name, length):
    spline = flat(dim)
    material = StVenantKirchhoff(**(values(dim) | {name: length * (1.0,)}))
    with pytest.raises(ValueError, match=rf"^{name} has shape \({length},\): shape \({2 * dim - 1},\) is required"):
        strain_energy(spline, material, spline.function())


def test_a_membrane_takes_no_moments():
    with pytest.raises(ValueError, match="bending_prestress is given with bending = False"):
        StVenantKirchhoff(1.0, 0.3, 0.1, bending_prestress=(1.0,), bending=False)
