"""Meshes that move by a given map, or as a fictitious elastic solid."""

import re

import numpy as np
import pytest
import ufl
from mpi4py import MPI
from dolfinx import fem

from tigar_x import compat
from tigar_x.fem.linear import SolveError, gmres_ilu
from tigar_x.fem.schemes import backward_euler, companion, generalized_alpha
from varmint.forms.ale import position
from varmint.forms.motion import ElasticMotion, MeshInversionError, MeshMotion, PrescribedMotion
from varmint.mesh import box, grid, named
from varmint.mesh.arrays import from_arrays

COMM = MPI.COMM_WORLD
SIDES = ("left", "right", "bottom", "top")
FACES = (*SIDES, "back", "front")
EULER, ALPHA = backward_euler(), generalized_alpha(0.5)
DT = 0.1


def brick(cell, n=3):
    d = 3 if cell in ("tetrahedron", "hexahedron") else 2
    return box(COMM, (0.0,) * d, (1.0,) * d, (n,) * d, cell)


def largest(array):
    return COMM.allreduce(float(np.abs(array).max(initial=0.0)), op=MPI.MAX)


def nodes(moving):
    """Coordinates at rest, and a function's nodal values, of all local nodes."""
    V = moving.time.x.function_space
    d = V.mesh.geometry.dim
    return V.tabulate_dof_coordinates()[:, :d], lambda f: f.x.array.reshape(-1, d)


def step(moving):
    moving.time.predict()
    moving.move()
    moving.time.advance()


# -- prescribed motion ------------------------------------------------------------------------------------------------


def wave(x, t):
    """With rate and second rate below."""
    return ufl.as_vector([0.1 * ufl.sin(3 * t) * x[1] ** 2, 0.05 * ufl.exp(-t) * x[0] + 0.2 * t])


def wave_at(x, t, rate):
    s = (np.sin(3 * t), 3 * np.cos(3 * t), -9 * np.sin(3 * t))[rate]
    linear = (0.2 * t, 0.2, 0.0)[rate]
    return np.column_stack([0.1 * s * x[:, 1] ** 2, 0.05 * (-1.0) ** rate * np.exp(-t) * x[:, 0] + linear])


@pytest.mark.mpi
@pytest.mark.parametrize(("cell", "degree"), [("triangle", 1), ("triangle", 2), ("quadrilateral", 1)])
def test_displacement_is_that_of_the_map_at_the_nodes(cell, degree):
    """Before the first step at the initial time, with the rates of the map, and then at the end of every step."""
    moving = PrescribedMotion(brick(cell), wave, DT, ALPHA, degree)
    x, at = nodes(moving)
    time = moving.time
    for f, rate in ((time.x, 0), (time.x_old, 0), (time.xdot_old, 1), (time.xddot_old, 2)):
        np.testing.assert_allclose(at(f), wave_at(x, 0.0, rate), atol=1e-15)
    assert (time.time, float(time.t.value)) == (0.0, DT)
    for n in (1, 2):
        time.predict()
        moving.move()
        np.testing.assert_allclose(at(time.x), wave_at(x, n * DT, 0), rtol=1e-13, atol=1e-15)
        time.advance()
        np.testing.assert_allclose(at(time.x_old), wave_at(x, n * DT, 0), rtol=1e-13, atol=1e-15)
    assert moving.degree == moving.motion.degree == moving.end.degree == degree


@pytest.mark.mpi
def test_a_step_of_another_size():
    moving = PrescribedMotion(brick("triangle"), wave, DT, ALPHA)
    x, at = nodes(moving)
    moving.time.step_size = 0.03
    moving.time.predict()
    moving.move()
    np.testing.assert_allclose(at(moving.time.x), wave_at(x, 0.03, 0), rtol=1e-13, atol=1e-15)


def velocity_error(steps, scheme, until=0.8):
    """Largest error of the velocity at the end."""
    moving = PrescribedMotion(brick("triangle"), wave, until / steps, scheme)
    x, at = nodes(moving)
    for _ in range(steps):
        step(moving)
    return largest(at(moving.time.xdot_old) - wave_at(x, until, 1))


@pytest.mark.mpi
@pytest.mark.parametrize(("scheme", "order"), [(EULER, 1), (ALPHA, 2), (generalized_alpha(0.0), 2)])
def test_velocity_follows_the_map_with_the_order_of_the_scheme(scheme, order):
    """The rates of the map are what they start from."""
    errors = [velocity_error(n, scheme) for n in (10, 20, 40, 80)]
    rate = np.log2(errors[-2] / errors[-1])
    assert rate == pytest.approx(order, abs=0.15)
    assert errors[-1] < (0.02 if order == 1 else 1e-3)


@pytest.mark.mpi
def test_levels_of_a_motion():
    """Displacement and velocity in the forms are those at the level of the equations, and those at the end of it."""
    moving = PrescribedMotion(brick("triangle"), wave, DT, ALPHA)
    time, domain = moving.time, moving.mesh.domain
    moving.move()
    assert time.scheme == companion(ALPHA)
    rate = time.rates()[0]
    a = time.scheme.alpha_f
    arrays = [
        a * time.x.x.array + (1 - a) * time.x_old.x.array,
        a * rate + (1 - a) * time.xdot_old.x.array,
        time.x.x.array,
        rate,
    ]
    found = fem.Function(time.x.function_space)
    motions = moving.motion.displacement, moving.motion.velocity, moving.end.displacement, moving.end.velocity
    for expression, array in zip(motions, arrays, strict=True):
        compat.interpolate(found, expression)
        np.testing.assert_allclose(found.x.array, array, rtol=1e-12, atol=1e-15)
    assert largest(arrays[0] - arrays[2]) > 1e-3
    compat.interpolate(found, position(domain, moving.end))
    x, at = nodes(moving)
    np.testing.assert_allclose(at(found), x + wave_at(x, DT, 0), atol=1e-14)


def test_a_map_of_a_wrong_shape():
    with pytest.raises(ValueError, match=r"^displacement has shape \(3,\): shape \(2,\) is required"):
        PrescribedMotion(brick("triangle"), lambda x, t: ufl.as_vector([0.0, t, t]), DT, EULER)


@pytest.mark.parametrize("make", [PrescribedMotion, ElasticMotion])
@pytest.mark.parametrize(
    ("change", "message"),
    [
        (dict(degree=0), "^degree = 0: an integer >= 1"),
        (dict(dt=0.0), r"^dt = 0.0: a number > 0"),
        (dict(scheme=companion(EULER)), "^order of scheme = 2: one of 1 is required"),
    ],
)
def test_bad_numbers(make, change, message):
    what = {PrescribedMotion: wave, ElasticMotion: {"left": None}}[make]
    with pytest.raises(ValueError, match=message):
        make(brick("triangle"), what, **(dict(dt=DT, scheme=EULER) | change))


# -- cells that are inside out ----------------------------------------------------------------------------------------


@pytest.mark.mpi
@pytest.mark.parametrize(
    ("cell", "degree"),
    [
        ("triangle", 1),
        ("quadrilateral", 1),
        ("triangle", 2),
        ("quadrilateral", 2),
        ("tetrahedron", 1),
        ("hexahedron", 1),
    ],
)
def test_volume_ratio(cell, degree):
    """That of an affine map in every cell; of one that folds, the smallest, negative, and where it is."""
    mesh = brick(cell)
    d = mesh.domain.geometry.dim
    A = np.array([[0.1, 0.3, -0.2], [-0.1, -0.2, 0.1], [0.2, 0.0, 0.3]])[:d, :d]
    moving = MeshMotion(mesh, DT, EULER, degree)
    assert moving.smallest_volume_ratio() == pytest.approx(1.0, rel=1e-14)
    x, at = nodes(moving)
    at(moving.time.x)[:] = x @ A.T
    assert moving.smallest_volume_ratio() == pytest.approx(np.linalg.det(np.eye(d) + A), rel=1e-12)
    moving.check()
    at(moving.time.x)[:] = 0.0
    far = np.isclose(x, 1.0).all(axis=1)
    at(moving.time.x)[far] = -0.9  # a corner of the mesh through its cells
    assert moving.smallest_volume_ratio() < 0.0
    with pytest.raises(MeshInversionError) as caught:
        moving.check()
    found = re.search(r"a cell at \((.*)\) has the .* J = (-[\d.]+)", str(caught.value))
    place = np.array([float(number) for number in found[1].split(",")])
    assert len(place) == d
    assert (place > 2 / 3).all()
    assert (place < 1).all()
    assert float(found[2]) == pytest.approx(moving.smallest_volume_ratio(), rel=1e-2)
    assert f"at t = {DT:g}:" in str(caught.value)


@pytest.mark.mpi
def test_cells_that_are_inside_out_between_their_corners():
    """A quadratic displacement that vanishes at all vertices; its largest slope is found at the nodes of the edges."""
    moving = MeshMotion(brick("triangle", 2), DT, EULER, 2)
    x, at = nodes(moving)
    middle = np.isclose(x, [0.25, 0.0]).all(axis=1)
    at(moving.time.x)[middle, 0] = 0.12
    assert 0.0 < moving.smallest_volume_ratio() < 0.1
    at(moving.time.x)[middle, 0] = 0.13
    assert moving.smallest_volume_ratio() < 0.0


@pytest.mark.mpi
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_displacement_that_is_not_finite(value):
    moving = MeshMotion(brick("triangle"), DT, EULER)
    if COMM.rank == COMM.size - 1:
        moving.time.x.x.array[0] = value
    with pytest.raises(MeshInversionError, match=r"J = -inf"):
        moving.check()


# -- elastic meshes ---------------------------------------------------------------------------------------------------


def turn(x, angle, about=(0.5, 0.5)):
    """Displacement of a rotation in the plane of the first two axes."""
    r = x[0] - about[0], x[1] - about[1]
    c, s = ufl.cos(angle), ufl.sin(angle)
    return ufl.as_vector([(c - 1) * r[0] - s * r[1], s * r[0] + (c - 1) * r[1]])


@pytest.mark.mpi
@pytest.mark.parametrize(
    ("cell", "degree"), [("triangle", 1), ("triangle", 2), ("quadrilateral", 1), ("tetrahedron", 1)]
)
def test_a_translation_of_the_boundary_translates_all_nodes(cell, degree):
    mesh = brick(cell)
    d = mesh.domain.geometry.dim
    direction = np.array([0.7, -1.3, 0.4])[:d]

    def shift(x, t):
        return ufl.as_vector([float(c) * t for c in direction])

    moving = ElasticMotion(mesh, dict.fromkeys(FACES[: 2 * d], shift), DT, ALPHA, degree)
    _, at = nodes(moving)
    for n in range(1, 4):
        step(moving)
        assert largest(at(moving.time.x) - n * DT * direction) < 1e-7
    assert moving.smallest_volume_ratio() == pytest.approx(1.0, rel=1e-6)


@pytest.mark.mpi
@pytest.mark.parametrize("cell", ["triangle", "quadrilateral"])
def test_a_rotation_of_the_boundary_rotates_all_nodes(cell):
    """Rigid motion costs the fictitious solid nothing, up to a quarter of a turn and more."""
    moving = ElasticMotion(brick(cell), dict.fromkeys(SIDES, lambda x, t: turn(x, t)), 0.2, EULER, rtol=1e-9)
    x, at = nodes(moving)
    while moving.time.time < 1.6:
        step(moving)
    angle = moving.time.time
    R = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    assert largest(at(moving.time.x) - (x - 0.5) @ (R.T - np.eye(2))) < 1e-7
    assert moving.smallest_volume_ratio() == pytest.approx(1.0, rel=1e-6)


@pytest.mark.mpi
def test_groups_that_are_not_named_move_freely():
    """Held at one side and turned at none, a mesh that is moved at the other follows as a whole only if it is free."""
    push = {"left": lambda x, t: ufl.as_vector([t, 0.5 * t])}
    free = ElasticMotion(brick("triangle"), push, DT, EULER, rtol=1e-9)
    held = ElasticMotion(brick("triangle"), push | {"right": None}, DT, EULER)
    for moving in (free, held):
        step(moving)
    x, at = nodes(free)
    assert largest(at(free.time.x) - [DT, 0.5 * DT]) < 1e-7
    right, left = np.isclose(x[:, 0], 1.0), np.isclose(x[:, 0], 0.0)
    np.testing.assert_array_equal(at(held.time.x)[right], 0.0)
    np.testing.assert_allclose(at(held.time.x)[left] - [DT, 0.5 * DT], 0.0, atol=1e-15)


@pytest.mark.mpi
def test_data_belong_to_coordinates_at_rest():
    """However far the mesh has gone."""
    moving = ElasticMotion(brick("triangle"), {"left": lambda x, t: ufl.as_vector([x[1] * t, t])}, DT, EULER)
    x, at = nodes(moving)
    for _ in range(3):
        step(moving)
    left = np.isclose(x[:, 0], 0.0)
    expected = 3 * DT * np.column_stack([x[left, 1], np.ones(left.sum())])
    np.testing.assert_allclose(at(moving.time.x)[left], expected, atol=1e-14)


def frame(n=8):
    """A square with a square hole of a quarter of its side, and smaller cells around the hole."""
    line = np.concatenate([np.linspace(0.0, 0.35, 4), np.linspace(0.375, 0.625, 6), np.linspace(0.65, 1.0, 4)])
    full = grid(MPI.COMM_SELF, [line, line])
    x, cells = full.domain.geometry.x[:, :2], compat.cell_nodes(full.domain)
    middles = x[cells].mean(axis=1)
    kept = cells[(np.abs(middles - 0.5) > 0.125).any(axis=1)]
    whole = from_arrays(COMM, "triangle", kept, x)
    hole = [lambda p: (np.abs(p[:2] - 0.5) < 0.1251).all(axis=0)]
    outer = [lambda p, i=i, e=e: np.isclose(p[i], e) for i in (0, 1) for e in (0.0, 1.0)]
    return named(whole.domain, hole=hole, outer=outer)


def shrunk(until, **options):
    """Smallest volume ratio of a mesh whose hole moves sideways by ``until`` and shrinks by as much."""

    def displacement(x, t):
        return ufl.as_vector([t - t * (x[0] - 0.5), -t * (x[1] - 0.5)])

    moving = ElasticMotion(frame(), {"hole": displacement, "outer": None}, until / 5, EULER, **options)
    for _ in range(5):
        step(moving)
    return moving.smallest_volume_ratio()


@pytest.mark.mpi
def test_a_hole_that_moves_and_shrinks_leaves_no_cell_inside_out():
    ratio = shrunk(0.2)
    assert 0.2 < ratio < 1.0


@pytest.mark.mpi
def test_small_cells_are_deformed_less_where_they_are_stiffer():
    """And cells that are compressed as well."""
    sizes = [shrunk(0.15, size_stiffening=b) for b in (0.0, 1.0, 2.0)]
    assert sizes[0] < sizes[1] - 0.02
    # with an exponent of 0 cells are inside out, and whether a balance is found hangs on rounding
    powers = [shrunk(0.1, size_stiffening=0.0, stiffening=a) for a in (1.0, 3.0)]
    assert powers[0] < powers[1] - 0.1


def test_size_stiffening_does_not_see_the_unit_of_length():
    """Cells are small relative to the others."""
    found = []
    for scale in (1.0, 1e-3):
        mesh = grid(MPI.COMM_SELF, [scale * np.array([0.0, 0.1, 0.3, 1.0])] * 2)
        moving = ElasticMotion(
            mesh, {"left": lambda x, t, s=scale: ufl.as_vector([s * t, 0.0 * t]), "right": None}, DT, EULER
        )
        step(moving)
        found.append(moving.time.x.x.array / scale)
    np.testing.assert_allclose(found[1], found[0], rtol=0, atol=1e-8)


@pytest.mark.mpi
def test_a_boundary_that_goes_through_the_mesh_is_refused():
    """And the state of the motion is restored by whoever steps it."""
    push = {"left": lambda x, t: ufl.as_vector([15 * t, 0.0 * t]), "right": None}
    moving = ElasticMotion(brick("triangle"), push, DT, EULER)

    def attempt():
        moving.time.predict()
        moving.move()
        moving.check()

    with pytest.raises(SolveError):
        attempt()
    moving.time.restore()
    assert not moving.time.x.x.array.any()
    moving.time.step_size = 0.01
    attempt()
    assert 0.0 < moving.smallest_volume_ratio() < 1.0


@pytest.mark.mpi
def test_a_displacement_in_parts():
    """One step so large that the cells at the wall could not follow at once ends where small steps do."""
    found = []
    for steps in (1, 8):
        push = {"left": lambda x, t: ufl.as_vector([0.6 * t, 0.0 * t]), "right": None}
        moving = ElasticMotion(brick("triangle", 4), push, 1.0 / steps, EULER, rtol=1e-10)
        for _ in range(steps):
            step(moving)
        found.append(moving.time.x.x.array.copy())
        assert moving.smallest_volume_ratio() > 0.1
    np.testing.assert_allclose(found[0], found[1], rtol=0, atol=1e-5)


@pytest.mark.mpi
def test_an_iterative_solver_serves_as_well():
    push = {"left": lambda x, t: ufl.as_vector([t, 0.3 * t]), "right": None}
    found = []
    for solver in (None, gmres_ilu(1, rtol=1e-10)):
        moving = ElasticMotion(brick("triangle"), push, DT, EULER, rtol=1e-9, solver=solver)
        step(moving)
        found.append(moving.time.x.x.array.copy())
    np.testing.assert_allclose(found[1], found[0], rtol=0, atol=1e-8)


# -- parts of the mesh ------------------------------------------------------------------------------------------------


def two_parts():
    mesh = brick("triangle", 4)
    sides = {name: lambda x, i=i: np.isclose(x[i // 2], float(i % 2)) for i, name in enumerate(SIDES)}
    halves = {"lower": lambda x: x[1] < 0.501, "upper": lambda x: x[1] > 0.499}
    return named(mesh.domain, cells=halves, **sides)


@pytest.mark.mpi
def test_other_cells_stay_where_they_have_been_put():
    """The nodes of both parts belong to the one that is not elastic."""
    moving = ElasticMotion(two_parts(), {"top": None}, DT, EULER, cells=("upper",))
    x, at = nodes(moving)
    lower = np.flatnonzero(x[:, 1] < 0.501)
    assert moving.cells == ("upper",)
    assert COMM.allreduce(np.array_equal(np.sort(moving.solid_nodes), lower), op=MPI.LAND)
    shift = np.array([0.05, -0.1])
    at(moving.time.x)[lower] = shift
    moving.begin()
    moving.relax()
    np.testing.assert_array_equal(at(moving.time.x)[lower], np.broadcast_to(shift, (len(lower), 2)))
    np.testing.assert_array_equal(at(moving.time.x)[np.isclose(x[:, 1], 1.0)], 0.0)
    inner = np.isclose(x[:, 1], 0.75)
    assert (at(moving.time.x)[inner, 1] < -0.02).all()
    assert (at(moving.time.x)[inner, 1] > -0.08).all()


@pytest.mark.parametrize(
    ("displacements", "options", "message"),
    [
        ({}, {}, "^displacements is empty: at least one facet group has to be held or moved"),
        ({"lid": None}, {}, "^facet group 'lid' does not exist: one of 'left', 'right', 'bottom', 'top'"),
        ({"left": None}, dict(cells=("fluid",)), "^cell group 'fluid' does not exist: one of 'lower', 'upper'"),
        ({"left": None}, dict(stiffening=-1.0), r"^stiffening = -1.0: a number >= 0"),
        ({"left": None}, dict(size_stiffening=np.nan), r"^size_stiffening = nan"),
        ({"left": None}, dict(rtol=0.0), r"^rtol = 0.0: a number > 0"),
    ],
)
def test_bad_elastic_motions(displacements, options, message):
    with pytest.raises(ValueError, match=message):
        ElasticMotion(two_parts(), displacements, DT, EULER, **options)


def test_data_of_a_wrong_shape():
    message = r"^displacements\['left'\] has shape \(3,\): shape \(2,\) is required"
    with pytest.raises(ValueError, match=message):
        ElasticMotion(brick("triangle"), {"left": lambda x, t: ufl.as_vector([t, t, t])}, DT, EULER)
