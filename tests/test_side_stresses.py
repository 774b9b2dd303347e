"""Stresses of the fluid on both sides of an immersed shell, against exact ones."""

from dataclasses import replace

import numpy as np
import pytest
from plane import HeldSheet
from scene import Setting
from space import IN_SPACE, HeldSurface
from test_sided import membrane

from coudalfish import CouplingOptions
from coudalfish.sides.stresses import side_stresses

pytestmark = pytest.mark.mpi
SHARP = Setting(CouplingOptions.sharp(), "jump and kink")
MU = 0.1


@pytest.mark.parametrize("bow", [0.0, 0.1])
@pytest.mark.parametrize("place", [0.0, 0.37])  # along lines of the mesh and within cells
def test_a_sheet_at_rest_has_the_pressures_of_both_its_sides(bow, place):
    scene = HeldSheet(8, bow=bow, place=place, ramp=3, steps=1, jump=100.0).build(SHARP)
    for _ in range(4):
        scene.step()
    found, off = side_stresses(scene.fsi), 2.5 if bow else 1e-3
    assert found.pressure.shape == (17, 2)
    np.testing.assert_allclose(found.pressure, np.broadcast_to([0.0, 100.0], (17, 2)), atol=off)
    np.testing.assert_allclose(found.viscous, 0.0, atol=off)
    np.testing.assert_allclose(found.traction, 100.0 * found.normal, atol=off)


def test_a_surface_at_rest_in_space_has_the_pressures_of_both_its_sides():
    """A dome across a cube, whose weak walls and edges it crosses; beyond them nothing is known."""
    options = CouplingOptions.converged(fluid_tangent="consistent")
    scene = HeldSurface(n=4, ramp=3, jump=100.0, weak=True).build(replace(IN_SPACE, options=options, immersed="jump"))
    for _ in range(4):
        scene.step()
    found = side_stresses(scene.fsi)
    there = np.isfinite(found.pressure).all(axis=1)
    x = found.x[:, :2]
    np.testing.assert_array_equal(there, ((x > 0.0) & (x < 1.0)).all(axis=1))
    np.testing.assert_allclose(found.pressure[there], np.broadcast_to([100.0, 0.0], (there.sum(), 2)), atol=1e-5)
    np.testing.assert_allclose(found.viscous[there], 0.0, atol=1e-5)
    np.testing.assert_allclose(found.traction[there], -100.0 * found.normal[there], atol=1e-5)
    assert scene.fsi.fluid.speed() < 1e-5  # with weights that are exact on one wall of a cell alone 5e-4


@pytest.fixture(scope="module")
def swept():
    """The manufactured membrane at t = 1."""
    _, fsi = membrane("jump and kink", level=2)
    for _ in range(24):
        fsi.takeStep()
    return fsi


def test_a_membrane_in_a_flow_has_the_shear_of_both_its_sides(swept):
    """The exact gradients of the velocity at the membrane, in front of it on its right and behind it on its left."""
    found = side_stresses(swept)
    y = found.x[:, 1]
    dY, zero = 1.0 - 2.0 * y, np.zeros_like(y)
    behind = np.array([[zero, dY], [zero, zero]])
    front = np.array([[dY, dY - dY**2], [zero + 1.0, -dY]])
    np.testing.assert_allclose(found.pressure, np.broadcast_to([-1.0, 0.0], (len(y), 2)), atol=0.06)
    for i, (grad, off) in enumerate(((front, 0.022), (behind, 0.008))):
        exact = MU * np.einsum("ijq,qj->qi", grad + np.swapaxes(grad, 0, 1), found.normal)
        error = found.viscous[:, i] - exact
        assert np.sqrt(np.mean(np.sum(error**2, axis=1))) < off, i
        along = np.einsum("qi,qi->q", found.shear[:, i], found.normal)
        np.testing.assert_allclose(along, 0.0, atol=1e-14)
    assert np.abs(found.viscous[:, 0] - found.viscous[:, 1]).max() > 0.1


def test_the_stresses_of_both_sides_are_the_force_of_the_coupling(swept):
    found, W = side_stresses(swept), swept.shell.quadrature.weights
    areas = W * swept.shell.sheets.stretch(found.x)
    exerted = np.sum(areas[:, None] * found.traction, axis=0)
    lam = np.sum(W[:, None] * swept.lam, axis=0)
    np.testing.assert_allclose(exerted, lam, atol=0.04)


def test_a_flow_that_is_the_same_on_both_sides_has_no_such_stresses():
    _, fsi = membrane("plain", level=1, multiplier_direction="normal", trace="nodes")
    with pytest.raises(ValueError, match="jump and kink"):
        side_stresses(fsi)
