"""Lines where functions are only C0: along which of them a shell can fold, and what keeps it from doing so."""

import logging

import numpy as np
import pytest
import scipy.sparse as sp
import ufl
from mpi4py import MPI

from shnapr.hyperelastic import Hyperelastic, neo_hookean
from shnapr.loads import dead_load
from shnapr.supports import pinned
from shnapr.svk import StVenantKirchhoff
from shnapr.work import internal_tangent, internal_work, strain_energy
from tigar_x.geometry import shapes, surfaces
from tigar_x.geometry.bspline import BSplineBasis
from tigar_x.geometry.gluing import glued
from tigar_x.geometry.lines import folds
from tigar_x.geometry.multipatch import as_multipatch, disjoint
from tigar_x.geometry.patch import Patch
from tigar_x.splines.constraints import no_rotation, null_space, smooth_joints, smooth_lines
from tigar_x.splines.spline import ExtractedSpline
from tigar_x.splines.spline_system import SplineSystem, solve_linear


def folding(geometry, constraints=(), fixed=()):
    """Names of the lines along which a shell folds."""
    whole = as_multipatch(geometry)
    n = whole.n * whole.nsd
    T = null_space([sp.csr_matrix((0, n)), *constraints], np.asarray(fixed, dtype=np.int32), n)
    return [line.name for line in folds(whole, T)]


def floor(degrees=(2, 2), elements=(2, 2)):
    return shapes.parallelogram((0, 0, 0), (1, 0, 0), (0, 1, 0), elements=elements, degrees=degrees)


def flap(angle):
    """A square that begins at an edge of the other one, at an angle."""
    edge = (-np.cos(angle), 0.0, np.sin(angle))
    return shapes.parallelogram((0, 0, 0), edge, (0, 1, 0), elements=(2, 2), degrees=(2, 2))


def repeated(patch, direction, *knots):
    bases = list(patch.bases)
    bases[direction] = bases[direction].with_knots(knots)
    return patch.on(bases)


ARC = dict(radius=1.0, elements=(2, 8), degrees=(3, 3))
SPANS = [f"the line v = {v} of patch 0" for v in ("0", "0.25", "0.5", "0.75")]
JOINT = ["side u0 of patch 0 and side u0 of patch 1"]
LINES = {
    "smooth": (floor(), []),
    "double knot": (repeated(floor(elements=(1, 1)), 1, 0.5, 0.5), ["the line v = 0.5 of patch 0"]),
    "double knot of a cubic": (repeated(floor((3, 3), (1, 1)), 1, 0.5, 0.5), []),
    "degree 1 across": (floor((2, 1)), ["the line v = 0.5 of patch 0"]),
    "one element of degree 1": (floor((2, 1), (2, 1)), []),
    "joint": (glued(floor(), flap(0.0)), JOINT),
    "joint backwards": (glued(floor(), flap(0.0).reversed(1)), JOINT),
    "at an angle": (glued(floor(), flap(1.0)), JOINT),
    "apart": (disjoint(floor(), flap(0.0)), []),
    "three": (
        glued(floor(), flap(0.0), flap(1.0)),
        [*JOINT, "side u0 of patch 0 and side u0 of patch 2", "side u0 of patch 1 and side u0 of patch 2"],
    ),
    "long arc": (surfaces.cylinder_panel(length=2.0, angle=3.0, **ARC), ["the line v = 0.5 of patch 0"]),
    "short arc": (surfaces.cylinder_panel(length=2.0, angle=1.5, **ARC), []),
    "polar disc": (surfaces.disc(kind="polar", **ARC), SPANS),
    "polar disc of degree 4": (surfaces.disc(kind="polar", **ARC | dict(degrees=(4, 4))), []),
    "with a pole": (glued(surfaces.disc(kind="polar", **ARC), within=True), SPANS),
    "curve": (
        glued(*(shapes.line((x, 0), (x + 1, 0), elements=2, degree=2) for x in (0, 1))),
        ["side u1 of patch 0 and side u0 of patch 1"],
    ),
    "curve of degree 1": (shapes.line((0, 0), (1, 0), elements=2, degree=1), ["the line u = 0.5 of patch 0"]),
}


@pytest.mark.parametrize(("geometry", "expected"), LINES.values(), ids=LINES)
def test_lines_along_which_a_shell_folds(geometry, expected):
    assert sorted(folding(geometry)) == sorted(expected)


@pytest.mark.parametrize("name", ["joint", "joint backwards", "curve"])
def test_smooth_joints_do_not_fold(name):
    geometry = LINES[name][0]
    assert folding(geometry, [smooth_joints(geometry)]) == []


@pytest.mark.parametrize("name", ["double knot", "long arc", "polar disc", "with a pole"])
def test_smooth_lines_do_not_fold(name):
    geometry = LINES[name][0]
    assert folding(geometry, [smooth_lines(geometry)]) == []


def test_what_supports_hold_does_not_fold():
    geometry = glued(floor(), flap(1.0))
    assert folding(geometry, fixed=geometry.side_dofs("u0", 2)) == []
    assert folding(geometry, fixed=geometry.side_dofs("u0", 1)) == JOINT
    assert folding(geometry, fixed=geometry.side_dofs("u0", 2, patch=0)) == JOINT
    held = [no_rotation(geometry, "u0", patch=k) for k in (0, 1)]
    assert folding(geometry, held) == []
    assert folding(geometry, held[:1]) == JOINT


def test_lines_that_cannot_be_smooth_are_refused():
    bent = Patch.from_points([BSplineBasis(2, [0, 0, 0, 1, 1, 2, 2, 2])], [[0, 0], [1, 0], [2, 0], [2, 1], [2, 2]])
    with pytest.raises(ValueError, match="both sides of the line u = 1 of patch 0 meet at an angle"):
        smooth_lines(bent)
    for patch in (floor(), floor((1, 1))):
        with pytest.raises(ValueError, match="no line inside a patch, of degree 2 or more"):
            smooth_lines(patch)


# -- shells ------------------------------------------------------------------------------------------------------------

SVK = StVenantKirchhoff(1e6, 0.3, 0.01)


def said(caplog):
    return [record.getMessage() for record in caplog.records if record.name == "shnapr.smoothness"]


@pytest.mark.mpi
def test_a_shell_of_degree_1_is_refused_unless_it_cannot_bend_or_move():
    plate = floor((1, 1), (4, 4))
    spline = ExtractedSpline(plate)
    y, z = spline.function(), ufl.TestFunction(spline.V)
    bending = (SVK, Hyperelastic(neo_hookean(1e3), 0.1))
    membranes = (StVenantKirchhoff(1e6, 0.3, 0.01, bending=False), Hyperelastic(neo_hookean(1e3), 0.1, points=1))
    for material in bending:
        with pytest.raises(ValueError, match=r"spline has degree 1 in patch 0, .* degree 2 or more is required"):
            strain_energy(spline, material, y)
        with pytest.raises(ValueError, match="or a material without bending"):
            internal_work(spline, material, y, z)
    for material in membranes:
        assert strain_energy(spline, material, y).integrals()
    rigid = ExtractedSpline(plate, zero_dofs=np.arange(plate.n * 3))
    assert strain_energy(rigid, SVK, rigid.function()).integrals()


@pytest.mark.mpi
def test_a_shell_that_folds_says_so_once_and_a_membrane_or_a_smooth_one_does_not(caplog):
    geometry = LINES["long arc"][0]
    membrane = StVenantKirchhoff(1e6, 0.3, 0.01, bending=False)
    with caplog.at_level(logging.WARNING):
        folded, smooth = ExtractedSpline(geometry), ExtractedSpline(geometry, constraints=[smooth_lines(geometry)])
        strain_energy(smooth, SVK, smooth.function())
        strain_energy(folded, membrane, folded.function())
        assert said(caplog) == []
        for _ in range(2):
            internal_work(folded, SVK, folded.function(), ufl.TestFunction(folded.V))
    (message,) = said(caplog)
    assert "functions are only C0 at the line v = 0.5 of patch 0: it turns there as on a hinge" in message
    assert "[smooth_lines(geometry)]" in message
    assert "smooth_joints" in message


@pytest.mark.mpi
def test_many_folds_are_not_all_named(caplog):
    spline = ExtractedSpline(floor((2, 1), (1, 9)))
    with caplog.at_level(logging.WARNING):
        strain_energy(spline, SVK, spline.function())
    assert "and 4 more" in said(caplog)[0]


@pytest.mark.mpi
def test_a_clamped_polar_disc_sinks_as_it_should_with_smooth_lines():
    """In the middle q R^4/(64 D), which hinges along the four spans of the circle more than double."""
    q = 1e-4
    geometry = glued(surfaces.disc(kind="polar", radius=1.0, elements=(4, 8), degrees=(3, 3)), within=True)
    sunk = []
    for constraints in ([], [smooth_lines(geometry)]):
        conditions = [no_rotation(geometry, "rim"), *constraints]
        spline = ExtractedSpline(
            geometry, MPI.COMM_SELF, zero_dofs=pinned(geometry, "rim"), constraints=conditions, quadrature_degree=6
        )
        y, z = spline.function(), ufl.TestFunction(spline.V)
        residual = internal_work(spline, SVK, y, z) + dead_load(spline, (0.0, 0.0, -q), z)
        solve_linear(SplineSystem(spline, residual, internal_tangent(spline, SVK, y, z, y), unknown=y))
        sunk.append(-spline.evaluate(y, [[0.0, 0.3]])[0, 2])
    exact = q / 64 / (1e6 * 0.01**3 / 12 / (1 - 0.3**2))
    assert sunk[1] == pytest.approx(exact, rel=1e-3)
    assert sunk[0] > 2.2 * exact


def test_a_rigid_motion_folds_nothing_where_lines_cross_obliquely():
    """Coordinate lines that meet an edge at different angles: only the part across it turns about it."""
    one, other = (
        shapes.parallelogram((0, 0, 0), a, (0, 1, 0), elements=(2, 2), degrees=(2, 2))
        for a in ((1, 0.4, 0), (-1, 0.7, 0))
    )
    both = glued(one, other)
    turned = np.array([np.cross(axis, both.points).ravel() for axis in np.eye(3)]).T
    assert folds(both, sp.csr_matrix(turned)) == []
    flapping = np.where(both.points[:, :1] > 0.0, np.cross([0.0, 1.0, 0.0], both.points), 0.0).reshape(-1, 1)
    assert [line.name for line in folds(both, sp.csr_matrix(flapping))] == JOINT
