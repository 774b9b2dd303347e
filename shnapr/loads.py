"""Inertia and loads of a shell: terms of the residual."""

from typing import Any

import ufl

from tigar_x.spline import ExtractedSpline


def inertia(spline: ExtractedSpline, acceleration: Any, z: Any, *, density: Any, thickness: Any) -> ufl.Form:
    """Virtual work of inertia, ``int rho_s h y'' . z``.

    Args:
        spline: the midsurface.
        acceleration: homogeneous second rate of the displacement, shape (nsd,); unit: length/time^2.
        z: test function in ``spline.V``.
        density: rho_s; unit: mass/volume.
        thickness: h; unit: length.

    Returns:
        Residual form.
    """
    R = spline.rationalize
    return density * thickness * ufl.inner(R(acceleration), R(z)) * spline.dx


def dead_load(spline: ExtractedSpline, force: Any, z: Any) -> ufl.Form:
    """Virtual work of a dead load, ``-int f . z`` over the reference area.

    Args:
        spline: the midsurface.
        force: force per reference area (per reference length and depth in the plane), shape (nsd,).
        z: test function in ``spline.V``.

    Returns:
        Residual form.
    """
    return -ufl.inner(force, spline.rationalize(z)) * spline.dx
