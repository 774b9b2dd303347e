"""A shell as one object: the same numbers as forms by hand, and what it refuses."""

import numpy as np
import pytest

from shnapr.conditions import DeadLoad
from shnapr.shell import Shell
from shnapr.svk import StVenantKirchhoff
from tigar_x.fem.schemes import companion, generalized_alpha
from tigar_x.geometry import shapes

MATERIAL = StVenantKirchhoff(1e3, 0.3, 0.1)


def panel(**options):
    """A clamped square plate with a load across it."""
    patch = shapes.plate(lengths=(1.0, 1.0), elements=(2, 2), degrees=(2, 2))
    return Shell(patch, MATERIAL, clamped=("u0",), **({"loads": [DeadLoad((0.0, 0.0, 0.01))]} | options))


@pytest.mark.mpi
def test_supports_carry_the_load():
    shell = panel()
    shell.solve()
    np.testing.assert_allclose(shell.support_force(), (0.0, 0.0, -0.01), atol=1e-9)
    assert shell.at("u1").displacement[2] > 0.0


@pytest.mark.mpi
def test_a_shell_gets_its_clock_from_what_it_is_coupled_with_once():
    shell = panel(density=1.0)
    scheme = generalized_alpha(0.5)
    shell.bind(0.1, scheme, 2.0)
    assert (shell.time.step_size, shell.time.time, shell.time.scheme) == (0.1, 2.0, companion(scheme))
    shell.bind(0.1, companion(scheme), 2.0)
    with pytest.raises(ValueError, match=r"dt = 0\.1: the shell has a clock of its own, and 0\.2 is required"):
        shell.bind(0.2, scheme, 2.0)
