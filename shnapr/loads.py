"""Inertia, damping and loads of a shell: terms of the residual.

Displacements, rates and test functions are homogeneous fields; forces, pressures and moments are physical. Parameters
are numbers, Constants or UFL expressions over the parametric mesh.
"""

from typing import Any

import ufl

from shnapr.kinematics import area_vector, midsurface
from tigar_x import checks
from tigar_x.splines.measures import SideMeasure, require_sides
from tigar_x.splines.spline import ExtractedSpline, require_spline


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

    Raises:
        ValueError: a parameter is no number, Constant or UFL scalar, or out of range.
    """
    require_spline(spline)
    checks.parameter("density", density, checks.not_negative)
    checks.parameter("thickness", thickness, checks.positive)
    R = spline.rationalize
    return density * thickness * ufl.inner(R(acceleration), R(z)) * spline.dx


def mass_damping(
    spline: ExtractedSpline, velocity: Any, z: Any, *, coefficient: Any, density: Any, thickness: Any
) -> ufl.Form:
    """Virtual work of damping in proportion to mass, ``int c rho_s h y' . z``.

    Args:
        spline: the midsurface.
        velocity: homogeneous rate of the displacement, shape (nsd,); unit: length/time.
        z: test function in ``spline.V``.
        coefficient: c >= 0; unit: 1/time.
        density: rho_s; unit: mass/volume.
        thickness: h; unit: length.

    Returns:
        Residual form.

    Raises:
        ValueError: a parameter is no number, Constant or UFL scalar, or out of range.
    """
    checks.parameter("coefficient", coefficient, checks.not_negative)
    return inertia(spline, coefficient * velocity, z, density=density, thickness=thickness)


def dead_load(spline: ExtractedSpline, force: Any, z: Any) -> ufl.Form:
    """Virtual work of a dead load, ``-int f . z`` over the reference area.

    Args:
        spline: the midsurface.
        force: force per reference area (per reference length and depth in the plane), shape (nsd,).
        z: test function in ``spline.V``.

    Returns:
        Residual form.

    Raises:
        ValueError: the force has another shape.
    """
    require_spline(spline)
    return -ufl.inner(checks.vector("force", force, spline.nsd), spline.rationalize(z)) * spline.dx


def gravity(spline: ExtractedSpline, acceleration: Any, z: Any, *, density: Any, thickness: Any) -> ufl.Form:
    """Virtual work of the weight, ``-int rho_s h g . z``.

    Args:
        spline: the midsurface.
        acceleration: g, shape (nsd,); unit: length/time^2.
        z: test function in ``spline.V``.
        density: rho_s; unit: mass/volume.
        thickness: h; unit: length.

    Returns:
        Residual form.

    Raises:
        ValueError: the acceleration has another shape, or a parameter is none or out of range.
    """
    require_spline(spline)
    checks.parameter("density", density, checks.not_negative)
    checks.parameter("thickness", thickness, checks.positive)
    return dead_load(spline, density * thickness * checks.vector("acceleration", acceleration, spline.nsd), z)


def follower_pressure(spline: ExtractedSpline, pressure: Any, y: Any, z: Any) -> ufl.Form:
    """Virtual work of a pressure that acts along the current normal on the current area, ``-int P a_3 . z da``.

    Args:
        spline: the midsurface.
        pressure: P, positive along a_3; unit: force/length^2.
        y: homogeneous displacement, shape (nsd,).
        z: test function in ``spline.V``.

    Returns:
        Residual form.

    Raises:
        ValueError: the pressure is no finite scalar.
    """
    require_spline(spline)
    checks.parameter("pressure", pressure, checks.finite)
    R = spline.rationalize
    area = area_vector(midsurface(spline, R(y)).tangents) / spline.dx.jacobian
    return -pressure * ufl.dot(area, R(z)) * spline.dx


def edge_traction(spline: ExtractedSpline, traction: Any, z: Any, ds: SideMeasure) -> ufl.Form:
    """Virtual work of a dead force on edges, ``-int t . z ds``.

    Args:
        spline: the midsurface.
        traction: force per reference length of the edge (in the plane: at the point, per depth), shape (nsd,).
        z: test function in ``spline.V``.
        ds: measure of the edges, such as ``spline.ds("u1")``.

    Returns:
        Residual form.

    Raises:
        ValueError: the traction has another shape, or the measure is not one of this spline's sides.
    """
    require_spline(spline)
    require_sides("ds", ds, spline.mesh)
    return -ufl.inner(checks.vector("traction", traction, spline.nsd), spline.rationalize(z)) * ds


def edge_moment(spline: ExtractedSpline, moment: Any, y: Any, z: Any, ds: SideMeasure) -> ufl.Form:
    """Virtual work of a moment about the current tangent of edges, ``-int M a_3 . dz/dnu ds``.

    With the parametric normal N the outward conormal has the components ``nu^alpha = a^{alpha beta} N_beta /
    sqrt(N . a^-1 N)``, and ``a_3 . dz/dnu`` is the angle by which the edge turns: positive M turns the outward conormal
    towards +a_3. It follows the edge, so its tangent is symmetric only where the edge keeps its direction.

    Args:
        spline: the midsurface.
        moment: M per reference length of the edge (in the plane: at the point, per depth); unit: force.
        y: homogeneous displacement, shape (nsd,).
        z: test function in ``spline.V``.
        ds: measure of the edges, such as ``spline.ds("u1")``.

    Returns:
        Residual form.

    Raises:
        ValueError: the moment is no finite scalar, or the measure is not one of this spline's sides.
    """
    require_spline(spline)
    require_sides("ds", ds, spline.mesh)
    checks.parameter("moment", moment, checks.finite)
    current = midsurface(spline, spline.rationalize(y))
    raised = ufl.inv(current.metric) * ds.normal
    conormal = raised / ufl.sqrt(ufl.dot(ds.normal, raised))
    slope = spline.parametric_grad(spline.rationalize(z)) * conormal
    return -moment * ufl.dot(current.normal, slope) * ds
