"""Factories of curved surfaces: exact round ones, and the leaflets of a heart valve; and of the circle as a curve.

Round surfaces are rational and over [0, 1]^2. Arcs are quadratic, of equal spans of up to 90 degrees. Where two spans
meet the functions are only C0, so that a thin shell would fold there as on a hinge; constraints make it smooth
(:func:`tigar_x.splines.constraints.smooth_lines`). A full circle is periodic: four such spans, or, from degree 4 on, a
quartic whose functions are C1. `elements` counts equal parts of a direction; the ends of the spans are breakpoints
besides.
"""

from collections.abc import Sequence
from math import ceil, pi
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from tigar_x import checks
from tigar_x.compat import FloatArray
from tigar_x.geometry.bspline import BSplineBasis, open_knots
from tigar_x.geometry.patch import Patch
from tigar_x.geometry.shapes import interpolated, one_per_direction, uniform, uniform_bases

LEAFLETS = 3
ROUNDING = 1e-12
"""Angles closer than this are one; unit: radians."""


def full_circle(*, radius: float, center: ArrayLike = (0.0, 0.0), elements: int, degree: int = 2) -> Patch:
    """Circle as a curve, anticlockwise from the first axis, normal to the third axis.

    Args:
        radius: unit: length.
        center: shape (nsd,), nsd = 2 or 3; unit: length.
        elements: number of equal parts.
        degree: polynomial degree, 2 or more.

    Returns:
        NURBS curve over [0, 1], periodic.

    Raises:
        ValueError: an argument is not as above.
    """
    R = checks.positive("radius", radius)
    basis, points = _arc(2.0 * pi, checks.whole("degree", degree, 2))
    x, y, w = points.T
    control = np.column_stack([R * x, R * y, np.zeros_like(w), w]) @ _flat(center)
    return _equal_parts(Patch((basis,), control), (elements,), (degree,))


def disc(
    *,
    radius: float,
    kind: Literal["square", "polar"] = "square",
    center: ArrayLike = (0.0, 0.0, 0.0),
    elements: Sequence[int],
    degrees: Sequence[int],
) -> Patch:
    """Flat disc normal to the third axis.

    Args:
        radius: unit: length.
        kind: "square" has four arcs of the rim as its sides, no pole, and four points of the rim where the
            parametrisation is singular because two sides meet in one tangent
            (:func:`tigar_x.splines.constraints.no_rotation` takes the limit of normals there); "polar" has u along
            the radius and v around, with a pole in the centre.
        center: shape (nsd,), nsd = 2 or 3; unit: length.
        elements: number of equal parts of both directions.
        degrees: polynomial degrees, 2 or more ("polar": the first one 1 or more).

    Returns:
        NURBS surface; "polar" is periodic in v and has the sides "pole" and "rim".

    Raises:
        ValueError: an argument is not as above.
    """
    R = checks.positive("radius", radius)
    if checks.choice("kind", kind, ("square", "polar")) == "polar":
        polar = _revolved(uniform(1, 1), [[0.0, 0.0, 1.0], [R, 0.0, 1.0]], 2.0 * pi, degrees)
        names = {"pole": (0, 0), "rim": (0, 1)}
        return _equal_parts(Patch(polar.bases, polar.control @ _flat(center), names), elements, degrees)
    from splipy import surface_factory

    square = Patch.from_splipy(surface_factory.disc(R, type="square"))
    control = np.insert(square.control, 2, 0.0, axis=1) @ _flat(center)
    return _equal_parts(Patch(square.bases, control), elements, degrees)


def annulus(
    *,
    inner: float,
    outer: float,
    angle: float = 2.0 * pi,
    center: ArrayLike = (0.0, 0.0, 0.0),
    elements: Sequence[int],
    degrees: Sequence[int],
) -> Patch:
    """Flat ring, or a sector of one that begins on the first axis, normal to the third axis.

    Args:
        inner: inner radius; unit: length.
        outer: outer radius; unit: length.
        angle: of the sector, up to 2 pi; unit: radians.
        center: shape (nsd,), nsd = 2 or 3; unit: length.
        elements: number of equal parts along the radius (u) and around (v).
        degrees: polynomial degrees, 1 or more along the radius and 2 or more around.

    Returns:
        NURBS surface with the sides "inner" and "outer"; a sector has "start" and "end", the whole ring is periodic.

    Raises:
        ValueError: an argument is not as above.
    """
    r = checks.positive("inner", inner)
    if checks.positive("outer", outer) <= r:
        raise ValueError(f"outer = {outer!r}: a number > inner = {inner!r} is required")
    ring = _revolved(uniform(1, 1), [[r, 0.0, 1.0], [outer, 0.0, 1.0]], _angle(angle, 2.0 * pi), degrees)
    names = {"inner": (0, 0), "outer": (0, 1)} | _ends(ring, "start", "end")
    return _equal_parts(Patch(ring.bases, ring.control @ _flat(center), names), elements, degrees)


def cylinder_panel(
    *, radius: float, length: float, angle: float, elements: Sequence[int], degrees: Sequence[int]
) -> Patch:
    """Part of a cylinder such as a barrel vault, symmetric about the vertical plane through its axis.

    The axis is the first coordinate axis, from 0 to ``length``, and the third one points up: parameters (u, v) lie at
    (length u, radius sin(phi), radius cos(phi)) with phi from -angle / 2 to angle / 2. The normal points outwards.

    Args:
        radius: unit: length.
        length: along the axis; unit: length.
        angle: the whole angle of the arc, up to 2 pi; unit: radians.
        elements: number of equal parts along the axis (u) and around (v).
        degrees: polynomial degrees, 1 or more along the axis and 2 or more around.

    Returns:
        NURBS surface with the curved sides "end_0" and "end_1" and, unless it is closed and periodic, the straight ones
        "straight_0" (phi < 0) and "straight_1".

    Raises:
        ValueError: an argument is not as above.
    """
    R, L, opening = checks.positive("radius", radius), checks.positive("length", length), _angle(angle, 2.0 * pi)
    panel = _revolved(uniform(1, 1), [[R, 0.0, 1.0], [R, L, 1.0]], opening, degrees)
    c, s = np.cos(opening / 2.0), np.sin(opening / 2.0)
    to_axes = np.array([[0.0, -s, c, 0.0], [0.0, c, s, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
    names = {"end_0": (0, 0), "end_1": (0, 1)} | _ends(panel, "straight_0", "straight_1")
    return _equal_parts(Patch(panel.bases, panel.control @ to_axes, names), elements, degrees)


def sphere_cap(*, radius: float, angle: float, elements: Sequence[int], degrees: Sequence[int]) -> Patch:
    """Part of a sphere around its pole (0, 0, radius); the centre is the origin and the normal points outwards.

    Args:
        radius: unit: length.
        angle: from the pole to the rim, less than pi (pi / 2: a hemisphere); unit: radians.
        elements: number of equal parts along the meridians (u) and around (v).
        degrees: polynomial degrees, 2 or more.

    Returns:
        NURBS surface, periodic in v, with the side "rim" and the degenerate side "pole", where all control points are
        one.

    Raises:
        ValueError: an argument is not as above.
    """
    R = checks.positive("radius", radius)
    if _angle(angle, pi) == pi:
        raise ValueError(f"angle = {angle!r}: less than pi is required")
    basis, meridian = _arc(angle, 2)
    cap = _revolved(basis, meridian[:, [1, 0, 2]] * [R, R, 1.0], 2.0 * pi, degrees)
    return _equal_parts(Patch(cap.bases, cap.control, {"pole": (0, 0), "rim": (0, 1)}), elements, degrees)


def leaflet(
    index: int,
    *,
    radius: float = 1.1,
    overlap: float = 0.03,
    gap: float = 0.028,
    z_bottom: float = -0.06,
    z_post: float = 0.60,
    z_top: float = 0.94,
    opening: float = 0.15,
    sag: float = 0.08,
    belly: float = 0.12,
    elements: Sequence[int] = (20, 16),
    degrees: Sequence[int] = (3, 3),
) -> Patch:
    """One leaflet of a heart valve of three; the axis is the third coordinate axis, and blood flows along it.

    With s = 2 u - 1, R_a = radius + overlap and a = pi / 3 - gap / (2 radius), in the leaflet's own frame (radial,
    tangential, axial), the attached edge is A = (R_a cos(a s), R_a sin(a s), z_bottom + (z_post - z_bottom) s^2), the
    free edge F = (sqrt(d^2 + (x^2 - d^2) s^2), y s, z_top - sag (1 - s^2)) with d = opening and (x, y) = R_a (cos a,
    sin a), and the surface (1 - v) F + v A - 4 belly (1 - s^2) v (1 - v) e_z. The normal points upstream and inwards.

    Args:
        index: 0, 1 or 2; the leaflet's middle is at the azimuth pi / 3 + 2 pi index / 3.
        radius: of the wall; unit: length, as of all that follow.
        overlap: how far the attached edge lies beyond the wall.
        gap: between neighbouring leaflets along the wall.
        z_bottom: height of the lowest point of the attached edge.
        z_post: height where the posts (u = 0 and u = 1) begin.
        z_top: height where they end.
        opening: distance of the middle of the free edge from the axis.
        sag: how much lower the middle of the free edge is than its ends.
        belly: how much lower the middle is than halfway between the edges.
        elements: number of Bezier elements from post to post (u) and from the free to the attached edge (v).
        degrees: polynomial degrees.

    Returns:
        B-spline surface that interpolates this at the Greville points, with the sides "post_0", "post_1", "free" and
        "attachment".

    Raises:
        ValueError: an argument is not positive (heights: finite, overlap, sag and belly: not negative), the heights are
            not in order, or the gap is as wide as a third of the wall.
    """
    azimuth = pi / 3.0 + 2.0 * pi / LEAFLETS * checks.choice("index", index, tuple(range(LEAFLETS)))
    R_a = checks.positive("radius", radius) + checks.not_negative("overlap", overlap)
    a = pi / LEAFLETS - checks.positive("gap", gap) / (2.0 * radius)
    if a <= 0.0:
        raise ValueError(f"gap = {gap!r}: less than a third of the wall, {2.0 * pi / LEAFLETS * radius:g}, is required")
    z_b, z_p, z_t = (checks.finite(*it) for it in (("z_bottom", z_bottom), ("z_post", z_post), ("z_top", z_top)))
    if not z_b < z_p < z_t:
        raise ValueError(f"z_bottom, z_post, z_top = {z_b:g}, {z_p:g}, {z_t:g}: increasing heights are required")
    d = checks.positive("opening", opening)
    drop, b = checks.not_negative("sag", sag), checks.not_negative("belly", belly)
    x, y = R_a * np.cos(a), R_a * np.sin(a)

    def position(u: Any, v: Any) -> list[Any]:
        s = 2.0 * u - 1.0
        r = (1.0 - v) * np.sqrt(d**2 + (x**2 - d**2) * s**2) + v * R_a * np.cos(a * s)
        t = (1.0 - v) * y * s + v * R_a * np.sin(a * s)
        z = (1.0 - v) * (z_t - drop * (1.0 - s**2)) + v * (z_b + (z_p - z_b) * s**2)
        z -= 4.0 * b * (1.0 - s**2) * v * (1.0 - v)
        return [r * np.cos(azimuth) - t * np.sin(azimuth), r * np.sin(azimuth) + t * np.cos(azimuth), z]

    names = {"post_0": (0, 0), "post_1": (0, 1), "free": (1, 0), "attachment": (1, 1)}
    return interpolated(position, uniform_bases(degrees, elements, 2), names)


def trileaflet(**parameters: Any) -> tuple[Patch, Patch, Patch]:
    """The three leaflets of a heart valve.

    Args:
        parameters: see :func:`leaflet`, the same for all three.

    Returns:
        Leaflets 0, 1 and 2.
    """
    first, second, third = (leaflet(index, **parameters) for index in range(LEAFLETS))
    return first, second, third


def _angle(value: float, limit: float) -> float:
    angle = checks.positive("angle", value)
    if angle > limit + ROUNDING:
        raise ValueError(f"angle = {value!r}: a number <= {limit:.6g} is required")
    return angle


def _flat(center: ArrayLike) -> FloatArray:
    """Matrix that moves homogeneous rows (w x, w y, w z, w) by ``center`` and drops z when this lies in the plane."""
    c = checks.array("center", center, (None,))
    if len(c) not in (2, 3):
        raise ValueError(f"center has {len(c)} coordinates: 2 or 3 are required")
    move = np.eye(4)
    move[3, : len(c)] = c
    return move[:, [*range(len(c)), 3]]


def _ends(patch: Patch, first: str, last: str) -> dict[str, tuple[int, int]]:
    """Names of the sides v0 and v1, where there are any."""
    return {} if patch.bases[1].periodic else {first: (1, 0), last: (1, 1)}


def _arc(angle: float, degree: int) -> tuple[BSplineBasis, FloatArray]:
    """Arc of the unit circle from the first axis over [0, 1]: basis and homogeneous control points (w x, w y, w)."""
    if abs(angle - 2.0 * pi) <= ROUNDING:
        from splipy import curve_factory

        circle = curve_factory.circle(type="p4C1" if degree >= 4 else "p2C0")
        circle.reparam((0.0, 1.0))
        patch = Patch.from_splipy(circle)
        return patch.bases[0], patch.control
    spans = ceil(angle / (pi / 2.0) - ROUNDING)
    half, i = angle / (2.0 * spans), np.arange(2 * spans + 1)
    weight = np.where(i % 2, np.cos(half), 1.0)
    basis = BSplineBasis(2, open_knots(2, np.linspace(0.0, 1.0, spans + 1), 0))
    return basis, np.column_stack([np.cos(half * i), np.sin(half * i), weight])


def _revolved(basis: BSplineBasis, profile: ArrayLike, angle: float, degrees: Sequence[int]) -> Patch:
    """Surface of revolution about the third axis (Piegl and Tiller, The NURBS Book, 2nd edition, section 8.5).

    Args:
        basis: of the profile.
        profile: homogeneous control points (w r, w z, w), shape (n, 3), in the plane of the first axis.
        angle: of the revolution.
        degrees: those wanted in the end, which decide on the circle.

    Returns:
        The surface, u along the profile and v around.
    """
    one_per_direction(2, degrees=degrees)
    around, circle = _arc(angle, checks.whole("degrees", degrees[1], 2))
    (r, z, w), (c, s, h) = np.transpose(profile), circle.T
    columns = [np.outer(a, b).ravel(order="F") for a, b in ((r, c), (r, s), (z, h), (w, h))]
    return Patch((basis, around), np.column_stack(columns))


def _equal_parts(patch: Patch, elements: Sequence[int], degrees: Sequence[int]) -> Patch:
    """The same geometry with every direction cut in equal parts besides its own breakpoints, and elevated degrees."""
    one_per_direction(patch.dim, elements=elements, degrees=degrees)
    ticks = [np.linspace(0.0, 1.0, checks.whole("elements", n, 1) + 1) for n in elements]
    return patch.on([b.elevated(p).with_knots(t) for b, p, t in zip(patch.bases, degrees, ticks, strict=True)])
